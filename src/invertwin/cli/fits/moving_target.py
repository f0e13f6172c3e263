"""Fits of a moving target: the strongest echo that moves becomes a body in motion."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, ClassVar

import torch
from rich.console import Console
from torch import Tensor

from invertwin import discovery, plotting
from invertwin.capture import ChirpCapture
from invertwin.channel import Sampling
from invertwin.cli import report
from invertwin.cli.estimate import SensorSetup, require_resources
from invertwin.cli.exact_signals import simulate_chirp_beats
from invertwin.cli.fits import problem as problems
from invertwin.cli.fits.problem import DataKind, Fits, Problem, Row, SensorData, Start, Summary
from invertwin.cli.fits.scores import error_bar_table
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, SimulatedData, build
from invertwin.cli.schema.motion_tables import scene_at_start
from invertwin.cli.schema.recordings import build_chirp_capture
from invertwin.cli.schema.shape_tables import MovingTargetParameter
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion import Reconstruction, Unknown
from invertwin.models.doppler import RangeDopplerMap
from invertwin.plotting import RATE_LABEL, U_LABEL, MapPanel
from invertwin.radar import doppler_maps
from invertwin.refusals import refusal
from invertwin.scene import Scene
from invertwin.storage.run_folder import RunFolder

HALF = "first_half"
"""Method of the fit to the first half of the chirps: it predicts the second half."""
_CELLS = 4  # about the target, that twin and point are scored on
_DRAWN_CELLS = 8
_SCALES = {
    "magnitude": "magnitude (√power)",
    "power": "power",
    "level": "level (dB, down to −40 dB)",
}


class MovingTarget(DataKind):
    """One frame of chirps with something in it that moves."""

    title: ClassVar[str] = "A moving twin"
    unused: ClassVar[tuple[str, ...]] = ("calibration", "landscape", "model", "placement")
    methods: ClassVar[tuple[str, ...]] = (HALF,)

    def read_problem(self, run: RunFile, scene: Scene, truth: Scene, console: Console) -> Problem:
        """See ``DataKind.read_problem``; ``reference`` holds the strongest echo that moves."""
        problems.require_sections(self, run, "a moving target")
        table, recording = _table(run), _read_recording(run, truth)
        radar = recording.radar()
        grid = build.grid(require_section(run, "grid", "reconstruct"), radar)
        item = SensorData(recording, radar, grid)
        known = isinstance(run.data, SimulatedData) or table.object in run.truth
        names = frozenset(truth.names if known else ())
        problem = Problem(run, scene, truth, names, {"": item}, None, self)
        problem = replace(problem, reference=_detect_echo(problem))
        self._build_body(problem, table, Start(scene), scene)
        return problem

    def with_method(self, problem: Problem, method: str) -> Problem:
        """The problem of a method; the first half has its own echo."""
        found = super().with_method(problem, method)
        if method != HALF:
            return found
        item = problem.first_sensor
        half = item.recording.select_chirps(0, item.recording.chirps.count // 2)
        found = replace(found, sensor_data={"": replace(item, recording=half)})
        return replace(found, reference=_detect_echo(found))

    def models(self, problem: Problem) -> list[ForwardModel]:
        """The map about the echo."""
        echo, radar = problem.reference, problem.first_sensor.sensor
        cells = _table(problem.run).cells
        return [_whole_map(problem).crop_around(echo.range, echo.range_rate, cells, radar)]

    def make_unknown(self, problem: Problem, name: str, table: Any, start: Start) -> Unknown:
        """The body in motion."""
        return Unknown(partial(self._build_body, problem, table, start), table.rate)

    def _build_body(
        self, problem: Problem, table: MovingTargetParameter, start: Start, scene: Scene
    ) -> discovery.MovingBody:
        run = problem.run
        # Starts and searches move the object of the scene; else the echo says where it is.
        placed = run.starts is not None or run.search is not None
        center = scene[table.object].center.detach() if placed else None
        with prefix_errors(f"scene.{table.object}"):
            sensor, echo = problem.first_sensor.sensor, problem.reference
            return discovery.MovingBody(table.object, scene, sensor, echo, table.free, center)

    def score_fit(self, problem: Problem, start: Start, found: Reconstruction) -> Row:
        """Errors of position and velocity, where the truth is known.

        The truth is that of the frame's start, the twin that of the middle of its chirps.
        """
        name, values = _table(problem.run).object, _find_body(found).values()
        row: Row = {"position": values["position_m"].tolist()}
        if name not in problem.known_objects:
            return row
        times = _times(problem.first_sensor.recording)
        truth = scene_at_start(problem.run, problem.truth, float(times.max()))[name]
        still = torch.zeros(1, 3, dtype=torch.float64)
        velocity = (still if truth.velocity is None else truth.velocity).reshape(-1, 3).mean(0)
        off = float((values["position_m"] - (truth.center + velocity * times.mean())).norm())
        return row | {
            "position_error_m": off,
            "velocity_error_m_s": float((values["velocity_m_s"] - velocity).norm()),
            "success": off <= problem.run.fit_settings.position_limit,
        }

    def metrics(self, fits: Fits) -> Row:
        """See ``DataKind.metrics``."""
        problem, best = fits.problem, fits.best
        recording, scene, seed = problem.first_sensor.recording, problem.scene, problem.run.seed
        whole, half = _make_twins(fits)
        count = recording.chirps.count // 2
        later = float(_times(recording)[count, 0])
        second = recording.select_chirps(count, count)
        predicted = half.predict_maps(scene, _CELLS, time=later, seed=seed)
        echo, values = whole.body.echo, whole.body.values()
        errors = ("position_error_m", "velocity_error_m_s", "success")
        found: Row = {
            "mover_range_m": echo.range,
            "mover_velocity_m_s": echo.range_rate,
            "mover_azimuth_deg": math.degrees(math.asin(max(-1.0, min(1.0, echo.u)))),
            "phase_coherence": echo.coherence,
            **_correlations(whole.predict_maps(scene, _CELLS, seed=seed), recording),
            **_correlations(predicted, second, "heldout_"),
            "twin": {name: value.tolist() for name, value in values.items()},
            **{key: best[key] for key in errors if key in best},
        }
        if "success" in best:
            found["successes"] = sum(row["success"] for row in fits.rows[problems.OWN_METHOD])
        return found

    def summary(self, fits: Fits, metrics: Row, folder: RunFolder) -> Summary:
        """See ``DataKind.summary``."""
        result, *tables = _tables(metrics)
        outcome = (
            f"The strongest mover is {metrics['mover_range_m']:.2f} m away; its twin correlates "
            f"{metrics['twin_correlation']:.3f} with the recording, a point target "
            f"{metrics['bare_psf_correlation']:.3f}. "
            f"{report.load_texts('verdicts')[metrics['verdict']]}"
        )
        return Summary(outcome, result, _pictures(fits, folder), tables)


def _table(run: RunFile) -> MovingTargetParameter:
    table, *others = run.parameters
    if others:
        kinds = ", ".join(parameter.kind for parameter in run.parameters)
        raise InputError(f"parameters: expected kind mover alone, got {kinds}; leave only this one")
    return table


def _read_recording(run: RunFile, truth: Scene) -> ChirpCapture:
    data = require_section(run, "data", "a mover")
    if isinstance(data, SimulatedData):
        radar = build.radar(require_section(run, "radar", "simulated data"))
        chirps = require_section(run, "chirps", "a mover in simulated data").build()
        grid = build.grid(require_section(run, "grid", "reconstruct"), radar)
        require_resources(run, truth, {"": SensorSetup(run, radar, grid)})
        recording = ChirpCapture(simulate_chirp_beats(run, truth, radar, chirps), radar, chirps)
    else:
        recording = build_chirp_capture(data)
    if recording.device.frame_count > 1:
        raise refusal("moving_target.several_frames", recording.device.frame_count)
    return recording


def _whole_map(problem: Problem) -> RangeDopplerMap:
    """The map of all ranges and range rates."""
    item, run = problem.first_sensor, problem.run
    radar, chirps = item.recording.radar(), item.recording.chirps
    oversample = math.ceil(require_section(run, "grid", "reconstruct").oversample)
    sampling = Sampling(depth=1, samples=run.fit_settings.samples, boundary=False)
    return RangeDopplerMap.from_chirps(radar, item.grid, chirps, oversample, sampling)


def _detect_echo(problem: Problem) -> Any:
    """The strongest echo that moves, in the box of ``[initial]`` if there is one."""
    table = problem.run.initial
    with prefix_errors("initial"):
        found = None if table is None else table.build()
    box = None if found is None or found.low is None else (found.low, found.high)
    recording = problem.first_sensor.recording
    return discovery.detect_strongest_target(recording, _whole_map(problem), box)


def _times(recording: ChirpCapture) -> Tensor:
    """Start times of the ramps of the frame [chirp, tx] [s]."""
    return recording.chirps.times(len(recording.device.transmitters.positions))


def _find_body(found: Reconstruction) -> discovery.MovingBody:
    return next(module for module in found.parameters if isinstance(module, discovery.MovingBody))


def _make_twins(fits: Fits) -> list[discovery.MovingTargetFit]:
    """The twin of the best fit, and that of the first half from the same start."""
    number, problem = fits.best["start"], fits.problem
    twins = []
    for method, found in ((problems.OWN_METHOD, fits.found), (HALF, fits.outcome(HALF, number))):
        own = problem.kind.with_method(problem, method)
        model, recording = _whole_map(own), own.first_sensor.recording
        twins.append(discovery.MovingTargetFit(recording, model, _find_body(found), found))
    return twins


def _correlations(
    maps: discovery.MovingTargetMaps, recording: ChirpCapture, prefix: str = ""
) -> Row:
    """Correlations with a recording, by scale."""
    rows = maps.correlations(recording)
    headline = {f"{prefix}{name}_correlation": v for name, v in rows["magnitude"].items()}
    return {**headline, f"{prefix}correlations": rows}


def _pictures(fits: Fits, folder: RunFolder) -> list[report.ReportPicture]:
    problem, (whole, _) = fits.problem, _make_twins(fits)
    scene, recording = problem.scene, whole.recording
    radar = recording.radar()
    wide = whole.predict_maps(scene, _DRAWN_CELLS, seed=problem.run.seed)
    grid, rates = wide.model.grid, wide.model.rates
    maps = {"recorded": wide.model.observe(recording)[0], "twin": wide.twin_map}
    maps["point target"] = wide.point_map
    over_rates = {
        name: MapPanel(power.amax((2, 3)).T, grid.ranges, rates, RATE_LABEL)
        for name, power in maps.items()
    }
    over_directions = {
        name: MapPanel(power.amax((0, 3)), grid.ranges, grid.u, U_LABEL)
        for name, power in maps.items()
    }
    table = _table(problem.run)
    with torch.no_grad():
        unknown = problem.kind.make_unknown(problem, "", table, fits.start)
        scenes = {"start": unknown.build_module(fits.start.scene)(scene), "twin": whole.body(scene)}
    names = {problems.OWN_METHOD: "twin", HALF: "twin of the first half"}
    losses = {names.get(how, how.replace("_", " ")): own for how, own in fits.losses.items()}
    seen = doppler_maps(recording.beat, radar, whole.model.grid, recording.chirps)
    where = plotting.scene(scenes, radar, highlight=[whole.body.object])
    directions = plotting.panels(over_directions)
    drawn = {
        "recording": (plotting.range_doppler(seen), "The recording", "doppler"),
        "twin_doppler": (plotting.panels(over_rates), "The mover over range and range rate", ""),
        "twin_direction": (directions, "The mover over range and azimuth", "mover_direction"),
        "scene": (where, "Where it is", "mover_scene"),
        "loss": (plotting.convergence(losses), "1 − correlation of the magnitudes", ""),
    }
    return [report.save_picture(folder, name, *shown) for name, shown in drawn.items()]


def _tables(metrics: Mapping[str, Any]) -> list[report.ReportTable]:
    columns = list(product(("", "heldout_"), ("twin", "bare_psf")))
    scales: list[Sequence[Any]] = [
        [label, *(metrics[f"{part}correlations"][scale][name] for part, name in columns)]
        for scale, label in _SCALES.items()
    ]
    heads = ["map", "twin", "point", "twin, second half", "point, second half"]
    note = report.load_texts("notes")["mover_correlation"]
    return [
        report.quantity_table("Result", metrics, skip=("loss",)),
        report.ReportTable("Correlation with the recording", heads, scales, note),
        report.quantity_table("The twin", metrics["twin"], label_table="mover"),
        error_bar_table(dict(metrics)),
    ]
