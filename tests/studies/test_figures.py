"""The figures of the paper, small: ways to a derivative, losses along a line."""

import re

import pytest
import torch

from cli.small import GRADCHECK, RUN, call, read_metrics
from invertwin_studies import methods as all_methods
from invertwin_studies.figures import deep_minima
from invertwin_studies.methods import best_factor, scores

METHODS = """
[methods]
points_per_m2 = 5e2
sources = 3
smoothing = [4, 3]
samples = 20_000
"""
LOSS_SCAN = """
[loss_scan]
object = "plate"
axis = [1.0, 0.0, 0.0]
span = 4e-3
points = 41
wide_points = 5
sources = 3
smoothing = [4, 3]
samples = 20_000
"""
CHECK = RUN.replace("[1.2, 0.02, 0.01]", "[1.2, 0.0, 0.0]") + GRADCHECK + METHODS
SCAN = (
    RUN.replace('task = "reconstruct"', 'task = "loss-scan"').replace("snr_db = 20.0\n", "")
    + LOSS_SCAN
)


@pytest.mark.slow
def test_all_methods_in_one_table(run_file, monkeypatch, capsys):
    """Without Sionna RT its row says so, and all others are there."""
    monkeypatch.setattr(all_methods, "sionna_version", lambda: None)
    run_file.write_text(re.sub(r"depth = \d", "depth = 1", CHECK))
    assert call(monkeypatch, "gradcheck", run_file) == 0
    out = run_file.parent / "out" / "small"
    metrics = read_metrics(out)
    methods = metrics["methods"]
    assert set(methods) == set(all_methods.NAMES)
    assert methods == metrics["scenes"]["small"]["methods"]
    assert methods["sionna_rt"]["relative_l1"] is None
    assert methods["sionna_rt"]["note"] == "not installed"
    ours = methods.pop("invertwin")
    del methods["sionna_rt"]
    for key in ("relative_l1", "mae_unit_max"):
        assert all(ours[key] < found[key] for found in methods.values())
    assert 0.3 < methods["music_direct"]["relative_l1"] <= 1
    assert (out / "small_methods.png").exists()
    report = (out / "report.html").read_text()
    said = " ".join(capsys.readouterr().out.split())
    for text in (report, said):
        assert "edge sampling, strength only" in text
        assert "cannot be compared" in text
        assert "not installed" in text


def test_distances_of_a_derivative():
    truth = torch.tensor([1.0, -2.0, 0.5, 0.0], dtype=torch.float64)
    assert scores(3 * truth, truth, fitted=True)["relative_l1"] == pytest.approx(0)
    assert scores(3 * truth, truth, fitted=False)["relative_l1"] == pytest.approx(2)
    assert scores(3 * truth, truth, fitted=False)["mae_unit_max"] == pytest.approx(0)
    nothing = scores(0 * truth, truth, fitted=True)
    assert nothing["relative_l1"] == 1
    assert nothing["mae_unit_max"] == pytest.approx(3.5 / 2 / 4)
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(60, generator=generator, dtype=torch.float64)
    truth = torch.randn(60, generator=generator, dtype=torch.float64) + 0.5 * values
    best = best_factor(values, truth)
    misses = [(s * values - truth).abs().sum() for s in torch.linspace(-2, 2, 801)]
    assert (best * values - truth).abs().sum() <= min(misses)


def test_minima_that_are_noise_do_not_count():
    x = torch.linspace(-1, 1, 401, dtype=torch.float64)
    noise = torch.randn(401, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert deep_minima((x**2 + 1e-5 * noise).numpy()) == 1
    assert deep_minima((1 - torch.cos(20 * torch.pi * x) + x**2).numpy()) == 19


@pytest.mark.slow
def test_losses_along_a_line(run_file, monkeypatch, capsys):
    run_file.write_text(SCAN)
    assert call(monkeypatch, "loss-scan", run_file) == 0
    out = run_file.parent / "out" / "small"
    metrics = read_metrics(out)
    rates = metrics["minima_per_wavelength"]
    assert set(rates) == {"beat", "range_profile", "music", "surrogate"}
    # Twice a wavelength, there and back.
    assert rates["beat"] == pytest.approx(2, abs=0.6)
    assert rates["range_profile"] == pytest.approx(2, abs=0.6)
    assert rates["surrogate"] < 0.6
    assert metrics["lowest_m"]["beat"] == pytest.approx(0, abs=1e-9)
    assert {p.name for p in out.iterdir()} == {
        *(".invertwin.json", "metrics.json", "run.toml", "report.html", "losses.png")
    }
    said = " ".join(capsys.readouterr().out.split())
    assert "raw beat signal" in said
    assert "per wavelength" in said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (RUN, "expected a section [loss_scan] for loss-scan"),
        (SCAN.replace('object = "plate"\naxis', 'object = "plat"\naxis'), "loss_scan.object: exp"),
        (SCAN.replace("\ndepth = 1", "\ndepth = 2"), "data.depth: expected 1"),
        (SCAN.replace("sources = 3", "sources = 30"), "sources"),
        (SCAN.replace("[4, 3]", "[9, 3]"), "subarrays"),
        (SCAN.replace("points = 41", "points = 2"), "loss_scan.points"),
    ],
)
def test_bad_input_is_one_line(run_file, monkeypatch, capfd, text, said):
    run_file.write_text(text)
    assert call(monkeypatch, "loss-scan", run_file) == 2
    error = capfd.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (run_file.parent / "out").exists()
