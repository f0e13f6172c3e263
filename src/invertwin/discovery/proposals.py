"""Shape proposals from groups of bright image points."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.discovery.shapes.primitives import SIZE_LIMITS, ShapeParameters, ground_rotation
from invertwin.inversion.initialisation.detections import label_groups

_YAW_COUNT = 45  # candidate yaws of a rectangle over a quarter turn
_TRIMMED_FRACTION = 0.05  # fraction of the weight beyond each side of a rectangle
_WALL_THICKNESS = 0.02  # m; its image is as wide as the resolution
_PERSON_SIZE = 0.32, 0.66, 1.75  # usual length, width and height [m]
# Minimum extent, and margin of the usual extents [m].
_MIN_PERSON_EXTENT, _PERSON_MARGIN = 0.12, 0.25
MAX_CORNER_EXTENT = 0.15
_Values = Float64[Tensor, " point"]  # one at every point
"""Maximum side of a group proposed as a corner reflector [m]."""


def bright_weights(strength: _Values, fraction: float = 0.02) -> Float64[Tensor, " chosen"]:
    """Compute weights of image points; weak points have weight zero.

    Echo strengths differ by orders of magnitude, but even a weak object is stronger than the
    speckle between objects. The reference level is that of the strongest hundredth of all non-zero
    points.

    Args:
        strength: image [point].
        fraction: minimum strength relative to the reference.
    """
    order = strength.sort(descending=True).values
    total = order.cumsum(0)
    # Half of the total strength is in points above this level.
    typical = order[int((total < 0.5 * total[-1]).sum())]
    return torch.where(strength > fraction * typical, strength, 0.0)


def group_bright_points(
    positions: Float64[Tensor, "point 2"], weight: _Values, max_gap: float
) -> list[_Values]:
    """Group bright points linked by steps of at most a gap; return their weights over all points.

    Args:
        positions: positions on the ground [point, 2] [m].
        weight: weight of every point; zero is dark.
        max_gap: longest step [m].
    """
    bright = weight.nonzero()[:, 0]
    if not len(bright):
        return []
    labels = torch.full_like(weight, -1.0).long()
    labels[bright] = label_groups(positions[bright], max_gap)
    groups = (torch.where(labels == k, weight, 0.0) for k in range(int(labels.max()) + 1))
    return sorted(groups, key=lambda own: -float(own.sum()))


def enclosing_rectangle(
    positions: Float64[Tensor, "point 2"], weight: _Values, yaw: float
) -> tuple[Float64[Tensor, "2"], Float64[Tensor, "2"], float]:
    """Return centre [m], sides [m] and tightness of the rectangle at a yaw around bright points.

    Args:
        positions: positions on the ground [point, 2] [m].
        weight: weight of every point.
        yaw: yaw of the first side, from x towards y [rad].

    Returns:
        The tightness is the weighted mean of 1/(d + 3 cm), d the distance to the nearest side.
    """
    rotation = ground_rotation(yaw)
    own = positions @ rotation
    ends = torch.stack([_trimmed_ends(own[:, axis], weight) for axis in range(2)])
    middle, sides = ends.mean(1), ends[:, 1] - ends[:, 0]
    away = (0.5 * sides - (own - middle).abs()).abs().amin(1)
    tight = float((weight / (away + 0.03)).sum() / weight.sum())
    return rotation @ middle, sides, tight


def _trimmed_ends(coordinates: Tensor, weight: Tensor) -> Tensor:
    order = coordinates.argsort()
    share = weight[order].cumsum(0) / weight.sum()
    low = int((share < _TRIMMED_FRACTION).sum())
    high = int((share < 1 - _TRIMMED_FRACTION).sum())
    return coordinates[order][[low, min(high, len(coordinates) - 1)]]


def propose_shapes(
    positions: Float64[Tensor, "point 2"], weight: _Values, *, step: float, height: float
) -> list[ShapeParameters]:
    """Propose shapes for bright points: boxes and walls of two yaws, round shapes, and people,
    vehicles and corner reflectors that fit the extent.

    Args:
        positions: positions on the ground [point, 2] [m].
        weight: weight of every point.
        step: point spacing of the image [m].
        height: height of the radars above the ground, at which objects are observed [m].
    """
    bright = weight > 0
    positions, weight = positions[bright], weight[bright].sqrt()  # lower weight of glints
    turns = [k * 0.5 * math.pi / _YAW_COUNT for k in range(_YAW_COUNT)]
    tried = [(enclosing_rectangle(positions, weight, turn), turn) for turn in turns]
    # The tightest suits a whole outline of a box, the smallest half an outline.
    tightest = max(tried, key=lambda one: one[0][2])
    smallest = min(tried, key=lambda one: float((one[0][1] + step).prod()))
    rows: list[ShapeParameters] = []
    for (middle, sides, _), turn in (tightest, smallest):
        # The image is about one step wider than the object.
        length, width = (max(float(side), 0.02) for side in sides)
        x, y = middle.tolist()
        box = ShapeParameters("box", (x, y), turn, length, width, 1.5 * height)
        thin = {"width" if length > width else "length": _WALL_THICKNESS}
        rows += [box, replace(box, **thin)]
    middle, sides, _ = smallest[0]
    spread, (x, y) = max(float(sides.mean()), 0.02), middle.tolist()
    rows.append(ShapeParameters("cylinder", (x, y), 0.0, spread, spread, 1.5 * height))
    rows.append(ShapeParameters("sphere", (x, y), 0.0, spread, spread, height))
    if float(sides.max()) < MAX_CORNER_EXTENT:
        rows += propose_headings(ShapeParameters("corner", (x, y), height=height))
    around = ShapeParameters("box", (x, y), smallest[1], *sides.clamp_min(0.02).tolist())
    return rows + propose_people_and_vehicles(around)


def propose_headings(shape: ShapeParameters) -> list[ShapeParameters]:
    """Return a shape at eight headings.

    Args:
        shape: shape parameters.
    """
    return [replace(shape, yaw=k * math.pi / 4) for k in range(8)]


def propose_people_and_vehicles(box: ShapeParameters) -> list[ShapeParameters]:
    """Propose people and vehicles of usual sizes that fit a box.

    Args:
        box: box around the points.
    """
    long, short = max(box.length, box.width), min(box.length, box.width)
    rows: list[ShapeParameters] = []
    length, width, height = _PERSON_SIZE
    slim = short < length + _PERSON_MARGIN
    if slim and _MIN_PERSON_EXTENT < long < width + _PERSON_MARGIN:
        upright = replace(box, kind="person", length=length, width=width, height=height)
        rows += propose_headings(upright)
    (low, _, _), (high, wide, height) = SIZE_LIMITS["vehicle"]
    if 0.8 * low < long < high and short < wide:
        ahead = box.yaw if box.length >= box.width else box.yaw + 0.5 * math.pi
        sizes = {"length": max(long, low), "width": max(short, 0.8 * wide), "height": 0.6 * height}
        rows += [replace(box, kind="vehicle", yaw=yaw, **sizes) for yaw in (ahead, ahead + math.pi)]
    return rows
