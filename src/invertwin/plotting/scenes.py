"""Figures of scenes: three views along world axes, with the radar's positions; turning views."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from invertwin.plotting.figures import color, label_axes, legible, numbers
from invertwin.plotting.triangles import Shape, paint, sharp_edges
from invertwin.radar import Radar
from invertwin.scene import Mesh, Scene

_BACKGROUND = "#b9bec7"
_OUTLINE = "#c0143c"
_MARKED_SHARE = 0.015  # of a view: objects that look smaller get a mark
_TRACK_COUNT = 24  # radar positions: more of them are drawn as dots
# What runs to the right and up, and where the eye is: 0, 1, 2 = the radar's boresight, left, up;
# −1 where it runs the other way.
_VIEWS = {
    "from the radar": ((1, -1), (2, 1), (0, -1)),
    "from above": ((1, -1), (0, 1), (2, 1)),
    "from the right": ((0, 1), (2, 1), (1, -1)),
}


def scene(
    scenes: Scene | Mapping[str, Scene],
    radar: Radar | Sequence[Radar] | None = None,
    *,
    highlight: Sequence[str] | None = None,
    outline: Scene | None = None,
) -> Figure:
    """Three views of a scene in a row; several scenes are one column each.

    Each view looks along the world axis nearest to the radar's boresight, down, or left. What is
    on the left of somebody who stands at the radar is on the left, as in maps and the viewer.

    Args:
        scenes: What is drawn, by title.
        radar: Its positions are marked, and its mean axes are those of the views; of several
            radars, those of the first. None takes the world's axes: ahead x, left y, up z.
        highlight: Names of the objects that are drawn in colour, the others grey; None is all.
        outline: Objects whose sharp edges are drawn on top in red, such as the truth.
    """
    titled = scenes if isinstance(scenes, Mapping) else {"scene": scenes}
    drawn = {title: _shapes(shown) for title, shown in titled.items()}
    edges = {} if outline is None else _shapes(outline)
    radars = [] if radar is None else [radar] if isinstance(radar, Radar) else list(radar)
    places = np.concatenate([numbers(r.positions) for r in radars]) if radars else None
    views = _views(radars[0] if radars else None)
    # Seen from the radar, its own marks would only hide the scene.
    marks = [None if view.title == "from the radar" else places for view in views]
    shown = [*drawn.values(), edges]
    windows = [_window(shown, own, view) for own, view in zip(marks, views, strict=True)]
    ratios = [min(max(h / w, 0.3), 1.3) for _, _, w, h in windows]
    if len(drawn) == 1:
        cells = [[(k, title) for k in range(len(views)) for title in drawn]]
        ratios = [max(ratios)]
    else:
        cells = [[(k, title) for title in drawn] for k in range(len(views))]
    width = 11.0
    height = 0.5 + sum(ratio * width / len(cells[0]) + 0.35 for ratio in ratios)
    figure = Figure(figsize=(width, height), layout="constrained")
    grid = figure.subplots(len(cells), len(cells[0]), squeeze=False, height_ratios=ratios)
    for axes, (k, title) in zip(grid.flat, (c for row in cells for c in row), strict=True):
        colors = _colors(drawn[title], highlight)
        _draw(axes, drawn[title], colors, edges, marks[k], views[k], windows[k])
        label_axes(axes, f"{title}, {views[k].title}", views[k].axis_label(0))
    names = {name: c for shapes in drawn.values() for name, c in _colors(shapes, highlight).items()}
    _legend(figure, names, bool(edges), places)
    return figure


@dataclass(frozen=True)
class _OrthographicView:
    """A look along a world axis.

    Attributes:
        title: From where the view looks.
        axes: World axes that run across, up and in depth.
        signs: Whether the first two grow to the right and up, and the third towards the eye.
    """

    title: str
    axes: tuple[int, ...]
    signs: tuple[int, ...]

    @property
    def plane(self) -> list[int]:
        return list(self.axes[:2])

    def axis_label(self, which: Literal[0, 1]) -> str:
        """Name the axis across (0) or up (1), and where it grows if not to the right or up."""
        where = f", to the {('left', 'bottom')[which]}" if self.signs[which] < 0 else ""
        return f"{'xyz'[self.axes[which]]} [m]{where}"


def _views(radar: Radar | None) -> list[_OrthographicView]:
    """The views along the world axes nearest to the radar's boresight, left and up."""
    turned = radar is not None and radar.rotations is not None
    frame = numbers(radar.rotations.mean(0)) if turned else np.eye(3)  # type: ignore[union-attr]
    orders = list(permutations(range(3)))
    nearest = max(orders, key=lambda order: sum(abs(frame[k, c]) for c, k in enumerate(order)))
    sign = [-1 if frame[k, c] < 0 else 1 for c, k in enumerate(nearest)]
    return [
        _OrthographicView(
            title, tuple(nearest[c] for c, _ in axes), tuple(way * sign[c] for c, way in axes)
        )
        for title, axes in _VIEWS.items()
    ]


def _shapes(scene: Scene) -> dict[str, Shape]:
    objects = scene.objects.items()
    return {name: (numbers(one.vertices), numbers(one.mesh.faces)) for name, one in objects}


def _colors(shapes: Mapping[str, Shape], highlight: Sequence[str] | None) -> dict[str, str]:
    return {
        name: color(i) if highlight is None or name in highlight else _BACKGROUND
        for i, name in enumerate(shapes)
    }


def _window(
    scene_shapes: Sequence[Mapping[str, Shape]], positions: NDArray | None, view: _OrthographicView
) -> tuple[float, float, float, float]:
    """Centre and size of what a view shows, equal for all scenes."""
    points = [vertices for shapes in scene_shapes for vertices, _ in shapes.values()]
    if positions is not None:
        points.append(positions)
    flat = np.concatenate(points)[:, view.plane]
    low, high = flat.min(axis=0), flat.max(axis=0)
    sides = (high - low) * 1.12
    sides = np.maximum(sides, max(0.3 * sides.max(), 1e-3))
    (x, y), (width, height) = (low + high) / 2, sides
    return float(x), float(y), float(width), float(height)


def _draw(
    axes: Any,
    shapes: Mapping[str, Shape],
    colors: Mapping[str, str],
    edges: Mapping[str, Shape],
    positions: NDArray | None,
    view: _OrthographicView,
    window: tuple[float, float, float, float],
) -> None:
    plane = view.plane
    eye = np.eye(3)[list(view.axes)]
    eye[2] *= view.signs[2]
    extent = np.ptp(np.concatenate([v for v, _ in shapes.values()]), axis=0).max()
    paint(axes, [(shape, colors[name]) for name, shape in shapes.items()], eye, extent / 6)
    for vertices, faces in edges.values():
        segments = vertices[sharp_edges(vertices, faces)][:, :, plane]
        axes.add_collection(LineCollection(list(segments), colors=_OUTLINE, linewidths=0.8))
    smallest = _MARKED_SHARE * max(window[2:])
    marks = [(v, {"marker": "o", "color": colors[k], "ms": 6}) for k, (v, _) in shapes.items()]
    marks += [(v, {"marker": "+", "color": _OUTLINE, "ms": 11}) for v, _ in edges.values()]
    for vertices, mark in marks:
        if np.ptp(vertices[:, plane], axis=0).max() < smallest:
            axes.plot(*vertices[:, plane].mean(axis=0), linestyle="", **mark)
    if positions is not None:
        axes.plot(*positions[:, plane].T, mew=0, **_draw_marks(positions))
    for set_limits, c in ((axes.set_xlim, 0), (axes.set_ylim, 1)):
        ends = window[c] + window[c + 2] / 2 * np.array([-1, 1])
        set_limits(*ends[:: view.signs[c]])
    axes.set_aspect("equal")
    axes.set_ylabel(view.axis_label(1), fontsize=8)


def _draw_marks(positions: NDArray) -> dict[str, Any]:
    many = len(positions) > _TRACK_COUNT
    mark = {"marker": ".", "markersize": 5} if many else {"marker": "v", "markersize": 4}
    return mark | {"color": "black", "linestyle": ""}


def _legend(
    figure: Figure, names: Mapping[str, str], outlined: bool, positions: NDArray | None
) -> None:
    """Add the legend of colours above all scenes."""
    labels = {("other objects" if c == _BACKGROUND else name): c for name, c in names.items()}
    handles: list[Patch | Line2D] = [Patch(color=c, label=legible(k)) for k, c in labels.items()]
    if outlined:
        handles.append(Line2D([], [], color=_OUTLINE, linewidth=1, label="truth"))
    if positions is not None:
        label = f"radar, {len(positions)} positions" if len(positions) > 1 else "radar"
        handles.append(Line2D([], [], label=label, **_draw_marks(positions)))
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8, frameon=False)


_FRAMES = 24  # of one turn
_TILT = 0.35  # rad, of the eye above the object
_PAUSE_MS = 120


def turntable(meshes: Mapping[str, Mesh], up: ArrayLike) -> bytes:
    """Shapes side by side, turning once about an axis, as an animated GIF.

    Args:
        meshes: Shapes, by title.
        up: Direction [3] of the axis.
    """
    shapes = {t: (numbers(m.vertices), numbers(m.faces)) for t, m in meshes.items()}
    corners = np.concatenate([vertices for vertices, _ in shapes.values()])
    center = (corners.min(0) + corners.max(0)) / 2
    reach = 1.05 * np.linalg.norm(corners - center, axis=1).max()
    pictures = []
    for angle in np.arange(_FRAMES) * 2 * np.pi / _FRAMES:
        figure = Figure(figsize=(2.6 * len(shapes), 2.7), layout="constrained", dpi=72)
        eye = _eye(np.asarray(up, dtype=float), angle)
        row = figure.subplots(1, len(shapes), squeeze=False)[0]
        for axes, (title, (vertices, faces)) in zip(row, shapes.items(), strict=True):
            paint(axes, [((vertices - center, faces), color(0))], eye, reach / 3)
            axes.set(title=title, xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
            axes.set_axis_off()
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    # One palette for all frames, so that colours do not flicker.
    palette = pictures[0].quantize(64)
    frames = [picture.quantize(palette=palette) for picture in pictures]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, "GIF", save_all=True, append_images=frames[1:], duration=_PAUSE_MS, loop=0
    )
    return buffer.getvalue()


def _eye(up: NDArray, angle: float) -> NDArray:
    """Right, up and towards the eye, as rows [3, 3], for an eye that turns about an axis."""
    up = up / np.linalg.norm(up)
    aside = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    aside /= np.linalg.norm(aside)
    ahead = np.cos(angle) * aside + np.sin(angle) * np.cross(up, aside)
    towards = np.cos(_TILT) * ahead + np.sin(_TILT) * up
    right = np.cross(up, ahead)
    return np.stack([right, np.cross(towards, right), towards])
