"""Unknowns of a radar in a fit: what a measurement gets wrong about itself."""

import pytest
import torch

from fits import fit
from invertwin.capture import Capture, Track
from invertwin.channel import Sampling
from invertwin.inversion import Optimizer
from invertwin.radar import FMCW, Radar, Surrogate
from invertwin.radar.parameters import ClockOffset, RangeBias
from invertwin.scene.antenna import AntennaArray
from invertwin.scene.parameters import Translation
from invertwin.simulation import simulate
from scenes import float64

BIAS = 0.12


def test_range_bias_is_found_in_shifted_data(case):
    """A beat of frequency S 2b/c more is a target b farther."""
    with torch.no_grad():
        drawn = Sampling(depth=1, points_per_m2=3_000.0)
        beat = simulate(case.scene, case.radar, case.grid, sampling=drawn, seed=7).beat
    waveform = case.radar.waveform
    phase = 2 * torch.pi * waveform.slope * 2 * BIAS / 299_792_458.0 * waveform.sample_times
    shifted = Capture.from_beat(beat * torch.polar(torch.ones_like(phase), phase), case.radar)
    bias = RangeBias()
    found = fit(
        case.scene,
        case.radar,
        shifted,
        [],
        of_radar=[bias],
        **case.settings(steps=40, optimizer=Optimizer(rate=0.02)),
    )
    assert float(bias.bias.detach()) == pytest.approx(BIAS, abs=0.01)
    assert float(found.sensors[0].range_bias) == float(bias.bias.detach())
    assert found.history[-1]["values"].keys() == {"range_bias"}
    assert found.scene["plate"].center.equal(case.scene["plate"].center)


def recording() -> tuple[Capture, Radar]:
    """Empty range profiles of a radar on a track that bends."""
    one = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    times = torch.linspace(0, 1, 5, dtype=torch.float64)
    track = Track(float64([-1.0, 0.45, 2.0]), float64([[-1.0, 0, 0], [0.0, 0.2, 0], [1.5, 0, 0.1]]))
    radar = Radar(one, one, FMCW(76e9, 2e9, 50e-6, 64), track.at(times + 0.1))
    profile = torch.ones(5, 4, dtype=torch.complex128)
    capture = Capture.from_range_profile(
        profile, 1 + torch.arange(4).double(), radar, times, track=track, clock_offset=0.1
    )
    return capture, radar


def test_clock_offset_moves_the_radar_along_its_track():
    capture, radar = recording()
    still, shifted = (
        ClockOffset(capture.positions)(radar),
        ClockOffset(capture.positions, 0.15)(radar),
    )
    assert torch.allclose(still.positions, radar.positions)
    assert capture.track is not None
    assert torch.allclose(shifted.positions, capture.track.at(capture.times + 0.25))


def test_clock_offset_has_the_gradient_of_the_track():
    capture, radar = recording()
    module, step = ClockOffset(capture.positions, 0.02), 1e-4
    weights = torch.rand(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (weights * module(radar).positions).sum().backward()
    ends = [
        (weights * ClockOffset(capture.positions, 0.02 + s)(radar).positions).sum()
        for s in (step, -step)
    ]
    truth = float((ends[0] - ends[1]).detach()) / (2 * step)
    assert module.shift.grad is not None
    assert float(module.shift.grad) == pytest.approx(truth, rel=1e-6)


def test_unknowns_of_the_radar_are_named_in_the_history(case):
    found = fit(
        case.scene,
        case.radar,
        case.capture,
        [Translation("plate")],
        of_radar=[RangeBias(0.05)],
        **case.settings(steps=2, samples=2_000, boundary_samples=500, surrogate=Surrogate()),
    )
    assert found.history[-1]["values"].keys() == {"plate.translation", "range_bias"}
