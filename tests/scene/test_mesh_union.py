"""Bodies that overlap or touch within one mesh are one surface."""

import math

import pytest
import torch

from invertwin.errors import PhysicsWarning
from invertwin.scene import Mesh, box, load_mesh, merge_meshes, plate, save_mesh, sphere
from invertwin.scene.mesh import concatenate_meshes


def moved(mesh, *offset):
    return Mesh(mesh.vertices + torch.tensor(offset, dtype=torch.float64), mesh.faces)


def overlapping_halves():
    """Two boxes with four planes in common that make one of 0.4 × 0.5 × 0.3."""
    return moved(box((0.3, 0.5, 0.3)), -0.05, 0, 0), moved(box((0.2, 0.5, 0.3)), 0.1, 0, 0)


def volume(mesh):
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


def test_overlapping_boxes_with_shared_planes_are_the_box():
    whole = merge_meshes(overlapping_halves())
    assert len(whole.faces) == 12
    assert volume(whole) == pytest.approx(0.4 * 0.5 * 0.3)
    assert whole.area == pytest.approx(box((0.4, 0.5, 0.3)).area)
    assert whole.summary().open_edges == whole.summary().nonmanifold_edges == 0


def test_touching_boxes_lose_the_faces_between_them():
    seat, leg = box((0.4, 0.4, 0.05)), moved(box((0.05, 0.05, 0.4)), 0.1, 0.1, -0.225)
    chair = merge_meshes([seat, leg])
    assert chair.area == pytest.approx(seat.area + leg.area - 2 * 0.05**2)
    assert chair.summary().open_edges == 0


def test_a_body_inside_of_another_is_dropped_and_a_cavity_stays():
    outer, inner = sphere(0.3, 2), sphere(0.1, 2)
    assert merge_meshes([outer, inner]).area == pytest.approx(outer.area)
    cavity = Mesh(inner.vertices, inner.faces.flip(1))
    assert merge_meshes([outer, cavity]).area == pytest.approx(outer.area + inner.area)


def test_what_is_apart_open_or_differentiated_stays():
    apart = [box(0.2), moved(box(0.2), 1.0, 0, 0)]
    crossing = [box(0.2), plate(1.0, 1.0)]
    halves = list(overlapping_halves())
    free = [Mesh(halves[0].vertices.clone().requires_grad_(), halves[0].faces), halves[1]]
    for parts in (apart, crossing, free):
        whole, plain = merge_meshes(parts), concatenate_meshes(parts)
        assert torch.equal(whole.vertices, plain.vertices)
        assert torch.equal(whole.faces, plain.faces)


def test_an_open_part_stays_beside_a_union():
    lid = moved(plate(0.1, 0.1), 0.0, 0.0, 2.0)
    whole = merge_meshes([*overlapping_halves(), lid])
    assert len(whole.faces) == 14
    assert whole.area == pytest.approx(box((0.4, 0.5, 0.3)).area + lid.area)


def test_a_file_of_overlapping_parts_is_repaired_and_says_so(tmp_path):
    save_mesh(tmp_path / "halves.ply", concatenate_meshes(overlapping_halves()))
    with pytest.warns(PhysicsWarning, match="24 triangles are 12"):
        read = load_mesh(tmp_path / "halves.ply")
    assert volume(read) == pytest.approx(0.06)
    assert math.isclose(read.area, box((0.4, 0.5, 0.3)).area)


def other_diagonals(mesh):
    """A box whose quadrilaterals are split along the other diagonal."""
    turned = mesh.vertices * torch.tensor([1.0, -1.0, 1.0]).double()
    return Mesh(turned, mesh.faces.flip(1))


@pytest.mark.parametrize("again", [lambda mesh: mesh, other_diagonals])
def test_equal_bricks_that_touch_in_a_whole_face_are_one(again):
    """The face of contact is in both: by the same triangles, or by others."""
    brick = box((0.2, 0.3, 0.1))
    wall = [brick, moved(again(brick), 0.2, 0, 0), moved(brick, 0, 0, 0.1)]
    whole = merge_meshes(wall)
    assert whole.area == pytest.approx(3 * brick.area - 2 * 0.03 - 2 * 0.06)
    assert whole.summary().open_edges == whole.summary().nonmanifold_edges == 0


def test_four_bricks_around_an_edge_are_one():
    brick = box(0.2)
    whole = merge_meshes([moved(brick, x, y, 0) for x in (0.0, 0.2) for y in (0.0, 0.2)])
    assert whole.area == pytest.approx(box((0.4, 0.4, 0.2)).area)


def test_a_sheet_with_two_sides_stays():
    sheet = plate(0.3, 0.3)
    both = Mesh(sheet.vertices, torch.cat([sheet.faces, sheet.faces.flip(1)]))
    beside = merge_meshes([both, box(0.2), moved(box(0.2), 0.1, 0, 0)])
    assert beside.area == pytest.approx(sheet.area + box((0.3, 0.2, 0.2)).area)
    assert len(merge_meshes([both]).faces) == 2 * len(sheet.faces)
