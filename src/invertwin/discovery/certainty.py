"""How sure shapes are: error bars, kinds and presence, from the scatter between frames."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from invertwin.discovery.assembly import Assembly
from invertwin.discovery.search import facing, other_kinds
from invertwin.discovery.shapes.primitives import Figure, upright
from invertwin.inversion import Reconstruction, speckle_weight
from invertwin.inversion.confidence.uncertainty import coordinates, map_derivatives


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
    score = 1 - ratio * speckle_weight(ratio, nu)
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


@dataclass(frozen=True)
class Rival:
    """What a shape may be.

    Attributes:
        figure: After a fit.
        weight: Its probability.
    """

    figure: Figure
    weight: float


def rivals(one: Assembly, shapes: Sequence[Figure]) -> list[list[Rival]]:
    """What every shape may be, all others as they are; itself first.

    Other kinds, and others that look the other way, are fitted for a short while first, all shapes
    together.

    Args:
        one: Maps.
        shapes: After their fit.
    """
    together = one.gains(shapes)
    found = [[Rival(shape, 1.0)] for shape in shapes]
    for changed in (*other_kinds(one, shapes), facing(shapes, math.pi, one.ground)):
        if not changed:
            continue
        fitted, _ = one.fitted(changed, _SHORT)
        for number, (start, new, old) in enumerate(zip(changed, fitted, shapes, strict=True)):
            if start is old:
                continue
            # A short fit stirs a shape up before it mends it.
            options = [
                (one.gains([*shapes[:number], r, *shapes[number + 1 :]]), r) for r in (start, new)
            ]
            swapped, rival = max(options, key=lambda option: float(option[0].sum()))
            right = min(max(surer(together, swapped), 1e-6), 1 - 1e-6)
            found[number].append(Rival(rival, (1 - right) / right))
    totals = [sum(rival.weight for rival in row) for row in found]
    return [
        [replace(rival, weight=rival.weight / total) for rival in row]
        for row, total in zip(found, totals, strict=True)
    ]


def kind_probabilities(among: Sequence[Rival]) -> dict[str, float]:
    """The probability of every kind.

    Args:
        among: What a shape may be.
    """
    found = dict[str, float]()
    for rival in among:
        found[rival.figure.named] = found.get(rival.figure.named, 0.0) + rival.weight
    return found


def widened(one: Assembly, own: Mapping[str, float], among: Sequence[Rival]) -> dict[str, float]:
    """Standard deviations of a shape's place, with what its derivatives do not tell.

    They do not tell where it would be if it were a rival; nor, of what may hang at any height near
    the radar's, how its range grows with the square of its way up or down.

    Args:
        one: Maps.
        own: Its deviations if it is what it is called.
        among: What it may be, itself first.
    """
    found, figure = dict(own), among[0].figure
    middle = upright(figure, one.ground, one.level)
    farther = 0.0
    if figure.ball:
        distance = float((one.radar.positions.detach() - middle).norm(dim=1).mean())
        farther = own["height"] ** 2 / (2 * distance)
    for number, axis in enumerate(one.ground.level):
        away = sum(r.weight * (r.figure.place[number] - figure.place[number]) ** 2 for r in among)
        found["xyz"[axis]] = math.hypot(own["xyz"[axis]], math.sqrt(away), farther)
    return found


_SHORT = 20  # steps
