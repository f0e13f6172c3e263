"""The throughput benchmark in small: it runs and measures what it says."""

import json
import sys

import pytest
from rich.console import Console

SMALL = {"samples": 20_000, "boundary_samples": 2_000, "memory_samples": 20_000, "steps": 2}


@pytest.mark.slow
def test_every_metric_is_there_without_sionna(throughput, monkeypatch):
    for name in ("sionna", "sionna.rt"):
        monkeypatch.setitem(sys.modules, name, None)
    metrics = throughput.measure(**SMALL)
    assert metrics["useful_paths_ratio_sionna"] is None
    assert all(metrics[key] > 0 for key in throughput.REQUIRED if "sionna" not in key)
    assert metrics["triangles"] >= 20_000
    assert metrics["hidden_share_of_facing_triangles"] > 0.05
    assert metrics["compiled_kernels_per_step"] == 0
    json.dumps(metrics)
    console = Console(width=200, record=True)
    console.print(throughput.table(metrics))
    assert "invertwin[bench]" in console.export_text()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Sionna RT
def test_both_find_paths_on_the_target(throughput):
    pytest.importorskip("sionna.rt", reason="needs the extra `bench`")
    found = throughput.useful_paths(rays=100_000, steps=1)
    # A 0.5 m cube at 2 m fills 0.65 % of all directions, and half of the cap around it.
    assert found["hits_sionna"] == pytest.approx(650, abs=50)
    assert found["hits_ours"] == pytest.approx(53_600, rel=0.02)
    assert found["useful_paths_ratio_sionna"] > 0
