"""Fields about wedges of a perfect conductor that are known exactly: oracles of diffraction.

Angles are counted from one face through the exterior; the exterior angle is nπ. All are scalar
fields that vanish on the faces ("soft", E along the edge) or whose normal derivative does ("hard",
H along the edge). Convention exp(+jωt). Slow: one number at a time.

Source: Balanis, Advanced Engineering Electromagnetics, §11.6 and §13; Bowman, Senior and Uslenghi,
Electromagnetic and Acoustic Scattering by Simple Shapes, §8.3 (Macdonald).
"""

import math
from typing import Literal

import numpy as np
from jaxtyping import Complex128, Float64
from scipy.special import hankel2, hankel2e, jv, wofz

WedgePolarisation = Literal["soft", "hard"]
_SIGNS = {"soft": -1.0, "hard": 1.0}
_PANELS, _POINTS = 24, 20  # of the quadrature of Macdonald's integral


def half_plane_plane_wave(
    k: float, azimuth_in: float, distance: float, azimuth: float, polarisation: WedgePolarisation
) -> complex:
    """Sommerfeld: a plane wave of amplitude 1 at the edge meets a half plane.

    Args:
        k: wave number across the edge [1/m].
        azimuth_in: φ′, from where the wave comes [rad].
        distance: ρ from the edge [m].
        azimuth: φ [rad].
        polarisation: soft or hard.
    """
    total = 0j
    for angle, sign in ((azimuth - azimuth_in, 1.0), (azimuth + azimuth_in, _SIGNS[polarisation])):
        total += sign * _half_plane_wave(k * distance, angle)
    return total


def _half_plane_wave(distance: float, angle: float) -> complex:
    """exp(jkρ cos β) ½ erfc(−exp(jπ/4) √(2kρ) cos(β/2)), without overflow."""
    x = math.sqrt(2 * distance) * math.cos(angle / 2)
    # ½ erfc(exp(jπ/4)|x|) = ½ exp(−jx²) w(j exp(jπ/4)|x|), and 1 less that beyond the shadow.
    edge = 0.5 * np.exp(-1j * x * x) * wofz(1j * np.exp(0.25j * math.pi) * abs(x))
    share = 1 - edge if x > 0 else edge
    return complex(np.exp(1j * distance * math.cos(angle)) * share)


def wedge_plane_wave(
    k: float,
    opening: float,
    azimuth_in: float,
    distance: float,
    azimuth: Float64[np.ndarray, " angle"],
    polarisation: WedgePolarisation,
) -> Complex128[np.ndarray, " angle"]:
    """The series of a wedge in a plane wave of amplitude 1 at the edge.

    Args:
        k: wave number across the edge [1/m].
        opening: n, exterior angle over π.
        azimuth_in: φ′ [rad].
        distance: ρ [m].
        azimuth: φ [rad].
        polarisation: soft or hard.
    """
    reach = k * distance
    order = np.arange(int(opening * (reach + 12 * np.cbrt(reach) + 25)))
    weight = np.where(order == 0, 1, 2) * np.exp(0.5j * math.pi * order / opening)
    weight = weight * jv(order / opening, reach) / opening
    return _angular_factors(order, weight, opening, azimuth_in, azimuth, polarisation)


def wedge_line_source(
    k: float,
    opening: float,
    source: tuple[float, float],
    distance: float,
    azimuth: Float64[np.ndarray, " angle"],
    polarisation: WedgePolarisation,
) -> Complex128[np.ndarray, " angle"]:
    """The series of a wedge beside a line source, whose own field is H₀⁽²⁾(kR).

    Args:
        k: wave number [1/m].
        opening: n, exterior angle over π.
        source: ρ′ [m] and φ′ [rad].
        distance: ρ [m].
        azimuth: φ [rad].
        polarisation: soft or hard.
    """
    near, far = k * min(distance, source[0]), k * max(distance, source[0])
    order = np.arange(int(opening * (near + 14 * np.cbrt(near) + 30)))
    small = jv(order / opening, near)
    with np.errstate(over="ignore", invalid="ignore"):
        large = hankel2(order / opening, far)
    sound = (np.abs(small) > 1e-280) & np.isfinite(large)
    weight = np.where(sound, small * np.where(sound, large, 0), 0)
    weight = weight * np.where(order == 0, 1, 2) / opening
    return _angular_factors(order, weight, opening, source[1], azimuth, polarisation)


def _angular_factors(
    order: np.ndarray,
    weight: np.ndarray,
    opening: float,
    azimuth_in: float,
    azimuth: np.ndarray,
    polarisation: WedgePolarisation,
) -> np.ndarray:
    direct = np.cos(np.outer(azimuth - azimuth_in, order) / opening)
    mirrored = np.cos(np.outer(azimuth + azimuth_in, order) / opening)
    return (direct + _SIGNS[polarisation] * mirrored) @ weight


def half_plane_point_source(
    k: float,
    source: tuple[float, float],
    point: tuple[float, float, float],
    polarisation: WedgePolarisation,
) -> complex:
    """Macdonald: a half plane beside a point source, whose own field is exp(−jkR)/R.

    Args:
        k: wave number [1/m].
        source: ρ′ [m] and φ′ [rad].
        point: ρ [m], φ [rad], and z along the edge from the source [m].
        polarisation: soft or hard.
    """
    (apart_in, azimuth_in), (apart, azimuth, along) = source, point
    total = 0j
    for angle, sign in ((azimuth - azimuth_in, 1.0), (azimuth + azimuth_in, _SIGNS[polarisation])):
        square = apart**2 + apart_in**2 - 2 * apart * apart_in * math.cos(angle) + along**2
        limit = 2 * math.sqrt(apart * apart_in) * math.cos(angle / 2)
        total += sign * _macdonald(k, math.sqrt(square), limit)
    return total


def _macdonald(k: float, straight: float, limit: float) -> complex:
    """−(jk/2) ∫ H₁⁽²⁾(k√(R² + μ²))/√(R² + μ²) dμ from −limit to ∞, down the steepest path.

    With √(R² + μ²) = √(R² + limit²) − jq², the integrand decays as exp(−kq²).
    """
    first = math.hypot(straight, limit)
    node, weight = np.polynomial.legendre.leggauss(_POINTS)
    width = math.sqrt(60 / k) / _PANELS
    q = (width * (np.arange(_PANELS)[:, None] + (node + 1) / 2)).ravel()
    weight = np.tile(weight * width / 2, _PANELS)
    length = first - 1j * q**2
    mu = np.sqrt(length - straight) * np.sqrt(length + straight)
    wave = hankel2e(1, k * length) * np.exp(-1j * k * first - k * q**2)
    tail = complex((wave / mu * -2j * q * weight).sum())
    whole = 2j * np.exp(-1j * k * straight) / (k * straight)
    return complex(-0.5j * k * (whole - tail if limit > 0 else tail))
