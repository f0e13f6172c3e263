"""Image method: specular paths between antennas for given sequences of planes; no derivatives.

The transmitter is reflected at one plane after another. The straight lines from the receiver to
these images intersect the planes at the interaction points of the path. A path exists if each such
point lies on a triangle of its plane, and nothing but sheets that transmit lies between the points.

Rays are float32, and may pass through the seam of two triangles. Every segment is therefore tested
by four slightly shifted rays, and where they disagree, a float64 test over all triangles decides.

Source: derivations §10.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em import plane_waves as waves
from invertwin.channel.rays import arrays
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import MAX_SHEETS, RAY_EPSILON, Occluders
from invertwin.channel.rays.topology import Topology
from invertwin.channel.rays.triangle_spheres import TriangleSpheres
from invertwin.channel.rows import Rows, bound_groups

_StepNumbers = Int64[Tensor, "row step"]
_StepVectors = Float64[Tensor, "row step 3"]
PathVectors: TypeAlias = Float64[Tensor, "row 3"]  # one for each path
_PathFilter = Callable[[PathVectors, _StepNumbers, Int64[Tensor, " row"]], Bool[Tensor, " row"]]
_PLANE_TOLERANCE = 1e-5  # rad, and fraction of the scene's size: equal planes
DIRECT = torch.zeros(1, 0, dtype=torch.int64)
"""The sequence without steps, of the line of sight."""
_LANES = 1 << 17
_MAX_PAIRS = 1 << 22  # segments × triangles per chunk of the exact test
_RAY_SPREAD = 4.0  # margins between the rays that test a segment
_EXACT_TOLERANCE = 1e-9  # of the scene's size: float64 points closer than this coincide


@dataclass(frozen=True)
class FaceInteractions:
    """Possible interactions of triangles with rays.

    Attributes:
        reflect: mask of triangles that reflect.
        transmit: mask of triangles that transmit.
    """

    reflect: Bool[Tensor, " f"]
    transmit: Bool[Tensor, " f"]


class CandidateSurfaces(Occluders):
    """Occluders of a scene and the planes of its triangles, candidates for reflection.

    Args:
        vertices: vertex positions in world axes, detached [m].
        topology: triangles of the vertices.
        antennas: antenna positions in world axes [m].
        interactions: triangles that reflect, and those that transmit.
    """

    def __init__(
        self,
        vertices: Float64[Tensor, "v 3"],
        topology: Topology,
        antennas: Float64[Tensor, "antenna 3"],
        interactions: FaceInteractions,
    ) -> None:
        ends = torch.cat([vertices, antennas])
        super().__init__(vertices, topology, (ends.amax(0) + ends.amin(0)) / 2)
        self.exact_vertices = vertices - self.origin
        self.size = float((ends - self.origin).norm(dim=1).max())
        self.margin = RAY_EPSILON * self.size
        self.planes: Planes = find_planes(self.exact_vertices, topology.faces)
        self.interactions = interactions

    @cached_property
    def device_planes(self) -> dict[str, Any]:
        """Planes as flat Dr.Jit arrays."""
        names = ("point", "normal", "axes", "low", "high")
        tables = {name: arrays.to_double(getattr(self.planes, name)) for name in names}
        sheets, planes = self.interactions.transmit, self.planes.face_plane.clamp_min(0)
        return tables | {"is_sheet": arrays.to_index(sheets), "of_face": arrays.to_index(planes)}

    @cached_property
    def triangle_spheres(self) -> TriangleSpheres:
        """Bounding spheres of the triangles."""
        return TriangleSpheres(self.exact_vertices[self.topology.faces], self.margin)

    @cached_property
    def device_rim_widths(self) -> Any:
        """Barycentric rim width within which rays may miss a triangle: margin over least height."""
        corners = self.exact_vertices[self.topology.faces]
        sides = corners.roll(-1, 1) - corners
        area = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1)
        height = area / sides.norm(dim=2).amax(1).clamp_min(1e-300)
        return arrays.to_float(self.margin / height.clamp_min(1e-300))

    def images(self, positions: PathVectors, steps: _StepNumbers) -> list[PathVectors]:
        """Images of positions after each step of sequences, relative to the local origin [m].

        Args:
            positions: positions in world axes [m].
            steps: planes of the reflections, in order.
        """
        point, normal = self.planes.point[steps], self.planes.normal[steps]
        return image_positions(
            positions - self.origin, point, normal, torch.zeros_like(steps).bool()
        )


@dataclass(frozen=True)
class SpecularPaths(Rows):
    """Specular paths with equal numbers of interactions; detached.

    Attributes:
        source, target: numbers of the antennas.
        faces: triangles of the interactions, from the source on.
        transmitted: True for transmission, False for reflection.
    """

    source: Int64[Tensor, " path"]
    target: Int64[Tensor, " path"]
    faces: Int64[Tensor, "path step"]
    transmitted: Bool[Tensor, "path step"]

    def reverse(self) -> "SpecularPaths":
        """Return the paths from target to source."""
        return SpecularPaths(self.target, self.source, self.faces.flip(1), self.transmitted.flip(1))


def image_positions(
    position: PathVectors,
    point: _StepVectors,
    normal: _StepVectors,
    transmitted: Bool[Tensor, "row step"],
) -> list[PathVectors]:
    """Positions of a source and of its images after each step.

    Args:
        position: positions of the source [m].
        point, normal: a point [m] and the unit normal of each plane.
        transmitted: mask of transmissions, which do not move the image.
    """
    found = [position]
    for step in range(point.shape[1]):
        n, p = normal[:, step], point[:, step]
        reflected = p + waves.reflect_vectors(found[-1] - p, n)
        found.append(torch.where(transmitted[:, step, None], found[-1], reflected))
    return found


def replace_zeros(values: Tensor) -> Tensor:
    """Replace zeros by ones, as denominators of masked rows.

    Args:
        values: denominators, of any shape.
    """
    return torch.where(values == 0, torch.ones_like(values), values)


def interaction_points(
    target: PathVectors, images: list[PathVectors], point: _StepVectors, normal: _StepVectors
) -> list[PathVectors]:
    """Intersection points of paths with the planes, from the source on.

    Args:
        target: positions of the target [m].
        images: result of ``image_positions``.
        point, normal: a point [m] and the unit normal of each plane.
    """
    found: list[Tensor] = []
    position = target
    for step in reversed(range(point.shape[1])):
        n, direction = normal[:, step], images[step + 1] - position
        fraction = waves.dot(point[:, step] - position, n) / replace_zeros(waves.dot(direction, n))
        position = position + fraction[:, None] * direction
        found.insert(0, position)
    return found


class UnfoldedPaths:
    """Paths from sources over given triangles, unfolded by images; differentiable.

    Args:
        vertices: vertex positions [m].
        topology: triangles of the vertices.
        faces: triangles of the interactions, from the source on.
        transmitted: True for transmission, False for reflection.
        source: positions of the sources [m].
    """

    def __init__(
        self,
        vertices: Float64[Tensor, "v 3"],
        topology: Topology,
        faces: _StepNumbers,
        transmitted: Bool[Tensor, "row step"],
        source: PathVectors,
    ) -> None:
        corners = vertices[topology.faces[faces]]
        self.faces, self.transmitted = faces, transmitted
        self.normal, self.point = waves.triangle_normals(corners), corners[..., 0, :]
        self.images = image_positions(source, self.point, self.normal, transmitted)

    @property
    def image(self) -> PathVectors:
        """Image of the source in all surfaces [m]."""
        return self.images[-1]

    def interaction_points(self, target: PathVectors) -> Tensor:
        """Interaction points of the paths to targets, [row, step, 3] [m].

        Args:
            target: positions of the targets [m].
        """
        found = interaction_points(target, self.images, self.point, self.normal)
        return torch.stack(found, 1) if found else self.point

    def directions(self, target: PathVectors) -> list[PathVectors]:
        """Unit vectors of the legs to targets, from the source on.

        Args:
            target: positions of the targets [m].
        """
        found = [normalize(target - self.image, dim=1)]
        for step in reversed(range(self.normal.shape[1])):
            reflected = waves.reflect_vectors(found[0], self.normal[:, step])
            found.insert(0, torch.where(self.transmitted[:, step, None], found[0], reflected))
        return found


def find_paths_along(
    surfaces: CandidateSurfaces,
    sequences: Sequence[Int64[Tensor, "_ _"]],
    sources: Float64[Tensor, "source 3"],
    targets: Float64[Tensor, "target 3"],
    is_needed: _PathFilter | None = None,
) -> list[SpecularPaths]:
    """Find the paths from all sources to all targets: direct, and along given sequences.

    Args:
        surfaces: candidate surfaces of the scene.
        sequences: sequences by length, as ``steps`` of ``find_paths_from``.
        sources, targets: positions in world axes [m].
        is_needed: as of ``find_paths_from``.
    """
    own, found = torch.zeros(len(targets), dtype=torch.int64), []
    for steps in (DIRECT, *sequences):
        for number, source in enumerate(sources) if len(steps) else ():
            for some in find_paths_from(
                surfaces, steps, source[None], own, targets, is_needed=is_needed
            ):
                found.append(replace(some, source=torch.full_like(some.source, number)))
    return found


def find_paths_from(
    surfaces: CandidateSurfaces,
    steps: Int64[Tensor, "sequence step"],
    sources: Float64[Tensor, "source 3"],
    source_index: Int64[Tensor, " target"],
    targets: Float64[Tensor, "target 3"],
    target_planes: Int64[Tensor, " target"] | None = None,
    is_needed: _PathFilter | None = None,
) -> list[SpecularPaths]:
    """Find the paths that follow given sequences to each target from its own source.

    Args:
        surfaces: candidate surfaces of the scene.
        steps: planes of the reflections, in order.
        sources, targets: positions in world axes [m].
        source_index: number of the source of each target.
        target_planes: plane that each target lies in, −1 = none; None = none for all.
        is_needed: mask of the paths to test for obstructions, by their sources, the planes of their
            reflections and the numbers of their targets; None = all.
    """
    found: list[SpecularPaths] = []
    for part in steps.split(max(1, _LANES // len(sources))):
        screen = _SequenceScreen(surfaces, part, sources)
        block = max(1, _LANES // len(part))
        for begin in range(0, len(targets), block):
            rows = slice(begin, begin + block)
            target, sequence = screen.select_candidates(targets[rows], source_index[rows])
            target = target + begin
            chosen, source = part[sequence], source_index[target]
            if is_needed is not None:
                rows = is_needed(sources[source], chosen, target)
                chosen, source, target = chosen[rows], source[rows], target[rows]
            plane = None if target_planes is None else target_planes[target]
            ends = sources[source], targets[target]
            valid, faces, transmitted = find_unobstructed_paths(surfaces, chosen, *ends, plane)
            length = torch.where(valid, (faces >= 0).sum(1), -1)
            for count in length[valid].unique().tolist() or [part.shape[1]]:
                rows, own = length == count, slice(count)
                paths = source[rows], target[rows], faces[rows, own], transmitted[rows, own]
                found.append(SpecularPaths(*paths))
    return found


class _SequenceScreen:
    """Screens all sequences from given sources with one ray per segment, in wide kernels."""

    def __init__(self, surfaces: CandidateSurfaces, steps: Tensor, sources: Tensor) -> None:
        self.surfaces = surfaces
        self.length = steps.shape[1]
        self.count = len(steps)
        place = sources.repeat_interleave(self.count, 0)
        seen = surfaces.images(place, steps.repeat(len(sources), 1))
        self.images = arrays.to_double(torch.stack(seen, 1))
        self.steps = arrays.to_index(steps) if self.length else None

    def select_candidates(self, targets: Tensor, source_index: Tensor) -> tuple[Tensor, Tensor]:
        """Return targets and sequences of possible paths, each target from its own source."""
        lane = dr.arange(mi.UInt32, self.count * len(targets))
        count = arrays.opaque(self.count)
        target, row = lane // count, lane % count
        end = dr.gather(mi.Vector3d, arrays.to_double(targets - self.surfaces.origin), target)
        source = dr.gather(mi.UInt32, arrays.to_index(source_index), target)
        first = (source * count + row) * (self.length + 1)
        active, corners, planes, normals = self._intersect_planes(row, first, end)
        free = self._is_unobstructed(first, active, [*corners, end], planes, normals)
        keep = torch.nonzero(arrays.to_torch(free))[:, 0]
        return keep // self.count, keep % self.count

    def _intersect_planes(
        self, row: Any, first: Any, end: Any
    ) -> tuple[Any, list[Any], list[Any], list[Any]]:
        """Intersect the lines to the images with the planes, within their rectangles.

        ``intersects_planes`` is the same test in torch.
        """
        surfaces, table = self.surfaces, self.surfaces.device_planes
        tolerance = arrays.opaque(_EXACT_TOLERANCE * surfaces.size, "Float64")
        margin = arrays.opaque(surfaces.margin, "Float64")
        active, position = mi.Bool(True), end
        corners, planes, normals = [], [], []
        for step in reversed(range(self.length)):
            plane = dr.gather(mi.UInt32, self.steps, row * self.length + step)
            point = dr.gather(mi.Vector3d, table["point"], plane)
            normal = dr.gather(mi.Vector3d, table["normal"], plane)
            direction = dr.gather(mi.Vector3d, self.images, first + step + 1) - position
            slope = dr.dot(direction, normal)
            active &= slope != 0
            fraction = dr.dot(point - position, normal) / dr.select(slope != 0, slope, 1.0)
            length = dr.norm(direction)
            distance = fraction * length
            # A receiver in a reflecting plane has a reflection.
            active &= (distance > -tolerance) & (distance < length - tolerance)
            position = position + fraction * direction
            for axis in (2 * plane, 2 * plane + 1):
                at = dr.dot(position - point, dr.gather(mi.Vector3d, table["axes"], axis))
                active &= at >= dr.gather(mi.Float64, table["low"], axis) - margin
                active &= at <= dr.gather(mi.Float64, table["high"], axis) + margin
            corners.insert(0, position)
            planes.insert(0, plane)
            normals.insert(0, normal)
        return active, corners, planes, normals

    def _is_unobstructed(
        self, first: Any, ok: Any, ends: list[Any], planes: list[Any], normals: list[Any]
    ) -> Any:
        """Test each segment with one ray: unobstructed, and ending on the expected plane.

        Hits of sheets, and near the rim of a triangle, are left to the exact test.
        """
        surfaces = self.surfaces
        margin, scene = arrays.opaque(surfaces.margin, "Float64"), surfaces.scene
        start = dr.gather(mi.Vector3d, self.images, first)
        for step, end in enumerate(ends):
            direction = end - start
            length = dr.norm(direction)
            unit = direction / dr.maximum(length, 1e-300)
            # Offset along the ray: a lateral offset would change which edges it passes.
            offset = mi.Float64(0.0)
            if step:
                offset = margin / dr.maximum(dr.abs(dr.dot(unit, normals[step - 1])), 0.1)
            length -= offset
            begin = start + unit * offset
            last = step == self.length
            excess = -margin
            if not last:
                excess = 2 * margin / dr.maximum(dr.abs(dr.dot(unit, normals[step])), 1e-3)
            reach = dr.maximum(length + excess, 0.0)
            ray = mi.Ray3f(mi.Point3f(begin), mi.Vector3f(unit), mi.Float(reach), 0.0, [])
            hit = scene.ray_intersect_preliminary(ray, active=ok)
            valid = hit.is_valid() & ok
            u, v = hit.prim_uv.x, hit.prim_uv.y
            rim = dr.gather(mi.Float, surfaces.device_rim_widths, hit.prim_index, valid)
            is_inside = valid & (dr.minimum(dr.minimum(u, v), 1 - u - v) > rim)
            table, face = surfaces.device_planes, hit.prim_index
            is_inside &= dr.gather(mi.UInt32, table["is_sheet"], face, valid) == 0
            plane = dr.gather(mi.UInt32, table["of_face"], face, valid)
            if step:
                is_inside &= plane != planes[step - 1]
            if last:
                return ok & ~is_inside
            ok &= ~is_inside | ((plane == planes[step]) & (hit.t > mi.Float(length - excess)))
            start = end
        return ok


@dataclass(frozen=True)
class _SpecularSegments(Rows):
    """Straight segments of paths, one row each; planes are −1 at antennas.

    Attributes:
        start, end: end points [m].
        plane_before, plane: planes of the surfaces at start and end.
        target_plane: plane that the target of a last segment lies in, else −1.
    """

    start: Tensor
    end: Tensor
    plane_before: Tensor
    plane: Tensor
    target_plane: Tensor


def intersects_planes(
    surfaces: CandidateSurfaces, steps: _StepNumbers, images: list[PathVectors], target: PathVectors
) -> Bool[Tensor, " row"]:
    """Test if lines to the images intersect the planes within their rectangles, in order.

    Args:
        surfaces: candidate surfaces of the scene.
        steps: planes of the reflections, in order.
        images: result of ``image_positions``, relative to the scene's origin [m].
        target: positions relative to the scene's origin [m].
    """
    planes = surfaces.planes
    point, normal = planes.point[steps], planes.normal[steps]
    nodes = torch.stack([*interaction_points(target, images, point, normal), target], 1)
    start, ray = nodes[:, 1:], torch.stack(images, 1)[:, 1:] - nodes[:, 1:]
    slope, length = waves.dot(ray, normal), ray.norm(dim=2)
    distance = waves.dot(point - start, normal) / replace_zeros(slope) * length
    at = torch.einsum("rsx,rsax->rsa", nodes[:, :-1] - point, planes.axes[steps])
    inside = (at >= planes.low[steps] - surfaces.margin) & (
        at <= planes.high[steps] + surfaces.margin
    )
    tolerance = _EXACT_TOLERANCE * surfaces.size
    # A receiver in a reflecting plane has a reflection.
    valid = (slope != 0) & (distance > -tolerance) & (distance < length - tolerance)
    return (valid & inside.all(2)).all(1)


def find_unobstructed_paths(
    surfaces: CandidateSurfaces,
    steps: _StepNumbers,
    source: PathVectors,
    targets: PathVectors,
    target_planes: Int64[Tensor, " row"] | None = None,
) -> tuple[Bool[Tensor, " row"], Int64[Tensor, "row vertex"], Bool[Tensor, "row vertex"]]:
    """Find paths that reflect at given planes, and that nothing but sheets obstructs.

    Args:
        surfaces: candidate surfaces of the scene.
        steps: planes of the reflections, in order.
        source, targets: positions in world axes [m].
        target_planes: plane that each target lies in, −1 = none; None = none for all.

    Returns:
        Mask of paths; their triangles from the source on, sheets included, padded with −1 at the
        end; and a mask of those that transmit.
    """
    count, planes = len(steps), surfaces.planes
    if not count:
        return torch.zeros(0, dtype=torch.bool), torch.zeros_like(steps), steps.bool()
    point, normal = planes.point[steps], planes.normal[steps]
    images, target = surfaces.images(source, steps), targets - surfaces.origin
    nodes = torch.stack([images[0], *interaction_points(target, images, point, normal), target], 1)
    none = torch.full((count, 1), -1)
    before, after = torch.cat([none, steps], 1), torch.cat([steps, none], 1)
    target_plane = none if target_planes is None else target_planes[:, None]
    last = torch.cat([torch.full_like(steps, -1), target_plane], 1)
    starts, ends = nodes[:, :-1].reshape(-1, 3), nodes[:, 1:].reshape(-1, 3)
    segments = _SpecularSegments(starts, ends, before.ravel(), after.ravel(), last.ravel())
    faces, valid, passed = _test_segments(surfaces, segments)
    transmits = torch.tensor([True] * passed.shape[1] + [False]).repeat(count, steps.shape[1] + 1)
    faces = torch.cat([passed, faces[:, None]], 1).view(count, -1)
    order = (faces < 0).to(torch.int8).sort(dim=1, stable=True).indices
    faces, transmits = faces.gather(1, order), transmits.gather(1, order)
    valid = valid.view(count, -1).all(1) & (((faces >= 0) & transmits).sum(1) <= MAX_SHEETS)
    separate = (target - images[-1]).norm(dim=1) > _EXACT_TOLERANCE * surfaces.size
    return valid & separate, faces, transmits


def is_unobstructed(
    surfaces: CandidateSurfaces, start: PathVectors, end: PathVectors
) -> Bool[Tensor, " row"]:
    """Mask of straight lines that no surface obstructs, sheets included.

    Args:
        surfaces: candidate surfaces of the scene.
        start, end: positions in world axes [m].
    """
    direct = DIRECT.expand(len(start), 0)
    valid, faces, _ = find_unobstructed_paths(surfaces, direct, start, end)
    return valid & (faces < 0).all(1)


def _test_segments(
    surfaces: CandidateSurfaces, segments: _SpecularSegments
) -> tuple[Tensor, Tensor, Tensor]:
    """Triangle at the end of each segment, mask of unobstructed segments, and the sheets passed."""
    count = len(segments.start)
    four = segments.select(torch.arange(count).repeat(4))  # rays in one launch
    unit = normalize(four.end - four.start, dim=1)
    first = waves.orthogonal_unit_vectors(unit)
    number = torch.arange(4, dtype=torch.float64).repeat_interleave(count)[:, None]
    offset = torch.cos(2.1 * number) * first + torch.sin(2.1 * number) * waves.cross(unit, first)
    offset = offset * (_RAY_SPREAD * surfaces.margin * (number < 3))  # the last one is not shifted
    start = four.start + _shift_in_plane(surfaces, offset, unit, four.plane_before)
    end_plane = four.plane.maximum(four.target_plane)
    end = four.end + _shift_in_plane(surfaces, offset, unit, end_plane)
    faces, passed = (
        found.unflatten(0, (4, count)) for found in _cast_rays(surfaces, start, end, four)
    )
    votes = torch.where(segments.plane >= 0, faces >= 0, faces == -1).sum(0)
    planes = surfaces.planes.face_plane[passed].where(passed >= 0, -1)
    agree = (planes == planes[:1]).all(2).all(0)
    faces, passed = faces[-1], passed[-1]
    undecided = torch.nonzero((votes > 0) & ~((votes == 4) & agree))[:, 0]
    valid = votes == 4
    if len(undecided):
        exact = _test_exactly(surfaces, segments.select(undecided), passed.shape[1])
        valid[undecided], faces[undecided], passed[undecided] = exact
    return faces, valid, passed


def _shift_in_plane(
    surfaces: CandidateSurfaces, offset: Tensor, direction: Tensor, plane: Tensor
) -> Tensor:
    """Project an offset along the segment into the plane at its end."""
    normal = surfaces.planes.normal[plane.clamp_min(0)]
    slope = waves.dot(direction, normal)
    steep = (plane >= 0) & (slope.abs() > 0.02)
    distance = torch.where(steep, waves.dot(offset, normal) / torch.where(steep, slope, 1.0), 0.0)
    return offset - distance[:, None] * direction


def _cast_rays(
    surfaces: CandidateSurfaces, start: Tensor, end: Tensor, segments: _SpecularSegments
) -> tuple[Tensor, Tensor]:
    """Triangle of the expected plane at each segment's end, and the sheets that rays pass.

    The triangle is −1 without a hit, −2 for another hit; the table of sheets is padded with −1.
    """
    planes, margin = surfaces.planes, surfaces.margin
    direction_vector = end - start
    length = direction_vector.norm(dim=1)
    unit = normalize(direction_vector, dim=1)
    before = planes.normal[segments.plane_before.clamp_min(0)]
    offset = torch.where(segments.plane_before >= 0, margin * waves.dot(unit, before).sign(), 0.0)
    end_plane = torch.maximum(segments.plane, segments.target_plane)
    slope = waves.dot(unit, planes.normal[end_plane.clamp_min(0)]).abs()
    excess = 2 * margin / slope.clamp_min(1e-3)
    excess = torch.where(segments.plane >= 0, excess, torch.where(end_plane >= 0, -excess, -margin))
    start, reach = start + offset[:, None] * before, (length + excess).clamp_min(0.0)
    found, row = torch.full_like(end_plane, -2), torch.arange(len(unit))
    last, gone = segments.plane_before, torch.zeros_like(length)
    width = MAX_SHEETS if bool(surfaces.interactions.transmit.any()) else 0
    passed = torch.full((len(unit), width), -1)
    for number in range(width + 1):
        origin, left = start[row] + gone[:, None] * unit[row], reach[row] - gone
        face, distance = surfaces.find_first_hits(origin, unit[row], left)
        gone, plane = gone + distance, planes.face_plane[face.clamp_min(0)]
        expected = (plane == segments.plane[row]) & (gone > (length - excess)[row])
        ends = (face < 0) | expected
        found[row[ends]] = face[ends]
        through = torch.nonzero(~ends & surfaces.interactions.transmit[face.clamp_min(0)])[:, 0]
        if number == width or not len(through):
            break
        # After rounding a ray may meet the plane that it has passed.
        fresh = through[plane[through] != last[through]]
        passed[row[fresh], number] = face[fresh]
        row, last, gone = row[through], plane[through], gone[through] + margin
    return found, passed


def _test_exactly(
    surfaces: CandidateSurfaces, segments: _SpecularSegments, width: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Test segments in float64 over all triangles, which include their edges.

    Returns:
        Mask of unobstructed segments, triangles at their ends, and up to ``width`` sheets on each.
    """
    own, corners = surfaces.planes.face_plane, surfaces.exact_vertices[surfaces.topology.faces]
    a, b, c = corners.unbind(1)
    area = waves.cross(b - a, c - a)
    valid = torch.ones(len(segments.start), dtype=torch.bool)
    hit_faces, least = torch.full((len(valid),), -1), torch.full((len(valid),), -torch.inf).double()
    passed = torch.full((len(valid), width), -1)
    tolerance, rim = _EXACT_TOLERANCE * surfaces.size, 1e-9
    # Points of seams lie in their surfaces to within rounding only; rays end before them, too.
    gap = torch.where(segments.plane.maximum(segments.target_plane) < 0, surfaces.margin, tolerance)
    for rows in torch.arange(len(valid)).split(max(1, _MAX_PAIRS // len(a))):
        near, face = surfaces.triangle_spheres.find_close(segments.start[rows], segments.end[rows])
        row = rows[near]
        start, end = segments.start[row], segments.end[row]
        length, slope = (end - start).norm(dim=1), waves.dot(end - start, area[face])
        fraction = waves.dot(a[face] - start, area[face]) / replace_zeros(slope)
        plane, other = own[face], segments.target_plane[row]
        ends = (plane == segments.plane_before[row]) | (plane == segments.plane[row])
        ends |= (plane == other) & (plane >= 0)
        between = (fraction * length > tolerance) & (fraction * length < length - gap[row])
        crossing = torch.nonzero(between & (slope != 0) & ~ends & (plane >= 0))[:, 0]
        point = start + fraction[:, None] * (end - start)
        inner = waves.barycentric_coordinates(corners[face[crossing]], point[crossing]).amin(1)
        crossing = crossing[inner >= -rim]
        is_sheet = surfaces.interactions.transmit[face[crossing]]
        valid[row[crossing[~is_sheet]]] = False
        crossing = crossing[is_sheet]
        number, sheet, place = _number_crossings(row[crossing], plane[crossing], fraction[crossing])
        valid[number[place >= width]] = False
        kept = place < width
        passed[number[kept], place[kept]] = face[crossing[sheet[kept]]]
        own_plane = torch.nonzero((plane == segments.plane[row]) & (plane >= 0))[:, 0]
        row, face = row[own_plane], face[own_plane]
        inner = waves.barycentric_coordinates(corners[face], end[own_plane]).amin(1)
        least.scatter_reduce_(0, row, inner, "amax")
        best = inner == least[row]
        hit_faces[row[best]] = face[best]
    surface = segments.plane >= 0
    return valid & (~surface | (least >= -rim)), hit_faces, passed


def _number_crossings(
    row: Tensor, plane: Tensor, fraction: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Number the planes that each segment crosses in order; triangles of one plane count once.

    Returns:
        Number of the segment, of the crossing, and of the place on the segment, from zero.
    """
    order = torch.from_numpy(np.lexsort((fraction.numpy(), row.numpy())))
    pairs = torch.stack([row, plane], 1)[order].numpy()
    order = order[np.sort(np.unique(pairs, axis=0, return_index=True)[1])]
    row = row[order]
    return row, order, torch.arange(len(row)) - torch.searchsorted(row, row)


@dataclass(frozen=True)
class Planes:
    """Planes of a scene, with rectangles that bound their triangles; detached.

    Attributes:
        face_plane: plane number of each triangle; −1 for triangles without area.
        point: a point on the plane, relative to the scene's centre [m].
        normal: unit normal.
        axes: two unit vectors in the plane, along the sides of the rectangle.
        low, high: bounds of the rectangle along ``axes``, relative to ``point`` [m].
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
    """Find the planes of all triangles; nearly coincident planes are merged across objects.

    Args:
        vertices: positions relative to the scene's centre, detached [m].
        faces: vertex numbers of the triangles.
    """
    corners = vertices[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = float((vertices.amax(0) - vertices.amin(0)).norm())
    doubled_area = area.norm(dim=1)
    valid = torch.nonzero(doubled_area > (1e-9 * size) ** 2)[:, 0]
    normal = normalize(area[valid], dim=1)
    # Same normal for both windings: the largest component is positive.
    normal = normal * normal.gather(1, normal.abs().argmax(1, keepdim=True)).sign()
    offset = (normal * corners[valid, 0]).sum(1) / size
    key = (torch.cat([normal, offset[:, None]], 1) / _PLANE_TOLERANCE).round().numpy() + 0.0
    _, plane = np.unique(key, axis=0, return_inverse=True)
    plane = torch.from_numpy(plane.ravel())
    count = int(plane.max()) + 1 if len(plane) else 0
    # The largest triangle represents its plane.
    order = np.lexsort((doubled_area[valid].numpy(), plane.numpy()))
    last = np.searchsorted(plane.numpy()[order], np.arange(count), side="right") - 1
    best = torch.from_numpy(order[last])
    corner = corners[valid[best]]
    sides = corner.roll(-1, 1) - corner
    # The shortest side of half a rectangle is a side of the rectangle.
    first = normalize(sides[torch.arange(count), sides.norm(dim=2).argmin(1)], dim=1)
    axes = torch.stack([first, torch.linalg.cross(normal[best], first)], 1)
    point = corners[valid[best], 0]
    coordinates = torch.einsum("fcx,fax->fca", corners[valid] - point[plane, None], axes[plane])
    low, high = bound_groups(plane.repeat_interleave(3), coordinates.flatten(0, 1), count)
    face_plane = torch.full((len(faces),), -1, dtype=torch.int64)
    face_plane[valid] = plane
    return Planes(face_plane, point, normal[best], axes, low, high)
