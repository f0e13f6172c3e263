"""The gradient scenes of several bounces, in small: fewer samples than the run files ask for."""

from pathlib import Path

import pytest

from gradients.run_files import check_run
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings, GradientReport

FOLDER = Path(__file__).resolve().parents[2] / "experiments" / "gradients" / "multi_bounce"


def test_all_scenes_are_here():
    names = {file.stem for file in FOLDER.glob("*.toml")}
    assert names >= {"two_bounce", "three_bounce_corner", "nlos_edge", "behind_board", "emerging"}


def checked(name: str, samples: int, boundary_samples: int, pairs: int) -> GradientReport:
    return check_run(
        FOLDER / f"{name}.toml",
        samples=samples,
        boundary_samples=boundary_samples,
        check=GradcheckSettings(
            repeats=2, difference_samples=2 * samples, noise=0.0, max_pairs=pairs
        ),
    )


@pytest.mark.claim
@pytest.mark.slow
def test_two_bounces_need_the_shadows_that_surfaces_cast_on_each_other():
    found = checked("two_bounce", 400_000, 200_000, pairs=12)
    assert found.difference_noise < 0.02
    assert found.full.relative_l2 < 0.02
    assert found.full.correlation > 0.999
    assert found.no_interior_edges is not None
    assert found.no_interior_edges.relative_l2 > 1.5 * found.full.relative_l2
    assert found.interior.relative_l2 > 4 * found.full.relative_l2


def test_a_target_that_leaves_a_shadow_has_its_whole_gradient():
    """Two thirds of it are hidden; what is seen already hardly says how the echo grows."""
    found = checked("emerging", 100_000, 50_000, pairs=4)
    assert found.difference_noise < 0.01
    assert found.full.relative_l1 < 0.01
    assert found.interior.relative_l1 > 0.5


@pytest.mark.claim
@pytest.mark.slow
def test_what_a_board_covers_comes_through_it_late_and_weak():
    """Its edge sweeps over a target, which is seen on either side of it."""
    found = checked("behind_board", 100_000, 50_000, pairs=4)
    assert found.difference_noise < 0.02
    assert found.full.relative_l1 < 0.02
    assert found.interior.relative_l1 > 0.5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:6 edges of meshes run along cracks")  # drawn 1 mm apart
def test_three_bounces_in_a_corner():
    found = checked("three_bounce_corner", 800_000, 1_600_000, pairs=16)
    assert found.difference_noise < 0.02
    assert found.full.relative_l1 < 0.04
    assert found.no_interior_edges is not None
    assert found.no_interior_edges.relative_l1 > 1.3 * found.full.relative_l1
    assert found.interior.relative_l1 > 0.5


@pytest.mark.slow
def test_an_object_seen_by_way_of_a_wall():
    """All of its shadows are those that surfaces cast on each other."""
    found = checked("nlos_edge", 2_000_000, 16_000_000, pairs=16)
    assert found.difference_noise < 0.03
    assert found.full.relative_l1 < 0.06
    assert found.no_interior_edges is not None
    for without in (found.interior, found.no_interior_edges):
        assert without.relative_l1 > 3 * found.full.relative_l1
