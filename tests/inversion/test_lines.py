"""Lines through the parameters of modules: both ends are what the number says."""

import pytest
import torch

from invertwin.errors import InputError
from invertwin.inversion.lines import FieldLine, line_of
from invertwin.scene import DensityGrid, DistanceGrid, Scene, Translation, sphere
from scenes import float64, thing

SCENE = Scene({"ball": thing(sphere(0.2, 2), (0, 0, 1))})
THETA = torch.tensor(0.03, dtype=torch.float64)


def ball() -> DistanceGrid:
    low, high = [-0.4] * 3, [0.4] * 3
    return DistanceGrid.sampled("ball", low, high, (17, 17, 17), lambda p: p.norm(dim=1) - 0.2)


def test_a_parameter_moves_by_theta_times_its_change():
    line = line_of(Translation("ball"), {"translation": float64([1.0, 0.0, -2.0])}, SCENE)
    assert torch.allclose(line.at(THETA)["ball"].center, float64([0.03, 0.0, 0.94]))
    assert torch.equal(line.end(0.03)["ball"].center, line.at(THETA)["ball"].center)


def test_a_field_keeps_its_triangles_and_its_points_are_on_the_new_zero():
    module = ball()
    line = line_of(module, -torch.ones_like(module.value), SCENE)
    assert isinstance(line, FieldLine)
    before, after = module(SCENE)["ball"].mesh, line.end(0.03)["ball"].mesh
    assert torch.equal(before.faces, after.faces)
    # The field falls by θ everywhere: the ball's radius grows by as much.
    assert torch.allclose(after.vertices.norm(dim=1), before.vertices.norm(dim=1) + 0.03, atol=2e-3)
    with torch.no_grad():
        grown = DistanceGrid("ball", [-0.4] * 3, [0.4] * 3, module.value - THETA)
        assert float(grown.distance(after.vertices).abs().max()) < 1e-9
    with pytest.raises(InputError, match="take a smaller step"):
        line.end(-0.3)


def test_derivatives_go_through_the_module_itself():
    module = ball()
    line = line_of(module, {"value": -torch.ones_like(module.value)}, SCENE)
    with torch.autograd.forward_ad.dual_level():
        theta = torch.autograd.forward_ad.make_dual(THETA * 0, torch.ones_like(THETA))
        moved = line.at(theta)
        vertices, speed = torch.autograd.forward_ad.unpack_dual(moved["ball"].mesh.vertices)
    assert speed is not None
    outwards = vertices / vertices.norm(dim=1, keepdim=True)
    assert torch.allclose((speed * outwards).sum(1), float64(1.0), atol=0.02)


def test_a_density_changes_where_the_tangent_is():
    module = DensityGrid("ball", [-1] * 3, [1] * 3, torch.full((2, 2, 2), 3.0).double())
    change = torch.zeros(2, 2, 2, dtype=torch.float64)
    change[1] = 2.0
    found = line_of(module, change, SCENE).at(THETA)["ball"].cloud
    assert found is not None
    assert torch.allclose(found.density[0], float64(3.0))
    # softplus' = 1 − exp(−σ h): the spacing of two nodes 2 m apart is 2 m.
    slope = (1 - torch.exp(-3.0 * module.lattice.spacing.mean())) / module.lattice.spacing.mean()
    assert torch.allclose(found.density[1], 3.0 + 0.06 * slope, atol=1e-4)


def test_a_line_leaves_its_module_alone():
    module = Translation("ball", [0.1, 0.0, 0.0])
    line = line_of(module, float64([1.0, 0.0, 0.0]), SCENE)
    assert float(line.end(0.5)["ball"].center[0]) == pytest.approx(0.6)
    assert module.translation.tolist() == [0.1, 0.0, 0.0]
