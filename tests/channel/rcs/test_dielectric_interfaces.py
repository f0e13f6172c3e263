"""What waves do at faces of solids: Fresnel's law from either side, currents, power."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams.beam_tracing import IlluminatedPatches
from invertwin.channel.em.dielectric_solids import DielectricSolids, normal_component, refract_waves
from invertwin.channel.em.plane_waves import SmoothInterfaces, dot, reflect_field, reflect_vectors
from invertwin.channel.rcs.dielectric_interfaces import (
    apply_fresnel,
    incident_power,
    scatter_at_interfaces,
)
from invertwin.scene.material.fresnel import fresnel_coefficients
from scenes import complex128, float64

K = 2 * math.pi / 0.01
UPWARDS = float64([[0.0, 0.0, 1.0]])
EPSILON = complex128([2.5 - 0.1j])
AIR = complex128([1.0])
LOSSLESS = complex128([2.5])
YES, NO = torch.tensor([True]), torch.tensor([False])
BLOCK = DielectricSolids(torch.tensor([0]), YES, NO, LOSSLESS, K, ["block"])
BODY = SmoothInterfaces(
    torch.tensor([False]), EPSILON, float64([torch.inf]), float64([1.0]), float64([0.0])
)


def wave(epsilon: Tensor, angle: float) -> tuple[Tensor, Tensor]:
    """K downwards at an angle to the normal, and unit fields across and in the plane."""
    d = float64([[math.sin(angle), 0.0, -math.cos(angle)]])
    plane = float64([[math.cos(angle), 0.0, math.sin(angle)]])
    fields = torch.stack([float64([[0.0, 1.0, 0.0]]), plane], 1)
    return epsilon.sqrt()[:, None] * d, fields.to(torch.complex128)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.2])
def test_from_air_it_is_the_law_of_half_spaces(angle):
    k, field = wave(AIR, angle)
    found = apply_fresnel(AIR, EPSILON, UPWARDS, k, field)
    expected = reflect_field(BODY, K, UPWARDS, k.real, field)
    assert torch.allclose(found.reflected, expected, atol=1e-12)
    law = fresnel_coefficients(EPSILON, float64([math.cos(angle)]))
    assert abs(complex(found.transmitted[0, 0, 1] - law.transmission_s)) < 1e-12
    length = dot(found.transmitted[0, 1], found.transmitted[0, 1])  # E·E, without conjugation
    assert abs(complex(length.sqrt() - law.transmission_p)) < 1e-12


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.6])
def test_from_within_stokes_relations_hold(angle):
    """r′ = −r and t t′ = 1 − r² of each polarisation (Stokes)."""
    k, field = wave(AIR, angle)
    there = apply_fresnel(AIR, EPSILON, UPWARDS, k, field)
    inner, _ = refract_waves(EPSILON, k, UPWARDS)
    onwards = apply_fresnel(EPSILON, AIR, UPWARDS, inner, there.transmitted)
    r = [complex(dot(m, m).sqrt()) for m in there.reflected[0]]
    for number in (0, 1):
        rest = onwards.transmitted[0, number] - (1 - r[number] ** 2) * field[0, number]
        assert float(rest.abs().max()) < 1e-12
    back = complex(onwards.reflected[0, 0, 1] / there.transmitted[0, 0, 1])
    assert abs(back + complex(there.reflected[0, 0, 1])) < 1e-12


@pytest.mark.parametrize("angle", [0.0, 0.5, 0.68])
@pytest.mark.parametrize("outwards", [True, False])
def test_what_goes_in_comes_out(angle, outwards):
    """Σ Re(K_n) |E|² of both waves that leave is that of the one that comes (no loss)."""
    media = (LOSSLESS, AIR) if outwards else (AIR, LOSSLESS)
    k, field = wave(media[0], angle)
    found = apply_fresnel(*media, UPWARDS, k, field)
    p, q = normal_component(media[0], k, UPWARDS).real, normal_component(media[1], k, UPWARDS).real
    power = p * found.reflected.abs().square().sum(2) + q * found.transmitted.abs().square().sum(2)
    beyond = outwards and math.sin(angle) > 1 / math.sqrt(2.5)
    assert (float(q) == 0.0) == beyond
    assert torch.allclose(power, p * torch.ones_like(power), rtol=1e-12)


def test_total_reflection_turns_the_phases_as_textbooks_say():
    """tan(δ_s/2) = √(sin² − 1/ε)/cos, with r = exp(jδ) for exp(+jωt)."""
    angle = 0.9
    k, field = wave(LOSSLESS, angle)
    found = apply_fresnel(LOSSLESS, AIR, UPWARDS, k, field)
    turn = 2 * math.atan(math.sqrt(math.sin(angle) ** 2 - 1 / 2.5) / math.cos(angle))
    assert complex(found.reflected[0, 0, 1]) == pytest.approx(
        complex(math.cos(turn), math.sin(turn)), abs=1e-12
    )
    decays = normal_component(AIR, k, UPWARDS)
    assert float(decays.imag) < 0
    assert not bool(refract_waves(AIR, k, UPWARDS)[1])


def inner_bounce(k: Tensor) -> IlluminatedPatches:
    """A patch of a solid's face that is met from within: the normal is that of the inner side."""
    number, plain = torch.tensor([0]), complex128([1.0])
    place = torch.zeros(1, 3, 3, dtype=torch.float64)
    d = normalize(k.real, dim=1)
    return IlluminatedPatches(
        number, number, UPWARDS, d, plain, place, number, k, number, number >= 0, plain
    )


@pytest.mark.parametrize("bend", [0.3, 1.2, 3.0])
def test_power_is_kept_where_the_phase_does_not_advance_along_the_ray(bend):
    """K of a tube's corners, which may be any behind a curved face, is not that of its power."""
    k, field = wave(LOSSLESS, 0.5)
    patch = replace(inner_bounce(k), wave_vector=k + complex128([[bend, 0.7 * bend, bend]]))
    met = scatter_at_interfaces(BLOCK, BODY, K, patch, field, UPWARDS)
    p, q = -k[0, 2].real, normal_component(AIR, k, UPWARDS).real
    power = p * met.reflected.abs().square().sum(2) + q * met.transmitted.abs().square().sum(2)
    assert torch.allclose(power, p * torch.ones_like(power), rtol=1e-12)
    plain = scatter_at_interfaces(BLOCK, BODY, K, inner_bounce(k), field, UPWARDS)
    for one, other in zip(met, plain, strict=True):
        assert torch.allclose(one, other, atol=1e-12 * K)


def test_the_field_of_a_tube_is_turned_orthogonal_to_its_ray():
    k, field = wave(LOSSLESS, 0.5)
    patch = replace(inner_bounce(k), wave_vector=k + 0.3)
    tilted = field + 0.4 * normalize(k.real, dim=1)[:, None]
    met = scatter_at_interfaces(BLOCK, BODY, K, patch, tilted, UPWARDS)
    straight = scatter_at_interfaces(BLOCK, BODY, K, patch, field, UPWARDS)
    # The same power, √(1² + 0.4²) in amplitude.
    assert torch.allclose(met.reflected, math.hypot(1, 0.4) * straight.reflected)


def test_incident_power_is_that_through_the_cross_section():
    k, field = wave(LOSSLESS, 0.5)
    triangle = float64([[[0, 0, 0], [3, 0, 0], [0, 4, 0]]])
    patch = replace(inner_bounce(k), polygon=triangle)
    expected = 2 * 2.5**0.5 * 6 * math.cos(0.5)
    assert incident_power(BLOCK, patch, field) == pytest.approx(expected)


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.6])
def test_the_outer_side_sends_what_passes(angle):
    """(jk/2π) cosθ′ E′ per m² in the refracted direction: a patch of an endless plane."""
    k, field = wave(LOSSLESS, angle)
    onwards, _ = refract_waves(AIR, k, UPWARDS)
    met = scatter_at_interfaces(BLOCK, BODY, K, inner_bounce(k), field, onwards.real)
    cosine = -float(onwards[0, 2].real)
    expected = 1j * K / (2 * math.pi) * cosine * met.transmitted
    assert torch.allclose(met.radiated, expected, atol=1e-9 * K)


def test_roughness_takes_less_from_what_passes_than_from_what_is_mirrored_inside():
    """Phases spread by kσ(q − p) and 2kσp."""
    k, field = wave(LOSSLESS, 0.3)
    height = 4e-4
    smooth, rough = (
        scatter_at_interfaces(
            BLOCK, BODY._replace(rms_height=float64([h])), K, inner_bounce(k), field, UPWARDS
        )
        for h in (0.0, height)
    )
    p = math.sqrt(2.5) * math.cos(0.3)
    q = math.sqrt(1 - 2.5 * math.sin(0.3) ** 2)
    passed, kept = (
        math.exp(-0.5 * (K * height * (p - q)) ** 2),
        math.exp(-0.5 * (K * height * 2 * p) ** 2),
    )
    assert torch.allclose(rough.transmitted, smooth.transmitted * passed)
    assert torch.allclose(rough.reflected, smooth.reflected * kept)


def test_a_conductor_inside_mirrors_and_sends_nothing():
    k, field = wave(EPSILON, 0.4)
    metal = DielectricSolids(torch.tensor([1]), NO, YES, EPSILON.repeat(2), K, ["block", "plate"])
    met = scatter_at_interfaces(metal, BODY, K, inner_bounce(k), field, UPWARDS)
    assert float(met.radiated.abs().max()) == 0
    total = met.reflected + field
    assert float(torch.linalg.cross(total, UPWARDS[:, None].to(total.dtype)).abs().max()) < 1e-12
    onwards = reflect_vectors(k, UPWARDS)
    assert float(dot(onwards[:, None], met.reflected).abs().max()) < 1e-12
