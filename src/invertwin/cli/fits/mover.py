"""`invertwin reconstruct` of a mover: the strongest echo that moves becomes a moving twin."""

import math
import time
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from invertwin import plotting
from invertwin.capture import ChirpCapture
from invertwin.channel import Sampling
from invertwin.cli.estimate import SensorSetup, require_resources
from invertwin.cli.exact_signals import simulate_chirp_beats
from invertwin.cli.report import (
    ReportPicture,
    ReportTable,
    load_texts,
    quantity_table,
    save_picture,
    write_report,
)
from invertwin.cli.schema import RunFile, SimulatedData, build
from invertwin.cli.schema.motion_tables import scene_at_start
from invertwin.cli.schema.recordings import build_chirp_capture
from invertwin.cli.schema.run_file import prefix_errors, require_section
from invertwin.cli.schema.shape_tables import MovingTargetParameter
from invertwin.discovery import (
    MovingBody,
    MovingTargetFit,
    MovingTargetMaps,
    detect_strongest_target,
)
from invertwin.errors import InputError
from invertwin.inversion import CorrelationLoss, Observation, Schedule, reconstruct, report_progress
from invertwin.models.doppler import RangeDopplerMap
from invertwin.plotting import RATE_LABEL, U_LABEL, MapPanel
from invertwin.radar import doppler_maps
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh
from invertwin.storage.run_folder import RunFolder

_CELLS = 4  # about the mover, that twin and point are scored on
_DRAWN_CELLS = 8
_SCALES = {
    "magnitude": "magnitude (√power)",
    "power": "power",
    "level": "level (dB, down to −40 dB)",
}


def _scores(maps: MovingTargetMaps, recording: ChirpCapture, prefix: str = "") -> dict[str, Any]:
    """Correlations with a recording, by scale."""
    rows = maps.correlations(recording)
    headline = {f"{prefix}{name}_correlation": v for name, v in rows["magnitude"].items()}
    return {**headline, f"{prefix}correlations": rows}


def run_mover(run: RunFile, folder: RunFolder, console: Console) -> tuple[list[ReportTable], str]:
    """Find the strongest mover, fit a twin to it, write the folder.

    Raises:
        InputError: A run file that asks for something else, or data without chirps.
    """
    begin = time.perf_counter()
    table, recording = _mover(run), _recorded(run)
    scene = build.scene(run)
    started = time.perf_counter()
    whole = _fitted(run, table, scene, recording, "twin", console)
    # The first half of the chirps predicts the second; nothing is taken from that.
    count = recording.chirps.count // 2
    first, second = recording.select_chirps(0, count), recording.select_chirps(count, count)
    half = _fitted(run, table, scene, first, "twin of the first half", console)
    seconds = time.perf_counter() - started
    later = float(_times(recording)[count, 0])
    values = whole.body.values()
    metrics: dict[str, Any] = {
        "task": run.task,
        "mover_range_m": whole.body.echo.range,
        "mover_velocity_m_s": whole.body.echo.range_rate,
        "mover_azimuth_deg": math.degrees(math.asin(max(-1.0, min(1.0, whole.body.echo.u)))),
        "phase_coherence": whole.body.echo.coherence,
        **_scores(whole.predict_maps(scene, _CELLS, seed=run.seed), recording),
        **_scores(half.predict_maps(scene, _CELLS, time=later, seed=run.seed), second, "heldout_"),
        "twin": {name: value.tolist() for name, value in values.items()},
        **_errors(run, table.object, recording, values),
        "loss": whole.reconstruction.history[-1]["loss"],
        "steps": whole.reconstruction.steps,
        "status": whole.reconstruction.status,
        "fit_seconds": seconds,
    }
    drawn = _pictures(run, folder, whole, half, scene)
    with torch.no_grad():
        save_mesh(folder.file("twin.ply"), whole.body(scene))
    metrics["wall_seconds"] = time.perf_counter() - begin
    result, *others = _tables(metrics)
    outcome = (
        f"The strongest mover is {metrics['mover_range_m']:.2f} m away; its twin correlates "
        f"{metrics['twin_correlation']:.3f} with the recording, a point target "
        f"{metrics['bare_psf_correlation']:.3f}."
    )
    title, parts = run.title or "A moving twin", [result, *drawn, *others]
    tables = write_report(
        folder, metrics, title, outcome, parts, again="reconstruct", note=run.note
    )
    return tables, outcome


def _mover(run: RunFile) -> MovingTargetParameter:
    table, *others = require_section(run, "parameters", "reconstruct")
    if others:
        kinds = ", ".join(parameter.kind for parameter in run.parameters)
        raise InputError(f"parameters: expected a mover alone, got {kinds}; leave only the mover")
    for name in ("starts", "search", "calibration", "landscape", "initial"):
        if getattr(run, name):
            raise InputError(
                f"{name}: expected no such section with a mover, got one; remove it: the fit "
                "starts at the strongest echo that moves"
            )
    return table


def _recorded(run: RunFile) -> ChirpCapture:
    data = require_section(run, "data", "a mover")
    if isinstance(data, SimulatedData):
        radar = build.radar(require_section(run, "radar", "simulated data"))
        chirps = require_section(run, "chirps", "a mover in simulated data").build()
        truth, grid = (
            build.true_scene(run),
            build.grid(require_section(run, "grid", "reconstruct"), radar),
        )
        require_resources(run, truth, {"": SensorSetup(run, radar, grid)})
        beat = simulate_chirp_beats(run, truth, radar, chirps)
        recording = ChirpCapture(beat, radar, chirps)
    else:
        recording = build_chirp_capture(data)
    if recording.device.frame_count > 1:
        raise InputError(
            f"data: expected one frame with a mover, got {recording.device.frame_count}; "
            "choose one with `frame`"
        )
    return recording


def _fitted(
    run: RunFile,
    table: MovingTargetParameter,
    scene: Scene,
    recording: ChirpCapture,
    name: str,
    console: Console,
) -> MovingTargetFit:
    settings, grid = (
        require_section(run, "reconstruct", "reconstruct"),
        require_section(run, "grid", "reconstruct"),
    )
    radar = recording.radar()
    model = RangeDopplerMap.from_chirps(
        radar,
        build.grid(grid, radar),
        recording.chirps,
        math.ceil(grid.oversample),
        Sampling(depth=1, samples=settings.samples, boundary=False),
    )
    echo = detect_strongest_target(recording, model)
    with prefix_errors(f"scene.{table.object}"):
        body = MovingBody(table.object, scene, radar, echo, table.free)
    near = model.crop_around(echo.range, echo.range_rate, table.cells, radar)
    with report_progress(name, settings.steps, console) as callbacks:
        found = reconstruct(
            scene,
            Observation(near, recording, sensor=radar),
            body,
            loss=CorrelationLoss(),
            optimizer=build.build_section(run, "optimizer"),
            schedule=Schedule(settings.steps),
            callbacks=callbacks,
            seed=run.seed,
        )
    return MovingTargetFit(recording, model, body, found)


def _times(recording: ChirpCapture) -> Tensor:
    """When each ramp of the frame starts [chirp, tx], s."""
    return recording.chirps.times(len(recording.device.transmitters.positions))


def _errors(
    run: RunFile, name: str, recording: ChirpCapture, found: Mapping[str, Tensor]
) -> dict[str, float]:
    """How far position and velocity are from the truth, where the run file knows it.

    The truth is that of the frame's start, the twin that of the middle of its chirps.
    """
    if not isinstance(run.data, SimulatedData) and name not in run.truth:
        return {}
    times = _times(recording)
    truth = scene_at_start(run, build.true_scene(run), float(times.max()))[name]
    still = torch.zeros(1, 3, dtype=torch.float64)
    velocity = (still if truth.velocity is None else truth.velocity).reshape(-1, 3).mean(0)
    place = truth.center + velocity * times.mean()
    return {
        "position_error_m": float((found["position_m"] - place).norm()),
        "velocity_error_m_s": float((found["velocity_m_s"] - velocity).norm()),
    }


def _pictures(
    run: RunFile, folder: RunFolder, whole: MovingTargetFit, half: MovingTargetFit, scene: Scene
) -> list[ReportPicture]:
    recording, radar = whole.recording, whole.recording.radar()
    wide = whole.predict_maps(scene, _DRAWN_CELLS, seed=run.seed)
    grid, rates = wide.model.grid, wide.model.rates
    maps = {
        "recorded": wide.model.observe(recording)[0],
        "twin": wide.twin_map,
        "point target": wide.point_map,
    }
    over_rates = {
        name: MapPanel(power.amax((2, 3)).T, grid.ranges, rates, RATE_LABEL)
        for name, power in maps.items()
    }
    over_directions = {
        name: MapPanel(power.amax((0, 3)), grid.ranges, grid.u, U_LABEL)
        for name, power in maps.items()
    }
    with torch.no_grad():
        begun = MovingBody(whole.body.object, scene, radar, whole.body.echo)(scene)
        scenes = {"start": begun, "twin": whole.body(scene)}
    losses = {
        name: [[row["loss"] for row in fit.reconstruction.history]]
        for name, fit in (("twin", whole), ("twin of the first half", half))
    }
    seen = doppler_maps(recording.beat, radar, whole.model.grid, recording.chirps)
    where = plotting.scene(scenes, radar, highlight=[whole.body.object])
    drawn = {
        "recording": (plotting.range_doppler(seen), "The recording", "doppler"),
        "twin_doppler": (plotting.panels(over_rates), "The mover over range and range rate", ""),
        "twin_direction": (
            plotting.panels(over_directions),
            "The mover over range and azimuth",
            "mover_direction",
        ),
        "scene": (where, "Where it is", "mover_scene"),
        "loss": (plotting.convergence(losses), "1 − correlation of the magnitudes", ""),
    }
    return [save_picture(folder, name, *shown) for name, shown in drawn.items()]


def _tables(metrics: Mapping[str, Any]) -> list[ReportTable]:
    columns = list(product(("", "heldout_"), ("twin", "bare_psf")))
    scales: list[Sequence[Any]] = [
        [label, *(metrics[f"{part}correlations"][scale][name] for part, name in columns)]
        for scale, label in _SCALES.items()
    ]
    heads = ["map", "twin", "point", "twin, second half", "point, second half"]
    note = load_texts("notes")["mover_correlation"]
    return [
        quantity_table("Result", metrics, skip=("loss",)),
        ReportTable("Correlation with the recording", heads, scales, note),
        quantity_table("The twin", metrics["twin"], label_table="mover"),
    ]
