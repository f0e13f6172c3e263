"""Doppler processing: range rates, directions of moving targets, micro-Doppler."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex, Float, Float64, Int64, Num
from torch import Tensor

from invertwin.channel import Grid
from invertwin.checks import check_shape, check_some
from invertwin.errors import InputError
from invertwin.radar.processing.beamforming import beamform
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.radar.signal.range_profile import range_profile
from invertwin.radar.waveform import unit_window

_Power = Float[Tensor, "*bin"]


@dataclass(frozen=True, eq=False)
class Spectrogram:
    """Power over time and range rate.

    Attributes:
        power: power, with peaks at |a|² for a constant range rate.
        times: centre of each window after the first chirp [s].
        velocities: range rates, positive for receding targets [m/s].
    """

    power: Float[Tensor, "*batch time velocity"]
    times: Float64[Tensor, " time"]
    velocities: Float64[Tensor, " velocity"]


def velocity_axis(
    radar: Radar, chirps: Chirps, bins: int | None = None
) -> Float64[Tensor, " velocity"]:
    """Return the range rates of the bins of ``range_doppler``, ascending, λf/2 [m/s].

    Args:
        radar: radar with its transmitters and wavelength.
        chirps: chirp timing.
        bins: number of bins, at least the number of chirps (None); range rate 0 is at ``bins //
            2``.
    """
    bins = chirps.count if bins is None else bins
    places = (torch.arange(bins, dtype=torch.float64) - bins // 2) / bins
    return places * velocity_span(radar, chirps)


def velocity_span(radar: Radar, chirps: Chirps) -> float:
    """Return twice the maximum unambiguous speed [m/s], the period of range rates.

    Args:
        radar: radar with its wavelength and transmitters.
        chirps: interval and order of the chirps.
    """
    return 2 * chirps.max_speed(radar.waveform.wavelength, radar.shape[1])


def range_doppler(
    beat: Complex[Tensor, "frame chirp tx rx sample"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    *,
    window: str = "hamming",
    bins: int | None = None,
) -> Complex[Tensor, "frame velocity tx rx range"]:
    """Transform every chirp over range, then all chirps over range rate, with a window.

    The bins are those of ``velocity_axis``: the beat phase of a target that moves away grows from
    chirp to chirp. The result is normalised by the sums of the windows, so a point target of
    coefficient a peaks at |a|. Under time-division multiplexing, moving targets gain phase between
    transmitters; ``compensate_tdm`` removes it.

    Args:
        beat: signals of all chirps of every transmitter.
        radar: radar with one pose per frame.
        grid: grid with its ranges.
        chirps: chirp timing.
        window: taper over the chirps, one of ``WINDOWS``.
        bins: number of range rates, at least the number of chirps (None).

    Raises:
        InputError: Signal, radar and chirps do not fit, an unknown window, or too few bins.
    """
    expected = (radar.frame_count, chirps.count)
    bins = chirps.count if bins is None else bins
    what = f"signals (frame, chirp, tx, rx, sample) of {chirps.count} chirps"
    check_shape(beat, (*expected, None, None, None), what, "use the timing that recorded them")
    if bins < chirps.count:
        raise InputError(
            f"expected at least {chirps.count} bins, one per chirp, got {bins}; use fewer chirps "
            "instead"
        )
    profile = range_profile(beat.flatten(0, 1), _repeat_poses(radar, chirps.count), grid)
    slow = profile.unflatten(0, expected)
    return _doppler_transform(slow.movedim(1, -1), window, bins).movedim(-1, 1)


def compensate_tdm(
    spectrum: Complex[Tensor, "frame velocity tx rx range"],
    radar: Radar,
    chirps: Chirps,
    fold: float | Num[Tensor, "*frame velocity range"] = 0,
) -> Complex[Tensor, "frame velocity tx rx range"]:
    """Remove the phase that moving targets gain between time-multiplexed transmitters.

    A chirp that starts t later has 2π f t more phase, with f the Doppler frequency, which biases
    beamforming. The phase depends on the true f, which a bin determines modulo the inverse loop
    time: ``fold`` is the number of spans of the velocity axis by which the target's range rate is
    aliased. Its fraction is the way from the centre of the bin, see ``interpolate_rates``: half a
    bin of few chirps turns the last transmitter by up to π over their number.

    Args:
        spectrum: spectrum from ``range_doppler``.
        radar: radar whose transmitters are multiplexed in time.
        chirps: chirp timing.
        fold: number of spans for all bins, or one per bin (see ``resolve_fold``).

    Raises:
        InputError: Another number of transmitters in the spectrum than in the radar.
    """
    expected = None, None, radar.shape[1], None, None
    what = f"a spectrum (frame, velocity, tx, rx, range) of {radar.shape[1]} transmitters"
    check_shape(spectrum, expected, what, "use the radar that recorded it")
    frames, count, transmitters, _, ranges = spectrum.shape
    folds = torch.as_tensor(fold, dtype=torch.float64, device=spectrum.device)
    axis, starts = velocity_axis(radar, chirps, count)[:, None], chirps.times(transmitters)[0]
    rate = folds.expand(frames, count, ranges) * velocity_span(radar, chirps) + axis.to(folds)
    cycles = 2 / radar.waveform.wavelength * rate[:, :, None] * starts[:, None].to(rate)
    turn = torch.exp(-2j * math.pi * (cycles - cycles.round()))
    return spectrum * turn[:, :, :, None].to(spectrum)


def interpolate_rates(power: Float[Tensor, "velocity range"]) -> Float64[Tensor, "velocity range"]:
    """Interpolate the range rate of the target in each bin, in spans from the centre of the bin.

    A parabola through the logarithms of a bin and its neighbours has its vertex there, at most half
    a bin away.

    Args:
        power: result of ``range_doppler``, averaged over channels.
    """
    return interpolate_peak(power.roll(1, 0), power, power.roll(-1, 0)) / len(power)


def interpolate_peak(before: _Power, middle: _Power, after: _Power) -> _Power:
    """Return the peak offset of the parabola through the logarithms of three levels: within half a
    step.

    Args:
        before, middle, after: levels of neighbouring bins.
    """
    tiny = torch.finfo(torch.float64).tiny
    low, level, high = (part.double().clamp_min(tiny).log() for part in (before, middle, after))
    curvature = low - 2 * level + high
    return (0.5 * (low - high) / torch.where(curvature < 0, curvature, torch.inf)).clamp(-0.5, 0.5)


def resolve_fold(
    spectrum: Complex[Tensor, "frame velocity tx rx range"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    candidates: Sequence[int] = (0, -1, 1),
) -> Int64[Tensor, "frame velocity range"]:
    """Estimate the number of velocity spans by which each bin's target is aliased.

    The correct number makes the phases of all transmitters and receivers consistent with one
    direction, so it maximises the Bartlett peak; ties resolve to the first candidate. With N
    multiplexed transmitters, candidates that differ by N are indistinguishable. The result has no
    gradients.

    Args:
        spectrum: spectrum from ``range_doppler``, not compensated.
        radar: radar with several transmitters.
        grid: grid with the directions of the peak search.
        chirps: chirp timing.
        candidates: candidate numbers of spans, the most likely first.

    Raises:
        InputError: No candidates, or a spectrum that does not fit radar and grid.
    """
    check_some(candidates, "candidate", "(0, -1, 1) are usual")
    parts = (compensate_tdm(spectrum.detach(), radar, chirps, fold) for fold in candidates)
    best = torch.stack([_steer_beams(part, radar, grid).amax((-2, -1)) for part in parts])
    # Break ties independently of rounding errors.
    chosen = (best >= (1 - 1e-9) * best.amax(0)).to(torch.int64).argmax(0)
    return torch.tensor(list(candidates), device=chosen.device)[chosen]


def range_doppler_angle(
    beat: Complex[Tensor, "frame chirp tx rx sample"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    *,
    window: str = "hamming",
    bins: int | None = None,
    fold: int | Int64[Tensor, "frame velocity range"] = 0,
) -> Float[Tensor, "frame velocity range u v"]:
    """Compute power over range rate, range and direction (Bartlett).

    It applies ``range_doppler``, ``compensate_tdm``, then ``beamform``.

    Args:
        beat: signals of chirp trains.
        radar: radar that recorded them.
        grid: Bins of range and direction.
        chirps: interval and order of the chirps.
        window: Taper along the chirps.
        bins: Number of range rates; None = number of chirps.
        fold: number of spans of aliasing, see ``compensate_tdm``.

    Raises:
        InputError: As these three.
    """
    spectrum = range_doppler(beat, radar, grid, chirps, window=window, bins=bins)
    return _steer_beams(compensate_tdm(spectrum, radar, chirps, fold), radar, grid)


def micro_doppler(
    signal: Complex[Tensor, "*batch chirp"],
    radar: Radar,
    chirps: Chirps,
    *,
    length: int,
    step: int = 1,
    window: str = "hann",
) -> Spectrogram:
    """Compute the short-time Fourier transform over the chirps of one range bin (or any slow-time
    signal).

    Args:
        signal: one value per chirp of one transmitter, such as a bin of the range profiles.
        radar: radar with its transmitters and wavelength.
        chirps: chirp timing; the signal may have another number of chirps.
        length: number of chirps in a window.
        step: number of chirps between the starts of consecutive windows.
        window: one of ``WINDOWS``.

    Raises:
        InputError: A window longer than the signal or of fewer than 2 chirps, a step below 1, or
            an unknown window.
    """
    count = signal.shape[-1]
    if not (2 <= length <= count and step >= 1):
        raise InputError(
            f"expected a window of 2..{count} chirps and a step of at least 1, got {length} and "
            f"{step}; the signal has {count} chirps"
        )
    power = _doppler_transform(signal.unfold(-1, length, step), window, length).abs().square()
    starts = torch.arange(power.shape[-2], dtype=torch.float64, device=power.device) * step
    loop = 0.5 * radar.waveform.wavelength / velocity_span(radar, chirps)
    times = (starts + 0.5 * (length - 1)) * loop
    return Spectrogram(power, times, velocity_axis(radar, chirps, length).to(power.device))


def frame_spectrogram(
    beat: Complex[Tensor, "frame chirp tx rx sample"], radar: Radar, grid: Grid, chirps: Chirps
) -> Spectrogram:
    """Compute the micro-Doppler of frames: ``micro_doppler`` without static echoes, averaged over
    channels and summed over ranges.

    A window has an eighth of the chirps of a frame, but at least 16.

    Args:
        beat: signals of all chirps of every transmitter.
        radar: radar with one pose per frame.
        grid: ranges that are summed.
        chirps: chirp timing.

    Raises:
        InputError: fewer than 16 chirps in a frame.
    """
    frames, count = beat.shape[:2]
    signal = (beat - beat.mean(1, keepdim=True)).flatten(0, 1)
    slow = range_profile(signal, _repeat_poses(radar, count), grid).unflatten(0, (frames, count))
    length = max(16, count // 8)
    found = micro_doppler(slow.movedim(1, -1), radar, chirps, length=length, step=length // 8)
    return replace(found, power=found.power.mean((1, 2)).sum(1))


def _steer_beams(spectrum: Tensor, radar: Radar, grid: Grid) -> Tensor:
    frames, count = spectrum.shape[:2]
    power = beamform(spectrum.flatten(0, 1), _repeat_poses(radar, count), grid)
    return power.unflatten(0, (frames, count))


def _doppler_transform(slow: Tensor, window: str, bins: int) -> Tensor:
    weight = unit_window(window, slow.shape[-1]).to(slow.device, slow.real.dtype)
    return torch.fft.fftshift(torch.fft.fft(slow * weight, bins), dim=-1)


def _repeat_poses(radar: Radar, count: int) -> Radar:
    """Return the radar with each pose repeated for its chirps or bins."""
    return radar.frames(torch.arange(radar.frame_count).repeat_interleave(count))
