"""Sharp edges: fringe currents, what physical optics leaves out along a wedge.

The fringe currents of Michaeli and Mitzner are the difference of an infinite wedge's field and
that of physical optics, as electric and magnetic currents along the edge. Each half of a wedge has
its own frame: x̂ into the face, n̂ outwards, t̂ = x̂ × n̂.

Source: derivations §14; Michaeli, "Elimination of infinities in equivalent edge currents", IEEE TAP
34, 1986; Mitzner, AFAL-TR-73-296, 1974.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot
from invertwin.checks import strip_derivatives

MIN_EDGE_ANGLE = math.radians(10.0)
"""Nearer to grazing, or to the edge itself, fringe currents are not valid."""
_MERGE_TOLERANCE = (
    1e-6  # radians, and share of the scene's size: lines and planes that count as one
)
_GENERIC_DIRECTION = torch.tensor([0.8123, 0.4571, 0.3623], dtype=torch.float64)
_SWAPPED_FACES = torch.tensor([1, 0])
_MIN_CREASE_ANGLE = (
    0.35  # rad that the normals of neighbours turn at an edge; less is a curved surface
)
_POLE_WIDTH = 1e-5
_VERTEX_TOLERANCE = 1e-9  # of the body's size: ends of edges this near are one
_MAX_COLLINEAR_COSINE = -math.cos(math.radians(30.0))  # cosine of two ends that run on
_OPENING_TOLERANCE = 0.2  # of openings along a line, over π


@dataclass(frozen=True)
class Wedges:
    """Edges of conductors between two faces, one row each.

    Attributes:
        start, end: of the edge [m].
        face_tangents: unit vectors from the edge into either face, across the edge.
        normals: outward normals of the faces; opposite for the two sides of a sheet.
        opening: exterior angle over π: N = 2 of a half plane, 1.5 of a cube.
        faces: triangles beside the edge; of an edge that ends a sheet, the same one twice.
    """

    start: Float64[Tensor, "row 3"]
    end: Float64[Tensor, "row 3"]
    face_tangents: Float64[Tensor, "row 2 3"]
    normals: Float64[Tensor, "row 2 3"]
    opening: Float64[Tensor, " row"]
    faces: Int64[Tensor, "row 2"]

    def rows(self, index: Tensor) -> "Wedges":
        """Some rows."""
        return Wedges(*(column[index] for column in vars(self).values()))


def find_wedges(
    corners: Float64[Tensor, "facet 3 3"],
    endpoints: Float64[Tensor, "edge 2 3"],
    edge_faces: Int64[Tensor, "edge k"],
) -> Wedges:
    """The sharp edges of a mesh: open edges, and edges at which normals turn by more than 20°.

    A crease of a sheet is two wedges, one on each side. Smooth tessellation and inner creases
    (exterior angles below π, where every bounce is physical optics already) are left out.

    Args:
        corners: of the triangles [m].
        endpoints: of the edges [m].
        edge_faces: triangles at each edge (−1: none).
    """
    found: list[Wedges] = []
    number = (edge_faces >= 0).sum(1)
    for count in (1, 2):
        edge = torch.nonzero(number == count)[:, 0]
        faces = edge_faces[edge].sort(1, descending=True).values[:, :count]
        along = normalize(endpoints[edge, 1] - endpoints[edge, 0], dim=1)
        inward = corners[faces].mean(2) - endpoints[edge, :1]
        inward = normalize(inward - dot(inward, along[:, None])[..., None] * along[:, None], dim=2)
        normal = cross(along[:, None], inward)
        # Triangles without area have no side to an edge.
        whole = (normal.detach().norm(dim=2) > 0.5).all(1)
        edge, faces, inward, normal = edge[whole], faces[whole], inward[whole], normal[whole]
        if count == 1:
            inwards = inward.expand(-1, 2, 3)
            normals = torch.cat([normal, -normal], 1)
            opening = torch.full((len(edge),), 2.0, dtype=torch.float64)
            found.append(
                Wedges(
                    endpoints[edge, 0],
                    endpoints[edge, 1],
                    inwards,
                    normals,
                    opening,
                    faces.expand(-1, 2),
                )
            )
            continue
        # Angle from the first face to the second about the edge, through the first one's normal.
        turn = torch.atan2(dot(normal[:, 0], inward[:, 1]), dot(inward[:, 0], inward[:, 1]))
        turn = turn % (2 * math.pi)
        for sign in (1.0, -1.0):
            angle = turn if sign > 0 else 2 * math.pi - turn
            keep = angle.detach() > math.pi + _MIN_CREASE_ANGLE
            # Normals that point into this region: along the first turn, against the second.
            normals = torch.stack([sign * normal[:, 0], -sign * normal[:, 1]], 1)
            wedge = Wedges(
                endpoints[edge, 0], endpoints[edge, 1], inward, normals, angle / math.pi, faces
            )
            found.append(wedge.rows(keep))
    columns = zip(*(vars(part).values() for part in found), strict=True)
    return Wedges(*(torch.cat(column) for column in columns))


def select_body_edges(wedges: Wedges, min_length: float) -> Bool[Tensor, " row"]:
    """Which edges are edges of the body, and not of the facets about a tip of a smooth one.

    Edges run on into others of like opening. About a tip, smooth facets turn sharply, but where the
    rings have more of them they do not: such lines are short and end in a smooth surface. Lines of
    the body end at others, or are long.

    Args:
        wedges: sharp edges.
        min_length: extent of a long line [m].
    """
    count = len(wedges.start)
    ends = torch.cat([wedges.start, wedges.end]).detach()
    if not count:
        return torch.zeros(0, dtype=torch.bool)
    size = float((ends.amax(0) - ends.amin(0)).norm())
    _, vertex = torch.unique(
        (ends / (_VERTEX_TOLERANCE * size)).round(), dim=0, return_inverse=True
    )
    away = normalize(ends[:count] - ends[count:], dim=1)
    away = torch.cat([-away, away])
    opening = wedges.opening.detach().repeat(2)
    order, number = torch.argsort(vertex), torch.bincount(vertex)
    pairs: list[Tensor] = [torch.zeros(2, 0, dtype=torch.int64)]
    for step in range(1, int(number.max())):
        own, other = order[:-step], order[step:]
        joined = (vertex[own] == vertex[other]) & (
            dot(away[own], away[other]) < _MAX_COLLINEAR_COSINE
        )
        joined &= (opening[own] - opening[other]).abs() < _OPENING_TOLERANCE
        pairs.append(torch.stack([own[joined], other[joined]]) % count)
    row, column = torch.cat(pairs, 1).numpy()
    graph = coo_array((np.ones(len(row)), (row, column)), shape=(count, count))
    line = torch.from_numpy(connected_components(graph, directed=False)[1]).long()
    lines = int(line.max()) + 1
    index = line.repeat(2)[:, None].expand(-1, 3)
    low, high = (
        torch.zeros(lines, 3, dtype=torch.float64).scatter_reduce(
            0, index, ends, reduce, include_self=False
        )
        for reduce in ("amin", "amax")
    )
    short = (high - low).norm(dim=1) < min_length
    kept, left = torch.ones(lines, dtype=torch.bool), -1
    # Taking one away may leave the next with a loose end.
    while left != int(kept.sum()):
        left = int(kept.sum())
        there = kept[line.repeat(2)]
        loose = there & (torch.bincount(vertex[there], minlength=len(number))[vertex] == 1)
        kept[line.repeat(2)[loose]] &= ~short[line.repeat(2)[loose]]
    return kept[line]


def edge_axis(wedges: Wedges) -> Float64[Tensor, "row 3"]:
    """Unit vectors along the edges, about which azimuths are counted from the first face."""
    return cross(wedges.face_tangents[:, 0], wedges.normals[:, 0])


def merge_collinear_wedges(wedges: Wedges) -> Wedges:
    """Edges that go on in a straight line between the same two planes as one, each along its axis.

    Args:
        wedges: one row each.
    """
    if not len(wedges.start):
        return wedges
    # Discrete: to `torch.func`, tensors made on the way would be its own.
    with _DisableFuncTorch():
        order, against, first, last = _group_collinear(wedges)
    rows = torch.arange(len(order))[:, None]
    start = torch.where(against, wedges.end, wedges.start)
    end = torch.where(against, wedges.start, wedges.end)
    return Wedges(
        start[first],
        end[last],
        wedges.face_tangents[rows, order][first],
        wedges.normals[rows, order][first],
        wedges.opening[first],
        wedges.faces[rows, order][first],
    )


def _group_collinear(wedges: Wedges) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Order of each edge's faces, whether it runs against its axis, first and last of each line."""
    names = ("start", "end", "face_tangents", "normals")
    start, end, inwards, normals = (strip_derivatives(getattr(wedges, name)) for name in names)
    # Both orders of the faces are one edge: the first one leans more to some direction.
    lean = (inwards + normals * math.sqrt(3)) @ _GENERIC_DIRECTION
    order = torch.where((lean[:, :1] < lean[:, 1:]), _SWAPPED_FACES, _SWAPPED_FACES.flip(0))
    rows = torch.arange(len(order))[:, None]
    inwards, normals = inwards[rows, order], normals[rows, order]
    axis = cross(inwards[:, 0], normals[:, 0])
    against = (dot(axis, end - start) < 0)[:, None]
    start, end = torch.where(against, end, start), torch.where(against, start, end)
    low, high = dot(axis, start), dot(axis, end)
    size = float(torch.maximum(low.abs(), high.abs()).amax()) + float((high - low).amax())
    aside = (start - low[:, None] * axis) / size
    key = torch.cat([aside, inwards.flatten(1), normals.flatten(1)], 1)
    # Adding zero makes negative zeros positive.
    rounded = (key / _MERGE_TOLERANCE).round().numpy() + 0.0
    line = np.unique(rounded, axis=0, return_inverse=True)[1].ravel()
    sequence = torch.from_numpy(np.lexsort((low.numpy(), line)))
    line = torch.from_numpy(line)[sequence]
    new = torch.ones(len(line), dtype=torch.bool)
    gap = (low[sequence][1:] - high[sequence][:-1]).abs() > _MERGE_TOLERANCE * size
    new[1:] = (line[1:] != line[:-1]) | gap
    return order, against, sequence[new], sequence[new.roll(-1)]


def is_outside_wedge(wedges: Wedges, direction: Float64[Tensor, "row 3"]) -> Tensor:
    """Whether a direction lies in each wedge's exterior, ``MIN_EDGE_ANGLE`` or more off its edge.

    Args:
        wedges: one row each.
        direction: unit vectors from the edge.
    """
    angle = azimuth(wedges, direction, 0)
    along = normalize(wedges.end - wedges.start, dim=1)
    return (angle <= wedges.opening * math.pi) & (
        dot(along, direction).abs() < math.cos(MIN_EDGE_ANGLE)
    )


def is_grazing_sheet(wedges: Wedges, direction: Float64[Tensor, "row 3"]) -> Tensor:
    """Whether a direction lies within ``MIN_EDGE_ANGLE`` of the plane of a sheet with this edge.

    Args:
        wedges: one row each.
        direction: unit vectors from the edge.
    """
    flat = wedges.opening > 2 - 1e-6
    return flat & (dot(wedges.normals[:, 0], direction).abs() < math.sin(MIN_EDGE_ANGLE))


def azimuth(wedges: Wedges, direction: Tensor, face: int) -> Tensor:
    """Angle about the edge from a face, through its normal, in [0, 2π).

    Args:
        wedges: one row each.
        direction: vectors from the edge, of any length.
        face: 0 or 1.
    """
    return torch.atan2(
        dot(wedges.normals[:, face], direction), dot(wedges.face_tangents[:, face], direction)
    ) % (2 * math.pi)


def exterior_azimuth(wedges: Wedges, direction: Tensor, face: int) -> Tensor:
    """Angle about the edge from a face, of a direction outside, in [0, opening · π].

    One that grazes a face is not taken for one inside.

    Args:
        wedges: one row each.
        direction: unit vectors from the edge.
        face: 0 or 1, the face from which the angle is counted.
    """
    angle, last = azimuth(wedges, direction, face), wedges.opening * math.pi
    grazed = torch.where(angle > last / 2 + math.pi, 0.0 * angle, last)
    return torch.where(angle > last, grazed, angle)


def fringe_field(
    wedges: Wedges,
    wave_number: float,
    direction: Float64[Tensor, "row 3"],
    field: Float64[Tensor, "row 2 3"],
    scattered_direction: Float64[Tensor, "row 3"],
) -> Tensor:
    """F per metre of edge of the fringe currents, for both incident polarisations.

    ``(jk/4π) Σ_faces [ηI s×(s×t̂) + M s×t̂]``; the phases of incident and scattered wave are left
    out, as they are of ``radiate_field``.

    Args:
        wedges: lit edges.
        wave_number: k [1/m].
        direction: d of the incident wave.
        field: E.
        towards: s, to the receiver.
    """
    total = torch.zeros(len(direction), 2, 3, dtype=torch.complex128)
    for face in (0, 1):
        along = cross(wedges.face_tangents[:, face], wedges.normals[:, face])
        cos_in, cos_out = dot(along, direction), dot(along, scattered_direction)
        sin_in, sin_out = (1 - cos_in**2).sqrt(), (1 - cos_out**2).sqrt()
        phi_in = exterior_azimuth(wedges, -direction, face)
        phi_out = exterior_azimuth(wedges, scattered_direction, face)
        mu = sin_out * torch.cos(phi_out) / sin_in
        electric, magnetic = _fringe_coefficients(wedges.opening, phi_in, mu)
        across = cross(scattered_direction, along)
        e = dot(along[:, None], field)
        h = dot(along[:, None], cross(direction[:, None], field))
        k = wave_number
        straight = mu * cos_in / sin_in - cos_out / sin_out * torch.cos(phi_out)
        current = (2j / (k * sin_in**2) * electric)[:, None] * e + (
            2j / (k * sin_in) * magnetic * straight
        )[:, None] * h
        charge = (-2j / k * magnetic * torch.sin(phi_out) / (sin_in * sin_out))[:, None] * h
        total = total + current[..., None] * cross(scattered_direction, across)[:, None]
        total = total + charge[..., None] * across[:, None]
    return 1j * wave_number / (4 * math.pi) * total


def _fringe_coefficients(opening: Tensor, azimuth: Tensor, mu: Tensor) -> tuple[Tensor, Tensor]:
    """A and B of one face: those of the wedge less those of physical optics.

    Both have the same pole at cosφ′ + μ = 0, the direction of the mirror; beside it their
    difference is smooth, so that a small step aside is exact enough.
    """
    pole = torch.cos(azimuth) + mu
    step = 2 * _POLE_WIDTH / torch.sin(azimuth).abs().clamp_min(0.1)
    azimuth = torch.where(pole.abs() < _POLE_WIDTH, azimuth + step, azimuth)
    # arccos μ, also of |μ| > 1 (beyond Keller's cone), where it is complex.
    alpha = torch.arccos(mu.to(torch.complex128))
    rest = math.pi - alpha
    small = rest.abs() < 1e-7
    rest = torch.where(small, torch.full_like(rest, 1e-7), rest)
    near = (alpha.abs() < 1e-7) & ~small
    rest = torch.where(near, rest * (1 - 1e-7), rest)
    delta = torch.cos(azimuth / opening) - torch.cos(rest / opening)
    lit = (azimuth < math.pi).double()
    optics = lit / (torch.cos(azimuth) + mu)
    electric = torch.sin(azimuth / opening) / (opening * delta) - optics * torch.sin(azimuth)
    magnetic = torch.sin(rest / opening) / (opening * torch.sin(rest) * delta) - optics
    return electric, magnetic
