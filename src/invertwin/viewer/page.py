"""A display on a page that stands alone: no server, no network, nothing of names that acts."""

import base64
import hashlib
import html
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invertwin.deprecation import rename_arguments
from invertwin.viewer.display import Display, DisplayStep
from invertwin.viewer.layers import ELLIPSOID, POSITION_LAYERS, SAMPLED_PATHS
from invertwin.viewer.link import InteractiveSensor
from invertwin.viewer.panels import (
    MAX_RESIDUAL_DB,
    MEASURED,
    MIN_LEVEL_DB,
    POWER_COLORMAP,
    RESIDUAL,
    RESIDUAL_COLORMAP,
    SIMULATED,
    relative_decibels,
)
from invertwin.viewer.sensor_maps import SensorMaps, collect_sensor_maps

_MAX_BYTES = 1_500_000  # of the steps on a page


@rename_arguments(links="sensors")
def page_html(display: Display, sensors: Mapping[str, InteractiveSensor] | None = None) -> str:
    """A whole page with a display.

    Args:
        display: What is shown.
        sensors: As of `view_html`.
    """
    title = html.escape(display.title)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{content_security_policy()}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>:root {{ color-scheme: light dark; }} "
        "body { font: 15px/1.5 system-ui, sans-serif; margin: 1rem; }</style></head>\n"
        f"<body><h1>{title}</h1>\n{view_html(display, sensors)}</body></html>\n"
    )


@rename_arguments(links="sensors")
def view_html(display: Display, sensors: Mapping[str, InteractiveSensor] | None = None) -> str:
    """A display as a part of a page; one page may hold it once.

    Of many steps it keeps as many as fit into 1.5 MB, evenly chosen, the last one among them.

    Args:
        display: What is shown.
        sensors: The forward model of each sensor, by its name: the page has the maps that it
            simulates at every step, and says which points feed a bin. None shows what was
            measured alone.
    """
    faces = {x.name.removeprefix("twin/"): x.faces for x in display.layers}

    def pack_step(step: DisplayStep) -> dict[str, Any]:
        bodies = {
            # Triangles are mostly those of the layer.
            f"twin/{name}": _encode_mesh(
                body.vertices, None if np.array_equal(body.faces, faces[name]) else body.faces
            )
            for name, body in step.bodies.items()
        }
        return {"label": step.label, "bodies": bodies}

    size = sum(len(json.dumps(pack_step(step))) for step in display.steps[-1:])
    count = max(2, min(len(display.steps), _MAX_BYTES // max(size, 1)))
    chosen = np.unique(np.linspace(0, len(display.steps) - 1, count).astype(int))
    kept = [display.steps[k] for k in chosen] if display.steps else []
    maps = collect_sensor_maps(replace(display, steps=kept), sensors or {})
    low, high = display.box
    data = {
        "up": display.up,
        "ahead": display.ahead,
        "box": [low.tolist(), high.tolist()],
        "layers": [
            # An ellipsoid is inside of its object, and seen through it.
            vars(layer)
            | {"group": layer.group, "through": layer.group == ELLIPSOID}
            | _encode_mesh(layer.points, layer.faces)
            for layer in display.layers
        ],
        "steps": [pack_step(step) for step in kept],
        "sensors": [_sensor_data(name, own) for name, own in maps.items()],
        "position": [
            {"name": name, "color": color, "size": size, "shown": name != SAMPLED_PATHS}
            for name, (color, size) in POSITION_LAYERS.items()
        ],
        "pictures": {"measured": MEASURED, "simulated": SIMULATED, "residual": RESIDUAL},
        "colors": {"power": _colormap(POWER_COLORMAP), "apart": _colormap(RESIDUAL_COLORMAP)},
        "depth": -MIN_LEVEL_DB,
        "largest": MAX_RESIDUAL_DB,
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
        levels = 255 * (1 - relative_decibels(power) / MIN_LEVEL_DB)
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
