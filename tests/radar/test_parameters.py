"""What is fitted of a radar: pose, range bias, clock."""

import math

import pytest
import torch

from invertwin.capture import Capture, Track
from invertwin.radar import FMCW, ClockOffset, Radar, RadarPose, RangeBias
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
    radar = Radar(one, one, FMCW(76e9, 2e9, 50e-6, 64), track.at(times + 0.1))
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
    assert torch.allclose(shifted.positions, capture.track.at(capture.times + 0.25))


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
