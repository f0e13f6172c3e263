"""Layers of links: antennas, metasurfaces, paths by what they meet, levels over a plane."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from invertwin.channel import KINDS
from invertwin.errors import InputError
from invertwin.links import MapPlane, Metasurface, PropagationSettings, ReceiverPoints, Transmitters
from invertwin.models.radio import RadioMap
from invertwin.scene import Scene
from invertwin.viewer.display import DisplayLayer
from invertwin.viewer.layers import LEVELS, ROLES, join_points, to_float32
from invertwin.viewer.panels import POWER_COLORMAP

_MAX_RECEIVERS, _MAX_ANTENNAS = 4, 64  # whose paths, and which themselves are drawn
_LEAST_SHARE = 0.1  # of the power of the strongest path of a link and kind, of drawn paths
_BANDS = 12  # of levels over a plane, of phases on a metasurface
PHASES = "metasurface: phase −180° to 180°"
"""Group of the cells of metasurfaces by their phase."""
_BAND_LOOKS = {LEVELS: (POWER_COLORMAP, 0.8), PHASES: ("hsv", 1.0)}  # colours, opacity
_CELL_SHARE = 0.9  # of a cell's side that is drawn, so that cells are apart
_PANEL_SHARE = 0.1  # of the distance of transmitters: least side of a drawn metasurface
_CORNERS = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]).double()  # of a cell
# Apart from the colours of antennas, on white and on black.
_PATH_COLORS = ((230, 159, 0), (0, 158, 115), (150, 100, 60), (214, 110, 170), (148, 103, 189))


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
    for panel in model.propagation.panels:
        layers += _draw_cells(panel, sensor)
    if isinstance(model.places, ReceiverPoints):
        layers.append(_draw_antennas("receivers", model.places.positions))
        with suppress(InputError):  # of scenes without such paths
            layers += _draw_paths(scene, sensor, model.places.positions, model.propagation)
    if isinstance(model.places, MapPlane) and levels is not None:
        layers += _draw_levels(model.places, levels, model.unit)
    return layers


def _draw_antennas(name: str, places: Tensor) -> DisplayLayer:
    some = places[:: -(-len(places) // _MAX_ANTENNAS)]
    return DisplayLayer(name, "points", to_float32(some), color=ROLES[name])


def _draw_paths(
    scene: Scene, sensor: Transmitters, receivers: Tensor, settings: PropagationSettings
) -> list[DisplayLayer]:
    """Strongest paths to some receivers, by the last of the ``KINDS`` that they meet."""
    chosen = np.linspace(0, len(receivers) - 1, min(len(receivers), _MAX_RECEIVERS)).astype(int)
    places, ends = sensor.positions.detach(), receivers.detach()[chosen]
    few = replace(settings, edges=min(settings.edges, 1))
    with torch.no_grad():
        paths = few.trace_links(scene, sensor, ends, 0)
    kind = paths.kinds.amax(1) if paths.kinds.shape[1] else torch.zeros_like(paths.tx)
    power, group = paths.coefficient.abs().square().sum((1, 2)), len(KINDS) * paths.link + kind
    none = power.new_zeros(len(KINDS) * len(places) * len(ends))
    strongest = none.scatter_reduce(0, group, power, "amax")[group]
    paths = paths.select(power > _LEAST_SHARE * strongest)
    found: dict[int, list[Any]] = {}
    for tx, rx, met, at in zip(paths.tx, paths.rx, paths.kinds, paths.vertices, strict=True):
        points = torch.cat([places[tx][None], at[met > 0], ends[rx][None]])
        found.setdefault(int(met.max()) if len(met) else 0, []).append(join_points(points.numpy()))
    layers = list[DisplayLayer]()
    for kind, pairs in sorted(found.items()):
        name, points = f"paths: {KINDS[kind] or 'line of sight'}", to_float32(np.concatenate(pairs))
        layers.append(DisplayLayer(name, "lines", points, color=_PATH_COLORS[kind]))
    return layers


def _draw_levels(plane: MapPlane, levels: NDArray[np.float64], unit: str) -> list[DisplayLayer]:
    """Cells of a plane in bands of as many cells."""
    sides = torch.stack([plane.first, plane.second]) / torch.tensor(plane.count)[:, None]
    corners, known = plane.centres.reshape(-1, 1, 3) + _CORNERS @ sides, np.isfinite(levels.ravel())
    values = levels.ravel()[known]
    edges = np.quantile(values, np.linspace(0, 1, _BANDS + 1)) if len(values) else values
    return _draw_bands(LEVELS, to_float32(corners)[known], values, edges, unit)


def _draw_cells(panel: Metasurface, sensor: Transmitters) -> list[DisplayLayer]:
    """Cells of a metasurface in bands of their phase."""
    least = _PANEL_SHARE * float((sensor.positions - panel.position).detach().norm(dim=1).amax())
    scale = max(1.0, least / (panel.spacing * max(panel.phase.shape)))
    offsets = panel.cells.offsets[:, None] + _CELL_SHARE * panel.spacing * _CORNERS
    corners = panel.position + scale * offsets @ panel.axes[:, 1:].T
    phases = np.rad2deg(panel.response.detach().angle().numpy())
    return _draw_bands(PHASES, to_float32(corners), phases, np.linspace(-180, 180, _BANDS + 1), "°")


def _draw_bands(
    group: str, corners: NDArray[Any], values: NDArray[Any], edges: NDArray[Any], unit: str
) -> list[DisplayLayer]:
    """Cells [cell, 4, 3] by bands of values, the lowest first, which a slider hides."""
    from matplotlib import colormaps

    (colormap, opacity), layers = _BAND_LOOKS[group], list[DisplayLayer]()
    bands = np.digitize(values, edges[1:-1])
    for band in np.unique(bands):
        own = corners[bands == band]
        faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(own))[:, None, None]
        red, green, blue, _ = colormaps[colormap]((band + 0.5) / _BANDS, bytes=True)
        look = (int(red), int(green), int(blue)), opacity
        low, high = float(edges[band]), float(edges[band + 1])
        name = f"{group}/{low:.4g} to {high:.4g} {unit}"
        body = own.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32), *look
        layers.append(DisplayLayer(name, "surface", *body, band=(low, high), unit=unit))
    return layers
