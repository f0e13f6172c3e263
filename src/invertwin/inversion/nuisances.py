"""What a measurement gets wrong about itself and the fit may find: range bias, clock offset."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from invertwin.capture.capture import Capture
from invertwin.radar.radar import Radar


class RangeBias(nn.Module):
    """All measured ranges are too large by this.

    Attributes:
        bias: Parameter [m].
    """

    applies_to = "range"

    def __init__(self, initial: float = 0.0) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.tensor(initial, dtype=torch.float64))

    def forward(self) -> Tensor:
        """The bias [m]."""
        return self.bias

    def values(self) -> dict[str, Tensor]:
        """By name, for progress and reports."""
        return {"range_bias": self.bias.detach().clone()}


class ClockOffset(nn.Module):
    """The track's clock is ahead of the radar's by this much more than the capture says.

    Attributes:
        shift: Parameter [s].
    """

    applies_to = "radar"

    def __init__(self, capture: Capture, initial: float = 0.0) -> None:
        super().__init__()
        self._capture = capture
        self.shift = nn.Parameter(torch.tensor(initial, dtype=torch.float64))

    def forward(self, radar: Radar) -> Radar:
        """The radar at the positions of the shifted times."""
        return replace(radar, positions=self._capture.positions(self.shift))

    def values(self) -> dict[str, Tensor]:
        """By name, for progress and reports."""
        return {"clock_shift": self.shift.detach().clone()}
