"""Echoes in the coherent image of a dense track."""

import pytest
import torch

from discovery.rail import OTHER, TARGET, rail_capture
from invertwin.discovery.imaging.point_detections import find_image_peak, locate_coherent_points


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
