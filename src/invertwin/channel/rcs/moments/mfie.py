"""Small closed conductors: currents from an integral equation instead of rules for rays.

Where a body is of few wavelengths, waves creep round it, tips and edges send to each other, and no
order of rays counts all. There the magnetic field integral equation has a few thousand unknowns.
It is asked on the surface and, times j, on a second surface inside: alone it fails at the
resonances of the inside.

Source: Shore and Yaghjian, "Dual-surface integral equations in electromagnetic scattering", IEEE
TAP 53, 2005; Poggio and Miller, in Mittra (ed.), Computer Techniques for Electromagnetics, 1973.

Differs from the source: where bodies are thin, the second surface lies nearer to the first, and is
left out where cells do not resolve the gap.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Complex64, Complex128, Float64
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot, phasor, polarisations
from invertwin.channel.rcs.moments.solver import CurrentSolver, conserves_power

_PIECES_PER_SIDE = 4.0  # of a side of a cell over the longest side of its pieces
_SEEDING_PIECES = 40  # pieces of a cell with which centres are spread first
_NORMAL_WEIGHT = 0.7  # cells' sides that normals at right angles are apart
_NEIGHBOUR_COUNT = 9
_MIN_NEIGHBOUR_COSINE = 0.6  # cosine of neighbours' normals, below which an edge lies between
_TANGENT_TOLERANCE = (
    1e-3  # of the size: nearer to the tangent plane, nothing faces a cell from within
)

Array = NDArray[np.float64]
_CELL_PAIRS_AT_ONCE = 1 << 20
_SEEDING_ROUNDS, _FINAL_ROUNDS = 20, 5  # rounds with some pieces, then with all
_CURVATURE_ROWS = 1 << 21
_SOLID_ANGLE_TOLERANCE, _MAX_BURIED_SHARE = (
    0.35,
    0.02,
)  # off half a solid angle, and share of the surface where it may be


MAX_CELLS = 6000
"""Cells up to which currents are solved: twice as many unknowns."""
_MAX_INNER_DEPTH = 0.25  # wavelengths to the second surface,
_INNER_DEPTH_SHARE = 0.8  # but less of the ball that fits in,
_MIN_CELLS_PER_DEPTH = 0.7  # and at least so many cells' sides
_INNER_WEIGHT = 1j  # of the second equation
_WIDTH_QUANTILES = (
    (0.25, 1.0),
    (0.05, 0.3),
)  # of how many cells the balls may be how many sides less
_CELLS_PER_WAVE_DIRECT = 75  # cells per wave, below which the matrix is factorised
_MAX_ITERATIONS = 80
_MAX_RESIDUAL = 3e-5  # of the right-hand side


@dataclass(frozen=True)
class SurfaceCells:
    """Patches of closed surfaces, one row each.

    Attributes:
        point: a place on the surface in the middle [m].
        normal: unit vectors outwards.
        area: [m²].
        curvature: how normals change along the surface, dn = B dx [1/m].
        inscribed_radius: radius of the ball inside that touches the surface there and nothing
            else [m].
        closed: whether the surfaces enclose bodies that do not overlap.
    """

    point: Float64[np.ndarray, "cell 3"]
    normal: Float64[np.ndarray, "cell 3"]
    area: Float64[np.ndarray, " cell"]
    curvature: Float64[np.ndarray, "cell 3 3"]
    inscribed_radius: Float64[np.ndarray, " cell"]
    closed: bool

    @property
    def tangents(self) -> Float64[np.ndarray, "cell 2 3"]:
        """Unit vectors in the surface: t₁, t₂ with t₁ × t₂ = n."""
        return _tangent_axes(self.normal)


def build_cells(corners: Float64[np.ndarray, "facet 3 3"], side: float) -> SurfaceCells:
    """Even cells of triangles.

    Args:
        corners: of the triangles, whose normals point outwards [m].
        side: of a cell [m].
    """
    place, normal, area = _subdivide_triangles(corners, side / _PIECES_PER_SIDE)
    owner = _cluster_pieces(np.concatenate([place, _NORMAL_WEIGHT * side * normal], 1), area, side)
    count = int(owner.max()) + 1
    whole = np.bincount(owner, area, count).astype(np.float64)
    middle = _cell_means(owner, area, place, whole)
    towards = _cell_means(owner, area, normal, whole)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    # The middle of a bent patch lies beside the surface.
    near = _find_nearest(place, middle)
    off = np.einsum("cx,cx->c", place[near] - middle, normal[near])
    middle += (off / np.einsum("cx,cx->c", towards, normal[near]))[:, None] * towards
    ball, closed = _inscribed_radii(middle, towards, whole)
    return SurfaceCells(middle, towards, whole, _estimate_curvature(middle, towards), ball, closed)


def _subdivide_triangles(corners: Array, longest: float) -> tuple[Array, Array, Array]:
    """Triangles halved until their sides are short: middles, normals, areas."""
    found: list[Array] = []
    while len(corners):
        size = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2)
        large = size.max(1) > longest
        found.append(corners[~large])
        # The longest side first, so that long thin triangles do not become many thin ones.
        turn = (size[large].argmax(1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[large], turn[..., None], 1).transpose(1, 0, 2)
        middle = (a + b) / 2
        corners = np.concatenate([np.stack(part, 1) for part in ((a, middle, c), (middle, b, c))])
    every = np.concatenate(found)
    normal = np.cross(every[:, 1] - every[:, 0], every[:, 2] - every[:, 0]) / 2
    area = np.linalg.norm(normal, axis=1)
    some = area > 1e-9 * area.mean()
    return every.mean(1)[some], normal[some] / area[some, None], area[some]


def _cluster_pieces(feature: Array, area: Array, side: float) -> NDArray[np.int64]:
    """The number of each piece's cell: Lloyd's rounds from centres drawn by area, always alike."""
    count = max(1, round(float(area.sum()) / side**2))
    draw = np.random.default_rng(0)
    order = draw.permutation(len(area))
    share = np.cumsum(area[order]) / area.sum()
    # One centre from each equal share of the area.
    chosen = order[np.searchsorted(share, (np.arange(count) + 0.5) / count)]
    centre = feature[np.unique(chosen)]
    some = order[: _SEEDING_PIECES * count]
    rounds = [some] * _SEEDING_ROUNDS + [order] * _FINAL_ROUNDS
    for pieces in rounds:
        owner = _find_nearest(centre, feature[pieces])
        whole = np.bincount(owner, area[pieces], len(centre)).astype(np.float64)
        kept = whole > 0
        centre = _cell_means(owner, area[pieces], feature[pieces], whole)[kept]
    return np.unique(_find_nearest(centre, feature), return_inverse=True)[1]


def _find_nearest(points: Array, queries: Array, count: int = 1) -> NDArray[np.int64]:
    """Numbers of the nearest places."""
    return np.asarray(KDTree(points).query(queries, k=count)[1], dtype=np.int64)


def _cell_means(owner: NDArray[np.int64], area: Array, value: Array, cell_area: Array) -> Array:
    """Means over cells; of empty ones zero."""
    total = np.stack([np.bincount(owner, area * column, len(cell_area)) for column in value.T], 1)
    return np.asarray(total / np.where(cell_area > 0, cell_area, 1.0)[:, None], dtype=np.float64)


def _tangent_axes(normal: Array) -> Array:
    aside = np.eye(3)[np.abs(normal).argmin(1)]
    first = np.cross(normal, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.asarray(np.stack([first, np.cross(normal, first)], 1), dtype=np.float64)


def _estimate_curvature(point: Array, normal: Array) -> Array:
    """How normals turn towards neighbours on the same face, by least squares."""
    near = _find_nearest(point, point, min(_NEIGHBOUR_COUNT, len(point)))[:, 1:]
    axes = _tangent_axes(normal)
    same = np.einsum("ckx,cx->ck", normal[near], normal) > _MIN_NEIGHBOUR_COSINE
    away = np.einsum("cax,ckx->cka", axes, point[near] - point[:, None]) * same[..., None]
    turn = np.einsum("cax,ckx->cka", axes, normal[near] - normal[:, None]) * same[..., None]
    square = np.einsum("cka,ckb->cab", away, away)
    # Where neighbours are few or in line, the surface counts as flat.
    least = 1e-9 * np.einsum("caa->c", square) + 1e-30
    sums = np.einsum("cka,ckb->cab", away, turn)
    bent: Array = np.linalg.solve(square + least[:, None, None] * np.eye(2), sums).real
    even = (bent + bent.transpose(0, 2, 1)) / 2
    return np.asarray(axes.transpose(0, 2, 1) @ even @ axes, dtype=np.float64)


def _inscribed_radii(point: Array, normal: Array, area: Array) -> tuple[Array, bool]:
    """Radii of touching balls, and whether the solid angle inside is half of all, as it should."""
    count = len(point)
    ball, angle = np.full(count, np.inf), np.zeros(count)
    least = _TANGENT_TOLERANCE * float(np.ptp(point, axis=0).max())
    for rows in np.array_split(np.arange(count), math.ceil(count**2 / _CURVATURE_ROWS)):
        away = point - point[rows, None]
        square = np.einsum("rcx,rcx->rc", away, away)
        below = -np.einsum("rcx,rx->rc", away, normal[rows])
        radius = np.where(below > least, square / (2 * np.maximum(below, least)), np.inf)
        ball[rows] = radius.min(1)
        seen = np.einsum("rcx,cx->rc", away, normal) * area
        # The cell itself is seen edge-on: zero over something.
        angle[rows] = (seen / np.maximum(square, least**2) ** 1.5).sum(1) / (4 * math.pi)
    wrong = np.abs(angle - 0.5) > _SOLID_ANGLE_TOLERANCE
    return ball, bool(area[wrong].sum() < _MAX_BURIED_SHARE * area.sum())


class MFIESolver(CurrentSolver[SurfaceCells]):
    """Closed conductors whose currents are solved on cells, see ``CurrentSolver``.

    Args:
        corners: of the triangles of closed bodies, normals outwards [m].
        up: V lies in a plane with this unit vector.
    """

    MIN_SQUARES = 250

    def __init__(self, corners: Float64[Tensor, "facet 3 3"], up: Float64[Tensor, "3"]) -> None:
        self.corners, self.up = corners.numpy(), up
        sides = self.corners[:, 1:] - self.corners[:, :1]
        normals = np.cross(sides[:, 0], sides[:, 1])
        super().__init__(float(np.linalg.norm(normals, axis=1).sum() / 2))

    def build_elements(self, side: float) -> SurfaceCells | None:
        """Cells that a thin body's width holds, if they are not too many."""
        if self.area / side**2 > MAX_CELLS:
            return None
        cells = build_cells(self.corners, side)
        width = min(
            float(np.quantile(cells.inscribed_radius, share)) / least
            for share, least in _WIDTH_QUANTILES
        )
        if width < side:
            if self.area / width**2 > MAX_CELLS:
                return None
            cells = build_cells(self.corners, width)
        return cells if cells.closed else None

    def assemble_equation(
        self, elements: SurfaceCells, wave_number: float, wave_count: int
    ) -> "_MFIEEquation":
        """See ``CurrentSolver.equation``."""
        return _MFIEEquation(elements, wave_number, self.up, wave_count)


class _MFIEEquation:
    """The integral equation of cells at one frequency: [t₁ of all cells, t₂ of all cells]."""

    def __init__(
        self, cells: SurfaceCells, wave_number: float, up: Float64[Tensor, "3"], wave_count: int
    ) -> None:
        self.k, self.up = wave_number, up
        self.use_direct_solver = wave_count * _CELLS_PER_WAVE_DIRECT > len(cells.point)
        self.origin = torch.from_numpy(cells.point.mean(0))
        self.point = torch.from_numpy(cells.point) - self.origin
        self.normal, self.tangents = (
            torch.from_numpy(cells.normal),
            torch.from_numpy(cells.tangents),
        )
        self.area, self.curvature = torch.from_numpy(cells.area), torch.from_numpy(cells.curvature)
        ball = torch.from_numpy(cells.inscribed_radius)
        self.inner_depth = (_INNER_DEPTH_SHARE * ball).clamp_max(
            _MAX_INNER_DEPTH * 2 * math.pi / wave_number
        )
        self.inner_weight = _INNER_WEIGHT * (
            self.inner_depth >= _MIN_CELLS_PER_DEPTH * self.area.sqrt()
        )

    @cached_property
    def matrix(self) -> Complex64[Tensor, "unknown unknown"]:
        """``J/2 − n × ∫ ∇G × J`` on the surface and inside."""
        count = len(self.point)
        matrix = torch.zeros(2, count, 2, count, dtype=torch.complex64)
        point, normal, axes = (x.float() for x in (self.point, self.normal, self.tangents))
        weight = self.area.float() / (4 * math.pi)
        for rows in torch.arange(count).split(max(1, _CELL_PAIRS_AT_ONCE // count)):
            away = point[rows, None] - point
            height = dot(away, normal[rows, None])
            square = dot(away, away)
            strength = _greens_gradient(self.k, square, weight)
            strength[torch.arange(len(rows)), rows] = 0
            inner = square - 2 * self.inner_depth[rows, None].float() * height
            inner = (inner + self.inner_depth[rows, None].float() ** 2).clamp_min(1e-20)
            second = self.inner_weight[rows, None].to(torch.complex64) * _greens_gradient(
                self.k, inner, weight
            )
            both = strength + second
            lower = strength * height + second * (height - self.inner_depth[rows, None].float())
            for a in (0, 1):
                along = both * dot(away, axes[rows, None, a])
                for b in (0, 1):
                    lean = normal[rows] @ axes[:, b].T
                    matrix[a, rows, b] = lower * (axes[rows, a] @ axes[:, b].T) - along * lean
        # The cell itself, as a disc that is bent as the surface is; half of J is the jump.
        own = self.tangents @ self.curvature @ self.tangents.mT
        trace = own.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
        radius = (self.area / math.pi).sqrt()[:, None, None]
        own = torch.eye(2, dtype=torch.float64) / 2 + radius / 4 * (
            own - trace / 2 * torch.eye(2, dtype=torch.float64)
        )
        every = torch.arange(count)
        for a in (0, 1):
            for b in (0, 1):
                matrix[a, every, b, every] += own[:, a, b].to(torch.complex64)
        return matrix.view(2 * count, 2 * count)

    @cached_property
    def factors(self) -> tuple[Tensor, Tensor]:
        """The matrix, factorised: for many waves that is less work than rounds for each."""
        lower, pivots = torch.linalg.lu_factor(self.matrix)
        return lower, pivots

    def solve_currents(
        self, transmitters: Float64[Tensor, "aspect 3"]
    ) -> Complex128[Tensor, "cell aspect 2 3"]:
        """η J of plane waves of 1 V/m.

        Args:
            transmitters: the antennas.
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
        """n × H along both axes of every cell, without phases: [axis, cell, aspect, field]."""
        magnetic = cross(direction[:, None], field)
        along = cross(self.tangents, self.normal[:, None])
        return torch.einsum("cix,atx->icat", along, magnetic)

    def _origin_phase(self, directions: Tensor) -> Tensor:
        """Of the cells' middle against the world's origin."""
        return phasor(self.k * (directions @ self.origin))

    def far_field(
        self,
        current: Complex128[Tensor, "cell aspect 2 3"],
        transmitters: Float64[Tensor, "aspect 3"],
        receivers: Float64[Tensor, "aspect 3"],
    ) -> Complex128[Tensor, "aspect 2 2"]:
        """S of currents, at the receiver of each wave.

        Args:
            current: η J of the transmitters' waves.
            transmitters, receivers: where these are.
        """
        phase = phasor(self.k * (self.point @ receivers.T)) * self.area[:, None]
        total = torch.einsum("ca,catx->atx", phase, current)
        field = -1j * self.k / (4 * math.pi) * self._origin_phase(receivers)[:, None, None] * total
        seen = polarisations(receivers, self.up).to(torch.complex128)
        return torch.einsum("arx,atx->art", seen, field)

    def conserves_power(self, current: Tensor, transmitters: Tensor) -> bool:
        """Whether the first wave's currents send out as much power as they take from the wave."""
        flowing = current[:, 0] * self.area[:, None, None]
        sent = polarisations(transmitters[:1], self.up)[0]
        return conserves_power(self.k, self.point + self.origin, flowing, -transmitters[0], sent)


def _solve_gmres(
    matrix: Complex64[Tensor, "n n"], right: Complex64[Tensor, "n column"]
) -> Complex64[Tensor, "n column"]:
    """Solutions of all columns at once by generalised minimal residuals (Saad and Schultz 1986)."""
    size = right.norm(dim=0)
    basis = [right / size]
    upper = torch.zeros(
        _MAX_ITERATIONS + 1, _MAX_ITERATIONS, right.shape[1], dtype=torch.complex128
    )
    share = upper[:0]
    for last in range(1, _MAX_ITERATIONS + 1):
        new = matrix @ basis[-1]
        for i, vector in enumerate(basis):
            along = (vector.conj() * new).sum(0)
            upper[i, last - 1] = along
            new = new - along * vector
        upper[last, last - 1] = new.norm(dim=0)
        basis.append(new / new.norm(dim=0))
        system = upper[: last + 1, :last].permute(2, 0, 1)
        first = torch.zeros(len(system), last + 1, 1, dtype=torch.complex128)
        first[:, 0] = 1
        share = torch.linalg.lstsq(system, first).solution
        if float((system @ share - first).norm(dim=1).max()) < _MAX_RESIDUAL:
            break
    weights = share[..., 0].T.to(torch.complex64) * size
    return torch.stack([w * v for w, v in zip(weights, basis, strict=False)]).sum(0)


def _greens_gradient(k: float, square: Tensor, weight: Tensor) -> Tensor:
    """∇G = (r − r′) times this, G = exp(−jkR)/4πR, in single precision."""
    distance = square.clamp_min(1e-20).sqrt()
    turn = k * distance
    wave = torch.polar(-weight / distance**3, -turn)
    return wave * torch.complex(torch.ones_like(turn), turn)
