"""Deposit of paths into the bins of a map, in Dr.Jit, and its adjoint, written out.

A path is spread over the grid with quadratic B-spline weights, three bins an axis (derivations §5);
the radar's point spread is a convolution of the grid afterwards. The B-spline is C¹, so the map
has continuous derivatives in range and direction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from invertwin.channel.paths import Grid, Link, Paths
from invertwin.channel.rays.arrays import to_float, to_index, to_torch, view_as_torch
from invertwin.channel.rays.backend import Mask, backend, dr, mi, mit, tracing

# Most bytes of copies of a map, one per thread; larger maps use atomic additions.
_MAX_COPY_BYTES = 2**28
# Size up to which a map has further copies, and the most copies: rounding errors are smaller if
# each copy sums a part of the contributions. They fit a core's cache.
_MAX_COPIED_VALUES, _MAX_COPIES = 2**16, 1024

FourFloats = tuple[mit.Float, mit.Float, mit.Float, mit.Float]
"""Derivatives with respect to, or of, the power, range, u and v of paths."""


@dataclass(frozen=True)
class PathContribution:
    """Contribution of paths to the bins.

    Attributes:
        frame: radar poses.
        power: received over transmitted power per sample.
        range: half of the optical length [m].
        u, v: direction cosines of arrival in the radar frame.
    """

    frame: mit.UInt32
    power: mit.Float
    range: mit.Float
    u: mit.Float
    v: mit.Float


def _axis_taps(
    coordinate: mit.Float, start: float, step: float, count: int
) -> list[tuple[mit.Int32, mit.Bool, mit.Float, mit.Float]]:
    """Compute bin, mask of bins on the axis, weight, and derivative of the weight of each tap."""
    if count == 1:
        return [(mi.Int32(0), mi.Bool(True), mi.Float(1.0), mi.Float(0.0))]
    t = (dr.detach(coordinate) - start) * (1 / step)
    nearest = dr.round(t)
    d = t - nearest
    weights = 0.5 * dr.square(0.5 - d), 0.75 - dr.square(d), 0.5 * dr.square(0.5 + d)
    slopes = (d - 0.5) / step, -2 * d / step, (d + 0.5) / step
    bins = [mi.Int32(nearest) + offset for offset in (-1, 0, 1)]
    inside = [(index >= 0) & (index < count) for index in bins]
    return list(zip(bins, inside, weights, slopes, strict=True))


@dataclass(frozen=True)
class BinLayout:
    """Bins of a map, and the range origin of each frame.

    Attributes:
        grid: bins of one frame.
        frames: number of radar poses.
        origin: range origin of every frame [m]; None = 0.
    """

    grid: Grid
    frames: int
    origin: Tensor | None = None

    @staticmethod
    def from_link(grid: Grid, link: Link) -> BinLayout:
        """Create the layout of the maps of antennas.

        Args:
            grid: bins of one frame.
            link: antennas.
        """
        return BinLayout(grid, link.frame_count, link.range_origin)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Numbers of frames, and of bins along range, u and v."""
        return self.frames, *self.grid.shape

    @property
    def strip_axis(self) -> int:
        """Axis of strips: the last one of range, u and v with more than one bin."""
        return max((axis for axis, count in enumerate(self.grid.shape) if count > 1), default=2)

    @property
    def strip_shape(self) -> tuple[int, ...]:
        """Shape of an array of strips: the strip axis comes last, with one strip at each end."""
        rest = list(self.shape)
        count = rest.pop(self.strip_axis + 1)
        return *rest, count + 2, 4

    def sum_strips(self, strips: mit.Float) -> Float32[Tensor, "frame range u v"]:
        """Sum strips to the map.

        Args:
            strips: flat array, one or more of the shape ``strip_shape``.
        """
        parts = view_as_torch(strips).reshape(-1, *self.strip_shape)
        parts = parts[0] if len(parts) == 1 else parts.sum(0)
        total = parts[..., 2:, 0] + parts[..., 1:-1, 1] + parts[..., :-2, 2]
        return total.movedim(-1, self.strip_axis + 1)

    def expand_to_strips(self, bins: Float32[Tensor, "frame range u v"]) -> mit.Float:
        """Adjoint of ``sum_strips``: copy the values of its three bins to every strip.

        Args:
            bins: value of every bin.
        """
        rows = torch.nn.functional.pad(bins.movedim(self.strip_axis + 1, -1), (2, 3))
        return to_float(rows.unfold(-1, 4, 1))

    def relative_range(self, path: PathContribution) -> mit.Float:
        """Compute the ranges of paths from the origin of their frame [m] (detached).

        Args:
            path: contributions.
        """
        length = dr.detach(path.range)
        if self.origin is None:
            return length
        return length - dr.gather(mi.Float, to_float(self.origin), mi.UInt32(path.frame))


@dataclass(frozen=True)
class _Strip:
    """Strip of three adjacent bins along the strip axis, and the weights of paths (detached).

    Attributes:
        index: strip number.
        is_inside: mask of strips whose row is on the grid and whose centre is at most one bin off.
        transverse_weight: weight of the row.
        transverse_derivatives: derivatives of the row's weight in range, u and v; the entry of the
            strip axis is the weight itself.
        weights: weights of the three bins.
        weight_derivatives: their derivatives along the strip axis.
    """

    index: mit.UInt32
    is_inside: mit.Bool
    transverse_weight: mit.Float
    transverse_derivatives: list[mit.Float]
    weights: list[mit.Float]
    weight_derivatives: list[mit.Float]

    def tap_derivatives(self, axis: int, strip_axis: int) -> list[mit.Float]:
        """Compute the derivatives of the three weights along an axis.

        Args:
            axis: 0 range, 1 u, 2 v.
            strip_axis: axis of the strips.
        """
        weights = self.weight_derivatives if axis == strip_axis else self.weights
        return [self.transverse_derivatives[axis] * weight for weight in weights]


def _iterate_strips(layout: BinLayout, path: PathContribution) -> Iterator[_Strip]:
    """Iterate over the strips of paths: three for every other axis with more than one bin."""
    grid, fine = layout.grid, layout.strip_axis
    counts = list(grid.shape)
    axes = [
        _axis_taps(
            layout.relative_range(path), grid.range_start, grid.range_step, grid.range_count
        ),
        _axis_taps(path.u, grid.u_start, grid.u_step, grid.u_count),
        _axis_taps(path.v, grid.v_start, grid.v_step, grid.v_count),
    ]
    none, one = mi.Float(0.0), mi.Float(1.0)
    along = axes[fine]
    if len(along) == 1:
        along = [(mi.Int32(0), mi.Bool(True), weight, none) for weight in (none, one, none)]
    middle, length = along[1][0], counts[fine] + 2
    near = (middle >= -1) & (middle <= counts[fine])
    axes[fine], counts[fine] = [(mi.Int32(0), mi.Bool(True), one, one)], 1
    for taps in product(*axes):
        row, inside = mi.Int32(path.frame), near
        for (index, on_axis, _, _), count in zip(taps, counts, strict=True):
            row, inside = row * count + index, inside & on_axis
        yield _Strip(
            index=mi.UInt32(row * length + middle + 1),
            is_inside=inside,
            transverse_weight=_multiply([tap[2] for tap in taps]),
            transverse_derivatives=[
                _multiply([tap[3] if k == axis else tap[2] for k, tap in enumerate(taps)])
                for axis in range(3)
            ],
            weights=[tap[2] for tap in along],
            weight_derivatives=[tap[3] for tap in along],
        )


def _multiply(factors: list[mit.Float]) -> mit.Float:
    return math.prod(factors)  # type: ignore[return-value]


class BinAccumulator:
    """Map that paths are added to.

    The three adjacent bins of a strip are added as one vector, to strips that overlap; the strips
    are summed at the end. For small maps, Dr.Jit keeps a copy per thread, so that additions need
    not be atomic.

    Args:
        layout: bins of the map.
    """

    def __init__(self, layout: BinLayout) -> None:
        self.layout = layout
        self._strip_count = math.prod(layout.strip_shape[:-1])
        self._copies = min(_MAX_COPIES, max(1, _MAX_COPIED_VALUES // (4 * self._strip_count)))
        size = 4 * self._strip_count * self._copies
        self.values = dr.zeros(mi.Float, size)
        copied = backend() == "cpu" and 4 * size * dr.thread_count() <= _MAX_COPY_BYTES
        self._mode = dr.ReduceMode.Expand if copied else dr.ReduceMode.Auto

    def add(self, path: PathContribution, active: Mask) -> None:
        """Add paths.

        Args:
            path: contributions.
            active: mask of paths that exist.
        """
        for strip in _iterate_strips(self.layout, path):
            power = path.power * strip.transverse_weight
            self._scatter_strip([power * weight for weight in strip.weights], strip, active)

    def add_tangent(self, path: PathContribution, tangents: FourFloats, active: Mask) -> None:
        """Add the tangent of the deposit of paths.

        Args:
            path: contributions.
            tangents: tangents of power, range, u and v.
            active: mask of paths that exist.
        """
        power = dr.detach(path.power)
        power_tangent, *others = tangents
        fine = self.layout.strip_axis
        for strip in _iterate_strips(self.layout, path):
            values = [power_tangent * strip.transverse_weight * weight for weight in strip.weights]
            for axis, tangent in enumerate(others):
                slopes = strip.tap_derivatives(axis, fine)
                values = [v + power * tangent * s for v, s in zip(values, slopes, strict=True)]
            self._scatter_strip(values, strip, active)

    def _scatter_strip(self, values: list[mit.Float], strip: _Strip, active: Mask) -> None:
        amounts = mi.Vector4f(*values, 0.0)
        lane = dr.arange(mi.UInt32, dr.width(amounts, strip.index))
        index = strip.index + lane % self._copies * self._strip_count
        dr.scatter_add(self.values, amounts, index, strip.is_inside & active, mode=self._mode)

    def to_map(self) -> Float32[Tensor, "frame range u v"]:
        """Sum all strips to the map."""
        return self.layout.sum_strips(self.values)


def gather_adjoint(
    strip_gradient: mit.Float, layout: BinLayout, path: PathContribution, active: Mask
) -> FourFloats:
    """Adjoint of the deposit: gather ∂loss/∂(power, range, u, v) of every path.

    Args:
        strip_gradient: ∂loss/∂map, see ``BinLayout.expand_to_strips``.
        layout: bins of the map.
        path: contributions.
        active: mask of paths that exist.
    """
    adjoints = [mi.Float(0.0) for _ in range(4)]
    for strip in _iterate_strips(layout, path):
        values = dr.gather(mi.Vector4f, strip_gradient, strip.index, strip.is_inside & active)
        factors = [[strip.transverse_weight * weight for weight in strip.weights]]
        factors += [strip.tap_derivatives(axis, layout.strip_axis) for axis in range(3)]
        for number, three in enumerate(factors):
            adjoints[number] += sum(f * values[k] for k, f in enumerate(three))
    power = dr.detach(path.power)
    return adjoints[0], adjoints[1] * power, adjoints[2] * power, adjoints[3] * power


def deposit_paths(paths: Paths, link: Link, grid: Grid) -> Float32[Tensor, "frame range u v"]:
    """Deposit the power of paths into the bins of a map, per frame; differentiable in both modes.

    Paths are deposited as by ``deposit_power``: at half their length, and in the direction in which
    the receiver sees their last point. Power may be negative, such as that of interference.

    Args:
        paths: propagation paths with ``power``.
        link: antennas of the paths.
        grid: bins of one frame.

    Source: derivations §5.
    """
    if not len(paths):
        return torch.zeros(link.frame_count, *grid.shape)
    u, v = paths.direction_cosines(link).unbind(1)
    with tracing():
        layout = BinLayout.from_link(grid, link)
        return Splat.apply(layout, paths.frame, paths.power, paths.range, u, v)


class Splat(torch.autograd.Function):
    """Deposit of points into the bins of a map, with the derivatives of this file in both modes."""

    @staticmethod
    def forward(ctx: Any, layout: BinLayout, frame: Tensor, *columns: Tensor) -> Tensor:
        ctx.layout, ctx.backend = layout, backend()
        with tracing():
            values = [to_float(column) for column in columns]
            ctx.path = PathContribution(mi.Int32(to_index(frame)), *values)
            out = BinAccumulator(layout)
            out.add(ctx.path, True)
            return out.to_map()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        with tracing(ctx.backend):
            adjoints = gather_adjoint(ctx.layout.expand_to_strips(grad), ctx.layout, ctx.path, True)
            return None, None, *(to_torch(adjoint).double() for adjoint in adjoints)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:  # type: ignore[override]
        with tracing(ctx.backend):
            none = mi.Float(0.0)
            power, length, u, v = (none if t is None else to_float(t) for t in tangents[2:])
            out = BinAccumulator(ctx.layout)
            out.add_tangent(ctx.path, (power, length, u, v), True)
            return out.to_map()
