"""Even cells of closed surfaces, whatever their triangles are."""

import numpy as np
import pytest

from invertwin.channel.rcs.moments.mfie import build_cells
from invertwin.scene import Mesh, box, cylinder, sphere
from scenes import float64

BALL = sphere(1.0, 4)


def corners(*meshes: Mesh) -> np.ndarray:
    return np.concatenate([mesh.vertices[mesh.faces].numpy() for mesh in meshes])


def moved(mesh: Mesh, x: float) -> Mesh:
    return Mesh(mesh.vertices + float64([x, 0.0, 0.0]), mesh.faces)


def test_cells_of_a_ball_are_even_and_bent_as_it_is():
    cells = build_cells(corners(BALL), 0.2)
    assert cells.closed
    assert len(cells.area) == pytest.approx(4 * np.pi / 0.2**2, rel=0.02)
    assert cells.area.sum() == pytest.approx(4 * np.pi, rel=0.01)
    assert cells.area.std() < 0.15 * cells.area.mean()
    radius = np.linalg.norm(cells.point, axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=0.003)
    np.testing.assert_allclose(cells.normal, cells.point / radius[:, None], atol=0.02)
    np.testing.assert_allclose(cells.inscribed_radius, 1.0, atol=0.1)
    # dn = dx along the surface of a ball of 1 m, nothing across it.
    across = np.eye(3) - cells.normal[:, :, None] * cells.normal[:, None]
    assert np.abs(cells.curvature - across).mean() < 0.03


def test_long_thin_triangles_give_the_same_cells():
    mesh = cylinder(0.5, 4.0)
    cells = build_cells(corners(mesh), 0.25)
    assert cells.closed
    assert cells.area.std() < 0.25 * cells.area.mean()
    bends = np.linalg.eigvalsh(cells.curvature)
    round_about = bends[:, 2] > 1.0
    assert cells.area[round_about].sum() == pytest.approx(4 * np.pi, rel=0.1)  # the lids are flat
    assert np.median(bends[round_about, 2]) == pytest.approx(2.0, rel=0.05)
    assert np.median(np.abs(bends[round_about, 1])) < 0.05


def test_faces_that_meet_at_an_edge_share_no_cell():
    cells = build_cells(corners(box((1.0, 1.0, 1.0))), 0.1)
    assert np.abs(cells.normal).max(1).min() > 0.98
    assert np.median(np.abs(cells.curvature)) < 1e-9


def test_bodies_that_overlap_or_are_inside_out_are_not_closed():
    assert build_cells(corners(BALL, moved(BALL, 2.5)), 0.3).closed
    assert not build_cells(corners(BALL, moved(BALL, 1.2)), 0.3).closed
    assert not build_cells(corners(Mesh(BALL.vertices, BALL.faces.flip(1))), 0.3).closed


def test_two_runs_are_equal():
    first, second = (build_cells(corners(BALL), 0.3) for _ in range(2))
    np.testing.assert_array_equal(first.point, second.point)
