"""The beat signal of moving points, sample by sample: no ray tracer, no paths, no transform."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar import FMCW, Chirps, Radar


def moving_beat(
    radar: Radar,
    chirps: Chirps,
    place: Callable[[Tensor], Tensor],
    coefficient: Tensor | float = 1.0,
) -> Tensor:
    """[frame, chirp, tx, rx, sample] of points at ``place(times)``, [..., point] → [..., point, 3].

    A sample received at a time comes from the point where it was one way back earlier, found by
    repeated substitution; conj(a) exp(2πj (f0 τ + S τ t_n − S τ²/2)) with the delay τ from the
    transmitter over that place to the receiver.
    """
    waveform = radar.waveform
    assert isinstance(waveform, FMCW)
    coefficient = torch.as_tensor(coefficient, dtype=torch.complex128)
    all_tx, all_rx = radar.elements()
    starts = chirps.times(all_tx.shape[1])
    beat = torch.zeros(
        (len(all_tx), *starts.shape, all_rx.shape[1], waveform.samples), dtype=torch.complex128
    )
    for frame, chirp, tx, rx in torch.cartesian_prod(*map(torch.arange, beat.shape[:-1])).tolist():
        received = starts[chirp, tx] + waveform.sample_times
        points = place(received[:, None].expand(-1, coefficient.numel()))
        for _ in range(2):
            back = (points - all_rx[frame, rx]).norm(dim=-1)
            points = place(received[:, None] - back / SPEED_OF_LIGHT)
        sent, back = (
            (points - all_tx[frame, tx]).norm(dim=-1),
            (points - all_rx[frame, rx]).norm(dim=-1),
        )
        delay = (sent + back) / SPEED_OF_LIGHT
        swept = waveform.slope * (waveform.sample_times[:, None] - 0.5 * delay)
        cycles = delay * (waveform.start_frequency + swept)
        beat[frame, chirp, tx, rx] = (torch.exp(2j * math.pi * cycles) * coefficient.conj()).sum(-1)
    return beat


def moving_point(
    radar: Radar,
    chirps: Chirps,
    distance: float,
    rate: float,
    u: float,
    v: float = 0.0,
    amplitude: float = 1.0,
) -> Tensor:
    """Beat signals of one point that moves along its line of sight.

    Distance [m] and direction are those in the frame of each pose, from the middle of the phase
    centres, at the middle of the burst; the range rate [m/s] is positive away.
    """
    ray = torch.tensor([math.sqrt(1 - u**2 - v**2), u, v], dtype=torch.float64)
    middle = chirps.times(len(radar.transmitters.positions)).mean()
    link = radar.link()
    beats = []
    for frame in range(radar.frame_count):
        origin = 0.5 * (link.tx + link.rx)[frame]
        along = link.rotations[frame] @ ray

        def place(times: Tensor, origin: Tensor = origin, along: Tensor = along) -> Tensor:
            return origin + (distance + rate * (times - middle))[..., None] * along

        beats.append(moving_beat(radar.frames([frame]), chirps, place, amplitude)[0])
    return torch.stack(beats)
