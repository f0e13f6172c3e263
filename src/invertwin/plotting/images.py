"""Figures of a camera's images and of their derivatives."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from invertwin.errors import InputError
from invertwin.plotting.figures import legible, numbers

_SHARE = 0.995  # of the pixels have derivatives within the colours


def images(
    panels: Mapping[str, Float[Tensor, "row column"]],
    derivatives: Mapping[str, Float[Tensor, "row column"]] | None = None,
    derivative_label: str = "",
) -> Figure:
    """Images side by side in grey, then derivatives on one symmetric scale of colours.

    Args:
        panels: Masks or depths by title, each on its own scale.
        derivatives: By title; what grows with θ is red, what falls is blue.
        derivative_label: Of the derivatives, with their unit.

    Raises:
        InputError: No image.
    """
    rates = derivatives or {}
    every = [*panels.values(), *rates.values()]
    if not every:
        raise InputError("expected at least one image, got none; give images or derivatives")
    rows, columns = every[0].shape
    size = (1.6 + 3.0 * len(every), min(max(3.0 * rows / columns, 1.4), 5.0) + 0.9)
    figure = Figure(figsize=size, layout="constrained")
    cells = figure.subplots(1, len(every), squeeze=False)[0]
    limit = max((float(np.quantile(abs(numbers(v)), _SHARE)) for v in rates.values()), default=1.0)
    signed = {"cmap": "RdBu_r", "vmin": -(limit or 1.0), "vmax": limit or 1.0}
    styles = [{"cmap": "gray"}] * len(panels) + [signed] * len(rates)
    for axes, name, values, style in zip(cells, [*panels, *rates], every, styles, strict=True):
        image = axes.imshow(numbers(values), **style)
        axes.set_title(legible(name), fontsize=9)
        axes.tick_params(labelsize=7)
        if values is every[-1] and rates:
            bar = figure.colorbar(image, ax=[*cells[len(panels) :]], shrink=0.85)
            bar.set_label(derivative_label, fontsize=8)
            bar.ax.tick_params(labelsize=7)
    return figure
