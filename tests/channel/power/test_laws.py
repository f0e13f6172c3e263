"""What holds for any right answer: reciprocity, energy, spreading, sheets and refraction."""

import math

import pytest
import torch
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power, trace_power
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import (
    Dielectric,
    Material,
    PerfectConductor,
    RefractingBody,
    RoughConductor,
    RoughDielectric,
    Scene,
    Slab,
    box,
    plate,
    sphere,
)
from scenes import WAVELENGTH, link, thing

# Many bins: one alone, in single precision, would lose the small paths among the large ones.
BINS = Grid(-0.1, 0.1, 160, u_start=-1.1, u_step=0.1, u_count=23)
WHITE = RoughConductor(scattering=1.0)
FREQUENCY = SPEED_OF_LIGHT / WAVELENGTH


def orders(scene: Scene, antennas: Link, depth: int, samples: int, seeds: int) -> Tensor:
    """Power of exactly 1 … depth points, one row a seed."""
    rows = []
    for seed in range(seeds):
        totals = [
            deposit_power(
                scene,
                antennas,
                BINS,
                sampling=Sampling(depth=d, samples=samples, boundary_samples=0),
                seed=seed,
            )
            .double()
            .sum()
            for d in range(1, depth + 1)
        ]
        rows.append(torch.stack(totals).diff(prepend=torch.zeros(1, dtype=torch.float64)))
    return torch.stack(rows)


MATERIALS: dict[str, Material] = {
    "diffuse": RoughDielectric(4.0),
    "glossy": RoughDielectric(4.0, 0.0, 0.3, 0.5),
    "lobes": Dielectric(4.0, 0.1, scattering=0.8, lambertian=0.3, directive=0.5, rms_slope=0.2),
    "sheet": Slab(2.7, 0.05, thickness=0.01, scattering=0.5, rms_slope=0.3),
    "body": RefractingBody(2.5, 0.02, scattering=0.5, rms_slope=0.3),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n == "sheet" else pytest.mark.slow) for n in MATERIALS]
)
def test_power_of_three_bounces_is_reciprocal(name):
    """Order by order within four standard errors; each error is below 6 %."""
    mesh = box((0.15, 0.5, 0.5)) if name == "body" else plate(0.5, 0.4)
    scene = Scene(
        {
            "wall": thing(plate(1.4, 1.2), (1.8, 0.0, 0.1), (0.0, 0.0, 0.15), MATERIALS["glossy"]),
            "floor": thing(plate(1.2, 1.2), (1.0, 0.0, -0.7), (0.0, 1.5, 0.0)),
            "front": thing(mesh, (1.0, 0.1, 0.0), (0.0, 0.1, 0.3), MATERIALS[name]),
        }
    )
    there, back = ((0.0, -0.3, 0.1),), ((0.1, 0.35, -0.1),)
    first, second = (
        orders(scene, link(tx, rx), 3, 200_000, 6) for tx, rx in ((there, back), (back, there))
    )
    error = (first.var(0) + second.var(0)).div(6).sqrt()
    mean = 0.5 * (first + second).mean(0)
    assert (error < 0.06 * mean).all()
    assert ((first - second).mean(0).abs() < 4 * error).all()


@pytest.mark.parametrize(
    ("tx", "rx"),
    [((0.0, 0.0, 0.0), None), ((0.1, 0.5, -0.2), (0.2, -0.3, 0.4))],
    ids=["at the centre", "anywhere"],
)
def test_a_white_sphere_conserves_power(tx, rx):
    """P_n = λ²/(4π²r²) for every order n.

    A white Lambertian sphere is lit evenly by what it scatters: E = Pt/(4πr²) for every order
    (for the first, from the centre only). An isotropic antenna anywhere inside takes in
    ∫ E/π · λ²/(4π) dω = λ²E/π. The mesh itself, inside the sphere, adds 0.1 %.
    """
    radius = 2.0
    room = Scene({"room": thing(sphere(radius, subdivisions=4), material=WHITE)})
    antennas = link((tx,), None if rx is None else (rx,))
    truth = WAVELENGTH**2 / (4 * math.pi**2 * radius**2)
    found = orders(room, antennas, 5, 100_000, 3) / truth
    if rx is not None:
        found = found[:, 1:]  # the first order is even from the centre only
    assert (found.std(0) / 3**0.5 < 3e-3).all()
    assert (found.mean(0) - 1.001).abs().max() < 8e-3


@pytest.mark.claim
@pytest.mark.slow
def test_two_bounces_fall_with_the_square_of_each_leg():
    """Small plates that face each other at 45°: P = (λ/4π)² (A/2π)² / (r₁ r₁₂ r₂)²."""
    size = 0.02

    def power(first: float, between: float, last: float) -> float:
        tilt = math.pi / 4
        scene = Scene(
            {
                "a": thing(plate(size, size), (0.0, 0.0, 0.0), (0.0, 0.0, tilt), WHITE),
                "b": thing(plate(size, size), (0.0, -between, 0.0), (0.0, 0.0, -tilt), WHITE),
            }
        )
        antennas = link(((-first, 0.0, 0.0),), ((-last, -between, 0.0),))
        paths = trace_power(
            scene,
            antennas,
            sampling=Sampling(depth=2, samples=1_000_000, boundary_samples=0, boundary=False),
            seed=0,
        )
        a_then_b = (paths.first[:, 1].abs() < size) & ((paths.last[:, 1] + between).abs() < size)
        return float(paths.power[a_then_b].sum())

    one = (WAVELENGTH / (4 * math.pi)) ** 2 * (size**2 / (2 * math.pi)) ** 2
    for legs in ((1.0, 1.0, 1.0), (2.0, 1.0, 1.0), (1.0, 2.0, 1.0), (1.0, 1.0, 2.0)):
        found = power(*legs) * math.prod(legs) ** 2 / one
        assert found == pytest.approx(1, abs=0.03), legs


@pytest.mark.parametrize("slope", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("bounces", [1, 2])
def test_a_plate_of_gentle_slopes_is_a_mirror(slope, bounces):
    """P = (λ/4πL)² with L the length by way of the mirrors, down to the narrowest lobe.

    A lobe at 45° reflects its share at normal incidence times the cosine.
    """
    metal = RoughConductor(rms_slope=slope, scattering=0.0)
    first = thing(plate(24 * slope, 24 * slope), (2.0, 0.0, 0.0), material=metal)
    scene, antennas = Scene({"a": first}), link(((0.0, -0.1, 0.0),), ((0.0, 0.1, 0.0),))
    length, share = 2 * math.hypot(2.0, 0.1), 1.0
    if bounces == 2:  # a roof: to the side, and back beside the transmitter
        small, tilt = plate(24 * slope, 24 * slope), math.pi / 4
        turned = thing(small, (2.0, 0.0, 0.0), (0.0, 0.0, tilt), metal)
        wide = thing(plate(120 * slope, 120 * slope), (2.0, -1.0, 0.0), (0.0, 0.0, -tilt), metal)
        scene, antennas = Scene({"a": turned, "b": wide}), link(((0.0,) * 3,), ((0.0, -1.0, 0.0),))
        length, share = 5.0, 0.5
    found = deposit_power(
        scene,
        antennas,
        BINS,
        sampling=Sampling(depth=bounces, samples=4_000_000, boundary_samples=0),
        seed=1,
    )
    mirrored = share * (WAVELENGTH / (4 * math.pi * length)) ** 2
    assert float(found.double().sum()) == pytest.approx(mirrored, rel=0.03)


@pytest.mark.parametrize("name", ["rms_slope", "lobe_width"])
def test_lobes_narrower_than_the_kernel_resolves_are_refused(name):
    kind = RoughConductor if name == "rms_slope" else PerfectConductor
    with pytest.raises(InputError, match=r"expected .* in \[0.0"):
        kind(**{name: 9e-5})
