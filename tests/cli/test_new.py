"""Run files to start from: they are valid as written, and never replace a file."""

import csv
import math
import os
import re
import subprocess
import sys

import pytest

from cli.small import call, read_metrics
from invertwin.cli.run_file import load_run

KINDS = {
    "fit": "reconstruct",
    "simulate": "simulate",
    "twin": "twin",
    "coverage": "simulate",
    "placement": "reconstruct",
    "dataset": "dataset",
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_run_file_is_valid_and_says_how_to_run_it(kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "new", kind) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"invertwin {KINDS[kind]} {kind}.toml" in said
    text = (tmp_path / f"{kind}.toml").read_text()
    assert f"# Run it: invertwin {KINDS[kind]} {kind}.toml" in text
    assert load_run(tmp_path / f"{kind}.toml").task == KINDS[kind]
    # A second one would replace what the user has written since.
    (tmp_path / f"{kind}.toml").write_text("mine")
    assert call(monkeypatch, "new", kind) == 2
    assert "expected a new file" in capsys.readouterr().err
    assert (tmp_path / f"{kind}.toml").read_text() == "mine"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
def test_the_objects_of_the_new_twin_are_found(seed, tmp_path, monkeypatch):
    """From a rail of eight positions, seed 3 made a person of the low box, 7 cm beside it.

    From 0.6 m above the ground, heights of 1.1 and 0.7 m were found as 0.6 to 1.25 m.
    """
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "new", "twin") == 0
    text = (tmp_path / "twin.toml").read_text()
    (tmp_path / "twin.toml").write_text(text.replace("seed = 1\n", f"seed = {seed}\n"))
    assert call(monkeypatch, "twin", "twin.toml", "-o", "out") == 0
    low, tall = sorted(read_metrics(tmp_path / "out")["things"], key=lambda one: one["position_m"])
    # As near as a right end of a fit must be; seeds 1 to 8 were within 1.7 cm.
    assert low["position_m"][:2] == pytest.approx([2.3, -0.6], abs=0.03)
    assert tall["position_m"][:2] == pytest.approx([2.8, 0.6], abs=0.03)
    # A prism has the outline of the box.
    assert {low["kind"], tall["kind"]} <= {"box", "prism"}
    assert low["height_m"] == pytest.approx(0.7, abs=0.1)
    assert tall["height_m"] == pytest.approx(1.1, abs=0.1)
    assert min(low["confidence"], tall["confidence"]) > 0.99


def test_a_coverage_map_without_a_radar_can_be_fitted(tmp_path, monkeypatch, capsys):
    """Free space: levels follow the inverse square of the distance, in dBm."""
    (tmp_path / "room.toml").write_text(
        """
task = "simulate"
frame = 2
[scene.plate]
shape = "plate"
width = 0.2
height = 0.2
position = [0.0, 50.0, -50.0]
material = { kind = "perfect_conductor" }
[transmitter]
positions = [[0.0, 0.0, 2.0]]
power_dbm = 20.0
[map]
places = { kind = "plane", low = [-4.0, -4.0], high = [4.0, 4.0], height = 0.0, cell = 0.5 }
frequency = 3e9
depth = 0
"""
    )
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "simulate", tmp_path / "room.toml", "-o", "out") == 0
    metrics = read_metrics(tmp_path / "out")
    rows = list(csv.DictReader((tmp_path / "out" / "map.csv").read_text().splitlines()))
    assert len(rows) == 16 * 16
    for row in (rows[0], rows[100]):
        x, y = float(row["x"]), float(row["y"])
        gain = 20 * math.log10(299792458.0 / 3e9 / (4 * math.pi * math.hypot(x, y, 2.0)))
        # The mean over a cell of half a metre is that of its middle to a few hundredths of a dB.
        assert float(row["transmitter_1"]) == pytest.approx(20 + gain, abs=0.1)
    levels = sorted(float(row["transmitter_1"]) for row in rows)
    assert metrics["largest"] == pytest.approx(levels[-1], abs=1e-6)
    assert metrics["median"] == pytest.approx(levels[len(levels) // 2], abs=0.05)
    said = " ".join(capsys.readouterr().out.split())
    assert metrics["answer"] in said
    assert metrics["answer"].startswith(
        f"Received power at 256 places: median {metrics['median']:.3g} dBm, a tenth below "
    )
    assert (tmp_path / "out" / "coverage.png").exists()


def test_a_new_plugin_runs_and_gives_run_files_its_shape(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    assert call(monkeypatch, "new", "plugin") == 0
    assert "wrote plugin.py; try: python plugin.py" in " ".join(capsys.readouterr().out.split())

    def run(*words: str) -> str:
        line = [sys.executable, "plugin.py", *words]
        return subprocess.run(line, check=True, capture_output=True, text=True).stdout

    found = re.fullmatch(r"strongest echo ([\d.]+) m away\n", run())
    assert found is not None
    # The nearest of the pyramid's points is 2.5 m ahead on the ground, the farthest seen its top.
    assert math.hypot(2.5, 0.4) < float(found[1]) < math.hypot(3.0, 0.5, 0.4)
    assert "side" in run("keys", "scene")
    assert call(monkeypatch, "new", "simulate") == 0
    text = (tmp_path / "simulate.toml").read_text()
    text = re.sub(r'shape = "box".*\nsize = .*', 'shape = "pyramid"\nside = 0.4', text)
    (tmp_path / "own.toml").write_text(text)
    run("simulate", "own.toml")
    assert read_metrics(tmp_path / "out" / "own")["paths"] > 1000
    assert call(monkeypatch, "simulate", tmp_path / "own.toml", "-o", "other") == 2
    assert "pyramid" in capsys.readouterr().err
