"""Figures of a camera's images and of their derivatives."""

from collections.abc import Mapping

from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from invertwin.deprecation import rename_arguments
from invertwin.errors import InputError
from invertwin.plotting.figures import add_colorbar, label_axes, numbers, row_of_axes, signed_colors

_SHARE = 0.995  # of the pixels have derivatives within the colours


@rename_arguments(shown="panels")
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
    figure, cells = row_of_axes(len(every), size)
    styles = [{"cmap": "gray"}] * len(panels)
    styles += [signed_colors(rates.values(), _SHARE)] * len(rates)
    for axes, name, values, style in zip(cells, [*panels, *rates], every, styles, strict=True):
        image = axes.imshow(numbers(values), **style)
        label_axes(axes, name)
        if values is every[-1] and rates:
            add_colorbar(figure, image, cells[len(panels) :], derivative_label)
    return figure
