"""The table of error bars."""

import math
from typing import Any

from invertwin.cli.report import Table, texts


def certainty_table(metrics: dict[str, Any]) -> Table:
    """The error bars of the best fit."""
    cells = []
    for name, value in metrics.get("standard_deviations", {}).items():
        unit, factor = metrics["units"][name], 1.0
        if unit == "rad":
            unit, factor = "°", math.degrees(1)
        row = [f"{name} [{unit}]" if unit else name, factor * value]
        row += [factor * metrics["within_95"][name]]
        row += [metrics.get("coverage_95", {}).get(name.split(".")[-1])]
        row += [metrics.get("predicted_over_observed", {}).get(name)]
        cells.append([*row, metrics.get("spread_of_ends", {}).get(name)])
    heads = ["parameter", "standard deviation", "95 % of errors within"]
    heads += ["coverage", "over that of simulated fits", "spread of other ends"]
    kept = [k for k in range(len(heads)) if k < 3 or any(row[k] is not None for row in cells)]
    heads, cells = [heads[k] for k in kept], [[row[k] for k in kept] for row in cells]
    told = ("verdict_reasons", "ambiguities", "unobserved")
    said = [text for key in told for text in metrics.get(key, [])]
    said += [metrics["spread_note"]] if "spread_note" in metrics else []
    said.append(metrics.get("no_error_bars", texts("notes")["error_bars"]))
    return Table("Error bars", heads, cells, "\n".join(said))
