"""Picture of the viewer of a run folder, run file or capture, by Chromium.

    python benchmarks/screenshot.py out/demo [-o docs/pictures/viewer.png] [--size 1280 800]

Needs the extra `browser` (`make test-browser` installs it).
"""

import argparse
import shutil
from pathlib import Path

from invertwin import viewer
from invertwin.cli.commands.view import load_display

_SETTLED = 6000  # ms, after which rays are traced and drawn


def take_picture(target: Path, size: tuple[int, int]) -> bytes:
    """Return a picture of the viewer as PNG.

    Args:
        target: Run folder, run file or capture.
        size: Width and height of the window [pixel].
    """
    from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]

    display, sensors = load_display(target)
    with viewer.Viewer(display, sensors, port=0) as shown, sync_playwright() as driver:
        # Debian's, or what `playwright install chromium` has fetched.
        found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
        browser = driver.chromium.launch(
            executable_path=found,
            args=["--no-sandbox", "--enable-unsafe-swiftshader"],
        )
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(shown.address)
        page.wait_for_selector("canvas")
        page.wait_for_timeout(_SETTLED)
        picture = page.screenshot()
        browser.close()
    return picture


def main() -> None:
    """Take the picture, write it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("target", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/pictures/viewer.png"))
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 800))
    options = parser.parse_args()
    options.out.write_bytes(take_picture(options.target, tuple(options.size)))


if __name__ == "__main__":
    main()
