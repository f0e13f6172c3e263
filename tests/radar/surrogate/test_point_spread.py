"""Each point spread by itself: peak, zeros, and derivatives."""

import math

import pytest
import torch

from invertwin.radar import FMCW, airy, dirichlet, normalized_gaussian
from invertwin.radar.aperture import aperture
from invertwin.radar.surrogate.point_spread import (
    airy_field,
    array_point_spread,
    bessel_j1,
    range_point_spread,
)


def test_point_spreads_peak_at_one(planar):
    zero = torch.zeros(1, dtype=torch.float64)
    assert range_point_spread(planar.waveform, zero).item() == pytest.approx(1)
    assert array_point_spread(aperture(planar), zero, zero).item() == pytest.approx(1)


def test_bessel_and_airy_gradients():
    z = torch.tensor([-3.0, 0.0, 1e-4, 9.9e-4, 1.1e-3, 0.5, 3.8, 40.0], dtype=torch.float64)
    z.requires_grad_()
    assert torch.autograd.gradcheck(bessel_j1, z)
    assert torch.autograd.gradcheck(airy, z)
    values = airy(z).detach()
    assert values[1] == 1
    assert values[3] == pytest.approx(1 - 0.25 * 9.9e-4**2, abs=1e-12)
    # First dark ring.
    assert airy(torch.tensor([3.8317059702], dtype=torch.float64)).item() < 1e-18


def test_normalized_gaussian_has_the_derivative_stated_and_not_the_printed_one():
    bins = torch.linspace(0, 2, 21, dtype=torch.float64)
    ranges = torch.tensor([0.93, 1.31], dtype=torch.float64, requires_grad=True)
    sigma = 0.12
    kernel = normalized_gaussian(ranges, bins, sigma)
    assert torch.allclose(kernel.sum(1), torch.ones(2, dtype=torch.float64))
    assert torch.autograd.gradcheck(lambda r: normalized_gaussian(r, bins, sigma), ranges)
    pull = (bins[None] - ranges[:, None]) / sigma**2
    stated = kernel * (pull - (kernel * pull).sum(1, keepdim=True))
    printed = kernel * pull * (1 - kernel)
    for path in range(2):
        row = torch.stack(
            [
                torch.autograd.grad(kernel[path, f], ranges, retain_graph=True)[0][path]
                for f in range(21)
            ]
        )
        assert torch.allclose(row, stated[path])
        assert (row - printed[path]).norm() > 0.04 * row.norm()


def test_dirichlet_is_the_transform_of_equal_weights():
    wave = FMCW(76e9, 1e9, 20e-6, 48)
    distance = torch.linspace(-1.2, 1.2, 241, dtype=torch.float64) * wave.max_range
    found = dirichlet(wave, distance)
    assert torch.allclose(found, wave.range_response(distance, "rectangular"), atol=1e-9)
    cell = wave.range_resolution
    peaks = torch.tensor([0.0, 1e-12, wave.max_range], dtype=torch.float64)
    assert torch.allclose(dirichlet(wave, peaks), torch.ones(3, dtype=torch.float64))
    dark = cell * torch.tensor([1.0, 5.0, 47.0], dtype=torch.float64)
    assert dirichlet(wave, dark).max() < 1e-25
    # First sidelobe −13.3 dB.
    side = dirichlet(wave, cell * torch.linspace(1, 2, 101, dtype=torch.float64)).max()
    assert 10 * math.log10(side) == pytest.approx(-13.26, abs=0.05)
    places = cell * torch.tensor([0.3, 1.4, 7.2], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda d: dirichlet(wave, d), places.requires_grad_())


def test_airy_field_squared_is_the_power():
    z = torch.tensor([0.0, 5e-4, 0.9, 5.1, 9.0], dtype=torch.float64, requires_grad=True)
    assert torch.allclose(airy_field(z).square(), airy(z))
    assert float(airy_field(torch.tensor(5.1, dtype=torch.float64))) < 0
    assert torch.autograd.gradcheck(airy_field, z)
