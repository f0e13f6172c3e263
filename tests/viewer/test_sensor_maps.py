"""Maps of a page: of every sensor at every step, coarse where they are fine."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from invertwin.channel import Grid
from invertwin.radar import FMCW, Radar
from invertwin.scene import Object, RoughDielectric, Scene, planar_array, rigid, sphere
from invertwin.viewer import (
    DisplayMaps,
    DisplayMesh,
    DisplayStep,
    InteractiveSensor,
    build_display,
    display_mesh,
)
from invertwin.viewer.page import SensorMaps, collect_sensor_maps

GRID = Grid(1.0, 0.05, 40, -0.5, 0.05, 21)
FINE = Grid(1.0, 0.01, 200, -0.5, 0.05, 21)


def links() -> dict[str, InteractiveSensor]:
    """One sensor at the origin, and one of a single position 0.4 m to the left."""
    ball = Object(sphere(0.2, 3), RoughDielectric(4.0), rigid(translation=[1.8, 0.0, 0.0]))
    array = planar_array((16, 1), (1.9e-3, 1.9e-3))
    one = planar_array((1, 1), (1.9e-3, 1.9e-3))
    scene = Scene({"ball": ball})
    found = {}
    for name, grid, y in (("a", GRID, 0.0), ("b", FINE, 0.4)):
        places = torch.tensor([[0.0, y, 0.0]], dtype=torch.float64).expand(1 if y else 30, 3)
        radar = Radar(one, array, FMCW(77e9, 1.5e9, 5e-5, 128), places)
        found[name] = InteractiveSensor(scene, radar, grid)
    return found


def peak(own: SensorMaps, step: int) -> tuple[float, float]:
    """Range and u of the strongest bin of the first position."""
    assert own.simulated is not None
    power = own.simulated[step, 0]
    row, column = np.unravel_index(power.argmax(), power.shape)
    start, apart, first, wide = own.grid
    return start + float(row) * apart, first + float(column) * wide


def test_maps_follow_the_steps_of_every_sensor():
    made = links()
    body = display_mesh(made["a"].scene["ball"])
    away = np.array([0.4, 0.0, 0.0], np.float32)
    steps = [
        DisplayStep(k, str(k), {"ball": DisplayMesh(body.vertices + k * away, body.faces)})
        for k in (0, 1)
    ]
    display = replace(build_display(made["a"].scene, {}, ""), steps=steps)
    found = collect_sensor_maps(display, made)
    assert list(found) == ["a", "b"]
    # Eight positions of thirty, evenly; the first and the last among them.
    assert found["a"].frames == [0, 4, 8, 12, 16, 20, 24, 29]
    assert found["b"].frames == [0]
    for step in (0, 1):
        near, straight = peak(found["a"], step)
        assert near == pytest.approx(1.6 + 0.4 * step, abs=0.06)
        assert straight == pytest.approx(0.0, abs=0.06)
        x = 1.8 + 0.4 * step
        near, u = peak(found["b"], step)
        assert near == pytest.approx(np.hypot(0.4, x) - 0.2, abs=0.06)
        assert u == pytest.approx(-0.4 / np.hypot(0.4, x), abs=0.06)
    # Two hundred ranges in blocks of three.
    assert found["b"].simulated is not None
    assert found["b"].simulated.shape == (2, 1, 67, 21)
    assert found["b"].grid == pytest.approx((1.01, 0.03, -0.5, 0.05))
    assert found["b"].positions == pytest.approx(np.array([[0.0, 0.4, 0.0]]))


def test_what_was_measured_stands_beside_it_and_needs_no_model():
    power = torch.zeros(30, 40, 21, 1)
    power[29, 7, 3] = 2.0
    display = replace(
        build_display(None, {}, ""), maps={"a": DisplayMaps.from_spectra({"measured": power}, GRID)}
    )
    found = collect_sensor_maps(display, {})["a"]
    assert found.simulated is None
    assert found.positions.shape == (0, 3)
    assert found.frames[-1] == 29
    assert found.measured is not None
    assert np.argwhere(found.measured).tolist() == [[len(found.frames) - 1, 7, 3]]


def test_many_steps_leave_fewer_positions():
    made = {"a": links()["a"]}
    bodies = {"ball": display_mesh(made["a"].scene["ball"])}
    steps = [DisplayStep(k, str(k), bodies) for k in range(72)]
    found = collect_sensor_maps(replace(build_display(made["a"].scene, {}, ""), steps=steps), made)[
        "a"
    ]
    assert found.frames == [0, 29]
    assert found.simulated is not None
    assert len(found.simulated) == 72
