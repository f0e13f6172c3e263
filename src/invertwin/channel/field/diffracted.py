"""Diffracted paths of a scene: which edges carry a wave between antennas, and how much of it.

Every sharp edge sends at every receiver whose way over it is free: also one whose ray would pass
the end of the edge, since the end itself then sends. Nothing therefore jumps where a ray slides off
an edge, and sums over the edges of a plate have no jump at its corners. What is in the way is found
by rays and is detached; the field is differentiable.

Source: derivations §9.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.field.edge_paths import Edge, EdgePaths, over_edges
from invertwin.channel.field.waves import dot
from invertwin.channel.field.wedges import (
    Wedges,
    azimuth,
    edge_axis,
    find_wedges,
    joined_wedges,
)
from invertwin.channel.rays.scene import Occluders, visible
from invertwin.channel.rays.topology import Topology
from invertwin.scene.material.fresnel import FieldCoefficients

Coefficients = Callable[[Int64[Tensor, " n"], Float64[Tensor, " n"]], FieldCoefficients]
"""What triangles reflect and let through at cosines of the angle of incidence, about the mesh."""

_ROWS_AT_ONCE = 1 << 16
_OFF = 1e-5  # of the scene's size: how far aside of an edge rays to it end
_GRAZING = 1e-9  # rad; and share of the scene's size within which two faces lie in one plane
_ONE_PLANE = 1e-6


@dataclass(frozen=True)
class EdgedScene:
    """A scene as diffraction sees it.

    Attributes:
        vertices: of all objects [m].
        topology: their triangles.
        occluders: what rays meet.
        coefficients: of the triangles.
    """

    vertices: Float64[Tensor, "v 3"]
    topology: Topology
    occluders: Occluders
    coefficients: Coefficients

    @cached_property
    def wedges(self) -> Wedges:
        """Sharp edges, each as long as it goes straight on."""
        corners = self.vertices[self.topology.faces]
        ends = self.vertices[self.topology.edges]
        return joined_wedges(find_wedges(corners, ends, self.topology.beside))

    @cached_property
    def size(self) -> float:
        """Of all together [m]."""
        plain = self.vertices.detach()
        return float((plain.amax(0) - plain.amin(0)).norm())

    def edge(self, row: Tensor, known: tuple[Tensor | None, Tensor | None] = (None, None)) -> Edge:
        """Edges on paths' ways.

        Args:
            row: numbers of wedges.
            known: azimuths of incidence and of departure, where a path runs along a face.
        """
        wedges = self.wedges.rows(row)

        def faces(face: int, cosine: Tensor) -> FieldCoefficients:
            return self.coefficients(wedges.faces[:, face], cosine)

        return Edge(wedges, faces, *known)


@dataclass(frozen=True)
class DiffractedPaths:
    """Paths over the same number of edges, one row each.

    Attributes:
        link: number of the pair of antennas.
        edge: numbers of the edges, from the transmitter on.
        points: where paths turn: a point of the edge, its end where they turn past it [m].
        length: of the path by these points [m].
        transfer: E at the receiver of E at 1 m from the transmitter, without the phase of
            ``length`` [1/m]; world coordinates, receive × transmit.
    """

    link: Int64[Tensor, " row"]
    edge: Int64[Tensor, "row order"]
    points: Float64[Tensor, "row order 3"]
    length: Float64[Tensor, " row"]
    transfer: Complex128[Tensor, "row 3 3"]


def diffracted_paths(
    around: EdgedScene,
    tx: Float64[Tensor, "link 3"],
    rx: Float64[Tensor, "link 3"],
    wave_number: float,
    order: int = 1,
) -> list[DiffractedPaths]:
    """Diffracted paths between pairs of antennas, over one edge, and over two.

    Args:
        around: the scene.
        tx, rx: one row a link [m].
        wave_number: k [1/m].
        order: most edges of a path, 1 or 2.
    """
    found = [_joined(list(_once(around, tx, rx, wave_number)), 1)]
    if order > 1:
        found.append(_joined(list(_twice(around, tx, rx, wave_number)), 2))
    return found


def _joined(parts: list[DiffractedPaths], order: int) -> DiffractedPaths:
    if not parts:
        none = torch.zeros(0, dtype=torch.float64)
        return DiffractedPaths(
            torch.zeros(0, dtype=torch.int64),
            torch.zeros(0, order, dtype=torch.int64),
            none.reshape(0, 1).expand(0, order)[..., None].expand(0, order, 3),
            none,
            torch.zeros(0, 3, 3, dtype=torch.complex128),
        )
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return DiffractedPaths(*(torch.cat(column) for column in columns))


def exterior(wedges: Wedges, places: Float64[Tensor, "row 3"]) -> Bool[Tensor, " row"]:
    """Which places lie outside of wedges that go on for ever; on a face is outside.

    Args:
        wedges: one row each.
        places: [m].
    """
    offset = (places - wedges.start).detach()
    angle = azimuth(wedges, offset, 0).detach()
    inside = (angle > wedges.opening.detach() * torch.pi + _GRAZING) & (
        angle < 2 * torch.pi - _GRAZING
    )
    axis = edge_axis(wedges).detach()
    aside = offset - dot(offset, axis)[:, None] * axis
    return ~inside & (aside.norm(dim=1) > 0)


def _once(
    around: EdgedScene, tx: Tensor, rx: Tensor, wave_number: float
) -> Iterator[DiffractedPaths]:
    """Paths over one edge."""
    count = len(around.wedges.start)
    for some in torch.arange(len(tx)).split(max(1, _ROWS_AT_ONCE // max(1, count))):
        sees = _sees(around, tx[some]) & _sees(around, rx[some])
        link, row = torch.nonzero(sees).T
        link = some[link]
        if not len(link):
            continue

        def send(chosen: Tensor, link: Tensor = link, row: Tensor = row) -> EdgePaths:
            ends = tx[link[chosen]], rx[link[chosen]]
            return over_edges([around.edge(row[chosen])], *ends, wave_number)

        yield from _seen(around, wave_number, link, row[:, None], (tx, rx), send)


def _twice(
    around: EdgedScene, tx: Tensor, rx: Tensor, wave_number: float
) -> Iterator[DiffractedPaths]:
    """Paths over two edges."""
    pairs, between = _pairs(around)
    for some in torch.arange(len(tx)).split(max(1, _ROWS_AT_ONCE // max(1, len(pairs)))):
        sees = _sees(around, tx[some])[:, pairs[:, 0]] & _sees(around, rx[some])[:, pairs[:, 1]]
        link, pair = torch.nonzero(sees).T
        link, row, face = some[link], pairs[pair], between[pair]
        if not len(link):
            continue
        opening = around.wedges.opening[row]
        angles = torch.where(face < 0, torch.nan, face * opening * torch.pi)

        def send(
            chosen: Tensor,
            link: Tensor = link,
            row: Tensor = row,
            angles: Tensor = angles,
            apart: Tensor = face[:, 0] < 0,
        ) -> EdgePaths:
            edges = [
                around.edge(row[chosen, 0], (None, angles[chosen, 0])),
                around.edge(row[chosen, 1], (angles[chosen, 1], None)),
            ]
            sent = over_edges(edges, tx[link[chosen]], rx[link[chosen]], wave_number)
            # Where no face lies between two edges, each must see the other's point.
            for one, other in ((0, 1), (1, 0)):
                outside = exterior(edges[one].wedges, sent.points[:, other])
                sent = replace(sent, stationary=sent.stationary & (outside | ~apart[chosen]))
            return sent

        yield from _seen(around, wave_number, link, row, (tx, rx), send)


def _sees(around: EdgedScene, places: Tensor) -> Bool[Tensor, "place edge"]:
    """Which wedges places are outside of."""
    count, edges = len(places), len(around.wedges.start)
    row = torch.arange(edges).repeat(count)
    outside = exterior(around.wedges.rows(row), places.repeat_interleave(edges, 0))
    return outside.reshape(count, edges)


def _pairs(around: EdgedScene) -> tuple[Int64[Tensor, "pair 2"], Int64[Tensor, "pair 2"]]:
    """Edges that may follow one another, and which of their faces lies between them (−1: none).

    Two edges with a face between them have one path along each side that both have in common.
    """
    wedges = Wedges(*(column.detach() for column in vars(around.wedges).values()))
    count = len(wedges.start)
    first, second = torch.nonzero(~torch.eye(count, dtype=torch.bool)).T
    way = (wedges.start + wedges.end)[second] - (wedges.start + wedges.end)[first]
    rows, faces, shared = [], [], torch.zeros(len(first), dtype=torch.bool)
    for one in (0, 1):
        for other in (0, 1):
            normal = wedges.normals[first, one]
            alike = dot(normal, wedges.normals[second, other]) > 1 - _ONE_PLANE**2
            flat = dot(normal, way).abs() < _ONE_PLANE * around.size
            over = dot(way, wedges.inwards[first, one]) > 0
            back = dot(way, wedges.inwards[second, other]) < 0
            chosen = torch.nonzero(alike & flat & over & back)[:, 0]
            shared[chosen] = True
            rows.append(torch.stack([first[chosen], second[chosen]], 1))
            faces.append(torch.tensor([[one, other]]).expand(len(chosen), 2))
    # The others: at least one end of each lies outside of the other.
    free = ~shared
    for near, far in ((first, second), (second, first)):
        outside = [exterior(wedges.rows(near), end[far]) for end in (wedges.start, wedges.end)]
        free &= outside[0] | outside[1]
    rows.append(torch.stack([first[free], second[free]], 1))
    faces.append(torch.full((int(free.sum()), 2), -1))
    return torch.cat(rows), torch.cat(faces)


def _seen(
    around: EdgedScene,
    wave_number: float,
    link: Tensor,
    edge: Tensor,
    ends: tuple[Tensor, Tensor],
    send: Callable[[Tensor], EdgePaths],
) -> Iterator[DiffractedPaths]:
    """The paths between whose points nothing lies.

    They are computed again for these rows alone: others may be singular, and would spoil
    derivatives.
    """
    tx, rx = ends
    with torch.no_grad():
        sent = send(torch.arange(len(link)))
    wedges = [around.wedges.rows(column) for column in edge.T]
    places = [on_edge(at, sent.points[:, number]) for number, at in enumerate(wedges)]
    aside = [
        place.detach() + _OFF * around.size * normalize((at.normals - at.inwards).sum(1), dim=1)
        for place, at in zip(places, wedges, strict=True)
    ]
    clear = sent.stationary
    stops = [tx[link], *aside, rx[link]]
    for start, end in pairwise(stops):
        rows = torch.nonzero(clear)[:, 0]
        clear[rows] = visible(around.occluders, start[rows], end[rows])
    rows = torch.nonzero(clear)[:, 0]
    if len(rows):
        sent = send(rows)
        wedges = [around.wedges.rows(column) for column in edge[rows].T]
        places = [on_edge(at, sent.points[:, number]) for number, at in enumerate(wedges)]
        points = torch.stack(places, 1)
        stops = torch.cat([tx[link[rows], None], points, rx[link[rows], None]], 1)
        length = (stops[:, 1:] - stops[:, :-1]).norm(dim=2).sum(1)
        # What the end of an edge sends has the delay of the path over that end.
        later = wave_number * (length - sent.length)
        turn = torch.polar(torch.ones_like(later), later)[:, None, None]
        yield DiffractedPaths(link[rows], edge[rows], points, length, sent.transfer * turn)


def on_edge(wedges: Wedges, points: Float64[Tensor, "row 3"]) -> Float64[Tensor, "row 3"]:
    """The nearest points of edges to points on their lines.

    Args:
        wedges: one row each.
        points: [m].
    """
    side = wedges.end - wedges.start
    share = dot(points - wedges.start, side) / dot(side, side)
    return wedges.start + share.clamp(0, 1)[:, None] * side
