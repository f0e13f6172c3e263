"""The benchmark of edge sampling in small: both ways estimate the same derivative."""

import json

import numpy as np
import pytest
from rich.console import Console


@pytest.mark.slow
def test_weighted_and_uniform_edges_agree_and_differ_in_variance(edges):
    metrics = edges.measure(samples=20_000, seeds=24)
    found = metrics["edge_sampling"]
    for body in edges.bodies():
        weighted, uniform = found[body]["weighted"], found[body]["uniform"]
        error = np.sqrt((weighted["variance"] + uniform["variance"]) / metrics["seeds"])
        assert np.linalg.norm(np.subtract(weighted["mean"], uniform["mean"])) < 4 * error
        assert weighted["variance"] > 0
    # Most edges of a ball hide next to nothing: that is what the weights know.
    assert found["ball"]["equal_samples_variance_ratio"] > 1.5
    assert found["variance_ratio"] <= found["ball"]["variance_ratio"]
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(edges.table(metrics))
    assert "uniform over weighted" in console.export_text()
