"""Paths over faces: to the sharp edge, whatever triangles the face is made of."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from invertwin.channel.beams.beam_tracing import build_facets
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import Occluders
from invertwin.channel.rays.topology import topology_of
from invertwin.channel.rcs.surface_paths import face_path_lengths
from invertwin.scene import Mesh, box, merge_meshes, sphere
from scenes import float64

SIZE = (0.4, 0.3, 0.2)


def halves() -> Mesh:
    """The box of SIZE in two parts along y, of other triangles each, without a face between."""
    parts = []
    for shift, count in ((-0.075, 1), (0.075, 2)):
        part = box((SIZE[0], SIZE[1] / 2, SIZE[2]))
        inner = (part.vertices[part.faces][..., 1] * shift < 0).all(1)
        part = Mesh(part.vertices + float64([0, shift, 0]), part.faces[~inner])
        parts.append(part if count == 1 else quartered(part))
    return merge_meshes(parts)


def quartered(mesh: Mesh) -> Mesh:
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    pieces = torch.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    return Mesh(pieces, torch.arange(len(pieces)).reshape(-1, 3))


def lengths(mesh: Mesh, point: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Lengths from points, each of which lies in the face it is nearest to."""
    with tracing():
        topology = topology_of([mesh], [mesh.vertices])
        facets = build_facets(mesh.vertices, topology)
        occluders = Occluders(mesh.vertices, topology, mesh.vertices.mean(0))
        top = facets.normal[:, 2] > 0.9
        far = (facets.corners.mean(1)[None] - (point + 1e-6 * direction)[:, None]).norm(dim=2)
        # The triangle that holds the point is the one whose barycentric coordinates are positive.
        a, b, c = facets.corners.unbind(1)
        inside = torch.ones(len(point), len(a), dtype=torch.bool)
        for p, q in ((a, b), (b, c), (c, a)):
            inward = torch.linalg.cross(facets.normal, q - p)
            inside &= ((point + 1e-6 * direction)[:, None] - p[None]).mul(inward[None]).sum(2) > 0
        face = torch.where(inside & top, far, math.inf).argmin(1)
        return face_path_lengths(facets, occluders, face, point, direction)


@pytest.mark.parametrize("make", [lambda: box(SIZE), lambda: quartered(box(SIZE)), halves])
def test_a_path_ends_at_the_sharp_edge(make):
    angle = torch.linspace(-1.2, 1.2, 9, dtype=torch.float64)
    direction = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    start = float64([-0.2, 0.013, 0.1]).expand(9, 3)
    room = torch.where(angle > 0, 0.15 - 0.013, 0.15 + 0.013)
    expected = torch.minimum(0.4 / angle.cos(), room / angle.sin().abs().clamp_min(1e-9))
    assert torch.allclose(lengths(make(), start, direction), expected, atol=1e-9)


def test_a_path_over_a_ball_ends_where_the_normal_has_turned():
    """At 0.35 rad of arc, to within a triangle."""
    mesh = sphere(1.0, 5)
    start = mesh.vertices[mesh.vertices[:, 2].argmax()][None]
    direction = float64([[0.6, 0.8, 0.0]])
    corners = mesh.vertices[mesh.faces]
    near = (corners.mean(1) - start - 0.01 * direction).norm(dim=1).argmin()
    normal = torch.linalg.cross(*(corners[near, k] - corners[near, 0] for k in (1, 2)))
    start = corners[near].mean(0)[None]
    direction = normalize(direction - direction @ normal * normal / normal.dot(normal), dim=1)
    assert float(lengths(mesh, start, direction)) == pytest.approx(0.35, abs=0.06)
