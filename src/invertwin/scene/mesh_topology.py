"""Topology of triangle meshes: seams, where surfaces go on, and windings.

Files from CAD programs, STL files and merged parts repeat a corner for each face, equal to rounding
only, and put the corners of one part on an edge of another. An edge is the boundary of a surface
only where no other triangle continues it.

``points`` are positions in metres. ``places`` are normalised: each group of vertices is scaled to a
diagonal of 1, and groups stand side by side (``separate_groups``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeAlias

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int, Int64
from scipy.sparse import coo_array, diags_array, find
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

WELD_TOLERANCE = 1e-6
"""Distance within which vertices count as one, relative to the diagonal of their object."""
CRACK_TOLERANCE = 1e-4
"""Width of the widest cracks between open edges that are closed, relative to the same."""

Points: TypeAlias = Float64[np.ndarray, "v 3"]
Faces: TypeAlias = Int64[np.ndarray, "f 3"]
Numbers: TypeAlias = Int64[np.ndarray, " n"]
Groups: TypeAlias = Int64[np.ndarray, " v"]
Owner: TypeAlias = Int64[np.ndarray, " f"] | int  # object of each triangle
_LINE = 0.8191, 0.4731, 0.3244  # normal to no plane that is usual in models
_BLOCK = 1 << 13  # rows
_MAX_PARTS = 2000  # whose boxes are compared in pairs
_SAME_SIDE = 1e-3  # rad between half planes at an edge that count as one
_MAX_CRACK_SHARE = 1e-3  # of the edges on both sides: width of the widest cracks that are closed
_MAX_OFFSET = 1e-7  # of welded vertices that need not move, relative to the size
_DOUBLINGS = 6  # of the steps in which vertices approach their edges: (2/3)⁶⁴ is left
_MIN_PARALLEL_COSINE = 0.995  # of these edges
_MAX_FOLD_COSINE = 0.985  # of surfaces that go on across a crack, unlike sheets side by side


class Cracks(NamedTuple):
    """Vertices that move onto edges, so that cracks close, and what stays open.

    Attributes:
        vertex: indices of the vertices that move.
        row: index in ``vertex`` of the vertex that each weight belongs to.
        column: vertex whose position each weight multiplies.
        weight: weights of the new positions, which are weighted sums of old ones.
        open_edges: number of open edges that run beside others, across cracks too wide to close.
        width: width of the widest of these cracks, in units of the size of the group.
    """

    vertex: Numbers
    row: Int[np.ndarray, " weight"]
    column: Int[np.ndarray, " weight"]
    weight: Float64[np.ndarray, " weight"]
    open_edges: int
    width: float


def close_cracks(
    points: Points, faces: Faces, groups: Groups | None = None, owner: Owner = 0
) -> tuple[Faces, MeshEdges, Points, Cracks]:
    """Weld vertices and close cracks.

    Args:
        points: positions [m].
        faces: vertices of each triangle.
        groups: group of each vertex, from 0; only those of one group are welded. None = one.
        owner: object of each triangle.

    Returns:
        Welded triangles, edges, positions after the moves in units of the size of their group, and
        the moves that close the cracks.
    """
    groups = np.zeros(len(points), dtype=np.int64) if groups is None else groups
    places = separate_groups(points, groups, faces)
    first, stray = weld_vertices(places), places[:, 0] < 0
    if stray.any():  # they move onto a vertex of their group
        inside = np.flatnonzero(~stray)[::-1]
        lowest = np.full(groups.max() + 1, -1)
        lowest[groups[inside]] = inside
        first = np.where(stray & (lowest[groups] >= 0), lowest[groups], first)
    welded = first[faces]
    whole, onto, open_edges, width = _whole_edges(welded, places, owner), first[:, None], 0, 0.0
    is_open = bool((whole.counts == 1).any())
    edges = _split_at_vertices(whole, places, is_open)

    def are_apart(rows: slice) -> Bool[np.ndarray, " block"]:
        gap = places[rows] - places.take(first[rows], 0)
        return np.vecdot(gap, gap) > _MAX_OFFSET**2

    moves = _by_blocks(are_apart, len(first))
    along = np.zeros(len(places))
    if (edges.counts == 1).any():
        onto, along, open_edges, width = _find_cracks(edges, places)
        onto, along = onto[first], along[first]
        moves |= (onto != first[:, None]).any(1)
    vertex, count = np.flatnonzero(moves), len(places)
    is_closing, share = (onto[vertex] != first[vertex, None]).any(), along[vertex]
    row, column = np.repeat(np.arange(len(vertex)), 2), onto[vertex][:, [0, -1]].ravel()
    weight = np.stack([1 - share, share], 1).ravel()
    if moves[column].any():  # parts side by side divide each other's edges: they meet on one line
        shares = coo_array((weight, (vertex[row], column)), shape=(count, count)).tocsr()
        shares += diags_array(1.0 * ~moves)
        for _ in range(_DOUBLINGS):
            shares = shares @ shares
        row, column, weight = find(shares[vertex])
    places[vertex] = coo_array((weight, (row, column)), shape=(len(vertex), count)) @ places
    if is_closing:
        welded = weld_vertices(places)[faces]
        edges = find_edges(welded, places, owner)
    elif is_open:
        edges = _split_at_vertices(whole, places)
    return welded, edges, places, Cracks(vertex, row, column, weight, open_edges, width)


def _find_cracks(
    edges: MeshEdges, places: Points
) -> tuple[Int64[np.ndarray, "v 2"], Float64[np.ndarray, " v"], int, float]:
    """Find where vertices beside open edges have to move for surfaces that go on there to close.

    Returns:
        Ends of an edge and position on it for each vertex, twice itself for most; number of edges
        along cracks that stay open, and width of the widest.
    """
    is_open = edges.counts == 1
    ends, apex = edges.ends[is_open], edges.apex[np.cumsum(edges.counts)[is_open] - 1]
    start, side = places[ends[:, 0]], places[ends[:, 1]] - places[ends[:, 0]]
    length, axis, into = np.linalg.norm(side, axis=1), _unit(side), places[apex] - start
    into = _unit(into - (into * axis).sum(1)[:, None] * axis)
    # Ends of each edge by themselves, of which those count whose edge runs along the other.
    corners = len(places) + np.arange(2 * len(ends))
    points = np.concatenate([places, places[ends.ravel()]])
    row, corner, share = find_vertices_on_edges(ends, corners, points, 10 * CRACK_TOLERANCE)
    beside, vertex = (corner - len(places)) // 2, ends.ravel()[corner - len(places)]
    share = share.clip(0.0, 1.0)
    gap = np.linalg.norm(places[vertex] - start[row] - share[:, None] * side[row], axis=1)
    reach = np.minimum(_MAX_CRACK_SHARE * np.minimum(length[row], length[beside]), CRACK_TOLERANCE)
    goes_on = (gap <= 10 * reach) & (vertex[:, None] != ends[row]).all(1)
    goes_on &= np.abs((axis[row] * axis[beside]).sum(1)) > _MIN_PARALLEL_COSINE
    goes_on &= (into[row] * into[beside]).sum(1) < _MAX_FOLD_COSINE
    row, vertex, share, gap, reach = (x[goes_on] for x in (row, vertex, share, gap, reach))
    at_end = (gap <= reach) & (np.minimum(share, 1 - share) * length[row] <= reach)
    nearest = np.where(share > 0.5, ends[row, 1], ends[row, 0])
    chain = label_components(np.stack([vertex, nearest], 1)[at_end], len(places))
    lowest = np.unique(chain, return_index=True)[1][chain]
    onto, own, others = np.stack([lowest, lowest], 1), lowest[vertex], lowest[ends[row]]
    rest = np.argsort(-gap, kind="stable")  # of several edges, the nearest counts
    rest = rest[((gap <= reach) & ~at_end)[rest]]
    along = np.zeros(len(places))
    onto[own[rest]], along[own[rest]] = others[rest], share[rest]
    left = (own[:, None] != others).all(1) & (onto[own, 0] == own)
    return onto[lowest], along[lowest], len(np.unique(row[left])), float(gap[left].max(initial=0.0))


def weld_vertices(places: Points) -> Int64[np.ndarray, " v"]:
    """Return for each vertex the first one within the tolerance; chains count as one.

    Args:
        places: positions in units of the size of their group, as ``separate_groups`` returns them.
    """
    # Copies of a place follow each other along any line, and close places are close there.
    along = places[:, 0] * _LINE[0]
    along += places[:, 1] * _LINE[1]
    along += places[:, 2] * _LINE[2]
    along -= along.min()
    finest = 2 ** min(40, 63 - len(along).bit_length()) - 1
    order = np.empty(len(along), dtype=np.int64)
    np.multiply(along, finest / max(along.max(), 1.0), out=order, casting="unsafe")
    sort_order(order)
    start = _find_runs(lambda rows: places.take(order[rows], 0).T, len(order))
    lowest = order[start]
    pairs = _find_close_pairs(places[lowest], along[lowest])
    if len(pairs):
        chain = label_components(pairs, len(start))
        least = np.full(chain.max() + 1, len(places))
        np.minimum.at(least, chain, lowest)
        lowest = least[chain]
    welded = np.empty_like(order)
    welded[order] = np.repeat(lowest, np.diff(start, append=len(order)))
    return welded


def sort_order(numbers: Numbers) -> Numbers:
    """Replace numbers below 2⁶³ over twice their count by their stable order, and return it.

    Their places stand below them in one number each: nine times faster than a stable sort. In their
    own memory, since the first touch of new memory costs as much as the sort.
    """
    bits = len(numbers).bit_length()
    numbers <<= bits
    for start in range(0, len(numbers), _BLOCK):
        numbers[start : start + _BLOCK] |= np.arange(start, min(start + _BLOCK, len(numbers)))
    numbers.sort()
    numbers &= (1 << bits) - 1
    return numbers


def _find_close_pairs(places: Points, along: Float64[np.ndarray, " v"]) -> Int64[np.ndarray, "n 2"]:
    """Return pairs of places within the tolerance, of places in their order along a line."""
    pairs, first, step = list[Int64[np.ndarray, "n 2"]](), np.arange(len(places) - 1), 1
    while len(first):
        first = first[along[first + step] - along[first] <= 1.1 * WELD_TOLERANCE]
        gap = places[first + step] - places[first]
        close = first[np.einsum("ei,ei->e", gap, gap) <= WELD_TOLERANCE**2]
        pairs.append(np.stack([close, close + step], 1))
        step += 1
        first = first[first + step < len(places)]
    return np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])


def sort_rows(*columns: Numbers, count: int) -> tuple[Numbers, Int64[np.ndarray, " u"]]:
    """Return the stable order of rows, and where in it runs of equal ones begin.

    Args:
        columns: numbers of the rows, from 0, the first column counting most.
        count: more than all numbers.
    """
    size, bits = len(columns[0]), count.bit_length()
    if count == 1:
        return np.arange(size), np.arange(min(size, 1))
    held = max(1, (63 - size.bit_length()) // bits)  # columns that one number holds
    parts = [columns[max(0, end - held) : end] for end in range(len(columns), 0, -held)]
    order = sort_order(_pack_columns(parts[0], bits))
    for part in parts[1:]:
        order = order.take(sort_order(_pack_columns(part, bits).take(order)))
    return order, _find_runs(lambda rows: [column.take(order[rows]) for column in columns], size)


def _pack_columns(columns: Sequence[Numbers], bits: int) -> Numbers:
    """Return one number for each row, of the given number of bits for each column."""
    code = columns[0].copy()
    for column in columns[1:]:
        code <<= bits
        code |= column
    return code


def _find_runs(
    columns: Callable[[slice], Iterable[np.ndarray]], count: int
) -> Int64[np.ndarray, " u"]:
    """Return where runs of equal rows begin, of columns that a function returns for some rows."""

    def differ(rows: slice) -> Bool[np.ndarray, " block"]:
        some = columns(slice(rows.start, rows.stop + 1))
        return np.logical_or.reduce([column[1:] != column[:-1] for column in some])

    return np.flatnonzero(np.append(count > 0, _by_blocks(differ, count)))


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


def triangle_sides(faces: Faces) -> tuple[Numbers, Numbers]:
    """Return start and end of the sides of triangles: all first sides, and so on.

    Args:
        faces: vertices of each triangle.
    """
    a, b, c = faces.T
    return np.concatenate([a, b, c]), np.concatenate([b, c, a])


def separate_groups(points: Points, groups: Groups, faces: Faces) -> Points:
    """Scale each group of vertices to a diagonal of 1, and place them side by side.

    Exports leave vertices of no triangle, and triangles that are points, anywhere, as at the
    origin: they stand aside of all groups, at negative x, and no size depends on them.

    Args:
        points: positions [m].
        groups: number of the group of each vertex, from 0.
        faces: vertices of each triangle.
    """

    def may_be_points(rows: slice) -> Bool[np.ndarray, " block"]:
        x = points[:, 0][faces[rows]]
        return (x[:, 0] == x[:, 1]) & (x[:, 0] == x[:, 2])

    used, found = np.zeros(len(points), dtype=bool), points.copy()
    flat = np.flatnonzero(_by_blocks(may_be_points, len(faces)))
    flat = flat[(points[faces[flat]] == points[faces[flat, :1]]).all((1, 2))]
    used[np.delete(faces, flat, axis=0) if len(flat) else faces] = True
    parts = [slice(None)]
    if groups.any() or not used.all():
        inside = np.flatnonzero(used)
        index, start = sort_rows(groups[inside], count=int(groups.max()) + 1)
        parts = np.split(inside[index], start[1:])[: len(start)]
    for row, own in enumerate(parts):
        # Extrema of one run, ten times faster than those along the axis.
        part = found[own]
        part -= np.minimum.reduceat(part, [0])
        part /= np.linalg.norm(np.maximum.reduceat(part, [0])) or 1.0
        part[:, 0] += 2.0 * row
        found[own] = part
    found[~used] = -1.0
    return found


class MeshEdges(NamedTuple):
    """Edges of triangles, and their half edges (sides of triangles), one edge after the other.

    Attributes:
        ends: vertices of each edge, in ascending order.
        counts: number of half edges of each edge.
        apex: opposite vertex of each half edge.
        triangle: triangle of each half edge.
    """

    ends: Int64[np.ndarray, "e 2"]
    counts: Int64[np.ndarray, " e"]
    apex: Int64[np.ndarray, " h"]
    triangle: Int64[np.ndarray, " h"]


def find_edges(faces: Faces, places: Points, owner: Owner = 0) -> MeshEdges:
    """Find the edges of triangles.

    Slivers and repetitions of a triangle in one object have none. A side on which vertices of
    other edges lie is several, from one to the next.

    Args:
        faces: welded vertices of each triangle.
        places: positions in units of the size of their group.
        owner: object of each triangle; repetitions in others count.
    """
    return _split_at_vertices(_whole_edges(faces, places, owner), places)


def _whole_edges(faces: Faces, places: Points, owner: Owner) -> MeshEdges:
    """Find the edges of triangles; vertices that lie on a side do not divide it."""
    whole = _sides_of(faces, np.flatnonzero(~find_slivers(faces, places)), len(places))
    # A repeated triangle has two half edges of one apex at its edges.
    if whole.counts.max(initial=0) > 2 or (np.diff(_pairs_at_edges(whole, whole.apex)) == 0).any():
        whole = _sides_of(faces, find_distinct_faces(faces, places, owner), len(places))
    return whole


def _sides_of(faces: Faces, number: Numbers, vertex_count: int) -> MeshEdges:
    """Group the sides of some triangles by edges."""
    used = faces if len(number) == len(faces) else faces[number]
    apex = np.concatenate([used[:, 2], used[:, 0], used[:, 1]])
    return _group_sides(*triangle_sides(used), apex, np.tile(number, 3), vertex_count)


def _by_blocks(function: Callable[[slice], np.ndarray], count: int) -> np.ndarray:
    """Join results of blocks of rows, small enough for the processor's cache."""
    starts = range(0, max(count, 1), _BLOCK)
    return np.concatenate([function(slice(start, start + _BLOCK)) for start in starts])


def find_distinct_faces(faces: Faces, places: Points, owner: Owner = 0) -> Numbers:
    """Return the numbers of triangles that are neither slivers nor repetitions in one object.

    Args:
        faces: welded vertices of each triangle.
        places: positions in units of the size of their group.
        owner: object of each triangle.
    """
    number = np.flatnonzero(~find_slivers(faces, places))
    a, b, c = faces[number].T
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    body = np.broadcast_to(owner, len(faces))[number]
    order, start = sort_rows(low, a + b + c - low - high, high, body, count=len(places))
    return number if len(start) == len(order) else number[np.sort(order[start])]


def merge_doubled_sides(edges: MeshEdges, places: Points, owner: Owner = 0) -> MeshEdges:
    """Keep one of the half edges of an object that lie in one half plane at an edge.

    Where faces are doubled, by other triangles or by bodies with planes in common, the surface
    goes on once.

    Args:
        edges: edges of triangles.
        places: positions in units of the size of their group.
        owner: object of each triangle.
    """
    if edges.counts.max(initial=0) < 3:
        return edges
    side, _, plane = _sort_around_edges(edges, places)
    body = edges.triangle[side] * 0 if isinstance(owner, int) else owner[edges.triangle[side]]
    order = np.lexsort((body, plane))
    kept = np.ones(len(edges.apex), dtype=bool)
    kept[side[order[1:]]] = (np.diff(plane[order]) != 0) | (np.diff(body[order]) != 0)
    counts = np.bincount(np.repeat(np.arange(len(edges.counts)), edges.counts)[kept])
    return MeshEdges(edges.ends, counts, edges.apex[kept], edges.triangle[kept])


def _sort_around_edges(
    edges: MeshEdges, places: Points, least: int = 3
) -> tuple[Numbers, Numbers, Numbers]:
    """Sort the half edges at edges with ``least`` or more of them by angle about the edge.

    Returns:
        Number, edge and half plane of each; half planes are numbered in the order of the angle, one
        edge after the other.
    """
    edge = np.repeat(np.arange(len(edges.counts)), edges.counts)
    side = np.flatnonzero((edges.counts >= least)[edge])
    edge, (start, end) = edge[side], np.moveaxis(places[edges.ends[edge[side]]], 1, 0)
    axis, into = _unit(end - start), places[edges.apex[side]] - start
    into = _unit(into - (into * axis).sum(1)[:, None] * axis)
    x = into[np.searchsorted(edge, edge)]  # of the first half edge
    angle = np.arctan2((into * np.cross(axis, x)).sum(1), (into * x).sum(1))
    angle = (angle + _SAME_SIDE) % (2 * np.pi)
    order = np.lexsort((angle, edge))
    turns = np.diff(angle[order], prepend=0.0) > _SAME_SIDE
    turns |= np.diff(edge[order], prepend=-1) != 0
    return side[order], edge[order], np.cumsum(turns)


def _unit(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def _group_sides(
    start: Numbers, end: Numbers, apex: Numbers, triangle: Numbers, vertex_count: int
) -> MeshEdges:
    """Group half edges by their edges, in the memory of ``end``, which is lost."""
    low, high = np.minimum(start, end), np.maximum(start, end, out=end)
    order, first = sort_rows(low, high, count=vertex_count)
    ends = np.stack([low[order[first]], high[order[first]]], 1)
    apex.take(order, out=low, mode="clip")  # new memory would take longer, as in sort_order
    triangle.take(order, out=high, mode="clip")
    return MeshEdges(ends, np.diff(first, append=len(order)), low, high)


def find_slivers(faces: Faces, places: Points) -> Bool[np.ndarray, " f"]:
    """Mask of triangles that are narrower than the tolerance.

    Args:
        faces: vertices of each triangle.
        places: positions in units of the size of their group.
    """

    def are_slivers(rows: slice) -> Bool[np.ndarray, " block"]:
        a, b, c = np.moveaxis(places.take(faces[rows], 0), 1, 0)
        one, other = b - a, c - a
        square, across, common = (np.vecdot(*p) for p in ((one, one), (other, other), (one, other)))
        longest = np.maximum(np.maximum(square, across), square + across - 2 * common)
        # |a × b|² = a² b² − (a · b)², whose rounding is far below the square of the tolerance.
        return square * across - common**2 <= WELD_TOLERANCE**2 * longest

    return _by_blocks(are_slivers, len(faces))


def _split_at_vertices(edges: MeshEdges, places: Points, before_cracks: bool = False) -> MeshEdges:
    """Split edges at the vertices of others that lie on them.

    Args:
        edges: edges of triangles.
        places: positions in units of the size of their group.
        before_cracks: True if cracks are closed next. Vertices off the edge or beside its end then
            move onto either, rather than to stay aside or to cut a short piece off.
    """
    # Two triangles complete an edge, except where another part of the mesh touches it.
    candidates = edges.counts != 2
    pairs = _pairs_at_edges(edges, edges.triangle)
    if len(pairs):
        part = label_components(pairs, int(pairs.max()) + 1)[pairs[:, 0]]
        if part.any():  # not a single one
            candidates[~candidates] = near_other_parts(places[edges.ends[~candidates]], part)
    rows = np.flatnonzero(candidates)
    ends = edges.ends[rows]
    tolerance, shortest = (_MAX_OFFSET, CRACK_TOLERANCE) if before_cracks else (WELD_TOLERANCE, 0.0)
    row, vertex, share = find_vertices_on_edges(ends, np.unique(ends), places, tolerance)
    inner = (vertex[:, None] != ends[row]).all(1)
    gap = np.linalg.norm(places[vertex, None] - places[ends[row]], axis=2).min(1)
    inner &= gap > shortest
    if not inner.any():
        return edges
    order = np.flatnonzero(inner)[np.lexsort((share[inner], row[inner]))]
    row, vertex = row[order], vertex[order]
    pieces = np.bincount(rows[row], minlength=len(edges.ends)) + 1
    # Stations along each edge, one edge after the other: an end, the vertices on it, the other end.
    stations = np.insert(edges.ends.ravel(), 2 * rows[row] + 1, vertex)
    first = np.cumsum(pieces + 1) - (pieces + 1)
    group = np.repeat(np.arange(len(pieces)), edges.counts)
    count = pieces[group]
    piece = np.repeat(np.arange(len(group)), count)
    at = first[group[piece]] + (np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count))
    ends = stations[at], stations[at + 1]
    return _group_sides(*ends, edges.apex[piece], edges.triangle[piece], len(places))


def find_parts(faces: Faces, places: Points) -> Int64[np.ndarray, " f"]:
    """Return the part of each triangle, connected across edges; −1 = none.

    Where bodies touch along an edge, neighbours are those that bound one body by their normals.
    Triangles that lie on each other at an edge are none: a sheet and its other side are two parts.
    Slivers and repetitions of a triangle, except those of the opposite normal, belong to no part.

    Args:
        faces: welded vertices of each triangle.
        places: positions in units of the size of their group.
    """
    a, b, c = faces.T
    edges = find_edges(faces, places, ((a > b) ^ (b > c) ^ (a > c)).astype(np.int64))
    side, edge, plane = _sort_around_edges(edges, places, 2)
    two = (edges.counts == 2)[edge]
    beside = edges.triangle[side[two]].reshape(-1, 2)[np.diff(plane[two].reshape(-1, 2))[:, 0] != 0]
    around = _pairs_of_bodies(edges, (side[~two], edge[~two], plane[~two]), faces, places)
    label = label_components(np.concatenate([beside, around]), len(faces))
    real, found = np.unique(edges.triangle), np.full(len(faces), -1)
    found[real] = np.unique(label[real], return_inverse=True)[1].ravel()
    return found


def _pairs_at_edges(edges: MeshEdges, values: Int64[np.ndarray, " h"]) -> Int64[np.ndarray, "e2 2"]:
    """Return the values of both half edges of each edge that has two."""
    return values[np.repeat(edges.counts == 2, edges.counts)].reshape(-1, 2)


def _pairs_of_bodies(
    edges: MeshEdges, around: Sequence[np.ndarray], faces: Faces, places: Points
) -> Int64[np.ndarray, "n 2"]:
    """Return triangles that follow each other around an edge of several, with a body in between."""
    side, edge, plane = around
    triangle = edges.triangle[side]
    a, b, c = np.moveaxis(places[faces[triangle]], 1, 0)
    start, end = np.moveaxis(places[edges.ends[edge]], 1, 0)
    onwards = np.cross(end - start, places[edges.apex[side]] - start)
    opens = (np.cross(b - a, c - a) * onwards).sum(1) < 0  # the body lies at greater angles
    # Of two faces in contact, the one at which a body ends is first; doubled ones are ambiguous.
    order = np.lexsort((opens, plane))
    single = np.bincount(2 * plane + opens)[2 * plane + opens] == 1
    triangle, opens, single = triangle[order], opens[order], single[order]
    last = np.append(np.flatnonzero(np.diff(edge)), len(edge) - 1)[: len(edge)]
    following = np.arange(1, len(edge) + 1)
    following[last] = np.searchsorted(edge, edge[last])
    found = opens & ~opens[following] & single & single[following]
    return np.stack([triangle, triangle[following]], 1)[found]


def near_other_parts(
    corners: Float64[np.ndarray, "n corner 3"], part: Numbers
) -> Bool[np.ndarray, " n"]:
    """Mask of edges or triangles whose boxes meet those of other parts.

    Args:
        corners: ends or corners of each, in units of the size of their group.
        part: part of each.
    """
    order = np.argsort(part, kind="stable")
    present, start = np.unique(part[order], return_index=True)
    if not 1 < len(present) <= _MAX_PARTS:
        return np.full(len(part), len(present) > 1)
    lowest, highest = corners.min(1), corners.max(1)
    low = np.minimum.reduceat(lowest[order], start) - WELD_TOLERANCE
    high = np.maximum.reduceat(highest[order], start) + WELD_TOLERANCE
    one, other = np.nonzero(overlapping_boxes(low, high))
    reach = np.full_like(low, np.inf), np.full_like(high, -np.inf)
    np.minimum.at(reach[0], one, np.maximum(low[one], low[other]))
    np.maximum.at(reach[1], one, np.minimum(high[one], high[other]))
    own = np.searchsorted(present, part)
    return ((lowest <= reach[1][own]) & (highest >= reach[0][own])).all(1)


def find_vertices_on_edges(
    edges: Int64[np.ndarray, "e 2"],
    vertices: Int64[np.ndarray, " c"],
    places: Points,
    tolerance: float = WELD_TOLERANCE,
) -> tuple[Numbers, Numbers, Float64[np.ndarray, " n"]]:
    """Return edge, vertex and position along the edge, 0 to 1, of vertices that lie on edges.

    Args:
        edges: ends of each edge.
        vertices: vertices that count.
        places: positions of all vertices, in units of the size of their group.
        tolerance: greatest distance from the edge, in these units.
    """
    if not len(edges) or not len(vertices):
        return edges[:0, 0], edges[:0, 0], np.zeros(0)
    start, side = places[edges[:, 0]], places[edges[:, 1]] - places[edges[:, 0]]
    length = np.linalg.norm(side, axis=1)
    tree = cKDTree(places[vertices], balanced_tree=False, compact_nodes=False)
    near = tree.query_ball_point(start + 0.5 * side, 0.5 * length + tolerance, return_sorted=False)
    row = np.repeat(np.arange(len(edges)), [len(found) for found in near])
    vertex = vertices[np.concatenate(near).astype(np.int64)]
    offset = places[vertex] - start[row]
    along = (offset * side[row]).sum(1) / length[row]
    aside = np.linalg.norm(offset - (along / length[row])[:, None] * side[row], axis=1)
    on = (aside <= tolerance) & (along >= -tolerance) & (along <= length[row] + tolerance)
    return row[on], vertex[on], along[on] / length[row[on]]


def find_inward_faces(faces: Faces, points: Float64[np.ndarray, "v 3"]) -> Bool[np.ndarray, " f"]:
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
    return ~inward if _volume(faces, points) < 0 else inward


def _is_consistent(faces: Faces, vertex_count: int) -> bool:
    """Test that triangles run along each edge as often in one direction as in the other.

    The sum over all sides of a product of random numbers of their ends decides, with the sign of
    the direction.
    """
    chance = np.random.default_rng(0).integers(1 << 62, size=vertex_count)
    corners = [(corner, chance[corner]) for corner in faces.T]
    total = 0
    for (start, one), (end, other) in zip(corners, corners[1:] + corners[:1], strict=True):
        total += int((one * other * np.sign(end - start)).sum())
    return total % (1 << 64) == 0


def _point_inwards(
    faces: Faces, part: Int64[np.ndarray, " f"], points: Float64[np.ndarray, "v 3"]
) -> Bool[np.ndarray, " part"]:
    """Mask of parts whose normals point into bodies, of parts that are consistent."""
    surfaces = [faces[part == number] for number in range(part.max() + 1)]
    inwards = np.array([_volume(own, points) < 0 for own in surfaces])
    for number, own in enumerate(surfaces):
        places = np.ascontiguousarray(points[np.unique(own)])
        for other, around in enumerate(surfaces):
            if other != number:
                winding = igl.winding_number(points, np.ascontiguousarray(around), places)
                inwards[number] ^= bool((np.abs(winding) > 0.5).all())
    return inwards


def _volume(faces: Faces, points: Float64[np.ndarray, "v 3"]) -> float:
    """Signed volume of the body that triangles bound [m³]."""
    middle = points[faces[0, 0]]  # far from the origin, differences would cancel

    def signed_volumes(rows: slice) -> Float64[np.ndarray, " block"]:
        a, b, c = np.moveaxis(points.take(faces[rows], 0) - middle, 1, 0)
        return np.vecdot(a, np.cross(b, c)) / 6

    return float(_by_blocks(signed_volumes, len(faces)).sum())
