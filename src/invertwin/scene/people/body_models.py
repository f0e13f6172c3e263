"""Articulated bodies by the name of their model, or from a file.

`person` is a procedural standing person, one closed skin over eleven joints; Anny is an open model
people of all ages and builds.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import Point, check_choice, checked_number
from invertwin.constants import read_table
from invertwin.errors import import_optional
from invertwin.limits import RADIANS, Positive
from invertwin.scene.mesh import Mesh
from invertwin.scene.people.body import BodyTemplate, load_smpl
from invertwin.scene.pose import Basis
from invertwin.scene.shape_models.iso_surface import iso_surface
from invertwin.scene.shape_models.lattice import Lattice

_BODY = read_table("invertwin.scene.people", "body.toml")
_JOINTS = _BODY["joints"]
_FILLET = 0.02  # blending width between parts [m]
_BLEND = 0.08  # width over which skinning weights change [m]
_DEFAULT_HEIGHT = 1.75  # m


def person(height: float = 1.75, spacing: float = 0.03) -> BodyTemplate:
    """Build a person who faces −x, z up, arms held out along ±y, in the frame of the pelvis.

    One closed skin around blended tapered cylinders; its weights are smooth between joints. The
    joints are pelvis, chest, neck, and shoulder, elbow, hip and knee of both sides, ``left_`` at
    −y; their axes are those of the object in the rest pose: elbows bend about z, knees about y.

    Args:
        height: height [m].
        spacing: vertex spacing [m].

    Raises:
        InputError: a height or spacing out of range.
    """
    tall = checked_number(height, "height [m]", 0.5, 2.5)
    step = checked_number(spacing, "spacing of the triangles [m]", 0.01, 0.05)
    low = torch.tensor([-0.24, -0.93, -1.0], dtype=torch.float64)
    high = torch.tensor([0.18, 0.93, 0.86], dtype=torch.float64)
    counts = ((high - low) * tall / _DEFAULT_HEIGHT / step).ceil().int() + 1
    mesh = iso_surface(_distance, Lattice.from_bounds(low, high, counts.tolist()))
    names = list(_JOINTS)
    parents = [names.index(row["parent"]) if "parent" in row else -1 for row in _JOINTS.values()]
    joints = torch.tensor([row["place"] for row in _JOINTS.values()], dtype=torch.float64)
    skin = mesh.vertices, mesh.faces, _weights(mesh.vertices)
    template = BodyTemplate(*skin, tuple(parents), joints, names=tuple(names))
    return template.scale(tall / _DEFAULT_HEIGHT)


def _parts() -> list[tuple[str, Tensor, Tensor, float, float]]:
    """Return all cones: joint, ends, radii."""
    parts = []
    for name, *ends, first, last in [*_BODY["cones"], *_BODY["limbs"]]:
        start, end = torch.tensor(ends, dtype=torch.float64)
        sides = {f"left_{name}": -1.0, f"right_{name}": 1.0}
        for own, sign in ({name: 1.0} if name in _JOINTS else sides).items():
            mirror = start.new_tensor([1.0, sign, 1.0])
            parts.append((own, start * mirror, end * mirror, first, last))
    return parts


def _cone(points: Tensor, start: Tensor, end: Tensor, first: float, last: float) -> Tensor:
    """Return the approximate distance to a cone with round ends, negative inside."""
    axis = end - start
    share = ((points - start) @ axis / axis.square().sum()).clamp(0.0, 1.0)
    return (points - start - share[:, None] * axis).norm(dim=1) - (first + share * (last - first))


def _distance(points: Float64[Tensor, "p 3"]) -> Float64[Tensor, " p"]:
    """Return the approximate signed distance to the skin: a soft minimum over the parts."""
    found = torch.stack([_cone(points, *part[1:]) for part in _parts()])
    return -_FILLET * torch.logsumexp(-found / _FILLET, dim=0)


def _weights(points: Float64[Tensor, "p 3"]) -> Float64[Tensor, "p j"]:
    """Return skinning weights from the distances to the parts of each joint."""
    parts = _parts()
    nearest = []
    for name in _JOINTS:
        own = [_cone(points, *part[1:]) for part in parts if part[0] == name]
        nearest.append(torch.stack(own).amin(0))
    found = torch.stack(nearest, dim=1)
    share = (1 - (found - found.amin(1, keepdim=True)) / _BLEND).clamp_min(0.0).square()
    return share / share.sum(1, keepdim=True)


_STEP = 0.05  # step of a phenotype for its central difference
# Anny's bodies face −y, z up; here they face −x, z up.
_ANNY_TO_BODY_AXES = Basis((1, 0, 2), (1, -1, 1))


def load_anny(
    phenotypes: Mapping[str, float] | None = None, coordinates: Sequence[str] = ()
) -> BodyTemplate:
    """Load a body of the model Anny (Apache-2.0), which the optional extra ``anny`` installs.

    The joints are its 104 bones by their names, such as ``upperarm01.L`` and ``lowerarm01.L``; the
    rest pose is Anny's, rotated to face −x, z up. The first use of Anny prepares files for about a
    minute.

    Args:
        phenotypes: values by their names in Anny ("gender", "age", "muscle", "weight", "height",
            "proportions"), from 0 to 1; the default is 0.5.
        coordinates: phenotypes that become shape coordinates, as changes from the given values.
            They follow Anny's own blending to first order.

    Raises:
        InputError: Anny is not installed, or has no such phenotype.
    """
    model = import_optional("anny", "anny").Anny(skinning_method="lbs").to(dtype=torch.float64)
    values = dict.fromkeys(model.phenotype_labels, 0.5)
    for name in (*(phenotypes or {}), *coordinates):
        check_choice(name, values, "phenotypes among", "use Anny's names")
    values |= {name: float(value) for name, value in (phenotypes or {}).items()}
    rest, places = _rest(model, values)
    skin, bones = [], []
    for name in coordinates:
        ends = [_rest(model, values | {name: values[name] + s * _STEP}) for s in (1.0, -1.0)]
        (up, heads_up), (down, heads_down) = ends
        skin.append((up - down) / (2 * _STEP))
        bones.append((heads_up - heads_down) / (2 * _STEP))
    share = torch.zeros(len(rest), len(model.bone_labels), dtype=torch.float64)
    share.scatter_add_(1, model.vertex_bone_indices.long(), model.vertex_bone_weights.double())
    parents = (-1, *(int(parent) for parent in model.bone_parents[1:]))
    own = rest, model.get_triangular_faces().long(), share, parents, places
    moves = [torch.stack(columns, dim=-1) if columns else None for columns in (skin, bones)]
    return BodyTemplate(*own, *moves, names=tuple(model.bone_labels))


def _rest(model: Any, values: Mapping[str, float]) -> tuple[Tensor, Tensor]:
    """Return skin and joints of the rest pose in this package's axes."""
    given = {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}
    with torch.no_grad():
        found = model(pose_parameters=None, phenotype_kwargs=given)
    rest, places = (found[name][0].double() for name in ("rest_vertices", "rest_bone_heads"))
    return _ANNY_TO_BODY_AXES.vectors(rest), _ANNY_TO_BODY_AXES.vectors(places)


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
