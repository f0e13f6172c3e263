"""Paths into the bins of a map, in Dr.Jit, and the adjoint of doing so, written out.

A path falls on the grid with quadratic B-spline weights, three taps an axis (derivations §5);
the radar's point spread is a convolution of the grid afterwards. The B-spline is C¹, so the map
has continuous derivatives in range and direction.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float32
from torch import Tensor

from invertwin.channel.paths import Grid
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import dr, mi


@dataclass(frozen=True)
class Contribution:
    """Received over transmitted power per sample, and where it falls."""

    frame: Any
    power: Any
    range: Any
    u: Any
    v: Any

    @property
    def attached(self) -> tuple[Any, Any, Any, Any]:
        """The four values that may carry derivatives."""
        return self.power, self.range, self.u, self.v


def _axis(position: Any, start: float, step: float, count: int) -> tuple[Any, list, list]:
    """First bin, weights and weights' derivatives of the quadratic B-spline along one axis."""
    if count == 1:
        return mi.Int32(0), [mi.Float(1.0)], [mi.Float(0.0)]
    t = (position - start) * (1 / step)
    nearest = dr.round(t)
    d = t - nearest
    weights = [0.5 * dr.square(0.5 - d), 0.75 - dr.square(d), 0.5 * dr.square(0.5 + d)]
    slopes = [(d - 0.5) / step, -2 * d / step, (d + 0.5) / step]
    return mi.Int32(nearest) - 1, weights, slopes


@dataclass(frozen=True)
class _Taps:
    """Where a path falls: first bins, weights and slopes of the three axes (all detached)."""

    frame: Any
    axes: tuple[tuple[Any, list, list], ...]
    counts: tuple[int, int, int]

    @staticmethod
    def of(grid: Grid, found: Contribution) -> "_Taps":
        g = grid
        axes = (
            _axis(dr.detach(found.range), g.range_start, g.range_step, g.range_count),
            _axis(dr.detach(found.u), g.u_start, g.u_step, g.u_count),
            _axis(dr.detach(found.v), g.v_start, g.v_step, g.v_count),
        )
        return _Taps(mi.Int32(found.frame), axes, g.shape)

    def __iter__(self) -> Iterator[tuple[Any, Any, tuple[int, int, int]]]:
        """Bin index, whether it is on the grid, and the tap along each axis."""
        (r0, rw, _), (u0, uw, _), (v0, vw, _) = self.axes
        nr, nu, nv = self.counts
        for i in range(len(rw)):
            ok_r = (r0 + i >= 0) & (r0 + i < nr)
            for j in range(len(uw)):
                ok_u = ok_r & (u0 + j >= 0) & (u0 + j < nu)
                line = ((self.frame * nr + (r0 + i)) * nu + (u0 + j)) * nv + v0
                for k in range(len(vw)):
                    yield line + k, ok_u & (v0 + k >= 0) & (v0 + k < nv), (i, j, k)


class Bins:
    """A map that paths are added to.

    Taps are added one by one: for small maps Dr.Jit then keeps a copy for every thread and lane,
    so that the many sums of one bin are rounded little. Additions of whole vectors are faster and
    have no copies: differences of maps were ten times as noisy with them.
    """

    def __init__(self, grid: Grid, frames: int) -> None:
        self.shape = (frames, *grid.shape)
        self.grid = grid
        self.values = dr.zeros(mi.Float, math.prod(self.shape))

    def add(self, found: Contribution, active: Any) -> None:
        """Add paths.

        Args:
            found: The paths.
            active: Which paths exist.
        """
        taps = _Taps.of(self.grid, found)
        (_, rw, _), (_, uw, _), (_, vw, _) = taps.axes
        for index, ok, (i, j, k) in taps:
            self._add(index, found.power * rw[i] * uw[j] * vw[k], ok & active)

    def add_derivative(self, found: Contribution, dots: tuple, active: Any) -> None:
        """Add the derivative of paths' deposit, given those of power, range, u and v.

        Args:
            found: The paths.
            dots: Derivatives of power, range, u and v.
            active: Which paths exist.
        """
        taps = _Taps.of(self.grid, found)
        (_, rw, rs), (_, uw, us), (_, vw, vs) = taps.axes
        power = dr.detach(found.power)
        dot_a, dot_r, dot_u, dot_v = dots
        for index, ok, (i, j, k) in taps:
            value = (
                dot_a * rw[i] * uw[j] * vw[k]
                + power * dot_r * rs[i] * uw[j] * vw[k]
                + power * dot_u * rw[i] * us[j] * vw[k]
                + power * dot_v * rw[i] * uw[j] * vs[k]
            )
            self._add(index, value, ok & active)

    def _add(self, index: Any, value: Any, active: Any) -> None:
        dr.scatter_add(self.values, value, mi.UInt32(index), active)

    def map(self) -> Float32[Tensor, "frame range u v"]:
        """What all bins hold."""
        return to_torch(self.values).reshape(self.shape)


def gather(seed: Any, grid: Grid, found: Contribution, active: Any) -> tuple[Any, Any, Any, Any]:
    """The adjoint of the deposit: ∂loss/∂(power, range, u, v) of every path.

    Args:
        seed: ∂loss/∂map, flat.
        grid: The bins.
        found: The paths.
        active: Which paths exist.
    """
    taps = _Taps.of(grid, found)
    (_, rw, rs), (_, uw, us), (_, vw, vs) = taps.axes
    bars = [mi.Float(0.0) for _ in range(4)]
    for index, ok, (i, j, k) in taps:
        g = dr.gather(mi.Float, seed, mi.UInt32(index), ok & active)
        bars[0] += g * (rw[i] * uw[j] * vw[k])
        bars[1] += g * (rs[i] * uw[j] * vw[k])
        bars[2] += g * (rw[i] * us[j] * vw[k])
        bars[3] += g * (rw[i] * uw[j] * vs[k])
    power = dr.detach(found.power)
    return bars[0], bars[1] * power, bars[2] * power, bars[3] * power
