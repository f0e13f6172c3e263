"""What all figures share."""

import io

import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image

from invertwin import plotting
from invertwin.plotting.figures import png_bytes, row_of_axes
from invertwin.scene import Scene
from invertwin.scene.shapes import sphere
from scenes import thing


@pytest.mark.parametrize("name", [r"$\frac$", "_hidden", "a_b^c $ 5 $", "%s {x}"])
def test_words_of_users_are_no_formulas(name):
    ball = Scene({name: thing(sphere(0.1), (1.0, 0.0, 0.0))})
    shown = plotting.scene({name: ball})
    words = [text.get_text() for text in shown.findobj(Text)]
    assert any(word.replace(r"\$", "$").strip() == name for word in words)
    losses = plotting.convergence({name: [[3.0, 2.0, 1.0]]})
    legend = losses.axes[0].get_legend()
    assert legend is not None
    (label,) = [text.get_text() for text in legend.get_texts()]
    assert label.replace(r"\$", "$").strip() == f"{name} (1)"
    assert png_bytes(shown)
    assert png_bytes(losses)


def test_a_picture_has_no_background_and_ink_that_reads_on_light_and_dark_pages():
    figure, (axes,) = row_of_axes(1, (3.0, 2.0))
    axes.text(0.5, 0.5, "ink", color="black", fontsize=30)
    axes.plot([0, 1], [0, 1], color="#4c78a8", linewidth=3)
    pixels = np.asarray(Image.open(io.BytesIO(png_bytes(figure)))).reshape(-1, 4)
    assert (pixels[:, 3] == 0).mean() > 0.8
    solid = {tuple(row[:3]) for row in pixels[pixels[:, 3] == 255].tolist()}
    assert (0x4C, 0x78, 0xA8) in solid
    assert (0x73, 0x7B, 0x87) in solid
    assert min(sum(color) for color in solid) > 200

    def contrast(page: tuple[float, ...]) -> float:
        light = [
            sum(
                w * (c / 255 / 12.92 if c < 11 else ((c / 255 + 0.055) / 1.055) ** 2.4)
                for w, c in zip((0.2126, 0.7152, 0.0722), color, strict=True)
            )
            for color in (page, (0x73, 0x7B, 0x87))
        ]
        return (max(light) + 0.05) / (min(light) + 0.05)

    assert contrast((255, 255, 255)) > 4.0
    assert contrast((0x15, 0x18, 0x1C)) > 4.0


def test_black_behind_echoes_stays():
    figure, (axes,) = row_of_axes(1, (3.0, 2.0))
    axes.set_facecolor("black")
    pixels = np.asarray(Image.open(io.BytesIO(png_bytes(figure))))
    assert pixels[100, 180].tolist() == [0, 0, 0, 255]
