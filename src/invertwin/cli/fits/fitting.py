"""The fits themselves: calibration, one fit per start, progress, interruptions."""

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import nn

from invertwin.capture import calibrate
from invertwin.cli import build
from invertwin.cli.fits.problem import (
    FULL,
    INTERIOR,
    Problem,
    density_of,
    nuisances_of,
    steps_of,
)
from invertwin.cli.fits.scores import scores
from invertwin.cli.run_file import need
from invertwin.cli.runs import PARTS, RunFolder
from invertwin.inversion.nuisances import ClockOffset, RangeBias
from invertwin.inversion.reconstruction import Reconstruction, reconstruct
from invertwin.radar.radar import Radar
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
        nuisances = [RangeBias(), ClockOffset(problem.capture)]
        checkpoint = f"{PARTS}/calibration.pt"
        rate = table.rate or problem.run.optimizer.rate
        steps = table.steps or steps_of(problem)
        found = _reconstruct(
            problem,
            alone,
            nuisances,
            Bar(console, "calibration", steps),
            folder.file(checkpoint),
            steps=steps,
            optimizer=replace(build.optimizer(problem.run.optimizer), rate=rate),
        )
        capture = problem.capture.recalibrated(
            problem.capture.clock_offset + float(nuisances[1].shift.detach()),
            problem.capture.range_bias + float(nuisances[0].bias.detach()),
        )
        row = {"loss": found.loss, "status": found.status}
    row |= {"clock_offset_s": capture.clock_offset, "range_bias_m": capture.range_bias}
    return replace(problem, capture=capture, radar=capture.radar()), row


def fit(
    problem: Problem,
    scene: Scene,
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
    name = f"start {index + 1}" + (", interior only" if mode == INTERIOR else "")
    checkpoint = checkpoint or f"{part}.pt"
    found = _reconstruct(
        problem,
        scene,
        [*build.parameters(problem.run.parameters, scene), *nuisances_of(problem)],
        Bar(console, name, steps_of(problem)),
        folder.file(checkpoint),
        steps=steps_of(problem),
        boundary=mode == FULL,
        seed=problem.run.seed + index,
        regularizers=build.regularizers(problem.run.parameters, scene),
    )
    row = {
        "start": index,
        **scores(problem, scene, found.scene),
        "loss": found.loss,
        "status": found.status,
        "steps": found.steps,
        "seconds": time.perf_counter() - begin,
        "values": _values(found.parameters),
        "checkpoint": checkpoint,
        "losses": [step["loss"] for step in found.history],
    }
    folder.write_json(f"{part}.json", row)
    return row


def _values(modules: nn.ModuleList) -> dict[str, Any]:
    """Fitted values by name; vertices are in the mesh file and the checkpoint."""
    rows: dict[str, Any] = {}
    for module in modules:
        found: dict[str, torch.Tensor] = getattr(module, "values", dict)()
        rows |= {name: value.tolist() for name, value in found.items() if value.numel() <= 16}
    return rows


def _reconstruct(
    problem: Problem,
    scene: Scene,
    modules: Sequence[nn.Module],
    bar: "Bar",
    checkpoint: Any,
    **changes: Any,
) -> Reconstruction:
    settings, table = need(problem.run, "reconstruct", "reconstruct"), problem.run.surrogate
    options = {
        "grid": problem.grid,
        "loss": build.loss(problem.run.loss),
        "optimizer": build.optimizer(problem.run.optimizer),
        "surrogate": None if table.exact else build.surrogate(table),
        "density": density_of(problem.run),
        "annealing": settings.annealing,
        "seed": problem.run.seed,
        "samples": settings.samples,
        "boundary_samples": settings.boundary_samples,
        "depth": settings.depth,
        "boundary": settings.boundary,
        "frames_per_step": settings.frames_per_step,
        "tolerance": settings.tolerance,
        "checkpoint": checkpoint,
        "checkpoint_every": settings.checkpoint_every,
        "resume": True,  # from its own unfinished part; open_run has settled what may be there
    }
    with bar, _interrupted_between_steps() as heed:

        def advance(row: dict[str, Any]) -> None:
            bar.advance(row)
            heed()

        return reconstruct(
            scene,
            problem.radar,
            problem.capture,
            modules,
            progress=advance,
            **(options | changes),
        )


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


def restored(
    problem: Problem, scene: Scene, folder: RunFolder, checkpoint: str
) -> tuple[Scene, Radar, torch.Tensor | None]:
    """Twin, radar and range offset of a finished fit, from its checkpoint."""
    modules = nn.ModuleList(
        [*build.parameters(problem.run.parameters, scene), *nuisances_of(problem)]
    )
    saved = torch.load(folder.path / checkpoint, weights_only=True)
    modules.load_state_dict(saved["modules"])
    radar, offset = problem.radar, None
    with torch.no_grad():
        for module in modules:
            match getattr(module, "applies_to", "scene"):
                case "scene":
                    scene = module(scene)
                case "radar":
                    radar = module(radar)
                case "range":
                    offset = module()
    return scene, radar, offset
