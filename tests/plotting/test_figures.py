"""What all figures share."""

import pytest
from matplotlib.text import Text

from invertwin import plotting
from invertwin.plotting.figures import png_bytes
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
