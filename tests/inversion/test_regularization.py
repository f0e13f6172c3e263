"""The Dirichlet energy of a displacement."""

import pytest
import torch

from invertwin.errors import InputError
from invertwin.inversion.regularization import Laplacian, cotangent_edges
from invertwin.scene import Mesh, RoughDielectric, Scene, plate, sphere
from invertwin.scene.parameters import Translation, Vertices
from scenes import float64, thing

BALL = sphere(0.2, subdivisions=1)
SCENE = Scene({"ball": thing(BALL, (0.1, 0.2, 2.0), (0.3, 0.0, 0.5), RoughDielectric(4.0))})


def offset(values: torch.Tensor) -> Scene:
    module = Vertices("ball", len(BALL.vertices))
    module.offsets.data = values
    return module(SCENE)


def test_the_first_shape_and_a_shift_cost_nothing():
    term = Laplacian(SCENE, "ball", 2.0)
    shift = float64([0.3, -0.1, 0.2]).expand(len(BALL.vertices), 3)
    assert float(term(SCENE)) == 0
    assert float(term(offset(shift.clone())).detach()) < 1e-20
    assert float(term(Translation("ball", [0.1, 0.2, 0.3])(SCENE)).detach()) == 0


def test_another_shape_is_refused():
    term = Laplacian(SCENE, "ball", 2.0)
    with pytest.raises(InputError, match="expected vertices of ball as those of its initial shape"):
        term(SCENE.replace("ball", mesh=sphere(0.2, subdivisions=2)))


def test_energy_is_that_of_the_matrix_and_scales_with_its_weight():
    """(w/2) tr(dᵀ L d), with L assembled densely."""
    edges, weights, unit = cotangent_edges(BALL)
    count = len(BALL.vertices)
    matrix = torch.zeros(count, count, dtype=torch.float64)
    for (i, j), weight in zip(edges.tolist(), weights.tolist(), strict=True):
        matrix[[i, j], [i, j]] += weight
        matrix[[i, j], [j, i]] -= weight
    generator = torch.Generator().manual_seed(0)
    d = 0.01 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    d.requires_grad_()
    term = Laplacian(SCENE, "ball", 3.0)
    moved = SCENE.replace("ball", mesh=Mesh(BALL.vertices + d, BALL.faces))
    value = term(moved)
    truth = 1.5 * torch.einsum("ik,ij,jk->", d, matrix, d) / unit**2
    assert float(value.detach()) == pytest.approx(float(truth.detach()), rel=1e-9)
    (gradient,) = torch.autograd.grad(value, d)
    assert torch.allclose(gradient, 3.0 * matrix @ d.detach() / unit**2, rtol=1e-9)


def test_gradient_is_that_of_differences():
    term = Laplacian(SCENE, "ball", 1.0)

    def value(d: torch.Tensor) -> torch.Tensor:
        return term(SCENE.replace("ball", mesh=Mesh(BALL.vertices + d, BALL.faces)))

    start = 0.01 * torch.randn(
        len(BALL.vertices), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    assert torch.autograd.gradcheck(value, start.requires_grad_(), fast_mode=True)


def test_cotangents_of_right_triangles():
    """A square of two right triangles: 1/2 on each side's edges, 0 (kept above) on the diagonal."""
    edges, weights, unit = cotangent_edges(plate(1.0, 1.0))
    assert len(edges) == 5
    assert sorted(round(w, 6) for w in weights.tolist()) == [0.01, 0.5, 0.5, 0.5, 0.5]
    assert unit == pytest.approx((4 + 2**0.5) / 5)
