"""Derivatives of coverage maps by run files, with fewer points than these ask for."""

from dataclasses import replace
from pathlib import Path

import pytest

from invertwin.cli.run_file import load_run
from invertwin.cli.schema import build
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck

FOLDER = Path(__file__).resolve().parents[2] / "experiments" / "gradients" / "waves"
NAMES = ("coverage_occluder", "coverage_panel", "coverage_transmitter")


def test_all_run_files_are_here():
    runs = {file.stem: load_run(file) for file in FOLDER.glob("*.toml")}
    cells = {name for name, run in runs.items() if run.map and run.map.places.kind == "plane"}
    assert cells == set(NAMES)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(NAMES[0], marks=pytest.mark.claim), *NAMES[1:]])
def test_shadows_and_beams_that_sweep_over_cells(name):
    run = load_run(FOLDER / f"{name}.toml")
    assert run.gradcheck is not None
    scene, model = build.scene(run), run.map.build()
    sampling = replace(model.places.sampling, points=64, edge_points=10_000)
    model = replace(model, places=model.places.with_sampling(sampling))
    module, tangent = build.tangent(run, scene)
    report = gradcheck(
        model,
        module,
        tangent,
        scene=scene,
        sensor=run.transmitter.build(),
        acts_on=run.gradcheck.acts_on,
        settings=GradcheckSettings(
            repeats=1, step=0.03, difference_samples=100_000, noise=0.05, max_pairs=4
        ),
    )
    assert report.full.relative_l1 < 0.08
    assert report.interior.relative_l1 > 0.3
