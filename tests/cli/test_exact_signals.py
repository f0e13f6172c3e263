"""Mirrors of run files: ghosts in simulated data, and in the model of a fit."""

import pytest
import torch

from cli.small import RUN
from invertwin.cli.exact_signals import simulate_exact
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import RunFile, build
from invertwin.errors import InputError

SIDE = """
[scene.side]
shape = "plate"
width = 4.0
height = 4.0
position = [1.0, -0.6, 0.0]
rotation_deg = [0.0, 0.0, 90.0]
material = { kind = "perfect_conductor" }
"""


def read(text: str, tmp_path) -> RunFile:
    file = tmp_path / "run.toml"
    file.write_text(text)
    return load_run(file)


def simulated(run: RunFile) -> torch.Tensor:
    scene = build.true_scene(run)
    assert run.radar is not None
    assert run.grid is not None
    radar = build.radar(run.radar)
    return simulate_exact(run, scene, radar, build.grid(run.grid, radar)).paths.last


def test_mirrors_of_a_run_file_add_ghosts(tmp_path):
    text = RUN.replace("[truth.plate]", SIDE + "\n[truth.plate]").replace("depth = 1", "depth = 3")
    named = text.replace('kind = "simulated"', 'kind = "simulated"\nmirrors = ["side"]')
    plain, ghosts = (simulated(read(one, tmp_path))[:, 1] < -0.61 for one in (text, named))
    assert not bool(plain.any())  # nothing is behind the mirror
    assert int(ghosts.sum()) > 1000


def test_a_mirror_that_the_scene_lacks_is_named_by_its_key(tmp_path):
    run = read(RUN.replace("snr_db = 20.0", 'mirrors = ["side"]'), tmp_path)
    with pytest.raises(InputError, match=r"^data\.mirrors: .*plate, wall, got 'side'"):
        simulated(run)


def test_a_model_of_a_run_file_takes_mirrors(tmp_path):
    text = RUN.replace(
        "[surrogate]", '[model]\nkind = "surrogate"\nmirrors = ["wall"]\n\n[surrogate]'
    )
    run = read(text, tmp_path)
    assert run.model is not None
    assert tuple(run.model.mirrors) == ("wall",)
