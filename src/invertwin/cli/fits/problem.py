"""What is to be fitted: scene, observations and unknowns of a run file."""

from collections.abc import Collection, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from rich.console import Console
from torch import nn

from invertwin.capture import Capture
from invertwin.channel import Grid, Sampling
from invertwin.cli import build
from invertwin.cli.fit_tables import SurrogateTable
from invertwin.cli.recordings import measured
from invertwin.cli.registry import registry
from invertwin.cli.run_file import about, need
from invertwin.cli.run_simulate import exact
from invertwin.cli.schema import RunFile, Settings, SimulatedData, Variant
from invertwin.cli.schema import Stage as StageTable
from invertwin.cli.shape_tables import shape_terms
from invertwin.errors import InputError
from invertwin.inversion import Observation, Stage, Unknown, remeshed
from invertwin.models import ExactMap, ForwardModel, SurrogateMap
from invertwin.radar.parameters import ClockOffset, RadarPose, RangeBias
from invertwin.radar.radar import Radar
from invertwin.scene import Scene
from invertwin.seeds import derived_seed

FULL, INTERIOR = "full", "interior_only"

_POINTS_PER_M2 = 2_000.0
_WIDTHS = ("range_width", "angle_width")
_OWN = ("radar", "grid", "data", "surrogate", "chirps", "model")  # sections of a sensor


@dataclass(frozen=True)
class Sight:
    """What one sensor has recorded."""

    capture: Capture
    radar: Radar
    grid: Grid
    surrogate: SurrogateTable
    weight: float = 1.0  # in the loss
    table: Any = None  # `[model]` of a plugin

    def model(self, sampling: Sampling) -> ForwardModel:
        """The forward model that is fitted."""
        if self.table is not None:
            return build.model(self.table, self.grid, build.surrogate(self.surrogate))
        if self.surrogate.exact:
            return ExactMap(self.grid, sampling)
        return SurrogateMap(self.grid, build.surrogate(self.surrogate), sampling)


@dataclass(frozen=True)
class Problem:
    """Everything a fit needs, built from the run file."""

    run: RunFile
    scene: Scene  # as known
    truth: Scene  # where the run file knows it
    known: frozenset[str]  # objects whose true pose is known
    sights: Mapping[str, Sight] = field(default_factory=dict)  # by the sensor's name
    target: str | None = None  # the object that is scored

    @property
    def first(self) -> Sight:
        """The only sensor, or the first one."""
        return next(iter(self.sights.values()))


def problem_of(run: RunFile, console: Console) -> Problem:
    """The problem of a run file; simulated data are simulated here.

    Raises:
        InputError: A section is missing or does not fit the data.
    """
    need(run, "parameters", "reconstruct")
    scene, truth = build.scene(run), build.true_scene(run)
    for i, parameter in enumerate(run.parameters):
        if parameter.kind == "mover":
            raise InputError(
                f"parameters[{i}].kind: expected a mover as the only parameter, got "
                f"{len(run.parameters)} parameters; leave only that"
            )
    # Their errors come before any work.
    build.parameters(run.parameters, scene, run.scene)
    sights, observed = {}, observed_runs(run)
    for name, (own, weight) in observed.items():
        with about(f"observations.{name}") if name else nullcontext():
            sights[name] = _sight(own, weight, truth, console)
    simulated = all(isinstance(own.data, SimulatedData) for own, _ in observed.values())
    known = frozenset(truth.names if simulated else run.truth)
    target = run.starts.object if run.starts else next(iter(sought_objects(run)), None)
    return Problem(run, scene, truth, known, sights, target)


def observed_runs(run: RunFile) -> dict[str, tuple[RunFile, float]]:
    """The run file with the sections of every sensor, and the sensor's weight, by name.

    The only sensor of a run file without `[observations]` has an empty name.
    """
    if not run.observations:
        return {"": (run, 1.0)}
    found = {}
    for number, (name, table) in enumerate(run.observations.items()):
        keys = [key for key in _OWN if getattr(table, key) is not None]
        own = {key: getattr(table, key) for key in keys}
        if "data" not in own and isinstance(run.data, SimulatedData):
            # The noise of one radar is not that of another.
            seed = derived_seed(run.seed if run.data.seed is None else run.data.seed, number)
            own["data"] = run.data.model_copy(update={"seed": seed})
        found[name] = (run.model_copy(update={**own, "observations": {}}), table.weight)
    return found


def _sight(run: RunFile, weight: float, truth: Scene, console: Console) -> Sight:
    data, table = need(run, "data", "reconstruct"), need(run, "grid", "reconstruct")
    if isinstance(data, SimulatedData):
        radar = build.radar(need(run, "radar", "simulated data"))
        grid = build.grid(table, radar)
        console.print("simulating the exact signals of the true scene")
        capture = Capture.from_beat(exact(run, truth, radar, grid).beat, radar)
        return Sight(capture, radar, grid, run.surrogate, weight, run.model)
    if run.radar is not None:
        raise InputError(
            f"radar: expected no [radar] with data.kind = {data.kind}, got one; "
            "remove it: a capture brings its radar along"
        )
    capture = measured(data)
    radar = capture.radar()
    return Sight(capture, radar, build.grid(table, radar), run.surrogate, weight, run.model)


def sought_objects(run: RunFile) -> list[str]:
    """Objects that have parameters."""
    return [p.object for p in run.parameters if getattr(p, "object", None)]


def varied(problem: Problem, mode: str) -> Problem:
    """The problem of a mode, with the parameters and the sensors of this fit only."""
    wanted = _wanted(problem.run, mode)
    widths = _among(_given(wanted), _WIDTHS)
    chosen = getattr(wanted, "observations", None) or problem.sights
    sights = {
        name: replace(sight, surrogate=sight.surrogate.model_copy(update=widths))
        for name, sight in problem.sights.items()
        if name in chosen
    }
    return replace(problem, run=varied_run(problem.run, mode), sights=sights)


def _wanted(run: RunFile, mode: str) -> Variant:
    if mode in (FULL, INTERIOR):
        return Variant() if mode == FULL else Variant(boundary=False)
    return run.variants[mode]


def varied_run(run: RunFile, mode: str) -> RunFile:
    """The run file of a mode, with the parameters of this fit only."""
    wanted = _wanted(run, mode)
    given = _given(wanted)
    changes: dict[str, Any] = {}
    stages = run.stages if wanted.stages is None else wanted.stages
    names = wanted.parameters or need(run, "reconstruct", "reconstruct").parameters
    tables = build.named(run.parameters)
    if stages and all(stage.parameters for stage in stages):
        staged = {name for stage in stages for name in stage.parameters}
        names = [name for name in staged if name in (names or tables)]
    kept = {name: table for name, table in tables.items() if name in (names or tables)}
    smooth = {} if wanted.smooth is None else {"smooth": wanted.smooth}
    changes["parameters"] = [
        table.model_copy(update=smooth if table.kind == "vertices" else {})
        for table in kept.values()
    ]
    # Stages seek what the fit has; one that has nothing left to seek falls out.
    changes["stages"] = [
        stage.model_copy(update={"parameters": [n for n in stage.parameters if n in kept]})
        for stage in stages
        if not stage.parameters or any(name in kept for name in stage.parameters)
    ]
    changes["optimizer"] = _optimizer(run, given)
    for section in ("reconstruct", "surrogate"):
        table = getattr(run, section)
        keys = set(type(table).model_fields) - {"parameters"}
        changes[section] = table.model_copy(update=_among(given, keys))
    return run.model_copy(update=changes)


def _optimizer(run: RunFile, given: Mapping[str, Any]) -> Any:
    """The table of the optimizer with what a variant or a stage changes."""
    table = run.optimizer
    made = registry.table("optimizer", given.get("kind", table.kind))
    if isinstance(table, made):
        return table.model_copy(update=_among(given, made.model_fields))
    # Each kind has a table of its own.
    values = table.model_dump(exclude_unset=True) | given
    return made(**_among(values, made.model_fields))


def _given(table: Settings) -> dict[str, Any]:
    """What a table says, by the names of the sections that it varies."""
    found = table.model_dump(exclude_none=True)
    if "optimizer" in found:
        found["kind"] = found.pop("optimizer")
    return found


def _among(values: Mapping[str, Any], keys: Collection[str]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key in keys}


def stages_of(run: RunFile) -> list[Stage]:
    """The stages of a fit, as the library takes them."""
    settings = vars(need(run, "reconstruct", "reconstruct"))
    common = _among(settings, ("steps", "annealing", "frames_per_step", "tolerance"))
    if not run.stages:
        return [Stage(**common)]
    return [_stage(run, table, common) for table in run.stages]


def _stage(run: RunFile, table: StageTable, common: dict[str, Any]) -> Stage:
    given = _given(table)
    rates = _among(given, ("kind", "rate", "final_rate"))
    counts, widths = _among(given, ("samples", "boundary_samples")), _among(given, _WIDTHS)
    remesh = {}
    if table.remesh is not None:
        tables = build.named(run.parameters)
        sought = [tables[name] for name in table.parameters or tables]
        change = partial(remeshed, edge=table.remesh)
        remesh = {t.object: change for t in sought if t.kind == "vertices"}
    return Stage(
        unknowns=tuple(table.parameters),
        rebuild=table.rebuild,
        remesh=remesh,
        optimizer=build.optimizer(_optimizer(run, rates)) if rates else None,
        change=partial(_changed, counts, widths) if counts or widths else None,
        **{**common, **_among(given, common)},
    )


def _changed(
    counts: Mapping[str, int], widths: Mapping[str, float], observation: Observation
) -> Observation:
    """An observation with what a stage says of samples and extra widths."""
    model = observation.model.sampled_by(**counts)
    if widths and isinstance(model, SurrogateMap):
        model = replace(model, surrogate=replace(model.kernels, **widths))
    return replace(observation, model=model)


def steps_of(run: RunFile) -> int:
    """The budget of a fit."""
    return sum(stage.steps for stage in stages_of(run))


def modes_of(run: RunFile) -> list[str]:
    """The fits of one start: as the run file says, and its variants."""
    settings = need(run, "reconstruct", "reconstruct")
    modes = [FULL if settings.boundary else INTERIOR]
    if settings.also_interior_only and settings.boundary:
        modes.append(INTERIOR)
    return [*modes, *run.variants]


def sampling_of(run: RunFile) -> Sampling:
    """How the model of a fit samples paths."""
    settings = vars(need(run, "reconstruct", "reconstruct"))
    keys = ("depth", "samples", "boundary_samples", "boundary")
    return Sampling(**_among(settings, keys), points_per_m2=points_per_m2(run))


def points_per_m2(run: RunFile) -> float:
    """Points per m² of rough surfaces in exact signals: those of simulated data, or enough."""
    return run.data.density if isinstance(run.data, SimulatedData) else _POINTS_PER_M2


def annealed_until(run: RunFile) -> float | None:
    """The step from which the surrogate has no extra widths; None if it never has, or in stages."""
    stages = stages_of(run)
    if len(stages) > 1 or run.surrogate.exact:
        return None
    given = _given(run.stages[0]) if run.stages else {}
    wide = any(given.get(key, getattr(run.surrogate, key)) > 0 for key in _WIDTHS)
    return stages[0].annealing * stages[0].steps if wide else None


def observations_of(problem: Problem) -> list[Observation]:
    """What is fitted of every sensor: data, model and the sensor's own unknowns."""
    run = problem.run
    poses = {
        name: Unknown(lambda _: RadarPose(), getattr(table, "rate", None))
        for name, table in build.named(run.parameters).items()
        if table.kind == "radar_pose"
    }
    return [
        Observation(
            sight.model(sampling_of(run)),
            sight.radar,
            sight.capture,
            sight.weight,
            {**poses, **_nuisances(run, sight, name)},
        )
        for name, sight in problem.sights.items()
    ]


def _nuisances(run: RunFile, sight: Sight, name: str) -> dict[str, nn.Module]:
    """Modules of what is wrong with a measurement, fitted along."""
    made = {"range_bias": RangeBias, "clock_offset": lambda: ClockOffset(sight.capture.positions)}
    kinds = need(run, "reconstruct", "reconstruct").nuisances
    return {f"{name}.{kind}" if name else kind: made[kind]() for kind in kinds}


def unknowns_of(run: RunFile) -> dict[str, Unknown]:
    """What is fitted of the scene, by name."""
    tables = build.named(run.parameters)
    makers = build.builders(run.parameters, run.scene)
    return {
        name: Unknown(makers[name], getattr(table, "rate", None), partial(shape_terms, table))
        for name, table in tables.items()
        if table.kind != "radar_pose"
    }
