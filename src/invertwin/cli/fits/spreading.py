"""Fits of a run by other processes or a Ray cluster: every start and variant is a piece of work.

A worker builds the problem from the run file anew, and gives back the files that the fit would
have left here. Then the run goes on as one that was interrupted after its fits.
"""

import tempfile
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from invertwin.cli.run_file import to_minimal_toml, validate_run
from invertwin.cli.schema import RunFile
from invertwin.cli.terminal import show_progress
from invertwin.errors import PhysicsWarning
from invertwin.refusals import refusal
from invertwin.runtime.engines import Engine, run_jobs
from invertwin.runtime.progress import track
from invertwin.storage.folders import PARTS, UNFINISHED
from invertwin.storage.run_folder import RunFolder, open_run

QUIET_CONSOLE = Console(quiet=True)
FitFunction = Callable[[RunFile, str, int, RunFolder], object]
"""Run file, way to fit, number of the start, folder → a fit that leaves its files there."""


@dataclass(frozen=True)
class FitWorkers:
    """Workers of the fits of a run.

    Attributes:
        engine: Processes of this machine, or tasks of a Ray cluster.
        count: Processes.
    """

    engine: Engine
    count: int

    @classmethod
    def from_options(cls, engine: Engine, count: int | None) -> "FitWorkers | None":
        """Workers that the options `--engine` and `--workers` ask for; None without them.

        Args:
            engine: Engine of the option.
            count: Count of the option; None where it is not given.
        """
        return None if engine == "processes" and count is None else cls(engine, count or 1)


def distribute_fits(
    fit_one: FitFunction,
    run: RunFile,
    folder: RunFolder,
    console: Console,
    workers: FitWorkers,
    fits: Sequence[tuple[str, int]],
) -> None:
    """Let others make the fits that are not in the folder yet, and put their files there.

    Args:
        fit_one: Makes one; a function of a module.
        run: The run file.
        folder: Gets the files.
        console: Shows progress.
        workers: Processes that fit.
        fits: Way to fit and number of the start of each.

    Raises:
        InputError: What a fit refuses, or only one fit.
    """
    if len(fits) == 1:
        raise refusal("spreading.one_fit")
    text, begun = to_minimal_toml(run), f"{PARTS}/calibration.pt"
    path = folder.path / UNFINISHED / begun
    files = {begun: path.read_bytes()} if path.is_file() else {}
    jobs = [fit for fit in fits if folder.read_json(f"{fit_file_stem(*fit)}.json") is None]
    work = partial(run_fit_job, fit_one, text, files)
    found = run_jobs(work, jobs, engine=workers.engine, workers=workers.count)
    with show_progress(console), closing(found) as done:
        for _ in track(jobs, "fits"):
            _, made = next(done)
            # A row says that its fit is done, so it comes last.
            for name in sorted(made, key=lambda name: name.endswith(".json")):
                folder.write_bytes(name, made[name])


def fit_file_stem(mode: str, start: int) -> str:
    """Path in the run's folder with which the files of a fit begin.

    Args:
        mode: The run's own way to fit, or a variant.
        start: Number of the start.
    """
    return f"{PARTS}/{mode}_{start:02d}"


def run_fit_job(
    fit_one: FitFunction, run_toml: str, files: Mapping[str, bytes], job: tuple[str, int]
) -> dict[str, bytes]:
    """Return the files of a fit by their path in the run's folder: what a worker does.

    Args:
        fit_one: fits; a function of a module.
        run_toml: the run file.
        files: inputs of the fit, such as the calibration, by path in the folder.
        job: way to fit, and number of the start.
    """
    run = validate_run(tomllib.loads(run_toml), Path("run.toml"))
    with tempfile.TemporaryDirectory() as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)  # issued once, where the run began
        with open_run(Path(scratch, "fit"), {"run": run_toml}) as folder:
            for name, content in files.items():
                folder.write_bytes(name, content)
            fit_one(run, *job, folder)
            inside = folder.path / UNFINISHED
            made = [str(path.relative_to(inside)) for path in (inside / PARTS).iterdir()]
            return {name: (inside / name).read_bytes() for name in made if name not in files}
