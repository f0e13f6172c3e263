"""A display on a page that stands alone: no server, no network, nothing of names that acts."""

import base64
import hashlib
import html
import json
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invertwin.viewer.display import Display, Step

_MOST_BYTES = 1_500_000  # of the steps on a page


def page_html(display: Display) -> str:
    """A whole page with a display.

    Args:
        display: What is shown.
    """
    title = html.escape(display.title)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy()}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>body {{ font: 15px/1.5 system-ui, sans-serif; margin: 1rem; "
        "color-scheme: light dark; }</style></head>\n"
        f"<body><h1>{title}</h1>\n{view_html(display)}</body></html>\n"
    )


def view_html(display: Display) -> str:
    """A display as a part of a page; one page may hold it once.

    Of many steps it keeps as many as fit into 1.5 MB, evenly chosen, the last one among them.

    Args:
        display: What is shown.
    """
    faces = {x.name.removeprefix("twin/"): x.faces for x in display.layers}

    def packed(step: Step) -> dict[str, Any]:
        bodies = {
            # Triangles are mostly those of the layer.
            f"twin/{name}": _arrays(
                body.vertices, None if np.array_equal(body.faces, faces[name]) else body.faces
            )
            for name, body in step.bodies.items()
        }
        return {"label": step.label, "bodies": bodies}

    size = sum(len(json.dumps(packed(step))) for step in display.steps[-1:])
    count = max(2, min(len(display.steps), _MOST_BYTES // max(size, 1)))
    chosen = np.unique(np.linspace(0, len(display.steps) - 1, count).astype(int))
    steps = [packed(display.steps[k]) for k in chosen] if display.steps else []
    low, high = display.box
    data = {
        "up": display.up,
        "ahead": display.ahead,
        "box": [low.tolist(), high.tolist()],
        "layers": [
            {
                "name": layer.name,
                "group": layer.group,
                "kind": layer.kind,
                "color": layer.color,
                "opacity": layer.opacity,
                "shown": layer.shown,
                **_arrays(layer.points, layer.faces),
            }
            for layer in display.layers
        ],
        "steps": steps,
    }
    # The only character that could end the element.
    text = json.dumps(data).replace("<", "\\u003c")
    return (
        f'<div id="view">{_resource("page.html")}</div>\n'
        f'<script type="application/json" id="view-data">{text}</script>\n'
        f"<script>{_script()}</script>\n"
    )


def policy() -> str:
    """What a page with a display may do: run our script alone, and load nothing."""
    digest = base64.b64encode(hashlib.sha256(_script().encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
        "img-src data:"
    )


def _arrays(points: NDArray[Any], faces: NDArray[Any] | None) -> dict[str, str]:
    """Numbers in little-endian order, as base64."""
    found = {"points": points.astype("<f4")} | (
        {} if faces is None else {"faces": faces.astype("<u4")}
    )
    return {name: base64.b64encode(array.tobytes()).decode() for name, array in found.items()}


@cache
def _resource(name: str) -> str:
    return (resources.files("invertwin.viewer") / name).read_text(encoding="utf-8")


def _script() -> str:
    return _resource("page.js")
