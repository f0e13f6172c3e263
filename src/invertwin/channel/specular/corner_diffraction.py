"""Corner diffraction: waves from the end of an edge that diffract at the adjacent edge.

An edge of a solid ends in a corner, and the field that it diffracts along one of its faces is
shadowed by the next edge of this face. For diffraction points far from the corner, this is a path
over both edges. Near the corner and beyond it no such path exists, and both edges act as one. The
field of the edge then diffracts at the next edge as a wave from before the corner, from the
distance within which the contributions of the end are in phase.

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
from invertwin.channel.specular import edge_path_geometry

_MIN_SQUARED_SINE = 1e-18  # sin² of angles below this is zero


def face_weight(
    edge: Wedges, after: Wedges, faces: Int64[Tensor, "row 2"], direction: Float64[Tensor, "row 3"]
) -> Float64[Tensor, " row"]:
    """Weight of a wave from a corner along a face: cos² of its angles off the plane.

    Angles are measured about the radiating edge, from the face, and about the next edge, beyond the
    face.

    Args:
        edge: edge that radiates the wave.
        after: next edge of this face.
        faces: number of this face at either edge, 0 or 1.
        direction: unit vectors from the corner.
    """
    row = torch.arange(len(direction))
    high = dot(edge.normals[row, faces[:, 0]], direction) ** 2
    over = dot(edge.face_tangents[row, faces[:, 0]], direction).clamp_min(0.0) ** 2
    beyond = dot(after.face_tangents[row, faces[:, 1]], direction).clamp_max(0.0) ** 2
    return over * beyond / ((over + high) * (beyond + high)).clamp_min(1e-300)


def diffract_round_corner(
    edges: Sequence[edge_path_geometry.PathEdge],
    end: Int64[Tensor, " row"],
    faces: Int64[Tensor, "row 2"],
    tx: Float64[Tensor, "row 3"],
    rx: Float64[Tensor, "row 3"],
    wave_number: float,
) -> edge_path_geometry.EdgePaths:
    """Diffract the field of the last edge but one, near its end, at the last edge.

    The last edge starts at this end, the corner.     With X the wave of the edges before, in the
    plane of the face, the result is ½ D X/√l, with l the distance parameter from d before the
    corner; for a single edge before, also the product of the slopes of X across the plane and of D.
    It is weighted by the product of

    - 1/(1 + x³), x = 2r/λ, where the ray of X runs r along the face to the last edge: the deficit
      of the path over both edges,
    - ``face_weight``,
    - sin²α/(sin²α + sin²β) of the angles of the legs to and from the corner off the plane. With
      both in the plane, the wave that meets the corner first is already counted.

    Args:
        edges: two or three edges, in the order of the path.
        end: 0 or 1 if the last edge but one starts or ends in the corner.
        faces: face numbers of the last edge but one and of the last edge, between them.
        tx, rx: positions of the antennas, or of their images [m].
        wave_number: wave number k [1/m].
    """
    before, last = edges[:-1], edges[-1]
    route, row = edge_path_geometry.find_route(before, tx, rx), torch.arange(len(end))
    wedges, first = before[-1].wedges, route.edge_diffractions(wave_number)
    gap, root = (each[row, end] for each in route.end_distances(len(before) - 1, wave_number))
    corner = torch.where(end[:, None] > 0, wedges.end, wedges.start)
    leaving = rx - corner
    leg = normalize(leaving, dim=1)
    reach = gap.clamp_min(0.0) + 1 / (root * (1 + 2 * gap.abs() * root)).clamp_min(1e-300)
    length = 1 / (1 / reach + 1 / leaving.norm(dim=1))
    sine = cross(edge_axis(last.wedges), leg).norm(dim=1)
    if last.azimuth_in is None:
        raise ValueError("no face lies between both edges")
    angles, reduced = (last.azimuth_in, exterior_azimuth(last.wedges, leg, 0)), length * sine**2
    final = EdgeDiffraction(last.wedges, leg, leg, *angles, reduced, last.face_coefficients)
    orders: tuple[DyadDerivative, ...] = ("value", "out") if len(before) == 1 else ("value",)
    fields = edge_path_geometry.transfer_dyads(route, first, wave_number, orders)
    dyads = diffraction_dyads(final, wave_number, ("value", "in"))
    transfer = dyads[0] @ fields[0]
    if len(fields) > 1:
        # Away from the face, azimuths grow from face 0 and fall from the other.
        sign = torch.where(faces[:, 0] == faces[:, 1], 1.0, -1.0)
        scale = sign / (1j * wave_number * sine * first[0].sin_beta * reach)
        transfer = transfer + scale[:, None, None] * (dyads[1] @ fields[1])
    normal = wedges.normals[row, faces[:, 0]]
    arriving = normalize(route.vertices[:, -3] - corner, dim=1)
    high, low = (dot(normal, u) ** 2 + _MIN_SQUARED_SINE for u in (arriving, leg))
    weight = _deficit_weight(route, end, last.wedges, gap, wave_number) * high / (high + low)
    weight = 0.5 * weight * face_weight(wedges, last.wedges, faces, leg) / length.sqrt()
    points = torch.cat([route.points, corner[:, None]], 1)
    transfer = transfer * weight[:, None, None]
    return edge_path_geometry.EdgePaths(points, route.legs.sum(1), transfer, route.stationary)


def _deficit_weight(
    route: edge_path_geometry.Route,
    end: Tensor,
    last: Wedges,
    end_distance: Tensor,
    wave_number: float,
) -> Float64[Tensor, " row"]:
    """Weight 1/(1 + x³), from the triangle along the face between the point and the last edge."""
    wedges = route.edges[-1].wedges
    outwards = normalize(wedges.end - wedges.start, dim=1) * (2.0 * end - 1)[:, None]
    corner = torch.where(end[:, None] > 0, wedges.end, wedges.start)
    cosine = -dot(normalize((last.start + last.end) / 2 - corner, dim=1), outwards)
    sine = (1 - cosine**2).clamp_min(1e-12).sqrt()
    axial = dot(normalize(route.vertices[:, -1] - route.vertices[:, -2], dim=1), outwards)
    radial = (1 - axial**2).clamp_min(1e-12).sqrt()
    meets = (sine * axial + cosine * radial).clamp_min(0.0) ** 3
    far = (wave_number * end_distance * sine / math.pi) ** 3
    return torch.where(end_distance > 0, meets / (meets + far).clamp_min(1e-300), 1.0)
