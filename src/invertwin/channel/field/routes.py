"""Ways between edges and antennas far away: straight, and by way of flat mirrors.

Light that a mirror sends on lights an edge as light from the antenna's image would. The edge is
seen in a mirror as it is from the image. So a route is a direction at the edge, polarisations
there, and a length.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, product

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel.field.waves import dot, mirrored
from invertwin.channel.rays.scene import Occluders, next_surface, visible

_FLAT = 1e-6  # of the scene's size: how far off a plane what lies in it may be
_MOST_PLANES = 24


@dataclass(frozen=True)
class Mirrors:
    """Planes of conductors that something stands before.

    Attributes:
        normal: n of each plane.
        height: n · x of its points [m].
        plane: number of each triangle's plane; −1 where there is none.
    """

    normal: Float64[Tensor, "plane 3"]
    height: Float64[Tensor, " plane"]
    plane: Int64[Tensor, " facet"]


def mirrors_of(
    corners: Float64[Tensor, "facet 3 3"],
    normal: Float64[Tensor, "facet 3"],
    shiny: Tensor,
    solid: Tensor,
    size: float,
) -> Mirrors:
    """The flat mirrors of a scene; none where there are too many planes to go through them.

    Args:
        corners: of the triangles [m].
        normal: of the triangles.
        shiny: whether they are smooth conductors.
        solid: whether they mirror in front only.
        size: of the scene [m].
    """
    fixed, way = corners.detach(), normal.detach()
    height = dot(way, fixed[:, 0])
    plane = torch.full((len(way),), -1)
    chosen: list[int] = []
    for facet in torch.nonzero(shiny)[:, 0].tolist() if len(way) <= _MOST_PLANES else ():
        for number, other in enumerate(chosen):
            same = dot(way[facet], way[other])
            off = height[facet] - same.sign() * height[other]
            if bool((same.abs() > 1 - 1e-9) & (off.abs() < _FLAT * size)):
                plane[facet] = number
                break
        else:
            plane[facet] = len(chosen)
            chosen.append(facet)
    kept = [
        number
        for number, facet in enumerate(chosen)
        if bool(_stands_before(fixed, way[facet], height[facet], solid[facet], _FLAT * size))
    ]
    renumbered = torch.full((len(chosen) + 1,), -1)
    renumbered[kept] = torch.arange(len(kept))
    rows = torch.tensor([chosen[number] for number in kept], dtype=torch.int64)
    return Mirrors(normal[rows], dot(normal[rows], corners[rows, 0]), renumbered[plane])


def _stands_before(
    corners: Tensor, normal: Tensor, height: Tensor, solid: Tensor, least: float
) -> Tensor:
    above = corners @ normal - height
    return (above > least).any() | (~solid & (above < -least).any())


@dataclass(frozen=True)
class Route:
    """Edges that one antenna sees in one way, one row for each edge and aspect.

    Attributes:
        aspect: number of the wave.
        edge: number of the edge.
        towards: unit vector from the edge into the route.
        fields: polarisations V and H of the antenna as they are at the edge.
        length: what the route's phase is ahead by, apart from ``towards`` · x [m].
    """

    aspect: Int64[Tensor, " row"]
    edge: Int64[Tensor, " row"]
    towards: Float64[Tensor, "row 3"]
    fields: Float64[Tensor, "row 2 3"]
    length: Float64[Tensor, " row"]

    def rows(self, index: Tensor) -> "Route":
        """Some rows."""
        return Route(*(column[index] for column in vars(self).values()))


def sequences(mirrors: Mirrors, most: int) -> Iterator[tuple[int, ...]]:
    """Mirrors in turn, from the edge on; none first.

    Args:
        mirrors: of the scene.
        most: mirrors in a route.
    """
    for count in range(most + 1):
        for sequence in product(range(len(mirrors.normal)), repeat=count):
            if all(one != other for one, other in pairwise(sequence)):
                yield sequence


def routed(
    direct: Route, mirrors: Mirrors, sequence: tuple[int, ...], ends: Float64[Tensor, "edge 2 3"]
) -> Route:
    """A route by way of mirrors, whether or not it is open; edges in the first mirror have none.

    Args:
        direct: the straight way.
        mirrors: of the scene.
        sequence: mirrors in turn, from the edge on.
        ends: of the edges [m].
    """
    towards, fields, length = direct.towards, direct.fields, direct.length
    for number in reversed(sequence):
        normal = mirrors.normal[number].expand_as(towards)
        length = length + 2 * mirrors.height[number] * dot(normal, towards)
        towards, fields = mirrored(towards, normal), -mirrored(fields, normal[:, None])
    found = Route(direct.aspect, direct.edge, towards, fields, length)
    if not sequence:
        return found
    first = sequence[0]
    apart = (ends.detach() @ mirrors.normal[first].detach() - mirrors.height[first].detach()).abs()
    own = apart.amax(1) < _FLAT * float((ends.amax((0, 1)) - ends.amin((0, 1))).norm())
    return found.rows(~own[direct.edge])


def is_open(
    occluders: Occluders,
    mirrors: Mirrors,
    sequence: tuple[int, ...],
    start: Float64[Tensor, "row 3"],
    towards: Float64[Tensor, "row 3"],
    far: float,
) -> Tensor:
    """Whether routes meet their mirrors in turn, and nothing else.

    Args:
        occluders: what may be in the way.
        mirrors: of the scene.
        sequence: of the routes.
        start: beside the edge [m].
        towards: into the route.
        far: farther than the scene is large [m].
    """
    lit = torch.ones(len(start), dtype=torch.bool)
    place, way = start.detach(), towards.detach()
    for number in sequence:
        rows = torch.nonzero(lit)[:, 0]
        face, along = next_surface(occluders, place[rows], place[rows] + far * way[rows])
        plane = torch.where(face >= 0, mirrors.plane[face.clamp_min(0)], -1)
        lit[rows] = plane == number
        place = place.index_add(0, rows, far * along[:, None] * way[rows])
        normal = mirrors.normal[number].detach().expand_as(way)
        # On the side that the ray comes from.
        off = dot(normal, place) - mirrors.height[number].detach()
        side = -dot(normal, way).sign()
        place = place + (side * _FLAT * far - off)[:, None] * normal
        way = mirrored(way, normal)
    return lit & visible(occluders, place, place + far * way)
