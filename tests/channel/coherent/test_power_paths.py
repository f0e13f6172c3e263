"""Listed power paths of objects in motion: the velocities of what they meet."""

import pytest
import torch

from invertwin.channel import Sampling, trace_field, trace_power
from invertwin.errors import InputError
from invertwin.scene import Scene
from scenes import float64, link, occluder

ONCE = Sampling(depth=1, samples=3_000, boundary_samples=300)
TURN = float64([0.5, 0.3, -0.2])  # rad/s


def spinning(velocity: torch.Tensor, shift: torch.Tensor | None = None) -> Scene:
    """The occluder turns about the origin and drifts; the wall rests."""
    scene = occluder()
    item = scene["occluder"]
    if shift is not None:
        mesh = type(item.mesh)(item.vertices + shift, item.mesh.faces)
        scene = scene.replace("occluder", mesh=mesh, pose=None)
        item = scene["occluder"]
    turning = torch.linalg.cross(TURN.expand_as(item.vertices), item.vertices)
    return scene.replace("occluder", velocity=turning + velocity)


def test_paths_have_the_velocity_of_what_they_meet():
    """A rigid motion is linear over a triangle: the velocity at a point is exactly its own."""
    drift = float64([-0.7, 0.1, 0.2])
    scene = spinning(drift)
    paths = trace_power(scene, link(), sampling=ONCE, seed=1)
    assert paths.velocity is not None
    assert torch.equal(paths.power, trace_power(occluder(), link(), sampling=ONCE, seed=1).power)
    wall = (paths.first[:, 0] - scene["wall"].vertices[:, 0].mean()).abs() < 1e-9
    assert 0 < int(wall.sum()) < len(paths)
    assert not paths.velocity[wall].any()
    expected = torch.linalg.cross(TURN.expand_as(paths.first), paths.first) + drift
    assert torch.allclose(paths.velocity[~wall], expected[~wall], atol=1e-9)


def test_velocities_are_differentiable():
    """With respect to the drift of the object, and by way of its vertices where it turns."""
    drift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    paths = trace_power(spinning(drift, shift), link(), sampling=ONCE, seed=1)
    assert paths.velocity is not None
    assert int(paths.boundary.sum()) > 0
    moving = ~paths.boundary & (paths.velocity.detach().norm(dim=1) > 0)
    weights = torch.arange(3.0, dtype=torch.float64) + 1
    total = (paths.velocity[moving] * weights).sum()
    by_drift, by_shift = torch.autograd.grad(total, [drift, shift])
    assert torch.allclose(by_drift, weights * int(moving.sum()))
    # d(ω × x) · w = dx · (w × ω)
    assert torch.allclose(by_shift, torch.linalg.cross(weights, TURN) * int(moving.sum()))
    power = torch.autograd.grad(
        trace_power(spinning(drift, shift), link(), sampling=ONCE, seed=1).power.sum(), shift
    )[0]
    assert power.any()


def test_fields_refuse_derivatives_with_respect_to_velocity():
    drift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    with pytest.raises(InputError, match="expected velocities without gradients"):
        trace_field(spinning(drift), link(), sampling=ONCE, seed=1)
    with pytest.raises(InputError, match="expected depth 1 for objects in motion, got 2"):
        trace_power(spinning(drift), link(), sampling=Sampling(depth=2, samples=10), seed=1)
