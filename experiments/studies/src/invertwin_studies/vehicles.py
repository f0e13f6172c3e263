"""Cars from numbers: a generator of bodies and wheels, from small hatchbacks to vans and pick-ups.

The frame is the usual one of vehicles: x ahead, y to the left, z up, metres; the origin lies on the
ground below the middle of the wheelbase.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from invertwin.checks import checked_count, checked_number
from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh
from invertwin.scene.shape_models.iso_surface import iso_surface
from invertwin.scene.shape_models.lattice import Lattice

_MARGIN = 0.12  # of the lattice around a car [m]
_UP = (0.0, 0.03)  # how the underbody rises from the sills to the bumpers [m]


@dataclass(frozen=True)
class Car:
    """The measures of a car. Lengths are in metres, angles in degrees, heights above the ground.

    Attributes:
        length, width, height: of the body, mirrors left out.
        clearance: height of the sills.
        wheelbase: distance of the axles.
        front_overhang: from the front axle to the bumper.
        wheel_radius, wheel_width: of all four.
        arch_gap: between wheel and wheel arch.
        nose_height: where the bonnet begins.
        nose_lean: how far the nose lies behind the bumper.
        bumper_height: of the foremost line.
        chin: how far the lowest front edge lies behind the bumper.
        cowl_height: where the bonnet ends and the windscreen begins.
        cowl_setback: how far behind the front axle that is.
        screen_angle: of the windscreen from the horizontal.
        bonnet_bulge: height of the bonnet's middle over the straight line.
        roof_peak: place of the highest point along the roof, 0 at its front, 1 at its rear.
        roof_front_drop, roof_rear_drop: of the roof's ends below its highest point.
        deck_height: of the boot lid or the bed's rails at the rear.
        deck_length: of the boot lid or the bed; nearly 0 for hatchbacks and vans.
        deck_rise: height of the deck's front over its rear.
        rear_angle: of the rear window from the horizontal.
        tail_lean: how far the rear's upper edge lies ahead of the bumper.
        rear_bumper_height: of the rearmost line.
        rear_chin: how far the lowest rear edge lies ahead of the bumper.
        belt_height: of the line where the windows begin.
        belt_rise: of that line along the car, over its length.
        shoulder_height: where the body is widest.
        sill_inset: how much narrower each side is at the sills.
        belt_inset: how much narrower each side is at the belt line.
        tumblehome: of the side windows from the vertical.
        front_taper, rear_taper: how much narrower each side is at the bumpers.
        front_curve, rear_curve: how far the corners lie behind the middle of the bumpers.
        roof_crown: height of the roof's middle over its edges.
        rounding: radius of the edges between sides, roof and ends.
    """

    length: float = 4.45
    width: float = 1.80
    height: float = 1.48
    clearance: float = 0.20
    wheelbase: float = 2.66
    front_overhang: float = 0.88
    wheel_radius: float = 0.32
    wheel_width: float = 0.21
    arch_gap: float = 0.05
    nose_height: float = 0.74
    nose_lean: float = 0.12
    bumper_height: float = 0.48
    chin: float = 0.10
    cowl_height: float = 0.98
    cowl_setback: float = 0.35
    screen_angle: float = 32.0
    bonnet_bulge: float = 0.02
    roof_peak: float = 0.4
    roof_front_drop: float = 0.06
    roof_rear_drop: float = 0.08
    deck_height: float = 0.98
    deck_length: float = 0.35
    deck_rise: float = 0.05
    rear_angle: float = 35.0
    tail_lean: float = 0.06
    rear_bumper_height: float = 0.55
    rear_chin: float = 0.12
    belt_height: float = 0.95
    belt_rise: float = 0.05
    shoulder_height: float = 0.68
    sill_inset: float = 0.05
    belt_inset: float = 0.06
    tumblehome: float = 20.0
    front_taper: float = 0.12
    rear_taper: float = 0.10
    front_curve: float = 0.15
    rear_curve: float = 0.10
    roof_crown: float = 0.05
    rounding: float = 0.08

    def __post_init__(self) -> None:
        for entry in fields(self):
            low = -math.inf if entry.name in ("cowl_setback", "belt_rise") else 0.0
            checked_number(getattr(self, entry.name), f"a car's {entry.name}", low)

    @property
    def box(self) -> tuple[list[float], list[float]]:
        """Corners of a box around the car with its wheels [m]."""
        front = self.wheelbase / 2 + self.front_overhang
        side = self.width / 2 + _MARGIN
        low = [front - self.length - _MARGIN, -side, -_MARGIN]
        return low, [front + _MARGIN, side, self.height + _MARGIN]


# What differs from kind to kind: ranges of the numbers, from which each is drawn evenly. Heights
# are drawn over the sills' height or below the roof's, so that every car hangs together.
_COMMON = {
    "clearance": (0.13, 0.30),
    "wheel_radius": (0.29, 0.37),
    "wheel_width": (0.17, 0.26),
    "arch_gap": (0.03, 0.08),
    "front_overhang": (0.68, 1.05),
    "nose_height": (0.62, 0.88),
    "nose_lean": (0.02, 0.28),
    "bumper_height": (0.38, 0.60),
    "chin": (0.02, 0.22),
    "cowl_height": (0.86, 1.10),
    "cowl_setback": (0.05, 0.70),
    "screen_angle": (25.0, 42.0),
    "bonnet_bulge": (0.0, 0.06),
    "roof_peak": (0.2, 0.6),
    "roof_front_drop": (0.02, 0.10),
    "roof_rear_drop": (0.02, 0.14),
    "deck_height": (0.85, 1.12),
    "deck_rise": (0.0, 0.10),
    "tail_lean": (0.0, 0.20),
    "rear_bumper_height": (0.42, 0.72),
    "rear_chin": (0.02, 0.28),
    "belt_height": (0.82, 1.05),
    "belt_rise": (-0.01, 0.12),
    "shoulder_height": (0.52, 0.82),
    "sill_inset": (0.0, 0.12),
    "belt_inset": (0.02, 0.12),
    "tumblehome": (12.0, 30.0),
    "front_taper": (0.03, 0.20),
    "rear_taper": (0.02, 0.18),
    "front_curve": (0.05, 0.30),
    "rear_curve": (0.02, 0.22),
    "roof_crown": (0.02, 0.09),
    "rounding": (0.03, 0.12),
}
KINDS: dict[str, dict[str, tuple[float, float]]] = {
    "hatchback": {
        "length": (3.5, 4.5),
        "width": (1.60, 1.86),
        "height": (1.38, 1.62),
        "rear_angle": (38.0, 75.0),
        "deck_length": (0.0, 0.18),
    },
    "saloon": {
        "length": (4.2, 5.3),
        "width": (1.68, 1.95),
        "height": (1.34, 1.54),
        "rear_angle": (22.0, 40.0),
        "deck_length": (0.25, 0.75),
    },
    "coupe": {
        "length": (3.9, 4.9),
        "width": (1.68, 1.95),
        "height": (1.20, 1.42),
        "clearance": (0.11, 0.20),
        "screen_angle": (22.0, 34.0),
        "cowl_setback": (0.30, 1.0),
        "rear_angle": (14.0, 32.0),
        "deck_length": (0.0, 0.6),
    },
    "estate": {
        "length": (4.2, 5.1),
        "width": (1.68, 1.95),
        "height": (1.40, 1.62),
        "rear_angle": (50.0, 80.0),
        "deck_length": (0.0, 0.08),
    },
    "off-road": {
        "length": (3.8, 5.2),
        "width": (1.70, 2.02),
        "height": (1.60, 1.92),
        "clearance": (0.22, 0.42),
        "wheel_radius": (0.33, 0.42),
        "nose_height": (0.82, 1.12),
        "cowl_height": (1.05, 1.30),
        "belt_height": (1.0, 1.25),
        "shoulder_height": (0.68, 0.98),
        "bumper_height": (0.50, 0.75),
        "rear_bumper_height": (0.52, 0.82),
        "deck_height": (1.0, 1.3),
        "screen_angle": (32.0, 58.0),
        "tumblehome": (8.0, 24.0),
        "rear_angle": (55.0, 86.0),
        "deck_length": (0.0, 0.06),
    },
    "van": {
        "length": (4.2, 5.4),
        "width": (1.70, 2.02),
        "height": (1.62, 2.05),
        "cowl_height": (0.98, 1.25),
        "cowl_setback": (-0.30, 0.30),
        "belt_height": (0.95, 1.2),
        "nose_height": (0.70, 1.0),
        "screen_angle": (28.0, 52.0),
        "tumblehome": (6.0, 20.0),
        "rear_angle": (62.0, 87.0),
        "deck_length": (0.0, 0.05),
    },
    "pick-up": {
        "length": (4.7, 5.8),
        "width": (1.70, 2.05),
        "height": (1.56, 1.95),
        "clearance": (0.24, 0.42),
        "wheel_radius": (0.33, 0.42),
        "nose_height": (0.85, 1.15),
        "cowl_height": (1.05, 1.30),
        "belt_height": (1.0, 1.25),
        "shoulder_height": (0.68, 0.98),
        "bumper_height": (0.50, 0.75),
        "rear_bumper_height": (0.52, 0.82),
        "deck_height": (1.0, 1.28),
        "deck_rise": (0.0, 0.03),
        "tail_lean": (0.0, 0.05),
        "screen_angle": (32.0, 50.0),
        "tumblehome": (10.0, 26.0),
        "rear_angle": (65.0, 88.0),
        "deck_length": (1.0, 2.0),
    },
}
_SHARES = (0.20, 0.24, 0.10, 0.12, 0.12, 0.10, 0.12)


def sample_car(seed: int, kind: str | None = None) -> Car:
    """A car of random measures.

    Args:
        seed: the same seed gives the same car.
        kind: one of `KINDS`; None draws it.

    Raises:
        InputError: a seed that is no count, or an unknown kind.
    """
    if kind is not None and kind not in KINDS:
        raise InputError(f"expected a kind of car ({', '.join(KINDS)}), got {kind!r}; choose one")
    random = np.random.default_rng(checked_count(seed, "seed", 0, 2**63 - 1))
    drawn = str(random.choice(list(KINDS), p=_SHARES))
    ranges = {**_COMMON, **KINDS[drawn if kind is None else kind]}
    value = {name: float(random.uniform(*ranges[name])) for name in sorted(ranges)}
    # What must follow from the rest for a car to hang together.
    wheelbase = value["length"] * random.uniform(0.555, 0.625)
    tail = value["length"] - value["front_overhang"] - wheelbase
    value["wheelbase"] = wheelbase - max(0.0, 0.55 - tail)
    value["cowl_height"] = min(value["cowl_height"], value["height"] - 0.30)
    value["belt_height"] = min(value["belt_height"], value["height"] - 0.35)
    value["deck_height"] = min(value["deck_height"], value["height"] - 0.25)
    value["nose_height"] = min(value["nose_height"], value["cowl_height"] - 0.08)
    value["shoulder_height"] = min(value["shoulder_height"], value["belt_height"] - 0.12)
    return Car(**value)


def car_distance(
    car: Car, points: Float[Tensor, "*any 3"], wheels: bool = False
) -> Float[Tensor, "*any"]:
    """A field that is negative inside a car and close to the signed distance near it [m].

    The body is where a side view and a half width meet, with rounded edges, less the wheel arches;
    the side view bends with the distance from the middle plane.

    Args:
        car: its measures.
        points: places [m].
        wheels: with the four wheels.
    """
    x, side, z = points[..., 0], points[..., 1].abs(), points[..., 2]
    half = car.width / 2
    out = (side / half).clamp_max(1.2).square()
    # Ends and roof bend towards the sides; between them the bending fades.
    ahead = (x / (car.length / 2)).clamp(-1.2, 1.2)
    bent_x = x + out * (
        car.front_curve * ahead.clamp_min(0) ** 2 - car.rear_curve * ahead.clamp_max(0) ** 2
    )
    high = ((z - car.belt_height) / (car.height - car.belt_height)).clamp(0, 1)
    bent_z = z + car.roof_crown * out * high
    body = _polygon_distance(_side_view(car), bent_x, bent_z)
    body = _smooth_max(body, side - _half_width(car, x, z), car.rounding)
    wheel = torch.full_like(body, math.inf)
    for axle in (car.wheelbase / 2, -car.wheelbase / 2):
        away = torch.sqrt((x - axle) ** 2 + (z - car.wheel_radius) ** 2 + 1e-12)
        inner = half - 0.02 - car.wheel_width
        arch = torch.maximum(away - car.wheel_radius - car.arch_gap, inner - car.arch_gap - side)
        body = _smooth_max(body, -arch, 0.03)
        tyre = torch.maximum(
            away - car.wheel_radius,
            (side - inner - car.wheel_width / 2).abs() - car.wheel_width / 2,
        )
        wheel = torch.minimum(wheel, tyre)
    return torch.minimum(body, wheel) if wheels else body


def car_mesh(car: Car, spacing: float = 0.05, wheels: bool = True) -> Mesh:
    """The watertight surface of a car.

    Args:
        car: The car.
        spacing: Size of the triangles, about [m].
        wheels: Whether it has some.

    Raises:
        InputError: a spacing that is not positive, or too coarse to meet the car.
    """
    step = checked_number(spacing, "spacing [m]", 0.0, 0.5, open_low=True)
    low, high = car.box
    counts = [math.ceil((b - a) / step) + 1 for a, b in zip(low, high, strict=True)]
    field: Callable[[Tensor], Tensor] = lambda points: car_distance(car, points, wheels)  # noqa: E731
    return iso_surface(field, Lattice.from_bounds(low, high, counts))


def _side_view(car: Car) -> np.ndarray:
    """Corners [n, 2] of the body in x and z, counter-clockwise as seen from the right."""
    front = car.wheelbase / 2 + car.front_overhang
    rear = front - car.length
    axle = car.wheelbase / 2
    low, top = car.clearance, car.height
    nose = (front - car.nose_lean, car.nose_height)
    cowl = (axle - car.cowl_setback, car.cowl_height)
    bonnet = ((nose[0] + cowl[0]) / 2, (nose[1] + cowl[1]) / 2 + car.bonnet_bulge)
    screen = math.tan(math.radians(car.screen_angle))
    header = top - car.roof_front_drop
    roof_front = cowl[0] - (header - cowl[1]) / screen
    tail = rear + car.tail_lean
    edge = top - car.roof_rear_drop
    deck_front = (tail + car.deck_length, car.deck_height + car.deck_rise)
    window = math.tan(math.radians(car.rear_angle))
    roof_rear = deck_front[0] + (edge - deck_front[1]) / window
    # Long rear windows of short cars end below the roof's front: the roof is never shorter than
    # half a metre, the window steeper instead.
    roof_rear = min(roof_rear, roof_front - 0.5)
    peak = roof_front + car.roof_peak * (roof_rear - roof_front)
    corners = [
        (rear + car.rear_chin, low + _UP[1]),
        (-axle, low),
        (axle, low),
        (front - car.chin, low + _UP[1]),
        (front, car.bumper_height),
        nose,
        bonnet,
        cowl,
        (roof_front, header),
        (peak, top),
        (roof_rear, edge),
        deck_front,
        (tail, car.deck_height),
        (rear, min(car.rear_bumper_height, car.deck_height - 0.1)),
    ]
    return _cut_corners(np.array(corners))


def _cut_corners(corners: np.ndarray, share: float = 0.12) -> np.ndarray:
    """Every corner replaced by two, at this share of its sides."""
    ahead = np.roll(corners, -1, axis=0)
    pairs = np.stack([(1 - share) * corners + share * ahead, share * corners + (1 - share) * ahead])
    return pairs.transpose(1, 0, 2).reshape(-1, 2)


def _half_width(car: Car, x: Tensor, z: Tensor) -> Tensor:
    """Distance of the body's side from the middle plane."""
    front = car.wheelbase / 2 + car.front_overhang
    middle, reach = front - car.length / 2, car.length / 2
    place = (x - middle) / reach
    taper = (
        car.front_taper * place.clamp(0, 1.2) ** 3 + car.rear_taper * (-place).clamp(0, 1.2) ** 3
    )
    shoulder, belt = car.shoulder_height, car.belt_height - car.belt_rise * place.clamp(-1, 1) / 2
    below = ((shoulder - z) / (shoulder - car.clearance)).clamp(0, 1.2)
    above = ((z - shoulder) / (belt - shoulder)).clamp(0, 1)
    windows = (z - belt).clamp_min(0) * math.tan(math.radians(car.tumblehome))
    inset = car.sill_inset * below**2 + car.belt_inset * above**2
    return car.width / 2 - taper - inset - windows


def _smooth_max(first: Tensor, second: Tensor, radius: float) -> Tensor:
    """The greater one, rounded where both are within a radius of each other."""
    if radius <= 0:
        return torch.maximum(first, second)
    near = (radius - (first - second).abs()).clamp_min(0) / radius
    return torch.maximum(first, second) + near.square() * (radius / 4)


def _polygon_distance(corners: np.ndarray, x: Tensor, z: Tensor) -> Tensor:
    """Signed distance to a closed polygon of the plane, negative inside."""
    nearest = torch.full_like(x, math.inf)
    inside = torch.zeros_like(x, dtype=torch.bool)
    for (ax, az), (bx, bz) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        dx, dz = float(bx - ax), float(bz - az)
        px, pz = x - float(ax), z - float(az)
        along = ((px * dx + pz * dz) / (dx * dx + dz * dz + 1e-12)).clamp(0, 1)
        nearest = torch.minimum(nearest, (px - along * dx) ** 2 + (pz - along * dz) ** 2)
        if dz != 0:
            crosses = (z >= min(float(az), float(bz))) & (z < max(float(az), float(bz)))
            inside = inside ^ (crosses & (px < pz * (dx / dz)))
    return torch.sqrt(nearest + 1e-12) * torch.where(inside, -1.0, 1.0)
