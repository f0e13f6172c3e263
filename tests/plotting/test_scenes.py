"""Figures of scenes: what is drawn where, which way round, in which colour."""

import io

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from PIL import Image

from invertwin import plotting
from invertwin.plotting.triangles import sharp_edges, small_triangles
from invertwin.radar import FMCW, Radar
from invertwin.scene import (
    Object,
    RoughDielectric,
    Scene,
    box,
    linear_array,
    plate,
    rigid,
    rotation_from_vector,
)

CUBE = (box(1.0).vertices.numpy(), box(1.0).faces.numpy())
PAINT = RoughDielectric(permittivity=4.0)


def at(x, y, z, mesh=None):
    return Object(mesh or box(1.0), PAINT, rigid(translation=[x, y, z]))


def radar(positions, turn=0.0):
    array = linear_array(1, 1.0)
    rotation = rotation_from_vector(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))
    rotations = rotation.expand(len(positions), 3, 3) if turn else None
    places = torch.tensor(positions, dtype=torch.float64)
    return Radar(array, array, FMCW(76e9, 2e9, 5e-5, 64), places, rotations)


def painted(axes):
    """Corners of all triangles in the axes."""
    (faces,) = [c for c in axes.collections if isinstance(c, PolyCollection)]
    return np.concatenate([np.asarray(path.vertices)[:3] for path in faces.get_paths()]), faces


def labels(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_three_views_show_an_object_where_it_is():
    figure = plotting.scene(Scene({"cube": at(5.0, 1.0, 2.0)}), radar([[0.0, 0.0, 0.0]]))
    views = {axes.get_title(): axes for axes in figure.axes}
    ends = {"x": (4.5, 5.5), "y": (0.5, 1.5), "z": (1.5, 2.5)}
    expected = {"from the radar": "yz", "from above": "yx", "from the right": "xz"}
    for title, (across, up) in expected.items():
        axes = views[f"scene, {title}"]
        leftwards = across == "y"
        assert axes.get_xlabel() == f"{across} [m]" + ", to the left" * leftwards
        assert axes.get_ylabel() == f"{up} [m]"
        points, _ = painted(axes)
        assert (points[:, 0].min(), points[:, 0].max()) == pytest.approx(ends[across])
        assert (points[:, 1].min(), points[:, 1].max()) == pytest.approx(ends[up])
        seen = title != "from the radar"
        assert len(axes.lines) == seen
        low, high = sorted(axes.get_xlim())
        assert (axes.get_xlim()[0] > axes.get_xlim()[1]) == leftwards
        assert low < (0.0 if seen else 0.5)
        assert high > ends[across][1]
    (mark,) = views["scene, from above"].lines
    assert mark.get_xydata().tolist() == [[0.0, 0.0]]
    assert labels(figure) == ["cube", "radar"]


def test_views_follow_the_radar():
    """A radar that looks along −x has the world's y on its right."""
    figure = plotting.scene(Scene({"cube": at(-5.0, 0, 0)}), radar([[0.0, 0.0, 0.0]] * 2, np.pi))
    front, above, _ = figure.axes
    assert front.get_xlim()[0] < front.get_xlim()[1]
    assert above.get_ylim()[0] > above.get_ylim()[1]
    assert labels(figure) == ["cube", "radar, 2 positions"]


def test_what_is_on_the_left_is_drawn_on_the_left():
    scene = Scene({"box": at(4.0, 1.0, 0.0), "wall": at(6.0, 0.0, 0.0, plate(6.0, 4.0))})
    figure = plotting.scene(scene, radar([[0.0, 0.0, 0.0]]), highlight=["box"])
    ahead, up = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    assert np.cross(ahead, up) @ [0.0, 1.0, 0.0] == -1.0  # the right of who stands there is −y
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    shown = np.asarray(Image.open(buffer).convert("RGB"), float)
    frame = figure.axes[0].get_window_extent()
    front = shown[:, int(frame.x0) : int(frame.x1)]
    blue = np.nonzero(front[..., 2] - front[..., 0] > 60)[1]
    assert blue.mean() < 0.45 * front.shape[1]


def test_what_is_near_is_painted_last():
    near, far = at(2.0, 0, 0, plate(1.0, 1.0)), at(4.0, 0, 0, plate(1.0, 1.0))
    figure = plotting.scene(Scene({"near": near, "far": far}), highlight=["near"])
    _, faces = painted(figure.axes[0])
    blue, grey = np.array(to_rgb(plotting.PALETTE[0])), np.array(to_rgb("#b9bec7"))

    def hue(rgb):
        return rgb[:3] / rgb[:3].max()

    colors = faces.get_facecolor()
    np.testing.assert_allclose(hue(colors[-1]), hue(blue), atol=0.01)
    np.testing.assert_allclose(hue(colors[0]), hue(grey), atol=0.01)
    assert labels(figure) == ["near", "other objects"]


def test_several_scenes_share_the_window_and_the_outline():
    truth = Scene({"cube": at(5.0, 0.3, 0)})
    scenes = {"start": Scene({"cube": at(5.0, 0, 0)}), "twin": truth}
    places = [[0.0, 0.1 * k, 0.0] for k in range(30)]
    figure = plotting.scene(scenes, radar(places), outline=truth)
    assert len(figure.axes) == 6
    start, twin = figure.axes[:2]
    assert start.get_xlim() == twin.get_xlim()
    (lines,) = [c for c in start.collections if isinstance(c, LineCollection)]
    assert len(lines.get_segments()) == 12
    corners = np.concatenate(lines.get_segments())
    assert (corners[:, 0].min(), corners[:, 0].max()) == pytest.approx((-0.2, 0.8))
    assert figure.axes[2].lines[0].get_marker() == "."
    assert labels(figure) == ["cube", "truth", "radar, 30 positions"]


def test_small_objects_get_a_mark():
    scene = Scene({"ball": at(3.0, 1.0, 0, box(0.01)), "wall": at(5.0, 0, 0, plate(4.0, 4.0))})
    figure = plotting.scene(scene, outline=Scene({"ball": scene["ball"]}))
    dot, cross = figure.axes[0].lines
    assert (dot.get_marker(), cross.get_marker()) == ("o", "+")
    for mark in (dot, cross):
        np.testing.assert_allclose(np.asarray(mark.get_xydata()), [[1, 0]], atol=1e-9)


def test_only_edges_that_bend_are_outlined():
    assert len(sharp_edges(*CUBE)) == 12


def test_splitting_keeps_the_area():
    triangles = CUBE[0][CUBE[1]]
    small = small_triangles(triangles, 0.3)

    def area(t):
        return np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() / 2

    assert len(small) > len(triangles)
    assert np.isclose(area(small), area(triangles))


@pytest.mark.slow
def test_a_turntable_turns_once():
    """An eye on the axis of symmetry sees a cube of four equal sides four times."""
    gif = plotting.turntable({"truth": box(1.0), "twin": box(1.0)}, up=[0.0, 0.0, 1.0])
    image = Image.open(io.BytesIO(gif))
    assert getattr(image, "n_frames", 1) == 24
    frames = []
    for k in range(24):
        image.seek(k)
        frames.append(np.asarray(image.convert("L"), dtype=float))
    assert image.size[0] > 1.8 * image.size[1]
    assert np.abs(frames[0] - frames[3]).max() > 30
    gap = np.abs(frames[0] - frames[6])
    assert (gap > 30).mean() < 0.02
