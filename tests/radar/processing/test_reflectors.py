"""Points of one frame: several in one range, of one chirp too, and no sidelobes."""

import math

import pytest
import torch

from invertwin.radar import FMCW, Chirps, Radar, detect_points, format_points_csv
from invertwin.radar.boards import board
from invertwin.radar.processing.reflectors import _sidelobe_powers, noise_power
from invertwin.radar.waveform import unit_window
from oracles.moving_point import moving_point

ARRAYS = board("IWR6843ISK").arrays(elevation=1)
RADAR = Radar(*ARRAYS, FMCW(60e9, 1.28e9, 32e-6, 64), torch.zeros(1, 3, dtype=torch.float64))
GRID = RADAR.grid(0.4, 7.0)
# Range, range rate, u, v, amplitude; the first two share a range.
POINTS = (
    (3.0, 0.0, 0.3, 0.0, 1.0),
    (3.0, 0.0, -0.4, 0.0, 0.7),
    (4.5, 0.0, 0.1, 0.2, 0.5),
    (2.0, 0.3, 0.0, 0.0, 0.3),
)


def noise(shape: torch.Size) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(shape, generator=generator, dtype=torch.complex128)


@pytest.mark.parametrize("count", [1, 4, 32])
@pytest.mark.parametrize("level", [0.3, 1e-3])
def test_each_reflector_is_a_point(count, level):
    """At any noise: sidelobes of the strong ones are not among them."""
    chirps = Chirps(count, 40e-6)
    beat = torch.stack([moving_point(RADAR, chirps, *p[:4], amplitude=p[4]) for p in POINTS]).sum(0)
    beat = beat + level * noise(beat.shape)
    found = detect_points(beat, RADAR, GRID, None if count == 1 else chirps, 0)
    assert len(found) == len(POINTS)
    rows = found.power.argsort(descending=True).tolist()
    for i, (distance, rate, u, v, amplitude) in zip(rows, POINTS, strict=True):
        assert float(found.range[i]) == pytest.approx(distance, abs=0.03)
        assert float(found.u[i]) == pytest.approx(u, abs=0.04)
        assert float(found.v[i]) == pytest.approx(v, abs=0.06)
        assert float(found.power[i].sqrt()) == pytest.approx(amplitude, rel=0.2)
        assert float(found.position[i, 1]) == pytest.approx(distance * u, abs=0.15)
        if count == 1:
            assert bool(found.velocity[i].isnan())
        elif count == 32:
            assert float(found.velocity[i]) == pytest.approx(rate, abs=0.1)


@pytest.mark.parametrize("count", [1, 32])
def test_noise_has_no_points(count):
    chirps = Chirps(count, 40e-6)
    beat = noise(torch.Size([1, count, 3, 4, 64]))
    found = detect_points(beat, RADAR, GRID, None if count == 1 else chirps, 0)
    assert len(found) <= 1
    assert format_points_csv(found).startswith("range_m,velocity_m_s,u,v,power_db,x_m,y_m,z_m\n")


@pytest.mark.parametrize("count", [1, 32])
@pytest.mark.parametrize("place", [0.0, 0.15, 7.4])
def test_what_lies_outside_of_the_grid_has_no_comb_of_sidelobes(count, place):
    """An offset of the converter, leakage, an echo beyond: 20 dB above what is in the grid."""
    chirps = Chirps(count, 40e-6)
    inside = moving_point(RADAR, chirps, 3.0, 0.0, 0.2)
    outside = moving_point(RADAR, chirps, place, 0.0, 0.0, amplitude=10.0)
    beat = inside + outside + 1e-3 * noise(inside.shape)
    found = detect_points(beat, RADAR, GRID, None if count == 1 else chirps, 0)
    assert len(found) == 1
    assert float(found.range[0]) == pytest.approx(3.0, abs=0.03)


def test_sidelobes_are_those_of_the_windows():
    rates, ranges = _sidelobe_powers(16, 20, RADAR, GRID)
    beside = torch.tensor([-0.5, 0.0, 0.5], dtype=torch.float64)
    weight = unit_window("hamming", 16).to(torch.complex128)
    for bins in (0, 1, 5, 15):
        turns = (bins + beside)[:, None] / 16 * torch.arange(16)
        expected = (torch.exp(2j * math.pi * turns) @ weight).abs().square().max()
        assert float(rates[bins]) == pytest.approx(float(expected), rel=1e-6)
        distance = (bins + beside) * GRID.range_step
        expected = RADAR.waveform.range_response(distance, RADAR.window).max()
        assert float(ranges[bins]) == pytest.approx(float(expected), rel=1e-6)
    assert (len(rates), len(ranges)) == (16, 20)


def test_noise_power_of_any_quantile():
    looks = noise(torch.Size([8, 40_000])).abs().square().mean(0)
    for empty in (0.2, 0.5):
        assert noise_power(looks, 8, empty) == pytest.approx(1.0, rel=0.02)
