"""The basin benchmark in small: the annealed surrogate finds a panel that the others do not."""

import json

import pytest
import torch

GOOD, BAD = (0.01, 0.02), (3.0, 0.1)


def rows(good: int, bad: int = 0):
    return [GOOD] * good + [BAD] * bad


@pytest.mark.parametrize(
    ("found", "cells"),
    [
        ({1.0: rows(20), 2.0: rows(19, 1), 4.0: rows(18, 2), 6.0: rows(20)}, 2.0),
        ({1.0: rows(20), 2.0: rows(20)}, 2.0),
        ({1.0: rows(3, 2), 2.0: rows(20)}, 0.0),
    ],
)
def test_the_basin_ends_before_the_first_failure(basin, found, cells):
    assert basin.basin(found, 20) == cells


def test_a_failure_in_either_coordinate_is_one(basin):
    assert basin.failures([(0.1, 0.1), (0.1, 0.6), (0.6, 0.1)]) == 2


def test_nineteen_of_twenty_stay_within_the_bound(basin):
    found = [(0.01 * i, 0.5 - 0.01 * i) for i in range(20)]
    assert basin.bound(found, 0, 20) == pytest.approx(0.18)
    assert basin.bound(found, 1, 20) == pytest.approx(0.49)
    assert basin.bound(found[:2], 0, 2) == pytest.approx(0.01)


def test_what_must_hold_is_said(basin):
    metrics = {
        "basin_cells": {"surrogate": 24.0},
        "basin_beamwidths": {"surrogate": 1.5},
        "final_error_cells": 0.06,
    }
    lines = basin.verdicts(metrics)
    assert [line.endswith(" yes") for line in lines] == [True, False, False]
    assert basin.verdicts(metrics | {"final_error_cells": None})[2].endswith(" NO")


def test_offsets_move_along_one_coordinate(basin):
    """Range cells along the line of sight; beamwidths on the arc, still facing the radar."""
    task = basin.Task.draw(1)
    cell, beam = basin.WAVEFORM.range_resolution, task.radar.beamwidth[0]
    with torch.no_grad():
        far = basin.Place(18.0, 0.0, beam)(task.scene)["panel"]
        aside = basin.Place(0.0, 3.0, beam)(task.scene)["panel"]
    assert float(far.center[0]) == pytest.approx(basin.DISTANCE + 18 * cell)
    assert float(aside.center.norm()) == pytest.approx(basin.DISTANCE)
    assert float(aside.center[1]) == pytest.approx(basin.DISTANCE * 3 * beam)
    along = (aside.vertices - aside.center) @ aside.center
    assert float(along.abs().max()) < 1e-9


def test_the_last_stage_has_no_extra_width(basin):
    wide, last = basin.STAGES["surrogate"]
    assert wide.kernel.range_width > 0
    assert wide.kernel.angle_width > 0
    assert last.kernel == "response"
    assert all(stage.steps > 0 for stages in basin.STAGES.values() for stage in stages)
    assert basin.STAGES.keys() == basin.OFFSETS.keys()


@pytest.mark.slow
def test_the_annealed_surrogate_has_the_wider_basin(basin, tmp_path):
    offsets = {
        "exact": {"cells": (6.0,)},
        "gaussian": {"cells": (12.0,)},
        "dirichlet": {"cells": (12.0,)},
        "surrogate": {"cells": (18.0,), "beamwidths": (3.0,)},
    }
    metrics = basin.measure(tmp_path, offsets, seeds=2)
    fixed = dict.fromkeys(("exact", "gaussian", "dirichlet"), 0.0)
    assert metrics["basin_cells"] == fixed | {"surrogate": 18.0}
    assert metrics["basin_beamwidths"] == {"surrogate": 3.0}
    assert metrics["final_error_cells"] < 0.1
    assert metrics["final_error_beamwidths"] < 0.2
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert (tmp_path / "basin.png").stat().st_size > 0
