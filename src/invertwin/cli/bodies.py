"""Bodies with joints in a run file: their templates, where their joints start, how far they are."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

from invertwin.cli.section import Vector, about
from invertwin.errors import InputError
from invertwin.limits import RADIANS, Positive
from invertwin.scene import Mesh, rotation_angle, rotation_from_vector
from invertwin.scene.geometry import BodyTemplate, SkinnedBody, load_anny, load_smpl, person

Angles = Annotated[dict[str, Vector], RADIANS]
_AT_REST: dict[str, list[float]] = {}


def body(
    model: Literal["person", "anny"] = "person",
    file: Path | None = None,
    height: Positive = 1.75,
    spacing: Positive = 0.03,
    angles: Angles = _AT_REST,
) -> Mesh:
    """A body with joints and one skin, y up, facing −z, in the frame of its model.

    Args:
        model: person = made of formulas, arms held out at rest; anny = of the extra `anny`.
        file: SMPL's layout (.npz), from the run file's folder; in place of a model.
        height: m, of `person`.
        spacing: m, of the corners of its triangles.
        angles: rotation vectors of joints by name, each in the frame of the joint before; others
            at rest.

    Raises:
        InputError: A file is missing or broken, the extra `anny` is not installed, or no such
            joint.
    """
    found = _template(model, file, height, spacing)
    given = {name: torch.tensor(turn, dtype=torch.float64) for name, turn in angles.items()}
    turns = torch.stack([rotation_from_vector(turn) for turn in found.rotations(given)])
    return Mesh(found.posed(turns)[0], found.faces)


@cache
def _template(model: str, file: Any, height: float, spacing: float) -> BodyTemplate:
    if file is not None:
        return load_smpl(file)
    return load_anny() if model == "anny" else person(height, spacing)


@dataclass(frozen=True)
class SoughtBody:
    """A body whose joint angles are sought."""

    template: BodyTemplate  # in the size that it has in the scene
    joints: Mapping[str, str]  # sought components of the rotation vectors, such as "xz"

    def module(self, name: str, mesh: Mesh) -> SkinnedBody:
        """The module of an object that starts as posed as this mesh of it is."""
        turns = self.template.rotations_of(mesh.vertices)
        found = SkinnedBody(name, self.template, turns, sought=self.joints)
        found.shape.requires_grad_(False)
        return found

    def turned(self, mesh: Mesh, angle: float, generator: torch.Generator) -> Mesh:
        """A mesh of the body with every sought joint turned by `angle` [rad], about random axes."""
        turns = self.template.rotations_of(mesh.vertices)
        rotations = torch.stack([rotation_from_vector(turn) for turn in turns])
        for name, axes in self.joints.items():
            free = torch.tensor([float(axis in axes) for axis in "xyz"], dtype=torch.float64)
            axis = torch.randn(3, generator=generator, dtype=torch.float64) * free
            change = angle * axis / axis.norm()
            joint = self.template.joint(name)
            # A hinge stays one: its angle changes, not its axis.
            rotations[joint] = (
                rotation_from_vector(turns[joint] + change)
                if len(axes) == 1
                else rotation_from_vector(change) @ rotations[joint]
            )
        return Mesh(self.template.posed(rotations)[0], mesh.faces)

    def errors(self, start: Mesh, found: Mesh, truth: Mesh) -> dict[str, float]:
        """Angles [°] by which the sought joints are off, means over them and each at the end."""
        true, before, after = (self._rotations(mesh) for mesh in (truth, start, found))
        rows = {
            f"joint_error_{name}_deg": math.degrees(float(rotation_angle(a.T @ t)))
            for name, a, t in zip(self.joints, after, true, strict=True)
        }
        first = rotation_angle(before.mT @ true).mean()
        return {
            "joint_error_before_deg": math.degrees(float(first)),
            "joint_error_after_deg": sum(rows.values()) / len(rows),
            **rows,
        }

    def _rotations(self, mesh: Mesh) -> Tensor:
        turns = self.template.rotations_of(mesh.vertices.detach())
        chosen = turns[[self.template.joint(name) for name in self.joints]]
        return torch.stack([rotation_from_vector(turn) for turn in chosen])


def sought_body(name: str, table: Any, joints: Mapping[str, str]) -> SoughtBody:
    """The body of an object whose joints are sought.

    Args:
        name: Of the object.
        table: Of the scene.
        joints: By name, the components of the rotation vector that are sought.

    Raises:
        InputError: The object is no body, or has no such joint.
    """
    if getattr(table, "shape", None) != "body":
        raise InputError(
            f'expected an object with shape = "body", got {name}; give it this shape, or use '
            'kind = "pose"'
        )
    found = _template(table.model, table.file, table.height, table.spacing).scaled(table.scale)
    for joint in joints:
        found.joint(joint)
    return SoughtBody(found, joints)


def sought_bodies(run: Any) -> dict[str, SoughtBody]:
    """The bodies of the `[[parameters]]` tables with kind = "body", by object.

    Raises:
        InputError: As above.
    """
    found = {}
    for i, parameter in enumerate(run.parameters):
        if parameter.kind == "body":
            name = parameter.object
            axes = {joint: "".join(axes) for joint, axes in parameter.joints.items()}
            with about(f"parameters[{i}]"):
                found[name] = sought_body(name, run.scene.get(name), axes)
    return found
