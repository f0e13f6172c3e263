"""A range bias is found by a fit, and shows in its history."""

from dataclasses import replace

import pytest
import torch

from fits import fit
from invertwin.capture import Capture
from invertwin.channel import Sampling
from invertwin.inversion import LatentNorm, Optimizer, Unknown
from invertwin.radar import RadarTrajectory, RangeBias, Surrogate
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


def test_a_drifting_path_is_found_and_held_by_its_odometry(case):
    """Known surfaces show where the radar was; a heavy prior leaves it where odometry says."""
    start = torch.linspace(-0.3, 0.3, 5).double()[:, None] * float64([0, 1, 0])
    said = replace(case.radar, positions=start, rotations=None)
    drifted = RadarTrajectory(2, drift=0.04, axes="x")
    with torch.no_grad():
        drifted.latent[:, 0] = float64([1.5, 1.0])
        drawn = Sampling(depth=1, points_per_m2=3_000.0)
        real = drifted(said)
        beat = simulate(case.scene, real, case.grid, sampling=drawn, seed=7).beat
    capture = Capture.from_beat(beat, said)

    def refined(weight: float) -> torch.Tensor:
        path = RadarTrajectory(2, drift=0.04, axes="x")
        own = Unknown(path, regularize=lambda module, _: [LatentNorm(module, weight)])
        settings = case.settings(steps=80, optimizer=Optimizer(rate=0.1))
        found = fit(case.scene, said, capture, [], of_radar={"path": own}, **settings)
        assert torch.equal(found.sensors[0].positions, path(said).positions.detach())
        return (found.sensors[0].positions - said.positions)[:, 0]

    truth = (real.positions - said.positions)[:, 0]
    assert float(truth[-1]) == pytest.approx(0.1)
    assert (refined(1e-3) - truth).abs().max() < 0.015
    assert refined(100.0).abs().max() < 0.01
