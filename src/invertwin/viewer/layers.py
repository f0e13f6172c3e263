"""From scenes, radars and error bars to layers of a display."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from invertwin.capture import Capture
from invertwin.channel import Grid
from invertwin.radar import Radar
from invertwin.scene import Object, Scene, box
from invertwin.scene.shape_models.density import replace_clouds
from invertwin.viewer.display import Display, DisplayLayer, DisplayMesh

ROLES = {
    "fitted": (76, 120, 168),
    "fixed": (185, 190, 199),
    "truth": (192, 20, 60),
    "start": (224, 128, 60),
    "radar": (110, 120, 140),
    "transmitters": (214, 39, 40),
    "receivers": (31, 119, 180),
}
"""Colours of surfaces and antennas by what they are in a fit."""
# Layers of the present position: their names, their colours, and how large their points are.
SAMPLED_PATHS, VISIBLE_POINTS = "sampled paths", "what is seen"
BOUNDARY_POINTS, BIN_POINTS = "boundary paths", "chosen bin"
POSITION_LAYERS: dict[str, tuple[tuple[int, int, int], float]] = {
    SAMPLED_PATHS: ((120, 170, 220), 1.0),
    VISIBLE_POINTS: ((30, 140, 90), 0.4),
    BOUNDARY_POINTS: ((200, 40, 160), 0.7),
    BIN_POINTS: ((255, 220, 0), 1.5),
}
ELLIPSOID = "95 % ellipsoid"
LEVELS = "levels"
"""Group of the bands of a map of levels, each named by its lowest and its highest level."""
_MAX_BEAMS, _MAX_BOARDS = 6, 64  # positions whose beams, and whose boards are drawn
_BOARD_SIDE = 0.06  # of a board [m]
_BOARD_SHARES = 0.04, 0.15  # of the beams: least and largest side of a drawn board
_CIRCLE_POINTS = 32  # corners of an ellipsoid's circles
_CHI_SQUARED_95 = 7.815  # squared radius of the ellipsoid that holds 95 % of a normal law in space


def to_float32(values: Any) -> NDArray[np.float32]:
    """Numbers as the graphics card takes them.

    Args:
        values: A tensor or an array.
    """
    return np.ascontiguousarray(torch.as_tensor(values).detach().cpu().numpy(), np.float32)


def to_int32(faces: torch.Tensor) -> NDArray[np.int32]:
    """Corners of triangles as the graphics card takes them.

    Args:
        faces: Numbers of vertices [t, 3].
    """
    return np.ascontiguousarray(faces.cpu().numpy(), np.int32)


def display_mesh(item: Object) -> DisplayMesh:
    """The surface of an object in the world.

    Args:
        item: The object.
    """
    return DisplayMesh(to_float32(item.vertices), to_int32(item.mesh.faces))


def scene_layers(
    scene: Scene, group: str = "twin", *, fitted: Collection[str] = (), fitted_only: bool = False
) -> list[DisplayLayer]:
    """The surfaces of a scene.

    Args:
        scene: What is shown.
        group: Of the layers, such as "twin".
        fitted: Names of objects that are coloured.
        fitted_only: Leave the others out.
    """
    layers, opacity = [], 0.35 if group in ROLES else 1.0
    for name, item in replace_clouds(scene).objects.items():
        if name in fitted or not fitted_only:
            body, of = display_mesh(item), f"{group}/{name}"
            color = ROLES.get(group, ROLES["fitted" if name in fitted else "fixed"])
            look = color, opacity, group != "start"
            layers.append(DisplayLayer(of, "surface", body.vertices, body.faces, *look))
    return layers


def radar_layers(
    radar: Radar, grid: Grid | None, length: float, name: str = ""
) -> list[DisplayLayer]:
    """Positions of a radar, its board, and the pyramid that its map covers from some of them.

    Args:
        radar: The radar.
        grid: Bins of the map; None = half of all directions.
        length: Of the beams [m].
        name: Of the radar, where there are several.
    """
    places, axes = radar.positions.detach(), radar.link().rotations.detach()
    spread = (np.linspace(0, len(places) - 1, most) for most in (_MAX_BEAMS, _MAX_BOARDS))
    chosen, boarded = (np.unique(numbers.astype(int)) for numbers in spread)
    side = min(max(_BOARD_SIDE, _BOARD_SHARES[0] * length), _BOARD_SHARES[1] * length)
    board = box([0.1 * side, side, 0.75 * side])
    corners = places[boarded, None] + board.vertices @ axes[boarded].mT
    faces = torch.cat([board.faces + k * len(board.vertices) for k in range(len(boarded))])
    u = torch.tensor([-1.0, 1.0, 1.0, -1.0]).double() * _largest_cosine(grid and grid.u)
    v = torch.tensor([-1.0, -1.0, 1.0, 1.0]).double() * _largest_cosine(grid and grid.v)
    w = (1 - u.square() - v.square()).clamp_min(0.0).sqrt()
    rays = torch.stack([w, u, v], dim=1) * length
    lines = []
    for k in chosen:
        ends = places[k] + rays @ axes[k].T
        sides = torch.stack([places[k].expand(4, 3), ends], dim=1)
        lines += [sides.reshape(-1, 3), torch.stack([ends, ends.roll(-1, 0)], 1).reshape(-1, 3)]
    of, is_alone = f"/{name}" if name else "", not name and len(places) == 1
    beams, boards = to_float32(torch.cat(lines)), to_float32(corners.reshape(-1, 3))
    return [
        DisplayLayer(f"radar{of}", "points", to_float32(places), color=ROLES["radar"]),
        DisplayLayer(f"beams{of}", "lines", beams, color=(150, 150, 160), shown=is_alone),
        DisplayLayer(f"boards{of}", "surface", boards, to_int32(faces), ROLES["radar"]),
    ]


def _largest_cosine(cosines: torch.Tensor | None) -> float:
    """The largest direction cosine that is covered, short of the side."""
    if cosines is None or len(cosines) < 2:
        return 0.5
    return min(float(cosines.abs().max()), math.sqrt(0.45))


def capture_layers(capture: Capture) -> list[DisplayLayer]:
    """Surveyed targets of a capture, and the track of its radar.

    Args:
        capture: The capture.
    """
    layers = []
    if capture.survey is not None:
        points = to_float32(capture.survey)
        layers.append(DisplayLayer("surveyed targets", "points", points, color=ROLES["truth"]))
    if capture.track is not None:
        places = to_float32(capture.track.positions)
        layers.append(DisplayLayer("track", "lines", join_points(places), color=ROLES["radar"]))
    return layers


def ellipsoid_layers(scene: Scene, metrics: Mapping[str, Any]) -> list[DisplayLayer]:
    """Build 95 % confidence ellipsoids of the centres of fitted objects, as three circles each.

    A coordinate without an error bar has none here either: the ellipsoid is flat along it.

    Args:
        scene: The twin.
        metrics: ``standard_deviations`` by coordinate and their ``correlations``.
    """
    deviations: Mapping[str, float] = metrics.get("standard_deviations", {})
    names, layers = list(deviations), []
    correlations = torch.as_tensor(metrics.get("correlations", [])).double().numpy()
    for name in scene.names:
        own = {k: f"{name}.{c}" for k, c in enumerate("xyz") if f"{name}.{c}" in deviations}
        if not own:
            continue
        axes, rows = [*own], [names.index(one) for one in own.values()]
        scale = np.array([deviations[one] for one in own.values()])
        covariance = np.zeros((3, 3))
        covariance[np.ix_(axes, axes)] = np.outer(scale, scale) * correlations[np.ix_(rows, rows)]
        sizes, axes = np.linalg.eigh(covariance)
        radii = axes * np.sqrt(_CHI_SQUARED_95 * sizes.clip(0))
        turn = np.linspace(0, 2 * math.pi, _CIRCLE_POINTS + 1)
        circle = np.stack([np.cos(turn), np.sin(turn)])
        rings = [(radii[:, [i, j]] @ circle).T for i, j in ((0, 1), (1, 2), (0, 2))]
        pairs = np.concatenate([join_points(ring) for ring in rings])
        points = to_float32(pairs) + to_float32(scene[name].center)
        layers.append(DisplayLayer(f"{ELLIPSOID}/{name}", "lines", points, color=(230, 160, 0)))
    return layers


def build_display(
    scene: Scene | None,
    radars: Mapping[str, tuple[Radar, Grid | None]],
    title: str,
    *,
    truth: Scene | None = None,
    fitted: Sequence[str] = (),
) -> Display:
    """A display of a scene and of what looks at it.

    Args:
        scene: What there is; None = nothing known.
        radars: With the bins of their maps, by name.
        title: Of the window.
        truth: The scene as it really is, of which what is fitted is shown.
        fitted: Names of objects that are coloured.
    """
    layers = [] if scene is None else scene_layers(scene, fitted=fitted)
    if truth is not None:
        layers += scene_layers(truth, "truth", fitted=fitted, fitted_only=True)
    places = [to_float32(radar.positions) for radar, _ in radars.values()]
    length = 1.0
    if layers and places:
        middle = np.concatenate([x.points for x in layers]).mean(0)
        length = float(np.linalg.norm(np.concatenate(places).mean(0) - middle))
    up, ahead = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    for name, (radar, grid) in radars.items():
        layers += radar_layers(radar, grid, length, name)
    for radar, _ in list(radars.values())[:1]:
        axes = radar.link().rotations.detach().mean(0)
        up, ahead = _unit_vector(axes[:, 2], up), _unit_vector(axes[:, 0], ahead)
    return Display(title, layers, up=up, ahead=ahead)


def join_points(points: NDArray[Any]) -> NDArray[Any]:
    """Return both ends of each piece of the line through some points, one after the other.

    Args:
        points: [point, 3], m.
    """
    return np.stack([points[:-1], points[1:]], axis=1).reshape(-1, 3)


def _unit_vector(
    vector: torch.Tensor, default: tuple[float, float, float]
) -> tuple[float, float, float]:
    """The direction of a mean axis; the default, where the axes cancel."""
    length = float(vector.norm())
    if length < 0.1:
        return default
    x, y, z = (vector / length).tolist()
    return x, y, z
