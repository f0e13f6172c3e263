"""The command line `invertwin`: from run files and recordings to folders of results."""

import json
import os
import shlex
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
import typer.main
from typer.core import TyperGroup

from invertwin import __version__
from invertwin.cli import inputs
from invertwin.cli import options as command_options
from invertwin.cli.options import FileArgument, ResumableOptions, argument, console, option
from invertwin.cli.report import ReportTable, use_plain_style
from invertwin.cli.terminal import load_runs, print_tables, run_each, run_in_folder, show_progress
from invertwin.errors import InputError, exit_on_interrupt, locate_errors, to_one_line
from invertwin.refusals import refusal
from invertwin.runtime.threads import available_threads
from invertwin.storage.folders import convert_os_errors
from invertwin.storage.run_folder import RunFolder


class _CommandGroup(TyperGroup):
    """Our commands, and those of plugins, which are imported when ours do not answer."""

    def make_context(self, *args: Any, **given: Any) -> Any:
        with exit_on_interrupt():
            return super().make_context(*args, **given)

    def invoke(self, ctx: Any) -> Any:
        with exit_on_interrupt():
            return super().invoke(ctx)

    def list_commands(self, ctx: Any) -> list[str]:
        self._add_plugins()
        return sorted(self.commands, key=lambda k: _PANELS.index(self.commands[k].rich_help_panel))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in self.commands:
            self._add_plugins()
        return super().get_command(ctx, cmd_name)

    def _add_plugins(self) -> None:
        from invertwin.registry.kinds import load_plugins

        found = typer.Typer()
        for name, function in load_plugins().commands.items():
            found.command(name, rich_help_panel=_PLUGINS)(function)
        if found.registered_commands:
            self.commands = {**self.commands, **typer.main.get_group(found).commands}


# Panels of the list of commands.
_LEARN, _DATA, _RUN, _DEVELOP, _PLUGINS = "Begin", "Recordings", "Run files", "Develop", "Plugins"
_PANELS = (_LEARN, _DATA, _RUN, _DEVELOP, _PLUGINS)
_PLAIN: dict[str, Any] = {"pretty_exceptions_enable": False, "add_completion": False}
_Command = Callable[..., None]
app = typer.Typer(name="invertwin", cls=_CommandGroup, no_args_is_help=True, **_PLAIN)


def _command_with(kind: type, panel: str = _RUN) -> Callable[[_Command], _Command]:
    """Add a command whose options are the fields of a dataclass."""

    def decorate(function: _Command) -> _Command:
        return app.command(rich_help_panel=panel)(command_options.with_options(kind)(function))

    return decorate


def _show_version(wanted: bool) -> bool:
    if wanted:
        print(f"invertwin {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def invertwin(
    version: Annotated[
        bool,
        option("--version", "Show the version and end.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    """Digital twins from radar: find a scene from its echoes by differentiating ray tracing."""


@_command_with(command_options.RunOptions)
def simulate(options: command_options.RunOptions, file: FileArgument) -> None:
    """Simulate exact radar signals of a scene, and their spectra; or a coverage map."""
    runs = load_runs([file], options, "simulate", _simulate_sections)

    def work(folder: RunFolder) -> tuple[list[ReportTable], str]:
        run = runs[file.stem]
        with locate_errors(file), show_progress(console):
            if _simulates_coverage(run):
                from invertwin.cli.commands.coverage import run_coverage

                return run_coverage(run, folder)
            from invertwin.cli.commands.simulate import run_simulate

            return run_simulate(run, folder)

    run_in_folder(options, Path("out", file.stem), work, runs)


def _simulates_coverage(run: Any) -> bool:
    return run.radar is None and run.map is not None


def _simulate_sections(run: Any) -> tuple[str, ...]:
    return ("map", "transmitter") if _simulates_coverage(run) else ("radar", "grid", "data")


@_command_with(command_options.DatasetOptions)
def dataset(options: command_options.DatasetOptions, file: FileArgument) -> None:
    """Simulate a data set: many samples of a run file with other values each, and their labels."""
    runs = load_runs([file], options, "dataset", inputs.DATASET_SECTIONS)
    from invertwin.cli.commands import dataset as command

    part = command.parse_part(options.shard)
    chosen = replace(options, out=command.part_folder(options.out or Path("out", file.stem), part))

    def work(folder: RunFolder) -> tuple[list[ReportTable], str]:
        with locate_errors(file), show_progress(console):
            workers = options.workers or available_threads()
            return command.run_dataset(runs[file.stem], folder, part, options.engine, workers)

    run_in_folder(chosen, Path("out"), work, runs)


@_command_with(command_options.FitOptions)
def reconstruct(options: command_options.FitOptions, file: FileArgument) -> None:
    """Fit the parameters of a scene to radar data."""
    _run_one_reconstruction(file, options, Path("out", file.stem))


@_command_with(ResumableOptions)
def plan(options: ResumableOptions, file: FileArgument) -> None:
    """State the error bars of a fit before anything is recorded, and rank positions to add."""
    runs = load_runs([file], options, "plan", ("radar", "data", "grid", "parameters"))

    def work(folder: RunFolder) -> tuple[list[ReportTable], str]:
        from invertwin.cli.commands.plan import run_plan

        with locate_errors(file):
            return run_plan(runs[file.stem], folder, console)

    run_in_folder(options, Path("out", file.stem), work, runs)


@app.command(rich_help_panel=_DEVELOP)
def check(file: FileArgument, backend: command_options.BackendOption = None) -> None:
    """Say how much memory and time a run file needs, without running it."""
    from invertwin.cli.run_file import load_run

    run = load_run(file)
    use_plain_style()
    from invertwin.cli.commands.check import run_check

    with locate_errors(file):
        tables, line = run_check(run)
    print_tables(tables)
    console.print(line, markup=False, soft_wrap=True)


@app.command(rich_help_panel=_DEVELOP)
def convert(files: command_options.FilesArgument) -> None:
    """Rewrite run files of the first frame (x right, y up) in today's: x ahead, y left, z up."""
    inputs.require_files((file, "a run file") for file in files)
    from invertwin_convert import run_convert

    for line in run_convert(files):
        console.print(line, markup=False, soft_wrap=True)


@app.command(rich_help_panel=_LEARN)
def new(
    kind: Annotated[
        Literal["fit", "simulate", "twin", "coverage", "placement", "dataset", "plugin"],
        typer.Argument(),
    ],
    file: Annotated[Path | None, argument("Default: kind.toml, or plugin.py.")] = None,
) -> None:
    """Write a commented run file, or a plugin, to start from."""
    # As a text: a module among the templates would be part of the package.
    name, default = ("plugin.txt", "plugin.py") if kind == "plugin" else (f"{kind}.toml",) * 2
    text = (resources.files("invertwin.cli") / "templates" / name).read_text("utf-8")
    path = file or Path(default)
    if os.path.lexists(path):
        raise InputError(f"expected a new file, got {path}, which exists; name another")
    with path.open("x", encoding="utf-8") as out:
        out.write(text)
    tasks = {"fit": "reconstruct", "coverage": "simulate", "placement": "reconstruct"}
    command = tasks.get(kind, kind)
    call = shlex.join([*(["python"] if kind == "plugin" else ["invertwin", command]), str(path)])
    console.print(f"wrote {path}; try: {call}", markup=False, soft_wrap=True)


@_command_with(ResumableOptions, _LEARN)
def demo(options: ResumableOptions) -> None:
    """Find a hidden letter from its radar echoes."""
    # In its own folder the demo replaces what it left there before.
    again = options.overwrite or (options.out is None and not options.resume)
    given = command_options.FitOptions(**vars(options))
    _run_one_reconstruction(_find_demo_file(), replace(given, overwrite=again), Path("out/demo"))


@_command_with(command_options.LookOptions, _DATA)
def look(options: command_options.LookOptions) -> None:
    """Show a recording: range, range rate, direction; and write it as a capture."""
    _run_recording(options, "")


@_command_with(command_options.TwinOptions, _DATA)
def twin(options: command_options.TwinOptions) -> None:
    """Find the objects in a recording without an initial guess: positions, sizes, confidences."""
    _run_recording(options, "_twin")


@app.command(rich_help_panel=_DATA)
def view(
    target: Annotated[Path, argument("Run folder, run file or capture (.nc).")],
    host: Annotated[str, option("Others than this machine need a token.")] = "127.0.0.1",
    port: Annotated[int, option("The first that is tried.", min=0, max=65535)] = 8080,
    token: Annotated[str | None, option("16 letters or digits that the address must hold.")] = None,
    record: Annotated[
        Path | None, option("Write an HTML page that needs no server, and end.", show_default=False)
    ] = None,
    overwrite: Annotated[bool, option("--overwrite", "Replace the page of --record.")] = False,
    backend: command_options.BackendOption = None,
) -> None:
    """Show a run, a scene or a capture in the browser, in three dimensions."""
    inputs.find_viewed_file(target)
    own = record is not None and os.path.realpath(record) == os.path.realpath(target)
    if record is not None and (own or (os.path.lexists(record) and not overwrite)):
        raise refusal("app.taken_record", record, "" if own else ", or give --overwrite")
    use_plain_style()
    from invertwin.cli.commands.view import run_view

    run_view(target, console, host=host, port=port, token=token, record=record)


@_command_with(ResumableOptions, _DEVELOP)
def gradcheck(options: ResumableOptions, files: command_options.FilesArgument) -> None:
    """Compare automatic derivatives with central differences."""
    runs = load_runs(files, options, "gradcheck", _gradcheck_sections)
    from invertwin.cli.commands.gradcheck import run_gradcheck

    run_each(options, files, "gradcheck", runs, run_gradcheck)


def _gradcheck_sections(run: Any) -> tuple[str, ...]:
    if run.map is not None:
        return ("gradcheck", "map", "transmitter")
    if run.image is not None:
        return ("gradcheck", "image", "camera")
    alone = run.rcs is not None or run.placement is not None
    return ("gradcheck",) if alone else ("gradcheck", "radar", "grid")


@_command_with(ResumableOptions)
def rcs(options: ResumableOptions, files: command_options.FilesArgument) -> None:
    """Compute radar signatures: cross-sections, range profiles, images."""
    runs = load_runs(files, options, "rcs", ("rcs",))
    from invertwin.cli.commands.rcs import run_rcs

    run_each(options, files, "rcs", runs, run_rcs)


@app.command(rich_help_panel=_LEARN)
def keys(
    section: Annotated[
        str | None, argument("Such as radar or radar.waveform; default: a list of all.")
    ] = None,
    as_json: Annotated[bool, option("--json-schema", "Print a JSON Schema, for editors.")] = False,
) -> None:
    """Print the keys of a section of run files: units, defaults, meaning; or list the sections."""
    from invertwin.cli.schema.keys import json_schema, key_index, key_tables

    if as_json:
        print(json.dumps(json_schema(), indent=2, ensure_ascii=False))
    else:
        print_tables([key_index()] if section is None else key_tables(section))


@app.command(rich_help_panel=_LEARN)
def doctor(backend: command_options.BackendOption = None) -> None:
    """Check that this machine can trace rays, and say how to fix it if not."""
    from invertwin.runtime import doctor as machine

    report = machine.collect_report()
    console.print(machine.render_report(report), markup=False, soft_wrap=True)
    if not report["ok"]:
        raise typer.Exit(1)


def main() -> None:
    """Entry point: bad input is one line and exit code 2, an interruption 130."""
    warnings.showwarning = _warn_once()
    try:
        with convert_os_errors(""):
            app(standalone_mode=True)
    except InputError as error:
        print(f"invertwin: {error}", file=sys.stderr)
        sys.exit(2)


def _run_recording(
    options: command_options.LookOptions | command_options.TwinOptions, ending: str
) -> None:
    """One recording, by default in a folder of its name and an ending."""
    inputs.require_recording(options)

    def work(folder: RunFolder) -> tuple[list[ReportTable], str]:
        with show_progress(console):
            if isinstance(options, command_options.TwinOptions):
                from invertwin.cli.commands.twin import run_twin

                return run_twin(options, folder)
            from invertwin.cli.commands.look import run_look

            return run_look(options, folder)

    run_in_folder(options, Path("out", options.recording.name.split(".")[0] + ending), work)


def _run_one_reconstruction(file: Path, options: command_options.FitOptions, default: Path) -> None:
    runs = load_runs([file], options, "reconstruct", _reconstruct_sections)

    def work(folder: RunFolder) -> tuple[list[ReportTable], str]:
        from invertwin.cli.commands.reconstruct import run_reconstruct
        from invertwin.cli.fits.spreading import FitWorkers

        workers = FitWorkers.from_options(options.engine, options.workers)
        with locate_errors(file):
            return run_reconstruct(runs[file.stem], folder, console, workers, view=options.view)

    run_in_folder(options, default, work, runs)


def _reconstruct_sections(run: Any) -> tuple[str, ...]:
    if run.placement is not None:
        return ("reconstruct", "parameters")
    if run.aim is not None:
        return ("reconstruct", "map", "transmitter", "parameters")
    return ("reconstruct", "data", "grid" if run.map is None else "transmitter", "parameters")


def _find_demo_file() -> Path:
    """In a wheel the run file lies beside this module, in a checkout in experiments."""
    beside = Path(__file__).with_name("demo.toml")
    return beside if beside.exists() else Path(__file__).parents[3] / "experiments" / "demo.toml"


def _warn_once() -> Callable[..., None]:
    """Print every warning on one line, the same text once."""
    said: set[str] = set()

    def show_warning(message: Warning | str, *_: Any) -> None:
        line = to_one_line(f"invertwin: warning: {message}")
        if line not in said:
            said.add(line)
            print(line, file=sys.stderr)

    return show_warning
