"""Pictures and tables of values in notebooks, and the viewer of a scene."""

import base64
import html
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from invertwin import plotting
from invertwin.capture import Capture, search_ranges
from invertwin.channel import Grid
from invertwin.inversion import Reconstruction
from invertwin.plotting.figures import numbers, row_of_axes
from invertwin.radar import Radar, SampledWaveform
from invertwin.scene import Scene
from invertwin.scene.shape_models.density import replace_clouds
from invertwin.viewer.display import Display
from invertwin.viewer.layers import build_display
from invertwin.viewer.link import InteractiveSensor
from invertwin.viewer.server import Viewer


def show(
    scene: Scene, *, radar: Radar | None = None, grid: Grid | None = None, **options: Any
) -> Viewer:
    """A viewer of a scene; with a radar and its grid, one whose map follows what is moved.

    Args:
        scene: What is shown.
        radar: What looks at it.
        grid: Bins of its map.
        options: As of `Viewer`.

    Raises:
        InputError: No `viser`, or a host without a token.
    """
    display: Display = build_display(scene, {} if radar is None else {"": (radar, grid)}, "scene")
    links = {} if radar is None or grid is None else {"": InteractiveSensor(scene, radar, grid)}
    viewer = Viewer(display, links, **options)
    print(f"open {viewer.address}")
    return viewer


def register_formatters() -> None:
    """Register with a running IPython the pictures of scenes, radars, captures and fits.

    The package's menu calls it. The values themselves know nothing of notebooks.
    """
    shell = sys.modules["IPython"].get_ipython()
    if shell is None:
        return
    formatter = shell.display_formatter.formatters["text/html"]
    for kind, page in PAGES.items():
        formatter.for_type(kind, page)


def scene_html(scene: Scene) -> str:
    """Three views of a scene, and its objects.

    Args:
        scene: The scene.
    """
    surfaces = replace_clouds(scene)
    rows = []
    for name, item in scene.objects.items():
        size = " × ".join(f"{x:.3g}" for x in np.ptp(numbers(surfaces[name].vertices), axis=0))
        middle = ", ".join(f"{x:.3g}" for x in item.center.detach().tolist())
        rows.append((name, len(item.mesh.faces), type(item.material).__name__, size, middle))
    heads = ("object", "triangles", "material", "size [m]", "middle [m]")
    return _figure_and_table(plotting.scene(surfaces), "three views of the scene", rows, heads)


def radar_html(radar: Radar) -> str:
    """The virtual array of a radar, and what it resolves.

    Args:
        radar: The radar.
    """
    places = 1e3 * radar.virtual_positions.detach()
    figure, (axes,) = row_of_axes(1, (4, 2.5))
    axes.plot(places[:, 1].numpy(), places[:, 2].numpy(), ".")
    axes.set(xlabel="y [mm], to the left", ylabel="z [mm]", title="virtual array")
    axes.invert_xaxis()
    return _figure_and_table(figure, "places of the virtual elements", _radar_rows(radar))


def capture_html(capture: Capture) -> str:
    """The first frame of a capture, and what recorded it.

    Args:
        capture: The capture.
    """
    radar = capture.radar()
    if "beat" in capture.dataset:
        grid = radar.grid(*search_ranges(capture, None, None))
        figure = plotting.spectrum({"first frame": capture.frames([0]).spectrum(grid)}, grid)
    else:
        figure, (axes,) = row_of_axes(1, (5, 2.5))
        level = 20 * torch.log10(capture.range_profile[0].abs().clamp_min(1e-30))
        axes.plot(capture.ranges.numpy(), level.numpy())
        axes.set(xlabel="range [m]", ylabel="power [dB]", title="first frame")
    return _figure_and_table(figure, "map of the first frame", _radar_rows(radar))


def reconstruction_html(found: Reconstruction) -> str:
    """The loss of a fit over its steps, and what was found.

    The verdict and the error bars are shown once they have been asked for: they take time.

    Args:
        found: The fit.
    """
    rows: list[tuple[Any, ...]] = [("why it stopped", found.status), ("steps", found.steps)]
    rows.append(("loss", f"{found.loss:.4g}"))
    known = vars(found)
    bars = known["uncertainty"].interval() if "uncertainty" in known else {}
    rows += [("verdict", known["verdict"].word)] if "verdict" in known else []
    for name, value in found.history[-1]["values"].items():
        numbers = torch.as_tensor(value).reshape(-1)
        if len(numbers) <= 16:
            rows.append((name, ", ".join(f"{x:.4g}" for x in numbers.tolist())))
    rows += [(f"{name}, within (95 %)", f"± {width:.2g}") for name, width in bars.items()]
    figure = plotting.convergence({"loss": [[step["loss"] for step in found.history]]})
    return _figure_and_table(figure, "loss over the steps", rows)


def _radar_rows(radar: Radar) -> list[tuple[str, Any]]:
    waveform = radar.waveform
    rows: list[tuple[str, Any]] = [
        ("positions", radar.frame_count),
        ("transmitters × receivers", " × ".join(map(str, radar.shape[1:]))),
        ("waveform", type(waveform).__name__),
        ("middle of the band [GHz]", f"{waveform.center_frequency / 1e9:.4g}"),
        ("range cell [m]", f"{waveform.range_resolution:.4g}"),
        ("cells in u and v", " × ".join(f"{x:.3g}" for x in radar.beamwidth)),
    ]
    if isinstance(waveform, SampledWaveform):
        rows.append(("unambiguous range [m]", f"{waveform.max_range:.4g}"))
    return rows


def _figure_and_table(
    figure: Figure,
    alt: str,
    rows: Iterable[Sequence[Any]],
    heads: Sequence[str] = ("quantity", "value"),
) -> str:
    """A picture above a table; texts of users are escaped."""
    png = base64.b64encode(plotting.png_bytes(figure)).decode()

    def tag_cells(row: Sequence[Any], tag: str) -> str:
        return "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for cell in row)

    body = "".join(f"<tr>{tag_cells(row, 'td')}</tr>" for row in rows)
    return (
        f'<img alt="{alt}" src="data:image/png;base64,{png}" style="max-width: 100%">'
        f"<table><thead><tr>{tag_cells(heads, 'th')}</tr></thead><tbody>{body}</tbody></table>"
    )


PAGES: dict[type, Callable[[Any], str]] = {
    Scene: scene_html,
    Radar: radar_html,
    Capture: capture_html,
    Reconstruction: reconstruction_html,
}
"""Type of a value → the function that returns its picture and table as HTML."""
