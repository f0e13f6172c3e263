"""Which shapes there are: births from what is unexplained, other kinds, mergers, and deaths."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.discovery.assembly import ShapeLikelihood
from invertwin.discovery.imaging.reflectivity import ImageResponse, reconstruct_reflectivity
from invertwin.discovery.proposals import (
    MAX_CORNER_EXTENT,
    bright_weights,
    group_bright_points,
    propose_headings,
    propose_people_and_vehicles,
    propose_shapes,
)
from invertwin.discovery.shapes.primitives import ShapeParameters, corner_direction, rotate_shape
from invertwin.discovery.shapes.prisms import PrismParameters, prism_contour
from invertwin.inversion.initialisation.detections import Ground

_MAX_SHAPES = 24  # objects
_BIRTH_ROUNDS = 3  # of births
_MAX_MERGE_GAP = 0.5  # gap between what may be one [m]
_MAX_EVIDENCE_DEFICIT = 100.0  # evidence that a fit may gain
_SLIM_FRACTION = 0.4  # of a side: how wide the slimmer half of a shape is at first
_MIN_SPLIT_SIZE = 0.25  # side of the smallest shape that may be two [m]
_SHORT_FIT_STEPS, _LONG_FIT_STEPS = 25, 50  # steps of fits
_CORNERS_PER_ROUND = 4  # corner reflectors of a round
_MIN_CORNER_COSINE = 0.8  # cosine off the way a corner opens, up to which it is bright
_MAX_FAILED_GROUPS = 3  # groups in a row that explain nothing
_MIN_GROUP_FRACTION = 1e-3  # of all strength: dimmer groups wait for the next round


@dataclass(frozen=True, eq=False)
class ImageGrid:
    """The places of an image on the ground, with their responses.

    Attributes:
        positions: On the ground [m].
        step: Between neighbours [m].
        response: Of the places, to thinned maps.
        height: Of the radars above the ground [m].
    """

    positions: Float64[Tensor, "place 2"]
    step: float
    response: ImageResponse
    height: float


def count_parameters(shape: ShapeParameters) -> int:
    """How many numbers a shape has.

    Args:
        shape: The shape.
    """
    return 7 if shape.is_rectangular else 5


@dataclass(frozen=True, eq=False)
class ShapeSearch:
    """A search for the shapes that explain maps.

    Evidence is the logarithm of the likelihood less half the logarithm of the number of draws for
    every free number, on the frames that are fitted; on frames that are held out, a change must
    not be for the worse either.

    Attributes:
        fitted_frames: The frames that are fitted.
        held_out_frames: Those that are held out; None = too few frames to hold some out.
        image_grid: Of the image.

    Source of the penalty: Schwarz, "Estimating the dimension of a model", 1978.
    """

    fitted_frames: ShapeLikelihood
    held_out_frames: ShapeLikelihood | None
    image_grid: ImageGrid

    @property
    def ground(self) -> Ground:
        """The plane."""
        return self.fitted_frames.ground

    def evidence(self, shapes: Sequence[ShapeParameters]) -> float:
        """Of shapes, on the fitted frames.

        Args:
            shapes: What there may be.
        """
        count = sum(count_parameters(shape) for shape in shapes)
        return float(
            self.fitted_frames.log_likelihood_gains(shapes).sum()
        ) - 0.5 * count * math.log(self.fitted_frames.independent_draws)

    def is_better(self, new: Sequence[ShapeParameters], old: Sequence[ShapeParameters]) -> bool:
        """Whether shapes are to be preferred.

        Args:
            new: What there may be.
            old: What was thought so far.
        """
        if self.evidence(new) <= self.evidence(old):
            return False
        if self.held_out_frames is None or len(new) <= len(old):
            return True
        return float(self.held_out_frames.log_likelihood_gains(new).sum()) > float(
            self.held_out_frames.log_likelihood_gains(old).sum()
        )

    @cached_property
    def first_image(self) -> Float64[Tensor, " place"]:
        """Where echoes come from, while nothing is known."""
        return self.residual_image([])

    def residual_image(self, shapes: Sequence[ShapeParameters]) -> Float64[Tensor, " place"]:
        """What shapes leave unexplained, as an image.

        Args:
            shapes: What is known already.
        """
        one = self.fitted_frames
        coarse = one.coarse_maps
        rest = one.predict_coarse(shapes) + coarse.loss.level[:, None, None]
        return reconstruct_reflectivity(
            self.image_grid.response, coarse.power, rest, degrees=coarse.loss.degrees
        )

    def run(self) -> list[ShapeParameters]:
        """The shapes."""
        shapes, before = list[ShapeParameters](), 0
        for _ in range(_BIRTH_ROUNDS):
            born = self.propose_births(shapes)
            if not born:
                break
            shapes = self.merge_shapes(self.refine([*shapes, *born]))
            survivors = self.prune(shapes)
            stalled = len(survivors) <= before
            before, shapes = len(survivors), survivors
            if stalled:
                break
        if not shapes:
            return []
        shapes = self.split_shapes(
            self.merge_shapes(self.select_headings(self.select_kinds(shapes)))
        )
        shapes, _ = self.fitted_frames.fit(shapes, _LONG_FIT_STEPS)
        shapes = self.refine(self.select_heights(shapes))
        return self.prune(shapes)

    def propose_births(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        """What could explain the rest, where it is bright.

        Args:
            shapes: What is known already.
        """
        strength = self.residual_image(shapes) if shapes else self.first_image
        # What a point's own kind of image cannot tell from speckle is left alone.
        weight = bright_weights(strength)
        parts = group_bright_points(self.image_grid.positions, weight, 3.5 * self.image_grid.step)
        total = float(strength.sum())
        parts = [part for part in parts if float(part.sum()) > _MIN_GROUP_FRACTION * total]
        known, born = list(shapes), list[tuple[Tensor, ShapeParameters]]()
        gain, vain = float(self.fitted_frames.log_likelihood_gains(known).sum()), 0
        for part in parts[: _MAX_SHAPES - len(shapes)]:
            one = self.select_best(known, self.propose_for_group(part))
            new = float(self.fitted_frames.log_likelihood_gains([*known, one]).sum())
            if new > gain:
                gain, vain = new, 0
                known.append(one)
                born.append((part, one))
            elif (vain := vain + 1) == _MAX_FAILED_GROUPS:
                break  # dimmer groups tell no more
        found = [one for _, one in self.unite_groups(shapes, born)]
        return found + self.propose_corners([*shapes, *found])

    def propose_corners(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        """Corner reflectors that explain what only some directions see.

        An image of places that reflect alike in all directions does not show them.

        Args:
            shapes: What is known already.
        """
        one, lattice = self.fitted_frames, self.image_grid
        power, loss = one.coarse_maps.power, one.coarse_maps.loss
        rest = one.predict_coarse(shapes)
        nothing = (power - loss.level[:, None, None]).clamp_min(rest)
        gain = lattice.response.average_over_bins(
            loss.bin_losses(rest, power) - loss.bin_losses(nothing, power)
        )
        at = one.radar.positions.detach()[:, list(self.ground.plane_axes)]
        way = torch.nn.functional.normalize(at[:, None] - lattice.positions, dim=2)
        yaws = [k * math.pi / 8 for k in range(16)]
        score = torch.stack(
            [
                ((way @ corner_direction(yaw, self.ground) > _MIN_CORNER_COSINE) * gain).sum(0)
                for yaw in yaws
            ]
        )
        found = list[ShapeParameters]()
        for _ in range(_CORNERS_PER_ROUND):
            best, yaw = score.amax(0), score.argmax(0)
            place = int(best.argmax())
            options = [
                ShapeParameters(
                    "corner",
                    (float(lattice.positions[place, 0]), float(lattice.positions[place, 1])),
                    yaws[int(yaw[place])],
                    height=part * lattice.height,
                    brightness=brightness,
                )
                for part in (0.6, 1.0, 1.5)
                for brightness in (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
            ]
            known = [*shapes, *found]
            new = self.select_best(known, options)
            for _ in range(2):
                # Narrow in place and heading, so that a fit would start beside its minimum.
                new = self.select_best(known, perturb_shape(new, lattice.step))
            if self.evidence([*known, new]) <= self.evidence(known):
                break
            found.append(new)
            near = (lattice.positions - lattice.positions[place]).norm(dim=1) < _MAX_MERGE_GAP
            score[:, near] = 0.0
        return found

    def unite_groups(
        self, shapes: Sequence[ShapeParameters], born: Sequence[tuple[Tensor, ShapeParameters]]
    ) -> list[tuple[Tensor, ShapeParameters]]:
        """Groups and their shapes, with one box for two groups where that is likelier.

        Two far ends of a box are often bright, and nothing between them.

        Args:
            shapes: What is known already.
            born: Groups of the image, and what stands there.
        """
        found, tried = list(born), set[tuple[int, int]]()
        while True:
            pairs = [
                (self._group_gap(a[0], b[0]), a, b)
                for k, a in enumerate(found)
                for b in found[k + 1 :]
                if (id(a[0]), id(b[0])) not in tried
            ]
            pairs = [pair for pair in pairs if pair[0] < _MAX_MERGE_GAP]
            if not pairs:
                return found
            _, a, b = min(pairs, key=lambda pair: pair[0])
            tried.add((id(a[0]), id(b[0])))
            others = [pair for pair in found if pair is not a and pair is not b]
            known = [*shapes, *(one for _, one in others)]
            part = a[0] + b[0]
            one = self.select_best(known, self.propose_for_group(part))
            if self.evidence([*known, one]) > self.evidence([*known, a[1], b[1]]):
                found = [*others, (part, one)]

    def _group_gap(self, first: Tensor, second: Tensor) -> float:
        places = self.image_grid.positions
        return float(torch.cdist(places[first > 0], places[second > 0]).min())

    def propose_for_group(self, group: Tensor) -> list[ShapeParameters]:
        """What could stand where a group of places is bright.

        Args:
            group: Strength of every place [m²], zero outside the group.
        """
        lattice = self.image_grid
        rows = propose_shapes(
            lattice.positions, group, self.ground, step=lattice.step, height=lattice.height
        )
        found: list[ShapeParameters] = []
        for row in rows:
            found.append(replace(row, brightness=max(float(group.sum()) / mean_rcs(row), 1e-4)))
        return found

    def select_best(
        self, known: Sequence[ShapeParameters], candidates: Iterable[ShapeParameters]
    ) -> ShapeParameters:
        """The likeliest of some shapes, beside others.

        Args:
            known: The others.
            candidates: To choose from.
        """
        return max(candidates, key=lambda one: self.evidence([*known, one]))

    def refine(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        """Shapes after a short fit.

        Args:
            shapes: At its start.
        """
        return self.fitted_frames.fit(shapes, _SHORT_FIT_STEPS)[0]

    def prune(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        """Shapes without those that evidence does not speak for, the weakest first.

        Args:
            shapes: All of them.
        """
        found: list[ShapeParameters] = [*shapes]
        while found:
            without: list[list[ShapeParameters]] = [
                [*found[:k], *found[k + 1 :]] for k in range(len(found))
            ]
            weakest = max(without, key=self.evidence)
            if self.is_better(found, weakest):
                break
            found = weakest
        return found

    def select_kinds(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        """Shapes, each of the kind that is likeliest, after a fit as every kind.

        Args:
            shapes: After a fit.
        """
        return self.select_likeliest(shapes, propose_kinds(self.fitted_frames, shapes))

    def select_headings(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        """Shapes, with people and vehicles turned as is likeliest, after a fit of every turn.

        Args:
            shapes: After a fit.
        """
        turns = (0.5 * math.pi, math.pi, 1.5 * math.pi)
        others = [rotate_headed_shapes(shapes, turn, self.ground) for turn in turns]
        return self.select_likeliest(shapes, [rows for rows in others if rows])

    def select_likeliest(
        self, shapes: Sequence[ShapeParameters], alternatives: Sequence[Sequence[ShapeParameters]]
    ) -> list[ShapeParameters]:
        """Every shape as it is, or as it is in other lists after a fit, whichever is likelier.

        Args:
            shapes: After a fit.
            alternatives: Lists of as many shapes, which start fits.
        """
        fitted = [self.refine(rows) for rows in alternatives]
        found = list(shapes)
        for number in range(len(found)):
            rest = [*found[:number], *found[number + 1 :]]
            options = [found[number], *(rows[number] for rows in (*alternatives, *fitted))]
            found[number] = max(options, key=lambda one, rest=rest: self.evidence([*rest, one]))
        return found

    def select_heights(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
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
                for part in _HEIGHT_FACTORS
                for power in (0.5, 1.0)
            ]
            rest = [*found[:number], *found[number + 1 :]]
            found[number] = max(
                [shape, *options],
                key=lambda one, rest=rest: self.evidence([*rest, one]),
            )
        return found

    def split_shapes(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
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
            if max(shape.length, shape.width) < _MIN_SPLIT_SIZE or len(found) == _MAX_SHAPES:
                continue
            pairs = propose_splits(shape, self.ground)
            pair = max(pairs, key=lambda two, rest=rest: self.evidence([*rest, *two]))
            # Cuts are many enough for the right one to be likelier before any fit.
            if self.evidence([*rest, *pair]) < self.evidence(found):
                continue
            new = self.refine([*rest, *pair])
            if self.is_better(new, found):
                found, tried = new, 0
        return found

    def merge_shapes(self, shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
        """Shapes, with one box, person or vehicle in place of two shapes where that is likelier.

        Args:
            shapes: After a fit.
        """
        found, tried = list(shapes), set[tuple[ShapeParameters, ShapeParameters]]()
        while True:
            pairs = [
                (a, b)
                for k, a in enumerate(found)
                for b in found[k + 1 :]
                if (a, b) not in tried and shape_gap(a, b, self.ground) < _MAX_MERGE_GAP
            ]
            if not pairs:
                return found
            a, b = min(pairs, key=lambda pair: shape_gap(*pair, self.ground))
            tried.add((a, b))
            rest = [shape for shape in found if shape is not a and shape is not b]
            boxes = [enclosing_box((a, b), turn, self.ground) for turn in _BOX_YAWS]
            least = min(boxes, key=lambda one: one.length * one.width)
            one = self.select_best(rest, [*boxes, *propose_people_and_vehicles(least)])
            if self.evidence([*rest, one]) < self.evidence(found) - _MAX_EVIDENCE_DEFICIT:
                continue
            new = self.refine([*rest, one])
            if self.is_better(new, found):
                found = new


_HEIGHT_FACTORS = (0.4, 0.55, 0.75, 1.35, 2.0)  # of a height that are tried
_BOX_YAWS = tuple(k * math.pi / 16 for k in range(8))


def mean_rcs(shape: ShapeParameters) -> float:
    """Radar cross-section of a shape of brightness 1, roughly, as a mean over directions [m²].

    A matte surface of area A seen aslant has 4 A cos²θ, half of it on average.

    Args:
        shape: The shape.
    """
    if shape.kind == "corner":
        return 0.5 * shape.length**2  # an eighth of its peak
    if shape.has_free_height:
        return 0.5 * math.pi * shape.length**2
    return 0.5 * math.pi * (shape.length + shape.width) * shape.height


def propose_kinds(
    likelihood: ShapeLikelihood, shapes: Sequence[ShapeParameters]
) -> list[list[ShapeParameters]]:
    """Shapes as other kinds, each time all that could be of that kind, before any fit.

    Args:
        likelihood: Maps, which tell how a shape with a heading looks best.
        shapes: As they are.
    """
    found = [
        [convert_kind(shape, kind) for shape in shapes] for kind in ("box", "cylinder", "sphere")
    ]
    for kind in ("person", "vehicle", "corner"):
        changed = list(shapes)
        for number, shape in enumerate(shapes):
            options = [
                row for row in _propose_headed_shapes(shape) if row.kind == kind != shape.kind
            ]
            if options:
                rest = [*shapes[:number], *shapes[number + 1 :]]
                gains = [
                    float(likelihood.log_likelihood_gains([*rest, option]).sum())
                    for option in options
                ]
                changed[number] = options[gains.index(max(gains))]
        found.append(changed)
    return [
        rows for rows in found if any(new is not old for new, old in zip(rows, shapes, strict=True))
    ]


def rotate_headed_shapes(
    shapes: Sequence[ShapeParameters], rotation: float, ground: Ground
) -> list[ShapeParameters]:
    """Shapes, with people and vehicles turned; empty if there are none.

    Args:
        shapes: As they are.
        rotation: About the vertical [rad].
        ground: The plane.
    """
    fronts = [shape.kind in ("person", "vehicle") for shape in shapes]
    pairs = zip(shapes, fronts, strict=True)
    rows = [rotate_shape(one, rotation, ground) if front else one for one, front in pairs]
    return rows if any(fronts) else []


def _propose_headed_shapes(shape: ShapeParameters) -> list[ShapeParameters]:
    """What has a heading, and could be in place of a shape; as bright in all."""
    if shape.kind == "prism":
        return []
    box = shape if shape.is_rectangular else convert_kind(shape, "box")
    rows = propose_people_and_vehicles(box)
    if max(shape.length, shape.width) < MAX_CORNER_EXTENT:
        middle = shape.height if shape.has_free_height else 0.5 * shape.height
        rows += propose_headings(ShapeParameters("corner", shape.position, height=middle))
    strength = shape.brightness * mean_rcs(shape)
    found = [replace(row, brightness=strength / mean_rcs(row)) for row in rows]
    # What is bright on one side only looked dim as something round.
    more = [row for row in found if row.kind == "corner"]
    return found + [replace(r, brightness=r.brightness * by) for r in more for by in (4.0, 16.0)]


def perturb_shape(shape: ShapeParameters, step: float) -> list[ShapeParameters]:
    """A shape, moved, turned, lifted, or brighter or dimmer by a little.

    Args:
        shape: As it is.
        step: Along the ground [m].
    """
    x, y = shape.position
    moves = [(x + a * step, y + b * step) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    return [
        *(replace(shape, position=place) for place in moves),
        *(replace(shape, yaw=shape.yaw + turn) for turn in (-0.2, 0.2)),
        *(replace(shape, height=shape.height * part) for part in (0.75, 1.3)),
        *(replace(shape, brightness=shape.brightness * part) for part in (0.6, 1.7)),
    ]


def convert_kind(shape: ShapeParameters, kind: str) -> ShapeParameters:
    """A shape of another kind, of about the same size.

    Args:
        shape: As it is.
        kind: Which it is to be.
    """
    if shape.kind in (kind, "prism"):
        return shape
    if kind == "box" and shape.is_rectangular:
        return replace(shape, kind="box")
    if kind == "box":
        side = 0.85 * shape.length
        high = shape.height if shape.kind == "cylinder" else 2 * shape.height
        return replace(shape, kind="box", length=side, width=side, height=high)
    mean = 0.5 * (shape.length + shape.width)
    across = mean if not shape.is_rectangular else 1.1 * mean
    high = shape.height
    if kind == "sphere" and not shape.has_free_height:
        high = 0.5 * shape.height
    elif kind == "cylinder" and shape.has_free_height:
        high = 2 * shape.height
    return replace(shape, kind=kind, length=across, width=across, height=max(high, 0.05))


def enclosing_box(shapes: Sequence[ShapeParameters], yaw: float, ground: Ground) -> ShapeParameters:
    """A box about shapes.

    Args:
        shapes: Which are to be one.
        yaw: Of the box [rad].
        ground: The plane.
    """
    corners = torch.cat([outline_corners(shape, ground) for shape in shapes])
    c, s = math.cos(ground.yaw_sign * yaw), math.sin(ground.yaw_sign * yaw)
    own = corners @ torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    low, high = own.amin(0), own.amax(0)
    x, y = (0.5 * (low + high)).tolist()
    length, width = (high - low).tolist()
    brightest = max(shapes, key=lambda one: one.brightness)
    tall = max(shape.height for shape in shapes)
    return ShapeParameters(
        "box", (c * x - s * y, s * x + c * y), yaw, length, width, tall, brightest.brightness
    )


def propose_splits(
    shape: ShapeParameters, ground: Ground
) -> list[tuple[ShapeParameters, ShapeParameters]]:
    """Two boxes in place of one shape: cut across either side at three places, one of them slim.

    Args:
        shape: Which is to be two.
        ground: The plane.

    Returns:
        For each cut both whole, and either one slim, along each edge or the middle of the shape.
    """
    box = enclosing_box((shape,), shape.yaw if shape.is_rectangular else 0.0, ground)
    c, s = math.cos(ground.yaw_sign * box.yaw), math.sin(ground.yaw_sign * box.yaw)

    def part(along: int, share: float, away: float, wide: float, off: float) -> ShapeParameters:
        """A part of the box, its sides as shares of the whole's, its middle off by halves of it."""
        sides, shift = [box.length, box.width], [0.0, 0.0]
        shift[along], shift[1 - along] = 0.5 * sides[along] * away, 0.5 * sides[1 - along] * off
        sides[along] *= share
        sides[1 - along] *= wide
        x, y = c * shift[0] - s * shift[1], s * shift[0] + c * shift[1]
        place = box.position[0] + x, box.position[1] + y
        return replace(box, position=place, length=sides[0], width=sides[1])

    found: list[tuple[ShapeParameters, ShapeParameters]] = []
    slim = [(_SLIM_FRACTION, off) for off in (_SLIM_FRACTION - 1, 0.0, 1 - _SLIM_FRACTION)]
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


def shape_gap(first: ShapeParameters, second: ShapeParameters, ground: Ground) -> float:
    """The gap between two shapes, to a few centimetres [m].

    Args:
        first, second: The shapes.
        ground: The plane.
    """
    share = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None, None]
    sides: list[Tensor] = []
    for shape in (first, second):
        corners = outline_corners(shape, ground)
        sides.append((corners + share * (corners.roll(1, 0) - corners)).flatten(0, 1))
    return float(torch.cdist(sides[0], sides[1]).min())


def outline_corners(
    shape: ShapeParameters, ground: Ground, count: int = 16
) -> Float64[Tensor, "corner 2"]:
    """Corners of a shape on the ground [m], those of a polygon for shapes without any.

    Args:
        shape: The shape.
        ground: The plane.
        count: Of the polygon's corners.
    """
    if isinstance(shape, PrismParameters):
        return prism_contour(shape)
    middle = torch.tensor(shape.position, dtype=torch.float64)
    if not shape.is_rectangular:
        turns = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
        return middle + 0.5 * shape.length * torch.stack([turns.cos(), turns.sin()], dim=1)
    c, s = math.cos(ground.yaw_sign * shape.yaw), math.sin(ground.yaw_sign * shape.yaw)
    half = 0.5 * torch.tensor([shape.length, shape.width], dtype=torch.float64)
    signs = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64)
    return middle + (signs * half) @ torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
