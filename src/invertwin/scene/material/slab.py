"""Layered sheets in air: reflectance, transmittance and group delay.

A plane wave in layer j has the normal wave number k s_j, s_j² = ε_j μ_j − sin²θ, and crosses it
with the phase δ_j = k s_j d_j. With u_j = s_j/μ_j for perpendicular and s_j/ε_j for parallel
polarisation, every interface has r = (u_i − u_j)/(u_i + u_j) and t = 2u_i/(u_i + u_j), and one more
layer in front of a stack (r', t') makes

    r = (r_i + x)/(1 + r_i x),   t = t_i t' e^(−jδ)/(1 + r_i x),   x = r' e^(−2jδ).

This form of the transfer-matrix product contains only decaying exponentials, so that thick lossy
layers neither overflow nor cancel.

Phase convention: the transmission coefficient includes the propagation through the thickness, from
the entry face to the exit face. The ray's geometric length is that of the straight line, which
crosses the same thickness of air, d cosθ of phase. The extra length is the group delay of their
ratio, times c₀:

    extra = −c₀ ∂(arg t)/∂ω − d cosθ,

at fixed θ, to first order in d over the distance of the antennas the extra length of the true,
displaced ray (Fermat). It enters the delay, never the coefficient, so nothing is counted twice.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import checked_type
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.material.fresnel import LEAST_COSINE, FieldCoefficients

_Angles: TypeAlias = Float64[Tensor, "*angle"]
_ONE = torch.ones((), dtype=torch.float64)


class SlabLayer(NamedTuple):
    """Layer as numbers: each 0-d or one per triangle with a last axis of 1 for the angles.

    Attributes:
        permittivity: complex relative permittivity ε.
        dispersion: ω dε/dω.
        thickness: thickness [m].
        permeability: complex relative permeability μ, without dispersion.
    """

    permittivity: Tensor
    dispersion: Tensor
    thickness: Tensor
    permeability: Tensor = _ONE


class SlabTables(NamedTuple):
    """Power coefficients of a slab, averaged over both polarisations, and its extra length [m]."""

    reflectance: _Angles
    transmittance: _Angles
    extra_length: _Angles


class _Response(NamedTuple):
    """Reflection and transmission of a stack for one polarisation.

    `slope` of a value is its derivative ω d/dω; that of the transmission is of its logarithm, which
    is finite for vanishing transmission.
    """

    reflection: Tensor
    reflection_slope: Tensor
    transmission: Tensor
    log_power: Tensor
    transmission_slope: Tensor


def slab_coefficients(
    layers: Sequence[SlabLayer], cos_theta: _Angles, frequency: float
) -> FieldCoefficients:
    """Compute complex field coefficients of a stack of layers in air, for both polarisations.

    The transmission is from the entry face to the exit face, at equal lateral positions.

    Args:
        layers: layers from ``Layer.sheet``, in the order of incidence.
        cos_theta: cosine of the angle of incidence, in [0, 1].
        frequency: frequency [Hz].

    Raises:
        InputError: no layers, or layers without a frequency.
    """
    s, p = _both_polarisations(layers, cos_theta, frequency)
    return FieldCoefficients(s.reflection, p.reflection, s.transmission, p.transmission)


def sheet_coefficients(
    layers: Sequence[SlabLayer], cos_theta: _Angles, frequency: float
) -> FieldCoefficients:
    """Compute coefficients of a stack for rays that treat its mesh as a sheet without thickness.

    The mesh is the middle of the stack, and the length of a ray is that of the straight line
    through air. The stack begins d/2 before the mesh, so that both coefficients of
    ``slab_coefficients`` gain the factor exp(+jkd cosθ).

    Args:
        layers: layers in the order of incidence.
        cos_theta: cosine of the angle of incidence, in [0, 1].
        frequency: frequency [Hz].

    Raises:
        InputError: no layers.

    Source: derivations §10.
    """
    faces = slab_coefficients(layers, cos_theta, frequency)
    wave_number = 2 * math.pi * frequency / SPEED_OF_LIGHT
    through_air = wave_number * sum(layer.thickness for layer in layers) * cos_theta
    turn = torch.polar(torch.ones_like(through_air), through_air)
    return FieldCoefficients(*(turn * value for value in faces))


def slab_tables(layers: Sequence[SlabLayer], cos_theta: _Angles, frequency: float) -> SlabTables:
    """Compute reflectance, transmittance and extra length of a stack of layers in air.

    Power coefficients are the mean of both polarisations; so is the extra length, weighted by the
    transmitted power of each. Differentiable with respect to the layers' values.

    Args:
        layers: layers in the order of incidence.
        cos_theta: cosine of the angle of incidence, in [0, 1].
        frequency: frequency [Hz].

    Raises:
        InputError: no layers.
    """
    responses = _both_polarisations(layers, cos_theta, frequency)
    s, p = responses
    wave_number = 2 * math.pi * frequency / SPEED_OF_LIGHT
    through_air = sum(layer.thickness for layer in layers) * cos_theta
    extra_s, extra_p = (
        -response.transmission_slope.imag / wave_number - through_air for response in responses
    )
    # Fraction of s in the transmitted power, from logarithms: both powers may underflow.
    share = torch.sigmoid(s.log_power - p.log_power)
    return SlabTables(
        (_power(s.reflection) + _power(p.reflection)) / 2,
        (s.log_power.exp() + p.log_power.exp()) / 2,
        share * extra_s + (1 - share) * extra_p,
    )


def _both_polarisations(
    layers: Sequence[SlabLayer], cos_theta: Tensor, frequency: float
) -> tuple[_Response, _Response]:
    if not layers:
        raise InputError("expected at least one layer, got none; give the layers of the slab")
    for layer in layers:
        checked_type(layer, SlabLayer, "layers at a frequency", "give layer.sheet(f)")
    cosine = cos_theta.clamp(min=LEAST_COSINE)
    s, p = (_response(layers, cosine, frequency, parallel=parallel) for parallel in (False, True))
    return s, p


def _response(
    layers: Sequence[SlabLayer], cosine: Tensor, frequency: float, *, parallel: bool
) -> _Response:
    """Return the stack's coefficients of tangential E (perpendicular) or H (parallel)."""
    wave_number = 2 * math.pi * frequency / SPEED_OF_LIGHT
    air = cosine.to(torch.complex128)
    media, phases = [(air, torch.zeros_like(air))], []
    for layer in layers:
        mu = layer.permeability
        root = torch.sqrt(layer.permittivity * mu - 1 + cosine**2)
        root_slope = mu * layer.dispersion / (2 * root)
        thickness = wave_number * layer.thickness
        phases.append((thickness * root, thickness * (root + root_slope)))
        if parallel:
            u = root / layer.permittivity
            media.append((u, (root_slope - u * layer.dispersion) / layer.permittivity))
        else:
            media.append((root / mu, root_slope / mu))
    media.append(media[0])
    total = _interface(media[-2], media[-1])
    for k in reversed(range(len(layers))):
        total = _prepend_layer(_interface(media[k], media[k + 1]), phases[k], total)
    return total


def _interface(before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]) -> _Response:
    (u, u_slope), (v, v_slope) = before, after
    both = u + v
    transmission = 2 * u / both
    return _Response(
        (u - v) / both,
        2 * (u_slope * v - u * v_slope) / both**2,
        transmission,
        torch.log(_power(transmission)),
        (u_slope * v - u * v_slope) / (u * both),
    )


def _prepend_layer(face: _Response, phase: tuple[Tensor, Tensor], rest: _Response) -> _Response:
    """Add a layer, entered through `face`, in front of the rest of the stack."""
    delta, delta_slope = phase
    once = torch.exp(-1j * delta)
    x = rest.reflection * once**2
    x_slope = (rest.reflection_slope - 2j * delta_slope * rest.reflection) * once**2
    echo = 1 + face.reflection * x
    echo_slope = face.reflection_slope * x + face.reflection * x_slope
    reflection = (face.reflection + x) / echo
    return _Response(
        reflection,
        (face.reflection_slope + x_slope - reflection * echo_slope) / echo,
        face.transmission * rest.transmission * once / echo,
        face.log_power + rest.log_power + 2 * delta.imag - torch.log(_power(echo)),
        face.transmission_slope + rest.transmission_slope - 1j * delta_slope - echo_slope / echo,
    )


def _power(field: Tensor) -> Tensor:
    return field.real**2 + field.imag**2
