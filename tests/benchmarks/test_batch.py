"""The benchmark of batches in small: it runs, and both ways see the same scenes."""

import json

import pytest
import torch
from rich.console import Console


def test_a_step_is_the_same_both_ways(batch):
    steps, at = batch.Steps(1, 30_000), batch.places(3, 0)
    alone, batched = (steps.step(at, 1, at_once=at_once) for at_once in (False, True))
    for one, many in zip(alone, batched, strict=True):
        assert one.shape == many.shape
        assert (one - many).norm() < 0.05 * one.norm()
    assert torch.equal(batch.places(1, 5)[0], batch.places(32, 5)[0])


@pytest.mark.slow
def test_every_metric_is_there(batch):
    metrics = batch.measure(count=3, sizes=(2_000,), steps=1, draws=3)
    for key in ("step_ratio", "map_ratio", "of_alone"):
        assert set(metrics[key]) == {"depth1_2000", "depth3_2000"}
        assert min(metrics[key].values()) > 0
    assert metrics["compile_seconds_ratio"]["depth3"] > 0
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(batch.table(metrics))
    assert "slope_noise_ratio.depth3" in console.export_text()
