"""report.html: one file that opens anywhere, pictures inside."""

import base64
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

from jinja2 import Environment

from invertwin import __version__

DOPPLER_NOTE = (
    "Range rates are modulo the unambiguous span; phases that transmitters in turn add to movers "
    "are taken out for range rates within it. Directions show the strongest of the other axis."
)


@dataclass(frozen=True)
class Table:
    """A table of the report; cells are text or numbers."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture of the report, as PNG bytes."""

    title: str
    png: bytes
    note: str = ""


@dataclass(frozen=True)
class Again:
    """How a run is done again: a command in the run's own folder, and its run files.

    Attributes:
        command: The command with its file, such as ``simulate run.toml``.
        files: Run files as used, by their path in the folder.
    """

    command: str
    files: Mapping[str, str]


def report_html(
    title: str, status: str, note: str, parts: Sequence[Table | Picture], again: Again
) -> str:
    """The report as one HTML text that loads nothing from elsewhere.

    Args:
        title: Heading.
        status: What came out, in a sentence.
        note: What the run file says about the run; blank lines part paragraphs.
        parts: Tables and pictures in reading order.
        again: How the run is done again.
    """
    pages = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    pages.filters |= {"shown": shown, "base64": lambda png: base64.b64encode(png).decode("ascii")}
    template = resources.files("invertwin.cli") / "report.html.jinja"
    backend = os.environ.get("INVERTWIN_BACKEND")
    return pages.from_string(template.read_text(encoding="utf-8")).render(
        title=title,
        status=status,
        note=note,
        parts=parts,
        version=__version__,
        command=f"invertwin {again.command} -o again"
        + (f" --backend {backend}" if backend else ""),
        files=again.files,
    )


def is_number(value: Any) -> bool:
    """Whether a cell is right-aligned."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def shown(value: Any) -> str:
    """A cell as people read it: four significant digits, yes and no, a dash for nothing."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "–"
    if isinstance(value, list | tuple):
        return ", ".join(shown(item) for item in value)
    return str(value)
