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
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Complex64, Complex128, Float64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot, polarisations, turned
from invertwin.channel.field.cells import Cells, cells_of
from invertwin.channel.field.currents import Currents, keeps_power

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
_ROWS_AT_ONCE = 1 << 20


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
