"""Common parts of figures: colours, numbers of tensors, PNG bytes."""

import io
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import same_color
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.text import Text
from numpy.typing import NDArray
from torch import Tensor

_INK = "#737b87"  # as far from white as from the dark pages
PALETTE = ("#4c78a8", "#e0803c", "#54a24b", "#b279a2", "#9d755d")


def color(index: int) -> str:
    """A colour of the palette, which repeats."""
    return PALETTE[index % len(PALETTE)]


def numbers(values: Tensor | NDArray) -> NDArray[Any]:
    """An array without gradients, on the CPU."""
    return torch.as_tensor(values).detach().cpu().numpy()


def row_of_axes(count: int, size: tuple[float, float], **options: Any) -> tuple[Figure, list[Any]]:
    """A figure with axes side by side.

    Args:
        count: Number of axes.
        size: Width and height [inch].
        options: As for ``Figure.subplots``.
    """
    figure = Figure(figsize=size, layout="constrained")
    return figure, list(figure.subplots(1, count, squeeze=False, **options)[0])


def label_axes(axes: Any, title: str, across: str = "") -> None:
    """Write the title and the name of the horizontal axis, small.

    Args:
        axes: Where.
        title: A user's words.
        across: Name of the horizontal axis.
    """
    axes.set_title(legible(title), fontsize=9)
    axes.set_xlabel(across, fontsize=8)
    axes.tick_params(labelsize=7)


def add_colorbar(figure: Figure, image: Any, cells: Sequence[Any], label: str) -> None:
    """Draw the scale of an image beside the axes that share it.

    Args:
        figure: Of these axes.
        image: Of one of them.
        cells: The axes.
        label: Name and unit of the values.
    """
    bar = figure.colorbar(image, ax=[*cells], shrink=0.85)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)


def signed_colors(values: Iterable[Tensor], share: float) -> dict[str, Any]:
    """Colours from blue over white, which is zero, to red, the same for some maps.

    Args:
        values: The maps.
        share: Of the values of each that the colours reach; the largest stick out.
    """
    limit = max((float(np.quantile(np.abs(numbers(v)), share)) for v in values), default=1.0) or 1.0
    return {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}


def png_bytes(figure: Figure) -> bytes:
    """The figure as a PNG file for light and dark pages: without a background, its black ink grey.

    Equal figures give equal bytes.
    """
    FigureCanvasAgg(figure)
    for axes in figure.axes:
        axes.tick_params(which="both", color=_INK, labelcolor=_INK)
        axes.spines[:].set_color(_INK)
    for artist in figure.findobj(lambda one: isinstance(one, Text | Line2D)):
        if same_color(artist.get_color(), "black"):
            artist.set_color(_INK)
    # Black behind echoes stays.
    frames = [legend.get_frame() for legend in figure.findobj(Legend)]
    for patch in [*(axes.patch for axes in figure.axes), *frames]:
        if same_color(patch.get_facecolor()[:3], "white"):
            patch.set_facecolor("none")
    buffer = io.BytesIO()
    # No time stamp: a run that is repeated writes the same bytes. No margins that axes left empty.
    how: Any = {"metadata": {"Software": None}, "bbox_inches": "tight"}
    figure.savefig(buffer, format="png", dpi=110, facecolor="none", **how)
    return buffer.getvalue()


def legible(text: str) -> str:
    """A user's words in a figure: no formula, and never hidden from a legend.

    Args:
        text: Such as the name of an object.
    """
    plain = text.replace("$", r"\$")
    return f" {plain}" if plain.startswith("_") else plain
