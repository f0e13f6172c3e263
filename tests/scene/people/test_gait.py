"""Walking: its speed, its cycle, its symmetry, and how fast feet are."""

import math
from dataclasses import replace

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import (
    Object,
    RoughDielectric,
    Walking,
    person,
    rigid,
    standing_height,
)
from invertwin.scene.people.gait import leg_length
from scenes import float64

BODY = person(spacing=0.05)
HIGH = standing_height(BODY)
STANDING = Object(BODY.mesh({}), RoughDielectric(4.0), rigid(translation=[3.0, 0.0, HIGH]))
ANKLE = int((BODY.vertices - float64([0.0, 0.10, -0.90])).norm(dim=1).argmin())


def places(walk: Walking, steps: int = 100) -> torch.Tensor:
    """Vertices over one cycle [step, vertex, 3], the last step the first of the next."""
    times = [walk.period * k / steps for k in range(steps + 1)]
    return torch.stack([walk(STANDING, time).vertices for time in times])


@pytest.mark.parametrize("speed", [0.4, 1.0, 1.4, 2.2])
def test_every_part_moves_on_at_the_set_speed(speed):
    walk = Walking(BODY, speed)
    first, last = walk(STANDING, 0.1).vertices, walk(STANDING, 0.1 + walk.period).vertices
    away = (last - first) / walk.period
    assert torch.allclose(away, float64([-speed, 0.0, 0.0]).expand_as(away), atol=1e-9)
    spot = Walking(BODY, speed, on_spot=True)
    again = spot(STANDING, spot.period).vertices
    assert torch.allclose(again, spot(STANDING, 0.0).vertices, atol=1e-9)


def test_the_cycle_has_the_published_length():
    """1.346 √v leg lengths; people walk at 1.4 m/s with 0.95 cycles a second, 1.4 m long."""
    walk = Walking(BODY, 1.4)
    leg = leg_length(BODY)
    assert leg == pytest.approx(0.84)
    assert walk.period * 1.4 / leg == pytest.approx(1.346 * math.sqrt(1.4 / leg))
    assert 0.9 < 1 / walk.period < 1.05
    tall = Walking(person(2.1, 0.05), 1.4)
    assert tall.period / walk.period == pytest.approx(math.sqrt(2.1 / 1.75))


def test_left_is_half_a_cycle_behind_right():
    walk = Walking(BODY, 1.3, phase=0.2)
    for name in ("hip", "knee"):
        right, left = (walk.body.joint(f"{side}_{name}") for side in ("right", "left"))
        for phase in (0.0, 0.3, 0.71):
            early, late = walk.rotations(phase), walk.rotations(phase + 0.5)
            assert torch.allclose(early[right], late[left], atol=1e-12)
    mirror = float64([1.0, -1.0, 1.0])
    here, there = (BODY.apply_pose(walk.rotations(phase))[1] for phase in (0.3, 0.8))
    for name in ("shoulder", "elbow", "hip", "knee"):
        right, left = (BODY.joint(f"{side}_{name}") for side in ("right", "left"))
        # The thorax's control points are no exact mirror image.
        assert torch.allclose(here[right], mirror * there[left], atol=0.01)


def test_angles_pass_the_published_control_points():
    walk = Walking(BODY, 1.0)

    def bent(joint: str, phase: float) -> float:
        turn = walk.rotations(phase)[BODY.joint(joint)]
        return math.degrees(math.atan2(float(turn[0, 2]), float(turn[2, 2])))

    for phase, angle in ((0.9, 25.0), (0.5, -15.0)):
        assert bent("right_hip", phase) == pytest.approx(angle, abs=2.0)
    for phase, angle in ((0.17, 3.0), (0.4, 3.0), (0.75, 70.0), (1.0, 3.0)):
        assert -bent("right_knee", phase) == pytest.approx(angle, abs=5.0)


def test_the_right_foot_lands_ahead_and_the_left_arm_swings_with_it():
    joints = BODY.apply_pose(Walking(BODY, 1.4).rotations(0.0))[1]
    x = {name: float(joints[BODY.joint(name), 0]) for name in BODY.names}
    assert x["right_knee"] < x["left_knee"] - 0.2
    assert x["left_elbow"] < x["right_elbow"] - 0.05
    assert x["right_hip"] < x["left_hip"]


@pytest.mark.parametrize("speed", [1.4, 1.8])
def test_feet_are_about_three_times_as_fast_as_the_person(speed):
    walk = Walking(BODY, speed)
    course = places(walk)
    ahead = -course[:, ANKLE, 0].diff() * 100 / walk.period
    assert 2.5 < float(ahead.max()) / speed < 3.5
    # It stands for the first half of the cycle, and is nearly as slow as the floor.
    assert float(ahead[10:50].square().mean().sqrt()) / speed < 0.25


def test_the_torso_keeps_its_speed_and_feet_keep_to_the_floor():
    walk = Walking(BODY, 1.4)
    course = places(walk)
    low = course[:, :, 2].amin(1)
    assert -0.06 < float(low.min()) < float(low.max()) < 0.02
    waist = int((BODY.vertices - float64([-0.12, 0.0, 0.05])).norm(dim=1).argmin())
    ahead = -course[:, waist, 0].diff() * 100 / walk.period / 1.4
    assert 0.7 < float(ahead.min()) < 0.95
    assert 1.05 < float(ahead.max()) < 1.3


def test_accelerations_do_not_jump():
    walk, step = Walking(BODY, 1.4), 2.5e-3
    course = torch.stack([walk(STANDING, step * k).vertices[ANKLE] for k in range(420)])
    speeds = course.diff(dim=0) / step
    accelerations = speeds.diff(dim=0) / step
    jumps = accelerations.diff(dim=0).norm(dim=1)
    assert float(jumps.max()) < 0.12 * float(accelerations.norm(dim=1).max())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Walking(BODY, 0.0), "walking speed"),
        (lambda: Walking(BODY, 4.0), "walking speed"),
        (lambda: Walking(BODY, 1.0, phase=math.nan), "phase"),
        (lambda: Walking(replace(BODY, names=()), 1.0), "joints of person"),
    ],
)
def test_what_cannot_walk_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
