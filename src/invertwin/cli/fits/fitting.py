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
from invertwin.cli.fits.displays import StepRecorder, steps_path
from invertwin.cli.fits.problem import (
    OWN_METHOD,
    Problem,
    fitted_objects,
    has_recording_per_start,
    known_truth,
    make_models,
    make_observations,
    make_schedule,
    make_unknowns,
    require_settings,
    with_method,
)
from invertwin.cli.fits.scores import score_fit
from invertwin.cli.fits.shape_scores import CURVE_KEY, make_shape_metric
from invertwin.cli.fits.spreading import fit_file_stem
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
    report_progress,
    search,
)
from invertwin.inversion.callbacks import stage_checkpoint_path
from invertwin.inversion.confidence.report import confidence_metrics
from invertwin.inversion.fit import Fit
from invertwin.radar.parameters import ClockOffset, RangeBias
from invertwin.scene import Object, Scene
from invertwin.seeds import derive_seed
from invertwin.storage.folders import PARTS
from invertwin.storage.run_folder import RunFolder
from invertwin.viewer import DisplayStep


def calibrate_problem(
    problem: Problem, folder: RunFolder, console: Console
) -> tuple[Problem, dict[str, Any]]:
    """The problem with range bias and clock offset found on an object whose place is known."""
    run, table = problem.run, problem.run.calibration
    if table is None:
        return problem, {}
    if len(problem.sensor_data) > 1:
        raise InputError(
            "calibration: expected one sensor, got several; calibrate each recording by itself"
        )
    sight, target = problem.first_sensor, problem.truth[table.object]
    if table.method == "backprojection":
        capture, row = calibrate(sight.capture, target.center), {}
    else:
        bias, clock = RangeBias(), ClockOffset(sight.capture.positions)
        own = replace(problem, run=run.apply_overrides(table))
        schedule, (model,) = require_settings(own.run).build(), make_models(own)
        with report_progress("calibration", schedule.steps, console) as shown:
            found = reconstruct(
                Scene({table.object: target}),
                Observation(model, sight.capture, sensor=sight.radar, parameters=[bias, clock]),
                [],
                loss=build.build_section(run, "loss"),
                optimizer=build.build_section(own.run, "optimizer"),
                schedule=schedule,
                callbacks=[*shown, _make_checkpoint(problem, folder, f"{PARTS}/calibration.pt")],
                seed=run.seed,
            )
        capture = sight.capture.recalibrate(
            sight.capture.clock_offset + float(clock.shift.detach()),
            sight.capture.range_bias + float(bias.bias.detach()),
        )
        row = {"loss": found.loss, "status": found.status}
    row |= {"clock_offset_s": capture.clock_offset, "range_bias_m": capture.range_bias}
    sight = replace(sight, capture=capture, radar=capture.radar())
    return replace(problem, sensor_data=dict.fromkeys(problem.sensor_data, sight)), row


def run_fit(
    problem: Problem,
    start: Scene,
    index: int,
    mode: str,
    folder: RunFolder,
    console: Console,
    checkpoint: str | None,
    show: Callable[[Fit, DisplayStep], None] | None = None,
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
    part = fit_file_stem(mode, index)
    checkpoint = checkpoint or f"{part}.pt"
    own = with_method(problem, mode)
    stages = make_schedule(own)
    again = partial(_fit_or_search, own, stages, start, index, folder, checkpoint, show)
    row = folder.read_json(f"{part}.json")
    if row is not None:
        # The checkpoints say what the fit found; nothing is fitted again.
        return row, lambda: again()[0]
    begin = time.perf_counter()
    name = f"start {index + 1}" + ("" if mode == OWN_METHOD else f", {mode.replace('_', ' ')}")
    with report_progress(name, sum(stage.steps for stage in stages), console) as shown:
        found, found_ends = again(shown)
    row = {
        "start": index,
        **score_fit(own, start, found.scene),
        "loss": found.loss,
        "status": found.status,
        "lost": found.is_uninformative,
        "steps": found.steps,
        "seconds": time.perf_counter() - begin,
        "values": _fitted_values(found.parameters),
        "checkpoint": found_ends.pop("checkpoint", checkpoint),
        **found_ends,
        **(confidence_metrics(found, known_truth(own)) if has_recording_per_start(own.run) else {}),
        "losses": [step["loss"] for step in found.history],
        "curve": [
            [step["step"] + 1, step[CURVE_KEY]] for step in found.history if CURVE_KEY in step
        ],
    }
    folder.write_json(f"{part}.json", row)
    # The twins of many recordings are read again, not kept.
    return row, (lambda: again()[0]) if has_recording_per_start(own.run) else lambda: found


def _fit_or_search(
    problem: Problem,
    stages: Sequence[Stage],
    start: Scene,
    index: int,
    folder: RunFolder,
    checkpoint: str,
    show: Callable[[Fit, DisplayStep], None] | None,
    reports: Sequence[Report] = (),
) -> tuple[Reconstruction, dict[str, Any]]:
    """A fit, or a search about its start; and what the row says of the search."""
    run, watch = problem.run, make_shape_metric(problem)
    every = run.measures.every if run.measures else 1

    def make_callbacks(file: str) -> list[Callback]:
        for k in range(len(stages) - 1):
            folder.file(str(stage_checkpoint_path(Path(file), k)))
        watching = [] if watch is None else [Watch(watch, every)]
        kept = StepRecorder(
            folder.file(steps_path(file)),
            [name for name in dict.fromkeys(fitted_objects(run)) if name in start.names],
            sum(stage.steps for stage in stages),
            require_settings(run).checkpoint_every,
            show if reports else None,
        )
        return [*watching, *reports, _make_checkpoint(problem, folder, file), kept]

    given = start, make_observations(problem), make_unknowns(run)
    how: dict[str, Any] = {key: build.build_section(run, key) for key in ("loss", "optimizer")}
    how |= {"schedule": stages, "seed": derive_seed(run.seed, index)}
    if run.search is None:
        return reconstruct(*given, callbacks=make_callbacks(checkpoint), **how), {}
    name, part = run.search.object, f"{PARTS}/{Path(checkpoint).stem}_fit"
    chance = torch.Generator().manual_seed(how["seed"])
    poses = build.build_section(run, "search", {Object: start[name], torch.Generator: chance})
    starts = {name: [start[name], *poses]}
    found = search(*given, starts, callbacks=lambda n: make_callbacks(f"{part}{n}.pt"), **how)
    return found.best, {"checkpoint": f"{part}{found.best_number}.pt", **found.to_metrics()}


def _make_checkpoint(problem: Problem, folder: RunFolder, name: str) -> Checkpoint:
    """Goes on from its own unfinished part; open_run has settled what may be there."""
    return Checkpoint(
        folder.file(name), require_settings(problem.run).checkpoint_every, resume=True
    )


def _fitted_values(modules: nn.ModuleList) -> dict[str, Any]:
    """Fitted values by name; vertices are in the mesh file and the checkpoint."""
    rows: dict[str, Any] = {}
    for module in modules:
        found: dict[str, torch.Tensor] = getattr(module, "values", dict)()
        rows |= {name: value.tolist() for name, value in found.items() if value.numel() <= 16}
    return rows
