"""The loss: gain in closed form, backgrounds, likelihood, and what it refuses."""

from typing import Any

import pytest
import torch
from torch import Tensor

from invertwin.errors import InputError
from invertwin.inversion.loss import SpectrumLoss


def maps(seed: int = 0, shape: tuple[int, ...] = (2, 16, 9, 4)) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.rand(2, *shape, generator=generator, dtype=torch.float64)
    return a + 0.1, b * a + 0.05


@pytest.mark.parametrize("kind", ["mse", "likelihood"])
def test_fitted_gain_minimises_the_loss(kind):
    """No other gain of calibrated data does better, and the best of them is as good."""
    a, b = maps()
    unit = b.mean() / a.mean()
    fitted = float(SpectrumLoss(kind=kind)(a, b))
    fixed = SpectrumLoss(kind=kind, gain="one")
    tried = [float(fixed(g * unit * a, b)) for g in torch.linspace(0.3, 2.0, 341).tolist()]
    assert fitted <= min(tried) + 1e-6
    assert fitted == pytest.approx(min(tried), rel=2e-3)


@pytest.mark.parametrize("kind", ["mse", "likelihood"])
def test_equal_maps_up_to_a_gain_cost_nothing(kind):
    a, _ = maps()
    assert float(SpectrumLoss(kind=kind)(1e-9 * a, a)) < 1e-6
    assert float(SpectrumLoss(kind=kind, gain="one")(a, a)) < 1e-12


@pytest.mark.parametrize("kind", ["mse", "likelihood"])
@pytest.mark.parametrize("seed", range(3))
def test_loss_is_positive_and_knows_no_units(kind, seed):
    a, b = maps(seed)
    loss = SpectrumLoss(kind=kind)
    plain = float(loss(a, b))
    assert plain > 0
    assert float(loss(1e-12 * a, b)) == pytest.approx(plain, rel=1e-6)
    assert float(loss(a, 1e-9 * b)) == pytest.approx(plain, rel=1e-6)


def test_empty_simulation_costs_one():
    _, b = maps()
    assert float(SpectrumLoss()(torch.zeros_like(b), b)) == pytest.approx(1)
    assert torch.isfinite(SpectrumLoss(kind="likelihood")(torch.zeros_like(b), b))


@pytest.mark.parametrize("background", ["level", "static"])
def test_background_is_taken_out(background):
    a, b = maps()
    added = torch.full_like(b[:1], 0.7) if background == "level" else maps(5)[0][:1]
    loss = SpectrumLoss(background=background)
    assert float(loss(a, b + added)) == pytest.approx(float(loss(a, b)), rel=1e-9)
    assert float(loss(a, a + added)) < 1e-12
    assert float(SpectrumLoss()(a, a + added)) > 1e-3


@pytest.mark.parametrize(
    "options",
    [
        {"kind": "mse"},
        {"kind": "likelihood"},
        {"gain": "one"},
        {"background": "level"},
        {"background": "static"},
        {"levels": 1},
    ],
    ids=str,
)
def test_gradient_is_that_of_differences(options):
    """The gain needs no derivative, being a minimiser (of the fixed point: nearly)."""
    a, b = maps(shape=(2, 8, 5, 1))
    a.requires_grad_()
    loss = SpectrumLoss(**options)
    (gradient,) = torch.autograd.grad(loss(a, b), a)
    away = torch.randn(a.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    step = 1e-5
    with torch.no_grad():
        truth = float(loss(a + step * away, b) - loss(a - step * away, b)) / (2 * step)
    assert float((gradient * away).sum()) == pytest.approx(truth, rel=1e-3)


def test_levels_see_what_a_single_bin_cannot():
    """A line that is off by two bins: the fine level is blind to by how much, the pool is not."""
    b = torch.zeros(1, 32, 1, 1, dtype=torch.float64)
    b[0, 8] = 1.0
    near, far = b.roll(1, 1), b.roll(9, 1)
    fine, pooled = SpectrumLoss(levels=1), SpectrumLoss(levels=3)
    assert float(fine(near, b)) == pytest.approx(float(fine(far, b)))
    assert float(pooled(near, b)) < float(pooled(far, b))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "l1"}, "expected kind 'mse' or 'likelihood', got 'l1'"),
        ({"levels": 0}, "expected levels >= 1"),
        ({"gain": "free"}, "gain 'fitted' or 'one'"),
        ({"background": "sky"}, "expected background among none, level, static, got 'sky'"),
        ({"kind": "likelihood", "background": "level"}, "expected no background and floor > 0"),
        ({"kind": "likelihood", "floor": 0.0}, "expected no background and floor > 0"),
    ],
)
def test_bad_choices_are_named(options: Any, message, unchecked):
    with pytest.raises(InputError, match=message):
        SpectrumLoss(**options)


def test_bad_maps_are_named(unchecked):
    a, b = maps()
    with pytest.raises(InputError, match="expected maps of one shape"):
        SpectrumLoss()(a[:, :8], b)
    with pytest.raises(InputError, match="expected a measured map with power in it, got zeros"):
        SpectrumLoss()(a, 0 * b)


@pytest.mark.parametrize("gain", [0.4, 1.0])
def test_the_likelihood_has_its_derivative_in_both_modes(gain):
    """Written out in the loss; here against differences, with bins below zero among them."""
    a, b = maps(shape=(2, 5, 4, 3))
    below = (gain * (a - 0.3)).requires_grad_()
    loss = SpectrumLoss(kind="likelihood", gain="one", levels=2)
    assert bool((below < 0).any())
    assert torch.autograd.gradcheck(lambda x: loss(x, b), below, check_forward_ad=True)


def test_the_gain_of_the_likelihood_is_that_of_a_long_iteration():
    a, b = maps()
    loss = SpectrumLoss(kind="likelihood")
    pairs = loss._pyramid(a, b)
    gain = 1.0
    for _ in range(200):
        up = sum(float((x * (y + 0.01) / (gain * x + 0.01) ** 2).mean()) for x, y in pairs)
        down = sum(float((x / (gain * x + 0.01)).mean()) for x, _ in pairs)
        gain *= up / down
    assert float(loss._gain(pairs)) == pytest.approx(gain, rel=1e-5)
