"""Gradient check: automatic derivatives of a whole map against central differences."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.deprecation import rename_arguments
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion.gradcheck.lines import make_line
from invertwin.inversion.gradcheck.tangents import ParameterChanges
from invertwin.limits import Count, NonNegative, Positive
from invertwin.runtime.concurrency import tracer_lock
from invertwin.scene.scene import Scene
from invertwin.seeds import derive_seed

_MIN_PAIRS = 4
_MIN_RELATIVE_CHANGE = 1e-3  # smaller relative changes of a gradient count as none


@dataclass(frozen=True)
class GradcheckSettings:
    """Settings of a gradient check.

    Attributes:
        repeats: number of derivatives to average, with different seeds.
        step: step ε of the differences; ε/2 is evaluated too, and 4ε and 8ε for the order.
        difference_samples: number of samples for one end of a pair.
        noise: target ‖standard error‖₁/‖g_FD‖₁ of the mean of all pairs.
        max_pairs: maximum number of pairs; the report states the noise reached.
        scheme: surface sampling of the differences: "rays" from the antenna, or by "area".
    """

    repeats: Count = 4
    step: Positive = 4e-3
    difference_samples: Count = 8_000_000
    noise: NonNegative = 0.007
    max_pairs: Count = 64
    scheme: Literal["rays", "area"] = "rays"


@dataclass(frozen=True)
class GradientAgreement:
    """Agreement of a gradient map with the differences.

    Attributes:
        relative_l1: ‖g − g_FD‖₁ / ‖g_FD‖₁.
        relative_l2: ‖g − g_FD‖₂ / ‖g_FD‖₂.
        correlation: Pearson correlation over bins.
        order: observed order of ‖FD(ε) − g‖ in ε, from the two large steps: 2 for a correct
            gradient, 0 for a wrong one.
    """

    relative_l1: float
    relative_l2: float
    correlation: float
    order: float


@dataclass(frozen=True)
class GradientReport:
    """Result of :func:`gradcheck`.

    Attributes:
        full: agreement with boundary paths.
        interior: agreement without boundary paths; equal to ``full`` if the model has none.
        no_interior_edges: agreement with boundary paths, except those of shadows that surfaces cast
            on each other; None for paths of one bounce, which have none.
        no_contact: agreement with boundary paths, except those of the curves in which surfaces
            intersect or touch; None without such curves.
        difference_noise: ‖standard error‖₁ / ‖g_FD‖₁; 0 if maps do not depend on the seed.
        step_agreement: ‖FD(ε) − FD(ε/2)‖₁ / ‖FD(ε)‖₁ (includes the noise of both).
        pairs: number of independent difference pairs.
        value, gradient, interior_gradient, difference: the map and its derivatives.
    """

    full: GradientAgreement
    interior: GradientAgreement
    no_interior_edges: GradientAgreement | None
    no_contact: GradientAgreement | None
    difference_noise: float
    step_agreement: float
    pairs: int
    value: Float64[Tensor, "frame *map"]
    gradient: Float64[Tensor, "frame *map"]
    interior_gradient: Float64[Tensor, "frame *map"]
    difference: Float64[Tensor, "frame *map"]


@rename_arguments(of="acts_on", check="settings")
def gradcheck(
    model: ForwardModel,
    module: nn.Module,
    tangent: ParameterChanges | Tensor,
    *,
    scene: Scene,
    sensor: Any,
    acts_on: Literal["scene", "sensor"] = "scene",
    settings: GradcheckSettings | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> GradientReport:
    """Compare the derivative of a map with central differences that have converged.

    The parameters of the module move along the tangent: p + θ · tangent. The differences use common
    random numbers: both ends of a pair draw the same numbers, with probabilities fixed at θ = 0,
    and every pair draws others. Pairs are added until the standard error of their mean is small
    enough. One pair suffices if maps do not depend on the seed.

    Args:
        model: forward model; its ``sampling`` is that of one derivative.
        module: module to differentiate with respect to; θ = 0 is its present state.
        tangent: changes of its values by name, or of its only one; see ``parameter_changes``.
        scene: scene that the module maps, or that the sensor observes.
        sensor: sensor that observes the scene.
        acts_on: "scene" or "sensor": the argument that the module maps.
        settings: accuracy of the check.
        seed: seed of all random numbers.
        progress: callback for occasional lines of text.

    Raises:
        InputError: A tangent that does not fit the module, a model whose derivatives have no
            mean, or a map that does not depend on θ (all differences are zero).
    """
    settings = settings or GradcheckSettings()
    _require_smooth(model)
    line = make_line(module, tangent, scene if acts_on == "scene" else sensor)
    least, repeats = (_MIN_PAIRS, settings.repeats) if model.is_random else (1, 1)

    def make_inputs(moved: Any) -> tuple[Scene, Any]:
        return (moved, sensor) if acts_on == "scene" else (scene, moved)

    def derivative(chosen: ForwardModel) -> tuple[Tensor, Tensor]:
        return _forward_derivative(chosen, lambda t: make_inputs(line.evaluate(t)), repeats, seed)

    def difference(number: int, epsilon: float = settings.step) -> Tensor:
        ends = (make_inputs(line.evaluate_end(end)) for end in (epsilon, -epsilon))
        plus, minus = (paired.predict(*e, derive_seed(seed, 1, number)).double() for e in ends)
        return (plus - minus) / (2 * epsilon)

    with torch.no_grad():
        middle = make_inputs(line.evaluate(torch.zeros((), dtype=torch.float64)))
        paired = model.for_differences(*middle, settings.difference_samples, settings.scheme)
        value, gradient = derivative(model)
        less = {name: derivative(other)[1] for name, other in model.ablations().items()}
        interior_gradient = less.get("boundary", gradient)
        if model.is_random:
            pairs, reached = _average_differences(difference, settings, progress)
        else:
            pairs, reached = difference(0)[None], 0.0
        _require_change(truth := pairs.mean(0))
        half, far, farther = (
            torch.stack([difference(n, k * settings.step) for n in range(least)]).mean(0)
            for k in (0.5, 4.0, 8.0)
        )
    edges, contacts = less.get("interior_edges"), _drop_equal(less.get("contacts"), gradient)
    agree = partial(_measure_agreement, truth=truth, far=far, farther=farther)
    return GradientReport(
        full=agree(gradient),
        interior=agree(interior_gradient),
        no_interior_edges=None if edges is None else agree(edges),
        no_contact=None if contacts is None else agree(contacts),
        difference_noise=reached,
        step_agreement=_step_agreement(pairs[:least].mean(0), half),
        pairs=len(pairs),
        value=value,
        gradient=gradient,
        interior_gradient=interior_gradient,
        difference=truth,
    )


def _require_smooth(model: ForwardModel) -> None:
    if not model.is_smooth:
        raise InputError(
            f"expected a smooth model, got {type(model).__name__}, whose silhouettes of single "
            "rough points have no derivative; use one such as SurrogateMap"
        )


def _require_change(difference: Tensor) -> None:
    if not difference.abs().sum() > 0:
        raise InputError(
            "expected a map that depends on θ, got differences that are all zero; check the grid "
            "and what the parameter moves"
        )


def _step_agreement(whole: Tensor, half: Tensor) -> float:
    """Return ‖FD(ε) − FD(ε/2)‖₁ / ‖FD(ε)‖₁."""
    return float((whole - half).abs().sum() / whole.abs().sum())


def _drop_equal(ablated: Tensor | None, gradient: Tensor) -> Tensor | None:
    """Return the gradient of an ablation; None if it equals the full gradient."""
    if ablated is None:
        return None
    changed = (ablated - gradient).abs().sum()
    return ablated if changed > _MIN_RELATIVE_CHANGE * gradient.abs().sum() else None


def _forward_derivative(
    model: ForwardModel, make_inputs: Callable[[Tensor], tuple[Scene, Any]], repeats: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Return the map at θ = 0 and its forward-mode derivative, averaged over seeds."""
    primals, tangents = [], []
    for number in range(repeats):
        with tracer_lock, forward_ad.dual_level():
            zero = torch.zeros((), dtype=torch.float64)
            theta = forward_ad.make_dual(zero, torch.ones_like(zero))
            out = model.predict(*make_inputs(theta), derive_seed(seed, 0, number)).double()
            primal, slope = forward_ad.unpack_dual(out)
            primals.append(primal)
            tangents.append(torch.zeros_like(primal) if slope is None else slope)
    return torch.stack(primals).mean(0), torch.stack(tangents).mean(0)


def _average_differences(
    difference: Callable[[int], Tensor],
    settings: GradcheckSettings,
    progress: Callable[[str], None] | None,
) -> tuple[Tensor, float]:
    """Return difference pairs until the noise target is met, and the noise of their mean."""
    pairs: list[Tensor] = []
    reached, begin = math.inf, time.monotonic()
    while len(pairs) < settings.max_pairs and (len(pairs) < _MIN_PAIRS or reached > settings.noise):
        pairs.append(difference(len(pairs)))
        if len(pairs) >= 2:
            every = torch.stack(pairs)
            error = every.std(0) / math.sqrt(len(pairs))
            reached = float(error.abs().sum() / every.mean(0).abs().sum().clamp_min(1e-300))
            if progress:
                # Noise falls with the square root of the number of pairs.
                enough = len(pairs) * (reached / max(settings.noise, 1e-9)) ** 2
                count = min(settings.max_pairs, max(_MIN_PAIRS, math.ceil(enough)))
                left = (time.monotonic() - begin) / len(pairs) * max(count - len(pairs), 0)
                noise = f"difference noise {reached:.4f}, about {left:.0f} s left"
                progress(f"{len(pairs)} pairs, {noise}")
    return torch.stack(pairs), reached


def _measure_agreement(
    gradient: Tensor, truth: Tensor, far: Tensor, farther: Tensor
) -> GradientAgreement:
    miss = gradient - truth
    both = torch.stack([gradient.flatten(), truth.flatten()])
    errors = [float((d - gradient).norm()) for d in (far, farther)]
    return GradientAgreement(
        relative_l1=float(miss.abs().sum() / truth.abs().sum()),
        relative_l2=float(miss.norm() / truth.norm()),
        correlation=float(torch.corrcoef(both)[0, 1]),
        order=math.log2(errors[1] / errors[0]) if min(errors) > 0 else math.nan,
    )
