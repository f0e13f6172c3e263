"""Uncertainty of shapes: error bars, kinds and existence, from the scatter over frames."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import torch

from invertwin.discovery.assembly import ShapeLikelihood
from invertwin.discovery.imaging.likelihood import find_grating_lobes
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
    flat = [(map_derivatives(fit, rows, k)[0].detach().double() / mean).flatten(2) for k in (0, 1)]
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


def _exchange(shapes: Shapes, number: int, new: ShapeParameters) -> list[ShapeParameters]:
    return [*shapes[:number], new, *shapes[number + 1 :]]


def preference(likelihood: ShapeLikelihood, shapes: Shapes, rivals: Shapes) -> float:
    """Compute the probability that one set of shapes, rather than another, made the maps.

    The difference of their likelihoods is compared with its scatter: between frames or, where these
    are few, between independent draws. Two shapes that are both slightly wrong differ by chance.

    Source: Vuong, "Likelihood ratio tests for model selection and non-nested hypotheses",
    Econometrica 57, 1989.

    Args:
        likelihood: likelihood of the maps.
        shapes: shapes.
        rivals: other shapes.
    """
    if likelihood.radar.frame_count >= _MIN_FRAMES:
        new, old = map(likelihood.log_likelihood_gains, (shapes, rivals))
        spread = float((new - old).std()) * math.sqrt(len(new))
    else:
        new, old = (-likelihood.bin_losses(row).double() for row in (shapes, rivals))
        spread = float((new - old).square().sum() * likelihood.bins_per_draw) ** 0.5
    right = torch.special.ndtr((new - old).sum() / max(spread, 1e-9))
    return float(right.clamp(1e-6, 1 - 1e-6))


def existence_probabilities(likelihood: ShapeLikelihood, shapes: Shapes) -> list[float]:
    """Compute the existence probability of every shape.

    In few frames, a shape must explain more than its free parameters do by chance.

    Args:
        likelihood: likelihood of the maps.
        shapes: all shapes.
    """
    without = [[*shapes[:k], *shapes[k + 1 :]] for k in range(len(shapes))]
    if likelihood.radar.frame_count >= _MIN_FRAMES:
        return [preference(likelihood, shapes, rest) for rest in without]
    odds = [likelihood.evidence(shapes) - likelihood.evidence(rest) for rest in without]
    return torch.tensor(odds, dtype=torch.float64).sigmoid().tolist()


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
    found = [[ShapeHypothesis(shape, 1.0)] for shape in shapes]
    for changed in (*propose_kinds(likelihood, shapes), rotate_headed_shapes(shapes, math.pi)):
        if not changed:
            continue
        fitted = likelihood.refine(changed, _SHORT_FIT_STEPS)
        for number, (start, new, old) in enumerate(zip(changed, fitted, shapes, strict=True)):
            if start is old:
                continue
            # The first steps of a short fit may lower the likelihood.
            options = [_exchange(shapes, number, one) for one in (start, new)]
            swapped = max(options, key=likelihood.total_gain)
            odds = 1 / preference(likelihood, shapes, swapped) - 1
            found[number].append(ShapeHypothesis(swapped[number], odds))
    lobes = find_grating_lobes(likelihood.radar, likelihood.model.grid)
    for (number, row), offset in product(list(enumerate(map(tuple, found))), lobes):
        if (turned := rotate_to_lobe(likelihood, shapes[number], offset)) is None:
            continue
        # The array distinguishes kinds there as here.
        odds = 1 / preference(likelihood, shapes, _exchange(shapes, number, turned)) - 1
        for other in row:
            moved = rotate_to_lobe(likelihood, other.shape, offset) or turned
            found[number].append(ShapeHypothesis(moved, odds * other.probability))
    totals = [sum(other.probability for other in row) for row in found]
    return [
        [replace(other, probability=other.probability / total) for other in row]
        for row, total in zip(found, totals, strict=True)
    ]


def rotate_to_lobe(
    likelihood: ShapeLikelihood, shape: ShapeParameters, offset: float
) -> ShapeParameters | None:
    """Rotate a shape about the radar into a grating lobe of its array.

    It keeps its range, its aspect and its echo, as the middle position sees it.

    Args:
        likelihood: likelihood of the maps.
        shape: present shape.
        offset: offset of u, see ``find_grating_lobes``.

    Returns:
        None out of the radar's view, or for a prism, whose outline does not turn.
    """
    link, middle = likelihood.radar.link(), likelihood.radar.frame_count // 2
    place, axes = likelihood.radar.positions[middle].detach(), link.rotations[middle].detach()
    way = shape_center(shape, likelihood.level) - place
    old = way / way.norm() @ axes
    new = old + old.new_tensor([0.0, offset, 0.0])
    new[0] = (1 - new[1:].square().sum()).clamp_min(0.0).sqrt().copysign(old[0])
    both = torch.stack([old, new])
    gains = (link.tx_pattern.gain(both) * link.rx_pattern.gain(both)).tolist()
    if new[0] == 0 or gains[1] == 0 or shape.kind == "prism":
        return None
    ends = way.norm() * both @ axes.T
    turn, (x, y) = torch.atan2(ends[:, 1], ends[:, 0]).diff(), (place + ends[1])[:2].tolist()
    yaw, brightness = shape.yaw + float(turn), shape.brightness * gains[0] / gains[1]
    return replace(shape, position=(x, y), yaw=yaw, brightness=brightness)


def kind_probabilities(hypotheses: Hypotheses) -> dict[str, float]:
    """Return the probability of every kind.

    Args:
        hypotheses: hypotheses of a shape.
    """
    found = defaultdict[str, float](float)
    for other in hypotheses:
        found[other.shape.effective_kind] += other.probability
    return dict(found)


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
        here = figure.position[number]
        away = sum(r.probability * (r.shape.position[number] - here) ** 2 for r in hypotheses)
        found[axis] = math.hypot(deviations[axis], math.sqrt(away), farther)
    return found


_SHORT_FIT_STEPS = 20  # steps
_MIN_FRAMES = 4  # whose scatter is an error bar
