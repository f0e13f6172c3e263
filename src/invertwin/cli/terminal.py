"""Shared steps of commands: load run files, open the folder, print tables and progress."""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from invertwin.cli.inputs import require_files
from invertwin.cli.options import OutputOptions, ResumableOptions, RunOptions, console
from invertwin.cli.report import ReportTable, format_cell, is_numeric_cell, use_plain_style
from invertwin.cli.run_file import load_run, require_section, to_toml
from invertwin.errors import locate_errors
from invertwin.refusals import refusal
from invertwin.runtime.progress import format_duration, progress_callback
from invertwin.storage.folders import PARTS
from invertwin.storage.run_folder import RunFolder, open_run

_LOG_INTERVAL = 10.0  # between lines of progress in a log
Result = dict[str, Any]
"""Numbers of one run file."""
Sections = Sequence[str] | Callable[[Any], Sequence[str]]  # that a command needs, of a run file


def run_in_folder(
    options: OutputOptions,
    default: Path,
    work: Callable[[RunFolder], tuple[Sequence[ReportTable], str]],
    runs: Mapping[str, Any] | None = None,
) -> None:
    """Work in the run's folder, as of `open_run`; say what came out once the folder is complete.

    Args:
        options: Options of the user.
        default: The folder if the user has chosen none.
        work: Function of the folder that returns tables and a last line; not called where an
            earlier run has completed it.
        runs: Run files by stem.
    """
    path, resume = options.out or default, getattr(options, "resume", False)
    texts = {name: to_toml(run) for name, run in (runs or {}).items()}
    folder = open_run(path, texts, overwrite=options.overwrite, resume=resume)
    use_plain_style()
    try:
        with folder:
            tables, outcome = ([], "") if folder.complete else work(folder)
    except KeyboardInterrupt:
        line = "invertwin: interrupted"
        if folder.resumable:
            line += f"; the same command with --resume goes on (results so far in {path})"
        print(line, file=sys.stderr)
        sys.exit(130)
    print_tables(tables)
    done = "was complete already" if folder.complete else "complete"
    for line in filter(None, (outcome, f"{done}: {path / 'report.html'}")):
        console.print(line, markup=False, soft_wrap=True)


def load_runs(
    files: Sequence[Path], options: RunOptions, command: str, sections: Sections
) -> dict[str, Any]:
    """Run files by stem, with the sections that the command cannot do without.

    A seed of the options replaces theirs. Run files of another task than the command's are refused.

    Args:
        files: Paths of the run files.
        options: Options of the user.
        command: Command whose task they must have.
        sections: Required sections, or a function that returns them for a run file.
    """
    require_files((file, "a run file") for file in files)
    runs: dict[str, Any] = {}
    for file in files:
        if file.stem in runs:
            raise refusal("terminal.equal_names", file.stem)
        run = load_run(file)
        other = "reconstruct" if run.task == "demo" else run.task
        cure = "add it"
        if other != command:
            cure = f"its task is {run.task}: use `invertwin {other} {quote(str(file))}`"
        with locate_errors(file):
            for section in sections(run) if callable(sections) else sections:
                require_section(run, section, command, cure)
        seeded = {} if options.seed is None else {"seed": options.seed}
        runs[file.stem] = run.model_copy(update=seeded)
    return runs


@dataclass(frozen=True)
class RunBatch:
    """Run files of one command that are computed one after another into one folder.

    Attributes:
        runs: Run files by stem.
        files: Paths of the run files.
        folder: Folder that keeps finished results.
    """

    runs: Mapping[str, Any]
    files: Mapping[str, Path]
    folder: RunFolder

    def results(self, compute: Callable[[str, Any], Result]) -> Iterator[tuple[str, Any, Result]]:
        """Compute a result for each run file, saved at once: a resumed run does not repeat it.

        Args:
            compute: Function of a stem and its run file.

        Yields:
            Stem, run file and result.
        """
        for name, run in self.runs.items():
            part = f"{PARTS}/{name}.json"
            found = self.folder.read_json(part)
            if found is None:
                with locate_errors(self.files[name]):
                    found = compute(name, run)
                self.folder.write_json(part, found)
            yield name, run, found


def run_each(
    options: ResumableOptions,
    files: Sequence[Path],
    command: str,
    runs: Mapping[str, Any],
    work: Callable[..., tuple[list[ReportTable], str]],
) -> None:
    """Work on several run files with one report.

    Args:
        options: Options of the user.
        files: Paths of the run files.
        command: Names the folder of several.
        runs: Run files by stem.
        work: Function of a `RunBatch` and of a function that takes lines of progress.
    """
    default = Path("out", files[0].stem if len(files) == 1 else command)

    def work_on(folder: RunFolder) -> tuple[list[ReportTable], str]:
        with console.status("tracing") as status:
            say = status.update if console.is_terminal else limit_rate()
            return work(RunBatch(runs, {file.stem: file for file in files}, folder), say)

    run_in_folder(options, default, work_on, runs)


@contextmanager
def show_progress(console: Console) -> Iterator[None]:
    """Show how far long loops have come: on one line, or a line now and then in a log.

    Args:
        console: Console to print on.
    """
    with console.status("working") as status:
        say = status.update if console.is_terminal else limit_rate(console, time.monotonic())

        def show_line(name: str, done: int, total: int, left: float) -> None:
            say(f"{name}: {done} of {total}, {format_duration(left)} left")

        with progress_callback(show_line):
            yield


def limit_rate(shown: Console = console, last: float = -math.inf) -> Callable[[str], None]:
    """A function that prints a line of progress, unless one was printed just now.

    Args:
        shown: Console of the printed line.
        last: Time of the last line.
    """

    def say(line: str) -> None:
        nonlocal last
        if time.monotonic() - last >= _LOG_INTERVAL:
            last = time.monotonic()
            shown.print(line, markup=False, soft_wrap=True)

    return say


def print_tables(tables: Sequence[ReportTable]) -> None:
    """Print tables with their notes; a narrow terminal wraps headings and words, never a number."""
    for table in tables:
        grid = RichTable(title=Text(table.title), title_justify="left")
        for i, column in enumerate(table.columns):
            numbers = [len(format_cell(row[i])) for row in table.rows if is_numeric_cell(row[i])]
            least, side = max(numbers, default=None), "right" if numbers else "left"
            how: Any = {"justify": side, "overflow": "fold", "min_width": least}
            grid.add_column(Text(column), no_wrap=i == 0, **how)
        for row in table.rows:
            grid.add_row(*(Text(format_cell(cell)) for cell in row))
        least = grid.__rich_measure__(console, console.options).minimum
        grid.width = least if least > console.width else None
        console.print(grid, crop=False)
        if table.note:
            console.print(table.note, markup=False)
