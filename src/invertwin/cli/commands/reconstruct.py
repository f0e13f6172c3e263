"""`invertwin reconstruct` and `demo`: fits from one or many starts, scored against the truth."""

import shutil
import time
import tomllib
from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from invertwin.cli.commands.landscape import plot_landscape
from invertwin.cli.fits import displays
from invertwin.cli.fits.fitting import fit_all, run_fit
from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.problem import OWN_METHOD, Fits, Problem, known_truth
from invertwin.cli.fits.scores import drop_histories
from invertwin.cli.fits.shape_scores import check_measures
from invertwin.cli.fits.spreading import QUIET_CONSOLE, FitWorkers, distribute_fits
from invertwin.cli.fits.writing import state_positions
from invertwin.cli.report import ReportTable, ReportView, save_picture, write_report
from invertwin.cli.run_file import to_minimal_toml, validate_run
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.cli.terminal import show_progress
from invertwin.inversion.confidence.report import confidence_metrics
from invertwin.inversion.fit import Fit
from invertwin.refusals import refusal
from invertwin.scene.files import save_mesh
from invertwin.scene.shape_models.density import replace_clouds
from invertwin.storage.run_folder import CHECKPOINT, RunFolder
from invertwin.viewer import SIMULATED, DisplayStep, InteractiveSensor, Viewer, view_html

_MAX_STEP_VALUES = 200_000  # of the maps of a step that is shown while the fit goes on


def run_reconstruct(
    run: RunFile,
    folder: RunFolder,
    console: Console,
    workers: FitWorkers | None = None,
    *,
    view: bool = False,
) -> tuple[list[ReportTable], str]:
    """Fit from every start, write the folder; return the tables to print and the outcome.

    Starts that an interrupted run has finished are not fitted again.

    Args:
        run: The run file.
        folder: Folder of the results.
        console: Shows progress.
        workers: Processes that fit; None = this process, one start after another.
        view: Show the fits in a browser while they go on.

    Raises:
        InputError: A wrong run file, workers where there is one fit, or a view of their fits.
    """
    if view and workers is not None:
        raise refusal("reconstruct.view_of_workers")
    begin = time.perf_counter()
    problem = build_problem(run, console)
    problem = problem.kind.prepare(problem, folder, console)
    starts = problem.starts()
    check_measures(problem.kind.with_method(problem, OWN_METHOD), replace_clouds(starts[0].scene))
    if workers is not None:
        distribute_fits(_fit_one, run, folder, console, workers, problem.work)
    live = Viewer(displays.make_start_display(problem, starts[0])) if view else None
    with live or nullcontext():
        if live is not None:
            console.print(f"open {live.address}", markup=False, soft_wrap=True)
        show = None if live is None else partial(_show_step, live)
        fits = fit_all(problem, folder, console, show)
    fits = replace(fits, maps=_maps(fits))
    with show_progress(console):
        confidence = confidence_metrics(fits.found, known_truth(fits.problem))
        confidence = fits.problem.kind.revise_confidence(fits, confidence)
    metrics = _metrics(fits, confidence)
    if run.landscape is not None and isinstance(run.data, SimulatedData):
        figure, minima = plot_landscape(fits.problem, console)
        save_picture(folder, "landscape", figure)
        metrics["landscape"] = minima
    metrics["wall_seconds"] = time.perf_counter() - begin
    return _write(fits, metrics, confidence, folder)


def _metrics(fits: Fits, confidence: dict[str, Any]) -> dict[str, Any]:
    """Numbers of the run, as metrics.json has them."""
    problem, best, rows = fits.problem, fits.best, fits.rows
    lean = {name: drop_histories(own, problem.kind.histories) for name, own in rows.items()}
    kept = ("other_ends", "ambiguities", "status", "steps", "loss", "start")
    return {
        "task": problem.run.task,
        "starts_count": len(rows[OWN_METHOD]),
        **confidence,
        **{key: best[key] for key in kept if key in best and key not in confidence},
        "parameters": best["values"],
        "answer": state_positions(fits, confidence),
        **problem.notes,
        **{f"starts_{name}": own for name, own in lean.items() if name != OWN_METHOD},
        "starts": lean[OWN_METHOD],
        **problem.kind.metrics(fits),
        "fit_seconds": sum(row["seconds"] for fits in rows.values() for row in fits),
    }


def _maps(fits: Fits) -> dict[str, list[torch.Tensor]]:
    """Sharp maps of every sensor: measured, at the start, of the twin."""
    kind, problem = fits.problem.kind, fits.problem
    sensors = [item.sensor for item in problem.sensor_data.values()]
    return {
        "measured": kind.measured_maps(problem),
        "start": kind.predict_maps(problem, fits.start.scene, sensors),
        "twin": kind.predict_maps(problem, fits.found.scene, fits.found.sensors),
    }


def _write(
    fits: Fits, metrics: dict[str, Any], confidence: dict[str, Any], folder: RunFolder
) -> tuple[list[ReportTable], str]:
    """Write the report, the display and the meshes of the best fit."""
    problem, best, run = fits.problem, fits.best, fits.problem.run
    twin = replace_clouds(fits.found.scene)
    summary = problem.kind.summary(fits, metrics, folder)
    steps = displays.load_steps(folder.file(displays.steps_path(best["checkpoint"])))
    display = displays.make_fit_display(fits, confidence, steps)
    display.save(folder.file(displays.VIEW_FILE))
    sensors = dict(zip(problem.sensor_data, fits.found.sensors, strict=True))
    depth = run.fit_settings.depth
    links = {
        name: InteractiveSensor(fits.found.scene, sensors[name], item.grid, depth)
        for name, item in displays.radar_data(problem).items()
    }
    shown = ReportView(view_html(display, links))
    found, *details = summary.tables
    parts = [shown, found, *summary.pictures, *details, summary.result]
    save_mesh(folder.file("twin.ply"), twin)
    if run.measures is not None:
        save_mesh(folder.file("twin.glb"), twin)
    shutil.copyfile(folder.file(best["checkpoint"]), folder.file(CHECKPOINT))
    title, status = run.title or problem.kind.title, summary.outcome
    tables = write_report(folder, metrics, title, status, parts, again="reconstruct", note=run.note)
    return tables, status


def _show_step(live: Viewer, problem: Problem, going: Fit, step: DisplayStep) -> None:
    """Show a step of a fit with what its sensors would see."""
    with torch.no_grad():
        simulated = problem.kind.predict_maps(problem, *going.apply_modules())
    maps = displays.make_sensor_maps(problem, {SIMULATED: simulated}, _MAX_STEP_VALUES)
    live.add_step(step, maps)


def _fit_one(run: RunFile, method: str, number: int, folder: RunFolder) -> None:
    """Make one fit of a run in a worker; it leaves its files in the folder."""
    problem = _load_problem(to_minimal_toml(run))
    problem = problem.kind.prepare(problem, folder, QUIET_CONSOLE)
    own = problem.kind.with_recording_of_start(problem, number, QUIET_CONSOLE)
    run_fit(own, problem.starts(method)[number], number, method, folder, QUIET_CONSOLE)


@lru_cache(maxsize=1)
def _load_problem(text: str) -> Problem:
    """A worker simulates the data of a run once for all its fits."""
    return build_problem(validate_run(tomllib.loads(text), Path("run.toml")), QUIET_CONSOLE)
