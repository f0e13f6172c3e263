"""The basin benchmark in small: the surrogate finds a wall that the exact signal does not."""

import json

import pytest


@pytest.mark.parametrize(
    ("counts", "cells"),
    [
        ({1.0: 20, 2.0: 19, 4.0: 18, 6.0: 20}, 2.0),
        ({1.0: 20, 2.0: 20}, 2.0),
        ({1.0: 18, 2.0: 20}, 0.0),
    ],
)
def test_the_basin_ends_before_the_first_failure(basin, counts, cells):
    assert basin.basin(counts, 20) == cells


@pytest.mark.slow
def test_the_surrogate_has_the_wider_basin(basin, tmp_path):
    offsets = {"exact_beat": (2.0,), "surrogate": (10.0,)}
    metrics = basin.measure(tmp_path, offsets, seeds=2)
    assert metrics["basin_cells"] == {"exact_beat": 0.0, "surrogate": 10.0}
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert (tmp_path / "basin.png").stat().st_size > 0
