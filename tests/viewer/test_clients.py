"""What clients of a viewer may say, and that nobody hinders others."""

import importlib.util
import json
import math
import random
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from invertwin.runtime.memory import peak_memory
from invertwin.scene import Object, RoughDielectric, Scene, box, rigid
from invertwin.viewer import (
    Display,
    DisplayLayer,
    DisplayMesh,
    DisplayStep,
    InteractiveSensor,
    Viewer,
    build_display,
    display_mesh,
    page_html,
)
from invertwin.viewer.guard import is_valid_message
from invertwin.viewer.layers import ELLIPSOID
from invertwin.viewer.server import _NO_OBJECT
from viewer.test_display import GRID, radar, scene
from viewer.test_guard import answered

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason='needs: pip install "invertwin[view]"'
)
WAIT = 20.0  # seconds, on a busy machine


class Client:
    """A browser that says what it likes."""

    def __init__(self, viewer: Viewer) -> None:
        import viser
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        self._link = connect(
            f"ws://127.0.0.1:{viewer._server.get_port()}",
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            max_size=None,
            open_timeout=WAIT,
        )

    def say(self, kind: str, **rest: Any) -> None:
        import msgspec

        self._link.send(msgspec.msgpack.encode({"type": kind, **rest}))

    def say_raw(self, raw: bytes | str) -> None:
        self._link.send(raw)

    def look(self) -> None:
        """Say where the camera is, with which viser counts a client."""
        place = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, 0.0, 0.0]}
        place |= {"look_at": [1.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0]}
        numbers = {"fov": 1.0, "near": 0.1, "far": 100.0, "image_height": 600, "image_width": 800}
        self.say("ViewerCameraMessage", **place, **numbers)

    def close(self) -> None:
        self._link.close()


def steps() -> Display:
    points = np.eye(3, dtype=np.float32)
    faces = np.array([[0, 1, 2]], np.int32)
    made = [DisplayStep(k, f"step {k}", {"a": DisplayMesh(points + k, faces)}) for k in range(5)]
    return Display("steps", [DisplayLayer("twin/a", "surface", points, faces)], made)


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    with Viewer(steps(), port=0) as made:
        until(lambda: made._where.value == "step 4")
        yield made


@pytest.fixture
def sensing() -> Iterator[Viewer]:
    display = build_display(scene(), {"": (radar(), GRID)}, "t", fitted=["a/cube"])
    with Viewer(display, {"": InteractiveSensor(scene(), radar(), GRID)}, port=0) as made:
        yield made


def until(holds: Any) -> None:
    end = time.monotonic() + WAIT
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


HOSTILE = (
    *(10**9, -99, -7, 2**40, 2**63, -(2**63), 0.5, -0.0, math.nan, math.inf, -math.inf, 1e300),
    *(None, True, "x", "", "9" * 5000, [], [1, 2], {}, {"a": 1}, [[[]]], b"\0", "twin", "layers"),
)
KINDS = (
    *("GuiUpdateMessage", "SceneNodeClickMessage", "TransformControlsUpdateMessage"),
    *("ViewerCameraMessage", "GuiFormSubmitMessage", "GuiButtonHoldMessage", "ShareUrlRequest"),
    *("FileTransferStartUpload", "FileTransferPart", "ScenePointerMessage", "RunJavascriptMessage"),
    *("TransformControlsDragStartMessage", "CommandTriggerMessage", "NoSuchMessage"),
)
NAMES = (
    *("uuid", "updates", "name", "wxyz", "position", "owner", "ray_origin", "ray_direction"),
    *("screen_pos", "modifier", "instance_index", "fov", "transfer_uuid", "source_component_uuid"),
)


def control(viewer: Viewer, name: str) -> Any:
    return getattr(viewer, name)._impl.uuid


def test_an_object_named_as_a_group_of_layers_moves_alone():
    material = RoughDielectric(4.0)
    ball = Object(box((0.4, 0.4, 0.4)), material, rigid(translation=[2.0, 0.0, 0.0]))
    body = display_mesh(ball)
    moved = DisplayMesh(body.vertices + np.float32(0.5), body.faces)
    shown = build_display(Scene({"radar": ball}), {"": (radar(), GRID)}, "t", fitted=["radar"])
    shown = replace(shown, steps=[DisplayStep(1, "step 1", {"radar": moved})])
    with Viewer(shown, port=0) as made:
        until(lambda: made._where.value == "step 1")
        assert made._said.visible is False
        vertices = made._nodes["twin/radar"].vertices
        np.testing.assert_allclose(vertices, moved.vertices)
    page = page_html(shown)  # the same triangles are not written again
    data = json.loads(page.split('id="view-data">')[1].split("</script>")[0])
    assert "faces" not in data["steps"][0]["bodies"]["twin/radar"]


def test_values_are_those_of_the_control_and_nothing_else(viewer):
    import msgspec

    known = viewer._server.gui._gui_input_handle_from_uuid
    slider, text = control(viewer, "_step"), control(viewer, "_where")
    boxes = [uuid for uuid, one in known.items() if type(one.value) is bool]

    def valid(uuid: Any, updates: Any) -> bool:
        message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates}
        return is_valid_message(msgspec.msgpack.encode(message), known)

    assert [valid(slider, {"value": k}) for k in (0, 4, 2.0)] == [True] * 3
    assert not any(valid(slider, {"value": k}) for k in HOSTILE if k not in (0, 0.5, -0.0))
    assert not valid(slider, {"max": 9})
    assert not valid(slider, {"value": 1, "update_cb": "x"})
    assert not valid(slider, {"update_cb": []})
    assert not valid(text, {"value": "other"})
    assert not valid("unknown", {"value": 1})
    assert valid(boxes[0], {"value": False})
    assert not valid(boxes[0], {"value": 1})


@pytest.mark.parametrize(
    ("change", "accepted"),
    [
        ({}, True),
        ({"owner": ""}, True),
        ({"position": [0.0, 0.0, 2.0**40]}, False),
        ({"position": [0.0, math.nan, 0.0]}, False),
        ({"position": [0.0, 0.0]}, False),
        ({"position": ["a", "b", "c"]}, False),
        ({"wxyz": [1.0, 0.0, 0.0]}, False),
        ({"wxyz": "wxyz"}, True),  # viser refuses it
        ({"name": "n" * 5000}, False),
        ({"name": {}}, False),
        ({"type": "RunJavascriptMessage"}, False),
        ({"type": ["GuiUpdateMessage"]}, False),
    ],
)
def test_places_are_vectors_of_usual_numbers(change, accepted):
    import msgspec

    message = {"type": "TransformControlsUpdateMessage", "name": "/gizmo"}
    message |= {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, 0.0, 1.0]} | change
    assert is_valid_message(msgspec.msgpack.encode(message), {}) == accepted


@pytest.mark.parametrize(
    "raw",
    [
        *(b"", b"\xc1", b"\x93\1\2\3", "text", b"\xff" * 100, b"\xa1x"),
        b"\xa1\xdd",  # no UTF-8
        b"\x91" * 60_000,  # deeper than Python calls
        b"\x81\xa4type\xc7\x0c\xff" + b"\xff" * 12,  # a time that is none
    ],
)
def test_what_is_no_message_is_none(raw):
    assert not is_valid_message(raw, {})


@pytest.mark.parametrize("band", [None, (1e9, 1e9), (1e9, -1e9), (0.0, 0.0)])
def test_a_file_with_other_levels_opens(band):
    faces, corners = np.array([[0, 1, 2]], np.int32), np.eye(3, dtype=np.float32)
    made = [DisplayLayer(f"levels/{k}", "surface", corners, faces, band=band) for k in "ab"]
    with Viewer(Display("map", made), port=0) as viewer:
        labels = {x.label for x in viewer._server.gui._gui_input_handle_from_uuid.values()}
        assert ("lowest level []" in labels) == (band is not None)


def test_the_level_slider_hides_the_cells_below_it():
    faces = np.array([[0, 1, 2]], np.int32)
    names, corners = ["levels/low", "levels/middle", "levels/high"], np.eye(3, dtype=np.float32)
    bands = [
        DisplayLayer(name, "surface", corners, faces, band=(low, low + 10), unit="dB")
        for name, low in zip(names, (-70.0, -60.0, -50.0), strict=True)
    ]
    with Viewer(Display("map", bands), port=0) as made:
        known = {x.label: x for x in made._server.gui._gui_input_handle_from_uuid.values()}
        slider, box = known["lowest level [dB]"], known["levels"]

        def shown() -> list[bool]:
            return [made._nodes[name].visible for name in names]

        assert (slider.min, slider.max, slider.step, slider.value) == (-61, -41, 1, -61)
        assert shown() == [True] * 3
        slider.value = -58
        until(lambda: shown() == [False, True, True])
        box.value = False
        until(lambda: shown() == [False] * 3)
        box.value = True
        until(lambda: shown() == [False, True, True])


def test_a_client_moves_the_slider(viewer):
    client = Client(viewer)
    client.look()
    client.say("GuiUpdateMessage", uuid=control(viewer, "_step"), updates={"value": 1})
    until(lambda: viewer._where.value == "step 1")
    client.close()


def test_a_browser_that_leaves_at_once_raises_nothing(viewer):
    client = Client(viewer)
    client.look()
    clients = viewer._server.get_clients
    until(lambda: len(clients()) == 1)
    (left,) = clients().values()
    client.close()
    until(lambda: not clients())
    with pytest.raises(UserWarning, match="closed connection"):
        left.camera.fov = 1.0
    left._websock_connection.get_message_buffer()._warned_push_after_done = False
    viewer._set_camera(left)


@pytest.mark.slow
def test_a_thousand_malformed_messages_end_nothing(sensing, capfd):
    from websockets.exceptions import ConnectionClosed

    draw = random.Random(1)
    before = peak_memory()
    uuids = [*sensing._server.gui._gui_input_handle_from_uuid, "unknown", *HOSTILE]
    held = {"uuid": uuids, "name": ["/gizmo", "/maps/simulated", "", *HOSTILE]}
    client = Client(sensing)
    client.look()
    for number in range(1000):
        rest: dict[str, Any] = {}
        for name in draw.sample(NAMES, draw.randrange(len(NAMES))):
            values = held.get(name, HOSTILE)
            rest[name] = draw.choice(values)
        if number % 2:
            key = draw.choice(["value", "min", "max", "update_cb", "visible", "_impl"])
            rest["updates"] = {key: draw.choice(HOSTILE)}
        message = {"type": draw.choice(KINDS), **rest}
        try:
            if number % 10 == 9:
                client.say_raw(draw.randbytes(draw.randrange(200)))
            else:
                client.say(**{("kind" if k == "type" else k): v for k, v in message.items()})
        except (OverflowError, OSError, ConnectionClosed):
            client = Client(sensing)
    assert sensing._worker.is_alive()
    good = Client(sensing)
    good.look()
    frame = sensing._frame
    good.say("GuiUpdateMessage", uuid=frame._impl.uuid, updates={"value": 1})
    until(lambda: sensing._wish.frame == 1)
    assert "Traceback" not in capfd.readouterr().err
    assert before is not None
    grown = (peak_memory() or 0.0) - before
    assert grown < 5e8


def test_the_worker_survives_an_exception_and_says_it(viewer):
    viewer._update_state(step=10**9)
    until(lambda: viewer._said.visible)
    assert "index" in viewer._said.value
    viewer._update_state(step=2)
    until(lambda: viewer._where.value == "step 2")
    until(lambda: not viewer._said.visible)


@pytest.mark.slow
def test_fifty_clients_and_a_hundred_slow_ones_hinder_no_good_one(viewer):
    """It is answered within a second, while 1 000 malformed messages come in beside it.

    Nine times of ten, since a busy machine delays some; `until` fails if an answer does not come.
    """
    draw = random.Random(2)
    with ExitStack() as stack:
        for _ in range(100):
            slow = socket.create_connection(("127.0.0.1", viewer._server.get_port()))
            stack.callback(slow.close)
            slow.send(b"GET / HTTP/1.1\r\nHo")
        others = [Client(viewer) for _ in range(50)]
        for client in others:
            stack.callback(client.close)
            client.look()
        good, times = Client(viewer), []
        stack.callback(good.close)
        good.look()
        for number in range(20):
            for client in others:
                if draw.random() < 0.5:
                    client.say_raw(draw.randbytes(draw.randrange(200)))
                else:
                    updates = {draw.choice(["value", "max"]): draw.choice(HOSTILE[2:])}
                    client.say("GuiUpdateMessage", uuid=draw.choice(HOSTILE), updates=updates)
            value = number % 4
            begun = time.monotonic()
            good.say("GuiUpdateMessage", uuid=control(viewer, "_step"), updates={"value": value})
            until(lambda value=value: viewer._where.value == f"step {value}")
            assert answered(viewer).status == 200
            times.append(time.monotonic() - begun)
        assert sorted(times)[-3] < 1.0


def test_a_moved_object_has_no_loss_and_no_error_bars_of_the_fit():
    """They come back with the object; a radius is a plain number."""
    bar = DisplayLayer(f"{ELLIPSOID}/a", "lines", np.float32([[0, 0, 0], [0.34, 0, 0]]))
    display = build_display(scene(), {"": (radar(), GRID)}, "t", fitted=["a/cube"])
    made = [DisplayStep(k, f"step {k}, loss {k + 1}", {}) for k in range(2)]
    display = replace(display, layers=[*display.layers, bar], steps=made)
    with Viewer(display, {"": InteractiveSensor(scene(), radar(), GRID)}, port=0) as viewer:
        until(lambda: viewer._where.value == "step 1, loss 2")
        drawn = viewer._nodes[f"{ELLIPSOID}/a"]
        handles = viewer._server.scene._handle_from_node_name
        (label,) = (handles[name] for name in handles if name.endswith("/radius"))
        assert label.text == "95 %: 170.0 mm"
        viewer._select_object("a/cube")
        assert (viewer._where.value, drawn.visible) == ("moved by hand", False)
        viewer._select_object(_NO_OBJECT)
        assert (viewer._where.value, drawn.visible) == ("step 1, loss 2", True)
