"""Surroundings of a scene in the window: ground with metres, first camera, legend, walls."""

from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invertwin.viewer.display import SCENE_GROUPS, Display, DisplayLayer
from invertwin.viewer.layers import LEVELS, ROLES

_TICKS = 6  # of the ground along its longer side, about
_ELEVATION = np.deg2rad(28.0)  # of the first camera above the sight of the radar
_ASIDE = np.deg2rad(12.0)  # of the first camera from the sight of the radar
_FIELD_OF_VIEW = np.deg2rad(50.0)  # of the first camera, from below to above
_USED_TANGENT = 0.85 * np.tan(_FIELD_OF_VIEW / 2)  # of its half height, and its half width
_PANEL_SHARE = 0.55  # of half the height by which a phone's scene stands above the middle
_WHOLE = 'style="display: inline-block; margin-right: 1em"'  # squares stay beside the name
_WALL_SHARE = 0.6  # of the scene's sides that a wall spans
_FLAT_SHARE = 0.1  # of a wall's length: its thickness


def draw_ground(scene: Any, display: Display) -> None:
    """Draw a grid below the scene, with metres along two sides.

    Args:
        scene: That of a viser server.
        display: What is shown.
    """
    up = int(np.abs(display.up).argmax())
    across = [axis for axis in range(3) if axis != up]
    points = _framed_points(display)
    low, high = points.min(0).astype(float), points.max(0).astype(float)
    cell = _round_step(float((high - low)[across].max()) / _TICKS)
    start, count = cell * np.floor(low / cell), np.ceil(high / cell) - np.floor(low / cell)
    count = np.maximum(count + count % 2, 2)  # the lines of viser begin at the middle
    middle = start + 0.5 * cell * count
    sign = np.sign(display.up[up])
    middle[up] = display.box[0 if sign > 0 else 1][up] - 1e-3 * cell * sign  # below floors
    plane, sides = "".join("xyz"[axis] for axis in across), (cell * count[across]).tolist()
    lines = {"plane": plane, "cell_size": cell, "section_size": cell}
    scene.add_grid("/ground", *sides, position=tuple(middle), **lines)
    # Labels stand on the sides towards the camera, where no object is before them.
    steps = np.where(_first_sight(display) > 0, 1, -1)
    corner = middle - 0.5 * cell * count * steps
    for axis, other, name in zip(across, across[::-1], plane, strict=True):
        for number in range(1, int(count[axis]) + 1):
            place = middle.copy()
            place[axis], place[other] = corner[axis] + number * cell * steps[axis], corner[other]
            text = f"{round(place[axis], 6):g}" if number < count[axis] else f"{name} [m]"
            scene.add_label(f"/ground/{name}{number}", text, position=tuple(place))


def _first_sight(display: Display) -> NDArray[np.float64]:
    """Direction in which the first camera looks."""
    up, ahead = np.array(display.up), np.array(display.sight)
    level = np.cos(_ASIDE) * ahead - np.sin(_ASIDE) * np.cross(up, ahead)
    return np.cos(_ELEVATION) * level - np.sin(_ELEVATION) * up


def set_camera(camera: Any, display: Display, aspect: float = 1.6) -> None:
    """Put the first camera behind and above the radar, so that it sees the radar and the scene.

    Args:
        camera: The first one of a viser server.
        display: What is shown.
        aspect: Width of the window over its height; below 1, as on a phone, the scene is in the
            upper part, above the panel.
    """
    up, sight = np.array(display.up), _first_sight(display)
    right = np.cross(sight, up) / np.linalg.norm(np.cross(sight, up))
    points = _framed_points(display)
    middle = 0.5 * (points.min(0) + points.max(0)).astype(float)
    away = points - middle
    above = np.cross(right, sight)
    # On narrow screens names of objects stand in the margin.
    aside = np.maximum(np.abs(away @ right) / min(0.85 * aspect, 1.0), np.abs(away @ above))
    distance = float((aside / _USED_TANGENT - away @ sight).max()) or 1.0
    camera.fov, camera.near, camera.far = _FIELD_OF_VIEW, 1e-3 * distance, 1e2 * distance
    middle -= (distance * _USED_TANGENT * _PANEL_SHARE if aspect < 1 else 0.0) * above
    camera.up, camera.position = up, middle - distance * sight
    camera.look_at = middle  # the last: that of a client moves with its position


def legend_html(display: Display) -> str:
    """A legend of the colours of layers, with a style that hides what viser says without a GPU.

    Args:
        display: What is shown.
    """
    roles, keys = {color: role for role, color in ROLES.items()}, dict[str, list[DisplayLayer]]()
    for x in display.layers:
        name = roles.get(x.color, "fixed") if x.group in (*SCENE_GROUPS, "boards") else x.group
        keys.setdefault(name, []).append(x)
    rows = list[str]()
    for name, own in keys.items():
        marks = "".join({f'<span style="color: rgb{x.color}">■</span>': None for x in own})
        row = f"{marks} {escape(name)}"
        bands = [x.band for x in own if x.band and name == LEVELS]
        if len(bands) > 1:  # the lowest band has no power in some cells
            strip = f'<span style="letter-spacing: -0.3em">{marks}</span>&ensp;'
            row = f"{bands[0][1]:.3g} {strip}{bands[-1][0]:.3g} {escape(own[-1].unit)}"
        rows.append(f"<span {_WHOLE}>{row}</span>")
    # On phones viser has letters of 10 pixels.
    style = "#webgl-software-rendering { display: none } html { font-size: 14.8px !important }"
    return f'<style>{style}</style><div style="padding: 0.3em 1em">{" ".join(rows)}</div>'


def open_walls(display: Display) -> dict[str, NDArray[np.int32]]:
    """Return the triangles of walls, turned towards the scene, by the name of the layer.

    Who stands behind a wall then sees through it.

    Args:
        display: What is shown.
    """
    low, high = display.box
    middle, found = _framed_points(display).mean(0), dict[str, NDArray[np.int32]]()
    drawn = [layer for layer in display.layers if len(layer.points)]
    fixed = [x for x in drawn if x.kind == "surface" and x.color == ROLES["fixed"]]
    for layer in fixed if len(drawn) > 1 else []:
        least, most = layer.points.min(0), layer.points.max(0)
        spans = np.linalg.svd(layer.points - layer.points.mean(0), compute_uv=False)
        inside = (((x.points > least) & (x.points < most)).all() for x in drawn if x is not layer)
        is_room = spans[-1] < _FLAT_SHARE * spans[0] or any(inside)
        if is_room and (most - least < _WALL_SHARE * (high - low)).sum() < 2:
            first, second, third = layer.points[layer.faces].transpose(1, 0, 2)
            normal = np.cross(second - first, third - first)
            turned = (normal * (middle - first)).sum(1, keepdims=True) < 0
            found[layer.name] = np.where(turned, layer.faces[:, [0, 2, 1]], layer.faces)
    return found


def _framed_points(display: Display) -> NDArray[np.float32]:
    """Points of all that is to be in the first picture."""
    layers = [layer for layer in display.layers if layer.shown and len(layer.points)]
    return np.concatenate([x.points for x in layers] or [np.zeros((1, 3), np.float32)])


def _round_step(length: float) -> float:
    """Return 1, 2 or 5 times a power of ten, from a length upwards."""
    power = 10.0 ** np.floor(np.log10(max(length, 1e-6)))
    return float(next(k * power for k in (1, 2, 5, 10) if k * power >= 0.999 * length))
