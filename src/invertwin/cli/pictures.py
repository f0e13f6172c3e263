"""Pictures of a run as PNG bytes: scene views, spectra, curves. Matplotlib (Agg)."""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from invertwin.scene import Scene

PALETTE = ("#4c78a8", "#e0803c", "#54a24b", "#b279a2", "#9d755d")
BACKGROUND = "#b9bec7"
OUTLINE = "#c0143c"
DYNAMIC_RANGE_DB = 40.0
MAX_TRIANGLES = 40_000

# Rows are the right, up and towards-the-viewer directions of a picture, in world coordinates.
VIEWS: Mapping[str, NDArray] = {
    "from the radar": np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
    "from above": np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "from the side": np.array([[0, 0, 1.0], [0, 1, 0], [1, 0, 0]]),
}


Curve = tuple[NDArray, NDArray]
"""Places and values."""


@dataclass(frozen=True)
class Drawing:
    """One scene as triangles, with an optional outline of where objects should be.

    Attributes:
        meshes: Vertices [v, 3] (m) and faces [f, 3] of each object.
        sought: Names of the objects drawn in colour; the others are grey.
        outline: Meshes whose edges are drawn on top, such as the truth.
        radar: Radar positions [frame, 3], m.
    """

    meshes: Mapping[str, tuple[NDArray, NDArray]]
    sought: Sequence[str] = ()
    outline: Mapping[str, tuple[NDArray, NDArray]] = field(default_factory=dict)
    radar: NDArray | None = None


@dataclass(frozen=True)
class Axes:
    """Axes of a power map: range (m) and direction cosines."""

    ranges: NDArray
    u: NDArray
    v: NDArray


def meshes_of(scene: Scene) -> dict[str, tuple[NDArray, NDArray]]:
    """Vertices and faces of every object, for a `Drawing`."""
    return {
        name: (item.vertices.detach().cpu().numpy(), item.mesh.faces.cpu().numpy())
        for name, item in scene.objects.items()
    }


def scene_picture(drawings: Mapping[str, Drawing]) -> bytes:
    """Rows of views, one row per drawing."""
    figure = Figure(figsize=(11, 3.4 * len(drawings)), layout="constrained")
    grid = figure.subplots(len(drawings), len(VIEWS), squeeze=False)
    for row, (title, drawing) in zip(grid, drawings.items(), strict=True):
        for axes, (view, frame) in zip(row, VIEWS.items(), strict=True):
            _draw_scene(axes, drawing, frame)
            axes.set_title(f"{title}, {view}", fontsize=9)
            across = {"from the side": "z [m]"}.get(view, "x [m]")
            axes.set_xlabel(across, fontsize=8)
            axes.set_ylabel({"from above": "z [m]"}.get(view, "y [m]"), fontsize=8)
    return _png(figure)


def _draw_scene(axes, drawing: Drawing, frame: NDArray) -> None:
    polygons, colors = [], []
    corners = [v for v, _ in drawing.meshes.values()]
    extent = np.ptp(np.concatenate(corners), axis=0).max() if corners else 1.0
    for i, (name, (vertices, faces)) in enumerate(drawing.meshes.items()):
        triangles = _small_triangles(vertices[faces], extent / 6)
        triangles = triangles[:: math.ceil(len(triangles) / MAX_TRIANGLES)]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        light = np.array([0.35, 0.6, -0.72])
        shade = np.abs(normals @ light) / np.where(lengths > 0, lengths, 1)
        color = PALETTE[i % len(PALETTE)] if name in drawing.sought else BACKGROUND
        rgb = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        polygons.append(triangles)
        colors.append(np.clip(rgb * (0.55 + 0.5 * shade[:, None]), 0, 1))
    if polygons:
        triangles, color = np.concatenate(polygons), np.concatenate(colors)
        order = np.argsort(triangles.mean(axis=1) @ frame[2])
        # Edges in the face's own colour close the hairlines between neighbouring triangles.
        axes.add_collection(
            PolyCollection(
                list((triangles @ frame[:2].T)[order]),
                facecolors=color[order],
                edgecolors=color[order],
                linewidths=0.3,
            )
        )
    for vertices, faces in drawing.outline.values():
        segments = vertices[_sharp_edges(vertices, faces)] @ frame[:2].T
        axes.add_collection(LineCollection(list(segments), colors=OUTLINE, linewidths=0.8))
    # Seen from the radar, its own marks would only hide the scene.
    if drawing.radar is not None and frame[2, 2] == 0:
        x, y = (drawing.radar @ frame[:2].T).T
        axes.plot(x, y, "v", color="black", markersize=4)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.tick_params(labelsize=7)


def _small_triangles(triangles: NDArray, longest: float) -> NDArray:
    """Splits large triangles so that sorting by depth paints them in the right order."""
    for _ in range(4):
        sides = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
        large = sides > longest
        if not large.any() or large.sum() * 4 > MAX_TRIANGLES:
            break
        a, b, c = triangles[large].transpose(1, 0, 2)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        split = [np.stack(corners, axis=1) for corners in quarters]
        triangles = np.concatenate([triangles[~large], *split])
    return triangles


def _sharp_edges(vertices: NDArray, faces: NDArray) -> NDArray:
    """Vertex pairs [e, 2] of open edges and of edges that bend by more than 30°."""
    normals = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    edges, index = np.unique(pairs, axis=0, return_inverse=True)
    index = index.reshape(-1)
    total = np.zeros((len(edges), 3))
    np.add.at(total, index, normals[owner])
    count = np.bincount(index, minlength=len(edges))
    # The sum of two unit normals at angle a has length 2·cos(a/2).
    flat = (count == 2) & (np.linalg.norm(total, axis=1) > 2 * math.cos(math.radians(15)))
    return edges[~flat]


def spectra_picture(spectra: Mapping[str, NDArray], axes: Axes) -> bytes:
    """Power maps [frame, range, u, v] side by side, each in dB below its own peak.

    Range × azimuth summed over elevation and frames, and range × elevation below it where the
    radar resolves it; a radar that resolves no direction is shown as range × frame.
    """
    rows: list[tuple[str, NDArray | None]] = []
    if len(axes.u) > 1:
        rows.append(("u (azimuth)", axes.u))
    if len(axes.v) > 1:
        rows.append(("v (elevation)", axes.v))
    if not rows:
        rows.append(("frame", None))
    figure = Figure(figsize=(3.7 * len(spectra), 3.3 * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), len(spectra), squeeze=False)
    image = None
    for r, (label, across) in enumerate(rows):
        for c, (title, power) in enumerate(spectra.items()):
            if across is None:
                flat = power.sum(axis=(2, 3)).T
                across_limits = (-0.5, flat.shape[1] - 0.5)
            else:
                flat = power.sum(axis=(0, 3) if across is axes.u else (0, 2))
                across_limits = (across[0], across[-1])
            peak = flat.max()
            level = 10 * np.log10(np.maximum(flat / peak if peak > 0 else flat, 1e-12))
            image = grid[r, c].imshow(
                level,
                origin="lower",
                aspect="auto",
                extent=(*across_limits, axes.ranges[0], axes.ranges[-1]),
                vmin=-DYNAMIC_RANGE_DB,
                vmax=0,
                cmap="viridis",
            )
            grid[r, c].set_title(title if r == 0 else "", fontsize=9)
            grid[r, c].set_xlabel(label, fontsize=8)
            grid[r, c].set_ylabel("range [m]" if c == 0 else "", fontsize=8)
            grid[r, c].tick_params(labelsize=7)
    if image is not None:
        figure.colorbar(image, ax=grid, label="power [dB below peak]", shrink=0.8)
    return _png(figure)


def loss_picture(losses: Mapping[str, Sequence[float]]) -> bytes:
    """Loss over steps, one line per run."""
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axes = figure.subplots()
    for i, (name, values) in enumerate(losses.items()):
        axes.plot(values, color=PALETTE[i % len(PALETTE)], linewidth=1.2, label=name)
    if any(value > 0 for values in losses.values() for value in values):
        axes.set_yscale("log")
    axes.set_xlabel("step")
    axes.set_ylabel("loss")
    axes.grid(alpha=0.3)
    if 1 < len(losses) <= 12:
        axes.legend(fontsize=7, ncols=2)
    return _png(figure)


def landscape_picture(exact: Curve, surrogates: Mapping[str, Curve]) -> bytes:
    """The exact signal's loss beside the surrogate's, over the offset from the truth.

    Args:
        exact: Offsets (m) and losses of the exact signal.
        surrogates: Offsets (m) and losses of the surrogate, by name.
    """
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(exact[0] * 1e3, exact[1], color=PALETTE[0], linewidth=0.8)
    left.set_title(f"exact signal: {count_minima(exact[1])} local minima", fontsize=9)
    left.set_xlabel("offset from the truth [mm]")
    for i, (name, (offsets, losses)) in enumerate(surrogates.items()):
        color = PALETTE[(i + 1) % len(PALETTE)]
        right.plot(offsets, losses, color=color, label=f"{name} ({count_minima(losses)})")
    right.set_title("surrogate, and its number of local minima", fontsize=9)
    right.set_xlabel("offset from the truth [m]")
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.axvline(0, color="black", linewidth=0.6, linestyle=":")
        axes.set_ylabel("loss")
        axes.grid(alpha=0.3)
    return _png(figure)


def count_minima(values: NDArray) -> int:
    """Points inside a curve that are lower than both neighbours."""
    return int(np.sum((values[1:-1] < values[:-2]) & (values[1:-1] < values[2:])))


def gradient_picture(gradients: Mapping[str, NDArray], axes: Axes) -> bytes:
    """Derivative maps [frame, range, u, v] side by side on one symmetric colour scale."""
    flats = {
        name: g.sum(axis=3)[0] if len(axes.u) > 1 else g.sum(axis=(2, 3)).T
        for name, g in gradients.items()
    }
    limit = max((np.quantile(np.abs(flat), 0.998) for flat in flats.values()), default=0) or 1.0
    figure = Figure(figsize=(3.7 * len(flats), 3.3), layout="constrained")
    grid = figure.subplots(1, len(flats), squeeze=False)[0]
    image = None
    for cell, (name, flat) in zip(grid, flats.items(), strict=True):
        across = (axes.u[0], axes.u[-1]) if len(axes.u) > 1 else (-0.5, flat.shape[1] - 0.5)
        image = cell.imshow(
            flat,
            origin="lower",
            aspect="auto",
            extent=(*across, axes.ranges[0], axes.ranges[-1]),
            vmin=-limit,
            vmax=limit,
            cmap="RdBu_r",
        )
        cell.set_title(name, fontsize=9)
        cell.set_xlabel("u (azimuth)" if len(axes.u) > 1 else "frame", fontsize=8)
        cell.tick_params(labelsize=7)
    grid[0].set_ylabel("range [m]", fontsize=8)
    if image is not None:
        figure.colorbar(image, ax=grid, shrink=0.8)
    return _png(figure)


def _png(figure: Figure) -> bytes:
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    # No time stamp: the same run gives the same bytes.
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()
