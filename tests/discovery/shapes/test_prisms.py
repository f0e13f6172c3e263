"""Things with vertical sides of any outline."""

import math

import pytest
import torch

from invertwin.discovery.shapes.primitives import PrimitiveModel, ShapeParameters
from invertwin.discovery.shapes.prisms import (
    OutlineModel,
    PrismParameters,
    make_shape_model,
    merge_into_prism,
    prism_contour,
)
from invertwin.scene import Mesh, Scene

BOX = ShapeParameters("box", (-0.4, 0.3), 0.5, 0.5, 0.8, 1.1, 0.05)
POST = ShapeParameters("cylinder", (-0.21, -0.05), 0.0, 0.3, 0.3, 0.7, 0.2)
LEVEL, SPACING = -0.2, 0.04


def volume(mesh: Mesh) -> torch.Tensor:
    """Of a closed mesh [m³], with derivatives."""
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    return (a * torch.linalg.cross(b, c)).sum() / 6


def outline_of(*figures: ShapeParameters) -> OutlineModel:
    return OutlineModel("thing", merge_into_prism(figures, LEVEL, SPACING), LEVEL)


def test_a_prism_starts_as_what_it_is_made_from():
    one = outline_of(BOX)
    mesh, true = one.mesh(), PrimitiveModel("thing", BOX, LEVEL).mesh()
    # Faces look outward, and all of the box is there; corners are rounded by less than a node.
    assert float(volume(mesh).detach()) == pytest.approx(0.8 * 0.5 * 1.1, rel=0.02)
    for low in (True, False):
        ends = [m.vertices.amin(0) if low else m.vertices.amax(0) for m in (mesh, true)]
        assert float((ends[0] - ends[1]).detach().abs().max()) < 0.5 * SPACING
    found = one.shape
    assert (found.kind, found.effective_kind, found.has_yaw, found.has_free_height) == (
        "prism",
        "prism",
        False,
        False,
    )
    assert found.position == pytest.approx(BOX.position, abs=0.01)
    assert (found.height, found.brightness) == pytest.approx((1.1, 0.05))
    # Written down and begun anew, it is the same.
    again = make_shape_model("thing", found, LEVEL)
    assert isinstance(again, OutlineModel)
    assert torch.allclose(again.mesh().vertices, mesh.vertices, atol=1e-9)


def area(line: torch.Tensor) -> float:
    x, y = line.unbind(1)
    return 0.5 * float((x * y.roll(-1) - y * x.roll(-1)).sum().abs())


def test_shapes_that_touch_become_one_of_the_largest_ones_height():
    one = merge_into_prism([BOX, POST], LEVEL, SPACING)
    assert (one.height, one.brightness) == (1.1, 0.05)
    box, post = (merge_into_prism([part], LEVEL, SPACING) for part in (BOX, POST))
    assert area(prism_contour(box)) == pytest.approx(0.8 * 0.5, rel=0.01)
    assert area(prism_contour(post)) == pytest.approx(math.pi * 0.15**2, rel=0.03)
    # The post stands to a half in the box.
    assert 0.4 + 0.02 < area(prism_contour(one)) < 0.4 + 0.05
    # One line goes around both.
    line = prism_contour(one)
    for place in (BOX.position, POST.position):
        turn = line - torch.tensor(place)
        angle = torch.atan2(turn[:, 1], turn[:, 0])
        winding = (angle.roll(-1) - angle + math.pi).remainder(2 * math.pi) - math.pi
        assert abs(float(winding.sum())) == pytest.approx(2 * math.pi)


def test_the_surface_follows_all_numbers():
    one = outline_of(BOX)
    mesh = one.mesh()
    (slope,) = torch.autograd.grad(volume(mesh), one.size)
    # A third of the logarithm of the height.
    assert float(slope) == pytest.approx(3 * 0.8 * 0.5 * 1.1, rel=0.05)
    # All distances less by d: the outline moves out by d everywhere.
    (slope,) = torch.autograd.grad(volume(one.mesh()), one.sides.value)
    assert float(-slope.sum()) == pytest.approx(2 * (0.8 + 0.5) * 1.1, rel=0.06)
    with torch.no_grad():
        one.place.add_(torch.tensor([0.1, -0.05]))
    moved = one.mesh().vertices.mean(0) - mesh.vertices.mean(0)
    expected = torch.tensor([0.1, -0.05, 0.0], dtype=torch.float64)
    assert torch.allclose(moved, expected, atol=1e-6)
    rows = {row.name: row for row in one.coordinates()}
    assert list(rows) == ["thing.x", "thing.y", "thing.height", "thing.brightness"]
    # By one metre and by one unit.
    assert float(rows["thing.height"].tangents["size"]) == pytest.approx(1 / (3 * 1.1))
    assert float(rows["thing.brightness"].tangents["strength"]) == pytest.approx(1 / (10 * 0.05))


def test_it_is_an_object_of_a_scene():
    one = outline_of(BOX)
    scene = one(Scene({"thing": PrimitiveModel("thing", POST).item}))
    assert len(scene["thing"].mesh.faces) == len(one.mesh().faces)
    assert set(one.values()) == {"thing.place", "thing.height", "thing.brightness"}
    assert math.isclose(float(one.values()["thing.height"]), 1.1)
    assert isinstance(one.shape, PrismParameters)


@pytest.mark.parametrize("length", [0.5, 0.62, 0.8, 1.03])
def test_a_wall_thinner_than_the_spacing_of_nodes_has_an_outline(length: float):
    """It lies on a line of nodes, or between two."""
    wall = ShapeParameters("box", (2.0, 0.3), 0.0, length, 0.02, 1.0)
    start = merge_into_prism([wall], 0.0, 0.04)
    model = OutlineModel("wall", start)
    places = model.mesh().vertices.detach()
    low, high = places[:, :2].amin(0), places[:, :2].amax(0)
    assert 0.5 * (low + high) == pytest.approx(torch.tensor([2.0, 0.3]).double(), abs=0.02)
    assert float(high[1] - low[1]) < 3 * 0.04
    assert float(high[0] - low[0]) == pytest.approx(length, abs=0.08)
