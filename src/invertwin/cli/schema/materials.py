"""Materials of run files: values as numbers, lists or images."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import torch
from annotated_types import Ge, Gt, Le, MinLen
from pydantic import model_validator

from invertwin import scene
from invertwin.refusals import refusal, refusal_text
from invertwin.registry.kinds import ConstructorTable, FormOf, KindGroup, Registry, ValueFormat
from invertwin.registry.section import InputPath, Section, raise_key_error
from invertwin.scene.material.materials import Medium
from invertwin.scene.material.values import RANGES, Value
from invertwin.storage.untrusted import read_npy


class TextureFile(Section):
    """Values from an image, laid over the object as seen along its own x axis, its z axis up.

    Attributes:
        image: NumPy file (.npy) of rows of pixels, top row first, read at the middle of each
            triangle
    """

    image: InputPath


def _value_type(name: str, angle: bool) -> Any:
    """One number, a list of one number per triangle, or a texture, in the range of its name."""
    number: Any = float
    if name in RANGES:
        span = RANGES[name]
        low, high = (math.degrees(end) if angle else end for end in (span.low, span.high))
        number = Annotated[float, Gt(low) if span.open_low else Ge(low)]
        number = number if math.isinf(high) else Annotated[number, Le(high)]
    return Annotated[Any, FormOf((number, Annotated[list[number], MinLen(1)], TextureFile))]


class MediumTable(ConstructorTable):
    """A dielectric, by numbers or from the ITU table.

    Attributes:
        itu: name in the table of ITU-R P.2040
    """

    optional: ClassVar = ("permittivity", "conductivity")
    itu: Annotated[str, MinLen(1)] | None = None

    @model_validator(mode="after")
    def _require_permittivity(self) -> "MediumTable":
        if self.itu is None and getattr(self, "permittivity", None) is None:
            raise_key_error(refusal_text("materials.no_permittivity"))
        return self

    def library_values(self, given: Mapping[type, object]) -> dict[str, Any]:
        """The arguments; numbers stand before those of the table."""
        found = super().library_values(given)
        if self.itu is None:
            return found
        return {"permittivity": scene.Itu(self.itu), "conductivity": scene.Itu(self.itu), **found}


def register(registry: Registry) -> None:
    """Add the materials."""
    registry.groups["material"] = KindGroup()
    registry.forms[scene.Texture] = ValueFormat(_value_type, _build_value)
    registry.bases[Medium] = MediumTable
    registry.given.add(scene.Mesh)
    registry.add("material", "rough_dielectric", scene.RoughDielectric)
    registry.add("material", "perfect_conductor", scene.PerfectConductor)
    registry.add("material", "rough_conductor", scene.RoughConductor)
    registry.add("material", "dielectric", scene.Dielectric)
    registry.add("material", "refracting_body", scene.RefractingBody)
    registry.add("material", "slab", scene.Slab)
    registry.add("material", "multilayer", scene.Multilayer)


def _build_value(value: Any, name: str, angle: bool, given: Mapping[type, object]) -> Value:
    if isinstance(value, list):
        row = torch.tensor(value, dtype=torch.float64)
        return torch.deg2rad(row) if angle else row
    if not isinstance(value, TextureFile):
        return math.radians(value) if angle else value
    mesh = given.get(scene.Mesh)
    if not isinstance(mesh, scene.Mesh):
        raise refusal("materials.texture", name)
    texture = scene.Texture.from_projection(read_npy(value.image), mesh)
    return replace(texture, image=torch.deg2rad(texture.image)) if angle else texture
