"""Figures of rooms from above: path gain, a panel's places, located transmitters."""

from collections.abc import Mapping

from jaxtyping import Float64
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from invertwin.links import MapPlane
from invertwin.plotting.coverage import coverage, project_edges
from invertwin.plotting.figures import PALETTE, legible, numbers, row_of_axes
from invertwin.scene import Scene

_MARKS = (("*", "#c0143c"), ("+", PALETTE[1]), (".", PALETTE[2]))


def floor_plan(
    levels: Mapping[str, Float64[Tensor, "x y"]],
    plane: MapPlane,
    scene: Scene,
    tx: Float64[Tensor, "3"],
    panel: Float64[Tensor, "3"],
) -> Figure:
    """Path gain at one height, side by side, with the walls that are there.

    Args:
        levels: [dB], by title.
        plane: Cells of the maps.
        scene: Its objects are cut at the height of the plane.
        tx, panel: Where they stand [m].
    """
    figure = coverage(levels, plane, scene=scene)
    for axes, title in zip(figure.axes, levels, strict=False):
        axes.plot(*numbers(tx)[:2], "^", color="white", markeredgecolor="black", label="sender")
        if title != next(iter(levels)):
            axes.plot(*numbers(panel)[:2], "s", color=PALETTE[1], label="panel")
        axes.legend(fontsize=8, loc="upper left")
    return figure


def placements(
    positions: Float64[Tensor, " place"],
    levels: Float64[Tensor, " place"],
    search_ends: Float64[Tensor, "start 2"],
) -> Figure:
    """The aim over the place of a panel, and where searches have ended.

    Args:
        positions: Places on the path [m].
        levels: The best of a grid at each [dB].
        search_ends: Place [m] and level [dB] of every search.
    """
    figure, (axes,) = row_of_axes(1, (8, 3.3))
    label = "best of the grid at this place"
    axes.plot(numbers(positions), numbers(levels), color=PALETTE[0], label=label)
    label = "found by gradient, phases fitted"
    axes.plot(*numbers(search_ends).T, "o", color=PALETTE[1], label=label)
    axes.set(xlabel="place along the walls [m]", ylabel="worst receivers [dB]")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def transmitter_fits(
    scene: Scene,
    height: float,
    positions: Mapping[str, Float64[Tensor, "place 3"]],
    fits: Float64[Tensor, "fit 2 3"],
) -> Figure:
    """Plot starts and ends of fits of a transmitter on a floor plan.

    Args:
        scene: Its objects are cut at the height.
        height: [m].
        positions: Further places by title, such as the receivers, the truth and what was found [m].
        fits: Start and end of each [m].
    """
    figure, (axes,) = row_of_axes(1, (6.4, 4.6))
    plane = MapPlane.horizontal([0.0, 0.0], [1.0, 1.0], height, 1.0)
    axes.add_collection(LineCollection(project_edges(scene, plane), colors="0.45", linewidths=1))
    ways = numbers(fits)[..., :2]
    axes.add_collection(LineCollection([*ways], colors="0.75", linewidths=0.8))
    axes.plot(*ways[:, 0].T, "o", color="0.6", markersize=4, label="starts")
    axes.plot(*ways[:, 1].T, "o", color=PALETTE[0], markersize=5, label="ends")
    for (title, some), style in zip(positions.items(), _MARKS, strict=False):
        axes.plot(*numbers(some)[:, :2].T, style[0], color=style[1], label=legible(title))
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
