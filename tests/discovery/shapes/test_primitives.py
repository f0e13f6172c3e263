"""Shapes on the ground as unknowns."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from invertwin.discovery.shapes.primitives import (
    CORNER_EXPONENT,
    PrimitiveModel,
    ShapeParameters,
    corner_direction,
    rotate_shape,
    shape_center,
)
from invertwin.errors import InputError
from invertwin.inversion.confidence.uncertainty import iterate_coordinates
from invertwin.inversion.initialisation.detections import yaw_rotation
from invertwin.scene import RoughConductor, RoughDielectric, rotation_from_vector

BOX = ShapeParameters("box", (0.3, -0.4), 0.3, 0.8, 0.2, 1.1, 0.05)


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
def test_a_shape_has_the_numbers_it_was_made_of(kind: Any):
    figure = ShapeParameters(kind, (0.3, -0.4), 0.3, 0.8, 0.8 if kind != "box" else 0.2, 1.1, 0.05)
    one = PrimitiveModel("thing", figure, level=0.5)
    found = one.shape
    for name, value in vars(figure).items():
        if name not in ("kind", "place"):
            assert getattr(found, name) == pytest.approx(value), name
    vertices = one.item.vertices.detach()
    middle = 0.5 * (vertices.amax(0) + vertices.amin(0))
    assert (middle - shape_center(figure, 0.5)).norm() < 1e-9
    if kind != "sphere":
        assert float(vertices[:, 2].min()) == pytest.approx(0.5)
        assert float(vertices[:, 2].max()) == pytest.approx(1.6)


def test_a_box_is_turned_as_the_ground_turns():
    turned, straight = (
        PrimitiveModel(
            "thing", ShapeParameters("box", (0.0, 0.0), yaw, 0.8, 0.2, 1.0)
        ).item.vertices
        for yaw in (0.3, 0.0)
    )
    middle = straight.detach().mean(0)
    expected = (straight.detach() - middle) @ yaw_rotation(0.3).T + middle
    assert (turned.detach() - expected).abs().max() < 1e-12
    vector = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    assert torch.allclose(yaw_rotation(0.3), rotation_from_vector(vector))


PERSON = ShapeParameters("person", (0.3, -0.4), 0.3, 0.31, 0.62, 1.7, 0.1)
VEHICLE = ShapeParameters("vehicle", (0.3, -0.4), 0.3, 4.4, 1.8, 1.5, 0.1)


@pytest.mark.parametrize("figure", [PERSON, VEHICLE])
def test_people_and_vehicles_fill_their_sides_and_stand(figure: ShapeParameters):
    straight = PrimitiveModel("thing", replace(figure, yaw=0.0), level=0.5).item.vertices.detach()
    extent = straight.amax(0) - straight.amin(0)
    assert extent.tolist() == pytest.approx([figure.length, figure.width, figure.height])
    assert float(straight[:, 2].min()) == pytest.approx(0.5)
    one = PrimitiveModel("thing", figure, level=0.5)
    middle = shape_center(figure, 0.5)
    turned_back = (one.item.vertices.detach() - middle) @ yaw_rotation(figure.yaw) + middle
    assert (turned_back - straight).abs().max() < 1e-9
    assert one.shape.effective_kind == figure.kind


def test_sizes_stay_those_of_people():
    giant = PrimitiveModel("thing", replace(PERSON, height=5.0, width=0.1))
    assert giant.shape.height == pytest.approx(2.1)
    assert giant.shape.width == pytest.approx(0.4)


def test_a_turn_keeps_the_mean_of_the_surface():
    means = [
        PrimitiveModel("thing", figure).item.vertices.detach().mean(0)
        for figure in (PERSON, rotate_shape(PERSON, math.pi))
    ]
    assert (means[0] - means[1]).norm() < 1e-9
    # Feet and toes reach further to the front.
    assert rotate_shape(PERSON, math.pi).position != pytest.approx(PERSON.position, abs=0.01)


def test_a_corner_is_bright_where_it_opens():
    """Its echo falls as a power of the cosine off the way it opens, and there is none behind."""
    figure = ShapeParameters("corner", (0.0, 0.0), 0.7, height=0.6, brightness=100.0)
    item = PrimitiveModel("thing", figure).item
    surface = item.material.scattering_law(77e9)
    way = torch.cat([corner_direction(0.7), torch.zeros(1, dtype=torch.float64)])
    corners = item.vertices.detach()[item.mesh.faces]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ahead = torch.nn.functional.normalize(normal, dim=1) @ way > 0.999
    assert int(ahead.sum()) == 2
    assert torch.equal(surface.diffuse > 0, ahead)
    share = float(surface.amplitude[ahead][0, round(255 * 0.8)] ** 2)
    assert share * 0.8**2 == pytest.approx(0.8**CORNER_EXPONENT, rel=0.02)


def test_coordinates_are_the_numbers_of_the_figure():
    """A step along a coordinate changes its number by as much."""
    ball = ShapeParameters("sphere", (0.0, 1.0), 0.0, 0.4, 0.4, 0.9, 0.2)
    for figure in (
        BOX,
        PERSON,
        VEHICLE,
        ShapeParameters("corner", (0.0, 1.0), 0.3, height=0.5),
        ball,
    ):
        one = PrimitiveModel("thing", figure)
        names = {"x": "position", "y": "position"}
        for row in iterate_coordinates(one):
            name = row.name.removeprefix("thing.")
            moved = PrimitiveModel("thing", figure)
            with torch.no_grad():
                for parameter, tangent in row.tangents.items():
                    moved.get_parameter(parameter).add_(tangent, alpha=1e-6)
            before, after = (getattr(p.shape, names.get(name, name)) for p in (one, moved))
            if name in names:
                before, after = before["xy".index(name)], after["xy".index(name)]
            assert (after - before) / 1e-6 == pytest.approx(1.0, rel=1e-3), row.name


@pytest.mark.parametrize(
    ("figure", "named"),
    [
        (BOX, "box"),
        (ShapeParameters("box", (0.0, 0.0), 0.0, 1.5, 0.03, 1.0), "wall"),
        (ShapeParameters("box", (0.0, 0.0), 0.0, 0.05, 0.04, 1.0), "box"),
        (ShapeParameters("sphere", (0.0, 0.0), 0.0, 0.03, 0.03, 1.0), "point"),
        (ShapeParameters("cylinder", (0.0, 0.0), 0.0, 0.3, 0.3, 1.0), "cylinder"),
    ],
)
def test_small_and_thin_things_have_names_of_their_own(figure: ShapeParameters, named: str):
    assert figure.effective_kind == named


def test_the_nearest_material_reflects_as_much_at_normal_incidence():
    written = replace(BOX, brightness=0.2).material
    assert isinstance(written, RoughDielectric)
    root = math.sqrt(float(torch.as_tensor(written.permittivity)))
    assert ((root - 1) / (root + 1)) ** 2 == pytest.approx(0.2)
    assert isinstance(replace(BOX, brightness=3.0).material, RoughConductor)


def test_sizes_must_be_positive():
    with pytest.raises(InputError, match="length"):
        ShapeParameters("box", (0.0, 0.0), 0.0, -0.1, 0.2, 1.0)
