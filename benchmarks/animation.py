"""Animation of a fit: the scene, the measured map of one position, and the twin's at every step.

    python benchmarks/animation.py out/demo [-o docs/pictures/fit.gif] [--position 11]

The folder is that of `invertwin demo` or of another fit of one radar whose truth is known. The
same folder gives the same file.
"""

import argparse
import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from invertwin import viewer
from invertwin.cli.commands.view import load_display
from invertwin.plotting.triangles import paint, sharp_edges

_PAUSE_MS, _LAST_MS = 160, 2500
_DEPTH_DB = 35.0
_SIZE, _DPI = (10.0, 3.9), 96  # inches, and pixels of one
_PAGE, _INK, _RED = "#14171c", "#d7dce3", "#ff5a76"
_COLORS = {"fitted": "#5b9bd5", "fixed": "#8a93a1"}
# Of the eye: to the right of the radar's boresight, and above it [rad].
_WINDOW, _ENDS = (1.1, 0.85), np.array([-1.0, 1.0])  # about the truth [m]
_ASIDE, _ABOVE = 0.5, 0.3


def animate(folder: Path, position: int) -> bytes:
    """Return the animation as GIF.

    Args:
        folder: Run folder of a fit.
        position: Number of the radar position whose maps are shown.
    """
    display, sensors = load_display(folder)
    ((name, link),) = sensors.items()
    measured = display.maps[name].maps_of_frame(position)[viewer.MEASURED]
    ranges, across = link.grid.ranges.numpy(), link.grid.u.numpy()
    truth = {x.name: x for x in display.layers if x.group == "truth"}
    count = link.radar.frame_count
    titles = f"measured, position {position + 1} of {count}", "simulated from the twin"
    pictures = []
    for step in display.steps:
        link.replace_meshes(step.bodies)
        predicted = link.predict_map(link.scene, position).numpy()
        figure = Figure(figsize=_SIZE, dpi=_DPI, facecolor=_PAGE)
        scene, *maps = figure.subplots(1, 3, gridspec_kw={"width_ratios": [1.5, 1, 1]})
        figure.subplots_adjust(0.005, 0.14, 0.985, 0.86, 0.16)
        shown = display.show_step(step)
        _draw_scene(scene, shown, list(truth.values()))
        for axes, power, title in zip(maps, (measured, predicted), titles, strict=True):
            _draw_map(axes, power, ranges, across, title)
        maps[1].set_ylabel("")
        maps[1].tick_params(labelleft=False)
        missing = _distance(shown, truth)
        figure.text(0.02, 0.9, f"twin, step {step.number:3d}", color=_COLORS["fitted"], fontsize=12)
        figure.text(0.2, 0.9, f"{100 * missing:.1f} cm from the truth", color=_RED, fontsize=12)
        pictures.append(_render(figure))
    # One palette for all frames, so that colours do not flicker.
    palette = pictures[len(pictures) // 4].quantize(224, dither=Image.Dither.NONE)
    frames = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
    buffer, last = io.BytesIO(), len(frames) - 1
    pauses = [4 * _PAUSE_MS, *[_PAUSE_MS] * (last - 1), _LAST_MS]
    frames[0].save(
        buffer,
        "GIF",
        save_all=True,
        append_images=frames[1:],
        duration=pauses,
        loop=0,
        optimize=True,
    )
    return buffer.getvalue()


def _distance(shown: Any, truth: dict[str, Any]) -> float:
    """How far the centres of the twin's objects are from the truth's, the farthest [m]."""
    twin = {x.name.removeprefix("twin/"): x.points for x in shown.layers if x.group == "twin"}
    ends = [(twin[name.removeprefix("truth/")], one.points) for name, one in truth.items()]
    return max(float(np.linalg.norm(a.mean(0) - b.mean(0))) for a, b in ends)


def _draw_scene(axes: Any, shown: Any, truth: list[Any]) -> None:
    """Draw the twin as from behind and above the radar, the truth in outline."""
    up, ahead = np.array(shown.up), np.array(shown.ahead)
    left = np.cross(up, ahead)
    level = np.cos(_ASIDE) * ahead + np.sin(_ASIDE) * left
    towards = np.sin(_ABOVE) * up - np.cos(_ABOVE) * level
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    eye = np.stack([right, np.cross(towards, right), towards])
    moved = {name for step in shown.steps for name in step.bodies}
    twin = [layer for layer in shown.layers if layer.group == "twin"]
    roles = ["fitted" if x.name.removeprefix("twin/") in moved else "fixed" for x in twin]
    bodies = [(x.points.astype(float), x.faces) for x in twin]
    shapes = [(body, _COLORS[role]) for body, role in zip(bodies, roles, strict=True)]
    paint(axes, shapes, eye, 0.3)
    for layer in truth:
        corners = layer.points[sharp_edges(layer.points, layer.faces)] @ eye[:2].T
        axes.add_collection(LineCollection(list(corners), colors=_RED, linewidths=0.8, alpha=0.8))
    middle = np.concatenate([layer.points for layer in truth]).mean(0) @ eye[:2].T
    axes.set(xlim=middle[0] + _WINDOW[0] * _ENDS, ylim=middle[1] + _WINDOW[1] * _ENDS)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _draw_map(
    axes: Any, power: NDArray[Any], ranges: NDArray[Any], across: NDArray[Any], title: str
) -> None:
    """Draw a map over azimuth and range, in decibels below its peak."""
    level = 10 * np.log10(np.maximum(power / power.max(), 1e-9))
    degrees = np.degrees(np.arcsin(across))
    axes.pcolormesh(
        degrees,
        ranges,
        level,
        vmin=-_DEPTH_DB,
        vmax=0,
        cmap="inferno",
        shading="gouraud",
        rasterized=True,
    )
    axes.set_ylim(2.3, 4.6)
    axes.set_xlim(degrees[-1], degrees[0])  # the left of the radar is on the left
    axes.set_title(title, color=_INK, fontsize=12, loc="left")
    axes.set_xlabel("azimuth [°]", color=_INK)
    axes.set_ylabel("range [m]", color=_INK)
    axes.tick_params(colors=_INK)
    axes.set_facecolor("black")


def _render(figure: Figure) -> Image.Image:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def main() -> None:
    """Write the animation."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/pictures/fit.gif"))
    parser.add_argument("--position", type=int, default=11)
    options = parser.parse_args()
    options.out.write_bytes(animate(options.folder, options.position))


if __name__ == "__main__":
    main()
