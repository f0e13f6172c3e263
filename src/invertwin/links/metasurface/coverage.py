"""Coverage of a room with a metasurface: the level of its worst receivers."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel import trace_paths
from invertwin.limits import UnitFraction
from invertwin.links.metasurface.panel import Metasurface, panel_response
from invertwin.links.responses import frequency_response
from invertwin.scene import Scene

_WEAK = 4.0  # times the share of the worst: receivers to which the panel matters
_FLOOR = 1e-20  # path gain that is added, so that decibels stay finite


def soft_quantile(values: Float64[Tensor, " n"], share: float, width: float) -> Float64[Tensor, ""]:
    """Smooth quantile: the level below which a share of the values lies.

    The level q solves mean σ((q − v)/width) = share; width 0 gives the exact quantile.

    Args:
        values: Values, at least one.
        share: Share between 0 and 1.
        width: Width in the unit of the values.
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
    """Field at receivers, over the paths of the scene and over a panel.

    Powers of the two are added, which is the mean over the fringes of a few wavelengths between
    them; the paths of the scene add up coherently among themselves.

    Attributes:
        scene: Propagation environment.
        tx: The transmitter [m].
        receivers: [m].
        frequency: [Hz].
        direct: Path gain without a panel.
        share: Share of the receivers that count as the worst.
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
        """Trace the paths of the scene without a panel.

        Args:
            scene: Propagation environment.
            tx: The transmitter [m].
            receivers: [rx, 3] [m].
            frequency: [Hz].
            share: Share of the receivers that count as the worst.
            depth, edges: Depth and edges of the paths, see ``trace_paths``.
            seed: Seed of the rays that find them.
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
            width: Additional width of penumbras on the panel [m].
            boundary: False = derivatives at fixed visibility.
        """
        link = self.tx[None], self.receivers, self.frequency
        over = panel_response(self.scene, panel, *link, blur=width, boundary=boundary)[0]
        return self.direct + over.real.square() + over.imag.square()

    def part(self, rows: Tensor | slice) -> "Coverage":
        """Select some of the receivers.

        Args:
            rows: Indices of the receivers.
        """
        return replace(self, receivers=self.receivers[rows], direct=self.direct[rows])

    def aim(
        self, panel: Metasurface, width: float = 0.0, boundary: bool = True, softness: float = 0.0
    ) -> Float64[Tensor, ""]:
        """Return ``worst`` of ``gain``; receivers with a high level are taken without the panel.

        Args:
            panel: The metasurface.
            width, boundary: See ``gain``.
            softness: See ``soft_quantile`` [dB].
        """
        weak = self.direct <= torch.quantile(self.direct, min(1.0, _WEAK * self.share))
        gain = self.part(weak).gain(panel, width, boundary)
        return self.worst(self.direct.masked_scatter(weak, gain), softness)

    def worst(self, gain: Tensor, softness: float = 0.0) -> Float64[Tensor, ""]:
        """Level below which the worst share of receivers lies [dB].

        Args:
            gain: Result of ``gain``.
            softness: See ``soft_quantile`` [dB].
        """
        return soft_quantile(10 * (gain + _FLOOR).log10(), self.share, softness)
