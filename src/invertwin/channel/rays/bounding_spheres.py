"""Bounding spheres of objects as tables: kernels do not grow with the number of objects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel.rays.arrays import opaque, tangent_frame, to_float, to_index
from invertwin.channel.rays.backend import Mask, dr, mi, mit
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.channel.rays.topology import morton_order

_MAX_GROUP_SIZE = 8  # objects of a group
_EMPTY_SPHERE = (0.0, 0.0, 0.0, -1.0)  # a sphere that no ray meets


State = TypeVar("State", bound=tuple[object, ...])


@runtime_checkable
class LoopRecorder(Protocol):
    """Ray scene as the loops over its objects see it."""

    def loop(
        self, state: State, going: Callable[..., mit.Bool], step: Callable[..., State]
    ) -> State:
        """Record a loop, see ``Occluders.loop``.

        Args:
            state: variables of the loop.
            going: function of the state that returns the mask of lanes that go on.
            step: function of the state that returns the next state.
        """
        ...


class BoundingSpheres:
    """Bounding sphere of each object, detached; neighbouring objects form groups.

    A ray that is aimed at an object counts if it ends on any object of its group: the density of a
    ray is then a sum over one group, whatever the number of objects. Kernels number the objects by
    their index in the table, group after group.

    Args:
        geometry: scene as flat tables.
        origin: local origin of the kernel [m].
        margin: factor by which spheres are larger than necessary.
    """

    def __init__(self, geometry: Geometry, origin: Float64[Tensor, 3], margin: float) -> None:
        centres, radii = _fit_spheres(geometry)
        order = morton_order(centres)
        self.object_count = len(order)  # of all scenes
        scene = np.zeros(self.object_count, dtype=np.int64)
        if geometry.object_scene is not None:
            scene = geometry.object_scene.numpy()
            order = order[np.argsort(scene[order], kind="stable")]
        counts = np.bincount(scene)
        self.max_objects = int(counts.max())  # of one scene
        self.group_size = -(-self.max_objects // -(-self.max_objects // _MAX_GROUP_SIZE))
        groups = -(-counts // self.group_size)
        first = np.cumsum(groups) - groups
        rank = np.arange(self.object_count) - (np.cumsum(counts) - counts)[scene[order]]
        indices = first[scene[order]] * self.group_size + rank
        rows = np.full((int(groups.sum()) * self.group_size, 4), _EMPTY_SPHERE)
        rows[indices] = np.column_stack([centres - origin.numpy(), margin * radii])[order]
        self.table = to_float(torch.from_numpy(rows))
        self.group_count = len(rows) // self.group_size  # of all scenes
        index = np.empty_like(order)
        index[order] = indices
        self._table_indices = to_index(torch.from_numpy(index))
        of_object = index // self.group_size
        self._group = to_index(torch.from_numpy(of_object))
        self._owner = geometry.topology.device_face_object
        self._size = opaque(self.group_size)
        self._scenes: dict[str, mit.UInt32] | None = None
        if geometry.object_scene is not None:
            columns = {"index": indices, "scene": scene[order], "first": first, "groups": groups}
            columns["members"] = np.bincount(of_object)
            self._scenes = {n: to_index(torch.from_numpy(c)) for n, c in columns.items()}

    def table_entry(self, number: mit.UInt32) -> tuple[mit.UInt32, mit.UInt32]:
        """Look up table index and scene of objects in the order of the table.

        Args:
            number: numbers from 0 to ``object_count`` − 1.
        """
        if self._scenes is None:
            return number, mi.UInt32(0)
        columns = self._scenes["index"], self._scenes["scene"]
        return dr.gather(mi.UInt32, columns[0], number), dr.gather(mi.UInt32, columns[1], number)

    def scene_groups(self, scene: mit.UInt32) -> tuple[mit.UInt32, mit.UInt32]:
        """Look up the first group of a scene and the number of its groups.

        Args:
            scene: scene numbers.
        """
        if self._scenes is None:
            return 0, self.group_count  # type: ignore[return-value]
        columns = self._scenes["first"], self._scenes["groups"]
        return dr.gather(mi.UInt32, columns[0], scene), dr.gather(mi.UInt32, columns[1], scene)

    def member_count(self, group: mit.UInt32) -> mit.UInt32:
        """Look up the number of objects in groups.

        Args:
            group: group numbers.
        """
        if self._scenes is None:
            return dr.minimum(self.group_size, self.object_count - group * self.group_size)
        return dr.gather(mi.UInt32, self._scenes["members"], group)

    def table_index(self, number: mit.UInt32) -> mit.UInt32:
        """Look up the table indices of objects.

        Args:
            number: object indices of the scene.
        """
        return dr.gather(mi.UInt32, self._table_indices, number)

    def cap(
        self, index: mit.UInt32, point: mit.Point3f
    ) -> tuple[mit.Vector3f, mit.Float, mit.Bool]:
        """Compute axis and height 1 − cos of the cap of directions to an object.

        Args:
            index: table indices of the objects.
            point: positions from which they are seen [m].

        Returns:
            Axis, height, and the mask of points outside of the sphere; inside, the cap is the whole
            sphere of directions.
        """
        sphere = dr.gather(mi.Vector4f, self.table, index)
        offset = sphere.xyz - point
        distance, radius = dr.norm(offset), sphere.w
        outside = distance > radius
        axis = dr.select(outside, offset / distance, mi.Vector3f(0, 0, 1))
        return axis, dr.select(outside, _cap_height(radius / distance), 2.0), outside

    def face_group(self, face: mit.UInt32, active: Mask = True) -> mit.UInt32:
        """Look up the groups of triangles.

        Args:
            face: triangle indices.
            active: mask of active lanes.
        """
        if self.group_count == 1:
            return mi.UInt32(0)
        owner = dr.gather(mi.UInt32, self._owner, face, active)
        return dr.gather(mi.UInt32, self._group, owner, active)

    def cap_density(
        self,
        index: mit.UInt32,
        point: mit.Point3f,
        direction: mit.Vector3f,
        target: mit.UInt32 | int,
    ) -> tuple[mit.Float, mit.Bool]:
        """Compute one over the solid angle of an object's cap; 0 if a direction is not in it.

        Args:
            index: table indices of the objects.
            point: positions from which they are seen [m].
            direction: unit directions.
            target: table index of the object for which the direction was sampled: its cap
                contains it.

        Returns:
            The density, and the mask of points inside the sphere, which then has no cap.
        """
        sphere = dr.gather(mi.Vector4f, self.table, index)
        offset = sphere.xyz - point
        # The distance of the line from the centre, without a difference of squares.
        beside = dr.squared_norm(dr.cross(offset, direction))
        square, far = dr.square(sphere.w), dr.squared_norm(offset)
        within, there = far <= square, sphere.w > 0
        met = (index == target) | ((dr.dot(offset, direction) > 0) & (beside <= square))
        share = 1 / (2 * dr.pi * _cap_height(sphere.w * dr.rsqrt(far)))
        return dr.select(there & met & ~within, share, 0.0), there & within

    def group_density(
        self,
        rays: LoopRecorder,
        group: mit.UInt32,
        point: mit.Point3f,
        direction: mit.Vector3f,
        active: mit.Bool,
        target: mit.UInt32 | int,
    ) -> tuple[mit.Float, mit.Float]:
        """Sum 1/(solid angle) over the caps of a group that contain a direction.

        Args:
            rays: ray scene that records the loop.
            group: group numbers.
            point: positions from which the objects are seen [m].
            direction: unit directions.
            active: mask of active lanes.
            target: table index of the object for which the direction was sampled.

        Returns:
            The sum, and the number of spheres of the group that contain the point.
        """
        lanes = max(dr.width(direction), dr.width(active))
        start = group * self._size + dr.zeros(mi.UInt32, lanes)
        end = dr.select(active, start + self._size, 0)

        def step(
            index: mit.UInt32, total: mit.Float, inside: mit.Float
        ) -> tuple[mit.UInt32, mit.Float, mit.Float]:
            share, within = self.cap_density(index, point, direction, target)
            return index + 1, total + share, inside + dr.select(within, 1.0, 0.0)

        none = dr.zeros(mi.Float, lanes)
        state = rays.loop((start, none, none), lambda place, *_: place < end, step)
        return state[1], state[2]


def sample_cap(axis: mit.Vector3f, height: mit.Float, numbers: list[mit.Float]) -> mit.Vector3f:
    """Sample a direction uniformly on a spherical cap.

    Args:
        axis: unit axis of the cap.
        height: height 1 − cos of the cap, at most 2.
        numbers: two uniform numbers.
    """
    depth = numbers[0] * height
    sine = dr.sqrt(dr.maximum(depth * (2 - depth), 0.0))
    s, c = dr.sincos(2 * dr.pi * numbers[1])
    return dr.normalize(tangent_frame(axis).to_world(mi.Vector3f(c * sine, s * sine, 1 - depth)))


def _cap_height(sine: mit.Float) -> mit.Float:
    square = dr.minimum(dr.square(sine), 1.0)
    return square / (1 + dr.sqrt(1 - square))


def _fit_spheres(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """Compute centre and radius of a sphere around each object [m]."""
    used, first, owner = geometry.topology.used_vertices
    corners = geometry.vertices.detach().numpy()[used]
    low, high = (f.reduceat(corners, first) for f in (np.minimum, np.maximum))
    centre = 0.5 * (low + high)
    return centre, np.sqrt(np.maximum.reduceat(np.square(corners - centre[owner]).sum(1), first))
