"""Displays as arrays: layers of scenes, radars and error bars; files."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from invertwin.channel import Grid
from invertwin.errors import InputError
from invertwin.radar import FMCW, Radar
from invertwin.scene import Object, RoughDielectric, Scene, box, planar_array, plate, rigid
from invertwin.viewer import (
    Display,
    DisplayLayer,
    DisplayMaps,
    DisplayMesh,
    DisplayStep,
    InteractiveSensor,
    build_display,
    display_mesh,
    ellipsoid_layers,
)

SURFACES = ("twin/a/cube", "twin/wall", "truth/a/cube")
GRID = Grid(1.0, 0.05, 60, -0.5, 0.05, 21)


def scene() -> Scene:
    material = RoughDielectric(4.0)
    cube = Object(box((0.4, 0.4, 0.4)), material, rigid(translation=[2.0, 0.3, 0.0]))
    wall = Object(plate(2.0, 2.0), material, rigid(translation=[3.0, 0.0, 0.0]))
    return Scene({"a/cube": cube, "wall": wall})


def radar() -> Radar:
    array = planar_array((16, 1), (1.9e-3, 1.9e-3))
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]], dtype=torch.float64)
    one = planar_array((1, 1), (1.9e-3, 1.9e-3))
    return Radar(one, array, FMCW(77e9, 1.5e9, 5e-5, 128), places)


def display() -> Display:
    made = build_display(scene(), {"": (radar(), GRID)}, "title", truth=scene(), fitted=["a/cube"])
    body = display_mesh(scene()["a/cube"])
    steps = [
        DisplayStep(
            k, f"step {k}", {"a/cube": DisplayMesh(body.vertices + np.float32(k), body.faces)}
        )
        for k in range(3)
    ]
    power = torch.rand(2, 60, 21, 1, generator=torch.Generator().manual_seed(1))
    return replace(
        made, steps=steps, maps={"": DisplayMaps.from_spectra({"measured": power}, GRID)}
    )


def test_layers_are_where_things_are():
    found = {layer.name: layer for layer in display().layers}
    assert list(found) == [*SURFACES, "radar", "beams", "boards"]
    assert found["twin/a/cube"].points.min(0) == pytest.approx([1.8, 0.1, -0.2], abs=1e-6)
    assert found["radar"].points.tolist() == [[0, 0, 0], [0, 0.5, 0]]
    # A beam is as wide as the map, and as long as the scene is far.
    end = found["beams"].points[1]
    assert abs(end[1]) / np.linalg.norm(end) == pytest.approx(0.5, rel=0.01)
    shown = {"twin": True, "truth": True, "radar": True, "beams": False, "boards": True}
    assert display().groups == shown
    # A board is across the direction in which its radar looks, at each position.
    boards = found["boards"].points.reshape(2, 8, 3)
    assert boards.mean(1) == pytest.approx(found["radar"].points, abs=1e-6)
    thick, wide, high = np.ptp(boards[0], axis=0)
    assert thick < high < wide


def test_a_step_moves_its_layer_alone():
    made = display()
    before = {layer.name: layer.points for layer in made.layers}
    after = {layer.name: layer.points for layer in made.show_step(made.steps[2]).layers}
    moved = [name for name in before if not np.array_equal(before[name], after[name])]
    assert moved == ["twin/a/cube"]
    assert after["twin/a/cube"] - before["twin/a/cube"] == pytest.approx(2.0, abs=1e-6)


def test_a_file_holds_everything_and_triangles_once(tmp_path):
    made = display()
    made.save(tmp_path / "view.npz")
    read = Display.load(tmp_path / "view.npz")
    assert [vars(x).keys() for x in read.layers] == [vars(x).keys() for x in made.layers]
    for one, other in zip(read.layers, made.layers, strict=True):
        assert np.array_equal(one.points, other.points)
        assert (one.name, one.color, one.shown) == (other.name, other.color, other.shown)
    assert [step.label for step in read.steps] == ["step 0", "step 1", "step 2"]
    one, other = (x.steps[1].bodies["a/cube"].vertices for x in (read, made))
    assert np.array_equal(one, other)
    assert np.array_equal(
        read.maps[""].maps_of_frame(1)["measured"], made.maps[""].maps_of_frame(1)["measured"]
    )
    assert (read.title, read.up, read.ahead) == (made.title, made.up, made.ahead)
    names = np.load(tmp_path / "view.npz").files
    assert len(names) < 1 + 2 * len(made.layers) + 2 * len(made.steps)


def test_a_file_stays_whole_while_the_next_one_is_written(tmp_path, monkeypatch):
    file = tmp_path / "view.npz"
    Display("first", []).save(file)

    def ended(part, **_):
        part.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", ended)
    with pytest.raises(KeyboardInterrupt):
        Display("second", []).save(file)
    assert Display.load(file).title == "first"


def test_damaged_files_are_refused(tmp_path):
    (tmp_path / "view.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match="npz"):
        Display.load(tmp_path / "view.npz")
    made = display()
    bad = replace(made.layers[0], faces=np.array([[0, 1, 999]], np.int32))
    replace(made, layers=[bad]).save(tmp_path / "view.npz")
    with pytest.raises(InputError, match="triangles without corners"):
        Display.load(tmp_path / "view.npz")


def test_many_frames_are_thinned_out_evenly():
    power = torch.zeros(300, 200, 101, 1)
    maps = DisplayMaps.from_spectra({"measured": power}, Grid(0.0, 0.1, 200, -1.0, 0.02, 101))
    assert maps.frames[0] == 0
    assert maps.frames[-1] == 299
    assert len(maps.frames) == 2_000_000 // (200 * 101)
    assert maps.maps_of_frame(1) == {} or 1 in maps.frames


def test_ellipsoids_hold_95_percent():
    names = ["wall.x", "wall.y", "wall.z"]
    deviations = dict(zip(names, (0.1, 0.02, 0.05), strict=True))
    correlations = [[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.0]]
    metrics = {"standard_deviations": deviations, "correlations": correlations}
    (layer,) = ellipsoid_layers(scene(), metrics)
    scale = torch.tensor([*deviations.values()]).double()
    covariance = torch.tensor(correlations).double() * scale * scale[:, None]
    away = torch.tensor(layer.points).double() - scene()["wall"].center
    # Every point of the circles is at the same distance by the covariance: 95 % of χ² with three.
    squares = torch.einsum("ni,ij,nj->n", away, covariance.inverse(), away)
    assert squares == pytest.approx(7.815, rel=1e-3)
    drawn = torch.randn(20000, 3, generator=torch.Generator().manual_seed(1)).square().sum(1)
    assert float((drawn < 7.815).double().mean()) == pytest.approx(0.95, abs=0.005)
    assert ellipsoid_layers(scene(), {}) == []


def test_a_link_says_what_feeds_a_bin_and_follows():
    link = InteractiveSensor(scene(), radar(), GRID)
    before = link.predict_map(link.scene, 0)
    moved = link.move_object("a/cube", rigid(translation=torch.tensor([0.25, 0.0, 0.0]).double()))
    after = link.predict_map(moved, 0)
    near = 1.0 + 0.05 * int(before.amax(1)[:28].argmax())
    assert near == pytest.approx(1.8, abs=0.06)
    assert 1.0 + 0.05 * int(after.amax(1)[:32].argmax()) == pytest.approx(2.05, abs=0.06)
    seen = link.sample_paths(link.scene, 0)
    row, column = 17, round((0.1 / math.hypot(0.1, 1.8) + 0.5) / 0.05)
    fed = seen.points_in_bin(row, column)
    assert len(fed) > 5
    assert float((fed.norm(dim=1) - GRID.ranges[row]).abs().max()) <= 0.051
    assert len(seen.edges) > 50
    body = display_mesh(moved["a/cube"])
    link.replace_meshes({"a/cube": body})
    assert link.predict_map(link.scene, 0) == pytest.approx(
        after, rel=0.05, abs=float(after.max()) * 0.05
    )


def spoil_array(folder, spoil, which):
    """A file with another array: the first one with so many dimensions."""
    display().save(folder / "view.npz")
    arrays = dict(np.load(folder / "view.npz"))
    name = next(n for n, a in arrays.items() if (a.ndim, a.dtype.kind) == which and n != "header")
    np.savez(folder / "view.npz", **arrays | {name: spoil(arrays[name])})
    return folder / "view.npz"


@pytest.mark.parametrize("which", [(2, "f"), (2, "i"), (3, "f")])
@pytest.mark.parametrize(
    "spoil",
    [
        *(lambda a, k=k: a.astype(k) for k in ("complex", "bool", "U8", "S8", ">f8", "u8", "f2")),
        lambda a: a.reshape(-1),
        lambda a: a.reshape(-1)[0],
        lambda a: a[..., :1],
        lambda a: np.zeros(a.shape, [("x", "f8"), ("y", "f8")]),
    ],
)
def test_arrays_of_other_kinds_and_shapes_are_refused(tmp_path, spoil, which):
    with pytest.raises(InputError, match="what a fit leaves to be viewed"):
        Display.load(spoil_array(tmp_path, spoil, which))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("title",), 5),
        (("layers", 0, "name"), None),
        (("layers", 0, "kind"), "cube"),
        (("layers", 0, "color"), [1, 2]),
        (("layers", 0, "points"), [1, 2]),
        (("layers", 0, "band"), [0.0, math.nan]),
        (("layers", 0, "band"), [-1e300, 1e300]),
        (("layers", 0, "band"), ["low", "high"]),
        (("layers",), {}),
        (("steps", 0, "label"), 7),
        (("steps", 0, "bodies"), []),
        (("up",), [0, 0]),
        (("up",), [0, 0, math.inf]),
        (("maps", "", "frames"), []),
        (("maps", "", "frames"), [0, 1, 2]),
        (("maps", "", "ranges"), [1.0]),
        (("maps", "", "power"), [1]),
        (("strange",), 1),
        (("format",), 3),
    ],
)
def test_headers_of_other_values_are_refused(tmp_path, path, value):
    display().save(tmp_path / "view.npz")
    arrays = dict(np.load(tmp_path / "view.npz"))
    header = json.loads(str(arrays["header"]))
    box = header
    for step in path[:-1]:
        box = box[step]
    box[path[-1]] = value
    np.savez(tmp_path / "view.npz", **arrays | {"header": np.array(json.dumps(header))})
    with pytest.raises(InputError, match="what a fit leaves to be viewed"):
        Display.load(tmp_path / "view.npz")


def test_points_that_are_not_finite_are_refused(tmp_path):
    with pytest.raises(InputError, match="triangles without corners"):
        Display.load(spoil_array(tmp_path, lambda a: a * np.float32(np.nan), (2, "f")))


def test_the_first_camera_stands_behind_a_transmitter():
    mast = DisplayLayer("transmitters", "points", np.array([[4.0, 1.0, 2.0]], np.float32))
    places = np.array([[0, 0, 0], [2, 2, 2]], np.float32)
    floor = DisplayLayer("twin/floor", "surface", places, np.zeros((1, 3), np.int32))
    assert Display("room", [floor, mast]).sight == pytest.approx((-1.0, 0.0, 0.0))
    assert Display("radar", [floor], ahead=(0.0, 1.0, 0.0)).sight == (0.0, 1.0, 0.0)
    above = DisplayLayer("transmitters", "points", np.array([[1.0, 1.0, 9.0]], np.float32))
    assert Display("room", [floor, above]).sight == (1.0, 0.0, 0.0)
