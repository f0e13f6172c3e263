"""Fields of point antennas by way of one edge or two: where paths turn, how long, how strong.

A path over edges is as short as paths that touch these edges can be. Its amplitude spreads with the
second derivatives H of its length by the places on the edges: over N edges
``A = Π sinβ_i / (Π s_j √det H)``, of the unit of 1/length that a free path has. The distance
parameter of an edge is that by which its field's step at a boundary is the whole field of the path
that leaves this edge out: ``L = s s′ sin²β/(s + s′)`` of one edge or of parallel ones.

Source: derivations §9; Capolino, Albani, Maci and Tiberio, "Double diffraction at a pair of
coplanar skew edges", IEEE TAP 45, 1997.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.field.diffraction import (
    Faces,
    Order,
    Turn,
    conductor,
    diffraction_dyads,
    double_dyad,
)
from invertwin.channel.field.waves import cross, dot
from invertwin.channel.field.wedges import Wedges, azimuth_outside, edge_axis

_STEPS = 40  # of the search for the shortest path over two edges
_LIFTS = (0.1, 0.01, 0.0)  # of the antennas' distance, one after the other
_BENT = 1e-6  # rad of phase, up to which a path over an end is as long as to second order
_LEAST = 1e-9  # of a path's length: edges that touch there have no path between them


@dataclass(frozen=True)
class Edge:
    """An edge on paths' ways, one row each.

    Attributes:
        wedges: the edges with their faces.
        faces: what these do to waves.
        azimuth_in, azimuth: φ′ and φ where they are known, NaN elsewhere [rad]; None = nowhere.
        endless: take the edges as infinitely long.
        absorbs: take the faces as such that neither mirror nor let through.
    """

    wedges: Wedges
    faces: Faces = conductor
    azimuth_in: Float64[Tensor, " row"] | None = None
    azimuth: Float64[Tensor, " row"] | None = None
    endless: bool = False
    absorbs: bool = False


@dataclass(frozen=True)
class EdgePaths:
    """Paths over edges, one row each.

    Attributes:
        points: where they turn; beyond the end of an edge, on the line of the edge [m].
        length: [m].
        transfer: E at the receiver of E at 1 m from the transmitter, without the phase of the
            length [1/m]; world coordinates, receive × transmit.
        stationary: False where no such path exists: edges meet in the point where it would turn.
        slopes: as ``transfer``, of ∂E/∂ψ at the transmitter, and for ∂E/∂ψ of what the receiver
            would send; where they were asked for. ψ [rad] is the angle by which the ray at the
            antenna turns about ``−edge_axis``, its field with it.
    """

    points: Float64[Tensor, "row edge 3"]
    length: Float64[Tensor, " row"]
    transfer: Complex128[Tensor, "row 3 3"]
    stationary: Tensor
    slopes: Complex128[Tensor, "2 row 3 3"] | None = None


def over_edges(
    edges: Sequence[Edge],
    tx: Float64[Tensor, "row 3"],
    rx: Float64[Tensor, "row 3"],
    wave_number: float,
    *,
    slopes: bool = False,
) -> EdgePaths:
    """The diffracted field of one edge, or of two one after the other.

    Where two edges bound a face along which the path runs (``Edge.azimuth`` is then that of the
    face), the second meets half the field of the first.

    Args:
        edges: one or two, in the order in which the wave meets them.
        tx, rx: the antennas, or their images [m].
        wave_number: k [1/m].
        slopes: whether those are asked for; of one edge only.

    Source: derivations §9; slopes are (1/jk sinβ) ∂D/∂φ′ ∂E/∂n′.
    """
    route = _route(edges, tx, rx)
    turns = route.turns(wave_number)
    turned: list[Tensor] = []
    if len(edges) == 2:
        transfer = _second(route, turns, wave_number)
    else:
        orders: tuple[Order, ...] = ("value", "in", "out") if slopes else ("value",)
        transfer, *turned = diffraction_dyads(turns[0], wave_number, orders)
    spread = 1 / (route.legs.prod(1) * route.spread)
    amplitude = torch.stack([turn.sine for turn in turns]).prod(0) * spread
    found = None
    if slopes:
        scale = (spread / (1j * wave_number * turns[0].sine))[:, None] / route.legs
        found = torch.stack(turned) * scale.T[..., None, None]
    return EdgePaths(
        route.points,
        route.legs.sum(1),
        transfer * amplitude[:, None, None],
        route.stationary,
        found,
    )


def turning_points(
    wedges: Wedges, tx: Float64[Tensor, "row 3"], rx: Float64[Tensor, "row 3"]
) -> tuple[Float64[Tensor, "row 3"], Bool[Tensor, " row"]]:
    """Where paths over one edge turn, on its line, and whether such a path exists.

    Args:
        wedges: one row each.
        tx, rx: the antennas, or their images [m].
    """
    axis = _unit(wedges.end - wedges.start)
    points = wedges.start + _between(wedges.start, axis, tx, rx)[:, None] * axis
    before, after = (points - tx).norm(dim=1), (rx - points).norm(dim=1)
    return points, torch.minimum(before, after) > _LEAST * (before + after)


def two_turning_points(
    first: Wedges, second: Wedges, tx: Float64[Tensor, "row 3"], rx: Float64[Tensor, "row 3"]
) -> tuple[Float64[Tensor, "row 2 3"], Bool[Tensor, " row"]]:
    """As ``turning_points``, of paths over two edges.

    Args:
        first, second: one row each.
        tx, rx: the antennas [m].
    """
    route = _route([Edge(first), Edge(second)], tx, rx)
    return route.points, route.stationary


@dataclass(frozen=True)
class _Route:
    """The shortest path over edges.

    Attributes:
        edges: in order.
        offsets: places of its points along the edges, from their starts [row, edge] [m].
        points: of the path, antennas included.
        hessian: second derivatives of the length by the offsets.
        stationary: whether it is smooth there.
    """

    edges: Sequence[Edge]
    offsets: Tensor
    vertices: Float64[Tensor, "row vertex 3"]
    hessian: Float64[Tensor, "row edge edge"]
    stationary: Tensor

    @property
    def points(self) -> Tensor:
        """Where it turns."""
        return self.vertices[:, 1:-1]

    @property
    def legs(self) -> Float64[Tensor, "row leg"]:
        """Lengths from point to point [m]."""
        return (self.vertices[:, 1:] - self.vertices[:, :-1]).norm(dim=2)

    @property
    def spread(self) -> Tensor:
        """√det H."""
        if len(self.edges) == 1:
            return self.hessian[:, 0, 0].sqrt()
        return _determinant(self.hessian).clamp_min(1e-300).sqrt()

    def turns(self, wave_number: float) -> list[Turn]:
        """The waves at every edge."""
        found, legs = [], self.legs
        way = (self.vertices[:, 1:] - self.vertices[:, :-1]) / legs[..., None].clamp_min(1e-300)
        for number, edge in enumerate(self.edges):
            direction, towards = way[:, number], way[:, number + 1]
            turn = Turn(
                edge.wedges,
                direction,
                towards,
                _azimuth(edge.wedges, -direction, edge.azimuth_in),
                _azimuth(edge.wedges, towards, edge.azimuth),
                self._parameter(number, legs, way),
                edge.faces,
                None if edge.endless else self.ends(number, wave_number),
                edge.absorbs,
            )
            found.append(turn)
        return found

    def _parameter(self, number: int, legs: Tensor, way: Tensor) -> Tensor:
        """L of an edge: (s s′/(s + s′))² det H over that of the path without it."""
        before, after = legs[:, number], legs[:, number + 1]
        share = before * after / (before + after)
        stiff = self.spread**2
        if len(self.edges) == 2:
            other = 1 - number
            outer = legs[:, 2] if other else legs[:, 0]
            axis = edge_axis(self.edges[other].wedges)
            square = cross(axis, way[:, 2 * other]).square().sum(1)
            stiff = stiff / (square * (1 / outer + 1 / (before + after)))
        return share**2 * stiff

    def ends(self, number: int, wave_number: float) -> Float64[Tensor, "row 2"]:
        """√phase by which paths over the ends of an edge are longer, < 0 past the end.

        Of two edges, the other's point follows.
        """
        wedges = self.edges[number].wedges
        offset = self.offsets[:, number]
        past = torch.stack([offset, (wedges.end - wedges.start).norm(dim=1) - offset], 1)
        if len(self.edges) == 1:
            axis = _unit(wedges.end - wedges.start)
            point = self.vertices[:, 1]
            excess = torch.zeros_like(past)
            for antenna in (self.vertices[:, 0], self.vertices[:, 2]):
                along = dot(point - antenna, axis)
                aside = cross(point - antenna, axis).norm(dim=1)
                excess = excess + _excess(aside[:, None], along[:, None], past)
            return past * (wave_number * excess).sqrt()
        other = self.hessian[:, 1 - number, 1 - number]
        stiff = self.spread**2 / other.clamp_min(1e-300)
        bent = 0.5 * stiff[:, None] * past**2
        excess = self._over_ends(number) - self.legs.sum(1, keepdim=True)
        near = wave_number * bent.detach() < _BENT
        ratio = torch.where(near, 1.0, excess / torch.where(near, 1.0, bent))
        return past * (0.5 * wave_number * stiff[:, None] * ratio.clamp_min(0.0)).sqrt()

    def _over_ends(self, number: int) -> Float64[Tensor, "row 2"]:
        """Lengths of the paths over the ends of one edge of two, shortest over the other edge."""
        wedges, other = self.edges[number].wedges, self.edges[1 - number].wedges
        near, far = self.vertices[:, 3 * number], self.vertices[:, 3 - 3 * number]
        axis = _unit(other.end - other.start)
        found = []
        for end in (wedges.start, wedges.end):
            asides = [cross(point - other.start, axis).norm(dim=1) for point in (end, far)]
            folded = torch.hypot(asides[0] + asides[1], dot(far - end, axis))
            found.append((end - near).norm(dim=1) + folded)
        return torch.stack(found, 1)


_OUTWARDS = torch.tensor([-1.0, 1.0], dtype=torch.float64)


def _excess(aside: Tensor, along: Tensor, past: Tensor) -> Tensor:
    """[√(ρ² + (x + d)²) − √(ρ² + x²) − xd/√(ρ² + x²)]/d², also for d → 0."""
    moved = along + past * _OUTWARDS
    here, there = torch.hypot(aside, along), torch.hypot(aside, moved)
    return (aside**2 + here * there - along * moved) / (here * (here + there) ** 2)


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.norm(dim=1, keepdim=True)


def _azimuth(wedges: Wedges, direction: Tensor, known: Tensor | None) -> Tensor:
    found = azimuth_outside(wedges, direction, 0)
    return found if known is None else torch.where(known.isnan(), found, known)


def _route(edges: Sequence[Edge], tx: Tensor, rx: Tensor) -> _Route:
    """Where paths turn: in closed form on one edge, by Newton's steps on two."""
    starts = torch.stack([edge.wedges.start for edge in edges], 1)
    axes = torch.stack([_unit(edge.wedges.end - edge.wedges.start) for edge in edges], 1)
    if len(edges) == 1:
        offsets = _between(starts[:, 0], axes[:, 0], tx, rx)[:, None]
    else:
        offsets = _shortest(starts.detach(), axes.detach(), tx.detach(), rx.detach())
        # One more step, attached: it carries the derivatives of the places.
        vertices = _vertices(starts, axes, offsets, tx, rx)
        hessian = _second_derivatives(vertices.detach(), axes.detach())
        offsets = offsets - _solved(hessian, _slopes(vertices, axes))
    vertices = _vertices(starts, axes, offsets, tx, rx)
    legs = (vertices[:, 1:] - vertices[:, :-1]).detach().norm(dim=2)
    slope = _slopes(vertices.detach(), axes.detach())
    stationary = (legs > _LEAST * legs.sum(1, keepdim=True)).all(1) & (slope.abs() < 1e-6).all(1)
    return _Route(edges, offsets, vertices, _second_derivatives(vertices, axes), stationary)


def _between(start: Tensor, axis: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Where the shortest path between two points touches a line, from its start."""
    along = [dot(point - start, axis) for point in (first, last)]
    aside = [
        (point - start - way[:, None] * axis).norm(dim=-1)
        for point, way in zip((first, last), along, strict=True)
    ]
    share = aside[0] / (aside[0] + aside[1]).clamp_min(1e-300)
    return along[0] + (along[1] - along[0]) * share


def _vertices(starts: Tensor, axes: Tensor, offsets: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
    points = starts + offsets[..., None] * axes
    return torch.cat([tx[:, None], points, rx[:, None]], 1)


def _slopes(vertices: Tensor, axes: Tensor) -> Tensor:
    """Derivatives of the length by the offsets."""
    way = vertices[:, 1:] - vertices[:, :-1]
    way = way / way.norm(dim=2, keepdim=True).clamp_min(1e-300)
    return dot(axes, way[:, :-1]) - dot(axes, way[:, 1:])


def _second_derivatives(vertices: Tensor, axes: Tensor) -> Tensor:
    """H of the length: of a leg (e_a·e_b − (e_a·u)(e_b·u))/s between both of its ends."""
    way = vertices[:, 1:] - vertices[:, :-1]
    legs = way.norm(dim=2).clamp_min(1e-300)
    way = way / legs[..., None]

    def entry(a: int, b: int, leg: int) -> Tensor:
        first, second, u = axes[:, a], axes[:, b], way[:, leg]
        return (dot(first, second) - dot(first, u) * dot(second, u)) / legs[:, leg]

    own = [entry(a, a, a) + entry(a, a, a + 1) for a in range(axes.shape[1])]
    if len(own) == 1:
        return own[0][:, None, None]
    both = -entry(0, 1, 1)
    return torch.stack([own[0], both, both, own[1]], 1).unflatten(1, (2, 2))


def _determinant(matrix: Tensor) -> Tensor:
    return matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] ** 2


def _solved(matrix: Tensor, right: Tensor) -> Tensor:
    """H⁻¹ times a vector, 2 × 2."""
    first, second = right.unbind(1)
    flipped = [
        matrix[:, 1, 1] * first - matrix[:, 0, 1] * second,
        matrix[:, 0, 0] * second - matrix[:, 0, 1] * first,
    ]
    return torch.stack(flipped, 1) / _determinant(matrix).clamp_min(1e-300)[:, None]


def _shortest(starts: Tensor, axes: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
    """Places on two edges of the shortest path: Newton's steps where they shorten it.

    The length is convex; elsewhere each place is moved to the shortest way between its neighbours.
    That would stick where the edges' lines cross. So the second edge and the receiver are lifted
    into a fourth dimension first, and then let down.
    """
    offsets = torch.zeros(starts.shape[:2], dtype=starts.dtype)
    size = (rx - tx).norm(dim=1)
    none = torch.zeros_like(size)[:, None]
    for lift in _LIFTS:
        up = lift * size[:, None]
        offsets = _settled(
            offsets,
            torch.cat([starts, torch.stack([none, up], 1)], 2),
            torch.nn.functional.pad(axes, (0, 1)),
            torch.cat([tx, none], 1),
            torch.cat([rx, up], 1),
        )
    return offsets


def _settled(offsets: Tensor, starts: Tensor, axes: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
    """``_shortest`` from given places on."""

    def length(at: Tensor) -> Tensor:
        points = _vertices(starts, axes, at, tx, rx)
        return (points[:, 1:] - points[:, :-1]).norm(dim=2).sum(1)

    for _ in range(_STEPS):
        points = _vertices(starts, axes, offsets, tx, rx)
        first = _between(starts[:, 0], axes[:, 0], tx, points[:, 2])
        place = starts[:, 0] + first[:, None] * axes[:, 0]
        second = _between(starts[:, 1], axes[:, 1], place, rx)
        turned = torch.stack([first, second], 1)
        points = _vertices(starts, axes, turned, tx, rx)
        step = _solved(_second_derivatives(points, axes), _slopes(points, axes))
        newton = turned - step
        better = (length(newton) < length(turned))[:, None]
        offsets, before = torch.where(better, newton, turned), offsets
        if bool((offsets - before).abs().max() < 1e-12 * (1 + offsets.abs().max())):
            break
    return offsets


def _second(route: _Route, turns: Sequence[Turn], wave_number: float) -> Tensor:
    """The dyad of both edges; of those of a face with half the field, which is twice the incident.

    Two edges closer than half a wavelength are one thing, which two one after the other are not:
    that grows without bound into the corner where they meet. There it is taken off, by x³/(1 + x³).
    """
    way, legs = turns[0].towards, route.legs
    first, second = turns
    one, other = (normalize(cross(edge_axis(turn.wedges), way), dim=1) for turn in turns)
    share = legs[:, 0] * legs[:, 2] / ((legs[:, 0] + legs[:, 1]) * (legs[:, 1] + legs[:, 2]))
    total = double_dyad(first, second, -dot(one, other) * share.sqrt(), wave_number)
    before, after = route.edges[0].azimuth, route.edges[1].azimuth_in
    if before is not None and after is not None:
        total = torch.where(before.isnan()[:, None, None], total, total / 2)
    apart = (wave_number * legs[:, 1] / torch.pi) ** 3
    return total * (apart / (1 + apart))[:, None, None]
