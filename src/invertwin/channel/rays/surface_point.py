"""Points on triangles, given by barycentric coordinates."""

from __future__ import annotations

from dataclasses import dataclass

from invertwin.channel.rays.arrays import gather_points
from invertwin.channel.rays.backend import Mask, dr, mi, mit

Triangle = tuple[mit.Point3f, mit.Point3f, mit.Point3f]


@dataclass
class SurfacePoint:
    """Point on a triangle. Not frozen, since loops of Dr.Jit assign their state field by field.

    Attributes:
        face: triangle index.
        b1, b2: barycentric coordinates of the second and the third corner.
    """

    face: mit.UInt32
    b1: mit.Float
    b2: mit.Float


def corners(
    vertices: mit.Float, faces: mit.UInt32, face: mit.UInt32, active: Mask = True
) -> Triangle:
    """Gather the corners of triangles.

    Args:
        vertices: table of points, see ``to_points``.
        faces: table of vertex indices, four numbers a triangle.
        face: triangle indices.
        active: mask of active lanes.
    """
    index = dr.gather(mi.Vector4u, faces, face, active)
    return tuple(gather_points(vertices, index[k], active) for k in range(3))  # type: ignore[return-value]


def interpolate_position(triangle: Triangle, b1: mit.Float, b2: mit.Float) -> mit.Point3f:
    """Interpolate between the corners of triangles (torch form: ``interpolate_values``).

    Args:
        triangle: the three corners.
        b1, b2: barycentric coordinates of the second and the third corner.
    """
    p0, p1, p2 = triangle
    return p0 * (1 - b1 - b2) + p1 * b1 + p2 * b2  # type: ignore[operator]


def barycentric_coordinates(point: mit.Point3f, triangle: Triangle) -> tuple[mit.Float, mit.Float]:
    """Compute the barycentric coordinates b1 and b2 of a point in the plane of a triangle.

    Args:
        point: point in the plane.
        triangle: the three corners.
    """
    p0, p1, p2 = triangle
    a, b, r = p1 - p0, p2 - p0, point - p0
    aa, ab, bb, ra, rb = dr.dot(a, a), dr.dot(a, b), dr.dot(b, b), dr.dot(r, a), dr.dot(r, b)
    determinant = dr.fma(aa, bb, -ab * ab)
    return (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant


def face_normal(triangle: Triangle) -> mit.Vector3f:
    """Compute the unit normals of triangles.

    Args:
        triangle: the three corners.
    """
    p0, p1, p2 = triangle
    return dr.normalize(dr.cross(p1 - p0, p2 - p0))
