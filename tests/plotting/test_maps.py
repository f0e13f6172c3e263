"""Figures of maps show the numbers of the maps, at the places of their bins."""

import numpy as np
import pytest
import torch

from invertwin import plotting
from invertwin.channel import Grid
from invertwin.errors import InputError
from invertwin.plotting import MapPanel
from invertwin.plotting.figures import png_bytes
from invertwin.radar import DopplerMaps, Spectrogram
from invertwin.radar.processing.doppler_maps import Peak

GRID = Grid(1.0, 0.5, 3, -0.4, 0.2, 5, -0.1, 0.1, 3)
ROW = Grid(1.0, 0.5, 3, -0.4, 0.2, 5)
ALONE = Grid(1.0, 0.5, 3)


def power(grid, frames=2):
    generator = torch.Generator().manual_seed(1)
    return torch.rand(frames, *grid.shape, generator=generator, dtype=torch.float64) + 0.1


def cells(figure):
    """The axes that hold a map, without those of colour bars."""
    return [axes for axes in figure.axes if axes.images]


def shown(axes):
    (image,) = axes.images
    return np.asarray(image.get_array())


def decibels(values):
    return 10 * np.log10(values.numpy())


def test_a_spectrum_is_summed_over_frames_and_the_other_direction():
    spectrum = power(GRID)
    figure = plotting.spectrum({"data": spectrum}, GRID)
    upper, lower = cells(figure)
    for axes, flat in ((upper, spectrum.sum((0, 3))), (lower, spectrum.sum((0, 2)))):
        np.testing.assert_allclose(shown(axes), decibels(flat / flat.max()), rtol=1e-12)
        assert axes.images[0].get_clim() == (-40, 0)
        assert axes.get_ylim() == pytest.approx((0.75, 2.25))
        assert axes.get_ylabel() == "range [m]"
    assert upper.get_xlim() == pytest.approx((0.5, -0.5))  # +u, the left, is on the left
    png_bytes(figure)  # limits of the degrees follow when it is drawn
    (degrees,) = upper.child_axes
    assert degrees.get_xlabel() == "azimuth [°]"
    assert degrees.get_xlim() == pytest.approx((30.0, -30.0))
    (degrees,) = lower.child_axes
    assert degrees.get_xlabel() == "elevation [°]"
    assert lower.get_xlim() == pytest.approx((-0.15, 0.15))
    assert upper.get_title() == "data"
    assert lower.get_title() == ""
    assert upper.get_xlabel() == plotting.U_LABEL
    assert lower.get_xlabel() == plotting.V_LABEL


def test_a_spectrum_without_directions_is_shown_over_frames():
    spectrum = power(ALONE, 4)
    (axes,) = cells(plotting.spectrum(spectrum, ALONE))
    flat = spectrum[:, :, 0, 0].T
    np.testing.assert_allclose(shown(axes), decibels(flat / flat.max()))
    assert axes.get_xlim() == (-0.5, 3.5)
    assert axes.get_xlabel() == "frame"


def test_maps_on_one_scale_keep_their_level():
    loud = power(ROW)
    maps = {"loud": loud, "quiet": 1e-3 * loud, "silent": 0 * loud}
    figure = plotting.spectrum(maps, ROW, relative=False, dynamic_range=60.0)
    first, second, third = cells(figure)
    np.testing.assert_allclose(shown(first) - shown(second), 30.0)
    assert bool((shown(third) == -300).all())
    top = float(decibels(loud.sum((0, 3))).max())
    for axes in cells(figure):
        assert axes.images[0].get_clim() == pytest.approx((top - 60, top))
    assert "received over transmitted power [dB]" in {axes.get_ylabel() for axes in figure.axes}
    relative = cells(plotting.spectrum(maps, ROW))
    np.testing.assert_allclose(shown(relative[0]), shown(relative[1]))


def test_panels_have_their_own_axes_and_peaks():
    values = torch.tensor([[1.0, 10.0], [100.0, 1.0], [1.0, 1.0]])
    rates = torch.tensor([-2.0, 2.0])
    panel = MapPanel(values, ALONE.ranges, rates, plotting.RATE_LABEL)
    first, second = cells(plotting.panels({"a": panel, "b": panel}, dynamic_range=30.0))
    np.testing.assert_allclose(shown(first), [[-20, -10], [0, -20], [-20, -20]], atol=1e-6)
    assert first.images[0].get_clim() == (-30, 0)
    assert first.get_xlim() == (-4, 4)
    assert first.get_xlabel() == "range rate [m/s], away > 0"
    assert (first.get_title(), second.get_title()) == ("a", "b")


@pytest.mark.parametrize(
    ("grid", "titles"),
    [
        (GRID, ["everything", "everything, elevation", "what moves", "what moves, elevation"]),
        (ROW, ["everything", "what moves"]),
        (ALONE, []),
    ],
)
def test_range_doppler_shows_rates_and_directions(grid, titles):
    peak = Peak(1.0, 0.0, 0.0, 0.0, 1.0)
    everything, rates = power(grid)[0], torch.tensor([-1.0, 0.0, 1.0, 2.0], dtype=torch.float64)
    maps = DopplerMaps(
        grid, rates, torch.rand(4, 3) + 0.1, everything, 0.5 * everything, peak, peak
    )
    first, *others = cells(plotting.range_doppler(maps))
    assert [axes.get_title() for axes in others] == titles
    flat = maps.range_doppler.T
    np.testing.assert_allclose(shown(first), decibels(flat / flat.max()), rtol=1e-5)
    assert first.get_xlim() == (-1.5, 2.5)
    if others:
        strongest = everything.amax(2)
        np.testing.assert_allclose(shown(others[0]), decibels(strongest / strongest.max()))
    without = plotting.doppler_panels(
        DopplerMaps(grid, rates, maps.range_doppler, everything, None, peak, None)
    )
    assert list(without)[1:] == titles[: len(titles) // 2]


def test_a_spectrogram_has_times_across_and_range_rates_up():
    power = torch.rand(5, 4, dtype=torch.float64, generator=torch.manual_seed(0)) + 0.1
    rates = torch.tensor([-1.0, 0.0, 1.0, 2.0], dtype=torch.float64)
    times = 1e-3 * torch.arange(1, 6, dtype=torch.float64)
    (axes,) = cells(plotting.spectrogram(Spectrogram(power, times, rates)))
    np.testing.assert_allclose(shown(axes), decibels(power.T / power.max()), rtol=1e-5)
    assert axes.get_xlim() == pytest.approx((0.5, 5.5))  # ms
    assert axes.get_ylim() == pytest.approx((-1.5, 2.5))
    assert "range rate" in axes.get_ylabel()


def test_derivatives_share_a_symmetric_scale():
    slope = power(ROW) - 0.6
    figure = plotting.gradient(
        {"differences": slope, "half": 0.5 * slope},
        ROW,
        label="∂ power [1/rad]",
        power=power(ROW),
        own_scale={"error": 1e-3 * slope},
    )
    level, first, second, error = cells(figure)
    flat = slope[0, :, :, 0].numpy()
    limit = np.quantile(np.abs(flat), 0.998)
    np.testing.assert_allclose(shown(first), flat)
    np.testing.assert_allclose(shown(second), 0.5 * flat)
    for axes in (first, second):
        assert axes.images[0].get_clim() == pytest.approx((-limit, limit))
    assert error.images[0].get_clim() == pytest.approx((-1e-3 * limit, 1e-3 * limit))
    assert level.images[0].get_clim() == (-30, 0)
    assert level.get_ylabel() == "range [m]"
    assert [axes.get_title() for axes in cells(figure)] == [
        *("power", "differences", "half", "error")
    ]
    labels = {axes.get_ylabel() for axes in figure.axes}
    assert labels >= {"∂ power [1/rad]", "own scale, same unit"}


def test_a_derivative_of_zero_and_one_without_directions():
    (axes,) = cells(plotting.gradient(torch.zeros(4, 3, 1, 1), ALONE))
    assert shown(axes).shape == (3, 4)
    assert axes.images[0].get_clim() == (-1, 1)


def test_maps_and_grids_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match=r"expected a map of shape \[any, 3, 5, 1\]"):
        plotting.spectrum(power(GRID), ROW)
    with pytest.raises(InputError, match="at least one map, got none"):
        plotting.spectrum({}, ROW)
    with pytest.raises(InputError, match="at least one map, got none"):
        plotting.gradient({}, ROW)


def test_residuals_beyond_the_mark_are_framed():
    grid = Grid(1.0, 0.1, 16, u_start=-0.4, u_step=0.05, u_count=16)
    found = torch.zeros(4, 4, 1)
    found[1, 2, 0], found[3, 0, 0] = 8.0, -4.0
    (cell,) = cells(plotting.residuals(found, grid))
    (frame,) = cell.patches
    # Bins of four: the second begins at the upper edge of the fourth, in range and in u.
    assert frame.get_xy() == pytest.approx((-0.4 + 0.05 * 7.5, 1.0 + 0.1 * 3.5))
    assert (frame.get_width(), frame.get_height()) == pytest.approx((0.2, 0.4))
    (image,) = cell.images
    assert float(shown(cell)[1, 2]) == 8.0
    assert image.get_clim() == (-10.0, 10.0)


def test_ranges_without_echoes_are_left_out_and_the_label_says_so():
    grid = Grid(1.0, 0.5, 40, -0.4, 0.2, 5)
    spectrum = torch.full((1, *grid.shape), 1e-2, dtype=torch.float64)
    spectrum[0, 10:13, 2] = 1.0
    (axes,) = cells(plotting.spectrum({"data": spectrum}, grid))
    # Four bins before and behind echoes from 6 to 7 m.
    assert axes.get_ylim() == pytest.approx((3.75, 9.25))
    assert axes.get_ylabel() == "range [m], cropped from 1 to 20.5"
