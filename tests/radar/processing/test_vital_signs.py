"""Vital signs from profiles of a moving point beside echoes that stand still."""

import math

import pytest
import torch
from torch import Tensor

import invertwin as iw
from invertwin.errors import InputError
from invertwin.radar import estimate_vital_signs

WAVEFORM = iw.FMCW(start_frequency=60e9, bandwidth=2e9, duration=50e-6, samples=64)
ANTENNA = iw.linear_array(1, WAVEFORM.wavelength / 2)
RADAR = iw.Radar(ANTENNA, ANTENNA, WAVEFORM, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
GRID = RADAR.grid(range_min=0.5, range_max=2.0)
INTERVAL, COUNT = 0.05, 1200
TIMES = INTERVAL * torch.arange(COUNT, dtype=torch.float64)
ROW = 20


def sine(depth: float, rate: float, phase: float = 0.3) -> Tensor:
    """Displacement of a peak-to-peak depth [m]."""
    return 0.5 * depth * torch.sin(2 * math.pi * rate * TIMES + phase)


def profiles(displacement: Tensor, still: complex = 0.6 - 0.4j, noise: float = 0.02) -> Tensor:
    """Profiles of a point of amplitude 1 that moves towards the radar, in one bin."""
    random = torch.Generator().manual_seed(3)
    shape = COUNT, GRID.range_count
    found = torch.complex(*(torch.randn(shape, generator=random) for _ in range(2))).to(
        torch.complex128
    )
    found *= noise / math.sqrt(2)
    found[:, ROW] += still
    found[:, ROW] += torch.exp(-4j * math.pi * displacement / WAVEFORM.wavelength + 1j)
    return found


def test_frequencies_depths_and_their_deviations() -> None:
    """Breathing of 8 mm and a heart of 0.4 mm, with a strong harmonic of breathing beside it."""
    chest = sine(8e-3, 0.26) + sine(3e-4, 4 * 0.26, 1.0) + sine(4e-4, 1.17, 2.0)
    found = estimate_vital_signs(profiles(chest), RADAR, GRID, INTERVAL)
    assert found.range == pytest.approx(float(GRID.ranges[ROW]))
    breathing, heart = found.breathing, found.heart
    assert breathing is not None
    assert heart is not None
    assert breathing.depth == pytest.approx(8e-3, rel=0.02)
    assert heart.depth == pytest.approx(4e-4, rel=0.1)
    assert abs(breathing.frequency - 0.26) < 1e-3
    assert abs(heart.frequency - 1.17) < 4 * heart.deviation + 1e-3
    assert 1e-6 < heart.deviation < 5e-3
    error = found.displacement - (chest - chest.mean())
    assert float(error.abs().max()) < 3e-4


def test_deviation_of_a_frequency_is_that_of_the_bound() -> None:
    """Cramér-Rao: 24 σ² / (A² N³) for the angle of one sample to the next."""
    noise = 0.1
    found = estimate_vital_signs(profiles(sine(1e-3, 1.2), noise=noise), RADAR, GRID, INTERVAL)
    spread = noise / math.sqrt(2) * WAVEFORM.wavelength / (4 * math.pi)
    expected = math.sqrt(24 / COUNT**3) * spread / 5e-4 / (2 * math.pi * INTERVAL)
    assert found.heart is not None
    assert found.breathing is None
    assert found.heart.deviation == pytest.approx(expected, rel=0.2)


def test_noise_has_no_vital_signs() -> None:
    """An echo that stands still in noise shows neither."""
    found = estimate_vital_signs(profiles(0 * TIMES, noise=0.3), RADAR, GRID, INTERVAL)
    assert found.breathing is None
    assert found.heart is None


def test_the_best_channel_is_used() -> None:
    """Of two channels, one of which fades, the other one's displacement is returned."""
    good = profiles(sine(6e-3, 0.3))
    bad = good.clone()
    bad[:, ROW] *= 1 + 0.9 * torch.sin(2 * math.pi * 0.9 * TIMES)
    both = torch.stack([bad, good], 1)[:, :, None]  # time, receiver, transmitter, range
    found = estimate_vital_signs(both, RADAR, GRID, INTERVAL)
    alone = estimate_vital_signs(good, RADAR, GRID, INTERVAL)
    assert torch.equal(found.displacement, alone.displacement)
    assert alone.breathing is not None
    assert alone.breathing.depth == pytest.approx(6e-3, rel=0.02)


def test_short_and_slow_recordings_are_refused() -> None:
    """Neither ten seconds nor two profiles a second are enough."""
    chest = profiles(sine(8e-3, 0.26))
    with pytest.raises(InputError, match="record more"):
        estimate_vital_signs(chest[:200], RADAR, GRID, INTERVAL)
    with pytest.raises(InputError, match="record more"):
        estimate_vital_signs(chest[::10], RADAR, GRID, 10 * INTERVAL)
    with pytest.raises(InputError, match="profiles"):
        estimate_vital_signs(chest[:, :-1], RADAR, GRID, INTERVAL)
