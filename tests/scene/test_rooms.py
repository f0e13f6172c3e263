"""A furnished room: closed, named, and with a free middle."""

import warnings

import pytest
import torch

from invertwin.channel import Sampling, trace_field
from invertwin.errors import InputError
from invertwin.radar import FMCW, Radar
from invertwin.scene import AntennaArray, RoughDielectric, Scene, room
from scenes import float64

SIDES = ("floor", "ceiling", "wall_front", "wall_back", "wall_right", "wall_left")
PIECES = ("table", "chair_1", "chair_2", "shelf", "sofa")
PLACE = float64([[0.1, 0.0, 1.0]])


def radar() -> Radar:
    one = AntennaArray(float64([[0.0, 0.0, 0.0]]))
    return Radar(one, one, FMCW(77e9, 1e9, 40e-6, 256), PLACE)


def test_a_room_is_closed_and_faces_inwards():
    made = room(4.5, 6.5, 2.5)
    assert tuple(made) == (*SIDES, *PIECES)
    assert made["wall_left"].center.tolist() == [3.25, 2.25, 1.25]
    assert made["wall_back"].center.tolist() == [6.5, 0.0, 1.25]
    middle = float64([3.25, 0.0, 1.25])
    area, volume = 0.0, 0.0
    for name in SIDES:
        corners = made[name].vertices[made[name].mesh.faces]
        normal = 0.5 * torch.linalg.cross(
            corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        )
        assert bool(((middle - corners.mean(1)) * normal).sum(1).gt(0).all()), name
        area += float(normal.norm(dim=1).sum())
        volume += float(((middle - corners[:, 0]) * normal).sum()) / 3
    assert area == pytest.approx(2 * (4.5 * 6.5 + 4.5 * 2.5 + 6.5 * 2.5))
    assert volume == pytest.approx(4.5 * 6.5 * 2.5)


@pytest.mark.parametrize("size", [(4.0, 4.0, 2.1), (5.0, 6.0, 2.6), (12.0, 9.0, 4.0)])
def test_furniture_stands_inside_apart_and_leaves_the_middle_free(size):
    width, depth, height = size
    made = room(*size)
    bounds = {}
    for name in PIECES:
        points = made[name].vertices
        low, high = points.amin(0), points.amax(0)
        assert 0 < float(low[2]) < 0.01, name
        assert float(points[:, 1].abs().max()) < width / 2, name
        assert float(low[0]) > 0.3, name
        assert float(high[0]) < depth, name
        assert float(high[2]) < height, name
        assert float(points[:, 1].abs().min()) > 0.5, name
        bounds[name] = (low, high)
    names = list(bounds)
    for number, one in enumerate(names):
        for other in names[number + 1 :]:
            (a, b), (c, d) = bounds[one], bounds[other]
            assert bool((a > d).any() or (c > b).any()), (one, other)


def test_the_same_numbers_give_the_same_room_of_stated_materials():
    first, second = room(), room()
    assert all(torch.equal(first[n].vertices, second[n].vertices) for n in first)
    assert set(room(furniture=["sofa"])) == {*SIDES, "sofa"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # every material is in its table's range
        for item in first.values():
            assert isinstance(item.material, RoughDielectric)
            for frequency in (24e9, 60e9, 77e9):
                item.material.permittivity.permittivity(frequency)  # type: ignore[union-attr]


def test_a_radar_inside_sees_every_piece_and_the_wall_at_its_distance():
    scene = Scene(room())
    few = Sampling(depth=1, points_per_m2=200.0)
    paths = trace_field(scene, radar().link(), sampling=few, seed=1)
    assert paths.face is not None
    counts = [len(item.mesh.faces) for item in scene.objects.values()]
    owner = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    seen = {scene.names[int(number)] for number in owner[paths.face].unique()}
    assert seen >= {"floor", "ceiling", "wall_back", "wall_left", "wall_right", *PIECES}
    assert float(paths.range.max()) < 7.0
    behind = paths.range[owner[paths.face] == scene.names.index("wall_back")]
    assert float(behind.min()) == pytest.approx(5.9, abs=0.02)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: room(3.0), "width of the room"),
        (lambda: room(5.0, 2.0), "depth of the room"),
        (lambda: room(height=1.0), "height of the room"),
        (lambda: room(furniture=["piano"]), "furniture among"),
        (lambda: room(furniture="sofa"), "give a list"),
    ],
)
def test_rooms_that_cannot_be_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
