"""`invertwin twin`: files, tables, and what it refuses."""

import json
import os
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import invertwin as iw
from cli.small import call
from invertwin.capture import Capture
from invertwin.channel import Grid
from invertwin.cli.commands.twin import _state_objects
from invertwin.cli.run_file import load_run
from invertwin.discovery import DetectedObject, Twin
from invertwin.scene import linear_array

STILL = torch.zeros(1, 3, dtype=torch.float64)
RUN = """
task = "twin"
frame = 2
seed = 2

[scene.low_box]
shape = "box"
size = [0.4, 0.5, 0.9]
position = [0.2, 0.1, 0.45]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[radar]
orientation = { look_at = [0.0, 0.0, 0.6] }
positions = [
    [0.0, 1.8, 0.6], [1.27, 1.27, 0.6], [1.8, 0.0, 0.6], [1.27, -1.27, 0.6],
    [0.0, -1.8, 0.6], [-1.27, -1.27, 0.6], [-1.8, 0.0, 0.6], [-1.27, 1.27, 0.6],
]

[radar.waveform]
kind = "fmcw"
start_frequency = 77e9
bandwidth = 4e9
duration = 50e-6
samples = 128

[radar.transmitters]
kind = "positions"
positions = [[0.0, 0.0, 0.0]]
pattern = { kind = "cosine", exponent = 1.0 }

[radar.receivers]
kind = "linear"
count = 8
spacing = 1.898e-3
pattern = { kind = "cosine", exponent = 1.0 }

[grid]
range_min = 0.5
range_max = 3.0

[data]
kind = "simulated"
depth = 1
points_per_m2 = 500.0
snr_db = 15.0

[twin]
low = [-1.0, -1.0]
high = [1.0, 1.0]
level = 0.0
rays = 1500
"""


@pytest.mark.slow
def test_what_is_found_can_be_fitted_on(tmp_path: Path, monkeypatch, capsys):
    (tmp_path / "box.toml").write_text(RUN)
    # What the command line says wins over the run file, which says 1500.
    given = ["twin", str(tmp_path / "box.toml"), "--rays", "1200", "-o", str(tmp_path / "found")]
    assert call(monkeypatch, *given) == 0, capsys.readouterr().err
    folder = tmp_path / "found"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["count"] == metrics["true_count"] == 1
    assert metrics["chamfer_m"] < 0.05
    (thing,) = metrics["things"]
    assert thing["kind"] == "box"
    assert thing["position_m"][0] == pytest.approx(0.2, abs=0.03)
    assert thing["position_m"][1] == pytest.approx(0.1, abs=0.03)
    assert 0 < thing["deviations"]["x"] < 0.05
    assert "object_1" in capsys.readouterr().out
    assert {"twin.glb", "report.html", "ground.png", "maps.png", "capture.nc"} <= {
        file.name for file in folder.iterdir()
    }
    command = "twin capture.nc --low -1.0 -1.0 --high 1.0 1.0 --level 0.0 --rays 1200"
    report = (folder / "report.html").read_text()
    assert f"{command} --seed 2" in report
    assert report.index('id="view-data"') < report.index("<h2>Objects</h2>")
    run = load_run(folder / "twin.toml")
    assert run.scene["object_1"].position == pytest.approx(thing["position_m"])
    # The capture that it wrote gives the same things again.
    options = ["--low", "-1", "-1", "--high", "1", "1", "--level", "0", "--rays", "1200"]
    again = [
        "twin",
        str(folder / "capture.nc"),
        *options,
        "--seed",
        "2",
        "-o",
        str(tmp_path / "again"),
    ]
    assert call(monkeypatch, *again) == 0, capsys.readouterr().err
    (other,) = json.loads((tmp_path / "again" / "metrics.json").read_text())["things"]
    assert other["position_m"] == pytest.approx(thing["position_m"], abs=1e-3)
    described = tomllib.loads((folder / "twin.toml").read_text())
    assert described["data"]["file"] == "capture.nc"


@pytest.mark.slow
def test_stopped_in_the_search_then_resumed_finds_the_same(tmp_path: Path, monkeypatch):
    """On one thread: two threads add paths in a varying order."""
    (tmp_path / "box.toml").write_text(RUN.replace("rays = 1500", "rays = 400"))
    monkeypatch.chdir(tmp_path)
    # A signal as from Ctrl-C comes at the beginning of the third fit, in mid-search.
    code = """
import signal, sys
from invertwin.cli.app import main
from invertwin.discovery.assembly import ShapeLikelihood
fit, count = ShapeLikelihood.fit, 0
def counted(self, shapes, steps):
    global count
    count += 1
    if count == 3:
        signal.raise_signal(signal.SIGINT)
    return fit(self, shapes, steps)
signal.signal(signal.SIGINT, signal.default_int_handler)
if sys.argv.pop() == "stop":
    ShapeLikelihood.fit = counted
main()
"""
    one = {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}

    def run(out: str, *more: str, ending: str = "go") -> subprocess.CompletedProcess[str]:
        words = ["twin", "box.toml", "-o", out, *more, ending]
        call = [sys.executable, "-c", code, *words]
        return subprocess.run(call, env=os.environ | one, capture_output=True, text=True)

    cut = run("cut", ending="stop")
    assert cut.returncode == 130, cut.stderr
    assert cut.stderr.startswith("invertwin: interrupted; the same command with --resume goes on")
    assert "so far" in cut.stdout
    kept = tmp_path / "cut" / "unfinished"
    metrics = json.loads((kept / "metrics.json").read_text())
    assert metrics["stopped"]
    assert metrics["answer"].split(";")[0].endswith("so far, 0 doubtful")
    (thing,) = metrics["things"]
    assert thing["position_m"][:2] == pytest.approx([0.2, 0.1], abs=0.05)
    assert thing["deviations"] == {}
    assert "the search was stopped" in (kept / "report.html").read_text()
    assert load_run(kept / "twin.toml").scene["object_1"].position == thing["position_m"]
    assert not (tmp_path / "cut" / "metrics.json").exists()

    other = run("cut", "--resume", "--rays", "1300")
    assert other.returncode == 2
    assert "expected a checkpoint of this search" in other.stderr
    assert run("cut", "--resume").returncode == run("whole").returncode == 0
    resumed, whole = (
        json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("cut", "whole")
    )
    assert not resumed["stopped"]
    assert resumed["things"] == whole["things"]


def test_noise_has_nothing_in_it(tmp_path: Path, monkeypatch, capsys):
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=4e9, duration=50e-6, samples=64)
    radar = iw.Radar(linear_array(1, 1.8e-3), linear_array(4, 1.8e-3), chirp, STILL)
    beat = torch.randn(1, 1, 4, 64, dtype=torch.complex128, generator=torch.manual_seed(0))
    Capture.from_beat(1e-6 * beat, radar).save(tmp_path / "noise.nc")
    given = ["twin", str(tmp_path / "noise.nc"), "-o", str(tmp_path / "found")]
    assert call(monkeypatch, *given) == 0, capsys.readouterr().err
    metrics = json.loads((tmp_path / "found" / "metrics.json").read_text())
    assert metrics["count"] == 0
    (note,) = metrics["notes"]
    assert note.startswith("nothing is above the noise from 0.15 to ")
    assert metrics["warnings"] == []
    assert not (tmp_path / "found" / "twin.glb").exists()
    assert "nothing is above the noise" in (tmp_path / "found" / "report.html").read_text()


def test_faults_of_the_samples_are_said(tmp_path: Path, monkeypatch, capsys):
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=4e9, duration=50e-6, samples=64)
    radar = iw.Radar(linear_array(1, 1.8e-3), linear_array(4, 1.8e-3), chirp, STILL)
    beat = torch.randn(1, 1, 4, 64, dtype=torch.complex128, generator=torch.manual_seed(0))
    Capture.from_beat(1e-6 * beat.real.to(beat.dtype), radar).save(tmp_path / "real.nc")
    given = ["twin", str(tmp_path / "real.nc"), "-o", str(tmp_path / "found")]
    assert call(monkeypatch, *given) == 0, capsys.readouterr().err
    (fault,) = json.loads((tmp_path / "found" / "metrics.json").read_text())["warnings"]
    assert fault.startswith("complex only by type: ")
    assert "complex only by type" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "options", "said"),
    [
        ("none.nc", [], "no file"),
        ("noise.toml", [], "noise.toml"),
        ("raw.bin", [], "--board"),
        ("raw.bin", ["--board", "xWR9999", "--config", "raw.cfg"], "raw.cfg"),
        ("noise.nc", ["--range-max", "0.01"], "range_max"),
    ],
)
def test_what_it_cannot_do_is_one_line(
    tmp_path: Path, monkeypatch, capsys, name: str, options: list[str], said: str
):
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=4e9, duration=50e-6, samples=64)
    radar = iw.Radar(linear_array(1, 1.8e-3), linear_array(4, 1.8e-3), chirp, STILL)
    beat = torch.randn(1, 1, 4, 64, dtype=torch.complex128, generator=torch.manual_seed(0))
    Capture.from_beat(1e-6 * beat, radar).save(tmp_path / "noise.nc")
    (tmp_path / "raw.bin").write_bytes(bytes(4096))
    (tmp_path / "noise.toml").write_text("[samples]\nfile = 'none.npy'\n")
    given = ["twin", str(tmp_path / name), *options, "-o", str(tmp_path / "found")]
    assert call(monkeypatch, *given) == 2
    err = capsys.readouterr().err
    assert said in err
    assert "Traceback" not in err
    assert not (tmp_path / "found" / "metrics.json").exists()


def test_an_object_without_a_known_place_is_doubtful():
    """Both are likely, one somewhere within 4 m of a grid that ends at 6 m."""
    bins = Grid(0.0, 0.1, 61)
    places = [
        ({"x": 0.02, "y": 0.05}, 0.9),
        ({"x": 4.0, "y": 0.1}, 0.9),
        ({"x": 0.1, "y": 0.1}, 0.4),
    ]
    found = Twin(
        tuple(
            DetectedObject.point(
                f"object_{k}", torch.tensor([1.0, k, 0.0]).double(), deviations, sure
            )
            for k, (deviations, sure) in enumerate(places)
        ),
        0.0,
        grid=bins,
    )
    expected = "1 object found, 2 doubtful; point at (1.00, 0.00) ± 0.05 m"
    assert _state_objects(found) == (1, expected)
    assert _state_objects(replace(found, grid=None))[0] == 2
