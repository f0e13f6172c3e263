"""Raw samples chirp by chirp, and the settings they were recorded with."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge, Le
from jaxtyping import Complex, Float64
from scipy.signal import hilbert
from torch import Tensor

from invertwin import limits
from invertwin.capture.chirp_capture import ChirpCapture
from invertwin.checks import check_fields, check_shape, check_some, checked_number, checked_tensor
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar.boards import Mounting, TxRxArrays
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps, check_order
from invertwin.radar.waveform import FMCW, PhysicsWarning
from invertwin.refusals import refusal, refusal_text
from invertwin.runtime.memory import require_memory

CHIRP_DIMS = ("frame", "chirp", "tx", "rx", "sample")
IdleTime = Annotated[limits.NonNegative, limits.UsualValue("seconds", 5e-6, high=1.0)]


@dataclass(frozen=True)
class ChirpSettings:
    """Settings of a board that sends one FMCW profile with its transmitters in turn (TDM).

    Attributes:
        start_frequency: frequency at the start of the ramp, before the ADC starts [Hz].
        slope: slope of the ramp [Hz/s].
        sample_rate: output rate of the ADC [Hz].
        samples: number of samples per chirp and receiver.
        transmit_order: numbers from 1 of the transmitters, in the order of sending in one loop.
        receivers: numbers from 1 of the recorded receivers, ascending.
        loops: number of loops per frame; every transmitter sends once per loop.
        frames: number of frames; None = the recording goes on until it is stopped.
        frame_period: time between the starts of two frames [s]; None = not known.
        idle_time: pause before each ramp [s].
        adc_start_time: time from the start of the ramp to the first sample [s].
        ramp_end_time: duration of the ramp [s]; None = it ends with the last sample.
        real: whether the ADC records real samples instead of I and Q.
        swap_iq: whether Q comes before I in the file.
        bits: resolution of the ADC: 12, 14 or 16 bits.
        lanes: lanes of the LVDS link: 4 (xWR12xx, 14xx) or 2 (later devices); None = not known.
        channel_factors: calibration of the channels: factors of their beat signals, by the numbers
            of the elements [tx][rx][real, imaginary]; none = ones.
        range_bias: measured minus true range [m].

    Raises:
        InputError: a value out of range, a transmitter that sends twice per loop, a ramp that
            ends before its last sample, or factors of other channels.
    """

    start_frequency: limits.Frequency
    slope: Annotated[limits.Positive, limits.UsualValue("Hz/s", 60e12, low=1.0)]
    sample_rate: Annotated[limits.Positive, limits.UsualValue("Hz", 5e6, low=1.0)]
    samples: limits.CountOfTwo
    transmit_order: tuple[int, ...]
    receivers: tuple[int, ...]
    loops: limits.Count
    frames: limits.Count | None = None
    frame_period: limits.Positive | None = None
    idle_time: IdleTime = 0.0
    adc_start_time: IdleTime = 0.0
    ramp_end_time: limits.Positive | None = None
    real: bool = False
    swap_iq: bool = False
    bits: Annotated[int, limits.AllowedValues((12, 14, 16))] = 16
    lanes: Annotated[int, limits.AllowedValues((2, 4))] | None = None
    channel_factors: Sequence[Sequence[Sequence[float]]] = ()
    range_bias: Annotated[float, Ge(-limits.MAX_LENGTH), Le(limits.MAX_LENGTH)] = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        order, receivers = self.transmit_order, self.receivers
        if not order or min(order) < 1 or len(set(order)) < len(order):
            raise refusal("chirps.order", order)
        if not receivers or min(receivers) < 1 or list(receivers) != sorted(set(receivers)):
            raise refusal("chirps.receivers", receivers)
        last = self.adc_start_time + self.samples / self.sample_rate
        if self.ramp_end_time is not None and self.ramp_end_time < last * (1 - 1e-9):
            raise refusal("chirps.ramp", last, self.ramp_end_time)
        object.__setattr__(self, "channel_factors", tuple(self.channel_factors))
        if self.channel_factors:
            do = "give (real, imaginary) for every receiver of every transmitter of the device"
            table = checked_tensor(self.channel_factors, (None, None, 2), "channel factors", do)
            sizes = tuple(table.shape[:2])
            if sizes[0] < max(order) or sizes[1] < max(receivers):
                raise refusal("chirps.factors", max(order), max(receivers), sizes, do)

    @property
    def correction(self) -> Complex[Tensor, "tx rx #sample"]:
        """Factors of beat signals that remove the errors of the channels and of range."""
        tx, rx = torch.tensor(self.transmit_order), torch.tensor(self.receivers)
        ones = [[[1.0, 0.0]] * int(rx.max())] * int(tx.max())
        table = torch.tensor(self.channel_factors or ones, dtype=torch.float64)
        phase = -4 * torch.pi * self.range_bias / SPEED_OF_LIGHT * self.waveform.frequencies
        return torch.view_as_complex(table)[tx - 1][:, rx - 1, None] * torch.exp(1j * phase)

    @property
    def waveform(self) -> FMCW:
        """The sampled part of the ramp; its start frequency is that of the first sample."""
        duration = self.samples / self.sample_rate
        start = self.start_frequency + self.slope * self.adc_start_time
        return FMCW(start, self.slope * duration, duration, self.samples)

    @property
    def ramp_time(self) -> float:
        """From the start of a ramp to its end [s]."""
        return self.ramp_end_time or self.adc_start_time + self.samples / self.sample_rate

    @property
    def chirps(self) -> Chirps:
        """Timing of the ramps of a frame.

        For the transmitters of `ChirpData`, which are in the order of sending already.
        """
        return Chirps(self.loops, self.idle_time + self.ramp_time)


@dataclass(frozen=True, eq=False)
class ChirpData:
    """Raw samples of every chirp, the transmitters already separated.

    Attributes:
        samples: (frame, chirp, tx, rx, sample); chirps are loops, transmitters in the order of
            sending, receivers ascending. Real samples have no imaginary part. ADC counts where
            they come from a file.
        settings: settings of the recording; their `frames` is None or the number of frames.

    Raises:
        InputError: another shape than the settings say, or NaN.
    """

    samples: Complex[Tensor, "frame chirp tx rx sample"]
    settings: ChirpSettings

    def __post_init__(self) -> None:
        settings = self.settings
        elements = len(settings.transmit_order), len(settings.receivers)
        expected = (None, settings.loops, *elements, settings.samples)
        do = "data and settings must describe the same recording"
        check_shape(self.samples, expected, "samples (frame, chirp, tx, rx, sample)", do)
        check_some(self.samples, "frame of samples", do)
        if not bool((torch.view_as_real(self.samples).abs() <= limits.MAX_NUMBER).all()):
            raise InputError("expected finite samples, got NaN or infinity; drop those frames")

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return self.samples.shape[0]

    def warn_if_saturated(self) -> None:
        """Warn (`PhysicsWarning`) where samples are at the ends of the ADC's range."""
        parts = torch.view_as_real(self.samples)
        top = 2 ** (self.settings.bits - 1) - 1
        count = int(((parts >= top) | (parts <= -top - 1)).any(dim=-1).sum())
        if count:
            text = refusal_text("chirps.saturation", count, self.samples.numel(), top)
            warnings.warn(text, PhysicsWarning, stacklevel=3)

    @property
    def beat(self) -> Complex[Tensor, "frame chirp tx rx sample"]:
        """Complex beat signals: the samples or, of real ones, their analytic signal, corrected.

        An analytic signal holds for ranges below half of the waveform's `max_range`.
        """
        found = self.samples
        if self.settings.real:
            # Of each sample 8 bytes as a double, and 16 each of spectrum, halved spectrum, result.
            need, do = 56.0 * found.numel(), "give fewer frames"
            require_memory(need, "the analytic signal of real samples", do)
            found = torch.from_numpy(hilbert(found.real.numpy().astype(np.float64), axis=-1))
        if self.settings.channel_factors or self.settings.range_bias:
            found = (found * self.settings.correction).to(found.dtype)
        return found

    def to_chirp_capture(
        self,
        board: Mounting | TxRxArrays,
        positions: Float64[Tensor, "frame 3"] | None = None,
        rotations: Float64[Tensor, "frame 3 3"] | None = None,
    ) -> ChirpCapture:
        """Complex beat signals of every chirp, with the radar that recorded them.

        Args:
            board: whose elements recorded, those that the settings name; or the elements: of TX in
                the order of sending, and of RX as in `ChirpSettings.receivers`.
            positions: position of the radar in every frame [m]; None = the origin.
            rotations: orientation of the radar in every frame; None = axes of the world.

        Raises:
            InputError: another number of elements, or what `Mounting.arrays` refuses.
        """
        settings = self.settings
        if isinstance(board, Mounting):
            board = board.arrays(settings.transmit_order, settings.receivers)
        for name, array, count in zip(("TX", "RX"), board, self.samples.shape[2:4], strict=True):
            if len(array.positions) != count:
                raise refusal("chirps.elements", count, name, len(array.positions))
        if positions is None:
            positions = torch.zeros(self.frame_count, 3, dtype=torch.float64)
        radar = Radar(*board, settings.waveform, positions, rotations)
        timing = settings.chirps, settings.frame_period
        return ChirpCapture(self.beat, radar, *timing, real=settings.real, unit="count")


def adc_counts(
    beat: Complex[Tensor, "frame chirp tx rx sample"] | Complex[Tensor, "frame tx rx sample"],
    settings: ChirpSettings,
    full_scale: float,
    order: Sequence[int] | None = None,
) -> ChirpData:
    """Convert simulated samples to the counts that an ADC writes.

    Amplitudes up to ``full_scale`` fit, what is beyond is clipped (and warned of). Of complex
    samples a real ADC keeps the real part.

    Args:
        beat: simulated; without a chirp dimension every chirp of a frame is the same.
        settings: whose bits, loops and kind of samples are used.
        full_scale: amplitude of the largest count, in the units of ``beat``.
        order: order of ``beat``'s transmitters, counted from 0, as in `Chirps`; None = they
            are in the order of sending.

    Raises:
        InputError: a full scale that is not positive, a shape that the settings contradict, or
            an order of other transmitters.
    """
    checked_number(full_scale, "full scale", 0.0, open_low=True)
    if beat.ndim == 4:
        beat = beat[:, None].expand(-1, settings.loops, -1, -1, -1)
    if order is not None:
        beat = beat[:, :, check_order(order, beat.shape[2])]
    top = 2 ** (settings.bits - 1) - 1
    parts = torch.view_as_real(beat.to(torch.complex128).resolve_conj()) * (top / full_scale)
    parts = parts.round().clamp(-top - 1, top)
    if settings.real:
        parts = parts * torch.tensor([1.0, 0.0], dtype=torch.float64)
    data = ChirpData(torch.view_as_complex(parts.contiguous()).to(torch.complex64), settings)
    data.warn_if_saturated()
    return data


def shortest_loop(order: Sequence[int], loops: int) -> tuple[tuple[int, ...], int]:
    """Write a repeated order of transmitters as its shortest period and more loops.

    Args:
        order: transmitters in their order of sending.
        loops: number of repetitions of the order.
    """
    whole = tuple(order)
    for length in range(1, len(whole)):
        repeats = len(whole) // length
        if whole == whole[:length] * repeats:
            return whole[:length], loops * repeats
    return whole, loops


def make_settings(
    waveform: FMCW,
    transmitters: int | Sequence[int],
    receivers: int | Sequence[int],
    *,
    order: Sequence[int] | None = None,
    adc_start_time: float = 0.0,
    **others: Any,
) -> ChirpSettings:
    """Make settings for a waveform, all transmitters in turn and all receivers.

    Args:
        waveform: waveform of every ramp, as it is sampled.
        transmitters: number of transmitters, or their numbers from 1.
        receivers: number of receivers, or their numbers from 1.
        order: turns of the transmitters, counted from 0, as in `Chirps`; None = as they are given.
        adc_start_time: time from the start of the ramp to the first sample [s].
        others: further fields of `ChirpSettings`; one loop unless `loops` says otherwise.

    Raises:
        InputError: see `ChirpSettings`; an order of other transmitters.
    """
    senders, listeners = (
        range(1, given + 1) if isinstance(given, int) else given
        for given in (transmitters, receivers)
    )
    if order is not None:
        senders = [senders[turn] for turn in check_order(order, len(senders))]
    others.setdefault("loops", 1)
    rate = waveform.samples / waveform.duration
    nearest = round(rate)
    others |= {"transmit_order": tuple(senders), "receivers": tuple(listeners)}
    others |= {"samples": waveform.samples, "adc_start_time": adc_start_time}
    return ChirpSettings(
        start_frequency=waveform.start_frequency - waveform.slope * adc_start_time,
        slope=waveform.slope,
        sample_rate=float(nearest) if math.isclose(rate, nearest, rel_tol=1e-12) else rate,
        **others,
    )
