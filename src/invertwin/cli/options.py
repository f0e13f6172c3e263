"""Arguments and options that commands share, those of plugins too."""

import inspect
import os
import shlex
import sys
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer
from rich.console import Console

from invertwin.registry.section import argument_docs


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


def option(*words: str, **given: Any) -> Any:
    """Return an option of a command.

    Args:
        words: Its names, if it has other ones than its parameter, and last its help.
        given: Arguments of ``typer.Option``.
    """
    return typer.Option(*words[:-1], help=words[-1], **given)


def argument(text: str) -> Any:
    """Return an argument of a command, whose default is not shown.

    Args:
        text: Its help.
    """
    return typer.Argument(help=text, show_default=False)


_BACKEND_HELP = "Where rays are traced; default: INVERTWIN_BACKEND, else auto."
_backend = option("--backend", _BACKEND_HELP, callback=_use_backend, show_default=False)
BackendOption = Annotated[Literal["auto", "cpu", "cuda"] | None, _backend]
_engine = option("--engine", "Processes of this machine, or tasks of a Ray cluster.")
EngineOption = Annotated[Literal["processes", "ray"], _engine]
SeedOption = Annotated[int | None, typer.Option(min=0, max=2**31 - 1)]
FileArgument = Annotated[Path, argument("Run file (TOML).")]
FilesArgument = Annotated[list[Path], argument("Run files (TOML).")]


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Output folder of a command.

    Attributes:
        out: Folder for the results; default: out/<file stem>.
        overwrite: Replace the results in the folder.
    """

    out: Annotated[Path | None, typer.Option("-o", "--out")] = None
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False


@dataclass(frozen=True, kw_only=True)
class RunOptions(OutputOptions):
    """Options common to commands with run files.

    Attributes:
        seed: Replaces the run file's seed.
    """

    seed: SeedOption = None
    backend: BackendOption = None


ResumeOption = Annotated[bool, typer.Option("--resume")]


@dataclass(frozen=True, kw_only=True)
class ResumableOptions(RunOptions):
    """Options of commands that resume interrupted work.

    Attributes:
        resume: Go on with an interrupted run in the folder.
    """

    resume: ResumeOption = False


@dataclass(frozen=True, kw_only=True)
class DatasetOptions(ResumableOptions):
    """Engine and workers of a data set, and the part to simulate.

    Attributes:
        workers: Processes of one thread; default: as many as cores.
        shard: i/n: part i of n, in a folder of its own.
    """

    workers: Annotated[int | None, typer.Option(min=1)] = None
    shard: str | None = None
    engine: EngineOption = "processes"


@dataclass(frozen=True, kw_only=True)
class FitOptions(ResumableOptions):
    """Engine and workers of the fits of a run.

    Attributes:
        workers: Processes of one thread that fit starts and variants beside each other; default:
            here, one after another.
        view: Show the fits in a browser while they go on.
    """

    workers: Annotated[int | None, typer.Option(min=1)] = None
    engine: EngineOption = "processes"
    view: Annotated[bool, typer.Option("--view")] = False


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(OutputOptions):
    """Recording and the options of its reader.

    Attributes:
        recording: Raw .bin or .setup.json, a .toml description of arrays or sweeps, an .s1p or .s2p
            sweep, or a .nc capture.
        config: Settings of a .bin: .cfg or .mmwave.json.
        board: Its preset, such as xWR1843.
        elevation: 1: rows of the board grow upwards, -1: downwards.
        azimuth: 1: columns grow to the radar's left (y), -1: right.
        lanes: 2 or 4 LVDS lanes, where the settings do not say.
        change: Corrects a setting of a .bin, such as samples=128; also lanes, real, receivers,
            transmitters, loops, frames.
    """

    recording: Annotated[Path, typer.Argument(show_default=False)]
    config: Annotated[Path | None, typer.Option("--config", "-c")] = None
    board: Annotated[str | None, typer.Option("--board", "-b")] = None
    elevation: int | None = None
    azimuth: int | None = None
    lanes: int | None = None
    change: Annotated[list[str] | None, typer.Option("--set")] = None

    def command(self, name: str, folder: Path) -> str:
        """The command line that does the same from another folder.

        Args:
            name: name of the command.
            folder: working folder of the call; paths are relative to it.
        """
        words, hints = [name], get_type_hints(type(self), include_extras=True)
        for field in fields(self):
            value = getattr(self, field.name)
            unsaid = field.name in ("out", "overwrite", "backend", "resume")
            if unsaid or value in (field.default, None):
                continue
            kind = next(iter(getattr(hints[field.name], "__metadata__", ())), typer.Option())
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
    """Options of `invertwin look`.

    Attributes:
        chirp: The one that the capture keeps; default: mean.
        frame: The one that the pictures show.
        range_min: m; default: 3 range cells.
        range_max: m; default: all.
        method: Of directions; others than bartlett are shown beside it.
        sources: For music; default: counted in each range.
        channels: Channel calibration to divide out (channels.json).
        reflector: x y z in m of a reflector: calibrates the channels on it.
    """

    chirp: Annotated[int | None, typer.Option(min=0)] = None
    frame: Annotated[int, typer.Option(min=0)] = 0
    range_min: float | None = None
    range_max: float | None = None
    method: Literal["bartlett", "capon", "music"] = "bartlett"
    sources: int | None = None
    channels: Path | None = None
    reflector: tuple[float, float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class TwinOptions(RecordingOptions):
    """Options of `invertwin twin`.

    Attributes:
        low: Corner x y of the ground searched, m; default: all that is seen.
        high: Opposite corner, m.
        range_max: m; default: the last range with echoes.
        level: z of the ground, m; default: 0.6 below the radars.
        height: Above the ground, where echoes are looked for, m; default: the radars'.
        rays: Of every frame in fits; default: 2000.
        seed: Of rays; default: 0.
        resume: Go on with an interrupted run in the folder.
    """

    low: tuple[float, float] | None = None
    high: tuple[float, float] | None = None
    range_max: float | None = None
    level: float | None = None
    height: float | None = None
    rays: Annotated[int | None, typer.Option(min=100)] = None
    seed: SeedOption = None
    backend: BackendOption = None
    resume: ResumeOption = False


def _add_help(field: inspect.Parameter, text: str | None) -> inspect.Parameter:
    """An option with what the docstring says of it; one of several commands brings its own help."""
    kind, info = field.annotation, typer.Option()
    if get_origin(kind) is Annotated:
        kind, info = get_args(kind)
    if text is not None:
        info = copy(info)
        info.help = f"{text}."
    return field.replace(annotation=Annotated[kind, info])


def with_options(kind: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the fields of a dataclass as options; it gets them as one value.

    Args:
        kind: The dataclass, whose annotations and docstring say what typer needs to know.

    Returns:
        A decorator of a function of that value and further options.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        texts, known = argument_docs(kind), inspect.signature(kind, eval_str=True).parameters
        own = {name: _add_help(known[name], texts.get(name)) for name in known}
        shared = list(inspect.signature(function).parameters.values())[1:]
        rest = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in shared]

        def command(**given: Any) -> None:
            function(kind(**{name: given.pop(name) for name in own}), **given)

        command.__name__, command.__doc__ = function.__name__, function.__doc__
        command.__annotations__ = {p.name: p.annotation for p in [*own.values(), *rest]}
        command.__signature__ = inspect.Signature([*own.values(), *rest])  # type: ignore[attr-defined]
        return command

    return decorate
