"""From the material tables of a run file to the library's materials."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from invertwin.cli import schema
from invertwin.errors import InputError
from invertwin.scene import (
    Dielectric,
    Itu,
    Layer,
    Material,
    Mesh,
    Multilayer,
    PerfectConductor,
    RefractingBody,
    RoughConductor,
    RoughDielectric,
    Scene,
    Slab,
    Texture,
)
from invertwin.scene.material import Value
from invertwin.scene.material.values import evaluated
from invertwin.scene.parameters import MaterialValues

_KINDS: Mapping[str, type[Material]] = {
    "rough_dielectric": RoughDielectric,
    "perfect_conductor": PerfectConductor,
    "rough_conductor": RoughConductor,
    "dielectric": Dielectric,
    "refracting_body": RefractingBody,
    "slab": Slab,
    "multilayer": Multilayer,
}


def material(table: schema.Material, mesh: Mesh | None) -> Material:
    """The material of a table.

    Args:
        table: its values.
        mesh: the shape that textures are laid over; None if it is not known.

    Raises:
        InputError: an unknown name of the ITU table, an impossible value, or a broken image.
    """
    return _KINDS[table.kind](**_values(table, mesh))


def fitted(table: schema.MaterialParameter, material: Any) -> MaterialValues:
    """The module that fits the named values, from those of the material.

    Raises:
        InputError: the material has no such value, it comes from the ITU table, or it starts at
            the end of its range.
    """
    holder = _holder(material, table.layer)
    missing = [name for name in table.values if name not in vars(holder)]
    if missing:
        raise InputError(f"expected values of {type(holder).__name__}, got {missing[0]}; remove it")
    start: dict[str, Any] = {name: getattr(holder, name) for name in table.values}
    for name, value in start.items():
        if isinstance(value, Itu):
            raise InputError(
                f"expected a number from which {name} starts, got that of the ITU table; "
                f"give `{name}` beside `itu`"
            )
    return MaterialValues(table.object, layer=table.layer, **start)


def value_errors(
    parameters: Sequence[schema.Parameter], twin: Scene, truth: Scene, frequency: float
) -> dict[str, float]:
    """How far the sought material values are from the truth, relative to it.

    Args:
        parameters: what was sought.
        twin: the scene that was found.
        truth: the true scene.
        frequency: of the radar [Hz], for values of the ITU table.
    """
    found: dict[str, float] = {}
    for table in parameters:
        if not isinstance(table, schema.MaterialParameter):
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


def _values(table: schema.Section, mesh: Mesh | None) -> dict[str, Any]:
    """Fields of the library's class by name."""
    given = {name: getattr(table, name) for name in type(table).model_fields}
    found: dict[str, Any] = {}
    name = given.pop("itu", None)
    if name is not None:
        found = {"permittivity": Itu(name), "conductivity": Itu(name)}
    for key, value in given.items():
        if key == "kind" or value is None:
            continue
        if key == "layers":
            found[key] = [Layer(**_values(layer, mesh)) for layer in value]
        elif key == "lobe_width_deg":
            found["lobe_width"] = _radians(_value(key, value, mesh))
        else:
            found[key] = _value(key, value, mesh)
    return found


def _value(
    key: str, value: float | list[float] | schema.TextureFile, mesh: Mesh | None
) -> float | Tensor | Texture:
    if isinstance(value, list):
        return torch.tensor(value, dtype=torch.float64)
    if not isinstance(value, schema.TextureFile):
        return value
    if mesh is None:
        raise InputError(
            f"expected {key} as a number for the materials of a scene file, got an image; "
            "give textures to objects of their own"
        )
    try:
        image = np.load(Path(value.image), allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"expected {key} from a NumPy file (.npy), got {value.image} ({error}); "
            "write it with numpy.save"
        ) from None
    return Texture.over(image, mesh)


def _radians(value: float | Tensor | Texture) -> float | Tensor | Texture:
    if isinstance(value, Texture):
        return replace(value, image=torch.deg2rad(value.image))
    return torch.deg2rad(value) if isinstance(value, Tensor) else math.radians(value)
