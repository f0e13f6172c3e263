"""Scenes of simple shapes: their likelihood for recorded maps, and their joint fit."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin import inversion
from invertwin.channel import Grid, Sampling
from invertwin.discovery.imaging.likelihood import HeavyTailedLoss
from invertwin.discovery.imaging.reflectivity import thin_map
from invertwin.discovery.memory import SearchMemory
from invertwin.discovery.shapes.primitives import PrimitiveModel, ShapeParameters, Shapes
from invertwin.discovery.shapes.prisms import OutlineModel, make_shape_model
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Radar
from invertwin.runtime.progress import track
from invertwin.scene import Scene

_LEARNING_RATE = 0.01  # learning rate in the parameter scales of ``PrimitiveModel``


@dataclass(frozen=True, eq=False)
class CoarseMaps:
    """Maps of nearly independent bins.

    Attributes:
        power: observed maps [frame, range, u, v].
        grid: bins of the maps.
        loss: negative log-likelihood of maps.
    """

    power: Float64[Tensor, "frame some_range some_u some_v"]
    grid: Grid
    loss: HeavyTailedLoss


@dataclass(frozen=True, eq=False)
class ShapeLikelihood:
    """Observed maps and the model that determines the likelihood of shapes.

    Attributes:
        model: forward model of the maps.
        radar: radar that recorded them.
        power: observed maps [frame, range, u, v].
        loss: negative log-likelihood of maps.
        bins_per_draw: number of correlated bins per independent draw.
        level: height of the ground [m].
        seed: seed of the rays.
        memory: results of the search.
    """

    model: SurrogateMap
    radar: Radar
    power: Float[Tensor, "frame range u v"]
    loss: HeavyTailedLoss
    bins_per_draw: float
    level: float
    seed: int
    memory: SearchMemory = field(default_factory=SearchMemory)

    def unknowns(self, shapes: Shapes) -> dict[str, PrimitiveModel | OutlineModel]:
        """Return the shape models of shapes by name.

        Args:
            shapes: shape parameters.
        """
        named = {f"object_{number}": shape for number, shape in enumerate(shapes, 1)}
        return {n: make_shape_model(n, one, self.level) for n, one in named.items()}

    @cached_property
    def coarse_maps(self) -> "CoarseMaps":
        """Return the maps with one bin for each resolution cell of range and direction."""
        power, grid = thin_map(self.power, self.radar, self.model.grid)
        stride = round(grid.range_step / self.model.grid.range_step)
        return CoarseMaps(power, grid, replace(self.loss, level=self.loss.level[::stride]))

    def predict_coarse(self, shapes: Shapes) -> Float64[Tensor, "frame some_range some_u some_v"]:
        """Return ``predict`` in the bins of ``coarse_maps``.

        Args:
            shapes: shape parameters.
        """
        return thin_map(self.predict(shapes).double(), self.radar, self.model.grid)[0]

    def build_scene(self, shapes: Shapes) -> Scene:
        """Build the scene of shapes.

        Args:
            shapes: shape parameters.
        """
        return Scene({name: one.item for name, one in self.unknowns(shapes).items()})

    @torch.no_grad()
    def predict(self, shapes: Shapes) -> Float[Tensor, "frame range u v"]:
        """Predict the maps of shapes, without background.

        Args:
            shapes: shape parameters.
        """
        if not shapes:
            return torch.zeros_like(self.power)
        model = replace(self.model, sampling=replace(self.model.sampling, boundary=False))
        return model.predict(self.build_scene(shapes), self.radar, self.seed)

    def log_likelihood_gains(self, shapes: Shapes) -> Float64[Tensor, " frame"]:
        """Compute the log-likelihood of shapes over that of the background alone for every frame.

        Args:
            shapes: shape parameters.

        Returns:
            Log-likelihood ratios [frame], scaled to independent draws.
        """

        def compute() -> Tensor:
            rows = self._background_loss - self.bin_losses(shapes)
            return rows.flatten(1).double().sum(1) / self.bins_per_draw

        return self.memory.recall(self.gains_name, shapes, compute)

    @property
    def gains_name(self) -> str:
        """Name of the gains in the memory; the selected frames have another one than all."""
        return f"gains of {self.radar.frame_count} frames"

    def total_gain(self, shapes: Shapes) -> float:
        """Sum of ``log_likelihood_gains`` over the frames."""
        return float(self.log_likelihood_gains(shapes).sum())

    def evidence(self, shapes: Shapes) -> float:
        """Compute the log-likelihood minus half the log number of draws per free parameter (BIC).

        Source: Schwarz, "Estimating the dimension of a model", 1978.

        Args:
            shapes: shape parameters.
        """
        count = sum(7 if one.is_rectangular else 5 for one in shapes)
        return self.total_gain(shapes) - 0.5 * count * math.log(self.independent_draws)

    def bin_losses(self, shapes: Shapes) -> Float[Tensor, "frame range u v"]:
        """Compute the negative log-likelihood of shapes in every bin.

        Args:
            shapes: shape parameters.
        """
        return self.loss.bin_losses(self.predict(shapes), self.power)

    @cached_property
    def _background_loss(self) -> Tensor:
        return self.bin_losses([])

    @property
    def independent_draws(self) -> float:
        """Number of independent draws in the maps."""
        return self.power.numel() / self.bins_per_draw

    def select_frames(self, indices: Sequence[int]) -> "ShapeLikelihood":
        """Return the likelihood of selected frames.

        Args:
            indices: indices of the frames.
        """
        chosen = list(indices)
        sampling = self.model.sampling
        share = len(chosen) / self.radar.frame_count
        fewer = make_sampling(1, max(1, round(sampling.samples * share)))
        model, radar = replace(self.model, sampling=fewer), self.radar.frames(chosen)
        return replace(self, model=model, radar=radar, power=self.power[chosen])

    def fit(
        self, shapes: Shapes, steps: int
    ) -> tuple[list[ShapeParameters], inversion.Reconstruction]:
        """Fit all numbers of the shapes jointly.

        Args:
            shapes: initial shape parameters.
            steps: number of steps.
        """
        scene, adam = self.build_scene(shapes), inversion.Optimizer("adam", rate=_LEARNING_RATE)
        free = self.unknowns(shapes)
        data = inversion.Observation(self.model, self.power, sensor=self.radar)
        plan, loss, seed = inversion.Schedule(steps, annealing=0.5), self.loss, self.seed
        done = track(range(steps + 1), f"steps of a fit of {len(shapes)} objects")
        hooks = [inversion.Report(lambda _: (self.memory.heed(), next(done, None)))]
        found = inversion.reconstruct(
            scene, data, free, loss=loss, optimizer=adam, schedule=plan, seed=seed, callbacks=hooks
        )
        return [one.shape for one in free.values()], found

    def refine(self, shapes: Shapes, steps: int) -> list[ShapeParameters]:
        """Return the shapes of ``fit``.

        Args:
            shapes: initial shape parameters.
            steps: number of steps.
        """
        name = f"{steps} steps on {self.radar.frame_count} frames"
        return list(self.memory.recall(name, shapes, lambda: self.fit(shapes, steps)[0]))


def make_sampling(frames: int, rays: int) -> Sampling:
    """Return the sampling of a fit, with an eighth as many rays on silhouettes.

    Args:
        frames: number of frames of the recording.
        rays: number of rays per frame.
    """
    count = frames * rays
    return Sampling(depth=1, samples=count, boundary_samples=max(1, count // 8), contacts=False)
