"""Ground plan of a twin: echoes, detected objects, and unobserved areas."""

import math

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from invertwin.discovery.outcome import Twin
from invertwin.discovery.search import outline_corners
from invertwin.plotting.figures import color, numbers, row_of_axes


def ground(twin: Twin, *, dynamic_range: float = 30.0) -> Figure:
    """The ground from above: where echoes come from, things with two deviations, blind places.

    Args:
        twin: With a picture.
        dynamic_range: Level of the brightest colour above the darkest [dB].
    """
    figure, (axes,) = row_of_axes(1, (7.5, 6.2))
    # As a map lies on the table of somebody at the radar: ahead is up, the left is left.
    axes.set(xlabel="y [m], to the left", ylabel="x [m]", aspect="equal", facecolor="black")
    axes.invert_xaxis()
    if twin.image is not None and len(twin.image.positions):
        places, strength = numbers(twin.image.positions), numbers(twin.image.strength)
        # A single glint would leave all else dark.
        top = max(float(np.quantile(strength, 0.998)), 1e-300)
        level = np.clip(10 * np.log10(np.maximum(strength, 1e-30) / top), -dynamic_range, 0)
        blind = numbers(twin.image.view_counts) == 0
        gaps = np.diff(np.unique(places[:, 1]))
        step = float(gaps.min()) if len(gaps) else 0.1
        side = 72 * 5 / max(float(np.ptp(places, axis=0).max()), 1e-6) * step
        style = {"s": max(1.3 * side, 1.0) ** 2, "marker": "s", "linewidths": 0}
        dots = axes.scatter(*places[~blind, ::-1].T, c=level[~blind], cmap="magma", **style)
        axes.scatter(*places[blind, ::-1].T, color="0.75", label="never seen", **style)
        figure.colorbar(dots, label="echoes, dB below bright ones", shrink=0.8)
    box = {"boxstyle": "round", "facecolor": "white", "alpha": 0.8, "linewidth": 0}
    for number, thing in enumerate(twin.objects):
        x, y = thing.position[:2].tolist()
        at = y, x
        tint = color(0) if thing.existence_probability > 0.5 else "0.5"
        if thing.shape is not None:
            corners = numbers(outline_corners(thing.shape))[:, ::-1]
            axes.plot(*np.concatenate([corners, corners[:1]]).T, color=tint, linewidth=1.5)
        spread = [thing.deviations.get(axis) for axis in "yx"]
        if None not in spread:
            width, height = (4 * float(value or 0.0) for value in spread)
            # Unlike a patch, it leaves the axes as they are: some deviations are of many metres.
            axes.add_artist(Ellipse(at, width, height, fill=False, color=tint))
        if thing.track is not None:
            path = numbers(thing.track.positions)[:, [1, 0]]
            axes.plot(*path.T, color=tint, linewidth=1.0, marker=".", markersize=3)
        if thing.velocity is not None:
            ahead, left = thing.velocity[:2].tolist()
            if math.hypot(ahead, left) > 0:
                axes.annotate("", (y + left, x + ahead), at, arrowprops={"arrowstyle": "->"})
        text = f"{thing.name}: {thing.kind}"
        side = 14 - 36 * (number % 2)  # names of neighbours are apart
        axes.annotate(text, at, (14, side), textcoords="offset points", fontsize=7, bbox=box)
    if twin.image is not None and bool((twin.image.view_counts == 0).any()):
        axes.legend(fontsize=7, loc="upper right")
    return figure
