"""The multi-bounce benchmark in small: it runs and compares like with like."""

import json
import sys

import pytest
import torch
from rich.console import Console

SMALL = {"samples": 20_000, "memory_samples": 20_000, "steps": 1}


def test_the_room_is_that_of_the_description(multibounce):
    vertices = multibounce.room().scene["room"].vertices
    assert vertices.amin(dim=0).tolist() == [-5.0, -5.0, 0.0]
    assert vertices.amax(dim=0).tolist() == [5.0, 5.0, 5.0]


@pytest.mark.slow
def test_every_metric_is_there_without_sionna(multibounce, monkeypatch):
    for name in ("sionna", "sionna.rt"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(multibounce, "sionna_version", lambda: None)
    monkeypatch.setattr(multibounce, "MANY", 5_000)
    metrics = multibounce.measure(**SMALL)
    for depth in ("depth2", "depth3"):
        assert metrics[depth]["forward_ratio_sionna"] is None
        assert metrics[depth]["step_ratio_sionna"] is None
        assert metrics[depth]["samples_per_second"] > 0
        assert 0.1 < metrics[depth]["peak_memory_gb"] < 5
    assert 0 < metrics["step"]["tree_share"] < 1
    assert 0 < metrics["step"]["assembly_share"] < metrics["step"]["tracing_share"] < 1
    assert 0 < metrics["step"]["short_share"] < 2
    assert metrics["step"]["new_kernels"] == 0
    json.dumps(metrics)
    console = Console(width=200, record=True)
    console.print(multibounce.table(metrics))
    assert "invertwin[bench]" in console.export_text()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Sionna RT
def test_both_trace_the_same_room(multibounce):
    pytest.importorskip("sionna.rt", reason="needs the extra `bench`")
    theirs = multibounce.Theirs()
    (walls,) = theirs.scene.objects.values()
    box = walls.mi_mesh.bbox()
    ours = multibounce.room().scene["room"].vertices
    assert ours.amin(dim=0).tolist() == pytest.approx([float(x) for x in box.min])
    assert ours.amax(dim=0).tolist() == pytest.approx([float(x) for x in box.max])
    assert len(multibounce.room().scene["room"].mesh.faces) == walls.mi_mesh.face_count()
    found = multibounce.compared(2, 20_000, 1, theirs, multibounce.bare_rays_per_second(20_000, 1))
    # Every vertex is diffuse with probability 1/4, and sees the receiver; or is, and does.
    assert found["paths_sionna"] == pytest.approx(2 * 20_000 / 4, rel=0.05)
    assert found["paths_sionna_diffuse"] == pytest.approx(2 * 20_000, rel=0.01)
    assert found["forward_ratio_sionna"] > 0
    assert found["step_ratio_sionna"] > 0
    assert found["step_ratio_sionna_tree"] > 0


def test_a_tree_is_asked_in_the_divided_room_alone(multibounce):
    plain, divided = (multibounce.room(count).scene["room"].mesh for count in (0, 2))
    assert (len(plain.faces), len(divided.faces)) == (12, 192)
    for mesh in (plain, divided):
        p0, p1, p2 = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        area = 0.5 * torch.linalg.cross(p1 - p0, p2 - p0).norm(dim=1).sum()
        assert float(area) == pytest.approx(2 * (100 + 50 + 50))
