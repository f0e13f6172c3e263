"""Fringe currents of faces that end: against the currents of a half plane, and along a box."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad_vec
from scipy.special import erfc

from invertwin.channel.em.wedges import _fringe_coefficients, _strip_shares
from invertwin.channel.rcs.moments import efie_solver, mfie
from invertwin.scene import Object, PerfectConductor, Scene, box
from invertwin.signatures import aspect_directions, rcs
from scenes import float64

TURN = complex(math.sqrt(0.5), math.sqrt(0.5))  # exp(jπ/4)


def half_plane_integrals(azimuth: float, mu: float, phase: float) -> np.ndarray:
    """Integrals from the edge of the fringe currents of a half plane, E- and H-polarised.

    The fields at the face are F(x) = ∫ exp(−jt²) dt from x to ∞ (Sommerfeld), here without the
    factors that do not depend on the strip's length.
    """

    def currents(root: float) -> np.ndarray:
        x = root**2  # phase from the edge; the root takes the singularity at the edge away
        fresnel = (
            math.sqrt(math.pi) / 2 / TURN * erfc(TURN * math.sqrt(2 * x) * math.cos(azimuth / 2))
        )
        hard = np.exp(1j * x * (math.cos(azimuth) + mu)) * fresnel
        edge = math.sin(azimuth / 2) * np.exp(-1j * x * (1 - mu)) / math.sqrt(2)
        return np.array([2 * root * -1j * math.sin(azimuth) * hard + 2 * edge, 2 * root * hard])

    return np.asarray(quad_vec(currents, 0.0, math.sqrt(phase), epsrel=1e-10)[0])


@pytest.mark.parametrize("phase", [4.0, 25.0, 60.0])
@pytest.mark.parametrize(
    ("azimuth", "mu"), [(1.2, 0.3), (3.0, 0.95), (2.5, 0.999), (0.4, -0.7), (3.1, 1.05)]
)
def test_strips_of_a_half_plane_carry_its_currents(azimuth, mu, phase):
    """A ratio of two widths, since the endless integral has no end to stop a quadrature at."""
    a = float64([math.sqrt(2) * math.cos(azimuth / 2)])
    shares = [_strip_shares(a, float64([1 - mu]), float64([p]))[:, 0].numpy() for p in (phase, 9.0)]
    exact = [half_plane_integrals(azimuth, mu, p) for p in (phase, 9.0)]
    assert shares[0] / shares[1] == pytest.approx(exact[0] / exact[1], abs=1e-6)


@pytest.mark.parametrize("opening", [1.5, 1.9])
def test_coefficients_stay_finite_where_both_waves_run_along_the_face(opening):
    """Of the order of the strip's phase, 30 rad; endless strips give 1/(ε + δ)."""
    angles = float64([-1e-3, -1e-9, 0.0, 1e-9, 1e-3])
    azimuth, out = (
        math.pi + grid.ravel() for grid in torch.meshgrid(angles, angles, indexing="ij")
    )
    size = float64([opening]).expand(len(azimuth))
    found = _fringe_coefficients(size, azimuth, -torch.cos(out), torch.full_like(size, 30.0))
    for coefficient in found:
        assert torch.isfinite(coefficient).all()
        assert coefficient.abs().max() < 60


def test_a_box_scatters_forward_as_the_method_of_moments_says(monkeypatch):
    """Light runs along four faces; endless strips were up to 50 dB too bright here."""
    wavelength = 0.1
    scene = Scene({"box": Object(box((0.2, 0.15, 0.15)), PerfectConductor())})
    azimuth = torch.deg2rad(torch.arange(150.0, 181.0, 6.0, dtype=torch.float64))
    receivers = aspect_directions(math.pi / 2, azimuth)
    towards = aspect_directions(math.pi / 2, torch.zeros_like(azimuth))
    sigma = []
    for solved in (True, False):
        if not solved:
            monkeypatch.setattr(efie_solver, "MAX_UNKNOWNS", 0)
            monkeypatch.setattr(mfie, "MAX_CELLS", 0)
        found = rcs(scene, towards, 299792458 / wavelength, receivers=receivers, depth=1)
        assert ("rest" in found.parts) == solved
        sigma.append(20 * torch.log10(found.matrix[0].diagonal(dim1=1, dim2=2).abs()))
    assert (sigma[0] - sigma[1]).abs().max() < 3.5
    assert (sigma[0] - sigma[1]).square().mean().sqrt() < 1.5
