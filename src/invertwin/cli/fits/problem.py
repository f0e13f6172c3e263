"""What is to be fitted: scene, observations, unknowns and stages of a run file."""

import math
import time
import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from rich.console import Console
from torch import nn

from invertwin.capture import Capture
from invertwin.channel import Densities, Grid, Sampling
from invertwin.cli.estimate import SensorSetup, require_resources
from invertwin.cli.exact_signals import simulate_exact
from invertwin.cli.schema import (
    MeasuresTable,
    ReconstructTable,
    RunFile,
    SamplingBase,
    SimulatedData,
    build,
)
from invertwin.cli.schema import StageTable as StageTable
from invertwin.cli.schema.recordings import build_capture
from invertwin.cli.schema.run_file import prefix_errors, require_section
from invertwin.cli.schema.shape_tables import shape_regularizers
from invertwin.errors import InputError, PhysicsWarning
from invertwin.forward_model import ForwardModel
from invertwin.inversion import Observation, Stage, Unknown, remesh
from invertwin.inversion.initialisation.detections import estimate_density
from invertwin.inversion.metrics import pose_error
from invertwin.models.facets import FacetMap
from invertwin.models.radar import ExactMap, SurrogateMap
from invertwin.radar.parameters import ClockOffset, RangeBias
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate.surrogate import Surrogate
from invertwin.scene import Object, Scene, rigid
from invertwin.seeds import derive_seed

OWN_METHOD, INTERIOR_ONLY = "full", "interior_only"

_RADAR_PARAMETER_KINDS = ("radar_pose", "radar_path")
_DEFAULT_POINTS_PER_M2 = 2_000.0
_RECORDING_SEED_KEY = 2**16  # key of the seeds of recordings, beyond those of sensors


@dataclass(frozen=True)
class SensorData:
    """What one sensor has recorded."""

    capture: Capture
    radar: Radar
    grid: Grid
    weight: float = 1.0  # in the loss


@dataclass(frozen=True)
class Problem:
    """Everything a fit needs, built from the run file."""

    run: RunFile
    scene: Scene  # as known
    truth: Scene  # where the run file knows it
    known_objects: frozenset[str]  # objects whose true pose is known
    sensor_data: Mapping[str, SensorData] = field(default_factory=dict)  # by the sensor's name
    scored_object: str | None = None  # the object that is scored

    @property
    def first_sensor(self) -> SensorData:
        """The only sensor, or the first one."""
        return next(iter(self.sensor_data.values()))

    @property
    def sensors_with_runs(self) -> list[tuple[RunFile, SensorData]]:
        """Every sensor with the run file as it is for it."""
        runs = sensor_runs(self.run)
        return [(runs[name], sight) for name, sight in self.sensor_data.items()]

    @property
    def measures(self) -> MeasuresTable | None:
        """How the shape is scored, where the true one is known."""
        table = self.run.measures
        return table if table is not None and table.object in self.known_objects else None


def build_problem(run: RunFile, console: Console) -> Problem:
    """The problem of a run file; simulated data are simulated here.

    Raises:
        InputError: A section is missing or does not fit the data.
    """
    require_section(run, "parameters", "reconstruct")
    scene, truth = build.scene(run), build.true_scene(run)
    for i, parameter in enumerate(run.parameters):
        if parameter.kind == "mover":
            raise InputError(
                f"parameters[{i}].kind: expected a mover as the only parameter, got "
                f"{len(run.parameters)} parameters; leave only that"
            )
    # Their errors come before any work.
    build.parameters(run.parameters, scene, run.scene)
    for name, variant in run.variants.items():
        with prefix_errors(f"variants.{name}"):
            build.parameters(variant.parameters or [], scene, run.scene)
    sensors = build_sensors(run)
    _warn_if_depths_differ(run, sensors)
    require_resources(run, truth, sensors)
    sights = _record_sensor_data(run, sensors, truth, console)
    simulated = all(isinstance(own.data, SimulatedData) for own in sensor_runs(run).values())
    known = frozenset(truth.names if simulated else run.truth)
    target = run.starts.object if run.starts else next(iter(fitted_objects(run)), None)
    return Problem(run, scene, truth, known, sights, target)


def _warn_if_depths_differ(run: RunFile, sensors: Mapping[str, SensorSetup]) -> None:
    if run.reconstruct is None:
        return
    for name, sensor in sensors.items():
        data, depth = sensor.run.data, run.reconstruct.depth
        if isinstance(data, SimulatedData) and data.depth != depth and run.chirps is None:
            at = f"observations.{name}." if name else ""
            warnings.warn(
                f"reconstruct.depth is {depth}, {at}data.depth is {data.depth}: the fit explains "
                "echoes of other numbers of bounces than its data have; make them equal",
                PhysicsWarning,
                stacklevel=3,
            )


def has_recording_per_start(run: RunFile) -> bool:
    """Whether every start has a recording of its own."""
    return isinstance(run.data, SimulatedData) and run.data.every_start


def with_recording_of_start(problem: Problem, start: int, console: Console) -> Problem:
    """The problem with the recording of a start, where each has one of its own."""
    return (
        with_new_recording(problem, start, console)
        if start and has_recording_per_start(problem.run)
        else problem
    )


def with_new_recording(problem: Problem, number: int, console: Console) -> Problem:
    """The problem with another simulated recording."""
    run, data = problem.run, problem.run.data
    assert isinstance(data, SimulatedData)
    seed = derive_seed(run.seed if data.seed is None else data.seed, _RECORDING_SEED_KEY, number)
    run = run.model_copy(update={"data": data.model_copy(update={"seed": seed})})
    return replace(
        problem,
        run=run,
        sensor_data=_record_sensor_data(run, build_sensors(run), problem.truth, console),
    )


def build_sensors(run: RunFile) -> dict[str, SensorSetup]:
    """What the tables of every sensor make; recordings are read, nothing is simulated."""
    found = {}
    for name, own in sensor_runs(run).items():
        with prefix_errors(f"observations.{name}") if name else nullcontext():
            found[name] = _build_sensor(own)
    return found


def _record_sensor_data(
    run: RunFile, sensors: Mapping[str, SensorSetup], truth: Scene, console: Console
) -> dict[str, SensorData]:
    sights = {}
    for name, own in sensors.items():
        capture = own.capture
        if capture is None:
            console.print("simulating the exact signals of the true scene")
            with prefix_errors(f"observations.{name}") if name else nullcontext():
                beat = simulate_exact(own.run, truth, own.radar, own.grid).beat
            capture = Capture.from_beat(beat, own.radar)
        weight = run.observations[name].weight if name else 1.0
        sights[name] = SensorData(capture, own.radar, own.grid, weight)
    return sights


def sensor_runs(run: RunFile) -> dict[str, RunFile]:
    """The run file with the sections of every sensor, by the sensor's name.

    The only sensor of a run file without `[observations]` has an empty name.
    """
    if not run.observations:
        return {"": run}
    found = {}
    for number, (name, table) in enumerate(run.observations.items()):
        own = {key: value for key, value in table if key != "weight" and value is not None}
        if "data" not in own and isinstance(run.data, SimulatedData):
            # The noise of one radar is not that of another.
            seed = derive_seed(run.seed if run.data.seed is None else run.data.seed, number)
            own["data"] = run.data.model_copy(update={"seed": seed})
        found[name] = run.model_copy(update={**own, "observations": {}})
    return found


def _build_sensor(run: RunFile) -> SensorSetup:
    data, table = (
        require_section(run, "data", "reconstruct"),
        require_section(run, "grid", "reconstruct"),
    )
    if isinstance(data, SimulatedData):
        radar = build.radar(require_section(run, "radar", "simulated data"))
        return SensorSetup(run, radar, build.grid(table, radar))
    if run.radar is not None:
        raise InputError(
            f"radar: expected no [radar] with data.kind = {data.kind}, got one; "
            "remove it: a capture brings its radar along"
        )
    capture = build_capture(data)
    radar = capture.radar()
    return SensorSetup(run, radar, build.grid(table, radar), capture)


def fitted_objects(run: RunFile) -> list[str]:
    """Objects that have parameters."""
    return [p.object for p in run.parameters if getattr(p, "object", None)]


def known_truth(problem: Problem) -> dict[str, Object]:
    """The object that is scored as it really is, where that is known."""
    name = problem.scored_object
    return {name: problem.truth[name]} if name is not None and name in problem.known_objects else {}


def make_starts(problem: Problem) -> list[Scene]:
    """Where fits start: about the truth as `[starts]` says, or where the scene is."""
    run, scene, table = problem.run, problem.scene, problem.run.starts
    if table is None:
        return [scene]
    body = build.fitted_body(run, scene, table.object)
    name, truth, found = table.object, problem.truth[table.object], []
    seed = run.seed if table.seed is None else table.seed
    generator = torch.Generator().manual_seed(seed)
    for moved in table.build({Object: truth}, generator=generator):
        # The object as known may have another size: it is its centre that is placed.
        turn = moved.transform[:3, :3]
        begun = scene.replace(name, pose=rigid(turn, moved.center - turn @ scene[name].mesh.center))
        if body is not None and table.joint_deg > 0:
            mesh = body.perturb_joints(truth.mesh, math.radians(table.joint_deg), generator)
            begun = begun.replace(name, mesh=mesh, pose=moved.transform)
        found.append(begun)
    return found


def require_settings(run: RunFile) -> ReconstructTable:
    """The `[reconstruct]` table, which every fit needs."""
    return require_section(run, "reconstruct", "reconstruct")


def method_run(run: RunFile, mode: str) -> RunFile:
    """The run file of a way to fit: the run's own, or a variant."""
    return run if mode == OWN_METHOD else run.apply_overrides(run.variants[mode])


def with_method(problem: Problem, mode: str) -> Problem:
    """The problem of a way to fit, with the sensors of this fit only."""
    run = method_run(problem.run, mode)
    chosen = require_settings(run).observations or problem.sensor_data
    sights = {name: sight for name, sight in problem.sensor_data.items() if name in chosen}
    return replace(problem, run=run, sensor_data=sights)


def fitted_tables(run: RunFile) -> dict[str, Any]:
    """The tables of what is fitted, by name."""
    tables = build.tables_by_name(run.parameters)
    names = set(require_settings(run).parameters or tables)
    if run.stages and all(stage.parameters for stage in run.stages):
        names &= {name for stage in run.stages for name in stage.parameters}
    return {name: table for name, table in tables.items() if name in names}


def stage_runs(run: RunFile) -> list[tuple[StageTable, RunFile]]:
    """The stages of a fit, each with its run file; one that fits nothing falls out."""
    fitted = fitted_tables(run)
    found = [
        (stage, run.apply_overrides(stage))
        for stage in run.stages
        if not stage.parameters or fitted.keys() & set(stage.parameters)
    ]
    return found or [(StageTable(), run)]


def make_schedule(problem: Problem) -> list[Stage]:
    """The stages of a fit, as the library takes them."""
    fitted, found = fitted_tables(problem.run), []
    for table, run in stage_runs(problem.run):
        names = [name for name in table.parameters if name in fitted]
        free = [fitted[name] for name in names or fitted]
        finer = partial(remesh, edge_length=table.remesh or 0.0)
        counts = {k: v for k, v in (table.reconstruct or {}).items() if k in SamplingBase.made_from}
        models = make_models(replace(problem, run=run))
        stage = Stage(
            **vars(require_settings(run).build()),
            unknowns=tuple(names),
            rebuild=table.rebuild,
            remesh={t.object: finer for t in free if table.remesh and t.kind == "vertices"},
            optimizer=build.build_section(run, "optimizer"),
            models=[model.with_sampling(**counts) if counts else model for model in models],
        )
        found.append(stage)
    return found


def blur_end_step(run: RunFile) -> float | None:
    """The step from which the surrogate has no extra widths; None if it never has, or in stages."""
    (_, own), *others = stage_runs(run)
    kernels, settings = own.surrogate, require_settings(own)
    widened = kernels.range_width > 0 or kernels.angle_width > 0
    if own.model is not None and own.model.kind == "surrogate":
        widened |= own.model.stretch > 1
    if others or kernels.exact or not widened:
        return None
    return settings.annealing * settings.steps


def make_sampling(run: RunFile) -> Sampling:
    """How the model of a fit samples paths."""
    settings = require_settings(run)
    counts = {name: getattr(settings, name) for name in SamplingBase.made_from}
    return Sampling(
        **counts,
        conductor_samples=settings.samples,
        points_per_m2=rough_point_densities(run),
    )


def rough_point_densities(run: RunFile) -> Densities:
    """Points per m² of rough surfaces in exact signals: those of simulated data, or enough."""
    return run.data.points_per_m2 if isinstance(run.data, SimulatedData) else _DEFAULT_POINTS_PER_M2


def make_models(problem: Problem) -> list[ForwardModel]:
    """The forward models that are fitted, one for every sensor."""
    sampling = make_sampling(problem.run)
    found: list[ForwardModel] = []
    for run, sight in problem.sensors_with_runs:
        kernels = build.build_section(run, "surrogate")
        if run.model is not None:
            found.append(
                build.build_section(
                    run, "model", {Grid: sight.grid, Surrogate: kernels, Sampling: sampling}
                )
            )
        elif run.surrogate.exact:
            found.append(ExactMap(sight.grid, sampling))
        else:
            found.append(SurrogateMap(sight.grid, kernels, sampling))
    return found


def make_display_models(problem: Problem) -> list[ForwardModel]:
    """Models of the spectra that are shown, sharp: of chains where these are fitted."""
    fitted = make_models(problem)
    if all(isinstance(model, FacetMap) for model in fitted):
        sights = problem.sensor_data.values()
        return [FacetMap(sight.grid, sampling=make_sampling(problem.run)) for sight in sights]
    return [*make_unblurred_models(problem)]


def make_unblurred_models(problem: Problem) -> list[SurrogateMap]:
    """The smooth model of every sensor without extra widths, mean over phases."""
    sampling, found = make_sampling(problem.run), []
    for model, (run, sight) in zip(make_models(problem), problem.sensors_with_runs, strict=True):
        smooth = model
        if not isinstance(smooth, SurrogateMap):
            smooth = SurrogateMap(sight.grid, build.build_section(run, "surrogate"), sampling)
        found.append(smooth.scale_blur(0.0))
    return found


def make_observations(problem: Problem) -> list[Observation]:
    """What is fitted of every sensor: data, model and what is unknown of the sensor."""
    poses = {
        name: Unknown(
            partial(_build_radar_module, table), table.rate, partial(shape_regularizers, table)
        )
        for name, table in fitted_tables(problem.run).items()
        if table.kind in _RADAR_PARAMETER_KINDS
    }
    found = []
    for model, (name, sight) in zip(make_models(problem), problem.sensor_data.items(), strict=True):
        unknowns: dict[str, Unknown | nn.Module] = {**poses}
        for kind in require_settings(problem.run).nuisances:
            unknowns[f"{name}.{kind}" if name else kind] = (
                RangeBias() if kind == "range_bias" else ClockOffset(sight.capture.positions)
            )
        found.append(
            Observation(
                model,
                sight.capture,
                sensor=sight.radar,
                weight=sight.weight,
                parameters=unknowns,
            )
        )
    return found


def _build_radar_module(table: Any, _: Radar) -> nn.Module:
    return table.build()


def make_unknowns(run: RunFile) -> dict[str, Unknown]:
    """What is fitted of the scene, by name."""
    makers = build.module_builders(run.parameters, run.scene)
    return {
        name: Unknown(
            makers[name], getattr(table, "rate", None), partial(shape_regularizers, table)
        )
        for name, table in fitted_tables(run).items()
        if table.kind not in _RADAR_PARAMETER_KINDS
    }


def estimate_initial_scene(problem: Problem, console: Console) -> tuple[Problem, dict[str, Any]]:
    """The problem with its object where `[initial]` finds it, and how that went.

    Raises:
        InputError: `[starts]` beside it, no echoes, or too few points.
    """
    run, table, sight = problem.run, problem.run.initial, problem.first_sensor
    if table is None:
        return problem, {}
    if run.starts is not None:
        raise InputError(
            "initial: expected no [starts] beside [initial], got both; a fit starts from one"
        )
    console.print(f"looking for {table.object} with a conventional detector")
    begin, name = time.perf_counter(), table.object
    with prefix_errors("initial"):
        guess = table.build().find(
            problem.scene,
            name,
            sight.capture,
            sight.grid,
            loss=build.build_section(run, "loss"),
            seed=run.seed,
        )
        scene = _add_density(problem, guess.scene, name)
    found: dict[str, Any] = {"initial_points": guess.points} if guess.points else {}
    if guess.size is not None:
        known = table.scale and name in problem.known_objects
        off = pose_error(guess.scene[name], problem.truth[name]) if known else None
        found |= {"initial_scale_error": abs(off.scale - 1)} if off else {}
        found |= {"initial_losses": guess.losses, "initial_size_m": list(guess.size)}
    found["initial_seconds"] = time.perf_counter() - begin
    return replace(problem, scene=scene), found


def _add_density(problem: Problem, scene: Scene, name: str) -> Scene:
    """The scene with a density from the backprojected echoes, where one is fitted."""
    sight = problem.first_sensor
    for table in problem.run.parameters:
        if table.kind == "density" and table.object == name:
            box = table.low, table.high, table.counts
            grid = estimate_density(sight.capture, sight.grid, scene[name], name, *box)
            return scene.replace(name, cloud=grid.cloud)
    return scene
