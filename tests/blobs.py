"""A model without rays, whose statistics are known: a blob of power at the place of an object."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from invertwin.channel import Sampling
from invertwin.forward_model import ForwardModel
from invertwin.inversion import SpectrumLoss
from invertwin.scene import Scene, sphere
from scenes import thing

LAW = SpectrumLoss("likelihood", levels=1, floor=1e-4, background="none")
BINS = torch.linspace(-2.0, 2.0, 200, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Blob(ForwardModel):
    """Power over y: a Gaussian about the object's centre, over a level; speckle bin by bin.

    Attributes:
        frames: All alike.
        known: Whether the model gives looks.
        even: The sign of y has no effect.
        sampling: Unused.
    """

    frames: int = 4
    known: bool = True
    even: bool = False
    sampling: Sampling = Sampling(depth=1, boundary=False)

    def predict(self, scene: Scene, sensor: Any, seed: int) -> Tensor:
        y = scene["ball"].center[1]
        power = 0.05 + torch.exp(-((BINS - y) ** 2) / 0.08)
        if self.even:
            power = power + torch.exp(-((BINS + y) ** 2) / 0.08)
        return power.expand(self.frames, -1)[..., None, None]

    def observe(self, recording: Tensor) -> Tensor:
        return recording

    def realisations(
        self, scene: Scene, sensor: Any, seed: int
    ) -> Callable[[int, float], Tensor] | None:
        if not self.known:
            return None
        mean = self.predict(scene, sensor, seed)

        def look(number: int, noise: float) -> Tensor:
            torch.manual_seed(number)
            return (mean + noise) * torch.empty_like(mean).exponential_()

        return look


def scene(y: float = 0.0) -> Scene:
    """A ball at y."""
    return Scene({"ball": thing(sphere(0.1, 1), (1.0, y, 0.0))})


def deviation(y: float, frames: int) -> float:
    """The least standard deviation of y that speckle allows: the Cramér–Rao bound."""
    place = torch.tensor(y, dtype=torch.float64, requires_grad=True)

    def level(value: Tensor) -> Tensor:
        return (0.05 + torch.exp(-((BINS - value) ** 2) / 0.08)).log()

    slopes = torch.autograd.functional.jacobian(level, place)
    assert isinstance(slopes, Tensor)
    # A fitted gain takes what is common to all bins.
    return float((frames * (slopes - slopes.mean()).square().sum()).rsqrt())


@dataclass(frozen=True, eq=False)
class Needle(Blob):
    """Shows where the object's own y axis points, but hardly at which end."""

    def predict(self, scene: Scene, sensor: Any, seed: int) -> Tensor:
        way = scene["ball"].transform[:3, 1]
        power = 0.05 + sum(torch.exp(-((BINS - s * way[0]) ** 2) / 0.08) for s in (1.0, -1.0))
        assert isinstance(power, Tensor)
        return power.expand(self.frames, -1)[..., None, None]


@dataclass(frozen=True, eq=False)
class Ripple(Blob):
    """Shows the place of the object up to whole periods, to some 0.05 m.

    Attributes:
        period: [m].
    """

    period: float = 0.2

    def predict(self, scene: Scene, sensor: Any, seed: int) -> Tensor:
        turn = 2 * torch.pi * scene["ball"].center[1] / self.period
        power = 1 + 0.16 * self.period * torch.sin(turn + torch.pi * BINS)
        return power.expand(self.frames, -1)[..., None, None]


@dataclass(frozen=True, eq=False)
class Faces(Blob):
    """Shows two faces of the ball along y: one blob at each, the far one dimmer.

    Attributes:
        share: of the far blob in power.
        size: factor on the ball's size in the data.
    """

    share: float = 0.0
    size: float = 1.0

    def predict(self, scene: Scene, sensor: Any, seed: int) -> Tensor:
        y = scene["ball"].vertices[:, 1]
        middle, half = scene["ball"].center[1], 0.5 * self.size * (y.max() - y.min())
        near, far = (torch.exp(-((BINS - middle - s * half) ** 2) / 0.02) for s in (-1.0, 1.0))
        return (0.05 + near + self.share * far).expand(self.frames, -1)[..., None, None]
