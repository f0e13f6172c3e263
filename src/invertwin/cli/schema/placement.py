"""The table of a metasurface that is placed in a room."""

import math
from dataclasses import replace
from itertools import product
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Gt, Len, Lt, MinLen
from torch import Tensor

from invertwin.cli.schema.radio_tables import random_points
from invertwin.limits import Count, CountOfTwo, NonNegative, Positive
from invertwin.links import Metasurface, PanelPlacement, WallPath
from invertwin.links.metasurface.coverage import Coverage
from invertwin.registry.kinds import OneOf, Registry
from invertwin.registry.section import Section, Seed, Vector, prefix_errors
from invertwin.scene import Scene
from invertwin.seeds import derive_seed

Trial = tuple[float, float, tuple[float, float]]
"""Position on the path [m], yaw and half widths of the beam [rad]."""

_POINT = Annotated[list[float], Len(2, 2)]
_SECTORS = 12  # of the path: of the starts in one of them, the best is enough
_AIMED = 0.25  # share of the receivers, the worst ones, on whose middle the panel is focused


class Receivers(Section):
    """Receivers at random in a box.

    Attributes:
        low: m, a corner of the box
        high: m, the opposite corner
        count: those that the search sees
        batch: of them, in one evaluation
        scored: others, of another seed, that score what was found
    """

    low: Vector
    high: Vector
    count: CountOfTwo = 4800
    batch: CountOfTwo = 1200
    scored: CountOfTwo = 4000


class Walls(Section):
    """Places of the panel: a level path along walls, the room on its left.

    Attributes:
        corners: m, x and y, off the walls by half a panel
        height: m, z of the panel's centre
        radius: m, of round corners
        closed: whether the last corner leads back to the first
    """

    corners: Annotated[list[_POINT], MinLen(2)]
    height: float
    radius: Positive = 0.2
    closed: bool = False


class Panel(Section):
    """The metasurface.

    Attributes:
        counts: elements across and up
        spacing: m, of the elements
        bits: phases are rounded to 2^bits values; without it they are not
        pattern: of an element; without it that of an aperture
    """

    counts: Annotated[list[Count], Len(2, 2)]
    spacing: Positive
    bits: Count | None = None
    pattern: Annotated[Any, OneOf("pattern")] | None = None


class Placement(Section):
    """A metasurface is placed so that the worst receivers of a room get most.

    Attributes:
        frequency: Hz
        transmitter: m
        receivers: who should be reached
        walls: where the panel may stand
        panel: the metasurface
        share: of the receivers, that count as the worst
        target: m, the focus; without it the middle of the worst quarter
        along: m on the path, where fits start that have no [search]
        yaw_deg: away from the wall's normal, where they start
        spread_start_deg: half widths of the beam, across and up, where they start
        yaw_limit_deg: largest turn away from the wall's normal
        spread_limit_deg: largest half width of the beam
        depth: most reflections of a path without the panel
        edges: most edges that a path without the panel goes round
        edge_width: m, added to the width of shadows; it falls to none over reconstruct.annealing
        softness: dB, width of the quantile; it falls to a tenth alike
        starts: fits, which differ by the random numbers of [search]
        seed: of the receivers; without it the run's
    """

    frequency: Positive
    transmitter: Vector
    receivers: Receivers
    walls: Walls
    panel: Panel
    share: Annotated[float, Gt(0), Lt(1)] = 0.1
    target: Vector | None = None
    along: float = 0.0
    yaw_deg: float = 0.0
    spread_start_deg: _POINT = [0.0, 0.0]
    yaw_limit_deg: NonNegative = 25.0
    spread_limit_deg: NonNegative = 30.0
    depth: Annotated[int, Ge(0)] = 1
    edges: Annotated[int, Ge(0)] = 1
    edge_width: NonNegative = 0.3
    softness: Positive = 3.0
    starts: Count = 1
    seed: Seed | None = None

    @property
    def initial(self) -> Trial:
        """Start of fits that have no search, and place of gradient checks."""
        across, up = (math.radians(angle) for angle in self.spread_start_deg)
        return self.along, math.radians(self.yaw_deg), (across, up)

    def coverage(self, scene: Scene, run_seed: int, *, scored: bool = False) -> Coverage:
        """The aim, of the receivers that a search sees, or of those that score it.

        Args:
            scene: What is in the way.
            run_seed: Of the run.
            scored: Whether for the score.
        """
        seed = run_seed if self.seed is None else self.seed
        box = self.receivers
        count = box.scored if scored else box.count
        with prefix_errors("placement"):
            tx = torch.tensor(self.transmitter, dtype=torch.float64)
            points = random_points(box.low, box.high, count, derive_seed(seed, int(scored)))
            how = {"depth": self.depth, "edges": self.edges, "seed": seed}
            return Coverage.of(scene, tx, points.positions, self.frequency, self.share, **how)

    def path(self) -> WallPath:
        """Positions where the panel may stand."""
        walls = self.walls
        with prefix_errors("placement.walls"):
            return WallPath(walls.corners, walls.height, walls.radius, walls.closed)

    def metasurface(self) -> Metasurface:
        """The panel, which a ``PlacedPanel`` puts on the path."""
        table = self.panel
        with prefix_errors("placement.panel"):
            none = torch.zeros(*table.counts, dtype=torch.float64)
            place, axes = torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
            panel = Metasurface(place, axes, none, table.spacing)
            return replace(panel, bits=table.bits, pattern=table.pattern and table.pattern.build())

    def place(self, coverage: Coverage, trial: Trial, phases: bool = False) -> PanelPlacement:
        """The module of a panel that starts at a trial.

        Args:
            coverage: Who is reached.
            trial: Position on the path [m], yaw and half widths of the beam [rad].
            phases: Whether it holds phases of its elements, too.
        """
        start: dict[str, Any] = dict(zip(("along", "yaw", "spread"), trial, strict=True))
        start["yaw_limit"] = math.radians(self.yaw_limit_deg)
        start["spread_limit"] = math.radians(self.spread_limit_deg)
        focus, counts = self.focus(coverage), self.panel.counts if phases else None
        return PanelPlacement(self.path(), coverage.tx, focus, self.frequency, counts, **start)

    def focus(self, coverage: Coverage) -> Tensor:
        """The point on which the panel is focused [3] [m]."""
        if self.target is not None:
            return torch.tensor(self.target, dtype=torch.float64)
        worst = coverage.direct <= torch.quantile(coverage.direct, _AIMED)
        return coverage.receivers[worst].mean(0)

    def sector(self, trial: Trial) -> int:
        """Number of the part of the path where a trial is: of each, one start is enough."""
        return int(_SECTORS * trial[0] / self.path().length)


class _PanelSearch(Section):
    """Placements in which the metasurface of [placement] may begin; the best few are fitted.

    Attributes:
        fits: of the best starts, of different parts of the path
        shortlist: fit these in the first stage only; the best of them is fitted in all
    """

    fits: Count = 6
    shortlist: bool = True


class RandomPanels(_PanelSearch):
    """Random placements, each from a slice of its own of every range.

    Attributes:
        count: placements that are compared
    """

    kind: Literal["panels"]
    count: Count = 32

    def trials(self, table: Placement, generator: torch.Generator) -> list[Trial]:
        """The placements.

        Args:
            table: Of the metasurface.
            generator: Of the random numbers.
        """
        u = torch.rand(self.count, 4, generator=generator, dtype=torch.float64)
        slices = [torch.randperm(self.count, generator=generator) for _ in range(4)]
        u = (torch.stack(slices, 1) + u) / self.count
        length, turn = table.path().length, math.radians(table.yaw_limit_deg)
        wide = math.radians(table.spread_limit_deg)
        return [
            (length * along, turn * (2 * yaw - 1), (wide * across, wide * up))
            for along, yaw, across, up in u.tolist()
        ]


class PanelGrid(_PanelSearch):
    """Placements on a grid; positions run slowest.

    Attributes:
        places: on the path
        yaws: between the limits
        spread_deg: half widths of the beam, of which every pair is tried
    """

    kind: Literal["panel_grid"]
    places: CountOfTwo = 80
    yaws: Count = 5
    spread_deg: Annotated[list[NonNegative], MinLen(1)] = [5.0, 15.0]

    def trials(self, table: Placement, generator: torch.Generator) -> list[Trial]:
        """The placements.

        Args:
            table: Of the metasurface.
            generator: Not used.
        """
        path, turn = table.path(), math.radians(table.yaw_limit_deg)
        step = path.length / (self.places if path.closed else self.places - 1)
        turns = torch.linspace(-turn, turn, self.yaws).tolist() if self.yaws > 1 else [0.0]
        spreads = [math.radians(angle) for angle in self.spread_deg]
        grid = product(range(self.places), turns, product(spreads, spreads))
        return [(number * step, yaw, widths) for number, yaw, widths in grid]


def register(registry: Registry) -> None:
    """Add searches for a metasurface."""
    registry.add("search", "panels", RandomPanels)
    registry.add("search", "panel_grid", PanelGrid)
