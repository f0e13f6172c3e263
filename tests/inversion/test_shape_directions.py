"""Numbers that change a shape: both ends are the shape that the number says."""

import pytest
import torch
from invertwin.inversion.shape_directions import along, along_density, along_field

from invertwin.errors import InputError
from invertwin.scene import Cloud, Scene, Translation, sphere
from invertwin.scene.geometry import DistanceGrid
from scenes import float64, radar, thing

SCENE = Scene({"ball": thing(sphere(0.2, 2), (0, 0, 1))})
THETA = torch.tensor(0.03, dtype=torch.float64)


def ball() -> DistanceGrid:
    low, high = [-0.4] * 3, [0.4] * 3
    return DistanceGrid.sampled("ball", low, high, (17, 17, 17), lambda p: p.norm(dim=1) - 0.2)


def test_a_parameter_moves_by_theta_times_its_change():
    direction = along(Translation("ball"), translation=float64([1.0, 0.0, -2.0]))
    moved, seen = direction(SCENE, radar(), THETA)
    assert torch.allclose(moved["ball"].center, float64([0.03, 0.0, 0.94]))
    assert torch.equal(seen.positions, radar().positions)


def test_a_field_keeps_its_triangles_and_its_points_are_on_the_new_zero():
    module = ball()
    scene = module(SCENE)
    direction = along_field(module, SCENE, value=-torch.ones_like(module.value))
    moved, _ = direction(scene, radar(), THETA)
    before, after = scene["ball"].mesh, moved["ball"].mesh
    assert torch.equal(before.faces, after.faces)
    # The field falls by θ everywhere: the ball's radius grows by as much.
    assert torch.allclose(after.vertices.norm(dim=1), before.vertices.norm(dim=1) + 0.03, atol=2e-3)
    with torch.no_grad():
        grown = DistanceGrid("ball", [-0.4] * 3, [0.4] * 3, module.value - THETA)
        assert float(grown.distance(after.vertices).abs().max()) < 1e-9
    with pytest.raises(InputError, match="take a smaller step"):
        direction(scene, radar(), -10 * THETA)


def test_derivatives_go_through_the_module_itself():
    module = ball()
    direction = along_field(module, SCENE, value=-torch.ones_like(module.value))
    with torch.autograd.forward_ad.dual_level():
        theta = torch.autograd.forward_ad.make_dual(THETA * 0, torch.ones_like(THETA))
        moved, _ = direction(SCENE, radar(), theta)
        vertices, speed = torch.autograd.forward_ad.unpack_dual(moved["ball"].mesh.vertices)
    assert speed is not None
    outwards = vertices / vertices.norm(dim=1, keepdim=True)
    assert torch.allclose((speed * outwards).sum(1), float64(1.0), atol=0.02)


def test_a_density_is_scaled_where_the_change_is():
    cloud = Cloud(float64([-1] * 3), float64([1] * 3), torch.full((2, 2, 2), 3.0).double())
    change = torch.zeros(2, 2, 2, dtype=torch.float64)
    change[1] = 2.0
    scene = SCENE.replace("ball", cloud=cloud)
    moved, _ = along_density("ball", change)(scene, radar(), THETA)
    found = moved["ball"].cloud
    assert found is not None
    assert torch.allclose(found.density[0], float64(3.0))
    assert torch.allclose(found.density[1], float64(3.18))
    with pytest.raises(InputError, match="expected a cloud on ball"):
        along_density("ball", change)(SCENE, radar(), THETA)
