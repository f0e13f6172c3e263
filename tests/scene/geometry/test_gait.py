"""A walking person: published relations, symmetry, and feet that do not slide."""

import math

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene.geometry.gait import Walk

WALK = Walk(1.4, spacing=0.05)
MIRROR = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
SOLE = torch.tensor([0.0, -0.43, 0.0], dtype=torch.float64)  # below the knee


def test_a_cycle_lasts_as_published():
    assert WALK.relative_speed == pytest.approx(1.4 / 0.895)
    assert WALK.cycle == pytest.approx(1.346 / math.sqrt(1.4 / 0.895))


@pytest.mark.parametrize("speed", [0.3, 0.9, 1.4, 2.0])
def test_after_a_cycle_the_person_is_the_same_further_on(speed):
    walk = Walk(speed, spacing=0.05)
    first, later = walk.mesh(0.2), walk.mesh(0.2 + walk.cycle)
    way = torch.tensor([0.0, 0.0, -speed * walk.cycle], dtype=torch.float64)
    assert torch.allclose(later.vertices, first.vertices + way, atol=1e-9)
    assert torch.equal(later.faces, first.faces)


def test_after_half_a_cycle_left_is_right():
    first, later = WALK.joints(0.1), WALK.joints(0.1 + WALK.cycle / 2)
    way = torch.tensor([0.0, 0.0, -1.4 * WALK.cycle / 2], dtype=torch.float64)
    for joint in ("shoulder", "elbow", "hip", "knee"):
        mirrored = first[f"right_{joint}"] * MIRROR + way
        assert torch.allclose(later[f"left_{joint}"], mirrored, atol=1e-9)


def soles(count: int = 200) -> torch.Tensor:
    """The lowest part of the right leg over a cycle [time, 3]."""
    lower = WALK.body.weights[:, WALK.body.joint("right_knee")] > 0.99
    found = []
    for k in range(count):
        skin = WALK.mesh(k * WALK.cycle / count).vertices[lower]
        found.append(skin[WALK.body.vertices[lower][:, 1].argsort()[:40]].mean(0))
    return torch.stack(found)


def test_feet_stand_and_swing():
    places = soles()
    step = WALK.cycle / len(places)
    ahead = -(places.roll(-1, 0) - places)[:-1, 2] / step
    height = places[:-1, 1]
    standing = height < height.min() + 0.03
    assert 0.3 < float(standing.double().mean()) < 0.8
    assert float(ahead[standing].mean().abs()) < 0.4 * 1.4
    assert 2.2 < float(ahead.max()) / 1.4 < 4.0
    assert abs(float(height.min())) < 0.1


def test_arms_swing_against_legs():
    hips, elbows = [], []
    for k in range(20):
        found = WALK.joints(k * WALK.cycle / 20)
        hips.append(float((found["right_knee"] - found["pelvis"])[2]))
        elbows.append(float((found["right_elbow"] - found["chest"])[2]))
    both = torch.corrcoef(torch.tensor([hips, elbows]))
    assert float(both[0, 1]) < -0.5


def test_places_are_smooth_in_time():
    """Second differences converge: accelerations are continuous."""
    times = torch.linspace(0, WALK.cycle, 400).tolist()
    knee = torch.stack([WALK.joints(t)["right_knee"] for t in times])
    step = times[1] - times[0]
    bend = (knee[2:] - 2 * knee[1:-1] + knee[:-2]) / step**2
    assert float((bend[1:] - bend[:-1]).norm(dim=1).max()) < 0.1 * float(bend.norm(dim=1).max())


def test_who_runs_is_refused():
    with pytest.raises(InputError, match="walking speed up to"):
        Walk(4.0)
    with pytest.raises(InputError, match="walking speed"):
        Walk(0.0)
