"""Data centred on a scene: ranges that count from an origin, in every signal and map alike."""

import math
import warnings
from dataclasses import replace

import pytest
import torch

from invertwin.channel import Grid, Sampling
from invertwin.errors import InputError
from invertwin.radar import (
    FMCW,
    Chirps,
    Impairments,
    Impulse,
    Leakage,
    PhysicsWarning,
    Radar,
    RadarPose,
    SteppedFrequency,
    Surrogate,
    beat_signal,
    exact_spectrum,
    moving_beat,
    peaks,
    range_profile,
    surrogate_spectrum,
)
from invertwin.radar.signal.range_profile import fft_bins
from invertwin.radar.signal.realisations import SpeckleRealisations
from invertwin.scene import Scene, plate
from invertwin.scene.antenna import linear_array
from scenes import float64, thing

CENTER = float64([100.0, 0.0, 0.0])
SWEEP = SteppedFrequency(9.7e9, 1.5e6, 64, 1e-5)  # 99.9 m unambiguous, 1.56 m cells


def far(positions: object = ((0.0, 0.0, 0.0), (-2.0, 3.0, 0.0)), waveform=SWEEP) -> Radar:
    """A radar 100 m away from the centre of its scene."""
    one = linear_array(1, 1.0)
    return Radar(one, one, waveform, float64(positions))


def echo(point_paths, radar: Radar, point: object):
    """One point, seen in every frame."""
    frames = radar.frame_count
    places = float64(point).expand(frames, 3)
    return point_paths(radar, places, torch.ones(frames), torch.arange(frames))


@pytest.mark.parametrize("waveform", [SWEEP, FMCW(9.7e9, 96e6, 1e-3, 64)], ids=["step", "ramp"])
def test_an_origin_takes_its_delay_off(waveform, point_paths):
    """What is 104 m away looks as if it were 4 m away: on a ramp, too, whose reference waits."""
    away, near = far([[0.0, 0.0, 0.0]], waveform), far([[100.0, 0.0, 0.0]], waveform)
    point = [104.0, 0.0, 0.0]
    found = beat_signal(echo(point_paths, away, point), away.center_on(CENTER))
    expected = beat_signal(echo(point_paths, near, point), near)
    assert (found - expected).abs().max() < 1e-8


def test_the_origins_are_those_of_the_phase_centres():
    radar = replace(far(), receivers=linear_array(2, 0.01)).center_on(CENTER)
    expected = [100.0, math.hypot(3.0, 102.0)]
    assert radar.origins.tolist() == pytest.approx(expected, rel=1e-12)
    assert radar.frames([1]).origins.tolist() == pytest.approx(expected[1:])
    assert radar.frames([1]).link().range_origin is not None
    assert far().origins.tolist() == [0.0, 0.0]


def test_ranges_around_a_far_scene_are_no_error(point_paths):
    """Without the origin the same data warn, and points and grids are refused."""
    radar = far()
    paths = echo(point_paths, radar, [120.0, 0.0, 0.0])
    with pytest.warns(PhysicsWarning, match=r"2 of 2 paths .* 99\.93 m and"):
        beat_signal(paths, radar)
    with pytest.raises(InputError, match="range origin for data that are centred"):
        radar.grid(60.0, 140.0)
    centered = radar.center_on(CENTER)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        beat = beat_signal(paths, centered)
    grid = centered.grid(-40.0, 40.0)
    shown = range_profile(beat, centered, grid)[:, 0, 0].abs()
    found = grid.ranges[shown.argmax(1)]
    truth = (float64([120.0, 0, 0]) - radar.positions).norm(dim=1) - centered.origins
    assert (found - truth).abs().max() < 0.5 * grid.range_step


def test_the_window_begins_half_of_it_before_the_origin_but_not_behind_the_radar(point_paths):
    span = SWEEP.max_range
    assert far().range_limits == (0.0, span)
    assert far().center_on(CENTER).range_limits == (-span / 2, span / 2)
    near = replace(far(), range_origin=float64([10.0, 12.0]))
    assert near.range_limits == (-10.0, span - 10.0)
    # A cable of 0.4 m shows everything so much later.
    assert replace(far(), range_origin=float64([-0.4, -0.4])).range_limits == (0.4, span + 0.4)
    pulse = replace(far(), waveform=Impulse(9.7e9, 1e8)).center_on(CENTER)
    assert pulse.range_limits == (-100.0, math.inf)
    with pytest.warns(PhysicsWarning, match=r"from -49\.97 to 49\.97 m of the origin"):
        beat_signal(echo(point_paths, far(), [160.0, 0, 0]), far().center_on(CENTER))


def test_negative_ranges_are_bins_of_the_fft(point_paths):
    radar = far().center_on(CENTER)
    beat = beat_signal(echo(point_paths, far(), [80.0, 4.0, 0.0]), radar)
    grid = radar.grid(-30.0, 20.0)
    assert fft_bins(SWEEP, grid) is not None
    between = replace(grid, range_step=grid.range_step * 1.0001)  # the sum as a matrix
    found, expected = range_profile(beat, radar, grid), range_profile(beat, radar, between)
    assert (found - expected).abs().max() < 0.05
    assert (found[..., 0] - expected[..., 0]).abs().max() < 5e-3


def test_movers_and_looks_count_from_the_origin(point_paths):
    radar = far().center_on(CENTER)
    paths = echo(point_paths, far(), [110.0, 0.0, 0.0])
    still = beat_signal(paths, radar)
    moving = replace(paths, velocity=torch.zeros(2, 3, dtype=torch.float64))
    train = moving_beat(moving, radar, Chirps(count=2, interval=1e-3))
    assert (train - still[:, None]).abs().max() < 1e-6
    look = SpeckleRealisations(paths, radar).beat(seed=1)
    # The same random amplitude in both frames; cells are a quarter of a resolution cell.
    first, second = (look / still).mean((1, 2, 3))
    assert abs(second / first - 1) < 0.1
    assert abs((second / first).angle()) < 1e-3


def test_detections_are_placed_in_the_world(point_paths):
    row = linear_array(16, 0.5 * SWEEP.wavelength)
    radar = replace(far([[0.0, 0.0, 0.0]]), receivers=row).center_on(CENTER)
    point = float64([95.0, 10.0, 0.0])
    beat = beat_signal(point_paths(radar, point, torch.ones(1)), radar)
    grid = radar.grid(-20.0, 20.0, 0.5)
    power = exact_spectrum(beat, radar, grid)
    seen = power[..., 0] == power.max()
    assert (peaks(power, seen, radar, grid).position[0] - point).norm() < 0.3


SCENE = Scene({"plate": thing(plate(6.0, 4.0, divisions=4), (103.0, 1.0, 0.5), (0.0, 0.1, 0.3))})


def test_the_surrogate_counts_from_the_origin_of_every_frame():
    """The map of one frame is that without an origin, moved: at two bounces, in both modes."""
    radar, sampling = far([[0.0, 0.0, 0.0]]), Sampling(depth=2, samples=20_000)
    pose = torch.zeros(3, dtype=torch.float64, requires_grad=True)

    def shown(device: Radar, start: float):
        grid = Grid(start, 0.78, 24)
        moved = replace(device, positions=device.positions + pose)
        return surrogate_spectrum(SCENE, moved, grid, Surrogate(), sampling=sampling, seed=3)

    plain = shown(radar, 92.0)
    found = shown(radar.center_on(CENTER), -8.0)
    assert plain.detach().sum() > 0
    assert (found - plain).abs().max() < 1e-4 * plain.detach().max()
    weight = torch.linspace(0, 1, 24)[None, :, None, None]
    slopes = [torch.autograd.grad((map_ * weight).sum(), pose)[0] for map_ in (plain, found)]
    assert (slopes[1] - slopes[0]).norm() < 2e-3 * slopes[0].norm()


def test_every_frame_has_an_origin_of_its_own():
    radar, sampling = far(), Sampling(depth=1, samples=20_000)
    centered, grid = radar.center_on(CENTER), Grid(-8.0, 0.78, 24)
    both = surrogate_spectrum(SCENE, centered, grid, Surrogate(), sampling=sampling, seed=3)
    places = (both.sum((2, 3)) * grid.ranges).sum(1) / both.sum((1, 2, 3))
    middle = float64([103.0, 1.0, 0.5])
    truth = (middle - radar.positions).norm(dim=1) - centered.origins
    assert (places - truth).abs().max() < 0.3
    assert float(radar.frames([1]).center_on(CENTER).origins) == float(centered.origins[1])


def test_the_origin_stays_where_the_radar_is_moved(point_paths):
    """It is what the recording was compensated with: phases turn by the whole shift of the path."""
    radar = far().center_on(CENTER)
    pose = RadarPose([0.5, 0.0, 0.0])
    assert torch.equal(pose(radar).origins, radar.origins)
    moved = echo(point_paths, pose(radar), [104.0, 0.0, 0.0])
    assert moved.delay.requires_grad
    beat = beat_signal(moved, pose(radar))
    center = (beat[0, 0, 0].conj() * beat[0, 0, 0].detach()).imag.sum() / SWEEP.samples
    (slope,) = torch.autograd.grad(center, pose.translation)
    # conj: the phase 4πf R/c falls by 4πf/c for each metre towards the point.
    wavenumber = 4 * math.pi * SWEEP.center_frequency / 299_792_458
    assert float(slope[0]) == pytest.approx(wavenumber, rel=1e-3)
    assert slope[1:].norm() < 0.05 * wavenumber


@pytest.mark.usefixtures("unchecked")
def test_wrong_origins():
    with pytest.raises(InputError, match=r"range_origin as numbers of shape \[2\]"):
        replace(far(), range_origin=float64([1.0]))
    with pytest.raises(InputError, match="without derivatives"):
        replace(far(), range_origin=float64([1.0, 2.0]).requires_grad_())
    with pytest.raises(InputError, match="no leakage with a range_origin"):
        Impairments(leakage=Leakage(1e-9, -30.0)).apply(
            torch.zeros(2, 1, 1, 64, dtype=torch.complex128), far().center_on(CENTER), seed=0
        )


def test_a_unit_slip_is_refused_before_memory_is_taken():
    """77e12 Hz, as a model of a thousandth of the size has: elements 500 wavelengths apart."""
    waveform = FMCW(77e12, 1e9, 50e-6, 256)
    one, column = linear_array(1, 1.0), linear_array(4, 1.9e-3, axis="z")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)  # grating lobes
        radar = Radar(linear_array(4, 4 * 1.9e-3), column, waveform, torch.zeros(1, 3).double())
        with pytest.raises(InputError, match="expected at most 268,435,456 bins, got"):
            radar.grid(0.5, 30.0)
    assert Radar(one, one, waveform, torch.zeros(1, 3).double()).grid(0.5, 30.0).u_count == 1
