"""Intersection curves of surfaces: common segments of pairs of triangles, in float64.

Edges are rays through the tree: each end of such a segment is where an edge of one triangle meets
the other. The tree, in float32, only proposes pairs; float64 decides (derivations §3).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel.rays.arrays import gather_points, to_index, to_torch
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RAY_EPSILON, RayScene
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.channel.rays.topology import Topology
from invertwin.channel.rows import Rows, bound_groups, concatenate_rows

_Numbers = Int64[Tensor, " n"]
PLANE_TOLERANCE = 1e-9  # closer than this to a plane [m] is in it
_MIN_PLANE_SINE = 1e-7  # least sine of the angle between two planes that cross
_EDGE_EXTENSION = 4e-7  # how far an edge's ray goes beyond its ends, relative to their coordinates
_MAX_HITS = 64  # surfaces that an edge may pass

# Instead of a side's edge (−1: it has none): no side in the plane, or the surface goes on beyond.
_PASSES = -2


@dataclass(frozen=True)
class IntersectionCurves(Rows):
    """Common segments of pairs of triangles.

    Attributes:
        first, second: triangle indices.
        start, end: ends of the segments in the world [m].
        touching: True if one surface ends in the other, so that the segment is no crossing.
        edge: edge of the first surface that ends in the second, beyond which that goes on; −1
            elsewhere.
    """

    first: _Numbers
    second: _Numbers
    start: Float64[Tensor, "n 3"]
    end: Float64[Tensor, "n 3"]
    touching: Bool[Tensor, " n"]
    edge: _Numbers


def find_possible_intersections(
    geometry: Geometry,
) -> tuple[Bool[Tensor, "object object"], Tensor, Tensor]:
    """Find pairs of objects that may intersect: one moves past the other, and their boxes overlap.

    An object may intersect itself if its own shape changes. Rigid objects of one group, which keep
    together along edges, do not pass each other.

    Args:
        geometry: scene as flat tables.

    Returns:
        The pairs, and per object the bounds of all overlaps, low and high [m].
    """
    moving = torch.tensor(geometry.differentiated)
    deforming = torch.tensor(geometry.shape_differentiated)
    pairs = (moving[:, None] | moving).fill_diagonal_(False) | torch.diag(deforming)
    groups = geometry.topology.object_group
    pairs &= (groups[:, None] != groups) | deforming[:, None] | deforming
    return find_overlapping_boxes(geometry.topology, geometry.vertices.detach(), pairs)


def find_overlapping_boxes(
    topology: Topology, vertices: Float64[Tensor, "v 3"], pairs: Bool[Tensor, "object object"]
) -> tuple[Bool[Tensor, "object object"], Tensor, Tensor]:
    """Find those of some pairs of objects whose boxes overlap.

    Args:
        topology: triangles of the vertices.
        vertices: world positions, detached [m].
        pairs: pairs of objects.

    Returns:
        The pairs, and per object the bounds of all overlaps, low and high [m].
    """
    low, high = bound_groups(topology.vertex_object, vertices, len(pairs))
    margin = 1e-5 * (high - low).amax().clamp_min(1.0)
    low, high = low - margin, high + margin
    for axis in range(3):
        reaches = low[:, None, axis] <= high[:, axis]
        pairs = pairs & reaches & reaches.T
    first, second = pairs.nonzero(as_tuple=True)
    rows = first[:, None].expand(-1, 3)
    place = torch.full_like(low, torch.inf)
    place.scatter_reduce_(0, rows, torch.maximum(low[first], low[second]), "amin")
    until = torch.full_like(high, -torch.inf)
    until.scatter_reduce_(0, rows, torch.minimum(high[first], high[second]), "amax")
    return pairs, place, until


def find_intersection_curves(rays: RayScene) -> IntersectionCurves | None:
    """Find all segments in which surfaces meet that move past each other; None if none can.

    Args:
        rays: ray scene.
    """
    geometry, topology = rays.geometry, rays.topology
    if not any(geometry.differentiated):
        return None
    pairs, low, high = find_possible_intersections(geometry)
    if not bool(pairs.any()):
        return None
    points = geometry.vertices.detach()
    owner = topology.vertex_object[topology.edges[:, 0]]
    ends = points[topology.edges]
    inside = (ends.amin(1) <= high[owner]) & (ends.amax(1) >= low[owner])
    edges = torch.nonzero(inside.all(1))[:, 0]
    edge, face = _trace_edges(rays, edges, pairs.clone().fill_diagonal_(False).any(1)[owner[edges]])
    beside, face = topology.edge_faces[edge], face[:, None].expand(-1, topology.edge_faces.shape[1])
    pairs_met = torch.stack([beside[beside >= 0], face[beside >= 0]])
    seen, parts = torch.zeros(0, dtype=torch.int64), []
    while True:
        # Where rays slip through a seam, the curve leads on: neighbours of a pair that meets.
        couple = pairs_met.sort(0).values
        key = (couple[0] * len(geometry.faces) + couple[1]).unique()
        key = key[~torch.isin(key, seen)]
        seen = torch.cat([seen, key])
        first, second = key // len(geometry.faces), key % len(geometry.faces)
        met = pairs[geometry.face_object[first], geometry.face_object[second]]
        corners = topology.welded_faces[first], topology.welded_faces[second]
        met &= ~(corners[0][:, :, None] == corners[1][:, None]).flatten(1).any(1)
        found = intersect_triangles(points, topology, first[met], second[met])
        parts.append(found)
        if not len(found.first):
            break
        around = [topology.face_neighbours(face) for face in (found.first, found.second)]
        pairs_met = torch.stack(torch.broadcast_tensors(around[0][:, :, None], around[1][:, None]))
        pairs_met = pairs_met.flatten(1)
        pairs_met = pairs_met[:, (pairs_met >= 0).all(0)]
    return concatenate_rows(parts)


def _trace_edges(rays: RayScene, edges: _Numbers, extended: Tensor) -> tuple[Tensor, Tensor]:
    """Find intersections of edges with triangles; some edges are extended beyond their ends."""
    # In both directions, so that neither of two close surfaces hides the other.
    edge = to_index(torch.cat([edges, edges[extended]]))
    longer = to_index(torch.cat([extended, extended[extended]])) > 0
    back = dr.arange(mi.UInt32, dr.width(edge)) >= len(edges)
    vertices = (dr.gather(mi.UInt32, ends, edge) for ends in rays.topology.device_edges)
    y0, y1 = (gather_points(rays.vertices, vertex) for vertex in vertices)
    start, offset = dr.select(back, y1, y0), dr.select(back, y0 - y1, y1 - y0)
    step = _EDGE_EXTENSION * (dr.norm(y0) + dr.norm(y1)) / dr.maximum(dr.norm(offset), 1e-30)
    step = dr.minimum(step + RAY_EPSILON, 0.5)
    at = dr.select(longer, -step, RAY_EPSILON)
    until = dr.select(longer, 1 + step, 1 - RAY_EPSILON)
    rows, faces = [edges[:0]], [edges[:0]]
    for _ in range(_MAX_HITS):
        ray = mi.Ray3f(mi.Point3f(start + offset * at), mi.Vector3f(offset), until - at, 0.0, [])
        hit = rays.find_nearest(ray, at < until)
        at = at + hit.t + step
        lanes = dr.compress(hit.valid)
        if not dr.width(lanes):
            break
        face = dr.gather(mi.UInt32, hit.point.face, lanes)
        columns = edge, mi.Point3f(start), mi.Vector3f(offset), at, until, step
        edge, start, offset, at, until, step = (dr.gather(type(x), x, lanes) for x in columns)
        rows.append(to_torch(mi.Int32(edge)).long())
        faces.append(to_torch(mi.Int32(face)).long())
    return torch.cat(rows), torch.cat(faces)


def intersect_triangles(
    points: Float64[Tensor, "v 3"], topology: Topology, first: _Numbers, second: _Numbers
) -> IntersectionCurves:
    """Intersect pairs of triangles, and keep the intersections that are segments.

    Args:
        points: world positions of all vertices [v, 3] in metres.
        topology: connectivity of the triangles.
        first, second: triangle indices of each pair [n].
    """
    faces = first, second
    triangles = [points[topology.welded_faces[face]] for face in faces]
    normals = [_unit(torch.linalg.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])) for t in triangles]
    line = torch.linalg.cross(normals[0], normals[1])
    kept = line.norm(dim=1) > _MIN_PLANE_SINE
    line = _unit(line)
    spans, resting = [], []
    for own, other in ((0, 1), (1, 0)):
        plane, normal = triangles[other][:, 0], normals[other]
        height = ((triangles[own] - plane[:, None]) * normal[:, None]).sum(2)
        height = torch.where(height.abs() < PLANE_TOLERANCE, 0.0, height)
        kept &= (height.amin(1) <= 0) & (height.amax(1) >= 0)
        # An edge in the plane: the surface crosses there if it goes on to the plane's other side.
        lies = (height == 0).sum(1) == 2
        apex = height.abs().argmax(1, keepdim=True)
        edge = topology.face_edges[faces[own]].gather(1, apex)[:, 0]
        nearby = topology.edge_apexes[edge.clamp_min(0)]
        there = ((points[nearby.clamp_min(0)] - plane[:, None]) * normal[:, None]).sum(2)
        mine = height.gather(1, apex)
        across = (nearby >= 0) & (edge >= 0)[:, None] & (there * mine < 0)
        across = (across & (there.abs() >= PLANE_TOLERANCE)).any(1)
        resting.append(torch.where(lies & ~across, edge, _PASSES))
        kept &= ~(lies & across & (mine[:, 0] > 0))  # the triangle on the other side has it
        spans.append(_line_interval(triangles[own], height, line))
    (low, high, place), (others_low, others_high, _) = spans
    low, high = torch.maximum(low, others_low), torch.minimum(high, others_high)
    kept &= high > low
    at = (place * line).sum(1)
    ends = (place + line * (value - at)[:, None] for value in (low, high))
    start, end = (value[kept] for value in ends)
    rests, supports = (edge[kept] for edge in resting)
    touching, swapped = torch.maximum(rests, supports) > _PASSES, (supports >= 0) & (rests < 0)
    edge = torch.maximum(rests, supports).clamp_min(-1)
    edge = torch.where((rests >= 0) & (supports >= 0), -1, edge)
    pair = first[kept], second[kept]
    first, second = (torch.where(swapped, pair[1 - k], pair[k]) for k in (0, 1))
    return IntersectionCurves(first, second, start, end, touching, edge)


def _line_interval(triangle: Tensor, height: Tensor, line: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the interval of a line within triangles of a common plane, and a point of it."""
    places, there = [*triangle.unbind(1)], [*(height == 0).unbind(1)]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        share = height[:, i] / (height[:, i] - height[:, j])
        places.append(triangle[:, i] + (triangle[:, j] - triangle[:, i]) * share[:, None])
        there.append(height[:, i] * height[:, j] < 0)
    place, valid = torch.stack(places, 1), torch.stack(there, 1)
    along = (place * line[:, None]).sum(2)
    low = torch.where(valid, along, torch.inf).min(1)
    high = torch.where(valid, along, -torch.inf).amax(1)
    return low.values, high, place[torch.arange(len(place)), low.indices]


def _unit(vectors: Tensor) -> Tensor:
    return vectors / vectors.norm(dim=1, keepdim=True).clamp_min(1e-300)


_BOX_PAIRS_AT_ONCE = 1 << 22  # triangles × triangles whose boxes are compared at a time


def find_overlapping_pairs(
    first: Float64[Tensor, "n 3 3"], second: Float64[Tensor, "m 3 3"]
) -> tuple[Int64[Tensor, " pair"], Int64[Tensor, " pair"]]:
    """Find pairs of triangles whose boxes overlap.

    Args:
        first, second: corners of the triangles [n, 3, 3] and [m, 3, 3] in metres.
    """
    least, most, low, high = first.amin(1), first.amax(1), second.amin(1), second.amax(1)
    own = torch.nonzero(((least <= high.amax(0)) & (most >= low.amin(0))).all(1))[:, 0]
    other = torch.nonzero(((low <= most.amax(0)) & (high >= least.amin(0))).all(1))[:, 0]
    low, high, rows = low[other], high[other], list[Tensor]()
    for some in own.split(max(1, _BOX_PAIRS_AT_ONCE // max(1, len(other)))):
        met = ((least[some, None] <= high) & (most[some, None] >= low)).all(2)
        here, there = torch.nonzero(met).unbind(1)
        rows.append(torch.stack([some[here], other[there]]))
    found = torch.cat(rows, 1)
    return found[0], found[1]
