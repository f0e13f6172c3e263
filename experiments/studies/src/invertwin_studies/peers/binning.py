"""Explicit paths onto the bins of a map, in torch: what the fused kernel does, for the peers."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel import Grid


def binned(
    frame: Int64[Tensor, " path"],
    power: Float64[Tensor, " path"],
    distance: Float64[Tensor, " path"],
    u: Float64[Tensor, " path"],
    v: Float64[Tensor, " path"],
    grid: Grid,
    frames: int = 1,
) -> Float64[Tensor, "frame range u v"]:
    """Sum the power of paths in the bins with quadratic B-spline weights, three taps an axis.

    The same bins and weights as ``deposit_power``; differentiable in power and place, in both
    modes. An axis that the grid does not resolve has one bin, with weight one.

    Args:
        frame: Radar pose of each path.
        power: What is summed.
        distance: Half the path length [m].
        u: Direction cosine.
        v: Direction cosine.
        grid: Bins.
        frames: Number of radar poses.

    Source: derivations §5.
    """
    axes = [
        _taps(distance, grid.range_start, grid.range_step, grid.range_count),
        _taps(u, grid.u_start, grid.u_step, grid.u_count),
        _taps(v, grid.v_start, grid.v_step, grid.v_count),
    ]
    counts = grid.shape
    size = frames * counts[0] * counts[1] * counts[2]
    # The last place takes what falls off the grid.
    total = torch.zeros(size + 1, dtype=torch.float64)
    for r, r_weight in axes[0]:
        for a, a_weight in axes[1]:
            for b, b_weight in axes[2]:
                index = ((frame * counts[0] + r) * counts[1] + a) * counts[2] + b
                inside = torch.ones_like(frame, dtype=torch.bool)
                for place, count in zip((r, a, b), counts, strict=True):
                    inside &= (place >= 0) & (place < count)
                index = torch.where(inside, index, size)
                total = total.index_add(0, index, power * r_weight * a_weight * b_weight)
    return total[:size].reshape(frames, *counts)


def _taps(place: Tensor, start: float, step: float, count: int) -> list[tuple[Tensor, Tensor]]:
    """Bin and weight of each tap along one axis."""
    if count == 1:
        return [(torch.zeros_like(place, dtype=torch.int64), torch.ones_like(place))]
    t = (place - start) / step
    nearest = t.detach().round()
    d = t - nearest
    base = nearest.long()
    return [
        (base - 1, 0.5 * (0.5 - d).square()),
        (base, 0.75 - d.square()),
        (base + 1, 0.5 * (0.5 + d).square()),
    ]
