"""What is to be fitted: scene, data, radar and grid of a run file."""

from dataclasses import dataclass

from rich.console import Console
from torch import nn

from invertwin.capture import Capture
from invertwin.channel.paths import Grid
from invertwin.cli import build
from invertwin.cli.recordings import measured
from invertwin.cli.run_file import need
from invertwin.cli.run_simulate import exact
from invertwin.cli.schema import MoverParameter, RadarParameter, RunFile, SimulatedData
from invertwin.errors import InputError
from invertwin.inversion.nuisances import ClockOffset, RangeBias
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
    build.parameters(run.parameters, scene)  # their errors come before any work
    data = need(run, "data", "reconstruct")
    for i, parameter in enumerate(run.parameters):
        if isinstance(parameter, MoverParameter):
            raise InputError(
                f'parameters[{i}].kind: expected "mover" with data.kind = "openradar" only, got '
                f'"{data.kind}"; use "translation", "pose" or another kind'
            )
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
    return [p.object for p in run.parameters if not isinstance(p, RadarParameter)]


def steps_of(problem: Problem) -> int:
    """The budget of a fit."""
    return need(problem.run, "reconstruct", "reconstruct").steps


def density_of(run: RunFile) -> float:
    """Rough points per m² of the exact chain: those of simulated data, or enough of them."""
    return run.data.density if isinstance(run.data, SimulatedData) else _DENSITY


def annealed_until(run: RunFile) -> float | None:
    """The step from which the surrogate has no extra widths; None if it never has."""
    settings = need(run, "reconstruct", "reconstruct")
    wide = run.surrogate.range_width > 0 or run.surrogate.angle_width > 0
    return settings.annealing * settings.steps if wide else None


def nuisances_of(problem: Problem) -> list[nn.Module]:
    """New modules of what is fitted along."""
    made = {"range_bias": RangeBias, "clock_offset": lambda: ClockOffset(problem.capture)}
    names = need(problem.run, "reconstruct", "reconstruct").nuisances
    return [made[name]() for name in names]
