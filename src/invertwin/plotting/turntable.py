"""A turning view of shapes, as an animation."""

import io
from collections.abc import Mapping

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from invertwin.plotting.figures import color, numbers
from invertwin.plotting.triangles import paint
from invertwin.scene import Mesh

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
        for axes, (title, (vertices, faces)) in zip(
            figure.subplots(1, len(shapes), squeeze=False)[0], shapes.items(), strict=True
        ):
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
