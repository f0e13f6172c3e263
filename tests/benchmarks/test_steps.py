"""The profile of a step in small: its parts are there, and they add up."""

import json

import pytest


@pytest.mark.slow
def test_the_parts_of_a_step_add_up(steps, tmp_path, monkeypatch):
    problem = steps.build_problem

    def small(run, console):
        table = run.reconstruct.model_copy(update={"samples": 20_000, "boundary_samples": 4_000})
        data = run.data.model_copy(update={"points_per_m2": 200.0})
        return problem(run.model_copy(update={"reconstruct": table, "data": data}), console)

    monkeypatch.setattr(steps, "build_problem", small)
    metrics = steps.measure(steps=4, skipped=2)
    assert metrics["steps"] == 2
    assert metrics["kernel_count"] >= 2
    for key in ("step", "kernels", "convolutions", "torch"):
        assert metrics[key] > 0
    assert metrics["kernels"] < metrics["step"]
    assert metrics["step_over_kernels"] == metrics["step"] / metrics["kernels"]
    parts = sum(metrics[key] for key in ("kernels", "convolutions", "torch", "rest"))
    assert parts >= metrics["step"]
    steps.write(metrics, steps.table(metrics).grid, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics


def test_what_shapes_the_map_is_told_from_other_operations(steps):
    """By the names that torch gives its operations."""

    def shaping(name):
        return any(word in name for word in steps.CONVOLUTIONS)

    assert all(map(shaping, ("aten::mm", "aten::bmm", "aten::_fft_r2c", "aten::einsum")))
    assert not any(map(shaping, ("aten::mul", "aten::copy_", "aten::avg_pool3d", "aten::log")))
