"""What a surface hides of itself, and which sheets a segment passes."""

import pytest
import torch

from invertwin.channel import visible_points
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import Occluders, find_passed_sheets
from invertwin.channel.rays.scene_tables import connect_surfaces
from invertwin.scene import Scene, sphere
from scenes import float64, level_plate, thing


def test_a_ball_hides_its_far_side():
    mesh = sphere(0.5, subdivisions=4)
    points = mesh.vertices[mesh.faces].mean(dim=1)
    near = points[:, 0] < -0.05
    seen = visible_points(mesh, points, [[-50.0, 0.0, 0.0]])
    assert seen[near].all()
    assert not seen[points[:, 0] > 0.05].any()
    both = visible_points(mesh, points, torch.tensor([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]]))
    assert both[points[:, 0].abs() > 0.05].all()


@pytest.mark.parametrize(("size", "tilt"), [(3.0, 0.3), (60.0, 1.2), (400.0, 1.2)])
def test_a_sheet_is_passed_once_however_large_it_is(size: float, tilt: float):
    """Rounding grows with the scene: rays met a facade again that they had just passed."""
    facade = Scene({"facade": thing(level_plate(size, size), turn=(0.0, tilt, 0.0))})
    ends = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(1)).double() - 0.5
    above, below = ends + float64([0.0, 0.0, 2.0]), ends - float64([0.1, 0.0, 2.0])
    with tracing():
        topology, vertices = connect_surfaces(facade)
        rays = Occluders(vertices, topology, torch.zeros(3).double())
        _, passed = find_passed_sheets(rays, below, above, torch.ones(2, dtype=torch.bool))
    row = torch.cat([row for row, _ in passed])
    assert len(row) == len(row.unique()) == len(ends)
