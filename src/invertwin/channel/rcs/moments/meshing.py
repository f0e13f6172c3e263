"""Conforming refinement of triangle meshes for the method of moments.

Sides are divided into equal parts, and faces are filled with even triangles between these. New
vertices have fixed barycentric coordinates in a face, so that they move with its corners.
Coincident vertices are merged.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray
from scipy.spatial import Delaunay, KDTree

_MERGE_TOLERANCE = 1e-6  # of the mesh's size
_MIN_GAP = 8e-3  # of a side: surfaces closer than this touch
_MIN_FLATNESS = 1e-6  # height of a triangle over its longest side
_LENGTH_SLACK = 1e-3  # relative excess length of a part over the side
_RIM_DISTANCE = 0.5  # sides between the rim of a face and interior vertices
_SMOOTHING_ROUNDS = 4
_BULGE = 1e-5  # of a side: outward curvature of the rim
_PAIRS_AT_ONCE = 1 << 17

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class ConformingMesh:
    """Conforming mesh of small triangles.

    Attributes:
        parent_vertices: vertices of the given mesh that each vertex is interpolated from.
        parent_weights: interpolation weights of these.
        faces: vertex numbers of the triangles, in the order of the given faces.
        parent_face: given face of each triangle.
        has_merged_vertices: True if coincident given vertices were merged.
    """

    parent_vertices: Int64[np.ndarray, "vertex 3"]
    parent_weights: Float64[np.ndarray, "vertex 3"]
    faces: Int64[np.ndarray, "face 3"]
    parent_face: Int64[np.ndarray, " face"]
    has_merged_vertices: bool


def build_conforming_mesh(
    vertices: Float64[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"], side: float
) -> ConformingMesh | None:
    """Refine a mesh to a side length; None if surfaces intersect or touch between vertices.

    Args:
        vertices: vertex positions [m].
        faces: vertex numbers of the triangles.
        side: side of the small triangles [m].
    """
    merged, has_merged = _merge_vertices(vertices, faces)
    faces = merged[faces]
    corners = vertices[faces]
    longest = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2).max(1)
    is_valid = np.linalg.norm(_double_area_vectors(corners), axis=1) > _MIN_FLATNESS * longest**2
    numbers = np.flatnonzero(is_valid)
    faces = faces[is_valid]
    if not len(faces) or not _is_conforming(vertices, faces, _MIN_GAP * side):
        return None
    # Edges are directed from the lower to the higher vertex number.
    ends = np.stack([faces, np.roll(faces, -1, 1)], 2)
    turned = ends[..., 0] > ends[..., 1]
    edges, edge = np.unique(np.sort(ends, 2).reshape(-1, 2), axis=0, return_inverse=True)
    edge = edge.reshape(-1, 3)
    length = np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1)
    parts = np.maximum(1, np.ceil(length / side - _LENGTH_SLACK)).astype(np.int64)
    first = len(vertices) + np.concatenate([[0], (parts - 1).cumsum()])
    every = np.arange(len(vertices))
    parents, weights = ([np.stack([every] * 3, 1)], [np.eye(3)[np.zeros(len(vertices), int)]])
    for (low, high), count in zip(edges, parts, strict=True):
        fraction = np.arange(1, count) / count
        parents.append(np.tile([low, high, high], (count - 1, 1)))
        weights.append(np.stack([1 - fraction, fraction, 0 * fraction], 1))
    count = int(first[-1])
    triangles: list[Index] = []
    for number, face in enumerate(faces):
        face_edges = edge[number]
        shape = _face_shape(vertices[face] / side)
        inner, local = _triangulate_face(tuple(int(n) for n in parts[face_edges]), shape)
        rim: list[Index] = []
        for corner in range(3):
            between = first[face_edges[corner]] + np.arange(parts[face_edges[corner]] - 1)
            rim += [face[corner : corner + 1], between[::-1] if turned[number, corner] else between]
        local_numbers = np.concatenate([*rim, count + np.arange(len(inner))])
        parents.append(np.tile(face, (len(inner), 1)))
        weights.append(inner)
        count += len(inner)
        triangles.append(local_numbers[local])
    parent_face = numbers.repeat([len(t) for t in triangles])
    used, small = np.unique(np.concatenate(triangles), return_inverse=True)
    interpolated = np.concatenate(parents)[used], np.concatenate(weights)[used]
    return ConformingMesh(*interpolated, small.reshape(-1, 3), parent_face, has_merged)


def _double_area_vectors(corners: Array) -> Array:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal, dtype=np.float64)


def _merge_vertices(vertices: Array, faces: Index) -> tuple[Index, bool]:
    """First of the coincident vertices of each vertex, and True if any coincide."""
    used = np.unique(faces)
    merged = np.arange(len(vertices))
    tolerance = _MERGE_TOLERANCE * float(np.linalg.norm(np.ptp(vertices[used], axis=0)))
    pairs = KDTree(vertices[used]).query_pairs(tolerance, output_type="ndarray")
    for low, high in pairs[np.lexsort(pairs.T)]:
        merged[used[high]] = merged[used[low]]
    return merged, bool(len(pairs))


def _face_shape(corners: Array) -> tuple[float, float, float]:
    """Length of the first side, and coordinates of the last corner along and across it.

    Rounded, so that similar faces share one triangulation.
    """
    base, other = corners[1] - corners[0], corners[2] - corners[0]
    length = float(np.linalg.norm(base))
    along = float(base @ other) / length
    across = math.sqrt(max(float(other @ other) - along**2, 0.0))
    return round(length, 1) + 0.05, round(along, 1), round(across, 1) + 0.05


@lru_cache(maxsize=4096)
def _triangulate_face(
    parts: tuple[int, ...], shape: tuple[float, float, float]
) -> tuple[Array, Index]:
    """Barycentric coordinates of interior vertices of a face, and its triangles.

    Vertices are numbered along the rim, from the first corner on, followed by interior ones.

    Args:
        parts: numbers of parts of the three sides, the first from the first corner to the second.
        shape: shape of the face from ``_face_shape``, in sides of a small triangle.
    """
    if parts == (1, 1, 1):
        return np.zeros((0, 3)), np.array([[0, 1, 2]])
    corner = np.array([[0, 0], [shape[0], 0], shape[1:]])
    fractions = [np.arange(n)[:, None] / n for n in parts]
    following = np.roll(corner, -1, 0)
    sides = zip(fractions, corner, following, strict=True)
    rim = np.concatenate([(1 - t) * p + t * q for t, p, q in sides])
    # Slightly outwards, so that the rim's parts are sides of triangles.
    outwards = (following - corner)[:, ::-1] * [1, -1]
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    bulge = np.concatenate([4 * t * (1 - t) * u for t, u in zip(fractions, outwards, strict=True)])
    inner = _interior_points(corner, outwards)
    count = len(rim)

    def triangulate() -> Index:
        return Delaunay(np.concatenate([rim + _BULGE * bulge, inner])).simplices.astype(np.int64)

    for _ in range(_SMOOTHING_ROUNDS if len(inner) else 0):
        inner = _smooth_points(np.concatenate([rim, inner]), triangulate())[count:]
    triangles = triangulate()
    positions = np.concatenate([rim, inner])[triangles]
    first, second = positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0]
    is_clockwise = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0
    triangles[is_clockwise] = triangles[is_clockwise][:, ::-1]
    system = np.concatenate([corner.T, np.ones((1, 3))])
    weights = np.linalg.solve(system, np.concatenate([inner.T, np.ones((1, len(inner)))]))
    return weights.T.astype(np.float64), triangles


def _interior_points(corners: Array, outwards: Array) -> Array:
    """Evenly spaced points inside a triangle, in rows along its longest side."""
    lengths = np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1)
    base = int(lengths.argmax())
    start, inwards = corners[base], -outwards[base]
    along = (corners[(base + 1) % 3] - start) / lengths[base]
    height = float((corners[(base + 2) % 3] - start) @ inwards)
    rows = max(1, round(height / math.sqrt(0.75)))
    steps = max(1, math.ceil(lengths[base] - _LENGTH_SLACK))
    i, j = np.meshgrid(np.arange(-1, steps + 2), np.arange(1, rows + 1), indexing="ij")
    across = (i + 0.5 * (j % 2)) * lengths[base] / steps
    points = start + across.reshape(-1, 1) * along + (j.reshape(-1, 1) * height / rows) * inwards
    inside = np.einsum("sex,ex->se", corners - points[:, None], outwards).min(1) > _RIM_DISTANCE
    return np.asarray(points[inside], dtype=np.float64)


def _smooth_points(points: Array, triangles: Index) -> Array:
    """Move points to the mean of their neighbours (Laplacian smoothing)."""
    total, count = np.zeros_like(points), np.zeros(len(points))
    own, neighbour = (
        triangles.T[[0, 0, 1, 1, 2, 2]].ravel(),
        triangles.T[[1, 2, 2, 0, 0, 1]].ravel(),
    )
    np.add.at(total, own, points[neighbour])
    np.add.at(count, own, 1)
    return np.asarray(total / np.maximum(count, 1)[:, None], dtype=np.float64)


def _is_conforming(vertices: Array, faces: Index, min_gap: float) -> bool:
    """Test if triangles meet in common sides and corners only."""
    if len(np.unique(np.sort(faces, 1), axis=0)) < len(faces):
        return False
    middle = vertices[faces].mean(1)
    radius = np.linalg.norm(vertices[faces] - middle[:, None], axis=2).max(1)
    for rows in np.array_split(np.arange(len(faces)), math.ceil(len(faces) ** 2 / (1 << 22))):
        distance = np.linalg.norm(middle[rows, None] - middle, axis=2)
        near = distance < radius[rows, None] + radius + min_gap
        near[np.arange(len(rows)), rows] = False
        one, other = np.nonzero(near)
        for pairs in np.array_split(np.arange(len(one)), len(one) // _PAIRS_AT_ONCE + 1):
            ends = faces[rows[one[pairs]]], faces[other[pairs]]
            if _triangles_touch(vertices, *ends, min_gap).any():
                return False
    return True


def _triangles_touch(
    vertices: Array, one: Index, other: Index, min_gap: float
) -> NDArray[np.bool_]:
    """Test if vertices or sides of triangles come near triangles that they do not belong to."""
    shared = (one[:, :, None] == other[:, None]).any(2)
    corners, beyond = vertices[one], vertices[other]
    normal = _double_area_vectors(beyond)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inwards = np.cross(normal[:, None], np.roll(beyond, -1, 1) - beyond)
    height = np.einsum("pvx,px->pv", corners - beyond[:, :1], normal)

    def projects_inside(points: Array) -> NDArray[np.bool_]:
        level = np.einsum("psx,psx->ps", beyond, inwards)
        return np.asarray((np.einsum("px,psx->ps", points, inwards) > level).all(1))

    touches = np.zeros(len(one), dtype=bool)
    for v in range(3):
        touches |= ~shared[:, v] & (np.abs(height[:, v]) < min_gap) & projects_inside(corners[:, v])
        w = (v + 1) % 3
        is_free = ~shared[:, v] & ~shared[:, w]
        difference = height[:, v] - height[:, w]
        at = height[:, v] / np.where(difference == 0, 1.0, difference)
        meets = corners[:, v] + at[:, None] * (corners[:, w] - corners[:, v])
        touches |= is_free & (height[:, v] * height[:, w] < 0) & projects_inside(meets)
        for s in range(3):
            e = (s + 1) % 3
            disjoint = ~((one[:, [v, w], None] == other[:, None, [s, e]]).any((1, 2)))
            gap = _segment_distances(corners[:, v], corners[:, w], beyond[:, s], beyond[:, e])
            touches |= disjoint & (gap < min_gap)
            # A corner that lies on a side whose other end is a neighbour.
            gap = _segment_distances(corners[:, v], corners[:, v], beyond[:, s], beyond[:, e])
            touches |= ~shared[:, v] & (gap < min_gap)
    return touches


def _segment_distances(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances of the segments from a to b and from c to d.

    Source: Ericson, Real-Time Collision Detection, §5.1.9.
    """
    first, second, offset = b - a, d - c, a - c
    pairs = (first, first), (second, second), (first, second)
    square, other, mixed = (np.einsum("px,px->p", x, y) for x, y in pairs)
    begin, end = (np.einsum("px,px->p", x, offset) for x in (first, second))
    minimum = 1e-30
    determinant = square * other - mixed**2
    is_skew = determinant > 1e-12 * square * other + minimum
    s = np.clip((mixed * end - begin * other) / np.where(is_skew, determinant, np.inf), 0, 1)
    t = np.clip((mixed * s + end) / np.maximum(other, minimum), 0, 1)
    s = np.clip((mixed * t - begin) / np.maximum(square, minimum), 0, 1)
    difference = offset + s[:, None] * first - t[:, None] * second
    return np.asarray(np.linalg.norm(difference, axis=1), dtype=np.float64)
