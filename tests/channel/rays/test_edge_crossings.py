"""Edges that pass through surfaces without a vertex there."""

import numpy as np
import pytest
import torch

from invertwin.channel.em.wedges import find_wedges, merge_collinear_wedges
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.edge_crossings import find_crossings, split_at_crossings
from invertwin.channel.rays.ray_scene import Occluders
from invertwin.channel.rays.topology import topology_of
from invertwin.scene import Mesh, box, plate, rotation_from_vector
from scenes import float64


def split_edges(meshes, points):
    """Edges of meshes, split where they pass through triangles."""
    topology = topology_of(meshes)
    corners = points[topology.faces]
    wedges = merge_collinear_wedges(
        find_wedges(corners, points[topology.edges], topology.edge_faces)
    )
    with tracing(), torch.no_grad():
        found = find_crossings(Occluders(points, topology, points.mean(0)), wedges, 1e-4)
    return split_at_crossings(wedges, found, corners)


def test_the_edges_of_a_bar_through_a_plate_have_two_pieces_each():
    bar, sheet = box((1.0, 0.2, 0.2)), plate(1.0, 1.0)
    points = torch.cat([bar.vertices, sheet.vertices + float64([0.1, 0.0, 0.0])])
    found = split_edges([bar, sheet], points)
    cut = [n for n, end in enumerate(torch.stack([found.start, found.end], 1)[:, :, 0])
           if ((end - 0.1).abs() < 1e-9).sum() == 1]  # fmt: skip
    assert len(found.start) == 12 + 4 + 4
    assert len(cut) == 8
    length = (found.end - found.start).norm(dim=1)[cut]
    torch.testing.assert_close(length.sort().values, float64([0.4] * 4 + [0.6] * 4))


def test_corners_at_crossings_move_with_both_bodies():
    """With the plate along the bar, and as far as its slope says where it slides aside."""
    bar, sheet = box((1.0, 0.2, 0.2)), plate(1.0, 1.0)
    tilted = sheet.vertices + 0.5 * sheet.vertices[:, 1:2] * float64([1.0, 0.0, 0.0])

    def corners(move):
        return split_edges([bar, sheet], torch.cat([bar.vertices, tilted + move]))

    rate = torch.autograd.functional.jacobian(
        lambda move: corners(move).start, torch.zeros(3).double()
    )
    at = corners(torch.zeros(3).double()).start
    inner = (at[:, 0].abs() < 0.2) & (at[:, 1].abs() < 0.2)
    assert inner.sum() == 4
    torch.testing.assert_close(rate[inner][:, 0], float64([[1.0, -0.5, 0.0]] * 4))
    assert not rate[inner][:, 1:].any()


def test_edges_that_only_touch_or_end_at_a_surface_stay_whole():
    low, high = box(0.2), Mesh(box(0.1).vertices + float64([0.0, 0.0, 0.15]), box(0.1).faces)
    assert len(split_edges([low, high], torch.cat([low.vertices, high.vertices])).start) == 24


@pytest.mark.parametrize("seed", range(5))
def test_edges_in_the_plane_of_a_face_do_not_cross_it(seed):
    """Two plates, turned, of which one goes on beside part of the other, in one plane to rounding.

    Rays beside the common edge lie in that plane.
    """
    turn = rotation_from_vector(torch.from_numpy(np.random.default_rng(seed).normal(size=3)))
    one, other = plate(0.3, 0.3), plate(0.3, 0.15)
    points = torch.cat([one.vertices, other.vertices + float64([0.0, 0.3, 0.01])]) @ turn.T
    assert len(split_edges([one, other], points).start) == 8
