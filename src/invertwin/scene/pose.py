"""Rotations and rigid transforms as matrices, differentiable and without singularities."""

from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

from invertwin.errors import InputError


def quaternion_from_vector(vector: Float[Tensor, "3"]) -> Float[Tensor, "4"]:
    """Unit quaternion (w, x, y, z) of a rotation vector [rad] (axis times angle).

    Its first derivative is right everywhere, at the zero vector too.
    """
    angle = torch.linalg.vector_norm(vector)
    # sin(a/2)/a written as a sinc, which is smooth at a = 0.
    scaled = 0.5 * torch.sinc(angle / (2 * torch.pi)) * vector
    return torch.cat([torch.cos(angle / 2)[None], scaled])


def vector_from_quaternion(quaternion: Float[Tensor, "4"]) -> Float[Tensor, "3"]:
    """Rotation vector [rad] of at most π in length of a quaternion (w, x, y, z), not zero."""
    # A quaternion and its negative are the same rotation; w ≥ 0 is the shorter way round.
    sign = torch.where(quaternion[0] < 0, -1.0, 1.0)
    unit = quaternion * sign / torch.linalg.vector_norm(quaternion)
    sine = torch.linalg.vector_norm(unit[1:])
    # 2 atan2(s, w)/s tends to 2 at s = 0.
    return torch.where(sine > 0, 2 * torch.atan2(sine, unit[0]) / sine, 2.0) * unit[1:]


def rotation_from_quaternion(quaternion: Float[Tensor, "4"]) -> Float[Tensor, "3 3"]:
    """Rotation matrix of a quaternion (w, x, y, z) of any length but zero.

    Raises:
        InputError: a quaternion of length zero, which is no rotation.
    """
    if not bool(quaternion.detach().abs().max() > 0):
        raise InputError(
            f"expected a quaternion that is not zero, got {quaternion.tolist()}; "
            "start from (1, 0, 0, 0), the identity"
        )
    w, x, y, z = torch.unbind(quaternion / torch.linalg.vector_norm(quaternion))
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
    ]
    return torch.stack(rows)


def rotation_from_vector(vector: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Rotation matrix of a rotation vector [rad] (axis times angle)."""
    return rotation_from_quaternion(quaternion_from_vector(vector))


def rotation_angle(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Angle of a rotation matrix in [0, π] rad, accurate at both ends."""
    skew = rotation - rotation.transpose(-1, -2)
    sine = torch.linalg.vector_norm(
        torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1), dim=-1
    )
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(sine, trace - 1)


def rigid(rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """The transform x → rotation x + translation [m] as a matrix."""
    top = torch.cat([rotation, translation[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])], dim=0)


def compose(*transforms: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """The transform that applies the given ones from first to last."""
    return reduce(lambda first, second: second @ first, transforms)
