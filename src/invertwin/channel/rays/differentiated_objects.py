"""Shadows that move with θ, in scenes of which only some objects carry derivatives."""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import torch
from jaxtyping import Bool
from torch import Tensor

from invertwin.channel.rays.arrays import opaque, to_index
from invertwin.channel.rays.backend import Mask, dr, mi, mit
from invertwin.channel.rays.bounding_spheres import BoundingSpheres, LoopRecorder, sample_cap
from invertwin.channel.rays.topology import Topology

NO_TARGET = 0xFFFFFFFF  # index of no object
_TOLERANCE = 1e-4  # relative to a distance: far more than rounding


class _Objects(LoopRecorder, Protocol):
    """Ray scene as differentiated objects see it."""

    topology: Topology
    spheres: cached_property[BoundingSpheres]

    def object_scene(self, number: mit.UInt32) -> mit.UInt32:
        """Look up the scenes of objects."""
        ...

    def edge_scene(self, edge: mit.UInt32) -> mit.UInt32:
        """Look up the scenes of edges."""
        ...


class DifferentiatedObjects:
    """Objects with derivatives, if the antennas and other objects have none.

    A shadow moves over a surface if the object that casts it moves or the surface does. An edge of
    an object at rest therefore counts only if its shadow may fall on an object that moves.

    Args:
        differentiated: True for each object with derivatives; some are.
        rays: ray scene.
    """

    def __init__(self, differentiated: Bool[Tensor, " object"], rays: _Objects) -> None:
        self._rays = rays
        self._differentiated = to_index(differentiated)
        self._numbers = to_index(torch.nonzero(differentiated)[:, 0])
        self._count = opaque(int(differentiated.sum()))

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
            met = (away <= radius + _TOLERANCE * far) & (far * (1 + _TOLERANCE) >= near)
            return number + 1, found | (met & (rays.object_scene(owner) == scene))

        lanes = dr.width(edge)
        initial = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Bool, lanes)
        return rays.loop(initial, lambda number, found: ~found & (number < self._count), step)[1]
