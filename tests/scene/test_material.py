"""Materials: Fresnel closed forms, energy, reciprocity, gradients."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene import (
    PerfectConductor,
    RoughDielectric,
    Surface,
    complex_permittivity,
    fresnel_amplitude,
    fresnel_reflectance,
)
from invertwin.scene.material import lobe_exponent, lobe_integral

FREQUENCY = 77e9


def cosines(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def amplitude_at(surface: Surface, cosine: Tensor) -> Tensor:
    """The tabulated amplitude, linear between nodes and 0 below the horizon."""
    table = surface.amplitude.detach().numpy()
    nodes = np.linspace(0, 1, len(table))
    value = torch.from_numpy(np.interp(cosine.numpy(), nodes, table))
    return torch.where(cosine > 0, value, 0.0)


def reflectance_distribution(surface: Surface, incoming: Tensor, outgoing: Tensor) -> Tensor:
    """f_r of the module text, for a surface with normal z."""
    cos_in, cos_out = incoming[..., 2], outgoing[..., 2]
    cos_psi = 2 * cos_in * cos_out - (incoming * outgoing).sum(-1)
    lobe = surface.lobe * ((1 + cos_psi).clamp(min=0) / 2) ** surface.exponent
    amplitude = amplitude_at(surface, cos_in) * amplitude_at(surface, cos_out)
    return amplitude * (surface.diffuse / math.pi + lobe)


def albedo(surface: Surface, cos_in: Tensor) -> Tensor:
    """Reflected over incident power: ∫ f_r cosθo dω by quadrature, [angle].

    The lobe is integrated over directions around its own axis, with t = ((1+cosψ)/2)^(p+1) as the
    variable, in which it is constant however narrow it is.
    """
    # Midpoints: the cut at the horizon spoils any higher order.
    t = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000
    chi = 2 * math.pi * (torch.arange(128, dtype=torch.float64) + 0.5) / 128
    cos_psi = (2 * t ** (1 / (surface.exponent + 1)) - 1)[None, :, None]
    sin_psi = (1 - cos_psi**2).clamp(min=0).sqrt()
    sin_in = (1 - cos_in**2).clamp(min=0).sqrt()[:, None, None]
    cos_out = cos_in[:, None, None] * cos_psi + sin_in * sin_psi * torch.cos(chi)
    received = amplitude_at(surface, cos_out) * cos_out
    lobe = surface.lobe * 4 * math.pi / (surface.exponent + 1) * received.mean((1, 2))
    diffuse = surface.diffuse * 2 * (amplitude_at(surface, t) * t).mean()
    return amplitude_at(surface, cos_in) * (diffuse + lobe)


ANGLES = torch.linspace(0, 1, 13, dtype=torch.float64)


def test_energy_never_exceeds_what_came_in():
    generator = np.random.default_rng(0)
    widths = np.radians([0.5, 2.0, 5.0, 20.0, 60.0, 120.0, 180.0])
    worst = 0.0
    for width in widths:
        for diffuse in (0.0, 0.5, 1.0):
            material = RoughDielectric(
                permittivity=float(1 + 10 ** generator.uniform(-3, 3)),
                conductivity=float(10 ** generator.uniform(-3, 8)),
                diffuse=diffuse,
                lobe_width=float(width),
            )
            worst = max(worst, float(albedo(material.surface(FREQUENCY), ANGLES).max()))
        worst = max(worst, float(albedo(PerfectConductor(float(width)).surface(1e9), ANGLES).max()))
    assert 0.9 < worst <= 1 + 2e-5


@pytest.mark.parametrize("width", [0.5, 5.0, 60.0, 180.0])
def test_conductor_returns_everything_at_normal_incidence(width):
    surface = PerfectConductor(math.radians(width)).surface(FREQUENCY)
    assert float(albedo(surface, cosines(1.0))) == pytest.approx(1.0, abs=2e-5)


@pytest.mark.parametrize("diffuse", [0.0, 0.3, 1.0])
def test_dielectric_returns_about_its_fresnel_reflectance(diffuse):
    # Far from grazing the amplitude hardly depends on the angle, and a narrow lobe stays in it.
    material = RoughDielectric(4.0, diffuse=diffuse, lobe_width=0.02)
    expected = fresnel_reflectance(complex_permittivity(4.0, 0.0, FREQUENCY), cosines(1.0))
    # The diffuse part reaches grazing angles, where reflection is stronger.
    tolerance = 0.02 + 0.25 * diffuse
    assert float(albedo(material.surface(FREQUENCY), cosines(1.0))) == pytest.approx(
        float(expected), rel=tolerance
    )


def test_reciprocity():
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(2, 500, 3, generator=generator, dtype=torch.float64)
    directions[..., 2] = directions[..., 2].abs()
    a, b = torch.nn.functional.normalize(directions, dim=-1)
    for material in (RoughDielectric(3.0, 0.5, diffuse=0.4), PerfectConductor()):
        surface = material.surface(FREQUENCY)
        forward = reflectance_distribution(surface, a, b)
        assert torch.allclose(forward, reflectance_distribution(surface, b, a), rtol=1e-10)
        assert (forward >= 0).all()


@pytest.mark.parametrize("width", [1e-4, 0.01, 0.3, 1.0, math.pi])
def test_lobe_has_the_stated_width_and_integral(width):
    exponent = lobe_exponent(width)
    assert float(((1 + math.cos(width / 2)) / 2) ** exponent) == pytest.approx(0.5, rel=1e-6)
    x = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000
    # The variable t = x^(p+1) as in `albedo`, with cosθ = 2x − 1 and dω = 2π dcosθ.
    cosine = (2 * x ** (1 / (exponent + 1)) - 1).clamp(min=0)
    quadrature = 4 * math.pi / (exponent + 1) * cosine.mean()
    assert float(lobe_integral(exponent)) == pytest.approx(float(quadrature), rel=1e-6)


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


def test_surface_tables():
    surface = RoughDielectric(4.0, diffuse=0.25, lobe_width=0.3).surface(FREQUENCY)
    assert surface.amplitude.shape == (256,)
    assert surface.amplitude.dtype == torch.float64
    assert float(surface.amplitude[-1]) == pytest.approx(1 / 3)
    assert float(surface.diffuse) == 0.25
    assert float(surface.lobe) == pytest.approx(0.75 / float(lobe_integral(lobe_exponent(0.3))))
    mirror = PerfectConductor().surface(FREQUENCY)
    assert (mirror.amplitude == 1).all()
    assert float(mirror.diffuse) == 0.0
    assert PerfectConductor.coherent
    assert not RoughDielectric.coherent


@pytest.mark.parametrize("values", [(3.0, 0.5, 0.4, 0.3), (1.01, 1e-3, 0.9, 1.0)])
def test_gradients_of_the_tables(values):
    def tables(permittivity, conductivity, diffuse, lobe_width):
        material = RoughDielectric(permittivity, conductivity, diffuse, lobe_width)
        surface = material.surface(FREQUENCY)
        return surface.amplitude, surface.diffuse, surface.lobe, surface.exponent

    inputs = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in values]
    assert torch.autograd.gradcheck(tables, inputs)


def test_gradient_of_the_conductor_lobe():
    width = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: PerfectConductor(w).surface(FREQUENCY).lobe, width)


def test_gradient_is_finite_in_vacuum():
    permittivity = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    RoughDielectric(permittivity).surface(FREQUENCY).amplitude.sum().backward()
    assert permittivity.grad is not None
    assert torch.isfinite(permittivity.grad)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RoughDielectric(0.9), r"relative permittivity in \[1, inf\), got 0.9"),
        (lambda: RoughDielectric(math.nan), "relative permittivity"),
        (lambda: RoughDielectric(torch.tensor(0.5)), "relative permittivity"),
        (lambda: RoughDielectric(torch.ones(2, 2)), r"shape \[any\], got shape \[2, 2\]"),
        (lambda: RoughDielectric(3.0, -0.1), "conductivity"),
        (lambda: RoughDielectric(3.0, math.inf), "conductivity"),
        (lambda: RoughDielectric(3.0, diffuse=1.1), r"diffuse fraction in \[0, 1\], got 1.1"),
        (lambda: RoughDielectric(3.0, lobe_width=0.0), "lobe width"),
        (lambda: PerfectConductor(lobe_width=10.0), "lobe width"),
        (lambda: PerfectConductor().surface(0.0), "frequency"),
        (lambda: RoughDielectric(3.0).surface(math.nan), "frequency"),
        (lambda: complex_permittivity(0.5, 0.0, 1e9), "relative permittivity"),
        (lambda: complex_permittivity(2.0, -1.0, 1e9), "conductivity"),
    ],
)
def test_unphysical_values_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
