"""`invertwin view`: a run folder, a run file or a capture in the browser, or on a page."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from invertwin.capture import Capture, shown_ranges
from invertwin.channel import Grid
from invertwin.cli.fits.displays import VIEW
from invertwin.cli.fits.problem import fitted_objects, sensors_of
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.run_file import about_file, load_run
from invertwin.errors import InputError
from invertwin.radar import Radar
from invertwin.viewer import (
    MEASURED,
    Display,
    Guard,
    Link,
    Maps,
    Viewer,
    capture_layers,
    display_of,
    page_html,
)


def run_view(
    target: Path, console: Console, *, host: str, port: int, token: str | None, record: Path | None
) -> None:
    """Show a target until Ctrl-C, or write a page of it.

    Args:
        target: A run folder, a run file or a capture.
        console: Says where to look.
        host, port, token: See ``Viewer``.
        record: The page.

    Raises:
        InputError: A target that is none of these, or a host without a token.
    """
    if record is None:
        Guard(host, token)  # its errors come before any work
    display, links = shown_of(target)
    if record is not None:
        record.write_text(page_html(display, links), encoding="utf-8")
        console.print(f"written: {record}", markup=False, soft_wrap=True)
        return
    with Viewer(display, links, host=host, port=port, token=token) as viewer:
        console.print(f"open {viewer.address} (Ctrl-C ends)", markup=False, soft_wrap=True)
        console.file.flush()  # a log shows it while the viewer runs
        with suppress(KeyboardInterrupt):  # that is how it is meant to end
            viewer.wait()


def shown_of(target: Path) -> tuple[Display, dict[str, Link]]:
    """What there is to see of a target, and by sensor what lets people move it.

    Args:
        target: A run folder, a run file or a capture.

    Raises:
        InputError: It is none of these.
    """
    if target.is_dir():
        files = [target / name for name in ("run.toml", "twin.toml")]
        file = next((file for file in files if file.exists()), None)
        if file is None:
            raise InputError(
                f"expected a run folder with its run.toml, got {target} without one; name a folder "
                "of invertwin reconstruct, simulate or twin, a run file, or a capture (.nc)"
            )
        return _of_run(file, target)
    if target.suffix == ".nc":
        return _of_capture(target), {}
    if target.suffix == ".toml":
        return _of_run(target, None)
    raise InputError(
        f"expected a run folder, a run file (.toml) or a capture (.nc), got {target}; read other "
        "recordings with invertwin look, which writes a capture"
    )


def _of_run(file: Path, folder: Path | None) -> tuple[Display, dict[str, Link]]:
    run: RunFile = load_run(file)
    with about_file(file):
        scene, truth = build.scene(run), build.true_scene(run)
        radars = _radars(run)
        title = run.title or file.stem
        names = fitted_objects(run)
        # Without a fit what stands there is shown where it stands.
        own = truth if folder is None or not (folder / VIEW).exists() else scene
        depth = run.reconstruct.depth if run.reconstruct else getattr(run.data, "depth", 1)
        links = {
            name: Link(own, radar, grid, depth)
            for name, (radar, grid) in radars.items()
            if grid is not None
        }
        display = display_of(own, radars, title, fitted=names or list(run.truth))
    if folder is not None and (folder / VIEW).exists():
        display = Display.load(folder / VIEW)
        for link in links.values():
            if display.steps:
                link.take(display.steps[-1].bodies)
    elif folder is not None and (folder / "capture.nc").exists() and "" in links:
        capture, grid = Capture.load(folder / "capture.nc"), links[""].grid
        display = replace(display, maps={"": Maps.of({MEASURED: capture.spectrum(grid)}, grid)})
    return display, links


def _radars(run: RunFile) -> dict[str, tuple[Radar, Grid | None]]:
    """The radars of a run file with their bins, by name; none where it has no map of them."""
    if (run.observations or (run.data and run.grid)) and not run.map:
        return {name: (own.radar, own.grid) for name, own in sensors_of(run).items()}
    if run.radar is None:
        return {}
    radar = build.radar(run.radar)
    return {"": (radar, None if run.grid is None else build.grid(run.grid, radar))}


def _of_capture(file: Path) -> Display:
    capture = Capture.load(file)
    radar, grid = capture.radar(), None
    low, high = shown_ranges(capture, None, None) if "beat" in capture.dataset else (0.0, 0.0)
    maps = {}
    if high > low:
        grid = radar.grid(low, high)
        maps[""] = Maps.of({MEASURED: capture.spectrum(grid)}, grid)
    display = display_of(None, {"": (radar, grid)}, file.name)
    return replace(display, layers=[*capture_layers(capture), *display.layers], maps=maps)
