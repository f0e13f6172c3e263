"""Several bounces between conductors in simulated fields: strength, delay, phase, reciprocity."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invertwin.channel import Link, Paths, Sampling, trace_field
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import Mesh, PerfectConductor, Scene, Slab, dihedral, plate, trihedral
from scenes import link, thing

METAL = PerfectConductor()
WAVELENGTH = SPEED_OF_LIGHT / 77e9
EDGE, DISTANCE = 0.05, 20.0


def paths_of(
    scene: Scene, antennas: Link, depth: int = 3, samples: int = 20_000, seed: int = 1
) -> Paths:
    sampling = Sampling(depth=depth, conductor_samples=samples, boundary_samples=0, boundary=False)
    return trace_field(scene, antennas, sampling=sampling, seed=seed)


def response(paths: Paths, antennas: Link, frequency: float = 77e9) -> Tensor:
    phase = -2 * math.pi * frequency * paths.delay
    field = paths.coefficient * torch.polar(torch.ones_like(phase), phase)
    total = torch.zeros(antennas.frame_count, dtype=torch.complex128)
    return total.index_add(0, paths.frame, field)


def section(mesh: Mesh, antennas: Link, **options) -> float:
    """σ [dBsm] at the origin, seen from 20 m."""
    found = response(
        paths_of(Scene({"a": thing(mesh, material=METAL)}), antennas, **options), antennas
    )
    power = float(found[0].abs().square())
    return 10 * math.log10(power * (4 * math.pi) ** 3 * DISTANCE**4 / WAVELENGTH**2)


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (dihedral(EDGE), 8 * math.pi * EDGE**4 / WAVELENGTH**2),
        (trihedral(EDGE), 4 * math.pi * EDGE**4 / 3 / WAVELENGTH**2),
    ],
    ids=["dihedral", "trihedral"],
)
@pytest.mark.parametrize("receiver", [None, ((-DISTANCE, 0.03, 0.0),)], ids=["one", "two"])
def test_corners_are_as_strong_as_they_are(mesh, expected, receiver):
    antennas = link(((-DISTANCE, 0.0, 0.0),), receiver, wavelength=WAVELENGTH)
    assert section(mesh, antennas) == pytest.approx(10 * math.log10(expected), abs=0.3)
    single = section(mesh, antennas, depth=1)
    assert single < 10 * math.log10(expected) - 20


def test_seeds_change_places_not_the_echo():
    antennas = link(((-DISTANCE, 0.0, 0.0),), wavelength=WAVELENGTH)
    scene = Scene({"a": thing(trihedral(EDGE), material=METAL)})
    first, again, other = (
        response(paths_of(scene, antennas, seed=seed), antennas) for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert abs(complex(other / first) - 1) < 0.01


def test_three_bounces_have_the_delay_of_the_apex():
    """The whole aperture of the corner is at one length: that of its apex and back."""
    antennas = link(((-2.0, 0.0, 0.0),), wavelength=WAVELENGTH)
    scene = Scene({"a": thing(trihedral(EDGE), material=METAL)})
    lengths = paths_of(scene, antennas).delay * SPEED_OF_LIGHT
    two = paths_of(scene, antennas, depth=2)
    three = lengths[len(two) :]
    assert len(three) > 1000
    assert float((three - 4.0).abs().max()) < 2e-3  # wave fronts are spheres at 2 m


def test_both_ways_are_equal():
    there = link(((-2.0, 0.1, 0.0),), ((-2.2, -0.2, 0.1),), wavelength=WAVELENGTH)
    back = replace(there, tx=there.rx, rx=there.tx)
    scene = Scene({"a": thing(trihedral(EDGE), material=METAL)})
    ways = [response(paths_of(scene, antennas), antennas) for antennas in (there, back)]
    assert torch.allclose(*ways, rtol=1e-6)


def test_an_image_of_the_antenna_is_as_far_as_the_path_is_long():
    """So that the length to every element follows from ``first``."""
    antennas = link(((-2.0, 0.0, 0.0),), wavelength=WAVELENGTH)
    moved = link(((-2.0, 0.004, 0.002),), wavelength=WAVELENGTH)
    scene = Scene({"a": thing(trihedral(EDGE), (0.0, 0.01, 0.0), material=METAL)})
    paths = paths_of(scene, antennas)
    lengths = (paths.first - moved.tx).norm(dim=1) + (paths.last - moved.rx).norm(dim=1)
    shifted = replace(paths, delay=lengths / SPEED_OF_LIGHT)
    exact = response(paths_of(scene, moved), moved)
    assert abs(complex(response(shifted, antennas) / exact) - 1) < 0.05


def test_a_sheet_before_a_corner_weakens_and_delays():
    antennas = link(((-2.0, 0.0, 0.0),), wavelength=WAVELENGTH)
    corner = {"a": thing(trihedral(EDGE), material=METAL)}
    board = thing(plate(0.5, 0.5), (-1.0, 0, 0), material=Slab(2.7, 0.05, thickness=0.01))
    bare = paths_of(Scene(corner), antennas)
    behind = paths_of(Scene({**corner, "board": board}), antennas)
    coherent = behind.select((behind.last[:, 0] > -0.1) & (behind.first[:, 0] > -0.1))
    strength = float(response(coherent, antennas).abs() / response(bare, antennas).abs())
    assert 0.1 < strength < 0.9
    assert float(coherent.delay.mean() - bare.delay.mean()) * SPEED_OF_LIGHT > 0.005


def test_nothing_is_mirrored_twice_by_one_plate():
    antennas = link(((-2.0, 0.0, 0.0),), wavelength=WAVELENGTH)
    scene = Scene({"a": thing(plate(0.1, 0.1), material=METAL)})
    assert len(paths_of(scene, antennas, depth=3)) == len(paths_of(scene, antennas, depth=1))


def test_derivatives_of_mirrored_paths_are_refused():
    antennas = link(((-2.0, 0.0, 0.0),), wavelength=WAVELENGTH)
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    corner = trihedral(EDGE)
    moved = Scene({"a": thing(Mesh(corner.vertices + shift, corner.faces), material=METAL)})
    with pytest.raises(InputError, match="depth 1 for derivatives of fields between conductors"):
        paths_of(moved, antennas)
    assert paths_of(moved, antennas, depth=1).coefficient.requires_grad


def test_places_far_from_the_antennas_do_not_meet_themselves():
    near, far = (
        response(
            paths_of(Scene({"a": thing(dihedral(0.3), material=METAL)}), antennas), antennas, 1e9
        )
        * float(antennas.tx[0].norm()) ** 2
        for antennas in (
            link(((-distance, 0.0, 0.0),), wavelength=SPEED_OF_LIGHT / 1e9)
            for distance in (20.0, 400.0)
        )
    )
    assert float(far.abs() / near.abs()) == pytest.approx(1, abs=0.02)
