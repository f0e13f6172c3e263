"""The beat phase of a moving point, written down directly: no ray tracer, no paths."""

import math

import torch
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar import FMCW, Chirps, Radar


def moving_point(
    radar: Radar,
    chirps: Chirps,
    distance: float,
    rate: float,
    u: float,
    v: float = 0.0,
    amplitude: float = 1.0,
) -> Tensor:
    """[frame, chirp, tx, rx, sample] of a point that moves along its line of sight.

    exp(2πj (f0 τ + S τ t_n − S τ²/2)) with exact distances when each chirp starts. Distance [m]
    and direction are those in the frame of each pose, from the middle of the phase centres, at
    the middle of the burst; the range rate [m/s] is positive away.
    """
    waveform = radar.waveform
    assert isinstance(waveform, FMCW)
    ray = torch.tensor([u, v, math.sqrt(1 - u**2 - v**2)], dtype=torch.float64)
    times = chirps.times(len(radar.transmitters.positions))
    ranges = distance + rate * (times - times.mean())
    link, (tx, rx) = radar.link(), radar.elements()
    beats = []
    for frame in range(radar.frame_count):
        origin = 0.5 * (link.tx + link.rx)[frame]
        place = origin + ranges[..., None] * (link.rotations[frame] @ ray)
        length = (place - tx[frame]).norm(dim=-1)[..., None]
        length = length + (place[:, :, None] - rx[frame]).norm(dim=-1)
        delay = (length / SPEED_OF_LIGHT)[..., None]
        swept = waveform.slope * (waveform.sample_times - 0.5 * delay)
        beats.append(torch.exp(2j * math.pi * delay * (waveform.start_frequency + swept)))
    return amplitude * torch.stack(beats)
