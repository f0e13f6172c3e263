"""Ray tubes inside dielectric bodies (shooting and bouncing rays), with rays at their corners.

A tube starts as an illuminated piece of a face. Its three corner rays are refracted with
interpolated normals, so that adjacent tubes stay adjacent behind curved faces: a tube's field
follows from its power and its cross section, and its phase is linear between its corners. Behind
flat faces that is a plane wave.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams import beam_tracing
from invertwin.channel.beams.beam_tracing import Facets, IlluminatedPatches
from invertwin.channel.em import plane_waves
from invertwin.channel.em.dielectric_solids import DielectricSolids
from invertwin.channel.em.plane_waves import area_vector, cross, dot, interpolate_vectors
from invertwin.channel.rays.ray_scene import Occluders, find_next_surface
from invertwin.channel.rcs import shooting_bouncing_rays as sbr
from invertwin.channel.rows import Rows, concatenate_rows
from invertwin.errors import InputError
from invertwin.scene.material.fresnel import refractive_index
from invertwin.scene.mesh_topology import label_components

MAX_SMOOTH_ANGLE = 0.35
"""Angle between normals of adjacent triangles [rad], above which their edge is sharp."""
_MAX_LAUNCH_RATIO = 4.0  # times the least width, over √ε: wider tubes are split at curved faces
_MIN_TUBE_AREA = 1e-14  # of the scene's size squared: smaller tubes are dropped
_MIN_COSINE = 1e-6  # cosine of rays at grazing incidence
_CONTACT_TOLERANCE = 1e-6  # of the scene's size, and of a normal: equal planes
_RETRIES = 2  # of a ray that hits a surface from the wrong side


@dataclass(frozen=True)
class SmoothFaces:
    """Smooth faces approximated by facets.

    Attributes:
        facets: facets of all triangles.
        face: number of the smooth face of each facet.
        normals: unit normals of the smooth face at the facets' corners.
    """

    facets: Facets
    face: Int64[Tensor, " facet"]
    normals: Float64[Tensor, "facet 3 3"]

    def normals_at(
        self, facet: Int64[Tensor, "row n"], points: Float64[Tensor, "row n 3"], directions: Tensor
    ) -> Float64[Tensor, "row n 3"]:
        """Return interpolated normals at points, towards the origin of rays.

        Args:
            facet: facet of each point.
            points: points on the facets [m].
            directions: unit directions of the rays, [row, n or 1, 3].
        """
        found = interpolate_vectors(self.normals[facet], self.facets.corners[facet], points)
        side = -dot(self.facets.normal[facet], directions).sign()
        return normalize(side[..., None] * found, dim=2)


def group_smooth_faces(facets: Facets, edge_faces: Int64[Tensor, "edge k"]) -> SmoothFaces:
    """Group facets to smooth faces, with angle-weighted vertex normals.

    Args:
        facets: facets of all triangles.
        edge_faces: triangles at each edge; −1 = none.
    """
    corners, normal = facets.corners.detach(), facets.normal.detach()
    pairs = edge_faces[:, :2]
    pairs = pairs[(pairs >= 0).all(1)]
    is_smooth = dot(normal[pairs[:, 0]], normal[pairs[:, 1]]) > math.cos(MAX_SMOOTH_ANGLE)
    face = torch.from_numpy(label_components(pairs[is_smooth].numpy(), len(normal)))
    rounded = torch.round(corners.reshape(-1, 3) / (1e-9 * facets.size))
    keys = torch.cat([face.repeat_interleave(3)[:, None].double(), rounded], 1)
    _, vertex = keys.unique(dim=0, return_inverse=True)
    a, b = (corners.roll(-n, 1) - corners for n in (1, 2))
    angle = torch.atan2(cross(a, b).norm(dim=2), dot(a, b))
    weighted = (angle[..., None] * normal[:, None]).reshape(-1, 3)
    total = torch.zeros(int(vertex.max()) + 1, 3, dtype=torch.float64)
    total = normalize(total.index_add(0, vertex, weighted), dim=1)[vertex].view(-1, 3, 3)
    # The tip of a face has no normal.
    is_valid = dot(total, normal[:, None]) > math.cos(MAX_SMOOTH_ANGLE)
    return SmoothFaces(facets, face, torch.where(is_valid[..., None], total, normal[:, None]))


@dataclass(frozen=True)
class _RayTubes(Rows):
    """Ray tubes at surfaces, with values at their three corners.

    Attributes:
        patch: number of the patch at the end of each tube.
        corners: intersections of the rays with the surface [m].
        directions: unit directions of arrival.
        normals: unit normals of the surface, towards the source.
        phases: optical lengths Σ √ε × length of the rays, from the plane of phase zero [m].
        area: cross section A [m²], by which a tube of field E carries √ε|E|²A.
        from_outside: mask of waves in air, whose reflections are traced elsewhere.
    """

    patch: Int64[Tensor, " patch"]
    corners: Float64[Tensor, "row 3 3"]
    directions: Float64[Tensor, "row 3 3"]
    normals: Float64[Tensor, "row 3 3"]
    phases: Complex128[Tensor, "row 3"]
    area: Float64[Tensor, " patch"]
    from_outside: Bool[Tensor, " patch"]


def trace_inner_tubes(
    surface: SmoothFaces,
    occluders: Occluders,
    solids: DielectricSolids,
    outer_orders: Sequence[IlluminatedPatches],
    min_tube_width: float,
    depth: int,
) -> list[IlluminatedPatches]:
    """Trace ray tubes through dielectric solids; returns patches of all orders, outer ones first.

    Directions follow the real part of √ε, phases and losses √ε along the ray, which holds for small
    losses per wavelength.

    Args:
        surface: smooth faces of the triangles.
        occluders: ray scene of the triangles.
        solids: dielectric solids.
        outer_orders: patches of waves that have stayed outside, per order.
        min_tube_width: width below which tubes are not split between faces [m].
        depth: maximum number of interactions.

    Raises:
        InputError: a dielectric within another one, or in contact with it.

    Source: derivations §13; Deschamps, "Ray techniques in electromagnetics", Proc. IEEE 60, 1972,
    for the spreading of tubes and their phase shift at caustics.
    """
    found: list[IlluminatedPatches] = []
    tubes: _RayTubes | None = None
    for order in range(depth):
        parts, begun = [], []
        if order < len(outer_orders):
            outer = outer_orders[order]
            parts.append(outer.to_complex())
            begun.append(_launch_inner_tubes(surface, solids, outer, min_tube_width))
        if tubes is not None:
            last = found[-1]
            inner, tubes = _trace_tubes(surface, occluders, solids, last, tubes, min_tube_width)
            if parts:
                tubes = replace(tubes, patch=tubes.patch + len(parts[0].aspect))
            parts.append(inner)
            begun.append(tubes)
        found.append(beam_tracing.concatenate_patches(parts))
        tubes = concatenate_rows(begun)
        if not len(found[-1].aspect):
            return found[:-1]
    return found


def _launch_inner_tubes(
    surface: SmoothFaces,
    solids: DielectricSolids,
    patches: IlluminatedPatches,
    min_tube_width: float,
) -> _RayTubes:
    """Launch tubes of waves in air into solids, in narrow pieces where the surface is curved."""
    row = torch.nonzero(solids.transparent[patches.facet])[:, 0]
    own = patches.select(row)
    inside = solids.permittivity[solids.owner[own.facet]]
    width = _MAX_LAUNCH_RATIO * min_tube_width / refractive_index(inside)[:, None]

    def normals_at(piece: Tensor, points: Tensor) -> Tensor:
        facet = own.facet[piece, None].expand(-1, 3)
        return surface.normals_at(facet, points, own.direction[piece, None])

    def is_wide(piece: Tensor, corners: Tensor) -> Tensor:
        """Mask of wide pieces, across the direction in which the normal does not turn."""
        sides, turns = (x.roll(-1, 1) - x for x in (corners, normals_at(piece, corners)))
        extent = dot(sides, turns).abs() - width[piece] * turns.norm(dim=2)
        return (extent > _MIN_COSINE * width[piece]).any(1)

    piece, corners = sbr.split_large_triangles(own.polygon, is_wide)
    d = own.direction[piece, None]
    phases = (dot(corners, d) + own.phase_offset[piece, None]).to(torch.complex128)
    area = dot(area_vector(corners), d[:, 0]).abs()
    waves = d.expand(-1, 3, 3), normals_at(piece, corners), phases, area
    return _RayTubes(row[piece], corners, *waves, torch.ones_like(piece, dtype=torch.bool))


def _continue_tubes(
    solids: DielectricSolids, previous: IlluminatedPatches, tubes: _RayTubes
) -> tuple[IlluminatedPatches, _RayTubes]:
    """Continue tubes by reflection, followed by transmission, with the patch that each leaves."""
    patches = previous.select(tubes.patch)
    again = torch.nonzero(~tubes.from_outside)[:, 0]
    behind = solids.medium_behind(patches.facet, patches.medium)
    inside, outside = (
        refractive_index(solids.permittivity_in(m)) for m in (patches.medium, behind)
    )
    cosine = -dot(tubes.normals, tubes.directions)
    ratio = (inside / outside)[:, None]
    square = 1 - ratio**2 * (1 - cosine**2)
    factor = ratio * cosine - square.clamp_min(0).sqrt()
    directions = ratio[..., None] * tubes.directions + factor[..., None] * tubes.normals
    propagates = (square > 0).all(1) & (cosine > _MIN_COSINE).all(1)
    propagates = torch.nonzero(propagates & solids.transparent[patches.facet])[:, 0]
    row = torch.cat([again, propagates])
    transmitted = torch.arange(len(row)) >= len(again)
    mirror = plane_waves.reflect_vectors(tubes.directions, tubes.normals)[again]
    directions = normalize(torch.cat([mirror, directions[propagates]]), dim=2)
    # Refraction changes the cross section as Fresnel's equations assume, at the patch's normal.
    cosine = -dot(patches.normal, patches.direction)
    widening = (1 - ratio[:, 0] ** 2 * (1 - cosine**2)).clamp_min(0).sqrt() / cosine
    area = tubes.area[row] * torch.where(transmitted, widening[row], 1.0)
    left = patches.select(row)
    medium = torch.where(transmitted, behind[row], left.medium)
    normal = torch.where(transmitted[:, None], -left.normal, left.normal)
    left = replace(left, medium=medium, normal=normal, transmitted=transmitted)
    return left, replace(tubes.select(row), directions=directions, area=area)


def _trace_tubes(
    surface: SmoothFaces,
    occluders: Occluders,
    solids: DielectricSolids,
    previous: IlluminatedPatches,
    tubes: _RayTubes,
    min_tube_width: float,
) -> tuple[IlluminatedPatches, _RayTubes]:
    """Trace tubes to their next surface, split so that each piece sees one smooth face."""
    facets = surface.facets
    left, departing = _continue_tubes(solids, previous, tubes)
    keep = _has_area(facets, departing.corners)
    left, departing = left.select(keep), departing.select(keep)

    def directions_at(row: Tensor, points: Tensor) -> Tensor:
        directions, corners = departing.directions[row], departing.corners[row]
        return normalize(interpolate_vectors(directions[:, None], corners[:, None], points), dim=2)

    def hit_facets(row: Tensor, points: Tensor) -> Tensor:
        shape, many = points.shape[:2], row.repeat_interleave(points.shape[1])
        starts = (points + sbr.ray_offset(facets, left.normal[row])[:, None]).flatten(0, 1)
        medium, ways = left.medium[many], directions_at(row, points).flatten(0, 1)
        return _find_first_facets(facets, occluders, solids, medium, starts, ways).view(shape)

    def visible_faces(row: Tensor, points: Tensor) -> Tensor:
        found = hit_facets(row, points)
        return torch.where(found >= 0, surface.face[found.clamp_min(0)], -1)

    def is_narrow(_: Tensor, pieces: Tensor) -> Tensor:
        return (pieces.roll(-1, 1) - pieces).norm(dim=2).amax(1) <= min_tube_width

    row, corners, face = sbr.subdivide_triangles(departing.corners, visible_faces, is_narrow)
    keep = (face >= 0) & _has_area(facets, corners)
    row, corners, face = row[keep], corners[keep], face[keep]
    hit = hit_facets(row, sbr.inset_points(corners))
    is_other_face = (hit < 0) | (surface.face[hit.clamp_min(0)] != face[:, None])
    # A split piece sees its face at least from its centre.
    is_valid = (~is_other_face).any(1)
    fallback = hit.gather(1, (~is_other_face).int().argmax(1, keepdim=True))
    facet = torch.where(is_other_face, fallback, hit)[is_valid]
    row, corners = row[is_valid], corners[is_valid]
    return _terminate_tubes(surface, solids, left, departing, row, corners, facet)


def _find_first_facets(
    facets: Facets,
    occluders: Occluders,
    solids: DielectricSolids,
    medium: Tensor,
    origins: Tensor,
    directions: Tensor,
) -> Tensor:
    """First facets that rays in a medium can hit (−1: none)."""
    far = 3 * facets.size
    found, along = find_next_surface(occluders, origins, origins + far * directions)

    def is_wrong_side() -> Tensor:
        """Mask of hits from the wrong side, at chords of curved faces."""
        facet = found.clamp_min(0)
        within, facing = medium == solids.owner[facet], dot(facets.normal[facet], directions)
        return (found >= 0) & facets.solid[facet] & (within != (facing > 0))

    for _ in range(_RETRIES):
        row = torch.nonzero(is_wrong_side())[:, 0]
        if not len(row):
            break
        d = directions[row]
        beyond = (along[row] * far)[:, None] * d + 2 * sbr.ray_offset(facets, d)
        origins = origins.index_copy(0, row, origins[row] + beyond)
        again, length = find_next_surface(occluders, origins[row], origins[row] + far * d)
        found, along = found.index_copy(0, row, again), along.index_copy(0, row, length)
    return torch.where(is_wrong_side(), -1, found)


def _terminate_tubes(
    surface: SmoothFaces,
    solids: DielectricSolids,
    left: IlluminatedPatches,
    departing: _RayTubes,
    row: Tensor,
    corners: Tensor,
    facet: Tensor,
) -> tuple[IlluminatedPatches, _RayTubes]:
    """Build the patches at the ends of tubes; ``facet`` at the centre, and at each corner."""
    facets, start = surface.facets, departing.corners[row]
    weights = plane_waves.barycentric_coordinates(start[:, None], corners)
    directions = normalize((weights[..., None] * departing.directions[row][:, None]).sum(2), dim=2)
    index = solids.permittivity_in(left.medium[row]).sqrt()
    # The phase is quadratic between corners of known slope.
    slopes = dot(departing.directions[row][:, None], corners[:, :, None] - start[:, None])
    phases = (weights * (departing.phases[row][:, None] + index[:, None, None] * slopes / 2)).sum(2)
    corner_facets = facet[:, 1:]
    facing = dot(facets.normal[corner_facets], directions)
    length = dot(facets.normal[corner_facets], facets.corners[corner_facets, 0] - corners) / facing
    ends = corners + length[..., None] * directions
    phases = phases + index[:, None] * length
    keep = (facing.abs() > _MIN_COSINE).all(1) & (length > -1e-6 * facets.size).all(1)
    keep &= _has_area(facets, ends)
    row, corners, ends, directions, phases, facet, index = (
        x[keep] for x in (row, corners, ends, directions, phases, facet, index)
    )
    direction = normalize(directions.sum(1), dim=1)
    middle = facet[:, 0]
    normals = surface.normals_at(facet[:, 1:], ends, directions)
    normal = normalize(normals.sum(1), dim=1)
    is_valid = (dot(normal, direction) < -_MIN_COSINE) & (dot(normals, directions) < 0).all(1)
    wave_vector = _fit_wave_vector(index[:, None] * direction, ends, phases)
    whole, piece = (area_vector(x).norm(dim=1) for x in (departing.corners[row], corners))
    before = departing.area[row] * piece / whole
    # A focus of all that the scene may gather is at least half a wavelength in the medium wide.
    focus = (math.pi / (solids.wave_number * facets.size * index.real)).clamp_max(1)
    spreading, area = _spreading_factor(direction, normal, before, before * focus**2, corners, ends)
    patches = replace(
        left.select(row),
        facet=middle,
        normal=normal,
        direction=direction,
        phase_offset=phases[:, 0] - dot(wave_vector, ends[:, 0]),
        polygon=ends,
        parent=departing.patch[row],
        wave_vector=wave_vector,
        spreading=spreading,
    )
    keep = is_valid & beam_tracing.exceeds_min_amplitude(patches, solids.wave_number)
    solids.require_gaps(patches.facet[keep], patches.medium[keep])
    number = torch.arange(int(keep.sum()))
    fresh = torch.zeros_like(number, dtype=torch.bool)
    tubes = _RayTubes(
        number, ends[keep], directions[keep], normals[keep], phases[keep], area[keep], fresh
    )
    return patches.select(keep), tubes


def _fit_wave_vector(wave_vector: Tensor, corners: Tensor, phases: Tensor) -> Tensor:
    """Correct K in the plane of three corners to match the phase differences there."""
    first, second = ((corners[:, n] - corners[:, 0]) for n in (1, 2))
    normal = cross(first, second)
    short = phases[:, 1] - phases[:, 0] - dot(wave_vector, first)
    long = phases[:, 2] - phases[:, 0] - dot(wave_vector, second)
    slope = short[:, None] * cross(second, normal) + long[:, None] * cross(normal, first)
    return wave_vector + slope / dot(normal, normal)[:, None]


def _spreading_factor(
    direction: Float64[Tensor, "row 3"],
    normal: Float64[Tensor, "row 3"],
    before: Float64[Tensor, " row"],
    least: Float64[Tensor, " row"],
    start: Float64[Tensor, "row 3 3"],
    end: Float64[Tensor, "row 3 3"],
) -> tuple[Complex128[Tensor, " row"], Float64[Tensor, " row"]]:
    """Spreading factor √(A/A′) of tubes, times j for each caustic line, and cross section A′ [m²].

    Args:
        direction: unit direction of each tube.
        normal: unit normal of the smooth surface at the end.
        before: cross section A [m²].
        least: least A′ [m²]: at a focus the field is finite.
        start, end: triangles at both ends [m].
    """
    section = area_vector(end)
    # A facet that is more oblique than the smooth surface is larger than the tube's footprint.
    oblique = section.norm(dim=1) * dot(normal, direction).abs()
    area = torch.maximum(dot(section, direction).abs(), oblique).maximum(least)
    first = plane_waves.orthogonal_unit_vectors(direction)
    axes = torch.stack([first, cross(direction, first)], 1)
    # One caustic where the determinant is negative, two where both eigenvalues are.
    turn, _ = torch.linalg.solve_ex(*((x[:, 1:] - x[:, :1]) @ axes.mT for x in (start, end)))
    trace = turn[:, 0, 0] + turn[:, 1, 1]
    caustics = torch.where(torch.linalg.det(turn) < 0, 1, torch.where(trace < 0, 2, 0))
    quarter = torch.tensor([1.0, 1j, -1.0], dtype=torch.complex128)[caustics]
    return (before / area).sqrt() * quarter, area


def _has_area(facets: Facets, corners: Float64[Tensor, "row 3 3"]) -> Bool[Tensor, " row"]:
    """Mask of triangles with an area."""
    a, b, c = corners.unbind(1)
    return cross(b - a, c - a).norm(dim=1) > _MIN_TUBE_AREA * facets.size**2


def require_separate_conductors(facets: Facets, solids: DielectricSolids) -> None:
    """Raise an error for conductors coplanar with a face of a solid, which rays cannot separate.

    Args:
        facets: facets of all triangles.
        solids: dielectric solids.

    Raises:
        InputError: a conductor in the plane of a face.
    """
    corners, normal = facets.corners.detach(), facets.normal.detach()
    own, metal = (torch.nonzero(some)[:, 0] for some in (solids.transparent, solids.conducting))
    planes = torch.cat([normal, dot(normal, corners[:, 0])[:, None] / facets.size], 1)
    if not len(metal):
        return
    tree = KDTree(torch.cat([planes[metal], -planes[metal]]))
    candidates = tree.query_ball_point(planes[own], _CONTACT_TOLERANCE)
    low, high = corners.amin(1), corners.amax(1)
    for facet, others in zip(own.tolist(), candidates, strict=True):
        other = metal[torch.tensor(others, dtype=torch.int64) % len(metal)]
        gap = torch.maximum(low[other] - high[facet], low[facet] - high[other])
        # Coplanar neighbours with a common side do not overlap.
        overlaps = (gap < _CONTACT_TOLERANCE * facets.size).all(1)
        overlaps &= (gap < -_CONTACT_TOLERANCE * facets.size).sum(1) > 1
        if bool(overlaps.any()):
            names = [solids.names[int(solids.owner[n])] for n in (facet, other[overlaps][0])]
            raise InputError(
                f"expected conductors that do not touch {names[0]} in a scene of more than 24 "
                f"triangles, got {names[1]} in the plane of one of its faces; sink it into "
                f"{names[0]} by a thousandth of a wavelength, or use at most 24 triangles"
            )
