"""Sitting down, standing up, waving: where the body ends, what rests, and that nothing jumps."""

import math
from itertools import pairwise

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import (
    MovingScene,
    Object,
    RoughDielectric,
    Scene,
    Sitting,
    Walking,
    Waving,
    person,
    rigid,
    standing_height,
)
from scenes import float64

BODY = person(spacing=0.05)
HIGH = standing_height(BODY)
STANDING = Object(BODY.mesh({}), RoughDielectric(4.0), rigid(translation=[3.0, 0.0, HIGH]))


def joints(motion: Sitting | Waving, time: float, body=BODY) -> dict[str, torch.Tensor]:
    """Places of the joints above a floor at z = 0 [m]."""
    rotations, shift = motion.posture(time)
    places = body.apply_pose(rotations)[1] + shift + float64([0.0, 0.0, standing_height(body)])
    return dict(zip(body.names, places, strict=True))


def vertex(place: list[float]) -> int:
    return int((BODY.vertices - float64(place)).norm(dim=1).argmin())


@pytest.mark.parametrize("height", [1.5, 1.75, 1.95])
@pytest.mark.parametrize("seat", [0.4, 0.5])
def test_the_seat_carries_the_thighs_of_a_person_who_sits(height, seat):
    body = person(height, 0.05)
    motion = Sitting(body, seat)
    hip = joints(motion, 2.0, body)["left_hip"]
    assert float(hip[2]) - seat == pytest.approx(0.088 * height / 1.75, abs=1e-9)
    start = joints(motion, 0.0, body)["left_hip"]
    assert float(start[2]) == pytest.approx((0.955 - 0.06) * height / 1.75, abs=0.02)
    assert float(hip[0] - start[0]) > 0.3  # the seat is behind


def test_feet_rest_and_shanks_stay_upright():
    motion = Sitting(BODY, 0.45)
    ankle = vertex([0.0, 0.10, -0.90])
    course = torch.stack([motion(STANDING, 0.1 * k).vertices[ankle] for k in range(21)])
    assert float((course - course[0]).abs().max()) < 1e-6


def test_the_trunk_leans_until_the_seat_carries_the_person():
    motion = Sitting(BODY, 0.45, start=1.0, duration=2.0)

    def lean(time: float) -> float:
        found = joints(motion, time)
        up = found["neck"] - found["chest"]
        return math.degrees(math.atan2(-float(up[0]), float(up[2])))

    assert lean(0.5) == pytest.approx(0.0, abs=1e-6)
    assert lean(2.2) == pytest.approx(40.0, abs=1e-4)
    assert lean(1.9) < 40.0 > lean(2.4)
    assert lean(3.0) == pytest.approx(0.0, abs=1e-6)
    reached, end = joints(motion, 2.2), joints(motion, 3.0)
    assert torch.allclose(reached["left_hip"], end["left_hip"], atol=1e-6)
    # Over the feet, or nearly, as the seat is reached: people do not fall onto it.
    assert float(reached["neck"][0]) < float(reached["left_hip"][0]) - 0.2


def test_standing_up_is_sitting_down_backwards():
    down, up = Sitting(BODY, 0.45), Sitting(BODY, 0.45, rising=True)
    for time in (0.0, 0.7, 1.3, 2.0):
        first, last = down(STANDING, time), up(STANDING, 2.0 - time)
        assert torch.allclose(first.vertices, last.vertices, atol=1e-12)
    assert torch.equal(up(STANDING, 5.0).vertices, up(STANDING, 2.0).vertices)


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_forearm_swings_beside_the_head(side):
    motion = Waving(BODY, side, rate=1.5)
    sign = 1.0 if side == "right" else -1.0
    hand = vertex([0.0, sign * 0.72, 0.45])
    heights, aside = [], []
    for k in range(61):
        place = motion(STANDING, 1.0 + k / 30).vertices[hand]
        heights.append(float(place[2]))
        aside.append(sign * float(place[1]))
    assert min(heights) > HIGH + 0.6
    turns = sum(a < 0.47 <= b for a, b in pairwise(aside))
    assert turns == 3  # 1.5 Hz for two seconds
    assert max(aside) - min(aside) == pytest.approx(2 * 0.25 * math.sin(math.radians(30)), rel=0.1)
    other = "left" if side == "right" else "right"
    rest = [joints(motion, t)[f"{other}_elbow"] for t in (0.0, 1.7)]
    assert torch.allclose(rest[0], rest[1])
    assert float(rest[0][2]) < HIGH + 0.25


def test_a_person_who_walks_can_wave():
    walk = Walking(BODY, 1.2)
    both = Waving(BODY, "left", during=walk)
    for name in ("left_knee", "right_elbow", "pelvis"):
        row = BODY.joint(name)
        assert torch.equal(both.posture(1.7)[0][row], walk.posture(1.7)[0][row])
    row = BODY.joint("left_elbow")
    assert not torch.allclose(both.posture(1.7)[0][row], walk.posture(1.7)[0][row], atol=0.1)
    assert torch.allclose(both.posture(9.0)[0], walk.posture(9.0)[0], atol=1e-9)
    assert torch.equal(both.posture(1.7)[1], walk.posture(1.7)[1])
    scene = MovingScene(Scene({"person": STANDING}), {"person": both})
    assert torch.equal(scene(1.7)["person"].vertices, both(STANDING, 1.7).vertices)


@pytest.mark.parametrize(
    "motion", [Sitting(BODY, 0.45, start=0.1, duration=1.0), Waving(BODY, start=0.1, duration=1.7)]
)
def test_velocities_do_not_jump(motion):
    step = 2e-3
    rows = [vertex([-0.1, 0.0, 0.5]), vertex([0.0, 0.72, 0.45]), vertex([0.1, 0.1, -0.06])]
    course = torch.stack([motion(STANDING, step * k).vertices[rows] for k in range(950)])
    speeds = course.diff(dim=0) / step
    assert float(speeds.norm(dim=-1).max()) > 0.5
    assert float(speeds.norm(dim=-1).max()) < 4.0
    assert float(speeds.diff(dim=0).norm(dim=-1).max()) < 0.15


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sitting(BODY, 0.9), "height of the seat"),
        (lambda: Sitting(BODY, 0.1), "height of the seat"),
        (lambda: Sitting(BODY, 0.45, duration=0.0), "duration"),
        (lambda: Waving(BODY, "up"), "side left, right"),
        (lambda: Waving(BODY, rate=0.0), "rate"),
        (lambda: Waving(BODY, duration=1.0), "duration"),
        (lambda: Waving(BODY, during=Walking(person(spacing=0.05), 1.0)), "one body"),
    ],
)
def test_what_no_body_can_do_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
