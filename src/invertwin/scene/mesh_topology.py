"""Topology of triangle meshes: seams, where surfaces go on, and windings.

Files from CAD programs, STL files and merged parts repeat a corner for each face, equal to rounding
only, and put the corners of one part on an edge of another. An edge is the boundary of a surface
only where no other triangle continues it.
"""

from __future__ import annotations

from typing import TypeAlias

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

WELD_TOLERANCE = 1e-6
"""Distance within which vertices count as one, relative to the diagonal of their object."""

Points: TypeAlias = Float64[np.ndarray, "v 3"]
Groups: TypeAlias = Int64[np.ndarray, " v"]
# Of a hash of three numbers: odd constants of good mixing.
_MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
_MAX_PARTS = 2000  # whose boxes are compared in pairs


def weld_faces(
    points: Points, faces: Int64[np.ndarray, "f 3"], groups: Groups | None = None
) -> tuple[Int64[np.ndarray, "f 3"], Points]:
    """Return triangles by welded vertices, and positions in units of the size of their group.

    Args:
        points: positions [m].
        faces: vertices of each triangle.
        groups: group of each vertex, from 0; only those of one group are welded. None = one.
    """
    groups = np.zeros(len(points), dtype=np.int64) if groups is None else groups
    places = separate_groups(points, groups)
    return weld_vertices(places)[faces], places


def weld_vertices(places: Points) -> Int64[np.ndarray, " v"]:
    """Return for each vertex the first one within the tolerance; chains count as one.

    Args:
        places: positions in units of the size of their group, as ``separate_groups`` returns them.
    """
    # Equal to the last bit first: files repeat each corner about six times.
    first, inverse = _unique_rows(np.ascontiguousarray(places).view(np.int64))
    tree = cKDTree(places[first], balanced_tree=False, compact_nodes=False)
    pairs = first[tree.query_pairs(WELD_TOLERANCE, output_type="ndarray")]
    welded = first[inverse]
    if len(pairs):
        chain = label_components(pairs, len(places))[welded]
        lowest = np.full(chain.max() + 1, len(places))
        np.minimum.at(lowest, chain, welded)
        welded = lowest[chain]
    return welded


def _unique_rows(
    rows: Int64[np.ndarray, "n 3"],
) -> tuple[Int64[np.ndarray, " u"], Int64[np.ndarray, " n"]]:
    """Return the first row of each kind, and the kind of each row; by hashes, which sort faster."""
    mixed = (rows.view(np.uint64) * _MIXERS).sum(1, dtype=np.uint64)
    _, first, inverse = np.unique(mixed, return_index=True, return_inverse=True)
    if not np.array_equal(rows[first][inverse], rows):  # two kinds with one hash
        _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first, inverse.ravel()


def label_components(pairs: Int64[np.ndarray, "n 2"], count: int) -> Int64[np.ndarray, " node"]:
    """Return the number of the connected component of each node.

    Args:
        pairs: connected nodes.
        count: number of nodes.
    """
    graph = coo_array((np.ones(len(pairs), dtype=bool), tuple(pairs.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def overlapping_boxes(
    low: Float64[np.ndarray, "n 3"], high: Float64[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n n"]:
    """Mask of pairs of different boxes that overlap or touch.

    Args:
        low: lower corners.
        high: upper corners.
    """
    meets = ~np.eye(len(low), dtype=bool)
    for axis in range(3):
        meets &= low[:, None, axis] <= high[:, axis]
    return meets & meets.T


def triangle_sides(faces: Int64[np.ndarray, "f 3"]) -> Int64[np.ndarray, "h 2"]:
    """Return the ends of the sides of triangles in their direction: all first sides, and so on.

    Args:
        faces: vertices of each triangle.
    """
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def separate_groups(points: Points, groups: Groups) -> Points:
    """Scale each group of vertices to a diagonal of 1, and place them side by side.

    Args:
        points: positions [m].
        groups: number of the group of each vertex, from 0.
    """
    index = np.argsort(groups, kind="stable")
    present, start = np.unique(groups[index], return_index=True)
    low, high = (f.reduceat(points[index], start) for f in (np.minimum, np.maximum))
    size = np.linalg.norm(high - low, axis=1)
    row = np.searchsorted(present, groups)
    places = (points - low[row]) / np.where(size > 0, size, 1.0)[row, None]
    places[:, 0] += 2.0 * row
    return places + 0.0  # −0 and 0 are one place


def half_edges(
    faces: Int64[np.ndarray, "f 3"], places: Points, owner: Int64[np.ndarray, " f"] | int = 0
) -> tuple[Int64[np.ndarray, "h 2"], Int64[np.ndarray, " h"], Int64[np.ndarray, " h"]]:
    """Return the sides of triangles: ends in ascending order, opposite vertex, and triangle.

    Slivers and repetitions of a triangle in one object have no sides. A side on which vertices of
    other edges lie is several, from one to the next.

    Args:
        faces: welded vertices of each triangle.
        places: positions in units of the size of their group.
        owner: object of each triangle.
    """
    number = np.flatnonzero(~_is_sliver(places[faces]))
    kinds = np.sort(faces, axis=1) + np.reshape(owner, (-1, 1)) * len(places)
    number = number[np.sort(_unique_rows(kinds[number])[0])]
    corners = faces[number]
    ends = np.sort(triangle_sides(corners), axis=1)
    apex = corners[:, [2, 0, 1]].T.ravel()
    return _split_at_vertices(ends, apex, np.tile(number, 3), places)


def _is_sliver(corners: Float64[np.ndarray, "f 3 3"]) -> Bool[np.ndarray, " f"]:
    """Mask of triangles that are narrower than the tolerance."""
    sides = corners[:, [1, 2, 0]] - corners
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return area <= WELD_TOLERANCE * np.linalg.norm(sides, axis=2).max(1, initial=0.0)


def _split_at_vertices(
    ends: Int64[np.ndarray, "h 2"],
    apex: Int64[np.ndarray, " h"],
    triangle: Int64[np.ndarray, " h"],
    places: Points,
) -> tuple[Int64[np.ndarray, "p 2"], Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
    """Split half edges at the vertices of other edges that lie on them."""
    edges, group, counts = unique_edges(ends, len(places))
    # Two triangles complete an edge, except where another part of the mesh touches it.
    candidates = counts != 2
    pairs = _pairs_of_triangles(triangle, group, counts)
    if len(pairs):
        candidates[~candidates] = _near_other_parts(edges[~candidates], pairs, places)
    rows = np.flatnonzero(candidates)
    row, vertex, share = find_vertices_on_edges(edges[rows], np.unique(edges[rows]), places)
    inner = (vertex[:, None] != edges[rows[row]]).all(1)
    if not inner.any():
        return ends, apex, triangle
    order = np.flatnonzero(inner)[np.lexsort((share[inner], row[inner]))]
    row, vertex = row[order], vertex[order]
    pieces = np.bincount(rows[row], minlength=len(edges)) + 1
    # Stations along each edge, one edge after the other: an end, the vertices on it, the other end.
    first = np.cumsum(pieces + 1) - (pieces + 1)
    stations = np.empty(int((pieces + 1).sum()), dtype=np.int64)
    stations[first], stations[first + pieces] = edges.T
    inner = np.ones(len(stations), dtype=bool)
    inner[first] = inner[first + pieces] = False
    stations[inner] = vertex
    count = pieces[group]
    piece = np.repeat(np.arange(len(ends)), count)
    step = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    at = first[group[piece]] + step
    return np.sort(np.stack([stations[at], stations[at + 1]], 1), 1), apex[piece], triangle[piece]


def unique_edges(
    ends: Int64[np.ndarray, "h 2"], vertex_count: int
) -> tuple[Int64[np.ndarray, "e 2"], Int64[np.ndarray, " h"], Int64[np.ndarray, " e"]]:
    """Return edges in ascending order, the edge of each half edge, and the numbers of these.

    Args:
        ends: ends of half edges, in ascending order each.
        vertex_count: number of vertices.
    """
    code = ends[:, 0] * vertex_count + ends[:, 1]
    _, first, group, counts = np.unique(
        code, return_index=True, return_inverse=True, return_counts=True
    )
    return ends[first], group.ravel(), counts


def find_parts(faces: Int64[np.ndarray, "f 3"], places: Points) -> Int64[np.ndarray, " f"]:
    """Return the part of each triangle, connected across edges of two triangles; −1 = none.

    Slivers and repetitions of a triangle belong to no part.

    Args:
        faces: welded vertices of each triangle.
        places: positions in units of the size of their group.
    """
    ends, _, triangle = half_edges(faces, places)
    _, group, counts = unique_edges(ends, len(places))
    pairs = _pairs_of_triangles(triangle, group, counts)
    label, found = label_components(pairs, len(faces)), np.full(len(faces), -1)
    real = np.unique(triangle)
    found[real] = np.unique(label[real], return_inverse=True)[1].ravel()
    return found


def _pairs_of_triangles(
    triangle: Int64[np.ndarray, " h"],
    group: Int64[np.ndarray, " h"],
    counts: Int64[np.ndarray, " e"],
) -> Int64[np.ndarray, "e2 2"]:
    """Return the triangles of each edge that has two."""
    order = np.argsort(group, kind="stable")
    return triangle[order[np.repeat(counts == 2, counts)]].reshape(-1, 2)


def _near_other_parts(
    edges: Int64[np.ndarray, "e 2"],
    pairs: Int64[np.ndarray, "e 2"],
    places: Points,
) -> Bool[np.ndarray, " e"]:
    """Mask of edges of two triangles that are near another part, connected by such edges.

    Args:
        edges: ends of each edge.
        pairs: its two triangles.
        places: positions in units of the size of their group.
    """
    ones, part = np.ones(len(pairs), dtype=bool), label_components(pairs, int(pairs.max()) + 1)
    part = part[pairs[:, 0]]
    order = np.argsort(part, kind="stable")
    present, start = np.unique(part[order], return_index=True)
    if len(present) == 1:
        return ~ones
    if len(present) > _MAX_PARTS:
        return ones
    ends = places[edges]
    low = np.minimum.reduceat(ends.min(1)[order], start) - WELD_TOLERANCE
    high = np.maximum.reduceat(ends.max(1)[order], start) + WELD_TOLERANCE
    one, other = np.nonzero(overlapping_boxes(low, high))
    reach = np.full_like(low, np.inf), np.full_like(high, -np.inf)
    np.minimum.at(reach[0], one, np.maximum(low[one], low[other]))
    np.maximum.at(reach[1], one, np.minimum(high[one], high[other]))
    own = np.searchsorted(present, part)
    return ((ends.min(1) <= reach[1][own]) & (ends.max(1) >= reach[0][own])).all(1)


def find_vertices_on_edges(
    edges: Int64[np.ndarray, "e 2"], vertices: Int64[np.ndarray, " c"], places: Points
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Return edge, vertex and position along the edge, 0 to 1, of vertices that lie on edges.

    Args:
        edges: ends of each edge.
        vertices: vertices that count.
        places: positions of all vertices, in units of the size of their group.
    """
    if not len(edges) or not len(vertices):
        return edges[:0, 0], edges[:0, 0], np.zeros(0)
    start, side = places[edges[:, 0]], places[edges[:, 1]] - places[edges[:, 0]]
    length = np.linalg.norm(side, axis=1)
    tree = cKDTree(places[vertices], balanced_tree=False, compact_nodes=False)
    radius = 0.5 * length + WELD_TOLERANCE
    near = tree.query_ball_point(start + 0.5 * side, radius, return_sorted=False)
    row = np.repeat(np.arange(len(edges)), [len(found) for found in near])
    vertex = vertices[np.concatenate(near).astype(np.int64)]
    offset = places[vertex] - start[row]
    along = (offset * side[row]).sum(1) / length[row]
    aside = np.linalg.norm(offset - (along / length[row])[:, None] * side[row], axis=1)
    on = (aside <= WELD_TOLERANCE) & (along >= -WELD_TOLERANCE)
    on &= along <= length[row] + WELD_TOLERANCE
    return row[on], vertex[on], along[on] / length[row[on]]


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
        oriented = igl.bfs_orient(np.ascontiguousarray(faces))
        agreeing, part = (np.asarray(found).astype(np.int64) for found in oriented)
        turned = (agreeing != faces).any(1)
        counts, turns = np.bincount(part), np.bincount(part, weights=turned)
        if ((turns > 0) & (turns < counts)).any():
            return turned ^ _point_inwards(agreeing, part, points)[part]
    return ~inward if _volumes(faces, points).sum() < 0 else inward


def _is_consistent(faces: Int64[np.ndarray, "f 3"], vertex_count: int) -> bool:
    """Test that no two triangles run along an edge in the same direction."""
    start, end = triangle_sides(faces).T
    code = start * vertex_count + end
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
