"""How sure shapes are: error bars, kinds and presence, from the scatter between frames."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from invertwin.discovery.assembly import Assembly
from invertwin.discovery.primitives import Figure
from invertwin.discovery.search import as_kind
from invertwin.inversion import Reconstruction
from invertwin.inversion.uncertainty import coordinates, map_derivatives


def deviations(one: Assembly, found: Reconstruction) -> dict[str, float]:
    """Standard deviations of all numbers of a joint fit, by name.

    The larger of two: H⁻¹, H the information of heavy-tailed speckle, and H⁻¹ S H⁻¹, S the scatter
    of single frames' gradients. The first is right if the shapes are, the second allows for shapes
    that are not. A coordinate that the maps do not tell has the deviation of what is thought
    beforehand, ten times an error that matters.

    Args:
        one: Maps.
        found: The fit.
    """
    fit = found.end.fit
    rows = list(coordinates(fit.modules))
    mean, power = found.end.maps[0]
    level = one.loss.level.to(mean)[:, None, None]
    mean = (mean.detach().clamp_min(0.0) + level).double()
    ratio, nu = power.double() / mean, one.loss.degrees
    score = 1 - ratio * (nu + 1) / (nu + ratio)
    first, second = (
        map_derivatives(fit, rows, number)[0].detach().double() / mean for number in (0, 1)
    )
    flat = [part.flatten(2) for part in (first, second)]
    # The product of two draws is free of the information that their noise feigns.
    mixed = torch.einsum("pfn,qfn->pq", *flat)
    information = nu / (nu + 2) * 0.5 * (mixed + mixed.T) / one.shared
    slopes = torch.einsum("pfn,fn->pf", 0.5 * (flat[0] + flat[1]), score.flatten(1)) / one.shared
    scatter = slopes @ slopes.T
    spans = torch.tensor([10 * row.span for row in rows], dtype=torch.float64)
    # In units of the spans, with one unit known beforehand; noise must not make it negative.
    scaled = information * spans * spans[:, None]
    values, axes = torch.linalg.eigh(scaled)
    inverse = axes / (values.clamp_min(0.0) + 1.0) @ axes.T
    sandwich = inverse @ (scatter * spans * spans[:, None]) @ inverse
    error = torch.maximum(inverse.diagonal(), sandwich.diagonal()).sqrt() * spans
    return {row.name: float(value) for row, value in zip(rows, error, strict=True)}


def surer(with_it: Tensor, without: Tensor) -> float:
    """The probability that a change that frames speak for is right.

    Args:
        with_it: Gains of all frames.
        without: Those without the change.
    """
    gain = with_it - without
    total = float(gain.sum())
    if len(gain) < 4:
        return 1 - min(1.0, math.exp(-max(total, 0.0)))
    spread = float(gain.std()) * math.sqrt(len(gain))
    return float(torch.special.ndtr(torch.tensor(total / max(spread, 1e-9)).double()))


def presence(one: Assembly, shapes: Sequence[Figure]) -> list[float]:
    """The probability of every shape that it is there.

    Args:
        one: Maps.
        shapes: All of them.
    """
    together = one.gains(shapes)
    return [surer(together, one.gains([*shapes[:k], *shapes[k + 1 :]])) for k in range(len(shapes))]


def kind_probabilities(one: Assembly, shapes: Sequence[Figure]) -> list[Mapping[str, float]]:
    """The probability of every kind for every shape, all others as they are.

    Other kinds are fitted for a short while first, all shapes together.

    Args:
        one: Maps.
        shapes: After their fit.
    """
    together = one.gains(shapes)
    odds = [{shape.named: 1.0} for shape in shapes]
    for kind in ("box", "cylinder", "sphere"):
        changed = [as_kind(shape, kind) for shape in shapes]
        if all(new is old for new, old in zip(changed, shapes, strict=True)):
            continue
        fitted, _ = one.fitted(changed, _SHORT)
        for number, (new, old) in enumerate(zip(fitted, shapes, strict=True)):
            if new.kind == old.kind or (new.kind == "box" and old.boxed):
                continue
            swapped = one.gains([*shapes[:number], new, *shapes[number + 1 :]])
            right = min(max(surer(together, swapped), 1e-6), 1 - 1e-6)
            odds[number][new.named] = max(odds[number].get(new.named, 0.0), (1 - right) / right)
    return [{k: v / sum(row.values()) for k, v in row.items()} for row in odds]


_SHORT = 20  # steps
