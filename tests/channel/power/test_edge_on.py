"""Edges of boxes that line up with an antenna, and the triangles beside every edge."""

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Sampling, deposit_power
from invertwin.channel.rays.topology import edge_tables
from invertwin.scene import Mesh, Object, RoughDielectric, Scene, box, plate, rotation_from_vector
from invertwin.scene.mesh_topology import close_cracks
from scenes import float64, link, relative, thing

GRID = Grid(0.0, 100.0, 1, u_start=-0.6, u_step=0.1, u_count=13)


def test_every_edge_knows_the_triangles_beside_it():
    cube = box(1.0)
    faces = cube.faces
    edges, opposite, beside = edge_tables(*close_cracks(cube.vertices.numpy(), faces.numpy())[1:3])
    assert beside.shape == opposite.shape == (18, 2)
    for ends, apexes, triangles in zip(edges, opposite, beside, strict=True):
        for apex, triangle in zip(apexes, triangles, strict=True):
            corners = {tuple(v.tolist()) for v in cube.vertices[faces[triangle]]}
            named = cube.vertices[torch.stack([*ends, apex])]
            assert corners == {tuple(v.tolist()) for v in named}
    # Every triangle lies beside its three edges.
    assert torch.bincount(beside.ravel()).tolist() == [3] * len(faces)
    single = plate(1.0, 1.0)
    _, opposite, beside = edge_tables(
        *close_cracks(single.vertices.numpy(), single.faces.numpy())[1:3]
    )
    assert torch.equal(opposite < 0, beside < 0)
    assert sorted((beside >= 0).sum(1).tolist()) == [1, 1, 1, 1, 2]


def rate(tilt: float) -> Tensor:
    """∂map/∂y of a box whose right face lies nearly in the plane of the antenna."""
    cube = box((0.2, 0.3, 0.4))
    turned = cube.vertices @ rotation_from_vector(float64([0.0, 0.0, tilt])).T
    wall = thing(plate(2.0, 2.0, divisions=2), (2.0, 0.0, 0.0), (0.0, 0.0, 0.1))
    with forward_ad.dual_level():
        shift = forward_ad.make_dual(float64(0.0), float64(1.0))
        offset = torch.stack([1.0 + 0 * shift, 0.15 + shift, 0.05 + 0 * shift])
        item = Object(Mesh(turned + offset, cube.faces), RoughDielectric(4.0))
        out = deposit_power(
            Scene({"wall": wall, "box": item}),
            link(),
            GRID,
            sampling=Sampling(depth=1, samples=100_000, boundary_samples=100_000),
            seed=0,
        )
        tangent = forward_ad.unpack_dual(out).tangent
    assert tangent is not None
    return tangent.ravel()


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["face seen", "face turned away"])
def test_a_face_nearly_edge_on_has_a_steady_shadow(side):
    """Down to a ten-thousandth of a radian; in the plane itself, the shadow's speed has a kink."""
    turned = rate(1e-3 * side)
    assert relative(rate(1e-4 * side), turned) < 0.01
    # The near edge of the face and the far one cast shadows of different speed.
    assert relative(rate(-1e-3 * side), turned) > 0.02
