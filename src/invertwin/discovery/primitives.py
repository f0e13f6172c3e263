"""Simple shapes that stand on the ground, with all their numbers free: what a twin is made of."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal, get_args

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.inversion.initial import Ground
from invertwin.limits import Positive
from invertwin.scene import Material, Mesh, Object, RoughConductor, RoughDielectric, Scene, Surface
from invertwin.scene.checks import check_fields
from invertwin.scene.parameters import Coordinate
from invertwin.scene.shapes import box, cylinder, sphere

Kind = Literal["wall", "box", "cylinder", "sphere", "point"]
KINDS: tuple[str, ...] = get_args(Kind)
THIN = 0.06
"""A box that is thinner than this, and three times as long, is a wall [m]."""
SMALL = 0.06
"""What is smaller than this is a point [m]."""
_SIZES = 0.01, 10.0  # of sides [m]
_BOXED, _BALLS = ("wall", "box"), ("sphere", "point")
_WHITE = 0.9  # of the reflectance of a material


@dataclass(frozen=True, eq=False)
class Matte(Material):
    """A surface that scatters the same brightness everywhere, of any strength.

    An uncalibrated radar knows power only up to a factor, and corners focus: brightness may
    exceed 1, which no rough surface does.

    Attributes:
        brightness: Scattered over incident power.
    """

    brightness: Tensor

    def surface(self, frequency: float) -> Surface:
        """The same at every frequency [Hz]."""
        return Surface(torch.ones(256, dtype=torch.float64), self.brightness)


@dataclass(frozen=True)
class Figure:
    """The numbers of a shape on the ground.

    Attributes:
        kind: Its shape. A wall is a thin box, a point a small sphere.
        place: Along the two axes of the ground [m].
        yaw: About the vertical, of boxes [rad].
        length: Along its first axis; the diameter of round shapes [m].
        width: Along its second axis, of boxes [m].
        height: Of the shape, which stands on the ground; a sphere's is that of its middle [m].
        brightness: See ``Matte``.
    """

    kind: Kind
    place: tuple[float, float]
    yaw: float = 0.0
    length: Positive = 0.3
    width: Positive = 0.3
    height: float = 0.8
    brightness: Positive = 0.1

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def boxed(self) -> bool:
        """Whether it has corners."""
        return self.kind in _BOXED

    @property
    def ball(self) -> bool:
        """Whether it is round all over, so that it need not stand on the ground."""
        return self.kind in _BALLS

    @property
    def material(self) -> RoughDielectric | RoughConductor:
        """The nearest material that a run file can name."""
        if self.brightness > _WHITE:
            return RoughConductor()
        root = math.sqrt(max(self.brightness, 1e-6))
        return RoughDielectric(permittivity=((1 + root) / (1 - root)) ** 2)

    @property
    def named(self) -> Kind:
        """The kind that its numbers speak of."""
        long, short = max(self.length, self.width), min(self.length, self.width)
        if self.boxed:
            return "wall" if short < THIN and long > 3 * short else "box"
        if self.length < SMALL:
            return "point"
        return "sphere" if self.kind == "point" else self.kind


class Primitive(nn.Module):
    """One shape on the ground as an unknown: place, turn, size and brightness.

    It brings its object with it: the scene needs none of that name.

    Args:
        name: Of the object.
        start: Its first numbers.
        ground: The plane, and which way is up.
        level: Height of the ground [m].

    Attributes:
        place: Parameter [2], metres.
        turn: Parameter, half the yaw.
        size: Parameter, thirds of the logarithms of length, width and height; a sphere's last is
            its height in m.
        strength: Parameter, a tenth of the logarithm of the brightness.
    """

    # Scaled so that steps of one length suit all parameters.
    _TURN, _SIZE, _STRENGTH = 2.0, 3.0, 10.0

    def __init__(self, name: str, start: Figure, ground: Ground, level: float = 0.0) -> None:
        super().__init__()
        self.kind: Kind = start.kind
        self.object, self.ground, self.level = name, ground, level
        self.round = start.ball
        low, high = _SIZES
        sizes = [min(max(v, low), high) for v in (start.length, start.width, start.height)]
        logs = torch.tensor(sizes, dtype=torch.float64).log() / self._SIZE
        if self.round:
            logs[2] = start.height
        self.place = nn.Parameter(torch.tensor(start.place, dtype=torch.float64))
        self.turn = nn.Parameter(torch.tensor(start.yaw / self._TURN, dtype=torch.float64))
        self.size = nn.Parameter(logs)
        strength = math.log(start.brightness) / self._STRENGTH
        self.strength = nn.Parameter(torch.tensor(strength, dtype=torch.float64))

    @property
    def sides(self) -> Float64[Tensor, "3"]:
        """Length, width and height within bounds [m]; the last is none of a sphere's."""
        low, high = (math.log(value) for value in _SIZES)
        return (self._SIZE * self.size).clamp(low, high).exp()

    @property
    def brightness(self) -> Float64[Tensor, ""]:
        """See ``Matte``."""
        return (self._STRENGTH * self.strength).exp()

    @property
    def figure(self) -> Figure:
        """Its present numbers."""
        length, width, height = self.sides.detach().tolist()
        x, y = self.place.detach().tolist()
        if self.round:
            height = float(self.size.detach()[2])
        if self.kind not in _BOXED:
            width = length
        yaw = self._TURN * float(self.turn.detach())
        return Figure(
            self.kind, (x, y), yaw, length, width, height, float(self.brightness.detach())
        )

    def mesh(self) -> Mesh:
        """The shape in the world, differentiable by all parameters."""
        unit = _unit(self.kind, self.ground.up)
        first, second = self.ground.level
        up = self.ground.vertical
        size = self.sides
        sides = [size[0]] * 3
        if not self.round:
            sides[up] = size[2]
        if self.kind in _BOXED:
            sides[second] = size[1]
        middle = [self.level + 0.5 * size[2]] * 3
        if self.round:
            middle[up] = self.level + self.size[2]
        middle[first], middle[second] = self.place.unbind()
        local = unit.vertices * torch.stack(sides)
        yaw = self._TURN * self.turn
        c, s = yaw.cos(), yaw.sin()
        # The turn of ``Ground.turn``: about y it takes z towards x, about z it takes x towards y.
        sign = self.ground.sense
        columns = list(local.unbind(-1))
        a, b = columns[first], columns[second]
        columns[first], columns[second] = c * a - sign * s * b, sign * s * a + c * b
        return Mesh(torch.stack(columns, dim=-1) + torch.stack(middle), unit.faces)

    @property
    def item(self) -> Object:
        """The object, differentiable by all parameters."""
        return Object(self.mesh(), Matte(self.brightness))

    def forward(self, scene: Scene) -> Scene:
        """The scene with the object in it, in place of one of the same name."""
        return Scene({**scene.objects, self.object: self.item})

    def values(self) -> dict[str, Tensor]:
        """What is fitted by name, in SI units."""
        found = self.figure
        numbers = {
            "place": found.place,
            "yaw": found.yaw,
            "size": (found.length, found.width, found.height),
            "brightness": found.brightness,
        }
        return {f"{self.object}.{n}": torch.tensor(v) for n, v in numbers.items()}

    def coordinates(self) -> list[Coordinate]:
        """Place, turn, size and brightness, as far as the shape has them."""
        zero, found = torch.zeros_like(self.size), self.figure
        place = torch.eye(2, dtype=torch.float64)
        axes = "xyz"
        rows = [
            Coordinate(f"{self.object}.{axes[axis]}", "m", {"place": along}, 0.1)
            for axis, along in zip(self.ground.level, place, strict=True)
        ]
        sizes = {"length": (0, found.length), "height": (2, found.height)}
        if found.boxed:
            along = torch.tensor(1 / self._TURN, dtype=torch.float64)
            rows.append(Coordinate(f"{self.object}.yaw", "rad", {"turn": along}, 0.2))
            sizes["width"] = (1, found.width)
        for name, (entry, value) in sizes.items():
            along = zero.clone()
            along[entry] = 1.0 if self.round and entry == 2 else 1 / (self._SIZE * value)
            rows.append(Coordinate(f"{self.object}.{name}", "m", {"size": along}, 0.1))
        share = 1 / (self._STRENGTH * found.brightness)
        slope = torch.tensor(share, dtype=torch.float64)
        rows.append(
            Coordinate(f"{self.object}.brightness", "", {"strength": slope}, found.brightness)
        )
        return rows


def upright(figure: Figure, ground: Ground, level: float) -> Float64[Tensor, "3"]:
    """The middle of a shape [m].

    Args:
        figure: The shape.
        ground: The plane.
        level: Height of the ground [m].
    """
    place = torch.zeros(3, dtype=torch.float64)
    place[list(ground.level)] = torch.tensor(figure.place, dtype=torch.float64)
    half = figure.height if figure.ball else 0.5 * figure.height
    place[ground.vertical] = level + half
    return place


@cache
def _unit(kind: str, up: str) -> Mesh:
    """A shape of size one about the origin."""
    if kind in _BOXED:
        return box(1.0)
    if kind in _BALLS:
        return sphere(0.5, 2)
    upright = cylinder(0.5, 1.0)
    # About x by a quarter turn: y to z.
    return upright if up == "y" else Mesh(upright.vertices @ _LAID, upright.faces)


_LAID = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
