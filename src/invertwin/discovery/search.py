"""Which shapes there are: births from what is unexplained, other kinds, mergers, and deaths."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.discovery.assembly import Assembly
from invertwin.discovery.imaging.reflectivity import Response, sharpened
from invertwin.discovery.proposals import CORNER, bright, figures, groups, headings, standing
from invertwin.discovery.shapes.primitives import Figure, opening, turned
from invertwin.discovery.shapes.prisms import Prism, contour
from invertwin.inversion.initialisation.detections import Ground

_MOST = 24  # objects
_ROUNDS = 3  # of births
_NEAR = 0.5  # gap between what may be one [m]
_HOPE = 100.0  # evidence that a fit may gain
_SLIM = 0.4  # of a side: how wide the slimmer half of a shape is at first
_WHOLE = 0.25  # side of the smallest shape that may be two [m]
_SHORT, _LONG = 25, 50  # steps of fits
_GLINTS = 4  # corner reflectors of a round
_SEEN = 0.8  # cosine off the way a corner opens, up to which it is bright
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
        coarse = one.coarse
        rest = one.coarse_predicted(shapes) + coarse.loss.level[:, None, None]
        return sharpened(self.lattice.response, coarse.power, rest, degrees=coarse.loss.degrees)

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
        shapes = self.split(self.merged(self.turns(self.kinds(shapes))))
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
        found = [one for _, one in self.united(shapes, born)]
        return found + self.glints([*shapes, *found])

    def glints(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Corner reflectors that explain what only some directions see.

        An image of places that reflect alike in all directions does not show them.

        Args:
            shapes: What is known already.
        """
        one, lattice = self.fitted, self.lattice
        power, loss = one.coarse.power, one.coarse.loss
        rest = one.coarse_predicted(shapes)
        nothing = (power - loss.level[:, None, None]).clamp_min(rest)
        gain = lattice.response.means(loss.rows(rest, power) - loss.rows(nothing, power))
        at = one.radar.positions.detach()[:, list(self.ground.level)]
        way = torch.nn.functional.normalize(at[:, None] - lattice.places, dim=2)
        yaws = [k * math.pi / 8 for k in range(16)]
        score = torch.stack(
            [((way @ opening(yaw, self.ground) > _SEEN) * gain).sum(0) for yaw in yaws]
        )
        found = list[Figure]()
        for _ in range(_GLINTS):
            best, yaw = score.amax(0), score.argmax(0)
            place = int(best.argmax())
            options = [
                Figure(
                    "corner",
                    (float(lattice.places[place, 0]), float(lattice.places[place, 1])),
                    yaws[int(yaw[place])],
                    height=part * lattice.height,
                    brightness=brightness,
                )
                for part in (0.6, 1.0, 1.5)
                for brightness in (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
            ]
            known = [*shapes, *found]
            new = self.best(known, options)
            for _ in range(2):
                # Narrow in place and heading, so that a fit would start beside its minimum.
                new = self.best(known, nudged(new, lattice.step))
            if self.evidence([*known, new]) <= self.evidence(known):
                break
            found.append(new)
            near = (lattice.places - lattice.places[place]).norm(dim=1) < _NEAR
            score[:, near] = 0.0
        return found

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
            found.append(replace(row, brightness=max(float(part.sum()) / section(row), 1e-4)))
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
        return self.likeliest(shapes, other_kinds(self.fitted, shapes))

    def turns(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Shapes, with people and vehicles turned as is likeliest, after a fit of every turn.

        Args:
            shapes: After a fit.
        """
        turns = (0.5 * math.pi, math.pi, 1.5 * math.pi)
        others = [facing(shapes, turn, self.ground) for turn in turns]
        return self.likeliest(shapes, [rows for rows in others if rows])

    def likeliest(
        self, shapes: Sequence[Figure], others: Sequence[Sequence[Figure]]
    ) -> list[Figure]:
        """Every shape as it is, or as it is in other lists after a fit, whichever is likelier.

        Args:
            shapes: After a fit.
            others: Lists of as many shapes, which start fits.
        """
        fitted = [self.settled(rows) for rows in others]
        found = list(shapes)
        for number in range(len(found)):
            rest = [*found[:number], *found[number + 1 :]]
            options = [found[number], *(rows[number] for rows in (*others, *fitted))]
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

    def split(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Shapes, with two boxes in place of one shape where that is likelier.

        Two things that touch are one group of the image, and one shape at first.

        Args:
            shapes: After a fit.
        """
        found, tried = list(shapes), 0
        while tried < len(found):
            shape = found[tried]
            rest = [*found[:tried], *found[tried + 1 :]]
            tried += 1
            if max(shape.length, shape.width) < _WHOLE or len(found) == _MOST:
                continue
            pairs = halves(shape, self.ground)
            pair = max(pairs, key=lambda two, rest=rest: self.evidence([*rest, *two]))
            # Cuts are many enough for the right one to be likelier before any fit.
            if self.evidence([*rest, *pair]) < self.evidence(found):
                continue
            new = self.settled([*rest, *pair])
            if self.better(new, found):
                found, tried = new, 0
        return found

    def merged(self, shapes: Sequence[Figure]) -> list[Figure]:
        """Shapes, with one box, person or vehicle in place of two shapes where that is likelier.

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
            boxes = [around((a, b), turn, self.ground) for turn in _TURNS]
            least = min(boxes, key=lambda one: one.length * one.width)
            one = self.best(rest, [*boxes, *standing(least)])
            if self.evidence([*rest, one]) < self.evidence(found) - _HOPE:
                continue
            new = self.settled([*rest, one])
            if self.better(new, found):
                found = new


_PARTS = (0.4, 0.55, 0.75, 1.35, 2.0)  # of a height that are tried
_TURNS = tuple(k * math.pi / 16 for k in range(8))


def section(figure: Figure) -> float:
    """Radar cross-section of a shape of brightness 1, roughly, as a mean over directions [m²].

    A matte surface of area A seen aslant has 4 A cos²θ, half of it on average.

    Args:
        figure: The shape.
    """
    if figure.kind == "corner":
        return 0.5 * figure.length**2  # an eighth of its peak
    if figure.ball:
        return 0.5 * math.pi * figure.length**2
    return 0.5 * math.pi * (figure.length + figure.width) * figure.height


def other_kinds(one: Assembly, shapes: Sequence[Figure]) -> list[list[Figure]]:
    """Shapes as other kinds, each time all that could be of that kind, before any fit.

    Args:
        one: Maps, which tell how a shape with a heading looks best.
        shapes: As they are.
    """
    found = [[as_kind(shape, kind) for shape in shapes] for kind in ("box", "cylinder", "sphere")]
    for kind in ("person", "vehicle", "corner"):
        changed = list(shapes)
        for number, shape in enumerate(shapes):
            options = [row for row in _headed(shape) if row.kind == kind != shape.kind]
            if options:
                rest = [*shapes[:number], *shapes[number + 1 :]]
                gains = [float(one.gains([*rest, option]).sum()) for option in options]
                changed[number] = options[gains.index(max(gains))]
        found.append(changed)
    return [
        rows for rows in found if any(new is not old for new, old in zip(rows, shapes, strict=True))
    ]


def facing(shapes: Sequence[Figure], turn: float, ground: Ground) -> list[Figure]:
    """Shapes, with people and vehicles turned; empty if there are none.

    Args:
        shapes: As they are.
        turn: About the vertical [rad].
        ground: The plane.
    """
    fronts = [shape.kind in ("person", "vehicle") for shape in shapes]
    pairs = zip(shapes, fronts, strict=True)
    rows = [turned(one, turn, ground) if front else one for one, front in pairs]
    return rows if any(fronts) else []


def _headed(shape: Figure) -> list[Figure]:
    """What has a heading, and could be in place of a shape; as bright in all."""
    if shape.kind == "prism":
        return []
    box = shape if shape.boxed else as_kind(shape, "box")
    rows = standing(box)
    if max(shape.length, shape.width) < CORNER:
        middle = shape.height if shape.ball else 0.5 * shape.height
        rows += headings(Figure("corner", shape.place, height=middle))
    strength = shape.brightness * section(shape)
    found = [replace(row, brightness=strength / section(row)) for row in rows]
    # What is bright on one side only looked dim as something round.
    more = [row for row in found if row.kind == "corner"]
    return found + [replace(r, brightness=r.brightness * by) for r in more for by in (4.0, 16.0)]


def nudged(shape: Figure, step: float) -> list[Figure]:
    """A shape, moved, turned, lifted, or brighter or dimmer by a little.

    Args:
        shape: As it is.
        step: Along the ground [m].
    """
    x, y = shape.place
    moves = [(x + a * step, y + b * step) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    return [
        *(replace(shape, place=place) for place in moves),
        *(replace(shape, yaw=shape.yaw + turn) for turn in (-0.2, 0.2)),
        *(replace(shape, height=shape.height * part) for part in (0.75, 1.3)),
        *(replace(shape, brightness=shape.brightness * part) for part in (0.6, 1.7)),
    ]


def as_kind(shape: Figure, kind: str) -> Figure:
    """A shape of another kind, of about the same size.

    Args:
        shape: As it is.
        kind: Which it is to be.
    """
    if shape.kind in (kind, "prism"):
        return shape
    if kind == "box" and shape.boxed:
        return replace(shape, kind="box")
    if kind == "box":
        side = 0.85 * shape.length
        high = shape.height if shape.kind == "cylinder" else 2 * shape.height
        return replace(shape, kind="box", length=side, width=side, height=high)
    mean = 0.5 * (shape.length + shape.width)
    across = mean if not shape.boxed else 1.1 * mean
    high = shape.height
    if kind == "sphere" and not shape.ball:
        high = 0.5 * shape.height
    elif kind == "cylinder" and shape.ball:
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


def halves(shape: Figure, ground: Ground) -> list[tuple[Figure, Figure]]:
    """Two boxes in place of one shape: cut across either side at three places, one of them slim.

    Args:
        shape: Which is to be two.
        ground: The plane.

    Returns:
        For each cut both whole, and either one slim, along each edge or the middle of the shape.
    """
    box = around((shape,), shape.yaw if shape.boxed else 0.0, ground)
    c, s = math.cos(ground.sense * box.yaw), math.sin(ground.sense * box.yaw)

    def part(along: int, share: float, away: float, wide: float, off: float) -> Figure:
        """A part of the box, its sides as shares of the whole's, its middle off by halves of it."""
        sides, shift = [box.length, box.width], [0.0, 0.0]
        shift[along], shift[1 - along] = 0.5 * sides[along] * away, 0.5 * sides[1 - along] * off
        sides[along] *= share
        sides[1 - along] *= wide
        x, y = c * shift[0] - s * shift[1], s * shift[0] + c * shift[1]
        place = box.place[0] + x, box.place[1] + y
        return replace(box, place=place, length=sides[0], width=sides[1])

    found: list[tuple[Figure, Figure]] = []
    slim = [(_SLIM, off) for off in (_SLIM - 1, 0.0, 1 - _SLIM)]
    for along in (0, 1):
        for share in (1 / 3, 1 / 2, 2 / 3):
            whole, other = (share, share - 1), (1 - share, share)
            for first, second in (
                ((1.0, 0.0), (1.0, 0.0)),
                *((one, (1.0, 0.0)) for one in slim),
                *(((1.0, 0.0), one) for one in slim),
            ):
                found.append((part(along, *whole, *first), part(along, *other, *second)))
    return found


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
    """Corners of a shape on the ground [m], those of a polygon for shapes without any.

    Args:
        shape: The shape.
        ground: The plane.
        count: Of the polygon's corners.
    """
    if isinstance(shape, Prism):
        return contour(shape)
    middle = torch.tensor(shape.place, dtype=torch.float64)
    if not shape.boxed:
        turns = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
        return middle + 0.5 * shape.length * torch.stack([turns.cos(), turns.sin()], dim=1)
    c, s = math.cos(ground.sense * shape.yaw), math.sin(ground.sense * shape.yaw)
    half = 0.5 * torch.tensor([shape.length, shape.width], dtype=torch.float64)
    signs = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64)
    return middle + (signs * half) @ torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
