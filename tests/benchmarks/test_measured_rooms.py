"""The measured worlds: their parts agree with closed forms, and a twin beats the power law."""

import math

import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT
from scenes import float64


def frequencies_of(module):
    bins = torch.arange(module.BINS).double() / module.BINS - 0.5
    return module.FREQUENCY + module.BANDWIDTH * bins


def test_two_equal_paths_have_half_their_distance_as_spread(measured_rooms):
    frequencies, apart = frequencies_of(measured_rooms), 100e-9
    delays = float64([50e-9, 50e-9 + apart])
    response = torch.polar(
        torch.ones(128, 2).double(), -2 * math.pi * frequencies[:, None] * delays
    )
    found = measured_rooms.measured_spreads(response.sum(1)[None, None])
    assert float(found) == pytest.approx(apart / 2, rel=0.01)


def test_what_is_weaker_than_the_dynamic_range_counts_for_nothing(measured_rooms):
    frequencies = frequencies_of(measured_rooms)
    strengths = float64([1.0, 10 ** (-30 / 20)])
    phases = -2 * math.pi * frequencies[:, None] * float64([50e-9, 250e-9])
    weak = torch.polar(strengths.expand(128, 2), phases).sum(1)[None, None]
    alone = torch.polar(strengths[:1].expand(128, 1), phases[:, :1]).sum(1)[None, None]
    found, expected = (float(measured_rooms.measured_spreads(h)) for h in (weak, alone))
    assert found == pytest.approx(expected, rel=0.05)


def test_the_graph_decays_with_the_gain_of_its_edges(measured_rooms, monkeypatch):
    # A bounce takes the mean distance and leaves the square of the gain.
    monkeypatch.setattr(measured_rooms, "SCATTERERS", 60)
    frequencies = frequencies_of(measured_rooms)
    generator = torch.Generator().manual_seed(3)
    tx, rx = (
        float64([place]) * measured_rooms.SIZE for place in ((0.2, 0.3, 0.5), (0.8, 0.6, 0.5))
    )
    window = torch.hann_window(measured_rooms.BINS, periodic=False, dtype=torch.float64)
    power = torch.zeros(measured_rooms.BINS).double()
    for _ in range(12):
        response = measured_rooms.reverberate(generator, tx, rx, frequencies)[0, 0]
        power += torch.fft.ifft(window * response).abs().square()
    delay = torch.arange(measured_rooms.BINS) / measured_rooms.BANDWIDTH
    late = (delay > 60e-9) & (delay < 220e-9)
    slope = torch.linalg.lstsq(
        torch.stack([delay[late], torch.ones(int(late.sum()))], 1).double(), power[late, None].log()
    ).solution[0]
    ends = measured_rooms.SIZE * torch.rand(2, 20_000, 3, generator=generator, dtype=torch.float64)
    bounce = float((ends[0] - ends[1]).norm(dim=1).mean()) / SPEED_OF_LIGHT
    expected = 2 * math.log(measured_rooms.GRAPH_GAIN) / bounce
    assert float(slope) == pytest.approx(expected, rel=0.15)


def test_a_power_law_is_found(measured_rooms):
    tx, rx = float64([[0.0, 0.0, 0.0]]), float64([[float(x), 1.0, 0.0] for x in range(10)])
    levels = -40 - 25 * torch.cdist(tx, rx).log10()
    world = measured_rooms.World(tx, rx, levels, torch.ones_like(levels))
    errors = measured_rooms.power_law_errors(world)
    assert errors.shape == (1, 8)
    assert errors.abs().max() < 1e-9


@pytest.mark.slow
def test_a_calibrated_twin_beats_the_power_law(measured_rooms, monkeypatch):
    monkeypatch.setattr(measured_rooms, "FURNITURE", 2)
    monkeypatch.setattr(measured_rooms, "RECEIVERS", 20)
    monkeypatch.setattr(measured_rooms, "EACH", 2)
    metrics = measured_rooms.measure(1)
    assert metrics["links"] == 4 * 10
    assert metrics["level_ratio"] < 0.8
    assert 1 <= metrics["spread_factor"] < 1.4
