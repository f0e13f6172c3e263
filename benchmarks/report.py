"""Tables of metrics for all benchmarks: what must hold, and the file that keeps them."""

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

#: By metric: "<=" or ">=", and the limit.
Required = dict[str, tuple[str, float]]


class MetricTable:
    """A row a metric: value, what must hold, and what was counted."""

    def __init__(self, title: str, required: Required) -> None:
        self.required = required
        self.grid = Table(title=title, title_justify="left")
        self.grid.add_column("metric", no_wrap=True)
        self.grid.add_column("value", justify="right", no_wrap=True)
        self.grid.add_column("must hold", justify="right", no_wrap=True)
        self.grid.add_column("what was counted")

    def row(self, key: str, value: float | None, shown: str, text: str = "") -> None:
        """Add a metric; what must hold goes by the last part of its key, or by all of it."""
        limit = self.required.get(key, self.required.get(key.rpartition(".")[2]))
        cell = "—" if value is None else format(value, shown)
        self.grid.add_row(key, cell, "" if limit is None else verdict(value, limit), escape(text))

    def rows(self, metrics: dict[str, Any], counted: dict[str, tuple[str, str]]) -> None:
        """Add metrics, each with the format of its value and what was counted."""
        for key, (shown, text) in counted.items():
            self.row(key, metrics[key], shown, text)


def verdict(value: float | None, limit: tuple[str, float]) -> str:
    """What must hold of a value, and whether it does."""
    sign, bound = limit
    if value is None:
        return f"{sign} {bound:.3g} —"
    holds = value >= bound if sign == ">=" else value <= bound
    return f"{sign} {bound:.3g} {'yes' if holds else 'NO'}"


def write(metrics: dict[str, Any], table: Table, out: Path) -> None:
    """Print the table; `metrics.json` goes into the folder."""
    Console(width=None if sys.stdout.isatty() else 140).print(table)
    out.mkdir(parents=True, exist_ok=True)
    path = out / "metrics.json"
    path.write_text(json.dumps(metrics, indent=2) + "\n")
    print(f"wrote {path}")
