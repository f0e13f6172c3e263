"""Start poses of fits: given poses, and random poses about a known one."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Annotated

import torch
from annotated_types import MinLen
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import Point
from invertwin.errors import InputError
from invertwin.limits import RADIANS, Axes, Count, NonNegative
from invertwin.runtime.memory import require_at_most
from invertwin.scene.pose import rigid, rotation_from_vector
from invertwin.scene.scene import Object, displace

_MAX_COPIES = 1e4
DrawInterval = tuple[NonNegative, NonNegative]


def sample_nearby_poses(
    item: Object,
    count: Count = 1,
    *,
    distance: DrawInterval,
    angle: Annotated[DrawInterval, RADIANS] = (0.0, 0.0),
    axes: Axes = "xyz",
    rotation_axis: Float64[Tensor, "3"] | None = None,
    generator: torch.Generator,
) -> Iterator[Object]:
    """Yield copies of an object at random poses about its pose.

    Args:
        item: object at its known pose.
        count: number of starts
        distance: minimum and maximum offset [m]
        angle: minimum and maximum rotation
        axes: world axes of the offset
        rotation_axis: axis of the rotation; None = random axis
        generator: random number generator, used copy by copy.
    """
    require_at_most(count, _MAX_COPIES, "poses", "lower count", "count")

    def draw_uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    def draw_direction(letters: str) -> Tensor:
        vector = torch.randn(3, generator=generator, dtype=torch.float64).roll(1)
        vector = vector * torch.tensor([letter in letters for letter in "xyz"])
        return vector / vector.norm()

    for _ in range(count):
        offset = draw_uniform(*distance) * draw_direction(axes)
        about = draw_direction("xyz")
        if rotation_axis is not None:
            about = rotation_axis / rotation_axis.norm() * (1 if draw_uniform(0, 1) < 0.5 else -1)
        yield displace(item, offset, draw_uniform(*angle) * about)


def place_at_poses(
    item: Object,
    positions: Annotated[Sequence[Point], MinLen(1)],
    rotations: Annotated[Sequence[Point], RADIANS] = (),
) -> Iterator[Object]:
    """Yield copies of an object at given poses.

    Args:
        item: object to copy.
        positions: positions of its origin [m]
        rotations: rotation vectors, one for each position; empty = keep its rotation

    Raises:
        InputError: Not as many rotations as positions.
    """
    if rotations and len(rotations) != len(positions):
        raise InputError(
            f"expected one rotation for each of {len(positions)} positions, got {len(rotations)}; "
            "give one each, or none"
        )
    matrices = [rotation_from_vector(torch.as_tensor(r, dtype=torch.float64)) for r in rotations]
    matrices = matrices or [item.transform[:3, :3]] * len(positions)
    for matrix, position in zip(matrices, positions, strict=True):
        yield replace(item, pose=rigid(matrix, torch.as_tensor(position, dtype=torch.float64)))
