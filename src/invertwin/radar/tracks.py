"""Tracks of a radar: positions [frame, 3] along simple curves, one per frame."""

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import Point, checked_tensor
from invertwin.limits import Angle, Count, NonNegative, Positive
from invertwin.runtime.memory import require_at_most

_MAX_POSITIONS = 1e6


def line(start: Point, stop: Point, count: Count) -> Float64[Tensor, "frame 3"]:
    """Return equally spaced positions on a line.

    Args:
        start, stop: end points [m].
        count: number of positions.
    """
    first, last = _point(start), _point(stop)
    return first + _linspace(0.0, 1.0, count)[:, None] * (last - first)


def arc(
    center: Point, radius: Positive, start: Angle, stop: Angle, count: Count
) -> Float64[Tensor, "frame 3"]:
    """Return a horizontal arc about `center`; 0° is on its −x side, 90° on its +y side.

    Args:
        center, radius: centre [3] and radius [m].
        start: first angle; 0 is on the −x side of the centre.
        stop: last angle; 90° is on the +y side.
        count: number of positions.
    """
    angle = _linspace(start, stop, count)
    return _point(center) + radius * torch.stack([-angle.cos(), angle.sin(), 0 * angle], dim=1)


def grid(
    center: Point, size: tuple[NonNegative, NonNegative], count: tuple[Count, Count]
) -> Float64[Tensor, "frame 3"]:
    """Return an upright rectangle of positions in the y-z plane through `center`; z runs fastest.

    Args:
        center: centre [3] [m].
        size: size along y, z [m].
        count: number of positions along y, z.
    """
    _require_positions(count[0] * count[1])
    y, z = (
        (_linspace(-0.5, 0.5, n) if n > 1 else torch.zeros(1, dtype=torch.float64)) * length
        for n, length in zip(count, size, strict=True)
    )
    return _point(center) + torch.nn.functional.pad(torch.cartesian_prod(y, z), (1, 0))


def _point(value: Point) -> Tensor:
    return checked_tensor(value, (3,), "a point [m]", "give x, y and z")


def _require_positions(count: int) -> None:
    require_at_most(count, _MAX_POSITIONS, "positions of a radar", "lower count", "count")


def _linspace(first: float, last: float, count: int) -> Tensor:
    _require_positions(count)
    return torch.linspace(first, last, count, dtype=torch.float64)
