"""Confidence of fits as numbers: verdict, error bars, and their coverage."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from invertwin.errors import InputError
from invertwin.inversion.confidence.uncertainty import Uncertainty
from invertwin.inversion.metrics import pose_error
from invertwin.inversion.reconstruction import Reconstruction
from invertwin.scene.scene import Object

COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Names of the coordinates of a position and of a rotation vector among parameters."""


def confidence_metrics(fit: Reconstruction, truth: Mapping[str, Object]) -> dict[str, Any]:
    """Return verdict, error bars and true errors of a fit.

    Args:
        fit: finished fit.
        truth: true objects by name.
    """
    verdict = fit.verdict
    rows: dict[str, Any] = {"verdict": verdict.word, "loss_excess": verdict.excess}
    rows |= {"structure_excess": verdict.structure, "verdict_reasons": list(verdict.reasons)}
    others = verdict.ambiguities
    rows["rivals"] = [{"pose": other.description, "score": other.score} for other in others]
    errors: dict[str, float] = {}
    for name, item in truth.items():
        off = pose_error(fit.scene[name], item)
        if off is not None:
            values = zip(COORDINATES, [*off.offset.tolist(), *off.rotation.tolist()], strict=True)
            errors |= {f"{name}.{coordinate}": value for coordinate, value in values}
    rows |= {"errors": errors} if errors else {}
    try:
        return rows | error_bar_metrics(fit.uncertainty)
    except InputError as error:
        return {**rows, "no_error_bars": str(error)}


def error_bar_metrics(uncertainty: Uncertainty) -> dict[str, Any]:
    """Return error bars as numbers by name.

    Args:
        uncertainty: error bars of a fit.
    """
    return {
        "standard_deviations": uncertainty.deviations,
        "within_95": uncertainty.interval(),
        "units": dict(zip(uncertainty.names, uncertainty.units, strict=True)),
        "correlations": uncertainty.correlations,
        "unobserved": list(uncertainty.unobserved),
        "size_errors": dict(uncertainty.size_errors),
        "early_stops": list(uncertainty.early_stops),
    }


def error_bar_coverage(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Compute the coverage and the mean size of error bars over recordings.

    Args:
        rows: ``confidence_metrics`` of every recording.
    """
    names = [n for n in rows[0].get("errors", {}) if n in rows[0].get("within_95", {})]
    hits, ratios = {}, {}
    for name in names:
        errors = [row["errors"][name] for row in rows]
        stated = [row["standard_deviations"][name] for row in rows]
        inside = [abs(e) <= row["within_95"][name] for e, row in zip(errors, rows, strict=True)]
        short = name.split(".")[-1]
        hits[short] = sum(inside) / len(rows)
        ratios[short] = math.hypot(*stated) / math.hypot(*errors)
    consistent = sum(row["verdict"] == "consistent" for row in rows) / len(rows)
    return {"coverage_95": hits, "stated_over_observed": ratios, "called_consistent": consistent}
