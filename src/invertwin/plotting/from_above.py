"""Maps from above in metres: the power of all positions of a radar, put where it came from."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from invertwin.channel import Grid
from invertwin.links import MapPlane
from invertwin.plotting.coverage import coverage, project_edges
from invertwin.plotting.figures import legible, numbers
from invertwin.radar import Radar
from invertwin.scene import Scene

_CELLS = 200  # along the longer side
_MARKS = (("o", "white"), ("+", "#ff5a6e"))  # hollow, so that echoes stay in sight


def from_above(
    spectra: Mapping[str, Float[Tensor, "frame range u v"]],
    grid: Grid,
    radar: Radar,
    marks: Mapping[str, Scene | Float[Tensor, "point 3"]],
) -> Figure:
    """Plot maps from above in metres, each in dB below its peak, cropped to what is marked.

    Every cell lies at the mean height of the marks, and adds up what each position of the radar
    has received from its range and azimuth.

    Args:
        spectra: Power, by title.
        grid: Bins of all maps.
        radar: Of the frames.
        marks: Places [m], such as detections, and scenes, whose sharp edges and middles are drawn,
            by their names in the legend.
    """
    points = {name: _points(shown, corners=False) for name, shown in marks.items()}
    every = torch.cat([_points(shown, corners=True) for shown in marks.values()])
    low, high = every.amin(0), every.amax(0)
    margin = 0.05 * (high - low)[:2].max() + 8 * grid.range_step
    low, (x, y, _) = low - margin, (high - low + 2 * margin).tolist()
    low[2] = torch.cat([*points.values()])[:, 2].mean()
    sides = torch.tensor([[0.0, y, 0.0], [x, 0.0, 0.0]], dtype=torch.float64)
    count = (round(_CELLS * y / max(x, y)) + 1, round(_CELLS * x / max(x, y)) + 1)
    plane = MapPlane(low, *sides, count=count)
    levels = {title: _project(power, grid, radar, plane) for title, power in spectra.items()}
    figure = coverage(levels, plane, label="power [dB below peak]", dynamic_range=30.0)
    for axes in figure.axes[: len(levels)]:
        for (name, shown), (sign, tint) in zip(marks.items(), _MARKS, strict=False):
            lines = project_edges(shown, plane) if isinstance(shown, Scene) else []
            axes.add_collection(LineCollection(lines, colors=tint, linewidths=0.7))
            ahead, left, _ = numbers(points[name]).T
            axes.plot(left, ahead, sign, color=tint, ms=4, mfc="none", label=legible(name))
        # As a map lies on the table of somebody at the radar: ahead is up, the left is left.
        axes.set(xlim=axes.get_xlim()[::-1], xlabel="y [m], to the left", facecolor="0.6")
    figure.set_figheight(figure.get_figheight() + 0.4)  # for the legend
    handles, at = figure.axes[0].get_legend_handles_labels(), "outside lower center"
    figure.legend(*handles, loc=at, ncols=4, fontsize=8, facecolor="0.3", labelcolor="white")
    return figure


def _points(shown: Scene | Tensor, *, corners: bool) -> Tensor:
    """Return places, or the corners or the middles of a scene's objects [point, 3]."""
    if isinstance(shown, Scene):
        objects = shown.objects.values()
        shown = torch.cat([x.vertices if corners else x.center[None] for x in objects])
    return shown.detach().cpu()


def _project(power: Tensor, grid: Grid, radar: Radar, plane: MapPlane) -> Tensor:
    """Return the power of the cells of a plane in dB below its peak; NaN where none sees."""
    total = torch.full(plane.shape, torch.nan, dtype=torch.float64)
    flat, turns = power.detach().double().cpu().sum(3), radar.link().rotations
    for seen, place, turn in zip(flat, radar.positions, turns, strict=True):
        away = (plane.centres - place.detach().cpu()) @ turn.detach().cpu()
        distance = away.norm(dim=-1)
        row = ((distance - grid.range_start) / grid.range_step).round().long()
        column = ((away[..., 1] / distance - grid.u_start) / grid.u_step).round().long()
        column *= grid.u_count > 1
        inside = (away[..., 0] > 0) & (row >= 0) & (row < grid.range_count)
        inside &= (column >= 0) & (column < grid.u_count)
        total[inside] = total[inside].nan_to_num() + seen[row[inside], column[inside]]
    return 10 * (total / total.nan_to_num().max()).clamp(min=1e-9).log10()
