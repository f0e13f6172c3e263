"""The table of a metasurface that is placed in a room."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import torch
from annotated_types import Ge, Gt, Len, Lt, MinLen
from torch import Tensor

from invertwin.limits import Count, CountOfTwo, NonNegative, Positive
from invertwin.links.metasurface.panel import Metasurface
from invertwin.links.metasurface.placement import Coverage, Descent, PanelDesign
from invertwin.links.metasurface.wall_path import PanelPlacement, WallPath
from invertwin.registry.kinds import OneOf, TableOf
from invertwin.registry.section import Section, Seed, Vector, key, prefix_errors
from invertwin.scene import Scene
from invertwin.seeds import derive_seed

_POINT = Annotated[list[float], Len(2, 2)]
_AIMED = 0.25  # share of the receivers, the worst ones, on whose middle the panel is focused


class Receivers(Section):
    """Receivers at random in a box."""

    low: Vector = key("m, a corner of the box")
    high: Vector = key("m, the opposite corner")
    count: CountOfTwo = key("those that the search sees", 4800)
    batch: CountOfTwo = key("of them, in one evaluation", 1200)
    scored: CountOfTwo = key("others, of another seed, that score what was found", 4000)

    def drawn(self, count: int, seed: int) -> Tensor:
        """Places [count, 3] [m]."""
        low, high = (torch.tensor(end, dtype=torch.float64) for end in (self.low, self.high))
        generator = torch.Generator().manual_seed(seed)
        return low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)


class Walls(Section):
    """Where the panel may stand: a level path along walls, the room on its left."""

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


class PlacementGrid(Section):
    """The grid whose best place is what a search should find."""

    places: CountOfTwo = key("on the path", 80)
    yaws: Count = key("between the limits", 5)
    spread_deg: Annotated[list[NonNegative], MinLen(1)] = key(
        "half widths of the beam, of which every pair is tried", [5.0, 15.0]
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
    along: float = key("m on the path, where a gradient check is made", 0.0)
    yaw_deg: float = key("away from the wall's normal, where a gradient check is made", 0.0)
    spread_start_deg: _POINT = key(
        "half widths of the beam, across and up, of a gradient check", [0.0, 0.0]
    )
    yaw_limit_deg: NonNegative = key("largest turn away from the wall's normal", 25.0)
    spread_limit_deg: NonNegative = key("largest half width of the beam", 30.0)
    depth: Annotated[int, Ge(0)] = key("most surfaces that a path without the panel meets", 1)
    edges: Annotated[int, Ge(0)] = key("most edges that a path without the panel goes round", 1)
    starts: Count = key("searches, of seeds one after another", 10)
    annealing: Count = key("most evaluations of simulated annealing, times those of a search", 10)
    annealed_starts: Annotated[int, Ge(0)] = key("of the starts, that annealing is tried from", 3)
    descent: Annotated[Any, TableOf(Descent)] = key("the search", {}, validate_default=True)
    grid: PlacementGrid = key("the exhaustive search", PlacementGrid())
    seed: Seed | None = key("of the receivers; without it the run's", None)

    def coverage(self, scene: Scene, run_seed: int, *, scored: bool = False) -> Coverage:
        """The aim, of the receivers that a search sees, or of those that score it.

        Args:
            scene: What is in the way.
            run_seed: Of the run.
            scored: Whether for the score.
        """
        seed = run_seed if self.seed is None else self.seed
        count = self.receivers.scored if scored else self.receivers.count
        with prefix_errors("placement"):
            return Coverage.of(
                scene,
                torch.tensor(self.transmitter, dtype=torch.float64),
                self.receivers.drawn(count, derive_seed(seed, int(scored))),
                self.frequency,
                self.share,
                depth=self.depth,
                edges=self.edges,
                seed=seed,
            )

    def placing(self, coverage: Coverage) -> PanelDesign:
        """The panel and where it may stand.

        Args:
            coverage: The aim.
        """
        table, walls = self.panel, self.walls
        with prefix_errors("placement.walls"):
            path = WallPath(walls.corners, walls.height, walls.radius, walls.closed)
        with prefix_errors("placement.panel"):
            none = torch.zeros(*table.counts, dtype=torch.float64)
            place = torch.zeros(3, dtype=torch.float64)
            axes = torch.eye(3, dtype=torch.float64)
            panel = Metasurface(place, axes, none, table.spacing)
            pattern = table.pattern and table.pattern.build()
            panel = replace(panel, bits=table.bits, pattern=pattern)
        target = self.focus(coverage)

        def make(along: float, yaw: float, spread: Sequence[float]) -> PanelPlacement:
            return PanelPlacement(
                path,
                coverage.tx,
                target,
                self.frequency,
                table.counts,
                along=along,
                yaw=yaw,
                spread=spread,
            )

        limits = math.radians(self.yaw_limit_deg), math.radians(self.spread_limit_deg)
        return PanelDesign(coverage, panel, make, *limits, self.receivers.batch)

    def focus(self, coverage: Coverage) -> Tensor:
        """On what the panel is focused [m]."""
        if self.target is not None:
            return torch.tensor(self.target, dtype=torch.float64)
        worst = coverage.direct <= torch.quantile(coverage.direct, _AIMED)
        return coverage.receivers[worst].mean(0)

    def example(self, placing: PanelDesign) -> PanelPlacement:
        """The module of a gradient check, at its start."""
        spread = [math.radians(angle) for angle in self.spread_start_deg]
        return placing.make(self.along, math.radians(self.yaw_deg), spread)
