"""Every gradient scene of the experiments, in small: fewer samples, a smoother map."""

from pathlib import Path

import pytest

from gradients.run_files import check_run
from invertwin.channel import Sampling
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, gradcheck
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Surrogate
from invertwin.scene import Scene, Translation, plate, sphere
from scenes import float64, radar, thing

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
    report = check_run(
        file,
        samples=400_000,
        boundary_samples=100_000,
        check=GradcheckSettings(repeats=3, difference_samples=500_000, noise=0.01, max_pairs=16),
        surrogate=Surrogate("gaussian", range_width=1.5, angle_width=1.0),
        oversample=1,
    )
    assert report.difference_noise < 0.015
    assert report.full.relative_l1 < 0.03
    assert report.full.correlation > 0.999
    # A radar that moves before a still scene sees nearly all of it change smoothly.
    if file.stem != "radar_x":
        assert report.interior.relative_l1 > 3 * report.full.relative_l1
        assert report.interior.relative_l1 > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    "axis", [pytest.param((0.0, 1.0, 0.0), marks=pytest.mark.claim), (0.0, 0.0, 1.0)], ids="yz"
)
def test_a_fine_mesh_keeps_its_silhouette(axis):
    """Triangles nearly edge-on beside a silhouette must not block its own boundary rays."""
    ball = thing(sphere(0.2, 5), (1.1, 0.05, 0.02))
    scene = Scene({"wall": thing(plate(2.4, 2.4, divisions=2), (2, 0, 0)), "ball": ball})
    seen = radar()
    model = SurrogateMap(
        seen.grid(0.7, 2.6, 0.6, oversample=1),
        Surrogate("gaussian", range_width=2.0, angle_width=1.0),
        Sampling(depth=1, samples=1_000_000, boundary_samples=400_000),
    )
    report = gradcheck(
        model,
        Translation("ball"),
        float64(axis),
        scene=scene,
        sensor=seen,
        settings=GradcheckSettings(
            repeats=2, difference_samples=1_500_000, noise=0.015, max_pairs=8
        ),
    )
    assert report.difference_noise < 0.02
    assert report.full.relative_l1 < 0.03
    assert report.interior.relative_l1 > 0.2
