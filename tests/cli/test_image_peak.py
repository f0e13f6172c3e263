"""Fits that leave an echo which the image shows."""

import pytest

from cli.small import call, read_metrics
from discovery.rail import OTHER, TARGET, rail_capture

RUN = """
task = "reconstruct"
frame = 2
seed = 1

[scene.ball]
shape = "sphere"
radius = 0.01
subdivisions = 1
position = [7.03, 0.42, 0.1]
material = { kind = "rough_dielectric", permittivity = 5.0 }

[truth.ball]
position = [7.0, 0.4, 0.1]

[data]
kind = "capture"
file = "rail.nc"

[grid]
range_min = 6.0
range_max = 8.6
oversample = 4.0

[[parameters]]
kind = "translation"
object = "ball"
axes = ["x", "y"]

[surrogate]
range_kernel = "gaussian"
range_width = 4.0

[loss]
kind = "mse"
levels = 3

[optimizer]
kind = "adam"
rate = 0.03

[reconstruct]
depth = 1
steps = 100
samples = 4_000
boundary_samples = 400
"""


@pytest.fixture
def fit(tmp_path, monkeypatch, capsys):
    """Fit the ball to echoes of points, given as amplitudes by place; return the metrics."""

    def run(targets):
        rail_capture(targets).save(tmp_path / "rail.nc")
        (tmp_path / "run.toml").write_text(RUN)
        words = ["reconstruct", str(tmp_path / "run.toml"), "-o", str(tmp_path / "out")]
        assert call(monkeypatch, *words) == 0, capsys.readouterr().err
        return read_metrics(tmp_path / "out")

    return run


def test_a_brighter_reflector_that_the_scene_lacks_pulls_no_fit_away(fit, capsys):
    found = fit({TARGET: 1.0, OTHER: 2.5})
    (plain,), (again,) = found["starts"], found["starts_from_image"]
    assert plain["position_error_m"] > 0.5
    assert again["position_error_m"] < 0.02
    assert found["position_error_m"] == again["position_error_m"]
    assert found["image_peak_m"] == pytest.approx(TARGET, abs=0.02)
    assert "left the echo of the image" in found["verdict_reasons"][-1]
    assert "made again from the echo of the image" in capsys.readouterr().out


def test_a_fit_that_explains_the_image_stays(fit):
    found = fit({TARGET: 1.0})
    assert "image_peak_m" not in found
    assert found["position_error_m"] < 0.02
