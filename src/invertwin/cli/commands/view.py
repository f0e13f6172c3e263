"""`invertwin view`: a run folder, a run file or a capture in the browser, or on a page."""

import io
import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from invertwin import viewer
from invertwin.capture import Capture, search_ranges
from invertwin.channel import Grid
from invertwin.cli.fits.displays import VIEW_FILE, placement_layers
from invertwin.cli.fits.radar_models import build_sensors
from invertwin.cli.inputs import find_viewed_file
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.motion_tables import build_moving_scene
from invertwin.errors import InputError, locate_errors
from invertwin.radar import Radar
from invertwin.scene import Scene
from invertwin.storage.folders import write_text_file
from invertwin.storage.untrusted import convert_read_errors, read_text

_TIMES, _TIME_STEP = 48, 0.05  # steps in time of what moves, and their distance [s]


def run_view(
    target: Path, console: Console, *, host: str, port: int, token: str | None, record: Path | None
) -> None:
    """Show a target until Ctrl-C, or write a page of it.

    Args:
        target: A run folder, a run file or a capture.
        console: Console that prints the address.
        host, port, token: See ``Viewer``.
        record: Path of the page; what is there is replaced.

    Raises:
        InputError: A target that is none of these, or a host without a token.
    """
    if record is None:
        viewer.AccessGuard(host, token)  # its errors come before any work
    display, links = load_display(target)
    if record is not None:
        write_text_file(record, viewer.page_html(display, links))
        console.print(f"written: {record}", markup=False, soft_wrap=True)
        return
    with viewer.Viewer(display, links, host=host, port=port, token=token) as shown:
        console.print(f"open {shown.address} (Ctrl-C ends)", markup=False, soft_wrap=True)
        console.file.flush()  # a log shows it while the viewer runs
        with suppress(KeyboardInterrupt):  # that is how it is meant to end
            shown.wait()


def load_display(target: Path) -> tuple[viewer.Display, dict[str, viewer.InteractiveSensor]]:
    """Load the display of a target, and by sensor the radars that a viewer can move.

    Args:
        target: A run folder, a run file or a capture.

    Raises:
        InputError: The target is none of these.
    """
    file = find_viewed_file(target)
    if file.suffix == ".nc":
        return _display_of_capture(file), {}
    return _display_of_run(file, target if target.is_dir() else None)


def _display_of_run(
    file: Path, folder: Path | None
) -> tuple[viewer.Display, dict[str, viewer.InteractiveSensor]]:
    run: RunFile = load_run(file)
    with locate_errors(file):
        scene, truth = build.scene(run), build.true_scene(run)
        radars = _build_radars(run)
        names = run.fitted_objects or list(run.truth)
        # Without a fit, show objects at their current pose.
        is_fit = folder is not None and (folder / VIEW_FILE).is_file()
        own = scene if is_fit else truth
        depth = run.reconstruct.depth if run.reconstruct else getattr(run.data, "depth", 1)
        links = {
            name: viewer.InteractiveSensor(own, radar, grid, depth)
            for name, (radar, grid) in radars.items()
            if grid is not None
        }
        display = viewer.build_display(own, radars, run.title or file.stem, fitted=names)
        steps = [] if is_fit else _steps_in_time(run, own)
        display = replace(display, steps=steps, shows_start=True)
        antennas = [] if is_fit else _build_link_layers(run, own, folder)
    if folder is not None and is_fit:
        display = viewer.Display.load(folder / VIEW_FILE)
        for link in links.values():
            if display.steps:
                link.replace_meshes(display.steps[-1].bodies)
    elif folder is not None and (folder / "capture.nc").is_file() and "" in links:
        capture, grid = Capture.load(folder / "capture.nc"), links[""].grid
        maps = viewer.DisplayMaps.from_spectra({viewer.MEASURED: capture.spectrum(grid)}, grid)
        display = replace(display, maps={"": maps})
    answer = "" if folder is None else _read_answer(folder / "metrics.json")
    return replace(display, layers=[*display.layers, *antennas], answer=answer), links


def _read_answer(file: Path) -> str:
    """Read the sentence that a run found, with its verdict; empty if it says nothing."""
    if not file.is_file():
        return ""
    with convert_read_errors(file, "the metrics of a run"):
        found = json.loads(read_text(file, "the metrics of a run"))
        answer, verdict = (str(found.get(name, "")) for name in ("answer", "verdict"))
    return f"{answer}; the fit is {verdict}" if verdict else answer


def _steps_in_time(run: RunFile, scene: Scene) -> list[viewer.DisplayStep]:
    """Steps of what moves, at times from the start of the recording on."""
    moving = build_moving_scene(run, scene)
    if isinstance(moving, Scene):
        return []
    steps = list[viewer.DisplayStep]()
    with suppress(InputError):  # a trajectory ends
        for number in range(_TIMES):
            time = number * _TIME_STEP
            then = moving(time)
            bodies = {name: viewer.display_mesh(then[name]) for name in moving.motions}
            steps.append(viewer.DisplayStep(number, f"time {time:.2f} s", bodies))
    return steps


def _build_link_layers(run: RunFile, scene: Scene, folder: Path | None) -> list[Any]:
    """Antennas, paths, levels and metasurface of a run file of links; else none."""
    if run.placement is not None:
        table, coverage = run.placement, run.placement.coverage(scene, run.seed)
        return placement_layers(coverage, table.place(coverage, table.initial)(table.metasurface()))
    if run.map is None or run.transmitter is None:
        return []
    file, levels = None if folder is None else folder / "map.csv", None
    model = run.map.build()
    if file is not None and file.is_file():
        with convert_read_errors(file, "the map of a run"):
            rows = np.loadtxt(io.StringIO(read_text(file, "the map")), delimiter=",", skiprows=1)
            levels = rows[:, 3:].max(1).reshape(model.places.shape)
    return viewer.link_layers(scene, run.transmitter.build(), model, levels)


def _build_radars(run: RunFile) -> dict[str, tuple[Radar, Grid | None]]:
    """The radars of a run file with their bins, by name; none where it has no map of them."""
    if (run.observations or (run.data and run.grid)) and not run.map:
        return {name: (own.radar, own.grid) for name, own in build_sensors(run).items()}
    if run.radar is None:
        return {}
    radar = build.radar(run.radar)
    return {"": (radar, None if run.grid is None else build.grid(run.grid, radar))}


def _display_of_capture(file: Path) -> viewer.Display:
    capture = Capture.load(file)
    radar, grid = capture.radar(), None
    low, high = search_ranges(capture, None, None) if "beat" in capture.dataset else (0.0, 0.0)
    maps = {}
    if high > low:
        grid = radar.grid(low, high)
        maps[""] = viewer.DisplayMaps.from_spectra({viewer.MEASURED: capture.spectrum(grid)}, grid)
    display = viewer.build_display(None, {"": (radar, grid)}, file.name)
    return replace(display, layers=[*viewer.capture_layers(capture), *display.layers], maps=maps)
