"""Materials that come with the library."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Float64, Shaped
from torch import Tensor

from invertwin.constants import VACUUM_PERMITTIVITY
from invertwin.scene.checks import checked_number
from invertwin.scene.material.surface import ANGLE_COUNT, LOBE_COUNT, Material, Surface

MIRROR_LOBE_WIDTH = math.radians(5.0)
ROUGH_LOBE_WIDTH = math.radians(20.0)


def complex_permittivity(
    permittivity: float | Tensor, conductivity: float | Tensor, frequency: float
) -> Shaped[Tensor, ""]:
    """Relative complex permittivity ε = ε' − jσ/(ωε0) for exp(+jωt).

    Args:
        permittivity: real part ε' ≥ 1.
        conductivity: σ [S/m].
        frequency: [Hz].

    Raises:
        InputError: ε' < 1, σ < 0, or a frequency that is not positive.
    """
    checked_number(permittivity, "relative permittivity", 1.0)
    checked_number(conductivity, "conductivity [S/m]", 0.0)
    checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
    loss = _float64(conductivity) / (2 * math.pi * frequency * VACUUM_PERMITTIVITY)
    return torch.complex(_float64(permittivity), -loss)


def fresnel_amplitude(
    permittivity: Shaped[Tensor, ""], cos_theta: Float[Tensor, "*angle"]
) -> Float[Tensor, "*angle"]:
    """Square root of the unpolarised Fresnel power reflectance of a half space.

    The textbook coefficients, multiplied out so that the factor ε − 1 stands alone:
    r_s = −(ε−1)/(c+s)² and r_p = (ε−1)((ε+1)c² − 1)/(εc+s)² with c = cosθ, s² = ε − 1 + c².
    The amplitude and its gradient then stay finite at grazing incidence and for ε → 1.

    Args:
        permittivity: complex relative permittivity, 0-d.
        cos_theta: cosine of the angle of incidence, in [0, 1].

    Returns:
        sqrt((|r_s|² + |r_p|²)/2), in [0, 1].
    """
    # At c = 0 and ε = 1 both denominators vanish; the shift is far below rounding elsewhere.
    cosine = cos_theta.clamp(min=1e-9)
    sine = torch.sqrt(permittivity - 1 + cosine**2)
    perpendicular = 1 / (cosine + sine) ** 2
    parallel = ((permittivity + 1) * cosine**2 - 1) / (permittivity * cosine + sine) ** 2
    mean = (perpendicular.abs() ** 2 + parallel.abs() ** 2) / 2
    return (permittivity - 1).abs() * torch.sqrt(mean)


def fresnel_reflectance(
    permittivity: Shaped[Tensor, ""], cos_theta: Float[Tensor, "*angle"]
) -> Float[Tensor, "*angle"]:
    """Unpolarised Fresnel power reflectance (|r_s|² + |r_p|²)/2 of a half space.

    Args:
        permittivity: complex relative permittivity, 0-d.
        cos_theta: cosine of the angle of incidence, in [0, 1].
    """
    return fresnel_amplitude(permittivity, cos_theta) ** 2


def lobe_exponent(width: float | Tensor) -> Float64[Tensor, ""]:
    """Exponent p of a lobe ((1 + cosψ)/2)^p with the given full width at half maximum [rad].

    From cos^2p(width/4) = 1/2; log1p keeps narrow lobes accurate.

    Raises:
        InputError: a width outside (0, π].
    """
    checked_number(width, "lobe width [rad]", 0.0, math.pi, open_low=True)
    return -math.log(2) / (2 * torch.log1p(-2 * torch.sin(_float64(width) / 8) ** 2))


def lobe_integral(exponent: Float64[Tensor, ""]) -> Float64[Tensor, ""]:
    """∫ ((1 + cosθ)/2)^p cosθ dω over the half space: the lobe's power at normal incidence."""
    p = exponent
    return 4 * math.pi * (p + torch.exp2(-(p + 1))) / ((p + 1) * (p + 2))


@dataclass(frozen=True)
class PerfectConductor(Material):
    """A smooth perfect conductor: nothing is absorbed, nothing is scattered diffusely.

    Field paths treat it with physical optics. Power paths cannot see a mirror from a point
    antenna, so there it is a narrow lobe around the mirror direction.

    Attributes:
        lobe_width: full width at half maximum of that lobe [rad], in (0, π].

    Raises:
        InputError: a width outside its range.
    """

    lobe_width: float | Tensor = MIRROR_LOBE_WIDTH
    coherent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        lobe_exponent(self.lobe_width)

    def surface(self, frequency: float) -> Surface:
        """The reflectance at `frequency` [Hz], here the same at every frequency."""
        checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
        exponent = lobe_exponent(self.lobe_width)
        return Surface.opaque(
            torch.ones(ANGLE_COUNT, dtype=torch.float64),
            torch.zeros((), dtype=torch.float64),
            _specular_only(1 / lobe_integral(exponent)),
            _specular_only(exponent),
        )


@dataclass(frozen=True)
class RoughDielectric(Material):
    """A rough half space: Fresnel reflectance, spread diffusely and into a lobe.

    Attributes:
        permittivity: relative permittivity ε' ≥ 1.
        conductivity: σ [S/m] ≥ 0.
        diffuse: fraction of the reflected power in the Lambertian part, in [0, 1]; the rest goes
            into the lobe.
        lobe_width: full width at half maximum of the lobe around the mirror direction [rad],
            in (0, π].

    All may be floats or 0-d tensors with gradients.

    Raises:
        InputError: a value outside its range.
    """

    permittivity: float | Tensor
    conductivity: float | Tensor = 0.0
    diffuse: float | Tensor = 1.0
    lobe_width: float | Tensor = ROUGH_LOBE_WIDTH
    coherent: ClassVar[bool] = False

    def __post_init__(self) -> None:
        checked_number(self.permittivity, "relative permittivity", 1.0)
        checked_number(self.conductivity, "conductivity [S/m]", 0.0)
        checked_number(self.diffuse, "diffuse fraction", 0.0, 1.0)
        lobe_exponent(self.lobe_width)

    def surface(self, frequency: float) -> Surface:
        """The reflectance at `frequency` [Hz]; differentiable in all four values."""
        cosine = torch.linspace(0, 1, ANGLE_COUNT, dtype=torch.float64)
        epsilon = complex_permittivity(self.permittivity, self.conductivity, frequency)
        diffuse = _float64(self.diffuse)
        exponent = lobe_exponent(self.lobe_width)
        return Surface.opaque(
            fresnel_amplitude(epsilon, cosine),
            diffuse,
            _specular_only((1 - diffuse) / lobe_integral(exponent)),
            _specular_only(exponent),
        )


def _float64(value: float | Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)


def _specular_only(value: Tensor) -> Tensor:
    """A row of values of the lobes in which all but the first are zero."""
    return torch.cat([value[..., None], value.new_zeros((*value.shape, LOBE_COUNT - 1))], dim=-1)
