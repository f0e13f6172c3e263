"""What a surface hides of itself."""

import torch

from invertwin.channel import visible_points
from invertwin.scene import sphere


def test_a_ball_hides_its_far_side():
    mesh = sphere(0.5, subdivisions=4)
    points = mesh.vertices[mesh.faces].mean(dim=1)
    near = points[:, 0] < -0.05
    seen = visible_points(mesh, points, [[-50.0, 0.0, 0.0]])
    assert seen[near].all()
    assert not seen[points[:, 0] > 0.05].any()
    both = visible_points(mesh, points, torch.tensor([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]]))
    assert both[points[:, 0].abs() > 0.05].all()
