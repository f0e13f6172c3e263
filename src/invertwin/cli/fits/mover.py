"""`invertwin reconstruct` of a mover: the strongest echo that moves becomes a moving twin."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from rich.console import Console
from torch import Tensor

from invertwin import plotting
from invertwin.capture import ChirpCapture
from invertwin.channel import Grid, Sampling
from invertwin.cli import build, sensors
from invertwin.cli.fits.fitting import Bar, watched
from invertwin.cli.recordings import chirp_capture
from invertwin.cli.report import Again, Picture, Table, report_html
from invertwin.cli.run_file import about, need, to_toml
from invertwin.cli.run_simulate import chirp_train
from invertwin.cli.runs import RunFolder
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.cli.shape_tables import Mover
from invertwin.errors import InputError
from invertwin.inversion import (
    CorrelationLoss,
    Echo,
    MovingBody,
    Observation,
    Reconstruction,
    Schedule,
    of_point,
    reconstruct,
    strongest_mover,
)
from invertwin.models import MotionMap
from invertwin.plotting import RATE_LABEL, U_LABEL, Panel, png_bytes
from invertwin.radar import doppler_maps
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh

Scale = Literal["magnitude", "power", "level"]
_CELLS = 4  # about the mover, that twin and point are scored on
_DRAWN_CELLS = 8
_RAYS = 10_000  # of a map that is scored or drawn
_SCALES: dict[Scale, str] = {
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
    "position_error_m": "distance to the truth [m]",
    "velocity_error_m_s": "velocity off the truth [m/s]",
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
class _Found:
    """A fitted body.

    Attributes:
        recording: What it was fitted to.
        model: The map of the whole recording.
        echo: The strongest mover in it.
        body: With the values that were found.
        fit: The fit.
        seconds: Time of the fit.
    """

    recording: ChirpCapture
    model: MotionMap
    echo: Echo
    body: MovingBody
    fit: Reconstruction
    seconds: float

    def predicted(self, scene: Scene, model: MotionMap, seed: int, time: float = 0.0) -> Tensor:
        """What the body looks like in a map, a time after the middle of its recording [s]."""
        with torch.no_grad():
            return model.sampled_by(samples=_RAYS).predict(
                self.body(scene, time), self.recording.radar(), seed
            )[0]

    def near(self, cells: int, model: MotionMap | None = None, time: float = 0.0) -> MotionMap:
        """The cells of a map about the echo, which moves along its line of sight for a time."""
        place = self.echo.range + self.echo.rate * time
        return (model or self.model).around(place, self.echo.rate, cells, self.recording.radar())


def run_mover(run: RunFile, folder: RunFolder, console: Console) -> tuple[list[Table], str]:
    """Find the strongest mover, fit a twin to it, write the folder.

    Args:
        run: The run file.
        folder: Where to write.
        console: Where progress is shown.

    Returns:
        The tables to print and the outcome.

    Raises:
        InputError: A run file that asks for something else, or data without chirps.
    """
    begin = time.perf_counter()
    table, recording = _mover(run), _recorded(run)
    grid = build.grid(need(run, "grid", "reconstruct"), recording.radar())
    scene = build.scene(run)
    whole = _fitted(run, table, scene, recording, grid, "twin", console)
    seen = whole.near(_CELLS)
    observed = seen.observe(recording)[0]
    metrics: dict[str, Any] = {
        "task": run.task,
        **_echo_metrics(whole.echo),
        **_scores("", whole, scene, seen, observed, run.seed),
    }
    halves, half = _heldout(run, table, scene, recording, grid, console)
    metrics |= halves
    values = whole.body.values()
    metrics["twin"] = {name: value.tolist() for name, value in values.items()}
    metrics |= _errors(run, table.object, recording, values)
    metrics["loss"] = whole.fit.history[-1]["loss"]
    metrics["steps"] = whole.fit.steps
    metrics["status"] = whole.fit.status
    metrics["fit_seconds"] = whole.seconds + half.seconds
    with torch.no_grad():
        moving = whole.body(scene)
    drawn = _pictures(run, whole, half, scene, moving)
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


def _recorded(run: RunFile) -> ChirpCapture:
    for name in ("starts", "calibration", "landscape", "initial"):
        if getattr(run, name):
            raise InputError(
                f"{name}: expected no such section with a mover, got one; remove it: the fit "
                "starts at the strongest echo that moves"
            )
    data = need(run, "data", "a mover")
    if isinstance(data, SimulatedData):
        radar = build.radar(need(run, "radar", "simulated data"))
        chirps = sensors.chirps(need(run, "chirps", "a mover in simulated data"))
        beat = chirp_train(run, build.true_scene(run), radar, chirps)
        recording = ChirpCapture(beat, radar, chirps)
    else:
        recording = chirp_capture(data)
    if recording.device.frame_count > 1:
        raise InputError(
            f"data: expected one frame with a mover, got {recording.device.frame_count}; "
            "choose one with `frame`"
        )
    return recording


def _mover(run: RunFile) -> Mover:
    table = need(run, "parameters", "reconstruct")[0]
    if len(run.parameters) > 1 or not isinstance(table, Mover):
        kinds = ", ".join(parameter.kind for parameter in run.parameters)
        raise InputError(f"parameters: expected a mover alone, got {kinds}; leave only the mover")
    return table


def _fitted(
    run: RunFile,
    table: Mover,
    scene: Scene,
    recording: ChirpCapture,
    grid: Grid,
    name: str,
    console: Console,
) -> _Found:
    settings = need(run, "reconstruct", "reconstruct")
    radar = recording.radar()
    oversample = math.ceil(need(run, "grid", "reconstruct").oversample)
    sampling = Sampling(depth=1, samples=settings.samples, boundary=False)
    model = MotionMap.of(radar, grid, recording.chirps, oversample, sampling)
    echo = strongest_mover(recording, model)
    begin = time.perf_counter()
    with about(f"scene.{table.object}"):
        body = MovingBody(table.object, scene, radar, echo)
    near = model.around(echo.range, echo.rate, table.cells, radar)
    with watched(Bar(console, name, settings.steps)) as callbacks:
        fit = reconstruct(
            scene,
            Observation(near, radar, recording),
            body,
            loss=CorrelationLoss(),
            optimizer=build.optimizer(run.optimizer),
            schedule=Schedule(settings.steps),
            callbacks=callbacks,
            seed=run.seed,
        )
    return _Found(recording, model, echo, body, fit, time.perf_counter() - begin)


def _heldout(
    run: RunFile,
    table: Mover,
    scene: Scene,
    recording: ChirpCapture,
    grid: Grid,
    console: Console,
) -> tuple[dict[str, Any], _Found]:
    """Fits the first half of the chirps and predicts the second, with a twin and with a point.

    Both move on with the velocities of the first half; nothing is taken from the second.
    """
    count = recording.chirps.count // 2
    half = _fitted(
        run, table, scene, recording.loops(0, count), grid, "twin of the first half", console
    )
    later = float(recording.chirps.times(len(recording.device.transmitters.positions))[count, 0])
    second = recording.loops(count, count)
    seen = half.near(_CELLS, time=later)
    return _scores("heldout_", half, scene, seen, seen.observe(second)[0], run.seed, later), half


def _errors(
    run: RunFile, name: str, recording: ChirpCapture, found: Mapping[str, Tensor]
) -> dict[str, float]:
    """How far position and velocity are from the truth, where the run file knows it.

    The truth is that of the frame's start, the twin that of the middle of its chirps.
    """
    if not isinstance(run.data, SimulatedData) and name not in run.truth:
        return {}
    truth = build.true_scene(run)[name]
    still = torch.zeros(1, 3, dtype=torch.float64)
    velocity = (still if truth.velocity is None else truth.velocity).reshape(-1, 3).mean(0)
    times = recording.chirps.times(len(recording.device.transmitters.positions))
    place = truth.center + velocity * times.mean()
    return {
        "position_error_m": float((found["position_m"] - place).norm()),
        "velocity_error_m_s": float((found["velocity_m_s"] - velocity).norm()),
    }


def _echo_metrics(echo: Echo) -> dict[str, Any]:
    return {
        "mover_range_m": echo.range,
        "mover_velocity_m_s": echo.rate,
        "mover_azimuth_deg": math.degrees(math.asin(max(-1.0, min(1.0, echo.u)))),
        "phase_coherence": echo.coherence,
    }


def _scores(
    prefix: str,
    found: _Found,
    scene: Scene,
    seen: MotionMap,
    observed: Tensor,
    seed: int,
    time: float = 0.0,
) -> dict[str, Any]:
    """Correlations of twin and point with the recording, on the same cells and scales."""
    maps = {
        "twin": found.predicted(scene, seen, seed, time),
        "bare_psf": of_point(seen, found.recording.radar(), found.echo, time)[0],
    }
    rows = {
        scale: {
            name: 1 - float(CorrelationLoss(scale)(power, observed)) for name, power in maps.items()
        }
        for scale in _SCALES
    }
    headline = {f"{prefix}{name}_correlation": v for name, v in rows["magnitude"].items()}
    return {**headline, f"{prefix}correlations": rows}


def _pictures(
    run: RunFile, whole: _Found, half: _Found, scene: Scene, moving: Scene
) -> dict[str, Picture]:
    recording = whole.recording
    radar, grid, chirps = recording.radar(), whole.model.grid, recording.chirps
    wide = whole.near(_DRAWN_CELLS)
    maps = {
        "recorded": wide.observe(recording)[0],
        "twin": whole.predicted(scene, wide, run.seed),
        "point target": of_point(wide, radar, whole.echo)[0],
    }
    with torch.no_grad():
        start = MovingBody(whole.body.object, scene, radar, whole.echo)(scene)
    scenes = {"start": start, "twin": moving}
    losses = {
        name: [[row["loss"] for row in found.fit.history]]
        for name, found in (("twin", whole), ("twin of the first half", half))
    }
    return {
        "recording": Picture(
            "The recording",
            png_bytes(plotting.range_doppler(doppler_maps(recording.beat, radar, grid, chirps))),
            "Range rates are modulo the unambiguous span; phases that transmitters in turn add to "
            "movers are taken out.",
        ),
        "twin_doppler": Picture(
            "The mover over range and range rate",
            png_bytes(plotting.panels(_over_rates(maps, wide))),
        ),
        "twin_direction": Picture(
            "The mover over range and azimuth",
            png_bytes(plotting.panels(_over_directions(maps, wide))),
            "Each map in dB below its own peak, the strongest over the axis that is not shown.",
        ),
        "scene": Picture(
            "Where it is",
            png_bytes(plotting.scene(scenes, radar, highlight=[whole.body.object])),
            "In the middle of the frame. Place and motion in height are given, not found: one row "
            "of antennas does not resolve it.",
        ),
        "loss": Picture(
            "1 − correlation of the magnitudes", png_bytes(plotting.convergence(losses))
        ),
    }


def _over_rates(maps: Mapping[str, Tensor], wide: MotionMap) -> dict[str, Panel]:
    return {
        name: Panel(power.amax((2, 3)).T, wide.grid.ranges, wide.rates, RATE_LABEL)
        for name, power in maps.items()
    }


def _over_directions(maps: Mapping[str, Tensor], wide: MotionMap) -> dict[str, Panel]:
    return {
        name: Panel(power.amax((0, 3)), wide.grid.ranges, wide.grid.u, U_LABEL)
        for name, power in maps.items()
    }


def _tables(metrics: Mapping[str, Any]) -> list[Table]:
    rows = [[label, metrics[key]] for key, label in _LABELS.items() if key in metrics]
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
