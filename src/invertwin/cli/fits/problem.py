"""What is to be fitted: scene, data, radar and grid of a run file."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rich.console import Console
from torch import nn

from invertwin.capture import Capture
from invertwin.channel import Grid
from invertwin.cli import build
from invertwin.cli.bodies import sought_bodies
from invertwin.cli.recordings import measured
from invertwin.cli.run_file import need
from invertwin.cli.run_simulate import exact
from invertwin.cli.schema import (
    RunFile,
    Settings,
    SimulatedData,
    Variant,
)
from invertwin.cli.schema import Stage as StageTable
from invertwin.errors import InputError
from invertwin.inversion.nuisances import ClockOffset, RangeBias
from invertwin.inversion.remeshing import remeshed
from invertwin.inversion.stages import Stage
from invertwin.radar.radar import Radar
from invertwin.scene import Scene

FULL, INTERIOR = "full", "interior_only"

_DENSITY = 2_000.0  # points per m²


@dataclass(frozen=True)
class Problem:
    """Everything a fit needs, built from the run file.

    Attributes:
        run: The run file.
        scene: The scene as known.
        truth: The true scene, where the run file knows it.
        known: Names of the objects whose true pose is known.
        capture: The data.
        radar: What measured them.
        grid: Bins that are compared.
        target: The object that is scored, if any moves.
    """

    run: RunFile
    scene: Scene
    truth: Scene
    known: frozenset[str]
    capture: Capture
    radar: Radar
    grid: Grid
    target: str | None


def problem_of(run: RunFile, console: Console) -> Problem:
    """Builds the problem; simulated data are simulated here.

    Raises:
        InputError: A section is missing or does not fit the data.
    """
    need(run, "parameters", "reconstruct")
    table = need(run, "grid", "reconstruct")
    scene, truth = build.scene(run), build.true_scene(run)
    data = need(run, "data", "reconstruct")
    for i, parameter in enumerate(run.parameters):
        if parameter.kind == "mover":
            raise InputError(
                f'parameters[{i}].kind: expected "mover" with data.kind = "openradar" only, got '
                f'"{data.kind}"; use "translation", "pose" or another kind'
            )
    # Their errors come before any work.
    build.parameters(run.parameters, scene, sought_bodies(run), run.scene)
    if isinstance(data, SimulatedData):
        radar = build.radar(need(run, "radar", "simulated data"))
        grid = build.grid(table, radar)
        console.print("simulating the exact signals of the true scene")
        beat = exact(run, truth, radar, grid).beat
        assert beat is not None
        capture = Capture.from_beat(beat, radar)
        known = frozenset(truth.names)
    else:
        if run.radar is not None:
            raise InputError(
                f"radar: expected no [radar] with data.kind = {data.kind}, got one; "
                "remove it: a capture brings its radar along"
            )
        capture = measured(data)
        radar = capture.radar()
        grid = build.grid(table, radar)
        known = frozenset(run.truth)
    target = run.starts.object if run.starts else next(iter(sought_objects(run)), None)
    return Problem(run, scene, truth, known, capture, radar, grid, target)


def sought_objects(run: RunFile) -> list[str]:
    """Objects that have parameters."""
    return [p.object for p in run.parameters if getattr(p, "object", None)]


def varied(problem: Problem, mode: str) -> Problem:
    """The problem of a mode: the run's own, without boundary terms, or a variant.

    Its run file holds the parameters of this fit only.
    """
    return replace(problem, run=varied_run(problem.run, mode))


def varied_run(run: RunFile, mode: str) -> RunFile:
    """The run file of a mode, with the parameters of this fit only."""
    wanted = Variant() if mode == FULL else Variant(boundary=False)
    if mode not in (FULL, INTERIOR):
        wanted = run.variants[mode]
    given = _given(wanted)
    changes: dict[str, Any] = {}
    stages = run.stages if wanted.stages is None else wanted.stages
    names = wanted.parameters or need(run, "reconstruct", "reconstruct").parameters
    tables = build.named(run.parameters)
    if stages and all(stage.parameters for stage in stages):
        staged = {name for stage in stages for name in stage.parameters}
        names = [name for name in staged if name in (names or tables)]
    kept = {name: table for name, table in tables.items() if name in (names or tables)}
    if wanted.smooth is not None:
        smooth = {"smooth": wanted.smooth}
        for name, table in kept.items():
            if table.kind == "vertices":
                kept[name] = table.model_copy(update=smooth)
    changes["parameters"] = list(kept.values())
    # Stages seek what the fit has; one that has nothing left to seek falls out.
    changes["stages"] = [
        stage.model_copy(update={"parameters": [n for n in stage.parameters if n in kept]})
        for stage in stages
        if not stage.parameters or any(name in kept for name in stage.parameters)
    ]
    for section in ("reconstruct", "optimizer", "surrogate"):
        table = getattr(run, section)
        keys = set(type(table).model_fields) - {"parameters"}
        update = {key: value for key, value in given.items() if key in keys}
        changes[section] = table.model_copy(update=update)
    return run.model_copy(update=changes)


def _given(table: Settings) -> dict[str, Any]:
    """What a table says, by the names of the sections that it varies."""
    found = table.model_dump(exclude_none=True)
    if "optimizer" in found:
        found["kind"] = found.pop("optimizer")
    return found


def stages_of(problem: Problem) -> list[Stage]:
    """The stages of a fit, as the library takes them."""
    return run_stages(problem.run)


def run_stages(run: RunFile) -> list[Stage]:
    """The same of a run file."""
    settings = need(run, "reconstruct", "reconstruct")
    if not run.stages:
        return [Stage(settings.steps)]
    return [_stage(run, table) for table in run.stages]


def _stage(run: RunFile, table: StageTable) -> Stage:
    given = _given(table)
    options = {
        key: given[key]
        for key in ("samples", "boundary_samples", "frames_per_step", "annealing")
        if key in given
    }
    rates = {key: given[key] for key in ("kind", "rate", "final_rate") if key in given}
    widths = {key: given[key] for key in ("range_width", "angle_width") if key in given}
    if rates:
        options["optimizer"] = build.optimizer(run.optimizer.model_copy(update=rates))
    if widths and not run.surrogate.exact:
        options["surrogate"] = build.surrogate(run.surrogate.model_copy(update=widths))
    remesh = {}
    if table.remesh is not None:
        tables = build.named(run.parameters)
        sought = [tables[name] for name in table.parameters or tables]
        change = partial(remeshed, edge=table.remesh)
        remesh = {t.object: change for t in sought if t.kind == "vertices"}
    steps = table.steps or need(run, "reconstruct", "reconstruct").steps
    return Stage(steps, tuple(table.parameters), table.rebuild, remesh, options)


def steps_of(problem: Problem) -> int:
    """The budget of a fit."""
    return sum(stage.steps for stage in stages_of(problem))


def modes_of(run: RunFile) -> list[str]:
    """The fits of one start: as the run file says, and its variants."""
    settings = need(run, "reconstruct", "reconstruct")
    modes = [FULL if settings.boundary else INTERIOR]
    if settings.also_interior_only and settings.boundary:
        modes.append(INTERIOR)
    return [*modes, *run.variants]


def density_of(run: RunFile) -> float:
    """Rough points per m² of the exact chain: those of simulated data, or enough of them."""
    return run.data.density if isinstance(run.data, SimulatedData) else _DENSITY


def annealed_until(run: RunFile) -> float | None:
    """The step from which the surrogate has no extra widths; None if it never has, or in stages."""
    settings, stages = need(run, "reconstruct", "reconstruct"), run_stages(run)
    if len(stages) > 1 or run.surrogate.exact:
        return None
    options = stages[0].options
    widths = options.get("surrogate", run.surrogate)
    wide = widths.range_width > 0 or widths.angle_width > 0
    return options.get("annealing", settings.annealing) * stages[0].steps if wide else None


def nuisances_of(problem: Problem) -> list[nn.Module]:
    """New modules of what is fitted along."""
    made = {"range_bias": RangeBias, "clock_offset": lambda: ClockOffset(problem.capture)}
    names = need(problem.run, "reconstruct", "reconstruct").nuisances
    return [made[name]() for name in names]
