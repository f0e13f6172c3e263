"""Power of explicit paths into the bins of a map, as ``deposit_power`` has it of sampled ones."""

from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.autograd.function import once_differentiable

from invertwin.channel.paths import Grid, Link, Paths
from invertwin.channel.power import bins
from invertwin.channel.rays.arrays import to_float, to_index, to_torch
from invertwin.channel.rays.backend import backend, mi, tracing


def deposit_paths(paths: Paths, link: Link, grid: Grid) -> Float32[Tensor, "frame range u v"]:
    """The power of paths in every bin of a map, per frame; differentiable in both modes.

    A path falls where ``deposit_power`` lets it fall: at half its length, and in the direction in
    which the receiver sees its last point. Power may be below zero, such as that of interference.

    Args:
        paths: With ``power``.
        link: The antennas that they belong to.
        grid: Bins.

    Source: derivations §5.
    """
    u, v = paths.cosines(link).unbind(1)
    with tracing():
        return Splat.apply(bins.Layout.of(grid, link), paths.frame, paths.power, paths.range, u, v)


class Splat(torch.autograd.Function):
    """Points into the bins of a map, with the derivatives of ``bins`` in both modes."""

    @staticmethod
    def forward(ctx: Any, layout: bins.Layout, frame: Tensor, *columns: Tensor) -> Tensor:
        ctx.layout, ctx.backend = layout, backend()
        with tracing():
            places = [to_float(column) for column in columns]
            ctx.found = bins.Contribution(mi.Int32(to_index(frame)), *places)
            out = bins.Bins(layout)
            out.add(ctx.found, True)
            return out.map()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        with tracing(ctx.backend):
            bars = bins.gather(ctx.layout.spread(grad), ctx.layout, ctx.found, True)
            return None, None, *(to_torch(bar).double() for bar in bars)

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:  # type: ignore[override]
        with tracing(ctx.backend):
            dots = tuple(
                mi.Float(0.0) if tangent is None else to_float(tangent) for tangent in tangents[2:]
            )
            out = bins.Bins(ctx.layout)
            out.add_derivative(ctx.found, dots, True)
            return out.map()
