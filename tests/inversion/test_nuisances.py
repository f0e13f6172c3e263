"""A range bias is found by a fit, and shows in its history."""

import pytest
import torch

from invertwin.capture import Capture
from invertwin.inversion import Optimizer, reconstruct
from invertwin.radar import RangeBias, Surrogate
from invertwin.scene.parameters import Translation
from invertwin.simulation import simulate

BIAS = 0.12


def test_range_bias_is_found_in_shifted_data(case):
    """A beat of frequency S 2b/c more is a target b farther."""
    with torch.no_grad():
        beat = simulate(case.scene, case.radar, case.grid, depth=1, density=3_000.0, seed=7).beat
    assert beat is not None
    waveform = case.radar.waveform
    phase = 2 * torch.pi * waveform.slope * 2 * BIAS / 299_792_458.0 * waveform.sample_times
    shifted = Capture.from_beat(beat * torch.polar(torch.ones_like(phase), phase), case.radar)
    bias = RangeBias()
    found = reconstruct(
        case.scene,
        case.radar,
        shifted,
        [],
        nuisances=[bias],
        **case.settings(steps=40, optimizer=Optimizer(rate=0.02)),
    )
    assert float(bias.bias.detach()) == pytest.approx(BIAS, abs=0.01)
    assert found.history[-1]["values"].keys() == {"range_bias"}
    assert found.scene["plate"].center.equal(case.scene["plate"].center)


def test_nuisances_are_named_in_the_history(case):
    found = reconstruct(
        case.scene,
        case.radar,
        case.capture,
        [Translation("plate")],
        nuisances=[RangeBias(0.05)],
        **case.settings(steps=2, samples=2_000, boundary_samples=500, surrogate=Surrogate()),
    )
    assert found.history[-1]["values"].keys() == {"plate.translation", "range_bias"}
