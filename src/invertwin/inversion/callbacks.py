"""Callbacks of a fit: progress reports, metrics of a known truth, checkpoints."""

import io
import signal
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from invertwin.errors import InputError
from invertwin.inversion.fit import Callback, Fit
from invertwin.runtime.progress import format_duration
from invertwin.scene.scene import Scene
from invertwin.storage.folders import replace_file
from invertwin.storage.untrusted import convert_read_errors


@dataclass(frozen=True)
class Report(Callback):
    """Call a function with the row of every step.

    Attributes:
        function: receives the row: ``step``, ``stage``, ``loss``, ``values``.
    """

    function: Callable[[dict[str, Any]], object]

    def step(self, fit: Fit, row: dict[str, Any]) -> None:
        """Report a row."""
        self.function(row)


@dataclass(frozen=True)
class Watch(Callback):
    """Add metrics of the present scene to the rows of a fit, such as its distance from a known
    truth.

    The metrics do not change the fit.

    Attributes:
        function: maps a scene to numbers by name.
        every: number of steps between two evaluations.
    """

    function: Callable[[Scene], dict[str, float]]
    every: int = 10

    def annotate(self, fit: Fit) -> dict[str, Any]:
        """Return the metrics of the present scene."""
        if fit.progress.step % self.every:
            return {}
        try:
            with torch.no_grad():
                return self.function(fit.apply_modules()[0])
        except InputError:  # parameters out of bounds, as the next step will find
            return {}


@dataclass(frozen=True)
class Checkpoint(Callback):
    """Write the state of a fit to a file atomically, and resume from it.

    Stages before the last one have files of their own: ``fit_stage0.pt`` beside ``fit.pt``. A
    checkpoint identifies its fit by a fingerprint of its content: a changed model, loss,
    regulariser, scene, material or datum is refused, and a user's loss function is recognised in a
    new process.

    Attributes:
        file: the checkpoint file.
        every: number of steps between two writes.
        resume: whether to resume from the file if it exists.
    """

    file: str | Path
    every: int = 10
    resume: bool = False

    def begin(self, fit: Fit) -> None:
        """Resume from the file.

        Raises:
            InputError: A file that cannot be read, or of another fit.
        """
        path = self._path(fit)
        if not (self.resume and path.is_file()):
            return
        with convert_read_errors(path, "a whole checkpoint", "delete it or start without resume"):
            # torch spends minutes on its message about names of a million letters.
            if torch.serialization.get_unsafe_globals_in_checkpoint(path):
                raise ValueError("it holds classes that no checkpoint has")
            state = torch.load(path, weights_only=True)
            restored = isinstance(state, dict) and fit.restore(state)
        if not restored:
            raise InputError(
                f"expected a checkpoint of this fit in {path}, got one of another (schedule, "
                "seed, model, loss, optimizer, regularizers, parameters, scene or data differ); "
                "start without resume"
            )

    def step(self, fit: Fit, row: dict[str, Any]) -> None:
        """Write the file every ``every`` steps."""
        if fit.progress.step % self.every == 0:
            self.end(fit)

    def end(self, fit: Fit) -> None:
        """Write the file. If the process is killed, the last complete file remains."""
        data = io.BytesIO()  # so that a full disk raises an error of this package
        torch.save(fit.state(), data)
        with replace_file(self._path(fit)) as part:
            part.write_bytes(data.getbuffer())

    def _path(self, fit: Fit) -> Path:
        path = Path(self.file)
        return path if fit.is_last else stage_checkpoint_path(path, fit.number)


def stage_checkpoint_path(file: Path, stage: int) -> Path:
    """Return the checkpoint path of a stage that is not the last.

    Args:
        file: checkpoint path of the last stage.
        stage: number of the stage, from 0.
    """
    return file.with_name(f"{file.stem}_stage{stage}{file.suffix}")


@contextmanager
def defer_interrupt() -> Generator[Callable[[], None]]:
    """Defer Ctrl-C to the end of the step; a second Ctrl-C interrupts at once.

    Yields a function that raises KeyboardInterrupt if an interrupt is pending.
    """
    due = False

    def raise_if_interrupted() -> None:
        if due:
            raise KeyboardInterrupt

    def record_interrupt(_signal: int, _frame: FrameType | None) -> None:
        nonlocal due
        raise_if_interrupted()
        due = True

    # Keep foreign handlers; only the main thread may set one.
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not ours or threading.current_thread() is not threading.main_thread():
        yield raise_if_interrupted
        return
    signal.signal(signal.SIGINT, record_interrupt)
    try:
        yield raise_if_interrupted
        raise_if_interrupted()
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def report_progress(
    name: str, steps: int, console: Console | None = None
) -> Generator[list[Report]]:
    """Show progress with the loss and the first parameters: a bar, or lines without a terminal.

    Pass the yielded callbacks to ``reconstruct``. Ctrl-C, or a notebook's stop, takes effect at the
    end of the step; a ``Checkpoint`` in the same list can then resume.

    Args:
        name: name of the fit, shown before the bar.
        steps: total number of steps of all stages.
        console: console to print on; None = standard output.
    """
    console = console or Console()
    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    lines = not (console.is_terminal or console.is_jupyter)
    bar = Progress(*columns, TextColumn("{task.description}"), console=console, disable=lines)
    task = bar.add_task("", total=steps)
    begin = time.monotonic()
    with bar, defer_interrupt() as heed:

        def show_row(row: dict[str, Any]) -> None:
            values = " ".join(
                np.array2string(np.atleast_1d(value), precision=3, suppress_small=True)
                for value in list(row["values"].values())[:2]
                if np.size(value) <= 3
            )
            text, done = f"loss {row['loss']:.4f} {values}", row["step"] + 1
            bar.update(task, completed=done, description=text)
            if lines and done * 10 // steps > row["step"] * 10 // steps:
                left = format_duration((time.monotonic() - begin) / done * (steps - done))
                line = f"{name}: step {done} of {steps}, {left} left, {text}"
                console.print(line, markup=False, soft_wrap=True)
            heed()

        yield [Report(show_row)]
