"""Pinhole cameras: projection, poses, and what is refused."""

import math

import pytest
import torch

from invertwin.camera import Camera, CameraPose
from invertwin.errors import InputError
from scenes import float64

CAMERA = Camera.look_at(
    [[2.0, 1.0, 1.5], [-1.0, 2.0, 0.5]], [0.2, 0.1, 0.3], width=64, height=48, field_of_view=0.9
)


def test_a_point_is_seen_along_the_direction_of_its_pixel():
    points = float64([[0.3, -0.2, 0.1], [0.0, 0.4, 0.6]])
    for frame in (0, 1):
        pixels = CAMERA.project(points, frame)
        depth = CAMERA.to_camera_axes(points, frame)[:, 2:]
        back = CAMERA.positions[frame] + depth * CAMERA.directions(pixels, frame)
        torch.testing.assert_close(back, points)


def test_looking_is_upright_and_as_wide_as_asked():
    middle = CAMERA.project(float64([[0.2, 0.1, 0.3], [0.2, 0.1, 0.4]]), 0)
    torch.testing.assert_close(middle[0], float64([32.0, 24.0]))
    assert float(middle[1, 1]) < 24
    torch.testing.assert_close(middle[1, 0], middle[0, 0])
    left, right = CAMERA.directions(float64([[0.0, 24.0], [64.0, 24.0]]), 1)
    cosine = left @ right / (left.norm() * right.norm())
    assert float(cosine.arccos()) == pytest.approx(0.9)


def test_a_picture_is_what_somebody_at_the_camera_sees():
    """Along x, z up: +y is on the left; 0.5 m at 2 m are a quarter of the focal length."""
    along_x = Camera.look_at([0, 0, 0], [1, 0, 0], width=40, height=30, field_of_view=math.pi / 2)
    found = along_x.project(float64([[2.0, 0.5, 0.0], [2.0, 0.0, 0.5]]), 0)
    torch.testing.assert_close(found, float64([[15.0, 15.0], [20.0, 10.0]]))
    assert torch.equal(along_x.rotations[0], float64([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))


def test_moved_keeps_cameras_to_each_other():
    pose = CameraPose([0.1, 0.2, 0.3], [0.2, -0.3, 0.4])
    moved = pose(CAMERA)
    apart = (moved.positions[1] - moved.positions[0]).norm()
    torch.testing.assert_close(apart, (CAMERA.positions[1] - CAMERA.positions[0]).norm())
    turn = moved.rotations[0].mT @ moved.rotations[1]
    torch.testing.assert_close(turn, CAMERA.rotations[0].mT @ CAMERA.rotations[1])
    shift = moved.positions.mean(0) - CAMERA.positions.mean(0)
    torch.testing.assert_close(shift, float64([0.1, 0.2, 0.3]))
    assert set(pose.values()) == {"camera.translation", "camera.rotation"}
    torch.testing.assert_close(moved.frames([1]).positions[0], moved.positions[1])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"positions": float64([math.nan, 0.0, 0.0])}, "positions of a camera"),
        ({"rotations": torch.ones(3, 3).double()}, "orthonormal"),
        ({"width": 0}, "width"),
        ({"width": 1 << 20, "height": 1 << 20}, "pixels"),
        ({"focal": -1.0}, "focal length"),
        ({"centre": float64([1.0, math.inf])}, "centre"),
    ],
)
def test_wrong_cameras_are_refused(changes, words):
    given = {
        "positions": float64([0.0, 0.0, 0.0]),
        "rotations": torch.eye(3).double(),
        "width": 8,
        "height": 6,
        "focal": 10.0,
    }
    with pytest.raises(InputError, match=words):
        Camera(**(given | changes))


def test_a_camera_that_looks_along_up_is_refused():
    with pytest.raises(InputError, match="along up"):
        Camera.look_at([0, 0, 1], [0, 0, 0], width=8, height=6, field_of_view=math.pi / 3)
