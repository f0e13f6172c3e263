"""Geometry and fields of diffracted paths over up to three edges between point antennas.

A diffracted path is the shortest path that touches its edges (Fermat's principle). Its amplitude
spreads with the Hessian H of its length with respect to the positions along the edges: over N edges
``A = Π sinβ_i / (Π s_j √det H)``, in 1/length as for a free path. The distance parameter of an edge
is chosen such that the jump of its field at a boundary equals the field of the path without this
edge: ``L = s s′ sin²β/(s + s′)`` for one edge.

Transverse displacements along a path follow the statistics of a chain of springs: with S_i the
length up to edge i and T the total length, apertures at the edges have the covariances ``Σ_ij =
cosγ_ij S_i (T − S_j)/T``, γ between the edges as seen along the path. With P = Σ⁻¹, ``L_i =
sin²β_i/P_ii`` and the coupling of two edges is ``w_ij = ±P_ij/√(P_ii P_jj)``.

Source: derivations §9; Capolino, Albani, Maci and Tiberio, "Double diffraction at a pair of
coplanar skew edges", IEEE TAP 45, 1997.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import torch
from jaxtyping import Bool, Complex128, Float64
from torch import Tensor

from invertwin.channel.em import utd
from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.em.wedges import Wedges, edge_axis, exterior_azimuth

Vectors: TypeAlias = Float64[Tensor, "row 3"]
_MAX_STEPS = 40  # of the search for the shortest path over several edges
_LIFTS = (0.1, 0.01, 0.0)  # of the antennas' distance, in this order
_COARSE_TOLERANCE, _FINE_TOLERANCE = 1e-3, 1e-13  # of the antennas' distance: convergence
_SECOND_ORDER_PHASE = 1e-6  # rad, below which lengths over an end are of second order
_MIN_LENGTH_FRACTION = 1e-9  # of a path's length; shorter legs join touching edges


@dataclass(frozen=True)
class PathEdge:
    """Diffracting edge of a path, one row each.

    Attributes:
        wedges: edges with their faces.
        face_coefficients: field coefficients of the faces.
        azimuth_in, azimuth: known φ′ and φ, NaN where unknown [rad]; None = unknown in all rows.
        infinite: True for edges of infinite length.
        reflects: False for faces that do not reflect.
    """

    wedges: Wedges
    face_coefficients: utd.FaceCoefficients = utd.conductor_coefficients
    azimuth_in: Float64[Tensor, " row"] | None = None
    azimuth: Float64[Tensor, " row"] | None = None
    infinite: bool = False
    reflects: bool = True


@dataclass(frozen=True)
class EdgePaths:
    """Diffracted paths, one row each.

    Attributes:
        points: diffraction points; beyond the end of an edge, on the line of the edge [m].
        length: path length [m].
        transfer: E at the receiver over E at 1 m from the transmitter, without the phase of the
            length [1/m]; world axes, receive × transmit.
        stationary: False where no such path exists, since edges meet in the diffraction point.
        slopes: as ``transfer``, for ∂E/∂ψ at the transmitter and, by reciprocity, at the receiver;
            None unless requested. ψ [rad] rotates the ray at the antenna, with its field, about
            ``−edge_axis``.
    """

    points: Float64[Tensor, "row edge 3"]
    length: Float64[Tensor, " row"]
    transfer: Complex128[Tensor, "row 3 3"]
    stationary: Tensor
    slopes: Complex128[Tensor, "2 row 3 3"] | None = None


def diffract_over_edges(
    edges: Sequence[PathEdge], tx: Vectors, rx: Vectors, wave_number: float, *, slopes: bool = False
) -> EdgePaths:
    """Compute the diffracted field of one edge, or of two or three consecutive edges.

    Where two edges bound a face along which the path runs (``PathEdge.azimuth`` is then that of the
    face), half the field of the first is incident on the second.

    Args:
        edges: one to three edges, in the order of the path.
        tx, rx: positions of the antennas, or of their images [m].
        wave_number: wave number k [1/m].
        slopes: True to compute slopes; for one edge only.

    Source: derivations §9; slopes are (1/jk sinβ) ∂D/∂φ′ ∂E/∂n′.
    """
    route = find_route(edges, tx, rx)
    diffractions = route.edge_diffractions(wave_number)
    orders: tuple[utd.DyadDerivative, ...] = ("value", "in", "out") if slopes else ("value",)
    transfer, *derivatives = transfer_dyads(route, diffractions, wave_number, orders)
    found = None
    if slopes:
        scale = 1 / (1j * wave_number * diffractions[0].sin_beta[:, None] ** 2 * route.legs)
        found = torch.stack(derivatives) * scale.T[..., None, None]
    return EdgePaths(route.points, route.legs.sum(1), transfer, route.stationary, found)


def transfer_dyads(
    route: "Route",
    diffractions: Sequence[utd.EdgeDiffraction],
    wave_number: float,
    orders: Sequence[utd.DyadDerivative] = ("value",),
) -> list[Complex128[Tensor, "row 3 3"]]:
    """Transfer dyads of ``EdgePaths``, or their derivatives with respect to azimuths at one edge.

    Args:
        route: geometry of the paths.
        diffractions: diffraction geometry at its edges.
        wave_number: wave number k [1/m].
        orders: requested derivatives; for several edges, the value alone.
    """
    if len(diffractions) > 1:
        found = [_multiple_dyad(route, diffractions, wave_number)]
    else:
        found = list(utd.diffraction_dyads(diffractions[0], wave_number, orders))
    sines = torch.stack([diffraction.sin_beta for diffraction in diffractions]).prod(0)
    return [dyad * (sines / (route.legs.prod(1) * route.spread))[:, None, None] for dyad in found]


def multiple_diffraction_points(
    wedges: Sequence[Wedges], tx: Vectors, rx: Vectors
) -> tuple[Float64[Tensor, "row edge 3"], Bool[Tensor, " row"]]:
    """Diffraction points of paths, on the lines of their edges, and a mask of existing paths.

    Args:
        wedges: one edge or several, in the order of the path, one row each.
        tx, rx: positions of the antennas, or of their images [m].
    """
    route = find_route([PathEdge(each) for each in wedges], tx, rx)
    return route.points, route.stationary


@dataclass(frozen=True)
class Route:
    """Shortest path over edges.

    Attributes:
        edges: edges in the order of the path.
        offsets: positions of its points along the edges, from their starts, [row, edge] [m].
        vertices: vertices of the path, antennas included [m].
        hessian: second derivatives of the length with respect to the offsets [1/m].
        stationary: True where the length is smooth and stationary.
    """

    edges: Sequence[PathEdge]
    offsets: Tensor
    vertices: Float64[Tensor, "row vertex 3"]
    hessian: Float64[Tensor, "row edge edge"]
    stationary: Tensor

    @property
    def points(self) -> Float64[Tensor, "row edge 3"]:
        """Diffraction points [m]."""
        return self.vertices[:, 1:-1]

    @property
    def legs(self) -> Float64[Tensor, "row leg"]:
        """Lengths of the legs [m]."""
        return (self.vertices[:, 1:] - self.vertices[:, :-1]).norm(dim=2)

    @property
    def units(self) -> Float64[Tensor, "row leg 3"]:
        """Unit vectors of the legs, from the transmitter on."""
        offsets = self.vertices[:, 1:] - self.vertices[:, :-1]
        return offsets / self.legs[..., None].clamp_min(1e-300)

    @property
    def spread(self) -> Tensor:
        """Spreading factor √det H."""
        return _cofactors(self.hessian)[1].clamp_min(1e-300).sqrt()

    @property
    def covariance(self) -> Float64[Tensor, "row edge edge"]:
        """Covariances Σ of the edges' apertures, towards growing azimuths of departure [m]."""
        total, reached = self.legs.sum(1), self.legs.cumsum(1)
        units, count = self.units, len(self.edges)
        found = [[total] * count for _ in range(count)]
        axes = [edge_axis(edge.wedges) for edge in self.edges]
        # Orthogonal to every edge and to the path, before and after the edge.
        into, out = (
            [_normalise(cross(axis, units[:, n + after])) for n, axis in enumerate(axes)]
            for after in (0, 1)
        )
        for a in range(count):
            lateral = out[a]
            for b in range(a, count):
                cosine = torch.ones_like(total) if a == b else dot(lateral, into[b])
                found[a][b] = found[b][a] = cosine * reached[:, a] * (1 - reached[:, b] / total)
                if a < b:
                    # Diffraction rotates the path about this edge.
                    sides = [cross(units[:, b + n], each[b]) for n, each in enumerate((into, out))]
                    lateral = dot(lateral, sides[0])[:, None] * sides[1] + cosine[:, None] * out[b]
        return torch.stack([torch.stack(row, 1) for row in found], 1)

    def edge_diffractions(self, wave_number: float) -> list[utd.EdgeDiffraction]:
        """Return the diffraction geometry at every edge.

        Args:
            wave_number: wave number k [1/m].
        """
        found, units = [], self.units
        # Distance parameters over sin²β are 1/P_ii.
        minors, whole = _cofactors(self.covariance)
        own = torch.diagonal(minors, dim1=1, dim2=2)
        parameters = whole.clamp_min(0)[:, None] / own.clamp_min(1e-300)
        for number, edge in enumerate(self.edges):
            wedges, incident, diffracted = edge.wedges, units[:, number], units[:, number + 1]
            azimuth_in = _azimuth(wedges, -incident, edge.azimuth_in)
            angles = azimuth_in, _azimuth(wedges, diffracted, edge.azimuth)
            length = parameters[:, number] * cross(edge_axis(wedges), incident).square().sum(1)
            ends = None if edge.infinite else self.end_parameters(number, wave_number)
            law = edge.face_coefficients, ends, edge.reflects
            found.append(utd.EdgeDiffraction(wedges, incident, diffracted, *angles, length, *law))
        return found

    @property
    def couplings(self) -> Float64[Tensor, "row edge edge"]:
        """Couplings w_ij, > 0 if azimuths of departure at i and incidence at j grow alike."""
        minors, _ = _cofactors(self.covariance)
        root = torch.diagonal(minors, dim1=1, dim2=2).clamp_min(1e-300).sqrt()
        return minors / (root[:, :, None] * root[:, None])

    def end_parameters(self, edge_index: int, wave_number: float) -> Float64[Tensor, "row 2"]:
        """Return √phase by which paths over the ends of an edge are longer, < 0 beyond the end.

        The points on the other edges are re-optimised.

        Args:
            edge_index: index of the edge on the path.
            wave_number: wave number k [1/m].
        """
        past, root = self.end_distances(edge_index, wave_number)
        return past * root

    def end_distances(self, edge_index: int, wave_number: float) -> tuple[Tensor, Tensor]:
        """Return outward distances of an edge's ends [m], and √phase over them [1/m].

        Args:
            edge_index: index of the edge on the path.
            wave_number: wave number k [1/m].
        """
        wedges = self.edges[edge_index].wedges
        offset = self.offsets[:, edge_index]
        distance = torch.stack([offset, (wedges.end - wedges.start).norm(dim=1) - offset], 1)
        if len(self.edges) == 1:
            axis = _normalise(wedges.end - wedges.start)
            point = self.vertices[:, 1]
            excess = torch.zeros_like(distance)
            for antenna in (self.vertices[:, 0], self.vertices[:, 2]):
                axial = dot(point - antenna, axis)
                radial = cross(point - antenna, axis).norm(dim=1)
                excess = excess + _excess(radial[:, None], axial[:, None], distance)
            return distance, (wave_number * excess).sqrt()
        others = [number for number in range(len(self.edges)) if number != edge_index]
        _, minor = _cofactors(self.hessian[:, others][:, :, others])
        stiffness = self.spread**2 / minor.clamp_min(1e-300)
        second_order = 0.5 * stiffness[:, None] * distance**2
        excess = self._lengths_over_ends(edge_index) - self.legs.sum(1, keepdim=True)
        near = wave_number * second_order.detach() < _SECOND_ORDER_PHASE
        ratio = torch.where(near, 1.0, excess / torch.where(near, 1.0, second_order))
        return distance, (0.5 * wave_number * stiffness[:, None] * ratio.clamp_min(0.0)).sqrt()

    def _lengths_over_ends(self, edge_index: int) -> Float64[Tensor, "row 2"]:
        """Lengths of the shortest paths over either end of one edge."""
        wedges = self.edges[edge_index].wedges
        before = [edge.wedges for edge in self.edges[:edge_index]]
        after = [edge.wedges for edge in self.edges[edge_index + 1 :]]
        found = []
        for end in (wedges.start, wedges.end):
            first_part = _shortest_length(before, self.vertices[:, 0], end)
            found.append(first_part + _shortest_length(after, end, self.vertices[:, -1]))
        return torch.stack(found, 1)


def _shortest_length(wedges: Sequence[Wedges], first: Tensor, last: Tensor) -> Tensor:
    """Length of the shortest path over infinite edges, differentiable once."""
    if not wedges:
        return (last - first).norm(dim=1)
    axes = [_normalise(each.end - each.start) for each in wedges]
    if len(wedges) == 1:
        radial = [cross(point - wedges[0].start, axes[0]).norm(dim=1) for point in (first, last)]
        return torch.hypot(radial[0] + radial[1], dot(last - first, axes[0]))
    starts, axis = torch.stack([each.start for each in wedges], 1), torch.stack(axes, 1)
    offsets = _minimise_length(starts.detach(), axis.detach(), first.detach(), last.detach())
    nodes = _path_vertices(starts, axis, offsets, first, last)
    found = (nodes[:, 1:] - nodes[:, :-1]).norm(dim=2).sum(1)
    # Where lines intersect, the shortest path may contain their intersection, where it is not
    # smooth.
    offset, cosine = starts[:, 1] - starts[:, 0], dot(axes[0], axes[1])
    square = (1 - cosine**2).clamp_min(_MIN_LENGTH_FRACTION)
    along = dot(offset, axes[0] - cosine[:, None] * axes[1]) / square
    near = starts[:, 0] + along[:, None] * axes[0]
    gap = cross(near - starts[:, 1], axes[1]).detach().norm(dim=1)
    crossing = gap < _MIN_LENGTH_FRACTION * found.detach()
    over = (near - first).norm(dim=1) + (last - near).norm(dim=1)
    found = torch.where(crossing & (over.detach() < found.detach()), over, found)
    # A point on the adjacent line has no distance to it.
    for side, point in ((0, first), (1, last)):
        distance = cross(point - wedges[side].start, axes[side]).detach().norm(dim=1)
        remaining = _shortest_length([wedges[1 - side]], first, last)
        found = torch.where(distance < _MIN_LENGTH_FRACTION * found.detach(), remaining, found)
    return found


_OUTWARDS = torch.tensor([-1.0, 1.0], dtype=torch.float64)


def _excess(aside: Tensor, along: Tensor, past: Tensor) -> Tensor:
    """Return [√(ρ² + (x + d)²) − √(ρ² + x²) − xd/√(ρ² + x²)]/d², also for d → 0."""
    moved = along + past * _OUTWARDS
    here, there = torch.hypot(aside, along), torch.hypot(aside, moved)
    return (aside**2 + here * there - along * moved) / (here * (here + there) ** 2)


def _normalise(vector: Tensor) -> Tensor:
    return vector / vector.norm(dim=1, keepdim=True)


def _azimuth(wedges: Wedges, direction: Tensor, known: Tensor | None) -> Tensor:
    found = exterior_azimuth(wedges, direction, 0)
    return found if known is None else torch.where(known.isnan(), found, known)


def find_route(edges: Sequence[PathEdge], tx: Vectors, rx: Vectors) -> Route:
    """Find the shortest path: in closed form over one edge, by Newton's method over more.

    Args:
        edges: edges in the order of the path.
        tx, rx: positions of the antennas, or of their images [m].
    """
    starts = torch.stack([edge.wedges.start for edge in edges], 1)
    axes = torch.stack([_normalise(edge.wedges.end - edge.wedges.start) for edge in edges], 1)
    if len(edges) == 1:
        offsets = _closest_offset(starts[:, 0], axes[:, 0], tx, rx)[:, None]
    else:
        offsets = _minimise_length(starts.detach(), axes.detach(), tx.detach(), rx.detach())
        # One attached Newton step carries the derivatives of the offsets.
        vertices = _path_vertices(starts, axes, offsets, tx, rx)
        hessian = _length_hessian(vertices.detach(), axes.detach())
        offsets = offsets - _solve_tridiagonal(hessian, _length_gradient(vertices, axes))
    vertices = _path_vertices(starts, axes, offsets, tx, rx)
    legs = (vertices[:, 1:] - vertices[:, :-1]).detach().norm(dim=2)
    slope = _length_gradient(vertices.detach(), axes.detach())
    stationary = (legs > _MIN_LENGTH_FRACTION * legs.sum(1, keepdim=True)).all(1)
    stationary &= (slope.abs() < 1e-6).all(1)
    return Route(edges, offsets, vertices, _length_hessian(vertices, axes), stationary)


def _closest_offset(start: Tensor, axis: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Offset from a line's start at which the shortest path between two points touches it."""
    axial = [dot(point - start, axis) for point in (first, last)]
    ends = zip((first, last), axial, strict=True)
    radial = [(point - start - offset[:, None] * axis).norm(dim=-1) for point, offset in ends]
    fraction = radial[0] / (radial[0] + radial[1]).clamp_min(1e-300)
    return axial[0] + (axial[1] - axial[0]) * fraction


def _path_vertices(starts: Tensor, axes: Tensor, offsets: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
    return torch.cat([tx[:, None], starts + offsets[..., None] * axes, rx[:, None]], 1)


def _length_gradient(vertices: Tensor, axes: Tensor) -> Tensor:
    """Derivatives of the length with respect to the offsets."""
    direction = vertices[:, 1:] - vertices[:, :-1]
    direction = direction / direction.norm(dim=2, keepdim=True).clamp_min(1e-300)
    return dot(axes, direction[:, :-1]) - dot(axes, direction[:, 1:])


def _length_hessian(vertices: Tensor, axes: Tensor) -> Tensor:
    """Hessian of the length; a leg contributes (e_a·e_b − (e_a·u)(e_b·u))/s for its two ends."""
    direction = vertices[:, 1:] - vertices[:, :-1]
    legs = direction.norm(dim=2).clamp_min(1e-300)
    direction = direction / legs[..., None]

    def entry(first: Tensor, second: Tensor, chosen: slice) -> Tensor:
        u = direction[:, chosen]
        return (dot(first, second) - dot(first, u) * dot(second, u)) / legs[:, chosen]

    own = entry(axes, axes, slice(None, -1)) + entry(axes, axes, slice(1, None))
    both = -entry(axes[:, :-1], axes[:, 1:], slice(1, -1))
    return torch.diag_embed(own) + torch.diag_embed(both, 1) + torch.diag_embed(both, -1)


def _cofactors(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Cofactors and determinants of symmetric matrices of up to three rows."""
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
    """Solve tridiagonal symmetric systems, H ≥ 0 (Thomas algorithm)."""
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
    """Find offsets of the shortest path by Newton steps, where these shorten it.

    The length is convex; elsewhere each point is moved to the shortest path between its neighbours.
    That iteration would stall where the lines of the edges intersect. Each edge and the receiver
    are therefore first shifted along a fourth dimension, above the previous edge, and then lowered
    (continuation).
    """
    offsets = torch.zeros(starts.shape[:2], dtype=starts.dtype)
    size = (rx - tx).norm(dim=1)
    none = torch.zeros_like(size)[:, None]
    for lift in _LIFTS:
        ups = lift * size[:, None] * torch.arange(starts.shape[1])
        lines = torch.cat([starts, ups[..., None]], 2), torch.nn.functional.pad(axes, (0, 1))
        ends = torch.cat([tx, none], 1), torch.cat([rx, ups[:, -1:]], 1)
        tolerance = _COARSE_TOLERANCE if lift else _FINE_TOLERANCE
        offsets = _iterate_offsets(offsets, *lines, *ends, tolerance)
    return offsets


def _iterate_offsets(
    offsets: Tensor, starts: Tensor, axes: Tensor, tx: Tensor, rx: Tensor, tolerance: float
) -> Tensor:
    """Iterate offsets until they move by less than a fraction of the antennas' distance."""

    def length(at: Tensor) -> Tensor:
        points = _path_vertices(starts, axes, at, tx, rx)
        return (points[:, 1:] - points[:, :-1]).norm(dim=2).sum(1)

    found, rows = offsets, torch.arange(len(offsets))
    for _ in range(_MAX_STEPS):
        points, point, moved = _path_vertices(starts, axes, offsets, tx, rx), tx, []
        for n in range(starts.shape[1]):
            moved.append(_closest_offset(starts[:, n], axes[:, n], point, points[:, n + 2]))
            point = starts[:, n] + moved[-1][:, None] * axes[:, n]
        relaxed = torch.stack(moved, 1)
        points = _path_vertices(starts, axes, relaxed, tx, rx)
        slope = _length_gradient(points, axes)
        newton = relaxed - _solve_tridiagonal(_length_hessian(points, axes), slope)
        better = (length(newton) < length(relaxed))[:, None]
        offsets, before = torch.where(better, newton, relaxed), offsets
        found = found.index_copy(0, rows, offsets)
        # Continue with rows that have not converged.
        active = (offsets - before).abs().amax(1) >= tolerance * (rx - tx).norm(dim=1)
        if not bool(active.any()):
            break
        rows, offsets, starts, axes = rows[active], offsets[active], starts[active], axes[active]
        tx, rx = tx[active], rx[active]
    return found


def _multiple_dyad(
    route: Route, diffractions: Sequence[utd.EdgeDiffraction], wave_number: float
) -> Tensor:
    """Dyads of several edges.

    Along a face half the field counts, since it is twice the incident one.

    Two edges closer than half a wavelength act as one diffractor, and double diffraction diverges
    towards the corner where they meet. It is attenuated there by x³/(1 + x³).
    """
    couplings = route.couplings
    if len(diffractions) == 2:
        total = utd.double_dyad(diffractions[0], diffractions[1], couplings[:, 0, 1], wave_number)
    else:
        total = utd.triple_dyad(diffractions, couplings, wave_number)
    weight = torch.ones_like(couplings[:, 0, 0])
    for number, (one, other) in enumerate(pairwise(route.edges), start=1):
        if one.azimuth is not None and other.azimuth_in is not None:
            weight = torch.where(one.azimuth.isnan(), weight, weight / 2)
        separation = (wave_number * route.legs[:, number] / torch.pi) ** 3
        weight = weight * separation / (1 + separation)
    return total * weight[:, None, None]
