"""Chromium, driven by Playwright; both are optional, and their tests skip without them."""

import importlib.util
import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from browser.references import PICTURES

INSTALL = "run: make test-browser"


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A browser without a window."""
    for extra in ("viser", "playwright"):
        if importlib.util.find_spec(extra) is None:
            pytest.skip(f"needs the package {extra}; {INSTALL}")
    from playwright.sync_api import (  # pyright: ignore[reportMissingImports]
        Error,
        sync_playwright,
    )

    # Debian's, or what `playwright install chromium` has fetched.
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    flags = ["--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=found, args=flags)
        except Error:
            pytest.skip(f"needs Chromium; {INSTALL}")
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def pictures() -> Path:
    """Where screenshots and measured figures go."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    return PICTURES


@pytest.fixture(scope="session")
def note(pictures: Path) -> Callable[..., None]:
    """Keeps measured figures."""

    def keep(**figures: float) -> None:
        file = pictures / "figures.json"
        known = json.loads(file.read_text()) if file.exists() else {}
        file.write_text(json.dumps(known | figures, indent=2) + "\n")

    return keep


class Watched:
    """A page whose errors and requests are noted."""

    def __init__(self, browser: Any) -> None:
        self.page = browser.new_page(viewport={"width": 1024, "height": 640})
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.received: list[bytes] = []
        self.page.on("console", self._said)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("dialog", lambda dialog: self.errors.append(dialog.message))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", self._connected)

    def _said(self, message: Any) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def _connected(self, socket: Any) -> None:
        self.requests.append(socket.url)
        socket.on("framereceived", lambda frame: self.received.append(frame))


@pytest.fixture
def watched(chromium: Any) -> Iterator[Watched]:
    """A fresh page."""
    found = Watched(chromium)
    yield found
    found.page.close()


@pytest.fixture
def blue() -> Callable[[bytes], float]:
    """The column of the middle of what has the colour of a twin, in a screenshot."""

    def middle(png: bytes) -> float:
        shown = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), float)
        mask = (shown[..., 2] - shown[..., 0] > 40) & (shown[..., 2] - shown[..., 1] > 15)
        return float(np.median(np.nonzero(mask)[1]))

    return middle
