"""Model search over shapes: births from residual images, kinds, mergers, splits and deaths."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, islice, product
from operator import is_not

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.discovery import proposals
from invertwin.discovery.assembly import ShapeLikelihood
from invertwin.discovery.imaging.reflectivity import ImageResponse, reconstruct_reflectivity
from invertwin.discovery.shapes import primitives
from invertwin.discovery.shapes.primitives import ShapeParameters, Shapes, rotate_shape
from invertwin.discovery.shapes.prisms import PrismParameters, prism_contour

_MAX_SHAPES = 24  # maximum number of objects
_BIRTH_ROUNDS = 3  # rounds of births
_DETECTION_SIZES = 0.1, 0.1  # m, across an echo that is a point to the radar
_MAX_MERGE_GAP = 0.5  # gap between shapes that may merge [m]
_MAX_EVIDENCE_DEFICIT = 100.0  # evidence that a fit may recover
_SLIM_FRACTION = 0.4  # initial width of the slimmer half of a split, relative to a side
_MIN_SPLIT_SIZE = 0.25  # minimum side of a shape that may split [m]
_SHORT_FIT_STEPS, _LONG_FIT_STEPS = 25, 50  # steps of short and long fits
_CORNERS_PER_ROUND = 4  # corner reflectors per round
_MIN_CORNER_COSINE = 0.8  # minimum cosine to the axis of a corner reflector
_MAX_FAILED_GROUPS = 3  # consecutive groups without a gain
_CORE_FRACTIONS = 0.0, 0.9  # of the typical strength of a group: weaker points are left out
_MIN_GROUP_FRACTION = 1e-3  # relative to the total strength: weaker groups wait for the next round


@dataclass(frozen=True, eq=False)
class ImageGrid:
    """Image points on the ground with their responses.

    Attributes:
        positions: x and y on the ground [point, 2] [m].
        step: distance of neighbours [m].
        response: response of the points in thinned maps.
        height: height of the radars above the ground [m].
    """

    positions: Float64[Tensor, "point 2"]
    step: float
    response: ImageResponse
    height: float


@dataclass(frozen=True, eq=False)
class ShapeSearch:
    """Search for the shapes that fit maps.

    A change must raise the evidence of the fitted frames; an added shape also its sum with the
    log-likelihood of the held-out frames.

    Source: Dawid, "Statistical theory: the prequential approach", 1984.
    Differs from the source: one prediction, of all held-out frames at once, with fitted values.

    Attributes:
        fitted_frames: likelihood of the fitted frames.
        held_out_frames: likelihood of the held-out frames; None = too few frames.
        image_grid: points of the image.
    """

    fitted_frames: ShapeLikelihood
    held_out_frames: ShapeLikelihood | None
    image_grid: ImageGrid

    def evidence(self, shapes: Shapes) -> float:
        """Compute the evidence of shapes on the fitted frames.

        Args:
            shapes: candidate shapes.
        """
        return self.fitted_frames.evidence(shapes)

    def is_better(self, new: Shapes, old: Shapes) -> bool:
        """Return whether new shapes are preferred to old ones.

        The log-likelihood of held-out frames adds to the evidence of the fitted ones, as the
        prediction of later data does. Alone it would judge by few frames, perhaps none of which
        sees a corner reflector where its pattern holds.

        Args:
            new: new shapes.
            old: present shapes.
        """
        gain = self.evidence(new) - self.evidence(old)
        if gain > 0 and self.held_out_frames is not None and len(new) > len(old):
            gain += self.held_out_frames.total_gain(new) - self.held_out_frames.total_gain(old)
        return gain > 0

    @cached_property
    def first_image(self) -> Float64[Tensor, " point"]:
        """Reflectivity image without any known shape."""
        return self.residual_image([])

    def residual_image(self, shapes: Shapes) -> Float64[Tensor, " point"]:
        """Compute the reflectivity image of the residual of shapes.

        Args:
            shapes: known shapes.
        """

        def compute() -> Tensor:
            coarse = self.fitted_frames.coarse_maps
            predicted = self.fitted_frames.predict_coarse(shapes) + coarse.loss.level[:, None, None]
            return reconstruct_reflectivity(self.image_grid.response, coarse.power, predicted)

        return self.fitted_frames.memory.recall("image", shapes, compute)

    def best_so_far(self) -> list[ShapeParameters]:
        """Return the shapes of highest evidence of all evaluated ones; empty without any."""
        likelihood = self.fitted_frames
        seen = [s for name, s in likelihood.memory.results if name == likelihood.gains_name]
        return list(max(seen, key=self.evidence, default=()))

    def run(self) -> list[ShapeParameters]:
        """Run the search and return the shapes."""
        shapes = list[ShapeParameters]()
        for _ in range(_BIRTH_ROUNDS):
            if not (born := self.propose_births(shapes)):
                break
            found, before = self.prune(self.merge_shapes(self.refine([*shapes, *born]))), shapes
            # A fit moves what is there towards the newcomer, and may lose more than it gains.
            shapes = found if self.is_better(found, before) else before
            if len(shapes) <= len(before):
                break
        if not shapes:
            return []
        shapes = self.select_headings(self.select_kinds(shapes))
        shapes = self.split_shapes(self.merge_shapes(shapes))
        shapes = self.fitted_frames.refine(shapes, _LONG_FIT_STEPS)
        return self.prune(self.refine(self.select_heights(shapes)))

    def fit_spheres(self, places: Iterable[Tensor]) -> list[ShapeParameters]:
        """Fit small spheres at detections; the evidence supports those that are returned.

        Args:
            places: positions of detections, the strongest first [m].
        """
        grid, found = self.image_grid, list[ShapeParameters]()
        for place in islice(places, _MAX_SHAPES):
            x, y = place[:2].tolist()
            ball = ShapeParameters("sphere", (x, y), 0.0, *_DETECTION_SIZES, grid.height)
            near = (grid.positions - place[:2]).norm(dim=1) < _MAX_MERGE_GAP
            guess = float(self.first_image[near].sum().clamp_min(1e-4)) / mean_rcs(ball)
            options = [replace(ball, brightness=10**k * guess) for k in (-1.0, -0.5, 0.0, 0.5, 1.0)]
            found.append(self.select_best(found, options))
        return self.prune(self.refine(found)) if found else []

    def propose_births(self, shapes: Shapes) -> list[ShapeParameters]:
        """Propose shapes at bright groups of the residual image.

        Args:
            shapes: known shapes.
        """
        strength = self.residual_image(shapes) if shapes else self.first_image
        # Skip groups that the residual image does not distinguish from speckle.
        weight = proposals.bright_weights(strength)
        grid = self.image_grid
        parts = proposals.group_bright_points(grid.positions, weight, 3.5 * grid.step)
        total = float(strength.sum())
        parts = [part for part in parts if float(part.sum()) > _MIN_GROUP_FRACTION * total]
        known, born = list(shapes), list[tuple[Tensor, ShapeParameters]]()
        gain, failures = self.fitted_frames.total_gain(known), 0
        for part in parts[: _MAX_SHAPES - len(shapes)]:
            shape = self.select_best(known, self.propose_for_group(part))
            new_gain = self.fitted_frames.total_gain([*known, shape])
            if new_gain > gain:
                gain, failures = new_gain, 0
                known.append(shape)
                born.append((part, shape))
            elif (failures := failures + 1) == _MAX_FAILED_GROUPS:
                break  # weaker groups add nothing
        found = [shape for _, shape in self.unite_groups(shapes, born)]
        return found + self.propose_corners([*shapes, *found])

    def propose_corners(self, shapes: Shapes) -> list[ShapeParameters]:
        """Propose corner reflectors for echoes that only some directions observe.

        An image of isotropic reflectors does not show them.

        Args:
            shapes: known shapes.
        """
        likelihood, grid = self.fitted_frames, self.image_grid
        power, loss = likelihood.coarse_maps.power, likelihood.coarse_maps.loss
        predicted = likelihood.predict_coarse(shapes)
        explained = (power - loss.level[:, None, None]).clamp_min(predicted)
        saved = loss.bin_losses(predicted, power) - loss.bin_losses(explained, power)
        gain = grid.response.average_over_bins(saved)
        radars = likelihood.radar.positions.detach()[:, :2]
        direction = torch.nn.functional.normalize(radars[:, None] - grid.positions, dim=2)
        yaws = [k * math.pi / 8 for k in range(16)]
        cosines = (direction @ primitives.corner_direction(yaw) for yaw in yaws)
        score = torch.stack([((c > _MIN_CORNER_COSINE) * gain).sum(0) for c in cosines])
        found = list[ShapeParameters]()
        for _ in range(_CORNERS_PER_ROUND):
            best, yaw = score.amax(0), score.argmax(0)
            index = int(best.argmax())
            x, y = grid.positions[index].tolist()
            corner = ShapeParameters("corner", (x, y), yaws[int(yaw[index])])
            tried = product((0.6, 1.0, 1.5), (3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0))
            options = [replace(corner, height=k * grid.height, brightness=b) for k, b in tried]
            known = [*shapes, *found]
            new = self.select_best(known, options)
            for _ in range(2):
                # The minimum is narrow in position and heading: refine the start of the fit.
                new = self.select_best(known, perturb_shape(new, grid.step))
            if self.evidence([*known, new]) <= self.evidence(known):
                break
            found.append(new)
            score[:, (grid.positions - grid.positions[index]).norm(dim=1) < _MAX_MERGE_GAP] = 0.0
        return found

    def unite_groups(
        self, shapes: Shapes, born: Sequence[tuple[Tensor, ShapeParameters]]
    ) -> list[tuple[Tensor, ShapeParameters]]:
        """Return groups and their shapes, with one box for two groups where that is more likely.

        Often only the two far ends of a box are bright.

        Args:
            shapes: known shapes.
            born: groups of the image, and their proposed shapes.
        """
        # Tried pairs keep their tensors: Python gives the id of a deleted one to the next.
        found, tried = list(born), dict[tuple[int, int], object]()
        places = self.image_grid.positions
        while True:
            pairs = [
                (float(torch.cdist(places[a[0] > 0], places[b[0] > 0]).min()), a, b)
                for a, b in combinations(found, 2)
                if (id(a[0]), id(b[0])) not in tried
            ]
            pairs = [pair for pair in pairs if pair[0] < _MAX_MERGE_GAP]
            if not pairs:
                return found
            _, a, b = min(pairs, key=lambda pair: pair[0])
            tried[id(a[0]), id(b[0])] = a, b
            others = [pair for pair in found if pair is not a and pair is not b]
            known = [*shapes, *(shape for _, shape in others)]
            union = a[0] + b[0]
            shape = self.select_best(known, self.propose_for_group(union))
            if self.evidence([*known, shape]) > self.evidence([*known, a[1], b[1]]):
                found = [*others, (union, shape)]

    def propose_for_group(self, group: Tensor) -> list[ShapeParameters]:
        """Propose shapes for a group of bright points, and for its brightest points alone.

        Echoes by way of floors and walls widen the group of an object, but not its brightest part.

        Args:
            group: strength of every point [m²], zero outside the group.
        """
        grid, total, rows = self.image_grid, float(group.sum()), list[ShapeParameters]()
        sizes = {"step": grid.step, "height": grid.height}
        for fraction in _CORE_FRACTIONS:
            core = proposals.bright_weights(group, fraction)
            rows += proposals.propose_shapes(grid.positions, core, **sizes)
        return [replace(row, brightness=max(total / mean_rcs(row), 1e-4)) for row in rows]

    def select_best(self, known: Shapes, candidates: Iterable[ShapeParameters]) -> ShapeParameters:
        """Select the candidate of highest likelihood, given other shapes.

        Args:
            known: other shapes.
            candidates: candidate shapes.
        """
        return max(candidates, key=lambda shape: self.evidence([*known, shape]))

    def refine(self, shapes: Shapes) -> list[ShapeParameters]:
        """Refine shapes by a short fit.

        Args:
            shapes: initial shapes.
        """
        return self.fitted_frames.refine(shapes, _SHORT_FIT_STEPS)

    def prune(self, shapes: Shapes) -> list[ShapeParameters]:
        """Remove shapes without supporting evidence, the weakest first.

        Args:
            shapes: all shapes.
        """
        found: list[ShapeParameters] = [*shapes]
        while found:
            without = [[*found[:k], *found[k + 1 :]] for k in range(len(found))]
            weakest = max(without, key=self.evidence)
            if self.is_better(found, weakest):
                break
            found = weakest
        return found

    def select_kinds(self, shapes: Shapes) -> list[ShapeParameters]:
        """Select the most likely kind of every shape, after a fit as every kind.

        Args:
            shapes: fitted shapes.
        """
        return self.select_likeliest(shapes, propose_kinds(self.fitted_frames, shapes))

    def select_headings(self, shapes: Shapes) -> list[ShapeParameters]:
        """Select the most likely heading of people and vehicles, after a fit of every rotation.

        Args:
            shapes: fitted shapes.
        """
        turns = (0.5 * math.pi, math.pi, 1.5 * math.pi)
        others = [rotate_headed_shapes(shapes, turn) for turn in turns]
        return self.select_likeliest(shapes, [rows for rows in others if rows])

    def select_likeliest(
        self, shapes: Shapes, alternatives: Sequence[Shapes]
    ) -> list[ShapeParameters]:
        """Select every shape from alternative lists after a fit, whichever is most likely.

        Args:
            shapes: fitted shapes.
            alternatives: lists of as many shapes, initial values of fits.
        """
        fitted = [self.refine(rows) for rows in alternatives]
        found = list(shapes)
        for number in range(len(found)):
            rest = [*found[:number], *found[number + 1 :]]
            options = [found[number], *(rows[number] for rows in (*alternatives, *fitted))]
            found[number] = self.select_best(rest, options)
        return found

    def select_heights(self, shapes: Shapes) -> list[ShapeParameters]:
        """Select the most likely heights of shapes.

        Points above and below the radars have nearly equal ranges, so that the likelihood has
        several minima in height.

        Args:
            shapes: fitted shapes.
        """
        found = list(shapes)
        for number, shape in enumerate(found):
            options, high, bright = [shape], shape.height, shape.brightness
            for part, power in product(_HEIGHT_FACTORS, (0.5, 1.0)):
                options.append(replace(shape, height=high * part, brightness=bright * part**-power))
            found[number] = self.select_best([*found[:number], *found[number + 1 :]], options)
        return found

    def split_shapes(self, shapes: Shapes) -> list[ShapeParameters]:
        """Replace shapes by two boxes where that is more likely.

        Two touching objects form one group of the image, and one shape at first.

        Args:
            shapes: fitted shapes.
        """
        found, tried = list(shapes), 0
        while tried < len(found):
            shape = found[tried]
            rest = [*found[:tried], *found[tried + 1 :]]
            tried += 1
            if max(shape.length, shape.width) < _MIN_SPLIT_SIZE or len(found) == _MAX_SHAPES:
                continue
            pairs = propose_splits(shape)
            pair = max(pairs, key=lambda two, rest=rest: self.evidence([*rest, *two]))
            # The cuts are dense enough for the right one to be more likely before a fit.
            if self.evidence([*rest, *pair]) < self.evidence(found):
                continue
            new = self.refine([*rest, *pair])
            if self.is_better(new, found):
                found, tried = new, 0
        return found

    def merge_shapes(self, shapes: Shapes) -> list[ShapeParameters]:
        """Replace two shapes by one box, person or vehicle where that is more likely.

        It must also be likelier than either of them alone: a false neighbour of a wall would widen
        it, and the wide one be dropped. Boxes at the yaws of the two join parts of a long wall.

        Args:
            shapes: fitted shapes.
        """
        found, tried = list(shapes), set[tuple[ShapeParameters, ShapeParameters]]()
        while True:
            pairs = [two for two in combinations(found, 2) if two not in tried]
            pairs = [two for two in pairs if shape_gap(*two) < _MAX_MERGE_GAP]
            if not pairs:
                return found
            a, b = min(pairs, key=lambda pair: shape_gap(*pair))
            tried.add((a, b))
            rest = [shape for shape in found if shape is not a and shape is not b]
            boxes = [enclosing_box((a, b), turn) for turn in (*_BOX_YAWS, a.yaw, b.yaw)]
            smallest = min(boxes, key=lambda box: box.length * box.width)
            options = [*boxes, *proposals.propose_people_and_vehicles(smallest)]
            merged = self.select_best(rest, options)
            if self.evidence([*rest, merged]) < self.evidence(found) - _MAX_EVIDENCE_DEFICIT:
                continue
            new = self.refine([*rest, merged])
            if all(self.is_better(new, old) for old in (found, [*rest, a], [*rest, b])):
                found = new


_HEIGHT_FACTORS = (0.4, 0.55, 0.75, 1.35, 2.0)  # candidate heights relative to the present one
_BOX_YAWS = tuple(k * math.pi / 16 for k in range(8))


def mean_rcs(shape: ShapeParameters) -> float:
    """Approximate the mean radar cross-section over directions of a shape of brightness 1 [m²].

    A matte surface of area A at incidence angle θ has 4 A cos²θ, half of it on average.

    Args:
        shape: shape parameters.
    """
    if shape.kind == "corner":
        return 0.5 * shape.length**2  # an eighth of its peak
    if shape.has_free_height:
        return 0.5 * math.pi * shape.length**2
    return 0.5 * math.pi * (shape.length + shape.width) * shape.height


def propose_kinds(likelihood: ShapeLikelihood, shapes: Shapes) -> list[list[ShapeParameters]]:
    """Convert all eligible shapes to each other kind, before any fit.

    Args:
        likelihood: likelihood that selects the heading of a shape.
        shapes: present shapes.
    """
    plain = ("box", "cylinder", "sphere")
    found = [[convert_kind(shape, kind) for shape in shapes] for kind in plain]
    for kind in ("person", "vehicle", "corner"):
        changed = list(shapes)
        for number, shape in enumerate(shapes):
            options = [r for r in _propose_headed_shapes(shape) if r.kind == kind != shape.kind]
            if options:
                rest = [*shapes[:number], *shapes[number + 1 :]]
                gains = [likelihood.total_gain([*rest, option]) for option in options]
                changed[number] = options[gains.index(max(gains))]
        found.append(changed)
    return [rows for rows in found if any(map(is_not, rows, shapes))]


def rotate_headed_shapes(shapes: Shapes, rotation: float) -> list[ShapeParameters]:
    """Rotate people and vehicles; empty if there are none.

    Args:
        shapes: present shapes.
        rotation: rotation about z [rad].
    """
    headed = "person", "vehicle"
    rows = [rotate_shape(one, rotation) if one.kind in headed else one for one in shapes]
    return rows if any(one.kind in headed for one in shapes) else []


def _propose_headed_shapes(shape: ShapeParameters) -> list[ShapeParameters]:
    """Propose shapes with a heading in place of a shape, of equal total brightness."""
    if shape.kind == "prism":
        return []
    box = shape if shape.is_rectangular else convert_kind(shape, "box")
    rows = proposals.propose_people_and_vehicles(box)
    if max(shape.length, shape.width) < proposals.MAX_CORNER_EXTENT:
        middle = shape.height if shape.has_free_height else 0.5 * shape.height
        rows += proposals.propose_headings(ShapeParameters("corner", shape.position, height=middle))
    strength = shape.brightness * mean_rcs(shape)
    found = [replace(row, brightness=strength / mean_rcs(row)) for row in rows]
    # A shape that is bright on one side only was fitted as a weak round one.
    more = [row for row in found if row.kind == "corner"]
    return found + [replace(r, brightness=r.brightness * by) for r in more for by in (4.0, 16.0)]


def perturb_shape(shape: ShapeParameters, step: float) -> list[ShapeParameters]:
    """Return a shape displaced, rotated, lifted, or changed in brightness by a small step.

    Args:
        shape: present shape.
        step: displacement along the ground [m].
    """
    x, y = shape.position
    moves = [(x + a * step, y + b * step) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    return [
        *(replace(shape, position=position) for position in moves),
        *(replace(shape, yaw=shape.yaw + turn) for turn in (-0.2, 0.2)),
        *(replace(shape, height=shape.height * part) for part in (0.75, 1.3)),
        *(replace(shape, brightness=shape.brightness * part) for part in (0.6, 1.7)),
    ]


def convert_kind(shape: ShapeParameters, kind: str) -> ShapeParameters:
    """Convert a shape to another kind of about the same size.

    Args:
        shape: present shape.
        kind: new kind.
    """
    if shape.kind in (kind, "prism"):
        return shape
    if kind == "box" and shape.is_rectangular:
        return replace(shape, kind="box")
    tall = 2 * shape.height if shape.has_free_height else shape.height
    if kind == "box":
        side = 0.85 * shape.length
        return replace(shape, kind="box", length=side, width=side, height=tall)
    across = (0.55 if shape.is_rectangular else 0.5) * (shape.length + shape.width)
    high = 0.5 * tall if kind == "sphere" else tall
    return replace(shape, kind=kind, length=across, width=across, height=max(high, 0.05))


def enclosing_box(shapes: Shapes, yaw: float) -> ShapeParameters:
    """Return a box around shapes.

    Args:
        shapes: shapes to merge.
        yaw: yaw of the box [rad].
    """
    corners = torch.cat([outline_corners(shape) for shape in shapes])
    rotation = primitives.ground_rotation(yaw)
    low, high = (corners @ rotation).aminmax(dim=0)
    x, y = (0.5 * rotation @ (low + high)).tolist()
    length, width = (high - low).tolist()
    brightest = max(shapes, key=lambda one: one.brightness)
    tall = max(shape.height for shape in shapes)
    return ShapeParameters("box", (x, y), yaw, length, width, tall, brightest.brightness)


def propose_splits(shape: ShapeParameters) -> list[tuple[ShapeParameters, ShapeParameters]]:
    """Propose two boxes in place of one shape: cuts across either side at three positions, one box
    slim.

    Args:
        shape: shape to split.

    Returns:
        For each cut both of full width, and either one slim, along each edge or the middle of the
        shape.
    """
    box = enclosing_box((shape,), shape.yaw if shape.is_rectangular else 0.0)
    c, s = math.cos(box.yaw), math.sin(box.yaw)

    def part(along: int, share: float, away: float, wide: float, off: float) -> ShapeParameters:
        """Return a part of the box; sides are fractions of the whole, offsets are in half sides."""
        sides, shift = [box.length, box.width], [0.0, 0.0]
        shift[along], shift[1 - along] = 0.5 * sides[along] * away, 0.5 * sides[1 - along] * off
        sides[along] *= share
        sides[1 - along] *= wide
        x, y = c * shift[0] - s * shift[1], s * shift[0] + c * shift[1]
        position = box.position[0] + x, box.position[1] + y
        return replace(box, position=position, length=sides[0], width=sides[1])

    whole = 1.0, 0.0
    slim = [(_SLIM_FRACTION, off) for off in (_SLIM_FRACTION - 1, 0.0, 1 - _SLIM_FRACTION)]
    widths = [(whole, whole), *((one, whole) for one in slim), *((whole, one) for one in slim)]
    return [
        (part(along, share, share - 1, *first), part(along, 1 - share, share, *second))
        for along, share, (first, second) in product((0, 1), (1 / 3, 1 / 2, 2 / 3), widths)
    ]


def shape_gap(first: ShapeParameters, second: ShapeParameters) -> float:
    """Compute the gap between two shapes, to a few centimetres [m].

    Args:
        first, second: shape parameters.
    """
    share = torch.linspace(0, 1, 9, dtype=torch.float64)[:, None, None]
    a, b = (
        (corners + share * (corners.roll(1, 0) - corners)).flatten(0, 1)
        for corners in map(outline_corners, (first, second))
    )
    return float(torch.cdist(a, b).min())


def outline_corners(shape: ShapeParameters, count: int = 16) -> Float64[Tensor, "corner 2"]:
    """Return the corners of a shape on the ground [m], or of a polygon for round shapes.

    Args:
        shape: shape parameters.
        count: number of corners of the polygon.
    """
    if isinstance(shape, PrismParameters):
        return prism_contour(shape)
    middle = torch.tensor(shape.position, dtype=torch.float64)
    if not shape.is_rectangular:
        turns = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
        return middle + 0.5 * shape.length * torch.stack([turns.cos(), turns.sin()], dim=1)
    half = 0.5 * torch.tensor([shape.length, shape.width], dtype=torch.float64)
    signs = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64)
    return middle + (signs * half) @ primitives.ground_rotation(shape.yaw).T
