"""Meshes of small triangles that fit together, made of any triangles that do.

Sides are cut in equal parts, faces filled with even triangles between these. New vertices are
fixed shares of a face's corners, so that they move with them. Vertices at one place count as one.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray
from scipy.spatial import Delaunay, KDTree

_MERGE_TOLERANCE = 1e-6  # of the size
_MIN_GAP = 8e-3  # of a side: what is nearer and not joined touches
_MIN_FLATNESS = 1e-6  # height of a triangle over its longest side
_LENGTH_SLACK = 1e-3  # of a side that a part may be longer
_RIM_DISTANCE = 0.5  # sides from the rim of a face to what is inside
_SMOOTHING_ROUNDS = 4  # rounds
_BULGE = 1e-5  # of a side
_PAIRS_AT_ONCE = 1 << 17

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class ConformingMesh:
    """Small triangles.

    Attributes:
        parent_vertices: vertices of the given mesh that each vertex is a mean of.
        parent_weights: of these.
        faces: vertices of the triangles, in the order of the given faces.
        parent_face: the given face of each triangle.
        has_merged_vertices: whether given vertices at one place were joined.
    """

    parent_vertices: Int64[np.ndarray, "vertex 3"]
    parent_weights: Float64[np.ndarray, "vertex 3"]
    faces: Int64[np.ndarray, "face 3"]
    parent_face: Int64[np.ndarray, " face"]
    has_merged_vertices: bool


def build_conforming_mesh(
    vertices: Float64[np.ndarray, "v 3"], faces: Int64[np.ndarray, "f 3"], side: float
) -> ConformingMesh | None:
    """Triangles with sides of about a length; None where surfaces cross or touch without joining.

    Args:
        vertices: [m].
        faces: their triangles.
        side: of the small triangles [m].
    """
    joined, seams = _merge_vertices(vertices, faces)
    faces = joined[faces]
    corners = vertices[faces]
    longest = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2).max(1)
    area = np.linalg.norm(_double_area_vectors(corners), axis=1)
    kept = area > _MIN_FLATNESS * longest**2
    numbers = np.flatnonzero(kept)
    faces = faces[kept]
    if not len(faces) or not _is_conforming(vertices, faces, _MIN_GAP * side):
        return None
    # Edges from the lower to the higher vertex, whatever the face.
    ends = np.stack([faces, np.roll(faces, -1, 1)], 2)
    turned = ends[..., 0] > ends[..., 1]
    edges, edge = np.unique(np.sort(ends, 2).reshape(-1, 2), axis=0, return_inverse=True)
    edge = edge.reshape(-1, 3)
    length = np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1)
    parts = np.maximum(1, np.ceil(length / side - _LENGTH_SLACK)).astype(np.int64)
    first = len(vertices) + np.concatenate([[0], (parts - 1).cumsum()])
    every = np.arange(len(vertices))
    parents, shares = [np.stack([every] * 3, 1)], [np.eye(3)[np.zeros(len(vertices), int)]]
    for (low, high), count in zip(edges, parts, strict=True):
        at = np.arange(1, count) / count
        parents.append(np.tile([low, high, high], (count - 1, 1)))
        shares.append(np.stack([1 - at, at, 0 * at], 1))
    count = int(first[-1])
    triangles: list[Index] = []
    for number, face in enumerate(faces):
        mine = edge[number]
        inner, local = _triangulate_face(
            tuple(int(n) for n in parts[mine]),
            _face_shape(vertices[face] / side),
        )
        rim: list[Index] = []
        for corner in range(3):
            between = first[mine[corner]] + np.arange(parts[mine[corner]] - 1)
            rim += [face[corner : corner + 1], between[::-1] if turned[number, corner] else between]
        places = np.concatenate([*rim, count + np.arange(len(inner))])
        parents.append(np.tile(face, (len(inner), 1)))
        shares.append(inner)
        count += len(inner)
        triangles.append(places[local])
    origin = numbers.repeat([len(t) for t in triangles])
    used, small = np.unique(np.concatenate(triangles), return_inverse=True)
    return ConformingMesh(
        np.concatenate(parents)[used],
        np.concatenate(shares)[used],
        small.reshape(-1, 3),
        origin,
        seams,
    )


def _double_area_vectors(corners: Array) -> Array:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal, dtype=np.float64)


def _merge_vertices(vertices: Array, faces: Index) -> tuple[Index, bool]:
    """The first of all vertices at each one's place, and whether there are others."""
    used = np.unique(faces)
    joined = np.arange(len(vertices))
    close = _MERGE_TOLERANCE * float(np.linalg.norm(np.ptp(vertices[used], axis=0)))
    pairs = KDTree(vertices[used]).query_pairs(close, output_type="ndarray")
    for low, high in pairs[np.lexsort(pairs.T)]:
        joined[used[high]] = joined[used[low]]
    return joined, bool(len(pairs))


def _face_shape(corners: Array) -> tuple[float, float, float]:
    """The first side's length, and the last corner's place along it and beside it.

    Rounded: what is inside depends on corners in steps, alike in faces that are alike.
    """
    base, other = corners[1] - corners[0], corners[2] - corners[0]
    length = float(np.linalg.norm(base))
    along = float(base @ other) / length
    beside = math.sqrt(max(float(other @ other) - along**2, 0.0))
    return round(length, 1) + 0.05, round(along, 1), round(beside, 1) + 0.05


@lru_cache(maxsize=4096)
def _triangulate_face(
    parts: tuple[int, ...], shape: tuple[float, float, float]
) -> tuple[Array, Index]:
    """Shares of the vertices inside a face, and its triangles.

    Their vertices are those of the rim in turn, from the first corner on, and then those inside.

    Args:
        parts: of the three sides, the first from the first corner to the second.
        shape: of the face, in sides of a small triangle.
    """
    if parts == (1, 1, 1):
        return np.zeros((0, 3)), np.array([[0, 1, 2]])
    corner = np.array([[0, 0], [shape[0], 0], shape[1:]])
    at = [np.arange(n)[:, None] / n for n in parts]
    following = np.roll(corner, -1, 0)
    rim = np.concatenate(
        [(1 - t) * p + t * q for t, p, q in zip(at, corner, following, strict=True)]
    )
    # A little outwards, so that the rim's parts are sides of triangles.
    outwards = (following - corner)[:, ::-1] * [1, -1]
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    bulge = np.concatenate([4 * t * (1 - t) * u for t, u in zip(at, outwards, strict=True)])
    inner = _interior_points(corner, outwards)
    count = len(rim)
    for _ in range(_SMOOTHING_ROUNDS if len(inner) else 0):
        triangles = Delaunay(np.concatenate([rim + _BULGE * bulge, inner])).simplices.astype(
            np.int64
        )
        inner = _smooth_points(np.concatenate([rim, inner]), triangles)[count:]
    triangles = Delaunay(np.concatenate([rim + _BULGE * bulge, inner])).simplices.astype(np.int64)
    places = np.concatenate([rim, inner])[triangles]
    first, second = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    back = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0
    triangles[back] = triangles[back][:, ::-1]
    system = np.concatenate([corner.T, np.ones((1, 3))])
    shares = np.linalg.solve(system, np.concatenate([inner.T, np.ones((1, len(inner)))]))
    return shares.T.astype(np.float64), triangles


def _interior_points(corners: Array, outwards: Array) -> Array:
    """Places with even distances inside a triangle, in rows along its longest side."""
    lengths = np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1)
    base = int(lengths.argmax())
    start, inwards = corners[base], -outwards[base]
    along = (corners[(base + 1) % 3] - start) / lengths[base]
    height = float((corners[(base + 2) % 3] - start) @ inwards)
    rows = max(1, round(height / math.sqrt(0.75)))
    steps = max(1, math.ceil(lengths[base] - _LENGTH_SLACK))
    i, j = np.meshgrid(np.arange(-1, steps + 2), np.arange(1, rows + 1), indexing="ij")
    across = (i + 0.5 * (j % 2)) * lengths[base] / steps
    spot = start + across.reshape(-1, 1) * along + (j.reshape(-1, 1) * height / rows) * inwards
    inside = np.einsum("sex,ex->se", corners - spot[:, None], outwards).min(1) > _RIM_DISTANCE
    return np.asarray(spot[inside], dtype=np.float64)


def _smooth_points(points: Array, triangles: Index) -> Array:
    """Places moved to the middle of their neighbours."""
    total, count = np.zeros_like(points), np.zeros(len(points))
    for turn in range(3):
        for other in (1, 2):
            here, there = triangles[:, turn], triangles[:, (turn + other) % 3]
            np.add.at(total, here, points[there])
            np.add.at(count, here, 1)
    return np.asarray(total / np.maximum(count, 1)[:, None], dtype=np.float64)


def _is_conforming(vertices: Array, faces: Index, min_gap: float) -> bool:
    """Whether triangles meet in common sides and corners only."""
    if len(np.unique(np.sort(faces, 1), axis=0)) < len(faces):
        return False
    middle = vertices[faces].mean(1)
    radius = np.linalg.norm(vertices[faces] - middle[:, None], axis=2).max(1)
    for some in np.array_split(np.arange(len(faces)), math.ceil(len(faces) ** 2 / (1 << 22))):
        distance = np.linalg.norm(middle[some, None] - middle, axis=2)
        near = distance < radius[some, None] + radius + min_gap
        near[np.arange(len(some)), some] = False
        one, other = np.nonzero(near)
        for rows in np.array_split(np.arange(len(one)), len(one) // _PAIRS_AT_ONCE + 1):
            if _triangles_touch(
                vertices, faces[some[one[rows]]], faces[other[rows]], min_gap
            ).any():
                return False
    return True


def _triangles_touch(
    vertices: Array, one: Index, other: Index, min_gap: float
) -> NDArray[np.bool_]:
    """Whether vertices or sides of triangles come near others that they do not belong to."""
    shared = (one[:, :, None] == other[:, None]).any(2)
    corners, beyond = vertices[one], vertices[other]
    normal = _double_area_vectors(beyond)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sides = np.roll(beyond, -1, 1) - beyond
    inwards = np.cross(normal[:, None], sides)
    height = np.einsum("pvx,px->pv", corners - beyond[:, :1], normal)

    def projects_inside(points: Array) -> NDArray[np.bool_]:
        return np.asarray(
            (
                np.einsum("px,psx->ps", points, inwards) > np.einsum("psx,psx->ps", beyond, inwards)
            ).all(1)
        )

    bad = np.zeros(len(one), dtype=bool)
    for v in range(3):
        bad |= ~shared[:, v] & (np.abs(height[:, v]) < min_gap) & projects_inside(corners[:, v])
        w = (v + 1) % 3
        free = ~shared[:, v] & ~shared[:, w]
        fall = height[:, v] - height[:, w]
        at = height[:, v] / np.where(fall == 0, 1.0, fall)
        meets = corners[:, v] + at[:, None] * (corners[:, w] - corners[:, v])
        bad |= free & (height[:, v] * height[:, w] < 0) & projects_inside(meets)
        for s in range(3):
            e = (s + 1) % 3
            alone = ~((one[:, [v, w], None] == other[:, None, [s, e]]).any((1, 2)))
            gap = _segment_distances(corners[:, v], corners[:, w], beyond[:, s], beyond[:, e])
            bad |= alone & (gap < min_gap)
            # A corner that ends on a side, of which a neighbour is at the other end.
            bad |= ~shared[:, v] & (
                _segment_distances(corners[:, v], corners[:, v], beyond[:, s], beyond[:, e])
                < min_gap
            )
    return bad


def _segment_distances(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances of the lines from a to b and from c to d (Ericson, Real-Time Collision Detection,
    §5.1.9)."""
    first, second, apart = b - a, d - c, a - c
    square, other, both = (
        np.einsum("px,px->p", x, y) for x, y in ((first, first), (second, second), (first, second))
    )
    begin, end = (np.einsum("px,px->p", x, apart) for x in (first, second))
    least = 1e-30
    determinant = square * other - both**2
    s = (both * end - begin * other) / np.where(
        determinant > 1e-12 * square * other + least, determinant, np.inf
    )
    s = np.clip(s, 0, 1)
    t = np.clip((both * s + end) / np.maximum(other, least), 0, 1)
    s = np.clip((both * t - begin) / np.maximum(square, least), 0, 1)
    away = apart + s[:, None] * first - t[:, None] * second
    return np.asarray(np.linalg.norm(away, axis=1), dtype=np.float64)
