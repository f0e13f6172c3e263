"""Meshes: tubes of light that solids have let in, with rays at their corners.

A tube begins as a lit triangle of a face. Its three corner rays are refracted by smooth normals, so
that on curved faces neighbours stay neighbours: a tube's field follows from its area across, its
phase is linear between its corners. Of flat faces that is a plane wave.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams.beam_tracing import Bounce, Facets, joined, left, rows_of
from invertwin.channel.em.dielectric_solids import Solids
from invertwin.channel.em.plane_waves import cross, dot, mirrored, points_at, shares, unit_across
from invertwin.channel.rays.ray_scene import Occluders, next_surface
from invertwin.channel.rcs.shooting_bouncing_rays import above, divided, inner_points
from invertwin.errors import InputError
from invertwin.scene.material.fresnel import refractive_index

SMOOTH = 0.35
"""Angle between normals of neighbours [rad], above which the edge between them is sharp."""
_THIN = 1e-14  # of the scene's size squared: a tube of less area is none
_FLAT = 1e-6  # cosine of rays that are too near grazing
_TOUCHING = 1e-6  # of the scene's size, and of a normal: two planes that differ less are one
_RETRIES = 2  # how often a ray goes on from a surface that it has already left


@dataclass(frozen=True)
class Curved:
    """Facets as pieces of smooth faces.

    Attributes:
        facets: the triangles.
        face: number of the smooth face that each belongs to.
        normals: at their corners, of the face.
    """

    facets: Facets
    face: Int64[Tensor, " facet"]
    normals: Float64[Tensor, "facet 3 3"]

    def at(
        self, facet: Int64[Tensor, "row 3"], points: Float64[Tensor, "row 3 3"], ways: Tensor
    ) -> Float64[Tensor, "row 3 3"]:
        """Normals at points, towards where rays come from.

        Args:
            facet: that each point lies on.
            points: on the facets [m].
            ways: of the rays.
        """
        found = points_at(self.normals[facet], self.facets.corners[facet], points)
        side = -dot(self.facets.normal[facet], ways).sign()
        return normalize(side[..., None] * found, dim=2)


def curved(facets: Facets, beside: Int64[Tensor, "edge k"]) -> Curved:
    """Smooth faces of meshes, and their normals: the mean of facets about a vertex.

    Args:
        facets: the triangles.
        beside: triangles at each edge; −1 = none.
    """
    corners, normal = facets.corners.detach(), facets.normal.detach()
    pairs = beside[:, :2]
    pairs = pairs[(pairs >= 0).all(1)]
    soft = dot(normal[pairs[:, 0]], normal[pairs[:, 1]]) > math.cos(SMOOTH)
    first, second = pairs[soft].numpy().T
    count = len(normal)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    face = torch.from_numpy(connected_components(graph, directed=False)[1]).long()
    places = torch.round(corners.reshape(-1, 3) / (1e-9 * facets.size))
    keys = torch.cat([face.repeat_interleave(3)[:, None].double(), places], 1)
    _, vertex = keys.unique(dim=0, return_inverse=True)
    a, b = (corners.roll(-n, 1) - corners for n in (1, 2))
    angle = torch.atan2(cross(a, b).norm(dim=2), dot(a, b))
    weighted = (angle[..., None] * normal[:, None]).reshape(-1, 3)
    total = torch.zeros(int(vertex.max()) + 1, 3, dtype=torch.float64)
    total = normalize(total.index_add(0, vertex, weighted), dim=1)[vertex].view(count, 3, 3)
    # A face that ends in a tip has no normal there.
    sound = dot(total, normal[:, None]) > math.cos(SMOOTH)
    return Curved(facets, face, torch.where(sound[..., None], total, normal[:, None]))


@dataclass(frozen=True)
class _Tubes:
    """Tubes where they meet surfaces, with values at their three corners.

    Attributes:
        row: number of the patch that each ends in.
        corners: where the rays meet the surface [m].
        ways: unit vectors that they arrive along.
        normals: of the surface, towards the source.
        phases: Σ √ε × length along each ray, from where the plane wave has phase zero [m].
        fresh: waves in air, of which others follow what is mirrored.
    """

    row: Int64[Tensor, " row"]
    corners: Float64[Tensor, "row 3 3"]
    ways: Float64[Tensor, "row 3 3"]
    normals: Float64[Tensor, "row 3 3"]
    phases: Complex128[Tensor, "row 3"]
    fresh: Bool[Tensor, " row"]


def with_inner(
    surface: Curved,
    occluders: Occluders,
    solids: Solids,
    outside: Sequence[Bounce],
    narrowest: float,
    depth: int,
) -> list[Bounce]:
    """Patches of all orders: those of waves that stayed outside, then those that went through.

    Directions follow the real part of √ε, phases and losses √ε along the ray, which holds where
    losses per wavelength are small.

    Args:
        surface: the triangles.
        occluders: the same as rays see them.
        solids: what waves enter.
        outside: orders of waves that have stayed outside.
        narrowest: width of a tube that is not split [m].
        depth: most meetings with surfaces.

    Raises:
        InputError: a dielectric within another one, or in touch with it.

    Source: derivations §13; Deschamps, "Ray techniques in electromagnetics", Proc. IEEE 60, 1972,
    for the spread of tubes and their phase behind a caustic.
    """
    found: list[Bounce] = []
    tubes: _Tubes | None = None
    for order in range(depth):
        parts, begun = [], []
        if order < len(outside):
            parts.append(_complex(outside[order]))
            begun.append(_entering(surface, solids, outside[order]))
        if tubes is not None:
            inner, tubes = _next(surface, occluders, solids, found[-1], tubes, narrowest)
            if parts:
                tubes = replace(tubes, row=tubes.row + len(parts[0].aspect))
            parts.append(inner)
            begun.append(tubes)
        found.append(joined(parts))
        names = [entry.name for entry in fields(_Tubes)]
        tubes = _Tubes(**{n: torch.cat([getattr(some, n) for some in begun]) for n in names})
        if not len(found[-1].aspect):
            return found[:-1]
    return found


def _complex(bounce: Bounce) -> Bounce:
    names = ("wave", "offset", "spread")
    return replace(bounce, **{name: getattr(bounce, name).to(torch.complex128) for name in names})


def _entering(surface: Curved, solids: Solids, bounce: Bounce) -> _Tubes:
    """Tubes of waves in air that meet solids."""
    row = torch.nonzero(solids.clear[bounce.facet])[:, 0]
    corners, d = bounce.polygon[row], bounce.direction[row]
    normals = surface.at(bounce.facet[row, None].expand(-1, 3), corners, d[:, None])
    phases = dot(corners, d[:, None]) + bounce.offset[row, None]
    ways = d[:, None].expand(-1, 3, 3)
    fresh = torch.ones_like(row, dtype=torch.bool)
    return _Tubes(row, corners, ways, normals, phases.to(torch.complex128), fresh)


class _Leaving(NamedTuple):
    """Tubes that set out from surfaces; ``slowness`` is √ε where they go."""

    before: Tensor
    corners: Tensor
    ways: Tensor
    phases: Tensor
    side: Tensor
    medium: Tensor
    passed: Tensor
    slowness: Tensor


def _leaving(solids: Solids, last: Bounce, tubes: _Tubes) -> _Leaving:
    """What surfaces mirror, and after that what they let through."""
    facet, medium = last.facet[tubes.row], last.medium[tubes.row]
    again = torch.nonzero(~tubes.fresh)[:, 0]
    behind = solids.behind(facet, medium)
    here, there = (refractive_index(solids.inside(m)) for m in (medium, behind))
    cosine = -dot(tubes.normals, tubes.ways)
    ratio = (here / there)[:, None]
    square = 1 - ratio**2 * (1 - cosine**2)
    onwards = ratio * cosine - square.clamp_min(0).sqrt()
    ways = ratio[..., None] * tubes.ways + onwards[..., None] * tubes.normals
    going = (square > 0).all(1) & (cosine > _FLAT).all(1) & solids.clear[facet]
    going = torch.nonzero(going)[:, 0]
    row = torch.cat([again, going])
    passed = torch.arange(len(row)) >= len(again)
    back = mirrored(tubes.ways, tubes.normals)[again]
    ways = normalize(torch.cat([back, ways[going]]), dim=2)
    normal = last.normal[tubes.row[row]]
    side = torch.where(passed[:, None], -normal, normal)
    medium = torch.where(passed, behind[row], medium[row])
    index = solids.inside(medium).sqrt()
    return _Leaving(
        tubes.row[row], tubes.corners[row], ways, tubes.phases[row], side, medium, passed, index
    )


def _next(
    surface: Curved,
    occluders: Occluders,
    solids: Solids,
    last: Bounce,
    tubes: _Tubes,
    narrowest: float,
) -> tuple[Bounce, _Tubes]:
    """What tubes meet next, in pieces that see one smooth face each."""
    facets = surface.facets
    begun = _leaving(solids, last, tubes)
    begun = _Leaving(*(x[_wide(facets, begun.corners)] for x in begun))

    def ways(row: Tensor, points: Tensor) -> Tensor:
        where = begun.corners[row][:, None]
        return normalize(points_at(begun.ways[row][:, None], where, points), dim=2)

    def met(row: Tensor, points: Tensor) -> Tensor:
        shape, many = points.shape[:2], row.repeat_interleave(points.shape[1])
        starts = (points + above(facets, begun.side[row])[:, None]).flatten(0, 1)
        found = _met(
            facets, occluders, solids, begun.medium[many], starts, ways(row, points).flatten(0, 1)
        )
        return found.view(shape)

    def seen(row: Tensor, points: Tensor) -> Tensor:
        found = met(row, points)
        return torch.where(found >= 0, surface.face[found.clamp_min(0)], -1)

    def narrow(_: Tensor, pieces: Tensor) -> Tensor:
        return (pieces.roll(-1, 1) - pieces).norm(dim=2).amax(1) <= narrowest

    row, corners, face = divided(begun.corners, seen, narrow)
    keep = (face >= 0) & _wide(facets, corners)
    row, corners, face = row[keep], corners[keep], face[keep]
    hit = met(row, inner_points(corners))
    wrong = (hit < 0) | (surface.face[hit.clamp_min(0)] != face[:, None])
    # A piece that was cut sees its face from its middle at least.
    sound = (~wrong).any(1)
    best = hit.gather(1, (~wrong).int().argmax(1, keepdim=True))
    facet = torch.where(wrong, best, hit)[sound]
    row, corners = row[sound], corners[sound]
    return _ended(surface, solids, last, begun, row, corners, facet)


def _met(
    facets: Facets,
    occluders: Occluders,
    solids: Solids,
    medium: Tensor,
    starts: Tensor,
    ways: Tensor,
) -> Tensor:
    """First facets that rays in a medium can meet (−1: none)."""
    far = 3 * facets.size
    found, along = next_surface(occluders, starts, starts + far * ways)

    def wrong() -> Tensor:
        """The chord of a curved face lies on the wrong side of it, or of its facets."""
        facet = found.clamp_min(0)
        within, facing = medium == solids.owner[facet], dot(facets.normal[facet], ways)
        return (found >= 0) & facets.solid[facet] & (within != (facing > 0))

    for _ in range(_RETRIES):
        row = torch.nonzero(wrong())[:, 0]
        if not len(row):
            break
        beyond = (along[row] * far)[:, None] * ways[row] + 2 * above(facets, ways[row])
        starts = starts.index_copy(0, row, starts[row] + beyond)
        again, along_again = next_surface(occluders, starts[row], starts[row] + far * ways[row])
        found = found.index_copy(0, row, again)
        along = along.index_copy(0, row, along_again)
    return torch.where(wrong(), -1, found)


def _ended(
    surface: Curved,
    solids: Solids,
    last: Bounce,
    begun: _Leaving,
    row: Tensor,
    corners: Tensor,
    facet: Tensor,
) -> tuple[Bounce, _Tubes]:
    """Patches where pieces of tubes end; ``facet`` at the middle, and at each corner."""
    facets, start = surface.facets, begun.corners[row]
    share = shares(start[:, None], corners)
    ways = normalize((share[..., None] * begun.ways[row][:, None]).sum(2), dim=2)
    index = begun.slowness[row]
    # The phase is quadratic between corners at which its slope is known.
    slopes = dot(begun.ways[row][:, None], corners[:, :, None] - start[:, None])
    phases = (share * (begun.phases[row][:, None] + index[:, None, None] * slopes / 2)).sum(2)
    own = facet[:, 1:]
    facing = dot(facets.normal[own], ways)
    length = dot(facets.normal[own], facets.corners[own, 0] - corners) / facing
    ends = corners + length[..., None] * ways
    phases = phases + index[:, None] * length
    keep = (facing.abs() > _FLAT).all(1) & (length > -1e-6 * facets.size).all(1)
    keep &= _wide(facets, ends)
    row, corners, ends, ways, phases, facet, index = (
        x[keep] for x in (row, corners, ends, ways, phases, facet, index)
    )
    direction = normalize(ways.sum(1), dim=1)
    middle = facet[:, 0]
    normals = surface.at(facet[:, 1:], ends, ways)
    normal = normalize(normals.sum(1), dim=1)
    steep = (dot(normal, direction) < -_FLAT) & (dot(normals, ways) < 0).all(1)
    wave = _fitted(index[:, None] * direction, ends, phases)
    before = begun.before[row]
    bounce = Bounce(
        aspect=last.aspect[before],
        facet=middle,
        normal=normal,
        direction=direction,
        offset=phases[:, 0] - dot(wave, ends[:, 0]),
        polygon=ends,
        before=before,
        wave=wave,
        medium=begun.medium[row],
        passed=begun.passed[row],
        spread=_spread(direction, corners, ends),
    )
    keep = steep & left(bounce, solids.wave_number)
    solids.check(bounce.facet[keep], bounce.medium[keep])
    number = torch.arange(int(keep.sum()))
    fresh = torch.zeros_like(number, dtype=torch.bool)
    tubes = _Tubes(number, ends[keep], ways[keep], normals[keep], phases[keep], fresh)
    return rows_of(bounce, keep), tubes


def _fitted(wave: Tensor, corners: Tensor, phases: Tensor) -> Tensor:
    """K whose phases at three corners differ as given, changed along their plane alone."""
    first, second = ((corners[:, n] - corners[:, 0]) for n in (1, 2))
    normal = cross(first, second)
    short, long = (
        (phases[:, n] - phases[:, 0] - dot(wave, side)) for n, side in ((1, first), (2, second))
    )
    slope = short[:, None] * cross(second, normal) + long[:, None] * cross(normal, first)
    return wave + slope / dot(normal, normal)[:, None]


def _spread(
    direction: Float64[Tensor, "row 3"],
    start: Float64[Tensor, "row 3 3"],
    end: Float64[Tensor, "row 3 3"],
) -> Complex128[Tensor, " row"]:
    """√(A/A′) of the areas of tubes across, and j for each line in which rays have crossed."""
    first = unit_across(direction)
    axes = torch.stack([first, cross(direction, first)], 1)
    a, b = ((x[:, 1:] - x[:, :1]) @ axes.mT for x in (start, end))
    a, b = a.mT, b.mT
    before, after = torch.linalg.det(a), torch.linalg.det(b)
    # b = J a; crossed in one line where det J < 0, in two where both parts of J are negative.
    trace = (
        b[:, 0, 0] * a[:, 1, 1]
        - b[:, 0, 1] * a[:, 1, 0]
        + b[:, 1, 1] * a[:, 0, 0]
        - b[:, 1, 0] * a[:, 0, 1]
    ) / before
    turned = before * after < 0
    turns = torch.where(turned, 1, torch.where(trace < 0, 2, 0))
    quarter = torch.tensor([1.0, 1j, -1.0], dtype=torch.complex128)[turns]
    return (before / after).abs().sqrt() * quarter


def _wide(facets: Facets, corners: Float64[Tensor, "row 3 3"]) -> Bool[Tensor, " row"]:
    """Whether triangles have an area."""
    a, b, c = corners.unbind(1)
    return cross(b - a, c - a).norm(dim=1) > _THIN * facets.size**2


def require_apart(facets: Facets, solids: Solids) -> None:
    """Refuse conductors in the very face of a solid: rays find the one or the other.

    Args:
        facets: the triangles.
        solids: what waves enter.

    Raises:
        InputError: names both.
    """
    corners, normal = facets.corners.detach(), facets.normal.detach()
    own, metal = (torch.nonzero(some)[:, 0] for some in (solids.clear, solids.conducting))
    planes = torch.cat([normal, dot(normal, corners[:, 0])[:, None] / facets.size], 1)
    if not len(metal):
        return
    tree = KDTree(torch.cat([planes[metal], -planes[metal]]))
    near = tree.query_ball_point(planes[own], _TOUCHING)
    low, high = corners.amin(1), corners.amax(1)
    for facet, others in zip(own.tolist(), near, strict=True):
        other = metal[torch.tensor(others, dtype=torch.int64) % len(metal)]
        gap = torch.maximum(low[other] - high[facet], low[facet] - high[other])
        # Neighbours that share a side in one plane do not cover each other.
        over = (gap < _TOUCHING * facets.size).all(1) & (
            (gap < -_TOUCHING * facets.size).sum(1) > 1
        )
        if bool(over.any()):
            names = [solids.names[int(solids.owner[n])] for n in (facet, other[over][0])]
            raise InputError(
                f"expected conductors that do not touch {names[0]} in a scene of more than 24 "
                f"triangles, got {names[1]} in the plane of one of its faces; sink it into "
                f"{names[0]} by a thousandth of a wavelength, or use at most 24 triangles"
            )
