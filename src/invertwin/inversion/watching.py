"""Progress of a fit that people see: a bar in a terminal or a notebook, lines in a log."""

import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from invertwin.inversion.callbacks import Report, interrupted_between_steps
from invertwin.progress import time_left


@contextmanager
def watched(name: str, steps: int, console: Console | None = None) -> Generator[list[Report]]:
    """Progress with the loss and the first parameters: a bar, or lines where nothing can draw one.

    Give ``reconstruct`` the callbacks that the block gets. Ctrl-C, or a notebook's stop, waits for
    the end of the step, so that nothing is half done; a ``Checkpoint`` beside them goes on.

    Args:
        name: Of the fit.
        steps: Of all its stages.
        console: Where; None = where the program runs.
    """
    console = console or Console()
    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    lines = not (console.is_terminal or console.is_jupyter)
    bar = Progress(*columns, TextColumn("{task.description}"), console=console, disable=lines)
    task = bar.add_task("", total=steps)
    begin = time.monotonic()
    with bar, interrupted_between_steps() as heed:

        def show(row: dict[str, Any]) -> None:
            values = " ".join(
                np.array2string(np.atleast_1d(value), precision=3, suppress_small=True)
                for value in list(row["values"].values())[:2]
                if np.size(value) <= 3
            )
            text, done = f"loss {row['loss']:.4f} {values}", row["step"] + 1
            bar.update(task, completed=done, description=text)
            if lines and done * 10 // steps > row["step"] * 10 // steps:
                left = time_left((time.monotonic() - begin) / done * (steps - done))
                line = f"{name}: step {done} of {steps}, {left} left, {text}"
                console.print(line, markup=False, soft_wrap=True)
            heed()

        yield [Report(show)]
