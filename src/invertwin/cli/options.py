"""Arguments and options that commands share, those of plugins too."""

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

# Tables in a log file or a pipe keep the width that holds their columns.
console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)


class Backend(StrEnum):
    """Where rays are traced."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


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
