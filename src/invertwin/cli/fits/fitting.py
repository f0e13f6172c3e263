"""The fits of a run: every start of every method, progress, checkpoints, interruptions."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from invertwin import discovery, inversion
from invertwin.capture import Capture, calibrate
from invertwin.cli.fits import problem as problems
from invertwin.cli.fits.displays import StepRecorder, steps_path
from invertwin.cli.fits.problem import Fits, Problem, Row, Start
from invertwin.cli.fits.shape_scores import CURVE_KEY, make_shape_metric
from invertwin.cli.fits.spreading import fit_file_stem
from invertwin.cli.report import format_place
from invertwin.cli.schema import build
from invertwin.discovery.imaging.point_detections import find_image_peak
from invertwin.errors import InputError
from invertwin.inversion.callbacks import stage_checkpoint_path
from invertwin.inversion.fit import Fit, parameter_values
from invertwin.models.radar import SurrogateMap
from invertwin.radar.parameters import ClockOffset, RangeBias
from invertwin.refusals import refusal
from invertwin.scene import Scene, signed_distance
from invertwin.scene.scene import displace
from invertwin.seeds import derive_seed
from invertwin.storage.folders import PARTS
from invertwin.storage.run_folder import RunFolder
from invertwin.viewer import DisplayStep

_MIN_RELATIVE_PEAK = 0.1  # of the echo where a fit ends: a weaker one was not meant

Show = Callable[[Problem, Fit, DisplayStep], None]
"""Observer of the steps of a fit."""


def fit_all(
    problem: Problem, folder: RunFolder, console: Console, show: Show | None = None
) -> Fits:
    """Fit from every start in every method; fits that are in the folder are not made again.

    Args:
        problem: Problem of the run.
        folder: Keeps results and checkpoints.
        console: Shows progress.
        show: Observer of the steps.
    """
    rows: dict[str, list[Row]] = {method: [] for method in problem.methods}
    outcomes: dict[tuple[str, int], Callable[[], inversion.Reconstruction]] = {}
    for method, number in problem.work:
        own = problem.kind.with_recording_of_start(problem, number, console)
        observer = None if show is None else partial(show, own)
        start = problem.starts(method)[number]
        row, outcome = run_fit(own, start, number, method, folder, console, observer)
        rows[method].append(row)
        if method not in problem.run.variants:
            outcomes[method, number] = outcome
    best = min(rows[problems.OWN_METHOD], key=problems.rank)
    number = best["start"]
    own = problem.kind.with_recording_of_start(problem, number, console)
    own = problem.kind.with_method(own, problems.OWN_METHOD)
    start, found = problem.starts()[number], outcomes[problems.OWN_METHOD, number]()
    fits = Fits(own, rows, lambda method, k: outcomes[method, k](), best, start, found)
    return _fit_from_image(_fit_among_clutter(fits, folder, console), folder, console)


def _fit_from_image(fits: Fits, folder: RunFolder, console: Console) -> Fits:
    """Make the best fit again from the image, without blur, if it has left the echo there."""
    problem, number, start = fits.problem, fits.best["start"], fits.start
    name, capture = problem.scored_object or "", problem.first_sensor.recording
    moved = {p.object for p in problem.run.parameters if p.kind in ("translation", "pose")}
    alone = len(problem.sensor_data) == 1 and isinstance(capture, Capture)
    if not alone or name not in moved or fits.found.verdict.is_consistent:
        return fits
    peak, left = _find_abandoned_echo(fits, name, capture), fits.found.scene[name].center.detach()
    if peak is None:
        return fits
    begun = displace(start.scene[name], peak - start.scene[name].center)
    start = replace(start, scene=start.scene.replace(name, pose=begun.transform))
    row, outcome = run_fit(problem, start, number, problems.FROM_IMAGE, folder, console)
    ends = " for ".join(f"({format_place(place.tolist())}) m" for place in (peak, left))
    doubt = f"with blurred kernels the fit left the echo of the image at {ends}"
    found = replace(outcome(), doubts=(doubt,))
    rows = {**fits.rows, problems.FROM_IMAGE: [row]}
    problem = replace(problem, notes={**problem.notes, "image_peak_m": peak.tolist()})
    return replace(fits, problem=problem, rows=rows, best=row, found=found)


def _find_abandoned_echo(fits: Fits, name: str, capture: Capture) -> torch.Tensor | None:
    """Find the brightest echo about the starts if the best fit does not explain it.

    The disc has the radius of the starts and of the blur. Where neither it nor the end of the fit
    has an echo, it is as wide as the fit has moved.
    """
    problem, item = fits.problem, fits.found.scene[name]
    model, end = problem.kind.models(problem)[0], item.center.detach()
    if not isinstance(model, SurrogateMap):
        return None
    starts = torch.stack([start.scene[name].center.detach() for start in problem.starts()])
    cell, center = capture.radar().waveform.range_resolution, starts.mean(0)
    radius = float((starts - center).norm(dim=1).max()) + cell * max(1.0, model.kernels.range_width)
    near = find_image_peak(capture, center, radius)
    there = find_image_peak(capture, end, 2 * cell)
    if near is None and there is None:
        near = find_image_peak(capture, center, radius + float((end - center).norm()))
    if near is None or (there is not None and near[1] < _MIN_RELATIVE_PEAK * there[1]):
        return None
    gap = signed_distance(item.world_mesh, near[0][None])
    return near[0] if float(gap) > cell else None


def _fit_among_clutter(fits: Fits, folder: RunFolder, console: Console) -> Fits:
    """Make the best fit again among clutter if the data call for it, and keep the better one."""
    problem, number = fits.problem, fits.best["start"]
    wanted = problem.run.fit_settings.clutter
    if wanted == "never" or not problem.kind.allows_clutter(problem):
        return fits
    if wanted == "auto":
        fits = _fit_materials(fits, folder, console)
        if not discovery.needs_clutter(fits.found):
            return fits
    try:
        row, outcome = run_fit(problem, fits.start, number, problems.AMONG_CLUTTER, folder, console)
    except InputError as error:
        if wanted == "always":
            raise
        notes = {**problem.notes, "clutter": {"kept": False, "refused": str(error)}}
        return replace(fits, problem=replace(problem, notes=notes))
    among = outcome()
    kept = wanted == "always" or discovery.choose_result(fits.found, among) is among
    observation = problems.make_observations(problem, fits.start)[0]
    moved = [n for n in dict.fromkeys(problem.run.fitted_objects) if n in among.scene.names]
    clutter = discovery.estimate_clutter(among.scene, observation, moved, seed=problem.run.seed)
    share = float(clutter.echoes.sum() / observation.observed_map().sum())
    summary = {"kept": kept, "share": share, "strongest_m": clutter.strongest_position.tolist()}
    rows = {**fits.rows, problems.AMONG_CLUTTER: [row]}
    problem = replace(problem, notes={**problem.notes, "clutter": summary})
    fits = replace(fits, problem=problem, rows=rows)
    return replace(fits, best=row, found=among) if kept else fits


def _fit_materials(fits: Fits, folder: RunFolder, console: Console) -> Fits:
    """Make the best fit again with free permittivities if the data contradict it or these.

    If the data contradict that fit as well, make it with free lobes, too.
    """
    if not discovery.needs_permittivities(fits.found):
        return fits
    given = fits.problem, fits.start, fits.best["start"]
    for method, lobes in ((problems.WITH_PERMITTIVITIES, False), (problems.WITH_LOBES, True)):
        try:
            row, outcome = run_fit(*given, method, folder, console)
        except InputError:  # the data do not determine material values
            break
        fits, found = replace(fits, rows={**fits.rows, method: [row]}), outcome()
        with suppress(InputError):  # error bars may not be available
            determined = not lobes or discovery.finds_lobes(found, fits.start.scene)
            if determined and not discovery.needs_clutter(found):
                return replace(fits, best=row, found=found)
    return fits


def run_fit(
    problem: Problem,
    start: Start,
    index: int,
    method: str,
    folder: RunFolder,
    console: Console,
    show: Callable[[Fit, DisplayStep], None] | None = None,
) -> tuple[Row, Callable[[], inversion.Reconstruction]]:
    """Make one fit, or read what an interrupted run has kept of it.

    Args:
        problem: Problem of the run.
        start: Initial values.
        index: Number of the start.
        method: The run's own way to fit, a variant, or one of the data.
        folder: Keeps results and checkpoints.
        console: Shows progress.
        show: Observer of the steps.

    Returns:
        The row of the fit, and a function that gives its outcome.
    """
    part = fit_file_stem(method, index)
    # Among the parts: a later fit's outcome does not take its place.
    checkpoint = f"{part}.pt"
    own = problem.kind.with_method(problem, method)
    stages = problems.make_schedule(own)
    again = partial(_fit_or_search, own, stages, start, index, folder, checkpoint, show, method)
    row = folder.read_json(f"{part}.json")
    if row is not None:
        # The checkpoints say what the fit found; nothing is fitted again.
        return row, lambda: again()[0]
    begin = time.perf_counter()
    way = "" if method == problems.OWN_METHOD else f", {method.replace('_', ' ')}"
    steps = sum(stage.steps for stage in stages) * (4 if method == problems.AMONG_CLUTTER else 1)
    with inversion.report_progress(f"start {index + 1}{way}", steps, console) as shown:
        found, found_ends = again(shown)
    curve = [[row["step"] + 1, row[CURVE_KEY]] for row in found.history if CURVE_KEY in row]
    row = {
        "start": index,
        "loss": found.loss,
        "status": found.status,
        "lost": found.is_uninformative,
        "steps": found.steps,
        "seconds": time.perf_counter() - begin,
        "values": parameter_values(found.parameters),
        "checkpoint": found_ends.pop("checkpoint", checkpoint),
        **found_ends,
        **own.kind.score_fit(own, start, found),
        "losses": [step["loss"] for step in found.history],
        "curve": curve,
    }
    folder.write_json(f"{part}.json", row)
    # The twins of many recordings are read again, not kept.
    anew = getattr(own.run.data, "every_start", False)
    return row, (lambda: again()[0]) if anew else lambda: found


def _fit_or_search(
    problem: Problem,
    stages: Sequence[inversion.Stage],
    start: Start,
    index: int,
    folder: RunFolder,
    checkpoint: str,
    show: Callable[[Fit, DisplayStep], None] | None,
    method: str,
    shown: Sequence[inversion.Report] = (),
) -> tuple[inversion.Reconstruction, Row]:
    """Fit, or search about the start; return what the row says of the search, too."""
    run, watch = problem.run, make_shape_metric(problem)
    every = run.measures.every if run.measures else 1

    def callbacks(file: str) -> list[inversion.Callback]:
        for k in range(len(stages) - 1):
            folder.file(str(stage_checkpoint_path(Path(file), k)))
        watching = [] if watch is None else [inversion.Watch(watch, every)]
        kept = StepRecorder(
            folder.file(steps_path(file)),
            [name for name in dict.fromkeys(run.fitted_objects) if name in start.scene.names],
            sum(stage.steps for stage in stages),
            run.fit_settings.checkpoint_every,
            show if shown else None,
        )
        return [*watching, *shown, _make_checkpoint(problem, folder, file), kept]

    observations = problems.make_observations(problem, start)
    given = start.scene, observations, problems.make_unknowns(problem, start)
    seed = derive_seed(run.seed, index)
    how: dict[str, Any] = {"loss": build.build_loss(run), "schedule": stages, "seed": seed}
    how["optimizer"] = build.build_section(run, "optimizer")
    if method == problems.FROM_IMAGE:
        # Kernels without blur reach far, too: all steps together move a tenth of a cell.
        rate = 0.1 * problem.first_sensor.sensor.waveform.range_resolution / stages[0].steps
        slow = replace(how["optimizer"], rate=rate, final_rate=None)
        sharp = [replace(o, model=o.model.scale_blur(0.0)) for o in observations]
        unknowns = {name: replace(unknown, rate=None) for name, unknown in given[2].items()}
        how["schedule"] = replace(stages[0], models=(), optimizer=slow)
        how["callbacks"] = callbacks(checkpoint)
        return inversion.reconstruct(start.scene, sharp, unknowns, **how), {}
    if method in (problems.WITH_PERMITTIVITIES, problems.WITH_LOBES):
        how |= {"callbacks": callbacks(checkpoint), "lobes": method == problems.WITH_LOBES}
        return discovery.reconstruct_with_permittivities(*given, **how), {}
    if method == problems.AMONG_CLUTTER:
        # Every frame has clutter of its own.
        how["schedule"] = [replace(stage, frames_per_step=None) for stage in stages]
        part = f"{PARTS}/{Path(checkpoint).stem}_round"
        how["callbacks"] = lambda n: callbacks(f"{part}{n}.pt")
        found = discovery.reconstruct_among_clutter(*given, **how)
        last = f"{part}{1 if len(found.parameters) == len(given[2]) else 3}.pt"
        return found, {"checkpoint": last}
    if run.search is None:
        return inversion.reconstruct(*given, callbacks=callbacks(checkpoint), **how), {}
    part = f"{PARTS}/{Path(checkpoint).stem}_fit"
    starts = problem.kind.make_candidates(problem, start, torch.Generator().manual_seed(seed))
    screened = inversion.Screening(starts, run.search.fits, run.search.shortlist)
    ends = inversion.search(*given, screened, callbacks=lambda n: callbacks(f"{part}{n}.pt"), **how)
    return ends.best, {"checkpoint": f"{part}{ends.best_number}.pt", **ends.to_metrics()}


def _make_checkpoint(problem: Problem, folder: RunFolder, name: str) -> inversion.Checkpoint:
    """Goes on from its own unfinished part; open_run has settled what may be there."""
    every = problem.run.fit_settings.checkpoint_every
    return inversion.Checkpoint(folder.file(name), every, resume=True)


def calibrate_problem(problem: Problem, folder: RunFolder, console: Console) -> Problem:
    """The problem with range bias and clock offset found on an object whose position is known.

    Args:
        problem: Problem of one radar.
        folder: Keeps the checkpoint.
        console: Shows progress.

    Raises:
        InputError: Several sensors.
    """
    run, table = problem.run, problem.run.calibration
    if table is None:
        return problem
    if len(problem.sensor_data) > 1:
        raise refusal("fitting.several_sensors")
    item, target = problem.first_sensor, problem.truth[table.object]
    capture, row = item.recording, {}
    if table.method == "backprojection":
        capture = calibrate(capture, target.center)
    else:
        bias, clock = RangeBias(), ClockOffset(capture.positions)
        own = replace(problem, run=run.apply_overrides(table))
        schedule, (model,) = own.run.fit_settings.build(), own.kind.models(own)
        with inversion.report_progress("calibration", schedule.steps, console) as shown:
            kept = _make_checkpoint(problem, folder, f"{PARTS}/calibration.pt")
            found = inversion.reconstruct(
                Scene({table.object: target}),
                inversion.Observation(model, capture, sensor=item.sensor, parameters=[bias, clock]),
                [],
                loss=build.build_loss(run),
                optimizer=build.build_section(own.run, "optimizer"),
                schedule=schedule,
                callbacks=[*shown, kept],
                seed=run.seed,
            )
        offset = capture.clock_offset + float(clock.shift.detach())
        capture = capture.recalibrate(offset, capture.range_bias + float(bias.bias.detach()))
        row = {"loss": found.loss, "status": found.status}
    row |= {"clock_offset_s": capture.clock_offset, "range_bias_m": capture.range_bias}
    item = replace(item, recording=capture, sensor=capture.radar())
    data, notes = dict.fromkeys(problem.sensor_data, item), {**problem.notes, "calibration": row}
    return replace(problem, sensor_data=data, notes=notes)
