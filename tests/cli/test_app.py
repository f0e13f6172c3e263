"""The commands end to end, on scenes small enough for seconds."""

import io
import math
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from cli.small import BEHIND, GRADCHECK, MATERIAL, RUN, STARTS, call, read_metrics
from invertwin.cli import app
from invertwin.cli import terminal as running
from invertwin.cli.run_file import load_run
from invertwin.runtime.progress import track


def test_help_names_the_commands(monkeypatch, capsys):
    assert call(monkeypatch, "--help") == 0
    said = capsys.readouterr().out
    for command in ("simulate", "reconstruct", "gradcheck", "demo", "doctor"):
        assert command in said
    places = [said.index(f"─ {head} ─") for head in ("Begin", "Recordings", "Run files", "Develop")]
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["reconstruct", "none.toml"], "none.toml"),
        (["simulate", "unknown.toml"], "did you mean `position`?"),
        (["gradcheck", "small.toml"], "small.toml: expected a section [gradcheck]"),
        (["gradcheck", "small.toml"], "its task is reconstruct: use `invertwin reconstruct small"),
        (["gradcheck", "check.toml", "check.toml"], "check twice"),
        (["reconstruct", "mesh.toml"], "invertwin: mesh.toml: scene.car: expected"),
        (["reconstruct", "behind.toml"], "invertwin: behind.toml: expected a"),
        (["reconstruct", "small.toml", "-o", "full"], "metrics.json"),
        (["reconstruct", "small.toml", "--resume"], "interrupted run"),
        (["reconstruct", "small.toml", "--resume", "--overwrite"], "both"),
    ],
)
def test_bad_input_is_one_line_and_code_2(run_file, monkeypatch, capfd, arguments, said):
    folder = run_file.parent
    (folder / "unknown.toml").write_text(RUN.replace("position = [1.2, 0.0, 0.0]", "positoin = 1"))
    (folder / "mesh.toml").write_text(RUN + '[scene.car]\nfile = "car.obj"\n' + MATERIAL)
    (folder / "check.toml").write_text(RUN + GRADCHECK)
    (folder / "behind.toml").write_text(BEHIND)
    (folder / "full").mkdir()
    (folder / "full" / "metrics.json").write_text("{}")
    assert call(monkeypatch, *arguments) == 2
    error = capfd.readouterr().err
    assert said in error
    assert error.startswith("invertwin: expected") or ": expected" in error
    assert error.count("\n") == 1
    assert not (folder / "out").exists()
    assert (folder / "full" / "metrics.json").read_text() == "{}"


def test_version(monkeypatch, capsys):
    assert call(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.startswith("invertwin ")


@pytest.mark.claim
@pytest.mark.slow
def test_simulate_then_reconstruct_from_the_saved_capture(run_file, monkeypatch, capsys):
    assert call(monkeypatch, "simulate", run_file) == 0
    out = run_file.parent / "out" / "small"
    metrics = read_metrics(out)
    assert metrics["frames"] == 2
    assert metrics["channels"] == 24
    assert 1.1 < metrics["peak_range_m"] < 1.8
    assert {p.name for p in out.iterdir()} >= {"capture.nc", "scene.png", "spectra.png"}
    assert "range [m]" in capsys.readouterr().out

    text = RUN[: RUN.index("[radar]")] + RUN[RUN.index("[grid]") :]
    text = text.replace('kind = "simulated"', 'kind = "capture"\nfile = "out/small/capture.nc"')
    text = text.replace("depth = 1\npoints_per_m2 = 2e3\nsnr_db = 20.0\n", "")
    measured = run_file.with_name("measured.toml")
    measured.write_text(text)
    assert call(monkeypatch, "reconstruct", measured, "-o", "fit") == 0
    metrics = read_metrics(run_file.parent / "fit")
    # The truth is an input here only because the run file says it.
    assert metrics["start_distance_m"] == pytest.approx(0.0224, abs=1e-3)


def test_simulate_of_nothing_visible_is_silence(run_file, monkeypatch):
    run_file.write_text(BEHIND)
    assert call(monkeypatch, "simulate", run_file) == 0
    assert read_metrics(run_file.parent / "out" / "small")["peak_power_db"] is None


@pytest.mark.slow
def test_reconstruct_writes_a_whole_folder(run_file, monkeypatch, capsys):
    landscape = '[landscape]\nobject = "plate"\naxis = [1.0, 0.0, 0.0]\npoints = 3\n'
    run_file.write_text(RUN + landscape + "exact_points = 21\n")
    assert call(monkeypatch, "reconstruct", run_file, "--seed", "5", "-o", "fit") == 0
    out = run_file.parent / "fit"
    names = {p.name for p in out.iterdir()}
    assert names == {
        *(".invertwin.json", "metrics.json", "run.toml", "report.html", "twin.ply"),
        *("checkpoint.pt", "scene.png", "spectra.png", "loss.png", "landscape.png", "above.png"),
        *("residuals.png", "view.npz"),
    }
    metrics = read_metrics(out)
    assert metrics["status"] in ("budget", "converged")
    assert metrics["starts_count"] == len(metrics["starts"]) == 1
    assert metrics["position_error_m"] >= 0
    assert metrics["landscape"]["local_minima"]["exact"] >= 3
    assert metrics["start_loss_sharp"] > 0
    assert 0 < metrics["fit_seconds"] <= metrics["wall_seconds"]
    assert 0.1 < metrics["peak_memory_gb"] < 8
    assert load_run(out / "run.toml").seed == 5
    report = (out / "report.html").read_text()
    assert report.count("data:image/png;base64,") == 6
    assert "plate.x [m]" in report
    said = capsys.readouterr().out
    assert "plate.x [m]" in said
    assert "all 8 steps used. A success is within 0.03 m: " in " ".join(said.split())
    # Without a terminal, progress is lines in the log.
    assert said.count("start 1: step ") == 8

    assert call(monkeypatch, "reconstruct", run_file, "--seed", "5", "-o", "fit") == 2
    assert call(monkeypatch, "reconstruct", run_file, "--seed", "5", "-o", "fit", "--resume") == 0
    assert "complete already" in capsys.readouterr().out


@pytest.mark.slow
def test_many_starts_with_and_without_boundary_terms(run_file, monkeypatch):
    run_file.write_text(
        RUN + "[variants.interior_only]\nreconstruct = { boundary = false }\n" + STARTS
    )
    assert call(monkeypatch, "reconstruct", run_file) == 0
    out = run_file.parent / "out" / "small"
    metrics = read_metrics(out)
    assert len(metrics["starts"]) == len(metrics["starts_interior_only"]) == 2
    assert metrics["successes"] == sum(row["success"] for row in metrics["starts"])
    assert "successes_interior_only" in metrics
    best = min(metrics["starts"], key=lambda row: row["loss"])
    assert metrics["position_error_m"] == best["position_error_m"]
    for row in metrics["starts"]:
        assert 0.05 <= row["start_distance_m"] <= 0.08
    assert (out / "checkpoint.pt").exists()
    assert not (out / "parts").exists()


@pytest.mark.slow
def test_gradcheck_of_several_files(run_file, monkeypatch, capsys):
    files = []
    for name in ("first", "second"):
        files.append(run_file.with_name(f"{name}.toml"))
        files[-1].write_text(RUN.replace("[1.2, 0.02, 0.01]", "[1.2, 0.0, 0.0]") + GRADCHECK)
    assert call(monkeypatch, "gradcheck", *files) == 0
    out = run_file.parent / "out" / "gradcheck"
    scenes = read_metrics(out)["scenes"]
    assert set(scenes) == {"first", "second"}
    for scene in scenes.values():
        for kind in ("full", "interior", "no_interior_edges"):
            assert set(scene[kind]) >= {"relative_l1", "relative_l2", "correlation"}
        assert scene["full"]["relative_l1"] < scene["interior"]["relative_l1"]
        assert scene["difference_noise"] > 0
    assert {p.name for p in out.iterdir()} >= {"first.png", "runs", "report.html"}
    said = " ".join(capsys.readouterr().out.split())
    assert "second" in said
    assert "2 for a correct derivative" in said


@pytest.mark.parametrize("gone", ["full", "closed", "pipe"])
def test_a_terminal_that_is_gone_ends_no_run(run_file, gone):
    """The folder is complete, and nothing else is said."""
    command = [sys.executable, "-c", "from invertwin.__main__ import main; main()"]
    line = shlex.join([*command, "simulate", str(run_file), "-o", "kept"])
    line += {"full": " > /dev/full", "closed": " >&-", "pipe": " | true"}[gone]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run(line, shell=True, env=environment, stderr=subprocess.PIPE, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert read_metrics(run_file.parent / "kept")["task"] == "simulate"


@pytest.mark.slow
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT])
def test_ended_at_any_moment_then_resumed_gives_the_same_twin(run_file, monkeypatch, ending):
    # At a rate this low no step overshoots: what atomic additions reorder is not amplified.
    slow = "[optimizer]\nrate = 0.004\n"
    run_file.write_text(RUN.replace("steps = 8", "steps = 60") + STARTS + slow)
    assert call(monkeypatch, "reconstruct", run_file, "-o", "whole") == 0
    whole = read_metrics(run_file.parent / "whole")

    # A shell that starts tests in the background has them ignore interruptions.
    heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    command = [sys.executable, "-c", heed + "from invertwin.cli.app import main; main()"]
    command += ["reconstruct", str(run_file), "-o", "cut"]
    checkpoint = run_file.parent / "cut" / "unfinished" / "parts" / "full_01.pt"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120
    while not checkpoint.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(ending)
    _, said = process.communicate()
    assert process.returncode == (130 if ending == signal.SIGINT else -signal.SIGKILL)
    if ending == signal.SIGINT:
        assert said.startswith("invertwin: interrupted; the same command with --resume goes on")
        assert said.count("\n") == 1
    assert checkpoint.exists()
    assert not (run_file.parent / "cut" / "metrics.json").exists()

    assert call(monkeypatch, "reconstruct", run_file, "-o", "cut", "--resume") == 0
    resumed = read_metrics(run_file.parent / "cut")
    for a, b in zip(resumed["starts"], whole["starts"], strict=True):
        # Relative to the length of the vector: one of its components may be next to zero.
        found, expected = a["values"]["plate.translation"], b["values"]["plate.translation"]
        assert math.dist(found, expected) <= 1e-4 * math.hypot(*expected)


def test_interruption_says_how_to_go_on(run_file, monkeypatch, capsys):
    from invertwin.cli.commands import reconstruct as run_reconstruct

    def interrupted(run, folder, console, workers, view):
        folder.write_text("checkpoint.pt", "state")
        raise KeyboardInterrupt

    monkeypatch.setattr(run_reconstruct, "run_reconstruct", interrupted)
    assert call(monkeypatch, "reconstruct", run_file) == 130
    error = capsys.readouterr().err
    assert "--resume" in error
    assert error.count("\n") == 1
    assert (run_file.parent / "out" / "small" / "unfinished" / "checkpoint.pt").exists()


def test_demo_reconstructs_the_run_file_that_comes_along(tmp_path, monkeypatch):
    from invertwin.cli.commands import reconstruct as run_reconstruct

    monkeypatch.chdir(tmp_path)
    seen = []

    def noted(run, folder, console, workers, view):
        seen.append((run, folder.path))
        return [], "found"

    monkeypatch.setattr(run_reconstruct, "run_reconstruct", noted)
    assert call(monkeypatch, "demo", "--seed", "9") == 0
    ((run, path),) = seen
    assert run.task == "demo"
    assert run.seed == 9
    assert path == Path("out/demo")


def test_demo_replaces_its_own_results_but_no_others(tmp_path, monkeypatch, capsys):
    from invertwin.cli.commands import reconstruct as run_reconstruct

    monkeypatch.chdir(tmp_path)

    def noted(run, folder, console, workers, view):
        folder.write_json("metrics.json", {"seed": run.seed})
        return [], "found"

    monkeypatch.setattr(run_reconstruct, "run_reconstruct", noted)
    for seed in (1, 2):
        assert call(monkeypatch, "demo", "--seed", str(seed)) == 0
        assert read_metrics(tmp_path / "out" / "demo")["seed"] == seed
    assert call(monkeypatch, "demo", "--resume", "--seed", "2") == 0
    assert "complete already" in capsys.readouterr().out
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "metrics.json").write_text("{}")
    assert call(monkeypatch, "demo", "-o", "mine") == 2
    assert (tmp_path / "mine" / "metrics.json").read_text() == "{}"


def test_wheels_carry_the_demo(repository):
    project = tomllib.loads((repository / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    ((source, target),) = wheel["force-include"].items()
    assert (repository / source).read_text() == app._find_demo_file().read_text()
    assert f"src/{target}" == str(Path(app.__file__).with_name("demo.toml").relative_to(repository))


@pytest.mark.parametrize("ok", [True, False])
def test_doctor_prints_and_returns_the_verdict(monkeypatch, capsys, ok):
    from invertwin.runtime import doctor

    monkeypatch.setattr(doctor, "collect_report", lambda: {"ok": ok})
    monkeypatch.setattr(doctor, "render_report", lambda report: "[not markup] " + "x" * 100)
    assert call(monkeypatch, "doctor") == (0 if ok else 1)
    assert "[not markup] " + "x" * 100 in capsys.readouterr().out


def test_backend_option_is_in_force(monkeypatch, run_file):
    monkeypatch.setenv("INVERTWIN_BACKEND", "auto")
    assert call(monkeypatch, "reconstruct", "none.toml", "--backend", "cpu") == 2
    assert os.environ["INVERTWIN_BACKEND"] == "cpu"
    assert call(monkeypatch, "reconstruct", "none.toml", "--backend", "tpu") == 2


def test_a_resumed_run_is_complete_and_only_then_complete_already(run_file, monkeypatch, capsys):
    from invertwin.cli.commands import reconstruct as run_reconstruct

    def interrupted(run, folder, console, workers, view):
        folder.write_text("checkpoint.pt", "state")
        raise KeyboardInterrupt

    def finished(run, folder, console, workers, view):
        folder.write_text("metrics.json", "{}")
        return [], "found"

    monkeypatch.setattr(run_reconstruct, "run_reconstruct", interrupted)
    assert call(monkeypatch, "reconstruct", run_file) == 130
    monkeypatch.setattr(run_reconstruct, "run_reconstruct", finished)
    capsys.readouterr()
    assert call(monkeypatch, "reconstruct", run_file, "--resume") == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("complete: ")
    assert call(monkeypatch, "reconstruct", run_file, "--resume") == 0
    assert capsys.readouterr().out.startswith("was complete already: ")


@pytest.mark.parametrize("place", ["load_runs", "_find_demo_file"])
def test_an_interruption_before_a_run_has_a_folder_is_one_line(
    run_file, monkeypatch, capsys, place
):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(app, place, stopped)
    assert (
        call(monkeypatch, *(["demo"] if place == "_find_demo_file" else ["simulate", run_file]))
        == 130
    )
    assert capsys.readouterr().err == "invertwin: interrupted\n"


def test_an_interruption_while_modules_are_imported_is_one_line(monkeypatch, capsys):
    from invertwin import __main__ as start

    def stopped():
        raise KeyboardInterrupt

    monkeypatch.setattr(app, "main", stopped)
    with pytest.raises(SystemExit) as ended:
        start.main()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "invertwin: interrupted\n"


def test_a_log_tells_the_time_that_is_left(monkeypatch):
    now = iter(range(0, 1000, 6))
    # Not the clock of the process: other threads may ask it, too.
    monkeypatch.setattr(running, "time", SimpleNamespace(monotonic=lambda: float(next(now))))
    written = io.StringIO()
    log = Console(file=written, width=100)
    with running.show_progress(log):
        for _ in track(range(10), "landscape"):
            pass
    lines = written.getvalue().splitlines()
    assert lines
    odd = [line for line in lines if not re.fullmatch(r"landscape: \d+ of 10, .* left", line)]
    assert odd == []
