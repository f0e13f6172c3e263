"""Folds of a mesh that rays past its edges would miss: followed triangle by triangle in float64."""

from typing import Any

from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.intersections import IN_PLANE
from invertwin.channel.rays.ray_scene import RayScene

# Of a mesh, so many triangles are looked at from an edge on, and more until rays that pass beside
# the edge clear them, up to so many.
_LEAST_FOLDS, _MOST_FOLDS = 8, 256


def folded(
    rays: RayScene,
    edge: Any,
    place: Any,
    way: Any,
    outwards: Any,
    aside: Any,
    near: Any,
    active: Any,
) -> Any:
    """Whether the mesh around an edge leads back into the way past it, where rays would miss it.

    Rays pass a little beside the edge and start a little off it, so they miss the folds of a fine
    mesh. So the curve in which the mesh meets the plane through ray and edge's height is followed
    from the edge both ways, in float64. Where it comes to the height of the ray further off, the
    ray meets it, and the edge's shadow falls on it.

    Args:
        rays: Rays.
        edge: Edges.
        place: Points on them, float64.
        way: Directions of rays past them, float64.
        outwards: Unit directions off the edge's own triangles; zero where there are some all round.
        aside: How far beside the edge rays pass [m].
        near: How far off the edge they start [m].
        active: Lanes.
    """
    topology, most = rays.topology, opaque(_MOST_FOLDS)
    across, along = dr.cross(way, outwards), dr.normalize(way)
    start, found = mi.UInt32(edge), mi.Bool(False)

    def body(state: dict[str, Any]) -> tuple[dict[str, Any]]:
        state = dict(state)
        entry, face, going = state["edge"], state["face"], state["going"]
        corners = dr.gather(mi.Vector3u, topology.device_welded, face, going)
        sides = dr.gather(mi.Vector3i, topology.device_face_edges, face, going)
        offsets = [rays.exact(corner, going) - place for corner in corners]
        beyond = [dr.dot(across, offset) for offset in offsets]
        leaving, height, reach = mi.Int32(-1), mi.Float64(0.0), mi.Float64(0.0)
        for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            crosses = ((beyond[i] >= 0) != (beyond[j] >= 0)) & (sides[k] != mi.Int32(entry))
            share = beyond[i] / (beyond[i] - beyond[j])
            at = offsets[i] + (offsets[j] - offsets[i]) * share
            leaving = dr.select(crosses, sides[k], leaving)
            height = dr.select(crosses, dr.dot(outwards, at), height)
            reach = dr.select(crosses, dr.dot(along, at), reach)
        on = going & (leaving >= 0)
        rises = on & (height > IN_PLANE)
        share = (aside - state["height"]) / (height - state["height"])
        met = state["reach"] + (reach - state["reach"]) * share
        state["found"] = state["found"] | (rises & ((height <= aside) | (dr.abs(met) <= near)))
        state["height"], state["reach"] = height, reach
        low = (height < -aside) & (state["count"] >= _LEAST_FOLDS)
        on &= (height <= IN_PLANE) & ~low
        edge, after, others = mi.UInt32(dr.maximum(leaving, 0)), mi.UInt32(0), mi.UInt32(0)
        for column, apex in zip(topology.device_beside, topology.device_opposite, strict=True):
            next_face = dr.gather(mi.UInt32, column, edge, on)
            other = (dr.gather(mi.Int32, apex, edge, on) >= 0) & (next_face != face)
            after = dr.select(other, next_face, after)
            others += dr.select(other, mi.UInt32(1), 0)
        state["edge"], state["face"], state["count"] = edge, after, state["count"] + 1
        state["going"] = on & (others == 1) & (state["count"] < most)
        return (state,)

    for column, apex in zip(topology.device_beside[:2], topology.device_opposite[:2], strict=True):
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
