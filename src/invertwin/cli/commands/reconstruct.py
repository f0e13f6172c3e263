"""`invertwin reconstruct` and `demo`: fits from one or many starts, scored against the truth."""

import math
import shutil
import time
import tomllib
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from invertwin.cli.commands.landscape import plot_landscape
from invertwin.cli.commands.placement import run_placement
from invertwin.cli.fits.displays import (
    VIEW_FILE,
    load_steps,
    make_fit_display,
    make_problem_display,
    make_sensor_maps,
    steps_path,
)
from invertwin.cli.fits.fitting import calibrate_problem, run_fit
from invertwin.cli.fits.mover import run_mover
from invertwin.cli.fits.problem import (
    OWN_METHOD,
    Problem,
    build_problem,
    estimate_initial_scene,
    has_recording_per_start,
    known_truth,
    make_starts,
    require_settings,
    with_method,
    with_recording_of_start,
)
from invertwin.cli.fits.radio import run_radio
from invertwin.cli.fits.scores import (
    drop_histories,
    predict_unblurred_maps,
    score_held_out,
    summarise_successes,
    surrogate_agreement,
    total_loss,
)
from invertwin.cli.fits.shape_scores import check_measures, is_shape_key
from invertwin.cli.fits.spreading import (
    QUIET_CONSOLE,
    FitWorkers,
    distribute_fits,
    no_parallel_fits_error,
)
from invertwin.cli.fits.writing import (
    START_COLUMNS,
    BestFit,
    describe_outcome,
    draw_pictures,
    make_tables,
)
from invertwin.cli.report import ReportTable, ReportView, save_picture, write_report
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.cli.schema.run_file import to_minimal_toml, validate_run
from invertwin.cli.schema.shape_tables import MovingTargetParameter
from invertwin.cli.terminal import show_progress
from invertwin.errors import InputError
from invertwin.inversion import Reconstruction
from invertwin.inversion.confidence.report import confidence_metrics, error_bar_coverage
from invertwin.inversion.fit import Fit
from invertwin.runtime.memory import peak_memory
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh
from invertwin.scene.shape_models.density import replace_clouds
from invertwin.storage.run_folder import CHECKPOINT, RunFolder
from invertwin.viewer import (
    MEASURED,
    SIMULATED,
    Display,
    DisplayStep,
    InteractiveSensor,
    Viewer,
    view_html,
)

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
        folder: For the results.
        console: Shows progress.
        workers: Who fits; None = this process, one start after another.
        view: Show the fits in a browser while they go on.

    Raises:
        InputError: A wrong run file, workers where there is one fit, or a view of fits that have
            none.
    """
    elsewhere = workers is not None or run.map is not None or run.placement is not None
    if view and (elsewhere or isinstance(next(iter(run.parameters), None), MovingTargetParameter)):
        raise InputError(
            "expected --view with fits of a scene to radar maps in this process, got others; "
            "leave --view or --workers out"
        )
    if run.map is not None:
        return run_radio(run, folder, console, workers)
    mover = isinstance(next(iter(run.parameters), None), MovingTargetParameter)
    if workers is not None and (mover or run.placement is not None):
        raise no_parallel_fits_error("a mover" if mover else "a metasurface")
    if mover:
        return run_mover(run, folder, console)
    if run.placement is not None:
        return run_placement(run, folder, console)
    begin = time.perf_counter()
    require_settings(run)
    problem, calibration = calibrate_problem(build_problem(run, console), folder, console)
    problem, conventional = estimate_initial_scene(problem, console)
    starts, modes = make_starts(problem), [OWN_METHOD, *run.variants]
    whole, problem = problem, with_method(problem, OWN_METHOD)
    check_measures(problem, replace_clouds(starts[0]))
    single = len(starts) * len(modes) == 1
    if workers is not None:
        fits = [(mode, i) for mode in modes for i in range(len(starts))]
        distribute_fits(_fit_one, run, folder, console, workers, fits)
    rows: dict[str, list[dict[str, Any]]] = {}
    outcomes: dict[int, Callable[[], Reconstruction]] = {}
    live = Viewer(_start_display(problem, starts[0])) if view else None
    with live or nullcontext():
        if live is not None:
            console.print(f"open {live.address}", markup=False, soft_wrap=True)
        for mode in modes:
            rows[mode] = []
            for i, start in enumerate(starts):
                checkpoint = CHECKPOINT if single else None
                own = with_recording_of_start(whole, i, console)
                show = None if live is None else partial(_show_step, live, own)
                row, outcome = run_fit(own, start, i, mode, folder, console, checkpoint, show)
                rows[mode].append(row)
                if mode == modes[0]:
                    outcomes[i] = outcome
    best = min(
        rows[modes[0]], key=lambda row: (row["status"] == "diverged", _finite_loss(row["loss"]))
    )
    start, found = starts[best["start"]], outcomes[best["start"]]()
    problem = with_method(with_recording_of_start(whole, best["start"], console), OWN_METHOD)
    twin, radars = found.scene, found.sensors
    maps = {
        "measured": [s.capture.spectrum(s.grid).float() for s in problem.sensor_data.values()],
        "start": predict_unblurred_maps(
            problem, start, [s.radar for s in problem.sensor_data.values()]
        ),
        "twin": predict_unblurred_maps(problem, twin, radars),
    }
    start, twin = replace_clouds(start), replace_clouds(twin)
    with show_progress(console):
        believed = confidence_metrics(found, known_truth(problem))
    metrics = {
        "task": run.task,
        **summarise_successes(problem, rows, modes),
        **(error_bar_coverage(rows[OWN_METHOD]) if has_recording_per_start(run) else {}),
        **believed,
        **{key: best[key] for key in ("other_ends", "ambiguities") if key in best},
        **{k: best[k] for k in best if (k in START_COLUMNS or is_shape_key(k)) and k != "seconds"},
        "start_loss_sharp": total_loss(problem, maps["start"], maps["measured"]),
        "loss_sharp": total_loss(problem, maps["twin"], maps["measured"]),
        "parameters": best["values"],
        **surrogate_agreement(problem, twin, radars[0]),
        **({"calibration": calibration} if calibration else {}),
        **conventional,
        **score_held_out(problem, rows[modes[0]], best),
        "starts": drop_histories(rows[modes[0]]),
    }
    for mode in modes[1:]:
        metrics[f"starts_{mode}"] = drop_histories(rows[mode])
        same = rows[mode][best["start"]]
        own = [key for key in same if is_shape_key(key) and not key.startswith("true_")]
        metrics |= {f"{key}_{mode}": same[key] for key in own}
    if run.landscape is not None and isinstance(run.data, SimulatedData):
        figure, minima = plot_landscape(problem, console)
        save_picture(folder, "landscape", figure)
        metrics["landscape"] = minima
    metrics["fit_seconds"] = sum(row["seconds"] for fits in rows.values() for row in fits)
    metrics["wall_seconds"] = time.perf_counter() - begin
    if (held := peak_memory()) is not None:
        metrics["peak_memory_gb"] = held / 1e9
    fitted = BestFit(problem, metrics, rows, start, twin, maps, found.verdict.residuals)
    result, *tables = make_tables(fitted)
    steps = load_steps(folder.file(steps_path(best["checkpoint"])))
    display = make_fit_display(problem, start, twin, maps, metrics, steps)
    display.save(folder.file(VIEW_FILE))
    links = {
        name: InteractiveSensor(twin, radar, sight.grid, require_settings(run).depth)
        for (name, sight), radar in zip(problem.sensor_data.items(), radars, strict=True)
    }
    parts = [result, ReportView(view_html(display, links)), *draw_pictures(fitted, folder), *tables]
    save_mesh(folder.file("twin.ply"), twin)
    if run.measures is not None:
        save_mesh(folder.file("twin.glb"), twin)
    if best["checkpoint"] != CHECKPOINT:
        shutil.copyfile(folder.file(best["checkpoint"]), folder.file(CHECKPOINT))
    title, outcome = run.title or "Reconstruction", describe_outcome(run, metrics)
    tables = write_report(
        folder, metrics, title, outcome, parts, again="reconstruct", note=run.note
    )
    return tables, outcome


def _start_display(problem: Problem, start: Scene) -> Display:
    """A display of a fit that has not begun: what was measured, and what the start has for it."""
    display, radars = make_problem_display(problem, start), problem.sensor_data.values()
    spectra = {
        MEASURED: [s.capture.spectrum(s.grid).float() for s in radars],
        SIMULATED: predict_unblurred_maps(problem, start, [s.radar for s in radars]),
    }
    return replace(display, maps=make_sensor_maps(problem, spectra))


def _show_step(live: Viewer, problem: Problem, going: Fit, step: DisplayStep) -> None:
    """Show a step of a fit with what its sensors would see."""
    with torch.no_grad():
        simulated = predict_unblurred_maps(problem, *going.apply_modules())
    live.add_step(step, make_sensor_maps(problem, {SIMULATED: simulated}, _MAX_STEP_VALUES))


def _fit_one(run: RunFile, mode: str, number: int, folder: RunFolder) -> None:
    """What a worker does of a run: one fit, which leaves its files in the folder."""
    problem, _ = calibrate_problem(_load_problem(to_minimal_toml(run)), folder, QUIET_CONSOLE)
    problem, _ = estimate_initial_scene(problem, QUIET_CONSOLE)
    start, own = (
        make_starts(problem)[number],
        with_recording_of_start(problem, number, QUIET_CONSOLE),
    )
    run_fit(own, start, number, mode, folder, QUIET_CONSOLE, None)


@lru_cache(maxsize=1)
def _load_problem(text: str) -> Problem:
    """A worker simulates the data of a run once for all its fits."""
    return build_problem(validate_run(tomllib.loads(text), Path("run.toml")), QUIET_CONSOLE)


def _finite_loss(loss: float | None) -> float:
    """The loss as a rank: one that is not a number comes last."""
    return loss if loss is not None and math.isfinite(loss) else math.inf
