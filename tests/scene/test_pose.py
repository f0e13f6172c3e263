"""Rotations: agreement with the exponential map, and finite gradients everywhere."""

import math

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import (
    compose,
    look_at,
    quaternion_from_vector,
    rigid,
    rotation_angle,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_quaternion,
)

IDENTITY = torch.eye(3, dtype=torch.float64)


def vector(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


@pytest.mark.parametrize(
    "r",
    [(0.0, 0.0, 0.0), (1e-9, 0.0, 0.0), (0.3, -1.0, 0.7), (0.0, math.pi, 0.0), (4.0, 1.0, -3.0)],
)
def test_rotation_vector_is_the_exponential_map(r):
    x, y, z = r
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    rotation = rotation_from_vector(vector(*r))
    assert torch.allclose(rotation, torch.linalg.matrix_exp(skew), atol=1e-12)


def test_rotation_about_y_turns_z_towards_x():
    assert torch.allclose(
        rotation_from_vector(vector(0.0, math.pi / 2, 0.0)) @ vector(0.0, 0.0, 1.0),
        vector(1.0, 0.0, 0.0),
        atol=1e-15,
    )


def test_any_quaternion_gives_a_rotation():
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        q = torch.randn(4, generator=generator, dtype=torch.float64)
        rotation = rotation_from_quaternion(q)
        assert torch.allclose(rotation @ rotation.T, IDENTITY, atol=1e-14)
        assert float(torch.linalg.det(rotation)) == pytest.approx(1.0)
        assert torch.allclose(rotation_from_quaternion(-3 * q), rotation, atol=1e-14)
        assert torch.allclose(rotation_from_vector(vector_from_quaternion(q)), rotation, atol=1e-13)
        assert float(torch.linalg.vector_norm(vector_from_quaternion(q))) <= math.pi


def test_rotation_vector_round_trip():
    for r in [(0.0, 0.0, 0.0), (1e-12, 0.0, 0.0), (0.1, 0.2, -0.3), (0.0, 3.14, 0.0)]:
        back = vector_from_quaternion(quaternion_from_vector(vector(*r)))
        assert back.tolist() == pytest.approx(list(r), rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.1, math.pi / 2, 3.0, math.pi])
def test_rotation_angle(angle):
    axis = torch.nn.functional.normalize(vector(1.0, 2.0, -0.5), dim=0)
    assert float(rotation_angle(rotation_from_vector(axis * angle))) == pytest.approx(
        angle, rel=1e-7, abs=1e-12
    )


def test_rotation_angle_of_many():
    many = torch.stack([IDENTITY, rotation_from_vector(vector(0.5, 0.0, 0.0))])
    assert rotation_angle(many).tolist() == pytest.approx([0.0, 0.5])


@pytest.mark.parametrize("r", [(0.0, 0.0, 0.0), (math.pi, 0.0, 0.0), (0.4, -2.0, 1.0)])
def test_gradient_of_rotation_vector(r):
    assert torch.autograd.gradcheck(rotation_from_vector, vector(*r).requires_grad_())


@pytest.mark.parametrize("q", [(1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.5, -0.2, 2.0, 0.1)])
def test_gradient_of_quaternion(q):
    assert torch.autograd.gradcheck(rotation_from_quaternion, vector(*q).requires_grad_())


def test_compose_applies_the_first_first():
    turn = rigid(rotation_from_vector(vector(0.0, 0.0, math.pi / 2)), vector(0.0, 0.0, 0.0))
    move = rigid(IDENTITY, vector(1.0, 0.0, 0.0))
    point = vector(1.0, 0.0, 0.0, 1.0)
    assert (compose(turn, move) @ point)[:3].tolist() == pytest.approx([1.0, 1.0, 0.0])
    assert (compose(move, turn) @ point)[:3].tolist() == pytest.approx([0.0, 2.0, 0.0])


def test_looking_ahead_is_the_identity_and_y_stays_level():
    position = [[0.0, 0.0, 1.0]]
    targets = ([5.0, 0.0, 1.0], [0.0, 5.0, 1.0], [3.0, 0.0, 0.0])
    ahead, left, down = (look_at(position, target)[0] for target in targets)
    assert torch.equal(ahead, IDENTITY)
    assert left.T.tolist() == [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    assert torch.allclose(down[:, 0], vector(3.0, 0.0, -1.0) / math.sqrt(10))
    assert down[:, 1].tolist() == [0.0, 1.0, 0.0]
    assert down[2, 2] > 0
    with pytest.raises(InputError, match="not straight above or below"):
        look_at(position, [0.0, 0.0, 3.0])


def test_zero_quaternion_is_refused():
    with pytest.raises(InputError, match="quaternion that is not zero"):
        rotation_from_quaternion(torch.zeros(4, dtype=torch.float64))
