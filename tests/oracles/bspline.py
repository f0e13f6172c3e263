"""Slow reference of the deposit: explicit quadratic B-spline weights, one path at a time."""

import torch
from torch import Tensor

from invertwin.channel import Grid


def weights(position: Tensor, start: float, step: float, count: int) -> Tensor:
    """[path, bin] quadratic B-spline around each position; one bin takes everything."""
    if count == 1:
        return torch.ones(len(position), 1, dtype=torch.float64)
    bins = start + step * torch.arange(count, dtype=torch.float64)
    t = ((position[:, None] - bins[None]) / step).abs()
    inner, outer = 0.75 - t.square(), 0.5 * (1.5 - t).square()
    return torch.where(t < 0.5, inner, torch.where(t < 1.5, outer, 0.0))


def deposit(power: Tensor, ranges: Tensor, u: Tensor, v: Tensor, grid: Grid) -> Tensor:
    """Power [path] on the bins of the map [range, u, v]."""
    r = weights(ranges, grid.range_start, grid.range_step, grid.range_count)
    a = weights(u, grid.u_start, grid.u_step, grid.u_count)
    b = weights(v, grid.v_start, grid.v_step, grid.v_count)
    return torch.einsum("p,pr,pu,pv->ruv", power, r, a, b)
