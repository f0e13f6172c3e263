"""Brute-force intersection with few triangles, without a BVH.

For a packet of rays, a BVH costs as much as some dozens of tests that all lanes do alike. Two
triangles that make a parallelogram, as those of a box's side, are one test.
"""

from __future__ import annotations

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel.rays.arrays import opaque, to_index
from invertwin.channel.rays.backend import Mask, dr, mi, mit

#: Most tests of such a scene: with 24, paths take three quarters of their time; from 40 on, more.
MAX_TESTS = 24
_CORNER_TOLERANCE = 1e-9  # distance of equal corners, relative to the largest coordinate


class BruteForceIntersector:
    """Intersector of few triangles, each stored as opaque scalars.

    Every test has a corner, its normal (of any length), and two vectors in its plane whose products
    with a point, relative to the corner, are the point's coordinates along the two sides.

    Args:
        vertices: positions [v, 3] about the local origin [m].
        faces: vertex indices [f, 3] of at least one triangle.
    """

    @staticmethod
    def build(
        vertices: Float64[Tensor, "v 3"], faces: Int64[Tensor, "f 3"]
    ) -> BruteForceIntersector | None:
        """Build the intersector, or return None for too many triangles.

        Args:
            vertices: positions [v, 3] about the local origin [m].
            faces: vertex indices [f, 3] of at least one triangle.
        """
        if len(faces) > 2 * MAX_TESTS:
            return None
        few = BruteForceIntersector(vertices, faces)
        return few if few.test_count <= MAX_TESTS else None

    def __init__(self, vertices: Float64[Tensor, "v 3"], faces: Int64[Tensor, "f 3"]) -> None:
        triangles = vertices[faces]
        pairs = _pair_parallelograms(triangles)
        paired = {face for pair in pairs for face in (pair[0], pair[2])}
        alone = [(face, 0, face, 0) for face in range(len(faces)) if face not in paired]
        rows = torch.tensor([*pairs, *alone])
        first, turn = rows[:, :1], rows[:, 1:2]
        p0, p1, p2 = (triangles[first[:, 0], ((turn + k) % 3)[:, 0]] for k in range(3))
        sides = p1 - p0, p2 - p0
        normal = torch.linalg.cross(*sides)
        square = normal.square().sum(1, keepdim=True)
        along = torch.linalg.cross(sides[1], normal), torch.linalg.cross(normal, sides[0])
        # No ray meets a triangle without area: products with NaN are not in any interval.
        numbers = torch.stack([p0, normal, *(axis / square for axis in along)], dim=1).tolist()
        self._pairs, self.test_count = len(pairs), len(rows)
        self._patches = [
            [mi.Vector3f(*(opaque(number, "Float") for number in vector)) for vector in row]
            for row in numbers
        ]
        #: Of every test, for its near and its far half: the triangle, and which corner comes first.
        self._halves = to_index(rows)

    def find_nearest(
        self, ray: mit.Ray3f, active: Mask
    ) -> tuple[mit.Bool, mit.UInt32, mit.Float, mit.Float, mit.Float]:
        """Find the first triangle on rays.

        Args:
            ray: origins, directions and largest distances.
            active: mask of active lanes.

        Returns:
            The mask of hits, triangle indices, two barycentric coordinates, and distances.
        """
        far, u, v = mi.Float(ray.maxt), mi.Float(0.0), mi.Float(0.0)
        test, valid = mi.UInt32(0), mi.Bool(False)
        for number in range(self.test_count):
            along, x, y, met = self._intersect_patch(number, ray, far)
            far, u, v = dr.select(met, along, far), dr.select(met, x, u), dr.select(met, y, v)
            test, valid = dr.select(met, number, test), valid | met
        valid &= active
        beyond, rest = u + v > 1, 1 - u - v
        half = dr.gather(mi.Vector2u, self._halves, 2 * test + dr.select(beyond, 1, 0), valid)
        # Weights of the corners from the one that comes first.
        pairs = (rest, -rest), (u, 1 - u), (v, 1 - v)
        weights = [dr.select(beyond, other, own) for own, other in pairs]
        b1, b2 = (
            dr.select(
                half.y == 0, weights[k], dr.select(half.y == 1, weights[k - 1], weights[k - 2])
            )
            for k in (1, 2)
        )
        return valid, half.x, b1, b2, far

    def is_blocked(self, ray: mit.Ray3f, active: Mask) -> mit.Bool:
        """Test whether any triangle is on rays.

        Args:
            ray: origins, directions and largest distances.
            active: mask of active lanes.
        """
        blocked = mi.Bool(False)
        for number in range(self.test_count):
            blocked |= self._intersect_patch(number, ray, mi.Float(ray.maxt))[3]
        return blocked & active

    def _intersect_patch(
        self, number: int, ray: mit.Ray3f, max_distance: mit.Float
    ) -> tuple[mit.Float, mit.Float, mit.Float, mit.Bool]:
        """Intersect rays with a plane: distance, coordinates, and mask of hits within the patch."""
        corner, normal, first, second = self._patches[number]
        origin = mi.Vector3f(ray.o - corner)  # type: ignore[operator]
        along = -dr.dot(normal, origin) / dr.dot(normal, ray.d)
        place = dr.fma(ray.d, along, origin)
        u, v = dr.dot(first, place), dr.dot(second, place)
        within = (u <= 1) & (v <= 1) if number < self._pairs else u + v <= 1
        return along, u, v, (along > 0) & (along < max_distance) & (u >= 0) & (v >= 0) & within


def _pair_parallelograms(triangles: Float64[Tensor, "n 3 3"]) -> list[tuple[int, int, int, int]]:
    """Find pairs of triangles that make a parallelogram, with no triangle twice.

    Each pair lists, for both triangles, its number and the corner opposite to the common side.
    """
    after, last = triangles.roll(-1, 1), triangles.roll(-2, 1)
    opposite = after + last - triangles
    most = _CORNER_TOLERANCE * triangles.abs().max()

    def are_equal(one: Tensor, other: Tensor) -> Tensor:
        return (one.flatten(0, 1)[:, None] - other.flatten(0, 1)).abs().amax(2) <= most

    found = are_equal(opposite, triangles) & are_equal(after, last) & are_equal(last, after)
    solid = torch.linalg.cross(after - triangles, last - triangles).flatten(0, 1).abs().amax(1) > 0
    found &= solid[:, None] & solid
    taken, pairs = set[int](), []
    for one, other in found.nonzero().tolist():
        ends = one // 3, other // 3
        if not taken.intersection(ends):
            taken.update(ends)
            pairs.append((ends[0], one % 3, ends[1], other % 3))
    return pairs
