"""Winding of closed surfaces: which triangles have normals that point inwards."""

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int64


def find_inward_faces(
    faces: Int64[np.ndarray, "f 3"], points: Float64[np.ndarray, "v 3"]
) -> Bool[np.ndarray, " f"]:
    """Mask of triangles of closed bodies to be turned for all normals to point outwards.

    Parts that are wound consistently stay as they are relative to each other, so that the inner
    surface of a hollow body keeps its normals; the whole is turned if its volume is negative. Else
    neighbours are made to agree, and each part counts as a body, or, inside of another, as a
    cavity.

    Args:
        faces: vertices of each triangle, one vertex at each place.
        points: positions [m].
    """
    inward = np.zeros(len(faces), dtype=bool)
    if not _is_consistent(faces, len(points)):
        agreeing, part = map(np.asarray, igl.bfs_orient(np.ascontiguousarray(faces)))
        turned = (agreeing != faces).any(1)
        counts, turns = np.bincount(part), np.bincount(part, weights=turned)
        if ((turns > 0) & (turns < counts)).any():
            return turned ^ _point_inwards(agreeing, part, points)[part]
    return ~inward if _volumes(faces, points).sum() < 0 else inward


def _is_consistent(faces: Int64[np.ndarray, "f 3"], vertex_count: int) -> bool:
    """Test that no two triangles run along an edge in the same direction."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    code = ends[:, 0] * vertex_count + ends[:, 1]
    return len(np.unique(code)) == len(code)


def _point_inwards(
    faces: Int64[np.ndarray, "f 3"],
    part: Int64[np.ndarray, " f"],
    points: Float64[np.ndarray, "v 3"],
) -> Bool[np.ndarray, " part"]:
    """Mask of parts whose normals point into bodies, of parts that are consistent."""
    surfaces = [faces[part == number] for number in range(part.max() + 1)]
    inwards = np.array([_volumes(own, points).sum() < 0 for own in surfaces])
    for number, own in enumerate(surfaces):
        places = np.ascontiguousarray(points[np.unique(own)])
        for other, around in enumerate(surfaces):
            if other != number:
                winding = igl.winding_number(points, np.ascontiguousarray(around), places)
                inwards[number] ^= bool((np.abs(winding) > 0.5).all())
    return inwards


def _volumes(
    faces: Int64[np.ndarray, "f 3"], points: Float64[np.ndarray, "v 3"]
) -> Float64[np.ndarray, " f"]:
    """Signed volumes between triangles and the middle of all points [m³]."""
    a, b, c = np.moveaxis((points - points.mean(0))[faces], 1, 0)
    return (a * np.cross(b, c)).sum(1) / 6
