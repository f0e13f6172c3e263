"""Deformation by a lattice: translations, smoothness, gradients."""

import pytest
import torch
from torch.autograd import gradcheck

from invertwin.errors import InputError
from invertwin.scene import LatticeDeformation, RoughDielectric, Scene, sphere
from scenes import float64, thing

BALL = sphere(0.2, subdivisions=1)
SCENE = Scene({"ball": thing(BALL, (0.1, 0.2, 2.0), (0.3, 0.0, 0.5), RoughDielectric(4.0))})


def module(counts: tuple[int, int, int] = (3, 2, 4)) -> LatticeDeformation:
    return LatticeDeformation("ball", [-0.3, -0.25, -0.2], [0.3, 0.25, 0.2], counts)


def test_starts_as_the_identity_and_equal_offsets_translate():
    bend = module()
    assert torch.equal(bend(SCENE)["ball"].mesh.vertices, BALL.vertices)
    shift = float64([0.03, -0.01, 0.02])
    bend.offsets.data = shift.expand(bend.offsets.shape).clone()
    moved = bend(SCENE)["ball"].mesh.vertices.detach()
    assert torch.allclose(moved, BALL.vertices + shift, atol=1e-15)
    assert bend.values()["ball.control_offsets"].shape == (5, 4, 6, 3)


def test_offsets_that_follow_a_straight_line_stretch():
    """Splines of linear data are linear: offsets proportional to the place scale the object."""
    bend = module((4, 4, 4))
    lattice = bend.lattice
    axes = [low + step * (torch.arange(6) - 1) for low, step in zip(lattice.low, lattice.spacing)]  # noqa: B905
    bend.offsets.data = 0.1 * torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    moved = bend(SCENE)["ball"].mesh.vertices.detach()
    assert torch.allclose(moved, 1.1 * BALL.vertices, atol=1e-14)


def test_a_control_point_moves_only_what_is_near_and_does_so_smoothly():
    bend = LatticeDeformation("ball", [0, 0, 0], [1, 1, 1], (9, 2, 2))
    bend.offsets.data[5, :, :, 0] = 1.0
    x = torch.linspace(0, 1, 4001, dtype=torch.float64)
    points = torch.stack([x, 0 * x + 0.4, 0 * x + 0.6], dim=1)
    moved = bend.displacement(points)[:, 0].detach()
    center, width = 0.5, 0.125
    assert float(moved[(x - center).abs() > 2 * width].abs().max()) < 1e-12
    assert float(moved[2000]) == pytest.approx(2 / 3)
    bends = moved.diff().diff() / x[1] ** 2  # the second derivative has no jump
    assert float(bends.diff().abs().max()) < 0.02 * float(bends.abs().max())


def test_gradients_both_ways():
    bend = module((2, 2, 2))
    generator = torch.Generator().manual_seed(0)
    offsets = 0.02 * torch.randn(bend.offsets.shape, generator=generator, dtype=torch.float64)

    def vertices(values: torch.Tensor) -> torch.Tensor:
        moved = torch.func.functional_call(bend, {"offsets": values}, (SCENE,))
        return moved["ball"].vertices

    assert gradcheck(vertices, offsets.requires_grad_(), check_forward_ad=True, fast_mode=True)


def test_bad_input():
    with pytest.raises(InputError, match="expected a box with low < high"):
        LatticeDeformation("ball", [0, 0, 0], [1, 0, 1])
    with pytest.raises(InputError, match=r"nodes along an axis as an integer in \[2, "):
        LatticeDeformation("ball", [0, 0, 0], [1, 1, 1], (4, 1, 4))
    with pytest.raises(InputError, match="expected points of 'ball' in the lattice's box"):
        LatticeDeformation("ball", [-0.1] * 3, [0.3] * 3)(SCENE)
