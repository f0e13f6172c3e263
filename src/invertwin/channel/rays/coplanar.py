"""Visible coplanar surfaces: rounding decides which of them a ray meets."""

import warnings
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import barycentric_coordinates, triangle_normals
from invertwin.channel.rays import ray_scene
from invertwin.channel.rays.intersections import find_overlapping_boxes
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.channel.rows import bound_groups
from invertwin.checks import strip_derivatives
from invertwin.errors import InputError, PhysicsWarning

_ObjectPairs = Bool[Tensor, "object object"]
_MAX_PAIRS = 20_000  # most coplanar pairs of triangles that are compared, evenly chosen
_MAX_POINTS = 64  # most tested points of a pair of objects
_MAX_POSES = 16  # most tested radar poses
_MIN_BARYCENTRIC = 1e-6  # least barycentric coordinate: what only touches does not overlap
_MAX_PLANE_SINE = 1e-3  # largest sine of the angle between planes that are one
#: Barycentric coordinates of a triangle's centre, and of points just within corners and sides.
_TEST_POINTS = torch.tensor(
    [
        [1 / 3, 1 / 3, 1 / 3],
        *([0.98 if k == j else 0.01 for k in range(3)] for j in range(3)),
        *([0.02 if k == j else 0.49 for k in range(3)] for j in range(3)),
    ],
    dtype=torch.float64,
)


def warn_coplanar_surfaces(rays: ray_scene.RayScene) -> None:
    """Warn of coplanar surfaces of two objects that an antenna sees, unless they are equivalent.

    They are if both objects are at rest and of one material. Hidden surfaces, as the underside of a
    box on a floor, do not count.

    Args:
        rays: ray scene.
    """
    geometry = rays.geometry
    for one, other in sorted(_find_coplanar_pairs(rays, _relevant_pairs(geometry))):
        warnings.warn(
            f"{geometry.names[one]} and {geometry.names[other]} lie in one plane, in a place that "
            "an antenna sees: which of them a ray meets there is left to rounding, so that values "
            "and derivatives mean nothing there; lift one of them off the other, or cut a hole",
            PhysicsWarning,
            stacklevel=2,
        )


def refuse_coplanar_surfaces(
    rays: ray_scene.Occluders,
    vertices: Float64[Tensor, "v 3"],
    viewers: Float64[Tensor, "n 3"],
    names: Sequence[str],
) -> None:
    """Raise an error for coplanar surfaces of two objects that are seen, where both would count.

    Args:
        rays: occluders.
        vertices: world positions [m].
        viewers: positions from where surfaces are seen [m].
        names: names of the objects.

    Raises:
        InputError: such surfaces.
    """
    pairs = ~torch.eye(len(names), dtype=torch.bool)
    sheets = torch.zeros(len(rays.topology.faces), dtype=torch.bool)
    given = strip_derivatives(vertices), pairs, viewers, sheets
    for one, other in sorted(_find_seen_pairs(rays, *given)):
        raise InputError(
            f"expected one surface in each place, got {names[one]} and {names[other]} in one "
            "plane, in a place that is seen: both would count; lift one of them off the other, or "
            "cut a hole"
        )


def _find_coplanar_pairs(rays: ray_scene.RayScene, pairs: _ObjectPairs) -> set[tuple[int, int]]:
    """Find pairs of objects with visible coplanar surfaces; cached for unmoved objects."""
    topology, points = rays.topology, rays.geometry.vertices.detach()
    antennas = torch.cat([rays.link.tx.detach(), rays.link.rx.detach()])
    known, remaining = set[tuple[int, int]](), pairs
    if topology.coplanar_cache is not None:
        found, *before = topology.coplanar_cache
        if torch.equal(before[0], pairs) and torch.equal(before[1], antennas):
            moved = torch.zeros(len(pairs), dtype=torch.bool)
            moved[topology.vertex_object[(points != before[2]).any(1)]] = True
            remaining = pairs & (moved[:, None] | moved)
            known = {(one, other) for one, other in found if not bool(remaining[one, other])}
    known |= _find_visible_pairs(rays, remaining) if bool(remaining.any()) else set()
    topology.coplanar_cache = known, pairs, antennas, points
    return known


def _find_visible_pairs(rays: ray_scene.RayScene, pairs: _ObjectPairs) -> set[tuple[int, int]]:
    """Find those of some pairs of objects that are coplanar at a point that an antenna sees."""
    geometry, link, count = rays.geometry, rays.link, rays.poses_per_scene
    looks = torch.arange(0, count, max(1, -(-count // _MAX_POSES)))
    views = [ends.detach().unflatten(0, (-1, count))[:, looks] for ends in (link.tx, link.rx)]
    # Derivatives are wrong in a contact that is seen through sheets, such as below a box of them.
    sheets = geometry.surfaces.transmittance.any(1) & any(geometry.differentiated)
    given = geometry.vertices.detach(), pairs, torch.cat(views, 1), sheets[geometry.face_surface]
    return _find_seen_pairs(rays, *given, geometry.object_scene)


def _find_seen_pairs(
    rays: ray_scene.Occluders,
    vertices: Float64[Tensor, "v 3"],
    pairs: _ObjectPairs,
    viewers: Float64[Tensor, "*scene n 3"],
    sheets: Bool[Tensor, " face"],
    object_scene: Int64[Tensor, " object"] | None = None,
) -> set[tuple[int, int]]:
    """Find those of some pairs of objects that are coplanar at a point that a viewer sees."""
    topology, found = rays.topology, set[tuple[int, int]]()
    pairs, low, high = find_overlapping_boxes(topology, vertices, pairs)
    points = vertices - rays.origin
    triangles, owner = points[topology.faces], topology.face_object
    low, high = ((bound - rays.origin)[owner] for bound in (low, high))
    near = (triangles.amin(1) <= high) & (triangles.amax(1) >= low)
    faces = near.all(1).nonzero()[:, 0]
    if not len(faces):
        return found
    first, second = _pair_coplanar_triangles(triangles[faces], owner[faces])
    first, second = faces[first], faces[second]
    kept = pairs[owner[first], owner[second]]
    first, second = first[kept], second[kept]
    face, place, normal = _find_common_points(triangles, first, second)
    couple = torch.stack([owner[first], owner[second]], 1).sort(1).values[face]
    for one, other in couple.unique(dim=0).tolist():
        here = ((couple[:, 0] == one) & (couple[:, 1] == other)).nonzero()[:, 0]
        here = here[:: -(-len(here) // _MAX_POINTS)]
        views = viewers if object_scene is None else viewers[object_scene[one]]
        if _is_any_visible(rays, place[here], normal[here], views.reshape(-1, 3), sheets):
            found.add((one, other))
    return found


def _relevant_pairs(geometry: Geometry) -> _ObjectPairs:
    """Find pairs of objects of which one moves, or whose materials differ."""
    rows = geometry.face_surface[:, None]
    bounds = bound_groups(geometry.face_object, rows, len(geometry.names))
    lowest, highest = bounds[0][:, 0], bounds[1][:, 0]
    moving = torch.tensor(geometry.differentiated)
    pairs = moving[:, None] | moving
    pairs |= (lowest[:, None] != lowest) | (lowest != highest)[:, None] | (lowest != highest)
    return pairs.fill_diagonal_(False)


def _ray_tolerance(points: Float64[Tensor, "*n 3"]) -> Float64[Tensor, "*n"]:
    """Compute the distance [m] within which rays do not separate surfaces."""
    return ray_scene.RAY_EPSILON * points.norm(dim=-1) + 1e-9


def _pair_coplanar_triangles(triangles: Tensor, owners: Tensor) -> tuple[Tensor, Tensor]:
    """Pair triangles whose planes have the same distance from the origin, on the same side."""
    normal = triangle_normals(triangles)
    largest = normal.gather(1, normal.abs().argmax(1, keepdim=True))
    away = (normal * triangles[:, 0]).sum(1) * largest[:, 0].sign()
    most = _ray_tolerance(triangles).max()
    away, order = away.sort()
    near = _has_near_neighbour(away, owners[order], most)
    away, order = away[near], order[near]
    counts = torch.searchsorted(away, away + most, right=True) - torch.arange(len(away)) - 1
    total, sums = int(counts.sum()), counts.cumsum(0)
    chosen = torch.arange(0, total, max(1, -(-total // _MAX_PAIRS)))
    first = torch.searchsorted(sums, chosen, right=True)
    return order[first], order[first + 1 + chosen - (sums - counts)[first]]


def _has_near_neighbour(offsets: Tensor, owner: Tensor, max_distance: Tensor) -> Tensor:
    """Find the sorted numbers with one of another owner within reach."""
    change = (owner[1:] != owner[:-1]).nonzero()[:, 0]  # the last number of every run
    if not len(change):
        return torch.zeros(len(offsets), dtype=torch.bool)
    run = torch.searchsorted(change, torch.arange(len(offsets)))
    after = (run < len(change)) & (
        offsets[change[run.clamp_max(len(change) - 1)] + 1] - offsets <= max_distance
    )
    return after | (run > 0) & (offsets - offsets[change[(run - 1).clamp_min(0)]] <= max_distance)


def _find_common_points(
    triangles: Float64[Tensor, "f 3 3"], first: Int64[Tensor, " n"], second: Int64[Tensor, " n"]
) -> tuple[Int64[Tensor, " m"], Float64[Tensor, "m 3"], Float64[Tensor, "m 3"]]:
    """Find common points of pairs of triangles: number of the pair, point and normal."""
    parts = []
    normals = [triangle_normals(triangles[face]) for face in (first, second)]
    alike = torch.linalg.cross(*normals).norm(dim=1) < _MAX_PLANE_SINE
    for own, other, normal in ((first, second, normals[1]), (second, first, normals[0])):
        places = (_TEST_POINTS[:, :, None] * triangles[own][:, None]).sum(2)  # [n, 7, 3]
        corners = triangles[other][:, None]
        height = ((places - corners[:, :, 0]) * normal[:, None]).sum(2)
        inside = barycentric_coordinates(corners, places).amin(2) > _MIN_BARYCENTRIC
        pair, place = (
            (inside & (height.abs() <= _ray_tolerance(places)) & alike[:, None]).nonzero().T
        )
        parts.append((pair, places[pair, place], normal[pair]))
    pair, place, normal = (torch.cat(column) for column in zip(*parts, strict=True))
    return pair, place, normal


def _is_any_visible(
    rays: ray_scene.Occluders, points: Tensor, normal: Tensor, viewers: Tensor, sheets: Tensor
) -> bool:
    """Test whether a viewer sees any of some points, also through sheets.

    Surfaces in the plane of the points are ignored.
    """
    antennas = viewers - rays.origin
    tilt = (normalize(antennas[:, None] - points, dim=2) * normal).sum(2)
    above = points + normal * (2 * tilt.sign() * _ray_tolerance(points))[..., None]
    clear, ends = tilt.abs() > _MAX_PLANE_SINE, antennas[:, None].expand_as(above)
    start, end = above[clear] + rays.origin, ends[clear] + rays.origin
    return bool(ray_scene.find_passed_sheets(rays, start, end, sheets)[0].any())
