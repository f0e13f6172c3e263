"""Annealing keeps its best, and stops where a level is reached."""

import tomllib
from dataclasses import replace

import pytest
from rich.console import Console

from cli.test_placement import ROOM
from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.run_file import validate_run


@pytest.fixture
def own(panel_annealing, tmp_path):
    run = validate_run(tomllib.loads(ROOM), tmp_path / "run.toml")
    problem = build_problem(run, Console(quiet=True))
    return problem, panel_annealing.Annealing(problem)


def test_annealing_gets_better_and_keeps_its_ranges(own):
    _, annealing = own
    # Half of these few receivers, so that most moves change the level.
    annealing.aim = replace(annealing.aim, share=0.5)
    gains = []
    for seed in (1, 2, 3):
        first, one = annealing.anneal(1, seed, 1e9)
        module, count = annealing.anneal(20, seed, 1e9)
        assert (one, count) == (1, 20)
        gains.append(annealing.level(module) - annealing.level(first))
        assert abs(float(module[0].yaw.detach())) <= 25.0 / 57.29
    assert min(gains) >= 0.0
    assert max(gains) > 0.01


def test_a_fit_is_compared_at_an_equal_level(own, panel_annealing):
    problem, annealing = own
    fits = {
        "starts": [{"level_db": -1e9, "evaluations": 4}, {"level_db": 1e9, "evaluations": 4}],
        "worst_exhaustive_db": annealing.level(annealing.anneal(1, 1, 1e9)[0], scored=True),
    }
    found = panel_annealing.compare(problem, fits, 2, 2)
    assert [row["annealing_evaluations"] for row in found["starts"]] == [1, 8]
    assert found["annealing_reached"] == 1
    assert found["starts"][0]["evaluations_ratio"] == 4.0
