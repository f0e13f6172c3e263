"""Unknowns of a radar: modules that map a radar to a radar."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from invertwin.radar.radar import Radar
from invertwin.scene.parameters import RadarPose as RadarPose


class RangeBias(nn.Module):
    """All measured ranges are too large by this.

    Attributes:
        bias: Parameter [m].
    """

    def __init__(self, initial: float = 0.0) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.tensor(initial, dtype=torch.float64))

    def forward(self, radar: Radar) -> Radar:
        """The radar with the bias added."""
        return replace(radar, range_bias=radar.range_bias + self.bias)

    def values(self) -> dict[str, Tensor]:
        """The bias by name, for progress and reports."""
        return {"range_bias": self.bias.detach().clone()}


class ClockOffset(nn.Module):
    """The track's clock is ahead of the radar's by this much more than the capture says.

    Attributes:
        shift: Parameter [s].
    """

    def __init__(self, positions: Callable[[Tensor], Tensor], initial: float = 0.0) -> None:
        super().__init__()
        self._positions = positions
        self.shift = nn.Parameter(torch.tensor(initial, dtype=torch.float64))

    def forward(self, radar: Radar) -> Radar:
        """The radar at the positions of the shifted times."""
        return replace(radar, positions=self._positions(self.shift))

    def values(self) -> dict[str, Tensor]:
        """The shift by name, for progress and reports."""
        return {"clock_shift": self.shift.detach().clone()}
