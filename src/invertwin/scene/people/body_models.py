"""Articulated bodies by the name of their model, or from a file."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from invertwin.checks import Point
from invertwin.limits import RADIANS, Positive
from invertwin.scene.mesh import Mesh
from invertwin.scene.people.anny_body import load_anny
from invertwin.scene.people.body import BodyTemplate, load_smpl
from invertwin.scene.people.person import person

Model = Literal["person", "anny"]
_AT_REST: dict[str, Point] = {}


@cache
def body_template(
    model: Model = "person",
    file: Path | str | None = None,
    height: Positive = 1.75,
    spacing: Positive = 0.03,
) -> BodyTemplate:
    """Return the template of a body, z up, facing −x; arguments as in `body`.

    Args:
        model: person or anny.
        file: path of an SMPL file, in place of a model.
        height: height of `person` [m].
        spacing: vertex spacing [m].
    """
    if file is not None:
        return load_smpl(file)
    return load_anny() if model == "anny" else person(height, spacing)


def body(
    model: Model = "person",
    file: Path | str | None = None,
    height: Positive = 1.75,
    spacing: Positive = 0.03,
    angles: Annotated[Mapping[str, Point], RADIANS] = _AT_REST,
) -> Mesh:
    """Build an articulated body with one skin, z up, facing −x, with the origin of its model.

    Args:
        model: person = procedural, arms held out at rest; anny = from the extra `anny`.
        file: path in SMPL's layout (.npz), in place of a model.
        height: height of `person` [m].
        spacing: vertex spacing [m].
        angles: rotation vectors of joints by name, in the frame of the parent joint; others at
            rest.

    Raises:
        InputError: a file is missing or broken, the extra `anny` is not installed, or no such
            joint.
    """
    return body_template(model, file, height, spacing).mesh(angles)
