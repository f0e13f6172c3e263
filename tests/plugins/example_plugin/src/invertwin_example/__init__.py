"""What this plugin adds to run files and to the command line.

Kinds are named as "module:name", so that torch is imported only where a run file is read.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from annotated_types import Gt


@dataclass(frozen=True)
class Survey:
    """How the plants were counted.

    Attributes:
        count: plants.
        area: m², that they stand on.
    """

    count: int
    area: Annotated[float, Gt(0)] = 1.0


def plants(file: Annotated[Path, typer.Argument(help="Run file (TOML).")]) -> None:
    """Tell how densely the plants of a run file stand."""
    from invertwin.cli.run_file import load_run, require_section

    survey = require_section(load_run(file), "survey", "plants").build()
    print(f"{survey.count / survey.area:g} plants per m²")


def register(registry) -> None:
    """The entry point: called with the registry once, when the command line starts."""
    kinds = "invertwin_example.kinds"
    registry.add("material", "foliage", f"{kinds}:Foliage")
    registry.add("shape", "bush", f"{kinds}:bush")
    registry.add("waveform", "falling_ramp", f"{kinds}:FallingRamp")
    registry.add("parameter", "thickness", f"{kinds}:Thickness")
    registry.add("loss", "log", f"{kinds}:LogLoss")
    registry.add("data", "npy", f"{kinds}:npy")
    registry.sections["survey"] = Survey
    registry.commands["plants"] = plants
