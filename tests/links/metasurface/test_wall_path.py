"""Paths along walls, and the module that places a metasurface on them."""

import math

import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.links import Metasurface, PanelPlacement, WallPath
from scenes import float64

FREQUENCY = 28e9
SPACING = SPEED_OF_LIGHT / FREQUENCY / 2
ROOM = [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]


@pytest.mark.parametrize("corners", [ROOM, [[0.0, 0.0], [3.0, 0.0], [3.0, -2.0], [5.0, -2.0]]])
def test_a_path_goes_on_smoothly_round_its_corners(corners: list[list[float]]):
    closed = corners is ROOM
    path = WallPath(corners, 1.5, 0.2, closed)
    turn = (math.pi / 2 - 2) * 0.2
    straight = 14.0 + 4 * turn if closed else 7.0 + 2 * turn
    assert path.length == pytest.approx(straight)
    step = 1e-4
    stops = torch.arange(0.0, path.length - 2 * step, 0.07).double()
    for stop in stops:
        places, normals = zip(*(path.locate(stop + k * step) for k in (0, 1)), strict=True)
        along = (places[1] - places[0]) / step
        assert float(along.norm()) == pytest.approx(1.0, abs=1e-3)
        assert abs(float(along @ normals[0])) < 1e-3
        assert float(torch.linalg.cross(along, normals[0])[2]) > 0.99  # the room is on the left
        assert float((normals[1] - normals[0]).norm()) < 6 * step


def test_derivatives_by_the_place_run_along_the_path():
    path = WallPath(ROOM, 1.5, 0.3, True)
    for stop in (1.0, 3.8, 3.9, 13.0, -0.5):
        here = float64(stop).requires_grad_()
        for k in range(3):
            for value in range(2):
                (slope,) = torch.autograd.grad(path.locate(here)[value][k] + 0 * here, here)
                with torch.no_grad():
                    ends = [path.locate(float64(stop + s * 1e-6))[value][k] for s in (1, -1)]
                truth = float(ends[0] - ends[1]) / 2e-6
                assert float(slope) == pytest.approx(truth, abs=1e-6)


def test_a_placed_panel_stays_focused():
    tx, target = float64([2.0, 2.0, 1.5]), float64([1.0, 2.5, 1.0])
    path = WallPath(ROOM, 1.5, 0.2, True)
    axes, none = torch.eye(3).double(), torch.zeros(6, 4).double()
    plain = Metasurface(torch.zeros(3).double(), axes, none, SPACING)
    for along, yaw in ((1.0, 0.3), (6.0, -0.2)):
        module = PanelPlacement(path, tx, target, FREQUENCY, (6, 4), along=along, yaw=yaw)
        with torch.no_grad():
            placed = module(plain)
        elements = placed.cells.centers
        length = (elements - tx).norm(dim=1) + (elements - target).norm(dim=1)
        left = placed.phase.ravel() - 2 * math.pi * FREQUENCY / SPEED_OF_LIGHT * length
        assert float(left.abs().max()) < 1e-9
        assert float(torch.linalg.det(placed.axes)) == pytest.approx(1.0)
        inward = path.locate(float64(along))[1]
        assert float(placed.axes[:, 0] @ inward) == pytest.approx(math.cos(yaw))


def test_what_is_fitted_has_names():
    path = WallPath(ROOM, 1.5, 0.2, True)
    module = PanelPlacement(path, [1.0, 1, 1], [2.0, 2, 1], FREQUENCY, (6, 4), along=2.0)
    assert {n: tuple(p.shape) for n, p in module.named_parameters()} == {
        "along": (),
        "yaw": (),
        "spread": (2,),
        "shift": (6, 4),
    }
    assert float(module.values()["panel.along"]) == 2.0


@pytest.mark.parametrize(
    ("corners", "radius", "words"),
    [
        ([[0.0, 0.0]], 0.2, "more corners"),
        ([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]], 0.2, "got two at one place"),
        (ROOM, 2.0, "lower the radius"),
        (ROOM, 0.0, "radius of corners"),
        ([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]], 0.2, "shape"),
    ],
)
def test_wrong_paths_are_refused(corners: list[list[float]], radius: float, words: str):
    with pytest.raises(InputError, match=words):
        WallPath(corners, 1.5, radius, len(corners) > 3)
