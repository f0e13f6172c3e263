"""A display in the browser that answers: `viser` draws, one thread of ours traces rays."""

import io
import math
import socket
import threading
import time
from collections.abc import Mapping
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from invertwin.errors import import_optional, to_one_line
from invertwin.scene import rigid, rotation_from_quaternion
from invertwin.viewer import layers, surroundings
from invertwin.viewer.display import Display, DisplayLayer, DisplayMaps, DisplayStep
from invertwin.viewer.guard import LOOPBACK, AccessGuard, install_guard
from invertwin.viewer.layers import POSITION_LAYERS, SAMPLED_PATHS, to_float32
from invertwin.viewer.link import InteractiveSensor, PositionSample
from invertwin.viewer.panels import MEASURED, RESIDUAL, SIMULATED, MapPanels

_NO_OBJECT = "nothing"
_NO_MAPS = "none: a run file with [radar] and [grid], or a capture with samples, has maps"
_CURSOR = ("cursor: range", "cursor: azimuth")
_MANY_LAYERS = 12  # of which the list is closed at first
_PLAY_INTERVAL = 0.2  # seconds, from step to step
_MAX_PATHS = 100  # rays that are drawn
_IDENTITY = torch.eye(4, dtype=torch.float64)
_SETTLE_TIME = 0.4  # seconds after which nothing moves


@dataclass
class _ViewerState:
    """Choices of the person at the viewer."""

    step: int
    sensor: str
    frame: int = 0
    moved_object: str = _NO_OBJECT
    motion: torch.Tensor = _IDENTITY  # of the moved object, world to world
    bin: tuple[int, int] | None = None


class Viewer:
    """A display that a browser shows, until it is closed.

    It listens on this machine alone. Elsewhere it needs a token, which is part of its address.

    Args:
        display: What is shown.
        sensors: Of each sensor by its name: let people move objects, and show maps and paths.
            None = it only shows.
        host: Where it listens.
        port: The first one that is tried.
        token: See ``AccessGuard``.

    Attributes:
        address: What to open in a browser.

    Raises:
        InputError: No `viser`, or a host without a token.
    """

    def __init__(
        self,
        display: Display,
        sensors: Mapping[str, InteractiveSensor] | None = None,
        *,
        host: str = LOOPBACK,
        port: int = 8080,
        token: str | None = None,
    ) -> None:
        self._server = _start_server(AccessGuard(host, token), host, port)
        query = "" if token is None else f"/?token={token}"
        # A host that means every address of this machine is none that a browser could open.
        reached = socket.gethostname() if host in ("0.0.0.0", "::") else host
        named = f"[{reached}]" if ":" in reached else reached
        self.address = f"http://{named}:{self._server.get_port()}{query}"
        self._links, self._steps = dict(sensors or {}), list(display.steps)
        self._display = display
        self._lock, self._due, self._closed = threading.Lock(), threading.Event(), False
        self._sensors = list(dict.fromkeys([*display.maps, *self._links]))
        begun = 0 if display.shows_start else len(self._steps) - 1
        self._wish = _ViewerState(step=begun, sensor=next(iter(self._sensors), ""))
        # What sensors see at steps as they come.
        self._found: dict[int, Mapping[str, DisplayMaps]] = {}
        self._taken: int | None = None  # the step whose bodies the link has
        self._nodes: dict[str, Any] = {}
        self._labels: dict[str, Any] = {}
        self._hidden: set[str] = set()  # bands below the lowest level
        self._walls = surroundings.open_walls(display)
        self._visible = display.groups | {x: x != SAMPLED_PATHS for x in POSITION_LAYERS if sensors}
        self._build_window()
        self._worker = threading.Thread(target=self._run_worker, daemon=True)
        self._worker.start()
        self._due.set()

    def add_step(self, step: DisplayStep, maps: Mapping[str, DisplayMaps] | None = None) -> None:
        """Show a further step of a fit that goes on; who looks at the last one follows.

        Args:
            step: The step.
            maps: Of sensors at this step, in place of those of the display.
        """
        with self._lock:
            follows = self._wish.step == len(self._steps) - 1
            self._found[len(self._steps)] = maps or {}
            self._steps.append(step)
        self._step.max = max(1, len(self._steps) - 1)
        self._step.visible = len(self._steps) > 1
        if follows:
            self._step.value = len(self._steps) - 1
            self._update_state(step=len(self._steps) - 1)

    def wait(self) -> None:
        """Return when the viewer is closed; Ctrl-C closes it."""
        try:
            while not self._closed:
                time.sleep(0.2)
        finally:
            self.close()

    def close(self) -> None:
        """Stop listening."""
        if not self._closed:
            self._closed = True
            self._due.set()
            self._worker.join()
            with redirect_stdout(io.StringIO()):
                self._server.stop()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _update_state(self, **changes: Any) -> None:
        """Note what the person wants; the worker takes the latest."""
        with self._lock:
            self._wish = replace(self._wish, **changes)
        self._due.set()

    def _build_window(self) -> None:
        """Put everything into the window."""
        display, gui, scene = self._display, self._server.gui, self._server.scene
        scene.set_up_direction(display.up)
        # Shadows and mirrored surroundings tell nothing here, and halve the rate without a GPU.
        scene.configure_default_lights(cast_shadow=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/light", intensity=1.2)
        gui.set_panel_label("invertwin")
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        # Texts of fields are shown as they are; markdown would run what names hold.
        gui.add_text("shown", display.title, disabled=True)
        if display.answer:
            gui.add_text("found", display.answer, multiline=True, disabled=True)
        last, several = len(self._steps) - 1, len(self._steps) > 1
        self._where = gui.add_text("state", "", disabled=True, visible=several)
        begun = max(0, self._wish.step)
        self._step = gui.add_slider("step", 0, max(1, last), 1, begun, visible=several)
        self._step.on_update(lambda _: self._update_state(step=int(self._step.value)))
        self._play = gui.add_checkbox("play", False, visible=several)
        self._play.on_update(lambda _: self._due.set())
        self._size = float(np.linalg.norm(np.subtract(*display.box))) or 1.0
        self._build_sensor_controls()
        gui.add_html(surroundings.legend_html(display))
        with gui.add_folder("layers", expand_by_default=len(self._visible) < _MANY_LAYERS):
            for group, shown in self._visible.items():
                gui.add_checkbox(group, shown).on_update(
                    lambda event, group=group: self._set_visibility(group, event.target.value)
                )
        self._said = gui.add_text("note", "", disabled=True, visible=False)
        for layer in display.layers:
            self._draw_layer(layer)
        self._build_level_slider()
        surroundings.draw_ground(scene, display)
        surroundings.set_camera(self._server.initial_camera, display)
        self._server.on_client_connect(self._set_camera)

    def _set_camera(self, client: Any) -> None:
        """Frame the scene for the window of one browser."""
        with suppress(UserWarning):  # viser's, of a browser that has left already
            surroundings.set_camera(client.camera, self._display, client.camera.aspect)

    def _build_level_slider(self) -> None:
        """Let the person hide all cells below a level."""
        own = (x for x in self._display.layers if x.name in self._nodes)
        bands = [x for x in own if x.group == layers.LEVELS]
        tops = {x.name: x.band[1] for x in bands if x.band}
        if len(tops) < 2:
            return
        low, high, unit = min(tops.values()), max(tops.values()), bands[0].unit
        step = 10.0 ** math.floor(math.log10(max(high - low, 1e-6 * abs(high), 1e-12) / 20))
        ends = step * (math.floor(low / step) - 1), step * (math.ceil(high / step) - 1)
        slider = self._server.gui.add_slider(f"lowest level [{unit}]", *ends, step, ends[0])

        def hide_lower(_: Any) -> None:
            self._hidden = {name for name, top in tops.items() if top <= slider.value}
            self._set_visibility(layers.LEVELS, self._visible[layers.LEVELS])

        slider.on_update(hide_lower)

    def _build_sensor_controls(self) -> None:
        gui, maps = self._server.gui, self._display.maps
        if not self._sensors:
            if "transmitters" not in self._visible:
                gui.add_text("maps", _NO_MAPS, multiline=True, disabled=True)
            return
        self._sensor = gui.add_dropdown("sensor", self._sensors, visible=len(self._sensors) > 1)
        self._sensor.on_update(lambda _: self._select_sensor(str(self._sensor.value)))
        self._frame = gui.add_slider("position", 0, 1, 1, 0)
        self._frame.on_update(lambda _: self._update_state(frame=int(self._frame.value)))
        simulated = self._links or any(SIMULATED in one.power for one in maps.values())
        shown = [MEASURED] * bool(maps) + [SIMULATED] * bool(simulated)
        self._panels = MapPanels(gui, [*shown, RESIDUAL] if len(shown) > 1 else shown)
        self._cursor = [gui.add_slider(name, 0, 1, 1, 0) for name in _CURSOR]
        for slider in self._cursor:
            slider.on_update(lambda _: self._move_cursor())
        self._bin = gui.add_text("bin", "", disabled=True)
        self._select_sensor(self._wish.sensor)
        if not self._links:
            return
        names = next(iter(self._links.values())).names
        self._mover = gui.add_dropdown("move", (_NO_OBJECT, *names), initial_value=_NO_OBJECT)
        self._mover.on_update(lambda _: self._select_object(str(self._mover.value)))
        self._gizmo = self._server.scene.add_transform_controls(
            "/gizmo", scale=0.4 * self._size, depth_test=False, visible=False
        )
        self._gizmo.on_update(lambda _: self._follow_gizmo())

    def _move_cursor(self) -> None:
        """Choose a bin by its range and its direction."""
        row, column = (int(slider.value) for slider in self._cursor)
        # As in the maps, the left of the radar is on the left.
        self._update_state(bin=(row, self._cursor[1].max - column))

    def _select_sensor(self, name: str) -> None:
        """Look through another sensor, from its first position."""
        last = (self._links.get(name) or self._display.maps[name]).frames[-1]
        self._frame.max, self._frame.value = max(1, last), 0
        self._frame.visible, self._bin.value = last > 0, "move the cursor"
        axes = self._axes_of(name)
        self._panels.draw_axes(*axes)
        for slider, axis in zip(self._cursor, axes, strict=True):
            slider.max, slider.value = max(1, len(axis) - 1), 0
        self._update_state(sensor=name, frame=0, bin=None)

    def _set_visibility(self, group: str, shown: bool) -> None:
        self._visible[group] = bool(shown)
        for name, node in list(self._nodes.items()):
            if name.split("/")[0] == group:
                node.visible = self._visible[group] and name not in self._hidden

    def _select_object(self, name: str) -> None:
        """Let the person move an object, from where the step has it."""
        node = self._nodes.get(f"twin/{self._wish.moved_object}")
        if node is not None:  # what was moved before goes back
            node.wxyz, node.position = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        self._update_state(moved_object=name, motion=_IDENTITY)
        # Loss and error bars are those of the fit.
        self._set_visibility(layers.ELLIPSOID, name == _NO_OBJECT)
        labels = [step.label for step in self._steps] or [""]
        self._where.value = labels[self._wish.step] if name == _NO_OBJECT else "moved by hand"
        if name != _NO_OBJECT:
            self._center = self._links[self._wish.sensor].scene[name].center.detach().numpy()
            self._gizmo.position, self._gizmo.wxyz = tuple(self._center), (1.0, 0.0, 0.0, 0.0)
        self._gizmo.visible = name != _NO_OBJECT

    def _follow_gizmo(self) -> None:
        """Follow the gizmo: the surface at once, the map when it is traced."""
        if self._wish.moved_object == _NO_OBJECT:
            return
        turn, place = (torch.tensor(x).double() for x in (self._gizmo.wxyz, self._gizmo.position))
        rotation = rotation_from_quaternion(turn)
        motion = rigid(rotation, place - rotation @ torch.from_numpy(self._center))
        node = self._nodes.get(f"twin/{self._wish.moved_object}")
        if node is not None:
            with self._server.atomic():
                node.wxyz, node.position = self._gizmo.wxyz, motion[:3, 3].numpy()
        self._update_state(motion=motion)

    def _draw_layer(self, layer: DisplayLayer, size: float = 1.0) -> None:
        """Draw a layer, in place of the one of its name."""
        scene, visible = self._server.scene, self._visible[layer.group]
        # Slashes would part a name into nodes of a tree, which are hidden together.
        node = "/" + "/".join(part.replace("/", "∕") for part in layer.name.split("/", 1))
        how: dict[str, Any] = {"visible": visible}
        if layer.kind == "surface":
            how |= {"color": layer.color, "opacity": None if layer.opacity == 1 else layer.opacity}
            how |= {"cast_shadow": False, "receive_shadow": False, "flat_shading": True}
            faces = self._walls.get(layer.name, layer.faces)
            side = "front" if layer.name in self._walls else "double"
            made = scene.add_mesh_simple(node, layer.points, faces, side=side, **how)
            if layer.group == "twin":
                name, top = layer.name.split("/", 1)[1], self._top(layer)
                self._labels[layer.name] = scene.add_label(f"{node}/name", name, position=top)
        elif layer.kind == "lines":
            pairs = layer.points.reshape(-1, 2, 3)
            thick = {"thickness": 1.5, "thickness_units": "screen"}
            made = scene.add_line_segments(node, pairs, colors=layer.color, **thick, **how)
            if layer.group == layers.ELLIPSOID:
                # It is inside of its object; only labels show through.
                middle = (layer.points.min(0) + layer.points.max(0)) / 2
                radius = np.linalg.norm(layer.points - middle, axis=1).max()
                scene.add_label(f"{node}/radius", f"95 %: {1e3 * radius:.1f} mm", position=middle)
        else:
            how |= {"point_size": 0.006 * size * self._size, "point_shape": "circle"}
            how |= {"colors": layer.color, "precision": "float32"}
            made = scene.add_point_cloud(node, layer.points, **how)
        self._nodes[layer.name] = made

    def _top(self, layer: DisplayLayer) -> NDArray[np.float32]:
        """The highest point of a surface; of several the farthest, which is before no object."""
        toward = np.array(self._display.up) + 1e-3 * np.array(self._display.sight)
        return layer.points[(layer.points @ toward).argmax()]

    def _run_worker(self) -> None:
        """Trace what the person wants, the latest alone; single paths when nothing moves."""
        while True:
            due = self._due.wait(_PLAY_INTERVAL if self._play.value else None)
            self._due.clear()
            if self._closed:
                return
            if not due:  # the slider notes its step
                self._step.value = (self._wish.step + 1) % len(self._steps)
                self._due.clear()
            with self._lock:
                wish = self._wish
            try:
                self._show_step(wish)
                if self._sensors:
                    self._update_maps(wish)
                self._said.visible = False
            # Nobody is answered any more if this thread ends, so nothing may end it.
            except Exception as error:
                self._said.value, self._said.visible = to_one_line(str(error)), True

    def _show_step(self, state: _ViewerState) -> None:
        if not self._steps or state.step == self._taken:
            return
        if state.moved_object != _NO_OBJECT:
            self._mover.value = _NO_OBJECT  # what was moved stands where the step has it
        self._taken, step = state.step, self._steps[state.step]
        for layer in self._display.show_step(step).layers:
            # The radar has a layer "radar": an object of that name is "twin/radar".
            if layer.group == "twin" and layer.name.removeprefix("twin/") in step.bodies:
                node = self._nodes[layer.name]
                if node.faces.shape == layer.faces.shape and (node.faces == layer.faces).all():
                    node.vertices = layer.points
                    self._labels[layer.name].position = self._top(layer)
                else:
                    self._draw_layer(layer)
        self._where.visible, self._where.value = True, step.label
        for link in self._links.values():
            link.replace_meshes(step.bodies)

    def _update_maps(self, state: _ViewerState) -> None:
        """Show the maps of a position, and its paths once nothing moves."""
        link, known = self._links.get(state.sensor), self._display.maps.get(state.sensor)
        maps = known.maps_of_frame(state.frame) if known else {}
        if (found := self._found.get(state.step, {}).get(state.sensor)) is not None:
            maps |= found.maps_of_frame(state.frame)
        scene = None if link is None else link.scene
        if link is not None and state.moved_object != _NO_OBJECT:
            scene = link.move_object(state.moved_object, state.motion)
        if link is not None and scene is not None:
            maps |= {SIMULATED: to_float32(link.predict_map(scene, state.frame))}
        self._panels.show(maps, state.bin)
        if state.bin is not None:
            (row, column), (ranges, across) = state.bin, self._axes_of(state.sensor)
            azimuth = math.degrees(math.asin(max(-1.0, min(1.0, across[column]))))
            self._bin.value = f"range {ranges[row]:.2f} m, azimuth {azimuth:.1f}°"
        if link is None or scene is None:
            return
        if not self._play.value and not self._due.wait(_SETTLE_TIME):
            self._show_paths(link.sample_paths(scene, state.frame), state.bin)

    def _axes_of(self, sensor: str) -> tuple[list[float], list[float]]:
        """Range [m] of each row and u of each column of a sensor's maps."""
        own = self._links.get(sensor) or self._display.maps[sensor]
        return own.ranges, own.across

    def _show_paths(self, sample: PositionSample, chosen: tuple[int, int] | None) -> None:
        points = to_float32(sample.points)
        some = points[:: max(1, len(points) // _MAX_PATHS)]
        place = np.broadcast_to(to_float32(sample.position), some[:, 0].shape)
        corners = np.stack([place, some[:, 0], some[:, 0], some[:, 1]], axis=1)
        fed = to_float32(sample.points_in_bin(*chosen)) if chosen else np.zeros((0, 3), np.float32)
        found = {SAMPLED_PATHS: corners.reshape(-1, 3), layers.VISIBLE_POINTS: points[:, 1]}
        found |= {layers.BOUNDARY_POINTS: sample.edges, layers.BIN_POINTS: fed}
        with self._server.atomic():
            for name, places in found.items():
                color, size = POSITION_LAYERS[name]
                kind = "lines" if name == SAMPLED_PATHS else "points"
                self._draw_layer(DisplayLayer(name, kind, to_float32(places), color=color), size)


def _start_server(guard: AccessGuard, host: str, port: int) -> Any:
    """The server of viser, behind a guard."""
    viser = import_optional("viser", "view")
    made: list[Any] = []  # clients may come before the constructor ends
    with (
        install_guard(guard, lambda: made[0].gui._gui_input_handle_from_uuid if made else {}),
        redirect_stdout(io.StringIO()),
    ):
        made.append(viser.ViserServer(host=host, port=port, verbose=False))
        return made[0]
