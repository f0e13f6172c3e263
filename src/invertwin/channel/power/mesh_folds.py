"""Mesh folds beside an edge that rays would miss, followed triangle by triangle in float64."""

from __future__ import annotations

from typing import TypedDict

from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.intersections import PLANE_TOLERANCE
from invertwin.channel.rays.ray_scene import RayScene

# Fewest triangles that are followed from an edge, and most of them: beyond the fewest, a fold is
# followed until rays beside the edge clear it.
_MIN_FOLD_TRIANGLES, _MAX_FOLD_TRIANGLES = 8, 256


class _FoldState(TypedDict):
    """State of the loop over the triangles of a fold.

    Attributes:
        edge, face: edge crossed last and triangle entered.
        going: lanes that continue.
        found: lanes where the fold hides the ray.
        count: number of triangles so far.
        height, reach: height above the ray and distance along it at the last edge [m].
    """

    edge: mit.UInt32
    face: mit.UInt32
    going: mit.Bool
    found: mit.Bool
    count: mit.UInt32
    height: mit.Float64
    reach: mit.Float64


def is_hidden_by_fold(
    rays: RayScene,
    edge: mit.UInt32,
    point: mit.Vector3d,
    direction: mit.Vector3d,
    outward: mit.Vector3d,
    clearance: mit.Float64,
    start_distance: mit.Float64,
    active: mit.Bool,
) -> mit.Bool:
    """Test whether the mesh around an edge folds back into the path of a ray past it.

    Rays pass a little beside the edge and start a little off it, so they miss the folds of a fine
    mesh. So the curve in which the mesh meets the plane through the ray and the outward direction
    is followed from the edge to both sides, in float64. If it reaches the height of the ray
    further off, the ray meets it there, and the edge shadows it.

    Args:
        rays: ray scene.
        edge: edge indices.
        point: points on the edges, float64.
        direction: directions of the rays past them, float64.
        outward: unit directions off the edge's own triangles; zero if these are all around.
        clearance: distance beside the edge at which rays pass [m].
        start_distance: distance off the edge at which they start [m].
        active: mask of active lanes.
    """
    topology, most = rays.topology, opaque(_MAX_FOLD_TRIANGLES)
    across, along = dr.cross(direction, outward), dr.normalize(direction)
    start, found = mi.UInt32(edge), mi.Bool(False)
    columns = list(zip(topology.device_edge_faces, topology.device_edge_apexes, strict=True))

    def body(state: _FoldState) -> tuple[_FoldState]:
        state = state.copy()
        entry, face, going = state["edge"], state["face"], state["going"]
        corners = dr.gather(mi.Vector3u, topology.device_welded_faces, face, going)
        sides = dr.gather(mi.Vector3i, topology.device_face_edges, face, going)
        offsets = [rays.exact_vertex(corner, going) - point for corner in corners]
        beyond = [dr.dot(across, offset) for offset in offsets]
        leaving, height, reach = mi.Int32(-1), mi.Float64(0.0), mi.Float64(0.0)
        for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            crosses = ((beyond[i] >= 0) != (beyond[j] >= 0)) & (sides[k] != mi.Int32(entry))
            share = beyond[i] / (beyond[i] - beyond[j])
            at = offsets[i] + (offsets[j] - offsets[i]) * share
            leaving = dr.select(crosses, sides[k], leaving)
            height = dr.select(crosses, dr.dot(outward, at), height)
            reach = dr.select(crosses, dr.dot(along, at), reach)
        on = going & (leaving >= 0)
        rises = on & (height > PLANE_TOLERANCE)
        share = (clearance - state["height"]) / (height - state["height"])
        met = state["reach"] + (reach - state["reach"]) * share
        meets = (height <= clearance) | (dr.abs(met) <= start_distance)
        state["found"] = state["found"] | (rises & meets)
        state["height"], state["reach"] = height, reach
        low = (height < -clearance) & (state["count"] >= _MIN_FOLD_TRIANGLES)
        on &= (height <= PLANE_TOLERANCE) & ~low
        edge, after, others = mi.UInt32(dr.maximum(leaving, 0)), mi.UInt32(0), mi.UInt32(0)
        for column, apex in columns:
            next_face = dr.gather(mi.UInt32, column, edge, on)
            other = (dr.gather(mi.Int32, apex, edge, on) >= 0) & (next_face != face)
            after = dr.select(other, next_face, after)
            others += dr.select(other, mi.UInt32(1), 0)
        state["edge"], state["face"], state["count"] = edge, after, state["count"] + 1
        state["going"] = on & (others == 1) & (state["count"] < most)
        return (state,)

    for column, apex in columns[:2]:
        there = active & (dr.gather(mi.Int32, apex, edge) >= 0) & (dr.squared_norm(across) > 0)
        state = {
            "edge": start,
            "face": dr.gather(mi.UInt32, column, edge),
            "going": there & ~found,
            "found": dr.zeros(mi.Bool, dr.width(edge)),
            "count": dr.zeros(mi.UInt32, dr.width(edge)),
            "height": dr.zeros(mi.Float64, dr.width(edge)),
            "reach": dr.zeros(mi.Float64, dr.width(edge)),
        }
        (state,) = rays.loop((state,), lambda state: state["going"], body)
        found |= state["found"]
    return found
