"""A scene of simple shapes that explains recorded maps: how likely it is, and its joint fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin.channel import Grid, Sampling
from invertwin.discovery.imaging.likelihood import HeavyTailed
from invertwin.discovery.imaging.reflectivity import thinned
from invertwin.discovery.shapes.primitives import Figure, Primitive
from invertwin.discovery.shapes.prisms import Outline, unknown
from invertwin.inversion import Observation, Optimizer, Reconstruction, Schedule, reconstruct
from invertwin.inversion.initialisation.detections import Ground
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Radar
from invertwin.scene import Scene

_RATE = 0.01  # of the optimiser, see the scales of ``Primitive``


@dataclass(frozen=True, eq=False)
class Coarse:
    """Maps of nearly independent bins.

    Attributes:
        power: The maps.
        grid: Their bins.
        loss: How unlikely they are.
    """

    power: Float64[Tensor, "frame some_range some_u some_v"]
    grid: Grid
    loss: HeavyTailed


@dataclass(frozen=True, eq=False)
class Assembly:
    """Maps, and what it takes to judge shapes by them.

    Attributes:
        model: Predicts maps.
        radar: Recorded them.
        power: The maps.
        loss: How unlikely maps are.
        shared: How many bins are worth one.
        ground: The plane on which things stand.
        level: Its height [m].
        seed: Of rays.
    """

    model: SurrogateMap
    radar: Radar
    power: Float[Tensor, "frame range u v"]
    loss: HeavyTailed
    shared: float
    ground: Ground
    level: float
    seed: int

    def unknowns(self, figures: Sequence[Figure]) -> dict[str, Primitive | Outline]:
        """Shapes as unknowns, by name.

        Args:
            figures: The shapes.
        """
        return {
            f"object_{number}": unknown(f"object_{number}", figure, self.ground, self.level)
            for number, figure in enumerate(figures, 1)
        }

    @cached_property
    def coarse(self) -> "Coarse":
        """The maps with one bin for each cell of range and direction."""
        power, grid = thinned(self.power, self.radar, self.model.grid)
        stride = round(grid.range_step / self.model.grid.range_step)
        return Coarse(power, grid, replace(self.loss, level=self.loss.level[::stride]))

    def coarse_predicted(
        self, figures: Sequence[Figure]
    ) -> Float64[Tensor, "frame some_range some_u some_v"]:
        """``predicted`` in the bins of ``coarse``.

        Args:
            figures: The shapes.
        """
        return thinned(self.predicted(figures).double(), self.radar, self.model.grid)[0]

    def scene(self, figures: Sequence[Figure]) -> Scene:
        """Shapes as a scene.

        Args:
            figures: The shapes.
        """
        return Scene({name: one.item for name, one in self.unknowns(figures).items()})

    @torch.no_grad()
    def predicted(self, figures: Sequence[Figure]) -> Float[Tensor, "frame range u v"]:
        """The maps of shapes, without background.

        Args:
            figures: The shapes.
        """
        if not figures:
            return torch.zeros_like(self.power)
        model = replace(self.model, sampling=replace(self.model.sampling, boundary=False))
        return model.predict(self.scene(figures), self.radar, self.seed)

    def gains(self, figures: Sequence[Figure]) -> Float64[Tensor, " frame"]:
        """By how much shapes are likelier than the background alone, of every frame.

        Args:
            figures: The shapes.

        Returns:
            Logarithms of likelihood ratios, for as many draws as are independent.
        """
        rows = self._nothing - self.loss.rows(self.predicted(figures), self.power)
        return rows.flatten(1).double().sum(1) / self.shared

    @cached_property
    def _nothing(self) -> Tensor:
        return self.loss.rows(torch.zeros_like(self.power), self.power)

    @property
    def draws(self) -> float:
        """How many independent draws the maps hold."""
        return self.power.numel() / self.shared

    def frames(self, numbers: Sequence[int]) -> "Assembly":
        """Some frames.

        Args:
            numbers: Of the frames.
        """
        chosen = list(numbers)
        sampling = self.model.sampling
        share = len(chosen) / self.radar.frame_count
        fewer = sampling_of(1, max(1, round(sampling.samples * share)))
        return replace(
            self,
            model=replace(self.model, sampling=fewer),
            radar=self.radar.frames(chosen),
            power=self.power[chosen],
        )

    def fitted(self, figures: Sequence[Figure], steps: int) -> tuple[list[Figure], Reconstruction]:
        """Shapes after a joint fit of all their numbers.

        Args:
            figures: At the start.
            steps: Of the fit.
        """
        unknowns = self.unknowns(figures)
        found = reconstruct(
            self.scene(figures),
            Observation(self.model, self.radar, self.power),
            unknowns,
            loss=self.loss,
            optimizer=Optimizer("adam", rate=_RATE),
            schedule=Schedule(steps, annealing=0.5),
            seed=self.seed,
        )
        return [one.figure for one in unknowns.values()], found


def sampling_of(frames: int, rays: int) -> Sampling:
    """Rays of a fit, an eighth as many on silhouettes.

    Args:
        frames: Of the recording.
        rays: In each frame.
    """
    count = frames * rays
    return Sampling(depth=1, samples=count, boundary_samples=max(1, count // 8), contacts=False)
