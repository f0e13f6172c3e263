"""Fields of point antennas by way of up to three edges: where paths turn, how long, how strong.

A path over edges is as short as paths that touch these edges can be. Its amplitude spreads with the
second derivatives H of its length by the places on the edges: over N edges
``A = Π sinβ_i / (Π s_j √det H)``, of the unit of 1/length that a free path has. The distance
parameter of an edge is that by which its field's step at a boundary is the whole field of the path
that leaves this edge out: ``L = s s′ sin²β/(s + s′)`` of one edge.

Waves spread across a path as a chain of springs: with S_i the length up to edge i and T that of
all, openings at the edges have the covariances ``Σ_ij = cosγ_ij S_i (T − S_j)/T``, γ between the
edges as seen along the way. With P = Σ⁻¹, ``L_i = sin²β_i/P_ii`` and the coupling of two edges
is ``w_ij = ±P_ij/√(P_ii P_jj)``.

Source: derivations §9; Capolino, Albani, Maci and Tiberio, "Double diffraction at a pair of
coplanar skew edges", IEEE TAP 45, 1997.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Complex128, Float64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.em.utd import (
    DyadDerivative,
    EdgeDiffraction,
    FaceCoefficients,
    conductor_coefficients,
    diffraction_dyads,
    double_dyad,
    triple_dyad,
)
from invertwin.channel.em.wedges import Wedges, edge_axis, exterior_azimuth

_MAX_STEPS = 40  # of the search for the shortest path over two edges
_LIFTS = (0.1, 0.01, 0.0)  # of the antennas' distance, one after the other
_COARSE_TOLERANCE, _FINE_TOLERANCE = (
    1e-3,
    1e-13,
)  # of the antennas' distance: by how much places may still move
_SECOND_ORDER_PHASE = (
    1e-6  # rad of phase, up to which a path over an end is as long as to second order
)
_MIN_LENGTH_FRACTION = 1e-9  # of a path's length: edges that touch there have no path between them


@dataclass(frozen=True)
class PathEdge:
    """An edge on paths' ways, one row each.

    Attributes:
        wedges: the edges with their faces.
        face_coefficients: what these do to waves.
        azimuth_in, azimuth: φ′ and φ where they are known, NaN elsewhere [rad]; None = nowhere.
        infinite: take the edges as infinitely long.
        absorbing: take the faces as such that neither mirror nor let through.
    """

    wedges: Wedges
    face_coefficients: FaceCoefficients = conductor_coefficients
    azimuth_in: Float64[Tensor, " row"] | None = None
    azimuth: Float64[Tensor, " row"] | None = None
    infinite: bool = False
    absorbing: bool = False


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


def diffract_over_edges(
    edges: Sequence[PathEdge],
    tx: Float64[Tensor, "row 3"],
    rx: Float64[Tensor, "row 3"],
    wave_number: float,
    *,
    slopes: bool = False,
) -> EdgePaths:
    """The diffracted field of one edge, or of two or three one after the other.

    Where two edges bound a face along which the path runs (``PathEdge.azimuth`` is then that of the
    face), the next meets half the field of the one before.

    Args:
        edges: one to three, in the order in which the wave meets them.
        tx, rx: the antennas, or their images [m].
        wave_number: k [1/m].
        slopes: whether those are asked for; of one edge only.

    Source: derivations §9; slopes are (1/jk sinβ) ∂D/∂φ′ ∂E/∂n′.
    """
    route = find_route(edges, tx, rx)
    turns = route.edge_diffractions(wave_number)
    orders: tuple[DyadDerivative, ...] = ("value", "in", "out") if slopes else ("value",)
    transfer, *turned = transfer_dyads(route, turns, wave_number, orders)
    found = None
    if slopes:
        scale = 1 / (1j * wave_number * turns[0].sin_beta[:, None] ** 2 * route.legs)
        found = torch.stack(turned) * scale.T[..., None, None]
    return EdgePaths(route.points, route.legs.sum(1), transfer, route.stationary, found)


def transfer_dyads(
    route: "Route",
    diffractions: Sequence[EdgeDiffraction],
    wave_number: float,
    orders: Sequence[DyadDerivative] = ("value",),
) -> list[Complex128[Tensor, "row 3 3"]]:
    """E at the receiver, as in ``EdgePaths``, and its derivatives by azimuths at a single edge.

    Args:
        route: the paths.
        diffractions: the waves at its edges.
        wave_number: k [1/m].
        orders: derivatives that are asked for; of several edges, the field alone.
    """
    if len(diffractions) > 1:
        found = [_multiple_dyad(route, diffractions, wave_number)]
    else:
        found = list(diffraction_dyads(diffractions[0], wave_number, orders))
    sines = torch.stack([turn.sin_beta for turn in diffractions]).prod(0)
    amplitude = sines / (route.legs.prod(1) * route.spread)
    return [dyad * amplitude[:, None, None] for dyad in found]


def diffraction_points(
    wedges: Wedges, tx: Float64[Tensor, "row 3"], rx: Float64[Tensor, "row 3"]
) -> tuple[Float64[Tensor, "row 3"], Bool[Tensor, " row"]]:
    """Where paths over one edge turn, on its line, and whether such a path exists.

    Args:
        wedges: one row each.
        tx, rx: the antennas, or their images [m].
    """
    axis = _normalise(wedges.end - wedges.start)
    points = wedges.start + _closest_offset(wedges.start, axis, tx, rx)[:, None] * axis
    before, after = (points - tx).norm(dim=1), (rx - points).norm(dim=1)
    return points, torch.minimum(before, after) > _MIN_LENGTH_FRACTION * (before + after)


def multiple_diffraction_points(
    wedges: Sequence[Wedges], tx: Float64[Tensor, "row 3"], rx: Float64[Tensor, "row 3"]
) -> tuple[Float64[Tensor, "row edge 3"], Bool[Tensor, " row"]]:
    """As ``diffraction_points``, of paths over several edges.

    Args:
        wedges: in the order of the path; one row each.
        tx, rx: the antennas [m].
    """
    route = find_route([PathEdge(each) for each in wedges], tx, rx)
    return route.points, route.stationary


@dataclass(frozen=True)
class Route:
    """The shortest path over edges.

    Attributes:
        edges: in order.
        offsets: places of its points along the edges, from their starts [row, edge] [m].
        vertices: of the path, antennas included [m].
        hessian: second derivatives of the length by the offsets.
        stationary: whether it is smooth there.
    """

    edges: Sequence[PathEdge]
    offsets: Tensor
    vertices: Float64[Tensor, "row vertex 3"]
    hessian: Float64[Tensor, "row edge edge"]
    stationary: Tensor

    @property
    def points(self) -> Float64[Tensor, "row edge 3"]:
        """Where it turns."""
        return self.vertices[:, 1:-1]

    @property
    def legs(self) -> Float64[Tensor, "row leg"]:
        """Lengths from point to point [m]."""
        return (self.vertices[:, 1:] - self.vertices[:, :-1]).norm(dim=2)

    @property
    def spread(self) -> Tensor:
        """√det H."""
        return _determinant(self.hessian).clamp_min(1e-300).sqrt()

    @property
    def covariance(self) -> Float64[Tensor, "row edge edge"]:
        """Σ of the openings at the edges, each where its azimuth of departure grows [m]."""
        legs = self.legs
        total, reached = legs.sum(1), legs.cumsum(1)
        ways = (self.vertices[:, 1:] - self.vertices[:, :-1]) / legs[..., None].clamp_min(1e-300)
        count = len(self.edges)
        found = [[total] * count for _ in range(count)]
        axes = [edge_axis(edge.wedges) for edge in self.edges]
        # Across every edge, before and after it.
        into, out = (
            [_normalise(cross(axis, ways[:, n + after])) for n, axis in enumerate(axes)]
            for after in (0, 1)
        )
        for a in range(count):
            side = out[a]
            for b in range(a, count):
                alike = torch.ones_like(total) if a == b else dot(side, into[b])
                found[a][b] = found[b][a] = alike * reached[:, a] * (1 - reached[:, b] / total)
                if a < b:
                    # Over this edge the way turns about it.
                    along = [cross(ways[:, b + n], each[b]) for n, each in enumerate((into, out))]
                    side = dot(side, along[0])[:, None] * along[1] + alike[:, None] * out[b]
        return torch.stack([torch.stack(row, 1) for row in found], 1)

    def edge_diffractions(self, wave_number: float) -> list[EdgeDiffraction]:
        """The waves at every edge.

        Args:
            wave_number: k [1/m].
        """
        found, legs = [], self.legs
        way = (self.vertices[:, 1:] - self.vertices[:, :-1]) / legs[..., None].clamp_min(1e-300)
        parameters = self._distance_parameters()
        for number, edge in enumerate(self.edges):
            direction, towards = way[:, number], way[:, number + 1]
            turn = EdgeDiffraction(
                edge.wedges,
                direction,
                towards,
                _azimuth(edge.wedges, -direction, edge.azimuth_in),
                _azimuth(edge.wedges, towards, edge.azimuth),
                parameters[:, number] * cross(edge_axis(edge.wedges), direction).square().sum(1),
                edge.face_coefficients,
                None if edge.infinite else self.end_parameters(number, wave_number),
                edge.absorbing,
            )
            found.append(turn)
        return found

    def _distance_parameters(self) -> Float64[Tensor, "row edge"]:
        """L/sin²β of the edges: 1/P_ii."""
        minors, whole = _cofactors(self.covariance)
        own = torch.diagonal(minors, dim1=1, dim2=2)
        return whole.clamp_min(0)[:, None] / own.clamp_min(1e-300)

    @property
    def couplings(self) -> Float64[Tensor, "row edge edge"]:
        """w_ij, > 0 where azimuths of departure from i and of incidence on j grow to one side."""
        minors, _ = _cofactors(self.covariance)
        root = torch.diagonal(minors, dim1=1, dim2=2).clamp_min(1e-300).sqrt()
        return minors / (root[:, :, None] * root[:, None])

    def end_parameters(self, edge_index: int, wave_number: float) -> Float64[Tensor, "row 2"]:
        """√phase by which paths over the ends of an edge are longer, < 0 past the end.

        The other edges' points follow.

        Args:
            edge_index: of the edge on the path.
            wave_number: k [1/m].
        """
        past, root = self.end_distances(edge_index, wave_number)
        return past * root

    def end_distances(self, edge_index: int, wave_number: float) -> tuple[Tensor, Tensor]:
        """How far the ends of an edge lie outwards of its point [m], and √phase over that [1/m].

        Args:
            edge_index: of the edge on the path.
            wave_number: k [1/m].
        """
        wedges = self.edges[edge_index].wedges
        offset = self.offsets[:, edge_index]
        past = torch.stack([offset, (wedges.end - wedges.start).norm(dim=1) - offset], 1)
        if len(self.edges) == 1:
            axis = _normalise(wedges.end - wedges.start)
            point = self.vertices[:, 1]
            excess = torch.zeros_like(past)
            for antenna in (self.vertices[:, 0], self.vertices[:, 2]):
                along = dot(point - antenna, axis)
                aside = cross(point - antenna, axis).norm(dim=1)
                excess = excess + _excess(aside[:, None], along[:, None], past)
            return past, (wave_number * excess).sqrt()
        rest = [other for other in range(len(self.edges)) if other != edge_index]
        other = _determinant(self.hessian[:, rest][:, :, rest])
        stiff = self.spread**2 / other.clamp_min(1e-300)
        bent = 0.5 * stiff[:, None] * past**2
        excess = self._lengths_over_ends(edge_index) - self.legs.sum(1, keepdim=True)
        near = wave_number * bent.detach() < _SECOND_ORDER_PHASE
        ratio = torch.where(near, 1.0, excess / torch.where(near, 1.0, bent))
        return past, (0.5 * wave_number * stiff[:, None] * ratio.clamp_min(0.0)).sqrt()

    def _lengths_over_ends(self, edge_index: int) -> Float64[Tensor, "row 2"]:
        """Lengths of the paths over the ends of one edge, shortest over the others."""
        wedges = self.edges[edge_index].wedges
        before = [edge.wedges for edge in self.edges[:edge_index]]
        after = [edge.wedges for edge in self.edges[edge_index + 1 :]]
        found = []
        for end in (wedges.start, wedges.end):
            there = _shortest_length(before, self.vertices[:, 0], end)
            found.append(there + _shortest_length(after, end, self.vertices[:, -1]))
        return torch.stack(found, 1)


def _shortest_length(wedges: Sequence[Wedges], first: Tensor, last: Tensor) -> Tensor:
    """Of ways over edges without ends, differentiable once."""
    if not wedges:
        return (last - first).norm(dim=1)
    axes = [_normalise(each.end - each.start) for each in wedges]
    if len(wedges) == 1:
        asides = [cross(point - wedges[0].start, axes[0]).norm(dim=1) for point in (first, last)]
        return torch.hypot(asides[0] + asides[1], dot(last - first, axes[0]))
    starts, axis = torch.stack([each.start for each in wedges], 1), torch.stack(axes, 1)
    offsets = _minimise_length(starts.detach(), axis.detach(), first.detach(), last.detach())
    stops = _path_vertices(starts, axis, offsets, first, last)
    found = (stops[:, 1:] - stops[:, :-1]).norm(dim=2).sum(1)
    # Where lines cross, the shortest way may go over their crossing, in which it is not smooth.
    apart, both = starts[:, 1] - starts[:, 0], dot(axes[0], axes[1])
    square = (1 - both**2).clamp_min(_MIN_LENGTH_FRACTION)
    near = (
        starts[:, 0] + (dot(apart, axes[0] - both[:, None] * axes[1]) / square)[:, None] * axes[0]
    )
    crossing = (
        cross(near - starts[:, 1], axes[1]).detach().norm(dim=1)
        < _MIN_LENGTH_FRACTION * found.detach()
    )
    over = (near - first).norm(dim=1) + (last - near).norm(dim=1)
    found = torch.where(crossing & (over.detach() < found.detach()), over, found)
    # A point on the line next to it needs no way there.
    for side, place in ((0, first), (1, last)):
        aside = cross(place - wedges[side].start, axes[side]).detach().norm(dim=1)
        rest = _shortest_length([wedges[1 - side]], first, last)
        found = torch.where(aside < _MIN_LENGTH_FRACTION * found.detach(), rest, found)
    return found


_OUTWARDS = torch.tensor([-1.0, 1.0], dtype=torch.float64)


def _excess(aside: Tensor, along: Tensor, past: Tensor) -> Tensor:
    """[√(ρ² + (x + d)²) − √(ρ² + x²) − xd/√(ρ² + x²)]/d², also for d → 0."""
    moved = along + past * _OUTWARDS
    here, there = torch.hypot(aside, along), torch.hypot(aside, moved)
    return (aside**2 + here * there - along * moved) / (here * (here + there) ** 2)


def _normalise(vector: Tensor) -> Tensor:
    return vector / vector.norm(dim=1, keepdim=True)


def _azimuth(wedges: Wedges, direction: Tensor, known: Tensor | None) -> Tensor:
    found = exterior_azimuth(wedges, direction, 0)
    return found if known is None else torch.where(known.isnan(), found, known)


def find_route(
    edges: Sequence[PathEdge], tx: Float64[Tensor, "row 3"], rx: Float64[Tensor, "row 3"]
) -> Route:
    """Where paths turn: in closed form on one edge, by Newton's steps on more.

    Args:
        edges: in the order of the path.
        tx, rx: the antennas, or their images [m].
    """
    starts = torch.stack([edge.wedges.start for edge in edges], 1)
    axes = torch.stack([_normalise(edge.wedges.end - edge.wedges.start) for edge in edges], 1)
    if len(edges) == 1:
        offsets = _closest_offset(starts[:, 0], axes[:, 0], tx, rx)[:, None]
    else:
        offsets = _minimise_length(starts.detach(), axes.detach(), tx.detach(), rx.detach())
        # One more step, attached: it carries the derivatives of the places.
        vertices = _path_vertices(starts, axes, offsets, tx, rx)
        hessian = _length_hessian(vertices.detach(), axes.detach())
        offsets = offsets - _solve_tridiagonal(hessian, _length_gradient(vertices, axes))
    vertices = _path_vertices(starts, axes, offsets, tx, rx)
    legs = (vertices[:, 1:] - vertices[:, :-1]).detach().norm(dim=2)
    slope = _length_gradient(vertices.detach(), axes.detach())
    stationary = (legs > _MIN_LENGTH_FRACTION * legs.sum(1, keepdim=True)).all(1) & (
        slope.abs() < 1e-6
    ).all(1)
    return Route(edges, offsets, vertices, _length_hessian(vertices, axes), stationary)


def _closest_offset(start: Tensor, axis: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Where the shortest path between two points touches a line, from its start."""
    along = [dot(point - start, axis) for point in (first, last)]
    aside = [
        (point - start - way[:, None] * axis).norm(dim=-1)
        for point, way in zip((first, last), along, strict=True)
    ]
    share = aside[0] / (aside[0] + aside[1]).clamp_min(1e-300)
    return along[0] + (along[1] - along[0]) * share


def _path_vertices(starts: Tensor, axes: Tensor, offsets: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
    points = starts + offsets[..., None] * axes
    return torch.cat([tx[:, None], points, rx[:, None]], 1)


def _length_gradient(vertices: Tensor, axes: Tensor) -> Tensor:
    """Derivatives of the length by the offsets."""
    way = vertices[:, 1:] - vertices[:, :-1]
    way = way / way.norm(dim=2, keepdim=True).clamp_min(1e-300)
    return dot(axes, way[:, :-1]) - dot(axes, way[:, 1:])


def _length_hessian(vertices: Tensor, axes: Tensor) -> Tensor:
    """H of the length: of a leg (e_a·e_b − (e_a·u)(e_b·u))/s between both of its ends."""
    way = vertices[:, 1:] - vertices[:, :-1]
    legs = way.norm(dim=2).clamp_min(1e-300)
    way = way / legs[..., None]

    def entry(a: int, b: int, leg: int) -> Tensor:
        first, second, u = axes[:, a], axes[:, b], way[:, leg]
        return (dot(first, second) - dot(first, u) * dot(second, u)) / legs[:, leg]

    count = axes.shape[1]
    none = torch.zeros_like(legs[:, 0])
    found = [[none] * count for _ in range(count)]
    for a in range(count):
        found[a][a] = entry(a, a, a) + entry(a, a, a + 1)
        if a:
            found[a][a - 1] = found[a - 1][a] = -entry(a - 1, a, a)
    return torch.stack([torch.stack(row, 1) for row in found], 1)


def _determinant(matrix: Tensor) -> Tensor:
    """Of tridiagonal symmetric ones."""
    before, last = torch.ones_like(matrix[:, 0, 0]), matrix[:, 0, 0]
    for n in range(1, matrix.shape[1]):
        step = matrix[:, n, n] * last - matrix[:, n - 1, n] ** 2 * before
        before, last = last, step
    return last


def _cofactors(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """The signed minors of symmetric matrices of up to three rows, and the determinants."""
    count = matrix.shape[1]
    if count == 1:
        return torch.ones_like(matrix), matrix[:, 0, 0]
    if count == 2:
        own, both = matrix.diagonal(dim1=1, dim2=2).flip(1), -matrix[:, 0, 1]
        found = torch.stack([own[:, 0], both, both, own[:, 1]], 1).unflatten(1, (2, 2))
    else:
        found = cross(matrix.roll(-1, 1), matrix.roll(-2, 1))
    return found, dot(matrix[:, 0], found[:, 0])


def _solve_tridiagonal(matrix: Tensor, right: Tensor) -> Tensor:
    """H⁻¹ times a vector, of tridiagonal H ≥ 0."""
    count = matrix.shape[1]
    pivots, sides = [matrix[:, 0, 0].clamp_min(1e-300)], [right[:, 0]]
    for n in range(1, count):
        share = matrix[:, n - 1, n] / pivots[-1]
        pivots.append((matrix[:, n, n] - share * matrix[:, n - 1, n]).clamp_min(1e-300))
        sides.append(right[:, n] - share * sides[-1])
    found = [sides[-1] / pivots[-1]]
    for n in reversed(range(count - 1)):
        found.insert(0, (sides[n] - matrix[:, n, n + 1] * found[0]) / pivots[n])
    return torch.stack(found, 1)


def _minimise_length(starts: Tensor, axes: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
    """Places on edges of the shortest path: Newton's steps where they shorten it.

    The length is convex; elsewhere each place is moved to the shortest way between its neighbours.
    That would stick where the edges' lines cross. So each edge and the receiver are lifted into a
    fourth dimension first, above the edge before, and then let down.
    """
    offsets = torch.zeros(starts.shape[:2], dtype=starts.dtype)
    size = (rx - tx).norm(dim=1)
    none = torch.zeros_like(size)[:, None]
    for lift in _LIFTS:
        ups = lift * size[:, None] * torch.arange(starts.shape[1])
        offsets = _iterate_offsets(
            offsets,
            torch.cat([starts, ups[..., None]], 2),
            torch.nn.functional.pad(axes, (0, 1)),
            torch.cat([tx, none], 1),
            torch.cat([rx, ups[:, -1:]], 1),
            _COARSE_TOLERANCE if lift else _FINE_TOLERANCE,
        )
    return offsets


def _iterate_offsets(
    offsets: Tensor, starts: Tensor, axes: Tensor, tx: Tensor, rx: Tensor, tolerance: float
) -> Tensor:
    """``_minimise_length`` from given places on, until these move by a share of the antennas'
    distance.
    """

    def length(at: Tensor) -> Tensor:
        points = _path_vertices(starts, axes, at, tx, rx)
        return (points[:, 1:] - points[:, :-1]).norm(dim=2).sum(1)

    found, rows = offsets, torch.arange(len(offsets))
    for _ in range(_MAX_STEPS):
        points, place, moved = _path_vertices(starts, axes, offsets, tx, rx), tx, []
        for n in range(starts.shape[1]):
            moved.append(_closest_offset(starts[:, n], axes[:, n], place, points[:, n + 2]))
            place = starts[:, n] + moved[-1][:, None] * axes[:, n]
        turned = torch.stack(moved, 1)
        points = _path_vertices(starts, axes, turned, tx, rx)
        newton = turned - _solve_tridiagonal(
            _length_hessian(points, axes), _length_gradient(points, axes)
        )
        better = (length(newton) < length(turned))[:, None]
        offsets, before = torch.where(better, newton, turned), offsets
        found = found.index_copy(0, rows, offsets)
        # Only those that still move go on.
        on = (offsets - before).abs().amax(1) >= tolerance * (rx - tx).norm(dim=1)
        if not bool(on.any()):
            break
        rows, offsets, starts, axes = rows[on], offsets[on], starts[on], axes[on]
        tx, rx = tx[on], rx[on]
    return found


def _multiple_dyad(
    route: Route, diffractions: Sequence[EdgeDiffraction], wave_number: float
) -> Tensor:
    """The dyad of all edges; of those of a face with half the field, which is twice the incident.

    Two edges closer than half a wavelength are one thing, which two one after the other are not:
    that grows without bound into the corner where they meet. There it is taken off, by x³/(1 + x³).
    """
    couplings = route.couplings
    if len(diffractions) == 2:
        total = double_dyad(diffractions[0], diffractions[1], couplings[:, 0, 1], wave_number)
    else:
        total = triple_dyad(diffractions, couplings, wave_number)
    share = torch.ones_like(couplings[:, 0, 0])
    for number, (one, other) in enumerate(pairwise(route.edges), start=1):
        if one.azimuth is not None and other.azimuth_in is not None:
            share = torch.where(one.azimuth.isnan(), share, share / 2)
        apart = (wave_number * route.legs[:, number] / torch.pi) ** 3
        share = share * apart / (1 + apart)
    return total * share[:, None, None]
