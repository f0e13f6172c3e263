"""What surrounds a scene: ground with metres, first camera, legend, walls seen through."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from invertwin.radar import FMCW, Radar
from invertwin.scene import Object, RoughDielectric, Scene, box, planar_array, plate, rigid
from invertwin.viewer import Display, DisplayLayer, build_display
from invertwin.viewer.surroundings import draw_ground, legend_html, open_walls, set_camera


def display(scale: float = 1.0) -> Display:
    """A box and a wall before a radar; all lengths may be scaled."""
    material = RoughDielectric(4.0)
    cube = Object(
        box([0.4 * scale] * 3), material, rigid(translation=[2.0 * scale, 0.3 * scale, 0])
    )
    wall = Object(
        plate(3.0 * scale, 2.0 * scale), material, rigid(translation=[3.0 * scale, 0.0, 0.0])
    )
    one = planar_array((1, 1), (1.9e-3, 1.9e-3))
    radar = Radar(one, one, FMCW(77e9, 1.5e9, 5e-5, 128), torch.zeros(1, 3).double())
    scene = Scene({"cube": cube, "wall": wall})
    return build_display(scene, {"": (radar, None)}, "title", fitted=["cube"])


class Drawn:
    """What a viser scene is told."""

    def __init__(self) -> None:
        self.grid: dict[str, Any] = {}
        self.labels: dict[str, tuple[str, Any]] = {}

    def add_grid(self, name: str, width: float, height: float, **given: Any) -> None:
        self.grid = {"width": width, "height": height, **given}

    def add_label(self, name: str, text: str, *, position: Any) -> None:
        self.labels[name] = text, np.array(position)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 300.0])
def test_the_ground_has_metres_where_they_are(scale):
    drawn, shown = Drawn(), display(scale=scale)
    draw_ground(drawn, shown)
    assert drawn.grid["plane"] == "xy"
    half = np.array([drawn.grid["width"], drawn.grid["height"]]) / 2
    middle = np.array(drawn.grid["position"])
    points = np.concatenate([layer.points for layer in shown.layers if layer.shown])
    assert (points[:, :2].max(0) <= middle[:2] + half + 1e-6 * scale).all()
    assert (points[:, :2].min(0) >= middle[:2] - half - 1e-6 * scale).all()
    assert middle[2] == pytest.approx(-1.0 * scale, abs=2e-2 * scale)
    texts = [(text, place) for name, (text, place) in drawn.labels.items() if "/x" in name]
    numbers = [(float(text), place[0]) for text, place in texts if text != "x [m]"]
    # They stand on the side of the camera, which is to the left of the radar, and nothing twice.
    assert np.array([place[1] for _, place in texts]) == pytest.approx(middle[1] + half[1])
    places = np.array([place for _, place in drawn.labels.values()])
    assert len(np.unique(places.round(6), axis=0)) == len(places)
    assert len(numbers) in range(3, 14)
    assert [text for text, _ in numbers] == pytest.approx([x for _, x in numbers], rel=1e-6)
    # Lines of the grid begin at its middle: a label stands on one of them.
    cells = (np.array([x for _, x in numbers]) - middle[0]) / drawn.grid["cell_size"]
    assert cells == pytest.approx(np.round(cells), abs=1e-6)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 300.0])
def test_the_first_camera_is_behind_and_above_the_radar_and_sees_all(scale):
    camera, shown = SimpleNamespace(), display(scale=scale)
    set_camera(camera, shown)
    assert camera.position[0] < 0  # the radar stands at 0 and looks along x
    assert camera.position[2] > 0
    ahead = camera.look_at - camera.position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up)
    right /= np.linalg.norm(right)
    points = np.concatenate([layer.points for layer in shown.layers if layer.shown])
    away = points - camera.position
    depth, half = away @ ahead, np.tan(camera.fov / 2)
    assert (camera.near < depth).all()
    assert (depth < camera.far).all()
    for axis in (right, np.cross(right, ahead)):
        share = np.abs(away @ axis) / (depth * half)
        assert share.max() < 0.9
    assert max(np.abs(away @ right).max(), 0) / (depth.max() * half) > 0.2  # not tiny either


def test_on_a_phone_the_scene_fits_the_width_and_stands_above_the_panel():
    camera, shown, aspect = SimpleNamespace(), display(), 390 / 844
    set_camera(camera, shown, aspect)
    ahead = camera.look_at - camera.position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up)
    right /= np.linalg.norm(right)
    points = np.concatenate([layer.points for layer in shown.layers if layer.shown])
    away = points - camera.position
    half = (away @ ahead) * np.tan(camera.fov / 2)
    assert (np.abs(away @ right) / (half * aspect)).max() < 1.0
    heights = (away @ np.cross(right, ahead)) / half
    assert heights.max() < 1.0
    assert heights.mean() > 0.2  # the panel takes the lower 60 % of the window


def test_walls_are_seen_through_from_behind_and_objects_are_not():
    shown = display()
    layers = {layer.name: layer for layer in shown.layers}
    turned = open_walls(shown).get("twin/wall")
    assert turned is not None
    first, second, third = layers["twin/wall"].points[turned].transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    assert (normals[:, 0] < 0).all()  # towards the radar
    assert open_walls(shown).get("twin/cube") is None
    assert open_walls(shown).get("boards") is None


def test_a_closed_room_is_open_to_who_looks_from_outside():
    room = Object(box([6.0, 5.0, 2.7]), RoughDielectric(4.0))
    table = Object(box([1.0, 0.6, 0.1]), RoughDielectric(4.0))
    shown = build_display(Scene({"room": room, "table": table}), {}, "title")
    layer = shown.layers[0]
    turned = open_walls(shown).get(layer.name)
    assert turned is not None
    first, second, third = layer.points[turned].transpose(1, 0, 2)
    assert ((np.cross(second - first, third - first) * first).sum(1) < 0).all()
    assert open_walls(shown).get(shown.layers[1].name) is None


def test_a_room_that_holds_antennas_alone_is_open_and_a_crate_before_a_radar_is_not():
    room = Object(box([6.0, 5.0, 2.7]), RoughDielectric(4.0))
    shown = build_display(Scene({"room": room}), {}, "title")
    name, place = shown.layers[0].name, np.array([[1.0, 1.0, 0.5]], np.float32)
    within = replace(shown, layers=[*shown.layers, DisplayLayer("receivers", "points", place)])
    beyond = replace(shown, layers=[*shown.layers, DisplayLayer("boards", "points", 9 * place)])
    assert open_walls(within).get(name) is not None
    assert open_walls(beyond).get(name) is None


def test_a_single_surface_is_no_wall():
    shown = build_display(Scene({"plate": Object(plate(1.0, 1.0), RoughDielectric(4.0))}), {}, "")
    assert open_walls(shown).get(shown.layers[0].name) is None


def test_the_legend_names_the_roles_that_there_are():
    text = legend_html(display())
    assert "fitted" in text
    assert "fixed" in text
    assert "radar" in text
    assert "truth" not in text
    assert "cube" not in text  # names of objects may be hostile


def test_the_legend_names_groups_with_all_their_colours_and_nothing_acts():
    none = np.zeros((0, 3), np.float32)
    dark, light, levels = (4, 5, 6), (7, 8, 9), {"band": (-90.0, -80.0), "unit": "dBm"}
    layers = [
        DisplayLayer("paths: <b>", "surface", none, color=(1, 2, 3)),
        DisplayLayer("levels/low", "surface", none, color=dark, **levels),
        DisplayLayer(
            "levels/high", "surface", none, color=light, **levels | {"band": (-80, -72.5)}
        ),
    ]
    text = legend_html(Display("title", layers))
    assert "paths: &lt;b&gt;" in text
    assert '>-80 <span style="letter-spacing: -0.3em"><span style="color: rgb(4, 5, 6)">' in text
    assert 'rgb(7, 8, 9)">■</span></span>&ensp;-80 dBm<' in text


@pytest.mark.parametrize("names", [["levels/low"], ["levels"], ["levels/<a>", "levels/<b>"]])
def test_levels_without_limits_have_their_name_in_the_legend(names):
    none = np.zeros((0, 3), np.float32)
    text = legend_html(Display("title", [DisplayLayer(name, "surface", none) for name in names]))
    assert text.count("■") == 1
    assert "<a>" not in text
    assert "<b>" not in text
