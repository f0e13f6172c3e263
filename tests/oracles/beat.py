"""Slow twin of the beat signal: the plain sum over paths, element by element."""

import math

import torch
from torch import Tensor

from invertwin.channel.paths import Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar import FMCW, Radar


def beat(paths: Paths, radar: Radar) -> Tensor:
    """[frame, tx, rx, sample], from exact lengths in float64."""
    waveform = radar.waveform
    assert isinstance(waveform, FMCW)
    link, (tx, rx) = radar.link(), radar.elements()
    times = waveform.sample_times
    frames = []
    for frame in range(radar.frame_count):
        rows = paths.frame == frame
        first, last = paths.first[rows], paths.last[rows]

        def excess(points: Tensor, elements: Tensor, center: Tensor) -> Tensor:
            return (points - elements[:, None]).norm(dim=-1) - (points - center).norm(dim=-1)

        legs_tx = excess(first, tx[frame], link.tx[frame])
        legs_rx = excess(last, rx[frame], link.rx[frame])
        delay = paths.delay[rows] + (legs_tx[:, None] + legs_rx[None]) / SPEED_OF_LIGHT
        cycles = (
            waveform.start_frequency * delay[..., None]
            + waveform.slope * delay[..., None] * times
            - 0.5 * waveform.slope * delay[..., None].square()
        )
        phasor = torch.exp(2j * math.pi * cycles)
        frames.append((paths.coefficient[rows].conj()[:, None] * phasor).sum(-2))
    return torch.stack(frames)
