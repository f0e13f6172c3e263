"""Scenes in motion against closed forms."""

import math

import pytest
import torch

from invertwin.channel import Sampling
from invertwin.errors import InputError
from invertwin.radar import FMCW, Radar
from invertwin.radar.signal.chirps import Chirps
from invertwin.scene import (
    AntennaArray,
    AxisRotation,
    MovingScene,
    Object,
    RoughDielectric,
    Scene,
    SplineTrajectory,
    TrajectoryMotion,
    Walking,
    box,
    person,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin.simulation import simulate_chirps
from scenes import float64

PAINT = RoughDielectric(4.0)
TIMES = [0.0, 0.4, 1.0, 1.5]
PATH = SplineTrajectory(TIMES, [[5, 0, 0], [4.5, 0.4, 0], [4.2, 1.0, 0.2], [3.0, 1.1, 0.1]])
STEP = 1e-5


def speeds(mover, item, time):
    """Velocities of the vertices by central differences [m/s]."""
    ahead, behind = (mover(item, time + sign * STEP).vertices for sign in (1, -1))
    return (ahead - behind) / (2 * STEP)


def test_the_rim_of_a_wheel_is_as_fast_as_rate_times_radius():
    turn = rotation_from_vector(float64([0.2, 0.3, -0.5]))
    wheel = Object(sphere(0.3, 2), PAINT, rigid(turn, [2.0, 1.0, 0.5]))
    spin = AxisRotation([2.0, 0.0, 0.0], rate=7.0)
    points = wheel.mesh.vertices
    radii = points[:, 1:].norm(dim=1)
    found = speeds(spin, wheel, 0.13)
    assert torch.allclose(found.norm(dim=1), 7.0 * radii, atol=1e-7)
    axis = turn @ float64([1.0, 0.0, 0.0])
    arm = spin(wheel, 0.13).vertices - wheel.center
    assert torch.allclose(found, torch.linalg.cross(7.0 * axis.expand_as(arm), arm), atol=1e-7)
    whole = spin(wheel, 2 * math.pi / 7.0).vertices
    assert torch.allclose(whole, wheel.vertices, atol=1e-12)


def test_a_crank_turns_about_a_place_of_its_own():
    pedal = Object(box((0.05, 0.1, 0.02)), PAINT, rigid(translation=[3.0, 0.0, 0.0]))
    crank = AxisRotation([0.0, 1.0, 0.0], rate=2 * math.pi, center=[0.0, 0.0, -0.17])
    low = crank(pedal, 0.5).center
    assert torch.allclose(low, float64([3.0, 0.0, -0.34]), atol=1e-12)


def test_a_spline_meets_its_places_and_its_velocity_is_their_derivative():
    for time, place in zip(TIMES, PATH.positions, strict=True):
        assert torch.allclose(PATH.position(time), place, atol=1e-12)
    for time in (0.1, 0.4, 0.77, 1.3):
        change = PATH.position(time + STEP) - PATH.position(time - STEP)
        assert torch.allclose(PATH.velocity(time), change / (2 * STEP), atol=1e-7)
    even = SplineTrajectory([0.0, 1.0, 3.0], [[0, 0, 0], [1, 2, 0], [3, 6, 0]])
    assert torch.allclose(even.velocity(2.2), float64([1.0, 2.0, 0.0]), atol=1e-12)


def test_an_object_follows_a_path_and_looks_ahead():
    item = Object(box(0.2), PAINT, rigid(translation=[0.0, 0.0, 0.3]))
    moved = TrajectoryMotion(PATH, heading=True)(item, 0.7)
    assert torch.allclose(moved.center, PATH.position(0.7) + float64([0, 0, 0.3]), atol=1e-12)
    way = PATH.velocity(0.7) * float64([1.0, 1.0, 0.0])
    front = moved.transform[:3, :3] @ float64([-1.0, 0.0, 0.0])
    assert torch.allclose(front, way / way.norm(), atol=1e-12)
    assert torch.equal(TrajectoryMotion(PATH)(item, 0.7).transform[:3, :3], torch.eye(3).double())


def test_a_rolling_wheel_stands_where_it_touches():
    wheel = Object(sphere(0.25, 3), PAINT)
    road = SplineTrajectory([0.0, 2.0], [[4.0, 0, 0.25], [4.0, 3.0, 0.25]])
    rolling = MovingScene(
        Scene({"wheel": wheel}),
        {"wheel": (AxisRotation([1.0, 0, 0], -1.5 / 0.25), TrajectoryMotion(road))},
    )
    found = speeds(lambda _, time: rolling(time)["wheel"], wheel, 0.8)
    points = rolling(0.8)["wheel"].vertices
    below = points[:, 2].argmin()
    slack = 1.5 / 0.25 * float((points[below] - float64([4.0, 1.2, 0.0])).norm())
    assert float(found[below].norm()) < slack + 1e-6
    assert slack < 0.3
    assert float(found.norm(dim=1).max()) == pytest.approx(3.0, rel=0.01)


def test_triangles_and_what_stands_still_stay():
    body = person(spacing=0.05)
    still = Scene(
        {
            "box": Object(box(0.3), PAINT, rigid(translation=[3.0, 1.0, 0.0])),
            "person": Object(body.mesh({}), PAINT),
            "car": Object(box(0.5), PAINT, velocity=float64([2.0, 0.0, 0.0])),
        }
    )
    walk = (Walking(body, 1.0, on_spot=True), TrajectoryMotion(PATH, heading=True))
    scene = MovingScene(still, {"person": walk})
    early, late = scene(0.1), scene(0.6)
    assert early.names == still.names
    assert torch.equal(early["box"].vertices, late["box"].vertices)
    assert torch.equal(early["person"].mesh.faces, late["person"].mesh.faces)
    assert float(late["car"].center[0] - early["car"].center[0]) == pytest.approx(1.0)
    assert late["car"].velocity is None
    middle = late["person"].vertices.mean(0) - early["person"].vertices.mean(0)
    assert torch.allclose(middle, PATH.position(0.6) - PATH.position(0.1), atol=0.06)


def test_a_radar_sees_the_doppler_of_a_path():
    """A small ball comes nearer at 3 m/s: its echo turns by 4π v T/λ from chirp to chirp."""
    chirp = FMCW(77e9, 1e9, 20e-6, 32)
    one = AntennaArray(float64([[0.0, 0.0, 0.0]]))
    radar = Radar(one, one, chirp, float64([[0.0, 0.0, 0.0]]))
    path = SplineTrajectory([0.0, 1.0], [[2.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    ball = Object(sphere(0.02, 2), PAINT)
    scene = MovingScene(Scene({"ball": ball}), {"ball": TrajectoryMotion(path)})
    few = Sampling(depth=1, points_per_m2=20_000.0)
    beat = simulate_chirps(
        scene, radar, Chirps(8, 100e-6), seed=3, sampling=few, visibility_every=8
    )[0, :, 0, 0]
    turn = float((beat[1:] * beat[:-1].conj()).sum().angle())
    expected = -4 * math.pi * 3.0 * 100e-6 / chirp.wavelength
    assert turn == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AxisRotation([0, 0, 0], 1.0), "axis with a direction"),
        (lambda: AxisRotation([1, 0, 0], math.inf), "rate"),
        (
            lambda: SplineTrajectory([0.0, 0.0], [[0, 0, 0], [1, 1, 1]]),
            "at least 2 ascending times",
        ),
        (lambda: SplineTrajectory([0.0, 1.0], [[0, 0, 0]]), "places"),
        (lambda: PATH.position(1.6), r"\[0, 1.5\] s, got 1.6"),
        (
            lambda: TrajectoryMotion(
                SplineTrajectory([0.0, 1.0], [[0, 0, 0], [0, 0, 1]]), heading=True
            )(Object(box(1.0), PAINT), 0.5),
            "level velocity",
        ),
        (
            lambda: MovingScene(
                Scene({"a": Object(box(1.0), PAINT)}), {"b": TrajectoryMotion(PATH)}
            ),
            "name of an object",
        ),
        (
            lambda: MovingScene(
                Scene({"a": Object(box(1.0), PAINT, velocity=float64([0.0, 1.0, 0.0]))}),
                {"a": TrajectoryMotion(PATH)},
            ),
            "beside its motion",
        ),
    ],
)
def test_what_cannot_move_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
