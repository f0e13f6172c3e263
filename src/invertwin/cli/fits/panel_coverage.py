"""Fits of a metasurface: its position, beam and phases, for the worst receivers of a room."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from invertwin import plotting
from invertwin.cli.fits import problem as problems
from invertwin.cli.fits.problem import DataKind, Fits, Problem, Row, SensorData, Start, Summary
from invertwin.cli.fits.scores import drop_histories, error_bar_table
from invertwin.cli.report import ReportTable, load_texts, save_picture
from invertwin.cli.run_file import require_section
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.placement import Placement, Trial
from invertwin.forward_model import ForwardModel
from invertwin.inversion import Reconstruction, Unknown
from invertwin.inversion.initialisation.multi_start import Candidate
from invertwin.links import ElementPhases, MapPlane, Metasurface, PanelPlacement
from invertwin.links.metasurface.coverage import Coverage
from invertwin.models.radio import CoverageMap
from invertwin.scene import Scene
from invertwin.storage.run_folder import RunFolder

EXHAUSTIVE = "exhaustive"
"""Variant whose search tries a grid; other fits are compared with it."""
_DERIVATIVE = 2  # evaluations that a derivative counts for, beside the one of its value
_AS_GOOD = 0.95
_CELLS = 2500  # of a drawn map
_FLOOR = 1e-16


class PanelCoverage(DataKind):
    """An aim instead of data: the path loss that the worst share of receivers exceeds."""

    title: ClassVar[str] = "Placement of a metasurface"
    unused = ("radar", "grid", "chirps", "data", "calibration", "landscape", "measures", "model")
    unused += ("starts", "map", "initial", "aim")

    def read_problem(self, run: RunFile, scene: Scene, truth: Scene, console: Console) -> Problem:
        """See ``DataKind.read_problem``; ``reference`` holds the receivers that score the panel."""
        problems.require_sections(self, run, "[placement]")
        table = require_section(run, "placement", "reconstruct")
        item = SensorData(table.coverage(scene, run.seed), table.metasurface())
        scored = table.coverage(scene, run.seed, scored=True)
        return Problem(run, scene, truth, frozenset(), {"": item}, None, self, scored)

    def recorded_values(self, item: SensorData) -> Tensor:
        """The path loss without a panel [dB]."""
        return -item.recording.worst(item.recording.direct).reshape(1, 1)

    def models(self, problem: Problem) -> list[ForwardModel]:
        """See ``DataKind.models``."""
        table, settings = _table(problem), problem.run.fit_settings
        blur, soft = table.edge_width, table.softness
        batch = table.receivers.batch
        return [CoverageMap(problem.first_sensor.recording, batch, blur, soft, settings.boundary)]

    def starts(self, problem: Problem) -> list[Start]:
        """As many as the run file says; they differ by the random numbers of ``[search]``."""
        return [Start(problem.scene)] * _table(problem).starts

    def make_unknown(self, problem: Problem, name: str, table: Any, start: Start) -> Unknown:
        """The position and beam of the panel, or the phases of its elements."""
        own = _table(problem)
        if table.kind == "panel_phases":
            return Unknown(ElementPhases(own.panel.counts), table.rate)
        if table.kind == "panel":
            return _start_panel(problem, table, own.initial)
        return super().make_unknown(problem, name, table, start)

    def make_candidates(
        self, problem: Problem, start: Start, generator: torch.Generator
    ) -> Sequence[Candidate]:
        """Placements that ``[search]`` compares."""
        named = build.tables_by_name(problem.run.parameters)
        name = next(n for n, table in named.items() if table.kind == "panel")
        (observation,) = problems.make_observations(problem, start)
        assert isinstance(observation.parameters, dict)
        found = []
        for trial in _search(problem).trials(_table(problem), generator):
            own = {**observation.parameters, name: _start_panel(problem, named[name], trial)}
            group = _table(problem).sector(trial)
            found.append(Candidate(start.scene, [replace(observation, parameters=own)], group))
        return found

    def score_fit(self, problem: Problem, start: Start, found: Reconstruction) -> Row:
        """Levels of the worst receivers, of those that the fit sees and of the others [dB]."""
        panel, batch = found.sensors[0], _table(problem).receivers.batch
        seen = problem.first_sensor.recording.part(slice(0, batch))
        module = next(m for m in found.parameters if isinstance(m, PanelPlacement))
        steps = [own.fit_settings.steps for _, own in problems.stage_runs(problem.run)]
        search, tried = problem.run.search, 0
        if search is not None:
            tried = len(search.trials(_table(problem), torch.Generator()))
            count = min(search.fits, tried)
            # Trials in the first stage, and the best of them in all.
            steps = [count * steps[0], *steps] if search.shortlist else [count * sum(steps)]
        with torch.no_grad():
            return {
                "level_db": float(seen.aim(panel)),
                "scored_db": float(problem.reference.aim(panel)),
                "along_m": float(module.along),
                "yaw_deg": math.degrees(float(module.yaw)),
                "evaluations": tried + (1 + _DERIVATIVE) * sum(steps),
            }

    def metrics(self, fits: Fits) -> Row:
        """See ``DataKind.metrics``."""
        scored, best = fits.problem.reference, fits.best
        before = float(scored.worst(scored.direct))
        found: Row = {
            "evaluations": fits.rows[problems.OWN_METHOD][0]["evaluations"],
            "worst_before_db": before,
            "worst_after_db": best["scored_db"],
            "gain_db": best["scored_db"] - before,
        }
        if EXHAUSTIVE not in fits.rows:
            return found
        grid = fits.best_of(EXHAUSTIVE)
        found |= {"worst_exhaustive_db": grid["scored_db"]}
        found["evaluations_exhaustive"] = len(grid.get("screened", ()))
        rows = [dict(row) for row in drop_histories(fits.rows[problems.OWN_METHOD])]
        for method, name in ((problems.OWN_METHOD, "found"), (problems.INTERIOR_ONLY, "interior")):
            if method not in fits.rows:
                continue
            ratios = [10 ** ((r["scored_db"] - grid["scored_db"]) / 10) for r in fits.rows[method]]
            for row, ratio in zip(rows, ratios, strict=False):
                row[f"{name}_over_exhaustive"] = ratio
            found[f"{name}_over_exhaustive"] = statistics.median(ratios)
            tail = "" if method == problems.OWN_METHOD else "_interior"
            found[f"successes{tail}"] = sum(ratio >= _AS_GOOD for ratio in ratios)
        return found | {"starts": rows}

    def summary(self, fits: Fits, metrics: Row, folder: RunFolder) -> Summary:
        """See ``DataKind.summary``."""
        problem, notes = fits.problem, load_texts("notes")
        drawn = [save_picture(folder, "loss", plotting.convergence(fits.losses))]
        if EXHAUSTIVE in fits.rows:
            drawn.append(save_picture(folder, "landscape", _landscape(fits), note="placement"))
        figure = _coverage(problem, fits.found.sensors[0])
        drawn.append(save_picture(folder, "coverage", figure, note="placement_coverage"))
        keys = ("start", "level_db", "found_over_exhaustive", "interior_over_exhaustive")
        heads = ("start", "worst receivers [dB]", "found / exhaustive", "interior only")
        cells = [[row.get(key) for key in keys] for row in metrics["starts"]]
        result = ReportTable("Starts", heads, cells, notes["placement_starts"])
        share, count = _table(problem).share, len(cells)
        outcome = f"the worst {share:.0%} of receivers gain {metrics['gain_db']:.1f} dB"
        if "successes" in metrics:
            reached = f"{metrics['successes']} of {count} starts reach {_AS_GOOD:g} of the best of"
            outcome = f"{reached} the grid; {outcome}"
        return Summary(outcome, result, drawn, [error_bar_table(metrics)])


def _table(problem: Problem) -> Placement:
    return require_section(problem.run, "placement", "a metasurface")


def _search(problem: Problem) -> Any:
    return require_section(problem.run, "search", "placements to compare")


def _start_panel(problem: Problem, table: Any, trial: Trial) -> Unknown:
    """The module of a panel that starts at a trial."""
    make = partial(_table(problem).place, problem.first_sensor.recording, trial)
    return Unknown(lambda _: make(), table.rate)


def _landscape(fits: Fits) -> Any:
    """The level of the best trial of the grid at each position, and where fits have ended."""
    problem = fits.problem.kind.with_method(fits.problem, EXHAUSTIVE)
    table, search = _table(problem), _search(problem)
    trials = search.trials(table, torch.Generator())
    losses = torch.tensor(fits.best_of(EXHAUSTIVE)["screened"], dtype=torch.float64)
    before = problem.kind.recorded_values(problem.first_sensor)[0]
    levels = (-losses * before).view(search.places, -1).amax(1)
    along = torch.tensor([trial[0] for trial in trials], dtype=torch.float64)
    length = table.path().length
    ends = [[row["along_m"] % length, row["level_db"]] for row in fits.rows[problems.OWN_METHOD]]
    places = along.view(search.places, -1)[:, 0]
    return plotting.placements(places, levels, torch.tensor(ends, dtype=torch.float64))


def _coverage(problem: Problem, panel: Metasurface) -> Any:
    """Path gain over the floor plan, without the panel and with it."""
    table, seen = _table(problem), problem.first_sensor.recording
    box = table.receivers
    height = 0.5 * (box.low[2] + box.high[2])
    side = (math.prod(np.subtract(box.high, box.low)[:2]) / _CELLS) ** 0.5
    plane = MapPlane.horizontal(box.low[:2], box.high[:2], height, side)
    points = plane.centres.reshape(-1, 3)
    how = {"depth": table.depth, "edges": table.edges, "seed": problem.run.seed}
    with torch.no_grad():
        aim = Coverage.of(seen.scene, seen.tx, points, table.frequency, **how)
        maps = {"without": aim.direct, "with the panel": aim.gain(panel)}
    shown = {n: 10 * g.clamp_min(_FLOOR).log10().view(plane.shape) for n, g in maps.items()}
    return plotting.floor_plan(shown, plane, seen.scene, seen.tx, panel.position)
