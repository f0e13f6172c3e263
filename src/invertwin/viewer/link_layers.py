"""Layers of links: transmitters, receivers, paths by what they meet, levels over a plane."""

from contextlib import suppress
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from invertwin.channel import KINDS, trace_paths
from invertwin.errors import InputError
from invertwin.links import MapPlane, PropagationSettings, ReceiverPoints, Transmitters
from invertwin.models.radio import RadioMap
from invertwin.scene import Scene
from invertwin.viewer.display import DisplayLayer
from invertwin.viewer.layers import LEVELS, ROLES, join_points, to_float32
from invertwin.viewer.panels import POWER_COLORMAP

_MAX_RECEIVERS = 4  # whose paths are drawn
_RAYS = 100_000
_BANDS = 12  # of levels over a plane
_PATH_COLORS = ((40, 40, 40), (31, 119, 180), (44, 160, 44), (214, 39, 40), (148, 103, 189))


def link_layers(
    scene: Scene, sensor: Transmitters, model: RadioMap, levels: NDArray[np.float64] | None = None
) -> list[DisplayLayer]:
    """Transmitters, receivers and paths to some of these; of a plane of cells their levels.

    Args:
        scene: What there is.
        sensor: Transmitters.
        model: Where receivers are, and how paths are searched.
        levels: Of the cells of a plane, along its first and its second side.
    """
    layers = [_draw_antennas("transmitters", sensor.positions)]
    if isinstance(model.places, ReceiverPoints):
        layers.append(_draw_antennas("receivers", model.places.positions))
        with suppress(InputError):  # of scenes without such paths
            layers += _draw_paths(scene, sensor, model.places.positions, model.propagation)
    if isinstance(model.places, MapPlane) and levels is not None:
        layers += _draw_levels(model.places, levels)
    return layers


def _draw_antennas(name: str, places: Tensor) -> DisplayLayer:
    return DisplayLayer(name, "points", to_float32(places), color=ROLES[name])


def _draw_paths(
    scene: Scene, sensor: Transmitters, receivers: Tensor, settings: PropagationSettings
) -> list[DisplayLayer]:
    """Paths to some receivers, by the last of the ``KINDS`` that they meet."""
    chosen = np.linspace(0, len(receivers) - 1, min(len(receivers), _MAX_RECEIVERS)).astype(int)
    places, ends = sensor.positions.detach(), receivers.detach()[chosen]
    depth, edges = settings.depth, min(settings.edges, 1)
    with torch.no_grad():
        paths = trace_paths(
            scene, places, ends, settings.frequency, depth=depth, edges=edges, rays=_RAYS
        )
    found: dict[int, list[Any]] = {}
    for tx, rx, met, at in zip(paths.tx, paths.rx, paths.kinds, paths.vertices, strict=True):
        points = torch.cat([places[tx][None], at[met > 0], ends[rx][None]])
        found.setdefault(int(met.max()) if len(met) else 0, []).append(join_points(points.numpy()))
    layers = list[DisplayLayer]()
    for kind, pairs in sorted(found.items()):
        name, points = f"paths: {KINDS[kind] or 'line of sight'}", to_float32(np.concatenate(pairs))
        layers.append(DisplayLayer(name, "lines", points, color=_PATH_COLORS[kind]))
    return layers


def _draw_levels(plane: MapPlane, levels: NDArray[np.float64]) -> list[DisplayLayer]:
    """Cells of a plane in bands of as many cells, the highest first: a slider hides the lowest."""
    from matplotlib import colormaps

    flat, layers = levels.ravel(), list[DisplayLayer]()
    sides = [side / n for side, n in zip((plane.first, plane.second), plane.count, strict=True)]
    turns = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]).double()
    corners = to_float32(plane.centres.reshape(-1, 1, 3) + turns @ torch.stack(sides))
    known = np.isfinite(flat)
    edges = np.quantile(flat[known], np.linspace(0, 1, _BANDS + 1)) if known.any() else []
    bands = np.digitize(flat, edges[1:-1])
    for band in np.unique(bands[known])[::-1]:
        own = corners[known & (bands == band)]
        faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(own))[:, None, None]
        red, green, blue, _ = colormaps[POWER_COLORMAP](band / (_BANDS - 1), bytes=True)
        color = int(red), int(green), int(blue)
        name = f"{LEVELS}/{edges[band]:.4g} to {edges[band + 1]:.4g}"
        triangles = faces.reshape(-1, 3).astype(np.int32)
        layers.append(DisplayLayer(name, "surface", own.reshape(-1, 3), triangles, color, 0.8))
    return layers
