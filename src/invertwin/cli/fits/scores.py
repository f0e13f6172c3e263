"""Scores of a fit: distances to the truth, held-out objects, losses without blur."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from invertwin.capture import calibrate, locate
from invertwin.channel import Sampling
from invertwin.cli.fits import radar_models
from invertwin.cli.fits.problem import HISTORIES, Problem, Row, fitted_tables
from invertwin.cli.fits.shape_scores import score_shape
from invertwin.cli.report import ReportTable, load_texts
from invertwin.cli.schema import SimulatedData, build
from invertwin.errors import InputError
from invertwin.inversion.confidence.report import COORDINATES
from invertwin.inversion.loss import Objective
from invertwin.inversion.metrics import axis_error, material_errors, pose_error
from invertwin.models.radar import surrogate_correlation
from invertwin.radar import Radar, SampledWaveform
from invertwin.scene import Mesh, Scene, SkinnedBody
from invertwin.scene.shape_models.density import replace_clouds

ANGLES = COORDINATES[3:]
"""Names of the coordinates of a rotation vector among parameters."""
DOUBTED = ("inconsistent", "worse", "lost")
"""Verdicts on fits whose error bars do not hold."""
_BAR_COLUMNS = {
    "predicted_over_observed": "over that of simulated fits",
    "spread_of_ends": "spread of other ends",
}


def score_fit(problem: Problem, start: Scene, twin: Scene) -> Row:
    """Errors of start and twin, where the truth is known."""
    name, twin = problem.scored_object, replace_clouds(twin)
    if name is None:
        return {}
    place = twin[name].center.detach().tolist()
    if name not in problem.known_objects:
        return {"position": place}
    shapes = score_shape(problem, replace_clouds(start), twin)
    before = pose_error(start[name], problem.truth[name])
    after = pose_error(twin[name], problem.truth[name])
    if before is None or after is None:
        return {"position": place, **shapes}
    settings = problem.run.fit_settings
    body = build.fitted_body(problem.run, problem.scene, name)
    if body is not None:
        angles = score_joints(body, *(s[name].mesh for s in (start, twin, problem.truth)))
        good = angles["joint_error_after_deg"] <= settings.joint_limit_deg
        return {**angles, "success": good, "position": place, **shapes}
    rows: Row = {"start_distance_m": before.distance, "position_error_m": after.distance}
    rows |= {"success": after.distance <= settings.position_limit, "position": place}
    if settings.axis is not None:
        ends = [(s[name], problem.truth[name]) for s in (start, twin)]
        (far, tilted), (near, tilt) = (axis_error(*pair, settings.axis) for pair in ends)
        good = near <= settings.position_limit and tilt <= math.radians(settings.rotation_limit_deg)
        return {
            "start_distance_m": far,
            "start_angle_deg": math.degrees(tilted),
            "position_error_m": near,
            "rotation_error_deg": math.degrees(tilt),
            "turn_error_deg": math.degrees(after.angle),
            "success": good,
            "position": twin[name].transform[:3, 3].tolist(),
            **shapes,
        }
    fitted = fitted_tables(problem.run).values()
    kinds = {table.kind for table in fitted}
    if "pose" in kinds:
        angle = math.degrees(after.angle)
        rows |= {"start_angle_deg": math.degrees(before.angle), "rotation_error_deg": angle}
        rows["success"] &= angle <= settings.rotation_limit_deg
    if "scale" in kinds:
        rows |= {"scale_error": abs(after.scale - 1)}
    for table in fitted:
        if _is_material_known(problem, table):
            ends = twin[table.object].material, problem.truth[table.object].material
            rows |= material_errors(table.values, *ends, _frequency(problem), table.layer)
    return rows | shapes


def _frequency(problem: Problem) -> float:
    """Frequency at which materials are compared [Hz]."""
    if problem.run.map is not None:
        return problem.run.map.frequency
    return problem.first_sensor.sensor.waveform.center_frequency


def score_joints(body: SkinnedBody, start: Mesh, found: Mesh, truth: Mesh) -> dict[str, float]:
    """Angles [°] by which the free joints are off, means over them and each at the end."""
    before, after = (body.joint_errors(mesh, truth) for mesh in (start, found))
    return {
        "joint_error_before_deg": math.degrees(sum(before.values()) / len(before)),
        "joint_error_after_deg": math.degrees(sum(after.values()) / len(after)),
        **{f"joint_error_{name}_deg": math.degrees(angle) for name, angle in after.items()},
    }


def _is_material_known(problem: Problem, parameter: Any) -> bool:
    """Return True if the run file tells the true material of a fitted object."""
    if parameter.kind != "material":
        return False
    table = problem.run.truth.get(parameter.object)
    stated = table is not None and table.material is not None
    return stated or isinstance(problem.run.data, SimulatedData)


def summarise_successes(
    problem: Problem, rows: Mapping[str, list[Row]], modes: Sequence[str]
) -> Row:
    """Successes of every way to fit, the run's own first; of several sensors, also each alone."""
    if problem.scored_object not in problem.known_objects or "success" not in rows[modes[0]][0]:
        return {}
    counts = {mode: sum(row.get("success", False) for row in rows[mode]) for mode in modes}
    found = {"successes": counts[modes[0]], "starts_count": len(rows[modes[0]])}
    found |= {f"successes_{mode}": counts[mode] for mode in modes[1:]}
    variants = problem.run.variants.items()
    chosen = {mode: (own.reconstruct or {}).get("observations", []) for mode, own in variants}
    alone = {names[0]: counts[mode] for mode, names in chosen.items() if len(names) == 1}
    if alone:
        found |= {"joint_successes": counts[modes[0]], "alone_successes": alone}
    return found


def score_held_out(problem: Problem, rows: list[Row], best: Row) -> Row:
    """For calibrated captures: the error on an object that took no part in the calibration."""
    table = problem.run.calibration
    name = problem.scored_object
    if table is None or name is None or name not in problem.known_objects or name == table.object:
        return {}
    truth, known = problem.truth[name].center, problem.truth[table.object].center
    focused = calibrate(problem.first_sensor.recording, known)
    peak = locate(focused, truth)
    places = torch.tensor([row["position"] for row in rows], dtype=torch.float64)
    spread = (places - places.mean(0)).norm(dim=1).max()
    return {
        "heldout_error_m": best["position_error_m"],
        "heldout_error_worst_m": max(row["position_error_m"] for row in rows),
        "backprojection_error_m": float((peak - truth).norm()),
        "spread_m": float(spread),
        # Between the two objects. That these differ is no matter of the fit.
        "backprojection_distance_m": float((peak - locate(focused, known)).norm()),
        "surveyed_distance_m": float((truth - known).norm()),
    }


def drop_histories(rows: Sequence[Row], dropped: Sequence[str] = HISTORIES) -> list[Row]:
    """The rows of the fits as metrics keep them."""
    return [{key: value for key, value in row.items() if key not in dropped} for row in rows]


def surrogate_agreement(problem: Problem, twin: Scene, radar: Radar) -> dict[str, float]:
    """Correlation of the surrogate with the mean of exact spectra: one bounce, first frame."""
    if not isinstance(radar.waveform, SampledWaveform):
        return {}
    sampling = Sampling(depth=1, points_per_m2=radar_models.rough_point_densities(problem.run))
    model = replace(radar_models.make_unblurred_models(problem)[0], sampling=sampling)
    first = replace(radar.frames([0]), range_bias=0.0)
    found = surrogate_correlation(twin, first, model, seed=problem.run.seed)
    return {"surrogate_correlation": found}


def total_loss(
    problem: Problem, simulated: Sequence[torch.Tensor], measured: Sequence[torch.Tensor]
) -> float | None:
    """The weighted mean of the losses of all sensors; None where a map without power has none."""
    loss = build.build_loss(problem.run)
    weights = tuple(item.weight for item in problem.sensor_data.values())
    try:
        pairs = list(zip(simulated, measured, strict=True))
        return float(Objective((loss,) * len(weights), weights)(pairs))
    except InputError:
        return None


def error_bar_table(metrics: Row, values: Mapping[str, Sequence[Any]] | None = None) -> ReportTable:
    """Tabulate the parameters of the best fit with their error bars.

    Args:
        metrics: numbers of the run.
        values: start, result and truth by the names of the error bars; angles in degrees.
    """
    bars, values, cells = metrics.get("standard_deviations", {}), values or {}, []
    for name in dict.fromkeys((*values, *bars)):
        tail, factor = name.split(".")[-1], 1.0
        unit = metrics.get("units", {}).get(name) or ("m" if tail in COORDINATES[:3] else "")
        if unit == "rad" or tail in ANGLES:
            unit, factor = "°", math.degrees(1)
        start, result, truth = values.get(name, (None, None, None))
        found = [bars.get(name), metrics.get("within_95", {}).get(name)]
        row = [f"{name} [{unit}]" if unit else name, start, result]
        row += [bar if bar is None else factor * bar for bar in found]
        row += [truth, metrics.get("coverage_95", {}).get(tail)]
        row += [metrics.get(key, {}).get(name) for key in _BAR_COLUMNS]
        cells.append(row)
    heads = ["parameter", "start", "result", "standard deviation", "95 % of errors within", "truth"]
    heads += ["coverage", *_BAR_COLUMNS.values()]
    kept = [k for k in range(len(heads)) if not k or any(row[k] is not None for row in cells)]
    heads, cells = [heads[k] for k in kept], [[row[k] for k in kept] for row in cells]
    sources = ("verdict_reasons", "ambiguities", "unobserved", "early_stops")
    said = [text for key in sources for text in metrics.get(key, [])]
    said += [metrics["spread_note"]] if "spread_note" in metrics else []
    note = "error_bars_without_model" if metrics.get("verdict") in DOUBTED else "error_bars"
    said.append(metrics.get("no_error_bars", load_texts("notes")[note]))
    return ReportTable("Parameters" if values else "Error bars", heads, cells, "\n".join(said))
