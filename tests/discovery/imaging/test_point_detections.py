"""Echoes in the coherent image of a dense track."""

import math

import pytest
import torch

import invertwin as iw
from discovery.rail import OTHER, TARGET, rail_capture
from invertwin.capture import ChirpCapture
from invertwin.discovery import DetectedObject
from invertwin.discovery.imaging.point_detections import (
    detect_moving_targets,
    find_image_peak,
    locate_coherent_points,
)
from invertwin.radar import Chirps
from invertwin.scene import linear_array


def image_peak(capture, center, radius):
    found = find_image_peak(capture, center, radius)
    assert found is not None
    return found


def test_the_brightest_echo_of_a_disc_is_found():
    capture = rail_capture({TARGET: 1.0, OTHER: 3.0})
    start = torch.tensor(TARGET, dtype=torch.float64) + torch.tensor([0.2, -0.1, 0.0]).double()
    place, power = image_peak(capture, start, 0.4)
    assert (place - torch.tensor(TARGET)).norm() < 0.03
    assert power == pytest.approx(1.0, abs=0.05)
    place, power = image_peak(capture, start, 1.5)
    assert (place - torch.tensor(OTHER)).norm() < 0.03
    assert power == pytest.approx(9.0, abs=0.5)


def test_a_disc_may_leave_the_measured_ranges():
    place, _ = image_peak(rail_capture({TARGET: 1.0}), torch.tensor(TARGET).double(), 2.6)
    assert (place - torch.tensor(TARGET)).norm() < 0.03


def test_noise_has_no_echo():
    capture = rail_capture({}, noise=1.0)
    assert find_image_peak(capture, torch.tensor(TARGET).double(), 0.5) is None


def test_a_sparse_track_has_no_image():
    capture = rail_capture({TARGET: 1.0}, frames=20)
    assert find_image_peak(capture, torch.tensor(TARGET).double(), 0.5) is None


def test_beyond_the_measured_ranges_is_no_image():
    far = torch.tensor([30.0, 0.0, 0.1], dtype=torch.float64)
    assert find_image_peak(rail_capture({TARGET: 1.0}), far, 0.5) is None


def test_points_lie_on_their_peaks_not_on_the_nodes_of_the_search():
    line = torch.arange(-1.0, 1.01, 0.09, dtype=torch.float64)
    nodes = torch.nn.functional.pad(torch.cartesian_prod(7.04 + line, 0.44 + line), (0, 1))
    nodes[:, 2] = 0.1
    (found, *_), _ = locate_coherent_points(rail_capture({TARGET: 1.0}), nodes, 0.3)
    assert float((nodes - torch.tensor(TARGET)).norm(dim=1).min()) > 0.035
    assert (found.position - torch.tensor(TARGET)).norm() < 0.02


RAMP = iw.FMCW(start_frequency=77e9, bandwidth=1e9, duration=50e-6, samples=128)


def movers(elements: int, chirps: int, seed: int, amplitude: float) -> list[DetectedObject]:
    """Moving targets in noise of power 1, before a strong wall at rest; one target at 8 m/s."""
    place = torch.zeros(1, 3, dtype=torch.float64)
    row = linear_array(elements, RAMP.wavelength / 2)
    radar = iw.Radar(linear_array(1, 1.0), row, RAMP, place)
    train, random = Chirps(chirps, 60e-6), torch.manual_seed(seed)
    noise = torch.randn(1, chirps, 1, elements, 128, dtype=torch.complex128, generator=random)
    samples = torch.arange(128, dtype=torch.float64)
    wall = 100 * torch.exp(2j * math.pi * 0.12 * samples)
    turns = 0.3 * samples + 2 * 8.0 / RAMP.wavelength * train.times(1)[:, :, None, None]
    beat = noise + wall + amplitude * torch.exp(2j * math.pi * turns)
    recording = ChirpCapture(beat, radar, train)
    return detect_moving_targets(recording, recording.radar().grid(0.6, 19.0))


@pytest.mark.slow
@pytest.mark.parametrize(("elements", "chirps"), [(2, 16), (3, 16), (4, 32)])
def test_noise_before_a_wall_at_rest_has_no_movers(elements, chirps):
    """A level that noise reaches in every second frame was listed with a confidence of 0.5."""
    found = [movers(elements, chirps, seed, 0.0) for seed in range(30)]
    assert sum(map(bool, found)) <= 1


def test_a_mover_well_above_the_noise_is_listed():
    for seed in range(3):
        (one,) = movers(2, 16, seed, 0.3)  # sum over chirps, elements and samples: 25 dB
        assert one.existence_probability > 0.98
        assert one.velocity is not None
        assert float(one.velocity.norm()) == pytest.approx(8.0, abs=1.2)
        assert float(one.position.norm()) == pytest.approx(0.3 * RAMP.max_range, abs=0.1)
