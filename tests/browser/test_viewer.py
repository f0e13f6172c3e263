"""The viewer in a real browser: it loads, follows, answers clicks, and is alone with its server."""

import math
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch

from browser.ball import EVIL, shown
from browser.references import APART, apart
from invertwin.radar import FMCW, Radar
from invertwin.scene import Object, RoughDielectric, Scene, planar_array, plate, rigid, sphere
from invertwin.viewer import (
    DisplayMaps,
    DisplayMesh,
    DisplayStep,
    InteractiveSensor,
    Viewer,
    build_display,
    display_mesh,
)

pytestmark = [pytest.mark.browser, pytest.mark.slow]

LOADED = 3.0  # s
RATE = 5.0  # maps a second, with 20 000 triangles


@pytest.fixture(scope="module")
def viewer(chromium: Any):
    array = planar_array((16, 4), (1.9e-3, 1.9e-3))
    waveform = FMCW(77e9, 2e9, 50e-6, 128)
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.8, 0.0]], dtype=torch.float64)
    radar = Radar(planar_array((1, 1), (1.9e-3, 1.9e-3)), array, waveform, places)
    grid = radar.grid(1.0, 4.5, 0.5, 0.5)
    material = RoughDielectric(4.0)
    ball = Object(sphere(0.3, 5), material, rigid(translation=[2.0, 0.0, 0.0]))
    wall = Object(plate(3.0, 2.4), material, rigid(translation=[3.3, 0.0, 0.0]))
    scene = Scene({"ball": ball, "wall": wall})
    assert len(ball.mesh.faces) >= 20_000
    link = InteractiveSensor(scene, radar, grid)
    truth = scene.replace("ball", pose=rigid(translation=[2.1, 0.1, 0.0]))
    measured = torch.stack([link.predict_map(truth, k)[..., None] for k in range(2)])
    begun, away = display_mesh(ball), np.array([0.0, 0.1, 0.0], np.float32)
    steps = [
        DisplayStep(
            k,
            f"step {k}",
            {"ball": DisplayMesh(begun.vertices - k * away, begun.faces)},
        )
        for k in range(6)
    ]
    display = build_display(
        scene, {"": (radar, grid)}, "<script>alert(1)</script>", fitted=["ball"]
    )
    display = replace(
        display, steps=steps, maps={"": DisplayMaps.from_spectra({"measured": measured}, grid)}
    )
    with Viewer(display, {"": link}, port=0) as found:
        yield found


def opened(watched: Any, viewer: Viewer) -> float:
    """Seconds until the page is drawn and its panel answers."""
    begin = time.monotonic()
    watched.page.goto(viewer.address)
    watched.page.wait_for_selector("canvas")
    watched.page.get_by_role("slider").first.wait_for()
    return time.monotonic() - begin


def seen_at(viewer: Viewer, place: Any) -> tuple[float, float]:
    """Where a point of the world is on the screen [pixels]; the panel is beside the scene."""
    camera = next(iter(viewer._server.get_clients().values())).camera
    ahead = camera.look_at - camera.position
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up_direction)
    right /= np.linalg.norm(right)
    away = np.asarray(place) - camera.position
    width, height = camera.image_width, camera.image_height
    scale = height / 2 / np.tan(camera.fov / 2) / (away @ ahead)
    return width / 2 + scale * (away @ right), height / 2 - scale * (away @ np.cross(right, ahead))


def test_it_loads_and_reaches_nobody_else(watched, viewer, pictures, note):
    seconds = min(opened(watched, viewer) for _ in range(3))  # others use the machine too
    watched.page.wait_for_timeout(2000)
    watched.page.screenshot(path=str(pictures / "viewer.png"))
    assert watched.errors == []
    hosts = {
        urlsplit(url).hostname for url in watched.requests if url.split(":")[0] in "http ws wss"
    }
    assert hosts == {"127.0.0.1"}
    note(viewer_load_seconds=seconds)
    assert seconds <= LOADED


def test_the_map_follows_what_a_person_drags(watched, viewer, pictures, note):
    opened(watched, viewer)
    page = watched.page
    page.wait_for_timeout(2000)
    page.get_by_role("combobox").click()
    page.get_by_role("option", name="ball").click()
    page.wait_for_timeout(1000)
    center = viewer._center
    begun = np.array(viewer._gizmo.position)
    x, y = seen_at(viewer, center + np.array([0.0, 0.3 * viewer._size, 0.0]))
    page.mouse.move(x, y)
    page.wait_for_timeout(300)
    page.mouse.down()
    watched.received.clear()
    begin = time.monotonic()
    k = 1
    while time.monotonic() - begin < 4.0:
        k = -k
        page.mouse.move(x + 40 * k, y, steps=20)
    seconds = time.monotonic() - begin
    page.mouse.up()
    page.screenshot(path=str(pictures / "dragged.png"))
    rate = maps_in(watched.received) / seconds
    moved = np.linalg.norm(np.array(viewer._gizmo.position) - begun)
    page.get_by_role("combobox").click()
    page.get_by_role("option", name="nothing").click()
    note(updates_per_second=rate, triangles=20_480)
    assert moved > 0.01
    assert watched.errors == []
    assert rate >= RATE


def maps_in(frames: list[bytes]) -> int:
    """How many figures of the simulated map have come."""
    import msgspec  # pyright: ignore[reportMissingImports]
    import zstandard  # pyright: ignore[reportMissingImports]

    found = 0
    for frame in frames:
        size = int.from_bytes(frame[8:16], "little")
        text = zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size])
        for message in msgspec.msgpack.decode(text)["messages"]:
            if 'alt="simulated map"' in str(message.get("updates")):
                found += 1
    return found


def test_the_slider_moves_the_mesh(watched, viewer, pictures, blue):
    opened(watched, viewer)
    page = watched.page
    page.wait_for_timeout(2500)
    hidden = page.get_by_role("checkbox")  # what is seen would cover the mesh
    hidden.nth(1 + list(viewer._visible).index("what is seen")).click()  # the first one plays
    columns, scenes = [], {}
    for number, key in ((5, "End"), (0, "Home")):
        page.get_by_role("slider").first.press(key)
        page.wait_for_timeout(2500)
        page.screenshot(path=str(pictures / f"step_{number}.png"))
        whole = {"x": 0, "y": 0, "width": 680, "height": 640}  # left of the window's panel
        scenes[f"viewer_step_{number}"] = page.screenshot(clip=whole)
        columns.append(blue(scenes[f"viewer_step_{number}"]))
    away = [seen_at(viewer, [2.0, -0.1 * k, 0.0])[0] for k in (5, 0)]
    assert max([apart(png, name) for name, png in scenes.items()]) <= APART
    assert columns[0] - columns[1] == pytest.approx(away[0] - away[1], rel=0.25)
    assert watched.errors == []


def test_the_cursor_lights_the_points_that_feed_its_bin(watched, viewer, pictures):
    opened(watched, viewer)
    page = watched.page
    page.wait_for_timeout(1000)
    page.get_by_role("slider").first.press("End")
    page.wait_for_timeout(2500)
    grid = viewer._links[""].grid
    # The last step has the ball at y = -0.5 m.
    row = round((math.hypot(0.5, 2.0) - 0.3 - grid.range_start) / grid.range_step)
    column = round((-0.5 / math.hypot(0.5, 2.0) - grid.u_start) / grid.u_step)
    # Sliders: the step, the position, both of the cursor.
    for number, value in ((2, row), (3, grid.u_count - 1 - column)):
        slider = page.get_by_role("slider").nth(number)
        slider.press("Home")
        for _ in range(value):
            slider.press("ArrowRight", delay=40)
        page.wait_for_timeout(500)  # viser sends at most every 50 ms, the latest control alone
    page.wait_for_timeout(2500)
    page.screenshot(path=str(pictures / "cursor.png"))
    assert viewer._wish.bin == (row, column)
    azimuth = math.degrees(math.asin(float(grid.u[column])))
    assert viewer._bin.value == f"range {float(grid.ranges[row]):.2f} m, azimuth {azimuth:.1f}°"
    fed = viewer._nodes["chosen bin"].points
    ranges = np.linalg.norm(fed, axis=1)
    assert len(fed) > 3
    assert np.abs(ranges - float(grid.ranges[row])).max() <= 1.01 * grid.range_step
    assert watched.errors == []


def test_the_first_picture_has_the_scene_the_radar_and_readable_words(watched, viewer):
    opened(watched, viewer)
    page = watched.page
    page.wait_for_timeout(2500)
    camera = next(iter(viewer._server.get_clients().values())).camera
    shown = [layer for layer in viewer._display.layers if layer.shown]
    for layer in shown:
        places = np.array([seen_at(viewer, point) for point in layer.points[::50]])
        inside = (places > 0).all(1) & (places < [camera.image_width, camera.image_height]).all(1)
        assert inside.mean() >= (0.9 if layer.group != "boards" else 1.0)
    sizes = page.evaluate(
        "[...document.querySelectorAll('body *')].filter(e => e.offsetParent && [...e.childNodes]"
        ".some(n => n.nodeType == 3 && n.textContent.trim())).map(e => [parseFloat("
        "getComputedStyle(e).fontSize), [...e.childNodes].filter(n => n.nodeType == 3)"
        ".map(n => n.textContent).join('')])"
    )
    words = {text.strip(): size for size, text in sizes}
    assert {"state", "step", "play", "position", "layers", "fitted", "fixed"} <= set(words)
    # Ends of sliders are viser's own, and smaller.
    assert min(size for text, size in words.items() if not text.isdigit()) >= 11
    assert not page.locator("#webgl-software-rendering").is_visible()
    assert watched.errors == []


def test_play_goes_through_the_steps(watched, viewer):
    opened(watched, viewer)
    page = watched.page
    page.wait_for_timeout(1500)
    seen = set()
    page.get_by_role("checkbox").first.click()
    for _ in range(40):
        seen.add(viewer._wish.step)
        page.wait_for_timeout(200)
    page.get_by_role("checkbox").first.click()
    page.wait_for_timeout(1000)
    ended = viewer._wish.step
    page.wait_for_timeout(1000)
    assert viewer._wish.step == ended
    assert len(seen) >= 4
    assert watched.errors == []


def test_each_sensor_has_its_maps_and_its_points(watched, pictures, chromium):
    display, links = shown()
    other = links[EVIL]
    with Viewer(display, links, port=0) as viewer:
        opened(watched, viewer)
        page = watched.page
        page.wait_for_timeout(2500)
        assert viewer._frame.visible
        before = viewer._panels._known["simulated"][0]
        page.get_by_role("combobox").first.click()
        page.get_by_role("option", name=EVIL).click()
        page.wait_for_timeout(2500)
        page.screenshot(path=str(pictures / "other_sensor.png"))
        assert not viewer._frame.visible  # it has one position
        now = viewer._panels._known["simulated"][0]
        assert now.shape == other.grid.shape[:2]
        assert np.abs(now / now.max() - before / before.max()).max() > 0.5
        # From y = -2.5 m, along y, the ball at y = 0.8 m is straight ahead.
        row = round((3.3 - 0.3 - other.grid.range_start) / other.grid.range_step)
        viewer._update_state(bin=(row, other.grid.u_count // 2))
        page.wait_for_timeout(2500)
        fed = viewer._nodes["chosen bin"].points
        assert len(fed) > 3
        assert np.linalg.norm(fed - [2.0, 0.5, 0.0], axis=1).max() < 0.15
    assert watched.errors == []


def test_no_port_is_open_beyond_loopback(viewer):
    own = {os.readlink(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd") if _there(n)}
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/self/net/{name}").read_text().splitlines()[1:]
    ]
    listening = [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in own]
    assert listening
    assert all(place.startswith("0100007F:") for place in listening)


def _there(number: str) -> bool:
    return os.path.islink(f"/proc/self/fd/{number}")
