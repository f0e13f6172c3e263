"""Every gradient scene of the experiments, in small: fewer samples, a smoother map."""

import math
from pathlib import Path

import pytest

from invertwin.cli import build
from invertwin.cli.run_file import load_run
from invertwin.inversion.gradcheck import Direction, gradcheck
from invertwin.radar import Surrogate
from invertwin.scene import Scene, plate, sphere
from scenes import radar, thing

FOLDER = Path(__file__).resolve().parents[2] / "experiments" / "gradients" / "one_bounce"
FILES = sorted(FOLDER.glob("*.toml"))


def test_all_scenes_are_here():
    assert {file.stem for file in FILES} >= {
        "letter_x",
        "letter_yaw",
        "letter_scale",
        "occluder",
        "double_slit",
        "radar_x",
        "bistatic",
    }


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_gradient_is_that_of_converged_differences(file):
    run = load_run(file)
    assert run.radar is not None
    assert run.grid is not None
    assert run.gradcheck is not None
    sensor, settings = build.radar(run.radar), run.gradcheck
    table = settings.parameter
    x, y, z = table.axis or (1.0, 0.0, 0.0)
    report = gradcheck(
        build.scene(run),
        sensor,
        sensor.grid(run.grid.range_min, run.grid.range_max, run.grid.u_max, oversample=1),
        Direction(table.kind, table.object or "", (x, y, z)),
        surrogate=Surrogate("gaussian", range_width=1.5, angle_width=1.0),
        depth=settings.depth,
        samples=400_000,
        boundary_samples=100_000,
        repeats=3,
        step=math.radians(settings.step_deg) if settings.step_deg else settings.step or 0.0,
        difference_samples=500_000,
        noise=0.01,
        max_pairs=16,
        sampling=settings.sampling,
        seed=1,
    )
    assert report.difference_noise < 0.015
    assert report.full.relative_l1 < 0.03
    assert report.full.correlation > 0.999
    # A radar that moves before a still scene sees nearly all of it change smoothly.
    if file.stem != "radar_x":
        assert report.interior.relative_l1 > 3 * report.full.relative_l1
        assert report.interior.relative_l1 > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], ids="xy")
def test_a_fine_mesh_keeps_its_silhouette(axis):
    """Triangles nearly edge-on beside a silhouette must not block its own boundary rays."""
    ball = thing(sphere(0.2, 5), (0.05, 0.02, 1.1))
    scene = Scene({"wall": thing(plate(2.4, 2.4, divisions=2), (0, 0, 2)), "ball": ball})
    seen = radar()
    report = gradcheck(
        scene,
        seen,
        seen.grid(0.7, 2.6, 0.6, oversample=1),
        Direction("translation", "ball", axis),
        surrogate=Surrogate("gaussian", range_width=2.0, angle_width=1.0),
        depth=1,
        samples=1_000_000,
        boundary_samples=400_000,
        repeats=2,
        difference_samples=1_500_000,
        noise=0.015,
        max_pairs=8,
    )
    assert report.difference_noise < 0.02
    assert report.full.relative_l1 < 0.03
    assert report.interior.relative_l1 > 0.2
