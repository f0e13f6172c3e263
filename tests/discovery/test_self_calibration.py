"""Calibration of the channels on a scene that nobody knows."""

import math
from functools import cache

import pytest
import torch

import invertwin as iw
from invertwin.capture import ChannelCalibration
from invertwin.discovery.self_calibration import calibrate_on_scene, phase_spread
from invertwin.scene import RoughDielectric, box, linear_array, look_at, rigid

CHIRP = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=128)
PLACES = 12


@cache
def recording() -> iw.Capture:
    """Two boxes from places on a circle of 3 m, with noise."""
    half = CHIRP.wavelength / 2
    angle = 2 * math.pi * torch.arange(PLACES, dtype=torch.float64) / PLACES
    places = 3 * torch.stack([angle.sin(), angle.cos(), 0 * angle], dim=1)
    tx, rx = linear_array(2, 4 * half), linear_array(4, half)
    radar = iw.Radar(tx, rx, CHIRP, places, look_at(places, [0, 0, 0]))
    paint = RoughDielectric(permittivity=4.0)
    scene = iw.Scene(
        {
            "one": iw.Object(box(0.4), paint, rigid(translation=[0.3, 0.7, 0.0])),
            "two": iw.Object(box([0.6, 0.2, 0.4]), paint, rigid(translation=[-0.5, -0.6, 0.0])),
        }
    )
    sampling = iw.Sampling(depth=1, points_per_m2=1e3)
    with torch.no_grad():
        beat = iw.simulate(
            scene, radar, radar.grid(0.5, 5.0), sampling=sampling, seed=1, snr_db=15.0
        ).beat
    return iw.Capture.from_beat(beat, radar)


def gains(seed: int) -> torch.Tensor:
    """Any phases, and amplitudes within 6 dB."""
    generator = torch.Generator().manual_seed(seed)
    phase, level = torch.rand(2, 2, 4, generator=generator, dtype=torch.float64)
    return torch.polar(10 ** (0.3 * (level - 0.5)), 2 * math.pi * phase)


def found(capture: iw.Capture) -> ChannelCalibration | None:
    radar = capture.radar()
    ends = torch.arange(-1.5, 1.5, 0.06, dtype=torch.float64)
    flat = torch.cartesian_prod(ends, ends)
    places = torch.cat([flat, torch.zeros(len(flat), 1)], dim=1).double()
    return calibrate_on_scene(capture, radar.grid(0.5, 5.0), places)


@pytest.mark.parametrize("seed", [0, 1])
def test_any_phases_and_levels_are_found(seed):
    wrong = gains(seed)
    spoilt = ChannelCalibration(1 / wrong).apply(recording())
    told = found(spoilt)
    assert told is not None
    left = told.gains / wrong
    left = left / left[0, 0]
    assert float(left.angle().abs().max()) < math.radians(6)
    assert float(20 * left.abs().log10().abs().max()) < 1.5
    assert phase_spread(told, spoilt.radar()) > 30


def test_channels_that_agree_are_left_alone():
    assert found(recording()) is None


def test_a_ramp_of_phases_is_a_turn_of_the_radar():
    radar = recording().radar()
    y = radar.virtual_positions[:, 1].reshape(2, 4) / CHIRP.wavelength
    ramp = ChannelCalibration(torch.polar(torch.ones(2, 4).double(), 2 * math.pi * 0.23 * y))
    assert phase_spread(ramp, radar) < 2
    bent = ChannelCalibration(torch.polar(torch.ones(2, 4).double(), 2 * y**2))
    assert phase_spread(bent, radar) > 30


@pytest.mark.parametrize("frames", [range(4), [0] * 12], ids=["few", "one, often"])
def test_few_positions_tell_nothing(frames):
    few = recording().frames(frames)
    spoilt = ChannelCalibration(1 / gains(0)).apply(few)
    assert found(spoilt) is None
