"""Lobes: normalised, reciprocal, never more power than came in; gradients."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import (
    Dielectric,
    Layer,
    Material,
    Multilayer,
    PerfectConductor,
    RoughConductor,
    RoughDielectric,
    ScatteringLaw,
    Slab,
    complex_permittivity,
    fresnel_reflectance,
    lobe_exponent,
    lobe_integral,
    slope_exponent,
)
from invertwin.scene.material.roughness import EffectiveRoughness

FREQUENCY = 77e9
ANGLES = torch.linspace(0, 1, 13, dtype=torch.float64)
NODES = torch.linspace(0, 1, 256, dtype=torch.float64)[::5]


def cosines(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


ROUGH: list[Material] = [
    RoughConductor(scattering=1.0, lambertian=0.0, directive=0.0, backscatter_exponent=2.0),
    RoughConductor(scattering=0.7, rms_slope=0.02, lambertian=0.3, directive=0.6),
    RoughConductor(scattering=1.0, lambertian=0.0, directive=0.5, directive_exponent=0.5),
    RoughConductor(rms_slope=1.0),
    Dielectric(5.24, 0.3, scattering=0.5, lambertian=0.4, directive=0.2, directive_exponent=20.0),
]


def amplitude_at(surface: ScatteringLaw, cosine: Tensor) -> Tensor:
    """The tabulated amplitude, linear between nodes and 0 below the horizon."""
    return between_nodes(surface.amplitude, cosine)


def between_nodes(values: Tensor, cosine: Tensor) -> Tensor:
    table = values.detach().numpy()
    nodes = np.linspace(0, 1, len(table))
    value = torch.as_tensor(np.interp(cosine.numpy(), nodes, table))
    return torch.where(cosine > 0, value, 0.0)


def reflectance_distribution(surface: ScatteringLaw, incoming: Tensor, outgoing: Tensor) -> Tensor:
    """f_r of the module text, for a surface with normal z."""
    cos_in, cos_out = incoming[..., 2], outgoing[..., 2]
    along = (incoming * outgoing).sum(-1)
    mirror = 2 * cos_in * cos_out - along
    shape = surface.diffuse / math.pi
    for k, cos_psi in enumerate((mirror, mirror, along)):
        half = (1 + cos_psi).clamp(min=0) / 2
        shape = shape + surface.lobes[k] * half ** surface.exponents[k]
    return amplitude_at(surface, cos_in) * amplitude_at(surface, cos_out) * shape


def albedo(surface: ScatteringLaw, cos_in: Tensor) -> Tensor:
    """Reflected over incident power: ∫ f_r cosθo dω by quadrature, [angle].

    Each lobe is integrated over directions around its own axis, with t = ((1+cosψ)/2)^(p+1) as the
    variable, in which it is constant however narrow it is. The incident direction and its mirror
    image stand at the same angle to the surface, so the sum is the same for both axes.
    """
    # Midpoints: the cut at the horizon spoils any higher order.
    t = (torch.arange(1000, dtype=torch.float64) + 0.5) / 1000
    chi = 2 * math.pi * (torch.arange(128, dtype=torch.float64) + 0.5) / 128
    sin_in = (1 - cos_in**2).clamp(min=0).sqrt()[:, None, None]
    total = surface.diffuse * 2 * (amplitude_at(surface, t) * t).mean()
    for number, (weight, exponent) in enumerate(zip(surface.lobes, surface.exponents, strict=True)):
        if not weight:
            continue
        cos_psi = (2 * t ** (1 / (exponent + 1)) - 1)[None, :, None]
        sin_psi = (1 - cos_psi**2).clamp(min=0).sqrt()
        cos_out = cos_in[:, None, None] * cos_psi + sin_in * sin_psi * torch.cos(chi)
        received = amplitude_at(surface, cos_out) * cos_out
        part = weight * 4 * math.pi / (exponent + 1)
        if not number:  # what is mirrored is no part of the specular lobe
            received = received * between_nodes(surface.spread, cos_out)
            part = part * between_nodes(surface.spread, cos_in)
        total = total + part * received.mean((1, 2))
    return amplitude_at(surface, cos_in) * total


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
            worst = max(worst, float(albedo(material.scattering_law(FREQUENCY), ANGLES).max()))
        worst = max(
            worst, float(albedo(PerfectConductor(float(width)).scattering_law(1e9), ANGLES).max())
        )
    assert 0.9 < worst <= 1 + 2e-5


@pytest.mark.parametrize("height", [0.0, 0.2e-3, 0.4e-3, 2e-3])
@pytest.mark.parametrize(("slope", "within"), [(0.02, 1e-3), (0.1, 0.012), (0.2, 0.045)])
def test_mirrored_and_incoherent_power_are_all_that_is_reflected(slope, within, height):
    """exp(−(2kσ cosθ)²) of the mirror-like part stays one wave, and the rest is scattered."""
    metal = RoughConductor(scattering=0.5, rms_slope=slope, rms_height=height)
    angles = cosines(0.5, 0.7, 0.9, 1.0)
    mirrored = metal.coefficients(FREQUENCY, angles, torch.zeros(4, dtype=torch.int64))
    kept = mirrored.reflection_s.abs().square()
    k = 2 * math.pi * FREQUENCY / SPEED_OF_LIGHT
    expected = 0.75 * torch.exp(-((2 * k * height * angles) ** 2))
    torch.testing.assert_close(kept, expected, rtol=1e-12, atol=0)
    surface = metal.incoherent_law(FREQUENCY)
    total = kept + albedo(surface, angles)
    torch.testing.assert_close(total, torch.ones_like(total), rtol=0, atol=within)
    if not height:
        assert not surface.lobes[0]


def test_stacks_lose_what_they_mirror():
    stack = Multilayer([Layer(4.0, thickness=1e-3), Layer(2.0, thickness=2e-3)], scattering=0.3)
    assert float(stack.scattering_law(FREQUENCY).lobes[0]) > 0
    assert not stack.incoherent_law(FREQUENCY).lobes[0]


@pytest.mark.parametrize("width", [0.5, 5.0, 60.0, 180.0])
def test_conductor_returns_everything_at_normal_incidence(width):
    surface = PerfectConductor(math.radians(width)).scattering_law(FREQUENCY)
    assert float(albedo(surface, cosines(1.0))) == pytest.approx(1.0, abs=2e-5)


@pytest.mark.parametrize("diffuse", [0.0, 0.3, 1.0])
def test_dielectric_returns_about_its_fresnel_reflectance(diffuse):
    # Far from grazing the amplitude hardly depends on the angle, and a narrow lobe stays in it.
    material = RoughDielectric(4.0, diffuse=diffuse, lobe_width=0.02)
    expected = fresnel_reflectance(complex_permittivity(4.0, 0.0, FREQUENCY), cosines(1.0))
    # The diffuse part reaches grazing angles, where reflection is stronger.
    tolerance = 0.02 + 0.25 * diffuse
    assert float(albedo(material.scattering_law(FREQUENCY), cosines(1.0))) == pytest.approx(
        float(expected), rel=tolerance
    )


def test_reciprocity():
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(2, 500, 3, generator=generator, dtype=torch.float64)
    directions[..., 2] = directions[..., 2].abs()
    a, b = torch.nn.functional.normalize(directions, dim=-1)
    for material in (RoughDielectric(3.0, 0.5, diffuse=0.4), PerfectConductor(), *ROUGH):
        surface = material.scattering_law(FREQUENCY)
        forward = reflectance_distribution(surface, a, b)
        assert torch.allclose(forward, reflectance_distribution(surface, b, a), rtol=1e-10)
        assert (forward >= 0).all()


@pytest.mark.parametrize("width", [3.5e-4, 0.01, 0.3, 1.0, math.pi])
def test_lobe_has_the_stated_width_and_integral(width):
    exponent = lobe_exponent(width)
    assert float(((1 + math.cos(width / 2)) / 2) ** exponent) == pytest.approx(0.5, rel=1e-6)
    x = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000
    # The variable t = x^(p+1) as in `albedo`, with cosθ = 2x − 1 and dω = 2π dcosθ.
    cosine = (2 * x ** (1 / (exponent + 1)) - 1).clamp(min=0)
    quadrature = 4 * math.pi / (exponent + 1) * cosine.mean()
    assert float(lobe_integral(exponent)) == pytest.approx(float(quadrature), rel=1e-6)


@pytest.mark.parametrize("material", ROUGH)
def test_three_lobes_never_return_more_than_came_in(material):
    reflected = albedo(material.scattering_law(FREQUENCY), ANGLES)
    assert reflected.min() >= 0
    assert reflected.max() <= 1 + 2e-5
    if isinstance(material, RoughConductor):
        assert float(reflected[-1]) == pytest.approx(1.0, abs=2e-5)


@pytest.mark.parametrize("cos_in", [0.2, 0.6, 1.0])
def test_the_sum_over_the_hemisphere_is_the_albedo(cos_in):
    # Brute force over all directions, with no knowledge of the lobes' axes.
    material = Dielectric(4.0, scattering=0.8, rms_slope=0.4, lambertian=0.2, directive=0.3)
    surface = material.scattering_law(FREQUENCY)
    cosine = (torch.arange(600, dtype=torch.float64) + 0.5) / 600
    phi = 2 * math.pi * (torch.arange(240, dtype=torch.float64) + 0.5) / 240
    sine = (1 - cosine**2).sqrt()[:, None]
    z = cosine[:, None].expand(-1, len(phi))
    outgoing = torch.stack([sine * phi.cos(), sine * phi.sin(), z], dim=-1)
    incoming = torch.tensor([math.sqrt(1 - cos_in**2), 0.0, cos_in], dtype=torch.float64)
    values = reflectance_distribution(surface, incoming.expand_as(outgoing), outgoing)
    total = 2 * math.pi * (values * z).mean()
    assert float(total) == pytest.approx(float(albedo(surface, cosines(cos_in))), rel=1e-4)


def test_a_sheet_returns_and_lets_through_about_what_came_in():
    # √(R R) is right on average over angles only; this is the worst of some hundred sheets.
    resonant = Slab(7.3948, thickness=6.366326e-3, scattering=1.0).scattering_law(FREQUENCY)
    board = Slab.itu("plasterboard", thickness=12.5e-3, scattering=1.0).scattering_law(FREQUENCY)
    everywhere = albedo(resonant, NODES) + resonant.transmittance[::5]
    assert 1.05 < float(everywhere.max()) < 1.12
    assert float((albedo(board, NODES) + board.transmittance[::5]).max()) < 1
    mirror = Slab(7.3948, thickness=6.366326e-3, rms_slope=0.01).scattering_law(FREQUENCY)
    assert float((albedo(mirror, NODES) + mirror.transmittance[::5]).max()) < 1.01


def test_shares_of_the_power():
    weights = EffectiveRoughness(
        scattering=0.6, lambertian=0.25, directive=0.75, rms_slope=0.2
    ).weights()
    power = weights.lobes * lobe_integral(weights.exponents)
    assert float(weights.diffuse) == pytest.approx(0.36 * 0.25)
    assert power.tolist() == pytest.approx([0.64, 0.36 * 0.75 * 0.75, 0.36 * 0.75 * 0.25])
    assert float(weights.diffuse + power.sum()) == pytest.approx(1)


def test_backscattering_points_back():
    surface = RoughConductor(
        scattering=1.0, lambertian=0.0, directive=0.0, backscatter_exponent=50.0
    ).scattering_law(FREQUENCY)
    incoming = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    mirrored = torch.tensor([-0.6, 0.0, 0.8], dtype=torch.float64)
    back = reflectance_distribution(surface, incoming, incoming)
    assert back > 100 * reflectance_distribution(surface, incoming, mirrored)


def test_the_lobe_of_small_slopes_is_that_of_their_distribution():
    # Facets with Gaussian slopes of rms m are tilted by β with the density exp(−tan²β/m²).
    slope = 0.08
    tilt = torch.linspace(0, 2 * slope, 20, dtype=torch.float64)
    lobe = torch.cos(tilt) ** (2 * slope_exponent(slope))  # ψ = 2β
    assert torch.allclose(lobe, torch.exp(-((torch.tan(tilt) / slope) ** 2)), atol=5e-3)


def test_gradients_of_the_weights():
    others = {"rms_height", "depolarisation"}  # of fields, of polarisation
    names = [n for n in EffectiveRoughness.__dataclass_fields__ if n not in others]

    def weights(*values):
        return tuple(EffectiveRoughness(**dict(zip(names, values, strict=True))).weights())

    starts = (0.6, 0.3, 0.4, 0.7, 3.0, 5.0)
    inputs = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in starts]
    assert torch.autograd.gradcheck(weights, inputs)
    rows = [torch.tensor([v, 0.9 * v], dtype=torch.float64, requires_grad=True) for v in starts]
    assert torch.autograd.gradcheck(weights, rows)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RoughConductor(scattering=1.2), r"scattering coefficient in \[0, 1\], got 1.2"),
        (lambda: RoughConductor(rms_slope=0.0), "rms slope"),
        (lambda: RoughConductor(lambertian=-0.1), "Lambertian share"),
        (lambda: RoughConductor(directive=2.0), "directive share"),
        (lambda: RoughConductor(directive_exponent=-1.0), "exponent of the directive lobe"),
        (lambda: RoughConductor(backscatter_exponent=math.nan), "exponent of the backscattering"),
    ],
)
def test_impossible_roughness_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
