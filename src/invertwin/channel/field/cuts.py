"""Where surfaces of a scene cut a screen: the power on the screen jumps from one side to the other.

A surface that moves takes the jump with it: ``ΔI = (f₋ − f₊) · n·(y − y_m)/sin``, with n the normal
of the surface, on whose side f₊ is, and y its material point on the curve.

Source: derivations §15, with one of the two surfaces at rest.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.field.images import Walls
from invertwin.channel.field.shadow_edges import Screen, spread_along
from invertwin.channel.rays.intersections import close_pairs, common_segments
from invertwin.channel.rays.topology import Topology
from invertwin.checks import plain


@dataclass(frozen=True)
class Cuts:
    """Points on curves where the scene cuts a screen; detached.

    Attributes:
        place: The points [m].
        face: Triangles of the scene.
        on_screen: Triangles of the screen.
        aside: Unit vectors in the screen across the curve, to the side of the normal.
        normal: Of the scene's triangles.
        weight: Length of curve that a point stands for, over n·aside [m].
    """

    place: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    on_screen: Int64[Tensor, " row"]
    aside: Float64[Tensor, "row 3"]
    normal: Float64[Tensor, "row 3"]
    weight: Float64[Tensor, " row"]


def cut_points(walls: Walls, screen: Screen, both: Topology, samples: int, seed: int) -> Cuts:
    """Points spread evenly over all curves where the scene cuts a screen.

    Args:
        walls: The scene.
        screen: The screen.
        both: The scene's triangles, and those of the screen after them.
        samples: Points.
        seed: Of the points.
    """
    vertices = walls.exact_vertices + walls.origin
    corners = vertices[walls.topology.faces]
    face, on_screen = close_pairs(corners, screen.corners)
    points = torch.cat([vertices, screen.vertices])
    met = common_segments(points, both, face, on_screen + len(corners))
    span = met.end - met.start
    row, along, weight = spread_along(span.norm(dim=1), samples, seed)
    face, on_screen = met.first[row], met.second[row] - len(corners)
    normal, up = _normals(corners[face]), _normals(screen.corners[on_screen])
    aside = normalize(normal - dot(normal, up)[:, None] * up, dim=1)
    return Cuts(
        met.start[row] + along[:, None] * span[row],
        face,
        on_screen,
        aside,
        normal,
        weight * span[row].norm(dim=1) / dot(normal, aside),
    )


def cut_rates(
    walls: Walls, cuts: Cuts, vertices: Float64[Tensor, "v 3"]
) -> Float64[Tensor, " row"]:
    """Area that the side of the normal loses, of each point's share; zero in value, attached [m²].

    Args:
        walls: The scene.
        cuts: The points.
        vertices: Of the scene in the world, attached [m].
    """
    corners = vertices[walls.topology.faces[cuts.face]]
    a, b, c = plain(corners).unbind(1)
    area = cross(b - a, c - a)
    square = dot(area, area)
    v = dot(cross(b - a, cuts.place - a), area) / square
    u = dot(cross(cuts.place - a, c - a), area) / square
    share = torch.stack([1 - u - v, u, v], 1)
    material = (share[..., None] * corners).sum(1)
    return dot(cuts.normal, material - plain(material)) * cuts.weight


def _normals(corners: Tensor) -> Tensor:
    a, b, c = corners.unbind(1)
    return normalize(cross(b - a, c - a), dim=1)
