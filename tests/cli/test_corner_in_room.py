"""A corner reflector among rough things, `experiments/corner_in_room.toml`: one map of both."""

import tomllib
from dataclasses import replace

import pytest
import torch

from cli.small import RUN, call, read_metrics
from invertwin.capture import Capture
from invertwin.cli.fits.problem import Problem, SensorData
from invertwin.cli.fits.radar_maps import RadarMaps
from invertwin.cli.fits.radar_models import blur_end_step, make_unblurred_models
from invertwin.cli.run_file import validate_run
from invertwin.cli.schema import build
from invertwin.errors import InputError
from invertwin.models.radar import SurrogateMap

MODEL = '\n[model]\nkind = "surrogate"\ncoherent = ["plate"]\nstretch = 2.0\n'


def run_of(text: str, tmp_path):
    return validate_run(tomllib.loads(text), tmp_path / "run.toml")


def test_run_files_name_targets_and_their_stretch(tmp_path):
    run = run_of(RUN + MODEL, tmp_path)
    scene, radar = build.scene(run), build.radar(run.radar)
    capture = Capture.from_beat(torch.zeros(*radar.shape, 64, dtype=torch.complex64), radar)
    sight = SensorData(capture, radar, build.grid(run.grid, radar))
    problem = Problem(run, scene, scene, frozenset(), {"": sight}, None, RadarMaps())
    (model,) = problem.kind.models(problem)
    assert isinstance(model, SurrogateMap)
    assert (model.coherent, model.stretch) == (("plate",), 2.0)
    assert model.kernels.range_width == 2.0
    (sharp,) = make_unblurred_models(problem)
    assert sharp == replace(model, surrogate="response", stretch=1.0)


def test_the_stretch_is_annealed_like_widths(tmp_path):
    sharp = RUN.replace("range_width = 2.0\nangle_width = 1.0\n", "range_width = 0.0\n")
    assert blur_end_step(run_of(sharp, tmp_path)) is None
    assert blur_end_step(run_of(sharp + MODEL, tmp_path)) == pytest.approx(0.7 * 8)


def test_a_stretch_below_one_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"model\.stretch: expected .* 1"):
        run_of(RUN + MODEL.replace("2.0", "0.5"), tmp_path)


@pytest.mark.slow
def test_a_corner_is_found_beside_rough_things(repository, tmp_path, monkeypatch):
    text = (repository / "experiments" / "corner_in_room.toml").read_text(encoding="utf-8")
    file = tmp_path / "corner.toml"
    file.write_text(text.replace("count = 4", "count = 1"), encoding="utf-8")
    assert call(monkeypatch, "reconstruct", file, "-o", tmp_path / "out") == 0
    metrics = read_metrics(tmp_path / "out")
    assert metrics["start_distance_m"] > 0.03
    assert metrics["success"]
    assert metrics["surrogate_correlation"] >= 0.9
    # Turns about the axis are stated as badly seen.
    stated = metrics["standard_deviations"]
    assert stated["corner.roll"] > 5 * stated["corner.pitch"]
