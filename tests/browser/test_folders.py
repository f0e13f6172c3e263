"""Folders of the commands in a real browser: coverage, links, motion, recordings, twins."""

import re
from collections.abc import Callable
from io import BytesIO
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from browser.references import APART, apart
from cli.small import call
from invertwin.cli.commands.view import load_display
from invertwin.viewer import Viewer

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SCREENS = {"desktop": (1280, 800), "phone": (390, 844)}
ROOM = """
task = "simulate"
frame = 2
[scene.room]
shape = "box"
size = [6.0, 5.0, 2.7]
position = [0.0, 0.0, 1.35]
material = { kind = "dielectric", permittivity = 5.24, conductivity = 0.1, scattering = 0.0 }
[transmitter]
positions = [[-2.5, -2.0, 2.4]]
[map]
places = { kind = "points", positions = [[2.0, 1.5, 1.2], [2.0, -1.5, 1.2], [0.0, 1.0, 1.2]] }
frequency = 5.2e9
depth = 1
"""
RADAR = """
[radar]
waveform = { kind = "fmcw", start_frequency = 77e9, bandwidth = 2e9, duration = 5e-5, samples = 64 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 8, spacing = 1.9e-3 }
positions = { kind = "line", start = [0.0, -0.6, 0.6], stop = [0.0, 0.6, 0.6], count = 6 }
[grid]
range_min = 1.0
range_max = 3.5
u_max = 0.75
[data]
kind = "simulated"
points_per_m2 = 300.0
snr_db = 20.0
"""
BOX = """
frame = 2
[scene.crate]
shape = "box"
size = [0.4, 0.5, 0.7]
position = [2.3, -0.3, 0.35]
rotation_deg = [0.0, 0.0, 25.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }
"""
WALKER = """
frame = 2
[scene.walker]
shape = "body"
spacing = 0.05
position = [2.8, 0.5, 0.95]
rotation_deg = [0.0, 0.0, 90.0]
material = { kind = "rough_dielectric", permittivity = 8.0 }
motion = [{ kind = "walking", speed = 1.2 }]
[chirps]
count = 16
interval = 2.5e-4
visibility_every = 16
"""
FOLDERS: dict[str, tuple[str, str]] = {
    "links": ("simulate", ROOM),
    "walker": ("simulate", 'task = "simulate"' + WALKER + RADAR.replace("count = 6", "count = 1")),
    "recording": ("simulate", 'task = "simulate"' + BOX + RADAR),
    "twin": (
        "twin",
        'task = "twin"'
        + BOX
        + RADAR
        + "[twin]\nlow = [1.0, -1.2]\nhigh = [3.4, 1.2]\nlevel = 0.0\n",
    ),
}

# Visible texts with their boxes and sizes in pixels.
WORDS = """[...document.querySelectorAll('body *:not(style):not(script)')]
    .filter(e => e.offsetParent && !e.children.length && e.textContent.trim())
    .map(e => [e.textContent.trim(), parseFloat(getComputedStyle(e).fontSize),
               ...['left', 'top', 'right', 'bottom'].map(k => e.getBoundingClientRect()[k])])"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: Any) -> Callable[[str], Path]:
    """Run the command of a name, once, and return its folder."""
    root = tmp_path_factory.mktemp("runs")

    def run(name: str) -> Path:
        out = root / name
        if not out.exists():
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(root)
                if name == "coverage":
                    assert call(patch, "new", "coverage") == 0
                    assert call(patch, "simulate", "coverage.toml", "-o", name) == 0
                else:
                    command, text = FOLDERS[name]
                    Path(f"{name}.toml").write_text(text)
                    assert call(patch, command, f"{name}.toml", "-o", name) == 0
        return out

    return run


def is_number(text: str) -> bool:
    return re.fullmatch(r"[-\d.e+]+", text) is not None


def overlap(one: list[float], other: list[float]) -> bool:
    """True if two boxes share more than a pixel."""
    low, high = np.maximum(one[:2], other[:2]), np.minimum(one[2:], other[2:])
    return bool((high - low > 1).all())


@pytest.mark.parametrize("screen", SCREENS)
@pytest.mark.parametrize("name", ["coverage", *FOLDERS])
def test_the_viewer_of_a_folder(watched, pictures, folder, name, screen):
    display, links = load_display(folder(name))
    page, (width, height) = watched.page, SCREENS[screen]
    page.set_viewport_size({"width": width, "height": height})
    with Viewer(display, links, port=0) as viewer:
        page.goto(viewer.address)
        page.wait_for_selector("canvas")
        png = b""
        for _ in range(10):  # a scene comes late where others use the machine, too
            page.wait_for_timeout(2000)
            png = page.screenshot(path=str(pictures / f"{name}_{screen}.png"))
            if apart(png, f"{name}_{screen}") <= APART:
                break
        assert apart(png, f"{name}_{screen}") <= APART
        words = [(text, size, box) for text, size, *box in page.evaluate(WORDS)]
        # Ends of sliders are viser's own, and smaller.
        assert min(size for text, size, _ in words if not is_number(text)) >= 11
        legible = [box for text, _, box in words if not is_number(text)]
        assert not [pair for pair in combinations(legible, 2) if overlap(*pair)]
        if screen == "desktop":
            viewer._server.scene.add_frame("/ground", visible=False)
            page.wait_for_timeout(1500)
            shown, bare = (
                np.asarray(Image.open(BytesIO(x)).convert("L"), float)
                for x in (png, page.screenshot())
            )
            assert (np.abs(shown - bare) > 20).mean() > 0.001  # the ground was visible
        assert watched.errors == []
