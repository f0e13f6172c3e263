"""Faults that samples show: each is found with its evidence, and sound look-alikes are not."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from invertwin.capture import Capture, ChirpCapture, find_faults, search_ranges
from invertwin.radar import FMCW, Chirps, Leakage, Radar, leakage_signal
from invertwin.scene.antenna import linear_array
from oracles.moving_point import moving_point

CHIRP = FMCW(start_frequency=77e9, bandwidth=1e9, duration=16e-6, samples=64)
RADAR = Radar(
    linear_array(2, 2 * CHIRP.wavelength),
    linear_array(4, CHIRP.wavelength / 2),
    CHIRP,
    torch.zeros(1, 3, dtype=torch.float64),
)
CHIRPS = Chirps(8, 25e-6)
CELL = CHIRP.range_resolution


def beat(*echoes: tuple[float, float, float], rate: float = 0.0, noise: float = 0.03) -> Tensor:
    """Echoes (cells, u, amplitude) in noise."""
    parts = [moving_point(RADAR, CHIRPS, r * CELL, rate, u, amplitude=a) for r, u, a in echoes]
    generator = torch.Generator().manual_seed(1)
    white = torch.randn(parts[0].shape, generator=generator, dtype=torch.complex128)
    return torch.stack(parts).sum(0) + noise * white


def names(samples: Tensor, **options: float) -> list[str]:
    return [fault.name for fault in find_faults(ChirpCapture(samples, RADAR, CHIRPS), **options)]


ECHOES = beat((11.3, 0.2, 1.0), (23.7, -0.4, 0.5))


@pytest.mark.parametrize(
    "samples",
    [
        ECHOES,
        beat((11.3, 0.3, 1.0), (11.3, -0.3, 1.0)),
        beat((11.3, 0.3, 1.0), (64 - 11.3, -0.3, 1.0)),
        beat((11.3, 0.2, 1.0), (43.3, -0.4, 0.3)),
        beat((11.3, 0.2, 1.0), rate=3.0),
        beat((11.3, 0.2, 1.0), noise=0.0),
        beat((11.3, 0.2, 1.0), noise=3.0),
        (beat((11.3, 0.2, 1.0)) * 200).real.round()
        + 1j * (beat((11.3, 0.2, 1.0)) * 200).imag.round(),
    ],
    ids=["two", "pair", "mirrored", "half apart", "mover", "clean", "noisy", "rounded"],
)
def test_sound_recordings_are_not_faulty(samples):
    assert names(samples) == []
    assert find_faults(Capture.from_beat(samples[:, 0], RADAR)) == []


def test_real_samples_done_rightly_are_sound():
    positive = torch.fft.fft(ECHOES.real)
    positive[..., 33:] = 0
    positive[..., 1:32] *= 2
    analytic = torch.fft.ifft(positive)
    assert find_faults(ChirpCapture(analytic, RADAR, CHIRPS, real=True)) == []
    assert find_faults(Capture.from_beat(analytic[:, 0], RADAR)) == []


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_complex_by_type(turn):
    """Also on a turned line, as after a calibration."""
    samples = ECHOES.real * torch.polar(torch.tensor(1.0).double(), torch.tensor(turn).double())
    (found,) = find_faults(ChirpCapture(samples, RADAR, CHIRPS))
    assert found.name == "complex only by type"
    assert "have a coherence of 1 (1 = real" in found.evidence
    assert names(ECHOES.real + 0.5j * ECHOES.imag) == ["ghosts"]


def test_odd_samples_with_another_gain():
    """A copy 26 dB below each echo, at the first echo's range plus half of the unambiguous one."""
    odd = torch.arange(64) % 2 == 1
    (found,) = find_faults(ChirpCapture(ECHOES * torch.where(odd, 0.95, 1.05), RADAR, CHIRPS))
    assert found.name == "ghosts"
    first, copy = 11.25 * CELL, 43.25 * CELL
    assert f"{first:.3g} m has a copy at {copy:.3g} m, 26 dB weaker" in found.evidence
    doubled = ECHOES[..., torch.arange(64) // 2 * 2]
    assert names(doubled) == ["ghosts"]


@pytest.mark.parametrize("rate", [0.0, 3.0])
def test_unlike_i_and_q(rate):
    """5 % of gain and 1.7° of phase: an image 30 dB below, of movers at the opposite rate."""
    echo = beat((11.25, 0.2, 1.0), rate=rate, noise=0.003)
    mixed = echo.real + 1.05j * (echo.imag * math.cos(0.03) + echo.real * math.sin(0.03))
    (found,) = find_faults(ChirpCapture(mixed, RADAR, CHIRPS))
    assert found.name == "ghosts"
    assert f"has a copy at {(64 - 11.25) * CELL:.3g} m, 31 dB weaker" in found.evidence
    assert "I and Q differ in gain" in found.evidence


def test_lost_packets():
    samples = ECHOES.clone()
    samples[0, 3, 1, :, 20:36] = 0
    (found,) = find_faults(ChirpCapture(samples, RADAR, CHIRPS))
    assert str(found).startswith(
        "dropped samples: 64 of 4096 samples are zeros in runs of up to 16"
    )


def test_silent_channels():
    dead = ECHOES.clone()
    dead[..., 2, :] = 0
    (found,) = find_faults(ChirpCapture(dead, RADAR, CHIRPS))
    assert found.name == "silent channels"
    assert found.evidence.startswith("2 of 8 channels are zeros (TX 1 with RX 3, TX 2 with RX 3)")
    assert "silent channels" not in names(0 * ECHOES)


@pytest.mark.parametrize("chirp", [slice(None), slice(5, 6)], ids=["all", "one"])
def test_a_phase_that_jumps(chirp):
    samples = ECHOES.clone()
    samples[:, chirp, ..., 40:] *= 1j
    (found,) = find_faults(ChirpCapture(samples, RADAR, CHIRPS))
    assert found.name == "phase break"
    where = int(found.evidence.split()[1])
    assert abs(where - 40) <= 4


def test_what_settles_at_the_start_of_a_ramp_is_no_break():
    samples = ECHOES.clone()
    samples[..., :7] *= 1j
    assert names(samples) == []


def test_leakage_is_the_strongest():
    """2 cells wide, so that its sidelobes outshine the echoes; and within 0.3 m, where shown."""
    over_board = leakage_signal(Leakage(0.4e-9, -0.1), RADAR)
    weak = 2e-3 * beat((11.3, 0.2, 1.0), noise=0.003)
    (found,) = find_faults(ChirpCapture(weak + over_board, RADAR, CHIRPS))
    assert found.name == "leakage"
    assert names(0.05 * ECHOES + over_board) == []
    (found,) = find_faults(ChirpCapture(0.1 * ECHOES + over_board, RADAR, CHIRPS), range_min=0.0)
    assert f"strongest echo beyond is at {11.25 * CELL:.3g} m" in found.evidence
    assert names(0.1 * ECHOES + over_board, range_min=1.0) == []


def test_clipped_samples_pile_up():
    """12 % of a tone's values are beyond 1/1.02 of its amplitude; rounding alone is no clipping."""
    tone = beat((11.3, 0.2, 1.0), noise=0.001)
    parts = torch.view_as_real(tone)
    for limit, expected in ((1 / 1.1, ["saturation"]), (2.0, [])):
        rounded = (parts * 2047 / limit).round().clamp(-2048, 2047)
        assert names(torch.view_as_complex(rounded) * 1e-3) == expected


def test_ranges_that_are_shown():
    recording = ChirpCapture(ECHOES, RADAR, CHIRPS)
    assert search_ranges(recording, None, None) == pytest.approx((3 * CELL, 61 * CELL))
    real = replace(recording, real=True)
    assert search_ranges(real, 0.2, None) == pytest.approx((0.2, 29 * CELL))
    assert search_ranges(real, None, 3.0) == pytest.approx((3 * CELL, 3.0))
    assert math.isclose(CHIRP.max_range, 64 * CELL)
