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
from invertwin.links.metasurface.coverage import Coverage
from invertwin.links.metasurface.panel import Metasurface
from invertwin.links.metasurface.wall_path import PanelPlacement, WallPath
from invertwin.registry.kinds import OneOf, Registry
from invertwin.registry.section import Section, Seed, Vector, key, prefix_errors
from invertwin.scene import Scene
from invertwin.seeds import derive_seed

Trial = tuple[float, float, tuple[float, float]]
"""Position on the path [m], yaw and half widths of the beam [rad]."""

_POINT = Annotated[list[float], Len(2, 2)]
_SECTORS = 12  # of the path: of the starts in one of them, the best is enough
_AIMED = 0.25  # share of the receivers, the worst ones, on whose middle the panel is focused


class Receivers(Section):
    """Receivers at random in a box."""

    low: Vector = key("m, a corner of the box")
    high: Vector = key("m, the opposite corner")
    count: CountOfTwo = key("those that the search sees", 4800)
    batch: CountOfTwo = key("of them, in one evaluation", 1200)
    scored: CountOfTwo = key("others, of another seed, that score what was found", 4000)


class Walls(Section):
    """Places of the panel: a level path along walls, the room on its left."""

    corners: Annotated[list[_POINT], MinLen(2)] = key("m, x and y, off the walls by half a panel")
    height: float = key("m, z of the panel's centre")
    radius: Positive = key("m, of round corners", 0.2)
    closed: bool = key("whether the last corner leads back to the first", False)


class Panel(Section):
    """The metasurface."""

    counts: Annotated[list[Count], Len(2, 2)] = key("elements across and up")
    spacing: Positive = key("m, of the elements")
    bits: Count | None = key("phases are rounded to 2^bits values; without it they are not", None)
    pattern: Annotated[Any, OneOf("pattern")] | None = key(
        "of an element; without it that of an aperture", None
    )


class Placement(Section):
    """A metasurface is placed so that the worst receivers of a room get most."""

    frequency: Positive = key("Hz")
    transmitter: Vector = key("m")
    receivers: Receivers = key("who should be reached")
    walls: Walls = key("where the panel may stand")
    panel: Panel = key("the metasurface")
    share: Annotated[float, Gt(0), Lt(1)] = key("of the receivers, that count as the worst", 0.1)
    target: Vector | None = key("m, the focus; without it the middle of the worst quarter", None)
    along: float = key("m on the path, where fits start that have no [search]", 0.0)
    yaw_deg: float = key("away from the wall's normal, where they start", 0.0)
    spread_start_deg: _POINT = key(
        "half widths of the beam, across and up, where they start", [0.0, 0.0]
    )
    yaw_limit_deg: NonNegative = key("largest turn away from the wall's normal", 25.0)
    spread_limit_deg: NonNegative = key("largest half width of the beam", 30.0)
    depth: Annotated[int, Ge(0)] = key("most surfaces that a path without the panel meets", 1)
    edges: Annotated[int, Ge(0)] = key("most edges that a path without the panel goes round", 1)
    edge_width: NonNegative = key(
        "m, added to the width of shadows; it falls to none over reconstruct.annealing", 0.3
    )
    softness: Positive = key("dB, width of the quantile; it falls to a tenth alike", 3.0)
    starts: Count = key("fits, which differ by the random numbers of [search]", 1)
    seed: Seed | None = key("of the receivers; without it the run's", None)

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
    """Placements in which the metasurface of [placement] may begin; the best few are fitted."""

    fits: Count = key("of the best starts, of different parts of the path", 6)
    shortlist: bool = key(
        "fit these in the first stage only; the best of them is fitted in all", True
    )


class RandomPanels(_PanelSearch):
    """Random placements, each from a slice of its own of every range."""

    kind: Literal["panels"]
    count: Count = key("placements that are compared", 32)

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
    """Placements on a grid; positions run slowest."""

    kind: Literal["panel_grid"]
    places: CountOfTwo = key("on the path", 80)
    yaws: Count = key("between the limits", 5)
    spread_deg: Annotated[list[NonNegative], MinLen(1)] = key(
        "half widths of the beam, of which every pair is tried", [5.0, 15.0]
    )

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
