"""A plate off its place in front of a wall, and the exact signals of it."""

from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from invertwin.capture import Capture
from invertwin.channel import Grid, Sampling
from invertwin.inversion import Optimizer
from invertwin.radar import Radar, Surrogate
from invertwin.scene import Scene, plate
from invertwin.scene.parameters import Translation
from invertwin.simulation import simulate
from scenes import float64, radar, thing

OFFSET = float64([-0.09, 0.06, 0.0])
DRAWN = Sampling(depth=1, points_per_m2=3_000.0)


@dataclass(frozen=True)
class Case:
    """A scene as known, a recording of the scene as it is, and cheap settings."""

    scene: Scene
    radar: Radar
    capture: Capture
    grid: Grid

    def settings(self, **changes: Any) -> dict[str, Any]:
        """Keyword arguments of ``fits.fit``."""
        return {
            "grid": self.grid,
            "steps": 30,
            "depth": 1,
            "samples": 8_000,
            "boundary_samples": 2_000,
            "optimizer": Optimizer(rate=0.02),
            "surrogate": Surrogate(range_width=2.0, angle_width=1.0),
            "seed": 1,
            **changes,
        }

    @property
    def offset(self) -> Tensor:
        """Where the plate really is, from where it is thought to be [m]."""
        return OFFSET

    def parameters(self) -> list[Translation]:
        return [Translation("plate")]

    def error(self, scene: Scene) -> Tensor:
        """Where the plate is, against where it really is [m]."""
        return scene["plate"].center.detach() - self.scene["plate"].center - OFFSET


@pytest.fixture(scope="session")
def case() -> Case:
    places = [[0.0, y, 0.0] for y in (-0.3, -0.1, 0.1, 0.3)]
    scene = Scene(
        {
            "plate": thing(plate(0.3, 0.3), (1.5, 0.0, 0.0), (0.0, 0.0, 0.1)),
            "wall": thing(plate(1.6, 1.2), (2.1, 0.0, 0.0)),
        }
    )
    device = radar(places, receivers=16)
    grid = device.grid(1.0, 2.4, 0.5, oversample=1)
    with torch.no_grad():
        true = Translation("plate", OFFSET)(scene)
        beat = simulate(true, device, grid, sampling=DRAWN, seed=7).beat
    return Case(scene, device, Capture.from_beat(beat, device), grid)
