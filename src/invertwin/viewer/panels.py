"""Maps in the side panel: measured, simulated, and their difference, over azimuth and range."""

import base64
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

MEASURED, SIMULATED, RESIDUAL = "measured", "simulated", "residual"
POWER_COLORMAP, RESIDUAL_COLORMAP = COLORMAPS = "viridis", "RdBu_r"  # of power, of residuals
MIN_LEVEL_DB = -40.0  # dB below the peak
MAX_RESIDUAL_DB = 15.0  # dB of a residual
_DEGREE_STEPS = (5, 10, 15, 30)  # between ticks of the azimuth [°]
_MAX_TICKS = 7
_CURSOR_COLOR = (255, 60, 60)


class MapPanels:
    """Figures of maps with axes in metres and degrees, a colour bar, and a cursor in all of them.

    Axes are drawn once for each sensor; bins are painted into them, which is quick.

    Args:
        gui: Panel of a viser server.
        shown: Names of the maps.
    """

    def __init__(self, gui: Any, shown: Sequence[str]) -> None:
        self._images = {name: gui.add_html("", visible=False) for name in shown}
        self._axes: dict[str, tuple[NDArray[np.uint8], slice, slice]] = {}
        self._known: dict[str, tuple[Any, Any]] = {}

    def draw_axes(self, ranges: Sequence[float], across: Sequence[float]) -> None:
        """Draw the axes of a sensor's maps.

        Args:
            ranges: Range of each row [m].
            across: Direction cosine u of each column.
        """
        self._known.clear()
        self._axes = {name: _draw_axes(name, ranges, across) for name in self._images}

    def show(self, maps: Mapping[str, NDArray[np.float32]], chosen: tuple[int, int] | None) -> None:
        """Draw maps, each below its own peak; the residual where both are known.

        Args:
            maps: Power [range, u], by the name of the map.
            chosen: Bin of the cursor.
        """
        from matplotlib import colormaps

        levels, shown = {name: relative_decibels(own) for name, own in maps.items()}, POWER_COLORMAP
        colors = {k: colormaps[shown](1 - level / MIN_LEVEL_DB) for k, level in levels.items()}
        if MEASURED in levels and SIMULATED in levels:
            apart = levels[MEASURED] - levels[SIMULATED]
            colors[RESIDUAL] = colormaps[RESIDUAL_COLORMAP](0.5 + apart / (2 * MAX_RESIDUAL_DB))
        for name, image in self._images.items():
            image.visible = name in colors
            if name in colors and not self._is_current(name, maps.get(name), chosen):
                painted = _paint_bins(*self._axes[name], colors[name], chosen)
                image.content = _image_html(name, painted)

    def _is_current(self, name: str, power: NDArray[np.float32] | None, chosen: Any) -> bool:
        """Return True if a figure is up to date, and mark it so."""
        before, cursor = self._known.get(name, (None, None))
        self._known[name] = power, chosen
        same = before is not None and power is not None and np.array_equal(before, power)
        return same and cursor == chosen


def relative_decibels(power: NDArray[np.float32]) -> NDArray[Any]:
    """A map below its own peak [dB], none below the darkest.

    Args:
        power: The map, or several of them [..., range, u].
    """
    peak = power.max((-2, -1), keepdims=True)
    level = 10 * np.log10(np.maximum(power / np.where(peak > 0, peak, 1.0), 1e-30))
    return level.clip(MIN_LEVEL_DB, 0.0)


def _draw_axes(
    name: str, ranges: Sequence[float], across: Sequence[float]
) -> tuple[NDArray[np.uint8], slice, slice]:
    """Return an empty figure, and the rows and columns of its pixels that bins fill."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from invertwin.plotting.maps import bin_edges

    figure = Figure((3.2, 2.5), dpi=200)
    axes = figure.add_axes((0.19, 0.19, 0.6, 0.7))
    title, low, high, cmap = f"{name} [dB below peak]", MIN_LEVEL_DB, 0.0, POWER_COLORMAP
    if name == RESIDUAL:
        title, cmap = f"{MEASURED} over {SIMULATED} [dB]", RESIDUAL_COLORMAP
        low, high = -MAX_RESIDUAL_DB, MAX_RESIDUAL_DB
    extent = (*bin_edges(across), *bin_edges(ranges))
    image = axes.imshow(np.zeros((1, 1)), cmap, aspect="auto", vmin=low, vmax=high, extent=extent)
    figure.colorbar(image, cax=figure.add_axes((0.82, 0.19, 0.03, 0.7)))
    sines = np.clip(extent[:2], -1.0, 1.0)
    span = float(np.ptp(np.rad2deg(np.arcsin(sines))))
    step = next((s for s in _DEGREE_STEPS if span / s < _MAX_TICKS), _DEGREE_STEPS[-1])
    angles = np.arange(-90, 91, step)
    places = np.sin(np.deg2rad(angles))
    inside = (places >= sines[0]) & (places <= sines[1])
    axes.set_xticks(places[inside], labels=[f"{angle}" for angle in angles[inside]])
    axes.invert_xaxis()  # the left of the radar is on the left
    axes.set(xlabel="azimuth [°]", ylabel="range [m]")
    axes.set_title(title, fontsize=10)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())[..., :3]
    box = axes.get_window_extent()
    rows = slice(round(len(drawn) - box.y1), round(len(drawn) - box.y0))
    return drawn.copy(), rows, slice(round(box.x0), round(box.x1))


def _image_html(name: str, pixels: NDArray[np.uint8]) -> str:
    """An image within its element: viser's own are fetched, and may be replaced before."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png", compress_level=1)
    data = base64.b64encode(file.getvalue()).decode()
    return f'<img alt="{name} map" style="width: 100%" src="data:image/png;base64,{data}">'


def _paint_bins(
    figure: NDArray[np.uint8], rows: slice, columns: slice, colors: Any, chosen: Any
) -> NDArray[np.uint8]:
    """Return a figure with its bins, the farthest range on top and the largest u on the left."""
    sizes = rows.stop - rows.start, columns.stop - columns.start
    shares = [np.arange(n)[::-1] * bins // n for n, bins in zip(sizes, colors.shape, strict=False)]
    painted = figure.copy()
    bins = (255 * colors[shares[0][:, None], shares[1], :3]).astype(np.uint8)
    if chosen is not None:
        middles = [np.nonzero(s == k)[0] for s, k in zip(shares, chosen, strict=True)]
        row, column = (int(pixels[len(pixels) // 2]) for pixels in middles)
        bins[max(0, row - 1) : row + 1] = bins[:, max(0, column - 1) : column + 1] = _CURSOR_COLOR
    painted[rows, columns] = bins
    return painted
