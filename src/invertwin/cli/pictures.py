"""Pictures of a run as PNG bytes: scene views, spectra, curves. Matplotlib (Agg)."""

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from invertwin.radar.radar import Radar
from invertwin.scene import Scene

PALETTE = ("#4c78a8", "#e0803c", "#54a24b", "#b279a2", "#9d755d")
BACKGROUND = "#b9bec7"
OUTLINE = "#c0143c"
DYNAMIC_RANGE_DB = 40.0
U_LABEL, V_LABEL = "direction cosine u (to the right)", "direction cosine v (up)"
MAX_TRIANGLES = 40_000

MARKED_SHARE = 0.015  # of a view: objects that look smaller get a mark
TRACK_COUNT = 24  # radar positions: more of them are drawn as dots

VIEWS: Mapping[str, tuple[int, int, int]] = {
    "from the radar": (0, 1, 2),
    "from above": (0, 2, 1),
    "from the side": (2, 1, 0),
}
"""What runs across, up, and in depth: 0, 1, 2 = the radar's right, up, boresight."""


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

    @property
    def colors(self) -> dict[str, str]:
        """A colour for every object."""
        return {
            name: PALETTE[i % len(PALETTE)] if name in self.sought else BACKGROUND
            for i, name in enumerate(self.meshes)
        }


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


def frame_of(radar: Radar) -> NDArray:
    """Mean right, up and boresight of a radar over its frames, as columns [3, 3]."""
    if radar.rotations is None:
        return np.eye(3)
    return radar.rotations.detach().mean(0).numpy()


def scene_picture(drawings: Mapping[str, Drawing], frame: NDArray | None = None) -> bytes:
    """Three views of every drawing: one drawing a column, or a single one in a row.

    Args:
        drawings: What is drawn, by title.
        frame: Right, up and boresight of the radar as columns [3, 3]; each view looks along the
            world axis nearest to one of them. None = the axes of the world.
    """
    nearest = _nearest_axes(np.eye(3) if frame is None else frame)
    windows = {view: _window(drawings.values(), nearest, view) for view in VIEWS}
    heights = {view: min(max(h / w, 0.3), 1.3) for view, (_, _, w, h) in windows.items()}
    cells = [[(view, title) for title in drawings] for view in VIEWS]
    ratios = list(heights.values())
    if len(drawings) == 1:
        cells = [[(view, title) for view in VIEWS for title in drawings]]
        ratios = [max(ratios)]
    width = 11.0
    height = 0.5 + sum(ratio * width / len(cells[0]) + 0.35 for ratio in ratios)
    figure = Figure(figsize=(width, height), layout="constrained")
    grid = figure.subplots(
        len(cells), len(cells[0]), squeeze=False, gridspec_kw={"height_ratios": ratios}
    )
    for axes, (view, title) in zip(grid.flat, (c for row in cells for c in row), strict=True):
        _draw_scene(axes, drawings[title], nearest, view, windows[view])
        axes.set_title(f"{title}, {view}", fontsize=9)
    _legend(figure, drawings)
    return png_bytes(figure)


@dataclass(frozen=True)
class _NearestAxes:
    """The world axes nearest to the radar's right, up and boresight, and their signs."""

    index: tuple[int, int, int]
    sign: tuple[int, int, int]


def _nearest_axes(frame: NDArray) -> _NearestAxes:
    size = np.abs(frame)
    orders = [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
    index = max(orders, key=lambda order: sum(size[k, c] for c, k in enumerate(order)))
    a, b, c = (-1 if frame[k, c] < 0 else 1 for c, k in enumerate(index))
    return _NearestAxes(index, (a, b, c))


def _window(drawings: Iterable[Drawing], nearest: _NearestAxes, view: str) -> tuple[float, ...]:
    """Centre and size of what a view shows, the same for all drawings."""
    across, up, depth = VIEWS[view]
    points = [np.zeros((0, 3))]
    for drawing in drawings:
        points += [v for v, _ in (*drawing.meshes.values(), *drawing.outline.values())]
        # Seen from the radar, its own marks would only hide the scene.
        if drawing.radar is not None and depth != 2:
            points.append(drawing.radar)
    flat = np.concatenate(points)[:, [nearest.index[across], nearest.index[up]]]
    if not len(flat):
        return 0.0, 0.0, 1.0, 1.0
    low, high = flat.min(axis=0), flat.max(axis=0)
    sides = (high - low) * 1.12
    sides = np.maximum(sides, max(0.3 * sides.max(), 1e-3))
    return (*(low + high) / 2, *sides)


def _draw_scene(
    axes, drawing: Drawing, nearest: _NearestAxes, view: str, window: tuple[float, ...]
) -> None:
    across, up, depth = VIEWS[view]
    plane = [nearest.index[across], nearest.index[up]]
    # The eye is before the radar's boresight, above, or on the right.
    behind = nearest.sign[depth] * (-1 if depth == 2 else 1)
    _paint(axes, drawing, plane, nearest.index[depth], behind)
    for vertices, faces in drawing.outline.values():
        segments = vertices[_sharp_edges(vertices, faces)][:, :, plane]
        axes.add_collection(LineCollection(list(segments), colors=OUTLINE, linewidths=0.8))
    smallest = MARKED_SHARE * max(window[2:])
    for name, (vertices, _) in drawing.meshes.items():
        if np.ptp(vertices[:, plane], axis=0).max() < smallest:
            axes.plot(*vertices[:, plane].mean(axis=0), "o", color=drawing.colors[name], ms=6)
    for vertices, _ in drawing.outline.values():
        if np.ptp(vertices[:, plane], axis=0).max() < smallest:
            axes.plot(*vertices[:, plane].mean(axis=0), "+", color=OUTLINE, ms=11, mew=1.2)
    if drawing.radar is not None and depth != 2:
        many = len(drawing.radar) > TRACK_COUNT
        style = {"marker": ".", "markersize": 5} if many else {"marker": "v", "markersize": 4}
        axes.plot(*drawing.radar[:, plane].T, color="black", linestyle="", mew=0, **style)
    for set_limits, k, c in ((axes.set_xlim, across, 0), (axes.set_ylim, up, 1)):
        ends = window[c] + window[c + 2] / 2 * np.array([-1, 1])
        set_limits(*ends[:: nearest.sign[k]])
    axes.set_aspect("equal")
    axes.set_xlabel(f"{'xyz'[plane[0]]} [m]", fontsize=8)
    axes.set_ylabel(f"{'xyz'[plane[1]]} [m]", fontsize=8)
    axes.tick_params(labelsize=7)


def _paint(axes, drawing: Drawing, plane: list[int], depth: int, behind: int) -> None:
    """Shaded triangles, the far ones first."""
    polygons, colors = [], []
    corners = [v for v, _ in drawing.meshes.values()]
    extent = np.ptp(np.concatenate(corners), axis=0).max() if corners else 1.0
    for name, (vertices, faces) in drawing.meshes.items():
        triangles = _small_triangles(vertices[faces], extent / 6)
        triangles = triangles[:: math.ceil(len(triangles) / MAX_TRIANGLES)]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        light = np.array([0.35, 0.6, -0.72])
        shade = np.abs(normals @ light) / np.where(lengths > 0, lengths, 1)
        color = drawing.colors[name]
        rgb = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        polygons.append(triangles)
        colors.append(np.clip(rgb * (0.55 + 0.5 * shade[:, None]), 0, 1))
    if polygons:
        triangles, color = np.concatenate(polygons), np.concatenate(colors)
        order = np.argsort(behind * triangles[:, :, depth].mean(axis=1))
        # Edges in the face's own colour close the hairlines between neighbouring triangles.
        axes.add_collection(
            PolyCollection(
                list(triangles[order][:, :, plane]),
                facecolors=color[order],
                edgecolors=color[order],
                linewidths=0.3,
            )
        )


def _legend(figure: Figure, drawings: Mapping[str, Drawing]) -> None:
    """Which colour is what, over all drawings."""
    handles: dict[str, Patch | Line2D] = {}
    for drawing in drawings.values():
        for name, color in drawing.colors.items():
            label = name if name in drawing.sought else "not sought"
            handles[label] = Patch(color=color, label=label)
        if drawing.outline:
            handles["truth"] = Line2D([], [], color=OUTLINE, linewidth=1, label="truth")
        if drawing.radar is not None:
            count = len(drawing.radar)
            label = f"radar, {count} positions" if count > 1 else "radar"
            handles["radar"] = Line2D(
                [],
                [],
                color="black",
                marker="." if count > TRACK_COUNT else "v",
                ls="",
                label=label,
            )
    figure.legend(
        handles=list(handles.values()),
        loc="outside lower center",
        ncols=6,
        fontsize=8,
        frameon=False,
    )


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
        rows.append((U_LABEL, axes.u))
    if len(axes.v) > 1:
        rows.append((V_LABEL, axes.v))
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
    return png_bytes(figure)


def loss_picture(
    losses: Mapping[str, Sequence[Sequence[float]]],
    annealed: float | None = None,
    before: float | None = None,
) -> bytes:
    """Loss over steps, one colour per group and one line per fit.

    Args:
        losses: Losses of every fit, by group.
        annealed: Step from which the surrogate has no extra width.
        before: Loss of the start without extra width.
    """
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    for i, (name, fits) in enumerate(losses.items()):
        for k, values in enumerate(fits):
            style = {"color": PALETTE[i % len(PALETTE)], "linewidth": 1.1, "alpha": 0.7}
            axes.plot(values, label="_" if k else f"{name} ({len(fits)})", **style)
    values = [value for fits in losses.values() for row in fits for value in row if value > 0]
    values += [before] if before else []
    if values and max(values) > 5 * min(values):
        axes.set_yscale("log")
    if annealed is not None:
        label = "extra width shrinks to 0: losses not comparable"
        axes.axvspan(0, annealed, color="black", alpha=0.07, linewidth=0, label=label)
    if before is not None:
        axes.plot([0], [before], "k*", markersize=8, label="start, without extra width")
    axes.set_xlabel("step")
    axes.set_ylabel("loss")
    axes.grid(alpha=0.3)
    if losses:
        axes.legend(fontsize=8)
    return png_bytes(figure)


def landscape_picture(exact: Curve, surrogates: Mapping[str, Curve], along: str) -> bytes:
    """The exact signal's loss beside the surrogate's, over the offset from the truth.

    Args:
        along: What is moved and in which direction, such as ``letter along z``.
        exact: Offsets (m) and losses of the exact signal.
        surrogates: Offsets (m) and losses of the surrogate, by name.
    """
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(exact[0] * 1e3, exact[1], color=PALETTE[0], linewidth=0.8)
    left.set_title(f"exact signal: {count_minima(exact[1])} local minima", fontsize=9)
    left.set_xlabel(f"offset of {along} from the truth, in millimetres [mm]", fontsize=9)
    for i, (name, (offsets, losses)) in enumerate(surrogates.items()):
        color = PALETTE[(i + 1) % len(PALETTE)]
        right.plot(offsets, losses, color=color, label=f"{name} ({count_minima(losses)})")
    right.set_title("surrogate, and its number of local minima", fontsize=9)
    right.set_xlabel(f"offset of {along} from the truth, in metres [m]", fontsize=9)
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.axvline(0, color="black", linewidth=0.6, linestyle=":")
        axes.set_ylabel("loss")
        axes.grid(alpha=0.3)
    return png_bytes(figure)


def count_minima(values: NDArray) -> int:
    """Points inside a curve that are lower than both neighbours."""
    return int(np.sum((values[1:-1] < values[:-2]) & (values[1:-1] < values[2:])))


def gradient_picture(
    gradients: Mapping[str, NDArray], error: tuple[str, NDArray], axes: Axes, unit: str
) -> bytes:
    """Derivative maps [frame, range, u, v] side by side on one symmetric colour scale.

    Args:
        gradients: Maps, by title.
        error: Title and map of a difference, on a colour scale of its own.
        axes: Of all maps.
        unit: Of the derivative, such as ``1/m``.
    """
    flats = {
        name: g.sum(axis=3)[0] if len(axes.u) > 1 else g.sum(axis=(2, 3)).T
        for name, g in {**gradients, error[0]: error[1]}.items()
    }
    limits = {name: float(np.quantile(np.abs(flat), 0.998)) for name, flat in flats.items()}
    common = max(limits[name] for name in gradients) or 1.0
    figure = Figure(figsize=(3.7 * len(flats), 3.3), layout="constrained")
    grid = figure.subplots(1, len(flats), squeeze=False)[0]
    for cell, (name, flat) in zip(grid, flats.items(), strict=True):
        limit = common if name in gradients else limits[name] or 1.0
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
        cell.set_xlabel(U_LABEL if len(axes.u) > 1 else "frame", fontsize=8)
        cell.tick_params(labelsize=7)
        if cell is grid[-2]:
            bar = figure.colorbar(image, ax=grid[:-1], shrink=0.8)
            bar.set_label(f"∂ power (received/sent) [{unit}]", fontsize=8)
        elif cell is grid[-1]:
            figure.colorbar(image, ax=cell, shrink=0.8).set_label(
                "own scale, same unit", fontsize=8
            )
    grid[0].set_ylabel("range [m]", fontsize=8)
    return png_bytes(figure)


def png_bytes(figure: Figure) -> bytes:
    """The figure as PNG."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    # No time stamp: the same run gives the same bytes.
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()
