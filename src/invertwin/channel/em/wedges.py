"""Wedges (sharp edges) and their fringe currents, the physical theory of diffraction (PTD).

The fringe currents of Michaeli and Mitzner are the difference between an infinite wedge's field and
that of physical optics, as electric and magnetic currents along the edge: integrals of the currents
on strips of the faces across the edge. Each face of a wedge has its own frame: x̂ into the face, n̂
outwards, t̂ = x̂ × n̂.

Source: derivations §14; Michaeli, "Equivalent edge currents for arbitrary aspects of observation",
IEEE TAP 32, 1984; Mitzner, AFAL-TR-73-296, 1974; Johansen, "Uniform physical theory of diffraction
equivalent edge currents for truncated wedge strips", IEEE TAP 44, 1996.

Differs from the source: truncation multiplies the coefficients of endless strips by the share that
a half plane's strip of that length has, which is exact for N = 2 and removes the pole of any wedge.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot, phasor
from invertwin.channel.em.transition_functions import EXP_J_PI_4, transition
from invertwin.channel.rows import Rows, bound_groups, concatenate_rows, strip_rows
from invertwin.checks import strip_derivatives
from invertwin.scene.mesh_topology import label_components

MIN_EDGE_ANGLE = math.radians(10.0)
"""Smallest angle to a sheet's plane and to the edge at which fringe currents are valid [rad]."""
_MERGE_TOLERANCE = 1e-6  # rad, and fraction of the scene's size: equal lines and planes
_GENERIC_DIRECTION = torch.tensor([0.8123, 0.4571, 0.3623], dtype=torch.float64)
_SWAPPED_FACES = torch.tensor([1, 0])
_MIN_CREASE_ANGLE = 0.35  # rad between adjacent normals; less is a curved surface
# Corners of a detour round an edge, as shares of its exterior.
_DETOUR_ANGLES = (0.1, 0.26, 0.42, 0.58, 0.74, 0.9)
_POLE_WIDTH = 1e-5
_MIN_PHASE = math.pi  # along a strip: over narrower faces currents go on round the next edge
_TRANSITION_AT_ZERO = math.sqrt(math.pi) * EXP_J_PI_4
_SHEET_TOLERANCE = 1e-6  # of an opening, over π
_VERTEX_TOLERANCE = 1e-9  # of the body's size: edge ends closer than this coincide
# Largest cosine between the outward directions of two edges that continue each other.
_MAX_COLLINEAR_COSINE = -math.cos(math.radians(30.0))
_OPENING_TOLERANCE = 0.2  # of openings along one line, over π


@dataclass(frozen=True)
class Wedges(Rows):
    """Edges between two faces, one row each.

    Attributes:
        start, end: end points of the edge [m].
        face_tangents: unit vectors from the edge into either face, orthogonal to the edge.
        normals: outward normals of the faces; opposite for the two sides of a sheet.
        opening: exterior angle over π: N = 2 for a half plane, 1.5 for a cube.
        faces: adjacent triangles; for the open edge of a sheet, the same one twice.
    """

    start: Float64[Tensor, "row 3"]
    end: Float64[Tensor, "row 3"]
    face_tangents: Float64[Tensor, "row 2 3"]
    normals: Float64[Tensor, "row 2 3"]
    opening: Float64[Tensor, " row"]
    faces: Int64[Tensor, "row 2"]


def find_wedges(
    corners: Float64[Tensor, "facet 3 3"],
    endpoints: Float64[Tensor, "edge 2 3"],
    edge_faces: Int64[Tensor, "edge k"],
) -> Wedges:
    """Find the sharp edges of a mesh: open edges and creases of more than 20°.

    Where several triangles meet, the exterior is the widest region between two of them; doubled
    triangles count as one. Smooth tessellation and concave creases (exterior angles below π,
    covered by physical optics with multiple bounces) are left out.

    Args:
        corners: corners of the triangles [m].
        endpoints: end points of the edges [m].
        edge_faces: triangles at each edge (−1: none).
    """
    found: list[Wedges] = []
    number = (edge_faces >= 0).sum(1)
    for count in range(1, edge_faces.shape[1] + 1):
        edge = torch.nonzero(number == count)[:, 0]
        faces = edge_faces[edge].sort(1, descending=True).values[:, :count]
        axis = normalize(endpoints[edge, 1] - endpoints[edge, 0], dim=1)
        t = corners[faces].mean(2) - endpoints[edge, :1]
        t = normalize(t - dot(t, axis[:, None])[..., None] * axis[:, None], dim=2)
        normal = cross(axis[:, None], t)
        # Triangles without area have no face tangent.
        valid = (normal.detach().norm(dim=2) > 0.5).all(1)
        edge, faces, t, normal = edge[valid], faces[valid], t[valid], normal[valid]
        # Angles of the faces about the edge; the widest region between two of them is the exterior.
        angle = torch.atan2(dot(normal[:, :1], t), dot(t[:, :1], t)) % (2 * math.pi)
        order = angle.detach().argsort(1)
        angle = angle.gather(1, order)
        gap = torch.cat([angle, angle[:, :1] + 2 * math.pi], 1).diff(dim=1)
        widest = gap.detach().argmax(1, keepdim=True)
        gap = gap.gather(1, widest)[:, 0]
        pair = order.gather(1, torch.cat([widest, (widest + 1) % count], 1))
        t, normal, faces = (x[torch.arange(len(x))[:, None], pair] for x in (t, normal, faces))
        normal = torch.stack([normal[:, 0], -normal[:, 1]], 1)
        start, end = endpoints[edge].unbind(1)
        wedges = Wedges(start, end, t, normal, gap / math.pi, faces)
        found.append(wedges.select(gap.detach() > math.pi + _MIN_CREASE_ANGLE))
    return concatenate_rows(found)


def has_open_exterior(
    wedges: Wedges,
    points: Float64[Tensor, "row 3"],
    offset: float,
    is_clear: Callable[[Tensor, Tensor], Bool[Tensor, " row"]],
) -> Bool[Tensor, " row"]:
    """Test if no surface fills part of the exterior of edges, by a detour round points on them.

    Plates that meet in a seam, a box on the floor, and partitions in a body have edges that do not
    diffract.

    Args:
        wedges: sharp edges, one row each.
        points: points on the edges [m].
        offset: distance of the detour from the edge [m].
        is_clear: test of straight lines between pairs of points.
    """
    with _DisableFuncTorch():  # discrete
        wedges, points = strip_rows(wedges), strip_derivatives(points)
        angle = wedges.opening[:, None] * wedges.opening.new_tensor(_DETOUR_ANGLES) * math.pi
        stops = [
            points + offset * (c * wedges.face_tangents[:, 0] + s * wedges.normals[:, 0])
            for c, s in zip(angle.cos().T[..., None], angle.sin().T[..., None], strict=True)
        ]
        return torch.stack([is_clear(*pair) for pair in pairwise(stops)]).all(0)


def select_body_edges(wedges: Wedges, min_length: float) -> Bool[Tensor, " row"]:
    """Mask of edges of the body, as opposed to facet edges at the tip of a smooth one.

    Edges of similar opening that continue each other form lines. Near a tip, the few facets of a
    smooth surface meet at sharp angles, but farther out, with more facets around, they do not: such
    lines are short and end within a smooth surface. Lines of the body end at other lines, or are
    long.

    Args:
        wedges: sharp edges.
        min_length: smallest extent of a long line [m].
    """
    count = len(wedges.start)
    ends = torch.cat([wedges.start, wedges.end]).detach()
    if not count:
        return torch.zeros(0, dtype=torch.bool)
    size = float((ends.amax(0) - ends.amin(0)).norm())
    _, node = torch.unique((ends / (_VERTEX_TOLERANCE * size)).round(), dim=0, return_inverse=True)
    outward = normalize(ends[:count] - ends[count:], dim=1)
    outward = torch.cat([-outward, outward])
    opening = wedges.opening.detach().repeat(2)
    order, number = torch.argsort(node), torch.bincount(node)
    pairs: list[Tensor] = [torch.zeros(2, 0, dtype=torch.int64)]
    for step in range(1, int(number.max())):
        own, other = order[:-step], order[step:]
        continued = dot(outward[own], outward[other]) < _MAX_COLLINEAR_COSINE
        continued &= node[own] == node[other]
        continued &= (opening[own] - opening[other]).abs() < _OPENING_TOLERANCE
        pairs.append(torch.stack([own[continued], other[continued]]) % count)
    line = torch.from_numpy(label_components(torch.cat(pairs, 1).T.numpy(), count))
    lines = int(line.max()) + 1
    low, high = bound_groups(line.repeat(2), ends, lines)
    short = (high - low).norm(dim=1) < min_length
    kept, previous = torch.ones(lines, dtype=torch.bool), -1
    # Removing a line may leave the next one with a loose end.
    while previous != int(kept.sum()):
        previous = int(kept.sum())
        there = kept[line.repeat(2)]
        loose = there & (torch.bincount(node[there], minlength=len(number))[node] == 1)
        kept[line.repeat(2)[loose]] &= ~short[line.repeat(2)[loose]]
    return kept[line]


def edge_axis(wedges: Wedges) -> Float64[Tensor, "row 3"]:
    """Unit vectors along the edges, the axes of azimuths measured from the first face."""
    return cross(wedges.face_tangents[:, 0], wedges.normals[:, 0])


def merge_collinear_wedges(wedges: Wedges) -> Wedges:
    """Merge edges that continue in a straight line between the same two planes.

    Args:
        wedges: sharp edges, one row each.
    """
    if not len(wedges.start):
        return wedges
    # Discrete: `torch.func` would claim the intermediate tensors.
    with _DisableFuncTorch():
        order, reversed_edge, first, last = _group_collinear(wedges)
    rows = torch.arange(len(order))[:, None]
    start = torch.where(reversed_edge, wedges.end, wedges.start)
    end = torch.where(reversed_edge, wedges.start, wedges.end)
    frames = wedges.face_tangents, wedges.normals
    tangents, normals = (column[rows, order][first] for column in frames)
    faces = wedges.faces[rows, order][first]
    return Wedges(start[first], end[last], tangents, normals, wedges.opening[first], faces)


def _group_collinear(wedges: Wedges) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Face order of each edge, a mask of reversed edges, and first and last edge of each line."""
    names = ("start", "end", "face_tangents", "normals")
    start, end, tangents, normals = (strip_derivatives(getattr(wedges, name)) for name in names)
    # Normalise the order of the faces: the first has the larger projection on a fixed direction.
    lean = (tangents + normals * math.sqrt(3)) @ _GENERIC_DIRECTION
    order = torch.where((lean[:, :1] < lean[:, 1:]), _SWAPPED_FACES, _SWAPPED_FACES.flip(0))
    rows = torch.arange(len(order))[:, None]
    tangents, normals = tangents[rows, order], normals[rows, order]
    axis = cross(tangents[:, 0], normals[:, 0])
    reversed_edge = (dot(axis, end - start) < 0)[:, None]
    start, end = torch.where(reversed_edge, end, start), torch.where(reversed_edge, start, end)
    low, high = dot(axis, start), dot(axis, end)
    size = float(torch.maximum(low.abs(), high.abs()).amax()) + float((high - low).amax())
    offset = (start - low[:, None] * axis) / size
    key = torch.cat([offset, tangents.flatten(1), normals.flatten(1)], 1)
    # Adding zero makes negative zeros positive.
    rounded = (key / _MERGE_TOLERANCE).round().numpy() + 0.0
    line = np.unique(rounded, axis=0, return_inverse=True)[1].ravel()
    sequence = torch.from_numpy(np.lexsort((low.numpy(), line)))
    line = torch.from_numpy(line)[sequence]
    new = torch.ones(len(line), dtype=torch.bool)
    gap = (low[sequence][1:] - high[sequence][:-1]).abs() > _MERGE_TOLERANCE * size
    new[1:] = (line[1:] != line[:-1]) | gap
    return order, reversed_edge, sequence[new], sequence[new.roll(-1)]


def is_outside_wedge(wedges: Wedges, direction: Float64[Tensor, "row 3"]) -> Tensor:
    """Mask of directions in the wedge's exterior, at least ``MIN_EDGE_ANGLE`` off its edge.

    Args:
        wedges: sharp edges, one row each.
        direction: unit vectors from the edge, [row, 3].
    """
    angle = azimuth(wedges, direction, 0)
    along = normalize(wedges.end - wedges.start, dim=1)
    is_across = dot(along, direction).abs() < math.cos(MIN_EDGE_ANGLE)
    return (angle <= wedges.opening * math.pi) & is_across


def is_grazing_sheet(wedges: Wedges, direction: Float64[Tensor, "row 3"]) -> Tensor:
    """Mask of directions within ``MIN_EDGE_ANGLE`` of the plane of a sheet with this edge.

    Args:
        wedges: sharp edges, one row each.
        direction: unit vectors from the edge, [row, 3].
    """
    flat = wedges.opening > 2 - _SHEET_TOLERANCE
    return flat & (dot(wedges.normals[:, 0], direction).abs() < math.sin(MIN_EDGE_ANGLE))


def azimuth(wedges: Wedges, direction: Tensor, face: int) -> Tensor:
    """Azimuth about the edge, measured from a face through its normal, in [0, 2π) [rad].

    Args:
        wedges: sharp edges, one row each.
        direction: vectors from the edge, [row, 3], of any length.
        face: number of the face, 0 or 1.
    """
    return torch.atan2(
        dot(wedges.normals[:, face], direction), dot(wedges.face_tangents[:, face], direction)
    ) % (2 * math.pi)


def exterior_azimuth(wedges: Wedges, direction: Tensor, face: int) -> Tensor:
    """Azimuth of a direction in the exterior, measured from a face, in [0, opening · π] [rad].

    Directions that graze a face are clamped to it, not counted as inside.

    Args:
        wedges: sharp edges, one row each.
        direction: unit vectors from the edge, [row, 3].
        face: number of the face from which azimuths are measured, 0 or 1.
    """
    angle, last = azimuth(wedges, direction, face), wedges.opening * math.pi
    clamped = torch.where(angle > last / 2 + math.pi, 0.0 * angle, last)
    return torch.where(angle > last, clamped, angle)


def fringe_field(
    wedges: Wedges,
    wave_number: float,
    direction: Float64[Tensor, "row 3"],
    field: Float64[Tensor, "row 2 3"],
    scattered_direction: Float64[Tensor, "row 3"],
    strip_widths: Float64[Tensor, "row 2"],
) -> Tensor:
    """Far field F of the fringe currents per metre of edge, for both incident polarisations.

    ``(jk/4π) Σ_faces [ηI s×(s×t̂) + M s×t̂]``; the phases of incident and scattered wave are left
    out, as in ``radiate_field``.

    Args:
        wedges: illuminated edges.
        wave_number: wave number k [1/m].
        direction: direction d of the incident wave.
        field: incident field E [V/m].
        scattered_direction: unit vector s towards the receiver.
        strip_widths: widths of both faces across the edge [m]. Strips of sheets count as endless,
            since their multiple diffraction is computed by itself.
    """
    total = torch.zeros(len(direction), 2, 3, dtype=torch.complex128)
    k = wave_number
    for face in (0, 1):
        axis = cross(wedges.face_tangents[:, face], wedges.normals[:, face])
        cos_in, cos_out = dot(axis, direction), dot(axis, scattered_direction)
        sin_in, sin_out = (1 - cos_in**2).sqrt(), (1 - cos_out**2).sqrt()
        phi_in = exterior_azimuth(wedges, -direction, face)
        phi_out = exterior_azimuth(wedges, scattered_direction, face)
        mu = sin_out * torch.cos(phi_out) / sin_in
        phase = k * strip_widths[:, face] * sin_in
        electric, magnetic = _fringe_coefficients(wedges.opening, phi_in, mu, phase)
        across = cross(scattered_direction, axis)
        e = dot(axis[:, None], field)
        h = dot(axis[:, None], cross(direction[:, None], field))
        skew = mu * cos_in / sin_in - cos_out / sin_out * torch.cos(phi_out)
        current = (2j / (k * sin_in**2) * electric)[:, None] * e
        current = current + (2j / (k * sin_in) * magnetic * skew)[:, None] * h
        charge = (-2j / k * magnetic * torch.sin(phi_out) / (sin_in * sin_out))[:, None] * h
        total = total + current[..., None] * cross(scattered_direction, across)[:, None]
        total = total + charge[..., None] * across[:, None]
    return 1j * k / (4 * math.pi) * total


def _fringe_coefficients(
    opening: Tensor, azimuth: Tensor, mu: Tensor, phase: Tensor
) -> tuple[Tensor, Tensor]:
    """Fringe coefficients A and B of one face: those of the wedge less those of physical optics.

    Both have the same pole at cosφ′ + μ = 0, the direction of specular reflection. Their difference
    is smooth there, so that evaluation a small step beside the pole is accurate enough. Where the
    incident and the scattered wave run along the face, the difference has a pole of its own, which
    the end of the strip limits.
    """
    mu = torch.where((1 - mu).abs() < _POLE_WIDTH**2, 1 - _POLE_WIDTH**2, mu)
    step = 2 * _POLE_WIDTH / torch.sin(azimuth).abs().clamp_min(0.1)
    azimuth = torch.where((torch.cos(azimuth) + mu).abs() < _POLE_WIDTH, azimuth + step, azimuth)
    # arccos μ, complex for |μ| > 1 (beyond Keller's cone).
    rest = math.pi - torch.arccos(mu.to(torch.complex128))
    rest = torch.where(rest.abs() < 1e-7, torch.full_like(rest, 1e-7), rest)
    delta = torch.cos(azimuth / opening) - torch.cos(rest / opening)
    optics = (azimuth < math.pi).double() / (torch.cos(azimuth) + mu)
    electric = torch.sin(azimuth / opening) / (opening * delta) - optics * torch.sin(azimuth)
    magnetic = torch.sin(rest / opening) / (opening * torch.sin(rest) * delta) - optics
    shares = _strip_shares(math.sqrt(2) * torch.cos(azimuth / 2).abs(), 1 - mu, phase)
    shares = torch.where(opening < 2 - _SHEET_TOLERANCE, shares, torch.ones_like(shares))
    return electric * shares[0], magnetic * shares[1]


def _strip_shares(a: Tensor, square: Tensor, phase: Tensor) -> Complex128[Tensor, "2 row"]:
    """Shares of the integrals of E- and H-polarised currents from the edge to the strip's end.

    The fringe currents of a half plane are Fresnel integrals, and so are their integrals with the
    phase of the scattered wave. With g the transition function and Λ the phase along the strip, the
    shares of A and B are 1 + exp(−jb²Λ)/g(0) · (b g(b√Λ) − a g(a√Λ))/(a − b) and the same with
    b g(a√Λ) − a g(b√Λ).

    Args:
        a: √2 |cos φ′/2|, zero where the incident wave runs along the face from its edge.
        square: b² = 1 − μ, zero where the scattered wave runs along it; negative beyond.
        phase: Λ = k ℓ sinβ′ of strips of width ℓ [rad].
    """
    phase = phase.clamp_min(_MIN_PHASE)
    root, size = phase.sqrt(), square.abs().sqrt()
    end_a, end_b = (transition(x * root) / _TRANSITION_AT_ZERO for x in (a, size))
    # g of an imaginary argument −jy over g(0) is the conjugate of that of y.
    beyond = square < 0
    end_b = torch.where(beyond, end_b.conj(), end_b)
    b = torch.where(beyond, -1j * size, size.to(torch.complex128))
    ends = torch.stack([b * end_b - a * end_a, b * end_a - a * end_b])
    return 1 + phasor(-square * phase) * ends / (a - b)
