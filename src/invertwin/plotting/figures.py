"""Common parts of figures: colours, numbers of tensors, PNG bytes."""

import io
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

PALETTE = ("#4c78a8", "#e0803c", "#54a24b", "#b279a2", "#9d755d")


def color(index: int) -> str:
    """A colour of the palette, which repeats."""
    return PALETTE[index % len(PALETTE)]


def numbers(values: Tensor | NDArray) -> NDArray[Any]:
    """An array without gradients, on the CPU."""
    return torch.as_tensor(values).detach().cpu().numpy()


def png_bytes(figure: Figure) -> bytes:
    """The figure as a PNG file; equal figures give equal bytes."""
    FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    # No time stamp: a run that is repeated writes the same bytes.
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def legible(text: str) -> str:
    """A user's words in a figure: no formula, and never hidden from a legend.

    Args:
        text: Such as the name of an object.
    """
    plain = text.replace("$", r"\$")
    return f" {plain}" if plain.startswith("_") else plain
