"""Pictures of shapes: a turning view of truth, start and twin, and measures over the steps."""

import io
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from invertwin.cli.pictures import PALETTE, png_bytes

_FRAMES = 24  # of one turn
_TILT = 0.35  # rad, of the eye above the object
_PAUSE_MS = 120
_MOST_TRIANGLES = 12_000  # of one view

Curve = Sequence[Sequence[float]]
"""Steps and values, in pairs."""


def turntable_gif(meshes: Mapping[str, tuple[NDArray, NDArray]], up: NDArray) -> bytes:
    """Shapes side by side, turning once about the axis up, as an animated GIF.

    Args:
        meshes: Vertices [v, 3] (m) and faces [f, 3], by title.
        up: Direction [3] of the axis.
    """
    corners = np.concatenate([vertices for vertices, _ in meshes.values()])
    center = (corners.min(0) + corners.max(0)) / 2
    reach = 1.05 * np.linalg.norm(corners - center, axis=1).max()
    pictures = []
    for angle in np.arange(_FRAMES) * 2 * np.pi / _FRAMES:
        figure = Figure(figsize=(2.6 * len(meshes), 2.7), layout="constrained", dpi=72)
        for axes, (title, mesh) in zip(
            figure.subplots(1, len(meshes), squeeze=False)[0], meshes.items(), strict=True
        ):
            _view(axes, mesh, center, _eye(np.asarray(up, dtype=float), angle))
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


def convergence_picture(
    losses: Mapping[str, Sequence[Sequence[float]]], curves: Mapping[str, Sequence[Curve]]
) -> bytes:
    """Loss and Chamfer distance over the steps, one colour for each way to fit.

    Args:
        losses: Of every fit, by way.
        curves: Steps and Chamfer distances (m) of every fit, by way.
    """
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for i, name in enumerate(losses):
        color = PALETTE[i % len(PALETTE)]
        for k, values in enumerate(losses[name]):
            left.plot(values, color=color, linewidth=1.1, alpha=0.8, label="_" if k else name)
        for k, curve in enumerate(curves[name]):
            steps, distances = zip(*curve, strict=True) if curve else ((), ())
            right.plot(steps, distances, color=color, marker=".", label="_" if k else name)
    left.set(xlabel="step", ylabel="loss")
    right.set(xlabel="step", ylabel="Chamfer distance [m]")
    highest = max(value for fits in curves.values() for curve in fits for _, value in curve)
    right.set_ylim(0, 1.05 * highest)
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return png_bytes(figure)


def _eye(up: NDArray, angle: float) -> NDArray:
    """Right, up and towards the eye, as rows [3, 3], for an eye that turns about an axis."""
    up = up / np.linalg.norm(up)
    aside = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    aside /= np.linalg.norm(aside)
    ahead = np.cos(angle) * aside + np.sin(angle) * np.cross(up, aside)
    towards = np.cos(_TILT) * ahead + np.sin(_TILT) * up
    right = np.cross(up, ahead)
    return np.stack([right, np.cross(towards, right), towards])


def _view(axes, mesh: tuple[NDArray, NDArray], center: NDArray, eye: NDArray) -> None:
    vertices, faces = mesh
    seen = (vertices - center) @ eye.T
    triangles = seen[faces[:: max(1, len(faces) // _MOST_TRIANGLES)]]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    light = np.array([0.4, 0.5, 0.77])
    shade = np.abs(normals @ light) / np.where(lengths > 0, lengths, 1)
    base = np.array([int(PALETTE[0][k : k + 2], 16) for k in (1, 3, 5)]) / 255
    colors = np.clip(base * (0.45 + 0.65 * shade[:, None]), 0, 1)
    order = np.argsort(triangles[:, :, 2].mean(axis=1))
    axes.add_collection(
        PolyCollection(
            list(triangles[order][:, :, :2]),
            facecolors=colors[order],
            edgecolors=colors[order],
            linewidths=0.2,
        )
    )
