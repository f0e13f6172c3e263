"""Fits to received levels: transmitters and materials."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import torch
from matplotlib.figure import Figure
from rich.console import Console
from torch import Tensor

from invertwin import plotting
from invertwin.channel import trace_paths
from invertwin.cli.fits import problem as problems
from invertwin.cli.fits.problem import DataKind, Fits, Problem, Row, SensorData, Start, Summary
from invertwin.cli.fits.scores import error_bar_table, score_fit
from invertwin.cli.fits.writing import describe_outcome, parameter_values
from invertwin.cli.report import ReportTable, format_place, quantity_table, save_picture
from invertwin.cli.run_file import prefix_errors, require_section
from invertwin.cli.schema import RunFile
from invertwin.cli.schema.radio_tables import ReceivedData, ReceivedFile
from invertwin.cli.schema.shape_tables import module_values
from invertwin.errors import InputError
from invertwin.forward_model import ForwardModel
from invertwin.inversion import Reconstruction, Unknown
from invertwin.inversion.confidence.ambiguities import REJECTION_ZSCORE, difference_score
from invertwin.links import MapPlane, ReceiverPoints, Transmitters
from invertwin.models.radio import RadioMap
from invertwin.refusals import refusal
from invertwin.scene import Scene
from invertwin.seeds import derive_seed
from invertwin.storage.run_folder import RunFolder

_POSED = ("translation", "pose", "scale", "body", "vertices", "mover")  # kinds of parameters
_FEW_ENDS = 2  # of other starts: fewer say nothing about how ends scatter


class ReceivedLevels(DataKind):
    """Levels that receivers at known positions get of transmitters."""

    title: ClassVar[str] = "Received levels"
    histories: ClassVar[tuple[str, ...]] = ("curve", "checkpoint", "screened")
    unused = ("radar", "grid", "chirps", "calibration", "landscape", "model", "placement")

    def read_problem(self, run: RunFile, scene: Scene, truth: Scene, console: Console) -> Problem:
        """See ``DataKind.read_problem``; ``reference`` holds the true transmitters, where known."""
        problems.require_sections(self, run, "[map]")
        with prefix_errors("transmitter"):
            sensor = require_section(run, "transmitter", "[map]").build()
        data = require_section(run, "data", "reconstruct")
        moved = (parameter.object for parameter in run.parameters if parameter.kind in _POSED)
        target = run.starts.object if run.starts else next(moved, None)
        if isinstance(data, ReceivedFile):
            with prefix_errors("data"):
                points, levels = data.read()
            if len(levels) != len(sensor.positions):
                raise refusal("received_levels.columns", len(sensor.positions), len(levels))
            item = SensorData((levels, points), sensor)
            return Problem(run, scene, truth, frozenset(run.truth), {"": item}, target, self)
        if not isinstance(data, ReceivedData):
            raise refusal("received_levels.other_data", data.kind)
        with prefix_errors("data"):
            real = sensor if data.positions is None else _with_positions(sensor, data.positions)
        console.print("simulating the levels of the true scene")
        model, seed = radio_map(run, None), run.seed if data.seed is None else data.seed
        given = {name: getattr(data, name) for name in ("bandwidth", "depth", "edges", "rays")}
        richer = {name: value for name, value in given.items() if value is not None}
        with prefix_errors("data"), torch.no_grad():
            model = replace(model, propagation=replace(model.propagation, **richer))
            mean = model.predict(truth, real, derive_seed(seed, 0))
        draw = replace(model, scatter=data.noise).realisations_about(mean)
        item = SensorData((draw(derive_seed(seed, 1), 0.0), None), sensor)
        return Problem(run, scene, truth, frozenset(truth.names), {"": item}, target, self, real)

    def prepare(self, problem: Problem, folder: RunFolder, console: Console) -> Problem:
        """The problem with its first transmitter at the centroid of power, with ``[initial]``."""
        table = problem.run.initial
        if table is None:
            return problem
        with prefix_errors("initial"):
            if table.object is not None or problem.run.transmitter_starts is not None:
                raise refusal("received_levels.other_initial")
            box = table.build()
        item = problem.first_sensor
        position = _power_centroid(problem, (box.low, box.high))
        sensor = place_first(item.sensor, position)
        notes = {**problem.notes, "initial_position": position.tolist()}
        return replace(problem, sensor_data={"": replace(item, sensor=sensor)}, notes=notes)

    def models(self, problem: Problem) -> list[ForwardModel]:
        """See ``DataKind.models``."""
        return [radio_map(problem.run, problem.first_sensor.recording[1])]

    def recorded_values(self, item: SensorData) -> Tensor:
        """Measured levels [tx, point]."""
        return item.recording[0]

    def starts(self, problem: Problem) -> list[Start]:
        """Every scene of ``[starts]`` with every position of ``[transmitter_starts]``."""
        table, scenes = problem.run.transmitter_starts, super().starts(problem)
        if table is None:
            places = [problem.first_sensor.sensor.positions[0]]
        else:
            with prefix_errors("transmitter_starts"):
                places = [*table.sample_positions(problem.scene, problem.run.seed)]
        return [Start(begun.scene, place) for begun in scenes for place in places]

    def initial_sensor(self, item: SensorData, start: Start) -> Transmitters:
        """The transmitters, the first one where the fit starts."""
        place = start.transmitter
        return item.sensor if place is None else place_first(item.sensor, place)

    def make_unknown(self, problem: Problem, name: str, table: Any, start: Start) -> Unknown:
        """See ``DataKind.make_unknown``; a transmitter starts where its sensor has it."""
        if table.kind == "transmitter":
            return Unknown(partial(_build_position, table, name, problem.scene), table.rate)
        return super().make_unknown(problem, name, table, start)

    def score_fit(self, problem: Problem, start: Start, found: Reconstruction) -> Row:
        """Distances of the first transmitter, or of a fitted object, from the truth."""
        if not has_transmitter(problem.run):
            return score_fit(problem, start.scene, found.scene)
        assert start.transmitter is not None
        rows: Row = {"start_position": start.transmitter.tolist()}
        if problem.reference is None:
            return rows
        real = problem.reference.positions[0]
        place = found.sensors[0].positions[0].detach()
        rows |= {"start_error_m": float((start.transmitter - real).norm())}
        rows |= {"position_error_m": float((place - real).norm())}
        limit = problem.run.fit_settings.position_limit
        return {**rows, "success": rows["position_error_m"] <= limit}

    def revise_confidence(self, fits: Fits, believed: Row) -> Row:
        """Verdict and error bars; ends of other starts may speak against them."""
        others = _find_other_ends(fits)
        run, bars = fits.problem.run, believed.get("within_95", {})
        spread = spread_of_ends(run, fits.rows[problems.OWN_METHOD], fits.best, bars)
        alone = bool(spread) and not spread["ends_within_bars"]
        doubtful = (others or alone) and believed["verdict"] == "consistent"
        return {**believed, **others, **spread, **({"verdict": "ambiguous"} if doubtful else {})}

    def metrics(self, fits: Fits) -> Row:
        """See ``DataKind.metrics``."""
        best, rows = fits.best, fits.rows
        found: Row = {}
        materials = _true_materials(fits.problem)
        for method in fits.methods:
            tail = "" if method == problems.OWN_METHOD else f"_{method}"
            if "success" in best:
                found[f"successes{tail}"] = sum(row["success"] for row in rows[method])
                found[f"errors_m{tail}"] = [row["position_error_m"] for row in rows[method]]
            if materials:
                values = fits.best_of(method)["values"]
                errors = {name: abs(values[name] / real - 1) for name, real in materials.items()}
                found[f"relative_errors{tail}"] = errors
        if "success" in best:
            found |= {key: best[key] for key in ("position_error_m", "success")}
        if "start_error_m" in best:
            found["start_errors_m"] = [row["start_error_m"] for row in rows[problems.OWN_METHOD]]
        found |= {"true_values": materials} if materials else {}
        return found | _share_blocked_links(fits.problem, fits.found)

    def summary(self, fits: Fits, metrics: Row, folder: RunFolder) -> Summary:
        """See ``DataKind.summary``."""
        drawn = [save_picture(folder, "loss", plotting.convergence(fits.losses))]
        if has_transmitter(fits.problem.run):
            drawn.append(save_picture(folder, "plan", draw_plan(fits)))
        values = parameter_values(fits)
        for name, real in metrics.get("true_values", {}).items():
            values[name][2] = real
        tables = [error_bar_table(metrics, values)]
        if "errors_m" in metrics:
            tables.append(_method_table(fits, metrics))
        result = quantity_table("Result", metrics)
        outcome = describe_outcome(fits.problem.run, metrics, counted=True)
        return Summary(outcome, result, drawn, tables)


def radio_map(run: RunFile, points: ReceiverPoints | None) -> RadioMap:
    """The forward model of ``[map]``.

    Args:
        run: The run file of a method or a stage.
        points: Points instead of those of ``[map]``, where the data bring their own.
    """
    with prefix_errors("map"):
        found = require_section(run, "map", "received levels").build()
    return found if points is None else replace(found, places=points)


def require_drawn_places(model: RadioMap) -> MapPlane | ReceiverPoints:
    """Return the receivers of a map that is drawn.

    Args:
        model: The map.

    Raises:
        InputError: They are the triangles of a mesh.
    """
    if not isinstance(model.places, MapPlane | ReceiverPoints):
        raise InputError("map.places: expected points or a plane, got a mesh; choose one of these")
    return model.places


def has_transmitter(run: RunFile) -> bool:
    """Return True if a transmitter is fitted."""
    return any(table.kind == "transmitter" for table in run.parameters)


def _with_positions(sensor: Transmitters, positions: Sequence[Sequence[float]]) -> Transmitters:
    places = torch.tensor(positions, dtype=torch.float64)
    if places.shape != sensor.positions.shape:
        raise refusal("received_levels.places", len(sensor.positions), len(places), at="positions")
    return replace(sensor, positions=places)


def place_first(sensor: Transmitters, position: Tensor) -> Transmitters:
    """Return the transmitters with the first one elsewhere.

    Args:
        sensor: The transmitters.
        position: Of the first one [3] [m].
    """
    return replace(sensor, positions=torch.cat([position[None], sensor.positions[1:]]))


def _build_position(table: Any, name: str, scene: Scene, sensor: Transmitters) -> Any:
    with prefix_errors(f"parameters.{name}"):
        return table.build(None, initial=sensor.positions[0], scene=scene)


def _power_centroid(problem: Problem, box: Sequence[Tensor | None]) -> Tensor:
    """Centroid of the receivers, weighted by their power, within a box [3] [m].

    Source: Blumenthal and others, "Weighted centroid localization in Zigbee-based sensor
    networks", 2007.
    """
    levels, points = problem.first_sensor.recording
    points = points or radio_map(problem.run, None).places
    if not isinstance(points, ReceiverPoints):
        raise InputError("initial: expected receivers at points, got cells; remove it")
    weight = 10 ** (0.1 * (levels[0] - levels[0].max()))
    middle = (weight[:, None] * points.positions).sum(0) / weight.sum()
    return middle if box[0] is None else middle.clamp(*box)


def _find_other_ends(fits: Fits) -> Row:
    """Ends elsewhere that the data do not reject, beside the best one."""
    run = fits.problem.run
    if not has_transmitter(run):
        return {}
    limit, best = run.fit_settings.position_limit, fits.found
    kept, notes = [best.sensors[0].positions[0].detach()], []
    for row in sorted(fits.rows[problems.OWN_METHOD], key=problems.rank):
        if row["start"] == fits.best["start"]:
            continue
        end = fits.outcome(problems.OWN_METHOD, row["start"])
        place = end.sensors[0].positions[0].detach()
        if min(float((place - other).norm()) for other in kept) <= limit:
            continue
        kept.append(place)
        found = difference_score(best.result, end.result)
        if found is not None and found < REJECTION_ZSCORE:
            where = format_place(place.tolist())
            notes.append(f"a transmitter at {where} m fits the data equally well: z = {found:.1f}")
    return {"ambiguities": notes} if notes else {}


def spread_of_ends(run: RunFile, rows: Sequence[Row], best: Row, bars: Mapping[str, float]) -> Row:
    """Spread of the ends of other starts about the best one, within the limit of positions.

    Error bars hold noise about one minimum. Where no other start has ended in them, there are more.

    Args:
        run: The run file.
        rows: Rows of all starts.
        best: One of them.
        bars: Half widths that hold 95 % of errors, by parameter.
    """
    if not has_transmitter(run) or not bars:
        return {}
    key = "transmitter.position"
    apart = {
        row["start"]: [a - b for a, b in zip(row["values"][key], best["values"][key], strict=True)]
        for row in rows
        if row["start"] != best["start"] and row["status"] != "diverged"
    }
    limit = run.fit_settings.position_limit
    near = [off for off in apart.values() if math.hypot(*off) <= limit]
    if len(near) < _FEW_ENDS:
        return {}
    names = [f"transmitter.{axis}" for axis in "xyz"]
    widths = [bars.get(name, math.inf) for name in names]
    inside = [all(abs(x) <= w for x, w in zip(off, widths, strict=True)) for off in near]
    middle = sorted(math.hypot(*off) for off in near)[len(near) // 2]
    columns = zip(names, zip(*near, strict=True), strict=True)
    spread = {n: math.hypot(*off) / math.sqrt(len(near)) for n, off in columns if n in bars}
    found: Row = {"ends_near": len(near), "ends_within_bars": sum(inside), "spread_of_ends": spread}
    if not any(inside):
        found["spread_note"] = (
            f"{len(near)} other starts ended within {limit:g} m of the best, none within its error "
            f"bars, half of them more than {middle:.3f} m away: the bars hold noise about one "
            "minimum of several; take the spread of the ends instead"
        )
    return found


def _true_materials(problem: Problem) -> dict[str, float]:
    """True values of the materials that are fitted, where the run file knows them."""
    if problem.reference is None:
        return {}
    found: dict[str, float] = {}
    for table in problem.run.parameters:
        if table.kind == "material":
            module = table.build(module_values(table.object, problem.truth, problem.run.scene))
            found |= {n: float(v) for n, v in module.values().items() if v.numel() == 1}
    return found


def _share_blocked_links(problem: Problem, found: Reconstruction) -> Row:
    """The share of links whose line of sight is blocked, at the truth or else at the twin."""
    model = radio_map(problem.run, problem.first_sensor.recording[1])
    if not isinstance(model.places, ReceiverPoints):
        return {}
    sensor = problem.reference or found.sensors[0]
    scene = problem.truth if problem.reference else found.scene
    ends = sensor.positions.detach(), model.places.positions
    with torch.no_grad():
        count = len(trace_paths(scene, *ends, model.propagation.frequency, depth=0))
    return {"blocked_share": 1 - count / (len(ends[0]) * len(ends[1]))}


def draw_plan(fits: Fits) -> Figure:
    """Draw a plan with the starts and ends of the fits of the first transmitter.

    Args:
        fits: All fits of a run.
    """
    problem, place = fits.problem, fits.found.sensors[0].positions[:1].detach()
    real = problem.reference
    shown = {"found": place} if real is None else {"truth": real.positions[:1], "found": place}
    points = radio_map(problem.run, problem.first_sensor.recording[1]).places
    if isinstance(points, ReceiverPoints):
        shown["receivers"] = points.positions
    rows = fits.rows[problems.OWN_METHOD]
    ends = [[row["start_position"], row["values"]["transmitter.position"]] for row in rows]
    starts = torch.tensor(ends, dtype=torch.float64)
    return plotting.transmitter_fits(fits.found.scene, float(place[0, 2]), shown, starts)


def _method_table(fits: Fits, metrics: Row) -> ReportTable:
    cells = []
    for method in fits.methods:
        tail = "" if method == problems.OWN_METHOD else f"_{method}"
        errors = sorted(metrics[f"errors_m{tail}"])
        name = "full" if method == problems.OWN_METHOD else method.replace("_", " ")
        cells.append([name, metrics[f"successes{tail}"], errors[len(errors) // 2], errors[-1]])
    heads = ["fit", "successes", "median error [m]", "largest error [m]"]
    return ReportTable("Ways to fit", heads, cells)
