"""`[placement]` in run files: a small room from end to end, and its errors."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from invertwin.cli.app import app
from invertwin.cli.commands.view import load_display
from invertwin.errors import InputError

ROOM = """
task = "reconstruct"
frame = 2
seed = 1

[scene.screen]
shape = "plate"
width = 3.0
height = 3.0
position = [0.5, 0.0, 1.35]
rotation_deg = [0.0, 0.0, -90.0]
material = { kind = "perfect_conductor" }

[placement]
frequency = 60e9
transmitter = [1.0, -2.5, 2.0]
receivers = { low = [0.0, 0.5, 1.2], high = [2.0, 2.5, 1.2], count = 40, batch = 20, scored = 20 }
walls = { corners = [[3.9, -2.9], [3.9, 2.9]], height = 1.8 }
panel = { counts = [6, 6], spacing = 2.5e-3, bits = 2, pattern.kind = "isotropic" }
starts = 2

[[parameters]]
kind = "panel"

[[parameters]]
kind = "panel_phases"

[search]
kind = "panels"
count = 2
fits = 2

[optimizer]
rate = 0.15
rotation_rate = 0.06

[reconstruct]
steps = 2

[[stages]]
parameters = ["panel"]
reconstruct = { steps = 1 }

[[stages]]
placement = { edge_width = 0.03 }

[variants.exhaustive]
search = { kind = "panel_grid", places = 3, yaws = 1, spread_deg = [5.0], fits = 1 }
stages = []
first_starts = 1
"""
CHECK = """
[gradcheck]
parameter = { kind = "panel" }
tangent = { along = 1.0 }
step = 1e-6
"""


def run(*arguments: object) -> None:
    app([str(argument) for argument in arguments], standalone_mode=False)


def written(folder: Path, text: str) -> Path:
    file = folder / "panel.toml"
    file.write_text(text, encoding="utf-8")
    return file


def metrics(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text(encoding="utf-8"))


def test_a_panel_is_placed_scored_and_drawn(tmp_path: Path):
    out = tmp_path / "out"
    run("reconstruct", written(tmp_path, ROOM), "-o", out)
    found = metrics(out)
    assert found["worst_after_db"] - found["worst_before_db"] == pytest.approx(found["gain_db"])
    assert found["evaluations"] == 2 + 3 * (2 * 1 + 1 + 2)
    assert found["evaluations_exhaustive"] == 3
    assert len(found["starts"]) == 2
    assert len(found["starts_exhaustive"]) == 1
    assert all(row["found_over_exhaustive"] > 0 for row in found["starts"])
    assert 0 <= found["successes"] <= 2
    # An aim has no noise: nothing to compare the twin with, and no error bars.
    assert found["verdict"] in ("unknown", "at a bound", "worse")
    assert "no_error_bars" in found
    for name in ("landscape.png", "coverage.png", "report.html"):
        assert (out / name).stat().st_size > 1000
    assert (out / "checkpoint.pt").exists()
    # The viewer shows the panel where it was placed: on the wall, x = 3.9 m, y = along - 2.9 m.
    places = panel_cells(out).mean((0, 1))
    (best,) = (x for x in found["starts"] if x["scored_db"] == found["worst_after_db"])
    assert places == pytest.approx([3.9, best["along_m"] - 2.9, 1.8], abs=1e-5)


def test_a_run_file_shows_the_panel_where_fits_start(tmp_path: Path):
    cells = panel_cells(written(tmp_path, ROOM.replace("bits = 2, ", "")))
    assert len(cells) == 36
    assert cells.mean((0, 1)) == pytest.approx([3.9, -2.9, 1.8], abs=1e-5)
    assert np.ptp(cells.reshape(-1, 3), axis=0)[0] == pytest.approx(0.0, abs=1e-6)


def panel_cells(target: Path) -> NDArray[np.float32]:
    """Corners [cell, 4, 3] of the elements that `invertwin view` draws."""
    layers = load_display(target)[0].layers
    cells = [layer.points for layer in layers if layer.group.startswith("metasurface")]
    return np.concatenate(cells).reshape(-1, 4, 3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("starts = 2", "starts = 2\ndescent = { steps = 3 }", r"\[stages\]"),
        ("starts = 2", "starts = 2\ngrid = { places = 3 }", "panel_grid"),
        ("starts = 2", "starts = 2\nannealing = 3", "panel_annealing"),
    ],
)
def test_keys_of_before_name_those_of_today(tmp_path: Path, old: str, new: str, words: str):
    with pytest.raises(InputError, match=words):
        run("reconstruct", written(tmp_path, ROOM.replace(old, new)), "-o", tmp_path / "out")


def test_check_says_what_a_placement_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run("check", written(tmp_path, ROOM))
    said = capsys.readouterr().out
    assert "steps, full, stage 2" in said
    assert "placement.starts" in said


def test_derivatives_by_the_place_are_checked(tmp_path: Path, repository: Path):
    file = repository / "experiments" / "gradients" / "waves" / "coverage_metasurface.toml"
    run("gradcheck", file, "-o", tmp_path / "out")
    (found,) = metrics(tmp_path / "out")["scenes"].values()
    assert found["full"]["relative_l1"] <= 0.015
    assert found["interior"]["relative_l1"] >= 0.1


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("counts = [6, 6]", "counts = [6]", "placement.panel.counts"),
        ("frequency = 60e9", "frequency = -1.0", "placement.frequency"),
        ("[3.9, 2.9]]", "[3.9, -2.9]]", "placement.walls: .*two at one place"),
        ("bits = 2", "bits = 9", "placement.panel: expected at most 8 bits"),
        ("starts = 2", "stars = 2", "did you mean `starts`"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, words: str):
    with pytest.raises(InputError, match=words):
        run("reconstruct", written(tmp_path, ROOM.replace(old, new)), "-o", tmp_path / "out")


def test_a_panel_needs_its_section(tmp_path: Path):
    text = ROOM[: ROOM.index("[placement]")].replace("reconstruct", "gradcheck")
    radar = """
[radar]
waveform = { kind = "fmcw", start_frequency = 77e9, bandwidth = 4e9, duration = 5e-5, samples = 64 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 4, spacing = 1.9e-3 }
positions = [[0.0, 0.0, 0.0]]

[grid]
range_min = 1.0
range_max = 2.0
"""
    with pytest.raises(InputError, match=r"expected a section \[placement\]"):
        run("gradcheck", written(tmp_path, text + radar + CHECK), "-o", tmp_path / "out")
