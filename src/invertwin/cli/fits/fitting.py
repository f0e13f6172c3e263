"""The fits themselves: calibration, one fit per start, progress, interruptions."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import nn

from invertwin.capture import calibrate
from invertwin.cli.fits.displays import KeptSteps, steps_file
from invertwin.cli.fits.problem import (
    FULL,
    Problem,
    fitted_objects,
    known_of,
    models_of,
    observations_of,
    recorded_anew,
    schedule_of,
    settings_of,
    unknowns_of,
    varied,
)
from invertwin.cli.fits.scores import scores
from invertwin.cli.fits.shape_scores import CURVE, watch_of
from invertwin.cli.fits.spreading import part_name
from invertwin.cli.schema import build
from invertwin.errors import InputError
from invertwin.inversion import (
    Callback,
    Checkpoint,
    Observation,
    Reconstruction,
    Report,
    Stage,
    Watch,
    reconstruct,
    search,
    watched,
)
from invertwin.inversion.callbacks import stage_file
from invertwin.inversion.confidence.report import certainty
from invertwin.inversion.fit import Fit
from invertwin.radar.parameters import ClockOffset, RangeBias
from invertwin.scene import Object, Scene
from invertwin.seeds import derived_seed
from invertwin.storage.folders import PARTS
from invertwin.storage.run_folder import RunFolder
from invertwin.viewer import Step


def calibrated(
    problem: Problem, folder: RunFolder, console: Console
) -> tuple[Problem, dict[str, Any]]:
    """The problem with range bias and clock offset found on an object whose place is known."""
    run, table = problem.run, problem.run.calibration
    if table is None:
        return problem, {}
    if len(problem.sights) > 1:
        raise InputError(
            "calibration: expected one sensor, got several; calibrate each recording by itself"
        )
    sight, target = problem.first, problem.truth[table.object]
    if table.method == "backprojection":
        capture, row = calibrate(sight.capture, target.center), {}
    else:
        bias, clock = RangeBias(), ClockOffset(sight.capture.positions)
        own = replace(problem, run=run.varied(table))
        schedule, (model,) = settings_of(own.run).build(), models_of(own)
        with watched("calibration", schedule.steps, console) as shown:
            found = reconstruct(
                Scene({table.object: target}),
                Observation(model, sight.radar, sight.capture, parameters=[bias, clock]),
                [],
                loss=build.made(run, "loss"),
                optimizer=build.made(own.run, "optimizer"),
                schedule=schedule,
                callbacks=[*shown, _checkpoint(problem, folder, f"{PARTS}/calibration.pt")],
                seed=run.seed,
            )
        capture = sight.capture.recalibrated(
            sight.capture.clock_offset + float(clock.shift.detach()),
            sight.capture.range_bias + float(bias.bias.detach()),
        )
        row = {"loss": found.loss, "status": found.status}
    row |= {"clock_offset_s": capture.clock_offset, "range_bias_m": capture.range_bias}
    sight = replace(sight, capture=capture, radar=capture.radar())
    return replace(problem, sights=dict.fromkeys(problem.sights, sight)), row


def fit(
    problem: Problem,
    start: Scene,
    index: int,
    mode: str,
    folder: RunFolder,
    console: Console,
    checkpoint: str | None,
    show: Callable[[Fit, Step], None] | None = None,
) -> tuple[dict[str, Any], Callable[[], Reconstruction]]:
    """One fit, or what an interrupted run has kept of it.

    Args:
        problem: What is to be fitted.
        start: From where.
        index: Number of the start.
        mode: The run's own way to fit, or a variant.
        folder: Keeps results and checkpoints.
        console: Shows progress.
        checkpoint: Name of the checkpoint; None = one among the parts.
        show: Is told of steps as they come.

    Returns:
        The row of the fit, and a function that gives its outcome.
    """
    part = part_name(mode, index)
    checkpoint = checkpoint or f"{part}.pt"
    own = varied(problem, mode)
    stages = schedule_of(own)
    again = partial(_staged, own, stages, start, index, folder, checkpoint, show)
    row = folder.read_json(f"{part}.json")
    if row is not None:
        # The checkpoints say what the fit found; nothing is fitted again.
        return row, lambda: again()[0]
    begin = time.perf_counter()
    name = f"start {index + 1}" + ("" if mode == FULL else f", {mode.replace('_', ' ')}")
    with watched(name, sum(stage.steps for stage in stages), console) as shown:
        found, found_ends = again(shown)
    row = {
        "start": index,
        **scores(own, start, found.scene),
        "loss": found.loss,
        "status": found.status,
        "lost": found.lost,
        "steps": found.steps,
        "seconds": time.perf_counter() - begin,
        "values": _values(found.parameters),
        "checkpoint": found_ends.pop("checkpoint", checkpoint),
        **found_ends,
        **(certainty(found, known_of(own)) if recorded_anew(own.run) else {}),
        "losses": [step["loss"] for step in found.history],
        "curve": [[step["step"] + 1, step[CURVE]] for step in found.history if CURVE in step],
    }
    folder.write_json(f"{part}.json", row)
    # The twins of many recordings are read again, not kept.
    return row, (lambda: again()[0]) if recorded_anew(own.run) else lambda: found


def _staged(
    problem: Problem,
    stages: Sequence[Stage],
    start: Scene,
    index: int,
    folder: RunFolder,
    checkpoint: str,
    show: Callable[[Fit, Step], None] | None,
    shown: Sequence[Report] = (),
) -> tuple[Reconstruction, dict[str, Any]]:
    """A fit, or a search about its start; and what the row says of the search."""
    run, watch = problem.run, watch_of(problem)
    every = run.measures.every if run.measures else 1

    def callbacks(file: str) -> list[Callback]:
        for k in range(len(stages) - 1):
            folder.file(str(stage_file(Path(file), k)))
        watching = [] if watch is None else [Watch(watch, every)]
        kept = KeptSteps(
            folder.file(steps_file(file)),
            [name for name in dict.fromkeys(fitted_objects(run)) if name in start.names],
            sum(stage.steps for stage in stages),
            settings_of(run).checkpoint_every,
            show if shown else None,
        )
        return [*watching, *shown, _checkpoint(problem, folder, file), kept]

    given = start, observations_of(problem), unknowns_of(run)
    how: dict[str, Any] = {key: build.made(run, key) for key in ("loss", "optimizer")}
    how |= {"schedule": stages, "seed": derived_seed(run.seed, index)}
    if run.search is None:
        return reconstruct(*given, callbacks=callbacks(checkpoint), **how), {}
    name, part = run.search.object, f"{PARTS}/{Path(checkpoint).stem}_fit"
    chance = torch.Generator().manual_seed(how["seed"])
    poses = build.made(run, "search", {Object: start[name], torch.Generator: chance})
    starts = {name: [start[name], *poses]}
    found = search(*given, starts, callbacks=lambda n: callbacks(f"{part}{n}.pt"), **how)
    return found.best, {"checkpoint": f"{part}{found.number}.pt", **found.rows()}


def _checkpoint(problem: Problem, folder: RunFolder, name: str) -> Checkpoint:
    """Goes on from its own unfinished part; open_run has settled what may be there."""
    return Checkpoint(folder.file(name), settings_of(problem.run).checkpoint_every, resume=True)


def _values(modules: nn.ModuleList) -> dict[str, Any]:
    """Fitted values by name; vertices are in the mesh file and the checkpoint."""
    rows: dict[str, Any] = {}
    for module in modules:
        found: dict[str, torch.Tensor] = getattr(module, "values", dict)()
        rows |= {name: value.tolist() for name, value in found.items() if value.numel() <= 16}
    return rows
