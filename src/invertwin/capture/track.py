"""Tracks: where the radar was over time, by the clock of the tracking system."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.checks import checked_ascending, checked_tensor
from invertwin.refusals import refusal


@dataclass(frozen=True, eq=False)
class Track:
    """A measured path of the radar.

    Attributes:
        times: ascending, on the clock of the tracking system [s].
        positions: world position of the radar at these times [m].

    Raises:
        InputError: wrong shapes, NaN, or times that do not ascend.
    """

    times: Float64[Tensor, " sample"]
    positions: Float64[Tensor, "sample 3"]

    def __post_init__(self) -> None:
        do = "give one position per time, and drop samples that are not finite"
        times = checked_ascending(self.times, "track times", f"sort the track by time, and {do}")
        checked_tensor(self.positions, (len(times), 3), "track positions", do)

    def interpolate(self, times: Float64[Tensor, " frame"]) -> Float64[Tensor, "frame 3"]:
        """Interpolate positions linearly at these times; differentiable with respect to the times.

        Raises:
            InputError: a time before the first or after the last sample.
        """
        first, last = float(self.times[0]), float(self.times[-1])
        asked = times.detach()
        if bool((asked < first).any()) or bool((asked > last).any()):
            raise refusal("track.times", first, last, asked.min(), asked.max())
        after = torch.searchsorted(self.times, asked).clamp(1, len(self.times) - 1)
        start, end = self.times[after - 1], self.times[after]
        part = (times - start) / (end - start)
        return torch.lerp(self.positions[after - 1], self.positions[after], part[:, None])
