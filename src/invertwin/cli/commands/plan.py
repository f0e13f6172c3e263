"""`invertwin plan`: error bars before any recording, and the gain of further positions."""

import time
from dataclasses import replace
from typing import Any

import torch
from rich.console import Console

from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.problem import Problem, make_observations, make_unknowns, stage_runs
from invertwin.cli.fits.radar_models import with_new_recording
from invertwin.cli.fits.scores import error_bar_table
from invertwin.cli.report import ReportTable, format_place, load_texts, write_report
from invertwin.cli.run_file import require_section
from invertwin.cli.schema import PlanTable, RunFile, SimulatedData, build
from invertwin.cli.terminal import show_progress
from invertwin.inversion import plan_error_bars, prepare_fit
from invertwin.inversion.confidence.planning import fit_errors
from invertwin.inversion.confidence.report import error_bar_metrics
from invertwin.refusals import refusal
from invertwin.runtime.progress import track
from invertwin.storage.folders import PARTS
from invertwin.storage.run_folder import RunFolder


def run_plan(run: RunFile, folder: RunFolder, console: Console) -> tuple[list[ReportTable], str]:
    """State the error bars of a run that has not been recorded; return tables and a sentence.

    Simulated fits that an interrupted run has finished are not done again.

    Raises:
        InputError: Data that are measured, not simulated; candidates of several sensors.
    """
    begin, table = time.perf_counter(), run.plan or PlanTable()
    for own in [run, *run.observations.values()]:
        if own.data is not None and not isinstance(own.data, SimulatedData):
            raise refusal("plan.measured_data", own.data.kind)
    wide, places = run, torch.zeros(0, 3)
    if table.candidates is not None:
        radar = require_section(run, "radar", "positions to add")
        places = radar.model_copy(update={"positions": table.candidates}).poses(1)[0]
        every = [*radar.poses(1)[0].tolist(), *places.tolist()]
        wide = run.model_copy(update={"radar": radar.model_copy(update={"positions": every})})
    own = build_problem(wide, console)
    console.print("error bars")
    with show_progress(console):
        found, added = plan_error_bars(_prepare_fit_at_truth(own), len(places))
    metrics: dict[str, Any] = {"task": "plan", **error_bar_metrics(found), "verdict_reasons": []}
    first = len(own.first_sensor.sensor.positions) - len(places)
    metrics["candidates"] = [
        {"position": places[one.frame - first].tolist(), "share": one.deviation_ratio}
        | {"standard_deviations": one.error_bars.deviations}
        for one in added
    ]
    metrics |= _compare_with_fits(replace(own, run=run), found.deviations, folder, console)
    parts = [replace(error_bar_table(metrics), title="Expected error bars")]
    answer = f"{len(found.names)} parameters, {len(found.unobserved)} directions not observed"
    if added:
        rows = [[str(k), c["position"], c["share"]] for k, c in enumerate(metrics["candidates"], 1)]
        heads, note = ("rank", "position [m]", "deviations, times"), "candidates"
        parts.append(ReportTable("Positions to add", heads, rows, load_texts("notes")[note]))
        best, share = format_place(places[added[0].frame - first].tolist()), rows[0][2]
        answer = f"Best position to add ({best}) m: standard deviations times {share:.2f}; {answer}"
    metrics |= {"answer": answer, "wall_seconds": time.perf_counter() - begin}
    how: dict[str, Any] = {"again": "plan", "note": run.note}
    return write_report(folder, metrics, run.title or "Plan", f"{answer}.", parts, **how), answer


def _prepare_fit_at_truth(problem: Problem) -> Any:
    # Error bars are those of the last stage, which may have another model.
    run, last = problem.run, replace(problem, run=stage_runs(problem.run)[-1][1])
    unknown = make_observations(last), make_unknowns(problem)
    return prepare_fit(problem.truth, *unknown, loss=build.build_loss(run), seed=run.seed)


def _compare_with_fits(
    problem: Problem, predicted_deviations: dict[str, float], folder: RunFolder, console: Console
) -> dict[str, Any]:
    """Fit simulated recordings from the truth, and return the scatter of the results."""
    count = problem.run.plan.fits if problem.run.plan else 0
    if not count:
        return {}
    parts = [f"{PARTS}/fit_{number:03d}.json" for number in range(count)]
    found = {part: row for part in parts if (row := folder.read_json(part)) is not None}
    with show_progress(console):
        for part in track([part for part in parts if part not in found], "simulated fits"):
            own = with_new_recording(problem, parts.index(part) + 1, console)
            found[part] = fit_errors(_prepare_fit_at_truth(own))
            folder.write_json(part, found[part])
    rows = [found[part] for part in parts]
    errors = torch.tensor([list(row.values()) for row in rows], dtype=torch.float64)
    spread = dict(zip(rows[0], errors.std(0).tolist(), strict=True))
    ratios = {n: own / spread[n] for n, own in predicted_deviations.items() if spread.get(n)}
    means = dict(zip(rows[0], errors.mean(0).tolist(), strict=True))
    observed = {"observed_deviations": spread, "observed_means": means}
    return {"simulated_fits": count, **observed, "predicted_over_observed": ratios}
