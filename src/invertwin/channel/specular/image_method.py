"""Specular paths by the method of images: which sequences of planes lead from antenna to antenna.

The transmitter is mirrored at plane after plane. From the receiver, straight lines to these images
cut the planes where the path meets them. A path exists if each such point lies on a triangle of its
plane, and nothing lies between the points.

Rays are float32, and may slip through where two triangles meet. So rays only choose: every segment
is tried by four rays a little apart, and where they disagree, float64 decides over all triangles.

Source: derivations §10.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot, orthogonal_unit_vectors, reflect_vectors
from invertwin.channel.rays.arrays import opaque, to_double, to_float, to_index, to_torch
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RAY_EPSILON, Occluders
from invertwin.channel.rays.topology import Topology

_PLANE_TOLERANCE = 1e-5  # radians, and share of the scene's size, within which planes are one


_LANES = 1 << 19
_MAX_PAIRS = 1 << 22  # segments × triangles of the exact test at a time
_RAY_SPREAD = 4.0  # margins between the rays that try a segment
_EXACT_TOLERANCE = 1e-9  # of the scene's size: float64 places closer than this are one


class CandidateSurfaces(Occluders):
    """What may be in the way between antennas, and the planes that mirror.

    Args:
        vertices: World positions, detached [m].
        topology: Their triangles.
        antennas: World positions [m].
    """

    def __init__(
        self,
        vertices: Float64[Tensor, "v 3"],
        topology: Topology,
        antennas: Float64[Tensor, "antenna 3"],
    ) -> None:
        ends = torch.cat([vertices, antennas])
        super().__init__(vertices, topology, (ends.amax(0) + ends.amin(0)) / 2)
        self.exact_vertices = vertices - self.origin
        self.size = float((ends - self.origin).norm(dim=1).max())
        self.margin = RAY_EPSILON * self.size
        self.planes: Planes = find_planes(self.exact_vertices, topology.faces)

    @cached_property
    def device_planes(self) -> dict[str, Any]:
        """The planes, as flat arrays of the ray tracer."""
        planes = self.planes
        vectors = {
            "point": planes.point,
            "normal": planes.normal,
            "first": planes.axes[:, 0],
            "second": planes.axes[:, 1],
        }
        ends = {
            "low0": planes.low[:, 0],
            "low1": planes.low[:, 1],
            "high0": planes.high[:, 0],
            "high1": planes.high[:, 1],
        }
        tables = {name: to_double(value) for name, value in (vectors | ends).items()}
        return tables | {"of_face": to_index(planes.face_plane.clamp_min(0))}

    @cached_property
    def device_rim_widths(self) -> Any:
        """How near to their sides rays may have missed triangles: share of the least height."""
        corners = self.exact_vertices[self.topology.faces]
        sides = corners.roll(-1, 1) - corners
        area = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1)
        height = area / sides.norm(dim=2).amax(1).clamp_min(1e-300)
        return to_float(self.margin / height.clamp_min(1e-300))


@dataclass(frozen=True)
class SpecularPaths:
    """Specular paths of one number of steps, as triangles that they meet; detached.

    Attributes:
        source, target: Numbers of the antennas.
        faces: Triangles, from the source on.
        transmitted: Whether the path goes through them instead of being mirrored.
    """

    source: Int64[Tensor, " path"]
    target: Int64[Tensor, " path"]
    faces: Int64[Tensor, "path step"]
    transmitted: Bool[Tensor, "path step"]

    def reverse(self) -> "SpecularPaths":
        """From target to source."""
        return SpecularPaths(self.target, self.source, self.faces.flip(1), self.transmitted.flip(1))


def image_positions(
    position: Float64[Tensor, "row 3"],
    point: Float64[Tensor, "row step 3"],
    normal: Float64[Tensor, "row step 3"],
    transmitted: Bool[Tensor, "row step"],
) -> list[Float64[Tensor, "row 3"]]:
    """A place, and its images after each step.

    Args:
        place: Of the source.
        point, normal: Of the planes.
        transmitted: Steps that leave the image where it is.
    """
    found = [position]
    for step in range(point.shape[1]):
        n, p = normal[:, step], point[:, step]
        turned = p + reflect_vectors(found[-1] - p, n)
        found.append(torch.where(transmitted[:, step, None], found[-1], turned))
    return found


def interaction_points(
    target: Float64[Tensor, "row 3"],
    images: list[Float64[Tensor, "row 3"]],
    point: Float64[Tensor, "row step 3"],
    normal: Float64[Tensor, "row step 3"],
) -> list[Float64[Tensor, "row 3"]]:
    """Where paths meet the planes, from the source on: back from the target to its images.

    Args:
        target: Places.
        images: From ``images``.
        point, normal: Of the planes.
    """
    found: list[Tensor] = []
    place = target
    for step in reversed(range(point.shape[1])):
        n, way = normal[:, step], images[step + 1] - place
        falls = dot(way, n)
        share = dot(point[:, step] - place, n) / torch.where(
            falls == 0, torch.ones_like(falls), falls
        )
        place = place + share[:, None] * way
        found.insert(0, place)
    return found


def find_paths_between(
    surfaces: CandidateSurfaces,
    steps: Int64[Tensor, "sequence step"],
    source: Float64[Tensor, "3"],
    targets: Float64[Tensor, "target 3"],
    source_index: int,
) -> list[SpecularPaths]:
    """The paths that follow given sequences from one source to all targets.

    Args:
        surfaces: The scene.
        steps: Sequences, see ``sample_rows``.
        source, targets: World positions [m].
        source_index: Of the source.
    """
    own = torch.zeros(len(targets), dtype=torch.int64)
    found = find_paths_from(surfaces, steps, source[None], own, targets)
    return [replace(some, source=torch.full_like(some.source, source_index)) for some in found]


def find_paths_from(
    surfaces: CandidateSurfaces,
    steps: Int64[Tensor, "sequence step"],
    sources: Float64[Tensor, "source 3"],
    source_index: Int64[Tensor, " target"],
    targets: Float64[Tensor, "target 3"],
    target_planes: Int64[Tensor, " target"] | None = None,
) -> list[SpecularPaths]:
    """The paths that follow given sequences to each target from its own source.

    Args:
        surfaces: The scene.
        steps: Sequences, see ``sample_rows``.
        sources, targets: World positions [m].
        source_index: Of the source of each target.
        target_planes: Planes of the scene that targets lie in, −1 where in none; None = none does.
    """
    found: list[SpecularPaths] = []
    for some in steps.split(max(1, _LANES // len(sources))):
        screen = _SequenceScreen(surfaces, some, sources)
        block = max(1, _LANES // len(some))
        for begin in range(0, len(targets), block):
            rows = slice(begin, begin + block)
            target, sequence = screen.select_candidates(targets[rows], source_index[rows])
            target = target + begin
            chosen, source = some[sequence], source_index[target]
            lies = None if target_planes is None else target_planes[target]
            good, faces = find_unobstructed_paths(
                surfaces, chosen, sources[source], targets[target], lies
            )
            through = (chosen[good] & 1).bool()
            found.append(SpecularPaths(source[good], target[good], faces[good], through))
    return found


class _SequenceScreen:
    """Tries all sequences from some sources by one ray a segment, in kernels of many lanes."""

    def __init__(self, surfaces: CandidateSurfaces, steps: Tensor, sources: Tensor) -> None:
        self.surfaces = surfaces
        self.length = steps.shape[1]
        self.count = len(steps)
        planes = surfaces.planes
        place = (sources - surfaces.origin).repeat_interleave(self.count, 0)
        every = steps.repeat(len(sources), 1)
        plane = every >> 1
        seen = image_positions(place, planes.point[plane], planes.normal[plane], (every & 1).bool())
        self.images = to_double(torch.stack(seen, 1))
        self.steps = to_index(steps) if self.length else None

    def select_candidates(self, targets: Tensor, source_index: Tensor) -> tuple[Tensor, Tensor]:
        """Targets and sequences of what may be paths from the sources of these numbers."""
        lane = dr.arange(mi.UInt32, self.count * len(targets))
        count = opaque(self.count)
        target, row = lane // count, lane % count
        places = to_double(targets - self.surfaces.origin)
        end = dr.gather(mi.Vector3d, places, target)
        first = (dr.gather(mi.UInt32, to_index(source_index), target) * count + row) * (
            self.length + 1
        )
        ok, corners, planes, normals = self._intersect_planes(row, first, end)
        good = to_torch(self._is_unobstructed(first, ok, [*corners, end], planes, normals))
        keep = torch.nonzero(good)[:, 0]
        return keep // self.count, keep % self.count

    def _intersect_planes(
        self, row: Any, first: Any, end: Any
    ) -> tuple[Any, list[Any], list[Any], list[Any]]:
        """Where the lines to the images cut the planes, inside of their rectangles."""
        walls, table = self.surfaces, self.surfaces.device_planes
        near = opaque(_EXACT_TOLERANCE * walls.size, "Float64")
        wide = opaque(walls.margin, "Float64")
        ok, place = mi.Bool(True), end
        corners, planes, normals = [], [], []
        for step in reversed(range(self.length)):
            code = dr.gather(mi.UInt32, self.steps, row * self.length + step)
            plane, through = code >> 1, (code & 1) == 1
            point = dr.gather(mi.Vector3d, table["point"], plane)
            normal = dr.gather(mi.Vector3d, table["normal"], plane)
            image = dr.gather(mi.Vector3d, self.images, first + step + 1)
            way = image - place
            falls = dr.dot(way, normal)
            ok &= falls != 0
            share = dr.dot(point - place, normal) / dr.select(falls != 0, falls, 1.0)
            reach = dr.norm(way)
            along = share * reach
            # A receiver on a mirror has a reflection; one on a sheet is not behind it.
            ok &= along > dr.select(through, near, -near)
            ok &= along < reach - near
            place = place + share * way
            for axis, bounds in (("first", "0"), ("second", "1")):
                at = dr.dot(place - point, dr.gather(mi.Vector3d, table[axis], plane))
                ok &= at >= dr.gather(mi.Float64, table["low" + bounds], plane) - wide
                ok &= at <= dr.gather(mi.Float64, table["high" + bounds], plane) + wide
            corners.insert(0, place)
            planes.insert(0, plane)
            normals.insert(0, normal)
        return ok, corners, planes, normals

    def _is_unobstructed(
        self, first: Any, ok: Any, ends: list[Any], planes: list[Any], normals: list[Any]
    ) -> Any:
        """Whether one ray a segment meets nothing, or what it should; seams let rays through.

        What it meets at a triangle's rim is left to the exact test.
        """
        walls = self.surfaces
        margin, scene = opaque(walls.margin, "Float64"), walls.scene
        start = dr.gather(mi.Vector3d, self.images, first)
        for step, end in enumerate(ends):
            way = end - start
            length = dr.norm(way)
            unit = way / dr.maximum(length, 1e-300)
            # Along the way: aside of it, rays would see other edges.
            lift = mi.Float64(0.0)
            if step:
                lift = margin / dr.maximum(dr.abs(dr.dot(unit, normals[step - 1])), 0.1)
            length -= lift
            begin = start + unit * lift
            last = step == self.length
            over = -margin
            if not last:
                over = 2 * margin / dr.maximum(dr.abs(dr.dot(unit, normals[step])), 1e-3)
            far = dr.maximum(length + over, 0.0)
            ray = mi.Ray3f(mi.Point3f(begin), mi.Vector3f(unit), mi.Float(far), 0.0, [])
            hit = scene.ray_intersect_preliminary(ray, active=ok)
            valid = hit.is_valid() & ok
            u, v = hit.prim_uv.x, hit.prim_uv.y
            rim = dr.gather(mi.Float, walls.device_rim_widths, hit.prim_index, valid)
            deep = valid & (dr.minimum(dr.minimum(u, v), 1 - u - v) > rim)
            plane = dr.gather(mi.UInt32, walls.device_planes["of_face"], hit.prim_index, valid)
            if step:
                deep &= plane != planes[step - 1]
            if last:
                return ok & ~deep
            ok &= ~deep | ((plane == planes[step]) & (hit.t > mi.Float(length - over)))
            start = end
        return ok


@dataclass(frozen=True)
class _SpecularSegments:
    """Straight pieces of paths, one row each; planes are −1 at antennas.

    Attributes:
        start, end: [m].
        plane_before, plane: Of the surfaces at start and end.
        target_plane: Planes that the ends of last pieces lie in, else −1.
    """

    start: Tensor
    end: Tensor
    plane_before: Tensor
    plane: Tensor
    target_plane: Tensor


def intersects_planes(
    surfaces: CandidateSurfaces,
    steps: Int64[Tensor, "row step"],
    images: list[Float64[Tensor, "row 3"]],
    target: Float64[Tensor, "row 3"],
) -> Bool[Tensor, " row"]:
    """Whether lines to the images cut the planes inside of their rectangles, in the right order.

    Args:
        surfaces: The scene.
        steps: Sequences, see ``sample_rows``.
        images: From ``images``, about the scene's origin.
        target: Places about it.
    """
    planes, place = surfaces.planes, target
    near = _EXACT_TOLERANCE * surfaces.size
    ok = torch.ones(len(target), dtype=torch.bool)
    for step in reversed(range(steps.shape[1])):
        plane, through = steps[:, step] >> 1, (steps[:, step] & 1).bool()
        point, normal, way = planes.point[plane], planes.normal[plane], images[step + 1] - place
        falls = dot(way, normal)
        ok &= falls != 0
        share = dot(point - place, normal) / torch.where(falls == 0, torch.ones_like(falls), falls)
        reach = way.norm(dim=1)
        # A receiver on a mirror has a reflection; one on a sheet is not behind it.
        ok &= share * reach > torch.where(through, near, -near)
        ok &= share * reach < reach - near
        place = place + share[:, None] * way
        at = torch.einsum("rx,rax->ra", place - point, planes.axes[plane])
        ok &= (at >= planes.low[plane] - surfaces.margin).all(1)
        ok &= (at <= planes.high[plane] + surfaces.margin).all(1)
    return ok


def find_unobstructed_paths(
    surfaces: CandidateSurfaces,
    steps: Int64[Tensor, "row step"],
    source: Float64[Tensor, "row 3"],
    targets: Float64[Tensor, "row 3"],
    target_planes: Int64[Tensor, " row"] | None = None,
) -> tuple[Bool[Tensor, " row"], Int64[Tensor, "row step"]]:
    """Which ways by given planes are free, and the triangles that they meet.

    Args:
        surfaces: The scene.
        steps: Sequences, see ``sample_rows``.
        source, targets: World positions [m].
        target_planes: Planes of the scene that targets lie in, −1 where in none; None = none does.
    """
    count, length = steps.shape
    if not count:
        return torch.zeros(0, dtype=torch.bool), torch.zeros_like(steps)
    planes, plane = surfaces.planes, steps >> 1
    point, normal = planes.point[plane], planes.normal[plane]
    place, target = source - surfaces.origin, targets - surfaces.origin
    seen = image_positions(place, point, normal, (steps & 1).bool())
    nodes = torch.stack([place, *interaction_points(target, seen, point, normal), target], 1)
    none = torch.full((count, 1), -1)
    before, after = torch.cat([none, plane], 1), torch.cat([plane, none], 1)
    lies = none if target_planes is None else target_planes[:, None]
    last = torch.cat([torch.full_like(plane, -1), lies], 1)
    starts, ends = nodes[:, :-1].reshape(-1, 3), nodes[:, 1:].reshape(-1, 3)
    pieces = _SpecularSegments(starts, ends, before.ravel(), after.ravel(), last.ravel())
    met, good = _test_segments(surfaces, pieces)
    met, good = met.view(count, length + 1), good.view(count, length + 1)
    apart = (target - seen[-1]).norm(dim=1) > _EXACT_TOLERANCE * surfaces.size
    return good.all(1) & apart, met[:, :length]


def _test_segments(
    surfaces: CandidateSurfaces, segments: _SpecularSegments
) -> tuple[Tensor, Tensor]:
    """The triangle at the end of each segment, and whether the segment exists."""
    way = segments.end - segments.start
    unit = normalize(way, dim=1)
    first = orthogonal_unit_vectors(unit)
    second = cross(unit, first)
    votes = torch.zeros(len(unit), dtype=torch.int64)
    met = torch.full_like(votes, -1)
    for number in range(4):  # the last one goes straight
        angle = torch.tensor(2.1 * number, dtype=torch.float64)
        aside = _RAY_SPREAD * surfaces.margin * (angle.cos() * first + angle.sin() * second)
        if number == 3:
            aside = torch.zeros_like(aside)
        start = segments.start + _shift_in_plane(surfaces, aside, unit, segments.plane_before)
        end = segments.end + _shift_in_plane(
            surfaces, aside, unit, torch.maximum(segments.plane, segments.target_plane)
        )
        face = _cast_rays(surfaces, start, end, segments)
        good = torch.where(segments.plane >= 0, face >= 0, face == -1)
        votes += good
        met = face
    unsure = torch.nonzero((votes > 0) & (votes < 4))[:, 0]
    good = votes == 4
    if len(unsure):
        rows = _SpecularSegments(*(column[unsure] for column in vars(segments).values()))
        good[unsure], met[unsure] = _test_exactly(surfaces, rows)
    return met, good


def _shift_in_plane(
    surfaces: CandidateSurfaces, offset: Tensor, direction: Tensor, plane: Tensor
) -> Tensor:
    """A step aside, prolonged along the segment to stay in the plane at its end."""
    normal = surfaces.planes.normal[plane.clamp_min(0)]
    falls = dot(direction, normal)
    steep = (plane >= 0) & (falls.abs() > 0.02)
    share = torch.where(steep, dot(offset, normal) / torch.where(steep, falls, 1.0), 0.0)
    return offset - share[:, None] * direction


def _cast_rays(
    surfaces: CandidateSurfaces, start: Tensor, end: Tensor, segments: _SpecularSegments
) -> Tensor:
    """Triangle of the right plane at each segment's end; −1 nothing met, −2 something else met."""
    planes, margin = surfaces.planes, surfaces.margin
    way = end - start
    length = way.norm(dim=1)
    unit = normalize(way, dim=1)
    before = planes.normal[segments.plane_before.clamp_min(0)]
    lift = torch.where(segments.plane_before >= 0, margin * dot(unit, before).sign(), 0.0)
    held = torch.maximum(segments.plane, segments.target_plane)
    over = 2 * margin / dot(unit, planes.normal[held.clamp_min(0)]).abs().clamp_min(1e-3)
    over = torch.where(segments.plane >= 0, over, torch.where(held >= 0, -over, -margin))
    begin = (start + lift[:, None] * before).to(torch.float32)
    origin = _mitsuba_vector(mi.Point3f, begin)
    direction = _mitsuba_vector(mi.Vector3f, unit.to(torch.float32))
    far = mi.Float(to_double((length + over).clamp_min(0.0)))
    hit = surfaces.scene.ray_intersect_preliminary(mi.Ray3f(origin, direction, far, 0.0, []))
    valid = hit.is_valid()
    face = to_torch(dr.select(valid, mi.Int32(hit.prim_index), -1)).long()
    distance = to_torch(dr.select(valid, hit.t, 0.0)).double()
    there = (face >= 0) & (planes.face_plane[face.clamp_min(0)] == segments.plane)
    there &= distance > length - over
    return torch.where(there | (face < 0), face, -2)


def _mitsuba_vector(kind: Any, values: Tensor) -> Any:
    return kind(*(to_float(values[:, k]) for k in range(3)))


def _test_exactly(
    surfaces: CandidateSurfaces, segments: _SpecularSegments
) -> tuple[Tensor, Tensor]:
    """The same in float64, over all triangles; their edges belong to them."""
    planes, vertices = surfaces.planes, surfaces.exact_vertices
    a, b, c = vertices[surfaces.topology.faces].unbind(1)
    first, second = b - a, c - a
    area = cross(first, second)
    square = dot(area, area).clamp_min(1e-300)
    good = torch.ones(len(segments.start), dtype=torch.bool)
    met = torch.full((len(good),), -1)
    near, wide = _EXACT_TOLERANCE * surfaces.size, 1e-9
    every = torch.arange(len(good))
    for some in every.split(max(1, _MAX_PAIRS // len(a))):
        start, end = segments.start[some, None], segments.end[some, None]
        way = end - start
        length = way.norm(dim=2)
        falls = dot(way, area.expand(len(some), -1, -1))
        share = dot(a - start, area.expand(len(some), -1, -1)) / torch.where(
            falls == 0, torch.ones_like(falls), falls
        )

        def inside(point: Tensor) -> Tensor:
            offset = point - a
            v = dot(cross(first.expand_as(offset), offset), area.expand_as(offset)) / square
            u = dot(cross(offset, second.expand_as(offset)), area.expand_as(offset)) / square
            return torch.minimum(torch.minimum(u, v), 1 - u - v)

        own = planes.face_plane
        ends = (own == segments.plane_before[some, None]) | (own == segments.plane[some, None])
        ends |= (own == segments.target_plane[some, None]) & (own >= 0)
        between = (share * length > near) & (share * length < length - near)
        crossing = between & (falls != 0) & ~ends & (own >= 0)
        blocked = crossing & (inside(start + share[..., None] * way) >= -wide)
        depth = torch.where(own == segments.plane[some, None], inside(end), -torch.inf)
        best, face = depth.max(1)
        surface = segments.plane[some] >= 0
        met[some] = torch.where(surface, face, -1)
        good[some] = ~blocked.any(1) & (~surface | (best >= -wide))
    return good, met


@dataclass(frozen=True)
class Planes:
    """Planes, and the rectangles in them that hold their triangles; detached.

    Attributes:
        face_plane: Plane of every triangle; −1 of triangles without area.
        point: On the plane, about the scene's middle [m].
        normal: Unit vector.
        axes: Two unit vectors in the plane, along the sides of the rectangle.
        low, high: Ends of the rectangle along them, from ``point`` [m].
    """

    face_plane: Int64[Tensor, " f"]
    point: Float64[Tensor, "plane 3"]
    normal: Float64[Tensor, "plane 3"]
    axes: Float64[Tensor, "plane 2 3"]
    low: Float64[Tensor, "plane 2"]
    high: Float64[Tensor, "plane 2"]

    def __len__(self) -> int:
        return len(self.point)


def find_planes(vertices: Float64[Tensor, "v 3"], faces: Int64[Tensor, "f 3"]) -> Planes:
    """The planes of all triangles. Those that nearly coincide are one, whatever object has them.

    Args:
        vertices: About the scene's middle, detached [m].
        faces: Of triangles.
    """
    corners = vertices[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = float((vertices.amax(0) - vertices.amin(0)).norm())
    flat = area.norm(dim=1)
    whole = torch.nonzero(flat > (1e-9 * size) ** 2)[:, 0]
    normal = normalize(area[whole], dim=1)
    # One sign for both windings: that of the largest component.
    lead = normal.abs().argmax(1, keepdim=True)
    normal = normal * normal.gather(1, lead).sign()
    offset = (normal * corners[whole, 0]).sum(1) / size
    key = (torch.cat([normal, offset[:, None]], 1) / _PLANE_TOLERANCE).round().numpy() + 0.0
    _, plane = np.unique(key, axis=0, return_inverse=True)
    plane = torch.from_numpy(plane.ravel())
    count = int(plane.max()) + 1 if len(plane) else 0
    # The largest triangle stands for its plane.
    order = np.lexsort((flat[whole].numpy(), plane.numpy()))
    last = np.searchsorted(plane.numpy()[order], np.arange(count), side="right") - 1
    best = torch.from_numpy(order[last])
    corner = corners[whole[best]]
    sides = corner.roll(-1, 1) - corner
    # The shortest side of half a rectangle is one of the rectangle's.
    shortest = sides.norm(dim=2).argmin(1)
    first = normalize(sides[torch.arange(count), shortest], dim=1)
    axes = torch.stack([first, torch.linalg.cross(normal[best], first)], 1)
    point = corners[whole[best], 0]
    seen = torch.einsum("fcx,fax->fca", corners[whole] - point[plane, None], axes[plane])
    ends = torch.full((count, 2), torch.inf, dtype=torch.float64)
    rows = plane[:, None].expand(-1, 2)
    low = ends.scatter_reduce(0, rows, seen.amin(1), "amin")
    high = (-ends).scatter_reduce(0, rows, seen.amax(1), "amax")
    face_plane = torch.full((len(faces),), -1, dtype=torch.int64)
    face_plane[whole] = plane
    return Planes(face_plane, point, normal[best], axes, low, high)
