"""Motion in the signal: range rates from many chirps, directions of movers, micro-Doppler."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float, Float64, Int64
from torch import Tensor

from invertwin.channel import Grid
from invertwin.checks import check_shape
from invertwin.errors import InputError
from invertwin.radar.processing.beamforming import beamform
from invertwin.radar.radar import Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.radar.signal.range_profile import range_profile
from invertwin.radar.waveform import unit_window


@dataclass(frozen=True, eq=False)
class Spectrogram:
    """Power over time and range rate.

    Attributes:
        power: Peaks at |a|² for a constant range rate.
        times: Middle of each window after the first chirp [s].
        velocities: Range rates, positive moves away [m/s].
    """

    power: Float[Tensor, "*batch time velocity"]
    times: Float64[Tensor, " time"]
    velocities: Float64[Tensor, " velocity"]


def velocity_axis(
    radar: Radar, chirps: Chirps, bins: int | None = None
) -> Float64[Tensor, " velocity"]:
    """Range rates of the bins of ``range_doppler``, ascending, λf/2 [m/s]; positive moves away.

    Args:
        radar: Its transmitters and wavelength.
        chirps: Timing.
        bins: Number of bins, at least that of chirps (None); range rate 0 is at ``bins // 2``.
    """
    bins = chirps.count if bins is None else bins
    places = (torch.arange(bins, dtype=torch.float64) - bins // 2) / bins
    return places * velocity_span(radar, chirps)


def velocity_span(radar: Radar, chirps: Chirps) -> float:
    """Twice the maximum speed [m/s]; range rates that differ by it look alike.

    Args:
        radar: Its wavelength and transmitters.
        chirps: Their interval and order.
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
    coefficient a peaks at |a|. Where transmitters take turns, movers gain phase between them;
    ``compensate_tdm`` removes it.

    Args:
        beat: Chirps of every transmitter.
        radar: With one pose per frame.
        grid: Its ranges are used.
        chirps: Timing.
        window: Over the chirps, one of ``WINDOWS``.
        bins: Number of range rates, at least that of chirps (None).

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
    fold: int | Int64[Tensor, "frame velocity range"] = 0,
) -> Complex[Tensor, "frame velocity tx rx range"]:
    """Remove the phase that movers gain until a later transmitter sends.

    A chirp that starts t later has 2π f t more phase, with f the Doppler frequency. Beamforming
    would take this for a direction. The phase depends on the true f, but a bin shows it modulo one
    over the time from loop to loop: ``fold`` says by how many spans of the velocity axis a bin's
    target is beyond it.

    Args:
        spectrum: Result of ``range_doppler``.
        radar: Its transmitters take turns in their order.
        chirps: Timing.
        fold: One number for all bins, or one for each (``resolve_fold`` finds it).

    Raises:
        InputError: Another number of transmitters in the spectrum than in the radar.
    """
    expected = None, None, radar.shape[1], None, None
    what = f"a spectrum (frame, velocity, tx, rx, range) of {radar.shape[1]} transmitters"
    check_shape(spectrum, expected, what, "use the radar that recorded it")
    frames, count, transmitters, _, ranges = spectrum.shape
    folds = torch.as_tensor(fold).cpu().expand(frames, count, ranges).to(torch.float64)
    rate = velocity_axis(radar, chirps, count)[:, None] + folds * velocity_span(radar, chirps)
    frequency = 2 / radar.waveform.wavelength * rate
    starts = chirps.times(transmitters)[0]
    cycles = frequency[:, :, None, :] * starts[:, None]
    turn = torch.exp(-2j * math.pi * (cycles - cycles.round()))
    return spectrum * turn[:, :, :, None].to(spectrum)


def resolve_fold(
    spectrum: Complex[Tensor, "frame velocity tx rx range"],
    radar: Radar,
    grid: Grid,
    chirps: Chirps,
    candidates: Sequence[int] = (0, -1, 1),
) -> Int64[Tensor, "frame velocity range"]:
    """Find by how many spans each bin's target is beyond the velocity axis.

    The right number makes all transmitters agree with the receivers on a direction, so it has the
    highest Bartlett peak. Of equal candidates the first is taken. With N transmitters that take
    turns, candidates that differ by N cannot be told apart. The result has no gradients.

    Args:
        spectrum: Result of ``range_doppler``, not compensated.
        radar: With several transmitters.
        grid: With the directions in which to look for the peak.
        chirps: Timing.
        candidates: Numbers of spans to choose from, the likeliest first.

    Raises:
        InputError: No candidates, or a spectrum that does not fit radar and grid.
    """
    if not candidates:
        raise InputError("expected at least one candidate, got none; (0, -1, 1) are usual")
    peaks = [
        _steer_beams(compensate_tdm(spectrum.detach(), radar, chirps, fold), radar, grid).amax(
            (-2, -1)
        )
        for fold in candidates
    ]
    # Rounding errors must not decide between equals.
    best = torch.stack(peaks)
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
    """Power over range rate, range and direction (Bartlett), with ``compensate_tdm``.

    It is ``range_doppler``, ``compensate_tdm``, then ``beamform``.

    Args:
        beat: Signals of trains of chirps.
        radar: What recorded them.
        grid: Bins of range and direction.
        chirps: Their interval and order.
        window: Taper along the chirps.
        bins: Number of range rates; None = number of chirps.
        fold: How often each range rate has wrapped around, see ``compensate_tdm``.

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
    """Short-time Fourier transform over the chirps of one range bin (or any slow-time signal).

    Args:
        signal: One value per chirp of one transmitter, such as a bin of the range profiles.
        radar: Its transmitters and wavelength.
        chirps: Timing; the signal may be of more or fewer of them.
        length: Chirps in a window.
        step: Chirps from the start of one window to that of the next.
        window: One of ``WINDOWS``.

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
    starts = torch.arange(power.shape[-2], dtype=torch.float64) * step
    loop = 0.5 * radar.waveform.wavelength / velocity_span(radar, chirps)
    times = (starts + 0.5 * (length - 1)) * loop
    return Spectrogram(power, times, velocity_axis(radar, chirps, length))


def _steer_beams(
    spectrum: Complex[Tensor, "frame velocity tx rx range"], radar: Radar, grid: Grid
) -> Float[Tensor, "frame velocity range u v"]:
    frames, count = spectrum.shape[:2]
    power = beamform(spectrum.flatten(0, 1), _repeat_poses(radar, count), grid)
    return power.unflatten(0, (frames, count))


def _doppler_transform(
    slow: Complex[Tensor, "*batch chirp"], window: str, bins: int
) -> Complex[Tensor, "*batch velocity"]:
    weight = unit_window(window, slow.shape[-1]).to(slow.device, slow.real.dtype)
    return torch.fft.fftshift(torch.fft.fft(slow * weight, bins), dim=-1)


def _repeat_poses(radar: Radar, count: int) -> Radar:
    """The radar with each pose as often as it has chirps or bins."""
    return radar.frames(torch.arange(radar.frame_count).repeat_interleave(count))
