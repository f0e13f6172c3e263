"""Report of a run: tables of its numbers, pictures, and a self-contained report.html."""

import base64
import math
import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invertwin import __version__
from invertwin.constants import read_table

if TYPE_CHECKING:  # Matplotlib takes half a second, and most errors come before any figure
    from matplotlib.figure import Figure

    from invertwin.storage.run_folder import RunFolder


@dataclass(frozen=True)
class ReportTable:
    """A table of the report; cells are text or numbers."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    note: str = ""


@dataclass(frozen=True)
class ReportPicture:
    """A picture of the report, as PNG bytes."""

    title: str
    png: bytes
    note: str = ""


@dataclass(frozen=True)
class ReportView:
    """A display in three dimensions; a report holds one at most.

    Attributes:
        html: HTML of `viewer.view_html`.
    """

    html: str
    title: str = "In three dimensions"
    note: str = "Drag to turn, wheel to come nearer, shift and drag to move."


ReportParts = Sequence[ReportTable | ReportPicture | ReportView]


def report_html(
    title: str, status: str, note: str, parts: ReportParts, again: str, files: Mapping[str, str]
) -> str:
    """The report as one HTML text that loads nothing from elsewhere.

    Args:
        title: Heading.
        status: Outcome, in a sentence.
        note: Note of the run file about the run; blank lines part paragraphs.
        parts: Tables, pictures and a view in reading order.
        again: The command that does it again, in the run's own folder.
        files: Run files as used, by their path in the folder.
    """
    from jinja2 import Environment

    from invertwin.viewer import content_security_policy

    pages = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    pages.filters |= {"shown": format_cell, "base64": base64.b64encode}
    backend = os.environ.get("INVERTWIN_BACKEND")
    given = {"title": title, "status": status, "note": note, "parts": parts, "files": files}
    given |= {"version": __version__, "policy": content_security_policy()}
    given["command"] = f"invertwin {again} -o again" + (f" --backend {backend}" if backend else "")
    page = (resources.files("invertwin.cli") / "report.html.jinja").read_text(encoding="utf-8")
    return pages.from_string(page).render(given)


def write_report(
    folder: "RunFolder",
    metrics: Mapping[str, Any],
    title: str,
    status: str,
    parts: ReportParts,
    *,
    again: str,
    note: str = "",
) -> list[ReportTable]:
    """Write metrics.json and report.html; return the tables, to be printed.

    Args:
        folder: Folder of the run.
        metrics: Numbers of the run.
        title: Heading.
        status: Outcome, in a sentence.
        parts: Tables and pictures in reading order.
        again: The command, with its file where the run has no run file.
        note: Note of the run file about the run.
    """
    folder.write_json("metrics.json", metrics)
    files = folder.run_files
    if files:
        again += " run.toml" if len(files) == 1 else " runs/*.toml"
    folder.write_text("report.html", report_html(title, status, note, parts, again, files))
    return [part for part in parts if isinstance(part, ReportTable)]


def use_plain_style() -> None:
    """Draw as the library says, not as a `matplotlibrc` does, such as that of the working folder.

    Call it before anything else imports Matplotlib, which reads that file.
    """
    with chdir(Path(__file__).parent):
        import matplotlib
    matplotlib.rcdefaults()


def save_picture(
    folder: "RunFolder", name: str, figure: "Figure", title: str = "", note: str = ""
) -> ReportPicture:
    """Write a figure as a PNG file, and return it for the report.

    Args:
        folder: Folder of the run.
        name: Name of the file, without its ending.
        figure: The figure.
        title: Title in the report; None = the name.
        note: A key among the notes of texts.toml, or none.
    """
    from invertwin.plotting import png_bytes

    png = png_bytes(figure)
    folder.write_bytes(f"{name}.png", png)
    title = title or name.capitalize().replace("_", ", ")
    return ReportPicture(title, png, load_texts("notes").get(note, note))


def quantity_table(
    title: str,
    values: Mapping[str, Any],
    *,
    skip: Collection[str] = (),
    label_table: str = "quantities",
) -> ReportTable:
    """A table of the values that texts.toml has a label for, in its order.

    Args:
        title: Title of the table.
        values: Values by the keys of metrics.json.
        skip: Keys to leave out.
        label_table: The table of labels.
    """
    labels = load_texts(label_table).items()
    rows = [[label, values[key]] for key, label in labels if key in values and key not in skip]
    return ReportTable(title, ["quantity", "value"], rows)


def load_texts(name: str) -> dict[str, str]:
    """A table of texts.toml."""
    return read_table("invertwin.cli", "texts.toml")[name]


def is_numeric_cell(value: Any) -> bool:
    """Return whether a cell is right-aligned."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def format_place(place: Sequence[float]) -> str:
    """Coordinates in metres as people read them, to the centimetre."""
    return ", ".join(f"{value:.2f}" for value in place)


def format_cell(value: Any) -> str:
    """A cell as people read it: four significant digits, yes and no, a dash for nothing."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "–"
    if isinstance(value, list | tuple):
        return ", ".join(format_cell(item) for item in value)
    return str(value)
