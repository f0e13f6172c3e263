"""Roughness: how the reflected power is split between a mirror-like lobe and others.

Effective roughness: the part 1 − S² of the reflected power stays about the mirror direction, in a
glossy lobe. The slopes of the surface set the width of this lobe. The part S² is scattered: into a
Lambertian part, a directive lobe about the mirror direction, and a lobe back to the source.

Source: Degli-Esposti et al., "Measurement and modelling of scattering from buildings", 2007.

Differs from the source: weights are normalised by the lobes' integrals at normal incidence, where
these are largest, instead of at every angle, and the reflectance enters as sqrt(R(θi) R(θo)); the
pattern is then reciprocal. The specular part has a width.
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
ROUGH_SCATTERING = 0.4
"""S of building walls, as measured (Degli-Esposti et al. 2007)."""


class LobeWeights(NamedTuple):
    """The part of a `ScatteringLaw` that says where the reflected power goes."""

    diffuse: Float64[Tensor, "*row"]
    lobes: Float64[Tensor, "*row 3"]
    exponents: Float64[Tensor, "*row 3"]


def lobe_exponent(width: Value) -> Float64[Tensor, "*row"]:
    """Exponent p of a lobe ((1 + cosψ)/2)^p with the given full width at half maximum [rad].

    From cos^2p(width/4) = 1/2; log1p keeps narrow lobes accurate.

    Raises:
        InputError: a width outside [3.4e-4, π].
    """
    checked_value(width, "lobe_width")
    return -math.log(2) / (2 * torch.log1p(-2 * torch.sin(evaluate_value(width) / 8) ** 2))


def slope_exponent(rms_slope: Value) -> Float64[Tensor, "*row"]:
    """Exponent of the lobe that a surface of small facets makes: p = 1/m², m the rms slope.

    A facet tilted by β reflects by 2β off the mirror direction, where the lobe is cos^2p(β); for
    gentle slopes that is exp(−tan²β/m²), the distribution of Gaussian slopes (Beckmann).

    Args:
        rms_slope: root mean square of the height's gradient, in [1e-4, 1].

    Raises:
        InputError: a slope outside its range.
    """
    checked_value(rms_slope, "rms_slope")
    return evaluate_value(rms_slope) ** -2


def lobe_integral(exponent: Float64[Tensor, "*row"]) -> Float64[Tensor, "*row"]:
    """∫ ((1 + cosθ)/2)^p cosθ dω over the half space: the lobe's power at normal incidence."""
    p = exponent
    return 4 * math.pi * (p + torch.exp2(-(p + 1))) / ((p + 1) * (p + 2))


def specular_weights(
    diffuse: Float64[Tensor, "*#row"], exponent: Float64[Tensor, "*#row"]
) -> LobeWeights:
    """Weights of a Lambertian part, with the rest in the specular lobe.

    Args:
        diffuse: Lambertian part, 0 to 1.
        exponent: exponent of the specular lobe.
    """
    diffuse, exponent = torch.broadcast_tensors(diffuse, exponent)
    none = diffuse.new_zeros((*diffuse.shape, LOBE_COUNT - 1))
    weight = (1 - diffuse) / lobe_integral(exponent)
    return LobeWeights(
        diffuse,
        torch.cat([weight[..., None], none], dim=-1),
        torch.cat([exponent[..., None], none], dim=-1),
    )


@dataclass(frozen=True, kw_only=True)
class EffectiveRoughness:
    """How the reflected power is spread. Values may be per triangle, a texture, and be fitted.

    Attributes:
        scattering: S in [0, 1]; the share S² of the reflected power is scattered.
        rms_slope: root mean square slope of the surface, in [1e-4, 1]; it makes the width of the
            lobe that holds the rest (`slope_exponent`).
        lambertian: share of the scattered power that goes in all directions alike, in [0, 1].
        directive: share Λ of the rest that goes into the directive lobe about the mirror direction;
            what is left goes back towards the source. In [0, 1].
        directive_exponent: α_R of the directive lobe, ((1 + cosψ)/2)^α_R.
        backscatter_exponent: α_i of the backscattering lobe.
        rms_height: of the roughness [m]: takes exp(−½(2kσ cosθ)²) off coherent fields (`skin`).
            Power maps do not see it.
        depolarisation: share of the scattered power that goes from V to H and from H to V, in
            [0, 1/4]; 1/4 is a cloud of thin wires. Coherent fields do not see it.
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
        self, permittivity: Tensor | None, thickness: Value = math.inf
    ) -> SmoothInterface:
        """What the surface does to fields: the share 1 − S² of the power stays coherent.

        Args:
            permittivity: complex and relative; None of a conductor.
            thickness: of a sheet [m].
        """
        coherent = (1 - evaluate_value(self.scattering) ** 2).sqrt()
        return SmoothInterface(
            permittivity, evaluate_value(thickness), coherent, evaluate_value(self.rms_height)
        )

    @property
    def depolarisation_terms(self) -> dict[str, Tensor]:
        """The part of a `ScatteringLaw` that says what changes its polarisation."""
        return {"depolarisation": evaluate_value(self.depolarisation)}

    def weights(self) -> LobeWeights:
        """Weights and exponents of the Lambertian part and the three lobes."""
        scattered = evaluate_value(self.scattering) ** 2
        lambertian, directive = evaluate_value(self.lambertian), evaluate_value(self.directive)
        directed = scattered * (1 - lambertian)
        shares = (1 - scattered, directed * directive, directed * (1 - directive))
        exponents = (
            slope_exponent(self.rms_slope),
            evaluate_value(self.directive_exponent),
            evaluate_value(self.backscatter_exponent),
        )
        diffuse, *rows = torch.broadcast_tensors(scattered * lambertian, *shares, *exponents)
        exponent = torch.stack(rows[LOBE_COUNT:], dim=-1)
        return LobeWeights(
            diffuse, torch.stack(rows[:LOBE_COUNT], dim=-1) / lobe_integral(exponent), exponent
        )
