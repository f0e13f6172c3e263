"""Arguments and options that commands share, those of plugins too."""

import inspect
import os
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer
from rich.console import Console


class _TolerantOutput:
    """Standard output that may be gone, as a closed pipe or a full disk: no run ends for it."""

    def write(self, text: str) -> int:
        self._try(lambda: sys.stdout.write(text))
        return len(text)

    def flush(self) -> None:
        self._try(lambda: sys.stdout.flush())

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stdout, name)

    def _try(self, step: Callable[[], Any]) -> None:
        """Take a step; if it fails, drop this and all further output."""
        try:
            step()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


# Tables in a log file or a pipe keep the width that holds their columns.
_output: Any = _TolerantOutput()
console = Console(file=_output, highlight=False, width=None if sys.stdout.isatty() else 120)


def _use_backend(value: str | None) -> str | None:
    if value is not None:
        os.environ["INVERTWIN_BACKEND"] = value
    return value


BackendOption = Annotated[
    Literal["auto", "cpu", "cuda"] | None,
    typer.Option(
        "--backend",
        callback=_use_backend,
        help="Where rays are traced; default: INVERTWIN_BACKEND, else auto.",
        show_default=False,
    ),
]
FileArgument = Annotated[Path, typer.Argument(help="Run file (TOML).", show_default=False)]
FilesArgument = Annotated[list[Path], typer.Argument(help="Run files (TOML).", show_default=False)]


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Output folder of a command."""

    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Folder for the results; default: out/<file stem>."),
    ] = None
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results that are in the folder.")
    ] = False


@dataclass(frozen=True, kw_only=True)
class RunOptions(OutputOptions):
    """Options common to commands with run files."""

    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, max=2**31 - 1, help="Replaces the run file's seed."),
    ] = None
    backend: BackendOption = None


@dataclass(frozen=True, kw_only=True)
class ResumableOptions(RunOptions):
    """Options of commands that resume interrupted work."""

    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the interrupted run in the folder.")
    ] = False


EngineOption = Annotated[
    Literal["processes", "ray"],
    typer.Option("--engine", help="Processes of this machine, or tasks of a Ray cluster."),
]


@dataclass(frozen=True, kw_only=True)
class DatasetOptions(ResumableOptions):
    """Engine and workers of a data set, and the part to simulate."""

    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, help="Processes of one thread; default: as many as cores."
        ),
    ] = None
    shard: Annotated[
        str | None,
        typer.Option("--shard", help="i/n: part i of n, into a folder of its own inside."),
    ] = None
    engine: EngineOption = "processes"


@dataclass(frozen=True, kw_only=True)
class FitOptions(ResumableOptions):
    """Engine and workers of the fits of a run."""

    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=1,
            help="Processes of one thread that fit starts and variants beside each other; "
            "default: here, one after another.",
        ),
    ] = None
    engine: EngineOption = "processes"
    view: Annotated[
        bool, typer.Option("--view", help="Show the fits in a browser while they go on.")
    ] = False


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(OutputOptions):
    """Recording and the options of its reader."""

    recording: Annotated[
        Path,
        typer.Argument(
            help="Raw .bin or .setup.json, a .toml description of arrays or sweeps, an .s1p or "
            ".s2p sweep, or a .nc capture.",
            show_default=False,
        ),
    ]
    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", help="Settings of a .bin: .cfg or .mmwave.json."),
    ] = None
    board: Annotated[
        str | None, typer.Option("--board", "-b", help="Preset that recorded, such as xWR1843.")
    ] = None
    elevation: Annotated[
        int | None, typer.Option(help="1: rows of the board grow upwards, -1: downwards.")
    ] = None
    azimuth: Annotated[
        int | None, typer.Option(help="1: columns grow to the radar's left (y), -1: right.")
    ] = None
    lanes: Annotated[
        int | None, typer.Option(help="2 or 4 LVDS lanes, where the settings do not say.")
    ] = None
    change: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="Corrects a setting of a .bin, such as samples=128; also lanes, real, receivers, "
            "transmitters, loops, frames.",
        ),
    ] = None

    def command(self, name: str, folder: Path) -> str:
        """The command line that does the same from another folder.

        Args:
            name: of the command.
            folder: where it is called; paths are relative to it.
        """
        words, hints = [name], get_type_hints(type(self), include_extras=True)
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("out", "overwrite", "backend") or value in (field.default, None):
                continue
            kind = hints[field.name].__metadata__[0]
            # Typer's first argument is a name, too, within an annotation.
            names = (str(kind.default), *(kind.param_decls or ()))
            flags = [name for name in names if name.startswith("--")]
            flags = flags or [f"--{field.name.replace('_', '-')}"]
            values = value if isinstance(value, list | tuple) else [value]
            values = [os.path.relpath(v, folder) if isinstance(v, Path) else str(v) for v in values]
            if isinstance(value, list):
                words += [word for one in values for word in (flags[0], one)]
            else:
                words += [*([] if field.name == "recording" else flags[:1]), *values]
        return shlex.join(words)


@dataclass(frozen=True, kw_only=True)
class LookOptions(RecordingOptions):
    """Options of `invertwin look`."""

    chirp: Annotated[
        int | None, typer.Option(min=0, help="The one that the capture keeps; default: mean.")
    ] = None
    frame: Annotated[int, typer.Option(min=0, help="The one that the pictures show.")] = 0
    range_min: Annotated[float | None, typer.Option(help="m; default: 3 range cells.")] = None
    range_max: Annotated[float | None, typer.Option(help="m; default: all.")] = None
    method: Annotated[
        Literal["bartlett", "capon", "music"],
        typer.Option(help="Of directions; others than bartlett are shown beside it."),
    ] = "bartlett"
    sources: Annotated[
        int | None, typer.Option(help="For music; default: counted in each range.")
    ] = None
    channels: Annotated[
        Path | None, typer.Option(help="Channel calibration to divide out (channels.json).")
    ] = None
    reflector: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="x y z in m of a reflector: calibrates the channels on it."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class TwinOptions(RecordingOptions):
    """Options of `invertwin twin`."""

    low: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Corner x y of the ground searched, m; default: all that is seen."),
    ] = None
    high: Annotated[tuple[float, float] | None, typer.Option(help="Opposite corner, m.")] = None
    range_max: Annotated[
        float | None, typer.Option(help="m; default: the last range with echoes.")
    ] = None
    level: Annotated[
        float | None, typer.Option(help="Height of the ground, m; default: 0.6 below the radars.")
    ] = None
    height: Annotated[
        float | None,
        typer.Option(
            help="Above the ground, where echoes are looked for, m; default: the radars'."
        ),
    ] = None
    rays: Annotated[
        int | None, typer.Option(min=100, help="Of every frame in fits; default: 2000.")
    ] = None
    seed: Annotated[int | None, typer.Option(min=0, max=2**31 - 1, help="Of rays; default: 0.")] = (
        None
    )
    backend: BackendOption = None


def with_options(kind: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the fields of a dataclass as options; it gets them as one value.

    Args:
        kind: The dataclass, whose annotations say what typer needs to know.

    Returns:
        A decorator of a function of that value and further options.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(kind, eval_str=True).parameters
        shared = list(inspect.signature(function).parameters.values())[1:]
        rest = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in shared]

        def command(**given: Any) -> None:
            function(kind(**{name: given.pop(name) for name in own}), **given)

        command.__name__, command.__doc__ = function.__name__, function.__doc__
        command.__annotations__ = {p.name: p.annotation for p in [*own.values(), *rest]}
        command.__signature__ = inspect.Signature([*own.values(), *rest])  # type: ignore[attr-defined]
        return command

    return decorate
