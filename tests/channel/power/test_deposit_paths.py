"""The deposit of explicit paths: that of ``deposit_power``, and its derivatives."""

from dataclasses import replace

import torch

from invertwin.channel import Grid, Sampling, deposit_paths, deposit_power, trace_power
from scenes import GRID, float64, link, occluder, relative

PLACES = ((0.0, 0.0, 0.0), (-0.1, 0.2, 0.1))


def test_explicit_paths_fall_where_sampled_ones_do():
    """Bin by bin, with separate antennas and a turned radar."""
    antennas = link(PLACES, ((0.0, 0.1, 0.0), (-0.1, 0.3, 0.1)))
    drawn = Sampling(depth=2, samples=5_000, boundary=False)
    truth = deposit_power(occluder(), antennas, GRID, sampling=drawn, seed=3)
    paths = trace_power(occluder(), antennas, sampling=drawn, seed=3)
    assert relative(deposit_paths(paths, antennas, GRID), truth) < 1e-4


def test_derivatives_by_power_and_place_are_differences():
    """Of a few paths, by all that they carry."""
    antennas, grid = link(), Grid(0.4, 0.05, 40, u_start=-0.6, u_step=0.1, u_count=13)
    drawn = Sampling(depth=1, samples=64, boundary=False)
    paths = trace_power(occluder(), antennas, sampling=drawn, seed=1)
    weight = torch.linspace(0, 1, 40 * 13).sin().reshape(1, 40, 13, 1)

    def value(power: torch.Tensor, last: torch.Tensor) -> torch.Tensor:
        moved = replace(paths, power=power, last=last)
        found = deposit_paths(moved, antennas, grid).double()
        return (found * weight).sum() / paths.power.sum()

    power = paths.power.clone().requires_grad_()
    last = paths.last.clone().requires_grad_()
    slopes = torch.autograd.grad(value(power, last), (power, last))
    generator = torch.Generator().manual_seed(0)
    for k, slope in enumerate(slopes):
        way = torch.randn(slope.shape, dtype=torch.float64, generator=generator)
        way = way * (paths.power if k == 0 else float64(1.0))
        step = 1e-3
        ends = []
        for sign in (1, -1):
            at = [paths.power, paths.last]
            at[k] = at[k] + sign * step * way
            ends.append(float(value(*at)))
        truth = (ends[0] - ends[1]) / (2 * step)
        assert abs(float((slope * way).sum()) - truth) < 0.01 * abs(truth)
