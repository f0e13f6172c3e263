"""Figures of maps over range and direction or range rate: power in dB, derivatives.

And of a camera's images and their derivatives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from torch import Tensor

from invertwin.channel import Grid
from invertwin.checks import check_shape, check_some
from invertwin.inversion.confidence.realisations import coarsen_map
from invertwin.plotting.figures import add_colorbar, label_axes, numbers, row_of_axes, signed_colors
from invertwin.radar import DopplerMaps, Spectrogram

U_LABEL, V_LABEL = "direction cosine u (to the left)", "direction cosine v (up)"
RATE_LABEL = "range rate [m/s], away > 0"
_SIGNED_SHARE = 0.998  # of the bins have derivatives within the colours: a few may exceed them
_MIN_POWER = 1e-30  # power that stands for none in dB
_NOISE_MARGIN = 4.0  # power of an echo over the median of a map
_RANGE_MARGIN = 4  # bins that are shown before and behind echoes

Maps = Tensor | Mapping[str, Tensor]
"""Spectra [frame, range, u, v] by title, or a single one."""


@dataclass(frozen=True, eq=False)
class MapPanel:
    """A map with its axes; rows are ranges.

    Attributes:
        values: Power or derivative [range, across].
        ranges: Range of each row [m].
        across: Place of each column.
        label: Name of the axis across, with its unit.
    """

    values: Float[Tensor, "range across"]
    ranges: Float[Tensor, " range"]
    across: Tensor
    label: str


def spectrum(
    spectra: Maps, grid: Grid, *, relative: bool = True, dynamic_range: float = 40.0
) -> Figure:
    """Power maps side by side in dB, summed over frames and over the direction not shown.

    Range × azimuth is the upper row and range × elevation the lower one; a direction that the grid
    does not resolve has no row. Without any, range × frame is shown.

    Args:
        spectra: Power [frame, range, u, v], by title.
        grid: Bins of all maps.
        relative: Show each map below its own peak. False shows received over transmitted power,
            all maps on one scale.
        dynamic_range: Level of the brightest colour above the darkest [dB].
    """
    columns = {title: _views(power, grid) for title, power in _title_maps(spectra).items()}
    rows = len(next(iter(columns.values())))
    figure = Figure(figsize=(1.2 + 3.4 * len(columns), 3.3 * rows), layout="constrained")
    cells = figure.subplots(rows, len(columns), squeeze=False, sharey=True)
    drawn = [
        (cells[row, column], title if row == 0 else "", view)
        for column, (title, views) in enumerate(columns.items())
        for row, view in enumerate(views)
    ]
    _draw_decibels(figure, drawn, relative, dynamic_range)
    _crop_ranges(drawn, dynamic_range)
    return figure


def panels(maps: Mapping[str, MapPanel], *, dynamic_range: float = 40.0) -> Figure:
    """Power maps of different axes side by side, each in dB below its own peak.

    Args:
        maps: The maps, by title.
        dynamic_range: Level of the brightest colour above the darkest [dB].
    """
    figure, cells = row_of_axes(len(maps), (3.9 * len(maps), 3.6))
    drawn = [(cell, *item) for cell, item in zip(cells, maps.items(), strict=True)]
    _draw_decibels(figure, drawn, True, dynamic_range)
    _crop_ranges(drawn, dynamic_range)
    return figure


def range_doppler(maps: DopplerMaps) -> Figure:
    """Range × range rate of one frame, and range × direction: all echoes and moving targets."""
    return panels(doppler_panels(maps))


def spectrogram(found: Spectrogram) -> Figure:
    """Range rate over time of one frame, in dB below the peak.

    Args:
        found: Micro-Doppler, of `DopplerMaps`.
    """
    figure, (axes,) = row_of_axes(1, (6.4, 3.6))
    power = MapPanel(found.power.T, found.velocities, 1e3 * found.times, "time [ms]")
    _draw_decibels(figure, [(axes, "", power)], True, 40.0)
    axes.set_ylabel(RATE_LABEL, fontsize=8)
    return figure


def doppler_panels(maps: DopplerMaps) -> dict[str, MapPanel]:
    """The panels of `range_doppler`, to be shown beside others."""
    rates = MapPanel(maps.range_doppler.T, maps.grid.ranges, maps.velocities, RATE_LABEL)
    found = {"range and range rate": rates}
    found |= direction_panels("everything", maps.total_power, maps.grid)
    if maps.moving_power is not None:
        found |= direction_panels("what moves", maps.moving_power, maps.grid)
    return found


def direction_panels(
    title: str, power: Float[Tensor, "range u v"], grid: Grid
) -> dict[str, MapPanel]:
    """Range × azimuth and range × elevation, the strongest over the other direction.

    Args:
        title: Title of the first panel.
        power: Map.
        grid: Its bins; directions that it does not resolve have no panel.
    """
    found = {}
    if grid.u_count > 1:
        found[title] = MapPanel(power.amax(2), grid.ranges, grid.u, U_LABEL)
    if grid.v_count > 1:
        name = f"{title}, elevation" if found else title
        found[name] = MapPanel(power.amax(1), grid.ranges, grid.v, V_LABEL)
    return found


def gradient(
    derivatives: Maps,
    grid: Grid,
    *,
    label: str = "∂ power (received/sent) [1/m]",
    power: Float[Tensor, "frame range u v"] | None = None,
    own_scale: Mapping[str, Tensor] | None = None,
) -> Figure:
    """Derivatives of a map side by side: power grows with θ where red, and falls where blue.

    Shown is the first frame, summed over the direction that is not shown; all frames, where the
    grid resolves no direction.

    Args:
        derivatives: Derivatives [frame, range, u, v], by title, on one symmetric colour scale.
        grid: Bins of all maps.
        label: What the colours of derivatives mean, with the unit.
        power: The map itself, shown first, in dB below its peak.
        own_scale: Further maps of the same unit, such as an error, each on its own colour scale.
    """
    still = grid.u_count == grid.v_count == 1

    def first(values: Tensor) -> MapPanel:
        return _views(values if still else values[:1], grid)[0]

    shared = {title: first(values) for title, values in _title_maps(derivatives).items()}
    others = {title: first(values) for title, values in (own_scale or {}).items()}
    count = len(shared) + len(others) + (power is not None)
    figure, cells = row_of_axes(count, (1.2 + 2.9 * count, 3.3), sharey=True)
    cells[0].set_ylabel("range [m]", fontsize=8)
    if power is not None:
        _draw_decibels(figure, [(cells.pop(0), "power", first(power))], True, 30.0)
    scale = signed_colors((panel.values for panel in shared.values()), _SIGNED_SHARE)
    images = [
        _draw_image(cell, title, panel, numbers(panel.values), **scale)
        for cell, (title, panel) in zip(cells, shared.items(), strict=False)
    ]
    add_colorbar(figure, images[-1], cells[: len(shared)], label)
    for cell, (title, panel) in zip(cells[len(shared) :], others.items(), strict=True):
        scale = signed_colors([panel.values], _SIGNED_SHARE)
        image = _draw_image(cell, title, panel, numbers(panel.values), **scale)
        add_colorbar(figure, image, [cell], "own scale, same unit")
    return figure


def residuals(residual: Float[Tensor, "range u v"], grid: Grid, *, marked: float = 5.0) -> Figure:
    """Plot residuals of data from a twin, in standard deviations of its recordings.

    Of the direction that is not shown, the largest counts. Bins beyond ``marked`` are framed: red
    ones hold more power than the twin predicts, blue ones less.

    Args:
        residual: Residuals of coarse bins, see ``Verdict.residuals``.
        grid: Bins of the fitted map.
        marked: Standard deviations.
    """
    ranges, u, v = (coarsen_map(axis[None]) for axis in (grid.ranges, grid.u, grid.v))
    views = [(u, U_LABEL, 2), (v, V_LABEL, 1)]
    views = [view for view in views if len(view[0]) > 1] or [(u, U_LABEL, 2)]
    figure, cells = row_of_axes(len(views), (1.2 + 3.9 * len(views), 3.6), sharey=True)
    image = None
    for cell, (across, label, dim) in zip(cells, views, strict=True):
        largest = residual.abs().argmax(dim, keepdim=True)
        panel = MapPanel(residual.gather(dim, largest).squeeze(dim), ranges, across, label)
        scale = {"vmin": -2 * marked, "vmax": 2 * marked, "cmap": "RdBu_r"}
        image = _draw_image(cell, "", panel, numbers(panel.values), **scale)
        half = 0.5 * (bin_edges(ranges)[1] - bin_edges(ranges)[0]) / len(ranges)
        wide = 0.5 * (bin_edges(across)[1] - bin_edges(across)[0]) / len(across)
        for row, column in (panel.values.abs() > marked).nonzero().tolist():
            corner = float(across[column]) - wide, float(ranges[row]) - half
            cell.add_patch(Rectangle(corner, 2 * wide, 2 * half, fill=False, linewidth=0.8))
    cells[0].set_ylabel("range [m]", fontsize=8)
    add_colorbar(figure, image, cells, "data − twin [standard deviations]")
    return figure


def _title_maps(maps: Maps) -> Mapping[str, Tensor]:
    titled = maps if isinstance(maps, Mapping) else {"": maps}
    check_some(titled, "map", "give a tensor or a dict of them")
    return titled


def _views(power: Tensor, grid: Grid) -> list[MapPanel]:
    """Range × azimuth and range × elevation where they are resolved, else range × frame."""
    check_shape(power, (None, *grid.shape), "a map", "give the grid that it was made on")
    views = []
    if grid.u_count > 1:
        views.append(MapPanel(power.sum((0, 3)), grid.ranges, grid.u, U_LABEL))
    if grid.v_count > 1:
        views.append(MapPanel(power.sum((0, 2)), grid.ranges, grid.v, V_LABEL))
    frames = torch.arange(len(power), dtype=torch.float64)
    return views or [MapPanel(power.sum((2, 3)).T, grid.ranges, frames, "frame")]


def _draw_decibels(
    figure: Figure, panels: list[tuple[Any, str, MapPanel]], relative: bool, dynamic_range: float
) -> None:
    """Power of all panels in dB, with one bar for their colours."""
    powers = [numbers(panel.values) for _, _, panel in panels]
    top = 0.0 if relative else 10 * np.log10(max(max(p.max() for p in powers), _MIN_POWER))
    image = None
    for (cell, title, panel), power in zip(panels, powers, strict=True):
        peak = power.max() if relative and power.max() > 0 else 1.0
        level = 10 * np.log10(np.maximum(power / peak, _MIN_POWER))
        image = _draw_image(cell, title, panel, level, vmin=top - dynamic_range, vmax=top)
    assert image is not None
    label = "power [dB below peak]" if relative else "received over transmitted power [dB]"
    add_colorbar(figure, image, [cell for cell, *_ in panels], label)


def _crop_ranges(panels: list[tuple[Any, str, MapPanel]], dynamic_range: float) -> None:
    """Show the ranges that have echoes in any of the panels, and say of which these are a part."""
    ranges, kept = panels[0][2].ranges, torch.zeros(len(panels[0][2].ranges), dtype=torch.bool)
    for *_, panel in panels:
        power = panel.values.detach().cpu().amax(1)
        noise = _NOISE_MARGIN * panel.values.detach().cpu().median()
        kept |= power >= (power.max() * 10 ** (-dynamic_range / 10)).maximum(noise)
    rows = kept.nonzero()[:, 0].tolist() or [0, len(ranges)]
    shown = ranges[max(rows[0] - _RANGE_MARGIN, 0) : rows[-1] + 1 + _RANGE_MARGIN]
    label = f"range [m], cropped from {ranges[0]:.3g} to {ranges[-1]:.3g}"
    for cell, *_ in panels:
        cell.set_ylim(bin_edges(shown))
        if cell.get_subplotspec().is_first_col():
            cell.set_ylabel("range [m]" if len(shown) == len(ranges) else label, fontsize=8)


def _draw_image(cell: Any, title: str, panel: MapPanel, values: NDArray, **style: Any) -> Any:
    extent = (*bin_edges(panel.across), *bin_edges(panel.ranges))
    image = cell.imshow(values, origin="lower", aspect="auto", extent=extent, **style)
    label_axes(cell, title, panel.label)
    if panel.label in (U_LABEL, V_LABEL):
        _add_degrees(cell, "azimuth" if panel.label == U_LABEL else "elevation")
    if panel.label == U_LABEL:
        cell.invert_xaxis()  # the left of the radar is on the left
    return image


def _add_degrees(cell: Any, name: str) -> None:
    """Add an axis of degrees above the axis of a direction cosine."""
    ways = (
        lambda cosine: np.rad2deg(np.arcsin(np.clip(cosine, -1, 1))),
        lambda angle: np.sin(np.deg2rad(np.clip(angle, -90, 90))),
    )
    scale = cell.secondary_xaxis("top", functions=ways)
    # Towards the rim degrees are so near to each other that their numbers would overlap.
    scale.xaxis.set_major_formatter(lambda angle, _: f"{angle:g}" if abs(angle) < 65 else "")
    scale.tick_params(labelsize=7, pad=1)
    scale.set_xlabel(f"{name} [°]", fontsize=7, labelpad=2)


def bin_edges(positions: Tensor | Sequence[float]) -> tuple[float, float]:
    """Outer edges of the first and the last bin.

    Args:
        positions: Middles of the bins, evenly spaced.
    """
    half = 0.5 * float(positions[1] - positions[0]) if len(positions) > 1 else 0.5
    return float(positions[0]) - half, float(positions[-1]) + half


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
    check_some(every, "image", "give images or derivatives")
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
