"""The benchmark of diffraction in small: every figure but the walk round the cube."""

import json

import pytest
from rich.console import Console


def test_transition_function(diffraction):
    assert diffraction.transition_error() < 1e-13


@pytest.mark.parametrize("distance", [0.5, 3.0])
def test_half_plane_is_exact_for_plane_waves(diffraction, distance):
    assert diffraction.plane_wave_error(2.0, distance, diffraction.sommerfeld) < 1e-10


def test_wedge_and_point_source(diffraction):
    assert diffraction.plane_wave_error(1.5, 3.0, diffraction.series) < 6e-4
    assert diffraction.point_source_error(3.0) < 2e-3


def test_no_jump_at_any_boundary_and_antennas_may_change_places(diffraction):
    for name, some in diffraction.bends().items():
        for bend in some:
            assert diffraction.jump(bend) < 1e-6, name
            # The same is no small step without the diffracted field.
            assert diffraction.jump(bend, diffracted=False) > 0.5, name
            assert diffraction.reciprocity(bend) < 1e-9, name


def test_slope_term_smooths_the_derivative(diffraction):
    assert diffraction.slope_jump() < 1e-3
    assert diffraction.slope_jump(corrected=False) > 0.1


def test_vertical_links_past_an_edge(diffraction, monkeypatch):
    monkeypatch.setattr(diffraction, "EDGE_HEIGHTS", (0.003,))
    monkeypatch.setattr(diffraction, "OFFSETS", (0.01, 0.2))
    found = diffraction.vertical_deviations()
    assert 0.1 < found["vertical_db"] < 0.5
    assert found["turned_db"] < 1e-9
    assert found["vertical_isotropic_db"] < 1.0


@pytest.mark.slow
def test_field_about_a_cube(diffraction):
    found = diffraction.ring_error()
    assert found["second"] < found["first"] < 0.3 * found["optics"]


def test_field_on_a_plane_that_cuts_a_cube(diffraction):
    found, optics = (diffraction.full_wave_error(order, every=40) for order in (2, 0))
    assert found["full_wave"] < found["full_wave_with_phases"] < 0.005
    assert optics["full_wave"] > 0.02


@pytest.mark.slow
def test_paths_over_one_edge_jump_where_a_second_one_hides_them(diffraction, monkeypatch):
    monkeypatch.setattr(diffraction, "PLACES", diffraction.PLACES[2:])
    assert diffraction.largest_jump(1) > 1.0


def test_table_says_what_must_hold(diffraction):
    metrics = {
        "transition": 1e-15,
        "half_plane": 1e-14,
        "wedge": {"3": 7e-4},
        "point_source": {"3": 1e-3},
        "jump": {"lossy": 1e-8},
        "jump_optics": 0.8,
        "reciprocity": {"lossy": 1e-15},
        "slope_jump": 1e-4,
        "slope_jump_plain": 0.2,
        "vertical_db": 0.6,
        "turned_db": 1e-11,
        "vertical_isotropic_db": 0.9,
        "jump_db_next": 0.5,
        "jump_db_second": 2.3,
        "jump_db_first": 5.0,
        "full_wave": 0.03,
        "full_wave_with_phases": 0.04,
        "ring_rms": 0.05,
        "ring_rms_of": {"optics": 0.3},
    }
    json.dumps(metrics)
    console = Console(width=160, record=True)
    console.print(diffraction.table(metrics))
    lines = {
        line.split("│")[1].strip(): line
        for line in console.export_text().splitlines()
        if "│" in line
    }
    assert "NO" in lines["wedge.3"]
    assert "NO" in lines["full_wave_with_phases"]
    assert "NO" in lines["vertical_db"]
    holding = ("jump.lossy", "reciprocity.lossy", "jump_db_next", "full_wave", "point_source.3")
    for name in (*holding, "turned_db", "vertical_isotropic_db"):
        assert "yes" in lines[name]
