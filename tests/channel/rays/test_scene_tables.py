"""A scene as flat tables."""

import pytest
import torch

from invertwin.channel.rays.scene_tables import flatten
from invertwin.radar import PhysicsWarning
from invertwin.scene import Mesh, Object, RoughConductor, RoughDielectric, Scene, rigid
from invertwin.scene.shapes import box, plate, sphere
from scenes import thing


def test_facets_that_turn_by_more_than_a_lobe_are_warned_of():
    shiny = RoughConductor(rms_slope=0.03)
    coarse = Scene({"ball": thing(sphere(0.1, 2), material=shiny), "wall": thing(plate(1.0, 1.0))})
    with pytest.warns(PhysicsWarning, match=r"triangles of ball turn by 1\d° .* wide \(1\.7°\)"):
        flatten(coarse, 4e-3)
    flatten(Scene({"ball": thing(sphere(0.1, 5), material=shiny)}), 4e-3)
    flatten(Scene({"box": thing(box(0.2), material=shiny)}), 4e-3)
    flatten(Scene({"ball": thing(sphere(0.1, 2))}), 4e-3)


def test_objects_of_one_material_share_its_row_and_values_per_triangle_have_rows_of_their_own():
    slopes = torch.linspace(0.1, 0.3, 12, dtype=torch.float64)
    patched, matt = RoughConductor(rms_slope=slopes), RoughConductor(rms_slope=0.2)
    scene = Scene(
        {
            "first": Object(box(0.2), matt),
            "patched": Object(box(0.3), patched),
            "paper": Object(plate(1.0, 1.0), RoughDielectric(4.0)),
            "equal": Object(box(0.4), RoughConductor(rms_slope=0.2)),
            "patched too": Object(box(0.5), patched),
        }
    )
    found = flatten(scene, 4e-3)
    assert len(found.surfaces.diffuse) == 1 + 12 + 1
    for number, item in enumerate(scene.objects.values()):
        rows = found.face_surface[found.face_object == number]
        own = item.material.scattering_law(299_792_458.0 / 4e-3)
        assert torch.equal(found.surfaces.exponents[rows], own.exponents.expand(len(rows), 3))


def test_a_shared_material_gets_the_derivatives_of_all_its_objects():
    slope = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    shiny = RoughConductor(rms_slope=slope)
    scene = Scene({"one": Object(box(0.2), shiny), "two": Object(box(0.3), shiny)})
    found = flatten(scene, 4e-3)
    assert len(found.surfaces.diffuse) == 1
    found.surfaces.exponents[found.face_surface].sum().backward()
    both = slope.grad
    slope.grad = None
    shiny.scattering_law(299_792_458.0 / 4e-3).exponents.sum().backward()
    assert slope.grad is not None
    assert both is not None
    assert float(both) == pytest.approx(24 * float(slope.grad))


def test_what_moves_is_said_of_each_object():
    turn = rigid(translation=(1.0, 0.0, 0.0)).requires_grad_()
    shape = Mesh(box(0.1).vertices.clone().requires_grad_(), box(0.1).faces)
    matt = RoughDielectric(4.0)
    found = flatten(
        Scene(
            {
                "still": thing(box(0.2), (0.0, 1.0, 0.0)),
                "placed": Object(box(0.3), matt, turn),
                "shaped": Object(shape, matt),
                "bare": Object(box(0.1), matt),
            }
        ),
        4e-3,
    )
    assert found.differentiated == (False, True, True, False)
    assert found.shape_differentiated == (False, False, True, False)
