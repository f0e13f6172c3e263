"""Rotations and rigid transforms as matrices, differentiable and free of singularities.

Our frame is x forward, y left, z up, right-handed. ROS (REP 103), ISO 8855, Sionna RT, Blender and
CAD files need no change: they are x forward, y left, z up, or have no forward axis and z up.
`to_frame` converts to the axes of other programs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin.checks import ArrayLike, check_choice, checked_point, checked_tensor, to_tensor
from invertwin.constants import read_table
from invertwin.errors import InputError
from invertwin.limits import MAX_LENGTH


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


def rotate_about_mean(points: Float64[Tensor, "n 3"], rotation: Float64[Tensor, "3 3"]) -> Tensor:
    """Rotate points about their mean.

    Args:
        points: positions [m].
        rotation: rotation matrix.
    """
    center = points.mean(0)
    return center + (points - center) @ rotation.T


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
    return torch.atan2(sine, rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)


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
    moved = checked_point(translation, "translation [m]", most=MAX_LENGTH)
    turned = torch.eye(3, dtype=torch.float64) if rotation is None else rotation
    turned = checked_tensor(turned, (3, 3), "rotation", "give a 3 × 3 matrix")
    top = torch.cat([turned, moved[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])], dim=0)


def look_at(
    positions: Float[Tensor, "n 3"] | Sequence[Sequence[float]], target: ArrayLike
) -> Float64[Tensor, "n 3 3"]:
    """Return rotations whose boresight (first column) points at a target, y level, z upwards.

    Args:
        positions: positions of the radar [*, 3] [m].
        target: target point [3] [m].

    Raises:
        InputError: wrong shapes, NaN, or a target straight above or below a position.
    """
    places = checked_tensor(positions, (None, 3), "positions [m]", "give x, y, z of each")
    aim = checked_point(target, "target [m]")
    boresight = aim - places
    left = torch.linalg.cross(boresight.new_tensor([[0.0, 0.0, 1.0]]), boresight)
    if bool((left.norm(dim=1) < 1e-6 * (1 + boresight.norm(dim=1))).any()):
        raise InputError(
            "expected a target that is not straight above or below a position, got "
            f"{aim.tolist()}; move it or give rotations"
        )
    boresight = boresight / boresight.norm(dim=1, keepdim=True)
    left = left / left.norm(dim=1, keepdim=True)
    return torch.stack([boresight, left, torch.linalg.cross(boresight, left)], dim=-1)


def compose(*transforms: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Compose transforms from first to last."""
    return reduce(lambda first, second: second @ first, transforms)


FrameName = Literal["ti", "opencv", "smpl", "unity"]

_AXES = read_table("invertwin.scene", "frames.toml")


@dataclass(frozen=True)
class Basis:
    """Axes of a frame in terms of those of another.

    Attributes:
        order: axis of the other frame along which each axis lies.
        signs: −1 for the opposite direction, else 1.
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]

    @property
    def inverse(self) -> "Basis":
        """Axes of the other frame in terms of these."""
        order = tuple(self.order.index(axis) for axis in range(3))
        return Basis(order, tuple(self.signs[axis] for axis in order))

    @property
    def is_reflection(self) -> bool:
        """True where one of the two frames is left-handed."""
        return float(torch.linalg.det(self.vectors(torch.eye(3).double()))) < 0

    def vectors(self, values: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return points or vectors along these axes."""
        return values[..., list(self.order)] * values.new_tensor(self.signs)

    def poses(self, values: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
        """Return poses M T M⁻¹: the axes of the world and of the body change alike."""
        order, signs = [*self.order, 3], values.new_tensor([*self.signs, 1])
        return values[..., order, :][..., order] * signs[:, None] * signs


@runtime_checkable
class Convertible(Protocol):
    """Value with coordinates."""

    def change_basis(self, basis: Basis) -> Any:
        """Return the value along other axes."""
        ...


def to_frame(value: Convertible | ArrayLike, frame: FrameName) -> Any:
    """Convert coordinates from our frame to that of another program.

    Ours is x forward, y left, z up. The others: ``ti`` (mmWave SDK point clouds): x right,
    y forward, z up; ``opencv``: x right, y down, z forward; ``smpl``: y up, the body faces z, its
    left is x, whereas our bodies face −x; ``unity``: left-handed, x right, y up, z forward. ROS,
    ISO 8855, Sionna RT, Blender and CAD files need no conversion.

    A pose becomes M T M⁻¹, since the axes of the body change with those of the world. In a
    left-handed frame triangles are wound the other way round, so that normals still point outwards.
    Rotation vectors are not vectors there: convert their poses.

    Args:
        value: points or vectors [*, 3], poses [*, 4, 4], a mesh, an object, a scene or an antenna
            array. An array's pattern and polarisation refer to boresight and stay.
        frame: name of the frame to convert to.

    Returns:
        The converted value, of the same type; lists become tensors. The simulation understands
        scenes and arrays in our frame only.

    Raises:
        InputError: an unknown frame, or a value of another type or shape.
    """
    return _convert(value, _basis_of(frame))


def from_frame(value: Convertible | ArrayLike, frame: FrameName) -> Any:
    """Convert coordinates from the frame of another program to ours, the inverse of `to_frame`.

    Args:
        value: as in `to_frame`, in the other program's frame.
        frame: name of that frame.

    Raises:
        InputError: an unknown frame, or a value of another type or shape.
    """
    return _convert(value, _basis_of(frame).inverse)


def _basis_of(frame: str) -> Basis:
    do = "choose one (ROS, ISO 8855, Sionna RT, Blender and CAD files have ours)"
    check_choice(frame, _AXES, "a frame among", do)
    axes = _AXES[frame]
    order = tuple("xyz".index(axis[-1]) for axis in axes)
    return Basis(order, tuple(-1 if axis.startswith("-") else 1 for axis in axes))


def _convert(value: Convertible | ArrayLike, basis: Basis) -> Convertible | Tensor:
    if isinstance(value, Convertible):
        return value.change_basis(basis)
    do = "give points [*, 3], poses [*, 4, 4], a mesh, an object, a scene or an antenna array"
    known = isinstance(value, Tensor) and value.is_floating_point()
    tensor = to_tensor(value, "coordinates", do, None if known else torch.float64)
    if tensor.shape[-2:] == (4, 4):
        return basis.poses(tensor)
    if tensor.shape[-1:] != (3,):
        raise InputError(
            f"expected coordinates of shape [*, 3] or [*, 4, 4], got {list(tensor.shape)}; {do}"
        )
    return basis.vectors(tensor)
