"""Front-end impairments of beat signals of frames or chirp trains.

Each impairment is off by default.

The order is that of the hardware: phase noise and leakage before the mixer, gain and phase errors
of the channels, thermal noise, then the converter.
"""

import math
import warnings
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from typing import Annotated, TypeAlias

import numpy as np
import torch
from annotated_types import Ge, Gt, Le, Lt
from jaxtyping import Complex, Complex128, Float64
from torch import Tensor

from invertwin.channel import Paths
from invertwin.checks import CheckedFields, check_fields, checked_number, refuse_derivatives
from invertwin.errors import InputError
from invertwin.limits import RADIANS, Decibels, NonNegative, Positive, UsualValue
from invertwin.radar.radar import Radar, require_sampled_waveform
from invertwin.radar.signal.chirps import Chirps, moving_beat
from invertwin.radar.signal.range_profile import add_noise, beat_signal, check_paths
from invertwin.radar.waveform import FMCW, PhysicsWarning, SteppedFrequency

# Phase step of the highest offset between delays of the residual: the error of linear
# interpolation is below 1 %.

_Beat: TypeAlias = Complex128[Tensor, "frame *chirp tx rx sample"]
_DELAY_STEP = 0.25
# Frequency resolution relative to that of one sweep, so that noise is not periodic in it.
_OSCILLATOR_OVERSAMPLING = 4

Level = Annotated[float, Gt(-400), Lt(0)]  # relative to the transmitted power [dB]


@dataclass(frozen=True)
class PhaseNoise:
    """Phase noise of the oscillator of both transmitter and mixer.

    The level is linear over the logarithm of the offset between the points, and constant beyond the
    first and the last one. A single point means −20 dB per decade.

    Attributes:
        offsets: ascending offsets from the carrier [Hz].
        levels: single-sideband levels L(f) [dBc/Hz].

    Raises:
        InputError: Offsets that do not ascend from above zero, another number of levels, or
            levels of 0 dBc/Hz and more.
    """

    offsets: tuple[Positive, ...]
    levels: tuple[Level, ...]

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.offsets or any(a >= b for a, b in pairwise(self.offsets)):
            raise InputError(
                f"expected ascending offsets > 0, got {self.offsets}; give them in Hz, such as "
                "(1e5, 1e6)"
            )
        if len(self.levels) != len(self.offsets):
            raise InputError(
                f"expected {len(self.offsets)} levels, got {len(self.levels)}; "
                "give one level per offset"
            )

    def density(self, offset: Float64[Tensor, " offset"]) -> Float64[Tensor, " offset"]:
        """Return the one-sided S_φ(f) = 2 · 10^(L/10) [rad²/Hz] at an offset f > 0 [Hz]."""
        if len(self.offsets) == 1:
            level = self.levels[0] - 20 * torch.log10(offset / self.offsets[0])
        else:
            points = np.log10(np.asarray(self.offsets))
            level = torch.from_numpy(np.interp(offset.log10().cpu(), points, self.levels))
            level = level.to(offset)
        return 2 * 10 ** (level / 10)


@dataclass(frozen=True)
class Leakage(CheckedFields):
    """Direct path from transmitters to receivers, equal in every channel.

    Attributes:
        delay: delay [s].
        level_db: received over transmitted power [dB].

    Raises:
        InputError: A delay implausible for a board, or more received than transmitted power.
    """

    delay: Annotated[NonNegative, UsualValue("seconds", 1e-9, high=1e-6)]
    level_db: Level


@dataclass(frozen=True)
class ADC(CheckedFields):
    """Converter of I and Q: uniform steps, two's complement codes, clipping.

    Attributes:
        bits: resolution of each of the two, 2 to 32 bits.
        full_scale: amplitude of the most negative code, in the units of the beat signal, √(received
            over transmitted power).

    Raises:
        InputError: Impossible bits or full scale.
    """

    bits: Annotated[int, Ge(2), Le(32)]
    full_scale: Positive

    @property
    def step(self) -> float:
        """Step of one code, 2 · full_scale / 2^bits."""
        return 2 * self.full_scale / 2**self.bits


@dataclass(frozen=True)
class Impairments:
    """Impairments of a recording. The defaults add none.

    Attributes:
        phase_noise: Phase noise of the common oscillator.
        leakage: Direct path from transmitters to receivers.
        gain_std_db: Standard deviation of the channels' gains [dB].
        phase_std: Standard deviation of the channels' phases [rad].
        snr_db: Thermal noise, relative to the mean power of the signal, leakage included [dB].
        noise_figure_db: Thermal noise of a receiver instead [dB].
        transmit_power: Power of one transmitter, for the noise figure [W].
        adc: Converter.

    Raises:
        InputError: Negative deviations, two levels of thermal noise, or impossible ones.
    """

    phase_noise: PhaseNoise | None = None
    leakage: Leakage | None = None
    gain_std_db: NonNegative = 0.0
    phase_std: Annotated[NonNegative, RADIANS] = 0.0
    snr_db: Decibels | None = None
    noise_figure_db: NonNegative | None = None
    transmit_power: Positive = 0.01
    adc: ADC | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if self.snr_db is not None and self.noise_figure_db is not None:
            raise InputError(
                f"expected snr_db or noise_figure_db, got both, {self.snr_db} and "
                f"{self.noise_figure_db}; give one of them"
            )

    def record(
        self, paths: Paths, radar: Radar, *, seed: int, chirps: Chirps | None = None
    ) -> _Beat:
        """Simulate the paths with these impairments, in single ramps or a chirp train.

        Each impairment draws from its own stream of the seed, so adding one does not change the
        random numbers of the others. Channel errors and leakage are constant over chirps. Thermal
        noise is independent in every sample. The oscillator is continuous over a train
        (``residual_phase``).

        Args:
            paths: field paths.
            radar: radar with samples.
            seed: Seed of all random numbers.
            chirps: timing of a train, as for ``moving_beat``; None = one ramp per frame.

        Raises:
            InputError: As ``noisy_oscillator_beat``, ``add_noise`` and ``quantize``.
        """
        if self.phase_noise is not None:
            stream = _streams(seed)[0]
            beat = noisy_oscillator_beat(paths, radar, self.phase_noise, seed=stream, chirps=chirps)
        else:
            beat = _ideal_beat(paths, radar, chirps)
        return self._add_receiver_effects(beat, radar, seed, chirps)

    def apply(self, beat: _Beat, radar: Radar, *, seed: int) -> _Beat:
        """Add all impairments except phase noise to a beat signal of frames or trains.

        Args:
            beat: signal without impairments.
            radar: radar that records it.
            seed: Seed of all random numbers.

        Raises:
            InputError: Phase noise, which depends on the paths; otherwise as ``record``.
        """
        self.check_applicable()
        return self._add_receiver_effects(beat, radar, seed, None)

    def check_applicable(self) -> None:
        """Raise if ``apply`` cannot add these impairments, because they need the paths."""
        if self.phase_noise is not None:
            raise InputError(
                "expected impairments of a finished beat signal, got phase noise, which depends on "
                "the delay of each path; use record(paths, radar, chirps=...), without retracing"
            )

    def _add_receiver_effects(
        self, beat: Tensor, radar: Radar, seed: int, chirps: Chirps | None
    ) -> _Beat:
        streams = _streams(seed)
        if self.leakage is not None:
            if radar.range_origin is not None:
                raise InputError(
                    "expected no leakage with a range_origin, got both; leave one out: motion "
                    "compensation spreads leakage over the frames"
                )
            direct = leakage_signal(self.leakage, radar)
            if self.phase_noise is not None:
                residual = residual_phase(
                    self.phase_noise, radar, self.leakage.delay, seed=streams[0], chirps=chirps
                )
                direct = direct * _phasor(residual).unsqueeze(-2)
            beat = beat + direct.to(beat.device)
        if self.gain_std_db > 0 or self.phase_std > 0:
            factors = channel_errors(radar, self.gain_std_db, self.phase_std, seed=streams[1])
            beat = beat * factors[..., None].to(beat.device)
        if self.snr_db is not None or self.noise_figure_db is not None:
            names = ("snr_db", "noise_figure_db", "transmit_power")
            levels = {name: getattr(self, name) for name in names}
            beat = add_noise(beat, radar, seed=streams[2], **levels)
        return beat if self.adc is None else quantize(beat, radar, self.adc)


def _streams(seed: int) -> list[int]:
    return [int(s) for s in np.random.SeedSequence(seed).generate_state(3, np.uint32)]


def noisy_oscillator_beat(
    paths: Paths, radar: Radar, noise: PhaseNoise, *, seed: int, chirps: Chirps | None = None
) -> _Beat:
    """Compute beat signals with one oscillator of phase noise φ for transmitter and mixer.

        s'[n] = Σ s_i[n] exp(j (φ(t_n) − φ(t_n − τ_i)))

    with s_i the beat signal of one path. Noise common to echo and mixer cancels. The factor is
    computed at delays dense enough for linear interpolation. In a train of chirps this factor uses
    a path's delay τ at the start of the frame.

    Args:
        paths: field paths.
        radar: An FMCW or stepped frequency radar.
        noise: phase noise.
        seed: seed of the noise, see ``residual_phase``.
        chirps: timing of a train; None = one ramp per frame.

    Raises:
        InputError: As ``beat_signal`` and ``residual_phase``.
    """
    waveform = _require_time_samples(radar)
    check_paths(paths, radar, waveform)

    if len(paths) == 0:
        return _ideal_beat(paths, radar, chirps)
    first, last = (float(end) for end in paths.delay.detach().aminmax())
    highest = 0.5 / float(waveform.sample_times[1])
    intervals = math.ceil((last - first) * 2 * math.pi * highest / _DELAY_STEP)
    spacing = (last - first) / max(intervals, 1)
    place = (paths.delay - first) / spacing if intervals else torch.zeros_like(paths.delay)

    def beat_near_node(node: int) -> Tensor:
        """Return the contribution of the paths near one of the delays."""
        weight = (1 - (place - node).abs()).clamp_min(0)
        chosen = weight > 0
        part = paths.select(chosen)
        with warnings.catch_warnings():
            # All paths have been checked together.
            warnings.simplefilter("ignore", PhysicsWarning)
            part = part.scale_fields(weight[chosen])
            beat = _ideal_beat(part, radar, chirps)
        residual = residual_phase(noise, radar, first + node * spacing, seed=seed, chirps=chirps)
        return beat * _phasor(residual).unsqueeze(-2).to(beat.device)

    return reduce(torch.add, map(beat_near_node, range(intervals + 1)))


def residual_phase(
    noise: PhaseNoise, radar: Radar, delay: float, *, seed: int, chirps: Chirps | None = None
) -> Float64[Tensor, "frame *chirp tx sample"]:
    """Compute the phase noise after mixing with an echo, φ(t_n) − φ(t_n − τ) [rad].

    Its one-sided density is ``S_φ(f) · 4 sin²(πfτ)``. Offsets reach up to half the sampling
    rate, where the IF filter ends. The same seed gives the same φ at every delay.

    Single sweeps have independent φ in every frame and transmitter, without components slower than
    four sweeps. In a chirp train one oscillator runs through the frame, pauses included.
    Time-multiplexed transmitters have φ at their own times; simultaneous transmitters share φ. Slow
    components are correlated between chirps, down to a frequency of 1 / (4 frames). The starts of
    ramps are rounded to the sampling interval.

    Args:
        noise: phase noise φ.
        radar: An FMCW or stepped frequency radar.
        delay: delay τ of the echo [s].
        seed: Seed of φ, which is independent for each frame.
        chirps: timing of a train; None = one ramp per frame.

    Raises:
        InputError: A waveform whose samples are not taken in time.
    """
    waveform = _require_time_samples(radar)
    interval = float(waveform.sample_times[1])
    transmitters, samples = radar.shape[1], waveform.samples
    if chirps is None:
        runs = (radar.frame_count, transmitters)
        return _oscillator(noise, interval, delay, seed, runs, samples)[..., :samples]
    starts = (chirps.times(transmitters) / interval).round().long()
    length = int(starts.max()) + samples
    phase = _oscillator(noise, interval, delay, seed, (radar.frame_count,), length)
    return phase[:, starts[..., None] + torch.arange(samples)]


def _oscillator(
    noise: PhaseNoise, interval: float, delay: float, seed: int, runs: tuple[int, ...], samples: int
) -> Float64[Tensor, "*run sample"]:
    """Return φ(t) − φ(t − τ) at the sampling rate, for independent runs of a minimum length."""
    length = _OSCILLATOR_OVERSAMPLING * samples
    spacing = 1 / (length * interval)
    offsets = spacing * torch.arange(1, length // 2, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    lines = torch.randn((*runs, len(offsets)), dtype=torch.complex128, generator=generator)
    lines = lines * (2 * spacing * noise.density(offsets)).sqrt()
    lines = lines * (1 - _phasor(-2 * math.pi * delay * offsets))
    # Re Σ lines exp(2πj f t): a real inverse FFT, up to its factor 2 / length and f = 0.
    return torch.fft.irfft(torch.nn.functional.pad(lines, (1, 1)) * (0.5 * length), length)


def leakage_signal(leakage: Leakage, radar: Radar) -> Complex128[Tensor, " sample"]:
    """Return the beat signal of the leakage alone, to be added to every channel.

    Args:
        leakage: delay and level.
        radar: radar with samples.

    Raises:
        InputError: The radar has no samples.
    """
    waveform, delay = require_sampled_waveform(radar), leakage.delay
    cycles = (waveform.frequencies - 0.5 * waveform.residual_slope * delay) * delay
    return 10 ** (leakage.level_db / 20) * _phasor(2 * math.pi * cycles)


def channel_errors(
    radar: Radar, gain_std_db: float = 0.0, phase_std: float = 0.0, *, seed: int
) -> Complex128[Tensor, "tx rx"]:
    """Draw factors of the virtual channels, with normal gains in dB and normal phases.

    Args:
        radar: radar with its arrays.
        gain_std_db: Standard deviation of the gain [dB].
        phase_std: Standard deviation of the phase [rad].
        seed: Seed of gains and phases.

    Raises:
        InputError: A negative deviation.
    """
    checked_number(gain_std_db, "gain_std_db", 0.0)
    checked_number(phase_std, "phase_std [rad]", 0.0)
    generator = torch.Generator().manual_seed(seed)
    gain, phase = torch.randn((2, *radar.shape[1:]), dtype=torch.float64, generator=generator)
    return torch.polar(10 ** (gain_std_db / 20 * gain), phase_std * phase)


def quantize(
    beat: Complex[Tensor, "*batch sample"], radar: Radar, adc: ADC
) -> Complex[Tensor, "*batch sample"]:
    """Quantise a beat signal to the converter's codes, with a warning about clipping.

    Args:
        beat: signal without a gradient.
        radar: An FMCW or stepped frequency radar.
        adc: Converter.

    Raises:
        InputError: A signal that requires a gradient, or samples that are not taken in time.
    """
    _require_time_samples(radar)
    do = "codes are constant between their steps: quantise data only, or detach() first"
    refuse_derivatives(beat, "a beat signal", do)
    codes = torch.round(torch.view_as_real(beat.resolve_conj()) / adc.step)
    lowest, highest = -(2 ** (adc.bits - 1)), 2 ** (adc.bits - 1) - 1
    clipped = int(((codes < lowest) | (codes > highest)).any(-1).sum())
    if clipped:
        warnings.warn(
            f"{clipped} of {beat.numel()} samples exceed the converter's full scale of "
            f"{adc.full_scale:g}; raise it, or lower the leakage",
            PhysicsWarning,
            stacklevel=2,
        )
    return torch.view_as_complex(codes.clamp(lowest, highest) * adc.step)


def _ideal_beat(paths: Paths, radar: Radar, chirps: Chirps | None) -> Tensor:
    return beat_signal(paths, radar) if chirps is None else moving_beat(paths, radar, chirps)


def _phasor(phase: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(phase), phase)


def _require_time_samples(radar: Radar) -> FMCW | SteppedFrequency:
    waveform = require_sampled_waveform(radar)
    if isinstance(waveform, FMCW | SteppedFrequency):
        return waveform
    raise InputError(
        f"expected samples taken one after the other in time, got {type(waveform).__name__}; phase "
        "noise and converter act in time: use them with FMCW or stepped frequency"
    )
