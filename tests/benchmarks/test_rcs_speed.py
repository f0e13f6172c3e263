"""The timed corner in small: its plates are joined, its echo is known, batches change nothing."""

import json
import math

import pytest
import torch


def test_the_plates_of_the_corner_share_vertices(rcs_speed):
    mesh = rcs_speed.corner(4)["corner"].mesh
    assert len(mesh.faces) == 3 * 2 * 4**2
    # Three joints of five vertices, of which one is common.
    assert len(mesh.vertices) == 3 * 25 - 3 * 5 + 1
    assert mesh.vertices.amin() == 0
    assert float(mesh.vertices.amax()) == pytest.approx(rcs_speed.EDGE)


def test_the_sweep_crosses_the_axis(rcs_speed):
    directions = rcs_speed.azimuth_sweep(3)
    assert torch.allclose(directions[1], torch.full((3,), 3**-0.5, dtype=torch.float64))
    assert torch.allclose(directions.norm(dim=1), torch.ones(3, dtype=torch.float64))


@pytest.mark.slow
def test_small_sweep_has_the_echo_of_the_corner(rcs_speed, tmp_path):
    metrics = rcs_speed.measure(aspects=3, divisions=4, frequency=10e9)
    assert metrics["triangles"] == 96
    assert metrics["alone_error"] < 1e-9
    # A square corner of 10 wavelengths, without the diffraction of its edges.
    assert metrics["peak_error_db"] < 0.3
    assert 0 < metrics["seconds"] < math.inf
    rcs_speed.write(metrics, rcs_speed.table(metrics).grid, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
