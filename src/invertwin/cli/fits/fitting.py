"""The fits themselves: calibration, one fit per start, progress, interruptions."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from types import FrameType
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import nn

from invertwin.capture import calibrate
from invertwin.cli import build
from invertwin.cli.fits.likeness import CURVE, watch_of
from invertwin.cli.fits.problem import (
    FULL,
    Problem,
    density_of,
    nuisances_of,
    stages_of,
    steps_of,
    varied,
)
from invertwin.cli.fits.scores import scores
from invertwin.cli.run_file import need
from invertwin.cli.runs import PARTS, RunFolder
from invertwin.inversion.reconstruction import Reconstruction, reconstruct
from invertwin.inversion.stages import reconstruct_in_stages, stage_checkpoint
from invertwin.radar import ClockOffset, Radar, RangeBias
from invertwin.scene import Scene


def calibrated(
    problem: Problem, folder: RunFolder, console: Console
) -> tuple[Problem, dict[str, Any]]:
    """The problem with range bias and clock offset found on an object whose place is known."""
    table = problem.run.calibration
    if table is None:
        return problem, {}
    center = problem.truth[table.object].center
    if table.method == "backprojection":
        capture, row = calibrate(problem.capture, center), {}
    else:
        alone = Scene({table.object: problem.truth[table.object]})
        nuisances = [RangeBias(), ClockOffset(problem.capture.positions)]
        checkpoint = f"{PARTS}/calibration.pt"
        rate = table.rate or problem.run.optimizer.rate
        steps = table.steps or steps_of(problem)
        options = _options(problem)
        options["optimizer"] = replace(options["optimizer"], rate=rate)
        with _watched(Bar(console, "calibration", steps)) as advance:
            found = reconstruct(
                alone,
                problem.radar,
                problem.capture,
                nuisances,
                steps=steps,
                seed=problem.run.seed,
                checkpoint=folder.file(checkpoint),
                resume=True,
                progress=advance,
                **options,
            )
        capture = problem.capture.recalibrated(
            problem.capture.clock_offset + float(nuisances[1].shift.detach()),
            problem.capture.range_bias + float(nuisances[0].bias.detach()),
        )
        row = {"loss": found.loss, "status": found.status}
    row |= {"clock_offset_s": capture.clock_offset, "range_bias_m": capture.range_bias}
    return replace(problem, capture=capture, radar=capture.radar()), row


@dataclass(frozen=True)
class Outcome:
    """What a finished fit has found.

    Attributes:
        twin: The scene.
        radar: With the poses of the fit.
        offset: Range offset [m], where one is fitted along.
    """

    twin: Scene
    radar: Radar
    offset: torch.Tensor | None


def fit(
    problem: Problem,
    start: build.Start,
    index: int,
    mode: str,
    folder: RunFolder,
    console: Console,
    checkpoint: str | None,
) -> dict[str, Any]:
    """One fit, or what an interrupted run has kept of it."""
    part = f"{PARTS}/{mode}_{index:02d}"
    done = folder.read_json(f"{part}.json")
    if done is not None:
        return done
    begin = time.perf_counter()
    name = f"start {index + 1}" + ("" if mode == FULL else f", {mode.replace('_', ' ')}")
    checkpoint = checkpoint or f"{part}.pt"
    problem = varied(problem, mode)
    bar = Bar(console, name, steps_of(problem))
    found = _staged(problem, start, index, nuisances_of(problem), bar, folder, checkpoint)
    row = {
        "start": index,
        **scores(problem, start, found.scene),
        "loss": found.loss,
        "status": found.status,
        "steps": found.steps,
        "seconds": time.perf_counter() - begin,
        "values": _values(found.parameters),
        "checkpoint": checkpoint,
        "losses": [step["loss"] for step in found.history],
        "curve": [[step["step"] + 1, step[CURVE]] for step in found.history if CURVE in step],
    }
    folder.write_json(f"{part}.json", row)
    return row


def outcome(
    problem: Problem, start: build.Start, row: dict[str, Any], mode: str, folder: RunFolder
) -> Outcome:
    """Twin, radar and range offset of a finished fit, from its checkpoints."""
    problem = varied(problem, mode)
    nuisances = nuisances_of(problem)
    found = _staged(problem, start, row["start"], nuisances, None, folder, row["checkpoint"])
    offset = torch.as_tensor(found.radar.range_bias) if found.radar.biased else None
    return Outcome(found.scene, replace(found.radar, range_bias=0.0), offset)


def _staged(
    problem: Problem,
    start: build.Start,
    index: int,
    nuisances: list[nn.Module],
    bar: "Bar | None",
    folder: RunFolder,
    checkpoint: str,
) -> Reconstruction:
    run = problem.run
    tables = build.named(run.parameters)
    stages = stages_of(problem)
    for k in range(len(stages) - 1):
        folder.file(stage_checkpoint(checkpoint, k))
    own = {name: getattr(table, "rate", None) for name, table in tables.items()}
    rates = {name: float(rate) for name, rate in own.items() if rate is not None}
    with _watched(bar) as advance:
        return reconstruct_in_stages(
            start.scene,
            problem.radar,
            problem.capture,
            build.builders(run.parameters, start, run.scene),
            stages,
            rates=rates,
            regularize=partial(build.regularizers, tables),
            checkpoint=folder.file(checkpoint),
            resume=True,  # from its own unfinished part; open_run has settled what may be there
            seed=run.seed + index,
            nuisances=nuisances,
            watch=watch_of(problem),
            watch_every=run.measures.every if run.measures else 1,
            progress=advance,
            **_options(problem),
        )


def _values(modules: nn.ModuleList) -> dict[str, Any]:
    """Fitted values by name; vertices are in the mesh file and the checkpoint."""
    rows: dict[str, Any] = {}
    for module in modules:
        found: dict[str, torch.Tensor] = getattr(module, "values", dict)()
        rows |= {name: value.tolist() for name, value in found.items() if value.numel() <= 16}
    return rows


def _options(problem: Problem) -> dict[str, Any]:
    """What all fits of a run have in common."""
    settings, table = need(problem.run, "reconstruct", "reconstruct"), problem.run.surrogate
    return {
        "grid": problem.grid,
        "loss": build.loss(problem.run.loss),
        "optimizer": build.optimizer(problem.run.optimizer),
        "surrogate": None if table.exact else build.surrogate(table),
        "density": density_of(problem.run),
        "annealing": settings.annealing,
        "samples": settings.samples,
        "boundary_samples": settings.boundary_samples,
        "depth": settings.depth,
        "boundary": settings.boundary,
        "frames_per_step": settings.frames_per_step,
        "tolerance": settings.tolerance,
        "checkpoint_every": settings.checkpoint_every,
    }


@contextmanager
def _watched(bar: "Bar | None") -> Iterator[Callable[[dict[str, Any]], None] | None]:
    """Progress that is shown; Ctrl-C waits for the end of the step."""
    if bar is None:
        yield None
        return
    with bar, _interrupted_between_steps() as heed:

        def advance(row: dict[str, Any]) -> None:
            bar.advance(row)
            heed()

        yield advance


@contextmanager
def _interrupted_between_steps() -> Iterator[Callable[[], None]]:
    """Ctrl-C waits for the end of the step, when nothing is half done; a second one does not.

    Gives a function that raises KeyboardInterrupt if one is due.
    """
    due = False

    def heed() -> None:
        if due:
            raise KeyboardInterrupt

    def note(_signal: int, _frame: FrameType | None) -> None:
        nonlocal due
        heed()
        due = True

    # Another handler, or another thread than the main one, is not ours to change.
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not ours or threading.current_thread() is not threading.main_thread():
        yield heed
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield heed
        heed()
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class Bar:
    """Progress with the loss and the first parameters: a bar, or lines where no terminal is."""

    def __init__(self, console: Console, name: str, steps: int):
        self._console, self._name, self._steps = console, name, steps
        self._bar = Progress(
            TextColumn(name),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=console,
        )
        self._task = self._bar.add_task("", total=steps)

    def __enter__(self) -> "Bar":
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._bar.stop()

    def advance(self, row: dict[str, Any]) -> None:
        """Shows a row of the history."""
        values = " ".join(
            np.array2string(np.atleast_1d(value), precision=3, suppress_small=True)
            for value in list(row["values"].values())[:2]
            if np.size(value) <= 3
        )
        text = f"loss {row['loss']:.4f} {values}"
        done = row["step"] + 1
        if self._console.is_terminal:
            self._bar.update(self._task, completed=done, description=text)
        elif done * 10 // self._steps > row["step"] * 10 // self._steps:
            line = f"{self._name}: step {done} of {self._steps}, {text}"
            self._console.print(line, markup=False, soft_wrap=True)
