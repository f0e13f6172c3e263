"""Figures of coverage maps: levels and derivatives of cells over the floor plan."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from torch import Tensor

from invertwin.checks import check_shape, check_some
from invertwin.links import MapPlane, Transmitters
from invertwin.plotting.figures import add_colorbar, label_axes, numbers, row_of_axes, signed_colors
from invertwin.plotting.triangles import sharp_edges
from invertwin.scene import Scene

_SHARE = 0.995  # of the cells that the colours of a derivative reach; the brightest stick out


def coverage(
    levels: Mapping[str, Float[Tensor, "first second"]],
    plane: MapPlane,
    *,
    derivatives: Mapping[str, Float[Tensor, "first second"]] | None = None,
    scene: Scene | None = None,
    transmitters: Transmitters | Mapping[str, Transmitters] | None = None,
    label: str = "path gain [dB]",
    derivative_label: str = "∂ path gain [dB/m]",
    dynamic_range: float | None = None,
) -> Figure:
    """Maps over the cells of a plane side by side: levels, then derivatives.

    The sharp edges of the scene's objects are drawn as the plane's normal sees them: the floor plan
    of a horizontal map. Transmitters are triangles. Levels share one scale of colours, as do
    derivatives: what grows is red, what falls is blue.

    Args:
        levels: Maps by title, such as one of a ``RadioMap`` of one transmitter.
        plane: Their cells.
        derivatives: Maps by title.
        scene: Whose edges are drawn.
        transmitters: What sends, in all maps, or by their titles.
        label: Of the levels, with its unit.
        derivative_label: Of the derivatives, with its unit.
        dynamic_range: Level of the brightest colour above the darkest; None = that of the highest
            level above all but a twentieth of the cells, at most 60 dB.

    Raises:
        InputError: No map, or one of other cells.
    """
    rates = derivatives or {}
    check_some([*levels, *rates], "map", "give levels or derivatives")
    for title, values in [*levels.items(), *rates.items()]:
        what = f"a map of the plane's cells for {title!r}"
        check_shape(values, plane.shape, what, "give one of a single transmitter")
    count = len(levels) + len(rates)
    s, t = (torch.linspace(0, 1, n + 1, dtype=torch.float64) for n in plane.count)
    corners = plane.corner + s[:, None, None] * plane.first + t[:, None] * plane.second
    grid = _project_to_plane(plane, corners)
    width, height = np.ptp(grid[..., 0]), np.ptp(grid[..., 1])
    tall = min(max(3.4 * height / width, 1.6), 5.0)
    figure, cells = row_of_axes(count, (1.4 + 3.4 * count, tall + 0.9), sharey=True)
    lines = [] if scene is None else project_edges(scene, plane)
    named = isinstance(transmitters, Mapping)
    senders = transmitters if named else dict.fromkeys([*levels, *rates], transmitters)
    split = len(levels)
    every = torch.cat([values.flatten() for values in (levels or rates).values()])
    # Cells inside of objects would take most of the colours.
    low, top = every.double().nanquantile(torch.tensor([0.05, 1.0]).double()).tolist()
    span = min(60.0, top - low) if dynamic_range is None else dynamic_range
    for part, maps, style, name in (
        (cells[:split], levels, {"vmin": top - span, "vmax": top}, label),
        (cells[split:], rates, signed_colors(rates.values(), _SHARE), derivative_label),
    ):
        image = None
        for axes, (title, values) in zip(part, maps.items(), strict=True):
            image = axes.pcolormesh(grid[..., 0], grid[..., 1], numbers(values), **style)
            _format_axes(axes, title, plane, lines, senders.get(title))
        if image is not None:
            add_colorbar(figure, image, part, name)
    cells[0].set_ylabel(_names(plane)[1], fontsize=8)
    return figure


def _axes(plane: MapPlane) -> Tensor:
    """Unit vectors along the first side, and across it in the plane."""
    right = plane.first / plane.first.norm()
    up = plane.second - (plane.second @ right) * right
    return torch.stack([right, up / up.norm()])


def _project_to_plane(plane: MapPlane, points: Tensor) -> NDArray[Any]:
    """World points in the plane, about the world's origin [m]."""
    return numbers(points.detach() @ _axes(plane).T)


def _names(plane: MapPlane) -> list[str]:
    """Names of both axes."""
    found = []
    for axis, words in zip(_axes(plane), ("along the first side", "across it"), strict=True):
        same = [n for n, e in zip("xyz", torch.eye(3).double(), strict=True) if axis @ e > 1 - 1e-9]
        found.append(f"{same[0] if same else words} [m]")
    return found


def project_edges(scene: Scene, plane: MapPlane) -> list[NDArray[Any]]:
    """Sharp edges of all objects, in the plane.

    Args:
        scene: the objects.
        plane: the plane onto whose axes they are projected.
    """
    lines: list[NDArray[Any]] = []
    for item in scene.objects.values():
        edges = sharp_edges(numbers(item.vertices), numbers(item.mesh.faces))
        lines += [*_project_to_plane(plane, item.vertices[torch.from_numpy(edges)])]
    return lines


def _format_axes(axes: Any, title: str, plane: MapPlane, lines: Any, sender: Any) -> None:
    halo = [withStroke(linewidth=1.8, foreground="white", alpha=0.7)]  # seen on dark pages
    axes.add_collection(LineCollection(lines, colors="black", linewidths=0.6, path_effects=halo))
    if sender is not None:
        marks = _project_to_plane(plane, sender.positions)
        axes.plot(marks[:, 0], marks[:, 1], "^", color="#c0143c", markeredgecolor="white")
    axes.set_aspect("equal")
    label_axes(axes, title, _names(plane)[0])
