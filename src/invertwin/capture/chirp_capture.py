"""A recording with every chirp of its frames, and the radar that took it."""

from dataclasses import dataclass, replace

from jaxtyping import Complex
from torch import Tensor

from invertwin.errors import InputError
from invertwin.radar.motion import Chirps
from invertwin.radar.radar import Radar


@dataclass(frozen=True, eq=False)
class ChirpCapture:
    """Beat signals of every chirp, with everything needed to model them.

    Attributes:
        beat: Complex samples.
        device: The radar, with one pose per frame.
        chirps: Timing of the ramps.

    Raises:
        InputError: Samples that are not complex, or a shape that radar and timing do not have.
    """

    beat: Complex[Tensor, "frame chirp tx rx sample"]
    device: Radar
    chirps: Chirps

    def __post_init__(self) -> None:
        frames, *elements = self.device.shape
        expected = (frames, self.chirps.count, *elements)
        if not self.beat.is_complex() or tuple(self.beat.shape[:-1]) != expected:
            raise InputError(
                f"expected complex beat samples of shape {expected} × samples, got "
                f"{self.beat.dtype} of {tuple(self.beat.shape)}; use the radar and the timing "
                "that recorded them"
            )

    def radar(self) -> Radar:
        """The radar at the poses of the frames."""
        return self.device

    def loops(self, first: int, count: int) -> "ChirpCapture":
        """A part of the chirps of every frame.

        Args:
            first: Number of the first chirp, from 0.
            count: How many.
        """
        chirps = replace(self.chirps, count=count)
        return replace(self, beat=self.beat[:, first : first + count], chirps=chirps)
