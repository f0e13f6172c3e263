"""Metrics of shape against closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from invertwin.channel import visible_points
from invertwin.errors import InputError
from invertwin.inversion.metrics import (
    ShapeMetrics,
    TopologyCounts,
    axis_error,
    compare_shapes,
    count_topology,
    is_watertight,
    sample_surface,
    volume_iou,
)
from invertwin.scene import Mesh, box, plate, rigid, rotation_from_vector, sphere, text
from scenes import float64, thing


def shifted(mesh: Mesh, *offset: float) -> Mesh:
    return Mesh(mesh.vertices + float64(offset), mesh.faces)


def joined(*parts: Mesh) -> Mesh:
    starts = [sum(len(p.vertices) for p in parts[:k]) for k in range(len(parts))]
    return Mesh(
        torch.cat([p.vertices for p in parts]),
        torch.cat([p.faces + s for p, s in zip(parts, starts, strict=True)]),
    )


def test_points_are_even_and_on_the_surface():
    points, normals = sample_surface(box([1.0, 2.0, 3.0]), 40_000, seed=1)
    faces = (points.abs() / float64([0.5, 1.0, 1.5]) - 1).abs() < 1e-12
    assert bool(faces.any(1).all())
    shares = [float(faces[:, k].double().mean()) for k in range(3)]
    assert shares == pytest.approx([12 / 22, 6 / 22, 4 / 22], abs=0.01)
    assert bool(((normals * points).sum(1) > 0).all())
    assert torch.allclose(normals.norm(dim=1), float64(1.0))
    again, _ = sample_surface(box([1.0, 2.0, 3.0]), 40_000, seed=1)
    other, _ = sample_surface(box([1.0, 2.0, 3.0]), 40_000, seed=1, stream=1)
    assert torch.equal(points, again)
    assert not torch.equal(points, other)


def test_two_spheres_of_one_centre():
    near = compare_shapes(sphere(0.5), sphere(0.6), thresholds=(0.05, 0.2))
    # Points lie beside each other by up to ½ √(A / 20 000) = 7 mm, which adds little to 10 cm.
    assert near.chamfer == pytest.approx(0.1, rel=0.01)
    assert near.fscore == {0.05: 0.0, 0.2: 1.0}
    assert near.normal_consistency > 0.99
    assert near.iou == pytest.approx((5 / 6) ** 3, rel=0.01)


def test_the_same_surface_is_apart_by_the_spacing_of_its_points():
    same = compare_shapes(sphere(0.5), sphere(0.5), thresholds=(0.02,))
    assert same.chamfer == pytest.approx(0.5 * math.sqrt(math.pi / 20_000), rel=0.05)
    assert same.fscore[0.02] > 0.99
    assert same.iou == 1.0


def test_shifted_cubes_share_a_third():
    assert volume_iou(box(1.0), shifted(box(1.0), 0.5, 0, 0)) == pytest.approx(1 / 3, rel=0.01)
    assert volume_iou(box(1.0), shifted(box(1.0), 0, 0, 0.5)) == pytest.approx(1 / 3, rel=0.01)
    assert volume_iou(box(1.0), shifted(box(1.0), 0, 2.0, 0)) == 0


def test_parallel_plates():
    """Half of one within the threshold of the other: precision 1, recall 1/2."""
    small, large = plate(1.0, 1.0), shifted(plate(2.0, 1.0), 0, 0.5, 0)
    found = compare_shapes(small, shifted(large, 0.01, 0, 0), thresholds=(0.03,))
    assert found.fscore[0.03] == pytest.approx(2 / 3, abs=0.02)
    assert found.normal_consistency == pytest.approx(1.0)
    assert found.iou is None
    # 1 cm for the small one; a quarter of a metre on average for half of the large one.
    assert found.chamfer == pytest.approx((0.012 + (0.012 + 0.5) / 2) / 2, rel=0.03)


def test_turned_normals():
    turn = rotation_from_vector(float64([0.3, 0, 0]))
    flat = plate(1.0, 1.0)
    tilted = Mesh(flat.vertices @ rotation_from_vector(float64([0, 0.3, 0])).T, flat.faces)
    found = compare_shapes(tilted, Mesh(flat.vertices @ turn.T, flat.faces))
    assert found.normal_consistency == pytest.approx(math.cos(0.3), abs=1e-9)


def signed_volume(mesh: Mesh) -> float:
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return float((torch.linalg.cross(a, b) * c).sum() / 6)


@pytest.mark.parametrize(
    ("mesh", "within"),
    [
        (box(0.4, divisions=4), 1e-9),
        (shifted(box(0.4, divisions=4), 0.0037, 0.0037, 0.0037), 1e-9),
        # Centres of voxels lie on the mesh's own edges and corners: every column comes out even.
        (shifted(box(0.4, divisions=4), 0.01, 0.01, 0.01), 0.16),
        (
            Mesh(
                box(0.4).vertices @ rotation_from_vector(float64([0.4, 0.2, 0.7])).T, box(1).faces
            ),
            0.02,
        ),
        (text("A", 0.6, 0.2), 0.03),
    ],
    ids=["between", "anywhere", "on edges", "turned", "letter"],
)
def test_volume_of_voxels_is_that_of_the_mesh(mesh, within):
    assert is_watertight(mesh)
    assert 8 * volume_iou(mesh, box(2.0)) == pytest.approx(signed_volume(mesh), rel=within)


def test_overlapping_parts_count_once_and_holes_are_holes():
    two = joined(box(1.0), shifted(box(1.0), 0.5, 0, 0))
    assert volume_iou(two, box([1.5, 1.0, 1.0])) == pytest.approx(1.25 / 1.75, rel=0.02)
    inner = box(0.5)
    hollow = joined(box(1.0), Mesh(inner.vertices, inner.faces[:, [0, 2, 1]]))
    assert volume_iou(hollow, box(1.0)) == pytest.approx(1 - 0.125, rel=0.02)


def test_open_meshes_are_told_apart():
    assert is_watertight(sphere(0.2, 1))
    opened = Mesh(sphere(0.2, 1).vertices, sphere(0.2, 1).faces[1:])
    assert not is_watertight(opened)
    with pytest.raises(InputError, match="expected a watertight found mesh"):
        volume_iou(opened, sphere(0.2, 1))
    with pytest.raises(InputError, match="expected a watertight true mesh"):
        volume_iou(sphere(0.2, 1), plate(1.0, 1.0))


def test_half_of_a_ball_is_seen_from_afar():
    points, _ = sample_surface(sphere(0.5, 5), 5_000, seed=0)
    seen = visible_points(sphere(0.5, 5), points, [[0, 0, -50.0]])
    assert float(seen.double().mean()) == pytest.approx(0.5, abs=0.03)
    assert bool((points[seen][:, 2] < 0.02).all())
    both = visible_points(sphere(0.5, 5), points, [[0, 0, -50.0], [0, 0, 50.0]])
    assert float(both.double().mean()) > 0.97


def test_a_far_side_that_nobody_sees_does_not_count():
    """A ball whose back is cut off: right where it is seen, wrong behind."""
    ball = sphere(0.5, 5)
    back = ball.vertices[:, 2] > 0.1
    vertices = ball.vertices.clone()
    vertices[back, 2] = 0.1
    cut = Mesh(vertices, ball.faces)
    whole = compare_shapes(cut, ball, thresholds=(0.03,), voxel=0.04)
    front = compare_shapes(cut, ball, seen_from=[[0, 0, -5.0]], thresholds=(0.03,), voxel=0.04)
    behind = compare_shapes(cut, ball, seen_from=[[0, 0, 5.0]], thresholds=(0.03,), voxel=0.04)
    assert front.fscore[0.03] > 0.99
    assert whole.fscore[0.03] < 0.9
    assert behind.fscore[0.03] < 0.5
    assert front.chamfer < 0.01 < whole.chamfer < behind.chamfer
    ious = [like.iou for like in (front, whole, behind)]
    assert all(iou is not None for iou in ious)
    assert ious == sorted(ious, key=float, reverse=True)  # type: ignore[arg-type]
    assert ious[0] > 0.95  # type: ignore[operator]


def test_same_seed_same_numbers():
    one, two = (compare_shapes(sphere(0.5), box(0.8), seed=3, count=500) for _ in range(2))
    assert isinstance(one, ShapeMetrics)
    assert one == two


def test_bad_input():
    ball = sphere(0.1, 1)
    with pytest.raises(InputError, match="expected thresholds > 0"):
        compare_shapes(ball, ball, thresholds=(0.0,))
    with pytest.raises(InputError, match="points as an integer"):
        compare_shapes(ball, ball, count=0)
    with pytest.raises(InputError, match="with area"):
        compare_shapes(Mesh(0 * ball.vertices, ball.faces), ball)
    with pytest.raises(InputError, match=r"voxel \[m\]"):
        volume_iou(ball, ball, voxel=0.0)
    with pytest.raises(InputError, match="give a larger voxel"):
        volume_iou(ball, ball, voxel=1e-5)
    with pytest.raises(InputError, match="give a smaller voxel"):
        volume_iou(shifted(ball, 0.25, 0.25, 0.25), shifted(ball, 0.25, 0.25, 0.25), voxel=1.0)
    with pytest.raises(InputError, match="radar positions"):
        compare_shapes(ball, ball, seen_from=[[0.0, 1.0]])
    (normal,) = sample_surface(ball, 1, seed=0)[1]
    with pytest.raises(InputError, match="expected a found surface that some position sees"):
        compare_shapes(ball, ball, seen_from=-10 * normal[None], count=1)


def test_the_volume_may_be_left_out():
    mesh = sphere(0.2, 2)
    with_volume, without = (compare_shapes(mesh, mesh, voxel=v, count=500) for v in (0.05, None))
    assert with_volume.iou == 1
    assert without.iou is None
    assert without.chamfer == with_volume.chamfer


def test_parts_and_holes_are_counted():
    assert count_topology(sphere(0.2, 1)) == TopologyCounts(components=1, euler_number=2)
    assert count_topology(text("A", 0.6, 0.2)) == TopologyCounts(components=1, euler_number=0)
    assert count_topology(text("B", 0.6, 0.2)) == TopologyCounts(components=1, euler_number=-2)
    two = joined(sphere(0.2), shifted(text("A", 0.6, 0.2), 2, 0, 0))
    assert count_topology(two) == TopologyCounts(components=2, euler_number=2)
    # Triangles without area, and vertices that no triangle has, are no part of the surface.
    ball = sphere(0.2, 1)
    corners = torch.cat([float64([[9.0, 9.0, 9.0]]), ball.vertices])
    thin = torch.tensor([[1, 1, 2], [3, 3, 3]])
    assert count_topology(Mesh(corners, torch.cat([ball.faces + 1, thin]))) == count_topology(ball)
    with pytest.raises(InputError, match="expected a watertight mesh"):
        count_topology(plate(1.0, 1.0))


def test_an_axis_knows_no_turns_about_itself():
    there = thing(box((1.0, 1.0, 1.0)), (0.1, 0.0, 0.0), (0.0, 0.3, 0.0))
    rolled = (
        there.transform @ thing(box((1.0, 1.0, 1.0)), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)).transform
    )
    moved = replace(there, pose=rigid(translation=float64([0.0, 0.03, 0.04])) @ rolled)
    assert axis_error(moved, there, (0.0, 0.0, -2.0)) == pytest.approx((0.05, 0.0), abs=1e-12)
    assert axis_error(moved, there, (1.0, 0.0, 0.0))[1] == pytest.approx(1.0)
    with pytest.raises(InputError, match="expected an axis of some length"):
        axis_error(moved, there, (0.0, 0.0, 0.0))
