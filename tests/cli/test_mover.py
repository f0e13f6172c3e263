"""Movers, recorded and simulated, from the run file to the report."""

import json

import pytest

from cli.small import RUN, call, read_metrics

OPENRADAR = """\
task = "reconstruct"
frame = 2

[scene.mover]
shape = "sphere"
radius = 0.25
material = { kind = "rough_dielectric", permittivity = 5.0, diffuse = 0.5 }

[data]
kind = "openradar"
folder = "openradar"

[grid]
range_min = 2.0
range_max = 4.0

[[parameters]]
kind = "mover"
object = "mover"

[optimizer]
rate = 0.05

[reconstruct]
steps = 40
samples = 800
"""
SCALE = '[[parameters]]\nkind = "scale"\nobject = "mover"\n'


@pytest.fixture
def write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def write(text):
        (tmp_path / "run.toml").write_text(text)
        return tmp_path / "run.toml"

    return write


@pytest.mark.claim
@pytest.mark.slow
def test_a_twin_of_the_recording_is_nearer_to_it_than_a_point(
    write, data_folder, tmp_path, monkeypatch
):
    monkeypatch.setenv("INVERTWIN_DATA", str(data_folder))
    assert call(monkeypatch, "reconstruct", write(OPENRADAR), "-o", "out") == 0
    metrics = read_metrics(tmp_path / "out")
    assert metrics["mover_range_m"] == pytest.approx(2.93, abs=0.05)
    assert metrics["phase_coherence"] > 0.99
    assert metrics["twin_correlation"] > max(0.8, metrics["bare_psf_correlation"])
    for prefix in ("", "heldout_"):
        found = metrics[f"{prefix}correlations"]
        assert set(found) == {"magnitude", "power", "level"}
        for name in ("twin", "bare_psf"):
            assert found["magnitude"][name] == metrics[f"{prefix}{name}_correlation"]
    assert metrics["twin"]["velocity_m_s"][0] == pytest.approx(0.59, abs=0.05)
    report = (tmp_path / "out" / "report.html").read_text()
    assert report.count("<img") == 5
    assert "0.947" in report  # the point target's
    assert (tmp_path / "out" / "twin.ply").exists()


@pytest.mark.slow
def test_the_run_file_holds_what_its_note_says(repository, data_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("INVERTWIN_DATA", str(data_folder))
    file = repository / "experiments" / "openradar.toml"
    assert call(monkeypatch, "reconstruct", file, "-o", tmp_path / "out") == 0
    metrics = read_metrics(tmp_path / "out")
    assert metrics["twin_correlation"] > metrics["bare_psf_correlation"] + 0.02
    assert metrics["heldout_twin_correlation"] > metrics["heldout_bare_psf_correlation"] + 0.03
    for prefix in ("", "heldout_"):
        for scale in metrics[f"{prefix}correlations"].values():
            assert scale["twin"] > scale["bare_psf"]
    assert all(0.3 < side < 2.0 for side in metrics["twin"]["extent_m"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ('kind = "mover"', 'kind = "translation"'),
            "data: expected one chirp of a recording of moving targets, got the mean",
        ),
        (
            ("[optimizer]", '[calibration]\nobject = "mover"\n[optimizer]'),
            "calibration: expected no such section with a moving target",
        ),
        (
            ("[optimizer]", f"{SCALE}\n[optimizer]"),
            "parameters: expected kind mover alone, got mover, sc",
        ),
        (('folder = "openradar"', 'folder = "elsewhere"'), "github.com/PreSenseRadar/OpenRadar"),
        (('folder = "openradar"', 'folder = "openradar"\nboard = { name = "xWR1443" }'), "board"),
        (
            ("diffuse = 0.5", "diffuse = 1.0"),
            "scene.mover: expected a diffuse share between",
        ),
    ],
)
def test_run_files_that_ask_for_something_else_are_refused(
    write, data_folder, monkeypatch, capsys, change, message
):
    monkeypatch.setenv("INVERTWIN_DATA", str(data_folder))
    assert call(monkeypatch, "reconstruct", write(OPENRADAR.replace(*change))) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_mover_needs_chirps(write, monkeypatch, capsys):
    head, rest = RUN.split("[[parameters]]", 1)
    other = rest[rest.index("\n[") :] if "\n[" in rest else ""
    file = write(f'{head}[[parameters]]\nkind = "mover"\nobject = "plate"\n{other}')
    assert call(monkeypatch, "reconstruct", file) == 2
    assert "expected a section [chirps] for a mover in simulated data" in capsys.readouterr().err


@pytest.mark.slow
def test_a_simulated_mover_is_scored_against_its_truth(write, tmp_path, monkeypatch):
    """The truth is that of the frame's start, the twin that of the middle of the chirps."""
    scene = OPENRADAR[OPENRADAR.index("[scene.mover]") : OPENRADAR.index("[data]")]
    sensor = RUN[RUN.index("[radar]") : RUN.index("[[parameters]]")]
    parts = (
        'task = "reconstruct"\nframe = 2\nseed = 2',
        scene.replace("0.25", "0.1"),
        "[truth.mover]\nposition = [1.4, 0.1, 0.0]\nvelocity = [-1.5, 0.0, 0.0]",
        sensor.replace(", [0.0, 0.1, 0.0]]", "]"),
        "[chirps]\ncount = 32\ninterval = 2.5e-4",
        OPENRADAR[OPENRADAR.index("[[parameters]]") :],
    )
    assert call(monkeypatch, "reconstruct", write("\n".join(parts)), "-o", "out") == 0
    metrics = read_metrics(tmp_path / "out")
    assert metrics["status"] in ("budget", "converged")
    assert metrics["position_error_m"] < 0.1
    assert metrics["velocity_error_m_s"] < 0.5
    assert metrics["mover_velocity_m_s"] == pytest.approx(-1.5, abs=0.1)


@pytest.mark.slow
def test_the_run_as_used_runs_again(write, data_folder, tmp_path, monkeypatch):
    """Defaults are filled in, the board among them, and the file is still accepted."""
    monkeypatch.setenv("INVERTWIN_DATA", str(data_folder))
    file = write(OPENRADAR.replace("steps = 40", "steps = 2"))
    assert call(monkeypatch, "reconstruct", file, "-o", "out") == 0
    assert call(monkeypatch, "reconstruct", tmp_path / "out" / "run.toml", "-o", "again") == 0
    first, second = (read_metrics(tmp_path / name) for name in ("out", "again"))
    assert json.dumps(first["twin"]) == json.dumps(second["twin"])
