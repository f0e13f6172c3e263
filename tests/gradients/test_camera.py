"""Derivatives of images by run files, with fewer rays and pixels than these ask for."""

from dataclasses import replace
from pathlib import Path

import pytest

from invertwin.cli.run_file import load_run
from invertwin.cli.schema import build
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck

FOLDER = Path(__file__).resolve().parents[2] / "experiments" / "gradients" / "camera"


@pytest.mark.parametrize("file", sorted(FOLDER.glob("*.toml")), ids=lambda file: file.stem)
def test_outlines_that_sweep_over_pixels(file):
    run = load_run(file)
    assert run.gradcheck is not None
    scene, camera = build.scene(run), build.build_section(run, "camera")
    module, tangent = build.tangent(run, scene)
    coarse = replace(camera, width=6, height=5, focal=camera.focal / 2, centre=None)
    report = gradcheck(
        build.build_section(run, "image"),
        module,
        tangent,
        scene=scene,
        sensor=coarse,
        acts_on=run.gradcheck.acts_on,
        settings=GradcheckSettings(
            repeats=1, step=6e-3, difference_samples=300_000, noise=0.02, max_pairs=8
        ),
    )
    assert report.full.relative_l1 < 0.06
    assert report.interior.relative_l1 > 0.5
