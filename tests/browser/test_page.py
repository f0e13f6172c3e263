"""Pages that stand alone, in a real browser: reports and recordings."""

import io
import math
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageChops, ImageFilter

from browser.ball import EVIL, shown
from browser.references import APART, apart, blocks, difference
from invertwin.cli.report import ReportTable, ReportView, report_html
from invertwin.viewer import Display, DisplayLayer, InteractiveSensor, page_html, view_html

pytestmark = [pytest.mark.browser, pytest.mark.slow]

LOADED = 3.0  # s
LIGHT = "rgb(255, 255, 255)"


@pytest.fixture(scope="module")
def display() -> Display:
    """A ball that moves to +x before a wall, its map from in front, and that of a sensor aside."""
    return shown()[0]


@pytest.fixture(scope="module")
def links() -> dict[str, InteractiveSensor]:
    """What simulates the maps."""
    return shown()[1]


def opened(watched: Any, text: str, file: Path) -> Any:
    """The page with its slider, once it is drawn."""
    file.write_text(text, encoding="utf-8")
    watched.page.goto(file.as_uri())
    slider = watched.page.get_by_role("slider", name="step")
    slider.wait_for()
    return slider


def picture_of(page: Any, name: str) -> Any:
    """The map of a name."""
    return page.get_by_role("img", name=name)


@pytest.mark.parametrize("kind", ["report", "recording"])
def test_the_slider_moves_mesh_and_map_and_no_name_acts(
    watched, pictures, tmp_path, kind, blue, display, links, note
):
    text = page_html(display, links)
    if kind == "report":
        parts = [ReportTable(EVIL, ["name"], [[EVIL]]), ReportView(view_html(display, links))]
        text = report_html(EVIL, EVIL, EVIL, parts, "reconstruct", {"run.toml": EVIL})
    begin = time.monotonic()
    slider = opened(watched, text, tmp_path / "page.html")
    seconds = time.monotonic() - begin
    note(**{f"{kind}_load_seconds": seconds, f"{kind}_kilobytes": len(text) / 1e3})
    assert seconds <= LOADED
    columns, bright = [], []
    for key in ("End", "Home"):
        slider.press(key)
        watched.page.wait_for_timeout(1000)
        watched.page.screenshot(path=str(pictures / f"{kind}_{key.lower()}.png"), full_page=True)
        scene = watched.page.locator("#view canvas").first.screenshot()
        maps = picture_of(watched.page, "simulated").screenshot()
        columns.append(blue(scene))
        near = np.asarray(image(maps).convert("RGB"), float)
        near = near[int(0.6 * len(near)) :, :, 1] - near[int(0.6 * len(near)) :, :, 2]  # yellow
        bright.append(float(np.nonzero(near > 0.95 * near.max())[1].mean() / near.shape[1]))
        if kind == "recording":
            assert apart(scene, f"recording_{key.lower()}") <= APART
            assert apart(maps, f"simulated_{key.lower()}") <= APART
    # Who looks along x with z up has y to the left.
    assert columns[0] < columns[1] - 50
    u = 0.8 / math.hypot(0.8, 2.0)
    assert bright == pytest.approx([0.5 - u / 1.2, 0.5], abs=0.05)
    assert watched.page.locator("output").first.inner_text() == f"{EVIL} 0"
    assert watched.errors == []
    assert {url.split(":")[0] for url in watched.requests} <= {"file", "data"}


def test_what_is_missing_is_noticed(watched, tmp_path, display, links):
    slider = opened(watched, page_html(display, links), tmp_path / "page.html")
    scene, page = watched.page.locator("#view canvas").first, watched.page
    slider.press("End")
    page.wait_for_timeout(1000)
    whole = scene.screenshot()
    assert apart(whole, "recording_end") <= APART
    page.get_by_role("checkbox", name="twin").click()
    page.wait_for_timeout(300)
    others = {
        "no mesh": (scene.screenshot(), "recording_end"),
        "slider without effect": (whole, "recording_home"),
        "no map": (blank(picture_of(page, "simulated").screenshot()), "simulated_end"),
    }
    assert min(difference(blocks(image(png)), name) for png, name in others.values()) > 2 * APART
    # Other rasterisers move what is seen by a pixel, and smooth it in another way.
    moved = ImageChops.offset(image(whole).convert("RGB"), 1, 1).filter(ImageFilter.BoxBlur(1))
    assert difference(blocks(moved), "recording_end") <= APART


def image(png: bytes) -> Image.Image:
    return Image.open(io.BytesIO(png))


def find_yellow_columns(png: bytes) -> np.ndarray:
    """Columns of the pixels in the colour of what feeds a bin."""
    pixels = np.asarray(image(png).convert("RGB"), float)
    yellow = (pixels[..., 0] > 200) & (pixels[..., 1] > 180) & (pixels[..., 2] < 60)
    return np.nonzero(yellow)[1]


def blank(png: bytes) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", image(png).size, "white").save(file, "png")
    return file.getvalue()


def test_a_click_lights_what_feeds_a_bin_for_every_sensor_and_position(
    watched, pictures, tmp_path, blue, display, links
):
    slider = opened(watched, page_html(display, links), tmp_path / "page.html")
    page = watched.page
    slider.press("End")  # the ball is at x = 2, y = 0.8
    for group in ("what is seen", "boundary paths"):
        page.get_by_role("checkbox", name=group).click()
    ball = np.array([2.0, 0.8, 0.0])
    for number, (name, link) in enumerate(links.items()):
        page.get_by_label("sensor").select_option(str(number))
        assert page.get_by_label("sensor").locator("option").nth(number).inner_text() == name
        for frame, place in enumerate(link.radar.positions.numpy()):
            if frame:
                page.get_by_role("slider", name="position").press("End")
            axes = link.radar.link().rotations[frame].numpy()
            toward = ball - place
            distance = float(np.linalg.norm(toward))
            u = float(toward @ axes[:, 1]) / distance
            box, grid = picture_of(page, "simulated").bounding_box(), link.grid
            up = ((distance - 0.3 - grid.range_start) / grid.range_step + 0.5) / grid.range_count
            left = ((u - grid.u_start) / grid.u_step + 0.5) / grid.u_count
            page.mouse.click(
                box["x"] + (1 - left) * box["width"], box["y"] + (1 - up) * box["height"]
            )
            page.wait_for_timeout(1000)
            told = page.locator("[data-part=told]").inner_text()
            found = re.fullmatch(r"range (.*) m, u (.*): (\d+) points .*", told)
            assert found is not None
            assert float(found[1]) == pytest.approx(distance - 0.3, abs=grid.range_step)
            assert float(found[2]) == pytest.approx(u, abs=grid.u_step)
            assert int(found[3]) > 3
            view = page.locator("#view canvas").first.screenshot()
            for _ in range(10):
                if len(find_yellow_columns(view)):
                    break
                page.wait_for_timeout(1000)  # slow machines draw later
                view = page.locator("#view canvas").first.screenshot()
            page.screenshot(path=str(pictures / f"fed_{number}_{frame}.png"))
            assert abs(np.median(find_yellow_columns(view)) - blue(view)) < 60
    # A bin in front of everything is fed by nothing.
    box = picture_of(page, "simulated").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] - 2)
    page.wait_for_timeout(1000)
    assert ": 0 points" in page.locator("[data-part=told]").inner_text()
    assert watched.errors == []


def test_the_slider_of_levels_reads_their_values_whatever_the_layers_are_called(watched, tmp_path):
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    layers = [
        DisplayLayer(name, "surface", square + k, np.arange(3, dtype=np.int32)[None], band=band)
        for k, (name, band) in enumerate(
            {"levels": (-90.0, -80.0), "levels/b": (-80.0, -72.55)}.items()
        )
    ]
    file = tmp_path / "page.html"
    file.write_text(page_html(Display("title", layers)), encoding="utf-8")
    watched.page.goto(file.as_uri())
    label = watched.page.get_by_text("lowest level")
    assert "from -90" in label.inner_text()
    label.locator("input").press("End")
    assert "from -80" in label.inner_text()
    assert watched.errors == []


def test_a_recording_is_legible_in_the_dark(watched, pictures, tmp_path, display, links):
    watched.page.emulate_media(color_scheme="dark")
    opened(watched, page_html(display, links), tmp_path / "page.html")
    page = watched.page
    for group in ("beams", "sampled paths"):
        page.get_by_role("checkbox", name=group).click()
    page.wait_for_timeout(1000)
    page.screenshot(path=str(pictures / "recording_dark.png"))
    shown = np.asarray(image(page.screenshot()).convert("L"), float)
    assert np.median(shown) < 60  # the page is dark, and so is the ground of the scene
    assert watched.page.locator("h1").evaluate("x => getComputedStyle(x).color") == LIGHT


def test_the_first_picture_has_ground_names_and_axes(watched, tmp_path, display, links):
    opened(watched, page_html(display, links), tmp_path / "page.html")
    page = watched.page
    page.wait_for_timeout(1000)
    words = "() => document.querySelector('[data-part=words]').toDataURL()"
    scene, named = page.locator("#view canvas").first, page.evaluate(words)
    first = np.asarray(image(scene.screenshot()).convert("L"), float)
    # Nothing that is shown is cut off: the rim has the colour of the page.
    for rim in (first[2:6], first[-6:-2], first[:, 2:6].T, first[:, -6:-2].T):
        assert np.ptp(rim[:, 12:-12]) < 3  # corners are round
    page.get_by_role("checkbox", name="ground").click()
    page.wait_for_timeout(300)
    bare = np.asarray(image(scene.screenshot()).convert("L"), float)
    assert (np.abs(first - bare) > 20).mean() > 0.003
    assert page.evaluate(words) != named  # without its metres
    shown = page.locator("[data-part=maps] span:visible")
    assert {"30", "0", "-30", "-40", "2"} <= set(shown.all_inner_texts())
    sizes = shown.evaluate_all("all => all.map((x) => parseFloat(getComputedStyle(x).fontSize))")
    assert min(sizes) >= 11
    assert watched.errors == []


def test_a_report_is_legible_in_the_dark_and_on_paper(
    watched, pictures, tmp_path: Any, display, links
):
    parts = [
        ReportTable("Result", ["quantity", "value"], [["loss", 0.5]]),
        ReportView(view_html(display, links)),
    ]
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
    assert not watched.page.get_by_role("slider", name="step").is_visible()
    # The layers that are drawn have their colours as a key.
    assert watched.page.locator("label", has_text="boundary paths").is_visible()
    assert "■" in watched.page.locator("label", has_text="boundary paths").inner_text()
    assert not watched.page.locator("label", has_text="sampled paths").is_visible()
    # The scene keeps its shape where paper is narrower than the window.
    assert (
        watched.page.locator("canvas").first.evaluate("x => getComputedStyle(x).objectFit")
        == "contain"
    )
    label = watched.page.locator("canvas").first.get_attribute("aria-label")
    assert label.startswith("Scene in three")
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
