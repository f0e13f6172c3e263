"""Parametric shapes on the ground: the primitives of an automatic twin."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, get_args

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin import scene as scenes
from invertwin.checks import CheckedFields
from invertwin.constants import read_table
from invertwin.limits import Positive
from invertwin.scene.parameters import Coordinate, position_coordinates
from invertwin.scene.people.gait import hanging_arm_rotation
from invertwin.scene.shapes import box, cylinder, sphere

ShapeKind = Literal[
    "wall", "box", "cylinder", "sphere", "point", "person", "vehicle", "corner", "prism"
]
SHAPE_KINDS: tuple[str, ...] = get_args(ShapeKind)
MAX_WALL_THICKNESS = 0.06
"""Maximum thickness of a wall, a box three times as long [m]."""
MAX_POINT_SIZE = 0.06
"""Maximum size of a point [m]."""
CORNER_EXPONENT = 9.0
"""Cosine exponent of the echo of a trihedral corner about its axis."""
_CORNER_FALLOFF = CORNER_EXPONENT - 2  # in addition to the cos² of any plate
_MIN_SIZES, _MAX_SIZES = (0.01, 0.01, 0.01), (10.0, 10.0, 10.0)
_TABLES = read_table("invertwin.discovery.shapes", "primitives.toml")
SIZE_LIMITS: dict[str, list[list[float]]] = _TABLES["size_limits"]
"""Minimum and maximum length, width and height of kinds with specific sizes [m]."""
_RECTANGULAR_KINDS = ("wall", "box", "person", "vehicle")
_FREE_HEIGHT_KINDS = ("sphere", "point", "corner")
MAX_DIELECTRIC_REFLECTANCE = 0.9
"""Larger reflectances are metal."""


@dataclass(frozen=True, eq=False)
class Matte(scenes.Material):
    """Surface of constant brightness in all directions, of any strength.

    The power of an uncalibrated radar is known up to a factor, and corners focus: unlike that of a
    rough surface, brightness may exceed 1.

    Attributes:
        brightness: scattered over incident power; per triangle, or one number.
        cosine_power: additional exponent of the cosine of the angle of incidence.
    """

    brightness: Tensor
    cosine_power: float = 0.0

    def scattering_law(self, frequency: float) -> scenes.ScatteringLaw:
        """Return the law, equal at every frequency [Hz]."""
        cosine = torch.linspace(0, 1, 256, dtype=torch.float64)
        return scenes.ScatteringLaw(cosine ** (0.5 * self.cosine_power), self.brightness)


@dataclass(frozen=True)
class ShapeParameters(CheckedFields):
    """Parameters of a shape on the ground.

    Attributes:
        kind: kind of shape. A wall is a thin box, a point a small sphere. A person stands with
            hanging arms. A vehicle is a car of usual proportions. A corner is a bright plate that
            reflects on one side, towards the opening of a corner reflector. A prism has vertical
            sides and any outline, see ``PrismParameters``.
        position: x and y on the ground [m].
        yaw: rotation about z, except for round shapes [rad]. At yaw 0, a vehicle faces x; a person
            and a corner face −x.
        length: size along x at yaw 0; the diameter of round shapes [m].
        width: size along y at yaw 0, of shapes with a yaw and of prisms [m].
        height: height of the shape above the ground; for a sphere and a corner that of its centre
            [m].
        brightness: see ``Matte``.
    """

    kind: ShapeKind
    position: tuple[float, float]
    yaw: float = 0.0
    length: Positive = 0.3
    width: Positive = 0.3
    height: float = 0.8
    brightness: Positive = 0.1

    @property
    def is_rectangular(self) -> bool:
        """True if the footprint is a rectangle with a yaw."""
        return self.kind in _RECTANGULAR_KINDS

    @property
    def has_yaw(self) -> bool:
        """True if the shape has a yaw."""
        return self.is_rectangular or self.kind == "corner"

    @property
    def has_free_height(self) -> bool:
        """True if the shape may be above the ground."""
        return self.kind in _FREE_HEIGHT_KINDS

    @property
    def material(self) -> scenes.RoughDielectric | scenes.RoughConductor:
        """Nearest library material."""
        if self.brightness > MAX_DIELECTRIC_REFLECTANCE:
            return scenes.RoughConductor()
        root = math.sqrt(max(self.brightness, 1e-6))
        return scenes.RoughDielectric(permittivity=((1 + root) / (1 - root)) ** 2)

    @property
    def effective_kind(self) -> ShapeKind:
        """Kind according to its parameters."""
        long, short = max(self.length, self.width), min(self.length, self.width)
        if self.kind in ("wall", "box"):
            return "wall" if short < MAX_WALL_THICKNESS and long > 3 * short else "box"
        if self.kind in ("sphere", "point"):
            return "point" if self.length < MAX_POINT_SIZE else "sphere"
        return self.kind


Shapes = Sequence[ShapeParameters]


class UnknownShape(nn.Module):
    """Common base of unknown shapes on the ground.

    It adds its object to the scene.

    Args:
        name: name of the object.
        level: height of the ground [m].
        position: initial x and y [m].
        brightness: initial brightness, see ``Matte``.

    Attributes:
        place: parameter [2], x and y [m].
        strength: parameter, a tenth of the logarithm of the brightness.
    """

    # Scaled so that one learning rate suits all parameters.
    TURN_SCALE, SIZE_SCALE, STRENGTH_SCALE = 2.0, 3.0, 10.0

    def __init__(
        self, name: str, level: float, position: tuple[float, float], brightness: float
    ) -> None:
        super().__init__()
        self.object, self.level = name, level
        self.place = nn.Parameter(torch.tensor(position, dtype=torch.float64))
        strength = math.log(brightness) / self.STRENGTH_SCALE
        self.strength = nn.Parameter(torch.tensor(strength, dtype=torch.float64))

    @property
    def brightness(self) -> Float64[Tensor, ""]:
        """Brightness, see ``Matte``."""
        return (self.STRENGTH_SCALE * self.strength).exp()

    def mesh(self) -> scenes.Mesh:
        """Return the surface in the world, differentiable with respect to all parameters."""
        raise NotImplementedError

    @property
    def item(self) -> scenes.Object:
        """Return the object, differentiable with respect to all parameters."""
        return scenes.Object(self.mesh(), Matte(self.brightness))

    def forward(self, scene: scenes.Scene) -> scenes.Scene:
        """Return the scene with the object, in place of one of the same name."""
        return scenes.Scene({**scene.objects, self.object: self.item})

    def position_coordinates(self) -> list[Coordinate]:
        """Return the two coordinates of its position."""
        return position_coordinates(self.object, "place", torch.ones(2, dtype=torch.float64))

    def brightness_coordinate(self) -> Coordinate:
        """Return the coordinate of its brightness."""
        value = float(self.brightness.detach())
        slope = torch.tensor(1 / (self.STRENGTH_SCALE * value), dtype=torch.float64)
        return Coordinate(f"{self.object}.brightness", "", {"strength": slope}, value)


class PrimitiveModel(UnknownShape):
    """Primitive shape on the ground as an unknown: position, yaw, size and brightness.

    Args:
        name: name of the object.
        start: initial shape parameters.
        level: height of the ground [m].

    Attributes:
        turn: parameter, half the yaw [rad].
        size: parameter, thirds of the logarithms of length, width and height; a sphere's last is
            its height in m.
    """

    def __init__(self, name: str, start: ShapeParameters, level: float = 0.0) -> None:
        super().__init__(name, level, start.position, start.brightness)
        self.kind: ShapeKind = start.kind
        self.round = start.has_free_height
        limits = SIZE_LIMITS.get(start.kind, (_MIN_SIZES, _MAX_SIZES))
        self.low, self.high = (torch.tensor(sizes, dtype=torch.float64) for sizes in limits)
        given = torch.tensor([start.length, start.width, start.height], dtype=torch.float64)
        logs = given.clamp(self.low, self.high).log() / self.SIZE_SCALE
        if self.round:
            logs[2] = start.height
        self.turn = nn.Parameter(torch.tensor(start.yaw / self.TURN_SCALE, dtype=torch.float64))
        self.size = nn.Parameter(logs)

    @property
    def sides(self) -> Float64[Tensor, "3"]:
        """Return length, width and height within bounds [m]; the last is unused for a sphere."""
        return (self.SIZE_SCALE * self.size).clamp(self.low.log(), self.high.log()).exp()

    @property
    def shape(self) -> ShapeParameters:
        """Return the current shape parameters."""
        length, width, height = self.sides.detach().tolist()
        x, y = self.place.detach().tolist()
        if self.round:
            height = float(self.size.detach()[2])
        if self.kind not in _RECTANGULAR_KINDS:
            width = length
        yaw = self.TURN_SCALE * float(self.turn.detach())
        brightness = float(self.brightness.detach())
        return ShapeParameters(self.kind, (x, y), yaw, length, width, height, brightness)

    def mesh(self) -> scenes.Mesh:
        """Return the shape in the world, differentiable with respect to all parameters."""
        unit = _unit_mesh(self.kind)
        length, width, height = self.sides
        if self.kind not in _RECTANGULAR_KINDS:
            width = length
        if self.round:
            height = length
        middle = self.level + (self.size[2] if self.round else 0.5 * height)
        x, y, z = (unit.vertices * torch.stack([length, width, height])).unbind(-1)
        yaw = self.TURN_SCALE * self.turn
        c, s = yaw.cos(), yaw.sin()
        local = torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)
        return scenes.Mesh(local + torch.cat([self.place, middle[None]]), unit.faces)

    @property
    def item(self) -> scenes.Object:
        """Return the object, differentiable with respect to all parameters."""
        if self.kind == "corner":
            brightness = self.brightness * _mark_front_triangles()
            return scenes.Object(self.mesh(), Matte(brightness, _CORNER_FALLOFF))
        return super().item

    def values(self) -> dict[str, Tensor]:
        """Return the fitted values by name, in SI units."""
        found, names = self.shape, ("place", "yaw", "size", "brightness")
        size = found.length, found.width, found.height
        values = map(torch.tensor, (found.position, found.yaw, size, found.brightness))
        return {f"{self.object}.{n}": value for n, value in zip(names, values, strict=True)}

    def coordinates(self) -> list[Coordinate]:
        """Return position, yaw, size and brightness, as far as the shape has them."""
        zero, found = torch.zeros_like(self.size), self.shape
        rows = self.position_coordinates()
        sizes = {"length": (0, found.length), "height": (2, found.height)}
        if found.has_yaw:
            along = torch.tensor(1 / self.TURN_SCALE, dtype=torch.float64)
            rows.append(Coordinate(f"{self.object}.yaw", "rad", {"turn": along}, 0.2))
        if found.is_rectangular:
            sizes["width"] = (1, found.width)
        if found.kind == "corner":
            del sizes["length"]
        for name, (entry, value) in sizes.items():
            along = zero.clone()
            along[entry] = 1.0 if self.round and entry == 2 else 1 / (self.SIZE_SCALE * value)
            rows.append(Coordinate(f"{self.object}.{name}", "m", {"size": along}, 0.1))
        return [*rows, self.brightness_coordinate()]


def shape_center(shape: ShapeParameters, level: float) -> Float64[Tensor, "3"]:
    """Return the centre of a shape [m].

    Args:
        shape: shape parameters.
        level: height of the ground [m].
    """
    half = shape.height if shape.has_free_height else 0.5 * shape.height
    return torch.tensor([*shape.position, level + half], dtype=torch.float64)


def corner_direction(yaw: float) -> Float64[Tensor, "2"]:
    """Return the direction along the ground in which a corner opens.

    Args:
        yaw: yaw of the corner [rad].
    """
    return -torch.tensor([math.cos(yaw), math.sin(yaw)], dtype=torch.float64)


def rotate_shape(shape: ShapeParameters, rotation: float) -> ShapeParameters:
    """Rotate a shape about the mean of its surface, not about its centre.

    Args:
        shape: shape parameters.
        rotation: increase of its yaw [rad].
    """
    unit, yaw = _unit_mesh(shape.kind).vertices.mean(0)[:2], shape.yaw + rotation
    mean = unit * torch.tensor([shape.length, shape.width], dtype=torch.float64)
    shift = (ground_rotation(shape.yaw) - ground_rotation(yaw)) @ mean
    x, y = (torch.tensor(shape.position, dtype=torch.float64) + shift).tolist()
    return replace(shape, position=(x, y), yaw=yaw)


def ground_rotation(yaw: float) -> Float64[Tensor, "2 2"]:
    """Return the rotation by a yaw of x and y.

    Args:
        yaw: angle from x towards y [rad].
    """
    c, s = math.cos(yaw), math.sin(yaw)
    return torch.tensor([[c, -s], [s, c]], dtype=torch.float64)


@cache
def _unit_mesh(kind: str) -> scenes.Mesh:
    """Return the mesh of a shape of unit size about the origin."""
    if kind in ("wall", "box"):
        return box(1.0)
    if kind in ("sphere", "point"):
        return sphere(0.5, 2)
    if kind == "corner":  # a plate that faces −x
        return box((0.1, 1.0, 1.0))
    builders = {"person": _person_mesh, "vehicle": _vehicle_mesh}
    return builders[kind]() if kind in builders else cylinder(0.5, 1.0)


def _person_mesh() -> scenes.Mesh:
    """Return a person with hanging arms facing −x, stretched to a cube."""
    body = scenes.person(spacing=0.05)
    turns = torch.eye(3, dtype=torch.float64).repeat(len(body.names), 1, 1)
    for side in ("left", "right"):
        turns[body.joint(f"{side}_shoulder")] = hanging_arm_rotation(side)
    skin, _ = body.apply_pose(turns)
    low, high = skin.amin(0), skin.amax(0)
    return scenes.Mesh((skin - 0.5 * (low + high)) / (high - low), body.faces)


def _vehicle_mesh() -> scenes.Mesh:
    """Return a car facing x: stacked octagonal layers joined by a skin."""
    sides = 8
    layers = [_vehicle_layer(*layer) for layer in _TABLES["vehicle_layers"]]
    rings = torch.tensor(layers, dtype=torch.float64).flatten(0, 1)
    faces: list[list[int]] = []
    for layer in range(len(layers) - 1):
        for k in range(sides):
            a, b = layer * sides + k, layer * sides + (k + 1) % sides
            faces += [[a, b, a + sides], [b, b + sides, a + sides]]
    for first in (0, (len(layers) - 1) * sides):
        faces += [[first, first + k, first + k + 1] for k in range(1, sides - 1)]
    return scenes.Mesh(rings, torch.tensor(faces))


def _vehicle_layer(high: float, rear: float, front: float, wide: float) -> list[list[float]]:
    """Return the corners of one layer of a car: a rectangle with cut corners."""
    cut, aside = 0.07, 0.3 * wide
    rows = [(front, -aside), (front - cut, -0.5 * wide), (rear + cut, -0.5 * wide), (rear, -aside)]
    rows += [(x, -y) for x, y in reversed(rows)]
    return [[x, y, high - 0.5] for x, y in rows]


@cache
def _mark_front_triangles() -> Float64[Tensor, " triangle"]:
    """Return 1 for triangles of a corner's plate on its open side, else 0."""
    mesh = _unit_mesh("corner")
    return (mesh.vertices[:, 0] < 0)[mesh.faces].all(1).double()
