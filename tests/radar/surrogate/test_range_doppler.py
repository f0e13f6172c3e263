"""Power in motion against the exact simulation: the same maps, point by point."""

from dataclasses import replace

import pytest
import torch

from invertwin.channel import Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar.boards import board
from invertwin.radar.processing.doppler import range_doppler_angle, velocity_axis
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps, moving_beat
from invertwin.radar.surrogate.range_doppler import range_doppler_power
from invertwin.radar.waveform import FMCW
from invertwin.scene.pose import look_at

PLACES = torch.tensor([[2.9, -0.4, 0.0], [2.4, 0.9, 0.2], [3.3, 0.1, -0.3]], dtype=torch.float64)
VELOCITIES = torch.tensor(
    [[1.4, 0.2, 0.0], [-1.1, -0.6, 0.1], [0.0, 0.0, 0.0]], dtype=torch.float64
)
POWERS = torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64)


def make_radar(name="xWR1642", elevation=None, **changes):
    waveform = FMCW(77e9, 1.5e9, 40e-6, 64)
    pose = torch.zeros(1, 3, dtype=torch.float64)
    return Radar(*board(name).arrays(elevation=elevation), waveform, pose, **changes)


def paths_of(radar, places, powers):
    link = radar.link()
    frame = torch.zeros(len(places), dtype=torch.int64)
    length = (places - link.tx[frame]).norm(dim=1) + (places - link.rx[frame]).norm(dim=1)
    return Paths(
        frame=frame,
        delay=length / SPEED_OF_LIGHT,
        coefficient=powers.sqrt().to(torch.complex128),
        power=powers,
        first=places,
        last=places,
        kind="rough",
        boundary=torch.zeros(len(places), dtype=torch.bool),
    )


def exact(radar, grid, chirps, bins):
    """The sum of the maps of every point alone: the mean over independent random phases."""
    middle = 0.5 * float(chirps.times(len(radar.transmitters.positions))[-1, 0])
    maps = []
    for place, velocity, power in zip(PLACES, VELOCITIES, POWERS, strict=True):
        start = (place - velocity * middle)[None]
        paths = replace(paths_of(radar, start, power[None]), velocity=velocity[None])
        beat = moving_beat(paths, radar, chirps)
        maps.append(range_doppler_angle(beat, radar, grid, chirps, bins=bins))
    return torch.stack(maps).sum(0)


@pytest.mark.parametrize(("name", "elevation"), [("xWR1642", None), ("xWR1843", 1)])
def test_power_in_motion_is_the_mean_of_exact_signals(name, elevation):
    radar = make_radar(name, elevation, window="hann")
    grid = radar.grid(2.0, 3.8)
    chirps = Chirps(32, 60e-6)
    paths = paths_of(radar, PLACES, POWERS)
    rates = velocity_axis(radar, chirps, 64)
    found = range_doppler_power(paths, VELOCITIES, radar, grid, chirps, rates)
    expected = exact(radar, grid, chirps, 64)
    # What is left: points at metres are no plane waves, and migrate within the frame.
    assert float((found - expected).abs().max() / expected.max()) < 0.02
    assert float((found - expected).norm() / expected.norm()) < 0.02


def test_transmitters_are_compensated_for_the_bin_not_for_the_point():
    """Off its own rate, a point in turn-taking TX shows in another direction."""
    radar = make_radar()
    grid = radar.grid(2.0, 3.8, oversample=4)
    chirps = Chirps(8, 60e-6)
    paths = paths_of(radar, PLACES[:1], POWERS[:1])
    toward = PLACES[:1] / PLACES[:1].norm()
    off = torch.tensor([-2.0, 0.0, 2.0], dtype=torch.float64)
    found = range_doppler_power(paths, 0 * toward, radar, grid, chirps, off)[0, ..., 0].amax(1)
    peaks = grid.u[found.argmax(1)]
    assert float(peaks[1]) == pytest.approx(float(toward[0, 1]), abs=grid.u_step)
    assert float((peaks[0] - peaks[2]).abs()) > 1.5 * grid.u_step
    at_once = replace(chirps, tdm=False)
    found = range_doppler_power(paths, 0 * toward, radar, grid, at_once, off)[0, ..., 0].amax(1)
    assert len(grid.u[found.argmax(1)].unique()) == 1


def test_world_and_frames_turn_with_the_radar():
    radar = make_radar()
    grid, chirps = radar.grid(2.0, 3.8), Chirps(16, 60e-6)
    rates = velocity_axis(radar, chirps)
    here = range_doppler_power(
        paths_of(radar, PLACES, POWERS), VELOCITIES, radar, grid, chirps, rates
    )
    shift = torch.tensor([3.0, 1.0, 2.0], dtype=torch.float64)
    turn = look_at(torch.zeros(1, 3, dtype=torch.float64), [1.0, 1.0, 0.0])[0]
    radars = replace(
        radar,
        positions=torch.stack([torch.zeros(3, dtype=torch.float64), shift]),
        rotations=torch.stack([torch.eye(3, dtype=torch.float64), turn]),
    )
    moved = paths_of(radar, PLACES, POWERS)
    place = PLACES @ turn.T + shift
    moved = replace(moved, frame=moved.frame + 1, first=place, last=place)
    there = range_doppler_power(moved, VELOCITIES @ turn.T, radars, grid, chirps, rates)
    torch.testing.assert_close(there[1], here[0], rtol=1e-9, atol=1e-12)
    assert not there[0].any()


@pytest.mark.claim
@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    radar = make_radar()
    grid, chirps = radar.grid(2.6, 3.2), Chirps(16, 60e-6)
    rates = velocity_axis(radar, chirps)[6:12]

    def shown(place, velocity, power):
        return range_doppler_power(
            paths_of(radar, place, power), velocity, radar, grid, chirps, rates
        )

    given = [x[:1].clone().requires_grad_() for x in (PLACES, VELOCITIES, POWERS)]
    assert torch.autograd.gradcheck(shown, given, eps=1e-5, atol=1e-4, rtol=1e-3)


def test_wrong_velocities_windows_and_grids_are_refused(unchecked):
    radar, chirps = make_radar(), Chirps(16, 60e-6)
    grid, rates = radar.grid(2.0, 3.8), torch.zeros(1, dtype=torch.float64)
    paths = paths_of(radar, PLACES, POWERS)
    with pytest.raises(InputError, match="one per path"):
        range_doppler_power(paths, VELOCITIES[:1], radar, grid, chirps, rates)
    with pytest.raises(InputError, match="got 'kaiser'"):
        range_doppler_power(paths, VELOCITIES, radar, grid, chirps, rates, window="kaiser")
    flat = replace(grid, u_count=1)
    with pytest.raises(InputError, match="resolves u"):
        range_doppler_power(paths, VELOCITIES, radar, flat, chirps, rates)
