"""A recording with every chirp of its frames, and the radar that took it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex, Float64
from torch import Tensor

from invertwin.capture.capture import BeatUnit, Capture
from invertwin.checks import check_shape
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.refusals import refusal


@dataclass(frozen=True, eq=False)
class ChirpCapture:
    """Beat signals of every chirp, with everything needed to model them.

    Attributes:
        beat: Complex samples.
        device: The radar, with one pose per frame.
        chirps: Timing of the ramps.
        frame_period: Time between the starts of two frames [s]; None = not known.
        real: Whether the samples were real: their analytic signal holds up to half the range.
        moving: Whether its echoes move, and so fade in the mean of a frame's chirps.
        unit: unit of the samples: "1", received over sent, or "count", of a file.

    Raises:
        InputError: Samples that are not complex, or a shape that radar and timing do not have.
    """

    beat: Complex[Tensor, "frame chirp tx rx sample"]
    device: Radar
    chirps: Chirps
    frame_period: float | None = None
    real: bool = False
    moving: bool = False
    unit: BeatUnit = "1"

    def __post_init__(self) -> None:
        frames, *elements = self.device.shape
        expected = (frames, self.chirps.count, *elements)
        shape = tuple(self.beat.shape)
        if not self.beat.is_complex() or shape[:-1] != expected:
            raise refusal("chirp_capture.samples", expected, self.beat.dtype, shape)

    def radar(self) -> Radar:
        """The radar at the poses of the frames."""
        return self.device

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return self.beat.shape[0]

    @property
    def max_range(self) -> float:
        """Range up to which the samples mean something [m]."""
        return self.device.range_limits[1] / (2 if self.real else 1)

    def merge_single_ramps(self) -> "ChirpCapture":
        """Return frames of one ramp, as vital signs are recorded, as one train of ramps.

        The frames of a radar that stands still and whose frame period is known have range rates
        then. Other recordings are returned as they are.
        """
        still = bool((self.device.positions == self.device.positions[:1]).all())
        if self.frame_period is None or self.chirps.count > 1 or self.frame_count < 2 or not still:
            return self
        # Transmitters in turn send almost at once, compared with the frame period.
        chirps = Chirps(self.frame_count, self.frame_period, tdm=False)
        beat, device = self.beat.movedim(0, 1), self.device.frames([0])
        return replace(self, beat=beat, device=device, chirps=chirps, frame_period=None)

    def select_chirps(self, first: int, count: int) -> "ChirpCapture":
        """A part of the chirps of every frame.

        Args:
            first: Number of the first chirp, from 0.
            count: Number of them.
        """
        chirps = replace(self.chirps, count=count)
        return replace(self, beat=self.beat[:, first : first + count], chirps=chirps)

    def frames(self, numbers: Sequence[int]) -> "ChirpCapture":
        """Only these frames, counted from 0.

        Raises:
            InputError: A frame that it does not have.
        """
        wrong = [number for number in numbers if not 0 <= number < self.frame_count]
        if wrong:
            raise refusal("chirp_capture.frame", self.frame_count, wrong[0])
        return replace(self, beat=self.beat[list(numbers)], device=self.device.frames(numbers))

    def with_poses(
        self,
        positions: Float64[Tensor, "frame 3"],
        rotations: Float64[Tensor, "frame 3 3"] | None = None,
    ) -> "ChirpCapture":
        """The recording of a radar at these poses.

        Args:
            positions: Position of the radar in every frame [m].
            rotations: Orientation of the radar in every frame; None = axes of the world.

        Raises:
            InputError: Another number of positions than of frames.
        """
        check_shape(positions, (self.frame_count, 3), "positions along frame", "give one each")
        return replace(self, device=replace(self.device, positions=positions, rotations=rotations))

    def to_capture(self, chirp: int | str = "mean") -> Capture:
        """One beat signal per frame and channel, for a scene that stands still within a frame.

        A static scene is the same in every chirp, so the mean over the chirps is the recording with
        less noise; echoes that move by λ/2 or more during a frame fade in it, by 13 dB or more. One
        chosen chirp keeps them, but its transmitters still send one after the other: what moves has
        phase steps from TX to TX, which `invertwin.radar.compensate_tdm` takes out of whole frames.

        Args:
            chirp: "mean", or the number from 0 of the chirp to take.

        Raises:
            InputError: A chirp that does not exist, or the mean of a recording of moving targets.
        """
        count = self.chirps.count
        if chirp == "mean":
            if self.moving:
                raise refusal("chirp_capture.mean")
            beat = self.beat.mean(dim=1)
        elif isinstance(chirp, bool) or not isinstance(chirp, int) or not 0 <= chirp < count:
            raise refusal("chirp_capture.chirps", count - 1, chirp)
        else:
            beat = self.beat[:, chirp]
        times = None
        if self.frame_period is not None:
            times = torch.arange(self.frame_count, dtype=torch.float64) * self.frame_period
        return Capture.from_beat(beat, self.device, times, unit=self.unit)
