"""Vital signs: displacement of a chest, frequencies of breathing and heartbeat.

Sources: A. D. Droitcour, O. Boric-Lubecke, V. M. Lubecke, J. Lin, G. T. A. Kovacs, "Range
correlation and I/Q performance benefits in single-chip silicon Doppler radars for noncontact
cardiopulmonary monitoring", IEEE Trans. Microwave Theory Tech. 52, 2004, 838–848, for the phase of
what moves. D. R. Morgan, M. G. Zierdt, "Novel signal processing techniques for Doppler radar
cardiopulmonary sensing", Signal Processing 89, 2009, 45–66, for harmonics of breathing, which hide
the heart.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float64
from scipy import signal
from torch import Tensor

from invertwin.channel import Grid
from invertwin.checks import check_shape, checked_number
from invertwin.errors import InputError
from invertwin.radar.radar import Radar

_BREATHING_BAND = 0.1, 0.7  # Hz
_HEART_BAND = 0.8, 3.0  # Hz
_FALSE_ALARM = 0.01  # probability that noise counts as an oscillation
# Of the samples about their circle, see estimate_displacement; noise has 4.7.
_LEAST_ROUNDNESS = 8.0
_TINY = 1e-300  # for bins without echoes
_PADDING = 64  # frequencies for each that the duration resolves


@dataclass(frozen=True)
class Oscillation:
    """Sine in a displacement.

    Attributes:
        frequency: frequency [Hz].
        deviation: standard deviation of the frequency in white noise [Hz].
        depth: peak-to-peak displacement [m].
    """

    frequency: float
    deviation: float
    depth: float


@dataclass(frozen=True, eq=False)
class VitalSigns:
    """Displacement of a chest, and what oscillates in it.

    Attributes:
        range: range of the chest [m].
        times: time after the first chirp [s].
        displacement: displacement towards the radar, without mean and drift [m].
        breathing: oscillation between 0.1 and 0.7 Hz; None = none above the noise, or an echo that
            fades so that its samples lie on no circle.
        heart: oscillation between 0.8 and 3 Hz beside harmonics of breathing; None likewise.
    """

    range: float
    times: Float64[Tensor, " time"]
    displacement: Float64[Tensor, " time"]
    breathing: Oscillation | None
    heart: Oscillation | None


def estimate_vital_signs(
    profile: Complex[Tensor, "time *channel range"], radar: Radar, grid: Grid, interval: float
) -> VitalSigns:
    """Estimate breathing and heartbeat of a person at rest from the phase of their echo.

    Of all channels and range bins the one is used with the largest variance times roundness (see
    ``estimate_displacement``). Frequencies hold for matt skin, too; its depths may be too small,
    since parts of it that move less have echoes in the same bin.

    Args:
        profile: range profiles of channels or beams.
        radar: radar that recorded them.
        grid: grid with their ranges.
        interval: time between profiles [s].

    Raises:
        InputError: Another number of ranges, or a recording too short for a breath or too slow for
            a heartbeat.
    """
    sizes = (*[None] * (profile.ndim - 1), grid.range_count)
    check_shape(profile, sizes, "profiles", "put time first, and ranges of the grid last")
    checked_number(interval, "interval [s]", 0.0, open_low=True)
    count = len(profile)
    if interval > 0.5 / _HEART_BAND[1] or count * interval < 2 / _BREATHING_BAND[0]:
        raise InputError(
            f"expected profiles every {0.5 / _HEART_BAND[1]:.2g} s or more often for at least "
            f"{2 / _BREATHING_BAND[0]:g} s, got {count} every {interval:g} s; record more"
        )
    moved, roundness, variance = estimate_displacement(profile.detach().flatten(1), radar)
    best = int((roundness * variance).argmax())
    displacement = signal.detrend(moved[:, best].cpu().numpy())
    is_arc = float(roundness[best]) > _LEAST_ROUNDNESS
    times, rest = interval * np.arange(count), displacement
    breathing = _find_oscillation(rest, interval, _BREATHING_BAND) if is_arc else None
    if breathing is not None:
        harmonics = breathing.frequency * np.arange(1, int(_HEART_BAND[1] / breathing.frequency))
        rest = rest - _fit_sines(rest, times, harmonics)[0]
    heart = _find_oscillation(rest, interval, _HEART_BAND) if is_arc else None
    at, seen = (torch.from_numpy(x).to(profile.device) for x in (times, displacement))
    return VitalSigns(float(grid.ranges[best % grid.range_count]), at, seen, breathing, heart)


def estimate_displacement(
    profile: Complex[Tensor, "time bin"], radar: Radar
) -> tuple[Float64[Tensor, "time bin"], Float64[Tensor, " bin"], Float64[Tensor, " bin"]]:
    """Estimate displacements towards the radar from the phase of echoes, with derivatives.

    Static echoes are the centre of the circle that fits the samples of a bin (linear least
    squares); the phase about it is unwrapped.

    Args:
        profile: echoes over time, of several bins.
        radar: radar that recorded them.

    Returns:
        Displacements from the first instant [m]; roundness of each bin: the variance of its samples
        over that of their distances from the centre; and this variance of the samples.
    """
    samples = profile.to(torch.complex128)
    off = samples - samples.mean(0)
    x, y, square = off.real, off.imag, off.abs().square()
    xx, yy, xy, xs, ys = (part.mean(0) for part in (x * x, y * y, x * y, x * square, y * square))
    twice = 2 * (xx * yy - xy * xy).clamp_min(_TINY)
    away = off - torch.complex((yy * xs - xy * ys) / twice, (xx * ys - xy * xs) / twice)
    phase = torch.nn.functional.pad((away[1:] * away[:-1].conj()).angle().cumsum(0), (0, 0, 1, 0))
    variance = square.mean(0)
    roundness = variance / away.abs().var(0, correction=0).clamp_min(_TINY)
    return -phase * radar.waveform.wavelength / (4 * math.pi), roundness, variance


def _fit_sines(
    values: Float64[np.ndarray, " time"],
    times: Float64[np.ndarray, " time"],
    frequencies: Float64[np.ndarray, " sine"],
) -> tuple[Float64[np.ndarray, " time"], Float64[np.ndarray, " sine"]]:
    """Fit sines by least squares; return their sum and their amplitudes."""
    angles = 2 * math.pi * times[:, None] * frequencies
    columns = np.concatenate([np.cos(angles), np.sin(angles)], 1)
    weights = np.linalg.lstsq(columns, values)[0]
    return columns @ weights, np.hypot(*weights.reshape(2, -1))


def _find_oscillation(
    values: Float64[np.ndarray, " time"], interval: float, band: tuple[float, float]
) -> Oscillation | None:
    """Find the strongest sine of a band; None where noise may be as strong."""
    count = len(values)
    frequencies, power = signal.periodogram(
        values, 1 / interval, "hann", nfft=_PADDING * count, scaling="spectrum"
    )
    inside = (frequencies >= band[0]) & (frequencies <= band[1])
    frequency = frequencies[inside][power[inside].argmax()]
    own, (amplitude,) = _fit_sines(values, interval * np.arange(count), np.array([frequency]))
    order = signal.butter(2, band, "bandpass", fs=1 / interval, output="sos")
    noise = signal.sosfiltfilt(order, values - own)
    # White noise of this power in the band.
    variance = float(noise.var()) * 0.5 / interval / (band[1] - band[0])
    resolved = (band[1] - band[0]) * count * interval
    if amplitude**2 * count < 4 * variance * math.log(resolved / _FALSE_ALARM):
        return None
    # Cramér-Rao bound of the frequency of a sine in white noise.
    deviation = math.sqrt(6 * variance / count**3) / (math.pi * amplitude * interval)
    return Oscillation(float(frequency), float(deviation), 2 * float(amplitude))
