"""Paths into the bins of a map, in Dr.Jit, and the adjoint of doing so, written out.

A path falls on the grid with quadratic B-spline weights, three taps an axis (derivations §5);
the radar's point spread is a convolution of the grid afterwards. The B-spline is C¹, so the map
has continuous derivatives in range and direction.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from invertwin.channel.bridge import to_torch, tracer
from invertwin.channel.paths import Grid


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
    import drjit as dr

    mi = tracer()
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
        import drjit as dr

        g = grid
        axes = (
            _axis(dr.detach(found.range), g.range_start, g.range_step, g.range_count),
            _axis(dr.detach(found.u), g.u_start, g.u_step, g.u_count),
            _axis(dr.detach(found.v), g.v_start, g.v_step, g.v_count),
        )
        return _Taps(tracer().Int32(found.frame), axes, g.shape)

    def __iter__(self) -> Iterator[tuple[Any, Any, tuple[int, ...]]]:
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

    def row(self, padded: tuple[int, ...]) -> tuple[Any, Any]:
        """Number of the row of the nearest bin, counted with a margin, and whether it exists."""
        row, ok = self.frame, tracer().Bool(True)
        for (first, _, _), count, room in zip(self.axes, self.counts, padded, strict=True):
            place = first + (2 if count > 1 else 0)
            row, ok = row * room + place, ok & (place >= 0) & (place < room)
        return row, ok

    def weights(self, power: Any) -> dict[tuple[int, ...], Any]:
        """What of the power falls on every tap."""
        (_, rw, _), (_, uw, _), (_, vw, _) = self.axes
        return {
            (i, j, k): power * rw[i] * uw[j] * vw[k]
            for i, j, k in product(*(range(len(w)) for w in (rw, uw, vw)))
        }

    def derivatives(self, power: Any, dots: tuple) -> dict[tuple[int, ...], Any]:
        """The derivative of that, given those of power, range, u and v."""
        (_, rw, rs), (_, uw, us), (_, vw, vs) = self.axes
        dot_a, dot_r, dot_u, dot_v = dots
        return {
            (i, j, k): dot_a * rw[i] * uw[j] * vw[k]
            + power * dot_r * rs[i] * uw[j] * vw[k]
            + power * dot_u * rw[i] * us[j] * vw[k]
            + power * dot_v * rw[i] * uw[j] * vs[k]
            for i, j, k in product(*(range(len(w)) for w in (rw, uw, vw)))
        }


class Bins:
    """A map that paths are added to.

    A map of one or two resolved axes that is small beside the number of paths is kept as rows: the
    taps of a path side by side in the row of its nearest bin, which takes one addition of a vector
    instead of three or nine of numbers. The rows become a map in the end.
    """

    def __init__(self, grid: Grid, frames: int, paths: int) -> None:
        import drjit as dr

        self.grid, self.frames = grid, frames
        self.padded = tuple(count + 2 if count > 1 else 1 for count in grid.shape)
        resolved = sum(count > 1 for count in grid.shape)
        width, rows = 4**resolved, frames * math.prod(self.padded)
        fits = rows * width <= min(paths, dr.expand_threshold())
        self.width = width if 1 <= resolved <= 2 and fits else 1
        size = rows * width if self.width > 1 else frames * math.prod(grid.shape)
        self.values = dr.zeros(tracer().Float, size)

    def add(self, found: Contribution, active: Any) -> None:
        """Add paths."""
        taps = _Taps.of(self.grid, found)
        self._add(taps, taps.weights(found.power), active)

    def add_derivative(self, found: Contribution, dots: tuple, active: Any) -> None:
        """Add the derivative of paths' deposit, given those of power, range, u and v."""
        import drjit as dr

        taps = _Taps.of(self.grid, found)
        self._add(taps, taps.derivatives(dr.detach(found.power), dots), active)

    def _add(self, taps: _Taps, weights: dict[tuple[int, ...], Any], active: Any) -> None:
        import drjit as dr

        mi = tracer()
        if self.width == 1:
            for index, ok, tap in taps:
                dr.scatter_add(self.values, weights[tap], mi.UInt32(index), ok & active)
            return
        side: list[Any] = [0.0] * self.width
        for tap, slot in self._slots():
            side[slot] = weights[tap]
        row, ok = taps.row(self.padded)
        vector = mi.Vector4f(*side) if self.width == 4 else mi.Matrix4f(*side)
        dr.scatter_add(self.values, vector, mi.UInt32(row), ok & active)

    def _slots(self) -> Iterator[tuple[tuple[int, ...], int]]:
        """Every tap of a path, and its place in a row: two bits for each resolved axis."""
        for tap in product(*(range(3 if count > 1 else 1) for count in self.grid.shape)):
            slot = 0
            for number, count in zip(tap, self.grid.shape, strict=True):
                slot = 4 * slot + number if count > 1 else slot
            yield tap, slot

    def map(self) -> Float32[Tensor, "frame range u v"]:
        """What all bins hold."""
        values, shape = to_torch(self.values), self.grid.shape
        if self.width == 1:
            return values.reshape(self.frames, *shape)
        rows = values.reshape(self.frames, *self.padded, self.width)
        total = torch.zeros(self.frames, *shape)
        for tap, slot in self._slots():
            # The nearest bin of what falls on a bin as its first tap is the bin after it.
            parts = (
                slice(2 - number, 2 - number + count) if count > 1 else slice(None)
                for number, count in zip(tap, shape, strict=True)
            )
            total += rows[(slice(None), *parts, slot)]
        return total


def gather(seed: Any, grid: Grid, found: Contribution, active: Any) -> tuple[Any, Any, Any, Any]:
    """The adjoint of the deposit: ∂loss/∂(power, range, u, v) of every path."""
    import drjit as dr

    mi = tracer()
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
