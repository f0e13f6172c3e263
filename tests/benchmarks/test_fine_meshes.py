"""The benchmark of fine meshes in small: shadows of folded meshes are counted once."""

import json

import numpy as np
import pytest
from rich.console import Console

from invertwin.scene import box


def test_the_outline_of_a_square(fine_meshes):
    square = box((2.0, 2.0, 2.0))
    count = 16
    found = fine_meshes.furthest(square.vertices.numpy()[:, :2], square.faces.numpy(), count)
    angle = 2 * np.pi * np.arange(count) / count
    assert found == pytest.approx(1 / np.maximum(abs(np.cos(angle)), abs(np.sin(angle))))


@pytest.mark.slow
def test_folds_far_away_are_counted_once(fine_meshes):
    metrics = fine_meshes.measure((4,), (1.5, 500.0), samples=50_000, seeds=3)
    for key in ("5120_1.5", "5120_500"):
        assert metrics["error"][key] < 2e-3
        assert metrics["boundary_ratio"][key] == pytest.approx(1.0, abs=0.01)
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(fine_meshes.table(metrics))
    assert "1 ± 0.01 yes" in console.export_text()
