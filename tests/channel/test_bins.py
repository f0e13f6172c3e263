"""Paths on a map: rows of taps hold what taps one by one do."""

import drjit as dr
import numpy as np
import pytest
import torch

from invertwin.channel.bins import Bins, Contribution
from invertwin.channel.bridge import tracer
from invertwin.channel.paths import Grid

FRAMES, PATHS = 2, 50_000
GRIDS = {
    "range": Grid(2.0, 0.1, 11),
    "direction": Grid(2.5, 1.0, 1, u_start=-0.5, u_step=0.1, u_count=9),
    "range_u": Grid(2.0, 0.1, 11, u_start=-0.5, u_step=0.1, u_count=9),
    "range_v": Grid(2.0, 0.1, 11, v_start=-0.4, v_step=0.2, v_count=5),
    "nothing": Grid(2.5, 1.0, 1),
    "all": Grid(2.0, 0.1, 11, -0.5, 0.1, 9, -0.4, 0.2, 5),
}


def paths() -> tuple[Contribution, tuple, object]:
    """Paths on the grids and beside them, their derivatives, and which of them exist."""
    mi = tracer()
    draw = np.random.default_rng(1).uniform

    def column(low: float, high: float) -> object:
        return mi.Float(draw(low, high, PATHS).astype(np.float32))

    frame = mi.UInt32((np.arange(PATHS) % FRAMES).astype(np.uint32))
    found = Contribution(frame, column(0, 1), column(1.7, 3.4), column(-0.8, 0.6), column(-1, 1))
    dots = tuple(column(-1, 1) for _ in range(4))
    exists = column(0, 1) < 0.9  # pyright: ignore[reportOperatorIssue]
    return found, dots, exists


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("derivative", [False, True], ids=["value", "derivative"])
def test_rows_hold_what_single_taps_do(name, derivative):
    found, dots, exists = paths()
    maps = []
    for expected in (PATHS, 1):  # of one path, no rows are made
        bins = Bins(GRIDS[name], FRAMES, expected)
        assert (bins.width > 1) == (expected > 1 and name not in ("nothing", "all"))
        if derivative:
            bins.add_derivative(found, dots, exists)
        else:
            bins.add(found, exists)
        dr.eval(bins.values)
        maps.append(bins.map())
    assert maps[0].shape == (FRAMES, *GRIDS[name].shape)
    assert maps[0].abs().sum() > 100
    assert torch.allclose(maps[0], maps[1], rtol=1e-4, atol=1e-4 * float(maps[1].abs().max()))
