"""Method of moments for small closed conductors: dual-surface magnetic field integral equation.

For bodies of a few wavelengths, creeping waves and multiple tip and edge diffraction matter, and no
finite number of bounces captures them. There the magnetic field integral equation (MFIE) has a few
thousand unknowns. It is enforced on the surface and, times j, on a second surface inside: the first
alone fails at interior resonances.

Source: Shore and Yaghjian, "Dual-surface integral equations in electromagnetic scattering", IEEE
TAP 53, 2005; Poggio and Miller, in Mittra (ed.), Computer Techniques for Electromagnetics, 1973.

Differs from the source: in thin bodies, the second surface lies nearer to the first, and is omitted
where cells do not resolve the gap.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Complex64, Complex128, Float64
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot, phasor, polarisations
from invertwin.channel.rcs.moments.solver import CurrentSolver, Refusal, power_error, too_many

_Vector = Float64[Tensor, "3"]
_Aspects = Float64[Tensor, "aspect 3"]
_Facets = Float64[Tensor, "facet 3 3"]
_PIECES_PER_SIDE = 4.0  # side of a cell over the longest side of its pieces
_SEEDING_PIECES = 40  # pieces per cell in the first rounds of clustering
_NORMAL_WEIGHT = 0.7  # distance of orthogonal normals, in sides of a cell
_NEIGHBOUR_COUNT = 9
_MIN_NEIGHBOUR_COSINE = 0.6  # cosine of normals across an edge
_TANGENT_TOLERANCE = 1e-3  # of the size: height above the tangent plane that counts as zero

Array = NDArray[np.float64]
_CELL_PAIRS_AT_ONCE = 1 << 20
_SEEDING_ROUNDS, _FINAL_ROUNDS = 20, 5  # Lloyd iterations with some pieces, then with all
_CURVATURE_ROWS = 1 << 21
_SOLID_ANGLE_TOLERANCE = 0.35  # deviation from half the solid angle
_MAX_BURIED_SHARE = 0.02  # fraction of the surface that may exceed it


MAX_CELLS = 6000
"""Maximum number of cells, with two unknowns each."""
_MAX_INNER_DEPTH = 0.25  # wavelengths to the second surface
_INNER_DEPTH_SHARE = 0.8  # maximum depth over the radius of the inscribed ball
_MIN_CELLS_PER_DEPTH = 0.7  # minimum depth over the side of a cell
_INNER_WEIGHT = 1j  # of the equation on the second surface
_WIDTH_QUANTILES = (0.25, 1.0), (0.05, 0.3)  # quantile of cells, minimum radius over side
_CELLS_PER_WAVE_DIRECT = 75  # cells per wave, below which the matrix is factorised
_MAX_ITERATIONS = 80
_MAX_RESIDUAL = 3e-5  # of the right-hand side


@dataclass(frozen=True)
class SurfaceCells:
    """Cells of closed surfaces, one row each.

    Attributes:
        point: centres on the surface [m].
        normal: outward unit normals.
        area: areas [m²].
        curvature: shape operator B, dn = B dx [1/m].
        inscribed_radius: radius of the inscribed ball tangent to the surface there [m].
        closed: True if the surfaces enclose bodies that do not overlap.
    """

    point: Float64[np.ndarray, "cell 3"]
    normal: Float64[np.ndarray, "cell 3"]
    area: Float64[np.ndarray, " cell"]
    curvature: Float64[np.ndarray, "cell 3 3"]
    inscribed_radius: Float64[np.ndarray, " cell"]
    closed: bool

    @property
    def tangents(self) -> Float64[np.ndarray, "cell 2 3"]:
        """Unit tangents t₁, t₂ with t₁ × t₂ = n."""
        return _tangent_axes(self.normal)


def build_cells(corners: Float64[np.ndarray, "facet 3 3"], side: float) -> SurfaceCells:
    """Cluster triangles into cells of even size.

    Args:
        corners: corners of the triangles, with outward normals [m].
        side: side of a cell [m].
    """
    place, normal, area = _subdivide_triangles(corners, side / _PIECES_PER_SIDE)
    owner = _cluster_pieces(np.concatenate([place, _NORMAL_WEIGHT * side * normal], 1), area, side)
    whole = np.bincount(owner, area).astype(np.float64)
    centre = _cell_means(owner, area, place, whole)
    normals = _cell_means(owner, area, normal, whole)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # The centroid of a curved patch lies off the surface.
    near = _find_nearest(place, centre)
    distance = np.einsum("cx,cx->c", place[near] - centre, normal[near])
    centre += (distance / np.einsum("cx,cx->c", normals, normal[near]))[:, None] * normals
    ball, closed = _inscribed_radii(centre, normals, whole)
    return SurfaceCells(centre, normals, whole, _estimate_curvature(centre, normals), ball, closed)


def _subdivide_triangles(corners: Array, longest: float) -> tuple[Array, Array, Array]:
    """Bisect triangles until their sides are short: centroids, normals, areas."""
    found: list[Array] = []
    while len(corners):
        size = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2)
        large = size.max(1) > longest
        found.append(corners[~large])
        # Bisect the longest side, so that the pieces are not thin.
        order = (size[large].argmax(1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[large], order[..., None], 1).transpose(1, 0, 2)
        middle = (a + b) / 2
        corners = np.concatenate([np.stack(part, 1) for part in ((a, middle, c), (middle, b, c))])
    pieces = np.concatenate(found)
    normal = np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]) / 2
    area = np.linalg.norm(normal, axis=1)
    valid = area > 1e-9 * area.mean()
    return pieces.mean(1)[valid], normal[valid] / area[valid, None], area[valid]


def _cluster_pieces(feature: Array, area: Array, side: float) -> NDArray[np.int64]:
    """Assign pieces to cells by Lloyd's algorithm from area-weighted seeds; deterministic."""
    count = max(1, round(float(area.sum()) / side**2))
    order = np.random.default_rng(0).permutation(len(area))
    cumulative = np.cumsum(area[order]) / area.sum()
    # One seed per equal share of the area.
    chosen = order[np.searchsorted(cumulative, (np.arange(count) + 0.5) / count)]
    centre = feature[np.unique(chosen)]
    seeding = order[: _SEEDING_PIECES * count]
    for pieces in [seeding] * _SEEDING_ROUNDS + [order] * _FINAL_ROUNDS:
        owner = _find_nearest(centre, feature[pieces])
        cell_area = np.bincount(owner, area[pieces], len(centre)).astype(np.float64)
        centre = _cell_means(owner, area[pieces], feature[pieces], cell_area)[cell_area > 0]
    return np.unique(_find_nearest(centre, feature), return_inverse=True)[1]


def _find_nearest(points: Array, queries: Array, count: int = 1) -> NDArray[np.int64]:
    """Numbers of the nearest points."""
    return np.asarray(KDTree(points).query(queries, k=count)[1], dtype=np.int64)


def _cell_means(owner: NDArray[np.int64], area: Array, value: Array, cell_area: Array) -> Array:
    """Means over cells; zero for empty ones."""
    total = np.stack([np.bincount(owner, area * column, len(cell_area)) for column in value.T], 1)
    return np.asarray(total / np.where(cell_area > 0, cell_area, 1.0)[:, None], dtype=np.float64)


def _tangent_axes(normal: Array) -> Array:
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.asarray(np.stack([first, np.cross(normal, first)], 1), dtype=np.float64)


def _estimate_curvature(point: Array, normal: Array) -> Array:
    """Estimate the shape operator by least squares over neighbours on the same face."""
    near = _find_nearest(point, point, min(_NEIGHBOUR_COUNT, len(point)))[:, 1:]
    axes = _tangent_axes(normal)
    same = np.einsum("ckx,cx->ck", normal[near], normal) > _MIN_NEIGHBOUR_COSINE
    offset = np.einsum("cax,ckx->cka", axes, point[near] - point[:, None]) * same[..., None]
    change = np.einsum("cax,ckx->cka", axes, normal[near] - normal[:, None]) * same[..., None]
    square = np.einsum("cka,ckb->cab", offset, offset)
    # Regularised: few or collinear neighbours give a flat surface.
    regularisation = 1e-9 * np.einsum("caa->c", square) + 1e-30
    sums = np.einsum("cka,ckb->cab", offset, change)
    solution: Array = np.linalg.solve(square + regularisation[:, None, None] * np.eye(2), sums).real
    symmetric = (solution + solution.transpose(0, 2, 1)) / 2
    return np.asarray(axes.transpose(0, 2, 1) @ symmetric @ axes, dtype=np.float64)


def _inscribed_radii(point: Array, normal: Array, area: Array) -> tuple[Array, bool]:
    """Radii of inscribed balls, and a check that the interior solid angle is half of 4π."""
    count = len(point)
    radii, angle = np.full(count, np.inf), np.zeros(count)
    minimum = _TANGENT_TOLERANCE * float(np.ptp(point, axis=0).max())
    for rows in np.array_split(np.arange(count), math.ceil(count**2 / _CURVATURE_ROWS)):
        offset = point - point[rows, None]
        square = np.einsum("rcx,rcx->rc", offset, offset)
        depth = -np.einsum("rcx,rx->rc", offset, normal[rows])
        radius = np.where(depth > minimum, square / (2 * np.maximum(depth, minimum)), np.inf)
        radii[rows] = radius.min(1)
        flux = np.einsum("rcx,cx->rc", offset, normal) * area
        # The cell itself is seen edge-on and contributes zero.
        angle[rows] = (flux / np.maximum(square, minimum**2) ** 1.5).sum(1) / (4 * math.pi)
    wrong = np.abs(angle - 0.5) > _SOLID_ANGLE_TOLERANCE
    return radii, bool(area[wrong].sum() < _MAX_BURIED_SHARE * area.sum())


class MFIESolver(CurrentSolver[SurfaceCells]):
    """MFIE solver for closed conductors on cells, see ``CurrentSolver``.

    Args:
        corners: corners of the triangles of closed bodies, with outward normals [m].
        up: unit vector of the vertical axis, in one plane with V.
        refinements: numbers of times that cells are doubled, tried in turn.
    """

    MIN_SQUARES = 250
    ELEMENTS = "cells"

    def __init__(self, corners: _Facets, up: _Vector, refinements: Sequence[int] = (0,)) -> None:
        self.corners, self.up = corners.numpy(), up
        sides = self.corners[:, 1:] - self.corners[:, :1]
        normals = np.cross(sides[:, 0], sides[:, 1])
        super().__init__(float(np.linalg.norm(normals, axis=1).sum() / 2), refinements)

    def build_elements(self, side: float, refinement: int) -> SurfaceCells | Refusal:
        """Build cells fine enough for thin parts, see ``CurrentSolver.build_elements``."""
        if refusal := too_many(self.area / side**2, MAX_CELLS, self.ELEMENTS):
            return refusal
        cells = build_cells(self.corners, side)
        widths = [
            float(np.quantile(cells.inscribed_radius, share)) / least
            for share, least in _WIDTH_QUANTILES
        ]
        fine = min(side, *widths) / 2 ** (refinement / 2)
        if refusal := too_many(self.area / fine**2, MAX_CELLS, self.ELEMENTS):
            return refusal
        if fine < side:
            cells = build_cells(self.corners, fine)
        if cells.closed:
            return cells
        return Refusal("cells of thin, overlapping or reversed bodies are not closed", by_size=True)

    def assemble_equation(
        self, elements: SurfaceCells, wave_number: float, wave_count: int
    ) -> "_MFIEEquation":
        """Assemble the integral equation, see ``CurrentSolver.assemble_equation``."""
        return _MFIEEquation(elements, wave_number, self.up, wave_count)


class _MFIEEquation:
    """MFIE of cells at one frequency, with unknowns [t₁ of all cells, t₂ of all cells]."""

    def __init__(
        self, cells: SurfaceCells, wave_number: float, up: _Vector, wave_count: int
    ) -> None:
        self.k, self.up = wave_number, up
        self.use_direct_solver = wave_count * _CELLS_PER_WAVE_DIRECT > len(cells.point)
        self.origin = torch.from_numpy(cells.point.mean(0))
        self.point = torch.from_numpy(cells.point) - self.origin
        self.normal, self.tangents = map(torch.from_numpy, (cells.normal, cells.tangents))
        self.area, self.curvature = torch.from_numpy(cells.area), torch.from_numpy(cells.curvature)
        ball = torch.from_numpy(cells.inscribed_radius)
        most = _MAX_INNER_DEPTH * 2 * math.pi / wave_number
        self.inner_depth = (_INNER_DEPTH_SHARE * ball).clamp_max(most)
        is_resolved = self.inner_depth >= _MIN_CELLS_PER_DEPTH * self.area.sqrt()
        self.inner_weight = _INNER_WEIGHT * is_resolved

    @cached_property
    def matrix(self) -> Complex64[Tensor, "unknown unknown"]:
        """Matrix of ``J/2 − n × ∫ ∇G × J`` on the surface and inside."""
        count = len(self.point)
        matrix = torch.zeros(2, count, 2, count, dtype=torch.complex64)
        point, normal, axes = (x.float() for x in (self.point, self.normal, self.tangents))
        weight = self.area.float() / (4 * math.pi)
        for rows in torch.arange(count).split(max(1, _CELL_PAIRS_AT_ONCE // count)):
            offset = point[rows, None] - point
            height = dot(offset, normal[rows, None])
            square = dot(offset, offset)
            strength = _greens_gradient(self.k, square, weight)
            strength[torch.arange(len(rows)), rows] = 0
            inner = square - 2 * self.inner_depth[rows, None].float() * height
            inner = (inner + self.inner_depth[rows, None].float() ** 2).clamp_min(1e-20)
            second = _greens_gradient(self.k, inner, weight)
            second = self.inner_weight[rows, None].to(torch.complex64) * second
            combined = strength + second
            lower = strength * height + second * (height - self.inner_depth[rows, None].float())
            for a in (0, 1):
                along = combined * dot(offset, axes[rows, None, a])
                for b in (0, 1):
                    lean = normal[rows] @ axes[:, b].T
                    matrix[a, rows, b] = lower * (axes[rows, a] @ axes[:, b].T) - along * lean
        # Self term: a disc with the curvature of the surface; half of J is the jump.
        self_term = self.tangents @ self.curvature @ self.tangents.mT
        trace = self_term.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        radius = (self.area / math.pi).sqrt()[:, None, None]
        half = torch.eye(2, dtype=torch.float64) / 2
        self_term = half + radius / 4 * (self_term - trace * half)
        matrix.diagonal(dim1=1, dim2=3).add_(self_term.permute(1, 2, 0))
        return matrix.view(2 * count, 2 * count)

    @cached_property
    def factors(self) -> tuple[Tensor, Tensor]:
        """LU factors of the matrix, cheaper than iterations for many waves."""
        lower, pivots = torch.linalg.lu_factor(self.matrix)
        return lower, pivots

    def solve_currents(self, transmitters: _Aspects) -> Complex128[Tensor, "cell aspect 2 3"]:
        """Solve the currents η J of plane waves of 1 V/m.

        Args:
            transmitters: unit vectors to the transmitters.
        """
        direction = -transmitters
        columns = self._excitation(direction, polarisations(transmitters, self.up))
        wave = -self.k * self.point @ direction.T
        inner = self.k * self.inner_depth[:, None] * (self.normal @ direction.T)
        phase = phasor(wave) * (1 + self.inner_weight[:, None] * phasor(inner))
        columns = columns * phase[None, :, :, None] * self._origin_phase(transmitters)[:, None]
        shape = columns.shape
        right = columns.reshape(shape[0] * shape[1], -1).to(torch.complex64)
        if self.use_direct_solver:
            solution = torch.linalg.lu_solve(*self.factors, right)
        else:
            solution = _solve_gmres(self.matrix, right)
        found = solution.view(shape).to(torch.complex128)
        return torch.einsum("icat,icx->catx", found, self.tangents.mT.permute(2, 0, 1) + 0j)

    def _excitation(self, direction: Tensor, field: Tensor) -> Tensor:
        """n × H along both tangents of every cell, without phases: [axis, cell, aspect, field]."""
        magnetic = cross(direction[:, None], field)
        return torch.einsum("cix,atx->icat", cross(self.tangents, self.normal[:, None]), magnetic)

    def _origin_phase(self, directions: Tensor) -> Tensor:
        """Phasor between the cells' centroid and the world's origin."""
        return phasor(self.k * (directions @ self.origin))

    def far_field(
        self,
        current: Complex128[Tensor, "cell aspect 2 3"],
        transmitters: _Aspects,
        receivers: _Aspects,
    ) -> Complex128[Tensor, "aspect 2 2"]:
        """Compute the far-field amplitudes S of currents, at the receiver of each wave.

        Args:
            current: η J for the transmitters' waves.
            transmitters, receivers: unit vectors to the antennas.
        """
        phase = phasor(self.k * (self.point @ receivers.T)) * self.area[:, None]
        total = torch.einsum("ca,catx->atx", phase, current)
        field = -1j * self.k / (4 * math.pi) * self._origin_phase(receivers)[:, None, None] * total
        received = polarisations(receivers, self.up).to(torch.complex128)
        return torch.einsum("arx,atx->art", received, field)

    def power_error(self, current: Tensor, transmitters: Tensor) -> float:
        """Relative error of the power balance of the first wave's currents (optical theorem)."""
        moments = current[:, 0] * self.area[:, None, None]
        sent = polarisations(transmitters[:1], self.up)[0]
        return power_error(self.k, self.point + self.origin, moments, -transmitters[0], sent)


def _solve_gmres(
    matrix: Complex64[Tensor, "n n"], right: Complex64[Tensor, "n column"]
) -> Complex64[Tensor, "n column"]:
    """Solve for all columns at once by GMRES (Saad and Schultz 1986)."""
    size = right.norm(dim=0)
    basis = [right / size]
    shape = _MAX_ITERATIONS + 1, _MAX_ITERATIONS, right.shape[1]
    upper = torch.zeros(shape, dtype=torch.complex128)
    coefficients = upper[:0]
    for iteration in range(1, _MAX_ITERATIONS + 1):
        vector_new = matrix @ basis[-1]
        for i, vector in enumerate(basis):
            projection = (vector.conj() * vector_new).sum(0)
            upper[i, iteration - 1] = projection
            vector_new = vector_new - projection * vector
        upper[iteration, iteration - 1] = vector_new.norm(dim=0)
        basis.append(vector_new / vector_new.norm(dim=0))
        system = upper[: iteration + 1, :iteration].permute(2, 0, 1)
        first = torch.zeros(len(system), iteration + 1, 1, dtype=torch.complex128)
        first[:, 0] = 1
        coefficients = torch.linalg.lstsq(system, first).solution
        if float((system @ coefficients - first).norm(dim=1).max()) < _MAX_RESIDUAL:
            break
    weights = coefficients[..., 0].T.to(torch.complex64) * size
    return torch.stack([w * v for w, v in zip(weights, basis, strict=False)]).sum(0)


def _greens_gradient(k: float, square: Tensor, weight: Tensor) -> Tensor:
    """Factor of ∇G = factor · (r − r′), G = exp(−jkR)/4πR, in single precision."""
    distance = square.clamp_min(1e-20).sqrt()
    phase = k * distance
    return torch.polar(-weight / distance**3, -phase) * torch.complex(torch.ones_like(phase), phase)
