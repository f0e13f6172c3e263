"""The materials: what they tell the ray kernel, its gradients, bad values."""

import math
from typing import Any

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import (
    Dielectric,
    Layer,
    Multilayer,
    PerfectConductor,
    RefractingBody,
    RoughConductor,
    RoughDielectric,
    Slab,
    complex_permittivity,
    lobe_exponent,
    lobe_integral,
)
from invertwin.scene.material.values import RANGES

FREQUENCY = 77e9


def test_surface_tables():
    surface = RoughDielectric(4.0, diffuse=0.25, lobe_width=0.3).scattering_law(FREQUENCY)
    assert surface.amplitude.shape == (256,)
    assert surface.amplitude.dtype == torch.float64
    assert float(surface.amplitude[-1]) == pytest.approx(1 / 3)
    assert float(surface.diffuse) == 0.25
    assert float(surface.lobes[0]) == pytest.approx(0.75 / float(lobe_integral(lobe_exponent(0.3))))
    mirror = PerfectConductor().scattering_law(FREQUENCY)
    assert (mirror.amplitude == 1).all()
    assert float(mirror.diffuse) == 0.0
    assert PerfectConductor.coherent
    assert not RoughDielectric.coherent


@pytest.mark.parametrize("values", [(3.0, 0.5, 0.4, 0.3), (1.01, 1e-3, 0.9, 1.0)])
def test_gradients_of_the_tables(values):
    def tables(permittivity, conductivity, diffuse, lobe_width):
        material = RoughDielectric(permittivity, conductivity, diffuse, lobe_width)
        surface = material.scattering_law(FREQUENCY)
        return surface.amplitude, surface.diffuse, surface.lobes, surface.exponents

    inputs = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in values]
    assert torch.autograd.gradcheck(tables, inputs)


def test_gradient_of_the_conductor_lobe():
    width = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda w: PerfectConductor(w).scattering_law(FREQUENCY).lobes, width
    )


def test_gradient_is_zero_in_vacuum():
    """The amplitude √R has a corner there, |ε − 1| at every angle: its mean slope is chosen."""
    permittivity = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    RoughDielectric(permittivity).scattering_law(FREQUENCY).amplitude.sum().backward()
    assert permittivity.grad is not None
    assert float(permittivity.grad) == 0.0


@pytest.mark.parametrize(
    ("make", "lets_through", "refracts"),
    [
        (PerfectConductor, False, False),
        (lambda: RoughConductor(scattering=0.3), False, False),
        (lambda: RoughDielectric(4.0), False, False),
        (lambda: Dielectric(4.0), False, False),
        (lambda: Slab(4.0, thickness=1e-3), True, False),
        (lambda: Multilayer([Layer(4.0, thickness=1e-3)]), True, False),
        (lambda: RefractingBody(4.0), False, True),
    ],
)
def test_each_material_fills_its_part_of_the_surface(make, lets_through, refracts):
    surface = make().scattering_law(FREQUENCY)
    assert all(value.dtype == torch.float64 for value in vars(surface).values())
    assert bool((surface.transmittance > 0).any()) == lets_through
    assert bool((surface.extra_length != 0).any()) == lets_through
    assert bool((surface.refraction > 0).any()) == refracts
    assert bool(surface.index != 1) == refracts
    assert not surface.attenuation


def test_effective_roughness_contains_the_simple_one():
    # A Lambertian share d is scattering with S² = d; a lobe of slopes m has the exponent 1/m².
    simple = RoughDielectric(4.0, 0.1, diffuse=0.36, lobe_width=0.3).scattering_law(FREQUENCY)
    slope = float(lobe_exponent(0.3)) ** -0.5
    effective = Dielectric(4.0, 0.1, scattering=0.6, rms_slope=slope).scattering_law(FREQUENCY)
    assert torch.equal(simple.amplitude, effective.amplitude)
    assert torch.allclose(simple.diffuse, effective.diffuse)
    assert torch.allclose(simple.lobes, effective.lobes)
    assert torch.allclose(simple.exponents[0], effective.exponents[0])


VALUES = {
    "permittivity": 3.0,
    "conductivity": 0.5,
    "loss_tangent": 0.02,
    "permeability": 1.5,
    "magnetic_loss_tangent": 0.03,
    "thickness": 1.3e-3,
    "diffuse": 0.4,
    "lobe_width": 0.3,
    "scattering": 0.5,
    "rms_slope": 0.2,
    "lambertian": 0.6,
    "directive": 0.7,
    "directive_exponent": 3.0,
    "backscatter_exponent": 5.0,
    "rms_height": 2e-4,
    "depolarisation": 0.1,
}


@pytest.mark.parametrize(
    "kind", [PerfectConductor, RoughConductor, RoughDielectric, Dielectric, RefractingBody, Slab]
)
def test_gradients_in_every_value(kind):
    # Of power, rms_height changes nothing.
    names = [n for n in VALUES if n in kind.__dataclass_fields__ and n != "rms_height"]

    def tables(*values):
        surface = kind(**dict(zip(names, values, strict=True))).scattering_law(FREQUENCY)
        # The node at grazing incidence has derivatives beyond any finite difference.
        return tuple(t[5:] if t.shape == (256,) else t for t in vars(surface).values())

    inputs = [torch.tensor(VALUES[n], dtype=torch.float64, requires_grad=True) for n in names]
    assert torch.autograd.gradcheck(tables, inputs, eps=1e-8, atol=1e-4, rtol=1e-4)


def test_every_value_has_a_range():
    assert set(VALUES) == set(RANGES)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RoughDielectric(0.9), r"relative permittivity in \[1, 1e\+15\], got 0.9"),
        (lambda: RoughDielectric(math.nan), "relative permittivity"),
        (lambda: RoughDielectric(torch.tensor(0.5)), "relative permittivity"),
        (lambda: RoughDielectric(torch.ones(2, 2)), r"shape \[any\], got shape \[2, 2\]"),
        (lambda: RoughDielectric(3.0, -0.1), "conductivity"),
        (lambda: RoughDielectric(3.0, math.inf), "conductivity"),
        (lambda: RoughDielectric(3.0, diffuse=1.1), r"diffuse fraction in \[0, 1\], got 1.1"),
        (lambda: RoughDielectric(3.0, lobe_width=0.0), "lobe width"),
        (lambda: PerfectConductor(lobe_width=10.0), "lobe width"),
        (lambda: PerfectConductor().scattering_law(0.0), "frequency"),
        (lambda: RoughDielectric(3.0).scattering_law(math.nan), "frequency"),
        (lambda: complex_permittivity(0.5, 0.0, 1e9), "relative permittivity"),
        (lambda: complex_permittivity(2.0, -1.0, 1e9), "conductivity"),
    ],
)
def test_unphysical_values_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_values_that_a_material_does_not_have_are_refused_by_name():
    kind: Any = RoughConductor
    for make in (lambda: kind("steel"), lambda: kind(scatering=0.3)):
        with pytest.raises(InputError, match=r"expected values of RoughConductor by name \(scatt"):
            make()
    with pytest.raises(InputError, match="got str"):
        RoughDielectric("concrete")
