"""Materials of the library.

Every value may be a number, one number per triangle of the mesh, or a `Texture`, and may carry
gradients; permittivity and conductivity may also be entries of the ITU table (`Itu`). A value out
of range raises `InputError`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, ClassVar, TypeVar

import torch
from annotated_types import MinLen
from jaxtyping import Float64, Int64, Shaped
from torch import Tensor

from invertwin.checks import checked_number
from invertwin.errors import InputError
from invertwin.limits import RADIANS
from invertwin.scene.material import fresnel, roughness
from invertwin.scene.material.itu import Itu
from invertwin.scene.material.slab import SlabLayer, sheet_coefficients, slab_tables
from invertwin.scene.material.surface import ANGLE_COUNT, Material, ScatteringLaw, SmoothInterface
from invertwin.scene.material.values import RANGES, Value, checked_value, evaluate_value, row_count

AnyMedium = TypeVar("AnyMedium", bound="Medium")
_COSINES = torch.linspace(0, 1, ANGLE_COUNT, dtype=torch.float64)
_FULL_REFLECTANCE = torch.ones_like(_COSINES)


class _MaterialRecord:
    """Dataclass with validated fields and a common number of triangles."""

    def __new__(cls, *values: object, **named: object) -> Any:
        """Reject unknown fields with an error of this package."""
        names = {entry.name: entry.kw_only for entry in fields(cls)}  # type: ignore[arg-type]
        bare = [name for name, by_name in names.items() if not by_name]
        others = [repr(value) for value in values[len(bare) :]]
        others += [name for name in named if name not in names]
        if others:
            raise InputError(
                f"expected values of {cls.__name__} by name ({', '.join(names)}), got "
                f"{others[0]}; such as {cls.__name__}({next(reversed(names))}=...)"
            )
        return super().__new__(cls)

    def __post_init__(self) -> None:
        for name in _value_names(self):
            value = getattr(self, name)
            if not (isinstance(value, Itu) and name in ("permittivity", "conductivity")):
                object.__setattr__(self, name, checked_value(value, name))
        _ = self.faces

    @property
    def faces(self) -> int | None:
        """Number of triangles of the values; None if they hold for any."""
        return row_count({name: getattr(self, name) for name in _value_names(self)})


@dataclass(frozen=True)
class Medium(_MaterialRecord):
    """Dielectric or magnetic medium, by numbers or from the ITU table.

    Attributes:
        permittivity: relative permittivity ε' ≥ 1.
        conductivity: conductivity σ ≥ 0 [S/m].
        loss_tangent: tanδ ≥ 0 of other losses: ε = ε' (1 − j tanδ) − jσ/(ωε0).
        permeability: relative permeability μ' > 0.
        magnetic_loss_tangent: tanδ_m ≥ 0: μ = μ' (1 − j tanδ_m), at all frequencies.

    Raises:
        InputError: a value outside its range.
    """

    permittivity: Value | Itu
    conductivity: Value | Itu = 0.0
    loss_tangent: Value = field(default=0.0, kw_only=True)
    permeability: Value = field(default=1.0, kw_only=True)
    magnetic_loss_tangent: Value = field(default=0.0, kw_only=True)

    @property
    def complex_permeability(self) -> Shaped[Tensor, "*row"]:
        """Relative permeability μ."""
        loss = evaluate_value(self.magnetic_loss_tangent)
        return evaluate_value(self.permeability) * (1 - 1j * loss)

    @property
    def is_magnetic(self) -> bool:
        """True if μ is not simply 1."""
        values = self.permeability, self.magnetic_loss_tangent
        return not all(isinstance(value, int | float) for value in values) or values != (1, 0)

    @classmethod
    def itu(cls: type[AnyMedium], name: str, **values: object) -> AnyMedium:
        """Return the material with permittivity and conductivity of ITU-R P.2040.

        Args:
            name: e.g. "concrete"; all are in `ITU_MATERIALS`.
            values: the other fields, by name.

        Raises:
            InputError: an unknown name (the nearest ones are named), or a value out of range.
        """
        return cls(permittivity=Itu(name), conductivity=Itu(name), **values)  # type: ignore[arg-type]

    def complex_permittivity(self, frequency: float) -> Shaped[Tensor, "*row"]:
        """Return ε at `frequency` [Hz]. Warns (`OutsideTableWarning`) outside the ITU table."""
        return self._epsilon(frequency)[0]

    def _amplitude(self, frequency: float) -> Tensor:
        """Return the root of the reflectance of a half space, over the nodes of the tables."""
        epsilon = self.complex_permittivity(frequency)[..., None]
        mu = self.complex_permeability[..., None] if self.is_magnetic else None
        return fresnel.fresnel_amplitude(epsilon, _COSINES, mu)

    def _epsilon(self, frequency: float) -> tuple[Tensor, Tensor]:
        """Return ε and its dispersion ω dε/dω."""
        # A power law f^b has the logarithmic derivative b, and σ/ω that of σ minus one.
        real, real_slope = self.permittivity, 0.0
        if isinstance(real, Itu):
            real, real_slope = real.permittivity(frequency), real.coefficients(frequency).b
        sigma, sigma_slope = self.conductivity, 0.0
        if isinstance(sigma, Itu):
            sigma, sigma_slope = sigma.conductivity(frequency), sigma.coefficients(frequency).d
        epsilon = fresnel.complex_permittivity(real, sigma, frequency, self.loss_tangent)
        polarised = evaluate_value(real) * (1 - 1j * evaluate_value(self.loss_tangent))
        return epsilon, real_slope * polarised + (sigma_slope - 1) * (epsilon - polarised)


def select_layer(material: Any, layer: int | None, name: str) -> Any:
    """Return the holder of material values: the material, or one of its layers.

    Args:
        material: material such as a `Multilayer`.
        layer: index of the layer, from 0; None = the material itself.
        name: name of the material in the error.

    Raises:
        InputError: no such layer.
    """
    if layer is None:
        return material
    layers = getattr(material, "layers", ())
    if layer >= len(layers):
        raise InputError(
            f"expected a layer below {len(layers)} of {name}, got {layer}; "
            "count layers from 0, and give `layer` for a Multilayer only"
        )
    return layers[layer]


@dataclass(frozen=True)
class PerfectConductor(_MaterialRecord, Material):
    """Smooth perfect conductor without absorption and diffuse scattering.

    Field paths use physical optics. Random power paths never hit an exact specular direction, so
    there it is a narrow lobe around that direction.

    Attributes:
        lobe_width: full width at half maximum of that lobe [rad], in [3.4e-4, π].

    Raises:
        InputError: a width outside its range.
    """

    lobe_width: Annotated[Value, RADIANS] = roughness.SPECULAR_LOBE_WIDTH
    coherent: ClassVar[bool] = True

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law, equal at every `frequency` [Hz]."""
        checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
        nothing = torch.zeros((), dtype=torch.float64)
        weights = roughness.specular_weights(nothing, roughness.lobe_exponent(self.lobe_width))
        return ScatteringLaw(_FULL_REFLECTANCE, *weights)


@dataclass(frozen=True)
class RoughConductor(_MaterialRecord, roughness.EffectiveRoughness, Material):
    """Perfect conductor with a rough surface, which scatters all power.

    Its fields are those of `EffectiveRoughness`; a rough surface scatters by default.
    """

    scattering: Value = field(default=roughness.ROUGH_SCATTERING, kw_only=True)

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law, equal at every `frequency` [Hz]."""
        checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
        return ScatteringLaw(_FULL_REFLECTANCE, *self.weights(), **self.depolarisation_terms)

    def smooth_interface(self, frequency: float) -> SmoothInterface | None:
        """Return the coherent interface at `frequency` [Hz]."""
        checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
        return self.make_interface(None)


@dataclass(frozen=True)
class RoughDielectric(Medium, Material):
    """Rough half space with two roughness values: Fresnel reflectance, split into a diffuse part
    and a lobe.

    Attributes:
        permittivity, conductivity, loss_tangent, permeability, magnetic_loss_tangent: see `Medium`.
        diffuse: fraction of the reflected power in the Lambertian part, in [0, 1]; the rest goes
            into the lobe.
        lobe_width: full width at half maximum of the lobe around the specular direction [rad], in
            [3.4e-4, π].
        depolarisation: fraction of the scattered power converted between V and H, in [0, 1/4]; 1/4
            is a cloud of thin wires.
    """

    diffuse: Value = 1.0
    lobe_width: Annotated[Value, RADIANS] = roughness.ROUGH_LOBE_WIDTH
    depolarisation: Value = 0.0

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law at `frequency` [Hz], differentiable w.r.t. all values."""
        diffuse, exponent = evaluate_value(self.diffuse), roughness.lobe_exponent(self.lobe_width)
        weights = roughness.specular_weights(diffuse, exponent)
        depolarisation = evaluate_value(self.depolarisation)
        return ScatteringLaw(self._amplitude(frequency), *weights, depolarisation=depolarisation)


class _RoughMedium(Medium, roughness.EffectiveRoughness, Material):
    """Medium with a rough surface."""

    def smooth_interface(self, frequency: float) -> SmoothInterface | None:
        """Return the coherent interface of the outer face at `frequency` [Hz]."""
        epsilon = self.complex_permittivity(frequency)
        return self.make_interface(epsilon, permeability=self.complex_permeability)


@dataclass(frozen=True)
class Dielectric(_RoughMedium):
    """Half space with effective roughness; the refracted power is lost.

    In `invertwin.rcs` a closed mesh of it is a penetrable solid.

    Attributes:
        permittivity, conductivity, loss_tangent, permeability, magnetic_loss_tangent: see `Medium`;
            the other fields are those of `EffectiveRoughness`; it scatters by default.
    """

    scattering: Value = field(default=roughness.ROUGH_SCATTERING, kw_only=True)

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law at `frequency` [Hz], differentiable w.r.t. all values."""
        amplitude = self._amplitude(frequency)
        return ScatteringLaw(amplitude, *self.weights(), **self.depolarisation_terms)


@dataclass(frozen=True)
class RefractingBody(_RoughMedium):
    """Solid body with a closed mesh, which rays enter and leave by Snell's law.

    Each face transmits the power it does not reflect; inside, power is absorbed. The direction
    follows the real part of √(εμ), which is valid for small losses per wavelength.

    Attributes:
        permittivity, conductivity, loss_tangent, permeability, magnetic_loss_tangent: see `Medium`;
            the other fields are those of `EffectiveRoughness`, of what the outside reflects.
    """

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law of one face at `frequency` [Hz]; differentiable with respect to
        all values.
        """
        square = self.complex_permittivity(frequency) * self.complex_permeability
        amplitude = self._amplitude(frequency)
        inside = {"index": fresnel.refractive_index(square), "refraction": 1 - amplitude**2}
        inside["attenuation"] = fresnel.attenuation(square, frequency)
        return ScatteringLaw(amplitude, *self.weights(), **inside, **self.depolarisation_terms)


@dataclass(frozen=True)
class Layer(Medium):
    """Layer of a slab.

    Attributes:
        permittivity, conductivity, loss_tangent, permeability, magnetic_loss_tangent: see `Medium`.
        thickness: thickness ≥ 0 [m].
    """

    thickness: Value = field(kw_only=True)

    def sheet(self, frequency: float) -> SlabLayer:
        """Return the layer as numbers at `frequency` [Hz], for `slab_tables`."""
        epsilon, dispersion = self._epsilon(frequency)
        values = (epsilon, dispersion, evaluate_value(self.thickness), self.complex_permeability)
        return SlabLayer(*(value[..., None] for value in values))


@dataclass(frozen=True)
class Slab(Layer, roughness.EffectiveRoughness, Material):
    """Thin sheet of one layer in air, meshed as an open surface, which reflects and transmits.

    Multiple reflections in the sheet are part of its coefficients, at the radar's centre frequency.
    Transmitted paths are straight and delayed by the sheet's group delay.

    Attributes:
        permittivity, conductivity, loss_tangent, permeability, magnetic_loss_tangent, thickness:
            see `Layer`; the other fields are those of `EffectiveRoughness`, of what it reflects.
    """

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law of the sheet at `frequency` [Hz]; differentiable with respect
        to all values.
        """
        return _slab_scattering_law([self], self, frequency)

    def smooth_interface(self, frequency: float) -> SmoothInterface | None:
        """Return the coherent interface of the sheet at `frequency` [Hz]."""
        epsilon = self.complex_permittivity(frequency)
        return self.make_interface(epsilon, self.thickness, self.complex_permeability)


@dataclass(frozen=True)
class Multilayer(_MaterialRecord, roughness.EffectiveRoughness, Material):
    """Thin sheet of several layers in air, meshed as an open surface.

    Attributes:
        layers: layers from the first face to the last. Both sides of the mesh reflect as the first
            face does, which is exact for lossless and for symmetric stacks; the transmission is
            equal from both sides.
        scattering, rms_slope, lambertian, directive, directive_exponent, backscatter_exponent: see
            `EffectiveRoughness`.
    """

    layers: Annotated[Sequence[Layer], MinLen(1)]

    def __post_init__(self) -> None:
        layers = tuple(self.layers)
        if not layers or not all(isinstance(layer, Layer) for layer in layers):
            got = ", ".join(type(layer).__name__ for layer in layers) or "none"
            raise InputError(
                f"expected at least one Layer, got {got}; give layers=[Layer(...), ...]"
            )
        object.__setattr__(self, "layers", layers)
        super().__post_init__()

    @property
    def faces(self) -> int | None:
        """Number of triangles of the values; None if they hold for any."""
        named = {name: getattr(self, name) for name in _value_names(self)}
        for k, layer in enumerate(self.layers):
            named |= {f"layers[{k}].{name}": getattr(layer, name) for name in _value_names(layer)}
        return row_count(named)

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law of the sheet at `frequency` [Hz]; differentiable with respect
        to all values.
        """
        return _slab_scattering_law(self.layers, self, frequency)

    def coefficients(
        self, frequency: float, cosine: Float64[Tensor, " n"], triangle: Int64[Tensor, " n"]
    ) -> fresnel.FieldCoefficients:
        """Return the coherent field coefficients of the stack, about its middle."""
        layers = [_select_triangles(layer.sheet(frequency), triangle) for layer in self.layers]
        skin = self.make_interface(None).select_triangles(triangle)
        kept = skin.coherent_reflection(frequency, cosine)
        return sheet_coefficients(layers, cosine, frequency).scale_reflection(kept)

    def incoherent_law(self, frequency: float) -> ScatteringLaw:
        """Return the scattering law without specular reflection. See `Material.incoherent_law`."""
        return self.scattering_law(frequency).without_specular(self.make_interface(None), frequency)


def _value_names(holder: object) -> list[str]:
    return [entry.name for entry in fields(holder) if entry.name in RANGES]  # type: ignore[arg-type]


def _select_triangles(sheet: SlabLayer, triangle: Tensor) -> SlabLayer:
    """Return a layer with one value per row of triangles."""
    values = (value[..., 0] for value in sheet)
    return SlabLayer(*(value[triangle] if value.ndim else value for value in values))


def _slab_scattering_law(
    layers: Sequence[Layer], skin: roughness.EffectiveRoughness, frequency: float
) -> ScatteringLaw:
    tables = slab_tables([layer.sheet(frequency) for layer in layers], _COSINES, frequency)
    through = {"transmittance": tables.transmittance, "extra_length": tables.extra_length}
    through |= skin.depolarisation_terms
    return ScatteringLaw(fresnel.safe_root(tables.reflectance), *skin.weights(), **through)
