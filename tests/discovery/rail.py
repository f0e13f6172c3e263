"""Range profiles of ideal points along a rail, computed beside the package's own simulation."""

from collections.abc import Mapping

import torch

from invertwin.capture import Capture
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar.radar import Radar
from invertwin.radar.waveform import Impulse
from invertwin.scene.antenna import AntennaArray

TARGET = (7.0, 0.4, 0.1)
OTHER = (7.1, 1.2, 0.1)


def rail_capture(
    targets: Mapping[tuple[float, ...], float], frames: int = 121, noise: float = 0.0
) -> Capture:
    """A pulse radar on a rail of 3.6 m, and points with amplitudes."""
    along = torch.linspace(-1.8, 1.8, frames, dtype=torch.float64)
    positions = torch.nn.functional.pad(along[:, None], (1, 1))
    ranges = 5 + 0.02 * torch.arange(200, dtype=torch.float64)
    waveform = Impulse(4e9, 1.5e9)
    generator = torch.Generator().manual_seed(3)
    profile = noise * torch.randn(frames, 200, dtype=torch.complex128, generator=generator)
    for place, amplitude in targets.items():
        offset = ranges - (positions - torch.tensor(place)).norm(dim=1, keepdim=True)
        phase = 4 * torch.pi * waveform.center_frequency / SPEED_OF_LIGHT * offset
        pulse = torch.exp(-((offset / 0.085) ** 2))
        profile += amplitude * torch.polar(pulse, phase)
    antenna = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    radar = Radar(antenna, antenna, waveform, positions)
    return Capture.from_range_profile(profile, ranges, radar)
