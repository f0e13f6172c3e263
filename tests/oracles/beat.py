"""Slow reference of the beat signal: the plain sum over paths, element by element."""

import math

import torch
from torch import Tensor

from invertwin.channel import Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar import FMCW, OFDM, Radar, SteppedFrequency


def beat(paths: Paths, radar: Radar) -> Tensor:
    """[frame, tx, rx, sample], from exact lengths in float64."""
    link, (tx, rx) = radar.link(), radar.elements()
    frames = []
    for frame in range(radar.frame_count):
        rows = paths.frame == frame
        first, last = paths.first[rows], paths.last[rows]

        def excess(points: Tensor, elements: Tensor, center: Tensor) -> Tensor:
            return (points - elements[:, None]).norm(dim=-1) - (points - center).norm(dim=-1)

        legs_tx = excess(first, tx[frame], link.tx[frame])
        legs_rx = excess(last, rx[frame], link.rx[frame])
        delay = paths.delay[rows] + (legs_tx[:, None] + legs_rx[None]) / SPEED_OF_LIGHT
        cycles = sample_cycles(radar, delay[..., None])
        phasor = torch.exp(2j * math.pi * cycles)
        frames.append((paths.coefficient[rows].conj()[:, None] * phasor).sum(-2))
    return torch.stack(frames)


def sample_cycles(radar: Radar, delay: Tensor) -> Tensor:
    """Phase of every sample in cycles, as each waveform's textbook has it."""
    waveform = radar.waveform
    if isinstance(waveform, FMCW):
        # Transmit phase now, less that of one delay ago.
        times = waveform.sample_times
        return (
            waveform.start_frequency * delay
            + waveform.slope * delay * times
            - 0.5 * waveform.slope * delay.square()
        )
    if isinstance(waveform, SteppedFrequency):
        tones = [waveform.start_frequency + n * waveform.step for n in range(waveform.samples)]
    else:
        assert isinstance(waveform, OFDM)
        tones = [
            waveform.start_frequency + n * waveform.spacing for n in range(waveform.subcarriers)
        ]
    return torch.tensor(tones, dtype=torch.float64) * delay
