"""Placement of a transmitter: an aim of its map in place of data."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch
from rich.console import Console

from invertwin import plotting
from invertwin.cli.fits import problem as problems
from invertwin.cli.fits.problem import Fits, Problem, Row, SensorData, Start, Summary
from invertwin.cli.fits.received_levels import (
    ReceivedLevels,
    draw_plan,
    place_first,
    radio_map,
    require_drawn_places,
)
from invertwin.cli.fits.scores import error_bar_table
from invertwin.cli.fits.writing import parameter_values
from invertwin.cli.report import ReportTable, format_place, quantity_table, save_picture
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile
from invertwin.errors import InputError
from invertwin.inversion import Reconstruction
from invertwin.links import MapPlane, ReceiverPoints
from invertwin.refusals import refusal
from invertwin.scene import Scene
from invertwin.seeds import derive_seed
from invertwin.storage.run_folder import RunFolder

_CELLS = 1500  # of a drawn map


class TransmitterCoverage(ReceivedLevels):
    """An aim of the levels of receivers: their mean, their worst tenth, or the share covered."""

    title = "Placement of a transmitter"
    unused = (*ReceivedLevels.unused, "data", "initial", "loss", "measures", "search", "starts")

    def read_problem(self, run: RunFile, scene: Scene, truth: Scene, console: Console) -> Problem:
        """See ``DataKind.read_problem``; the fit starts at the best place of a few random ones."""
        problems.require_sections(self, run, "[aim]")
        model, aim = radio_map(run, None), require_section(run, "aim", "a placement")
        if not model.unit.startswith("dB"):
            raise refusal("transmitter_coverage.quantity", model.quantity)
        require_drawn_places(model)
        table = next((table for table in run.parameters if table.kind == "transmitter"), None)
        if table is None or len(run.parameters) > 1:
            kinds = ", ".join(table.kind for table in run.parameters)
            raise refusal("transmitter_coverage.other_parameters", kinds)
        with prefix_errors("transmitter"):
            sensor = require_section(run, "transmitter", "[aim]").build()
        places = sensor.positions[:1]
        if run.transmitter_starts is not None:
            with prefix_errors("transmitter_starts"):
                clear = max(run.transmitter_starts.clear, table.clear or 0.0)
                some = run.transmitter_starts.model_copy(update={"clear": clear})
                places = torch.cat([places, some.sample_positions(scene, run.seed)])
        numbers = range(1, len(places)) or range(1)
        with suppress(InputError):  # where the transmitter is may be too near to furniture
            table.build(None, initial=places[0], scene=scene)
            numbers = range(len(places))
        console.print(f"levels of {len(numbers)} places to start from")
        sensors = [place_first(sensor, place) for place in places]
        seed = derive_seed(derive_seed(run.seed, 0), 0)  # of the fit, so that gains are exact
        with torch.no_grad():
            levels = [model.predict(scene, sensor, seed) for sensor in sensors]
        tried = [float(aim.evaluate(one)) for one in levels]
        # Where none covers anyone, the one that comes nearest is the best.
        best = max(numbers, key=lambda k: (tried[k], -aim.loss(levels[k], levels[k])))
        items = {"": SensorData((levels[best], None), sensors[best])}
        return Problem(run, scene, truth, frozenset(), items, None, self, notes={"tried": tried})

    def starts(self, problem: Problem) -> list[Start]:
        """The best of the places that were compared."""
        return [Start(problem.scene, problem.first_sensor.sensor.positions[0])]

    def score_fit(self, problem: Problem, start: Start, found: Reconstruction) -> Row:
        """The aim at the start and at the end, without softness."""
        aim = require_section(problem.run, "aim", "a placement")
        with torch.no_grad():
            ((levels, begun),) = found.result.fit.maps(0)
        place = problem.first_sensor.sensor.positions[0].tolist()
        row = {"aim_before": float(aim.evaluate(begun)), "aim_after": float(aim.evaluate(levels))}
        return {"start_position": place, **row}

    def revise_confidence(self, fits: Fits, believed: Row) -> Row:
        """An aim has no noise: nothing to compare the map with, and no error bars."""
        (module,) = fits.found.parameters
        names = getattr(module, "at_bounds", list)()
        bounds = [f"{name} is at the end of its range" for name in names]
        none = "An aim has no noise: there are no error bars."
        word = "at a bound" if bounds else "unknown"
        return {"verdict": word, "verdict_reasons": bounds, "no_error_bars": none}

    def metrics(self, fits: Fits) -> Row:
        """See ``DataKind.metrics``."""
        ends = {key: fits.best[key] for key in ("aim_before", "aim_after")}
        return {**ends, "answer": _describe(fits)}

    def summary(self, fits: Fits, metrics: Row, folder: RunFolder) -> Summary:
        """See ``DataKind.summary``."""
        drawn = [save_picture(folder, "plan", draw_plan(fits))]
        drawn.append(save_picture(folder, "coverage", _draw_coverage(fits)))
        drawn.append(save_picture(folder, "loss", plotting.convergence(fits.losses)))
        run = fits.problem.run
        label = require_section(run, "aim", "a placement").label(radio_map(run, None).unit)
        cells = [[label, metrics["tried"][0], metrics["aim_before"], metrics["aim_after"]]]
        reached = ReportTable("Aim", ["aim", "given place", "start", "placed"], cells)
        tables = [reached, error_bar_table(metrics, parameter_values(fits))]
        table = quantity_table("Result", metrics, skip=("loss",))  # of smooth steps
        return Summary(f"{metrics['answer']}.", table, drawn, tables)


def _describe(fits: Fits) -> str:
    """State the place of the transmitter and its gain, in the units of the run file."""
    run, (given, *tried) = fits.problem.run, fits.problem.notes["tried"]
    aim, unit = require_section(run, "aim", "a placement"), radio_map(run, None).unit
    others = {f"the best of {len(tried)} random places": max(tried)} if tried else {}
    others, after = {**others, "the given place": given}, fits.best["aim_after"]
    if aim.measure == "coverage":
        what = f"{aim.label(unit)} {100 * after:.0f} %"
        gains = [f"{100 * (after - own):+.0f} points over {name}" for name, own in others.items()]
    else:
        what = f"{aim.measure.replace('_', ' ')} {after:.1f} {unit}"
        gains = [f"{after - own:+.1f} dB over {name}" for name, own in others.items()]
    place = format_place(fits.found.sensors[0].positions[0].tolist())
    return f"Transmitter at ({place}) m: {what}, {' and '.join(gains)}"


def _draw_coverage(fits: Fits) -> Any:
    """Draw the map among the receivers, of the given place and of the fitted one."""
    model, scene, found = radio_map(fits.problem.run, None), fits.found.scene, fits.found.sensors[0]
    at = require_drawn_places(model)
    if isinstance(at, ReceiverPoints):
        low, high = at.positions.amin(0), at.positions.amax(0)
        side = float((high - low)[:2].prod() / _CELLS) ** 0.5
        at = MapPlane.horizontal(low[:2], high[:2], float((low + high)[2] / 2), side)
        model = replace(model, places=ReceiverPoints(at.centres.reshape(-1, 3)))
    given = require_section(fits.problem.run, "transmitter", "[aim]").build()
    ends = {"given place": given, "placed": found}
    with torch.no_grad():
        maps = {
            title: model.predict(scene, sensor, fits.problem.run.seed).amax(0).view(at.shape)
            for title, sensor in ends.items()
        }
    label = f"{model.quantity.replace('_', ' ')} [{model.unit}]"
    return plotting.coverage(maps, at, scene=scene, transmitters=ends, label=label)
