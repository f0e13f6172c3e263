"""Breathing: displacement of the chest over time, its mask, and its derivative."""

import math

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import (
    Breathing,
    MovingScene,
    Object,
    RoughDielectric,
    Scene,
    Sitting,
    box,
    person,
)

BODY = person(spacing=0.05)
ITEM = Object(BODY.mesh({}), RoughDielectric(permittivity=8.0))


def test_the_chest_moves_and_the_rest_does_not() -> None:
    """Between breathing out and in the front moves by the depth, the back and the legs not."""
    breathing = Breathing(BODY, rate=0.25, depth=8e-3, heart_depth=0.0)
    out, inside = (breathing(ITEM, time).mesh.vertices for time in (0.0, 2.0))
    assert torch.equal(out, ITEM.mesh.vertices)
    moved = inside - out
    front = moved.norm(dim=1).argmax()
    assert float(moved[front].norm()) == pytest.approx(8e-3, rel=1e-6)
    assert float(moved[front, 0]) < -7.5e-3  # ahead is −x
    behind = BODY.vertices[:, 0] > float(BODY.joints[BODY.joint("chest"), 0])
    low = BODY.vertices[:, 2] < float(BODY.joints[BODY.joint("pelvis"), 2])
    assert float(moved[behind | low].abs().max()) < 1e-12


def test_displacement_is_the_sum_of_both() -> None:
    """Half a heartbeat and half a breath are two depths."""
    breathing = Breathing(BODY, rate=0.25, depth=8e-3, heart_rate=1.25, heart_depth=4e-4)
    assert float(breathing.displacement(2.0)) == pytest.approx(8.4e-3)
    expected = 4e-3 * (1 - math.cos(0.2 * math.pi)) + 4e-4
    assert float(breathing.displacement(0.4)) == pytest.approx(expected)


def test_derivative_with_respect_to_the_depth() -> None:
    """The vertices are linear in the depth."""
    depth = torch.tensor(8e-3, dtype=torch.float64, requires_grad=True)
    points = Breathing(BODY, depth=depth, heart_depth=0.0)(ITEM, 2.0).mesh.vertices
    (slope,) = torch.autograd.grad(points[:, 0].sum(), depth)
    total = float((points.detach()[:, 0] - ITEM.mesh.vertices[:, 0]).sum())
    assert float(slope) == pytest.approx(total / 8e-3, rel=1e-9)
    assert total < -1e-2


def test_a_seated_person_breathes_where_the_chest_is() -> None:
    """After sitting, the chest is displaced ahead from its new place."""
    scene = Scene({"person": ITEM})
    sitting = Sitting(BODY, duration=1.0)
    breathing = Breathing(BODY, rate=0.25, heart_depth=0.0)
    still = MovingScene(scene, {"person": sitting})(2.0)["person"]
    moved = MovingScene(scene, {"person": [sitting, breathing]})(2.0)["person"]
    shift = moved.vertices - still.vertices
    row = shift.norm(dim=1).argmax()
    assert float(shift[row].norm()) == pytest.approx(8e-3, rel=1e-6)
    assert float(shift[row, 0]) < -7e-3


def test_a_rotated_chest_moves_along_its_normal() -> None:
    """A quarter turn of the trunk turns the displacement."""
    quarter = BODY.mesh({"pelvis": [0.0, 0.0, math.pi / 2]})
    item = Object(quarter, ITEM.material)
    moved = Breathing(BODY, heart_depth=0.0)(item, 2.0).mesh.vertices - quarter.vertices
    row = moved.norm(dim=1).argmax()
    assert float(moved[row, 1]) == pytest.approx(-8e-3, rel=0.05)


def test_other_meshes_and_numbers_are_refused() -> None:
    """A mesh that is no body of this template, and frequencies and depths out of range."""
    with pytest.raises(InputError, match="vertices of the person"):
        Breathing(BODY)(Object(box(0.4), ITEM.material), 0.0)
    with pytest.raises(InputError, match="depth"):
        Breathing(BODY, depth=-1e-3)
    with pytest.raises(InputError, match="heart_rate"):
        Breathing(BODY, heart_rate=0.0)
