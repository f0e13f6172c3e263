"""Flat plates: waves that several edges of one plate diffract, one after another.

An edge sends a wave along the plate, strongest where H lies along the edge. It meets another edge
head on and is diffracted again. Both sides of the plate carry it with opposite sign, so the half of
a grazing wave that counts as incident counts twice.

Source: derivations §14; Ross, "Radar cross section of rectangular flat plates as a function of
aspect angle", IEEE TAP 14, 1966.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot, parallelogram_integral
from invertwin.channel.em.wedges import LEAST_ANGLE, Wedges

_SAMPLES = 16  # of the lit part of the last edge
_FLAT = 1e-6

Lit = Callable[[Tensor, Tensor], Tensor]
"""Points and unit vectors from them → whether nothing is in the way."""


def several_diffractions(
    plates: Sequence[Wedges],
    wave_number: float,
    incident: Float64[Tensor, "row 3"],
    field: Float64[Tensor, "row 2 3"],
    towards: Float64[Tensor, "row 3"],
    most: int,
    lit: Lit,
) -> Iterator[Tensor]:
    """F of two diffractions, of three, and so on, by sides of one plate; [row, 2, 3].

    A wave goes from side to side, but not between sides that share a corner: there it has no way
    to become the wave of an edge, and what the corner itself does is not modelled.

    Args:
        plates: sides of each, from ``plates_of``.
        wave_number: k [1/m].
        incident: d of each wave.
        field: E.
        towards: s, to the receiver.
        most: diffractions.
        lit: tells what the source sees of an edge.
    """
    chains = [(sides, [side]) for sides in plates for side in range(len(sides.start))]
    for _ in range(2, most + 1):
        chains = [
            (sides, [*chain, side])
            for sides, chain in chains
            for side in range(len(sides.start))
            if side != chain[-1] and not _touching(sides, side, chain[-1])
        ]
        total = torch.zeros(len(incident), 2, 3, dtype=torch.complex128)
        for sides, chain in chains:
            total = total + _chain(sides, chain, wave_number, incident, field, towards, lit)
        yield total


def plates_of(wedges: Wedges) -> list[Wedges]:
    """The sides of flat convex plates, found among open edges.

    Args:
        wedges: edges; those of solid bodies and creases are left out.
    """
    left = torch.nonzero(wedges.opening > 2 - _FLAT)[:, 0].tolist()
    found: list[Wedges] = []
    while left:
        plate, rest, grown = [left[0]], left[1:], True
        while grown:
            near = [e for e in rest if any(_joined(wedges, e, other) for other in plate)]
            plate, rest, grown = plate + near, [e for e in rest if e not in near], bool(near)
        left = rest
        edges = wedges.rows(torch.tensor(plate))
        if _convex(edges):
            found.append(_sides(edges))
    return found


def _joined(wedges: Wedges, one: int, other: int) -> bool:
    """Whether two edges share a corner and a plane."""
    turn = cross(wedges.normals[one, 0], wedges.normals[other, 0]).norm()
    return bool(turn < _FLAT) and _touching(wedges, one, other)


def _touching(wedges: Wedges, one: int, other: int) -> bool:
    """Whether two edges share a corner."""
    ends = [torch.stack([wedges.start[e], wedges.end[e]]) for e in (one, other)]
    gap = (ends[0][:, None] - ends[1][None]).norm(dim=2).min()
    return bool(gap < _FLAT * (ends[0][1] - ends[0][0]).norm())


def _convex(edges: Wedges) -> bool:
    """Whether all edges lie on the inner side of each."""
    middles = (edges.start + edges.end) / 2
    depth = (edges.inwards[:, :1] * (middles[None] - middles[:, None])).sum(2)
    return bool((depth > -_FLAT * depth.abs().max()).all())


def _sides(edges: Wedges) -> Wedges:
    """Edges of a convex plate with those of one line joined."""
    inward, left, sides = edges.inwards[:, 0], list(range(len(edges.start))), []
    while left:
        own = [e for e in left if bool((inward[e] - inward[left[0]]).norm() < _FLAT)]
        left = [e for e in left if e not in own]
        points = torch.cat([edges.start[own], edges.end[own]])
        along = points @ (edges.end[own[0]] - edges.start[own[0]])
        first = edges.rows(torch.tensor(own[:1]))
        ends = {"start": points[along.argmin()][None], "end": points[along.argmax()][None]}
        sides.append(vars(first) | ends)
    return Wedges(**{name: torch.cat([side[name] for side in sides]) for name in sides[0]})


def _chain(
    wedges: Wedges,
    chain: list[int],
    k: float,
    incident: Tensor,
    field: Tensor,
    towards: Tensor,
    lit: Lit,
) -> Tensor:
    """F of the waves that a sequence of edges diffracts."""
    above = wedges.normals[chain[0], 0]
    ways, amplitude = _along_plate(wedges, chain, k, incident, field, above)
    start, side = wedges.start[chain[-1]], wedges.end[chain[-1]] - wedges.start[chain[-1]]
    # Where rays left the edges before is linear along the last edge: its lit part is an interval.
    ends = [_back(wedges, chain, ways, start + t * side) for t in (0.0, 1.0)]
    low, high = torch.zeros_like(ends[0].path), torch.ones_like(ends[0].path)
    for first, last, least, most in zip(
        (*ends[0].places.T, *ends[0].lengths.T),
        (*ends[1].places.T, *ends[1].lengths.T),
        [0.0] * len(ways) + [_FLAT * float(side.detach().norm())] * len(ways),
        [1.0] * len(ways) + [math.inf] * len(ways),
        strict=True,
    ):
        slope = last - first
        for bound, sign in ((least, 1.0), (most, -1.0)):
            safe = torch.where(slope.abs() > 1e-12, slope, torch.ones_like(slope))
            at = (bound - first) / safe
            rising = sign * slope > 1e-12
            falling = sign * slope < -1e-12
            never = ~rising & ~falling & (sign * (first - bound) <= 0)
            low = torch.where(rising, torch.maximum(low, at), low)
            high = torch.where(falling, torch.minimum(high, at), high)
            high = torch.where(never, torch.full_like(high, -1.0), high)
    row = torch.nonzero(high - low > _FLAT)[:, 0].repeat_interleave(_SAMPLES)
    size = (high - low)[row] / _SAMPLES
    begin = low[row] + size * (torch.arange(len(row)) % _SAMPLES)
    point = start + (begin + size / 2)[:, None] * side
    # The mean of 1/√length over each piece, also where two edges meet.
    roots = [
        torch.lerp(ends[0].lengths[row], ends[1].lengths[row], t[:, None]).clamp_min(0).sqrt()
        for t in (begin, begin + size)
    ]
    spread = (2 / (roots[0] + roots[1]).clamp_min(1e-12)).prod(1)
    ray = _back(wedges, chain, [way[row] for way in ways], point)
    d, s, wave = incident[row], towards[row], ways[-1][row]
    inward = wedges.inwards[chain[-1], 0]
    along = cross(inward, above).expand_as(s)
    magnetic = dot(cross(wave, above.expand_as(wave)), along)
    azimuth = torch.atan2(dot(s, above), dot(s, inward)) % (2 * math.pi)
    sines = [(1 - dot(along, v) ** 2).clamp_min(1e-12).sqrt() for v in (wave, s)]
    valid = dot(s, above).abs() > math.sin(LEAST_ANGLE)
    for sine in sines:
        valid &= sine > math.sin(LEAST_ANGLE)
    strength = magnetic / (2 * math.pi * sines[0] * sines[1] * torch.cos(azimuth / 2))
    strength = torch.where(valid & lit(ray.origin, -d), strength * spread, 0.0)
    piece = side * size[:, None]
    width = parallelogram_integral(k * (s - wave), piece, torch.zeros_like(piece))
    turn = k * (dot(s, point) - dot(d, ray.origin) - ray.path)
    scale = torch.polar(strength * width * piece.norm(dim=1), turn)
    sent = scale[:, None, None] * amplitude[row][..., None] * cross(s, along)[:, None]
    return torch.zeros(len(incident), 2, 3, dtype=torch.complex128).index_add(0, row, sent)


def _along_plate(
    wedges: Wedges, chain: list[int], k: float, incident: Tensor, field: Tensor, above: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Ways along the plate after each edge but the last; E after them without its spreading."""
    ways: list[Tensor] = []
    wave, electric = incident, field
    amplitude = torch.ones(len(incident), 2, dtype=torch.complex128)
    for edge in chain[:-1]:
        inward = wedges.inwards[edge, 0]
        along = cross(inward, above).expand_as(wave)
        cosine = dot(wave, along)
        sine = (1 - cosine**2).clamp_min(1e-12).sqrt()
        magnetic = dot(cross(wave[:, None], electric), along[:, None])
        valid = sine > math.sin(LEAST_ANGLE)
        azimuth = torch.zeros_like(cosine)
        if not ways:
            azimuth = torch.atan2(-dot(wave, above), -dot(wave, inward)) % (2 * math.pi)
            valid &= dot(wave, above).abs() > math.sin(LEAST_ANGLE)
        # The hard half plane at φ = 0: both of its terms are 1/cos(φ′/2).
        hard = -((2 * math.pi * k) ** -0.5) / (sine * torch.cos(azimuth / 2)) * valid
        wave = cosine[:, None] * along + sine[:, None] * inward
        ways.append(wave)
        electric = above.expand(len(wave), 1, 3)
        turned = dot(cross(wave, above.expand_as(wave)), along)
        phase = complex(math.cos(math.pi / 4), -math.sin(math.pi / 4))
        amplitude = amplitude * magnetic * (hard / turned)[:, None] * phase
    return ways, amplitude


class _Ray(NamedTuple):
    """Rays along a plate, followed back from the last edge.

    Attributes:
        origin: on the first edge [m].
        path: length along the plate [m].
        places: where rays left each edge, 0 at its start and 1 at its end.
        lengths: between the edges [m].
    """

    origin: Tensor
    path: Tensor
    places: Tensor
    lengths: Tensor


def _back(wedges: Wedges, chain: list[int], ways: list[Tensor], point: Tensor) -> _Ray:
    places, lengths = [], []
    at = point.expand_as(ways[0])
    for edge, way in zip(chain[-2::-1], ways[::-1], strict=True):
        origin, inward = wedges.start[edge], wedges.inwards[edge, 0].expand_as(at)
        sideways = wedges.end[edge] - origin
        length = dot(at - origin, inward) / dot(way, inward)
        at = at - length[:, None] * way
        places.append(dot(at - origin, sideways.expand_as(at)) / dot(sideways, sideways))
        lengths.append(length)
    between = torch.stack(lengths, 1)
    return _Ray(at, between.sum(1), torch.stack(places, 1), between)
