"""`invertwin view` and `reconstruct --view`: what there is to see of runs, run files, captures."""

import html
import importlib.util
import re
import socket
from pathlib import Path

import numpy as np
import pytest

from cli.small import RUN, call, read_metrics
from invertwin.cli.commands.view import load_display
from invertwin.cli.fits.displays import VIEW_FILE, load_steps
from invertwin.cli.run_file import load_run
from invertwin.errors import InputError
from invertwin.viewer import Display, Viewer, content_security_policy

WALKS = """
[[scene.plate.motion]]
kind = "along"
times = [0.0, 2.0]
places = [[1.2, 0.0, 0.0], [1.2, 1.0, 0.0]]
"""
EVIL = "<script>alert(1)</script>"
NEEDS_VISER = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason='needs: pip install "invertwin[view]"'
)


def test_a_run_file_shows_the_truth_and_can_be_moved(run_file):
    display, links = load_display(run_file)
    run = load_run(run_file)
    layers = {layer.name: layer for layer in display.layers}
    name = next(iter(run.truth))
    center = (layers[f"twin/{name}"].points.min(0) + layers[f"twin/{name}"].points.max(0)) / 2
    assert center == pytest.approx(run.truth[name].position, abs=1e-5)
    assert links[""].names == tuple(run.scene)


def test_a_fit_leaves_its_steps_and_a_report_in_which_no_name_acts(run_file, monkeypatch, capsys):
    text = RUN.replace('object = "plate"', f'object = "{EVIL}"')
    run_file.write_text(re.sub(r"\[(scene|truth)\.plate]", rf'[\1."{EVIL}"]', text))
    assert call(monkeypatch, "reconstruct", run_file) == 0
    folder = Path("out/small")
    metrics = read_metrics(folder)
    display, links = load_display(folder)
    assert [step.number for step in display.steps] == list(range(metrics["steps"] + 1))
    assert display.steps[0].label == "start"
    assert f"{metrics['loss']:.4g}" in display.steps[-1].label
    begun, ended = (display.steps[k].bodies[EVIL].vertices for k in (0, -1))
    assert (ended - begun).std(0) == pytest.approx(0, abs=1e-5)  # it was moved, not turned
    assert np.linalg.norm(ended - begun, axis=1).mean() > 1e-3
    layers = {layer.name: layer for layer in display.layers}
    assert layers[f"twin/{EVIL}"].points == pytest.approx(ended, abs=1e-6)
    assert {"truth", "start", "radar", "95 % ellipsoid"} <= set(display.groups)
    assert set(display.maps[""].power) == {"measured", "simulated"}
    assert links[""].scene[EVIL].vertices.numpy() == pytest.approx(ended, abs=1e-6)
    report = (folder / "report.html").read_text()
    assert "<script>alert" not in report
    assert 'id="view-data"' in report
    assert content_security_policy() in html.unescape(report)
    assert call(monkeypatch, "view", folder, "--record", "page.html") == 0
    assert "<script>alert" not in Path("page.html").read_text()
    Path("notes.txt").write_text("mine")
    for path, said in (("notes.txt", "--overwrite"), ("no/folder/page.html", "existing folder")):
        assert call(monkeypatch, "view", folder, "--record", path) == 2
        assert said in capsys.readouterr().err
    assert Path("notes.txt").read_text() == "mine"
    assert call(monkeypatch, "view", folder, "--record", "notes.txt", "--overwrite") == 0
    assert "<!DOCTYPE html>" in Path("notes.txt").read_text()


def test_a_capture_shows_its_maps(run_file, monkeypatch):
    assert call(monkeypatch, "simulate", run_file) == 0
    display, links = load_display(Path("out/small/capture.nc"))
    assert links == {}
    assert len(display.maps[""].frames) == len(display.layers[0].points)
    assert set(load_display(Path("out/small"))[0].maps) == {""}


def test_a_folder_of_a_twin_shows_what_was_found(run_file):
    folder = Path("found")
    folder.mkdir()
    (folder / "twin.toml").write_text(RUN)
    display, links = load_display(folder)
    assert set(links) == {""}
    assert "twin/plate" in {layer.name for layer in display.layers}


def test_a_folder_says_what_was_found_and_its_verdict(run_file):
    folder = Path("found")
    folder.mkdir()
    (folder / "run.toml").write_text(RUN)
    assert load_display(folder)[0].answer == ""
    (folder / "metrics.json").write_text('{"answer": "plate at (1, 2, 3)", "verdict": "doubtful"}')
    assert load_display(folder)[0].answer == "plate at (1, 2, 3); the fit is doubtful"
    (folder / "metrics.json").write_text("[1")
    with pytest.raises(InputError, match=r"metrics\.json"):
        load_display(folder)


def test_what_moves_has_steps_in_time(run_file):
    text = RUN.replace("[radar]\n", WALKS + "\n[radar]\n", 1)
    Path("walk.toml").write_text(text)
    display = load_display(Path("walk.toml"))[0]
    steps = display.steps
    assert display.shows_start  # as its data do
    assert [step.label for step in steps[:2]] == ["time 0.00 s", "time 0.05 s"]
    middles = [step.bodies["plate"].vertices.mean(0) for step in (steps[0], steps[40])]
    assert steps[-1].label == "time 2.00 s"  # where its trajectory ends
    assert middles[1] - middles[0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-5)


def test_a_coverage_folder_shows_transmitters_and_levels(run_file, monkeypatch):
    assert call(monkeypatch, "new", "coverage") == 0
    assert call(monkeypatch, "simulate", "coverage.toml") == 0
    display, links = load_display(Path("out/coverage"))
    names = [layer.name for layer in display.layers]
    assert links == {}
    assert "transmitters" in names
    bands = [layer for layer in display.layers if " to " in layer.name]
    rows = Path("out/coverage/map.csv").read_text().splitlines()[1:]
    assert 4 * len(rows) == sum(len(layer.points) for layer in bands)
    assert "dBm" in display.answer


@pytest.mark.parametrize("target", ["none.toml", "empty", "picture.png"])
def test_what_cannot_be_shown_is_one_line(target, run_file, monkeypatch, capsys):
    Path("empty").mkdir()
    assert call(monkeypatch, "view", target) == 2
    error = capsys.readouterr().err
    assert "expected a run" in error
    assert error.count("\n") == 1


def test_a_host_of_others_without_a_token_is_refused(run_file, monkeypatch, capsys):
    assert call(monkeypatch, "view", run_file, "--host", "0.0.0.0") == 2
    assert "expected a token" in capsys.readouterr().err


@NEEDS_VISER
def test_it_ends_by_an_interruption_as_it_says(run_file, monkeypatch, capsys):
    def interrupted(self: Viewer) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "wait", interrupted)
    assert call(monkeypatch, "view", run_file, "--port", "0") == 0
    said = capsys.readouterr()
    assert "(Ctrl-C ends)" in said.out
    assert said.err == ""


def test_a_damaged_view_is_refused(run_file, monkeypatch, capsys):
    folder = Path("out/small")
    folder.mkdir(parents=True)
    (folder / "run.toml").write_text(RUN)
    (folder / VIEW_FILE).write_bytes(b"damaged")
    assert call(monkeypatch, "view", folder) == 2
    assert "repeat the run with --overwrite" in capsys.readouterr().err


@NEEDS_VISER
def test_a_fit_is_seen_while_it_goes_on(run_file, monkeypatch, capsys):
    seen, maps, begun = [], [], []
    plain = Viewer.add_step

    def noted(self: Viewer, step, found) -> None:
        plain(self, step, found)
        port = self._server.get_port()
        with socket.create_connection(("127.0.0.1", port), timeout=5):
            seen.append(step.number)
        (own,) = found.values()
        (known,) = self._display.maps.values()
        begun.append(known.maps_of_frame(0)["simulated"])
        maps.append(own.maps_of_frame(0)["simulated"])

    monkeypatch.setattr(Viewer, "add_step", noted)
    assert call(monkeypatch, "reconstruct", run_file, "--view", "-o", "watched") == 0
    assert "open http://127.0.0.1:" in capsys.readouterr().out
    assert seen == list(range(read_metrics(Path("watched"))["steps"] + 1))
    # At first what the start has for it, at last what the twin has.
    (kept,) = Display.load(Path("watched") / VIEW_FILE).maps.values()
    ended = kept.maps_of_frame(0)["simulated"]
    peak = float(ended.max())
    assert maps[0] == pytest.approx(begun[0], abs=1e-5 * peak)
    assert maps[-1] == pytest.approx(ended, abs=1e-5 * peak)
    assert abs(maps[-1] - maps[0]).max() > 0.01 * peak
    # To look on changes nothing.
    assert call(monkeypatch, "reconstruct", run_file) == 0
    losses = [read_metrics(Path(folder))["loss"] for folder in ("watched", "out/small")]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)


def test_workers_cannot_be_viewed(run_file, monkeypatch, capsys):
    assert call(monkeypatch, "reconstruct", run_file, "--view", "--workers", "2") == 2
    assert "expected --view with fits" in capsys.readouterr().err


def test_no_file_has_no_steps(tmp_path):
    assert load_steps(tmp_path / "none.npz") == []
    Display("", []).save(tmp_path / "empty.npz")
    assert load_steps(tmp_path / "empty.npz") == []


def test_the_run_file_is_never_replaced_by_its_page(run_file, monkeypatch, capsys):
    before = run_file.read_bytes()
    assert call(monkeypatch, "view", run_file, "--record", run_file, "--overwrite") == 2
    assert "expected a new file for --record" in capsys.readouterr().err
    assert run_file.read_bytes() == before
