"""The command line `invertwin`: from run files and recordings to folders of results."""

import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from invertwin import __version__
from invertwin.cli.registry import load_plugins
from invertwin.cli.report import Table, is_number, shown
from invertwin.cli.run_file import about_file, load_run, need
from invertwin.cli.runs import RunFolder, open_run
from invertwin.errors import InputError

app = typer.Typer(
    name="invertwin",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
# Tables in a log file or a pipe keep the width that holds their columns.
console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)


_LOG_SECONDS = 10.0  # between lines of progress in a log


class Backend(StrEnum):
    """Where rays are traced."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Method(StrEnum):
    """How directions are told apart."""

    bartlett = "bartlett"
    capon = "capon"
    music = "music"


def _use_backend(value: Backend | None) -> Backend | None:
    if value is not None:
        os.environ["INVERTWIN_BACKEND"] = value.value
    return value


BackendOption = Annotated[
    Backend | None,
    typer.Option(
        "--backend",
        callback=_use_backend,
        help="Where rays are traced; default: INVERTWIN_BACKEND, else auto.",
        show_default=False,
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option("-o", "--out", help="Folder for the results; default: out/<file stem>."),
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace the results that are in the folder.")
]
ResumeOption = Annotated[
    bool, typer.Option("--resume", help="Go on with the interrupted run in the folder.")
]
SeedOption = Annotated[
    int | None, typer.Option("--seed", min=0, max=2**31 - 1, help="Replaces the run file's seed.")
]
FileArgument = Annotated[Path, typer.Argument(help="Run file (TOML).", show_default=False)]
FilesArgument = Annotated[list[Path], typer.Argument(help="Run files (TOML).", show_default=False)]


def _show_version(wanted: bool) -> bool:
    if wanted:
        print(f"invertwin {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and end."
        ),
    ] = False,
) -> None:
    """Digital twins from radar: find a scene from its echoes by differentiating ray tracing."""


@app.command()
def simulate(
    file: FileArgument,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    backend: BackendOption = None,
) -> None:
    """Simulate exact radar signals of a scene, and their spectra."""
    runs = _load([file], seed, "simulate", ("radar", "grid", "data"))
    with _folder(out or _default(file), runs, overwrite, False) as folder:
        from invertwin.cli.run_simulate import run_simulate

        with about_file(file):
            tables = run_simulate(runs[file.stem], folder)
        _print(tables)


@app.command()
def reconstruct(
    file: FileArgument,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    resume: ResumeOption = False,
    seed: SeedOption = None,
    backend: BackendOption = None,
) -> None:
    """Fit the parameters of a scene to radar data."""
    _reconstruct(file, out or _default(file), overwrite, resume, seed)


@app.command()
def demo(
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    resume: ResumeOption = False,
    seed: SeedOption = None,
    backend: BackendOption = None,
) -> None:
    """Find a hidden letter from its radar echoes."""
    # In its own folder the demo replaces what it left there before.
    again = out is None and not resume
    _reconstruct(_demo_file(), out or Path("out/demo"), overwrite or again, resume, seed)


@app.command()
def look(
    recording: Annotated[
        Path,
        typer.Argument(
            help="Raw .bin or .setup.json, a .toml description of arrays, or a .nc capture.",
            show_default=False,
        ),
    ],
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help="Settings of a .bin: .cfg or .mmwave.json."),
    ] = None,
    board: Annotated[
        str | None, typer.Option("--board", "-b", help="Preset that recorded, such as xWR1843.")
    ] = None,
    elevation: Annotated[
        int | None, typer.Option(help="1: rows of the board grow upwards, -1: downwards.")
    ] = None,
    azimuth: Annotated[
        int | None, typer.Option(help="1: columns grow to the right, -1: to the left.")
    ] = None,
    lanes: Annotated[
        int | None, typer.Option(help="2 or 4 LVDS lanes, where the settings do not say.")
    ] = None,
    chirp: Annotated[
        int | None, typer.Option(min=0, help="The one that the capture keeps; default: mean.")
    ] = None,
    frame: Annotated[int, typer.Option(min=0, help="The one that the pictures show.")] = 0,
    range_min: Annotated[float | None, typer.Option(help="m; default: 3 range cells.")] = None,
    range_max: Annotated[float | None, typer.Option(help="m; default: all.")] = None,
    method: Annotated[
        Method, typer.Option(help="Of directions; others than bartlett are shown beside it.")
    ] = Method.bartlett,
    sources: Annotated[
        int | None, typer.Option(help="For music; default: counted in each range.")
    ] = None,
    channels: Annotated[
        Path | None, typer.Option(help="Channel calibration to divide out (channels.json).")
    ] = None,
    reflector: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="x y z in m of a reflector: calibrates the channels on it."),
    ] = None,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Show a recording: range, range rate, direction; and write it as a capture."""
    from invertwin.cli.run_look import Look, run_look

    wanted = Look(
        recording,
        config,
        board,
        elevation,
        azimuth,
        lanes,
        chirp,
        frame,
        range_min,
        range_max,
        method.value,
        sources,
        channels,
        reflector,
    )
    default = Path("out") / recording.name.split(".")[0]
    with _folder(out or default, {}, overwrite, False) as folder:
        tables = run_look(wanted, folder)
        _print(tables)


@app.command()
def gradcheck(
    files: FilesArgument,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    resume: ResumeOption = False,
    seed: SeedOption = None,
    backend: BackendOption = None,
) -> None:
    """Compare automatic derivatives with central differences."""
    runs = _load(files, seed, "gradcheck", ("gradcheck", "radar", "grid"))
    default = _default(files[0]) if len(files) == 1 else Path("out/gradcheck")
    with _folder(out or default, runs, overwrite, resume) as folder:
        if folder.complete:
            return
        from invertwin.cli.run_gradcheck import run_gradcheck

        with console.status("tracing") as status:
            say = status.update if console.is_terminal else _now_and_then()
            tables = run_gradcheck(runs, {file.stem: file for file in files}, folder, say)
        _print(tables)


@app.command(name="loss-scan")
def loss_scan(
    file: FileArgument,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
    seed: SeedOption = None,
    backend: BackendOption = None,
) -> None:
    """Show the losses of signals and of the surrogate along a line."""
    runs = _load([file], seed, "loss-scan", ("loss_scan", "radar", "grid", "data"))
    with _folder(out or _default(file), runs, overwrite, False) as folder:
        from invertwin.cli.run_loss_scan import run_loss_scan

        with about_file(file):
            tables = run_loss_scan(runs[file.stem], folder)
        _print(tables)


@app.command(name="train-prior")
def train_prior(
    cars: Annotated[int, typer.Option(min=100, help="Cars that are drawn for it.")] = 3000,
    latent: Annotated[int, typer.Option(min=1, max=64, help="Coordinates of a shape.")] = 24,
    epochs: Annotated[int, typer.Option(min=1, help="Times that every car is seen.")] = 40,
    wheels: Annotated[bool, typer.Option("--wheels", help="Cars with wheels.")] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1)] = 0,
    out: OutOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Train a shape prior on cars of the generator; the packaged one by default."""
    from invertwin.cli.run_train_prior import run_train_prior
    from invertwin.inversion import Training

    settings = Training(cars=cars, latent=latent, epochs=epochs, wheels=wheels, seed=seed)
    again = f"train-prior --cars {cars} --latent {latent} --epochs {epochs} --seed {seed}"
    again += " --wheels" if wheels else ""
    with _folder(out or Path("out/train_prior"), {}, overwrite, False) as folder:
        say = _now_and_then()
        tables = run_train_prior(settings, folder, again, say)
        _print(tables)


@app.command()
def keys(
    section: Annotated[
        str | None,
        typer.Argument(help="Such as radar or radar.waveform; default: all.", show_default=False),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json-schema", help="Print the JSON Schema, for editors.")
    ] = False,
) -> None:
    """Print the keys of run files: what may be written where, units, defaults."""
    from invertwin.cli.keys import json_schema, key_tables

    if as_json:
        print(json.dumps(json_schema(), indent=2, ensure_ascii=False))
    else:
        _print(key_tables(section))


@app.command()
def doctor(backend: BackendOption = None) -> None:
    """Check that this machine can trace rays, and say how to fix it if not."""
    from invertwin import doctor as machine

    report = machine.report()
    console.print(machine.render(report), markup=False, soft_wrap=True)
    if not report["ok"]:
        raise typer.Exit(1)


def main() -> None:
    """Entry point: bad input is one line and exit code 2, an interruption 130."""
    warnings.showwarning = _shown_once()
    for name, command in load_plugins().commands.items():
        app.command(name)(command)
    try:
        app(standalone_mode=True)
    except InputError as error:
        print(f"invertwin: {error}", file=sys.stderr)
        sys.exit(2)


def _reconstruct(file: Path, out: Path, overwrite: bool, resume: bool, seed: int | None) -> None:
    runs = _load([file], seed, "reconstruct", ("reconstruct", "data", "grid", "parameters"))
    with _folder(out, runs, overwrite, resume) as folder:
        if folder.complete:
            return
        from invertwin.cli.run_reconstruct import run_reconstruct

        with about_file(file):
            tables, outcome = run_reconstruct(runs[file.stem], folder, console)
        _print(tables)
        console.print(outcome, markup=False, soft_wrap=True)


@contextmanager
def _folder(path: Path, runs: dict[str, Any], overwrite: bool, resume: bool) -> Iterator[RunFolder]:
    """The run's folder; says where the results are, or how to resume."""
    folder = open_run(path, runs, overwrite=overwrite, resume=resume)
    try:
        with folder:
            yield folder
    except KeyboardInterrupt:
        line = "invertwin: interrupted"
        if folder.resumable:
            line += f"; the same command with --resume goes on (results so far in {path})"
        print(line, file=sys.stderr)
        sys.exit(130)
    done = "was complete already" if folder.complete and folder.resumed else "complete"
    console.print(f"{done}: {path / 'report.html'}", markup=False, soft_wrap=True)


def _load(
    files: list[Path], seed: int | None, command: str, sections: Sequence[str]
) -> dict[str, Any]:
    """Run files by stem, with the sections that the command cannot do without."""
    runs: dict[str, Any] = {}
    for file in files:
        if file.stem in runs:
            raise InputError(
                f"expected run files of different names, got {file.stem} twice; rename one"
            )
        run = load_run(file)
        other = "reconstruct" if run.task == "demo" else run.task
        cure = "add it"
        if other != command:
            cure = f"its task is {run.task}: use `invertwin {other} {file}`"
        with about_file(file):
            for section in sections:
                need(run, section, command, cure)
        runs[file.stem] = run if seed is None else run.model_copy(update={"seed": seed})
    return runs


def _now_and_then() -> Callable[[str], None]:
    """Prints a line of progress, unless one was printed just now."""
    last = -_LOG_SECONDS

    def say(line: str) -> None:
        nonlocal last
        if time.monotonic() - last >= _LOG_SECONDS:
            last = time.monotonic()
            console.print(line, markup=False, soft_wrap=True)

    return say


def _default(file: Path) -> Path:
    return Path("out") / file.stem


def _demo_file() -> Path:
    """In a wheel the run file lies beside this module, in a checkout in experiments."""
    beside = Path(__file__).with_name("demo.toml")
    return beside if beside.exists() else Path(__file__).parents[3] / "experiments" / "demo.toml"


def _print(tables: list[Table]) -> None:
    for table in tables:
        grid = RichTable(title=Text(table.title), title_justify="left")
        for i, column in enumerate(table.columns):
            numbers = any(is_number(row[i]) for row in table.rows)
            grid.add_column(Text(column), justify="right" if numbers else "left", no_wrap=i == 0)
        for row in table.rows:
            grid.add_row(*(Text(shown(cell)) for cell in row))
        console.print(grid)
        if table.note:
            console.print(table.note, markup=False)


def _shown_once() -> Callable[..., None]:
    """Prints every warning on one line, the same text once."""
    said: set[str] = set()

    def show(message: Warning | str, *_: Any) -> None:
        line = f"invertwin: warning: {message}"
        if line not in said:
            said.add(line)
            print(line, file=sys.stderr)

    return show
