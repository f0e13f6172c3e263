"""What a surface does to the power that meets it: the one thing the ray kernel knows of a material.

Every material hands the ray kernel the same small set of numbers, a `ScatteringLaw`, so that a new
material needs no kernel code. What is reflected follows the distribution

    f_r(ωi, ωo) = A(cosθi) A(cosθo) [ diffuse/π + Σ_l lobes_l ((1 + cosψ_l)/2)^exponents_l ],

with A the tabulated amplitude. The lobes are a specular one and a directive one about the mirror
direction of ωi, cosψ = 2 (n·ωi)(n·ωo) − ωi·ωo, and a backscattering one about ωi itself,
cosψ = ωi·ωo; all directions point away from the surface. The distribution is reciprocal, and
reflects at most what came in: each weight is the lobe's share of the power divided by its integral
at normal incidence, where the integral is largest (the lobe and the cosine share their axis).
The specular lobe is also multiplied by two roots of a share, `spread(cosθi) spread(cosθo)`: what a
smooth surface mirrors as one wave is no part of what it scatters (`Material.incoherent`).

What passes goes straight through a sheet (`transmittance`, longer by `extra_length`) or is
refracted into a solid body (`refraction`, `index`, `attenuation`).

Differs from the source: the paper leaves the scattering model open. Here the reflectance R of the
mean plane enters as sqrt(R(θi) R(θo)), which keeps reciprocity, so that a surface sends back R on
average and R exactly where both angles agree.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene.material.fresnel import FieldCoefficients, fresnel_coefficients
from invertwin.scene.material.slab import SlabLayer, sheet_coefficients

ANGLE_COUNT = 256
"""Nodes of the tables over the angle of incidence, at cosθ = linspace(0, 1, 256)."""
LOBE_COUNT = 3
"""Lobes of a surface: specular, directive, backscattering."""
_SCALARS = ("diffuse", "index", "attenuation", "depolarisation")  # the other fields are tables


_NO_LOBES = torch.zeros(LOBE_COUNT, dtype=torch.float64)
_ZERO_TABLE = torch.zeros(ANGLE_COUNT, dtype=torch.float64)
_UNIT_TABLE = torch.ones(ANGLE_COUNT, dtype=torch.float64)
_COSINES = torch.linspace(0, 1, ANGLE_COUNT, dtype=torch.float64)
_ZERO, _ONE = _ZERO_TABLE[0], torch.ones((), dtype=torch.float64)
_INFINITE = torch.full((), torch.inf, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class ScatteringLaw:
    """What the ray kernel needs to know of a material at one frequency (see the module text).

    Tables run over cosθ = linspace(0, 1, 256) of the angle of incidence from outside. `*row` is
    empty for one value per object, or the number of triangles for values per triangle; a field
    with one value is repeated for all rows of the others. The defaults are those of a Lambertian
    surface that lets nothing through.

    Attributes:
        amplitude: square root of the power reflectance, mean of both polarisations.
        diffuse: weight of the Lambertian part.
        lobes: weights of the specular, directive and backscattering lobe, each already divided by
            the lobe's integral.
        exponents: their exponents.
        transmittance: share of the power that passes straight through a sheet; 0 if opaque.
        extra_length: what passing adds to the straight path through air [m].
        refraction: share of the power that one interface lets into a solid body; 0 if the surface
            is not the skin of a refracting body.
        index: real refractive index of that body, else 1.
        attenuation: power attenuation in that body [1/m], else 0.
        depolarisation: share of the scattered power that goes from V to H and from H to V.
        spread: root of the share of the specular lobe that is scattered; 1 = all of it.
    """

    amplitude: Float64[Tensor, "*#row 256"]
    diffuse: Float64[Tensor, "*#row"]
    lobes: Float64[Tensor, "*#row 3"] = _NO_LOBES
    exponents: Float64[Tensor, "*#row 3"] = _NO_LOBES
    transmittance: Float64[Tensor, "*#row 256"] = _ZERO_TABLE
    extra_length: Float64[Tensor, "*#row 256"] = _ZERO_TABLE
    refraction: Float64[Tensor, "*#row 256"] = _ZERO_TABLE
    index: Float64[Tensor, "*#row"] = _ONE
    attenuation: Float64[Tensor, "*#row"] = _ZERO
    depolarisation: Float64[Tensor, "*#row"] = _ZERO
    spread: Float64[Tensor, "*#row 256"] = _UNIT_TABLE

    def __post_init__(self) -> None:
        """Give all fields the same rows."""
        given = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        widths = {n: v.shape[v.ndim - (n not in _SCALARS) :] for n, v in given.items()}
        # NumPy's: torch's takes seconds where it is first called.
        row = np.broadcast_shapes(
            *(values.shape[: values.ndim - len(widths[n])] for n, values in given.items())
        )
        for name, values in given.items():
            object.__setattr__(self, name, values.expand((*row, *widths[name])))

    def scale(self, share: Float64[Tensor, "*row"]) -> "ScatteringLaw":
        """The surface with this share of what it scatters.

        Args:
            share: of each row.
        """
        return replace(self, diffuse=self.diffuse * share, lobes=self.lobes * share[..., None])

    def without_specular(self, interface: "SmoothInterface", frequency: float) -> "ScatteringLaw":
        """The surface without what `skin` keeps together in the mirror direction.

        Of the specular lobe's power the share 1 − exp(−(2kσ cosθ)²) is left: what heights take off
        the mirrored wave. A lobe that is normalised at normal incidence sends back less at other
        angles. The share is divided by how much: the mean of cosθo, with cosθo spread about cosθ
        like a Gaussian of the lobe's variance 2/p, where it is above the horizon.

        Args:
            interface: what the surface does to fields.
            frequency: [Hz].
        """
        height = interface.rms_height
        if not bool((height > 0).any()):
            return replace(self, lobes=self.lobes * self.lobes.new_tensor([0.0, 1.0, 1.0]))
        k = 2 * math.pi * frequency / SPEED_OF_LIGHT
        share = -torch.expm1(-((2 * k * height[..., None] * _COSINES) ** 2))
        width = (2 / self.exponents[..., :1]).sqrt()
        at = _COSINES / width
        above = at * torch.special.ndtr(at) + torch.exp(-0.5 * at**2) / math.sqrt(2 * math.pi)
        share = share * above[..., -1:] / above
        lit = share > 0  # a root of zero has no derivative
        return replace(self, spread=torch.where(lit, torch.where(lit, share, 1.0).sqrt(), 0.0))


class SmoothInterface(NamedTuple):
    """What a smooth surface does to fields, with one value or one per triangle each.

    Attributes:
        permittivity: complex relative permittivity; None of a perfect conductor.
        thickness: of a sheet about the surface [m]; infinite for a body.
        coherence: share of the reflected field that stays in the mirror direction, in [0, 1].
        rms_height: of the roughness [m].
    """

    permittivity: Tensor | None
    thickness: Tensor
    coherence: Tensor
    rms_height: Tensor

    def select_triangles(self, triangle: Int64[Tensor, " n"]) -> "SmoothInterface":
        """The values of some triangles; values for all triangles stay."""
        epsilon, *others = (
            value if value is None or not value.ndim else value[triangle] for value in self
        )
        return SmoothInterface(epsilon, *others)  # type: ignore[arg-type]

    def coherent_reflection(
        self, frequency: float, cosine: Float64[Tensor, " n"]
    ) -> Float64[Tensor, " n"]:
        """Share of the mirrored field that stays coherent: roughness spreads phases by 2kσ cosθ.

        Args:
            frequency: [Hz].
            cosine: of the angle of incidence.
        """
        k = 2 * math.pi * frequency / SPEED_OF_LIGHT
        return self.coherence * torch.exp(-0.5 * (2 * k * self.rms_height * cosine) ** 2)


class Material(ABC):
    """What an object's surface does to the waves.

    Attributes:
        coherent: True if field paths follow physical optics, False if the surface is rough.
    """

    coherent: ClassVar[bool] = False

    @property
    def faces(self) -> int | None:
        """The number of triangles that its values are for; None if they hold for any."""
        return None

    def smooth_interface(self, frequency: float) -> SmoothInterface | None:
        """What the surface does to fields at `frequency` [Hz]; None if it is only rough.

        A coherent material is a perfect conductor, unless it says otherwise.
        """
        return SmoothInterface(None, _INFINITE, _ONE, _ZERO) if self.coherent else None

    def coefficients(
        self, frequency: float, cosine: Float64[Tensor, " n"], triangle: Int64[Tensor, " n"]
    ) -> FieldCoefficients:
        """Coherent fields that the surface reflects and lets through, about the mesh.

        A sheet is centred on its mesh, as in ``sheet_coefficients``; a body lets nothing through;
        a surface that is only rough does neither.

        Args:
            frequency: [Hz].
            cosine: of the angles of incidence, in [0, 1].
            triangle: the triangle of the object's mesh that is met, for values per triangle.
        """
        skin = self.smooth_interface(frequency)
        one = torch.ones_like(cosine).to(torch.complex128)
        if skin is None:
            return FieldCoefficients(0 * one, 0 * one, 0 * one, 0 * one)
        skin = skin.select_triangles(triangle)
        kept = skin.coherent_reflection(frequency, cosine)
        if skin.permittivity is None:
            return FieldCoefficients(-kept * one, kept * one, 0 * one, 0 * one)
        if bool(torch.isfinite(skin.thickness).all()):
            none = torch.zeros_like(skin.permittivity)  # dispersion, of which nothing here depends
            sheet = SlabLayer(skin.permittivity, none, skin.thickness)
            found = sheet_coefficients([sheet], cosine, frequency)
        else:
            half = fresnel_coefficients(skin.permittivity, cosine)
            found = half._replace(transmission_s=0 * one, transmission_p=0 * one)
        return found.scale_reflection(kept)

    @abstractmethod
    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """What the surface does at `frequency` [Hz]; its values keep their gradients."""

    def incoherent_law(self, frequency: float) -> ScatteringLaw:
        """What it does beside mirroring: `surface` without what `coefficients` reflect."""
        skin = self.smooth_interface(frequency)
        surface = self.scattering_law(frequency)
        return surface if skin is None else surface.without_specular(skin, frequency)
