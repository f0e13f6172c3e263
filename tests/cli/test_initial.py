"""`[initial]`: a start by conventional processing, and what the fit adds to it."""

import tomllib

import pytest
from rich.console import Console

from cli.small import call, read_metrics
from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.radar_models import estimate_initial_scene
from invertwin.cli.run_file import validate_run


def smaller(repository, **changes: str) -> str:
    text = (repository / "experiments" / "initial_guess.toml").read_text(encoding="utf-8")
    small = {
        "count = 24 }": "count = 12 }",
        "points_per_m2 = 800.0": "points_per_m2 = 500.0",
        "steps = 100": "steps = 50",
        "frames_per_step = 12": "frames_per_step = 6",
    }
    for whole, part in (small | changes).items():
        assert whole in text
        text = text.replace(whole, part)
    return text


@pytest.mark.slow
@pytest.mark.parametrize("method", ["points", "image"])
def test_the_fit_adds_to_a_conventional_guess(method, repository, tmp_path, monkeypatch):
    text = smaller(repository, **{"[initial]": f'[initial]\nmethod = "{method}"'})
    file = tmp_path / "small.toml"
    file.write_text(text, encoding="utf-8")
    assert call(monkeypatch, "reconstruct", file, "--out", tmp_path / "found") == 0
    metrics = read_metrics(tmp_path / "found")
    assert metrics["initial_points"] > 20
    # The scene's own pose is 8 m off.
    assert metrics["start_distance_m"] < 0.5
    assert metrics["start_angle_deg"] < 12
    assert metrics["position_error_m"] < 0.3 * metrics["start_distance_m"]
    assert metrics["rotation_error_deg"] < 1
    report = (tmp_path / "found" / "report.html").read_text(encoding="utf-8")
    assert "What the refinement added" in report


def test_a_fit_has_one_start(repository, tmp_path, monkeypatch, capsys):
    file = tmp_path / "small.toml"
    starts = '[starts]\nobject = "truck"\ndistance = [0.1, 0.2]\n\n[[parameters]]'
    file.write_text(smaller(repository, **{"[[parameters]]": starts}), encoding="utf-8")
    assert call(monkeypatch, "reconstruct", file, "--out", tmp_path / "found") != 0
    assert "expected no [starts] beside [initial]" in capsys.readouterr().err


def test_a_box_without_echoes_is_named(repository, tmp_path, monkeypatch, capsys):
    file = tmp_path / "small.toml"
    text = smaller(repository, **{"low = [4.5, -4.0, -1.0]": "low = [11.8, 4.8, -1.0]"})
    file.write_text(text, encoding="utf-8")
    assert call(monkeypatch, "reconstruct", file, "--out", tmp_path / "found") != 0
    assert "initial: expected echoes within the box" in capsys.readouterr().err


def test_a_size_is_guessed_also_of_an_object_whose_true_shape_is_another(repository, tmp_path):
    text = smaller(repository, **{"[initial]": "[initial]\nscale = true"})
    parts = '\n\n[[truth.truck.parts]]\nshape = "box"\nsize = [1.6, 4.4, 1.0]\n\n[radar]'
    text = text.replace("\n\n[radar]", parts)
    run = validate_run(tomllib.loads(text), tmp_path / "run.toml")
    console = Console(quiet=True)
    found = estimate_initial_scene(build_problem(run, console), console).notes
    assert found["initial_points"] > 20
    assert "initial_scale_error" not in found
