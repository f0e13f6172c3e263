"""Maps from above put echoes at their metres, whichever way the radar looks."""

import numpy as np
import pytest
import torch

import invertwin as iw
from invertwin import plotting
from invertwin.channel import Grid
from invertwin.scene.pose import rotation_from_vector

GRID = Grid(1.0, 0.05, 60, -0.8, 0.05, 33)
PLACES = torch.tensor([[0.0, -0.5, 0.3], [0.0, 0.5, 0.3]]).double()
TARGET = torch.tensor([2.0, 0.4, 0.3]).double()
PAINT = iw.RoughDielectric(permittivity=4.0)


def radar_at(positions, **pose):
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=3.6e9, duration=50e-6, samples=128)
    arrays = iw.linear_array(1, 0.002), iw.linear_array(8, 0.002)
    return iw.Radar(*arrays, chirp, positions=positions, **pose)


def echoes(radar, grid=GRID):
    """Power in the bin of the target alone, over faint noise."""
    power = torch.full((radar.frame_count, *grid.shape), 1e-4, dtype=torch.float64)
    away = torch.einsum("fij,fi->fj", radar.link().rotations, TARGET - radar.positions)
    ranges = away.norm(dim=1)
    rows = ((ranges - grid.range_start) / grid.range_step).round().long()
    columns = ((away[:, 1] / ranges - grid.u_start) / grid.u_step).round().long()
    columns = columns if grid.u_count > 1 else torch.zeros_like(rows)
    power[torch.arange(len(rows)), rows, columns] = 1.0
    return power


def brightest(axes):
    """Middle of the brightest cells of a map: x and y [m]."""
    mesh = axes.collections[0]
    corners = np.asarray(mesh.get_coordinates())
    level = np.asarray(np.ma.filled(mesh.get_array(), -np.inf)).reshape(corners[1:, 1:, 0].shape)
    middles = 0.25 * (corners[1:, 1:] + corners[:-1, 1:] + corners[1:, :-1] + corners[:-1, :-1])
    assert level.max() == 0.0
    return middles[level == 0].mean(0)[::-1].tolist()


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_an_echo_is_at_its_metres(turn):
    rotation = rotation_from_vector(torch.tensor([[0.0, 0.0, turn]] * 2).double())
    radar = radar_at(PLACES, rotations=rotation)
    marks = {"detections": TARGET[None] + torch.tensor([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.0]])}
    figure = plotting.from_above({"recording": echoes(radar)}, GRID, radar, marks)
    axes, bar = figure.axes
    assert brightest(axes) == pytest.approx(TARGET[:2].tolist(), abs=0.05)
    left, right = axes.get_xlim()
    assert left == pytest.approx(0.4 + 0.5 + 0.05 + 0.4)  # 5 % and eight bins beyond the mark
    assert right == pytest.approx(0.4 - 0.5 - 0.05 - 0.4)  # the left of the radar is on the left
    assert bar.get_ylabel() == "power [dB below peak]"
    (drawn,) = axes.get_lines()
    assert drawn.get_xydata().ravel() == pytest.approx(
        marks["detections"][:, [1, 0]].numpy().ravel()
    )


def test_positions_without_directions_cross_at_the_target():
    grid = Grid(1.0, 0.05, 60)
    radar = radar_at(PLACES)
    scene = iw.Scene({"mast": iw.Object(iw.plate(0.5, 0.5), PAINT, iw.rigid(translation=TARGET))})
    figure = plotting.from_above({"twin": echoes(radar, grid)}, grid, radar, {"twin": scene})
    axes = figure.axes[0]
    assert brightest(axes) == pytest.approx(TARGET[:2].tolist(), abs=0.05)
    edges = np.concatenate(axes.collections[-1].get_segments())
    assert edges.min(0).tolist() == pytest.approx([0.4 - 0.25, 2.0])
    assert edges.max(0).tolist() == pytest.approx([0.4 + 0.25, 2.0])
