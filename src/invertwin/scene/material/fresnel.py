"""Half spaces: complex permittivity and permeability, Fresnel reflection and transmission."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Complex128, Float, Float64, Shaped
from torch import Tensor

from invertwin.checks import checked_number
from invertwin.constants import SPEED_OF_LIGHT, VACUUM_PERMITTIVITY
from invertwin.scene.material.values import Value, checked_value, evaluate_value

_Cosines = Float[Tensor, "*#angle"]
_Constants = Shaped[Tensor, "*#angle"]
LEAST_COSINE = 1e-9
"""Shift that avoids 0/0 at grazing incidence on ε = 1, below rounding elsewhere."""
_SAFE_POWER = 1e-30  # smaller reflectances are zero, without derivative of their root


class FieldCoefficients(NamedTuple):
    """Reflected and transmitted field over the incident one, for exp(+jωt), by polarisation.

    Perpendicular (s, TE): E normal to the plane of incidence. Parallel (p, TM): E within it, with
    the sign by which both reflection coefficients of a conductor are opposite, −1 and +1.
    """

    reflection_s: Complex128[Tensor, "*angle"]
    reflection_p: Complex128[Tensor, "*angle"]
    transmission_s: Complex128[Tensor, "*angle"]
    transmission_p: Complex128[Tensor, "*angle"]

    def scale_reflection(self, share: Float64[Tensor, "*#angle"]) -> "FieldCoefficients":
        """Return the coefficients with the reflected field scaled."""
        s, p = share * self.reflection_s, share * self.reflection_p
        return self._replace(reflection_s=s, reflection_p=p)


def complex_permittivity(
    permittivity: Value, conductivity: Value, frequency: float, loss_tangent: Value = 0.0
) -> Shaped[Tensor, "*row"]:
    """Compute the relative complex permittivity ε = ε' (1 − j tanδ) − jσ/(ωε0) for exp(+jωt).

    Args:
        permittivity: real part ε' ≥ 1.
        conductivity: conductivity σ [S/m].
        frequency: frequency [Hz].
        loss_tangent: tanδ of losses other than σ, independent of frequency.

    Raises:
        InputError: ε' < 1, σ < 0, tanδ < 0, or a frequency that is not positive.
    """
    checked_value(permittivity, "permittivity")
    checked_value(conductivity, "conductivity")
    checked_value(loss_tangent, "loss_tangent")
    checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
    real = evaluate_value(permittivity)
    loss = evaluate_value(conductivity) / (2 * math.pi * frequency * VACUUM_PERMITTIVITY)
    real, loss = torch.broadcast_tensors(real, loss + real * evaluate_value(loss_tangent))
    return torch.complex(real, -loss)


def fresnel_coefficients(
    permittivity: _Constants, cos_theta: _Cosines, permeability: _Constants | None = None
) -> FieldCoefficients:
    """Compute the complex field coefficients of a half space for waves from air.

    r_s = (μc − s)/(μc + s), r_p = (εc − s)/(εc + s), t_s = 2μc/(μc + s), t_p = 2√(εμ) c/(εc + s),
    with c = cosθ and s² = εμ − 1 + c². Source: Fresnel.

    Args:
        permittivity: complex relative permittivity; broadcasts with the angles.
        cos_theta: cosine of the angle of incidence, in [0, 1].
        permeability: complex relative permeability; None = 1.
    """
    epsilon = permittivity.to(torch.complex128)
    mu = torch.ones_like(epsilon) if permeability is None else permeability
    cosine = cos_theta.double().clamp(min=LEAST_COSINE)
    sine = torch.sqrt(epsilon * mu - 1 + cosine**2)
    return FieldCoefficients(
        (mu * cosine - sine) / (mu * cosine + sine),
        (epsilon * cosine - sine) / (epsilon * cosine + sine),
        2 * mu * cosine / (mu * cosine + sine),
        2 * torch.sqrt(epsilon * mu) * cosine / (epsilon * cosine + sine),
    )


def fresnel_amplitude(
    permittivity: _Constants, cos_theta: _Cosines, permeability: _Constants | None = None
) -> Float[Tensor, "*angle"]:
    """Compute the square root of the unpolarised Fresnel power reflectance of a half space.

    Fresnel coefficients with the factor ε − 1 extracted: r_s = −(ε−1)/(c+s)² and r_p =
    (ε−1)((ε+1)c² − 1)/(εc+s)² with c = cosθ, s² = ε − 1 + c². The amplitude and its gradient then
    stay finite at grazing incidence and for ε → 1. Where a permeability makes both zero, their
    derivative is, too.

    Args:
        permittivity: complex relative permittivity; broadcasts with the angles.
        cos_theta: cosine of the angle of incidence, in [0, 1].
        permeability: complex relative permeability; None = 1.

    Returns:
        sqrt((|r_s|² + |r_p|²)/2), in [0, 1].
    """
    if permeability is not None:
        found = fresnel_coefficients(permittivity, cos_theta, permeability)
        return safe_root((found.reflection_s.abs() ** 2 + found.reflection_p.abs() ** 2) / 2)
    cosine = cos_theta.clamp(min=LEAST_COSINE)
    sine = torch.sqrt(permittivity - 1 + cosine**2)
    perpendicular = 1 / (cosine + sine) ** 2
    parallel = ((permittivity + 1) * cosine**2 - 1) / (permittivity * cosine + sine) ** 2
    mean = (perpendicular.abs() ** 2 + parallel.abs() ** 2) / 2
    return (permittivity - 1).abs() * torch.sqrt(mean)


def safe_root(power: Float[Tensor, "*row"], least: float = _SAFE_POWER) -> Float[Tensor, "*row"]:
    """Compute √x, with a derivative of zero where x is, which is infinite by itself.

    Args:
        power: values x; negative ones are treated as zero.
        least: smaller values are treated as zero.
    """
    seen = power > least
    return torch.where(seen, torch.where(seen, power, 1.0).sqrt(), 0.0)


def fresnel_reflectance(permittivity: _Constants, cos_theta: _Cosines) -> Float[Tensor, "*angle"]:
    """Compute the unpolarised Fresnel power reflectance (|r_s|² + |r_p|²)/2 of a half space.

    Args:
        permittivity: complex relative permittivity; broadcasts with the angles.
        cos_theta: cosine of the angle of incidence, in [0, 1].
    """
    return fresnel_amplitude(permittivity, cos_theta) ** 2


def fresnel_transmittance(permittivity: _Constants, cos_theta: _Cosines) -> Float[Tensor, "*angle"]:
    """Compute the unpolarised power transmittance of a half space, one minus its reflectance. It is
    equal in the reverse direction at the refracted angle.

    Args:
        permittivity: complex relative permittivity; broadcasts with the angles.
        cos_theta: cosine of the angle of incidence from air, in [0, 1].
    """
    return 1 - fresnel_reflectance(permittivity, cos_theta)


def refractive_index(permittivity: Shaped[Tensor, "*row"]) -> Float64[Tensor, "*row"]:
    """Return the real refractive index n of √ε, of Snell's law sinθ = n sinθ'."""
    return torch.sqrt(permittivity).real


def attenuation(permittivity: Shaped[Tensor, "*row"], frequency: float) -> Float64[Tensor, "*row"]:
    """Compute the power attenuation per metre [1/m] of a medium: −2 (ω/c₀) Im √ε.

    Args:
        permittivity: complex relative permittivity.
        frequency: frequency [Hz].
    """
    return -4 * math.pi * frequency / SPEED_OF_LIGHT * torch.sqrt(permittivity).imag
