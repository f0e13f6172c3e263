"""The table of ITU-R P.2040: published numbers, names, ranges."""

import warnings

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import (
    ITU_MATERIALS,
    Dielectric,
    Itu,
    OutsideTableWarning,
    RefractingBody,
    RoughDielectric,
    Slab,
)
from invertwin.scene.material import itu


@pytest.fixture(autouse=True)
def _not_warned_yet(monkeypatch):
    monkeypatch.setattr(itu, "_warned", set())


# ε' and σ [S/m] by another implementation of the recommendation.
@pytest.mark.parametrize(
    ("name", "ghz", "permittivity", "conductivity"),
    [
        ("vacuum", 10, 1, 0),
        ("concrete", 1, 5.24, 0.0462),
        ("concrete", 10, 5.24, 0.27979631),
        ("concrete", 77, 5.24, 1.3811951),
        ("brick", 40, 3.91, 0.042944402),
        ("plasterboard", 60, 2.73, 0.39809986),
        ("wood", 10, 1.99, 0.055449529),
        ("glass", 10, 6.31, 0.078650683),
        ("glass", 300, 5.79, 5.1183152),
        ("ceiling_board", 10, 1.48, 0.013073525),
        ("ceiling_board", 300, 1.52, 1.0264925),
        ("chipboard", 10, 2.58, 0.13075543),
        ("plywood", 10, 2.71, 0.33),
        ("marble", 10, 7.074, 0.046404777),
        ("floorboard", 60, 3.66, 1.1133305),
        ("metal", 10, 1, 10000000),
        ("very_dry_ground", 10, 3, 0.049669668),
        ("medium_dry_ground", 10, 11.914924, 1.4930283),
        ("wet_ground", 10, 11.943215, 2.9928935),
    ],
)
def test_published_values(name, ghz, permittivity, conductivity):
    entry = Itu(name)
    assert entry.permittivity(ghz * 1e9) == pytest.approx(permittivity, rel=1e-7)
    assert entry.conductivity(ghz * 1e9) == pytest.approx(conductivity, rel=1e-7)


def test_every_material_of_the_table_is_checked():
    marks = getattr(test_published_values, "pytestmark")  # noqa: B009
    assert {case[0] for case in marks[0].args[1]} == set(ITU_MATERIALS)


@pytest.mark.parametrize(
    "make",
    [
        RoughDielectric.itu,
        Dielectric.itu,
        RefractingBody.itu,
        lambda name: Slab.itu(name, thickness=0.01),
    ],
)
def test_materials_follow_the_frequency_of_the_radar(make):
    material, fixed = make("wood"), RoughDielectric
    for frequency in (10e9, 77e9):
        entry = Itu("wood")
        values = entry.permittivity(frequency), entry.conductivity(frequency)
        expected = fixed(*values).complex_permittivity(frequency)
        assert torch.equal(material.complex_permittivity(frequency), expected)
    assert not torch.equal(
        material.scattering_law(10e9).amplitude, material.scattering_law(77e9).amplitude
    )


def test_other_values_beside_the_table():
    material = Dielectric.itu("concrete", scattering=0.5)
    assert material.scattering == 0.5
    measured = RoughDielectric(5.0, conductivity=Itu("concrete"))
    assert complex(measured.complex_permittivity(10e9)).real == 5.0


def test_outside_the_table_warns_once():
    material = RoughDielectric.itu("brick")
    with pytest.warns(OutsideTableWarning, match="brick from 1 to 40 GHz, got 77 GHz") as caught:
        first = material.scattering_law(77e9)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = material.scattering_law(77e9)
        RoughDielectric.itu("brick").scattering_law(79e9)
    assert torch.equal(first.amplitude, again.amplitude)
    # The nearer of two ranges serves between them.
    with pytest.warns(OutsideTableWarning, match="0.1 to 100 and 220 to 450 GHz"):
        assert Itu("glass").permittivity(200e9) == 5.79


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("concret", "did you mean concrete"),
        ("plaster board", "did you mean plasterboard"),
        ("Glass", "did you mean glass"),
        ("dry_ground", "very_dry_ground"),
        ("unobtainium", "use vacuum, concrete, brick"),
    ],
)
def test_unknown_names_come_with_the_nearest(name, hint):
    with pytest.raises(InputError, match=hint):
        RoughDielectric.itu(name)


def test_frequencies_must_be_positive():
    with pytest.raises(InputError, match="frequency"):
        Itu("wood").permittivity(0.0)
