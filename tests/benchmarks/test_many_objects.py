"""The benchmark of many objects in small: it runs, and many objects are the same scene as one."""

import json

import pytest
import torch
from rich.console import Console


def test_boxes_are_the_same_triangles_as_one_object(many_objects):
    many, one = many_objects.Boxes(20), many_objects.Boxes(20, joined=True)
    placed = torch.cat([mesh.vertices + place for mesh, place in many.items])
    ((mesh, place),) = one.items
    assert torch.equal(mesh.vertices + place, placed)
    assert len(mesh.faces) == 20 * len(many.items[0][0].faces)
    assert placed[:, 0].min() > 0.5


@pytest.mark.slow
def test_every_metric_is_there(many_objects):
    metrics = many_objects.measure(counts=(3, 10, 20), samples=4_000, steps=1)
    for key in ("second_call_ratio", "compile_seconds_ratio"):
        assert set(metrics[key]) == {"depth1", "depth3"}
        assert min(metrics[key].values()) > 0
    assert metrics["compile_seconds"]["depth3"] > metrics["compile_seconds"]["depth1"] > 0.05
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(many_objects.table(metrics))
    assert "compile_seconds_ratio.depth3" in console.export_text()
