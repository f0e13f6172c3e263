"""Placing a metasurface by gradient: the worst receivers of a room decide.

Beside it stand what it is compared with: every place of a grid, and simulated annealing.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel import trace_paths
from invertwin.limits import Angle, Count, NonNegative, Positive, UnitFraction
from invertwin.links.metasurface.panel import Metasurface, panel_response
from invertwin.links.metasurface.wall_path import PanelPlacement
from invertwin.links.responses import frequency_response
from invertwin.runtime.progress import track
from invertwin.scene import Scene

Trial = tuple[float, float, tuple[float, float]]
"""Place on the path [m], yaw and spread [rad]."""

_WEAK = 4.0  # times the share of the worst: receivers to which the panel matters
_APART = 0.08  # of the path: scouts that stand nearer to each other are one track
_FLOOR = 1e-20  # path gain that is added, so that decibels stay finite
BACKWARD = 2
"""Evaluations that a derivative by all unknowns counts for, beside the one of its value."""


def soft_quantile(values: Float64[Tensor, " n"], share: float, width: float) -> Float64[Tensor, ""]:
    """The level that a share of values is below, smooth in all of them.

    It solves mean σ((q − v)/width) = share; width 0 gives the quantile itself.

    Args:
        values: At least one.
        share: Between 0 and 1.
        width: In the unit of the values.
    """
    if width <= 0:
        return torch.quantile(values, share)
    still = values.detach()
    low, high = still.min() - 40 * width, still.max() + 40 * width
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = ((middle - still) / width).sigmoid().mean() < share
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    part = ((low - still) / width).sigmoid()
    weight = part * (1 - part)
    return low + (weight * (values - still)).sum() / weight.sum().clamp_min(1e-300)


@dataclass(frozen=True, eq=False)
class Coverage:
    """What receivers get, by the paths of the scene and over a panel.

    Powers of the two are added, which is the mean over the fringes of a few wavelengths between
    them; the paths of the scene add up coherently among themselves.

    Attributes:
        scene: What is in the way.
        tx: The transmitter [m].
        receivers: [m].
        frequency: [Hz].
        direct: Path gain without a panel.
        share: Of the receivers that count as the worst.
    """

    scene: Scene
    tx: Float64[Tensor, "3"]
    receivers: Float64[Tensor, "rx 3"]
    frequency: float
    direct: Float64[Tensor, " rx"]
    share: UnitFraction = 0.1

    @classmethod
    def of(
        cls,
        scene: Scene,
        tx: Tensor,
        receivers: Tensor,
        frequency: float,
        share: float = 0.1,
        *,
        depth: int = 1,
        edges: int = 1,
        seed: int = 0,
    ) -> "Coverage":
        """With the paths that are there without a panel.

        Args:
            scene: What is in the way.
            tx: The transmitter [m].
            receivers: [rx, 3] [m].
            frequency: [Hz].
            share: Of the receivers that count as the worst.
            depth, edges: Of the paths, see ``trace_paths``.
            seed: Of the rays that find them.
        """
        with torch.no_grad():
            paths = trace_paths(
                scene, tx, receivers, frequency, depth=depth, edges=edges, rays=20_000, seed=seed
            )
            gain = frequency_response(paths, [frequency]).abs().square().reshape(len(receivers))
        return cls(scene, tx, receivers, frequency, gain, share)

    def gain(
        self, panel: Metasurface, width: float = 0.0, boundary: bool = True
    ) -> Float64[Tensor, " rx"]:
        """Path gain of every receiver, with the panel.

        Args:
            panel: The metasurface.
            width: Added to the width over which shadows end on it [m].
            boundary: False leaves out of derivatives that shadows move.
        """
        over = panel_response(
            self.scene,
            panel,
            self.tx[None],
            self.receivers,
            self.frequency,
            blur=width,
            boundary=boundary,
        )[0]
        return self.direct + over.real.square() + over.imag.square()

    def part(self, rows: Tensor | slice) -> "Coverage":
        """Some of the receivers.

        Args:
            rows: Their numbers.
        """
        return replace(self, receivers=self.receivers[rows], direct=self.direct[rows])

    def aim(
        self, panel: Metasurface, width: float = 0.0, boundary: bool = True, softness: float = 0.0
    ) -> Float64[Tensor, ""]:
        """``worst`` of ``gain``; receivers that get much without the panel stay without.

        Args:
            panel: The metasurface.
            width, boundary: See ``gain``.
            softness: See ``soft_quantile`` [dB].
        """
        weak = self.direct <= torch.quantile(self.direct, min(1.0, _WEAK * self.share))
        gain = self.part(weak).gain(panel, width, boundary)
        return self.worst(self.direct.masked_scatter(weak, gain), softness)

    def worst(self, gain: Tensor, softness: float = 0.0) -> Float64[Tensor, ""]:
        """The level that the worst share of receivers is below [dB].

        Args:
            gain: From ``gain``.
            softness: See ``soft_quantile`` [dB].
        """
        return soft_quantile(10 * (gain + _FLOOR).log10(), self.share, softness)


@dataclass(frozen=True)
class Descent:
    """How a panel is placed by gradient.

    Attributes:
        scouts: Places that are tried before, spread at random over all.
        tracks: The best of them that stand apart, from which short descents start.
        track_steps: Of each short descent.
        steps: Of the last one, from the best end.
        edge_width: Added to the width of shadows at the start [m]; it shrinks to none.
        softness: Of the quantile at the start [dB]; it shrinks to a tenth.
        rates: Of place [m], yaw and spread [rad], and phases [rad] in a step.
    """

    scouts: Count = 32
    tracks: Count = 6
    track_steps: Count = 24
    steps: Count = 240
    edge_width: NonNegative = 0.3
    softness: Positive = 3.0
    rates: tuple[Positive, Positive, Positive] = (0.15, 0.06, 0.15)

    @property
    def evaluations(self) -> int:
        """Of a whole run; a step counts for its derivative, too."""
        steps = self.tracks * self.track_steps + self.steps
        return self.scouts + steps * (1 + BACKWARD) + self.tracks + 1


@dataclass
class Found:
    """Where a search has ended.

    Attributes:
        state: Values of the module's parameters.
        level: The aim there, of sharp shadows and the quantile itself [dB].
        evaluations: Counted so far.
        history: Number of evaluations and best level, as the search went on.
    """

    state: dict[str, Tensor]
    level: float
    evaluations: int = 0
    history: list[tuple[int, float]] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class PanelDesign:
    """A panel, what it may do, and what it is for.

    Attributes:
        coverage: The aim.
        panel: The metasurface; where it stands is the module's.
        make: A module at the start of a search: place [m], yaw [rad], spread [2] [rad].
        yaw_limit: Largest turn away from the wall's normal [rad].
        spread_limit: Largest half width of the beam [rad].
        batch: Receivers that one evaluation looks at: the first ones, or some at random in a step
            by gradient.
    """

    coverage: Coverage
    panel: Metasurface
    make: Callable[[float, float, Sequence[float]], PanelPlacement]
    yaw_limit: Angle
    spread_limit: Angle
    batch: int

    def level(self, module: PanelPlacement, coverage: Coverage | None = None) -> float:
        """The aim of a placed panel [dB].

        Args:
            module: Where the panel stands.
            coverage: Other receivers, to score it.
        """
        aim = coverage or self.coverage.part(slice(0, self.batch))
        with torch.no_grad():
            return float(aim.aim(module(self.panel)))

    def module(self, state: dict[str, Tensor]) -> PanelPlacement:
        """A module with the values of a search's end."""
        module = self.make(0.0, 0.0, (0.0, 0.0))
        module.load_state_dict(state)
        return module

    def drawn(self, generator: torch.Generator, count: int = 1) -> list[PanelPlacement]:
        """Modules at random places, yaws and spreads, each from a slice of its own of every range.

        Args:
            generator: Of the random numbers.
            count: How many.
        """
        u = torch.rand(count, 4, generator=generator, dtype=torch.float64)
        slices = [torch.randperm(count, generator=generator) for _ in range(4)]
        u = (torch.stack(slices, 1) + u) / count
        length = self._example.path.length
        return [
            self.make(
                length * along,
                self.yaw_limit * (2 * yaw - 1),
                [self.spread_limit * across, self.spread_limit * up],
            )
            for along, yaw, across, up in u.tolist()
        ]

    @property
    def _example(self) -> PanelPlacement:
        return self.make(0.0, 0.0, (0.0, 0.0))

    def keep_inside(self, module: PanelPlacement) -> None:
        """Move values that have left their ranges back to the ends."""
        with torch.no_grad():
            module.yaw.clamp_(-self.yaw_limit, self.yaw_limit)
            module.spread.clamp_(-self.spread_limit, self.spread_limit)
            if not module.path.closed:
                module.along.clamp_(0.0, module.path.length)

    def descend(
        self,
        module: PanelPlacement,
        steps: int,
        settings: Descent,
        *,
        width: float,
        boundary: bool = True,
        phases: bool = True,
    ) -> None:
        """Move a module by gradient steps.

        Args:
            module: Is changed.
            steps: How many.
            settings: Rates and softness.
            width: Added to shadows at the start [m]; none after two thirds of the steps.
            boundary: False leaves out that shadows move.
            phases: Whether each element's own phase moves, too.
        """
        place, turn, phase = settings.rates
        groups = [([module.along], place), ([module.yaw, module.spread], turn)]
        groups.append(([module.shift], phase if phases else 0.0))
        optimizer = torch.optim.Adam([{"params": p, "lr": r} for p, r in groups])
        # Other receivers in every step: phases must not learn single ones.
        drawn, count = torch.Generator().manual_seed(steps), len(self.coverage.receivers)
        for step in range(steps):
            part = step / steps
            for group, (_, rate) in zip(optimizer.param_groups, groups, strict=True):
                group["lr"] = rate * (0.5 * (1 + math.cos(math.pi * part)) + 0.02)
            optimizer.zero_grad()
            aim = self.coverage.part(torch.randperm(count, generator=drawn)[: self.batch])
            edge = width * max(0.0, 1 - 1.5 * part)
            softness = settings.softness * 0.1**part
            (-aim.aim(module(self.panel), edge, boundary, softness)).backward()
            optimizer.step()
            self.keep_inside(module)

    def by_gradient(self, settings: Descent, seed: int, boundary: bool = True) -> Found:
        """Scouts at random, short descents from the best, and a long one from the best of these.

        The short descents leave the phases of single elements alone: these fit the place where
        they are learnt, and would hold the panel there.

        Args:
            settings: How long.
            seed: Of the scouts.
            boundary: False leaves out that shadows move.
        """
        generator = torch.Generator().manual_seed(seed)
        scouts = self.drawn(generator, settings.scouts)
        scouts.sort(key=self.level, reverse=True)
        tracks: list[PanelPlacement] = []
        for scout in scouts:
            if len(tracks) < settings.tracks and all(self._apart(scout, own) for own in tracks):
                tracks.append(scout)
        for module in tracks:
            self.descend(
                module,
                settings.track_steps,
                settings,
                width=settings.edge_width,
                boundary=boundary,
                phases=False,
            )
        best = max(tracks, key=self.level)
        width = settings.edge_width / 10
        self.descend(best, settings.steps, settings, width=width, boundary=boundary)
        state = {name: value.clone() for name, value in best.state_dict().items()}
        return Found(state, self.level(best), settings.evaluations)

    def _apart(self, first: PanelPlacement, second: PanelPlacement) -> bool:
        """Whether two panels stand at places that are tracks of their own."""
        length = first.path.length
        gap = abs(float(first.along.detach() - second.along.detach()))
        return min(gap, length - gap if first.path.closed else gap) > _APART * length

    def annealed(self, evaluations: int, seed: int, enough: float = math.inf) -> Found:
        """Simulated annealing over the same unknowns, from a random start.

        Half of its moves change place, yaw and spread, from the whole range down to a hundredth;
        the others add a random wave to the phases. The temperature falls from 3 dB to 0.03 dB.

        Args:
            evaluations: Most of them.
            seed: Of its random numbers.
            enough: A level at which it stops [dB].
        """
        generator = torch.Generator().manual_seed(seed)
        (here,) = self.drawn(generator)
        level = self.level(here)
        found = Found({n: v.clone() for n, v in here.state_dict().items()}, level, 1)
        kept = {n: v.clone() for n, v in found.state.items()}
        while found.evaluations < evaluations and found.level < enough:
            part = found.evaluations / evaluations
            self._disturb(here, 0.01**part, generator)
            trial = self.level(here)
            found.evaluations += 1
            chance = math.exp(min(0.0, (trial - level) / (3.0 * 0.01**part)))
            if float(torch.rand((), generator=generator)) < chance:
                level, kept = trial, {n: v.clone() for n, v in here.state_dict().items()}
            else:
                here.load_state_dict(kept)
            if level > found.level:
                found.level, found.state = level, {n: v.clone() for n, v in kept.items()}
                found.history.append((found.evaluations, level))
        return found

    def _disturb(self, module: PanelPlacement, size: float, generator: torch.Generator) -> None:
        """A random move, of a share of the ranges."""
        u = torch.randn(8, generator=generator, dtype=torch.float64)
        with torch.no_grad():
            if torch.rand((), generator=generator) < 0.5:
                module.along.add_(0.3 * size * module.path.length * u[0])
                module.yaw.add_(size * self.yaw_limit * u[1])
                module.spread.add_(size * self.spread_limit * u[2:4])
            else:
                counts = module.shift.shape
                across = [torch.linspace(-1, 1, n, dtype=torch.float64) for n in counts]
                wave = torch.cos(
                    3 * u[4] * across[0][:, None] + 3 * u[5] * across[1] + math.pi * u[6]
                )
                module.shift.add_(size * u[7] * wave)
        self.keep_inside(module)

    def trials(self, places: int, yaws: int, spreads: Sequence[float]) -> list[Trial]:
        """Places, yaws and spreads on a grid; places run slowest.

        Args:
            places: On the path.
            yaws: Between the limits.
            spreads: Half widths of the beam, of which every pair is tried [rad].
        """
        path = self._example.path
        step = path.length / (places if path.closed else places - 1)
        turns = torch.linspace(-self.yaw_limit, self.yaw_limit, yaws).tolist()
        turns = turns if yaws > 1 else [0.0]
        return [
            (number * step, yaw, (across, up))
            for number in range(places)
            for yaw in turns
            for across in spreads
            for up in spreads
        ]

    def exhaustive(self, trials: Sequence[Trial]) -> Float64[Tensor, " trial"]:
        """The aim of every trial [dB]."""
        levels = [self.level(self.make(*trial)) for trial in track(trials, "exhaustive grid")]
        return torch.tensor(levels, dtype=torch.float64)


def evaluations_until(history: Iterable[tuple[int, float]], level: float) -> int | None:
    """After how many evaluations a search has reached a level; None if never.

    Args:
        history: Of a ``Found``.
        level: [dB].
    """
    return next((count for count, best in history if best >= level), None)
