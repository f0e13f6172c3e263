"""The gradient scenes of surfaces that meet, in small: fewer samples than the run files ask for."""

from pathlib import Path

import pytest

from gradients.run_files import check_run
from invertwin.inversion.gradcheck.gradcheck import GradcheckSettings

FOLDER = Path(__file__).resolve().parents[2] / "experiments" / "gradients" / "contact"
NAMES = (
    *("overlapping_balls", "crossed_plates", "sunk_box_rises", "sunk_box_slides"),
    *("box_on_floor", "box_on_floor_grows"),
    *("box_on_floor_scales", "box_on_floor_scales_and_turns"),
)


def test_all_scenes_are_here():
    names = {file.stem for file in FOLDER.glob("*.toml")}
    assert names >= {*NAMES, "past_a_contact_two_bounces"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.claim) if n == "box_on_floor" else n for n in NAMES]
)
def test_a_contact_that_moves(name):
    report = check_run(
        FOLDER / f"{name}.toml",
        samples=400_000,
        boundary_samples=100_000,
        check=GradcheckSettings(repeats=2, difference_samples=1_000_000, noise=0.01, max_pairs=8),
    )
    assert report.difference_noise < 0.015
    assert report.full.relative_l1 < 0.02
    assert report.no_contact is not None
    assert report.no_contact.relative_l1 > 0.1


@pytest.mark.slow
def test_a_contact_lit_by_way_of_a_screen():
    report = check_run(
        FOLDER / "past_a_contact_two_bounces.toml",
        samples=2_000_000,
        boundary_samples=500_000,
        check=GradcheckSettings(repeats=3, difference_samples=8_000_000, noise=0.02, max_pairs=40),
    )
    assert report.difference_noise < 0.025
    assert report.full.relative_l1 < 0.04
    assert report.no_contact is not None
    assert report.no_contact.relative_l1 > 0.1
