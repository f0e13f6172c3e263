"""Linear shape spaces."""

import pytest
import torch
from torch.autograd import gradcheck

from invertwin.errors import InputError
from invertwin.scene import LinearShape, Scene, ShapeSpace, box
from scenes import float64, thing

CUBE = box(1.0)
SCENE = Scene({"car": thing(CUBE, (0, 0, 3), (0.1, 0.2, 0.3))})


def space() -> ShapeSpace:
    """A cube that gets longer (σ 0.1 m) and higher (σ 0.05 m)."""
    longer, higher = (CUBE.vertices * float64(axis) for axis in ((1, 0, 0), (0, 0, 1)))
    components = torch.stack([longer, higher], dim=-1)
    return ShapeSpace(CUBE.vertices, components, float64([0.1, 0.05]), CUBE.faces)


def extent(mesh):
    return (mesh.vertices.amax(0) - mesh.vertices.amin(0)).detach()


def test_coordinates_are_in_standard_deviations():
    module = LinearShape("car", space(), [2.0, -1.0])
    found = module(SCENE)["car"]
    assert torch.allclose(extent(found.mesh), float64([1.2, 1.0, 0.95]))
    assert found.pose is SCENE["car"].pose
    assert torch.equal(module.values()["car.latent"], float64([2.0, -1.0]))
    assert torch.allclose(space().latent(found.mesh.vertices.detach()), float64([2.0, -1.0]))
    mean = LinearShape("car", space(), 1)
    assert torch.equal(mean(SCENE)["car"].mesh.vertices, CUBE.vertices)


def test_gradients_both_ways():
    module = LinearShape("car", space(), 2)

    def vertices(latent: torch.Tensor) -> torch.Tensor:
        moved = torch.func.functional_call(module, {"latent": latent}, (SCENE,))
        return moved["car"].vertices

    start = float64([0.4, -0.2]).requires_grad_()
    assert gradcheck(vertices, start, check_forward_ad=True)


def test_bad_input(unchecked):
    with pytest.raises(InputError, match="at most 2 coordinates of the shape space, got 3"):
        LinearShape("car", space(), 3)
    with pytest.raises(InputError, match=r"coordinates as an integer in \[1, "):
        LinearShape("car", space(), 0)
    with pytest.raises(InputError, match="NaN"):
        LinearShape("car", space(), [float("nan")])
    with pytest.raises(InputError, match="expected deviations >= 0"):
        ShapeSpace(CUBE.vertices, space().components, float64([0.1, -1.0]), CUBE.faces)
    with pytest.raises(InputError, match="expected components as numbers of shape"):
        ShapeSpace(CUBE.vertices, space().components[1:], float64([0.1, 0.1]), CUBE.faces)
