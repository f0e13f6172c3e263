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

from invertwin.channel.paths import Grid, Link
from invertwin.channel.rays.arrays import to_float, to_torch
from invertwin.channel.rays.backend import dr, mi


@dataclass(frozen=True)
class Contribution:
    """Received over transmitted power per sample, and where it falls."""

    frame: Any  # radar pose
    power: Any
    range: Any  # half of the optical length [m]
    u: Any  # direction cosines of arrival in the radar frame
    v: Any

    @property
    def attached(self) -> tuple[Any, Any, Any, Any]:
        """The four values that may carry derivatives."""
        return self.power, self.range, self.u, self.v


def _axis(position: Any, start: float, step: float, count: int) -> list[tuple[Any, ...]]:
    """Bin, whether it is on the axis, weight and weight's derivative of each tap of one axis."""
    if count == 1:
        return [(mi.Int32(0), mi.Bool(True), mi.Float(1.0), mi.Float(0.0))]
    t = (dr.detach(position) - start) * (1 / step)
    nearest = dr.round(t)
    d = t - nearest
    weights = 0.5 * dr.square(0.5 - d), 0.75 - dr.square(d), 0.5 * dr.square(0.5 + d)
    slopes = (d - 0.5) / step, -2 * d / step, (d + 0.5) / step
    places = [mi.Int32(nearest) + offset for offset in (-1, 0, 1)]
    inside = [(place >= 0) & (place < count) for place in places]
    return list(zip(places, inside, weights, slopes, strict=True))


@dataclass(frozen=True)
class Layout:
    """The bins of a map, and the range from which each frame counts.

    Attributes:
        grid: Bins of one frame.
        frames: Number of radar poses.
        origin: Of every frame [m]; None = 0.
    """

    grid: Grid
    frames: int
    origin: Tensor | None = None

    @staticmethod
    def of(grid: Grid, link: Link) -> "Layout":
        """That of the maps of an antenna.

        Args:
            grid: Bins of one frame.
            link: Antennas.
        """
        return Layout(grid, link.frame_count, link.range_origin)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Frames, and bins along range, u and v."""
        return self.frames, *self.grid.shape

    def shown(self, found: Contribution) -> Any:
        """Ranges of paths from the origin of their frame (detached).

        Args:
            found: The paths.
        """
        length = dr.detach(found.range)
        if self.origin is None:
            return length
        return length - dr.gather(mi.Float, to_float(self.origin), mi.UInt32(found.frame))


def _taps(
    layout: Layout, found: Contribution
) -> Iterator[tuple[Any, Any, Any, tuple[Any, Any, Any]]]:
    """The bins that paths fall on (detached).

    Yields a bin's index, whether it is on the grid, the weight with which paths fall on it, and
    the derivatives of the weight in range, u and v.
    """
    grid = layout.grid
    ranges = _axis(layout.shown(found), grid.range_start, grid.range_step, grid.range_count)
    across = _axis(found.u, grid.u_start, grid.u_step, grid.u_count)
    upwards = _axis(found.v, grid.v_start, grid.v_step, grid.v_count)
    for i, on_range, wr, sr in ranges:
        for j, on_u, wu, su in across:
            row = (mi.Int32(found.frame) * grid.range_count + i) * grid.u_count + j
            for k, on_v, wv, sv in upwards:
                index, inside = mi.UInt32(row * grid.v_count + k), on_range & on_u & on_v
                yield index, inside, wr * wu * wv, (sr * wu * wv, wr * su * wv, wr * wu * sv)


class Bins:
    """A map that paths are added to.

    Taps are added one by one: for small maps Dr.Jit then keeps a copy for every thread and lane,
    so that the many sums of one bin are rounded little. Additions of whole vectors are faster and
    have no copies: differences of maps were ten times as noisy with them.

    Args:
        layout: Its bins.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.values = dr.zeros(mi.Float, math.prod(layout.shape))

    def add(self, found: Contribution, active: Any) -> None:
        """Add paths.

        Args:
            found: The paths.
            active: Which paths exist.
        """
        for index, inside, weight, _ in _taps(self.layout, found):
            dr.scatter_add(self.values, found.power * weight, index, inside & active)

    def add_derivative(self, found: Contribution, dots: tuple, active: Any) -> None:
        """Add the derivative of paths' deposit, given those of power, range, u and v.

        Args:
            found: The paths.
            dots: Derivatives of power, range, u and v.
            active: Which paths exist.
        """
        power = dr.detach(found.power)
        dot_power, *moves = dots
        for index, inside, weight, slopes in _taps(self.layout, found):
            moved = sum(dot * slope for dot, slope in zip(moves, slopes, strict=True))
            dr.scatter_add(self.values, dot_power * weight + power * moved, index, inside & active)

    def map(self) -> Float32[Tensor, "frame range u v"]:
        """What all bins hold."""
        return to_torch(self.values).reshape(self.layout.shape)


def gather(
    seed: Any, layout: Layout, found: Contribution, active: Any
) -> tuple[Any, Any, Any, Any]:
    """The adjoint of the deposit: ∂loss/∂(power, range, u, v) of every path.

    Args:
        seed: ∂loss/∂map, flat.
        layout: The bins.
        found: The paths.
        active: Which paths exist.
    """
    bars = [mi.Float(0.0) for _ in range(4)]
    for index, inside, weight, slopes in _taps(layout, found):
        value = dr.gather(mi.Float, seed, index, inside & active)
        for number, factor in enumerate((weight, *slopes)):
            bars[number] += value * factor
    power = dr.detach(found.power)
    return bars[0], bars[1] * power, bars[2] * power, bars[3] * power
