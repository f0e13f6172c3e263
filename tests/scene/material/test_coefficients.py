"""Coherent field coefficients of materials: what paths between antennas multiply."""

import math

import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene import (
    Dielectric,
    Layer,
    Multilayer,
    PerfectConductor,
    RefractingBody,
    RoughConductor,
    RoughDielectric,
    Slab,
    fresnel_coefficients,
    slab_coefficients,
)
from scenes import float64

FREQUENCY = 6e9
COSINE = float64([1.0, 0.6, 0.1])
WAVE_NUMBER = 2 * math.pi * FREQUENCY / SPEED_OF_LIGHT
TRIANGLE = torch.tensor([0, 1, 2])


def coefficients(material):
    return material.coefficients(FREQUENCY, COSINE, TRIANGLE)


def test_conductors():
    found = coefficients(PerfectConductor())
    assert found.reflection_s.tolist() == [-1, -1, -1]
    assert found.reflection_p.tolist() == [1, 1, 1]
    assert not found.transmission_s.any()
    assert not found.transmission_p.any()
    rough = coefficients(RoughConductor(scattering=0.6, rms_height=2e-3))
    share = 0.8 * torch.exp(-0.5 * (2 * WAVE_NUMBER * 2e-3 * COSINE) ** 2)
    torch.testing.assert_close(rough.reflection_p.real, share)


@pytest.mark.parametrize("kind", [Dielectric, RefractingBody])
def test_bodies(kind):
    body = kind(4.0, 0.1, scattering=0.0)
    found = coefficients(body)
    half = fresnel_coefficients(body.complex_permittivity(FREQUENCY), COSINE)
    torch.testing.assert_close(found.reflection_s, half.reflection_s)
    torch.testing.assert_close(found.reflection_p, half.reflection_p)
    assert not found.transmission_s.any()


def test_what_is_only_rough_has_none():
    assert not any(value.any() for value in coefficients(RoughDielectric(4.0)))


def test_sheets_are_centred_on_their_mesh():
    """Both faces of a sheet are half its thickness off the mesh."""
    slab = Slab(4.0, 0.05, thickness=0.03)
    found = coefficients(slab)
    faces = slab_coefficients([slab.sheet(FREQUENCY)], COSINE[:, None], FREQUENCY)
    phase = WAVE_NUMBER * 0.03 * COSINE
    turn = torch.polar(torch.ones_like(phase), phase)
    for ours, theirs in zip(found, faces, strict=True):
        torch.testing.assert_close(ours, turn * theirs[:, 0])
    stack = Multilayer([Layer(4.0, 0.05, thickness=0.02), Layer(4.0, 0.05, thickness=0.01)])
    for ours, theirs in zip(coefficients(stack), found, strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("layered", [False, True])
def test_values_of_triangles(layered):
    values, thickness = float64([3.0, 4.0, 9.0]), float64([0.01, 0.02, 0.03])

    def made(permittivity, depth):
        if layered:
            return Multilayer([Layer(permittivity, 0.05, thickness=depth)])
        return Slab(permittivity, 0.05, thickness=depth)

    mixed = coefficients(made(values, thickness))
    for row in range(3):
        single = coefficients(made(float(values[row]), float(thickness[row])))
        for ours, theirs in zip(mixed, single, strict=True):
            torch.testing.assert_close(ours[row], theirs[row])


def test_energy_is_kept_by_sheets_without_losses():
    found = coefficients(Slab(4.0, thickness=0.03))
    for r, t in ((found[0], found[2]), (found[1], found[3])):
        torch.testing.assert_close(r.abs() ** 2 + t.abs() ** 2, torch.ones(3).double())
        # What a symmetric sheet reflects and lets through is in quadrature, about its middle.
        assert float((r * t.conj()).real.abs().max()) < 1e-12
