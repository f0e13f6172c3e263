"""Polarised fields between antennas: reciprocity, corners, handedness, elements, rough speckle."""

import cmath
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from invertwin.channel import Link, Paths, Sampling, trace_field
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene import (
    Dielectric,
    JonesTable,
    Material,
    Mesh,
    PerfectConductor,
    Scene,
    dihedral,
    linear_array,
    plate,
    trihedral,
)
from invertwin.scene.polarisation import Polarisation
from invertwin.signatures import rcs
from scenes import float64, link, thing

METAL = PerfectConductor()
WAVELENGTH = SPEED_OF_LIGHT / 77e9
EDGE, DISTANCE = 0.05, 20.0
LEFT = (0.5**0.5, -(0.5**0.5) * 1j)


def antennas(sent: Any, received: Any, *places: Any, leakage: float = 0.0) -> Link:
    """Antennas of two polarisations, 20 m before the origin unless said otherwise."""
    where = places or (((-DISTANCE, 0.0, 0.0),),)
    jones = [Polarisation.from_jones(value, leakage, 1) for value in (sent, received)]
    found = link(*where, wavelength=WAVELENGTH)
    return replace(found, tx_jones=jones[0], rx_jones=jones[1])


def response(mesh: Mesh, between: Link, turn: float = 0.0, depth: int = 2) -> complex:
    """The field of a metal object that is rolled about the line of sight."""
    scene = Scene({"a": thing(mesh, turn=(turn, 0.0, 0.0), material=METAL)})
    paths = traced(scene, between, depth=depth)
    return complex(summed(paths))


def traced(scene: Scene, between: Link, depth: int = 2, samples: int = 20_000) -> Paths:
    sampling = Sampling(
        depth=depth, conductor_samples=samples, boundary_samples=0, boundary=False, rough_paths=4000
    )
    return trace_field(scene, between, sampling=sampling, seed=1)


def summed(paths: Paths) -> Tensor:
    phase = -2 * math.pi * 77e9 * paths.delay
    return (paths.coefficient * torch.polar(torch.ones_like(phase), phase)).sum()


def decibels(field: complex, truth: float) -> float:
    """Over the radar cross-section ``truth`` [m²], both at 20 m."""
    section = abs(field) ** 2 * (4 * math.pi) ** 3 * DISTANCE**4 / WAVELENGTH**2
    return 10 * math.log10(section / truth)


CORNER = 8 * math.pi * EDGE**4 / WAVELENGTH**2


def test_a_dihedral_rolled_by_45_degrees_returns_all_power_cross_polar():
    roll = math.pi / 4
    co, cross = (response(dihedral(EDGE), antennas("V", r), roll) for r in "VH")
    assert decibels(cross, CORNER) == pytest.approx(0.0, abs=0.1)
    assert decibels(co, CORNER) < -30
    upright = [response(dihedral(EDGE), antennas("V", r)) for r in "VH"]
    assert decibels(upright[0], CORNER) == pytest.approx(0.0, abs=0.1)
    assert decibels(upright[1], CORNER) < -60


def test_a_dihedral_turns_the_sign_between_v_and_h():
    along, across = (response(dihedral(EDGE), antennas(p, p)) for p in "VH")
    assert abs(along + across) < 0.03 * abs(along)
    corner = [response(trihedral(EDGE), antennas(p, p), depth=3) for p in "VH"]
    assert abs(corner[0] - corner[1]) < 0.03 * abs(corner[0])


@pytest.mark.parametrize(
    ("mesh", "depth"), [(plate(0.05, 0.03), 1), (dihedral(EDGE), 2), (trihedral(EDGE), 3)]
)
def test_fields_are_those_of_the_signature(mesh, depth):
    """Sign and phase of all four polarisations; near fields of 20 m bend the phase by 0.05."""
    scene = Scene({"a": thing(mesh, turn=(0.3, 0.0, 0.1), material=METAL)})
    truth = rcs(scene, [[-1.0, 0.0, 0.0]], [77e9], edges=0, depth=depth, up=[0.0, 0.0, 1.0]).matrix[
        0, 0
    ]
    found = torch.tensor(
        [[complex(summed(traced(scene, antennas(t, r), depth))) for t in "VH"] for r in "VH"],
        dtype=torch.complex128,
    )
    turned = cmath.exp(4j * math.pi * DISTANCE / WAVELENGTH)
    found = found * 4 * math.pi / WAVELENGTH * DISTANCE**2 * turned
    assert float((found - truth).norm()) < 0.06 * float(truth.norm())


def test_handedness():
    """A plate turns it, a dihedral turns it twice."""
    flat = [response(plate(0.1, 0.1), antennas("circular", r)) for r in ("circular", LEFT)]
    assert abs(flat[0]) < 1e-9 * abs(flat[1])
    double = [response(dihedral(EDGE), antennas("circular", r), 0.3) for r in ("circular", LEFT)]
    assert decibels(double[0], CORNER) == pytest.approx(0.0, abs=0.1)
    assert decibels(double[1], CORNER) < -30


@pytest.mark.parametrize("pair", ["VV", "HH", "VH"])
@pytest.mark.parametrize(
    "places",
    [
        (((-2.0, 0.1, 0.3),), ((-2.2, -0.2, 0.1),)),
        (((-2.0, 0.1, 0.3),),),
    ],
    ids=["apart", "one place"],
)
def test_both_ways_are_equal(pair, places):
    there = antennas(*pair, *places)
    back = replace(
        there, tx=there.rx, rx=there.tx, tx_jones=there.rx_jones, rx_jones=there.tx_jones
    )
    turned = thing(trihedral(EDGE), turn=(0.4, 0.1, 0.2), material=METAL)
    # Few rays, of which none grazes an edge: there rounding decides who sees what.
    ways = [
        complex(summed(traced(Scene({"a": turned}), way, depth=3, samples=2000)))
        for way in (there, back)
    ]
    assert ways[0] == pytest.approx(ways[1], rel=1e-6)
    assert abs(ways[0]) > 0


def test_polarisation_does_not_matter_where_nothing_turns_it():
    """A plate square to antennas of one place: V, H and any linear one alike."""
    scene = Scene({"a": thing(plate(0.2, 0.1), (0, 0.05, 0.02), material=METAL)})
    fields = [summed(traced(scene, antennas(p, p))) for p in ("V", "H", (0.6, 0.8))]
    assert float((fields[0] - fields[1]).abs()) < 1e-12 * float(fields[0].abs())
    assert float((fields[0] - fields[2]).abs()) < 1e-12 * float(fields[0].abs())


def test_a_table_of_one_vector_is_that_vector():
    table = JonesTable(
        float64([0.0, 1.0, 3.0]),
        float64([0.0]),
        torch.tensor([0.6, 0.8j], dtype=torch.complex128).expand(3, 1, 2),
    )
    scene = Scene(
        {
            "metal": thing(dihedral(EDGE), turn=(0.5, 0.1, 0.0), material=METAL),
            "rough": thing(plate(0.05, 0.05), (0, 0.1, 0), material=Dielectric(4.0)),
        }
    )
    places = ((-2.0, 0.1, 0.3),), ((-2.2, -0.2, 0.1),)
    found = [traced(scene, antennas(j, j, *places)) for j in (table, (0.6, 0.8j))]
    assert torch.allclose(found[0].coefficient, found[1].coefficient, rtol=1e-9, atol=1e-20)
    assert len(found[0]) > 100


def test_a_table_follows_the_direction():
    """V at boresight, H beyond 0.2 rad."""
    vectors = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]])[:, None]
    table = JonesTable(float64([0.0, 0.1, 0.2, 3.0]), float64([0.0]), vectors.to(torch.complex128))
    for aside, kept in ((0.0, "V"), (0.5, "H")):
        direction = math.atan(aside)
        scene = Scene(
            {"a": thing(plate(0.02, 0.02), (0, aside * DISTANCE, 0), (0, 0, direction), METAL)}
        )
        strength = {p: abs(complex(summed(traced(scene, antennas(table, p))))) for p in "VH"}
        assert strength["V" if kept == "H" else "H"] < 1e-6 * strength[kept]


def test_elements_that_leak_are_mixtures():
    """Every channel is what a radar of those two elements alone would hear."""
    scene = Scene(
        {
            "metal": thing(dihedral(EDGE), turn=(0.4, 0.0, 0.0), material=METAL),
            "rough": thing(
                plate(0.05, 0.05), (0, 0.1, 0), material=Dielectric(4.0, depolarisation=0.2)
            ),
        }
    )
    leak = [0.0, 0.3, -0.2]
    array = linear_array(3, 1e-3, polarisation="V", leakage=leak)
    both = replace(antennas("V", "V"), tx_jones=array.jones, rx_jones=array.jones)
    paths = traced(scene, both)
    assert paths.matrix is not None
    sent, received = array.jones.mixtures[1], array.jones.mixtures[2]
    channel = torch.einsum("r,prt,t->p", received, paths.matrix, sent)
    alone = replace(
        both,
        tx_jones=Polarisation.from_jones("V", leak[1], 1),
        rx_jones=Polarisation.from_jones("V", leak[2], 1),
    )
    single = traced(scene, alone)
    assert single.matrix is None
    total = torch.view_as_real(summed(replace(paths, coefficient=channel)))
    assert torch.allclose(total, torch.view_as_real(summed(single)), rtol=1e-9)
    mean = torch.einsum("r,prt,t->p", array.jones.mean, paths.matrix, array.jones.mean)
    assert torch.allclose(mean, paths.coefficient)


def powers(material: Material, sent: Any, received: Any) -> float:
    """Sum of |a|² of one-bounce rough paths."""
    scene = Scene({"a": thing(plate(0.3, 0.3), material=material)})
    return float(traced(scene, antennas(sent, received), 1).coefficient.abs().square().sum())


@pytest.mark.parametrize("share", [0.0, 0.1, 0.25])
def test_rough_surfaces_depolarise_as_stated(share):
    """Any linear polarisation loses χ, a circular one 2χ; a slanted one is as good as V."""
    material = Dielectric(4.0, scattering=1.0, depolarisation=share)
    whole = powers(Dielectric(4.0, scattering=1.0), "V", "V")
    slant, other = (0.5**0.5, 0.5**0.5), (0.5**0.5, -(0.5**0.5))
    expected = {
        ("V", "V"): 1 - share,
        ("V", "H"): share,
        (slant, slant): 1 - share,
        (slant, other): share,
        ("circular", LEFT): 1 - 2 * share,
        ("circular", "circular"): 2 * share,
    }
    for (sent, received), value in expected.items():
        found = powers(material, sent, received) / whole
        assert found == pytest.approx(value, abs=0.02), (sent, received)


def test_depolarised_speckle_is_the_same_both_ways():
    material = Dielectric(4.0, scattering=1.0, depolarisation=0.2)
    scene = Scene({"a": thing(plate(0.3, 0.3), material=material)})
    there, back = (summed(traced(scene, antennas(*pair), 1)) for pair in ("VH", "HV"))
    assert complex(there) == pytest.approx(complex(back), rel=1e-9)
    assert abs(there) > 0
