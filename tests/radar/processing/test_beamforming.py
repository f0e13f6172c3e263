"""Beamforming: signs, levels, and every shape of array."""

import math
from dataclasses import replace

import pytest
import torch

from invertwin.errors import InputError
from invertwin.radar import FMCW, Radar, beamform, beat_signal, exact_spectrum, range_profile
from invertwin.radar.aperture import aperture
from invertwin.radar.signal.range_profile import fft_bins
from invertwin.scene.antenna import AntennaArray, linear_array
from invertwin.scene.pose import rotation_from_vector

U, V, DISTANCE = 0.3, -0.2, 5.0
TARGET = DISTANCE * torch.tensor([math.sqrt(1 - U**2 - V**2), U, V], dtype=torch.float64)


def scattered_array(radar: Radar) -> AntennaArray:
    """A planar array that is no product of a row and a column: its corners are missing."""
    places = radar.receivers.positions
    corner = (places / places.amax(0).clamp(min=1e-9)).abs()[:, 1:].sum(1) > 1.6
    return AntennaArray(places[~corner])


@pytest.fixture(params=["planar", "mimo", "scattered"])
def radar(request, planar, mimo) -> Radar:
    if request.param == "mimo":
        return mimo
    if request.param == "planar":
        return planar
    return replace(planar, receivers=scattered_array(planar))


def test_target_off_both_axes(radar, point_paths):
    """The peak is at u = +0.3, v = −0.2 with the value |a|², and at no mirror image of it."""
    paths = point_paths(radar, TARGET, torch.tensor([0.02j]))
    grid = radar.grid(4.5, 5.5, oversample=4)
    power = exact_spectrum(beat_signal(paths, radar), radar, grid)[0]
    r, u, v = torch.unravel_index(power.argmax(), power.shape)
    assert grid.u[u] == pytest.approx(U, abs=grid.u_step)
    assert grid.v[v] == pytest.approx(V, abs=grid.v_step)
    assert grid.ranges[r] == pytest.approx(DISTANCE, abs=grid.range_step)
    assert power.max() == pytest.approx(4e-4, rel=0.05)
    for mirror in ((-U, V), (U, -V), (-U, -V)):
        i = round((mirror[0] - grid.u_start) / grid.u_step)
        j = round((mirror[1] - grid.v_start) / grid.v_step)
        # 0.4 in v is within the main lobe of 8 tapered elements.
        assert power[:, i, j].max() < 0.05 * power.max()


def test_turned_radar_sees_the_same(planar, point_paths):
    """Directions are those of the radar frame, wherever it looks."""
    turn = rotation_from_vector(torch.tensor([0.3, 0.4, -0.8], dtype=torch.float64))
    place = torch.tensor([[3.0, 1, -2]], dtype=torch.float64)
    moved = replace(planar, positions=place, rotations=turn[None])
    grid = planar.grid(4.5, 5.5)
    maps = [
        exact_spectrum(beat_signal(point_paths(r, x, torch.tensor([1.0])), r), r, grid)
        for r, x in ((planar, TARGET), (moved, turn @ TARGET + place[0]))
    ]
    assert torch.allclose(maps[0], maps[1], atol=1e-7)


def test_separable_equals_the_plain_sum(mimo, point_paths):
    """The factored sum against the plain one over all elements, at a few nodes."""
    paths = point_paths(mimo, TARGET, torch.tensor([1.0]))
    grid = mimo.grid(4.8, 5.2)
    profile = range_profile(beat_signal(paths, mimo), mimo, grid)
    found = beamform(profile, mimo, grid)[0]
    array = aperture(mimo)
    weight = array.y_taper[array.column] * array.z_taper[array.row]
    places = mimo.virtual_positions
    k = 2 * math.pi / mimo.waveform.wavelength
    for i, j in ((3, 5), (30, 11), (20, 16)):
        phase = k * (grid.u[i] * places[:, 1] + grid.v[j] * places[:, 2])
        steering = weight / weight.sum() * torch.polar(torch.ones_like(phase), phase)
        expected = (steering @ profile[0].flatten(0, 1)).abs().square()
        assert torch.allclose(found[:, i, j], expected)


def test_unresolved_axes_average_the_elements(planar, point_paths):
    paths = point_paths(planar, TARGET, torch.tensor([0.1]))
    beat = beat_signal(paths, planar)
    full = planar.grid(4.5, 5.5)
    for unresolved in ({"u_count": 1}, {"v_count": 1}, {"u_count": 1, "v_count": 1}):
        grid = replace(full, **unresolved)
        power = exact_spectrum(beat, planar, grid)
        assert power.shape[1:] == grid.shape
        assert power.max() == pytest.approx(0.01, rel=0.1)


def test_overlapping_virtual_elements(waveform, point_paths):
    """2 × 4 elements with three shared places, against explicit sums."""
    half = 0.5 * waveform.wavelength
    radar = Radar(
        linear_array(2, half),
        linear_array(4, half),
        waveform,
        torch.zeros(1, 3, dtype=torch.float64),
    )
    array = aperture(radar)
    assert array.counts[:, 0].tolist() == [1, 2, 2, 2, 1]
    target = DISTANCE * torch.tensor([math.sqrt(1 - U**2), U, 0], dtype=torch.float64)
    grid = radar.grid(4.5, 5.5, oversample=8)
    power = exact_spectrum(
        beat_signal(point_paths(radar, target, torch.tensor([1.0])), radar), radar, grid
    )
    assert power.max() == pytest.approx(1, rel=0.05)
    assert grid.u[power.amax((0, 1, 3)).argmax()] == pytest.approx(U, abs=2 * grid.u_step)


def test_frames_are_independent(planar, point_paths):
    both = replace(planar, positions=torch.zeros(2, 3, dtype=torch.float64))
    frame = torch.tensor([1])
    paths = point_paths(both, TARGET, torch.tensor([1.0]), frame)
    grid = both.grid(4.8, 5.2)
    power = exact_spectrum(beat_signal(paths, both), both, grid)
    assert power[0].max() == 0
    alone = point_paths(planar, TARGET, torch.tensor([1.0]))
    assert torch.allclose(power[1], exact_spectrum(beat_signal(alone, planar), planar, grid)[0])


def test_gradient(linear):
    grid = replace(linear.grid(4.8, 5.2), u_count=5)
    beat = torch.randn(
        1, 1, 16, 64, dtype=torch.complex128, generator=torch.Generator().manual_seed(0)
    )
    assert torch.autograd.gradcheck(
        lambda b: exact_spectrum(b, linear, grid), beat.requires_grad_(), fast_mode=True
    )


def test_wrong_input(planar):
    grid = planar.grid(4, 5)
    with pytest.raises(InputError, match=r"profile \(frame, tx, rx, range\) of shape"):
        beamform(torch.zeros(1, 1, 96, 3, dtype=torch.complex128), planar, grid)
    profile = torch.zeros(1, 1, 96, grid.range_count, dtype=torch.complex128)
    places = planar.receivers.positions.clone()
    places[:, 0] = torch.linspace(0, 0.01, 96)
    deep = replace(planar, receivers=AntennaArray(places))
    with pytest.raises(InputError, match="y-z plane"):
        beamform(profile, deep, grid)
    few = replace(planar, receivers=scattered_array(planar))
    count = len(few.receivers.positions)
    with pytest.raises(InputError, match="resolve both axes"):
        beamform(profile[:, :, :count], few, replace(grid, v_count=1))


@pytest.mark.parametrize("count", [3, 8, 13])
def test_directions_of_a_grid_end_at_one(count):
    chirp = FMCW(start_frequency=77e9, bandwidth=2e9, duration=5e-5, samples=64)
    row = linear_array(count, chirp.wavelength / 2)
    radar = Radar(
        linear_array(1, 0.002), row, chirp, positions=torch.zeros(1, 3, dtype=torch.float64)
    )
    u = radar.grid(0.5, 1.5).u
    assert 1 - radar.beamwidth[0] < float(u.abs().max()) <= 1.0


def test_ranges_beyond_the_unambiguous_one_show_the_period_before():
    chirp = FMCW(start_frequency=77e9, bandwidth=2e9, duration=5e-5, samples=16)
    one = linear_array(1, 0.002)
    radar = Radar(one, one, chirp, positions=torch.zeros(1, 3, dtype=torch.float64))
    grid = radar.grid(0.0, chirp.max_range)
    beat = torch.randn(
        1, 1, 1, 16, dtype=torch.complex128, generator=torch.Generator().manual_seed(1)
    )
    found = range_profile(beat, radar, grid)
    assert fft_bins(chirp, grid) is not None
    torch.testing.assert_close(found[..., -1], found[..., 0])
