"""report.html: one file that opens anywhere, pictures inside."""

import base64
import html
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from invertwin import __version__

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem;
       color: #1b1f24; background: #fff; }
h1 { font-size: 1.6rem; margin-bottom: .2rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
p { max-width: 60rem; } p.status { font-size: 1.15rem; }
img { max-width: 100%; height: auto; } details { margin: .5rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid #d8dce2; padding: .25rem .8rem; text-align: right; }
th:first-child, td:first-child { text-align: left; } thead th { border-bottom-color: #6b7280; }
div.wide { overflow-x: auto; } pre { background: #f4f5f7; padding: 1rem; overflow-x: auto; }
"""


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
    body = [f"<h1>{html.escape(title)}</h1>", f'<p class="status">{html.escape(status)}</p>']
    body += [f"<p>{html.escape(text)}</p>" for text in note.split("\n\n") if text.strip()]
    for part in parts:
        body.append(f"<h2>{html.escape(part.title)}</h2>")
        body.append(_table(part) if isinstance(part, Table) else _image(part))
        if part.note:
            body.append(f"<p>{html.escape(part.note)}</p>")
    body += _again(again)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
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


def _again(again: Again) -> list[str]:
    backend = os.environ.get("INVERTWIN_BACKEND")
    command = f"invertwin {again.command} -o again" + (f" --backend {backend}" if backend else "")
    lines = [
        "<h2>The same run again</h2>",
        f"<p>In this folder, with invertwin {__version__}:</p>",
        f"<pre>{html.escape(command)}</pre>",
    ]
    for name, text in again.files.items():
        lines.append(f"<details><summary>{html.escape(name)}</summary>")
        lines.append(f"<pre>{html.escape(text)}</pre></details>")
    return lines


def _table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in table.columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(shown(cell))}</td>" for cell in row) + "</tr>\n"
        for row in table.rows
    )
    inner = f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    return f'<div class="wide"><table>{inner}</table></div>'


def _image(picture: Picture) -> str:
    data = base64.b64encode(picture.png).decode("ascii")
    return f'<img alt="{html.escape(picture.title)}" src="data:image/png;base64,{data}">'
