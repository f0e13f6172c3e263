"""Simple shapes that stand on the ground, with all their numbers free: what a twin is made of."""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, get_args

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.checks import check_fields
from invertwin.inversion.initialisation.detections import Ground
from invertwin.limits import Positive
from invertwin.scene import (
    Material,
    Mesh,
    Object,
    RoughConductor,
    RoughDielectric,
    Scene,
    Surface,
    person,
)
from invertwin.scene.parameters import Coordinate
from invertwin.scene.people.gait import hanging
from invertwin.scene.shapes import box, cylinder, sphere

Kind = Literal["wall", "box", "cylinder", "sphere", "point", "person", "vehicle", "corner", "prism"]
KINDS: tuple[str, ...] = get_args(Kind)
THIN = 0.06
"""A box that is thinner than this, and three times as long, is a wall [m]."""
SMALL = 0.06
"""What is smaller than this is a point [m]."""
NARROW = 9.0
"""Power of the cosine with which the echo of a trihedral corner falls off the way it opens."""
_NARROW = NARROW - 2  # beside the cos² of any plate
_FACE = 0.03  # side of the plate that stands for a corner reflector [m]
_LEAST, _MOST = (0.01, 0.01, 0.01), (10.0, 10.0, 10.0)
SIZES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "person": ((0.4, 0.2, 1.2), (0.9, 0.5, 2.1)),
    "vehicle": ((3.0, 1.4, 1.2), (6.5, 2.3, 2.6)),
    "corner": ((_FACE, _FACE, 0.01), (_FACE, _FACE, 10.0)),
}
"""Least and greatest length, width and height of kinds that have sizes of their own [m]."""
_BOXED, _BALLS = ("wall", "box", "person", "vehicle"), ("sphere", "point", "corner")
_WHITE = 0.9  # of the reflectance of a material


@dataclass(frozen=True, eq=False)
class Matte(Material):
    """A surface that scatters the same brightness everywhere, of any strength.

    An uncalibrated radar knows power only up to a factor, and corners focus: brightness may
    exceed 1, which no rough surface does.

    Attributes:
        brightness: Scattered over incident power; of every triangle, or of all.
        falling: Power of the cosine of the angle of incidence with which it falls besides.
    """

    brightness: Tensor
    falling: float = 0.0

    def surface(self, frequency: float) -> Surface:
        """The same at every frequency [Hz]."""
        cosine = torch.linspace(0, 1, 256, dtype=torch.float64)
        return Surface(cosine ** (0.5 * self.falling), self.brightness)


@dataclass(frozen=True)
class Figure:
    """The numbers of a shape on the ground.

    Attributes:
        kind: Its shape. A wall is a thin box, a point a small sphere. A person stands with hanging
            arms. A vehicle is a car of usual proportions. A corner is a bright plate that reflects
            on one side: the way a corner reflector opens. A prism has vertical sides and any
            outline, see ``Prism``.
        place: Along the two axes of the ground [m].
        yaw: About the vertical, of all but round shapes [rad]. If it is 0, a vehicle looks along
            x; a person and a corner look along −z where y is up, and along y where z is up.
        length: Along its first axis; the diameter of round shapes [m].
        width: Along its second axis, of shapes with a yaw and of prisms [m].
        height: Of the shape, which stands on the ground; a sphere's and a corner's is that of its
            middle [m].
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
        """Whether it fills a rectangle of the ground, with a yaw."""
        return self.kind in _BOXED

    @property
    def turned(self) -> bool:
        """Whether its yaw means something."""
        return self.boxed or self.kind == "corner"

    @property
    def ball(self) -> bool:
        """Whether it need not stand on the ground."""
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
        if self.kind in ("wall", "box"):
            return "wall" if short < THIN and long > 3 * short else "box"
        if self.kind in ("sphere", "point"):
            return "point" if self.length < SMALL else "sphere"
        return self.kind


class Unknown(nn.Module):
    """What all unknown things on the ground share.

    It brings its object with it: the scene needs none of that name.

    Args:
        name: Of the object.
        ground: The plane, and which way is up.
        level: Height of the ground [m].
        place: To start with [m].
        brightness: To start with, see ``Matte``.

    Attributes:
        place: Parameter [2], metres.
        strength: Parameter, a tenth of the logarithm of the brightness.
    """

    # Scaled so that steps of one length suit all parameters.
    TURN, SIZE, STRENGTH = 2.0, 3.0, 10.0

    def __init__(
        self, name: str, ground: Ground, level: float, place: tuple[float, float], brightness: float
    ) -> None:
        super().__init__()
        self.object, self.ground, self.level = name, ground, level
        self.place = nn.Parameter(torch.tensor(place, dtype=torch.float64))
        strength = math.log(brightness) / self.STRENGTH
        self.strength = nn.Parameter(torch.tensor(strength, dtype=torch.float64))

    @property
    def brightness(self) -> Float64[Tensor, ""]:
        """See ``Matte``."""
        return (self.STRENGTH * self.strength).exp()

    def mesh(self) -> Mesh:
        """The surface in the world, differentiable by all parameters."""
        raise NotImplementedError

    @property
    def item(self) -> Object:
        """The object, differentiable by all parameters."""
        return Object(self.mesh(), Matte(self.brightness))

    def forward(self, scene: Scene) -> Scene:
        """The scene with the object in it, in place of one of the same name."""
        return Scene({**scene.objects, self.object: self.item})

    def places(self) -> list[Coordinate]:
        """The two of its place."""
        along = torch.eye(2, dtype=torch.float64)
        return [
            Coordinate(f"{self.object}.{'xyz'[axis]}", "m", {"place": row}, 0.1)
            for axis, row in zip(self.ground.level, along, strict=True)
        ]

    def bright(self) -> Coordinate:
        """That of its brightness."""
        value = float(self.brightness.detach())
        slope = torch.tensor(1 / (self.STRENGTH * value), dtype=torch.float64)
        return Coordinate(f"{self.object}.brightness", "", {"strength": slope}, value)


class Primitive(Unknown):
    """One shape on the ground as an unknown: place, turn, size and brightness.

    Args:
        name: Of the object.
        start: Its first numbers.
        ground: The plane, and which way is up.
        level: Height of the ground [m].

    Attributes:
        turn: Parameter, half the yaw.
        size: Parameter, thirds of the logarithms of length, width and height; a sphere's last is
            its height in m.
    """

    def __init__(self, name: str, start: Figure, ground: Ground, level: float = 0.0) -> None:
        super().__init__(name, ground, level, start.place, start.brightness)
        self.kind: Kind = start.kind
        self.round = start.ball
        self.low, self.high = SIZES.get(start.kind, (_LEAST, _MOST))
        given = (start.length, start.width, start.height)
        sizes = [
            min(max(v, low), high) for v, low, high in zip(given, self.low, self.high, strict=True)
        ]
        logs = torch.tensor(sizes, dtype=torch.float64).log() / self.SIZE
        if self.round:
            logs[2] = start.height
        self.turn = nn.Parameter(torch.tensor(start.yaw / self.TURN, dtype=torch.float64))
        self.size = nn.Parameter(logs)

    @property
    def sides(self) -> Float64[Tensor, "3"]:
        """Length, width and height within bounds [m]; the last is none of a sphere's."""
        low, high = (torch.tensor(v, dtype=torch.float64).log() for v in (self.low, self.high))
        return (self.SIZE * self.size).clamp(low, high).exp()

    @property
    def figure(self) -> Figure:
        """Its present numbers."""
        length, width, height = self.sides.detach().tolist()
        x, y = self.place.detach().tolist()
        if self.round:
            height = float(self.size.detach()[2])
        if self.kind not in _BOXED:
            width = length
        yaw = self.TURN * float(self.turn.detach())
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
        yaw = self.TURN * self.turn
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
        if self.kind == "corner":
            lit = self.brightness * _front(self.ground.up)
            return Object(self.mesh(), Matte(lit, _NARROW))
        return super().item

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
        rows = self.places()
        sizes = {"length": (0, found.length), "height": (2, found.height)}
        if found.turned:
            along = torch.tensor(1 / self.TURN, dtype=torch.float64)
            rows.append(Coordinate(f"{self.object}.yaw", "rad", {"turn": along}, 0.2))
        if found.boxed:
            sizes["width"] = (1, found.width)
        if found.kind == "corner":
            del sizes["length"]
        for name, (entry, value) in sizes.items():
            along = zero.clone()
            along[entry] = 1.0 if self.round and entry == 2 else 1 / (self.SIZE * value)
            rows.append(Coordinate(f"{self.object}.{name}", "m", {"size": along}, 0.1))
        return [*rows, self.bright()]


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


def opening(yaw: float, ground: Ground) -> Float64[Tensor, "2"]:
    """The way along the ground that a corner opens.

    Args:
        yaw: Of the corner [rad].
        ground: The plane.
    """
    c, s = math.cos(ground.sense * yaw), math.sin(ground.sense * yaw)
    ahead = -1.0 if ground.up == "y" else 1.0
    return ahead * torch.tensor([-s, c], dtype=torch.float64)


def turned(figure: Figure, turn: float, ground: Ground) -> Figure:
    """A shape that looks another way: turned about the mean of its surface, not about its middle.

    Args:
        figure: The shape.
        turn: By which its yaw grows [rad].
        ground: The plane.
    """
    unit = _unit(figure.kind, ground.up).vertices.mean(0)[list(ground.level)]
    x, y = (unit * torch.tensor([figure.length, figure.width], dtype=torch.float64)).tolist()
    before, after = ground.sense * figure.yaw, ground.sense * (figure.yaw + turn)
    rows = [
        (math.cos(a) * x - math.sin(a) * y, math.sin(a) * x + math.cos(a) * y)
        for a in (before, after)
    ]
    first, second = (p + a - b for p, a, b in zip(figure.place, *rows, strict=True))
    return replace(figure, place=(first, second), yaw=figure.yaw + turn)


@cache
def _unit(kind: str, up: str) -> Mesh:
    """A shape of size one about the origin."""
    if kind in ("wall", "box"):
        return box(1.0)
    if kind in ("sphere", "point"):
        return sphere(0.5, 2)
    upright = {"person": _standing, "vehicle": _vehicle, "corner": _plate}.get(kind, _post)()
    # About x by a quarter turn: y to z.
    return upright if up == "y" else Mesh(upright.vertices @ _LAID, upright.faces)


_LAID = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)


def _post() -> Mesh:
    return cylinder(0.5, 1.0)


def _standing() -> Mesh:
    """A person with hanging arms who looks along −z, stretched to a cube."""
    body = person(spacing=0.05)
    turns = torch.eye(3, dtype=torch.float64).repeat(len(body.names), 1, 1)
    for side in ("left", "right"):
        turns[body.joint(f"{side}_shoulder")] = hanging(side)
    skin, _ = body.posed(turns)
    low, high = skin.amin(0), skin.amax(0)
    return Mesh((skin - 0.5 * (low + high)) / (high - low), body.faces)


def _vehicle() -> Mesh:
    """A car that looks along x: octagons above each other, between them its skin."""
    sides = 8
    rings = torch.tensor([_octagon(*layer) for layer in _LAYERS], dtype=torch.float64).flatten(0, 1)
    faces: list[list[int]] = []
    for layer in range(len(_LAYERS) - 1):
        for k in range(sides):
            a, b = layer * sides + k, layer * sides + (k + 1) % sides
            faces += [[a, b, a + sides], [b, b + sides, a + sides]]
    for first in (0, (len(_LAYERS) - 1) * sides):
        faces += [[first, first + k, first + k + 1] for k in range(1, sides - 1)]
    return Mesh(rings, torch.tensor(faces))


# Height, rear end, front end and width, as shares of those of a car: underbody, sills, bumpers and
# shoulders, belt line, foot of the screens, roof.
_LAYERS = (
    (0.0, -0.30, 0.30, 0.5),
    (0.15, -0.47, 0.46, 0.94),
    (0.36, -0.50, 0.50, 1.0),
    (0.58, -0.48, 0.45, 0.98),
    (0.66, -0.45, 0.24, 0.92),
    (1.0, -0.30, -0.02, 0.7),
)


def _octagon(high: float, rear: float, front: float, wide: float) -> list[list[float]]:
    """Corners of one layer of a car: a rectangle whose corners are cut off."""
    cut, aside = 0.07, 0.3 * wide
    rows = [(front, aside), (front - cut, 0.5 * wide), (rear + cut, 0.5 * wide), (rear, aside)]
    rows += [(x, -z) for x, z in reversed(rows)]
    return [[x, high - 0.5, z] for x, z in rows]


def _plate() -> Mesh:
    """A plate that faces −z."""
    return box((1.0, 1.0, 0.1))


@cache
def _front(up: str) -> Float64[Tensor, " triangle"]:
    """1 for the triangles of a corner's plate that face the way it opens, else 0."""
    mesh = _unit("corner", up)
    ahead = mesh.vertices[:, 2] < 0 if up == "y" else mesh.vertices[:, 1] > 0
    return ahead[mesh.faces].all(1).double()
