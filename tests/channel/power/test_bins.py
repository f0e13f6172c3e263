"""Paths on a map, against NumPy in float64."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
import torch

from invertwin.channel import Grid
from invertwin.channel.power.bins import BinAccumulator, BinLayout, PathContribution
from invertwin.channel.rays.backend import mi

FRAMES, PATHS = 2, 50_000
GRIDS = {
    "range": Grid(2.0, 0.1, 11),
    "direction": Grid(2.5, 1.0, 1, u_start=-0.5, u_step=0.1, u_count=9),
    "range_u": Grid(2.0, 0.1, 11, u_start=-0.5, u_step=0.1, u_count=9),
    "range_v": Grid(2.0, 0.1, 11, v_start=-0.4, v_step=0.2, v_count=5),
    "nothing": Grid(2.5, 1.0, 1),
    "all": Grid(2.0, 0.1, 11, -0.5, 0.1, 9, -0.4, 0.2, 5),
}


def paths() -> tuple[PathContribution, tuple, object]:
    """Paths on the grids and beside them, their derivatives, and which of them exist."""
    draw = np.random.default_rng(1).uniform

    def column(low: float, high: float) -> object:
        return mi.Float(draw(low, high, PATHS).astype(np.float32))

    frame = mi.UInt32((np.arange(PATHS) % FRAMES).astype(np.uint32))
    found = PathContribution(
        frame, column(0, 1), column(1.7, 3.4), column(-0.8, 0.6), column(-1, 1)
    )
    dots = tuple(column(-1, 1) for _ in range(4))
    exists = column(0, 1) < 0.9  # pyright: ignore[reportOperatorIssue]
    return found, dots, exists


def spline(found, dots, exists, grid: Grid, derivative: bool) -> np.ndarray:
    """The map in NumPy, in float64: quadratic B-splines along the resolved axes."""
    values = {k: getattr(found, k).numpy().astype(np.float64) for k in ("power", "range", "u", "v")}
    rates = [dot.numpy().astype(np.float64) for dot in dots]
    starts = (grid.range_start, grid.u_start, grid.v_start)
    steps = (grid.range_step, grid.u_step, grid.v_step)
    here = exists.numpy()
    total = np.zeros((FRAMES, *grid.shape))
    factors, slopes, places = [], [], []
    for name, start, step, count in zip(
        ["range", "u", "v"], starts, steps, grid.shape, strict=True
    ):
        if count == 1:
            factors.append([np.ones(PATHS)])
            slopes.append([np.zeros(PATHS)])
            places.append(np.zeros(PATHS, dtype=int))
            continue
        t = (values[name] - start) / step
        near = np.round(t)
        d = t - near
        factors.append([0.5 * (0.5 - d) ** 2, 0.75 - d**2, 0.5 * (0.5 + d) ** 2])
        slopes.append([(d - 0.5) / step, -2 * d / step, (d + 0.5) / step])
        places.append(near.astype(int) - 1)
    frame = found.frame.numpy()
    for i, j, k in np.ndindex(*(len(f) for f in factors)):
        f, g = (
            (factors[0][i], factors[1][j], factors[2][k]),
            (slopes[0][i], slopes[1][j], slopes[2][k]),
        )
        weight = values["power"] * f[0] * f[1] * f[2]
        if derivative:
            weight = rates[0] * f[0] * f[1] * f[2] + values["power"] * (
                rates[1] * g[0] * f[1] * f[2]
                + rates[2] * f[0] * g[1] * f[2]
                + rates[3] * f[0] * f[1] * g[2]
            )
        index = [places[0] + i, places[1] + j, places[2] + k]
        on = here & np.all([(x >= 0) & (x < n) for x, n in zip(index, grid.shape, strict=True)], 0)
        np.add.at(total, (frame[on], *(x[on] for x in index)), weight[on])
    return total


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("derivative", [False, True], ids=["value", "derivative"])
def test_bins_hold_what_falls_on_them(name, derivative):
    found, dots, exists = paths()
    bins = BinAccumulator(BinLayout(GRIDS[name], FRAMES))
    if derivative:
        bins.add_tangent(found, dots, exists)
    else:
        bins.add(found, exists)
    dr.eval(bins.values)
    expected = torch.from_numpy(spline(found, dots, exists, GRIDS[name], derivative)).float()
    assert bins.to_map().shape == expected.shape
    assert expected.abs().sum() > 100
    scale = float(expected.abs().max())
    # A path that falls halfway between two bins may be rounded to either, with equal weights.
    assert torch.allclose(bins.to_map(), expected, rtol=1e-4, atol=1e-4 * scale)


@pytest.mark.parametrize("derivative", [False, True], ids=["value", "derivative"])
def test_ranges_count_from_the_origin_of_their_frame(derivative):
    found, dots, exists = paths()
    origin, frame = torch.tensor([1.5, 2.25]).double(), found.frame.numpy()
    layout = BinLayout(replace(GRIDS["all"], range_start=0.0), FRAMES, origin)
    bins = BinAccumulator(layout)
    if derivative:
        bins.add_tangent(found, dots, exists)
    else:
        bins.add(found, exists)
    shown = mi.Float((found.range.numpy() - origin.numpy()[frame]).astype(np.float32))
    moved = replace(found, range=shown)
    expected = torch.from_numpy(spline(moved, dots, exists, layout.grid, derivative)).float()
    assert expected[0].abs().sum() > 100
    scale = float(expected.abs().max())
    assert torch.allclose(bins.to_map(), expected, rtol=1e-4, atol=1e-4 * scale)


def test_sums_of_many_paths_are_rounded_little():
    """Differences of maps live in the last digits of such sums."""
    power = np.random.default_rng(2).uniform(0, 1, 4_000_000).astype(np.float32)
    frame = mi.UInt32(np.zeros(len(power), dtype=np.uint32))
    still = mi.Float(2.3)
    grid = Grid(2.0, 0.1, 7)
    bins = BinAccumulator(BinLayout(grid, 1))
    bins.add(
        PathContribution(frame, mi.Float(power), still, mi.Float(0.0), mi.Float(0.0)), mi.Bool(True)
    )
    dr.eval(bins.values)
    exact = power.astype(np.float64).sum()
    assert (
        abs(float(bins.to_map().double().sum()) / exact - 1) < 5e-5
    )  # one sum of float32 is off by percents


def test_many_amounts_in_few_bins_are_rounded_little():
    """A million equal amounts in one bin: one sum in single precision would be 0.01 off."""
    count = 1_000_000
    ones, zeros = dr.full(mi.Float, 0.1, count), dr.zeros(mi.Float, count)
    out = BinAccumulator(BinLayout(GRIDS["nothing"], 1))
    out.add(PathContribution(dr.zeros(mi.UInt32, count), ones, ones, zeros, zeros), mi.Bool(True))
    total = float(out.to_map().double().sum())
    assert total == pytest.approx(count * float(np.float32(0.1)), rel=2e-5)
