"""Scenes of a few triangles: rays are tested against each of them, and no tree is asked.

A tree spends on a packet of rays as much as some dozens of tests that all lanes do alike.
"""

from typing import Any

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi

#: Most triangles of such a scene: with 24 paths take three quarters of their time, from 40 on more.
MOST = 24


class Few:
    """A few triangles, each known to all lanes.

    Every triangle is a corner, its normal (of any length), and two vectors in its plane whose
    products with a point, from the corner on, are the point's barycentric coordinates.

    Args:
        vertices: About the local origin [m].
        faces: At least one triangle, at most ``MOST``.
    """

    def __init__(self, vertices: Float64[Tensor, "v 3"], faces: Int64[Tensor, "f 3"]) -> None:
        p0, p1, p2 = (vertices[faces[:, k]] for k in range(3))
        first, second = p1 - p0, p2 - p0
        normal = torch.linalg.cross(first, second)
        square = normal.square().sum(1, keepdim=True)
        along = (
            torch.linalg.cross(second, normal) / square,
            torch.linalg.cross(normal, first) / square,
        )
        # A triangle without area is met by no ray: products with NaN are not in any interval.
        rows = torch.stack([p0, normal, *along], dim=1)
        self._triangles = [[_point(vector) for vector in row] for row in rows.tolist()]

    def nearest(self, ray: Any, active: Any) -> tuple[Any, Any, Any, Any, Any]:
        """The first triangle on a ray.

        Args:
            ray: Origin, direction and largest distance.
            active: Lanes.

        Returns:
            Whether there is one, its number, barycentric coordinates, and the distance.
        """
        far, b1, b2 = mi.Float(ray.maxt), mi.Float(0.0), mi.Float(0.0)
        face, valid = mi.UInt32(0), mi.Bool(False)
        for number, triangle in enumerate(self._triangles):
            along, u, v, met = _met(triangle, ray, far)
            far, b1, b2 = dr.select(met, along, far), dr.select(met, u, b1), dr.select(met, v, b2)
            face, valid = dr.select(met, number, face), valid | met
        return valid & active, face, b1, b2, far

    def blocked(self, ray: Any, active: Any) -> Any:
        """Whether any triangle is on a ray.

        Args:
            ray: Origin, direction and largest distance.
            active: Lanes.
        """
        blocked = mi.Bool(False)
        for triangle in self._triangles:
            blocked |= _met(triangle, ray, ray.maxt)[3]
        return blocked & active


def _point(numbers: list[float]) -> Any:
    return mi.Vector3f(*(opaque(number, "Float") for number in numbers))


def _met(triangle: list[Any], ray: Any, far: Any) -> tuple[Any, Any, Any, Any]:
    """Distance and barycentric coordinates where a ray meets a triangle's plane, and if within."""
    corner, normal, first, second = triangle
    origin = mi.Vector3f(ray.o - corner)
    along = -dr.dot(normal, origin) / dr.dot(normal, ray.d)
    place = dr.fma(ray.d, along, origin)
    u, v = dr.dot(first, place), dr.dot(second, place)
    return along, u, v, (along > 0) & (along < far) & (u >= 0) & (v >= 0) & (u + v <= 1)
