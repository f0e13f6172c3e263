"""Procedural standing person as a skinned body: one closed skin over eleven joints."""

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import checked_number
from invertwin.scene.people.body import BodyTemplate
from invertwin.scene.shape_models.iso_surface import iso_surface
from invertwin.scene.shape_models.lattice import Lattice

# Joints of a standing person 1.75 m tall with arms held out, relative to the pelvis [m].
_JOINTS: dict[str, tuple[str | None, tuple[float, float, float]]] = {
    "pelvis": (None, (0.0, 0.0, 0.0)),
    "chest": ("pelvis", (0.0, 0.0, 0.22)),
    "neck": ("chest", (0.0, 0.0, 0.52)),
    "left_shoulder": ("chest", (0.0, -0.19, 0.45)),
    "left_elbow": ("left_shoulder", (0.0, -0.47, 0.45)),
    "right_shoulder": ("chest", (0.0, 0.19, 0.45)),
    "right_elbow": ("right_shoulder", (0.0, 0.47, 0.45)),
    "left_hip": ("pelvis", (0.0, -0.10, -0.06)),
    "left_knee": ("left_hip", (0.0, -0.10, -0.48)),
    "right_hip": ("pelvis", (0.0, 0.10, -0.06)),
    "right_knee": ("right_hip", (0.0, 0.10, -0.48)),
}
# Cones with round ends: their joint, both ends, both radii [m].
_CONES = [
    ("pelvis", (0.0, -0.06, -0.02), (0.0, 0.06, -0.02), 0.115, 0.115),
    ("pelvis", (0.0, 0.0, 0.0), (0.0, 0.0, 0.2), 0.12, 0.115),
    ("chest", (0.0, 0.0, 0.22), (0.0, 0.0, 0.40), 0.12, 0.12),
    ("chest", (0.0, -0.13, 0.43), (0.0, 0.13, 0.43), 0.075, 0.075),
    ("neck", (0.0, 0.0, 0.5), (-0.01, 0.0, 0.6), 0.055, 0.055),
    ("neck", (-0.02, 0.0, 0.66), (-0.01, 0.0, 0.73), 0.085, 0.09),
]
_LIMBS = [
    ("shoulder", (0.0, 0.19, 0.45), (0.0, 0.47, 0.45), 0.06, 0.045),
    ("elbow", (0.0, 0.47, 0.45), (0.0, 0.72, 0.45), 0.045, 0.033),
    ("elbow", (0.0, 0.72, 0.45), (-0.01, 0.85, 0.44), 0.038, 0.032),
    ("hip", (0.0, 0.10, -0.06), (0.0, 0.10, -0.48), 0.088, 0.058),
    ("knee", (0.0, 0.10, -0.48), (0.0, 0.10, -0.90), 0.056, 0.04),
    ("knee", (0.02, 0.10, -0.90), (-0.16, 0.10, -0.92), 0.045, 0.035),
]
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
    parents = [-1 if parent is None else names.index(parent) for parent, _ in _JOINTS.values()]
    joints = torch.tensor([place for _, place in _JOINTS.values()], dtype=torch.float64)
    template = BodyTemplate(
        mesh.vertices,
        mesh.faces,
        _weights(mesh.vertices),
        tuple(parents),
        joints,
        names=tuple(names),
    )
    return template.scale(tall / _DEFAULT_HEIGHT)


def _parts() -> list[tuple[str, Tensor, Tensor, float, float]]:
    """Return all cones: joint, ends, radii."""
    parts = []
    for name, *ends, first, last in [*_CONES, *_LIMBS]:
        start, end = torch.tensor(ends, dtype=torch.float64)
        sides = {f"left_{name}": -1.0, f"right_{name}": 1.0}
        for own, sign in ({name: 1.0} if name in _JOINTS else sides).items():
            mirror = start.new_tensor([1.0, sign, 1.0])
            parts.append((own, start * mirror, end * mirror, first, last))
    return parts


def _cone(
    points: Tensor, start: Tensor, end: Tensor, first: float, last: float
) -> Float64[Tensor, " p"]:
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
