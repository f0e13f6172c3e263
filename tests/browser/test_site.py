"""The documentation site in a real browser; tutorials are not executed."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("sphinx", reason="pip install -e '.[docs]'")

pytestmark = [pytest.mark.browser, pytest.mark.slow]

DOCS = Path(__file__).parents[2] / "docs"
LONGEST = 16_000  # px, of a page of 1280 px
WIDTHS = {"desktop": 1280, "phone": 390}  # px
FIGURES = """() => {
    const code = [...document.querySelectorAll("div.highlight pre")].filter(
        (one) => one.checkVisibility() && !one.closest(".cell_output, .output"));
    return {
        height: document.documentElement.scrollHeight,
        width: document.documentElement.scrollWidth,
        cut: code.filter((one) => one.scrollWidth > one.clientWidth + 1).length,
        bare: code.filter((one) => !one.parentElement.querySelector("button.copybtn")).length,
    };
}"""


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The pages."""
    folder = tmp_path_factory.mktemp("site")
    options = ["-q", "-D", "nb_execution_mode=off", "-b", "html", "-d", folder / "trees"]
    line = [sys.executable, "-m", "sphinx", *options, DOCS, folder / "html"]
    subprocess.run(line, check=True, stderr=subprocess.DEVNULL)  # of cells without a lexer
    return folder / "html"


def test_pages_are_short_whole_and_without_errors(site, watched, note):
    """At the width of a desktop and of a phone; every snippet has a button that copies it."""
    heights: dict[str, int] = {}
    for file in sorted(site.rglob("*.html")):
        if "_static" in file.parts:
            continue
        name = str(file.relative_to(site))
        for kind, width in WIDTHS.items():
            watched.page.set_viewport_size({"width": width, "height": 900})
            watched.page.goto(file.as_uri())
            watched.page.wait_for_timeout(100)
            found: dict[str, Any] = watched.page.evaluate(FIGURES)
            assert (found["cut"], found["bare"]) == (0, 0), (name, kind)
            assert found["width"] <= width, (name, kind)
            if kind == "desktop":
                heights[name] = found["height"]
    del heights["genindex-all.html"]  # the index on one page, beside that of pages by letter
    assert max(heights.values()) <= LONGEST, max(heights.items(), key=lambda item: item[1])
    note(site_pages=len(heights), site_tallest_px=max(heights.values()))
    assert not watched.errors


def test_links_open_what_is_folded(site, watched):
    for page, anchor in (("api/scene", "invertwin.scene.Mesh.summary"), ("results", "demo")):
        watched.page.goto((site / f"{page}.html").as_uri() + f"#{anchor}")
        target = watched.page.locator(f"[id='{anchor}']")
        target.wait_for(state="visible")
        assert watched.page.locator("details[open]").count() == 1
