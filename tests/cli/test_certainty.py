"""Verdicts and error bars in run folders, and how often they hold over recordings."""

import math
import re

import pytest

from cli.small import RUN, STARTS, call, read_metrics


def test_a_run_states_verdict_and_error_bars(run_file, monkeypatch, capsys):
    assert call(monkeypatch, "reconstruct", run_file, "-o", "out") == 0
    metrics = read_metrics(run_file.parent / "out")
    names = ["plate.x", "plate.y", "plate.z"]
    assert list(metrics["standard_deviations"]) == names
    for name in names:
        ratio = metrics["within_95"][name] / metrics["standard_deviations"][name]
        assert ratio == pytest.approx(1.998, abs=0.001)
    # A range cell is 75 mm; two looks at a plate before a wall tell its range to a fraction of it.
    assert 1e-4 < metrics["standard_deviations"]["plate.x"] < 0.03
    assert metrics["verdict"] in ("consistent", "inconsistent")
    assert (metrics["loss_excess"] > 3.5) == (metrics["verdict"] == "inconsistent")
    said = " ".join(capsys.readouterr().out.split())
    place = re.search(r"plate at \((.*?)\)( ± ([0-9.]+))? m\.", metrics["answer"] + ".")
    assert place is not None
    assert metrics["answer"] in said
    offset = metrics["parameters"]["plate.translation"]
    start = [1.2, 0.0, 0.0]  # position in the run file
    expected = [begun + moved for begun, moved in zip(start, offset, strict=True)]
    assert [float(x) for x in place[1].split(",")] == pytest.approx(expected, abs=6e-4)
    assert (place[2] is None) == (metrics["verdict"] == "inconsistent")
    if place[2] is not None:
        bars = metrics["standard_deviations"].values()
        assert float(place[3]) == pytest.approx(math.hypot(*bars), rel=0.06)
    assert "standard deviation" in said
    assert "95 % of errors within" in said
    assert "recordings of the twin" in said.lower()
    assert "standard deviation" in (run_file.parent / "out" / "report.html").read_text()


@pytest.mark.claim
@pytest.mark.slow
def test_a_search_about_a_bad_start_finds_the_right_place(run_file, monkeypatch, capsys):
    search = """
[search]
object = "plate"
kind = "given"
positions = [[1.18, 0.02, 0.01], [1.4, 0.4, 0.0]]

[loss]
kind = "likelihood"
"""
    begun = RUN.replace("position = [1.2, 0.0, 0.0]", "position = [1.45, -0.5, 0.0]")
    run_file.write_text(begun + search)
    assert call(monkeypatch, "reconstruct", run_file, "-o", "out") == 0
    metrics = read_metrics(run_file.parent / "out")
    assert metrics["position_error_m"] < 0.1
    assert metrics["ambiguities"] == []
    assert {"pose", "loss", "score"} == set(metrics["other_ends"][0])
    assert metrics["other_ends"][0]["loss"] > metrics["loss"]
    assert (run_file.parent / "out" / "checkpoint.pt").exists()
    assert (run_file.parent / "out" / "residuals.png").exists()


@pytest.mark.slow
def test_every_start_with_a_recording_of_its_own(run_file, monkeypatch):
    run_file.write_text(RUN.replace("snr_db = 20.0", "snr_db = 20.0\nevery_start = true") + STARTS)
    assert call(monkeypatch, "reconstruct", run_file, "-o", "out") == 0
    metrics = read_metrics(run_file.parent / "out")
    first, second = metrics["starts"]
    # Other speckle, other losses, other errors.
    assert first["loss"] != pytest.approx(second["loss"], rel=1e-3)
    inside = [
        abs(row["errors"]["plate.x"]) <= row["within_95"]["plate.x"] for row in (first, second)
    ]
    assert metrics["coverage_95"]["x"] == sum(inside) / 2
    assert set(metrics["coverage_95"]) == {"x", "y", "z"}
    assert metrics["stated_over_observed"]["x"] > 0
    assert metrics["errors"]["plate.x"] in (first["errors"]["plate.x"], second["errors"]["plate.x"])
