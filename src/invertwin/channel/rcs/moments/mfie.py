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

from invertwin.channel.em.plane_waves import cross, dot, polarisations, turned
from invertwin.channel.rcs.moments.solver import Currents, keeps_power

_PIECES = 4.0  # of a side of a cell over the longest side of its pieces
_MANY = 40  # pieces of a cell with which centres are spread first
_LEAN = 0.7  # cells' sides that normals at right angles are apart
_NEIGHBOURS = 9
_TURNED = 0.6  # cosine of neighbours' normals, below which an edge lies between
_ASIDE = 1e-3  # of the size: nearer to the tangent plane, nothing faces a cell from within

Array = NDArray[np.float64]
_ROWS_AT_ONCE = 1 << 20
_SPREAD, _SETTLED = 20, 5  # rounds with some pieces, then with all
_CURVATURE_ROWS = 1 << 21
_BURIED, _SOME = 0.35, 0.02  # off half a solid angle, and share of the surface where it may be


MOST = 6000
"""Cells up to which currents are solved: twice as many unknowns."""
_INSIDE = 0.25  # wavelengths to the second surface,
_OF_BALL = 0.8  # but less of the ball that fits in,
_RESOLVED = 0.7  # and at least so many cells' sides
_SHARE = 1j  # of the second equation
_WIDTHS = ((0.25, 1.0), (0.05, 0.3))  # of how many cells the balls may be how many sides less
_WORTH = 75  # cells per wave, below which the matrix is factorised
_ROUNDS = 80
_RESIDUAL = 3e-5  # of the right-hand side


@dataclass(frozen=True)
class Cells:
    """Patches of closed surfaces, one row each.

    Attributes:
        point: a place on the surface in the middle [m].
        normal: unit vectors outwards.
        area: [m²].
        bend: how normals change along the surface, dn = B dx [1/m].
        ball: radius of the ball inside that touches the surface there and nothing else [m].
        closed: whether the surfaces enclose bodies that do not overlap.
    """

    point: Float64[np.ndarray, "cell 3"]
    normal: Float64[np.ndarray, "cell 3"]
    area: Float64[np.ndarray, " cell"]
    bend: Float64[np.ndarray, "cell 3 3"]
    ball: Float64[np.ndarray, " cell"]
    closed: bool

    @property
    def axes(self) -> Float64[np.ndarray, "cell 2 3"]:
        """Unit vectors in the surface: t₁, t₂ with t₁ × t₂ = n."""
        return _axes(self.normal)


def cells_of(corners: Float64[np.ndarray, "facet 3 3"], side: float) -> Cells:
    """Even cells of triangles.

    Args:
        corners: of the triangles, whose normals point outwards [m].
        side: of a cell [m].
    """
    place, normal, area = _pieces(corners, side / _PIECES)
    owner = _gathered(np.concatenate([place, _LEAN * side * normal], 1), area, side)
    count = int(owner.max()) + 1
    whole = np.bincount(owner, area, count).astype(np.float64)
    middle = _mean(owner, area, place, whole)
    towards = _mean(owner, area, normal, whole)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    # The middle of a bent patch lies beside the surface.
    near = _nearest(place, middle)
    off = np.einsum("cx,cx->c", place[near] - middle, normal[near])
    middle += (off / np.einsum("cx,cx->c", towards, normal[near]))[:, None] * towards
    ball, closed = _surroundings(middle, towards, whole)
    return Cells(middle, towards, whole, _bend(middle, towards), ball, closed)


def _pieces(corners: Array, longest: float) -> tuple[Array, Array, Array]:
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


def _gathered(feature: Array, area: Array, side: float) -> NDArray[np.int64]:
    """The number of each piece's cell: Lloyd's rounds from centres drawn by area, always alike."""
    count = max(1, round(float(area.sum()) / side**2))
    draw = np.random.default_rng(0)
    order = draw.permutation(len(area))
    share = np.cumsum(area[order]) / area.sum()
    # One centre from each equal share of the area.
    chosen = order[np.searchsorted(share, (np.arange(count) + 0.5) / count)]
    centre = feature[np.unique(chosen)]
    some = order[: _MANY * count]
    rounds = [some] * _SPREAD + [order] * _SETTLED
    for pieces in rounds:
        owner = _nearest(centre, feature[pieces])
        whole = np.bincount(owner, area[pieces], len(centre)).astype(np.float64)
        kept = whole > 0
        centre = _mean(owner, area[pieces], feature[pieces], whole)[kept]
    return np.unique(_nearest(centre, feature), return_inverse=True)[1]


def _nearest(place: Array, to: Array, count: int = 1) -> NDArray[np.int64]:
    """Numbers of the nearest places."""
    return np.asarray(KDTree(place).query(to, k=count)[1], dtype=np.int64)


def _mean(owner: NDArray[np.int64], area: Array, value: Array, whole: Array) -> Array:
    """Means over cells; of empty ones zero."""
    total = np.stack([np.bincount(owner, area * column, len(whole)) for column in value.T], 1)
    return np.asarray(total / np.where(whole > 0, whole, 1.0)[:, None], dtype=np.float64)


def _axes(normal: Array) -> Array:
    aside = np.eye(3)[np.abs(normal).argmin(1)]
    first = np.cross(normal, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.asarray(np.stack([first, np.cross(normal, first)], 1), dtype=np.float64)


def _bend(point: Array, normal: Array) -> Array:
    """How normals turn towards neighbours on the same face, by least squares."""
    near = _nearest(point, point, min(_NEIGHBOURS, len(point)))[:, 1:]
    axes = _axes(normal)
    same = np.einsum("ckx,cx->ck", normal[near], normal) > _TURNED
    away = np.einsum("cax,ckx->cka", axes, point[near] - point[:, None]) * same[..., None]
    turn = np.einsum("cax,ckx->cka", axes, normal[near] - normal[:, None]) * same[..., None]
    square = np.einsum("cka,ckb->cab", away, away)
    # Where neighbours are few or in line, the surface counts as flat.
    least = 1e-9 * np.einsum("caa->c", square) + 1e-30
    sums = np.einsum("cka,ckb->cab", away, turn)
    bent: Array = np.linalg.solve(square + least[:, None, None] * np.eye(2), sums).real
    even = (bent + bent.transpose(0, 2, 1)) / 2
    return np.asarray(axes.transpose(0, 2, 1) @ even @ axes, dtype=np.float64)


def _surroundings(point: Array, normal: Array, area: Array) -> tuple[Array, bool]:
    """Radii of touching balls, and whether the solid angle inside is half of all, as it should."""
    count = len(point)
    ball, angle = np.full(count, np.inf), np.zeros(count)
    least = _ASIDE * float(np.ptp(point, axis=0).max())
    for rows in np.array_split(np.arange(count), math.ceil(count**2 / _CURVATURE_ROWS)):
        away = point - point[rows, None]
        square = np.einsum("rcx,rcx->rc", away, away)
        below = -np.einsum("rcx,rx->rc", away, normal[rows])
        radius = np.where(below > least, square / (2 * np.maximum(below, least)), np.inf)
        ball[rows] = radius.min(1)
        seen = np.einsum("rcx,cx->rc", away, normal) * area
        # The cell itself is seen edge-on: zero over something.
        angle[rows] = (seen / np.maximum(square, least**2) ** 1.5).sum(1) / (4 * math.pi)
    wrong = np.abs(angle - 0.5) > _BURIED
    return ball, bool(area[wrong].sum() < _SOME * area.sum())


class SolvedBodies(Currents[Cells]):
    """Closed conductors whose currents are solved on cells, see ``Currents``.

    Args:
        corners: of the triangles of closed bodies, normals outwards [m].
        up: V lies in a plane with this unit vector.
    """

    LEAST = 250

    def __init__(self, corners: Float64[Tensor, "facet 3 3"], up: Float64[Tensor, "3"]) -> None:
        self.corners, self.up = corners.numpy(), up
        sides = self.corners[:, 1:] - self.corners[:, :1]
        normals = np.cross(sides[:, 0], sides[:, 1])
        super().__init__(float(np.linalg.norm(normals, axis=1).sum() / 2))

    def cut(self, side: float) -> Cells | None:
        """Cells that a thin body's width holds, if they are not too many."""
        if self.area / side**2 > MOST:
            return None
        cells = cells_of(self.corners, side)
        width = min(float(np.quantile(cells.ball, share)) / least for share, least in _WIDTHS)
        if width < side:
            if self.area / width**2 > MOST:
                return None
            cells = cells_of(self.corners, width)
        return cells if cells.closed else None

    def equation(self, pieces: Cells, wave_number: float, waves: int) -> "_Equation":
        """See ``Currents.equation``."""
        return _Equation(pieces, wave_number, self.up, waves)


class _Equation:
    """The integral equation of cells at one frequency: [t₁ of all cells, t₂ of all cells]."""

    def __init__(
        self, cells: Cells, wave_number: float, up: Float64[Tensor, "3"], waves: int
    ) -> None:
        self.k, self.up = wave_number, up
        self.direct = waves * _WORTH > len(cells.point)
        self.origin = torch.from_numpy(cells.point.mean(0))
        self.point = torch.from_numpy(cells.point) - self.origin
        self.normal, self.axes = torch.from_numpy(cells.normal), torch.from_numpy(cells.axes)
        self.area, self.bend = torch.from_numpy(cells.area), torch.from_numpy(cells.bend)
        ball = torch.from_numpy(cells.ball)
        self.gap = (_OF_BALL * ball).clamp_max(_INSIDE * 2 * math.pi / wave_number)
        self.share = _SHARE * (self.gap >= _RESOLVED * self.area.sqrt())

    @cached_property
    def matrix(self) -> Complex64[Tensor, "unknown unknown"]:
        """``J/2 − n × ∫ ∇G × J`` on the surface and inside."""
        count = len(self.point)
        matrix = torch.zeros(2, count, 2, count, dtype=torch.complex64)
        point, normal, axes = (x.float() for x in (self.point, self.normal, self.axes))
        weight = self.area.float() / (4 * math.pi)
        for rows in torch.arange(count).split(max(1, _ROWS_AT_ONCE // count)):
            away = point[rows, None] - point
            height = dot(away, normal[rows, None])
            square = dot(away, away)
            strength = _gradient(self.k, square, weight)
            strength[torch.arange(len(rows)), rows] = 0
            inner = square - 2 * self.gap[rows, None].float() * height
            inner = (inner + self.gap[rows, None].float() ** 2).clamp_min(1e-20)
            second = self.share[rows, None].to(torch.complex64) * _gradient(self.k, inner, weight)
            both = strength + second
            lower = strength * height + second * (height - self.gap[rows, None].float())
            for a in (0, 1):
                along = both * dot(away, axes[rows, None, a])
                for b in (0, 1):
                    lean = normal[rows] @ axes[:, b].T
                    matrix[a, rows, b] = lower * (axes[rows, a] @ axes[:, b].T) - along * lean
        # The cell itself, as a disc that is bent as the surface is; half of J is the jump.
        own = self.axes @ self.bend @ self.axes.mT
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

    def currents(
        self, towards: Float64[Tensor, "aspect 3"]
    ) -> Complex128[Tensor, "cell aspect 2 3"]:
        """η J of plane waves of 1 V/m.

        Args:
            towards: the antennas.
        """
        direction = -towards
        columns = self._incident(direction, polarisations(towards, self.up))
        wave = -self.k * self.point @ direction.T
        inner = self.k * self.gap[:, None] * (self.normal @ direction.T)
        phase = turned(wave) * (1 + self.share[:, None] * turned(inner))
        columns = columns * phase[None, :, :, None] * self._phase(towards)[:, None]
        shape = columns.shape
        right = columns.reshape(shape[0] * shape[1], -1).to(torch.complex64)
        if self.direct:
            solution = torch.linalg.lu_solve(*self.factors, right)
        else:
            solution = _least_residual(self.matrix, right)
        found = solution.view(shape).to(torch.complex128)
        return torch.einsum("icat,icx->catx", found, self.axes.mT.permute(2, 0, 1) + 0j)

    def _incident(self, direction: Tensor, field: Tensor) -> Tensor:
        """n × H along both axes of every cell, without phases: [axis, cell, aspect, field]."""
        magnetic = cross(direction[:, None], field)
        along = cross(self.axes, self.normal[:, None])
        return torch.einsum("cix,atx->icat", along, magnetic)

    def _phase(self, towards: Tensor) -> Tensor:
        """Of the cells' middle against the world's origin."""
        return turned(self.k * (towards @ self.origin))

    def received(
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
        phase = turned(self.k * (self.point @ receivers.T)) * self.area[:, None]
        total = torch.einsum("ca,catx->atx", phase, current)
        field = -1j * self.k / (4 * math.pi) * self._phase(receivers)[:, None, None] * total
        seen = polarisations(receivers, self.up).to(torch.complex128)
        return torch.einsum("arx,atx->art", seen, field)

    def keeps_power(self, current: Tensor, towards: Tensor) -> bool:
        """Whether the first wave's currents send out as much power as they take from the wave."""
        flowing = current[:, 0] * self.area[:, None, None]
        sent = polarisations(towards[:1], self.up)[0]
        return keeps_power(self.k, self.point + self.origin, flowing, -towards[0], sent)


def _least_residual(
    matrix: Complex64[Tensor, "n n"], right: Complex64[Tensor, "n column"]
) -> Complex64[Tensor, "n column"]:
    """Solutions of all columns at once by generalised minimal residuals (Saad and Schultz 1986)."""
    size = right.norm(dim=0)
    basis = [right / size]
    upper = torch.zeros(_ROUNDS + 1, _ROUNDS, right.shape[1], dtype=torch.complex128)
    share = upper[:0]
    for last in range(1, _ROUNDS + 1):
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
        if float((system @ share - first).norm(dim=1).max()) < _RESIDUAL:
            break
    weights = share[..., 0].T.to(torch.complex64) * size
    return torch.stack([w * v for w, v in zip(weights, basis, strict=False)]).sum(0)


def _gradient(k: float, square: Tensor, weight: Tensor) -> Tensor:
    """∇G = (r − r′) times this, G = exp(−jkR)/4πR, in single precision."""
    distance = square.clamp_min(1e-20).sqrt()
    turn = k * distance
    wave = torch.polar(-weight / distance**3, -turn)
    return wave * torch.complex(torch.ones_like(turn), turn)
