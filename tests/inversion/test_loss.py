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


@pytest.mark.parametrize("kind", ["mse", "likelihood", "heavy_tailed"])
def test_fitted_gain_minimises_the_loss(kind):
    """No other gain of calibrated data does better, and the best of them is as good."""
    a, b = maps()
    unit = b.mean() / a.mean()
    fitted = float(SpectrumLoss(kind=kind)(a, b))
    fixed = SpectrumLoss(kind=kind, gain="one")
    tried = [float(fixed(g * unit * a, b)) for g in torch.linspace(0.3, 2.0, 341).tolist()]
    assert fitted <= min(tried) + 1e-6
    assert fitted == pytest.approx(min(tried), rel=2e-3)


@pytest.mark.parametrize("kind", ["mse", "likelihood", "heavy_tailed"])
def test_equal_maps_up_to_a_gain_cost_nothing(kind):
    a, _ = maps()
    assert float(SpectrumLoss(kind=kind)(1e-9 * a, a)) < 1e-6
    assert float(SpectrumLoss(kind=kind, gain="one")(a, a)) < 1e-12


@pytest.mark.parametrize("kind", ["mse", "likelihood", "heavy_tailed"])
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
    assert float(SpectrumLoss("mse")(torch.zeros_like(b), b)) == pytest.approx(1)
    assert torch.isfinite(SpectrumLoss(kind="likelihood")(torch.zeros_like(b), b))


@pytest.mark.parametrize("background", ["level", "static"])
def test_background_is_taken_out(background):
    a, b = maps()
    added = torch.full_like(b[:1], 0.7) if background == "level" else maps(5)[0][:1]
    loss = SpectrumLoss("mse", background=background)
    assert float(loss(a, b + added)) == pytest.approx(float(loss(a, b)), rel=1e-9)
    assert float(loss(a, a + added)) < 1e-12
    assert float(SpectrumLoss("mse")(a, a + added)) > 1e-3


@pytest.mark.parametrize(
    "options",
    [
        {"kind": "mse"},
        {"kind": "likelihood"},
        {"kind": "heavy_tailed"},
        {"gain": "one"},
        {"kind": "mse", "gain": "one"},
        {"kind": "mse", "background": "level"},
        {"kind": "mse", "background": "static"},
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
        ({"kind": "l1"}, "expected kind to be one of mse, likelihood, heavy_tailed, got 'l1'"),
        ({"levels": 0}, "expected levels of at least 1"),
        ({"gain": "free"}, "expected gain to be one of fitted, one"),
        ({"background": "sky"}, "expected background to be one of auto, none, level"),
        ({"kind": "likelihood", "background": "static"}, "expected one level as the background"),
        ({"kind": "likelihood", "floor": 0.0}, "expected floor above 0"),
    ],
)
def test_bad_choices_are_named(options: Any, message, unchecked):
    with pytest.raises(InputError, match=message):
        SpectrumLoss(**options)


def test_bad_maps_are_named(unchecked):
    a, b = maps()
    with pytest.raises(InputError, match="expected a map like the measured one"):
        SpectrumLoss()(a[:, :8], b)
    with pytest.raises(InputError, match="expected a measured map with power in it, got zeros"):
        SpectrumLoss()(a, 0 * b)


@pytest.mark.parametrize("kind", ["likelihood", "heavy_tailed"])
@pytest.mark.parametrize("gain", [0.4, 1.0])
def test_the_likelihood_has_its_derivative_in_both_modes(gain, kind):
    """Written out in the loss; here against differences, with bins below zero among them."""
    a, b = maps(shape=(2, 5, 4, 3))
    below = (gain * (a - 0.3)).requires_grad_()
    loss = SpectrumLoss(kind=kind, gain="one", levels=2)
    assert bool((below < 0).any())
    assert torch.autograd.gradcheck(lambda x: loss(x, b), below, check_forward_ad=True)


def test_the_gain_of_the_likelihood_is_that_of_a_long_iteration():
    a, b = maps()
    loss = SpectrumLoss(kind="likelihood", background="none")
    pairs = loss._pyramid(a, b)
    gain = 1.0
    for _ in range(200):
        up = sum(float((x * (y + 0.01) / (gain * x + 0.01) ** 2).mean()) for x, y in pairs)
        down = sum(float((x / (gain * x + 0.01)).mean()) for x, _ in pairs)
        gain *= up / down
    assert loss._fit_gain(pairs) == (pytest.approx(gain, rel=1e-5), 0.0)


@pytest.mark.parametrize("noise", [0.0, 0.05, 1.0, 30.0])
def test_noise_of_any_level_leaves_the_gain(noise):
    """Of 80 000 bins of a sparse map; without the level the noise would count as echoes."""
    generator = torch.Generator().manual_seed(4)
    a = torch.rand(4, 200, 100, 1, generator=generator, dtype=torch.float64) ** 8
    draws = torch.rand(a.shape, generator=generator, dtype=torch.float64)
    data = -(3.0 * a + noise) * draws.log()
    loss = SpectrumLoss(levels=1, floor=1e-4)
    assert loss.fitted_gain(a, data) == pytest.approx(3.0, rel=0.03 + 0.01 * noise)
    _, level = loss._fit_gain(loss._pyramid(a, data))
    assert level * float(data.mean()) == pytest.approx(noise, rel=0.02, abs=1e-3)
    if noise >= 1:
        assert SpectrumLoss(levels=1, background="none").fitted_gain(a, data) > 2 * 3.0


def test_no_other_noise_does_better():
    a, b = maps()
    loss = SpectrumLoss(gain="one", levels=2)
    fitted = float(loss(a, b + 0.4))
    known = SpectrumLoss(gain="one", levels=2, background="none")
    tried = [float(known(a + n, b + 0.4)) for n in torch.linspace(0.0, 1.0, 401).tolist()]
    assert fitted == pytest.approx(min(tried), abs=1e-5)


def test_the_heavy_tail_is_the_likelihood_for_many_degrees():
    a, b = maps()
    plain, many = SpectrumLoss("likelihood"), SpectrumLoss("heavy_tailed", degrees=1e7)
    assert float(many(a, b)) == pytest.approx(float(plain(a, b)), rel=1e-5)
    assert many.fitted_gain(a, b) == pytest.approx(plain.fitted_gain(a, b), rel=1e-5)


def test_one_echo_that_the_scene_does_not_hold_moves_the_gain_of_plain_speckle_only():
    """Speckle of a known map with one stranger a thousand times as bright as anything else."""
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(4, 32, 16, 1, generator=generator, dtype=torch.float64) + 0.1
    looks = -torch.rand(a.shape, generator=generator, dtype=torch.float64).log()
    known = 2.0 * a * looks
    alien = known.clone()
    alien[:, 5, 3] += 1e3
    gains = {
        kind: [
            SpectrumLoss(kind, levels=1, background="none").fitted_gain(a, b)
            for b in (known, alien)
        ]
        for kind in ("likelihood", "heavy_tailed")
    }
    assert gains["likelihood"][1] > 2.5 * gains["likelihood"][0]
    assert gains["heavy_tailed"][1] == pytest.approx(gains["heavy_tailed"][0], rel=0.03)


def test_curvature_of_the_heavy_tail_is_the_mean_second_derivative():
    """Over many draws of data from its own law, as the Fisher information is."""
    generator = torch.Generator().manual_seed(1)
    degrees, shape = 4.0, (2000, 4, 5, 1)
    a = torch.rand(1, *shape[1:], generator=generator, dtype=torch.float64) + 0.5
    tangent = torch.rand(1, *shape[1:], generator=generator, dtype=torch.float64) - 0.3
    u = torch.rand(shape, generator=generator, dtype=torch.float64)
    data = a * degrees * (u ** (-1 / degrees) - 1)  # by the inverse of its distribution
    loss = SpectrumLoss("heavy_tailed", levels=1, gain="one", floor=1e-9, degrees=degrees)
    wide, rows = a.expand(shape).contiguous(), tangent.expand(shape).contiguous()
    step = 1e-3
    values = [float(loss(wide + k * step * rows, data)) for k in (-1, 0, 1)]
    second = (values[0] - 2 * values[1] + values[2]) / step**2
    assert float(loss.curvature(wide, data, rows[None])) == pytest.approx(second, rel=0.05)
