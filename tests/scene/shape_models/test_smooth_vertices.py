"""Preconditioned vertices: the matrix, its adjoint, and that steps stay smooth."""

import copy
import pickle

import pytest
import torch
from torch.autograd import gradcheck

from invertwin.errors import InputError
from invertwin.scene import Scene, SmoothVertices, box, sphere
from invertwin.scene.parameters import Vertices
from invertwin.scene.shape_models.smooth_vertices import Smoother, laplacian
from scenes import thing

BALL = sphere(0.2, subdivisions=2)
COUNT = len(BALL.vertices)
SCENE = Scene({"ball": thing(BALL, (0.1, 0.2, 2.0), (0.3, 0.0, 0.5))})


def noise(seed: int = 0) -> torch.Tensor:
    return torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_laplacian_of_an_octahedron():
    """Four neighbours each; the opposite corner is none."""
    faces = [(a, b, c) for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    found = laplacian(torch.tensor(faces), 6).toarray()
    for row in range(6):
        assert found[row, row] == 4
        assert found[row, row ^ 1] == 0
    assert abs(found.sum(1)).max() == 0


def test_solves_the_system():
    module = SmoothVertices("ball", BALL, 7.0)
    module.latent.data = noise()
    matrix = torch.eye(COUNT, dtype=torch.float64) + 7.0 * torch.from_numpy(
        laplacian(BALL.faces, COUNT).toarray()
    )
    assert torch.allclose(matrix @ module.offsets.detach(), noise(), atol=1e-12)
    moved = module(SCENE)["ball"].mesh.vertices
    assert torch.allclose(moved, BALL.vertices + module.offsets)
    assert torch.equal(module.values()["ball.offsets"], module.offsets.detach())


def test_starts_as_the_identity_and_equal_numbers_translate():
    module = SmoothVertices("ball", BALL)
    assert torch.equal(module(SCENE)["ball"].mesh.vertices, BALL.vertices)
    module.latent.data += 0.1
    assert torch.allclose(module.offsets, torch.full((COUNT, 3), 0.1, dtype=torch.float64))


def test_gradients_both_ways():
    small = box(1.0, divisions=2)
    module = SmoothVertices("cube", small, 3.0)
    scene = Scene({"cube": thing(small, (0, 0, 2), (0.1, 0.2, 0.3))})

    def vertices(latent: torch.Tensor) -> torch.Tensor:
        moved = torch.func.functional_call(module, {"latent": latent}, (scene,))
        return moved["cube"].vertices

    start = noise()[: len(small.vertices)].clone().requires_grad_()
    assert gradcheck(vertices, start, check_forward_ad=True, check_batched_grad=False)


def test_a_step_is_the_gradient_solved_twice():
    module = SmoothVertices("ball", BALL, 5.0)
    optimizer = torch.optim.SGD(module.parameters(), lr=0.3)
    weights = noise(3)
    (weights * module(SCENE)["ball"].mesh.vertices).sum().backward()
    optimizer.step()
    smoother = Smoother(BALL.faces, COUNT, 5.0)
    expected = -0.3 * smoother.solve(smoother.solve(weights))
    assert torch.allclose(module.offsets.detach(), expected, atol=1e-12)


def test_rough_gradients_do_not_crumple_the_surface():
    """Noisy pulls to the same mean displacement: edges keep their lengths."""
    edges = BALL.faces[:, :2]

    def stretch(module) -> float:
        optimizer = torch.optim.SGD(module.parameters(), lr=0.01)
        for step in range(20):
            optimizer.zero_grad()
            pull = BALL.vertices / 0.2 + 3 * noise(step)
            (-pull * module(SCENE)["ball"].mesh.vertices).sum().backward()
            optimizer.step()
        vertices = module(SCENE)["ball"].mesh.vertices.detach()
        lengths = (vertices[edges[:, 0]] - vertices[edges[:, 1]]).norm(dim=1)
        return float(lengths.std() / lengths.mean())

    smooth = stretch(SmoothVertices("ball", BALL, 10.0))
    assert smooth < 0.15
    assert stretch(Vertices("ball", COUNT)) > 4 * smooth


def test_every_shape_can_be_reached():
    target = 0.01 * noise(1)
    module = SmoothVertices("ball", BALL, 4.0)
    matrix = torch.eye(COUNT, dtype=torch.float64) + 4.0 * torch.from_numpy(
        laplacian(BALL.faces, COUNT).toarray()
    )
    module.latent.data = matrix @ target
    assert torch.allclose(module.offsets.detach(), target, atol=1e-12)


def test_copies_and_state():
    module = SmoothVertices("ball", BALL, 4.0)
    module.latent.data = noise()
    for other in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert torch.equal(other.offsets, module.offsets)
    fresh = SmoothVertices("ball", BALL, 4.0)
    fresh.load_state_dict(module.state_dict())
    assert torch.equal(fresh.offsets, module.offsets)


def test_bad_input():
    with pytest.raises(InputError, match="smoothing λ"):
        SmoothVertices("ball", BALL, -1.0)
    with pytest.raises(InputError, match="expected the triangles of 'ball' as they were"):
        SmoothVertices("ball", sphere(0.2, subdivisions=1))(SCENE)
