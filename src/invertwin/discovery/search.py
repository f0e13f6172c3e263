"""Which shapes there are: births from what is unexplained, other kinds, mergers, and deaths."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.discovery.assembly import Assembly
from invertwin.discovery.primitives import Figure
from invertwin.discovery.proposals import bright, figures, groups
from invertwin.discovery.sharp_image import Response, sharpened, thinned
from invertwin.inversion.initial import Ground

_MOST = 24  # objects
_ROUNDS = 3  # of births
_NEAR = 0.5  # gap between what may be one [m]
_HOPE = 100.0  # evidence that a fit may gain
_SHORT, _LONG = 25, 50  # steps of fits
_PATIENCE = 3  # groups in a row that explain nothing
_DIM = 1e-3  # of all strength: dimmer groups wait for the next round


@dataclass(frozen=True, eq=False)
class Lattice:
    """The places of an image on the ground, with their responses.

    Attributes:
        places: On the ground [m].
        step: Between neighbours [m].
        response: Of the places, to thinned maps.
        height: Of the radars above the ground [m].
    """

    places: Float64[Tensor, "place 2"]
    step: float
    response: Response
    height: float


def numbers_of(figure: Figure) -> int:
    """How many numbers a shape has.

    Args:
        figure: The shape.
    """
    return 7 if figure.boxed else 5


@dataclass(frozen=True, eq=False)
class Search:
    """A search for the shapes that explain maps.

    Evidence is the logarithm of the likelihood less half the logarithm of the number of draws for
    every free number, on the frames that are fitted; on frames that are held out, a change must
    not be for the worse either.

    Attributes:
        fitted: The frames that are fitted.
        held: Those that are held out; None = too few frames to hold some out.
        lattice: Of the image.

    Source of the penalty: Schwarz, "Estimating the dimension of a model", 1978.
    """

    fitted: Assembly
    held: Assembly | None
    lattice: Lattice

    @property
    def ground(self) -> Ground:
        """The plane."""
        return self.fitted.ground

    def evidence(self, shapes: Sequence[Figure]) -> float:
        """Of shapes, on the fitted frames.

        Args:
            shapes: What there may be.
        """
        count = sum(numbers_of(shape) for shape in shapes)
        return float(self.fitted.gains(shapes).sum()) - 0.5 * count * math.log(self.fitted.draws)

    def better(self, new: Sequence[Figure], old: Sequence[Figure]) -> bool:
        """Whether shapes are to be preferred.

        Args:
            new: What there may be.
            old: What was thought so far.
        """
        if self.evidence(new) <= self.evidence(old):
            return False
        if self.held is None or len(new) <= len(old):
            return True
        return float(self.held.gains(new).sum()) > float(self.held.gains(old).sum())

    @cached_property
    def first_image(self) -> Float64[Tensor, " place"]:
        """Where echoes come from, while nothing is known."""
        return self.image([])

    def image(self, shapes: Sequence[Figure]) -> Float64[Tensor, " place"]:
        """What shapes leave unexplained, as an image.

        Args:
            shapes: What is known already.
        """
        one = self.fitted
        level = one.loss.level[:, None, None]
        rest, _ = thinned(one.predicted(shapes).double() + level, one.radar, one.model.grid)
        power, _ = thinned(one.power, one.radar, one.model.grid)
        return sharpened(self.lattice.response, power, rest, degrees=one.loss.degrees)

    def run(self) -> list[Figure]:
        """The shapes."""
        shapes, before = list[Figure](), 0
        for _ in range(_ROUNDS):
            born = self.births(shapes)
            if not born:
                break
            shapes = self.merged(self.settled([*shapes, *born]))
            survivors = self.alive(shapes)
            stalled = len(survivors) <= before
            before, shapes = len(survivors), survivors
            if stalled:
                break
        if not shapes:
            return []
        shapes = self.merged(self.kinds(shapes))
        shapes, _ = self.fitted.fitted(shapes, _LONG)
        shapes = self.settled(self.heights(shapes))
        return self.alive(shapes)

    def births(self, shapes: Sequence[Figure]) -> list[Figure]:
        """What could explain the rest, where it is bright.

        Args:
            shapes: What is known already.
        """
        strength = self.image(shapes) if shapes else self.first_image
        # What a point's own kind of image cannot tell from speckle is left alone.
        weight = bright(strength)
        parts = groups(self.lattice.places, weight, 3.5 * self.lattice.step)
        total = float(strength.sum())
        parts = [part for part in parts if float(part.sum()) > _DIM * total]
        known, born = list(shapes), list[tuple[Tensor, Figure]]()
        gain, vain = float(self.fitted.gains(known).sum()), 0
        for part in parts[: _MOST - len(shapes)]:
            one = self.best(known, self.options(part))
            new = float(self.fitted.gains([*known, one]).sum())
            if new > gain:
                gain, vain = new, 0
                known.append(one)
                born.append((part, one))
            elif (vain := vain + 1) == _PATIENCE:
                break  # dimmer groups tell no more
        return [one for _, one in self.united(shapes, born)]

    def united(
        self, shapes: Sequence[Figure], born: Sequence[tuple[Tensor, Figure]]
    ) -> list[tuple[Tensor, Figure]]:
        """Groups and their shapes, with one box for two groups where that is likelier.

        Two far ends of a box are often bright, and nothing between them.

        Args:
            shapes: What is known already.
            born: Groups of the image, and what stands there.
        """
        found, tried = list(born), set[tuple[int, int]]()
        while True:
            pairs = [
                (self._gap(a[0], b[0]), a, b)
                for k, a in enumerate(found)
                for b in found[k + 1 :]
                if (id(a[0]), id(b[0])) not in tried
            ]
            pairs = [pair for pair in pairs if pair[0] < _NEAR]
            if not pairs:
                return found
            _, a, b = min(pairs, key=lambda pair: pair[0])
            tried.add((id(a[0]), id(b[0])))
            others = [pair for pair in found if pair is not a and pair is not b]
            known = [*shapes, *(one for _, one in others)]
            part = a[0] + b[0]
            one = self.best(known, self.options(part))
            if self.evidence([*known, one]) > self.evidence([*known, a[1], b[1]]):
                found = [*others, (part, one)]

    def _gap(self, first: Tensor, second: Tensor) -> float:
        places = self.lattice.places
        return float(torch.cdist(places[first > 0], places[second > 0]).min())

    def options(self, part: Tensor) -> list[Figure]:
        """What could stand where a group of places is bright.

        Args:
            part: Strength of every place [m²], zero outside the group.
        """
        lattice = self.lattice
        rows = figures(lattice.places, part, self.ground, step=lattice.step, height=lattice.height)
        found: list[Figure] = []
        for row in rows:
            # A matte wall of area A seen aslant: cross-section 4 β A cos²θ, half of it on average.
            seen = 0.5 * math.pi * (row.length + row.width) * 1.5 * lattice.height
            bright = max(float(part.sum()) / seen, 1e-4)
            found.append(replace(row, brightness=bright))
        return found

    def best(self, known: Sequence[Figure], options: Iterable[Figure]) -> Figure:
        """The likeliest of some shapes, beside others.

        Args:
            known: The others.
            options: To choose from.
        """
        return max(options, key=lambda one: self.evidence([*known, one]))

    def settled(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Shapes after a short fit.

        Args:
            shapes: At its start.
        """
        return self.fitted.fitted(shapes, _SHORT)[0]

    def alive(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Shapes without those that evidence does not speak for, the weakest first.

        Args:
            shapes: All of them.
        """
        found: list[Figure] = [*shapes]
        while found:
            without: list[list[Figure]] = [[*found[:k], *found[k + 1 :]] for k in range(len(found))]
            weakest = max(without, key=self.evidence)
            if self.better(found, weakest):
                break
            found = weakest
        return found

    def kinds(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Shapes, each of the kind that is likeliest, after a fit as every kind.

        Args:
            shapes: After a fit.
        """
        fitted = {
            kind: self.settled([as_kind(shape, kind) for shape in shapes])
            for kind in ("box", "cylinder", "sphere")
        }
        found = list(shapes)
        for number in range(len(found)):
            rest = [*found[:number], *found[number + 1 :]]
            options = [found[number], *(rows[number] for rows in fitted.values())]
            found[number] = max(options, key=lambda one, rest=rest: self.evidence([*rest, one]))
        return found

    def heights(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Shapes of the likeliest heights.

        What is above the radars has nearly the same ranges as what is below, so that a height may
        rest in a minimum of its own.

        Args:
            shapes: After a fit.
        """
        found = list(shapes)
        for number, shape in enumerate(found):
            options = [
                replace(
                    shape, height=shape.height * part, brightness=shape.brightness * part**-power
                )
                for part in _PARTS
                for power in (0.5, 1.0)
            ]
            rest = [*found[:number], *found[number + 1 :]]
            found[number] = max(
                [shape, *options],
                key=lambda one, rest=rest: self.evidence([*rest, one]),
            )
        return found

    def merged(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Shapes, with one box in place of two where that is likelier.

        Args:
            shapes: After a fit.
        """
        found, tried = list(shapes), set[tuple[Figure, Figure]]()
        while True:
            pairs = [
                (a, b)
                for k, a in enumerate(found)
                for b in found[k + 1 :]
                if (a, b) not in tried and apart(a, b, self.ground) < _NEAR
            ]
            if not pairs:
                return found
            a, b = min(pairs, key=lambda pair: apart(*pair, self.ground))
            tried.add((a, b))
            rest = [shape for shape in found if shape is not a and shape is not b]
            one = self.best(rest, [around((a, b), turn, self.ground) for turn in _TURNS])
            if self.evidence([*rest, one]) < self.evidence(found) - _HOPE:
                continue
            new = self.settled([*rest, one])
            if self.better(new, found):
                found = new


_PARTS = (0.4, 0.55, 0.75, 1.35, 2.0)  # of a height that are tried
_TURNS = tuple(k * math.pi / 16 for k in range(8))


def as_kind(shape: Figure, kind: str) -> Figure:
    """A shape of another kind, of about the same size.

    Args:
        shape: As it is.
        kind: Which it is to be.
    """
    if kind == shape.kind:
        return shape
    if kind == "box":
        side = 0.85 * shape.length
        high = shape.height if shape.kind == "cylinder" else 2 * shape.height
        return replace(shape, kind="box", length=side, width=side, height=high)
    mean = 0.5 * (shape.length + shape.width)
    across = mean if not shape.boxed else 1.1 * mean
    high = shape.height
    if kind == "sphere" and shape.kind != "sphere":
        high = 0.5 * shape.height
    elif kind == "cylinder" and shape.kind == "sphere":
        high = 2 * shape.height
    return replace(shape, kind=kind, length=across, width=across, height=max(high, 0.05))


def around(shapes: Sequence[Figure], yaw: float, ground: Ground) -> Figure:
    """A box about shapes.

    Args:
        shapes: Which are to be one.
        yaw: Of the box [rad].
        ground: The plane.
    """
    corners = torch.cat([outline(shape, ground) for shape in shapes])
    c, s = math.cos(ground.sense * yaw), math.sin(ground.sense * yaw)
    own = corners @ torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    low, high = own.amin(0), own.amax(0)
    x, y = (0.5 * (low + high)).tolist()
    length, width = (high - low).tolist()
    brightest = max(shapes, key=lambda one: one.brightness)
    tall = max(shape.height for shape in shapes)
    return Figure(
        "box", (c * x - s * y, s * x + c * y), yaw, length, width, tall, brightest.brightness
    )


def apart(first: Figure, second: Figure, ground: Ground) -> float:
    """The gap between two shapes, to a few centimetres [m].

    Args:
        first, second: The shapes.
        ground: The plane.
    """
    share = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None, None]
    sides: list[Tensor] = []
    for shape in (first, second):
        corners = outline(shape, ground)
        sides.append((corners + share * (corners.roll(1, 0) - corners)).flatten(0, 1))
    return float(torch.cdist(sides[0], sides[1]).min())


def outline(shape: Figure, ground: Ground, count: int = 16) -> Float64[Tensor, "corner 2"]:
    """Corners of a shape on the ground [m], those of a polygon for round ones.

    Args:
        shape: The shape.
        ground: The plane.
        count: Of the polygon's corners.
    """
    middle = torch.tensor(shape.place, dtype=torch.float64)
    if not shape.boxed:
        turns = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
        return middle + 0.5 * shape.length * torch.stack([turns.cos(), turns.sin()], dim=1)
    c, s = math.cos(ground.sense * shape.yaw), math.sin(ground.sense * shape.yaw)
    half = 0.5 * torch.tensor([shape.length, shape.width], dtype=torch.float64)
    signs = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64)
    return middle + (signs * half) @ torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
