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

from invertwin.channel.beams.beam_tracing import (
    Facets,
    IlluminatedPatches,
    concatenate_patches,
    exceeds_min_amplitude,
    select_patches,
)
from invertwin.channel.em.dielectric_solids import DielectricSolids
from invertwin.channel.em.plane_waves import (
    barycentric_coordinates,
    cross,
    dot,
    interpolate_vectors,
    orthogonal_unit_vectors,
    reflect_vectors,
)
from invertwin.channel.rays.ray_scene import Occluders, find_next_surface
from invertwin.channel.rcs.shooting_bouncing_rays import (
    inset_points,
    ray_offset,
    subdivide_triangles,
)
from invertwin.errors import InputError
from invertwin.scene.material.fresnel import refractive_index

MAX_SMOOTH_ANGLE = 0.35
"""Angle between normals of neighbours [rad], above which the edge between them is sharp."""
_MIN_TUBE_AREA = 1e-14  # of the scene's size squared: a tube of less area is none
_MIN_COSINE = 1e-6  # cosine of rays that are too near grazing
_CONTACT_TOLERANCE = (
    1e-6  # of the scene's size, and of a normal: two planes that differ less are one
)
_RETRIES = 2  # how often a ray goes on from a surface that it has already left


@dataclass(frozen=True)
class SmoothFaces:
    """Facets as pieces of smooth faces.

    Attributes:
        facets: the triangles.
        face: number of the smooth face that each belongs to.
        normals: at their corners, of the face.
    """

    facets: Facets
    face: Int64[Tensor, " facet"]
    normals: Float64[Tensor, "facet 3 3"]

    def normals_at(
        self, facet: Int64[Tensor, "row 3"], points: Float64[Tensor, "row 3 3"], directions: Tensor
    ) -> Float64[Tensor, "row 3 3"]:
        """Normals at points, towards where rays come from.

        Args:
            facet: that each point lies on.
            points: on the facets [m].
            directions: of the rays.
        """
        found = interpolate_vectors(self.normals[facet], self.facets.corners[facet], points)
        side = -dot(self.facets.normal[facet], directions).sign()
        return normalize(side[..., None] * found, dim=2)


def group_smooth_faces(facets: Facets, edge_faces: Int64[Tensor, "edge k"]) -> SmoothFaces:
    """Smooth faces of meshes, and their normals: the mean of facets about a vertex.

    Args:
        facets: the triangles.
        edge_faces: triangles at each edge; −1 = none.
    """
    corners, normal = facets.corners.detach(), facets.normal.detach()
    pairs = edge_faces[:, :2]
    pairs = pairs[(pairs >= 0).all(1)]
    soft = dot(normal[pairs[:, 0]], normal[pairs[:, 1]]) > math.cos(MAX_SMOOTH_ANGLE)
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
    sound = dot(total, normal[:, None]) > math.cos(MAX_SMOOTH_ANGLE)
    return SmoothFaces(facets, face, torch.where(sound[..., None], total, normal[:, None]))


@dataclass(frozen=True)
class _RayTubes:
    """Tubes where they meet surfaces, with values at their three corners.

    Attributes:
        patch: number of the patch that each ends in.
        corners: where the rays meet the surface [m].
        directions: unit vectors that they arrive along.
        normals: of the surface, towards the source.
        phases: Σ √ε × length along each ray, from where the plane wave has phase zero [m].
        from_outside: waves in air, of which others follow what is mirrored.
    """

    patch: Int64[Tensor, " patch"]
    corners: Float64[Tensor, "row 3 3"]
    directions: Float64[Tensor, "row 3 3"]
    normals: Float64[Tensor, "row 3 3"]
    phases: Complex128[Tensor, "row 3"]
    from_outside: Bool[Tensor, " patch"]


def trace_inner_tubes(
    surface: SmoothFaces,
    occluders: Occluders,
    solids: DielectricSolids,
    outer_orders: Sequence[IlluminatedPatches],
    min_tube_width: float,
    depth: int,
) -> list[IlluminatedPatches]:
    """Patches of all orders: those of waves that stayed outside, then those that went through.

    Directions follow the real part of √ε, phases and losses √ε along the ray, which holds where
    losses per wavelength are small.

    Args:
        surface: the triangles.
        occluders: the same as rays see them.
        solids: what waves enter.
        outer_orders: orders of waves that have stayed outside.
        min_tube_width: width of a tube that is not split [m].
        depth: most meetings with surfaces.

    Raises:
        InputError: a dielectric within another one, or in touch with it.

    Source: derivations §13; Deschamps, "Ray techniques in electromagnetics", Proc. IEEE 60, 1972,
    for the spread of tubes and their phase behind a caustic.
    """
    found: list[IlluminatedPatches] = []
    tubes: _RayTubes | None = None
    for order in range(depth):
        parts, begun = [], []
        if order < len(outer_orders):
            parts.append(_to_complex(outer_orders[order]))
            begun.append(_launch_inner_tubes(surface, solids, outer_orders[order]))
        if tubes is not None:
            inner, tubes = _trace_tubes(
                surface, occluders, solids, found[-1], tubes, min_tube_width
            )
            if parts:
                tubes = replace(tubes, patch=tubes.patch + len(parts[0].aspect))
            parts.append(inner)
            begun.append(tubes)
        found.append(concatenate_patches(parts))
        names = [entry.name for entry in fields(_RayTubes)]
        tubes = _RayTubes(**{n: torch.cat([getattr(some, n) for some in begun]) for n in names})
        if not len(found[-1].aspect):
            return found[:-1]
    return found


def _to_complex(patches: IlluminatedPatches) -> IlluminatedPatches:
    names = ("wave_vector", "phase_offset", "spreading")
    return replace(patches, **{name: getattr(patches, name).to(torch.complex128) for name in names})


def _launch_inner_tubes(
    surface: SmoothFaces, solids: DielectricSolids, patches: IlluminatedPatches
) -> _RayTubes:
    """Tubes of waves in air that meet solids."""
    row = torch.nonzero(solids.transparent[patches.facet])[:, 0]
    corners, d = patches.polygon[row], patches.direction[row]
    normals = surface.normals_at(patches.facet[row, None].expand(-1, 3), corners, d[:, None])
    phases = dot(corners, d[:, None]) + patches.phase_offset[row, None]
    ways = d[:, None].expand(-1, 3, 3)
    fresh = torch.ones_like(row, dtype=torch.bool)
    return _RayTubes(row, corners, ways, normals, phases.to(torch.complex128), fresh)


class _DepartingTubes(NamedTuple):
    """Tubes that set out from surfaces; ``slowness`` is √ε where they go."""

    parent: Tensor
    corners: Tensor
    directions: Tensor
    phases: Tensor
    source_normal: Tensor
    medium: Tensor
    transmitted: Tensor
    refractive_index: Tensor


def _continue_tubes(
    solids: DielectricSolids, previous: IlluminatedPatches, tubes: _RayTubes
) -> _DepartingTubes:
    """What surfaces mirror, and after that what they let through."""
    facet, medium = previous.facet[tubes.patch], previous.medium[tubes.patch]
    again = torch.nonzero(~tubes.from_outside)[:, 0]
    behind = solids.medium_behind(facet, medium)
    here, there = (refractive_index(solids.permittivity_in(m)) for m in (medium, behind))
    cosine = -dot(tubes.normals, tubes.directions)
    ratio = (here / there)[:, None]
    square = 1 - ratio**2 * (1 - cosine**2)
    onwards = ratio * cosine - square.clamp_min(0).sqrt()
    ways = ratio[..., None] * tubes.directions + onwards[..., None] * tubes.normals
    going = (square > 0).all(1) & (cosine > _MIN_COSINE).all(1) & solids.transparent[facet]
    going = torch.nonzero(going)[:, 0]
    row = torch.cat([again, going])
    passed = torch.arange(len(row)) >= len(again)
    back = reflect_vectors(tubes.directions, tubes.normals)[again]
    ways = normalize(torch.cat([back, ways[going]]), dim=2)
    normal = previous.normal[tubes.patch[row]]
    side = torch.where(passed[:, None], -normal, normal)
    medium = torch.where(passed, behind[row], medium[row])
    index = solids.permittivity_in(medium).sqrt()
    return _DepartingTubes(
        tubes.patch[row], tubes.corners[row], ways, tubes.phases[row], side, medium, passed, index
    )


def _trace_tubes(
    surface: SmoothFaces,
    occluders: Occluders,
    solids: DielectricSolids,
    previous: IlluminatedPatches,
    tubes: _RayTubes,
    min_tube_width: float,
) -> tuple[IlluminatedPatches, _RayTubes]:
    """What tubes meet next, in pieces that see one smooth face each."""
    facets = surface.facets
    begun = _continue_tubes(solids, previous, tubes)
    begun = _DepartingTubes(*(x[_has_area(facets, begun.corners)] for x in begun))

    def directions_at(row: Tensor, points: Tensor) -> Tensor:
        where = begun.corners[row][:, None]
        return normalize(interpolate_vectors(begun.directions[row][:, None], where, points), dim=2)

    def hit_facets(row: Tensor, points: Tensor) -> Tensor:
        shape, many = points.shape[:2], row.repeat_interleave(points.shape[1])
        starts = (points + ray_offset(facets, begun.source_normal[row])[:, None]).flatten(0, 1)
        found = _find_first_facets(
            facets,
            occluders,
            solids,
            begun.medium[many],
            starts,
            directions_at(row, points).flatten(0, 1),
        )
        return found.view(shape)

    def visible_faces(row: Tensor, points: Tensor) -> Tensor:
        found = hit_facets(row, points)
        return torch.where(found >= 0, surface.face[found.clamp_min(0)], -1)

    def is_narrow(_: Tensor, pieces: Tensor) -> Tensor:
        return (pieces.roll(-1, 1) - pieces).norm(dim=2).amax(1) <= min_tube_width

    row, corners, face = subdivide_triangles(begun.corners, visible_faces, is_narrow)
    keep = (face >= 0) & _has_area(facets, corners)
    row, corners, face = row[keep], corners[keep], face[keep]
    hit = hit_facets(row, inset_points(corners))
    wrong = (hit < 0) | (surface.face[hit.clamp_min(0)] != face[:, None])
    # A piece that was cut sees its face from its middle at least.
    sound = (~wrong).any(1)
    best = hit.gather(1, (~wrong).int().argmax(1, keepdim=True))
    facet = torch.where(wrong, best, hit)[sound]
    row, corners = row[sound], corners[sound]
    return _terminate_tubes(surface, solids, previous, begun, row, corners, facet)


def _find_first_facets(
    facets: Facets,
    occluders: Occluders,
    solids: DielectricSolids,
    medium: Tensor,
    origins: Tensor,
    directions: Tensor,
) -> Tensor:
    """First facets that rays in a medium can meet (−1: none)."""
    far = 3 * facets.size
    found, along = find_next_surface(occluders, origins, origins + far * directions)

    def is_wrong_side() -> Tensor:
        """The chord of a curved face lies on the wrong side of it, or of its facets."""
        facet = found.clamp_min(0)
        within, facing = medium == solids.owner[facet], dot(facets.normal[facet], directions)
        return (found >= 0) & facets.solid[facet] & (within != (facing > 0))

    for _ in range(_RETRIES):
        row = torch.nonzero(is_wrong_side())[:, 0]
        if not len(row):
            break
        beyond = (along[row] * far)[:, None] * directions[row] + 2 * ray_offset(
            facets, directions[row]
        )
        origins = origins.index_copy(0, row, origins[row] + beyond)
        again, along_again = find_next_surface(
            occluders, origins[row], origins[row] + far * directions[row]
        )
        found = found.index_copy(0, row, again)
        along = along.index_copy(0, row, along_again)
    return torch.where(is_wrong_side(), -1, found)


def _terminate_tubes(
    surface: SmoothFaces,
    solids: DielectricSolids,
    previous: IlluminatedPatches,
    departing: _DepartingTubes,
    row: Tensor,
    corners: Tensor,
    facet: Tensor,
) -> tuple[IlluminatedPatches, _RayTubes]:
    """Patches where pieces of tubes end; ``facet`` at the middle, and at each corner."""
    facets, start = surface.facets, departing.corners[row]
    share = barycentric_coordinates(start[:, None], corners)
    ways = normalize((share[..., None] * departing.directions[row][:, None]).sum(2), dim=2)
    index = departing.refractive_index[row]
    # The phase is quadratic between corners at which its slope is known.
    slopes = dot(departing.directions[row][:, None], corners[:, :, None] - start[:, None])
    phases = (share * (departing.phases[row][:, None] + index[:, None, None] * slopes / 2)).sum(2)
    own = facet[:, 1:]
    facing = dot(facets.normal[own], ways)
    length = dot(facets.normal[own], facets.corners[own, 0] - corners) / facing
    ends = corners + length[..., None] * ways
    phases = phases + index[:, None] * length
    keep = (facing.abs() > _MIN_COSINE).all(1) & (length > -1e-6 * facets.size).all(1)
    keep &= _has_area(facets, ends)
    row, corners, ends, ways, phases, facet, index = (
        x[keep] for x in (row, corners, ends, ways, phases, facet, index)
    )
    direction = normalize(ways.sum(1), dim=1)
    middle = facet[:, 0]
    normals = surface.normals_at(facet[:, 1:], ends, ways)
    normal = normalize(normals.sum(1), dim=1)
    steep = (dot(normal, direction) < -_MIN_COSINE) & (dot(normals, ways) < 0).all(1)
    wave = _fit_wave_vector(index[:, None] * direction, ends, phases)
    before = departing.parent[row]
    bounce = IlluminatedPatches(
        aspect=previous.aspect[before],
        facet=middle,
        normal=normal,
        direction=direction,
        phase_offset=phases[:, 0] - dot(wave, ends[:, 0]),
        polygon=ends,
        parent=before,
        wave_vector=wave,
        medium=departing.medium[row],
        transmitted=departing.transmitted[row],
        spreading=_spreading_factor(direction, corners, ends),
    )
    keep = steep & exceeds_min_amplitude(bounce, solids.wave_number)
    solids.require_gaps(bounce.facet[keep], bounce.medium[keep])
    number = torch.arange(int(keep.sum()))
    fresh = torch.zeros_like(number, dtype=torch.bool)
    tubes = _RayTubes(number, ends[keep], ways[keep], normals[keep], phases[keep], fresh)
    return select_patches(bounce, keep), tubes


def _fit_wave_vector(wave_vector: Tensor, corners: Tensor, phases: Tensor) -> Tensor:
    """K whose phases at three corners differ as given, changed along their plane alone."""
    first, second = ((corners[:, n] - corners[:, 0]) for n in (1, 2))
    normal = cross(first, second)
    short, long = (
        (phases[:, n] - phases[:, 0] - dot(wave_vector, side))
        for n, side in ((1, first), (2, second))
    )
    slope = short[:, None] * cross(second, normal) + long[:, None] * cross(normal, first)
    return wave_vector + slope / dot(normal, normal)[:, None]


def _spreading_factor(
    direction: Float64[Tensor, "row 3"],
    start: Float64[Tensor, "row 3 3"],
    end: Float64[Tensor, "row 3 3"],
) -> Complex128[Tensor, " row"]:
    """√(A/A′) of the areas of tubes across, and j for each line in which rays have crossed."""
    first = orthogonal_unit_vectors(direction)
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


def _has_area(facets: Facets, corners: Float64[Tensor, "row 3 3"]) -> Bool[Tensor, " row"]:
    """Whether triangles have an area."""
    a, b, c = corners.unbind(1)
    return cross(b - a, c - a).norm(dim=1) > _MIN_TUBE_AREA * facets.size**2


def require_separate_conductors(facets: Facets, solids: DielectricSolids) -> None:
    """Refuse conductors in the very face of a solid: rays find the one or the other.

    Args:
        facets: the triangles.
        solids: what waves enter.

    Raises:
        InputError: names both.
    """
    corners, normal = facets.corners.detach(), facets.normal.detach()
    own, metal = (torch.nonzero(some)[:, 0] for some in (solids.transparent, solids.conducting))
    planes = torch.cat([normal, dot(normal, corners[:, 0])[:, None] / facets.size], 1)
    if not len(metal):
        return
    tree = KDTree(torch.cat([planes[metal], -planes[metal]]))
    near = tree.query_ball_point(planes[own], _CONTACT_TOLERANCE)
    low, high = corners.amin(1), corners.amax(1)
    for facet, others in zip(own.tolist(), near, strict=True):
        other = metal[torch.tensor(others, dtype=torch.int64) % len(metal)]
        gap = torch.maximum(low[other] - high[facet], low[facet] - high[other])
        # Neighbours that share a side in one plane do not cover each other.
        over = (gap < _CONTACT_TOLERANCE * facets.size).all(1) & (
            (gap < -_CONTACT_TOLERANCE * facets.size).sum(1) > 1
        )
        if bool(over.any()):
            names = [solids.names[int(solids.owner[n])] for n in (facet, other[over][0])]
            raise InputError(
                f"expected conductors that do not touch {names[0]} in a scene of more than 24 "
                f"triangles, got {names[1]} in the plane of one of its faces; sink it into "
                f"{names[0]} by a thousandth of a wavelength, or use at most 24 triangles"
            )
