"""Hand-built paths: the radar is tested without a ray tracer."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from invertwin.channel import Paths
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.radar import FMCW, Radar
from invertwin.scene.antenna import linear_array, planar_array


@pytest.fixture(scope="session")
def point_paths() -> Callable[..., Paths]:
    """One-bounce field paths of points with given coefficients, seen by every frame."""

    def build(radar: Radar, points: Tensor, coefficient: Tensor, frame: Tensor | None = None):
        points = points.to(torch.float64).reshape(-1, 3)
        if frame is None:
            frame = torch.zeros(len(points), dtype=torch.int64)
        link = radar.link()
        tx, rx = link.tx[frame], link.rx[frame]
        length = (points - tx).norm(dim=-1) + (points - rx).norm(dim=-1)
        return Paths(
            frame=frame,
            delay=length / SPEED_OF_LIGHT,
            coefficient=coefficient.to(torch.complex128).reshape(-1),
            power=torch.zeros(len(points), dtype=torch.float64),
            first=points,
            last=points,
            kind="rough",
            boundary=torch.zeros(len(points), dtype=torch.bool),
        )

    return build


@pytest.fixture(scope="session")
def waveform() -> FMCW:
    """77 GHz, 1 GHz of bandwidth, 64 samples: 0.15 m cells, 9.6 m unambiguous."""
    return FMCW(76.5e9, 1e9, 40e-6, 64)


@pytest.fixture(scope="session")
def planar(waveform: FMCW) -> Radar:
    """One transmitter, 12 × 8 receivers."""
    half = 0.5 * waveform.wavelength
    return Radar(
        linear_array(1, half),
        planar_array((12, 8), (half, half)),
        waveform,
        torch.zeros(1, 3, dtype=torch.float64),
    )


@pytest.fixture(scope="session")
def mimo(waveform: FMCW) -> Radar:
    """A column of 8 transmitters and a row of 12 receivers: the same virtual array."""
    half = 0.5 * waveform.wavelength
    return Radar(
        linear_array(8, half, "z"),
        linear_array(12, half),
        waveform,
        torch.zeros(1, 3, dtype=torch.float64),
    )


@pytest.fixture(scope="session")
def linear(waveform: FMCW) -> Radar:
    """One transmitter, 16 receivers in a row."""
    half = 0.5 * waveform.wavelength
    return Radar(
        linear_array(1, half),
        linear_array(16, half),
        waveform,
        torch.zeros(1, 3, dtype=torch.float64),
    )
