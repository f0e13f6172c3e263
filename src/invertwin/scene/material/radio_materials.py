"""Materials in scene files of Sionna RT.

Sionna treats every surface as a sheet of some thickness in air, a ``Slab``.
"""

import math
import xml.etree.ElementTree as ElementTree

from invertwin.errors import InputError
from invertwin.scene.material.itu import Itu
from invertwin.scene.material.materials import PerfectConductor, Slab
from invertwin.scene.material.surface import Material

_THICKNESS = 0.1  # default thickness [m]
_NUMBERS = {
    "relative_permittivity": "permittivity",
    "conductivity": "conductivity",
    "thickness": "thickness",
    "scattering_coefficient": "scattering",
}


def read_radio_material(element: ElementTree.Element) -> Material | None:
    """Read the material of a `bsdf` of a scene file; None for one of a camera.

    Sionna's scattering pattern and its depolarisation are ignored.

    Args:
        element: `bsdf` element.

    Raises:
        InputError: a value that is not a number, out of range, or an unknown ITU material.
    """
    kind = element.get("type")
    values = {"thickness": _THICKNESS} | _numbers(element)
    if kind == "itu-radio-material":
        name = element.find("string[@name='type']")
        table = Itu("" if name is None else name.get("value", ""))
        return Slab(**{"permittivity": table, "conductivity": table} | values)  # type: ignore[arg-type]
    if kind == "radio-material":
        return Slab(**{"permittivity": 1.0} | values)  # type: ignore[arg-type]
    return None


def radio_bsdf(material: Material, name: str) -> ElementTree.Element:
    """Build a `bsdf` of a scene file for Sionna RT.

    A perfect conductor becomes ITU's metal.

    Args:
        material: a `Slab` of numbers or of the ITU table, or a `PerfectConductor`.
        name: id of the material.

    Raises:
        InputError: another material, without counterpart in Sionna.
    """
    if isinstance(material, PerfectConductor):
        material = Slab.itu("metal", thickness=_THICKNESS)
    table = getattr(material, "permittivity", None)
    stated = isinstance(table, Itu) and getattr(material, "conductivity", None) == table
    given = {word: getattr(material, field, None) for word, field in _NUMBERS.items()}
    if stated:
        given = {word: given[word] for word in ("thickness", "scattering_coefficient")}
    plain = all(isinstance(value, int | float) for value in given.values())
    if isinstance(material, Slab):
        plain &= material.loss_tangent == 0 and not material.is_magnetic
    if not (isinstance(material, Slab) and plain):
        raise InputError(
            f"expected a Slab of single numbers or of the ITU table for {name!r}, got "
            f"{type(material).__name__}; Sionna RT has sheets only: replace it before writing"
        )
    found = ElementTree.Element("bsdf", type="radio-material", id=name)
    if isinstance(table, Itu) and stated:
        found.set("type", "itu-radio-material")
        ElementTree.SubElement(found, "string", name="type", value=table.name)
    for word, value in given.items():
        ElementTree.SubElement(found, "float", name=word, value=repr(float(value)))  # type: ignore[arg-type]
    return found


def _numbers(element: ElementTree.Element) -> dict[str, float]:
    found: dict[str, float] = {}
    for word, field in _NUMBERS.items():
        stated = element.find(f"float[@name='{word}']")
        if stated is not None:
            try:
                found[field] = float(stated.get("value", ""))
            except ValueError:
                found[field] = math.nan
    return found
