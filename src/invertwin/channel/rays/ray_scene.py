"""Ray scene: triangles and antennas in float32 about a local origin, and ray queries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel.paths import Link
from invertwin.channel.rays import arrays, surface_point
from invertwin.channel.rays.backend import Mask, backend, dr, mi, mit, tracing
from invertwin.channel.rays.bounding_spheres import BoundingSpheres, State, sample_cap
from invertwin.channel.rays.brute_force import BruteForceIntersector
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.channel.rays.surface_point import SurfacePoint, Triangle
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.checks import ArrayLike, checked_tensor
from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh

Points: TypeAlias = Float64[Tensor, "n 3"]
# Offset along a ray, relative to its length: fifty float32 roundings of a coordinate, and so small
# that the shadowed side of a 0.3 m ball stays dark from a kilometre away.
RAY_EPSILON = 3e-6
NO_TARGET = 0xFFFFFFFF  # index of no object
MAX_SHEETS = 8  # that a segment may pass
_SEAM = 4e-6  # of the scene's size: triangles that a ray meets so close are one sheet
_MIN_RELATIVE_AREA = 1e-3  # least area over squared sides of a triangle that is not a sliver
_SHADOW_MARGIN = 1e-4  # relative to a distance: far more than rounding


@dataclass(frozen=True)
class RayIntersection:
    """First intersection of rays with triangles.

    Attributes:
        valid: mask of rays that meet a triangle; elsewhere the other fields are undefined.
        point: intersection point.
        t: distance along the ray, in lengths of its direction.
    """

    valid: mit.Bool
    point: SurfacePoint
    t: mit.Float


class Occluders:
    """Triangles that block rays, in float32 about a local origin.

    Args:
        vertices: world positions [v, 3] in metres.
        topology: connectivity of the triangles.
        origin: local origin [3] in the world [m].
    """

    def __init__(
        self, vertices: Float64[Tensor, "v 3"], topology: Topology, origin: Float64[Tensor, 3]
    ) -> None:
        self.topology = topology
        self.origin = origin
        self.local_vertices = (vertices.detach() - origin).to(torch.float32)
        #: Brute-force intersector, for so few triangles that no BVH is needed.
        self.brute_force: BruteForceIntersector | None = None

    @property
    def scene(self) -> Any:
        """Mitsuba's scene, looked up anew: other ray scenes of the objects may have moved them."""
        return self.topology.ray_scene(self.local_vertices)

    def loop(
        self, state: State, going: Callable[..., mit.Bool], step: Callable[..., State]
    ) -> State:
        """Record a loop in which rays are cast; all loops of kernels over rays are made here.

        The BVH is built before: to build it while a loop is recorded aborts the process. The step
        is recorded once only, since a second recording would gain the kernel nothing.

        Args:
            state: tuple of arrays that the loop carries.
            going: function of the state that returns the mask of lanes that continue.
            step: function of the state that returns the next one.
        """
        if self.brute_force is None:
            _ = self.scene
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            return dr.while_loop(state, going, step, mode="symbolic")

    def is_clear(self, start: mit.Point3f, end: mit.Point3f, active: Mask = True) -> mit.Bool:
        """Test whether segments are unobstructed (the surfaces of their ends excluded).

        Args:
            start, end: ends of the segments.
            active: mask of active lanes.
        """
        ray = mi.Ray3f(
            start + (end - start) * RAY_EPSILON, end - start, 1 - 2 * RAY_EPSILON, 0.0, []
        )
        if self.brute_force is not None:
            return active & ~self.brute_force.is_blocked(ray, active)
        return active & ~self.scene.ray_test(ray, active)

    def find_nearest(
        self, ray: mit.Ray3f, active: mit.Bool, *, coherent: bool = False
    ) -> RayIntersection:
        """Find the first triangle on rays.

        Args:
            ray: origins, directions, and largest distances.
            active: mask of active lanes.
            coherent: True if neighbouring rays are alike.
        """
        if self.brute_force is not None:
            valid, face, b1, b2, t = self.brute_force.find_nearest(ray, active)
            return RayIntersection(valid, SurfacePoint(face, b1, b2), t)
        hit = self.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        valid = active & hit.is_valid()
        point = SurfacePoint(hit.prim_index, hit.prim_uv.x, hit.prim_uv.y)
        return RayIntersection(valid, point, hit.t)

    def find_first_hits(
        self, origin: Tensor, direction: Tensor, reach: Tensor | None = None
    ) -> tuple[Int64[Tensor, " n"], Float64[Tensor, " n"]]:
        """Find the first triangle on rays (−1: none), and its distance (infinite without a hit).

        Args:
            origin: origins about the local origin, [n, 3] [m].
            direction: directions [n, 3], in whose lengths distances count.
            reach: largest distances; None = all.
        """
        if not len(origin):
            return torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.float64)
        start = arrays.to_vectors(mi.Point3f, origin)
        most = dr.largest(mi.Float) if reach is None else arrays.to_float(reach)
        ray = mi.Ray3f(start, arrays.to_vectors(mi.Vector3f, direction), most, 0.0, [])
        hit = self.scene.ray_intersect_preliminary(ray)
        face = dr.select(hit.is_valid(), mi.Int32(hit.prim_index), -1)
        dr.eval(face, hit.t)
        return arrays.to_torch(face).long(), arrays.to_torch(hit.t).double()

    def to_local_points(self, points: Points, shift: mit.Vector3d | float = 0.0) -> mit.Point3f:
        """Convert world points to Dr.Jit points about the local origin.

        Args:
            points: points in the world [m].
            shift: vector to add to them [m].
        """
        table, origin = (arrays.to_double(values) for values in (points, self.origin))
        world = dr.gather(mi.Vector3d, table, dr.arange(mi.UInt32, len(points)))
        return mi.Point3f(world + shift - dr.gather(mi.Vector3d, origin, mi.UInt32(0)))


class RayScene(Occluders):
    """Triangles of a scene, and the antennas that see them.

    Args:
        geometry: scene as flat tables.
        link: antennas; the local origin is the mean position of the transmitters.
        differentiate_antennas: True if derivatives may flow through the antennas' positions.
    """

    def __init__(
        self, geometry: Geometry, link: Link, *, differentiate_antennas: bool = True
    ) -> None:
        origin = link.tx.detach().mean(dim=0)
        super().__init__(geometry.vertices, geometry.topology, origin)
        # A GPU traverses a BVH in hardware.
        if backend() == "cpu":
            self.brute_force = BruteForceIntersector.build(
                geometry.vertices.detach() - origin, geometry.faces
            )
        self.geometry = geometry
        self.link = link
        self.vertices = arrays.to_points(self.local_vertices)
        self.tx = arrays.to_points(link.tx - origin)
        self.rx = arrays.to_points(link.rx - origin)
        # Lanes without a hit are evaluated on a valid triangle, then masked: no NaN can leak.
        self.fallback_face = arrays.opaque(_find_fallback_face(geometry))
        owners = geometry.object_scene
        self.scene_count = 1 if owners is None else int(owners.max()) + 1
        #: Radar poses per scene; those of the first scene come first.
        self.poses_per_scene = link.frame_count // self.scene_count
        self._scene_of_object = None if owners is None else arrays.to_index(owners)
        some = any(geometry.differentiated) and not all(geometry.differentiated)
        #: Objects with derivatives, if others and the antennas have none; else None.
        self.differentiated_objects = None
        if some and not differentiate_antennas:
            self.differentiated_objects = DifferentiatedObjects(
                torch.tensor(geometry.differentiated), self
            )

    @cached_property
    def spheres(self) -> BoundingSpheres:
        """Bounding spheres of the objects."""
        return BoundingSpheres(self.geometry, self.origin, margin=1.001)

    @cached_property
    def triangles(self) -> mit.Float:
        """Corner, two sides and unit normal of every triangle, as three rows of four numbers.

        Rows are (corner, normal's x), (side, its y), (side, its z): each is read as a whole.
        """
        p0, p1, p2 = (self.local_vertices[self.geometry.faces[:, k]] for k in range(3))
        normal = torch.nn.functional.normalize(torch.linalg.cross(p1 - p0, p2 - p0), dim=1)
        rows = torch.stack([p0, p1 - p0, p2 - p0], dim=1)
        return arrays.to_float(torch.cat([rows, normal[:, :, None]], dim=2))

    @cached_property
    def exact_vertices(self) -> mit.Float64:
        """Vertices in float64, three numbers each."""
        return arrays.to_double(self.geometry.vertices.detach() - self.origin)

    def exact_vertex(self, vertex: mit.UInt32, active: Mask = True) -> mit.Vector3d:
        """Gather vertices in float64.

        Args:
            vertex: vertex indices.
            active: mask of active lanes.
        """
        return dr.gather(mi.Vector3d, self.exact_vertices, vertex, active)

    def exact_ends(self, edge: mit.UInt32) -> tuple[mit.Vector3d, mit.Vector3d]:
        """Gather both ends of edges in float64.

        Args:
            edge: edge indices.
        """
        ends = (dr.gather(mi.UInt32, column, edge) for column in self.topology.device_edges)
        return tuple(map(self.exact_vertex, ends))  # type: ignore[return-value]

    def object_scene(self, number: mit.UInt32) -> mit.UInt32:
        """Look up the scenes of objects.

        Args:
            number: object indices.
        """
        if self._scene_of_object is None:
            return mi.UInt32(0)
        return dr.gather(mi.UInt32, self._scene_of_object, number)

    def edge_scene(self, edge: mit.UInt32) -> mit.UInt32:
        """Look up the scenes of edges.

        Args:
            edge: edge indices.
        """
        return self.object_scene(dr.gather(mi.UInt32, self.topology.device_edge_object, edge))

    def frame_scene(self, frame: mit.UInt32) -> mit.UInt32:
        """Look up the scenes of radar poses.

        Args:
            frame: radar poses.
        """
        return mi.UInt32(0) if self._scene_of_object is None else frame // self.poses_per_scene

    def is_in_scene(self, frame: mit.UInt32, face: mit.UInt32, active: Mask = True) -> mit.Bool:
        """Test whether triangles belong to the scene of a radar pose.

        A ray ends when it leaves its scene, whatever it meets in another one.

        Args:
            frame: radar poses.
            face: triangle indices.
            active: mask of active lanes.
        """
        if self._scene_of_object is None:
            return mi.Bool(True)
        owner = dr.gather(mi.UInt32, self.topology.device_face_object, face, active)
        return dr.gather(mi.UInt32, self._scene_of_object, owner, active) == self.frame_scene(frame)

    def corners(self, face: mit.UInt32, active: Mask = True) -> Triangle:
        """Gather the corners of triangles, detached.

        Args:
            face: triangle indices.
            active: mask of active lanes.
        """
        return surface_point.corners(self.vertices, self.topology.device_corners, face, active)


class DifferentiatedObjects:
    """Objects with derivatives, if the antennas and other objects have none.

    A shadow moves over a surface if the object that casts it moves or the surface does. An edge of
    an object at rest therefore counts only if its shadow may fall on an object that moves.

    Args:
        differentiated: True for each object with derivatives; some are.
        rays: ray scene.
    """

    def __init__(self, differentiated: Bool[Tensor, " object"], rays: RayScene) -> None:
        self._rays = rays
        self._differentiated = arrays.to_index(differentiated)
        self._numbers = arrays.to_index(torch.nonzero(differentiated)[:, 0])
        self._count = arrays.opaque(int(differentiated.sum()))

    def has_object(self, owner: mit.UInt32, active: Mask = True) -> mit.Bool:
        """Test whether objects carry derivatives.

        Args:
            owner: object indices.
            active: mask of active lanes.
        """
        return dr.gather(mi.UInt32, self._differentiated, owner, active) > 0

    def has_face(self, face: mit.UInt32, active: Mask = True) -> mit.Bool:
        """Test whether triangles belong to objects with derivatives.

        Args:
            face: triangle indices.
            active: mask of active lanes.
        """
        owners = self._rays.topology.device_face_object
        return self.has_object(dr.gather(mi.UInt32, owners, face, active), active)

    def has_edge(self, edge: mit.UInt32) -> mit.Bool:
        """Test whether edges belong to objects with derivatives.

        Args:
            edge: edge indices.
        """
        return self.has_object(dr.gather(mi.UInt32, self._rays.topology.device_edge_object, edge))

    def sample_direction(
        self, point: mit.Point3f, numbers: list[mit.Float]
    ) -> tuple[mit.Vector3f, mit.UInt32]:
        """Sample a direction to the bounding sphere of an object with derivatives.

        Args:
            point: positions from which the objects are seen [m].
            numbers: three uniform numbers.

        Returns:
            The unit direction, and the table index of the object.
        """
        spheres = self._rays.spheres
        number = dr.minimum(mi.UInt32(numbers[0] * self._count), self._count - 1)
        aimed = spheres.table_index(dr.gather(mi.UInt32, self._numbers, number))
        axis, height, _ = spheres.cap(aimed, point)
        return sample_cap(axis, height, numbers[1:]), aimed

    def line_density(
        self, point: mit.Point3f, direction: mit.Vector3f, target: mit.UInt32
    ) -> mit.Float:
        """Evaluate the density per solid angle of such directions, half of them reversed.

        Args:
            point: positions from which the objects are seen [m].
            direction: unit directions.
            target: table index of the object that the direction was sampled for, or any other
                number if it was sampled otherwise.
        """
        rays, spheres = self._rays, self._rays.spheres

        def step(number: mit.UInt32, total: mit.Float) -> tuple[mit.UInt32, mit.Float]:
            at = spheres.table_index(dr.gather(mi.UInt32, self._numbers, number))
            ahead, within = spheres.cap_density(at, point, direction, target)
            behind, _ = spheres.cap_density(at, point, -direction, NO_TARGET)
            return number + 1, total + dr.select(within, 1 / (4 * dr.pi), 0.5 * (ahead + behind))

        lanes = dr.width(direction)
        initial = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Float, lanes)
        _, total = rays.loop(initial, lambda number, _: number < self._count, step)
        return total / mi.Float(self._count)

    def may_receive_shadow(
        self, edge: mit.UInt32, origin: mit.Point3f, y0: mit.Vector3d, y1: mit.Vector3d
    ) -> mit.Bool:
        """Test whether shadows of edges may fall on the spheres of objects with derivatives.

        Args:
            edge: edge indices.
            origin: positions of the antennas [m].
            y0, y1: ends of the edges [m].
        """
        rays, spheres = self._rays, self._rays.spheres
        first, second = (mi.Vector3f(y - mi.Vector3d(origin)) for y in (y0, y1))
        normal = dr.cross(first, second)
        length = dr.norm(normal)
        # The shadow of an edge that points at the antenna may fall anywhere.
        normal = dr.select(length > 0, normal / length, 0.0)
        rims = [dr.normalize(end) for end in (first, second)]
        along = second - first
        foot = dr.clip(-dr.dot(first, along) / dr.squared_norm(along), 0.0, 1.0)
        near = dr.norm(first + along * foot)
        scene = rays.edge_scene(edge)

        def step(number: mit.UInt32, found: mit.Bool) -> tuple[mit.UInt32, mit.Bool]:
            owner = dr.gather(mi.UInt32, self._numbers, number)
            sphere = dr.gather(mi.Vector4f, spheres.table, spheres.table_index(owner))
            centre, radius = sphere.xyz - origin, sphere.w
            # Within the sector of directions through the edge, or near one of its rims.
            height = dr.dot(centre, normal)
            inside = dr.dot(dr.cross(first, centre), normal) >= 0
            inside &= dr.dot(dr.cross(centre, second), normal) >= 0
            away = dr.select(inside, dr.abs(height), dr.inf)
            for rim in rims:
                at = dr.maximum(dr.dot(centre, rim), 0.0)
                away = dr.minimum(away, dr.norm(centre - rim * at))
            far = dr.norm(centre) + radius
            met = (away <= radius + _SHADOW_MARGIN * far) & (far * (1 + _SHADOW_MARGIN) >= near)
            return number + 1, found | (met & (rays.object_scene(owner) == scene))

        lanes = dr.width(edge)
        initial = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Bool, lanes)
        return rays.loop(initial, lambda number, found: ~found & (number < self._count), step)[1]


def _find_fallback_face(geometry: Geometry) -> int:
    """Find a triangle that is no sliver: the cached one if still valid, which is faster."""
    topology = geometry.topology
    if topology.fallback_face is not None:
        p0, p1, p2 = geometry.vertices.detach()[geometry.faces[topology.fallback_face]]
        sides = torch.stack([p1 - p0, p2 - p0])
        area = torch.linalg.cross(sides[0], sides[1]).norm()
        if area > _MIN_RELATIVE_AREA * sides.square().sum():
            return topology.fallback_face
    topology.fallback_face = int(face_areas(geometry).argmax())
    return topology.fallback_face


def face_areas(geometry: Geometry) -> Float64[Tensor, " f"]:
    """Compute the areas of all triangles [m²], detached."""
    p0, p1, p2 = (geometry.vertices.detach()[geometry.faces[:, k]] for k in range(3))
    areas = 0.5 * torch.linalg.cross(p1 - p0, p2 - p0).norm(dim=1)
    if not bool((areas > 0).any()):
        raise InputError("expected a triangle of positive area, got none; check the mesh's scale")
    return areas


def is_visible(rays: Occluders, start: Points, end: Points) -> Tensor:
    """Test whether segments between world points are unobstructed.

    Args:
        rays: occluders.
        start, end: ends of the segments, [n, 3] in the world [m].
    """
    if not len(start):
        return torch.zeros(0, dtype=torch.bool)
    return arrays.to_torch(
        rays.is_clear(rays.to_local_points(start), rays.to_local_points(end))
    ).bool()


def find_next_surface(
    rays: Occluders, start: Points, end: Points
) -> tuple[Int64[Tensor, " n"], Float64[Tensor, " n"]]:
    """Find the first triangle between pairs of world points.

    Args:
        rays: occluders.
        start, end: ends of the segments, [n, 3] in the world [m].

    Returns:
        Triangle indices (−1: none), and positions along the segments from 0 to 1.
    """
    if not len(start):
        return torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.float64)
    origin = rays.to_local_points(start)
    return _intersect_segments(rays, origin, rays.to_local_points(end) - origin)


def find_surface_ahead(
    rays: Occluders, points: Float64[Tensor, "n p 3"], row: Tensor, offset: Tensor, way: Tensor
) -> tuple[Int64[Tensor, "n p"], Float64[Tensor, "n p"]]:
    """Find the first triangle on segments that all points of a row share but for their start.

    Args:
        rays: occluders.
        points: points of each row, in the world [m].
        row: number of each row in the tables ``offset`` and ``way`` [m, 3].
        offset: offset of the points [m].
        way: vector from there to the end of the segment [m].

    Returns:
        Triangle indices (−1: none), and positions along the segments from 0 to 1.
    """
    if not len(row):
        return torch.zeros(points.shape[:2]).long(), torch.zeros(points.shape[:2]).double()
    lanes = dr.arange(mi.UInt32, points.shape[0] * points.shape[1]) // points.shape[1]
    number = dr.gather(mi.UInt32, arrays.to_index(row), lanes)
    shift, ahead = (dr.gather(mi.Vector3d, arrays.to_double(x), number) for x in (offset, way))
    start = rays.to_local_points(points.flatten(0, 1), shift)
    face, along = _intersect_segments(rays, start, mi.Point3f(ahead))
    return face.view(points.shape[:2]), along.view(points.shape[:2])


def _intersect_segments(
    rays: Occluders, start: mit.Point3f, way: mit.Point3f
) -> tuple[Int64[Tensor, " n"], Float64[Tensor, " n"]]:
    ray = mi.Ray3f(start + way * RAY_EPSILON, mi.Vector3f(way), 1 - 2 * RAY_EPSILON, 0.0, [])
    hit = rays.scene.ray_intersect_preliminary(ray)
    face = dr.select(hit.is_valid(), mi.Int32(hit.prim_index), -1)
    along = dr.minimum(hit.t + RAY_EPSILON, 1.0)
    dr.eval(face, along)  # in one kernel
    return arrays.view_as_torch(face).long(), arrays.view_as_torch(along).double()


def find_passed_sheets(
    rays: Occluders, start: Points, end: Points, sheets: Bool[Tensor, " f"]
) -> tuple[Bool[Tensor, " n"], list[tuple[Int64[Tensor, " m"], Int64[Tensor, " m"]]]]:
    """Find the sheets between pairs of world points.

    Args:
        rays: occluders.
        start, end: ends of the segments, [n, 3] in the world [m].
        sheets: mask of triangles that let waves pass.

    Returns:
        Mask of segments that nothing but sheets blocks, and numbers of segments with the triangle
        of the first sheet on each, of the second, and so on.
    """
    if not bool(sheets.any()):
        return is_visible(rays, start, end), []
    clear, passed = torch.zeros(len(start), dtype=torch.bool), list[tuple[Tensor, Tensor]]()
    row, last = torch.arange(len(start)), torch.full((len(start),), -1)
    seam = _SEAM * float(rays.local_vertices.abs().amax())
    while len(row) and len(passed) <= MAX_SHEETS:
        face, share = find_next_surface(rays, start, end[row])
        clear[row[face < 0]] = True
        # After rounding a ray may meet the triangle that it has passed, or its neighbour.
        again = (face == last) | ((share * (end[row] - start).norm(dim=1) < seam) & (last >= 0))
        through = (face >= 0) & sheets[face]
        start = torch.lerp(start, end[row], share[:, None])[through]
        row, last, fresh = row[through], face[through], ~again[through]
        passed.append((row[fresh], last[fresh]))
    return clear, passed


def visible_points(mesh: Mesh, points: Points, positions: ArrayLike) -> Bool[Tensor, " n"]:
    """Find the points of a surface that at least one position sees past the rest of the mesh.

    Args:
        mesh: surface, which also occludes.
        points: points on the surface [n, 3], in the frame of the mesh [m].
        positions: positions of the viewers, [p, 3] in metres.

    Raises:
        InputError: Positions of another shape, or that are not finite.
    """
    viewers = checked_tensor(positions, (None, 3), "radar positions [m]", "give x, y, z of each")
    visible = torch.zeros(len(points), dtype=torch.bool)
    with tracing():
        topology = topology_of([mesh])
        vertices = topology.join_vertices([mesh.vertices])
        rays = Occluders(vertices, topology, viewers.detach().mean(dim=0))
        for viewer in viewers:
            hidden = torch.nonzero(~visible)[:, 0]
            visible[hidden[is_visible(rays, points[hidden], viewer.expand(len(hidden), 3))]] = True
    return visible
