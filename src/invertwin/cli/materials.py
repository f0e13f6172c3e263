"""Materials of run files: values as numbers, lists or images, and what is sought of them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge, Gt, Le, MinLen
from pydantic import GetCoreSchemaHandler, model_validator
from torch import Tensor

from invertwin.cli.registry import Form, Group, Registry, Table, number_or_list
from invertwin.cli.section import InputPath, Section, about, fail, key
from invertwin.errors import InputError
from invertwin.limits import Among
from invertwin.scene import (
    Dielectric,
    Itu,
    Material,
    Mesh,
    Multilayer,
    Object,
    PerfectConductor,
    RefractingBody,
    RoughConductor,
    RoughDielectric,
    Scene,
    Slab,
    Texture,
)
from invertwin.scene.material import RANGES, Value
from invertwin.scene.material.materials import Medium
from invertwin.scene.material.values import evaluated
from invertwin.scene.parameters import MaterialValues

MaterialValue = Annotated[str, Among(tuple(RANGES))]
_KINDS: Mapping[str, type[Material]] = {
    "rough_dielectric": RoughDielectric,
    "perfect_conductor": PerfectConductor,
    "rough_conductor": RoughConductor,
    "dielectric": Dielectric,
    "refracting_body": RefractingBody,
    "slab": Slab,
    "multilayer": Multilayer,
}


class TextureFile(Section):
    """Values from an image, laid over the object as seen along its own z axis."""

    image: InputPath = key(
        "NumPy file (.npy) of rows of pixels, top row first, read at the middle of each triangle"
    )


def _value_type(name: str, angle: bool) -> Any:
    """One number, a list of one number per triangle, or a texture, in the range of its name."""
    number: Any = float
    if name in RANGES:
        span = RANGES[name]
        low, high = (math.degrees(end) if angle else end for end in (span.low, span.high))
        number = Annotated[float, Gt(low) if span.open_low else Ge(low)]
        number = number if math.isinf(high) else Annotated[number, Le(high)]
    return number_or_list(number, Annotated[list[number], MinLen(1)], TextureFile)


@dataclass(frozen=True)
class _ValueOf:
    """Annotates a key that holds a material value of this name."""

    name: str

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> Any:
        return handler.generate_schema(_value_type(self.name, False))


class MediumTable(Table):
    """A dielectric, by numbers or from the ITU table."""

    itu: Annotated[str, MinLen(1)] | None = key("name in the table of ITU-R P.2040", None)
    permittivity: Annotated[Any, _ValueOf("permittivity")] | None = key(
        "relative, real part; needed without `itu`", None
    )
    conductivity: Annotated[Any, _ValueOf("conductivity")] | None = key(
        "S/m; 0 without `itu`", None
    )

    @model_validator(mode="after")
    def _known(self) -> "MediumTable":
        if self.itu is None and self.permittivity is None:
            fail("expected `permittivity`, or `itu` with a name of its table, got neither; add one")
        return self

    def library_values(self, given: Mapping[type, object]) -> dict[str, Any]:
        """The arguments; numbers stand before those of the table."""
        found = super().library_values(given)
        if self.itu is None:
            return found
        return {"permittivity": Itu(self.itu), "conductivity": Itu(self.itu), **found}


def register(registry: Registry) -> None:
    """Adds the materials and what can be sought of them."""
    registry.groups["material"] = Group()
    registry.forms[Texture] = Form(_value_type, _value)
    registry.bases[Medium] = MediumTable
    registry.given.add(Mesh)
    for name, kind in _KINDS.items():
        registry.add("material", name, kind)


def sought_values(
    object: str,
    values: Annotated[Sequence[MaterialValue], MinLen(1)],
    item: Object,
    layer: Annotated[int, Ge(0)] | None = None,
) -> MaterialValues:
    """Material values that are sought, from the values of the scene table.

    Args:
        values: which are sought.
        layer: of a multilayer, from 0: the layer whose values they are.

    Raises:
        InputError: the material has no such value, it comes from the ITU table, or it starts at
            the end of its range.
    """
    with about(f"values, material of {object}"):
        holder = _holder(item.material, layer)
        missing = [name for name in values if name not in vars(holder)]
        if missing:
            raise InputError(
                f"expected values of {type(holder).__name__}, got {missing[0]}; remove it"
            )
        start: dict[str, Any] = {name: getattr(holder, name) for name in values}
        for name, value in start.items():
            if isinstance(value, Itu):
                raise InputError(
                    f"expected a number from which {name} starts, got that of the ITU table; "
                    f"give `{name}` beside `itu`"
                )
        return MaterialValues(object, layer=layer, **start)


def value_errors(
    parameters: Sequence[Any], twin: Scene, truth: Scene, frequency: float
) -> dict[str, float]:
    """How far sought material values are from the truth, relative to it, at a frequency [Hz]."""
    found: dict[str, float] = {}
    for table in parameters:
        if table.kind != "material":
            continue
        ends = [_holder(scene[table.object].material, table.layer) for scene in (twin, truth)]
        for name in table.values:
            if all(hasattr(end, name) for end in ends):
                value, true = (_number(getattr(end, name), name, frequency) for end in ends)
                found[f"{name}_error"] = float((value - true).abs().mean() / true.abs().mean())
    return found


def _holder(material: Any, layer: int | None) -> Any:
    """The material, or one of its layers."""
    if layer is None:
        return material
    layers = getattr(material, "layers", ())
    if layer >= len(layers):
        raise InputError(
            f"expected a layer below {len(layers)} of {type(material).__name__}, "
            f"got {layer}; correct `layer`"
        )
    return layers[layer]


def _number(value: Value | Itu, name: str, frequency: float) -> Tensor:
    if isinstance(value, Itu):
        curve = value.permittivity if name == "permittivity" else value.conductivity
        return evaluated(curve(frequency))
    return evaluated(value).detach()


def _value(value: Any, name: str, angle: bool, given: Mapping[type, object]) -> Value:
    if isinstance(value, list):
        row = torch.tensor(value, dtype=torch.float64)
        return torch.deg2rad(row) if angle else row
    if not isinstance(value, TextureFile):
        return math.radians(value) if angle else value
    mesh = given.get(Mesh)
    if not isinstance(mesh, Mesh):
        raise InputError(
            f"expected {name} as a number for the materials of a scene file, got an image; "
            "give textures to objects of their own"
        )
    try:
        image = np.load(Path(value.image), allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"expected {name} from a NumPy file (.npy), got {value.image} ({error}); "
            "write it with numpy.save"
        ) from None
    texture = Texture.over(image, mesh)
    return replace(texture, image=torch.deg2rad(texture.image)) if angle else texture
