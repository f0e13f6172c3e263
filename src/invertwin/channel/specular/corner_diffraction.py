"""Waves that edges send near their ends, and that go on round the next edge there.

An edge of a solid ends in a corner, and what it sends along one of its faces has the shadow of the
next edge of this face. Where its ray would turn far from the corner, this is a path over both
edges. Near the corner and past it there is none, and both edges are one thing. What the edge sends
there goes on round the next edge as a wave from before the corner, from as far as the waves of the
end are in phase.

Source: derivations §9; ours.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.em.utd import DyadDerivative, EdgeDiffraction, diffraction_dyads
from invertwin.channel.em.wedges import Wedges, edge_axis, exterior_azimuth
from invertwin.channel.specular.edge_path_geometry import (
    EdgePaths,
    PathEdge,
    Route,
    find_route,
    transfer_dyads,
)

_MIN_SQUARED_SINE = 1e-18  # sin² of angles that count as none


def face_weight(
    edge: Wedges,
    next_edge: Wedges,
    faces: Int64[Tensor, "row 2"],
    direction: Float64[Tensor, "row 3"],
) -> Float64[Tensor, " row"]:
    """How much of a wave from a corner runs along a face there: cos² of its angles off the plane.

    About the edge that sends the wave, from the face on, and about the next, beyond it.

    Args:
        edge: sends the wave.
        next_edge: the next edge of this face.
        faces: which face this is of either edge, 0 or 1.
        direction: unit vectors from the corner.
    """
    row = torch.arange(len(direction))
    high = dot(edge.normals[row, faces[:, 0]], direction) ** 2
    over = dot(edge.face_tangents[row, faces[:, 0]], direction).clamp_min(0.0) ** 2
    beyond = dot(next_edge.face_tangents[row, faces[:, 1]], direction).clamp_max(0.0) ** 2
    return over * beyond / ((over + high) * (beyond + high)).clamp_min(1e-300)


def diffract_round_corner(
    edges: Sequence[PathEdge],
    end: Int64[Tensor, " row"],
    faces: Int64[Tensor, "row 2"],
    tx: Float64[Tensor, "row 3"],
    rx: Float64[Tensor, "row 3"],
    wave_number: float,
) -> EdgePaths:
    """What edges send near an end of the last but one, on round the last edge, which begins there.

    With X the wave of the edges before, as it is in the plane of the face, this is ½ D X/√l, l the
    distance parameter from d before the corner; and of one edge before, whose X is uneven across
    the plane, the slopes of both. It counts by the product of

    - 1/(1 + x³), x = 2r/λ, where the ray of X runs r along the face to the last edge: what a path
      over both edges is short of there,
    - ``face_weight``,
    - sin²α/(sin²α + sin²β) of the angles of the ways to and from the corner off the plane. With
      both in the plane, the wave that meets the corner first is the same thing.

    Args:
        edges: two or three, in the order of the path.
        end: 0 or 1: whether the last but one starts or ends in the corner.
        faces: of the last but one and of the last edge, between them.
        tx, rx: the antennas, or their images [m].
        wave_number: k [1/m].
    """
    before, last = edges[:-1], edges[-1]
    route, row = find_route(before, tx, rx), torch.arange(len(end))
    wedges, turns = before[-1].wedges, route.edge_diffractions(wave_number)
    past, root = (each[row, end] for each in route.end_distances(len(before) - 1, wave_number))
    corner = torch.where(end[:, None] > 0, wedges.end, wedges.start)
    onwards = rx - corner
    way = normalize(onwards, dim=1)
    reach = past.clamp_min(0.0) + 1 / (root * (1 + 2 * past.abs() * root)).clamp_min(1e-300)
    length = 1 / (1 / reach + 1 / onwards.norm(dim=1))
    sine = cross(edge_axis(last.wedges), way).norm(dim=1)
    if last.azimuth_in is None:
        raise ValueError("no face lies between both edges")
    azimuth = exterior_azimuth(last.wedges, way, 0)
    turned = EdgeDiffraction(
        last.wedges, way, way, last.azimuth_in, azimuth, length * sine**2, last.face_coefficients
    )
    orders: tuple[DyadDerivative, ...] = ("value", "out") if len(before) == 1 else ("value",)
    sent = transfer_dyads(route, turns, wave_number, orders)
    dyads = diffraction_dyads(turned, wave_number, ("value", "in"))
    transfer = dyads[0] @ sent[0]
    if len(sent) > 1:
        # Off the face, azimuths grow from the face 0 and fall from the other.
        side = torch.where(faces[:, 0] == faces[:, 1], 1.0, -1.0)
        scale = side / (1j * wave_number * sine * turns[0].sin_beta * reach)
        transfer = transfer + scale[:, None, None] * (dyads[1] @ sent[1])
    normal = wedges.normals[row, faces[:, 0]]
    came = normalize(route.vertices[:, -3] - corner, dim=1)
    high, low = (dot(normal, u) ** 2 + _MIN_SQUARED_SINE for u in (came, way))
    share = _deficit_weight(route, end, last.wedges, past, wave_number) * high / (high + low)
    share = 0.5 * share * face_weight(wedges, last.wedges, faces, way) / length.sqrt()
    points = torch.cat([route.points, corner[:, None]], 1)
    transfer = transfer * share[:, None, None]
    return EdgePaths(points, route.legs.sum(1), transfer, route.stationary)


def _deficit_weight(
    route: Route, end: Tensor, last: Wedges, end_distance: Tensor, wave_number: float
) -> Float64[Tensor, " row"]:
    """1/(1 + x³): of a triangle along the face, from the point of the edge to the last edge."""
    wedges = route.edges[-1].wedges
    outwards = normalize(wedges.end - wedges.start, dim=1) * (2.0 * end - 1)[:, None]
    corner = torch.where(end[:, None] > 0, wedges.end, wedges.start)
    middle = (last.start + last.end) / 2
    cosine = -dot(normalize(middle - corner, dim=1), outwards)
    sine = (1 - cosine**2).clamp_min(1e-12).sqrt()
    ahead = dot(normalize(route.vertices[:, -1] - route.vertices[:, -2], dim=1), outwards)
    aside = (1 - ahead**2).clamp_min(1e-12).sqrt()
    meets = (sine * ahead + cosine * aside).clamp_min(0.0) ** 3
    far = (wave_number * end_distance * sine / math.pi) ** 3
    return torch.where(end_distance > 0, meets / (meets + far).clamp_min(1e-300), 1.0)
