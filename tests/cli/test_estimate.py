"""Limits before work: what would not fit is refused in one line that names the key."""

import time
import tomllib

import pytest
import torch

from cli.small import GRADCHECK, RUN, STARTS, call
from invertwin.cli import estimate as estimates
from invertwin.cli.commands import check as run_check
from invertwin.cli.commands import gradcheck as run_gradcheck
from invertwin.cli.commands import simulate as run_simulate
from invertwin.cli.fits import radar_models
from invertwin.cli.run_file import load_run, validate_run
from invertwin.cli.schema import build
from invertwin.errors import PhysicsWarning
from invertwin.runtime.progress import format_duration
from invertwin.scene import Mesh, shapes
from invertwin.scene.files import save_mesh
from invertwin.scene.mesh import concatenate_meshes

PAINT = 'material = { kind = "rough_dielectric", permittivity = 4.0 }\n'
TEXT = f'\n[scene.letter]\nshape = "text"\ntext = "AB"\nsize = 0.6\n{PAINT}'
BOX = f'\n[scene.box]\nshape = "box"\nsize = 0.2\ndivisions = 2\n{PAINT}'
LATTICE = """
[[parameters]]
kind = "lattice"
object = "wall"
low = [-1.0, -1.0, -1.0]
high = [1.0, 1.0, 1.0]
counts = [4, 4, 4]
"""
SEARCH = """
[search]
kind = "grid"
object = "plate"
low = [1.0, -1.0, -1.0]
high = [2.0, 1.0, 1.0]
step = 0.5
"""
CASES = {
    # millimetres for metres, one kind of shape after another
    "scene.letter.max_edge": (RUN + TEXT, "size = 0.6", "size = 600.0"),
    "scene.letter.text": (RUN + TEXT, '"AB"', f'"{"AB" * 1000}"'),
    "scene.box.divisions": (RUN + BOX, "divisions = 2", "divisions = 200_000"),
    "data.points_per_m2": (RUN + BOX, "size = 0.2", "size = 2000.0"),
    "scene.plate.divisions": (RUN, "divisions = 3", "divisions = 300_000"),
    "parameters[1].counts": (RUN + LATTICE, "[4, 4, 4]", "[400, 400, 4000]"),
    "search.step": (RUN + SEARCH, "high = [2.0,", "high = [1000.0,"),
    # what measures
    "radar.receivers.count": (RUN, "count = [6, 4]", "count = [60_000, 4_000]"),
    "radar.waveform": (RUN, "samples = 64 }", "samples = 2_000_000_000 }"),
    "grid.oversample": (RUN, "u_max = 0.6", "u_max = 0.6\noversample = 1e9"),
    "grid.u_max": (RUN, "spacing = [1.9e-3, 1.9e-3]", "spacing = [1.9e6, 1.9e-3]"),
    # how much
    "points on 4.12 m²": (RUN, "points_per_m2 = 2e3", "points_per_m2 = 2e12"),
    "data.samples": (RUN, "points_per_m2", "samples = 3_000_000_000\npoints_per_m2"),
    "starts.count": (RUN + STARTS, "count = 2", "count = 2_000_000"),
    "starts.distance": (RUN + STARTS, "[0.05, 0.08]", "[0.05, 80.0]"),
    "reconstruct.steps": (RUN, "steps = 8", "steps = 2_000_000_000"),
    "reconstruct.samples": (RUN, "20_000", "20_000_000_000_000"),
    "stages[0].remesh": (
        RUN.replace('"translation"', '"vertices"') + "[[stages]]\nremesh = 0.1\n",
        "remesh = 0.1",
        "remesh = 1e-5",
    ),
}


@pytest.fixture
def idle(monkeypatch):
    """No work begins."""
    work = (
        (radar_models, "simulate_exact"),
        (run_simulate, "simulate_exact"),
        (run_check, "simulate_exact"),
    )
    for module, name in (*work, (run_gradcheck, "gradcheck")):
        monkeypatch.setattr(module, name, None)


@pytest.mark.usefixtures("idle")
@pytest.mark.filterwarnings("ignore:virtual elements")
@pytest.mark.parametrize("case", CASES)
def test_what_would_not_fit_is_refused_before_work(run_file, monkeypatch, capsys, case):
    text, old, new = CASES[case]
    assert old in text
    run_file.write_text(text.replace(old, new, 1))
    begin = time.process_time()
    assert call(monkeypatch, "reconstruct", run_file) == 2
    assert time.process_time() - begin < 10  # the reading of the run file, and torch's, included
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert case.replace("grid.oversample", "grid.range_max") in error
    assert "expected" in error
    assert "got" in error
    assert not (run_file.parent / "out").exists()


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("command", ["simulate", "gradcheck", "check", "plan"])
def test_every_command_refuses_the_same(run_file, monkeypatch, capsys, command):
    text = RUN.replace("points_per_m2 = 2e3", "points_per_m2 = 2e12")
    task = {"check": "reconstruct"}.get(command, command)
    if command == "gradcheck":  # no exact signals
        text = text.replace("u_max = 0.6", "u_max = 0.6\noversample = 1e6")
    run_file.write_text(text.replace('"reconstruct"', f'"{task}"', 1) + GRADCHECK)
    if command == "plan":
        run_file.write_text(text)
    assert call(monkeypatch, command, run_file) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert ("expected at most" if command == "gradcheck" else "expected a run within the") in error


@pytest.mark.usefixtures("idle")
@pytest.mark.filterwarnings("ignore:.*a mesh 400 m wide")
def test_a_mesh_in_millimetres_is_refused(run_file, monkeypatch, capsys):
    ball = shapes.sphere(200.0, 2)
    save_mesh(run_file.parent / "ball.ply", ball)
    run_file.write_text(f'{RUN}\n[scene.ball]\nfile = "ball.ply"\n{PAINT}')
    assert call(monkeypatch, "reconstruct", run_file) == 2
    error = capsys.readouterr().err
    assert "m² of rough surfaces" in error
    assert "millimetres" in error


@pytest.mark.usefixtures("idle")
def test_less_memory_refuses_what_more_allows(run_file, monkeypatch, capsys):
    monkeypatch.setattr(estimates, "free_memory", lambda: 0.5e9)
    assert call(monkeypatch, "reconstruct", run_file) == 2
    assert "within the 0.5 GB of memory that are free" in capsys.readouterr().err


def test_check_says_memory_and_time_and_leaves_nothing(run_file, monkeypatch, capsys):
    assert call(monkeypatch, "check", run_file) == 0
    said = capsys.readouterr().out
    assert "data.points_per_m2" in said
    assert "GB free" in said
    assert f"{8 * 24_000:.2g} rays" in said
    assert [path.name for path in run_file.parent.iterdir()] == ["small.toml"]


@pytest.mark.filterwarnings("default::invertwin.errors.PhysicsWarning")
def test_check_names_what_is_wrong_with_a_mesh(run_file, monkeypatch, capsys):
    """Two halves of a plate, a fifth of a millimetre apart."""
    half, aside = shapes.plate(0.2, 0.3), torch.tensor([0.0, 0.2002, 0.0]).double()
    cracked = concatenate_meshes([half, Mesh(half.vertices + aside, half.faces)])
    save_mesh(run_file.with_name("cracked.ply"), cracked)
    drawn = 'shape = "plate"\nwidth = 0.4\nheight = 0.3\ndivisions = 3\n'
    run_file.write_text(RUN.replace(drawn, 'file = "cracked.ply"\n'))
    assert call(monkeypatch, "check", run_file) == 0
    said, warned = capsys.readouterr()
    rows = [line.split("│")[1:-1] for line in said.splitlines() if "│" in line]
    defects = {row[0].strip(): row[-1].strip() for row in rows if len(row) == 6}
    assert defects == {"plate": "2 edges along cracks 0.0002 m wide", "wall": "none"}
    assert "the mesh has 2 edges along cracks 0.0002 m wide" in warned


def test_points_of_every_object_are_counted(run_file, monkeypatch, capsys):
    own = 'points_per_m2 = { plate = 3e3, "*" = 1e3 }'
    run_file.write_text(RUN.replace("points_per_m2 = 2e3", own))
    run = load_run(run_file)
    scene = build.scene(run)
    areas = {
        name: Mesh(item.vertices, item.mesh.faces).area for name, item in scene.objects.items()
    }
    radar = build.radar(run.radar)
    sensor = estimates.SensorSetup(run, radar, build.grid(run.grid, radar))
    counts = {
        part.key: part.count for part in estimates.estimate_sensor_resources(sensor, scene)[0]
    }
    expected = 3e3 * areas["plate"] + 1e3 * areas["wall"]
    assert counts["data.points_per_m2"] == pytest.approx(expected)
    assert call(monkeypatch, "check", run_file) == 0
    run_file.write_text(RUN.replace("points_per_m2 = 2e3", "points_per_m2 = { plate = 3e3 }"))
    assert call(monkeypatch, "reconstruct", run_file) == 2
    assert "data.points_per_m2: expected points_per_m2 of every" in capsys.readouterr().err


def test_times_as_people_say_them():
    said = [format_duration(seconds) for seconds in (3.2, 90.0, 150.0, 3 * 3600.0, 1e6)]
    assert said == ["3 s", "90 s", "2 min", "3 h", "12 days"]


@pytest.mark.usefixtures("idle")
def test_a_fit_of_another_depth_than_its_data_gets_a_warning(tmp_path):
    text = RUN.replace("depth = 1", "depth = 2", 1)  # of the data
    run = validate_run(tomllib.loads(text), tmp_path / "run.toml")
    with pytest.warns(PhysicsWarning, match=r"reconstruct.depth is 1, data.depth is 2"):
        radar_models.warn_if_depths_differ(run, radar_models.build_sensors(run))
