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
from invertwin.channel.em.wedges import MIN_EDGE_ANGLE, Wedges

_SAMPLES_PER_EDGE = 16  # of the lit part of the last edge
_TOLERANCE = 1e-6

VisibilityTest = Callable[[Tensor, Tensor], Tensor]
"""Points and unit vectors from them → whether nothing is in the way."""


def trace_multiple_diffractions(
    plates: Sequence[Wedges],
    wave_number: float,
    incident: Float64[Tensor, "row 3"],
    field: Float64[Tensor, "row 2 3"],
    scattering_direction: Float64[Tensor, "row 3"],
    max_diffractions: int,
    is_visible: VisibilityTest,
) -> Iterator[Tensor]:
    """F of two diffractions, of three, and so on, by sides of one plate; [row, 2, 3].

    A wave goes from side to side, but not between sides that share a corner: there it has no way
    to become the wave of an edge, and what the corner itself does is not modelled.

    Args:
        plates: sides of each, from ``find_plates``.
        wave_number: k [1/m].
        incident: d of each wave.
        field: E.
        scattering_direction: s, to the receiver.
        max_diffractions: diffractions.
        is_visible: tells what the source sees of an edge.
    """
    chains = [(sides, [side]) for sides in plates for side in range(len(sides.start))]
    for _ in range(2, max_diffractions + 1):
        chains = [
            (sides, [*chain, side])
            for sides, chain in chains
            for side in range(len(sides.start))
            if side != chain[-1] and not _share_corner(sides, side, chain[-1])
        ]
        total = torch.zeros(len(incident), 2, 3, dtype=torch.complex128)
        for sides, chain in chains:
            total = total + _diffract_sequence(
                sides, chain, wave_number, incident, field, scattering_direction, is_visible
            )
        yield total


def find_plates(wedges: Wedges) -> list[Wedges]:
    """The sides of flat convex plates, found among open edges.

    Args:
        wedges: edges; those of solid bodies and creases are left out.
    """
    left = torch.nonzero(wedges.opening > 2 - _TOLERANCE)[:, 0].tolist()
    found: list[Wedges] = []
    while left:
        plate, rest, grown = [left[0]], left[1:], True
        while grown:
            near = [
                e
                for e in rest
                if any(_are_coplanar_neighbours(wedges, e, other) for other in plate)
            ]
            plate, rest, grown = plate + near, [e for e in rest if e not in near], bool(near)
        left = rest
        edges = wedges.rows(torch.tensor(plate))
        if _is_convex(edges):
            found.append(_merge_collinear_edges(edges))
    return found


def _are_coplanar_neighbours(wedges: Wedges, one: int, other: int) -> bool:
    """Whether two edges share a corner and a plane."""
    turn = cross(wedges.normals[one, 0], wedges.normals[other, 0]).norm()
    return bool(turn < _TOLERANCE) and _share_corner(wedges, one, other)


def _share_corner(wedges: Wedges, one: int, other: int) -> bool:
    """Whether two edges share a corner."""
    ends = [torch.stack([wedges.start[e], wedges.end[e]]) for e in (one, other)]
    gap = (ends[0][:, None] - ends[1][None]).norm(dim=2).min()
    return bool(gap < _TOLERANCE * (ends[0][1] - ends[0][0]).norm())


def _is_convex(edges: Wedges) -> bool:
    """Whether all edges lie on the inner side of each."""
    middles = (edges.start + edges.end) / 2
    depth = (edges.face_tangents[:, :1] * (middles[None] - middles[:, None])).sum(2)
    return bool((depth > -_TOLERANCE * depth.abs().max()).all())


def _merge_collinear_edges(edges: Wedges) -> Wedges:
    """Edges of a convex plate with those of one line joined."""
    inward, left, sides = edges.face_tangents[:, 0], list(range(len(edges.start))), []
    while left:
        own = [e for e in left if bool((inward[e] - inward[left[0]]).norm() < _TOLERANCE)]
        left = [e for e in left if e not in own]
        points = torch.cat([edges.start[own], edges.end[own]])
        along = points @ (edges.end[own[0]] - edges.start[own[0]])
        first = edges.rows(torch.tensor(own[:1]))
        ends = {"start": points[along.argmin()][None], "end": points[along.argmax()][None]}
        sides.append(vars(first) | ends)
    return Wedges(**{name: torch.cat([side[name] for side in sides]) for name in sides[0]})


def _diffract_sequence(
    wedges: Wedges,
    sequence: list[int],
    k: float,
    incident: Tensor,
    field: Tensor,
    scattering_direction: Tensor,
    is_visible: VisibilityTest,
) -> Tensor:
    """F of the waves that a sequence of edges diffracts."""
    above = wedges.normals[sequence[0], 0]
    ways, amplitude = _trace_along_plate(wedges, sequence, k, incident, field, above)
    start, side = wedges.start[sequence[-1]], wedges.end[sequence[-1]] - wedges.start[sequence[-1]]
    # Where rays left the edges before is linear along the last edge: its lit part is an interval.
    ends = [_trace_back(wedges, sequence, ways, start + t * side) for t in (0.0, 1.0)]
    low, high = torch.zeros_like(ends[0].path_length), torch.ones_like(ends[0].path_length)
    for first, last, least, most in zip(
        (*ends[0].edge_fractions.T, *ends[0].segment_lengths.T),
        (*ends[1].edge_fractions.T, *ends[1].segment_lengths.T),
        [0.0] * len(ways) + [_TOLERANCE * float(side.detach().norm())] * len(ways),
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
    row = torch.nonzero(high - low > _TOLERANCE)[:, 0].repeat_interleave(_SAMPLES_PER_EDGE)
    size = (high - low)[row] / _SAMPLES_PER_EDGE
    begin = low[row] + size * (torch.arange(len(row)) % _SAMPLES_PER_EDGE)
    point = start + (begin + size / 2)[:, None] * side
    # The mean of 1/√length over each piece, also where two edges meet.
    roots = [
        torch.lerp(ends[0].segment_lengths[row], ends[1].segment_lengths[row], t[:, None])
        .clamp_min(0)
        .sqrt()
        for t in (begin, begin + size)
    ]
    spread = (2 / (roots[0] + roots[1]).clamp_min(1e-12)).prod(1)
    ray = _trace_back(wedges, sequence, [way[row] for way in ways], point)
    d, s, wave = incident[row], scattering_direction[row], ways[-1][row]
    inward = wedges.face_tangents[sequence[-1], 0]
    along = cross(inward, above).expand_as(s)
    magnetic = dot(cross(wave, above.expand_as(wave)), along)
    azimuth = torch.atan2(dot(s, above), dot(s, inward)) % (2 * math.pi)
    sines = [(1 - dot(along, v) ** 2).clamp_min(1e-12).sqrt() for v in (wave, s)]
    valid = dot(s, above).abs() > math.sin(MIN_EDGE_ANGLE)
    for sine in sines:
        valid &= sine > math.sin(MIN_EDGE_ANGLE)
    strength = magnetic / (2 * math.pi * sines[0] * sines[1] * torch.cos(azimuth / 2))
    strength = torch.where(valid & is_visible(ray.origin, -d), strength * spread, 0.0)
    piece = side * size[:, None]
    width = parallelogram_integral(k * (s - wave), piece, torch.zeros_like(piece))
    turn = k * (dot(s, point) - dot(d, ray.origin) - ray.path_length)
    scale = torch.polar(strength * width * piece.norm(dim=1), turn)
    sent = scale[:, None, None] * amplitude[row][..., None] * cross(s, along)[:, None]
    return torch.zeros(len(incident), 2, 3, dtype=torch.complex128).index_add(0, row, sent)


def _trace_along_plate(
    wedges: Wedges,
    sequence: list[int],
    k: float,
    incident: Tensor,
    field: Tensor,
    plate_normal: Tensor,
) -> tuple[list[Tensor], Tensor]:
    """Ways along the plate after each edge but the last; E after them without its spreading."""
    ways: list[Tensor] = []
    wave, electric = incident, field
    amplitude = torch.ones(len(incident), 2, dtype=torch.complex128)
    for edge in sequence[:-1]:
        inward = wedges.face_tangents[edge, 0]
        along = cross(inward, plate_normal).expand_as(wave)
        cosine = dot(wave, along)
        sine = (1 - cosine**2).clamp_min(1e-12).sqrt()
        magnetic = dot(cross(wave[:, None], electric), along[:, None])
        valid = sine > math.sin(MIN_EDGE_ANGLE)
        azimuth = torch.zeros_like(cosine)
        if not ways:
            azimuth = torch.atan2(-dot(wave, plate_normal), -dot(wave, inward)) % (2 * math.pi)
            valid &= dot(wave, plate_normal).abs() > math.sin(MIN_EDGE_ANGLE)
        # The hard half plane at φ = 0: both of its terms are 1/cos(φ′/2).
        hard = -((2 * math.pi * k) ** -0.5) / (sine * torch.cos(azimuth / 2)) * valid
        wave = cosine[:, None] * along + sine[:, None] * inward
        ways.append(wave)
        electric = plate_normal.expand(len(wave), 1, 3)
        turned = dot(cross(wave, plate_normal.expand_as(wave)), along)
        phase = complex(math.cos(math.pi / 4), -math.sin(math.pi / 4))
        amplitude = amplitude * magnetic * (hard / turned)[:, None] * phase
    return ways, amplitude


class _PlateRays(NamedTuple):
    """Rays along a plate, followed back from the last edge.

    Attributes:
        origin: on the first edge [m].
        path_length: length along the plate [m].
        edge_fractions: where rays left each edge, 0 at its start and 1 at its end.
        segment_lengths: between the edges [m].
    """

    origin: Tensor
    path_length: Tensor
    edge_fractions: Tensor
    segment_lengths: Tensor


def _trace_back(
    wedges: Wedges, sequence: list[int], directions: list[Tensor], point: Tensor
) -> _PlateRays:
    places, lengths = [], []
    at = point.expand_as(directions[0])
    for edge, way in zip(sequence[-2::-1], directions[::-1], strict=True):
        origin, inward = wedges.start[edge], wedges.face_tangents[edge, 0].expand_as(at)
        sideways = wedges.end[edge] - origin
        length = dot(at - origin, inward) / dot(way, inward)
        at = at - length[:, None] * way
        places.append(dot(at - origin, sideways.expand_as(at)) / dot(sideways, sideways))
        lengths.append(length)
    between = torch.stack(lengths, 1)
    return _PlateRays(at, between.sum(1), torch.stack(places, 1), between)
