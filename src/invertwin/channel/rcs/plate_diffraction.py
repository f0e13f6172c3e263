"""Multiple diffraction between the edges of flat plates.

An edge diffracts a wave along the plate, strongest for H along the edge. At another edge it is
diffracted again. Both sides of the plate carry it with opposite sign, so that the factor of one
half for grazing incidence is compensated.

Source: derivations §14; Ross, "Radar cross section of rectangular flat plates as a function of
aspect angle", IEEE TAP 14, 1966.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot, parallelogram_integral
from invertwin.channel.em.wedges import MIN_EDGE_ANGLE, Wedges, merge_collinear_wedges
from invertwin.scene.mesh_topology import label_components

_SAMPLES_PER_EDGE = 16  # of the illuminated part of the last edge
_TOLERANCE = 1e-6

VisibilityTest = Callable[[Tensor, Tensor], Tensor]
"""Function of points and unit directions; returns a mask of unobstructed rays."""


def trace_multiple_diffractions(
    plates: Sequence[Wedges],
    wave_number: float,
    incident: Float64[Tensor, "row 3"],
    field: Float64[Tensor, "row 2 3"],
    scattering_direction: Float64[Tensor, "row 3"],
    max_diffractions: int,
    is_visible: VisibilityTest,
) -> Iterator[Tensor]:
    """Compute the far fields F of two diffractions, of three, and so on; [row, 2, 3] each.

    A wave propagates from side to side of one plate, except between sides that share a corner: edge
    diffraction does not apply there, and corner diffraction is not modelled.

    Args:
        plates: sides of each plate, from ``find_plates``.
        wave_number: wave number k [1/m].
        incident: direction d of each wave.
        field: incident field E [V/m].
        scattering_direction: unit vectors s towards the receiver.
        max_diffractions: maximum number of diffractions.
        is_visible: visibility test of edge points from the source.
    """
    apart = [~_share_corner(sides) for sides in plates]
    chains = [(plate, [side]) for plate, own in enumerate(apart) for side in range(len(own))]
    for _ in range(2, max_diffractions + 1):
        chains = [
            (plate, [*chain, side])
            for plate, chain in chains
            for side in torch.nonzero(apart[plate][:, chain[-1]])[:, 0].tolist()
        ]
        total = torch.zeros(len(incident), 2, 3, dtype=torch.complex128)
        for plate, chain in chains:
            total = total + _diffract_sequence(
                plates[plate], chain, wave_number, incident, field, scattering_direction, is_visible
            )
        yield total


def find_plates(wedges: Wedges) -> list[Wedges]:
    """Find the sides of flat convex plates among open edges.

    Args:
        wedges: sharp edges; those of solid bodies and creases are left out.
    """
    sides = wedges.select(wedges.opening > 2 - _TOLERANCE)
    turn = cross(sides.normals[:, None, 0], sides.normals[:, 0]).norm(dim=2)
    pairs = torch.nonzero(_share_corner(sides) & (turn < _TOLERANCE))
    plate = torch.from_numpy(label_components(pairs.numpy(), len(sides.start)))
    plates = [sides.select(plate == number) for number in plate.unique()]
    return [merge_collinear_wedges(edges) for edges in plates if _is_convex(edges)]


def _share_corner(wedges: Wedges) -> Bool[Tensor, "edge edge"]:
    """Mask of pairs of edges with a common corner, or of one edge."""
    ends = torch.stack([wedges.start, wedges.end], 1).detach()
    gap = (ends[:, None, :, None] - ends[:, None]).norm(dim=-1).amin((2, 3))
    return gap < _TOLERANCE * (ends[:, 1] - ends[:, 0]).norm(dim=1, keepdim=True)


def _is_convex(edges: Wedges) -> bool:
    """Test if all edges lie on the inner side of each."""
    middles = (edges.start + edges.end) / 2
    depth = (edges.face_tangents[:, :1] * (middles[None] - middles[:, None])).sum(2)
    return bool((depth > -_TOLERANCE * depth.abs().max()).all())


def _diffract_sequence(
    wedges: Wedges,
    sequence: list[int],
    k: float,
    incident: Tensor,
    field: Tensor,
    scattering_direction: Tensor,
    is_visible: VisibilityTest,
) -> Tensor:
    """Far field F of waves diffracted by a sequence of edges."""
    plate_normal = wedges.normals[sequence[0], 0]
    directions, amplitude = _trace_along_plate(wedges, sequence, k, incident, field, plate_normal)
    start, side = wedges.start[sequence[-1]], wedges.end[sequence[-1]] - wedges.start[sequence[-1]]
    # Departure points on previous edges are linear along the last one: its illuminated part is an
    # interval.
    ends = [_trace_back(wedges, sequence, directions, start + t * side) for t in (0.0, 1.0)]
    shortest = _TOLERANCE * float(side.detach().norm())
    first, last = (
        torch.cat([e.edge_fractions, 1 - e.edge_fractions, e.segment_lengths - shortest], 1)
        for e in ends
    )
    slope = last - first
    crossing = -first / torch.where(slope.abs() > 1e-12, slope, 1.0)
    low = torch.where(slope > 1e-12, crossing, 0.0).amax(1).clamp_min(0)
    high = torch.where(slope < -1e-12, crossing, 1.0).amin(1).clamp_max(1)
    high = torch.where(((slope.abs() <= 1e-12) & (first <= 0)).any(1), -1.0, high)
    row = torch.nonzero(high - low > _TOLERANCE)[:, 0].repeat_interleave(_SAMPLES_PER_EDGE)
    size = (high - low)[row] / _SAMPLES_PER_EDGE
    begin = low[row] + size * (torch.arange(len(row)) % _SAMPLES_PER_EDGE)
    point = start + (begin + size / 2)[:, None] * side
    # Mean of 1/√length over each piece, finite also where two edges meet.
    lengths, others = (end.segment_lengths[row] for end in ends)
    mixed = [torch.lerp(lengths, others, t[:, None]) for t in (begin, begin + size)]
    roots = [length.clamp_min(0).sqrt() for length in mixed]
    spread = (2 / (roots[0] + roots[1]).clamp_min(1e-12)).prod(1)
    ray = _trace_back(wedges, sequence, [way[row] for way in directions], point)
    d, s, wave = incident[row], scattering_direction[row], directions[-1][row]
    inward = wedges.face_tangents[sequence[-1], 0]
    axis = cross(inward, plate_normal).expand_as(s)
    magnetic = dot(cross(wave, plate_normal.expand_as(wave)), axis)
    azimuth = torch.atan2(dot(s, plate_normal), dot(s, inward)) % (2 * math.pi)
    sines = [(1 - dot(axis, v) ** 2).clamp_min(1e-12).sqrt() for v in (wave, s)]
    valid = dot(s, plate_normal).abs() > math.sin(MIN_EDGE_ANGLE)
    for sine in sines:
        valid &= sine > math.sin(MIN_EDGE_ANGLE)
    strength = magnetic / (2 * math.pi * sines[0] * sines[1] * torch.cos(azimuth / 2))
    strength = torch.where(valid & is_visible(ray.origin, -d), strength * spread, 0.0)
    piece = side * size[:, None]
    width = parallelogram_integral(k * (s - wave), piece, torch.zeros_like(piece))
    phase = k * (dot(s, point) - dot(d, ray.origin) - ray.path_length)
    scale = torch.polar(strength * width * piece.norm(dim=1), phase)
    radiated = scale[:, None, None] * amplitude[row][..., None] * cross(s, axis)[:, None]
    return torch.zeros(len(incident), 2, 3, dtype=torch.complex128).index_add(0, row, radiated)


def _trace_along_plate(
    wedges: Wedges, sequence: list[int], k: float, incident: Tensor, field: Tensor, normal: Tensor
) -> tuple[list[Tensor], Tensor]:
    """Directions along the plate after each edge but the last, and field amplitudes there."""
    directions: list[Tensor] = []
    wave, electric = incident, field
    amplitude = torch.ones(len(incident), 2, dtype=torch.complex128)
    for edge in sequence[:-1]:
        inward = wedges.face_tangents[edge, 0]
        axis = cross(inward, normal).expand_as(wave)
        cosine = dot(wave, axis)
        sine = (1 - cosine**2).clamp_min(1e-12).sqrt()
        magnetic = dot(cross(wave[:, None], electric), axis[:, None])
        valid = sine > math.sin(MIN_EDGE_ANGLE)
        azimuth = torch.zeros_like(cosine)
        if not directions:
            azimuth = torch.atan2(-dot(wave, normal), -dot(wave, inward)) % (2 * math.pi)
            valid &= dot(wave, normal).abs() > math.sin(MIN_EDGE_ANGLE)
        # Hard half plane at φ = 0: both of its terms are 1/cos(φ′/2).
        hard = -((2 * math.pi * k) ** -0.5) / (sine * torch.cos(azimuth / 2)) * valid
        wave = cosine[:, None] * axis + sine[:, None] * inward
        directions.append(wave)
        electric = normal.expand(len(wave), 1, 3)
        normalisation = dot(cross(wave, normal.expand_as(wave)), axis)
        phase = complex(math.cos(math.pi / 4), -math.sin(math.pi / 4))
        amplitude = amplitude * magnetic * (hard / normalisation)[:, None] * phase
    return directions, amplitude


class _PlateRays(NamedTuple):
    """Rays along a plate, traced back from the last edge.

    Attributes:
        origin: points on the first edge [m].
        path_length: lengths along the plate [m].
        edge_fractions: departure points on each edge, from 0 at its start to 1 at its end.
        segment_lengths: lengths between the edges [m].
    """

    origin: Tensor
    path_length: Tensor
    edge_fractions: Tensor
    segment_lengths: Tensor


def _trace_back(
    wedges: Wedges, sequence: list[int], directions: list[Tensor], point: Tensor
) -> _PlateRays:
    fractions, lengths = [], []
    at = point.expand_as(directions[0])
    for edge, direction in zip(sequence[-2::-1], directions[::-1], strict=True):
        origin, inward = wedges.start[edge], wedges.face_tangents[edge, 0].expand_as(at)
        sideways = wedges.end[edge] - origin
        length = dot(at - origin, inward) / dot(direction, inward)
        at = at - length[:, None] * direction
        fractions.append(dot(at - origin, sideways.expand_as(at)) / dot(sideways, sideways))
        lengths.append(length)
    between = torch.stack(lengths, 1)
    return _PlateRays(at, between.sum(1), torch.stack(fractions, 1), between)
