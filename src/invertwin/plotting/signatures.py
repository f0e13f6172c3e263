"""Figures of radar signatures: cross-sections over aspect or frequency, profiles, images."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from invertwin.plotting.figures import color, legible, numbers, row_of_axes

_SPAN = 60.0  # dB below the largest value that figures show


def rcs_curves(
    panels: Mapping[str, Mapping[str, Tensor]], across: Tensor, label: str, least: float = _SPAN
) -> Figure:
    """Radar cross-sections in dBsm, a panel for each frequency or aspect.

    Args:
        panels: title → name of a curve → values [dBsm]. A name that begins with "measured" is drawn
            dashed.
        across: angles [°] or frequencies [GHz] of the values.
        label: of the axis across, with its unit.
        least: dB below the largest value that are shown.
    """
    figure = Figure(figsize=(8, 2.7 * len(panels)), layout="constrained")
    for axes, (title, curves) in zip(
        figure.subplots(len(panels), 1, squeeze=False)[:, 0], panels.items(), strict=True
    ):
        top = max(float(np.nanmax(numbers(curve))) for curve in curves.values())
        _lines(axes, curves, across)
        axes.set(title=legible(title), xlabel=label, ylabel="RCS [dBsm]")
        axes.set_ylim(top - least, top + 3)
    return figure


def rcs_derivatives(curves: Mapping[str, Tensor], across: Tensor, label: str, unit: str) -> Figure:
    """Derivatives of a radar cross-section.

    Args:
        curves: derivatives by name; the last is drawn dashed.
        across: angles [°] or frequencies [GHz] of the values.
        label: of the axis across, with its unit.
        unit: of the derivatives.
    """
    figure, (axes,) = row_of_axes(1, (8, 3.6))
    _lines(axes, curves, across, dashed=[*curves][-1])
    axes.set(xlabel=label, ylabel=unit)
    return figure


def _lines(
    axes: Axes, curves: Mapping[str, Tensor], across: Tensor, dashed: str = "measured"
) -> None:
    """Curves with a legend; dashed are those whose names begin so."""
    for number, (name, curve) in enumerate(curves.items()):
        line = "--" if name.startswith(dashed) else "-"
        look: dict[str, Any] = {"color": color(number), "lw": 1.1, "label": legible(name)}
        look["marker"] = "." if len(curve) < 8 else ""
        axes.plot(numbers(across), numbers(curve), line, **look)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def rcs_profile(levels: Tensor, ranges: Tensor, across: Tensor, label: str) -> Figure:
    """Range profiles in dBsm: a curve of one aspect, a map of several.

    Args:
        levels: [range, aspect] in dBsm.
        ranges: beyond the origin [m].
        across: angle of each aspect [°].
        label: of the axis across.
    """
    figure, (axes,) = row_of_axes(1, (8, 3.6))
    values, place = numbers(levels), numbers(ranges)
    top = float(values.max())
    if values.shape[1] == 1:
        axes.plot(place, values[:, 0], color=color(0), lw=1.1)
        axes.set(xlabel="range beyond the origin [m]", ylabel="RCS [dBsm]")
        axes.set_ylim(top - _SPAN, top + 3)
        axes.grid(alpha=0.3)
        return figure
    drawn = axes.pcolormesh(
        numbers(across), place, values, vmin=top - _SPAN, vmax=top, shading="nearest"
    )
    axes.set(xlabel=label, ylabel="range beyond the origin [m]")
    figure.colorbar(drawn, ax=axes, label="RCS [dBsm]")
    return figure


def rcs_image(levels: Tensor, extent: float, labels: tuple[str, str]) -> Figure:
    """An image in dBsm.

    Args:
        levels: rows along the second axis, columns along the first.
        extent: half its side [m].
        labels: of both axes.
    """
    figure, (axes,) = row_of_axes(1, (5.4, 4.6))
    values = numbers(levels)
    top = float(values.max())
    drawn = axes.imshow(
        values, origin="lower", extent=(-extent, extent, -extent, extent), vmin=top - 40, vmax=top
    )
    axes.set(xlabel=labels[0], ylabel=labels[1])
    figure.colorbar(drawn, ax=axes, label="RCS [dBsm]")
    return figure
