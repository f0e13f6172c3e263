"""Exact radar signals: paths to beat signals to range profiles."""

import math
import warnings

import torch
from jaxtyping import Complex, Complex128
from torch import Tensor

from invertwin.channel import Grid, Paths
from invertwin.checks import checked_number
from invertwin.constants import BOLTZMANN, SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar.radar import Radar, checked_beat, require_sampled_waveform
from invertwin.radar.signal.nufft import beat_of_delays
from invertwin.radar.waveform import PhysicsWarning, SampledWaveform, unit_window
from invertwin.runtime.progress import track

_STANDARD_TEMPERATURE = 290.0  # reference temperature of noise figures [K]


def beat_signal(
    paths: Paths,
    radar: Radar,
    *,
    tolerance: float = 1e-9,
    channels: tuple[slice, slice] = (slice(None), slice(None)),
) -> Complex128[Tensor, "frame tx rx sample"]:
    """Compute the beat (IF) signal of every TX and RX element: transmit × conj(receive).

        s[n] = Σ conj(a) exp(2πj (f_n τ − S τ²/2))

    with f_n the frequency of the sample (f0 + S t_n on an FMCW ramp), S the slope of the ramp (0
    where the frequency stands: stepped frequency, OFDM, whose s is conj(H)), and τ the delay from
    the TX element over the path to the RX element: the path's own delay between the phase centres,
    corrected by the exact lengths from its first and last vertex, so the near field and multiple
    bounces are exact. The sum is a non-uniform FFT (type 1) in float64; its adjoint (type 2) gives
    gradients with respect to the coefficient, delay, first and last vertex and the radar's poses.
    With a range origin τ is the delay beyond the origin's: the reference, and on a ramp its clock,
    are delayed by it; the origin has no derivative.

    Source: eq:fmcw_if of the paper; derivations §1 and §6.
    Differs from the source: the coefficient is conj(a) and includes the path's phase φ (printed
    inside 2πj(…)).

    Args:
        paths: field paths, whose frames index the radar's poses.
        radar: radar with samples: FMCW, stepped frequency, OFDM.
        tolerance: relative error of the sum.
        channels: transmitters and receivers of the signals.

    Raises:
        InputError: The radar has no samples, the paths carry power only, or a frame is missing.
    """
    waveform = require_sampled_waveform(radar)
    check_paths(paths, radar, waveform)
    device = paths.delay.device
    tx, rx = (places.to(device) for places in radar.elements())
    origin_delays = radar.origin_delays.to(device)
    order = torch.argsort(paths.frame, stable=True)
    counts = torch.bincount(paths.frame, minlength=radar.frame_count).tolist()
    frames: list[Tensor] = []
    for frame, rows in track(list(enumerate(torch.split(order, counts))), "beat signals"):
        own = paths.select(rows)
        first, last = own.first, own.last
        # Delay without the segments to the antennas.
        outer = (first - tx[frame].mean(0)).norm(dim=1) + (last - rx[frame].mean(0)).norm(dim=1)
        inner = paths.delay[rows] - origin_delays[frame] - outer / SPEED_OF_LIGHT
        senders, hearers = range(radar.shape[1])[channels[0]], range(radar.shape[2])[channels[1]]
        forth = [inner + (first - tx[frame, t]).norm(dim=1) / SPEED_OF_LIGHT for t in senders]
        back = [(last - rx[frame, r]).norm(dim=1) / SPEED_OF_LIGHT for r in hearers]
        signals = [
            beat_of_delays(radar.coefficient(own, t, r), (f + b)[None], waveform, tolerance)
            for t, f in zip(senders, forth, strict=True)
            for r, b in zip(hearers, back, strict=True)
        ]
        frames.append(torch.stack(signals).unflatten(0, (len(forth), len(back))))
    return torch.stack(frames)


def add_noise(
    beat: Complex128[Tensor, "*batch sample"],
    radar: Radar | None = None,
    *,
    seed: int,
    snr_db: float | None = None,
    noise_figure_db: float | None = None,
    transmit_power: float = 0.01,
) -> Complex128[Tensor, "*batch sample"]:
    """Add white complex Gaussian noise to a beat signal of frames or chirp trains.

    Give either a signal-to-noise ratio or a noise figure. The power per sample is the mean
    signal power over ``snr_db``, or ``k T0 F b`` (T0 = 290 K, b the waveform's noise bandwidth,
    the sampling rate of an FMCW radar) relative to the transmit power, since |s|² is received
    over transmitted power.

    Args:
        beat: signal without noise.
        radar: radar, needed with ``noise_figure_db`` for the noise bandwidth.
        seed: seed of the noise.
        snr_db: mean signal over noise power in each sample [dB].
        noise_figure_db: noise figure of the receiver [dB].
        transmit_power: power of one transmitter [W].

    Raises:
        InputError: Not exactly one of the two levels, or no radar for the noise figure.
    """
    if (snr_db is None) == (noise_figure_db is None):
        raise InputError(
            f"expected either snr_db or noise_figure_db, got {snr_db} and {noise_figure_db}; "
            "give exactly one"
        )
    if snr_db is not None:
        snr_db = checked_number(snr_db, "snr_db", -300.0, 300.0)
        power = float(beat.detach().abs().square().mean()) * 10 ** (-snr_db / 10)
    elif noise_figure_db is not None and radar is not None:
        rate = require_sampled_waveform(radar).noise_bandwidth
        factor = 10 ** (noise_figure_db / 10)
        power = BOLTZMANN * _STANDARD_TEMPERATURE * factor * rate / transmit_power
    else:
        raise InputError(
            "expected a radar with noise_figure_db, got None; pass the radar of the beat signal"
        )
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(beat.shape, dtype=torch.complex128, generator=generator)
    return beat + math.sqrt(power) * noise.to(beat.device)


def range_profile(
    beat: Complex[Tensor, "frame tx rx sample"], radar: Radar, grid: Grid
) -> Complex[Tensor, "frame tx rx range"]:
    """Compute the windowed range transform at the grid's ranges.

    Normalised by the window's sum: a path of coefficient a peaks at |a|. Ranges on the bins of a
    zero-padded FFT use an FFT; others use the same sum as a matrix product.

    Source: eq:fmcw_fft of the paper.

    Args:
        beat: beat signals.
        radar: radar that recorded them.
        grid: grid with its ranges.

    Raises:
        InputError: The signal does not fit the radar.
    """
    waveform = require_sampled_waveform(radar)
    window = unit_window(radar.window, waveform.samples)
    tapered = checked_beat(beat, radar) * window.to(beat.device, beat.real.dtype)
    bins = fft_bins(waveform, grid)
    if bins is None:
        cycles = torch.arange(waveform.samples)[:, None] * (grid.ranges / waveform.max_range)
        return tapered @ torch.exp(-2j * math.pi * cycles).to(beat.device, beat.dtype)
    length, first = bins
    # Ranges outside the unambiguous interval are aliased.
    wanted = (first + torch.arange(grid.range_count, device=beat.device)) % length
    return torch.fft.fft(tapered, length)[..., wanted]


def check_paths(paths: Paths, radar: Radar, waveform: SampledWaveform) -> None:
    """Raise if the paths cannot be summed, warn if they are aliased in range.

    Args:
        paths: paths to sum.
        radar: radar with its poses and range bias.
        waveform: waveform with its unambiguous range.
    """
    if paths.kind == "power":
        raise InputError(
            "expected field paths, got power paths, which have no phase; use trace_field, or "
            "the surrogate for power"
        )
    if radar.has_range_bias:
        raise InputError(
            f"expected range_bias 0 for exact signals, got {radar.range_bias}; fit a range bias "
            "with a surrogate"
        )
    if len(paths) == 0:
        return
    if not 0 <= int(paths.frame.min()) <= int(paths.frame.max()) < radar.frame_count:
        raise InputError(
            f"expected path frames in 0..{radar.frame_count - 1}, got {int(paths.frame.min())}.."
            f"{int(paths.frame.max())}; trace with the link of the same radar"
        )
    low, high = radar.range_limits
    shown = paths.range - radar.origins.to(paths.delay.device)[paths.frame]
    beyond = int(((shown < low) | (shown > high)).sum())
    if beyond:
        centred = radar.range_origin is not None
        within = f" from {low:.2f} to {high:.2f} m of the origin" if centred else ""
        warnings.warn(
            f"{beyond} of {len(paths)} paths lie beyond the unambiguous range of "
            f"{waveform.max_range:.2f} m{within} and appear at wrong ranges; use finer frequency "
            "steps, which are more samples on a ramp",
            PhysicsWarning,
            stacklevel=3,
        )


def fft_bins(waveform: SampledWaveform, grid: Grid) -> tuple[int, int] | None:
    """Return the FFT length and first bin if all ranges are FFT bins, else None.

    Args:
        waveform: sampled waveform.
        grid: grid with its ranges.
    """
    length = waveform.max_range / grid.range_step
    first = grid.range_start / grid.range_step
    on_bins = max(abs(length - round(length)), abs(first - round(first))) < 1e-6
    if on_bins and round(length) >= waveform.samples:
        return round(length), round(first)
    return None
