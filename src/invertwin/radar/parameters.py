"""Modules Radar → Radar that can be fitted: pose, range bias and clock offset."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from invertwin.radar.radar import Radar
from invertwin.scene.parameters import Coordinate, RigidMotion


class RadarPose(RigidMotion):
    """Turns and moves all poses of a radar together, as `Radar.moved` defines it."""

    def forward(self, radar: Radar) -> Radar:
        """The moved radar."""
        return radar.moved(self.rotation_matrix, self.shift)

    def values(self) -> dict[str, Tensor]:
        """Translation [m] and rotation vector [rad] by name, for progress and reports."""
        return self.named_values("radar")

    def coordinates(self) -> list[Coordinate]:
        """Place and turn of the radar, as far as they are free."""
        return self.named_coordinates("radar")


class RangeBias(nn.Module):
    """Adds a bias to all ranges that the surrogate shows.

    Attributes:
        bias: parameter [m].
    """

    def __init__(self, initial: float = 0.0) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.tensor(initial, dtype=torch.float64))

    def forward(self, radar: Radar) -> Radar:
        """The radar with the bias added to its own."""
        return replace(radar, range_bias=radar.range_bias + self.bias)

    def values(self) -> dict[str, Tensor]:
        """Bias [m] by name, for progress and reports."""
        return {"range_bias": self.bias.detach().clone()}

    def coordinates(self) -> list[Coordinate]:
        """The bias."""
        return [Coordinate("range_bias", "m", {"bias": torch.ones_like(self.bias)})]


class ClockOffset(nn.Module):
    """Shifts the clock of the track against the radar's.

    Attributes:
        shift: parameter [s].
    """

    def __init__(self, positions: Callable[[Tensor], Tensor], initial: float = 0.0) -> None:
        """Shift the clock, by `initial` at the start.

        Args:
            positions: positions [frame, 3] in metres at a shift of the clock [s], differentiable;
                such as `Capture.positions`.
            initial: [s].
        """
        super().__init__()
        self._positions = positions
        self.shift = nn.Parameter(torch.tensor(initial, dtype=torch.float64))

    def forward(self, radar: Radar) -> Radar:
        """The radar at its positions of the shifted times."""
        return replace(radar, positions=self._positions(self.shift))

    def values(self) -> dict[str, Tensor]:
        """Shift [s] by name, for progress and reports."""
        return {"clock_shift": self.shift.detach().clone()}

    def coordinates(self) -> list[Coordinate]:
        """The shift."""
        return [Coordinate("clock_shift", "s", {"shift": torch.ones_like(self.shift)})]
