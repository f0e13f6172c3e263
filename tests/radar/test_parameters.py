"""What is fitted of a radar: pose, range bias, clock."""

import math

import pytest
import torch

from invertwin.capture import Capture, Track
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar import (
    FMCW,
    ClockOffset,
    Radar,
    RadarPose,
    RadarTrajectory,
    RangeBias,
    SteppedFrequency,
    backproject_beat,
)
from invertwin.scene.antenna import AntennaArray
from invertwin.scene.parameters import Compose
from scenes import float64


def still_radar() -> Radar:
    one = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    return Radar(one, one, FMCW(76e9, 2e9, 50e-6, 64), float64([[0.0, 0, 1], [0.0, 0, 2]]))


def test_radar_pose_turns_the_radar_about_its_mean_position_and_moves_it():
    radar = still_radar()
    module = RadarPose([0.1, 0.2, 0.3], [0.0, math.pi / 2, 0.0])
    moved = module(radar)
    expected = float64([[-0.4, 0.2, 1.8], [0.6, 0.2, 1.8]])
    assert torch.allclose(moved.positions, expected)
    (moved.positions * expected).sum().backward()
    assert module.rotation.grad is not None
    assert module.rotation.grad.abs().sum() > 0
    assert torch.equal(RadarPose()(radar).positions, radar.positions)
    assert RadarPose().values()["radar.rotation"].tolist() == [0.0, 0.0, 0.0]
    assert not any(value.requires_grad for value in module.values().values())


def test_a_path_is_a_walk_from_the_first_frame():
    module = RadarTrajectory(2, drift=0.1, axes="xz")
    with torch.no_grad():
        module.latent[:] = float64([[1.0, 5.0, 0.0], [-3.0, 5.0, 2.0]])
    moved = module.displacements(5)
    expected = [[0, 0, 0], [0.05, 0.25, 0], [0.1, 0.5, 0], [-0.05, 0.75, 0.1], [-0.2, 1.0, 0.2]]
    assert torch.allclose(moved, float64(expected))
    (moved[3] * float64([1.0, 1.0, 10.0])).sum().backward()
    assert module.latent.grad is not None
    assert module.latent.grad.tolist() == [[0.1, 0.0, 1.0], [0.05, 0.0, 0.5]]  # y is held
    names = [coordinate.name for coordinate in module.coordinates()]
    assert names == ["radar.step1.x", "radar.step1.z", "radar.step2.x", "radar.step2.z"]
    assert float(module.coordinates()[1].tangents["latent"][0, 2]) == pytest.approx(10.0)
    assert module.values()["radar.displacements"][1].tolist() == pytest.approx([-0.2, 1.0, 0.2])
    with pytest.raises(InputError, match="at most 1 steps for 2 frames, got 2"):
        module(still_radar())


def test_a_path_is_refined_until_the_image_is_sharp():
    """Spotlight data from 1 km, centred where odometry was: reflectors come into focus again."""
    sweep = SteppedFrequency(1.2e9, 1.5e6, 64, 1e-6)
    turn = torch.linspace(-0.06, 0.06, 61, dtype=torch.float64)
    places = 1000 * torch.stack([turn.sin(), 0 * turn, -turn.cos()], dim=1)
    one = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    said = Radar(one, one, sweep, places).center_on([0.0, 0.0, 0.0])
    truth = RadarTrajectory(6, drift=0.03, axes="z")
    with torch.no_grad():
        truth.latent[:, 2] = float64([1.0, -1.5, -1.0, 1.2, 1.4, -1.0])
    points = float64([[0.0, 0.0, 0.0], [13.0, 0.0, -9.0], [-8.0, 0.0, 15.0]])
    real = truth(said).positions.detach()
    shown = (real[:, None] - points).norm(dim=-1) - said.origins[:, None]
    beat = torch.exp(4j * math.pi * shown[..., None] * sweep.frequencies / SPEED_OF_LIGHT).sum(1)
    found = RadarTrajectory(6, drift=0.03, axes="z")

    def loss():
        image = backproject_beat(beat[:, None, None], found(said), points)
        return -image.abs().square().sum() + 1e-3 * found.latent.square().sum()

    blurred = -float(loss().detach())
    optimizer = torch.optim.Adam(found.parameters(), lr=0.1)
    for _ in range(80):
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()
    off = (found.displacements(61) - truth.displacements(61)).detach()[:, 2]
    before = truth.displacements(61).detach()[:, 2]
    assert blurred < 1.5
    assert -float(loss().detach()) > 2.8  # 3 = all in focus
    # A shift of the whole path along the line of sight turns all phases alike: it is not seen.
    assert (off - off.mean()).abs().max() < 0.1 * before.std()


def test_modules_of_a_radar_compose():
    both = Compose(RadarPose([0.0, 1.0, 0.0]), RangeBias(0.25), RangeBias(0.5))
    moved = both(still_radar())
    assert moved.positions.tolist() == [[0.0, 1.0, 1.0], [0.0, 1.0, 2.0]]
    assert torch.equal(torch.as_tensor(moved.range_bias).detach(), float64(0.75))
    assert set(both.values()) == {"radar.translation", "radar.rotation", "range_bias"}


def test_range_bias_has_a_derivative_of_one():
    module = RangeBias(0.1)
    moved = module(still_radar())
    assert isinstance(moved.range_bias, torch.Tensor)
    moved.range_bias.backward()
    assert module.bias.grad is not None
    assert float(module.bias.grad) == 1.0


def recording() -> tuple[Capture, Radar]:
    """Empty range profiles of a radar on a track that bends."""
    one = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    times = torch.linspace(0, 1, 5, dtype=torch.float64)
    track = Track(float64([-1.0, 0.45, 2.0]), float64([[-1.0, 0, 0], [0.0, 0.2, 0], [1.5, 0, 0.1]]))
    radar = Radar(one, one, FMCW(76e9, 2e9, 50e-6, 64), track.interpolate(times + 0.1))
    profile = torch.ones(5, 4, dtype=torch.complex128)
    capture = Capture.from_range_profile(
        profile, 1 + torch.arange(4).double(), radar, times, track=track, clock_offset=0.1
    )
    return capture, radar


def test_clock_offset_moves_the_radar_along_its_track():
    capture, radar = recording()
    still, shifted = (
        ClockOffset(capture.positions)(radar),
        ClockOffset(capture.positions, 0.15)(radar),
    )
    assert torch.allclose(still.positions, radar.positions)
    assert capture.track is not None
    assert torch.allclose(shifted.positions, capture.track.interpolate(capture.times + 0.25))


def test_clock_offset_has_the_gradient_of_the_track():
    capture, radar = recording()
    module, step = ClockOffset(capture.positions, 0.02), 1e-4
    weights = torch.rand(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (weights * module(radar).positions).sum().backward()
    ends = [
        (weights * ClockOffset(capture.positions, 0.02 + s)(radar).positions).sum()
        for s in (step, -step)
    ]
    truth = float((ends[0] - ends[1]).detach()) / (2 * step)
    assert module.shift.grad is not None
    assert float(module.shift.grad) == pytest.approx(truth, rel=1e-6)
