"""Backprojection: images of beat signals by coherent summation, also in the near field."""

import math

import torch
from jaxtyping import Complex, Complex128, Float64
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.radar.radar import Radar, checked_beat, require_sampled_waveform
from invertwin.radar.waveform import unit_window

# Oversampling of linear interpolation: the error is (π/8)²/8 = 2 % at the edge of a critically
# sampled band, and decreases quadratically within it.
UPSAMPLING = 8


def backproject_beat(
    beat: Complex[Tensor, "frame tx rx sample"], radar: Radar, points: Float64[Tensor, "*point 3"]
) -> Complex128[Tensor, "*point"]:
    """Focus beat signals on points: average the echoes from each point's exact distance.

        I(p) = mean Σ w_n s[n] exp(−2πj (f_n τ − S τ²/2)) / Σ w_n

    with τ from each TX element over p to each RX element in each pose: no plane-wave approximation,
    so it focuses in the near field of the array and along the track of a moving radar. A point
    target of coefficient a gives conj(a) at its position; static points add coherently, moving ones
    do not. τ is counted from the radar's range origin. Delays are float64: at 10 km and 10 GHz
    phases are accurate to 1e-9. Differentiable with respect to the signal, the points and the
    poses.

    Source: the matched filter of the paper's eq:fmcw_if.

    Args:
        beat: beat signals of all frames.
        radar: radar with the pose of each frame.
        points: positions [*, 3] in world axes [m].

    Raises:
        InputError: The signal does not fit the radar, the radar has no beat signal, or a point
            lies beyond the unambiguous ranges, see ``Radar.range_limits``.
    """
    waveform = require_sampled_waveform(radar)
    tx, rx = (places.to(beat.device) for places in radar.elements())
    flat = points.reshape(-1, 3).to(beat.device)
    middle, length = waveform.samples // 2, UPSAMPLING * waveform.samples
    window = unit_window(radar.window, waveform.samples).to(beat.device)
    tapered = checked_beat(beat, radar).to(torch.complex128) * window
    # Samples are counted from the middle one, so that the phase varies slowly between bins.
    turn = torch.exp(2j * math.pi * middle / length * torch.arange(length))
    spectrum = torch.fft.fft(tapered, length) * turn.to(beat.device)
    spectrum = torch.cat([spectrum, spectrum[..., :1]], dim=-1)
    origin_delays, limits = radar.origin_delays.to(beat.device), radar.range_limits
    image = torch.zeros(len(flat), dtype=torch.complex128, device=beat.device)
    for frame in range(radar.frame_count):
        to_tx, to_rx = pairwise_distances(tx[frame], flat), pairwise_distances(rx[frame], flat)
        for sender in range(tx.shape[1]):
            delay = (to_tx[sender] + to_rx) / SPEED_OF_LIGHT - origin_delays[frame]
            _check_range(delay, limits)
            index = torch.remainder(delay * (waveform.step * length), length)
            echo = interpolate_samples(spectrum[frame, sender], index)
            tone = waveform.start_frequency + middle * waveform.step
            cycles = delay * (tone - 0.5 * waveform.residual_slope * delay)
            # Reduce the 1e5 cycles at 77 GHz and 200 m in float64.
            phase = -2 * math.pi * (cycles - cycles.detach().round())
            image = image + (echo * torch.polar(torch.ones_like(phase), phase)).sum(0)
    return (image / (radar.frame_count * tx.shape[1] * rx.shape[1])).reshape(points.shape[:-1])


def pairwise_distances(
    positions: Float64[Tensor, "place 3"], points: Float64[Tensor, "point 3"]
) -> Float64[Tensor, "place point"]:
    """Compute distances from every position to every point [m].

    Args:
        positions, points: [*, 3] [m].
    """
    # The default matrix product of cdist loses digits by cancellation.
    return torch.cdist(positions, points, compute_mode="donot_use_mm_for_euclid_dist")


def interpolate_samples(
    samples: Complex128[Tensor, "row sample"], index: Float64[Tensor, "row point"]
) -> Complex128[Tensor, "row point"]:
    """Interpolate linearly along each row at a fractional index.

    Args:
        samples: rows of samples.
        index: fractional position in each row, in samples.
    """
    cell = index.detach().floor().clamp(0, samples.shape[1] - 2).long()
    before, after = samples.gather(1, cell), samples.gather(1, cell + 1)
    return before + (after - before) * (index - cell)


def _check_range(delay: Float64[Tensor, "rx point"], limits: tuple[float, float]) -> None:
    if not delay.numel():
        return
    for end in delay.detach().aminmax():
        shown = 0.5 * SPEED_OF_LIGHT * float(end)
        if not limits[0] - 1e-9 <= shown <= limits[1]:
            raise InputError(
                f"expected points within the unambiguous ranges from {limits[0]:g} to "
                f"{limits[1]:g} m, got one at {shown:g} m; choose nearer points, or give the radar "
                "the range origin of data that are centred on a scene"
            )
