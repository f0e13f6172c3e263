"""Defects of meshes, by their names."""

import gc
import weakref

import pytest
import torch

from invertwin.errors import InputError
from invertwin.scene import Mesh, Object, PerfectConductor, Scene, box, plate, sphere
from invertwin.scene.mesh import concatenate_meshes
from invertwin.scene.mesh_defects import find_defects, require_single_surfaces


def moved(mesh, *offset):
    return Mesh(mesh.vertices + torch.tensor(offset, dtype=torch.float64), mesh.faces)


@pytest.mark.parametrize("mesh", [box(0.2), plate(0.3, 0.2), sphere(0.1, 2)])
def test_clean_meshes_have_none(mesh):
    assert find_defects(mesh) == (0, 0, 0.0, False)
    assert find_defects(mesh).in_words() == []


def test_both_sides_of_a_sheet_count_once():
    sheet = plate(0.3, 0.3)
    both = Mesh(sheet.vertices, torch.cat([sheet.faces, sheet.faces.flip(1)]))
    assert find_defects(both) == (2, 0, 0.0, False)


def test_bricks_that_touch_are_overlapping_parts_whose_faces_of_contact_are_doubled():
    wall = concatenate_meshes([box(0.2), moved(box(0.2), 0.2, 0, 0)])
    named = ["closed parts that overlap or touch", "2 triangles on others"]
    assert find_defects(wall).in_words() == named


def test_overlaps_are_refused_unless_they_are_hidden():
    inner = concatenate_meshes([sphere(0.1, 2), sphere(0.08, 2)])
    metal = PerfectConductor()
    scene = Scene({"ball": Object(inner, metal), "box": Object(box(1.0), metal)})
    require_single_surfaces(scene, allows_overlaps=True)
    require_single_surfaces(scene, ["box"])
    with pytest.raises(InputError, match="each place of ball, got closed parts that overlap"):
        require_single_surfaces(scene)


def test_what_is_found_of_a_mesh_does_not_keep_it():
    mesh = box(0.2)
    find_defects(mesh)
    gone = weakref.ref(mesh)
    del mesh
    gc.collect()
    assert gone() is None
