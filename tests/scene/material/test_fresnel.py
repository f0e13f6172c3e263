"""One interface: Fresnel coefficients of both polarisations against closed forms and limits."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch import Tensor

from invertwin.scene import (
    RefractingBody,
    RoughDielectric,
    complex_permittivity,
    fresnel_amplitude,
    fresnel_coefficients,
    fresnel_reflectance,
    fresnel_transmittance,
)
from invertwin.scene.material.fresnel import attenuation, refractive_index

FREQUENCY = 77e9
NODES = np.linspace(0, 1, 256)
ANGLES = torch.linspace(0, 1, 13, dtype=torch.float64)


def cosines(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_coefficients_equal_the_closed_forms_in_360_cases():
    materials = [(1.02, 0.0), (2.73, 0.05), (3.0, 2.0), (5.24, 0.3), (6.31, 1.2), (15.0, 10.0)]
    nodes = np.linspace(1, 255, 30).round().astype(int)
    cases, worst = 0, 0.0
    for (permittivity, conductivity), node in itertools.product(materials, nodes):
        epsilon = complex(complex_permittivity(permittivity, conductivity, FREQUENCY))
        c = float(NODES[node])
        # With the angle of refraction, as textbooks have it.
        sine = np.sqrt(1 - c**2) / np.sqrt(epsilon)
        index, inside = np.sqrt(epsilon), np.sqrt(1 - sine**2)
        expected = {
            "reflection_s": (c - index * inside) / (c + index * inside),
            "reflection_p": (index * c - inside) / (index * c + inside),
            "transmission_s": 2 * c / (c + index * inside),
            "transmission_p": 2 * c / (index * c + inside),
        }
        got = fresnel_coefficients(torch.tensor(epsilon), cosines(c))
        for name, value in expected.items():
            worst = max(worst, abs(complex(getattr(got, name)) - value))
        cases += 2  # both polarisations
        table = (
            RoughDielectric(permittivity, conductivity).scattering_law(FREQUENCY).amplitude[node]
        )
        mean = (abs(expected["reflection_s"]) ** 2 + abs(expected["reflection_p"]) ** 2) / 2
        worst = max(worst, abs(float(table) - math.sqrt(mean)))
    assert cases == 360
    assert worst < 2e-6


def test_magnetic_half_spaces_equal_the_closed_forms():
    """By impedances η = √(μ/ε) and the angle of refraction, as textbooks have it."""
    worst = 0.0
    for epsilon, mu in itertools.product((1.0, 4.0 - 1j, 9.0 - 0.2j), (0.8 - 0.1j, 1.0, 5.0 - 2j)):
        material = RoughDielectric(
            epsilon.real, loss_tangent=-epsilon.imag / epsilon.real,
            permeability=mu.real, magnetic_loss_tangent=-mu.imag / mu.real,
        )  # fmt: skip
        for node in (20, 120, 255):
            c = float(NODES[node])
            eta, index = np.sqrt(mu / epsilon + 0j), np.sqrt(mu * epsilon + 0j)
            inside = np.sqrt(1 - (1 - c**2) / index**2)
            expected = (
                (eta * c - inside) / (eta * c + inside),
                (c - eta * inside) / (c + eta * inside),
                2 * eta * c / (eta * c + inside),
                2 * eta * c / (c + eta * inside),
            )
            permittivity, permeability = (torch.tensor(complex(v)) for v in (epsilon, mu))
            got = fresnel_coefficients(permittivity, cosines(c), permeability)
            worst = max(worst, *(abs(complex(a) - b) for a, b in zip(got, expected, strict=True)))
            mean = (abs(expected[0]) ** 2 + abs(expected[1]) ** 2) / 2
            table = material.scattering_law(FREQUENCY).amplitude[node]
            worst = max(worst, abs(float(table) - math.sqrt(mean)))
    assert worst < 2e-6


def test_a_medium_of_equal_permittivity_and_permeability_reflects_nothing_at_normal_incidence():
    mu = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    law = RefractingBody(3.0, permeability=mu).scattering_law(FREQUENCY)
    assert law.amplitude[-1] == 0
    assert law.refraction[-1] == 1
    assert float(law.index.detach()) == pytest.approx(3.0)
    assert float(law.amplitude[100].detach()) > 0.01
    (slope,) = torch.autograd.grad(law.amplitude.sum(), mu)
    assert torch.isfinite(slope)


def test_power_into_a_half_space_is_what_it_does_not_reflect():
    # By Poynting's vector behind the interface, from the transmitted fields.
    epsilon, c = complex_permittivity(3.0, 2.0, FREQUENCY), ANGLES[1:]
    field = fresnel_coefficients(epsilon, c)
    root = torch.sqrt(epsilon - 1 + c**2)
    across = field.transmission_s.abs() ** 2 * root.real / c
    magnetic = field.transmission_p * torch.sqrt(epsilon)
    along = magnetic.abs() ** 2 * (root / epsilon).real / c
    expected = fresnel_transmittance(epsilon, c)
    assert torch.allclose((across + along) / 2, expected, atol=1e-12)


def test_a_conductor_reflects_with_opposite_signs():
    field = fresnel_coefficients(complex_permittivity(1.0, 1e12, FREQUENCY), cosines(0.6))
    assert complex(field.reflection_s) == pytest.approx(-1, abs=1e-4)
    assert complex(field.reflection_p) == pytest.approx(1, abs=1e-4)


def test_a_refracting_body_has_an_index_and_an_attenuation():
    surface = RefractingBody(4.0, 0.5).scattering_law(10e9)
    epsilon = complex(complex_permittivity(4.0, 0.5, 10e9))
    root = np.sqrt(epsilon)
    assert float(surface.index) == pytest.approx(root.real, rel=1e-14)
    wave_number = 2 * math.pi * 10e9 / 299_792_458
    # The field decays as exp(k Im√ε z); power as its square.
    assert float(surface.attenuation) == pytest.approx(-2 * wave_number * root.imag, rel=1e-14)
    assert torch.allclose(surface.refraction, 1 - surface.amplitude**2, atol=1e-15)
    assert (surface.transmittance == 0).all()


def test_refraction_is_the_same_both_ways():
    # Snell: out of the body at the refracted angle, as much as in.
    c = ANGLES[1:].numpy()
    index = 1.7
    inside = np.sqrt(1 - (1 - c**2) / index**2)
    s = (index * inside - c) / (index * inside + c)
    p = (inside - index * c) / (inside + index * c)
    outward = 1 - (s**2 + p**2) / 2
    inward = fresnel_transmittance(complex_permittivity(index**2, 0.0, FREQUENCY), ANGLES[1:])
    assert inward.numpy() == pytest.approx(outward, rel=1e-12)


def test_loss_tangent_and_conductivity_add():
    both = complex(complex_permittivity(3.0, 0.1, 10e9, 0.02))
    assert both.imag == pytest.approx(
        complex(complex_permittivity(3.0, 0.1, 10e9)).imag - 3.0 * 0.02, rel=1e-12
    )


def test_gradients_of_the_coefficients():
    def tables(permittivity, conductivity, loss_tangent):
        epsilon = complex_permittivity(permittivity, conductivity, FREQUENCY, loss_tangent)
        body = (refractive_index(epsilon), attenuation(epsilon, FREQUENCY))
        inside = fresnel_transmittance(epsilon, ANGLES[1:])
        return (*fresnel_coefficients(epsilon, ANGLES[1:]), inside, *body)

    inputs = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (3.0, 0.5, 0.02)]
    assert torch.autograd.gradcheck(tables, inputs)


def test_fresnel_at_normal_incidence():
    for epsilon in (1.0, 1.5, 4.0, 80.0):
        index = math.sqrt(epsilon)
        value = fresnel_reflectance(complex_permittivity(epsilon, 0.0, 1e9), cosines(1.0))
        assert float(value) == pytest.approx(((index - 1) / (index + 1)) ** 2, abs=1e-15)


@pytest.mark.parametrize("epsilon", [1.2, 4.0, 30.0])
def test_fresnel_at_the_brewster_angle(epsilon):
    cosine = 1 / math.sqrt(1 + epsilon)
    value = fresnel_reflectance(complex_permittivity(epsilon, 0.0, 1e9), cosines(cosine))
    assert float(value) == pytest.approx(((epsilon - 1) / (epsilon + 1)) ** 2 / 2)


def test_fresnel_against_the_textbook():
    cosine = np.linspace(0.01, 1, 50)
    for epsilon, sigma in ((2.0, 0.0), (5.24, 0.5), (1.001, 10.0), (3.0, 1e4)):
        eps = complex(complex_permittivity(epsilon, sigma, 10e9))
        root = np.sqrt(eps - (1 - cosine**2))
        perpendicular = (cosine - root) / (cosine + root)
        parallel = (eps * cosine - root) / (eps * cosine + root)
        expected = (abs(perpendicular) ** 2 + abs(parallel) ** 2) / 2
        got = fresnel_reflectance(
            torch.tensor(eps, dtype=torch.complex128), torch.from_numpy(cosine)
        )
        assert np.allclose(got.numpy(), expected, rtol=1e-10)


def test_fresnel_limits():
    concrete = complex_permittivity(5.24, 0.1, FREQUENCY)
    assert float(fresnel_reflectance(concrete, cosines(0.0))) == pytest.approx(1.0, abs=1e-7)
    # A conductor of growing conductivity becomes perfect at every angle but grazing.
    copper = complex_permittivity(1.0, 1e12, FREQUENCY)
    assert fresnel_amplitude(copper, ANGLES[1:]).min() > 0.999
    # Vacuum reflects nothing, and no angle gives NaN.
    assert (fresnel_amplitude(complex_permittivity(1.0, 0.0, FREQUENCY), ANGLES) == 0).all()


def test_complex_permittivity_has_a_negative_imaginary_part():
    # ITU-R P.2040: ε'' = 17.98 σ/f with f in GHz.
    value = complex(complex_permittivity(5.24, 0.1, 10e9))
    assert value.real == 5.24
    assert value.imag == pytest.approx(-17.98 * 0.1 / 10, rel=1e-3)
