"""A display on a page that stands alone: no server, no network, nothing of names that acts.

Pages cannot trace: they hold the maps of every sensor at every step, and what links them.
"""

import base64
import hashlib
import html
import json
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from string import Template
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from invertwin.errors import InputError, PhysicsWarning
from invertwin.viewer import panels
from invertwin.viewer.display import Display, DisplayStep
from invertwin.viewer.layers import ELLIPSOID, POSITION_LAYERS, SAMPLED_PATHS, to_float32
from invertwin.viewer.link import InteractiveSensor
from invertwin.viewer.surroundings import open_walls

_MAX_MAPS = 144  # simulated ones of a page, over sensors, steps and positions
_MAX_FRAMES = 8  # positions of a sensor
_MAX_BINS = 96  # of a map along range, and across


@dataclass(frozen=True, eq=False)
class SensorMaps:
    """Maps of one sensor on a page.

    Attributes:
        frames: Numbers of its positions.
        grid: Middle of the first bin and distance of the bins, of range [m] and of u.
        positions: positions of the radar [frame, 3], m; none where nothing links maps to them.
        rotations: Columns are the radar's axes, [frame, 3, 3].
        origins: Range from which each position counts its own [m].
        measured: Power [frame, range, u], if there is any.
        simulated: Power [step, frame, range, u], if there is any; without steps one of the scene.
    """

    frames: list[int]
    grid: tuple[float, float, float, float]
    positions: NDArray[np.float32]
    rotations: NDArray[np.float32]
    origins: NDArray[np.float32]
    measured: NDArray[np.float32] | None
    simulated: NDArray[np.float32] | None


def collect_sensor_maps(
    display: Display, sensors: Mapping[str, InteractiveSensor]
) -> dict[str, SensorMaps]:
    """Maps of all sensors at some of their positions, by the name of the sensor.

    The links are left with the bodies of the last step.

    Args:
        display: With its steps and with what was measured.
        sensors: The forward model of each sensor.
    """
    names = list(dict.fromkeys([*display.maps, *sensors]))
    count = _MAX_MAPS // (max(1, len(display.steps)) * max(1, len(names)))
    count = min(max(1, count), _MAX_FRAMES)
    found = {name: _collect_maps(display, name, sensors.get(name), count) for name in names}
    return {k: x for k, x in found.items() if x.measured is not None or x.simulated is not None}


def _collect_maps(
    display: Display, name: str, sensor: InteractiveSensor | None, count: int
) -> SensorMaps:
    known = display.maps.get(name)
    own = known or sensor
    assert own is not None
    frames, ranges, across = own.frames, own.ranges, own.across
    chosen = np.unique(np.linspace(0, len(frames) - 1, count).astype(int)).tolist()
    frames = [frames[k] for k in chosen]
    blocks = [-(-len(axis) // _MAX_BINS) for axis in (ranges, across)]

    def max_pool(power: Tensor) -> NDArray[np.float32]:
        """The strongest of each block of bins."""
        flat = power.reshape(-1, 1, *power.shape[-2:])
        pooled = torch.nn.functional.max_pool2d(flat, blocks, ceil_mode=True)
        return to_float32(pooled.reshape(*power.shape[:-2], *pooled.shape[-2:]))

    measured = None
    if known is not None and panels.MEASURED in known.power:
        measured = max_pool(torch.from_numpy(known.power[panels.MEASURED][chosen]))
    simulated = None if sensor is None else _simulate_maps(display, sensor, frames)
    poses: tuple[Any, ...] = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)
    if sensor is not None:
        radar = sensor.radar.frames(frames)
        poses = radar.positions, radar.link().rotations, radar.origins
    axes = (*_block_axis(ranges, blocks[0]), *_block_axis(across, blocks[1]))
    pooled = None if simulated is None else max_pool(simulated)
    place, turn, origin = map(to_float32, poses)
    return SensorMaps(frames, axes, place, turn, origin, measured, pooled)


def _simulate_maps(display: Display, sensor: InteractiveSensor, frames: list[int]) -> Tensor | None:
    """Power [step, frame, range, u]; None for scenes that have no smooth map."""
    found = []
    with warnings.catch_warnings(), suppress(InputError):
        warnings.simplefilter("ignore", PhysicsWarning)  # of bins that are coarse for a fit
        for step in display.steps or [None]:
            if step is not None:
                sensor.replace_meshes(step.bodies)
            maps = [sensor.predict_map(sensor.scene, frame).float() for frame in frames]
            found.append(torch.stack(maps))
    return None if len(found) < max(1, len(display.steps)) else torch.stack(found)


def _block_axis(centers: list[float], block: int) -> tuple[float, float]:
    """Middle of the first block of bins, and the distance of blocks."""
    step = centers[1] - centers[0] if len(centers) > 1 else 1.0
    return centers[0] + (block - 1) / 2 * step, block * step


_MAX_BYTES = 1_500_000  # of the steps on a page


def page_html(display: Display, sensors: Mapping[str, InteractiveSensor] | None = None) -> str:
    """A whole page with a display.

    Args:
        display: What is shown.
        sensors: As of `view_html`.
    """
    parts = {"title": html.escape(display.title), "policy": content_security_policy()}
    return Template(_resource("document.html")).substitute(parts, view=view_html(display, sensors))


def view_html(display: Display, sensors: Mapping[str, InteractiveSensor] | None = None) -> str:
    """A display as a part of a page; one page may hold it once.

    Of many steps it keeps as many as fit into 1.5 MB, evenly chosen, the last one among them.

    Args:
        display: What is shown.
        sensors: The forward model of each sensor, by its name: the page has the maps that it
            simulates at every step, and says which points feed a bin. None shows what was
            measured alone.
    """
    faces, walls = {x.name: x.faces for x in display.layers}, open_walls(display)

    def pack_step(step: DisplayStep) -> dict[str, Any]:
        bodies = {
            # Triangles are mostly those of the layer.
            f"twin/{name}": _encode_mesh(
                body.vertices,
                None if np.array_equal(body.faces, faces[f"twin/{name}"]) else body.faces,
            )
            for name, body in step.bodies.items()
        }
        return {"label": step.label, "bodies": bodies}

    size = sum(len(json.dumps(pack_step(step))) for step in display.steps[-1:])
    count = max(2, min(len(display.steps), _MAX_BYTES // max(size, 1)))
    chosen = np.unique(np.linspace(0, len(display.steps) - 1, count).astype(int))
    kept = [display.steps[k] for k in chosen] if display.steps else []
    maps = collect_sensor_maps(replace(display, steps=kept), sensors or {})
    data = {
        "up": display.up,
        "ahead": display.sight,
        "box": [corner.tolist() for corner in display.box],
        "layers": [
            # An ellipsoid is inside of its object, and seen through it.
            vars(layer)
            | {"group": layer.group, "through": layer.group == ELLIPSOID}
            | {"wall": layer.name in walls}
            | _encode_mesh(layer.points, walls.get(layer.name, layer.faces))
            for layer in display.layers
        ],
        "steps": [pack_step(step) for step in kept],
        "initial_step": 0 if display.shows_start else len(kept) - 1,
        "sensors": [_sensor_data(name, own) for name, own in maps.items()],
        "position": [
            {"name": name, "color": color, "size": size, "shown": name != SAMPLED_PATHS}
            for name, (color, size) in POSITION_LAYERS.items()
        ],
        "pictures": {name: name for name in (panels.MEASURED, panels.SIMULATED, panels.RESIDUAL)},
        "colors": dict(zip(("power", "apart"), map(_colormap, panels.COLORMAPS), strict=True)),
        "depth": -panels.MIN_LEVEL_DB,
        "largest": panels.MAX_RESIDUAL_DB,
    }
    # The only character that could end the element.
    text = json.dumps(data).replace("<", "\\u003c")
    return (
        f'<div id="view">{_resource("page.html")}</div>\n'
        f'<script type="application/json" id="view-data">{text}</script>\n'
        f"<script>{_script()}</script>\n"
    )


def content_security_policy() -> str:
    """Return the policy of a page with a display: it runs our script alone and loads nothing."""
    digest = base64.b64encode(hashlib.sha256(_script().encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
        "img-src data:"
    )


def _sensor_data(name: str, maps: SensorMaps) -> dict[str, Any]:
    """Maps of a sensor, each value one byte: 255 is the peak of its map, 0 the darkest."""

    def pack_power(power: NDArray[np.float32]) -> str:
        levels = 255 * (1 - panels.relative_decibels(power) / panels.MIN_LEVEL_DB)
        return _base64(np.rint(levels).astype(np.uint8))

    some = maps.measured if maps.simulated is None else maps.simulated
    assert some is not None
    return {
        "name": name,
        "frames": maps.frames,
        "grid": maps.grid,
        "shape": some.shape[-2:],
        "places": maps.positions.tolist(),
        "rotations": maps.rotations.tolist(),
        "origins": maps.origins.tolist(),
        "measured": None if maps.measured is None else pack_power(maps.measured),
        "simulated": None if maps.simulated is None else [pack_power(x) for x in maps.simulated],
    }


def _colormap(name: str) -> str:
    """A colour map as 256 times red, green and blue."""
    from matplotlib import colormaps

    return _base64(colormaps[name](np.arange(256), bytes=True)[:, :3])


def _base64(array: NDArray[Any]) -> str:
    """Bytes of an array, as base64."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _encode_mesh(points: NDArray[Any], faces: NDArray[Any] | None) -> dict[str, str]:
    """Numbers in little-endian order, as base64."""
    found = {"points": _base64(points.astype("<f4"))}
    return found if faces is None else found | {"faces": _base64(faces.astype("<u4"))}


@cache
def _resource(name: str) -> str:
    return (resources.files("invertwin.viewer") / name).read_text(encoding="utf-8")


def _script() -> str:
    return _resource("sight.js") + _resource("page.js")
