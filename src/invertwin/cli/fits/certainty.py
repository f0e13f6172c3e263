"""How sure fits are: verdicts, error bars, and how often these hold over many recordings."""

import math
from collections.abc import Sequence
from typing import Any

from invertwin.cli.fits.problem import Problem
from invertwin.cli.report import Table, texts
from invertwin.errors import InputError
from invertwin.inversion import Reconstruction
from invertwin.inversion.metrics import residual

_COORDINATES = ("x", "y", "z", "pitch", "yaw", "roll")


def judged(problem: Problem, found: Reconstruction) -> dict[str, Any]:
    """Verdict and error bars of a fit, and how far it is from a known truth."""
    seen, name = found.verdict, problem.target or ""
    rows: dict[str, Any] = {"verdict": seen.word, "loss_excess": seen.excess}
    rows["verdict_reasons"] = list(seen.reasons)
    known = name in problem.known
    off = residual(found.scene[name], problem.truth[name]) if known else None
    if off is not None:
        values = [*off.offset.tolist(), *off.turn.tolist()]
        keys = [f"{name}.{coordinate}" for coordinate in _COORDINATES]
        rows["errors"] = dict(zip(keys, values, strict=True))
    try:
        bars = found.uncertainty
    except InputError as error:
        return {**rows, "no_error_bars": str(error)}
    return {
        **rows,
        "standard_deviations": bars.deviations,
        "within_95": bars.interval(),
        "units": dict(zip(bars.names, bars.units, strict=True)),
        "correlations": bars.correlations,
        "unobserved": list(bars.unobserved),
    }


def coverage(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Over recordings: the share of errors within the error bars, and how large these are."""
    names = [n for n in rows[0].get("errors", {}) if n in rows[0].get("within_95", {})]
    hits, ratios = {}, {}
    for name in names:
        errors = [row["errors"][name] for row in rows]
        bars = [row["standard_deviations"][name] for row in rows]
        inside = [abs(e) <= row["within_95"][name] for e, row in zip(errors, rows, strict=True)]
        short = name.split(".")[-1]
        hits[short] = sum(inside) / len(rows)
        ratios[short] = math.hypot(*bars) / math.hypot(*errors)
    consistent = sum(row["verdict"] == "consistent" for row in rows) / len(rows)
    return {"coverage_95": hits, "stated_over_observed": ratios, "called_consistent": consistent}


def certainty_table(metrics: dict[str, Any]) -> Table:
    """The error bars of the best fit."""
    cells = []
    for name, value in metrics.get("standard_deviations", {}).items():
        unit, factor = metrics["units"][name], 1.0
        if unit == "rad":
            unit, factor = "°", math.degrees(1)
        shown = [factor * value, factor * metrics["within_95"][name]]
        shown.append(metrics.get("coverage_95", {}).get(name.split(".")[-1]))
        cells.append([f"{name} [{unit}]" if unit else name, *shown])
    heads = ["parameter", "standard deviation", "95 % of errors within", "coverage"]
    if not any(row[-1] for row in cells):
        heads, cells = heads[:-1], [row[:-1] for row in cells]
    said = [*metrics["verdict_reasons"], *metrics.get("unobserved", [])]
    said.append(metrics.get("no_error_bars", texts("notes")["error_bars"]))
    return Table("Error bars", heads, cells, "\n".join(said))
