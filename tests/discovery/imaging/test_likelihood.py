"""Heavy-tailed speckle: likelihood, background, and how many bins share a draw."""

import math

import pytest
import torch

import invertwin as iw
from invertwin.discovery.imaging.likelihood import (
    HeavyTailedLoss,
    count_bins_per_draw,
    estimate_background,
    find_grating_lobes,
    map_axes,
)
from invertwin.scene import AntennaArray, linear_array

CHIRP = iw.FMCW(start_frequency=77e9, bandwidth=1e9, duration=50e-6, samples=64)


def radar(frames: int = 1) -> iw.Radar:
    half = CHIRP.wavelength / 2
    one = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    return iw.Radar(one, linear_array(8, half), CHIRP, torch.zeros(frames, 3, dtype=torch.float64))


def test_it_is_zero_at_the_data_and_larger_on_both_sides():
    loss = HeavyTailedLoss(torch.zeros(1, dtype=torch.float64), degrees=4.0)
    power = torch.full((1, 1, 1, 1), 3.0, dtype=torch.float64)
    assert float(loss(power, power)) == pytest.approx(0.0, abs=1e-12)
    assert float(loss(0.5 * power, power)) > 0.05
    assert float(loss(2.0 * power, power)) > 0.05


def test_many_degrees_are_plain_speckle():
    loss = HeavyTailedLoss(torch.zeros(1, dtype=torch.float64), degrees=1e6)
    mean = torch.full((1, 1, 1, 1), 2.0, dtype=torch.float64)
    q = 3.5
    expected = q - math.log(q) - 1
    assert float(loss(mean, q * mean)) == pytest.approx(expected, rel=1e-4)


def test_an_echo_that_nothing_explains_counts_as_its_logarithm():
    loss = HeavyTailedLoss(torch.ones(1, dtype=torch.float64), degrees=4.0)
    nothing = torch.zeros(1, 1, 1, 1, dtype=torch.float64)
    far, farther = (float(loss(nothing, torch.full_like(nothing, p))) for p in (1e4, 1e6))
    assert farther - far == pytest.approx(4.0 * math.log(1e2), rel=0.01)


def test_the_background_is_the_mean_of_noise_beside_a_bright_thing():
    torch.manual_seed(0)
    power = -torch.rand(40, 5, 30, 1, dtype=torch.float64).log() * 2e-3
    power[:, 2, :8] += 5.0  # a quarter of the directions
    found = estimate_background(power)
    assert found[[0, 1, 3, 4]].tolist() == pytest.approx([2e-3] * 4, rel=0.1)
    assert float(found[2]) < 4e-3


def test_an_echo_that_fills_all_directions_is_not_its_own_background():
    """As the beam of two to four receivers does, in one frame."""
    power = -torch.rand(1, 60, 9, 1, dtype=torch.float64, generator=torch.manual_seed(0)).log()
    power[:, 20:24] += 1e4
    assert float(estimate_background(power)[21]) > 1e3
    found = estimate_background(power, 4.5)
    assert found.max() < 1.6
    assert found.min() > 0.5


def test_noise_has_as_many_draws_as_bins_over_the_shared_ones():
    """The variance of the mean power over a map is that of so many exponential draws."""
    device = radar(400)
    grid = device.grid(0.5, 9.0)
    noise = torch.randn(400, 1, 8, 64, dtype=torch.complex128, generator=torch.manual_seed(1))
    power = iw.Capture.from_beat(noise, device).spectrum(grid)
    power = power[:, :, 8:-8]  # the outermost directions see less of their neighbours
    mean = power.flatten(1).mean(1)
    draws = float((mean.mean() / mean.std()) ** 2)
    assert power[0].numel() / count_bins_per_draw(map_axes(device, grid)) == pytest.approx(
        draws, rel=0.25
    )


@pytest.mark.filterwarnings("ignore::invertwin.errors.PhysicsWarning")
@pytest.mark.parametrize(
    ("count", "wavelengths", "lobes"),
    [(2, 0.5, []), (2, 1.0, [-1.0, 1.0]), (3, 0.75, [-4 / 3, 4 / 3]), (1, 1.0, [])],
)
def test_elements_apart_have_grating_lobes(count, wavelengths, lobes):
    """u + λ/d gives all elements the phases of u."""
    place = torch.zeros(1, 3, dtype=torch.float64)
    row = linear_array(count, wavelengths * CHIRP.wavelength)
    board = iw.Radar(linear_array(1, 1.0), row, CHIRP, place, array_window="rectangular")
    assert find_grating_lobes(board, board.grid(0.5, 4.0)) == pytest.approx(lobes, abs=2e-3)
