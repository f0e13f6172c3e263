"""Lines close to triangles against all distances."""

import pytest
import torch

from invertwin.channel.rays.triangle_spheres import TriangleSpheres


@pytest.mark.parametrize("count", [1, 8, 300])
def test_triangles_close_to_lines_are_those_by_all_distances(count):
    generator = torch.Generator().manual_seed(count)
    corners = torch.rand(count, 1, 3, generator=generator, dtype=torch.float64)
    corners = corners + 0.1 * torch.rand(count, 3, 3, generator=generator, dtype=torch.float64)
    center = corners.mean(1)
    start, offset = torch.rand(2, 50, 3, generator=generator, dtype=torch.float64).unbind()
    end = center[torch.arange(50) % count] + 0.1 * offset
    radius = (corners - center[:, None]).norm(dim=2).amax(1) + 1e-3
    direction = torch.nn.functional.normalize(end - start, dim=1)[:, None]
    distance = torch.linalg.cross(center - start[:, None], direction).norm(dim=2)
    expected = torch.nonzero(distance <= radius)

    row, face = TriangleSpheres(corners, 1e-3).find_close(start, end)

    assert len(expected) > 0
    assert torch.equal(torch.stack([row, face], 1), expected)
