"""What antennas take of scattered power, by polarisation, bounce and material."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power, trace_power
from invertwin.channel.em.depolarisation import random_scattering_matrix, received_power_fraction
from invertwin.errors import InputError
from invertwin.scene import Dielectric, JonesTable, Object, Scene, linear_array, plate
from invertwin.scene.polarisation import Polarisation
from scenes import float64, link, thing

RIGHT, LEFT = "circular", (0.5**0.5, -(0.5**0.5) * 1j)
SLANT, ASIDE = (0.5**0.5, 0.5**0.5), (0.5**0.5, -(0.5**0.5))
WHOLE = Grid(-4.0, 1.0, 16)


def antennas(sent: Any, received: Any, *places: Any) -> Link:
    jones = [Polarisation.from_jones(value, 0.0, 1) for value in (sent, received)]
    found = link(*(places or (((0.0, 0.0, 0.0),),)))
    return replace(found, tx_jones=jones[0], rx_jones=jones[1])


@pytest.mark.parametrize(
    ("sent", "received", "once", "twice"),
    [
        ("V", "V", 1.0, 1.0),
        ("H", "V", 0.0, 0.0),
        (SLANT, SLANT, 1.0, 0.0),
        (SLANT, ASIDE, 0.0, 1.0),
        (RIGHT, RIGHT, 0.0, 1.0),
        (RIGHT, LEFT, 1.0, 0.0),
        (RIGHT, "V", 0.5, 0.5),
    ],
)
def test_a_mirror_turns_handedness_and_keeps_v_and_h(sent, received, once, twice):
    clean = torch.zeros(1, dtype=torch.float64)
    between = antennas(sent, received)
    assert float(received_power_fraction(between, [clean])) == pytest.approx(once, abs=1e-12)
    assert float(received_power_fraction(between, [clean] * 2)) == pytest.approx(twice, abs=1e-12)
    assert float(received_power_fraction(between, [clean] * 3)) == pytest.approx(once, abs=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_random_fields_have_the_power_that_is_stated(count):
    """For any pair of polarisations: the law of fields is the law of power."""
    shares = [torch.full((40_000,), chi, dtype=torch.float64) for chi in (0.05, 0.2, 0.1)][:count]
    phase = 6.28 * torch.rand(40_000, generator=torch.Generator().manual_seed(1)).double()
    fields = (
        random_scattering_matrix(shares, phase)
        * torch.polar(torch.ones_like(phase), phase)[:, None, None]
    )
    for sent, received in [("V", "V"), ("V", "H"), (SLANT, SLANT), (RIGHT, RIGHT), (RIGHT, LEFT),
                           ((0.6, 0.8j), SLANT)]:  # fmt: skip
        between = antennas(sent, received)
        seen = between.rx_jones.vectors[0] @ fields @ between.tx_jones.vectors[0]
        stated = float(received_power_fraction(between, shares)[0])
        assert float(seen.abs().square().mean()) == pytest.approx(stated, abs=0.015)
        assert float(seen.mean().abs()) < 0.03


def corner(chi: float = 0.0) -> Scene:
    """Two walls that light each other, and one that stands before them."""
    rough = Dielectric(5.0, 0.1, scattering=0.8, depolarisation=chi)
    return Scene(
        {
            "wall": thing(plate(0.8, 0.6), (1.9, 0.15, 0.0), (0.0, 0.0, 0.3), rough),
            "side": thing(plate(0.8, 0.6), (1.5, -0.5, 0.0), (0.0, 0.0, -1.1), Dielectric(3.0)),
            "front": thing(plate(0.25, 0.2), (1.6, -0.12, 0.02), (0.0, 0.0, -0.4), rough),
        }
    )


def total(scene: Scene, between: Link, depth: int = 2) -> Tensor:
    drawn = Sampling(depth=depth, samples=40_000, boundary_samples=40_000, contacts=False)
    return deposit_power(scene, between, WHOLE, sampling=drawn, seed=1).double().sum()


@pytest.mark.parametrize("pair", [("V", "V"), ("V", "H"), (SLANT, ASIDE), (RIGHT, RIGHT)])
@pytest.mark.parametrize("chi", [0.0, 0.15])
def test_kernels_and_rows_agree(pair, chi):
    between = antennas(*pair, ((0.0, 0.0, 0.0),), ((0.0, 0.05, 0.0),))
    drawn = Sampling(depth=2, samples=40_000, boundary=False)
    rows = float(trace_power(corner(chi), between, sampling=drawn, seed=1).power.sum())
    assert float(total(corner(chi), between)) == pytest.approx(rows, rel=1e-4, abs=1e-20)


def gradient(between: Link, depth: int = 2) -> Tensor:
    """Of all power, by the place of the wall in front, with its shadows."""
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    scene = corner()
    front = scene["front"]
    moved = Object(front.mesh, front.material, front.transform + torch.nn.functional.pad(
        shift[:, None], (3, 0, 0, 1)))  # fmt: skip
    value = total(scene.replace("front", pose=moved.transform), between, depth)
    return torch.autograd.grad(value, shift)[0]


def test_every_bounce_of_boundary_paths_counts():
    """Handedness tells odd from even numbers of bounces: their derivatives add up to all."""
    places = ((0.0, 0.0, 0.0),), ((0.0, 0.05, 0.0),)
    odd, even, both = (
        gradient(antennas(*pair, *places)) for pair in [(RIGHT, LEFT), (RIGHT, RIGHT), "VV"]
    )
    assert torch.allclose(odd + even, both, rtol=1e-3, atol=1e-3 * float(both.abs().max()))
    once = gradient(antennas("V", "V", *places), depth=1)
    assert float((odd - once).norm()) < 0.05 * float(once.norm())
    assert float((even - (both - once)).norm()) < 0.05 * float(once.norm())


def test_depolarisation_has_a_derivative():
    between = antennas("V", "H")

    def value(chi: Tensor) -> Tensor:
        rough = Dielectric(5.0, 0.1, scattering=0.8, depolarisation=chi)
        return total(corner().replace("wall", material=rough), between)

    chi = float64(0.1).requires_grad_()
    (found,) = torch.autograd.grad(value(chi), chi)
    with torch.no_grad():
        difference = (value(float64(0.11)) - value(float64(0.09))) / 0.02
    assert float(found) == pytest.approx(float(difference), rel=1e-3)


def test_power_refuses_polarisation_over_direction():
    vectors = torch.ones(2, 1, 2, dtype=torch.complex128)
    table = JonesTable(float64([0.0, 3.0]), float64([0.0]), vectors)
    with pytest.raises(InputError, match="one Jones vector in all directions"):
        total(corner(), antennas(table, "V"))


def test_power_takes_the_mean_element():
    """The peak of a beam is the mean over channels."""
    array = linear_array(2, 1e-3, polarisation="V", leakage=[0.0, 0.4])
    between = replace(antennas("V", "V"), rx_jones=array.jones)
    mean = float(array.jones.mean[0].real)
    whole = float(total(corner(), antennas("V", "V")))
    assert float(total(corner(), between)) == pytest.approx(mean**2 * whole, rel=1e-4)
