"""What rays need: the ray scene and the antennas, in float32 about a local origin."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel.paths import Link
from invertwin.channel.rays import arrays
from invertwin.channel.rays.arrays import (
    opaque,
    to_double,
    to_float,
    to_index,
    to_points,
    to_torch,
)
from invertwin.channel.rays.backend import backend, dr, mi, tracing
from invertwin.channel.rays.bounding_spheres import BoundingSpheres
from invertwin.channel.rays.brute_force import BruteForceIntersector
from invertwin.channel.rays.differentiated_objects import DifferentiatedObjects
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.checks import ArrayLike, checked_tensor
from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh

# Offset along a ray, relative to its length: fifty float32 roundings of a coordinate, and small
# enough that the dark side of a 0.3 m ball stays dark from a kilometre away.
RAY_EPSILON = 3e-6
_MIN_RELATIVE_AREA = 1e-3  # a triangle's area over its squared sides, below which it is one


@dataclass(frozen=True)
class RayIntersection:
    """What a ray meets first.

    Attributes:
        valid: Whether it meets anything; else the rest is not defined.
        face: Triangle.
        b1, b2: Barycentric coordinates.
        t: How far along the ray, in lengths of its direction.
    """

    valid: Any
    face: Any
    b1: Any
    b2: Any
    t: Any


class Occluders:
    """Triangles that block rays, in float32 about a local origin.

    Args:
        vertices: World positions [m].
        topology: Their triangles.
        origin: The local origin [m].
    """

    def __init__(
        self, vertices: Float64[Tensor, "v 3"], topology: Topology, origin: Float64[Tensor, "3"]
    ) -> None:
        self.topology = topology
        self.origin = origin
        self.local_vertices = (vertices.detach() - origin).to(torch.float32)
        #: The triangles by themselves, where they are so few that no tree is needed.
        self.brute_force: BruteForceIntersector | None = None

    @property
    def scene(self) -> Any:
        """Mitsuba's scene. Asked for anew: other rays on the same objects may have moved them."""
        return self.topology.ray_scene(self.local_vertices)

    def loop(self, state: Any, going: Callable[..., Any], step: Callable[..., Any]) -> Any:
        """Record a loop in which rays are cast; all loops of kernels over rays are made here.

        A tree is built before: to build it while a loop is recorded aborts the process. The step
        is not recorded a second time, which would gain the kernel nothing.

        Args:
            state: What the loop carries, a tuple.
            going: Takes the state; which lanes go on.
            step: Takes the state and returns the next one.
        """
        if self.brute_force is None:
            _ = self.scene
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            return dr.while_loop(state, going, step, mode="symbolic")

    def is_clear(self, start: Any, end: Any, active: Any = True) -> Any:
        """Whether nothing lies between two points (their own surfaces excluded).

        Args:
            start, end: Points.
            active: Lanes.
        """
        ray = mi.Ray3f(
            start + (end - start) * RAY_EPSILON, end - start, 1 - 2 * RAY_EPSILON, 0.0, []
        )
        if self.brute_force is not None:
            return active & ~self.brute_force.is_blocked(ray, active)
        return active & ~self.scene.ray_test(ray, active)

    def find_nearest(self, ray: Any, active: Any, *, coherent: bool = False) -> "RayIntersection":
        """The first triangle on a ray.

        Args:
            ray: Origin, direction, and how far it goes.
            active: Lanes.
            coherent: Whether neighbouring rays are alike.
        """
        if self.brute_force is not None:
            return RayIntersection(*self.brute_force.find_nearest(ray, active))
        hit = self.scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
        valid = active & hit.is_valid()
        return RayIntersection(valid, hit.prim_index, hit.prim_uv.x, hit.prim_uv.y, hit.t)

    def to_local_points(self, points: Float64[Tensor, "n 3"]) -> Any:
        """World points as Dr.Jit points about the origin."""
        local = (points.detach() - self.origin).to(torch.float32)
        return mi.Point3f(*(to_float(local[:, k]) for k in range(3)))


class RayScene(Occluders):
    """The triangles of a scene and the antennas that look at them.

    Args:
        geometry: The scene.
        link: The antennas; the local origin is the mean place of the transmitters.
        differentiate_antennas: Whether derivatives may flow through the places of antennas.
    """

    def __init__(
        self, geometry: Geometry, link: Link, *, differentiate_antennas: bool = True
    ) -> None:
        origin = link.tx.detach().mean(dim=0)
        super().__init__(geometry.vertices, geometry.topology, origin)
        # A GPU walks trees in hardware.
        if backend() == "cpu":
            self.brute_force = BruteForceIntersector.build(
                geometry.vertices.detach() - origin, geometry.faces
            )
        self.geometry = geometry
        self.link = link
        self.vertices = to_points(self.local_vertices)
        self.tx = to_points(link.tx - origin)
        self.rx = to_points(link.rx - origin)
        # Lanes without a hit are evaluated on a sound triangle, then masked: no NaN can leak.
        self.fallback_face = opaque(_find_fallback_face(geometry))
        owners = geometry.object_scene
        self.scene_count = 1 if owners is None else int(owners.max()) + 1
        #: Radar poses that look at one scene; those of the first scene come first.
        self.poses_per_scene = link.frame_count // self.scene_count
        self._scene_of_object = None if owners is None else to_index(owners)
        some = any(geometry.differentiated) and not all(geometry.differentiated)
        #: Objects that move where others and the antennas do not; None where that is not so.
        self.differentiated_objects = None
        if some and not differentiate_antennas:
            self.differentiated_objects = DifferentiatedObjects(
                torch.tensor(geometry.differentiated), self
            )

    @cached_property
    def spheres(self) -> BoundingSpheres:
        """Around the objects."""
        return BoundingSpheres(self.geometry, self.origin, margin=1.001)

    @cached_property
    def triangles(self) -> Any:
        """Of every triangle a corner, two sides and the unit normal, as three rows of four numbers.

        Rows are (corner, normal's x), (side, its y), (side, its z): each is read as a whole.
        """
        p0, p1, p2 = (self.local_vertices[self.geometry.faces[:, k]] for k in range(3))
        normal = torch.nn.functional.normalize(torch.linalg.cross(p1 - p0, p2 - p0), dim=1)
        rows = torch.stack([p0, p1 - p0, p2 - p0], dim=1)
        return to_float(torch.cat([rows, normal[:, :, None]], dim=2))

    @cached_property
    def exact_vertices(self) -> Any:
        """Vertices in float64, three numbers each."""
        return to_double(self.geometry.vertices.detach() - self.origin)

    def exact_vertex(self, vertex: Any, active: Any = True) -> Any:
        """Vertices in float64.

        Args:
            vertex: Their numbers.
            active: Lanes.
        """
        return dr.gather(mi.Vector3d, self.exact_vertices, vertex, active)

    def exact_ends(self, edge: Any) -> tuple[Any, Any]:
        """Both ends of edges in float64.

        Args:
            edge: Their numbers.
        """
        first, second = self.topology.device_edges
        return tuple(
            self.exact_vertex(dr.gather(mi.UInt32, ends, edge)) for ends in (first, second)
        )  # type: ignore[return-value]

    def object_scene(self, number: Any) -> Any:
        """The scenes of objects.

        Args:
            number: Of the objects.
        """
        if self._scene_of_object is None:
            return mi.UInt32(0)
        return dr.gather(mi.UInt32, self._scene_of_object, number)

    def edge_scene(self, edge: Any) -> Any:
        """The scenes of edges.

        Args:
            edge: Their numbers.
        """
        if self._scene_of_object is None:
            return mi.UInt32(0)
        return self.object_scene(dr.gather(mi.UInt32, self.topology.device_edge_object, edge))

    def frame_scene(self, frame: Any) -> Any:
        """The scenes that radar poses look at.

        Args:
            frame: Radar poses.
        """
        return mi.UInt32(0) if self._scene_of_object is None else frame // self.poses_per_scene

    def is_in_scene(self, frame: Any, face: Any, active: Any = True) -> Any:
        """Whether triangles belong to the scene that a radar pose looks at.

        A ray that leaves its scene ends for it, whatever it meets in another one.

        Args:
            frame: Radar pose.
            face: Triangle.
            active: Lanes.
        """
        if self._scene_of_object is None:
            return mi.Bool(True)
        owner = dr.gather(mi.UInt32, self.topology.device_face_object, face, active)
        scene = dr.gather(mi.UInt32, self._scene_of_object, owner, active)
        return scene == self.frame_scene(frame)

    def corners(self, face: Any, active: Any = True) -> tuple[Any, Any, Any]:
        """Corners of triangles, detached.

        Args:
            face: Triangle.
            active: Lanes.
        """
        return arrays.corners(self.vertices, self.topology.device_corners, face, active)


def _find_fallback_face(geometry: Geometry) -> int:
    """A triangle that is no sliver; the last answer while it stays one, which is quicker."""
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
    """Areas of all triangles [m²], detached."""
    p0, p1, p2 = (geometry.vertices.detach()[geometry.faces[:, k]] for k in range(3))
    areas = 0.5 * torch.linalg.cross(p1 - p0, p2 - p0).norm(dim=1)
    if not bool((areas > 0).any()):
        raise InputError("expected a triangle of positive area, got none; check the mesh's scale")
    return areas


def is_visible(
    rays: Occluders, start: Float64[Tensor, "n 3"], end: Float64[Tensor, "n 3"]
) -> Tensor:
    """Whether nothing lies between pairs of world points (torch in, torch out).

    Args:
        rays: What may be in the way.
        start, end: Points.
    """
    if not len(start):
        return torch.zeros(0, dtype=torch.bool)
    return to_torch(rays.is_clear(rays.to_local_points(start), rays.to_local_points(end))).bool()


def find_next_surface(
    rays: Occluders, start: Float64[Tensor, "n 3"], end: Float64[Tensor, "n 3"]
) -> tuple[Int64[Tensor, " n"], Float64[Tensor, " n"]]:
    """First triangle between pairs of world points (−1: none), and how far along it lies.

    Args:
        rays: What may be in the way.
        start, end: Points.
    """
    if not len(start):
        return torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.float64)
    origin = rays.to_local_points(start)
    offset = rays.to_local_points(end) - origin
    ray = mi.Ray3f(origin + offset * RAY_EPSILON, mi.Vector3f(offset), 1 - 2 * RAY_EPSILON, 0.0, [])
    hit = rays.scene.ray_intersect_preliminary(ray)
    face = dr.select(hit.is_valid(), mi.Int32(hit.prim_index), -1)
    along = dr.select(hit.is_valid(), hit.t + RAY_EPSILON, 1.0)
    return to_torch(face).long(), to_torch(along).double()


def visible_points(
    mesh: Mesh, points: Float64[Tensor, "n 3"], positions: ArrayLike
) -> Bool[Tensor, " n"]:
    """Which points of a surface at least one position sees past the rest of the same mesh.

    Args:
        mesh: The surface; its triangles hide what is behind them.
        points: On the surface [m], in the frame of the mesh.
        positions: From where it is seen, [p, 3] in metres.

    Raises:
        InputError: Positions of another shape, or that are not finite.
    """
    places = checked_tensor(positions, (None, 3), "radar positions [m]", "give x, y, z of each")
    seen = torch.zeros(len(points), dtype=torch.bool)
    with tracing():
        rays = Occluders(mesh.vertices, topology_of([mesh]), places.detach().mean(dim=0))
        for place in places:
            hidden = torch.nonzero(~seen)[:, 0]
            clear = is_visible(rays, points[hidden], place.expand(len(hidden), 3))
            seen[hidden[clear]] = True
    return seen
