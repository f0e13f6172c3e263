"""Pages that stand alone, in a real browser: reports and recordings."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from invertwin.cli.report import Table, View, report_html
from invertwin.scene import Object, RoughDielectric, Scene, plate, rigid, sphere
from invertwin.viewer import Body, Display, Step, body_of, display_of, page_html, view_html

pytestmark = [pytest.mark.browser, pytest.mark.slow]

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


def display() -> Display:
    material = RoughDielectric(4.0)
    ball = Object(sphere(0.3, 5), material, rigid(translation=[0.0, 0.0, 2.0]))
    wall = Object(plate(3.0, 2.4), material, rigid(translation=[0.0, 0.0, 3.3]))
    body, away = body_of(ball), np.array([0.2, 0.0, 0.0], np.float32)
    steps = [
        Step(k, f"{EVIL} {k}", {EVIL: Body(body.vertices + k * away, body.faces)}) for k in range(5)
    ]
    return replace(
        display_of(Scene({EVIL: ball, "wall": wall}), {}, EVIL, fitted=[EVIL]), steps=steps
    )


@pytest.mark.parametrize("kind", ["report", "recording"])
def test_the_slider_moves_the_mesh_and_no_name_acts(watched, pictures, tmp_path, kind, blue):
    made = display()
    text = page_html(made)
    if kind == "report":
        parts = [Table(EVIL, ["name"], [[EVIL]]), View(view_html(made))]
        text = report_html(EVIL, EVIL, EVIL, parts, "reconstruct", {"run.toml": EVIL})
    file = tmp_path / "page.html"
    file.write_text(text, encoding="utf-8")
    begin = time.monotonic()
    watched.page.goto(file.as_uri())
    slider = watched.page.get_by_role("slider")
    slider.wait_for()
    assert time.monotonic() - begin <= 3.0
    columns = []
    for key in ("End", "Home"):
        slider.press(key)
        watched.page.wait_for_timeout(500)
        watched.page.screenshot(path=str(pictures / f"{kind}_{key.lower()}.png"))
        columns.append(blue(watched.page.locator("canvas").screenshot()))
    # Who looks along z with y up has x to the left.
    assert columns[0] < columns[1] - 50
    assert watched.page.locator("output").inner_text() == f"{EVIL} 0"
    assert watched.errors == []
    assert {url.split(":")[0] for url in watched.requests} <= {"file", "data"}


def test_a_report_is_legible_in_the_dark_and_on_paper(watched, pictures, tmp_path: Any):
    parts = [Table("Result", ["quantity", "value"], [["loss", 0.5]]), View(view_html(display()))]
    file = tmp_path / "report.html"
    file.write_text(report_html("Title", "Status.", "", parts, "reconstruct", {}), encoding="utf-8")
    watched.page.emulate_media(color_scheme="dark")
    watched.page.goto(file.as_uri())
    look = "x => { const s = getComputedStyle(x); return [s.color, s.backgroundColor]; }"
    color, ground = watched.page.locator("body").evaluate(look)
    assert contrast(color, ground) > 7
    watched.page.screenshot(path=str(pictures / "report_dark.png"))
    watched.page.emulate_media(color_scheme="dark", media="print")
    assert contrast(*watched.page.locator("body").evaluate(look)) > 7
    assert not watched.page.get_by_role("slider").is_visible()
    assert watched.page.locator("canvas").get_attribute("aria-label").startswith("Scene in three")
    (pictures / "report.pdf").write_bytes(watched.page.pdf())
    assert watched.errors == []


def contrast(one: str, other: str) -> float:
    """Ratio of the lights of two colours, by the rule of WCAG."""

    def light(text: str) -> float:
        shares = np.array([float(x) for x in text[text.index("(") + 1 : -1].split(",")[:3]]) / 255
        linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722]) + 0.05

    low, high = sorted((light(one), light(other)))
    return high / low
