"""Slow reference of the fused deposit: explicit torch paths on explicit B-spline weights."""

import torch
from torch import Tensor

from invertwin.channel import Grid, Link, Paths, Sampling, trace_power
from invertwin.scene import Scene
from oracles.bspline import deposit


def map_of(paths: Paths, link: Link, grid: Grid) -> Tensor:
    """[frame, range, u, v] of power paths, in float64."""
    frames = []
    for frame in range(link.frame_count):
        rows = paths.frame == frame
        offset = paths.last[rows] - link.rx[frame]
        seen = (offset / offset.norm(dim=1, keepdim=True)) @ link.rotations[frame]
        frames.append(deposit(paths.power[rows], paths.range[rows], seen[:, 1], seen[:, 2], grid))
    return torch.stack(frames)


def deposit_by_paths(
    scene: Scene, link: Link, grid: Grid, *, sampling: Sampling, seed: int
) -> Tensor:
    """The same map as ``deposit_power``, from the same samples."""
    return map_of(trace_power(scene, link, sampling=sampling, seed=seed), link, grid)
