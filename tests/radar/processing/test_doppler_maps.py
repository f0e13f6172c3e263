"""What moves: above the noise and drift of what stands still, in chirps without their mean."""

import math

import pytest
import torch

from invertwin.radar import FMCW, Chirps, Radar, doppler_maps, velocity_span
from invertwin.radar.boards import board
from oracles.moving_point import moving_point

ARRAYS = board("IWR6843ISK").arrays(elevation=1)
RADAR = Radar(*ARRAYS, FMCW(60e9, 1.28e9, 32e-6, 64), torch.zeros(1, 3, dtype=torch.float64))
CHIRPS = Chirps(32, 40e-6)
GRID = RADAR.grid(0.4, 7.0)
STILL = moving_point(RADAR, CHIRPS, 3.0, 0.0, 0.3)
BIN = velocity_span(RADAR, CHIRPS) / 32


def noise(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(STILL.shape, generator=generator, dtype=torch.complex128)


@pytest.mark.parametrize("rate", [1.0, 8.0, -12.0])
def test_a_weak_mover_is_found_beside_a_strong_echo(rate):
    """Also a slow one, next to range rate zero; 30 dB below what stands still."""
    mover = moving_point(RADAR, CHIRPS, 4.5, rate * BIN, -0.2, amplitude=0.03)
    maps = doppler_maps(STILL + mover + 0.1 * noise(1), RADAR, GRID, CHIRPS)
    assert maps.strongest_peak.range == pytest.approx(3.0, abs=0.06)
    assert maps.moving_peak is not None
    assert maps.moving_peak.range == pytest.approx(4.5, abs=0.06)
    assert maps.moving_peak.velocity == pytest.approx(rate * BIN, abs=BIN)
    assert maps.moving_peak.u == pytest.approx(-0.2, abs=0.1)
    assert maps.moving_power is not None
    assert GRID.ranges[int(maps.moving_power.amax((1, 2)).argmax())] == pytest.approx(4.5, abs=0.06)


def test_nothing_moves_in_noise():
    """One of a thousand recordings may; no one of these does."""
    for seed in range(10):
        maps = doppler_maps(STILL + 0.3 * noise(seed), RADAR, GRID, CHIRPS)
        assert maps.moving_peak is None
        assert maps.moving_power is None


def test_rounding_and_drift_do_not_move():
    assert doppler_maps(STILL, RADAR, GRID, CHIRPS).moving_peak is None
    assert doppler_maps(STILL.to(torch.complex64), RADAR, GRID, CHIRPS).moving_peak is None
    drift = torch.exp(1j * math.radians(3) * torch.linspace(-1, 1, 32, dtype=torch.float64))
    drifting = STILL * drift[:, None, None, None]
    assert doppler_maps(drifting + 0.01 * noise(1), RADAR, GRID, CHIRPS).moving_peak is None
