"""Where surfaces meet: lengths of curves that are known."""

import math

import pytest
import torch

from invertwin.channel.rays.intersections import (
    IntersectionCurves,
    find_intersection_curves,
    find_possible_intersections,
)
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.scene_tables import flatten
from invertwin.scene import Mesh, Object, Scene, box, plate, rigid, sphere
from scenes import WAVELENGTH, link, thing

FLOOR = thing(plate(4.0, 4.0), turn=(0, math.pi / 2, 0))


def met(still: Object, moving: Object, *, deforming: bool = False) -> IntersectionCurves | None:
    """Where two objects meet, one of which moves (or only it, if its shape changes)."""
    if deforming:
        vertices = moving.mesh.vertices.clone().requires_grad_()
        objects = {"moving": Object(Mesh(vertices, moving.mesh.faces), moving.material)}
    else:
        pose = moving.transform.clone().requires_grad_()
        objects = {"still": still, "moving": Object(moving.mesh, moving.material, pose)}
    return find_intersection_curves(RayScene(flatten(Scene(objects), WAVELENGTH), link()))


def length(found: IntersectionCurves, touching: bool = False) -> float:
    chosen = found.select(found.touching == touching)
    return float((chosen.end - chosen.start).norm(dim=1).sum())


@pytest.mark.parametrize("divisions", [3, 5])
def test_balls_meet_in_a_circle(divisions):
    balls = [thing(sphere(0.25, divisions), (1.5, y, 0), (0, 0.1, y)) for y in (-0.12, 0.12)]
    found = met(*balls)
    assert found is not None
    circle = 2 * math.pi * math.sqrt(0.25**2 - 0.12**2)
    assert length(found) == pytest.approx(circle, rel=0.2 / 4 ** (divisions - 2))
    assert float((found.start[:, 1]).abs().max()) < 0.01


@pytest.mark.parametrize("depth", [0.1, 1e-3, 1e-6, 1e-8])
def test_a_box_sunk_into_the_floor_meets_it_around_itself(depth):
    found = met(FLOOR, thing(box([0.3, 0.5, 0.4], 2), (0, 0, 0.2 - depth), (0, 0, 0.5)))
    assert found is not None
    assert length(found) == pytest.approx(1.6, rel=1e-9)
    assert not found.touching.any()


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_a_box_that_stands_on_the_floor_touches_it(up):
    found = met(FLOOR, thing(box([0.3, 0.5, 0.4], 2), (0, 0, 0.2 * up), (0, 0, 0.5)))
    assert found is not None
    assert found.touching.all()
    assert bool((found.edge >= 0).all())  # the floor goes on beyond each of them


def test_a_box_above_the_floor_meets_nothing():
    found = met(FLOOR, thing(box([0.3, 0.5, 0.4], 2), (0, 0, 0.2 + 1e-8), (0, 0, 0.5)))
    assert found is not None
    assert len(found.first) == 0
    assert met(FLOOR, thing(box([0.3, 0.5, 0.4]), (0, 0, 0.21))) is None


def test_an_edge_that_lies_in_a_plane_crosses_it_once():
    wall, fin = thing(plate(0.9, 0.7), (1.5, 0, 0.02)), thing(plate(0.6, 0.5, 2), (1.5, 0, 0))
    turned = Object(fin.mesh, fin.material, thing(plate(1, 1), (1.5, 0, 0), (0, 0, 1.2)).pose)
    found = met(wall, turned)
    assert found is not None
    assert length(found) == pytest.approx(0.5, rel=1e-9)


def test_a_mesh_meets_itself_only_where_its_shape_changes():
    parts = [
        thing(plate(0.6, 0.5, 3), (1.5, 0, 0), (0.2, 0, turn)).vertices for turn in (0.9, -0.6)
    ]
    faces = plate(0.6, 0.5, 3).faces
    crossed = Mesh(torch.cat(parts), torch.cat([faces, faces + len(parts[0])]))
    found = met(FLOOR, thing(crossed), deforming=True)
    assert found is not None
    assert length(found) > 0.4
    away = Object(crossed, FLOOR.material, rigid(translation=[0.0, 0.0, 3.0]))
    assert met(FLOOR, away) is None


def test_nothing_is_looked_for_where_nothing_moves():
    balls = Scene({name: thing(sphere(0.25, 2), (1.5, y, 0)) for name, y in (("a", 0), ("b", 0.1))})
    assert find_intersection_curves(RayScene(flatten(balls, WAVELENGTH), link())) is None


def test_boxes_that_overlap_are_found_with_what_they_share():
    """Against all pairs, one by one."""
    places = torch.rand(30, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    objects = {
        str(k): Object(
            box(0.2), FLOOR.material, rigid(translation=place.clone().requires_grad_(bool(k % 3)))
        )
        for k, place in enumerate(places.clone())
    }
    geometry = flatten(Scene(objects), WAVELENGTH)
    pairs, low, high = find_possible_intersections(geometry)
    for i in range(30):
        shared = [
            (torch.maximum(places[i], places[j]) - 0.1, torch.minimum(places[i], places[j]) + 0.1)
            for j in range(30)
            if i != j and (i % 3 or j % 3) and float((places[i] - places[j]).abs().max()) < 0.2
        ]
        assert int(pairs[i].sum()) == len(shared)
        if shared:
            first, last = (torch.stack(ends) for ends in zip(*shared, strict=True))
            torch.testing.assert_close(low[i], first.amin(0), rtol=0, atol=1e-4)
            torch.testing.assert_close(high[i], last.amax(0), rtol=0, atol=1e-4)
    assert bool(pairs.any())
