"""Where fits start: random poses about a known one."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.limits import RADIANS, Axes, Count, NonNegative
from invertwin.scene.pose import rigid, rotation_from_vector
from invertwin.scene.scene import Object

Interval = tuple[NonNegative, NonNegative]


def nearby(
    item: Object,
    count: Count = 1,
    *,
    distance: Interval,
    angle: Annotated[Interval, RADIANS] = (0.0, 0.0),
    axes: Axes = "xyz",
    rotation_axis: Float64[Tensor, "3"] | None = None,
    generator: torch.Generator,
) -> Iterator[Object]:
    """Random poses about the pose of an object, as copies of it.

    Args:
        item: The object where it is.
        count: of starts
        distance: m, least and most
        angle: least and most
        axes: of the offset
        rotation_axis: without it any axis
        generator: Of the random numbers. They are drawn copy by copy.
    """

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))

    def direction(letters: str) -> Tensor:
        vector = torch.randn(3, generator=generator, dtype=torch.float64)
        vector = vector * torch.tensor([letter in letters for letter in "xyz"])
        return vector / vector.norm()

    for _ in range(count):
        offset = uniform(*distance) * direction(axes)
        about = direction("xyz")
        if rotation_axis is not None:
            sign = 1 if uniform(0, 1) < 0.5 else -1
            about = rotation_axis / rotation_axis.norm() * sign
        yield displaced(item, offset, uniform(*angle) * about)


def displaced(
    item: Object, offset: Float64[Tensor, "3"], rotation: Float64[Tensor, "3"] | None = None
) -> Object:
    """An object that is turned about its centre and moved.

    Args:
        item: The object.
        offset: Of its centre [m].
        rotation: Rotation vector [rad]; None = no turn.
    """
    turn = rotation_from_vector(torch.zeros_like(offset) if rotation is None else rotation)
    motion = rigid(turn, offset + item.center - turn @ item.center)
    return replace(item, pose=motion @ item.transform)
