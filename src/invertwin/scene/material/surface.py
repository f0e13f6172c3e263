"""Scattering laws: the material inputs of the ray kernel.

Every material provides the same small set of numbers, a `ScatteringLaw`, so that a new material
needs no kernel code. Its BRDF is

    f_r(ωi, ωo) = A(cosθi) A(cosθo) [ diffuse/π + Σ_l lobes_l ((1 + cosψ_l)/2)^exponents_l ],

with A the tabulated amplitude. The lobes are a specular one and a directive one about the specular
direction of ωi, cosψ = 2 (n·ωi)(n·ωo) − ωi·ωo, and a backscattering one about ωi itself, cosψ =
ωi·ωo; all directions point away from the surface. The BRDF is reciprocal and conserves energy: each
weight is the lobe's fraction of the power divided by its integral at normal incidence, where the
integral is largest (the lobe and the cosine share their axis). The specular lobe is also multiplied
by two roots of a fraction, `spread(cosθi) spread(cosθo)`: the coherent reflection of a smooth
surface is no part of its scattered power (`Material.incoherent_law`).

Transmitted power passes straight through a sheet (`transmittance`, longer by `extra_length`) or is
refracted into a solid body (`refraction`, `index`, `attenuation`).

Differs from the source: the paper leaves the scattering model open. Here the reflectance R of the
mean plane enters as sqrt(R(θi) R(θo)), which keeps reciprocity: a surface reflects R on average,
and exactly R where both angles agree.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene.material.fresnel import FieldCoefficients, fresnel_coefficients, safe_root
from invertwin.scene.material.slab import SlabLayer, sheet_coefficients

_Values: TypeAlias = Float64[Tensor, " n"]
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
    """Material inputs of the ray kernel at one frequency (see the module text).

    Tables run over cosθ = linspace(0, 1, 256) of the angle of incidence from outside. `*row` is
    empty for one value per object, or the number of triangles for values per triangle; a field with
    one value is repeated for all rows of the others. The defaults are those of an opaque Lambertian
    surface.

    Attributes:
        amplitude: square root of the power reflectance, mean of both polarisations.
        diffuse: weight of the Lambertian part.
        lobes: weights of the specular, directive and backscattering lobe, each already divided by
            the lobe's integral.
        exponents: exponents of the lobes.
        transmittance: power transmittance of a sheet; 0 if opaque.
        extra_length: extra path length of the transmission relative to air [m].
        refraction: power transmittance of one interface of a solid body; 0 if the surface does not
            bound a refracting body.
        index: real refractive index of that body, else 1.
        attenuation: power attenuation in that body [1/m], else 0.
        depolarisation: fraction of the scattered power converted between V and H.
        spread: root of the scattered fraction of the specular lobe; 1 = all of it.
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
        """Broadcast all fields to equal rows."""
        given = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        widths = {n: v.shape[v.ndim - (n not in _SCALARS) :] for n, v in given.items()}
        # NumPy's function: the first call of torch's takes seconds.
        rows = (values.shape[: values.ndim - len(widths[n])] for n, values in given.items())
        row = np.broadcast_shapes(*rows)
        for name, values in given.items():
            object.__setattr__(self, name, values.expand((*row, *widths[name])))

    def scale(self, share: Float64[Tensor, "*row"]) -> "ScatteringLaw":
        """Return the law with the scattered power scaled.

        Args:
            share: factor of each row.
        """
        return replace(self, diffuse=self.diffuse * share, lobes=self.lobes * share[..., None])

    def without_specular(self, interface: "SmoothInterface", frequency: float) -> "ScatteringLaw":
        """Return the law without the coherent specular reflection of `interface`.

        The fraction 1 − exp(−(2kσ cosθ)²) of the specular lobe's power remains: the power that
        rough heights remove from the coherent wave. A lobe normalised at normal incidence scatters
        less at other angles. The fraction is divided by this loss: the mean of cosθo over a
        Gaussian about cosθ of the lobe's variance 2/p, above the horizon.

        Args:
            interface: coherent interface of the surface.
            frequency: frequency [Hz].
        """
        height = interface.rms_height
        if not bool((height > 0).any()):
            return replace(self, lobes=self.lobes * self.lobes.new_tensor([0.0, 1.0, 1.0]))
        k = 2 * math.pi * frequency / SPEED_OF_LIGHT
        share = -torch.expm1(-((2 * k * height[..., None] * _COSINES) ** 2))
        at = _COSINES / (2 / self.exponents[..., :1]).sqrt()
        above = at * torch.special.ndtr(at) + torch.exp(-0.5 * at**2) / math.sqrt(2 * math.pi)
        share = share * above[..., -1:] / above
        return replace(self, spread=safe_root(share, 0.0))


class SmoothInterface(NamedTuple):
    """Coherent interface of a surface, with one value or one per triangle each.

    Attributes:
        permittivity: complex relative permittivity; None for a perfect conductor.
        thickness: thickness of a sheet centred on the surface [m]; infinite for a body.
        coherence: fraction of the reflected field in the specular direction, in [0, 1].
        rms_height: rms height of the roughness [m].
        permeability: complex relative permeability.
    """

    permittivity: Tensor | None
    thickness: Tensor
    coherence: Tensor
    rms_height: Tensor
    permeability: Tensor = _ONE

    def select_triangles(self, triangle: Int64[Tensor, " n"]) -> "SmoothInterface":
        """Return the values of some triangles; values for all triangles are kept."""
        epsilon, *others = (
            value if value is None or not value.ndim else value[triangle] for value in self
        )
        return SmoothInterface(epsilon, *others)  # type: ignore[arg-type]

    def coherent_reflection(self, frequency: float, cosine: _Values) -> _Values:
        """Return the coherent fraction of the reflected field: roughness spreads phases by 2kσ
        cosθ.

        Args:
            frequency: frequency [Hz].
            cosine: cosine of the angle of incidence.
        """
        k = 2 * math.pi * frequency / SPEED_OF_LIGHT
        return self.coherence * torch.exp(-0.5 * (2 * k * self.rms_height * cosine) ** 2)


class Material(ABC):
    """Electromagnetic material of a surface.

    Attributes:
        coherent: True if field paths follow physical optics, False if the surface is rough.
    """

    coherent: ClassVar[bool] = False

    @property
    def faces(self) -> int | None:
        """Number of triangles of its values; None if they hold for any."""
        return None

    def smooth_interface(self, frequency: float) -> SmoothInterface | None:
        """Return the coherent interface at `frequency` [Hz]; None for a purely rough surface.

        The default of a coherent material is a perfect conductor.
        """
        return SmoothInterface(None, _INFINITE, _ONE, _ZERO) if self.coherent else None

    def coefficients(
        self, frequency: float, cosine: _Values, triangle: Int64[Tensor, " n"]
    ) -> FieldCoefficients:
        """Return coherent field coefficients of reflection and transmission, about the mesh.

        A sheet is centred on its mesh, as in ``sheet_coefficients``; a body does not transmit; a
        purely rough surface has zero coefficients.

        Args:
            frequency: frequency [Hz].
            cosine: cosines of the angles of incidence, in [0, 1].
            triangle: index of the triangle of the object's mesh, for values per triangle.
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
            none = torch.zeros_like(skin.permittivity)  # dispersion, unused here
            sheet = SlabLayer(skin.permittivity, none, skin.thickness, skin.permeability)
            found = sheet_coefficients([sheet], cosine, frequency)
        else:
            half = fresnel_coefficients(skin.permittivity, cosine, skin.permeability)
            found = half._replace(transmission_s=0 * one, transmission_p=0 * one)
        return found.scale_reflection(kept)

    @abstractmethod
    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law at `frequency` [Hz]; its values keep their gradients."""

    def incoherent_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law without the coherent reflection of `coefficients`."""
        skin = self.smooth_interface(frequency)
        surface = self.scattering_law(frequency)
        return surface if skin is None else surface.without_specular(skin, frequency)
