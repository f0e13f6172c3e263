"""Rotations and rigid transforms as matrices, differentiable and free of singularities."""

from collections.abc import Sequence
from functools import reduce

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin.checks import ArrayLike, checked_tensor
from invertwin.errors import InputError


def quaternion_from_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the unit quaternion (w, x, y, z) of a rotation vector [rad] (axis times angle).

    Its first derivative is correct everywhere, including the zero vector.
    """
    angle = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    # sin(a/2)/a as a sinc, smooth at a = 0.
    scaled = 0.5 * torch.sinc(angle / (2 * torch.pi)) * vector
    return torch.cat([torch.cos(angle / 2), scaled], dim=-1)


def vector_from_quaternion(quaternion: Float[Tensor, "4"]) -> Float[Tensor, "3"]:
    """Return the rotation vector [rad] of length up to π of a non-zero quaternion (w, x, y, z)."""
    # A quaternion and its negative are the same rotation; w ≥ 0 is the shorter one.
    sign = torch.where(quaternion[0] < 0, -1.0, 1.0)
    unit = quaternion * sign / torch.linalg.vector_norm(quaternion)
    sine = torch.linalg.vector_norm(unit[1:])
    # 2 atan2(s, w)/s tends to 2 at s = 0.
    return torch.where(sine > 0, 2 * torch.atan2(sine, unit[0]) / sine, 2.0) * unit[1:]


def rotation_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrix of a quaternion (w, x, y, z) of any non-zero length.

    Raises:
        InputError: a quaternion of length zero.
    """
    if not bool((quaternion.detach().abs().amax(-1) > 0).all()):
        raise InputError(
            f"expected a quaternion that is not zero, got {quaternion.tolist()}; "
            "start from (1, 0, 0, 0), the identity"
        )
    length = torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    w, x, y, z = (quaternion / length).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotation_from_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrix of a rotation vector [rad] (axis times angle)."""
    return rotation_from_quaternion(quaternion_from_vector(vector))


def rotation_angle(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the angle of a rotation matrix in [0, π] rad, accurate at both ends."""
    skew = rotation - rotation.transpose(-1, -2)
    axis = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    sine = torch.linalg.vector_norm(axis, dim=-1)
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(sine, trace - 1)


def rigid(
    rotation: Float[Tensor, "3 3"] | None = None, translation: ArrayLike = (0.0, 0.0, 0.0)
) -> Float[Tensor, "4 4"]:
    """Return the matrix of the transform x → rotation x + translation [m].

    Args:
        rotation: rotation matrix [3, 3]; None = identity.
        translation: translation [3] [m].

    Raises:
        InputError: wrong shapes, or NaN.
    """
    moved = checked_tensor(translation, (3,), "translation [m]", "give x, y, z")
    turned = torch.eye(3, dtype=torch.float64) if rotation is None else rotation
    turned = checked_tensor(turned, (3, 3), "rotation", "give a 3 × 3 matrix")
    top = torch.cat([turned, moved[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])], dim=0)


def look_at(
    positions: Float[Tensor, "n 3"] | Sequence[Sequence[float]], target: ArrayLike
) -> Float64[Tensor, "n 3 3"]:
    """Return rotations whose boresight (third column) points at a target, x level, y upwards.

    Args:
        positions: positions of the radar [*, 3] [m].
        target: target point [3] [m].

    Raises:
        InputError: wrong shapes, NaN, or a target straight above or below a position.
    """
    places = checked_tensor(positions, (None, 3), "positions [m]", "give x, y, z of each")
    aim = checked_tensor(target, (3,), "target [m]", "give x, y, z")
    boresight = aim - places
    right = torch.linalg.cross(boresight.new_tensor([[0.0, 1.0, 0.0]]), boresight)
    if bool((right.norm(dim=1) < 1e-6 * (1 + boresight.norm(dim=1))).any()):
        raise InputError(
            "expected a target that is not straight above or below a position, got "
            f"{aim.tolist()}; move it or give rotations"
        )
    boresight = boresight / boresight.norm(dim=1, keepdim=True)
    right = right / right.norm(dim=1, keepdim=True)
    return torch.stack([right, torch.linalg.cross(boresight, right), boresight], dim=-1)


def compose(*transforms: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Compose transforms from first to last."""
    return reduce(lambda first, second: second @ first, transforms)
