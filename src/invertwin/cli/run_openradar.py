"""`invertwin reconstruct` of a recording of movers: the strongest one becomes a moving twin."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from invertwin.capture import ChirpData
from invertwin.channel import Grid
from invertwin.cli import build, pictures
from invertwin.cli.doppler_maps import Panel, doppler_maps, panels, panels_picture
from invertwin.cli.fits.fitting import Bar
from invertwin.cli.pictures import U_LABEL
from invertwin.cli.recordings import recorded_chirps
from invertwin.cli.report import Again, Picture, Table, report_html
from invertwin.cli.run_file import about, need, to_toml
from invertwin.cli.runs import RunFolder
from invertwin.cli.schema import RunFile
from invertwin.errors import InputError
from invertwin.inversion.mover import (
    Echo,
    MotionMap,
    MovingBody,
    body_power,
    fit_mover,
    motion_map,
    pattern_correlation,
    strongest_mover,
)
from invertwin.radar.motion import Chirps
from invertwin.radar.radar import Radar
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh

_CELLS = 4  # about the mover, that twin and point are scored on
_DRAWN_CELLS = 8
_RAYS = 10_000  # of a map that is scored or drawn
_SCALES = {
    "magnitude": "magnitude (√power)",
    "power": "power",
    "level": "level (dB, down to −40 dB)",
}
_LABELS = {
    "mover_range_m": "strongest mover, range [m]",
    "mover_velocity_m_s": "its range rate, away > 0 [m/s]",
    "mover_azimuth_deg": "its azimuth [°]",
    "phase_coherence": "phase coherence of its channels (1 = a plane wave)",
    "twin_correlation": "twin and recording, correlation of the magnitudes",
    "bare_psf_correlation": "a point target at the peak instead",
    "heldout_twin_correlation": "second half of the frame, predicted by a twin of the first half",
    "heldout_bare_psf_correlation": "the same with a point target of the first half",
    "fit_seconds": "time of the fits [s]",
    "wall_seconds": "time of all, pictures included [s]",
}
_TWIN_LABELS = {
    "position_m": "centre (right, up, ahead) [m]",
    "velocity_m_s": "velocity [m/s]",
    "spin_rad_s": "turn about the axis up [rad/s]",
    "extent_m": "size across, up, along the line of sight [m]",
    "diffuse": "diffuse share of the echo",
}


@dataclass(frozen=True)
class _Frame:
    """Chirps in a row.

    Attributes:
        beat: [chirp, tx, rx, sample].
        found: Their map.
        echo: The strongest mover in it.
    """

    beat: Tensor
    found: MotionMap
    echo: Echo


@dataclass(frozen=True)
class _Twin:
    """A fitted body, and the seconds that it took."""

    body: MovingBody
    losses: list[float]
    seconds: float


def run_openradar(run: RunFile, folder: RunFolder, console: Console) -> tuple[list[Table], str]:
    """Finds the strongest mover, fits a twin to it, writes the folder.

    Returns:
        The tables to print and the outcome.

    Raises:
        InputError: A run file that asks for something else, or no recording.
    """
    begin = time.perf_counter()
    data, radar, grid = _recorded(run)
    scene, table = build.scene(run), _mover(run)
    chirps = data.settings.chirps
    whole = _frame(run, data.beat[0], radar, grid, chirps)
    twin = _fitted(run, table, scene, whole, "twin", console)
    seen = whole.found.around(whole.echo, _CELLS)
    with torch.no_grad():
        shown = body_power(twin.body, scene, seen, samples=_RAYS, seed=run.seed)
    metrics: dict[str, Any] = {
        "task": run.task,
        **_echo_metrics(whole.echo),
        **_scores("", shown, seen.of_point(whole.echo), seen),
    }
    halves, half_twin = _heldout(run, table, scene, data, radar, grid, console)
    metrics |= halves
    metrics["twin"] = twin.body.values(scene)
    metrics["loss"] = twin.losses[-1]
    metrics["steps"] = len(twin.losses)
    metrics["fit_seconds"] = twin.seconds + half_twin.seconds
    moving = twin.body.moving(scene)
    drawn = _pictures(run, data, whole, twin, half_twin, scene, moving)
    for name, picture in drawn.items():
        folder.write_bytes(f"{name}.png", picture.png)
    save_mesh(folder.file("twin.ply"), moving)
    metrics["wall_seconds"] = time.perf_counter() - begin
    folder.write_json("metrics.json", metrics)
    tables = _tables(metrics)
    outcome = _outcome(metrics)
    again = Again("reconstruct run.toml", {"run.toml": to_toml(run)})
    title = run.title or "A moving twin"
    parts = [tables[0], *drawn.values(), *tables[1:]]
    folder.write_text("report.html", report_html(title, outcome, run.note, parts, again))
    return tables, outcome


def _recorded(run: RunFile) -> tuple[ChirpData, Radar, Grid]:
    data = need(run, "data", "reconstruct")
    for name in ("radar", "starts", "calibration", "landscape", "truth"):
        if getattr(run, name):
            raise InputError(
                f"{name}: expected no such section with data.kind = openradar, got one; remove it: "
                "the recording brings its radar along, and nothing in it was surveyed"
            )
    found = recorded_chirps(data)
    chirps = found.chirps
    with about("data.board"):
        radar = found.radar()
    return chirps, radar, build.grid(need(run, "grid", "reconstruct"), radar)


def _mover(run: RunFile) -> Any:
    table = need(run, "parameters", "reconstruct")[0]
    if len(run.parameters) > 1 or table.kind != "mover":
        kinds = ", ".join(parameter.kind for parameter in run.parameters)
        raise InputError(
            f"parameters: expected one of kind mover with data.kind = openradar, got {kinds}; "
            "leave only that"
        )
    return table


def _frame(run: RunFile, beat: Tensor, radar: Radar, grid: Grid, chirps: Chirps) -> _Frame:
    oversample = math.ceil(need(run, "grid", "reconstruct").oversample)
    found = motion_map(beat, radar, grid, chirps, oversample)
    return _Frame(beat, found, strongest_mover(beat, found))


def _fitted(
    run: RunFile, table: Any, scene: Scene, frame: _Frame, name: str, console: Console
) -> _Twin:
    settings = need(run, "reconstruct", "reconstruct")
    begin = time.perf_counter()
    with about(f"scene.{table.object}"):
        body = MovingBody(table.object, scene, frame.found.radar, frame.echo)
    bar = Bar(console, name, settings.steps)
    with bar:
        losses = fit_mover(
            body,
            scene,
            frame.found.around(frame.echo, table.cells),
            steps=settings.steps,
            samples=settings.samples,
            seed=run.seed,
            optimizer=build.optimizer(run.optimizer),
            progress=bar.advance,
        )
    return _Twin(body, losses, time.perf_counter() - begin)


def _heldout(
    run: RunFile,
    table: Any,
    scene: Scene,
    data: ChirpData,
    radar: Radar,
    grid: Grid,
    console: Console,
) -> tuple[dict[str, Any], _Twin]:
    """Fits the first half of the chirps and predicts the second, with a twin and with a point.

    Both move on with the velocities of the first half; nothing is taken from the second.
    """
    chirps, count = data.settings.chirps, data.settings.loops // 2
    half = replace(chirps, count=count)
    first = _frame(run, data.beat[0, :count], radar, grid, half)
    twin = _fitted(run, table, scene, first, "twin of the first half", console)
    later = float(chirps.times(len(radar.transmitters.positions))[count, 0])
    second = motion_map(
        data.beat[0, count : 2 * count], radar, grid, half, len(first.found.rates) // count
    ).around(first.echo, _CELLS, later)
    with torch.no_grad():
        shown = body_power(twin.body, scene, second, samples=_RAYS, seed=run.seed, time=later)
    return _scores("heldout_", shown, second.of_point(first.echo, later), second), twin


def _echo_metrics(echo: Echo) -> dict[str, Any]:
    return {
        "mover_range_m": echo.range,
        "mover_velocity_m_s": echo.rate,
        "mover_azimuth_deg": math.degrees(math.asin(max(-1.0, min(1.0, echo.u)))),
        "phase_coherence": echo.coherence,
    }


def _scores(prefix: str, twin: Tensor, point: Tensor, seen: MotionMap) -> dict[str, Any]:
    """Correlations of twin and point with the recording, on the same cells and scales."""
    found = {
        scale: {
            name: float(pattern_correlation(power, seen.power, scale))
            for name, power in (("twin", twin), ("bare_psf", point))
        }
        for scale in _SCALES
    }
    headline = {f"{prefix}{name}_correlation": v for name, v in found["magnitude"].items()}
    return {**headline, f"{prefix}correlations": found}


def _pictures(
    run: RunFile,
    data: ChirpData,
    whole: _Frame,
    twin: _Twin,
    half: _Twin,
    scene: Scene,
    moving: Scene,
) -> dict[str, Picture]:
    radar, grid, chirps = whole.found.radar, whole.found.grid, whole.found.chirps
    wide = whole.found.around(whole.echo, _DRAWN_CELLS)
    with torch.no_grad():
        shown = body_power(twin.body, scene, wide, samples=_RAYS, seed=run.seed)
    maps = {"recorded": wide.power, "twin": shown, "point target": wide.of_point(whole.echo)}
    start = MovingBody(twin.body.object, scene, radar, whole.echo).moving(scene)
    drawings = {
        name: pictures.Drawing(
            pictures.meshes_of(drawn), [twin.body.object], {}, radar.positions.numpy()
        )
        for name, drawn in (("start", start), ("twin", moving))
    }
    losses = {"twin": [twin.losses], "twin of the first half": [half.losses]}
    return {
        "recording": Picture(
            "The recording",
            panels_picture(panels(doppler_maps(data.beat, radar, grid, chirps))),
            "Range rates are modulo the unambiguous span; phases that transmitters in turn add to "
            "movers are taken out.",
        ),
        "twin_doppler": Picture(
            "The mover over range and range rate", panels_picture(_over_rates(maps, wide))
        ),
        "twin_direction": Picture(
            "The mover over range and azimuth",
            panels_picture(_over_directions(maps, wide)),
            "Each map in dB below its own peak, the strongest over the axis that is not shown.",
        ),
        "scene": Picture(
            "Where it is",
            pictures.scene_picture(drawings, pictures.frame_of(radar)),
            "In the middle of the frame. Place and motion in height are given, not found: one row "
            "of antennas does not resolve it.",
        ),
        "loss": Picture("1 − correlation of the magnitudes", pictures.loss_picture(losses)),
    }


def _over_rates(maps: Mapping[str, Tensor], wide: MotionMap) -> dict[str, Panel]:
    ranges, rates = wide.grid.ranges.numpy(), wide.rates.numpy()
    return {
        name: Panel(power.amax((2, 3)).T.numpy(), ranges, rates, "range rate [m/s], away > 0")
        for name, power in maps.items()
    }


def _over_directions(maps: Mapping[str, Tensor], wide: MotionMap) -> dict[str, Panel]:
    ranges, cosines = wide.grid.ranges.numpy(), wide.grid.u.numpy()
    return {
        name: Panel(power.amax((0, 3)).numpy(), ranges, cosines, U_LABEL)
        for name, power in maps.items()
    }


def _tables(metrics: Mapping[str, Any]) -> list[Table]:
    rows = [[label, metrics[key]] for key, label in _LABELS.items()]
    scales: list[Sequence[Any]] = [
        [
            label,
            *(
                metrics[f"{prefix}correlations"][scale][name]
                for prefix in ("", "heldout_")
                for name in ("twin", "bare_psf")
            ),
        ]
        for scale, label in _SCALES.items()
    ]
    columns = ["map", "twin", "point", "twin, second half", "point, second half"]
    twin = [[label, metrics["twin"][key]] for key, label in _TWIN_LABELS.items()]
    return [
        Table("Result", ["quantity", "value"], rows),
        Table(
            "Correlation with the recording",
            columns,
            scales,
            f"Pearson's, over {_CELLS} range and Doppler cells to either side of the mover and all "
            "directions, without what stands still. The twin is fitted to the whole frame (first "
            "columns) or to its first half alone (last columns).",
        ),
        Table("The twin", ["quantity", "value"], twin),
    ]


def _outcome(metrics: Mapping[str, Any]) -> str:
    return (
        f"The strongest mover is {metrics['mover_range_m']:.2f} m away; its twin correlates "
        f"{metrics['twin_correlation']:.3f} with the recording, a point target "
        f"{metrics['bare_psf_correlation']:.3f}."
    )
