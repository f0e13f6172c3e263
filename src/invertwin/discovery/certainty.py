"""Uncertainty of shapes: error bars, kinds and existence, from the scatter over frames."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from invertwin.discovery.assembly import ShapeLikelihood
from invertwin.discovery.search import propose_kinds, rotate_headed_shapes
from invertwin.discovery.shapes.primitives import ShapeParameters, Shapes, shape_center
from invertwin.inversion import Reconstruction, speckle_weight
from invertwin.inversion.confidence.uncertainty import iterate_coordinates, map_derivatives


def standard_deviations(
    likelihood: ShapeLikelihood, reconstruction: Reconstruction
) -> dict[str, float]:
    """Compute standard deviations of all numbers of a joint fit by name.

    The larger of two covariances: H⁻¹, H the information of heavy-tailed speckle, and H⁻¹ S H⁻¹, S
    the scatter of single frames' gradients. The first assumes correct shapes, the second allows for
    model errors. An unobserved coordinate has its prior deviation, ten times its span.

    Args:
        likelihood: likelihood of the maps.
        reconstruction: joint fit of the shapes.
    """
    fit = reconstruction.result.fit
    rows = list(iterate_coordinates(fit.modules))
    mean, power = reconstruction.result.maps[0]
    mean = (mean.detach().clamp_min(0.0) + likelihood.loss.level.to(mean)[:, None, None]).double()
    ratio, nu = power.double() / mean, likelihood.loss.degrees
    score = 1 - ratio * speckle_weight(ratio, nu)
    first, second = (
        map_derivatives(fit, rows, number)[0].detach().double() / mean for number in (0, 1)
    )
    flat = [part.flatten(2) for part in (first, second)]
    # The product of two independent draws is free of the apparent information of their noise.
    mixed = torch.einsum("pfn,qfn->pq", *flat)
    information = nu / (nu + 2) * 0.5 * (mixed + mixed.T) / likelihood.bins_per_draw
    slopes = torch.einsum("pfn,fn->pf", 0.5 * (flat[0] + flat[1]), score.flatten(1))
    slopes = slopes / likelihood.bins_per_draw
    scatter = slopes @ slopes.T
    spans = torch.tensor([10 * row.span for row in rows], dtype=torch.float64)
    # In units of the spans, with a prior of one unit; keep it positive despite noise.
    values, axes = torch.linalg.eigh(information * spans * spans[:, None])
    inverse = axes / (values.clamp_min(0.0) + 1.0) @ axes.T
    sandwich = inverse @ (scatter * spans * spans[:, None]) @ inverse
    error = torch.maximum(inverse.diagonal(), sandwich.diagonal()).sqrt() * spans
    return {row.name: float(value) for row, value in zip(rows, error, strict=True)}


def acceptance_probability(gains_with: Tensor, gains_without: Tensor) -> float:
    """Compute the probability that a model change supported by the frames is real.

    Args:
        gains_with: log-likelihood gains of all frames with the change.
        gains_without: log-likelihood gains of all frames without the change.
    """
    gain = gains_with - gains_without
    total = float(gain.sum())
    if len(gain) < 4:
        return 1 - min(1.0, math.exp(-max(total, 0.0)))
    spread = float(gain.std()) * math.sqrt(len(gain))
    return float(torch.special.ndtr(torch.tensor(total / max(spread, 1e-9)).double()))


def existence_probabilities(likelihood: ShapeLikelihood, shapes: Shapes) -> list[float]:
    """Compute the existence probability of every shape.

    Args:
        likelihood: likelihood of the maps.
        shapes: all shapes.
    """
    together = likelihood.log_likelihood_gains(shapes)
    without = [[*shapes[:k], *shapes[k + 1 :]] for k in range(len(shapes))]
    return [acceptance_probability(together, likelihood.log_likelihood_gains(r)) for r in without]


@dataclass(frozen=True)
class ShapeHypothesis:
    """Hypothesis about the kind of a shape.

    Attributes:
        shape: fitted shape parameters.
        probability: its probability.
    """

    shape: ShapeParameters
    probability: float


Hypotheses = Sequence[ShapeHypothesis]


def find_hypotheses(likelihood: ShapeLikelihood, shapes: Shapes) -> list[list[ShapeHypothesis]]:
    """Return alternative hypotheses of every shape with all others fixed; the shape itself comes
    first.

    Other kinds and opposite headings are first fitted for a few steps, all shapes together.

    Args:
        likelihood: likelihood of the maps.
        shapes: fitted shapes.
    """
    together = likelihood.log_likelihood_gains(shapes)
    found = [[ShapeHypothesis(shape, 1.0)] for shape in shapes]
    for changed in (*propose_kinds(likelihood, shapes), rotate_headed_shapes(shapes, math.pi)):
        if not changed:
            continue
        fitted = likelihood.refine(changed, _SHORT_FIT_STEPS)
        for number, (start, new, old) in enumerate(zip(changed, fitted, shapes, strict=True)):
            if start is old:
                continue
            # The first steps of a short fit may lower the likelihood.
            options = [
                (likelihood.log_likelihood_gains([*shapes[:number], r, *shapes[number + 1 :]]), r)
                for r in (start, new)
            ]
            swapped, other = max(options, key=lambda option: float(option[0].sum()))
            right = min(max(acceptance_probability(together, swapped), 1e-6), 1 - 1e-6)
            found[number].append(ShapeHypothesis(other, (1 - right) / right))
    totals = [sum(other.probability for other in row) for row in found]
    return [
        [replace(other, probability=other.probability / total) for other in row]
        for row, total in zip(found, totals, strict=True)
    ]


def kind_probabilities(hypotheses: Hypotheses) -> dict[str, float]:
    """Return the probability of every kind.

    Args:
        hypotheses: hypotheses of a shape.
    """
    found = dict[str, float]()
    for other in hypotheses:
        kind = other.shape.effective_kind
        found[kind] = found.get(kind, 0.0) + other.probability
    return found


def widen_deviations(
    likelihood: ShapeLikelihood, deviations: Mapping[str, float], hypotheses: Hypotheses
) -> dict[str, float]:
    """Widen the standard deviations of a shape by errors that its derivatives do not show.

    These are the displacement of other hypotheses, and for shapes of unknown height near the
    radar's the change of range with the square of their height offset.

    Args:
        likelihood: likelihood of the maps.
        deviations: deviations given the best hypothesis.
        hypotheses: hypotheses of the shape, the best first.
    """
    found, figure = dict(deviations), hypotheses[0].shape
    middle = shape_center(figure, likelihood.level)
    farther = 0.0
    if figure.has_free_height:
        distance = float((likelihood.radar.positions.detach() - middle).norm(dim=1).mean())
        farther = deviations["height"] ** 2 / (2 * distance)
    for number, axis in enumerate("xy"):
        away = sum(
            r.probability * (r.shape.position[number] - figure.position[number]) ** 2
            for r in hypotheses
        )
        found[axis] = math.hypot(deviations[axis], math.sqrt(away), farther)
    return found


_SHORT_FIT_STEPS = 20  # steps
