"""Modules Radar → Radar that can be fitted: pose, trajectory, range bias and clock offset."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.checks import checked_count, checked_number
from invertwin.errors import InputError
from invertwin.limits import MAX_LENGTH, Axes, Count, Positive
from invertwin.radar.radar import Radar
from invertwin.scene.parameters import Coordinate, RigidMotion, axes_mask, free_part


class RadarPose(RigidMotion):
    """Rigid transform of all poses of a radar, see `Radar.transform_rigidly`."""

    moved = "radar"

    def forward(self, radar: Radar) -> Radar:
        """Return the moved radar."""
        return radar.transform_rigidly(self.rotation_matrix, self.shift)


class RadarTrajectory(nn.Module):
    """Correction of a radar trajectory by an odometry error: a random walk from the first frame.

        d(0) = 0,   d(k) = d(k−1) + drift · z_k

    at `steps` + 1 knots at evenly spaced frames, linear between them, in the world; z are standard
    normal. So the odometry is the prior: `inversion.LatentNorm(module, weight)` adds ½ weight |z|²
    to the loss. Rotations and the range origin stay as recorded.

    Args:
        steps: number of steps of the walk, at most one less than the number of frames.
        drift: standard deviation of a step along each axis [m].
        axes: free world axes.

    Attributes:
        latent: parameter [step, 3], z in standard deviations.
    """

    def __init__(self, steps: Count, drift: Positive, axes: Axes = "xyz") -> None:
        super().__init__()
        count = checked_count(steps, "steps", 1)
        self.drift = checked_number(drift, "drift [m]", 0.0, open_low=True)
        self.latent = nn.Parameter(torch.zeros(count, 3, dtype=torch.float64))
        self._axes = axes_mask(axes)

    def displacements(self, frames: int) -> Float64[Tensor, "frame 3"]:
        """Return the displacements of the frames from odometry [m].

        Args:
            frames: number of frames.

        Raises:
            InputError: fewer frames than knots.
        """
        steps = len(self.latent)
        if frames <= steps:
            raise InputError(
                f"expected at most {frames - 1} steps for {frames} frames, got {steps}; give fewer"
            )
        walk = (self.drift * free_part(self.latent, self._axes)).cumsum(0)
        knots = torch.cat([torch.zeros_like(walk[:1]), walk])
        rows = nn.functional.interpolate(knots.T[None], frames, mode="linear", align_corners=True)
        return rows[0].T

    def forward(self, radar: Radar) -> Radar:
        """Return the radar on the corrected trajectory."""
        return replace(radar, positions=radar.positions + self.displacements(radar.frame_count))

    def values(self) -> dict[str, Tensor]:
        """Return displacements of the knots after the first one [m] by name, for progress and
        reports.
        """
        return {"radar.displacements": (self.drift * self.latent.detach()).cumsum(0)}

    def coordinates(self) -> list[Coordinate]:
        """Return every step of the walk along the free axes."""
        found = []
        for number in range(len(self.latent)):
            for column in torch.nonzero(self._axes)[:, 0].tolist():
                change = torch.zeros_like(self.latent.detach())
                change[number, column] = 1 / self.drift
                name = f"radar.step{number + 1}.{'xyz'[column]}"
                found.append(Coordinate(name, "m", {"latent": change}))
        return found


class RangeBias(nn.Module):
    """Bias of all ranges of the surrogate.

    Attributes:
        bias: parameter [m].
    """

    def __init__(self, initial: float = 0.0) -> None:
        super().__init__()
        start = checked_number(initial, "range bias [m]", -MAX_LENGTH, MAX_LENGTH)
        self.bias = nn.Parameter(torch.tensor(start, dtype=torch.float64))

    def forward(self, radar: Radar) -> Radar:
        """Return the radar with the bias added to its own."""
        return replace(radar, range_bias=radar.range_bias + self.bias)

    def values(self) -> dict[str, Tensor]:
        """Return the bias [m] by name, for progress and reports."""
        return {"range_bias": self.bias.detach().clone()}

    def coordinates(self) -> list[Coordinate]:
        """Return the bias."""
        return [Coordinate("range_bias", "m", {"bias": torch.ones_like(self.bias)})]


class ClockOffset(nn.Module):
    """Offset between the clocks of the track and the radar.

    Attributes:
        shift: parameter [s].
    """

    def __init__(self, positions: Callable[[Tensor], Tensor], initial: float = 0.0) -> None:
        """Start from an offset `initial`.

        Args:
            positions: function of a clock shift [s] that returns positions [frame, 3] [m],
                differentiable; such as `Capture.positions`.
            initial: initial shift [s].
        """
        super().__init__()
        self._positions = positions
        start = checked_number(initial, "clock offset [s]", -1.0, 1.0)
        self.shift = nn.Parameter(torch.tensor(start, dtype=torch.float64))

    def forward(self, radar: Radar) -> Radar:
        """Return the radar at its positions at the shifted times."""
        return replace(radar, positions=self._positions(self.shift))

    def values(self) -> dict[str, Tensor]:
        """Return the shift [s] by name, for progress and reports."""
        return {"clock_shift": self.shift.detach().clone()}

    def coordinates(self) -> list[Coordinate]:
        """Return the shift."""
        return [Coordinate("clock_shift", "s", {"shift": torch.ones_like(self.shift)})]
