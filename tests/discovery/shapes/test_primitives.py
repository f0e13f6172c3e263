"""Shapes on the ground as unknowns."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from invertwin.discovery.shapes.primitives import (
    NARROW,
    Figure,
    Primitive,
    opening,
    turned,
    upright,
)
from invertwin.errors import InputError
from invertwin.inversion.confidence.uncertainty import coordinates
from invertwin.inversion.initialisation.detections import Ground
from invertwin.scene import RoughConductor, RoughDielectric, rotation_from_vector

BOX = Figure("box", (0.3, -0.4), 0.3, 0.8, 0.2, 1.1, 0.05)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
def test_a_shape_has_the_numbers_it_was_made_of(kind: Any, up: Any):
    ground = Ground(up)
    figure = Figure(kind, (0.3, -0.4), 0.3, 0.8, 0.8 if kind != "box" else 0.2, 1.1, 0.05)
    one = Primitive("thing", figure, ground, level=0.5)
    found = one.figure
    for name, value in vars(figure).items():
        if name not in ("kind", "place"):
            assert getattr(found, name) == pytest.approx(value), name
    vertices = one.item.vertices.detach()
    middle = 0.5 * (vertices.amax(0) + vertices.amin(0))
    assert (middle - upright(figure, ground, 0.5)).norm() < 1e-9
    if kind != "sphere":
        assert float(vertices[:, ground.vertical].min()) == pytest.approx(0.5)
        assert float(vertices[:, ground.vertical].max()) == pytest.approx(1.6)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_box_is_turned_as_the_ground_turns(up: Any):
    ground = Ground(up)
    turned, straight = (
        Primitive("thing", Figure("box", (0.0, 0.0), yaw, 0.8, 0.2, 1.0), ground).item.vertices
        for yaw in (0.3, 0.0)
    )
    middle = straight.detach().mean(0)
    expected = (straight.detach() - middle) @ ground.turn(0.3).T + middle
    assert (turned.detach() - expected).abs().max() < 1e-12
    vector = torch.zeros(3, dtype=torch.float64)
    vector[ground.vertical] = 0.3
    assert torch.allclose(ground.turn(0.3), rotation_from_vector(vector))


PERSON = Figure("person", (0.3, -0.4), 0.3, 0.62, 0.31, 1.7, 0.1)
VEHICLE = Figure("vehicle", (0.3, -0.4), 0.3, 4.4, 1.8, 1.5, 0.1)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("figure", [PERSON, VEHICLE])
def test_people_and_vehicles_fill_their_sides_and_stand(figure: Figure, up: Any):
    ground = Ground(up)
    straight = Primitive(
        "thing", replace(figure, yaw=0.0), ground, level=0.5
    ).item.vertices.detach()
    extent = straight.amax(0) - straight.amin(0)
    sides = [figure.length, figure.width, figure.height]
    found = [float(extent[axis]) for axis in (*ground.level, ground.vertical)]
    assert found == pytest.approx(sides)
    assert float(straight[:, ground.vertical].min()) == pytest.approx(0.5)
    one = Primitive("thing", figure, ground, level=0.5)
    middle = upright(figure, ground, 0.5)
    turned_back = (one.item.vertices.detach() - middle) @ ground.turn(figure.yaw) + middle
    assert (turned_back - straight).abs().max() < 1e-9
    assert one.figure.named == figure.kind


def test_sizes_stay_those_of_people():
    giant = Primitive("thing", replace(PERSON, height=5.0, length=0.1), Ground())
    assert giant.figure.height == pytest.approx(2.1)
    assert giant.figure.length == pytest.approx(0.4)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_turn_keeps_the_mean_of_the_surface(up: Any):
    ground = Ground(up)
    means = [
        Primitive("thing", figure, ground).item.vertices.detach().mean(0)
        for figure in (PERSON, turned(PERSON, math.pi, ground))
    ]
    assert (means[0] - means[1]).norm() < 1e-9
    # Feet and toes reach further to the front.
    assert turned(PERSON, math.pi, ground).place != pytest.approx(PERSON.place, abs=0.01)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_corner_is_bright_where_it_opens(up: Any):
    """Its echo falls as a power of the cosine off the way it opens, and there is none behind."""
    ground = Ground(up)
    figure = Figure("corner", (0.0, 0.0), 0.7, height=0.6, brightness=100.0)
    item = Primitive("thing", figure, ground).item
    surface = item.material.surface(77e9)
    way = torch.zeros(3, dtype=torch.float64)
    way[list(ground.level)] = opening(0.7, ground)
    corners = item.vertices.detach()[item.mesh.faces]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ahead = torch.nn.functional.normalize(normal, dim=1) @ way > 0.999
    assert int(ahead.sum()) == 2
    assert torch.equal(surface.diffuse > 0, ahead)
    share = float(surface.amplitude[ahead][0, round(255 * 0.8)] ** 2)
    assert share * 0.8**2 == pytest.approx(0.8**NARROW, rel=0.02)


def test_coordinates_are_the_numbers_of_the_figure():
    """A step along a coordinate changes its number by as much."""
    ball = Figure("sphere", (0.0, 1.0), 0.0, 0.4, 0.4, 0.9, 0.2)
    for figure in (BOX, PERSON, VEHICLE, Figure("corner", (0.0, 1.0), 0.3, height=0.5), ball):
        one = Primitive("thing", figure, Ground())
        names = {"x": "place", "z": "place"}
        for row in coordinates(one):
            name = row.name.removeprefix("thing.")
            moved = Primitive("thing", figure, Ground())
            with torch.no_grad():
                for parameter, tangent in row.tangents.items():
                    moved.get_parameter(parameter).add_(tangent, alpha=1e-6)
            before, after = (getattr(p.figure, names.get(name, name)) for p in (one, moved))
            if name in names:
                before, after = before["xz".index(name)], after["xz".index(name)]
            assert (after - before) / 1e-6 == pytest.approx(1.0, rel=1e-3), row.name


@pytest.mark.parametrize(
    ("figure", "named"),
    [
        (BOX, "box"),
        (Figure("box", (0.0, 0.0), 0.0, 1.5, 0.03, 1.0), "wall"),
        (Figure("box", (0.0, 0.0), 0.0, 0.05, 0.04, 1.0), "box"),
        (Figure("sphere", (0.0, 0.0), 0.0, 0.03, 0.03, 1.0), "point"),
        (Figure("cylinder", (0.0, 0.0), 0.0, 0.3, 0.3, 1.0), "cylinder"),
    ],
)
def test_small_and_thin_things_have_names_of_their_own(figure: Figure, named: str):
    assert figure.named == named


def test_the_nearest_material_reflects_as_much_at_normal_incidence():
    written = replace(BOX, brightness=0.2).material
    assert isinstance(written, RoughDielectric)
    root = math.sqrt(float(torch.as_tensor(written.permittivity)))
    assert ((root - 1) / (root + 1)) ** 2 == pytest.approx(0.2)
    assert isinstance(replace(BOX, brightness=3.0).material, RoughConductor)


def test_sizes_must_be_positive():
    with pytest.raises(InputError, match="length"):
        Figure("box", (0.0, 0.0), 0.0, -0.1, 0.2, 1.0)
