"""Bodies with joints in a run file: their templates, where their joints start, how far they are."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from invertwin.cli import schema
from invertwin.cli.run_file import about
from invertwin.errors import InputError
from invertwin.scene import Mesh, rotation_angle, rotation_from_vector
from invertwin.scene.geometry import BodyTemplate, SkinnedBody, load_anny, load_smpl, person


def template(table: schema.BodyShape) -> BodyTemplate:
    """The template of a body, in its own size.

    Raises:
        InputError: A file is missing or broken, or the extra `anny` is not installed.
    """
    if table.file is not None:
        return load_smpl(table.file)
    return load_anny() if table.model == "anny" else person(table.height, table.spacing)


def posed(table: schema.BodyShape) -> Mesh:
    """The mesh with turned joints, in the template's size.

    Raises:
        InputError: No such joint, or as for the template.
    """
    body = template(table)
    angles = {
        name: torch.tensor(turn, dtype=torch.float64).deg2rad()
        for name, turn in table.angles_deg.items()
    }
    turns = torch.stack([rotation_from_vector(turn) for turn in body.rotations(angles)])
    return Mesh(body.posed(turns)[0], body.faces)


@dataclass(frozen=True)
class SoughtBody:
    """A body whose joint angles are sought.

    Attributes:
        template: The body, in the size that it has in the scene.
        joints: Sought components of the rotation vectors by joint, such as "xz".
    """

    template: BodyTemplate
    joints: Mapping[str, str]

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


def sought_bodies(run: schema.RunFile) -> dict[str, SoughtBody]:
    """The bodies of the `[[parameters]]` tables with kind = "body", by object.

    Raises:
        InputError: The object is no body, or has no such joint.
    """
    found = {}
    for i, parameter in enumerate(run.parameters):
        if not isinstance(parameter, schema.BodyParameter):
            continue
        table = run.scene.get(parameter.object)
        with about(f"parameters[{i}]"):
            if not isinstance(table, schema.BodyShape):
                raise InputError(
                    f'expected an object with shape = "body", got {parameter.object}; '
                    'give it this shape, or use kind = "pose"'
                )
            body = template(table).scaled(table.scale)
            for name in parameter.joints:
                body.joint(name)
        axes = {name: "".join(axes) for name, axes in parameter.joints.items()}
        found[parameter.object] = SoughtBody(body, axes)
    return found
