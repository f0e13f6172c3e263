"""Many starts in small: they differ, and each ends where it ends alone."""

import json

import pytest


@pytest.mark.slow
def test_starts_end_where_they_end_alone(many_starts, tmp_path, monkeypatch):
    problem = many_starts.build_problem

    def small(run, console):
        table = run.reconstruct.model_copy(update={"samples": 20_000, "boundary_samples": 4_000})
        data = run.data.model_copy(update={"points_per_m2": 200.0})
        return problem(run.model_copy(update={"reconstruct": table, "data": data}), console)

    monkeypatch.setattr(many_starts, "build_problem", small)
    places = [start.scene["letter"].center for start in many_starts.make_problem(2).starts()]
    assert (places[1] - places[0]).norm() > 0.01
    metrics = many_starts.measure(starts=2, steps=2)
    assert metrics["starts"] == 2
    assert metrics["ratio"] > 1
    assert metrics["end_difference_m"] <= 1e-6
    many_starts.write(metrics, many_starts.table(metrics).grid, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
