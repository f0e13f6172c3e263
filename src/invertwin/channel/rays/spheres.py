"""Spheres around objects as tables, so that kernels do not grow with the number of objects."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel.rays.arrays import opaque, to_float, to_index
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.geometry import Geometry

_TOGETHER = 8  # objects of a group
_NOWHERE = (0.0, 0.0, 0.0, -1.0)  # a sphere that nothing meets


class Spheres:
    """A sphere around each object, detached; objects that lie side by side form groups.

    Rays that are aimed at an object count where they end on one of its group: so the density of
    a ray is a sum over one group, however many objects there are. Kernels number the objects by
    their place in the table, group after group.
    """

    def __init__(self, geometry: Geometry, origin: Float64[Tensor, "3"], margin: float) -> None:
        """Surround the objects.

        Args:
            geometry: The scene.
            origin: About which the kernel counts places [m].
            margin: By how much spheres are larger than they need to be.
        """
        centres, radii = _around(geometry)
        order = _side_by_side(centres)
        self.count = len(order)
        self.groups = -(-self.count // _TOGETHER)
        self.size = -(-self.count // self.groups)
        rows = np.full((self.groups * self.size, 4), _NOWHERE)
        rows[: self.count] = np.column_stack([centres - origin.numpy(), margin * radii])[order]
        self.table = to_float(torch.from_numpy(rows))
        self._group = to_index(torch.from_numpy(np.argsort(order) // self.size))
        self._owner = geometry.topology.device_face_object
        self._size = opaque(self.size)

    def cap(self, place: Any, point: Any) -> tuple[Any, Any, Any]:
        """Axis and height 1 − cos of the cap of directions in which an object lies.

        Args:
            place: Of the object in the table.
            point: From where it is seen.

        Returns:
            Both, and whether the point is outside of the sphere; inside, every direction counts.
        """
        sphere = dr.gather(mi.Vector4f, self.table, place)
        offset = sphere.xyz - point
        distance, radius = dr.norm(offset), sphere.w
        outside = distance > radius
        axis = dr.select(outside, offset / distance, mi.Vector3f(0, 0, 1))
        return axis, dr.select(outside, _height(radius / distance), 2.0), outside

    def group(self, face: Any, active: Any = True) -> Any:
        """The group of a triangle's object.

        Args:
            face: Triangle.
            active: Lanes.
        """
        if self.groups == 1:
            return mi.UInt32(0)
        owner = dr.gather(mi.UInt32, self._owner, face, active)
        return dr.gather(mi.UInt32, self._group, owner, active)

    def density(
        self, rays: Any, group: Any, point: Any, direction: Any, active: Any, aimed: Any
    ) -> tuple[Any, Any]:
        """Σ 1/(solid angle) over the caps of a group that hold a direction.

        Args:
            rays: Whose kernel this is a part of.
            group: The group.
            point: From where the objects are seen.
            direction: Unit vector.
            active: Lanes.
            aimed: Place of the object that the direction was drawn for, whose cap holds it.

        Returns:
            The sum, and how many spheres of the group the point is inside of.
        """
        lanes = max(dr.width(direction), dr.width(active))
        start = group * self._size + dr.zeros(mi.UInt32, lanes)
        end = dr.select(active, start + self._size, 0)

        def step(place: Any, total: Any, inside: Any) -> tuple[Any, Any, Any]:
            sphere = dr.gather(mi.Vector4f, self.table, place)
            offset = sphere.xyz - point
            # The distance of the line from the centre, without a difference of squares.
            beside = dr.squared_norm(dr.cross(offset, direction))
            square, far = dr.square(sphere.w), dr.squared_norm(offset)
            within, there = far <= square, sphere.w > 0
            met = (place == aimed) | ((dr.dot(offset, direction) > 0) & (beside <= square))
            share = 1 / (2 * dr.pi * _height(sphere.w * dr.rsqrt(far)))
            total = total + dr.select(there & met & ~within, share, 0.0)
            return place + 1, total, inside + dr.select(there & within, 1.0, 0.0)

        none = dr.zeros(mi.Float, lanes)
        state = rays.loop((start, none, none), lambda place, *_: place < end, step)
        return state[1], state[2]


def _height(sine: Any) -> Any:
    square = dr.minimum(dr.square(sine), 1.0)
    return square / (1 + dr.sqrt(1 - square))


def _around(geometry: Geometry) -> tuple[np.ndarray, np.ndarray]:
    """Centre and radius of a sphere around each object [m]."""
    used, first, owner = geometry.topology.used
    corners = geometry.vertices.detach().numpy()[used]
    low, high = (f.reduceat(corners, first) for f in (np.minimum, np.maximum))
    centre = 0.5 * (low + high)
    away = np.square(corners - centre[owner]).sum(1)
    return centre, np.sqrt(np.maximum.reduceat(away, first))


def _side_by_side(places: np.ndarray) -> np.ndarray:
    """Objects in the order of a curve that fills space (Morton)."""
    cells = ((places - places.min(0)) / (np.ptp(places) or 1.0) * 1023).astype(np.int64)
    bits = (cells[..., None] >> np.arange(10)) & 1
    return np.argsort((bits << (3 * np.arange(10) + np.arange(3)[:, None])).sum((1, 2)))
