"""Exact fields about wedges against each other and against brute force."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import hankel2

from oracles.exact_wedge import (
    half_plane_plane_wave,
    half_plane_point_source,
    wedge_line_source,
    wedge_plane_wave,
)

K = 2 * math.pi
AZIMUTHS = np.linspace(0.05, 2 * math.pi - 0.05, 11)


@pytest.mark.parametrize("polarisation", ["soft", "hard"])
def test_half_plane_is_the_wedge_without_a_body(polarisation):
    series = wedge_plane_wave(K, 2.0, 0.9, 3.0, AZIMUTHS, polarisation)
    exact = [half_plane_plane_wave(K, 0.9, 3.0, a, polarisation) for a in AZIMUTHS]
    np.testing.assert_allclose(series, exact, atol=1e-12)


def test_soft_fields_vanish_on_both_faces_and_hard_ones_do_not():
    faces = np.array([0.0, 1.5 * math.pi])
    soft = wedge_plane_wave(K, 1.5, 0.9, 2.0, faces, "soft")
    assert np.abs(soft).max() < 1e-12
    assert np.abs(wedge_plane_wave(K, 1.5, 0.9, 2.0, faces, "hard")).min() > 0.1


def test_flat_wedge_is_a_mirror():
    """An exterior angle of π: the straight wave and its image."""
    source, distance = (2.0, 0.9), 3.0
    azimuth = np.linspace(0.1, 3.0, 7)
    series = wedge_line_source(K, 1.0, source, distance, azimuth, "soft")

    def wave(angle):
        return hankel2(0, K * np.sqrt(13.0 - 12.0 * np.cos(angle)))

    np.testing.assert_allclose(series, wave(azimuth - 0.9) - wave(azimuth + 0.9), atol=1e-10)


def test_line_source_far_away_is_a_plane_wave():
    far = 2000.0
    azimuth = np.array([0.3, 2.0, 4.5])
    line = wedge_line_source(K, 1.5, (far, 0.9), 1.0, azimuth, "hard") / hankel2(0, K * far)
    np.testing.assert_allclose(line, wedge_plane_wave(K, 1.5, 0.9, 1.0, azimuth, "hard"), atol=3e-3)


@pytest.mark.parametrize("azimuth", [0.4, 3.0, 5.5])
def test_macdonald_by_brute_force(azimuth):
    """Both integrals over the real axis, where their ends add up to half a wave."""
    (apart_in, azimuth_in), (apart, along) = (1.5, 0.9), (1.0, 0.4)

    def part(angle):
        square = apart**2 + apart_in**2 - 2 * apart * apart_in * math.cos(angle) + along**2
        limit = 2 * math.sqrt(apart * apart_in) * math.cos(angle / 2)

        def integrand(mu):
            length = math.sqrt(square + mu * mu)
            return hankel2(1, K * length) / length

        real, _ = quad(lambda mu: integrand(mu).real, 0, limit, limit=400)
        imaginary, _ = quad(lambda mu: integrand(mu).imag, 0, limit, limit=400)
        half = 1j * np.exp(-1j * K * math.sqrt(square)) / (K * math.sqrt(square))
        return -0.5j * K * (half + real + 1j * imaginary)

    found = half_plane_point_source(K, (apart_in, azimuth_in), (apart, azimuth, along), "soft")
    assert found == pytest.approx(part(azimuth - azimuth_in) - part(azimuth + azimuth_in), abs=1e-9)
