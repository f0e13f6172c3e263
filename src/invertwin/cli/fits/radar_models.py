"""Radar data of run files, and the forward models of their maps."""

import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rich.console import Console

from invertwin.capture import Capture
from invertwin.channel import Densities, Grid, Sampling
from invertwin.cli.estimate import SensorSetup
from invertwin.cli.exact_signals import simulate_exact
from invertwin.cli.fits.problem import Problem, SensorData, about_sensor, sensor_runs, stage_runs
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile, SamplingBase, SimulatedData, build
from invertwin.cli.schema.recordings import DEFAULT_POINTS_PER_M2, build_capture
from invertwin.errors import InputError, PhysicsWarning
from invertwin.forward_model import ForwardModel
from invertwin.inversion import InitialPoseEstimator, pose_error
from invertwin.inversion.initialisation.detections import estimate_density
from invertwin.models import ExactMap, FacetMap, SurrogateMap
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.refusals import refusal, refusal_text
from invertwin.scene import Scene
from invertwin.seeds import derive_seed

_RECORDING_SEED_KEY = 2**16  # key of the seeds of recordings, beyond those of sensors


def build_sensors(run: RunFile) -> dict[str, SensorSetup]:
    """Radars and bins of every sensor's tables; recordings are read, nothing is simulated."""
    found = {}
    for name, own in sensor_runs(run).items():
        with about_sensor(name):
            found[name] = _sensor(own)
    return found


def _sensor(run: RunFile) -> SensorSetup:
    data = require_section(run, "data", "reconstruct")
    table = require_section(run, "grid", "reconstruct")
    if isinstance(data, SimulatedData):
        radar = build.radar(require_section(run, "radar", "simulated data"))
        return SensorSetup(run, radar, build.grid(table, radar))
    if run.radar is not None:
        raise refusal("radar_models.second_radar", data.kind)
    capture = build_capture(data)
    radar = capture.radar()
    return SensorSetup(run, radar, build.grid(table, radar), capture)


def record_sensors(
    run: RunFile, sensors: Mapping[str, SensorSetup], truth: Scene, console: Console
) -> dict[str, SensorData]:
    """Data of every sensor: as read, or simulated exactly.

    Args:
        run: The run file.
        sensors: Sensors by name.
        truth: Scene that they record.
        console: Shows progress.
    """
    found = {}
    for name, own in sensors.items():
        capture = own.capture
        if capture is None:
            console.print("simulating the exact signals of the true scene")
            with about_sensor(name):
                beat = simulate_exact(own.run, truth, own.radar, own.grid).beat
            capture = Capture.from_beat(beat, own.radar)
        weight = run.observations[name].weight if name else 1.0
        found[name] = SensorData(capture, own.radar, own.grid, weight)
    return found


def with_new_recording(problem: Problem, number: int, console: Console) -> Problem:
    """The problem with another recording of the same scene, from simulated data.

    Args:
        problem: Problem with its own recording.
        number: Number of the recording.
        console: Shows progress.
    """
    run, data = problem.run, problem.run.data
    assert isinstance(data, SimulatedData)
    seed = derive_seed(run.seed if data.seed is None else data.seed, _RECORDING_SEED_KEY, number)
    run = run.model_copy(update={"data": data.model_copy(update={"seed": seed})})
    recorded = record_sensors(run, build_sensors(run), problem.truth, console)
    return replace(problem, run=run, sensor_data=recorded)


def warn_if_depths_differ(run: RunFile, sensors: Mapping[str, SensorSetup]) -> None:
    """Warn where fit and simulated data differ in bounces.

    Args:
        run: The run file.
        sensors: Sensors by name.
    """
    for name, sensor in sensors.items():
        data, depth = sensor.run.data, run.fit_settings.depth
        if isinstance(data, SimulatedData) and data.depth != depth and run.chirps is None:
            at = f"observations.{name}." if name else ""
            text = refusal_text("radar_models.depths", depth, at, data.depth)
            warnings.warn(text, PhysicsWarning, stacklevel=4)


def has_recording_per_start(run: RunFile) -> bool:
    """Return True if every start has a recording of its own."""
    return isinstance(run.data, SimulatedData) and run.data.every_start


def blur_end_step(run: RunFile) -> float | None:
    """Step from which the surrogate has no additional blur; None if there is none, or in stages."""
    (_, own), *others = stage_runs(run)
    kernels, settings = own.surrogate, own.fit_settings
    widened = kernels.range_width > 0 or kernels.angle_width > 0
    if own.model is not None and own.model.kind == "surrogate":
        widened |= own.model.stretch > 1
    return None if others or kernels.exact or not widened else settings.annealing * settings.steps


def make_sampling(run: RunFile) -> Sampling:
    """Sampling of paths by the model of a fit."""
    settings = run.fit_settings
    counts = {name: getattr(settings, name) for name in SamplingBase.made_from}
    rough = rough_point_densities(run)
    return Sampling(**counts, conductor_samples=settings.samples, points_per_m2=rough)


def rough_point_densities(run: RunFile) -> Densities:
    """Points per m² of rough surfaces in exact signals: those of simulated data, or enough."""
    return run.data.points_per_m2 if isinstance(run.data, SimulatedData) else DEFAULT_POINTS_PER_M2


def make_radar_models(problem: Problem) -> list[ForwardModel]:
    """The forward models that are fitted, one for every radar."""
    sampling = make_sampling(problem.run)
    found: list[ForwardModel] = []
    for run, item in _sensors_with_runs(problem):
        kernels = build.build_section(run, "surrogate")
        if run.model is not None:
            given = {Grid: item.grid, Surrogate: kernels, Sampling: sampling}
            found.append(build.build_section(run, "model", given))
        elif run.surrogate.exact:
            found.append(ExactMap(item.grid, sampling))
        else:
            found.append(SurrogateMap(item.grid, kernels, sampling))
    return found


def make_display_models(problem: Problem) -> list[ForwardModel]:
    """Models of the spectra that are shown, sharp: of facets where these are fitted."""
    fitted = make_radar_models(problem)
    if all(isinstance(model, FacetMap) for model in fitted):
        sampling = make_sampling(problem.run)
        return [FacetMap(item.grid, sampling=sampling) for item in problem.sensor_data.values()]
    return [*make_unblurred_models(problem)]


def make_unblurred_models(problem: Problem) -> list[SurrogateMap]:
    """Smooth model of every radar without additional blur, mean over phases."""
    sampling, found = make_sampling(problem.run), []
    sensors = zip(make_radar_models(problem), _sensors_with_runs(problem), strict=True)
    for model, (run, item) in sensors:
        if not isinstance(model, SurrogateMap):
            model = SurrogateMap(item.grid, build.build_section(run, "surrogate"), sampling)
        found.append(model.scale_blur(0.0))
    return found


def _sensors_with_runs(problem: Problem) -> list[tuple[RunFile, Any]]:
    """Data of every sensor, with the run file as it is for it."""
    runs = sensor_runs(problem.run)
    return [(runs[name], item) for name, item in problem.sensor_data.items()]


def estimate_initial_scene(problem: Problem, console: Console) -> Problem:
    """The problem with its object where `[initial]` finds it.

    Raises:
        InputError: `[starts]` beside it, no echoes, or too few points.
    """
    run, table, item = problem.run, problem.run.initial, problem.first_sensor
    if table is None:
        return problem
    if run.starts is not None:
        raise refusal("radar_models.two_starts")
    with prefix_errors("initial"):
        name = table.object
        if name is None:
            raise InputError("expected the name of an object, got none; add `object`")
        console.print(f"looking for {name} with a conventional detector")
        begin = time.perf_counter()
        estimator: InitialPoseEstimator = table.build()
        seen, loss = (item.recording, item.grid), build.build_loss(run)
        found = estimator.estimate(problem.scene, name, *seen, loss=loss, seed=run.seed)
        scene = _add_density(problem, found.scene, name)
    notes: dict[str, Any] = {}
    if found.detection_count:
        notes["initial_points"] = found.detection_count
    if found.rectangle_size is not None:
        known = table.scale and name in problem.known_objects
        off = pose_error(found.scene[name], problem.truth[name]) if known else None
        notes |= {"initial_scale_error": abs(off.scale - 1)} if off else {}
        notes |= {"initial_losses": found.losses, "initial_size_m": list(found.rectangle_size)}
    notes["initial_seconds"] = time.perf_counter() - begin
    return replace(problem, scene=scene, notes={**problem.notes, **notes})


def _add_density(problem: Problem, scene: Scene, name: str) -> Scene:
    """The scene with a density from the backprojected echoes, where one is fitted."""
    item = problem.first_sensor
    for table in problem.run.parameters:
        if table.kind == "density" and table.object == name:
            box = table.low, table.high, table.counts
            grid = estimate_density(item.recording, item.grid, scene[name], name, *box)
            return scene.replace(name, cloud=grid.cloud)
    return scene
