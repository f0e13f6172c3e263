"""Figures of curves: how fits converge, losses along a line, and radar signatures.

Signatures are cross-sections over aspect or frequency, profiles and images.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from invertwin.plotting.figures import color, legible, numbers, row_of_axes

Curve = tuple[NDArray, NDArray]
"""Places and values."""


def convergence(
    losses: Sequence[float] | Mapping[str, Sequence[Sequence[float]]],
    errors: Mapping[str, Sequence[Sequence[Sequence[float]]]] | None = None,
    *,
    annealed: float | None = None,
    before: float | None = None,
    error_label: str = "Chamfer distance [m]",
) -> Figure:
    """Loss over the steps and, beside it, an error: one colour for each way to fit.

    Args:
        losses: Losses of one fit; or those of several fits, by name.
        errors: Pairs of step and error of every fit, by name.
        annealed: Step from which the surrogate has no additional blur.
        before: Loss of the start without additional blur.
        error_label: What the errors are, with the unit.
    """
    if not isinstance(losses, Mapping):
        losses = {"loss": [losses]}
    count, width = (1, 7) if errors is None else (2, 10)
    figure, (left, *others) = row_of_axes(count, (width, 3.3))
    for i, (name, fits) in enumerate(losses.items()):
        for k, values in enumerate(fits):
            label = "_" if k else legible(f"{name} ({len(fits)})")
            left.plot(values, label=label, color=color(i), linewidth=1.1, alpha=0.7)
    positive = [value for fits in losses.values() for row in fits for value in row if value > 0]
    positive += [before] if before else []
    if positive and max(positive) > 5 * min(positive):
        left.set_yscale("log")
    if annealed is not None:
        label = "blur is reduced to 0: losses not comparable"
        left.axvspan(0, annealed, color="black", alpha=0.07, linewidth=0, label=label)
    if before is not None:
        left.plot([0], [before], "k*", markersize=8, label="start, without blur")
    left.set(xlabel="step", ylabel="loss")
    for right in others:
        _draw_errors(right, losses, errors or {}, error_label)
    for axes in (left, *others):
        axes.grid(alpha=0.3)
        if losses:
            axes.legend(fontsize=8)
    return figure


def _draw_errors(axes, losses, errors, label: str) -> None:
    for i, name in enumerate(losses):
        for k, curve in enumerate(errors[name]):
            steps, values = zip(*curve, strict=True) if curve else ((), ())
            axes.plot(steps, values, color=color(i), marker=".", label="_" if k else legible(name))
    highest = max(value for fits in errors.values() for curve in fits for _, value in curve)
    axes.set(xlabel="step", ylabel=label, ylim=(0, 1.05 * highest))


def landscape(exact: Curve, surrogates: Mapping[str, Curve], displacements: str) -> Figure:
    """The exact signal's loss beside the surrogate's, over the offset from the truth.

    Args:
        exact: Offsets [m] and losses of the exact signal.
        surrogates: Offsets [m] and losses of the surrogate, by name.
        displacements: What is moved and in which direction, such as ``letter along z``.
    """
    figure, (left, right) = row_of_axes(2, (10, 3.4))
    left.plot(exact[0] * 1e3, exact[1], color=color(0), linewidth=0.8)
    left.set_title(f"exact signal: {count_minima(exact[1])} local minima", fontsize=9)
    offset = legible(f"offset of {displacements} from the truth, in")
    left.set_xlabel(f"{offset} millimetres [mm]", fontsize=9)
    for i, (name, (offsets, losses)) in enumerate(surrogates.items()):
        label = legible(f"{name} ({count_minima(losses)})")
        right.plot(offsets, losses, color=color(i + 1), label=label)
    right.set_title("surrogate, and its number of local minima", fontsize=9)
    right.set_xlabel(f"{offset} metres [m]", fontsize=9)
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.axvline(0, color="black", linewidth=0.6, linestyle=":")
        axes.set_ylabel("loss")
        axes.grid(alpha=0.3)
    return figure


def count_minima(values: NDArray) -> int:
    """Points inside a curve that are lower than both neighbours."""
    return int(np.sum((values[1:-1] < values[:-2]) & (values[1:-1] < values[2:])))


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
    rows = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
    for axes, (title, curves) in zip(rows, panels.items(), strict=True):
        top = max(float(np.nanmax(numbers(curve))) for curve in curves.values())
        _lines(axes, curves, across)
        ends = (top - least, top + 3)
        axes.set(title=legible(title), xlabel=label, ylabel="RCS [dBsm]", ylim=ends)
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
        ends = (top - _SPAN, top + 3)
        axes.set(xlabel="range beyond the origin [m]", ylabel="RCS [dBsm]", ylim=ends)
        axes.grid(alpha=0.3)
        return figure
    drawn = axes.pcolormesh(numbers(across), place, values, vmin=top - _SPAN, vmax=top)
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
    values, ends = numbers(levels), 2 * (-extent, extent)
    top = float(values.max())
    drawn = axes.imshow(values, origin="lower", extent=ends, vmin=top - 40, vmax=top)
    axes.set(xlabel=labels[0], ylabel=labels[1])
    figure.colorbar(drawn, ax=axes, label="RCS [dBsm]")
    return figure
