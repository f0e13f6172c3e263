"""Densities on a grid: values, the cloud they make, and the surface of a level."""

import pytest
import torch
from torch import Tensor

from invertwin.errors import InputError
from invertwin.inversion.metrics import volume_iou
from invertwin.scene import DensityGrid, Object, RoughDielectric, Scene, plate, sphere
from invertwin.scene.parameters import Scale, Translation
from invertwin.scene.shape_models.density import replace_clouds

BOX = [-0.5] * 3, [0.5] * 3


def ball(radius: float = 0.3, count: int = 21) -> Tensor:
    """A soft ball: 20 per metre inside, 0 outside, half of it on the sphere."""
    axis = torch.linspace(-0.5, 0.5, count, dtype=torch.float64)
    distance = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0)
    return 20 * torch.sigmoid((radius - distance) / 0.02)


def test_densities_come_back_and_are_never_negative() -> None:
    given = ball()
    grid = DensityGrid("item", *BOX, given)
    faintest = 1e-3 / 0.05  # of one over a spacing
    torch.testing.assert_close(grid.density.detach(), given.clamp_min(faintest))
    with torch.no_grad():
        grid.value.sub_(50.0)
    assert float(grid.density.detach().min()) >= 0
    assert grid.cloud.density.requires_grad


def test_an_even_start_has_the_depth_it_was_given() -> None:
    grid = DensityGrid.from_optical_depth("item", [0, 0, 0], [2, 1, 1], (9, 5, 5), depth=0.3)
    torch.testing.assert_close(
        2 * grid.density.detach(), torch.full((9, 5, 5), 0.3, dtype=torch.float64)
    )


def test_the_object_becomes_a_cloud_and_a_mesh_again() -> None:
    scene = Scene({"item": Object(plate(1.0, 1.0), RoughDielectric(4.0))})
    grid = DensityGrid("item", *BOX, ball())
    soft = grid(scene)
    assert soft["item"].cloud is not None
    assert soft["item"].mesh is scene["item"].mesh
    mesh = grid.mesh(level=10.0)
    assert volume_iou(mesh, sphere(0.3), voxel=0.02) > 0.95
    assert not mesh.vertices.requires_grad


def test_a_scene_without_clouds() -> None:
    marker = Object(plate(1.0, 1.0), RoughDielectric(4.0))
    scene = Scene({"soft": marker, "even": marker, "hard": marker})
    scene = DensityGrid("soft", *BOX, ball())(scene)
    scene = DensityGrid.from_optical_depth("even", *BOX, (3, 3, 3))(scene)
    solid = replace_clouds(scene)
    assert all(item.cloud is None for item in solid.objects.values())
    assert volume_iou(solid["soft"].mesh, sphere(0.3), voxel=0.02) > 0.9
    assert solid["even"].mesh is marker.mesh


def test_what_reaches_the_box_is_closed() -> None:
    grid = DensityGrid("item", *BOX, ball(radius=0.6))
    mesh = grid.mesh()
    edges = torch.cat([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, counts = edges.sort(dim=1).values.unique(dim=0, return_counts=True)
    assert bool((counts == 2).all())
    corners = mesh.vertices[mesh.faces]
    volume = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert 0.75 < float(volume) < 1.0  # outwards


@pytest.mark.parametrize(
    ("density", "message"),
    [(torch.full((3, 3, 3), -1.0), "at least 0"), (torch.full((3, 3, 1), 1.0), r"in \[2, ")],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_densities_are_refused(density: Tensor, message: str) -> None:
    with pytest.raises(InputError, match=message):
        DensityGrid("item", *BOX, density.double())


def test_a_level_beyond_the_densities_is_refused() -> None:
    with pytest.raises(InputError, match="level"):
        DensityGrid("item", *BOX, ball()).mesh(level=30.0)


@pytest.mark.parametrize("order", [("size", "cloud"), ("cloud", "size")])
def test_what_a_cloud_does_not_show_cannot_be_fitted(order):
    scene = Scene({"ball": Object(sphere(0.1, 1), RoughDielectric(4.0))})
    made = {
        "size": Scale("ball"),
        "cloud": DensityGrid.from_optical_depth("ball", [-0.2] * 3, [0.2] * 3, (3, 3, 3)),
    }
    first, last = (made[name] for name in order)
    with pytest.raises(
        InputError, match=r"shape of 'ball' beside|of the cloud 'ball', got its mesh"
    ):
        last(first(scene))


def test_a_cloud_can_be_moved():
    scene = Scene({"ball": Object(sphere(0.1, 1), RoughDielectric(4.0))})
    scene = DensityGrid.from_optical_depth("ball", [-0.2] * 3, [0.2] * 3, (3, 3, 3))(scene)
    moved = Translation("ball", [0.1, 0, 0])(scene)["ball"]
    offset = moved.transform[:3, 3] - scene["ball"].transform[:3, 3]
    torch.testing.assert_close(offset, torch.tensor([0.1, 0, 0], dtype=torch.float64))
    before, after = scene["ball"].cloud, moved.cloud
    assert before is not None
    assert after is not None
    for name in ("low", "high", "density"):
        assert torch.equal(getattr(after, name), getattr(before, name))
