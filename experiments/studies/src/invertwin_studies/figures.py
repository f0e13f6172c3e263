"""Figures of the studies: ways to a derivative, losses along a line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import find_peaks
from torch import Tensor

from invertwin.channel import Grid
from invertwin.plotting import PALETTE, U_LABEL, V_LABEL

_SHALLOW = 1e-3  # of a curve's span: less deep minima are noise of its samples

Curve = tuple[NDArray, NDArray]
"""Places and values."""


@dataclass(frozen=True, eq=False)
class Derivative:
    """One derivative map.

    Attributes:
        title: Above it.
        values: Map [frame, range, u, v], or the text that stands where there is none.
        own_scale: Its colours do not compare with those of the other maps.
    """

    title: str
    values: Tensor | str
    own_scale: bool = False


def derivatives(panels: Sequence[Derivative], grid: Grid) -> Figure:
    """Projections of derivative maps of the first frame: summed over elevation, over range.

    Red: power grows with θ; blue: it falls. The rows of axes that a radar does not resolve are
    left out.

    Args:
        panels: Maps, one column or half a column each.
        grid: Bins of all maps.
    """
    views = [("range [m]", grid.ranges.tolist(), 2), (V_LABEL, grid.v.tolist(), 0)]
    views = [view for view in views if len(view[1]) > 1]
    u, columns = grid.u.tolist(), (len(panels) + 1) // 2
    height = 2 * len(views)
    figure = Figure(figsize=(3.2 * columns, 2.6 * height), layout="constrained")
    cells = figure.subplots(height, columns, squeeze=False)
    for cell in cells.flat:
        cell.set_axis_off()
    for row, (label, places, summed) in enumerate(views):
        flats = {
            panel.title: panel.values[0].sum(dim=summed).numpy()
            for panel in panels
            if not isinstance(panel.values, str)
        }
        shared = [flats[p.title] for p in panels if p.title in flats and not p.own_scale]
        common = max((_limit(flat) for flat in shared), default=1.0)
        for k, panel in enumerate(panels):
            cell = cells[len(views) * (k // columns) + row, k % columns]
            if isinstance(panel.values, str):
                if row == 0:
                    cell.set_title(panel.title, fontsize=9)
                    cell.text(0.5, 0.5, panel.values, ha="center", va="center", fontsize=8)
                continue
            flat = flats[panel.title] if summed == 2 else flats[panel.title].T
            limit = _limit(flat) if panel.own_scale else common
            cell.set_axis_on()
            cell.imshow(
                flat,
                origin="lower",
                aspect="auto",
                extent=(u[0], u[-1], places[0], places[-1]),
                vmin=-limit,
                vmax=limit,
                cmap="RdBu_r",
            )
            cell.invert_xaxis()  # the left of the radar is on the left
            cell.set_title(panel.title if row == 0 else "", fontsize=9)
            cell.set_xlabel(U_LABEL if row == len(views) - 1 else "", fontsize=7)
            cell.set_ylabel(label if k % columns == 0 else "", fontsize=7)
            cell.tick_params(labelsize=6)
    return figure


def _limit(flat: NDArray) -> float:
    return float(np.quantile(np.abs(flat), 0.998)) or 1.0


def scan(near: Mapping[str, Curve], wide: Curve, along: str) -> Figure:
    """Losses against displacement, one panel a loss, and the last one over a longer line.

    Args:
        near: Offsets (m) and losses, by name.
        wide: Offsets (m) and losses of the surrogate on a longer line.
        along: What is moved and in which direction.
    """
    figure = Figure(figsize=(3.1 * (len(near) + 1), 3.0), layout="constrained")
    cells = figure.subplots(1, len(near) + 1)
    for k, (cell, (name, (offsets, losses))) in enumerate(zip(cells, near.items(), strict=False)):
        cell.plot(offsets * 1e3, losses, color=PALETTE[k % len(PALETTE)], linewidth=0.9)
        cell.set_title(f"{name}: {deep_minima(losses)} local minima", fontsize=9)
        cell.set_xlabel(f"{along} [mm]", fontsize=8)
    cells[-1].plot(*wide, color=PALETTE[(len(near) - 1) % len(PALETTE)])
    cells[-1].set_title(f"surrogate, farther: {deep_minima(wide[1])}", fontsize=9)
    cells[-1].set_xlabel(f"{along} [m]", fontsize=8)
    for cell in cells:
        cell.axvline(0, color="black", linewidth=0.6, linestyle=":")
        cell.tick_params(labelsize=7)
        cell.grid(alpha=0.3)
    cells[0].set_ylabel("loss", fontsize=8)
    return figure


def deep_minima(values: NDArray) -> int:
    """Minima inside a curve that a descent would have to climb a thousandth of its span out of."""
    return len(find_peaks(-values, prominence=_SHALLOW * float(np.ptp(values)))[0])
