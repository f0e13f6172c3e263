"""Roughness: distribution of the reflected power over a specular lobe and others.

Effective roughness: the fraction 1 − S² of the reflected power is in a lobe about the specular
direction, whose width depends on the slopes of the surface. The fraction S² is scattered: into a
Lambertian part, a directive lobe about the specular direction, and a backscattering lobe.

Source: Degli-Esposti et al., "Measurement and modelling of scattering from buildings", 2007.

Differs from the source: weights are normalised by the lobes' integrals at normal incidence, where
these are largest, instead of at every angle, and the reflectance enters as sqrt(R(θi) R(θo)), which
makes the pattern reciprocal. The specular part has a width.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.scene.material.surface import LOBE_COUNT, SmoothInterface
from invertwin.scene.material.values import Value, checked_value, evaluate_value

SPECULAR_LOBE_WIDTH = math.radians(5.0)
ROUGH_LOBE_WIDTH = math.radians(20.0)
_ONE = torch.ones((), dtype=torch.float64)
ROUGH_SCATTERING = 0.4
"""S of building walls, as measured (Degli-Esposti et al. 2007)."""


class LobeWeights(NamedTuple):
    """Directional part of a `ScatteringLaw`."""

    diffuse: Float64[Tensor, "*row"]
    lobes: Float64[Tensor, "*row 3"]
    exponents: Float64[Tensor, "*row 3"]


def lobe_exponent(width: Value) -> Float64[Tensor, "*row"]:
    """Return the exponent p of a lobe ((1 + cosψ)/2)^p with a full width at half maximum [rad].

    It solves cos^2p(width/4) = 1/2; log1p keeps narrow lobes accurate.

    Raises:
        InputError: a width outside [3.4e-4, π].
    """
    checked_value(width, "lobe_width")
    return -math.log(2) / (2 * torch.log1p(-2 * torch.sin(evaluate_value(width) / 8) ** 2))


def slope_exponent(rms_slope: Value) -> Float64[Tensor, "*row"]:
    """Return the lobe exponent of a surface of small facets: p = 1/m², m the rms slope.

    A facet tilted by β reflects at 2β from the specular direction, where the lobe is cos^2p(β); for
    gentle slopes that is exp(−tan²β/m²), the distribution of Gaussian slopes (Beckmann).

    Args:
        rms_slope: root mean square of the height's gradient, in [1e-4, 1].

    Raises:
        InputError: a slope outside its range.
    """
    checked_value(rms_slope, "rms_slope")
    return evaluate_value(rms_slope) ** -2


def lobe_integral(exponent: Float64[Tensor, "*row"]) -> Float64[Tensor, "*row"]:
    """Compute ∫ ((1 + cosθ)/2)^p cosθ dω over the half space: the power at normal incidence."""
    p = exponent
    return 4 * math.pi * (p + torch.exp2(-(p + 1))) / ((p + 1) * (p + 2))


def specular_weights(
    diffuse: Float64[Tensor, "*#row"], exponent: Float64[Tensor, "*#row"]
) -> LobeWeights:
    """Return the weights of a Lambertian part, with the rest in the specular lobe.

    Args:
        diffuse: weight of the Lambertian part, 0 to 1.
        exponent: exponent of the specular lobe.
    """
    diffuse, exponent = torch.broadcast_tensors(diffuse, exponent)
    none = diffuse.new_zeros((*diffuse.shape, LOBE_COUNT - 1))
    weight = (1 - diffuse) / lobe_integral(exponent)
    lobes = (torch.cat([first[..., None], none], dim=-1) for first in (weight, exponent))
    return LobeWeights(diffuse, *lobes)


@dataclass(frozen=True, kw_only=True)
class EffectiveRoughness:
    """Effective roughness of a surface. Values may be per triangle, textures, and fitted.

    Attributes:
        scattering: S in [0, 1]; the fraction S² of the reflected power is scattered.
        rms_slope: root mean square slope of the surface, in [1e-4, 1]; it determines the width of
            the specular lobe (`slope_exponent`).
        lambertian: Lambertian fraction of the scattered power, in [0, 1].
        directive: fraction Λ of the rest in the directive lobe about the specular direction; the
            remainder is backscattered. In [0, 1].
        directive_exponent: α_R of the directive lobe, ((1 + cosψ)/2)^α_R.
        backscatter_exponent: α_i of the backscattering lobe.
        rms_height: rms height of the roughness [m]: attenuates coherent fields by exp(−½(2kσ
            cosθ)²) (`smooth_interface`). Power maps ignore it.
        depolarisation: fraction of the scattered power converted between V and H, in [0, 1/4]; 1/4
            is a cloud of thin wires. Coherent fields ignore it.
    """

    scattering: Value = 0.0
    rms_slope: Value = 0.1
    lambertian: Value = 1.0
    directive: Value = 1.0
    directive_exponent: Value = 4.0
    backscatter_exponent: Value = 4.0
    rms_height: Value = 0.0
    depolarisation: Value = 0.0

    def make_interface(
        self, permittivity: Tensor | None, thickness: Value = math.inf, permeability: Tensor = _ONE
    ) -> SmoothInterface:
        """Return the coherent interface, which keeps the fraction 1 − S² of the power.

        Args:
            permittivity: complex relative permittivity; None for a conductor.
            thickness: thickness of a sheet [m].
            permeability: complex relative permeability.
        """
        coherent = (1 - evaluate_value(self.scattering) ** 2).sqrt()
        depth, height = evaluate_value(thickness), evaluate_value(self.rms_height)
        return SmoothInterface(permittivity, depth, coherent, height, permeability)

    @property
    def depolarisation_terms(self) -> dict[str, Tensor]:
        """Return the depolarisation part of a `ScatteringLaw`."""
        return {"depolarisation": evaluate_value(self.depolarisation)}

    def weights(self) -> LobeWeights:
        """Return weights and exponents of the Lambertian part and the three lobes."""
        scattered = evaluate_value(self.scattering) ** 2
        lambertian, directive = evaluate_value(self.lambertian), evaluate_value(self.directive)
        directed = scattered * (1 - lambertian)
        shares = (1 - scattered, directed * directive, directed * (1 - directive))
        others = (self.directive_exponent, self.backscatter_exponent)
        exponents = (slope_exponent(self.rms_slope), *map(evaluate_value, others))
        diffuse, *rows = torch.broadcast_tensors(scattered * lambertian, *shares, *exponents)
        share, exponent = (torch.stack(r, -1) for r in (rows[:LOBE_COUNT], rows[LOBE_COUNT:]))
        return LobeWeights(diffuse, share / lobe_integral(exponent), exponent)
