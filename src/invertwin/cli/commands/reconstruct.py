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

from invertwin.cli.commands.landscape import landscape
from invertwin.cli.commands.placement import run_placement
from invertwin.cli.fits.displays import (
    VIEW,
    display_of_fit,
    display_of_problem,
    maps_of_sensors,
    steps_file,
    steps_in,
)
from invertwin.cli.fits.fitting import calibrated, fit
from invertwin.cli.fits.mover import run_mover
from invertwin.cli.fits.problem import (
    FULL,
    Problem,
    guessed,
    known_of,
    problem_of,
    recorded_anew,
    recorded_for,
    settings_of,
    starts_of,
    varied,
)
from invertwin.cli.fits.radio import run_radio
from invertwin.cli.fits.scores import (
    agreement,
    heldout,
    misfit,
    sharp_maps,
    summary,
    without_history,
)
from invertwin.cli.fits.shape_scores import check_measures, is_shape_key
from invertwin.cli.fits.spreading import QUIET, Workers, fit_elsewhere, refused
from invertwin.cli.fits.writing import COLUMNS, Fitted, pictures_of, status, tables_of
from invertwin.cli.report import Table, View, finish, picture
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.cli.schema.run_file import stated, validate
from invertwin.cli.schema.shape_tables import Mover
from invertwin.cli.terminal import progress
from invertwin.errors import InputError
from invertwin.inversion import Reconstruction
from invertwin.inversion.confidence.report import certainty, coverage
from invertwin.inversion.fit import Fit
from invertwin.runtime.memory import peak_memory
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh
from invertwin.scene.shape_models.density import without_clouds
from invertwin.storage.run_folder import CHECKPOINT, RunFolder
from invertwin.viewer import MEASURED, SIMULATED, Display, Link, Step, Viewer, view_html

_VALUES_OF_STEPS = 200_000  # of the maps of a step that is shown while the fit goes on


def run_reconstruct(
    run: RunFile,
    folder: RunFolder,
    console: Console,
    workers: Workers | None = None,
    *,
    view: bool = False,
) -> tuple[list[Table], str]:
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
    if view and (elsewhere or isinstance(next(iter(run.parameters), None), Mover)):
        raise InputError(
            "expected --view with fits of a scene to radar maps in this process, got others; "
            "leave --view or --workers out"
        )
    if run.map is not None:
        return run_radio(run, folder, console, workers)
    mover = isinstance(next(iter(run.parameters), None), Mover)
    if workers is not None and (mover or run.placement is not None):
        raise refused("a mover" if mover else "a metasurface")
    if mover:
        return run_mover(run, folder, console)
    if run.placement is not None:
        return run_placement(run, folder, console)
    begin = time.perf_counter()
    settings_of(run)
    problem, calibration = calibrated(problem_of(run, console), folder, console)
    problem, conventional = guessed(problem, console)
    starts, modes = starts_of(problem), [FULL, *run.variants]
    whole, problem = problem, varied(problem, FULL)
    check_measures(problem, without_clouds(starts[0]))
    single = len(starts) * len(modes) == 1
    if workers is not None:
        fits = [(mode, i) for mode in modes for i in range(len(starts))]
        fit_elsewhere(_fit_one, run, folder, console, workers, fits)
    rows: dict[str, list[dict[str, Any]]] = {}
    outcomes: dict[int, Callable[[], Reconstruction]] = {}
    live = Viewer(_begun(problem, starts[0])) if view else None
    with live or nullcontext():
        if live is not None:
            console.print(f"open {live.address}", markup=False, soft_wrap=True)
        for mode in modes:
            rows[mode] = []
            for i, start in enumerate(starts):
                checkpoint = CHECKPOINT if single else None
                own = recorded_for(whole, i, console)
                show = None if live is None else partial(_show, live, own)
                row, outcome = fit(own, start, i, mode, folder, console, checkpoint, show)
                rows[mode].append(row)
                if mode == modes[0]:
                    outcomes[i] = outcome
    best = min(rows[modes[0]], key=lambda row: (row["status"] == "diverged", _finite(row["loss"])))
    start, found = starts[best["start"]], outcomes[best["start"]]()
    problem = varied(recorded_for(whole, best["start"], console), FULL)
    twin, radars = found.scene, found.sensors
    maps = {
        "measured": [s.capture.spectrum(s.grid).float() for s in problem.sights.values()],
        "start": sharp_maps(problem, start, [s.radar for s in problem.sights.values()]),
        "twin": sharp_maps(problem, twin, radars),
    }
    start, twin = without_clouds(start), without_clouds(twin)
    with progress(console):
        believed = certainty(found, known_of(problem))
    metrics = {
        "task": run.task,
        **summary(problem, rows, modes),
        **(coverage(rows[FULL]) if recorded_anew(run) else {}),
        **believed,
        **{key: best[key] for key in ("other_ends", "ambiguities") if key in best},
        **{k: best[k] for k in best if (k in COLUMNS or is_shape_key(k)) and k != "seconds"},
        "start_loss_sharp": misfit(problem, maps["start"], maps["measured"]),
        "loss_sharp": misfit(problem, maps["twin"], maps["measured"]),
        "parameters": best["values"],
        **agreement(problem, twin, radars[0]),
        **({"calibration": calibration} if calibration else {}),
        **conventional,
        **heldout(problem, rows[modes[0]], best),
        "starts": without_history(rows[modes[0]]),
    }
    for mode in modes[1:]:
        metrics[f"starts_{mode}"] = without_history(rows[mode])
        same = rows[mode][best["start"]]
        own = [key for key in same if is_shape_key(key) and not key.startswith("true_")]
        metrics |= {f"{key}_{mode}": same[key] for key in own}
    if run.landscape is not None and isinstance(run.data, SimulatedData):
        figure, minima = landscape(problem, console)
        picture(folder, "landscape", figure)
        metrics["landscape"] = minima
    metrics["fit_seconds"] = sum(row["seconds"] for fits in rows.values() for row in fits)
    metrics["wall_seconds"] = time.perf_counter() - begin
    if (held := peak_memory()) is not None:
        metrics["peak_memory_gb"] = held / 1e9
    fitted = Fitted(problem, metrics, rows, start, twin, maps, found.verdict.residuals)
    result, *tables = tables_of(fitted)
    steps = steps_in(folder.file(steps_file(best["checkpoint"])))
    display = display_of_fit(problem, start, twin, maps, metrics, steps)
    display.save(folder.file(VIEW))
    links = {
        name: Link(twin, radar, sight.grid, settings_of(run).depth)
        for (name, sight), radar in zip(problem.sights.items(), radars, strict=True)
    }
    parts = [result, View(view_html(display, links)), *pictures_of(fitted, folder), *tables]
    save_mesh(folder.file("twin.ply"), twin)
    if run.measures is not None:
        save_mesh(folder.file("twin.glb"), twin)
    if best["checkpoint"] != CHECKPOINT:
        shutil.copyfile(folder.file(best["checkpoint"]), folder.file(CHECKPOINT))
    title, outcome = run.title or "Reconstruction", status(run, metrics)
    tables = finish(folder, metrics, title, outcome, parts, again="reconstruct", note=run.note)
    return tables, outcome


def _begun(problem: Problem, start: Scene) -> Display:
    """A display of a fit that has not begun: what was measured, and what the start has for it."""
    display, radars = display_of_problem(problem, start), problem.sights.values()
    spectra = {
        MEASURED: [s.capture.spectrum(s.grid).float() for s in radars],
        SIMULATED: sharp_maps(problem, start, [s.radar for s in radars]),
    }
    return replace(display, maps=maps_of_sensors(problem, spectra))


def _show(live: Viewer, problem: Problem, going: Fit, step: Step) -> None:
    """Show a step of a fit with what its sensors would see."""
    with torch.no_grad():
        simulated = sharp_maps(problem, *going.applied())
    live.add_step(step, maps_of_sensors(problem, {SIMULATED: simulated}, _VALUES_OF_STEPS))


def _fit_one(run: RunFile, mode: str, number: int, folder: RunFolder) -> None:
    """What a worker does of a run: one fit, which leaves its files in the folder."""
    problem, _ = calibrated(_recorded(stated(run)), folder, QUIET)
    problem, _ = guessed(problem, QUIET)
    start, own = starts_of(problem)[number], recorded_for(problem, number, QUIET)
    fit(own, start, number, mode, folder, QUIET, None)


@lru_cache(maxsize=1)
def _recorded(text: str) -> Problem:
    """A worker simulates the data of a run once for all its fits."""
    return problem_of(validate(tomllib.loads(text), Path("run.toml")), QUIET)


def _finite(loss: float | None) -> float:
    """The loss as a rank: one that is not a number comes last."""
    return loss if loss is not None and math.isfinite(loss) else math.inf
