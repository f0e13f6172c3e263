"""`invertwin reconstruct` with `[map]`: transmitters and materials from received levels."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from matplotlib.figure import Figure
from rich.console import Console
from torch import Tensor, nn

from invertwin import plotting
from invertwin.channel import trace_paths
from invertwin.cli.fits.problem import OWN_METHOD, method_run, require_settings, stage_runs
from invertwin.cli.fits.scores import error_bar_table
from invertwin.cli.fits.spreading import QUIET_CONSOLE, FitWorkers, distribute_fits, fit_file_stem
from invertwin.cli.report import ReportTable, load_texts, quantity_table, save_picture, write_report
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.radio_tables import ReceivedData, ReceivedFile
from invertwin.cli.schema.run_file import prefix_errors, require_section
from invertwin.cli.schema.shape_tables import module_values
from invertwin.cli.terminal import show_progress
from invertwin.errors import InputError
from invertwin.inversion import (
    Checkpoint,
    Observation,
    Reconstruction,
    Stage,
    Unknown,
    reconstruct,
    report_progress,
)
from invertwin.inversion.confidence.ambiguities import REJECTION_ZSCORE, difference_score
from invertwin.inversion.confidence.report import confidence_metrics
from invertwin.links import ReceiverPoints, Transmitters
from invertwin.models.radio import RadioMap
from invertwin.scene import Scene
from invertwin.seeds import derive_seed
from invertwin.storage.run_folder import RunFolder

_TRANSMITTER = "transmitter"  # kind of its parameter
_FEW_ENDS = 2  # of other starts: fewer say nothing about how ends scatter
_FOREIGN = (
    *("radar", "grid", "chirps", "starts", "search", "initial", "calibration", "landscape"),
    *("measures", "model"),
)


@dataclass(frozen=True)
class Heard:
    """What a fit needs, built from the run file.

    Attributes:
        run: The run file.
        scene: As known.
        truth: As it is, where the run file knows that.
        sensor: Transmitters as known.
        true_sensor: As they are; None where that is not known.
        levels: Measured [tx, place].
        places: In place of those of ``[map]``, where the data bring their own.
    """

    run: RunFile
    scene: Scene
    truth: Scene
    sensor: Transmitters
    true_sensor: Transmitters | None
    levels: Tensor
    places: ReceiverPoints | None

    def model(self, run: RunFile) -> RadioMap:
        """The forward model of a way to fit, or of a stage of one.

        Args:
            run: Its run file.
        """
        with prefix_errors("map"):
            found = require_section(run, "map", "received levels").build()
        return found if self.places is None else replace(found, places=self.places)


def run_radio(
    run: RunFile, folder: RunFolder, console: Console, workers: FitWorkers | None = None
) -> tuple[list[ReportTable], str]:
    """Fit from every start, write the folder; return the tables to print and the outcome.

    Starts that an interrupted run has finished are not fitted again.

    Args:
        run: The run file.
        folder: For the results.
        console: Shows progress.
        workers: Who fits; None = this process, one start after another.
    """
    begin = time.perf_counter()
    heard = _heard(run, console)
    starts = _starts(heard)
    modes = [OWN_METHOD, *run.variants]
    if workers is not None:
        fits = [(mode, number) for mode in modes for number in range(len(starts))]
        distribute_fits(_fit_one, run, folder, console, workers, fits)
    rows: dict[str, list[dict[str, Any]]] = {}
    again: list[Callable[[], Reconstruction]] = []
    for mode in modes:
        rows[mode] = []
        for number, start in enumerate(starts):
            row, outcome = _fitted(heard, start, number, mode, folder, console)
            rows[mode].append(row)
            again += [outcome] if mode == OWN_METHOD else []
    order = sorted(range(len(starts)), key=lambda k: _rank(rows[OWN_METHOD][k]))
    best, found = rows[OWN_METHOD][order[0]], again[order[0]]()
    with show_progress(console):
        believed = confidence_metrics(found, {})
        others = _others(heard, found, [(rows[OWN_METHOD][k], again[k]) for k in order[1:]])
    metrics: dict[str, Any] = {
        "task": run.task,
        "starts_count": len(starts),
        **_scores(heard, rows, modes, best),
        **believed,
        **others,
        **{key: best[key] for key in ("status", "steps", "loss", "start")},
        "parameters": best["values"],
        **_line_of_sight(heard, found),
        "starts": rows[OWN_METHOD],
        **{f"starts_{mode}": rows[mode] for mode in modes[1:]},
    }
    spread = spread_of_ends(heard, rows[OWN_METHOD], best, believed.get("within_95", {}))
    metrics |= spread
    alone = bool(spread) and not spread["ends_within_bars"]
    if (others or alone) and metrics["verdict"] == "consistent":
        metrics["verdict"] = "ambiguous"
    metrics["fit_seconds"] = sum(row["seconds"] for fits in rows.values() for row in fits)
    metrics["wall_seconds"] = time.perf_counter() - begin
    losses = {name: [row["losses"] for row in fits] for name, fits in rows.items()}
    drawn = [save_picture(folder, "loss", plotting.convergence(losses))]
    if _located(run):
        drawn.append(save_picture(folder, "plan", _plan(heard, rows[OWN_METHOD], found)))
    parts = [*_tables(heard, metrics, rows), *drawn]
    title, outcome = run.title or "Received levels", _outcome(run, metrics)
    return write_report(
        folder, metrics, title, outcome, parts, again="reconstruct", note=run.note
    ), (outcome)


def _fit_one(run: RunFile, mode: str, number: int, folder: RunFolder) -> None:
    """What a worker does of a run: one fit, which leaves its files in the folder."""
    heard = _heard(run, QUIET_CONSOLE)
    _fitted(heard, _starts(heard)[number], number, mode, folder, QUIET_CONSOLE)


def _heard(run: RunFile, console: Console) -> Heard:
    """The problem of a run file; simulated levels are simulated here."""
    require_settings(run)
    for name in _FOREIGN:
        if getattr(run, name):
            raise InputError(f"{name}: expected no such section with [map], got one; remove it")
    require_section(run, "parameters", "reconstruct")
    scene, truth = build.scene(run), build.true_scene(run)
    with prefix_errors("transmitter"):
        sensor = require_section(run, "transmitter", "[map]").build()
    data = require_section(run, "data", "reconstruct")
    if isinstance(data, ReceivedFile):
        with prefix_errors("data"):
            places, levels = data.read()
        if len(levels) != len(sensor.positions):
            raise InputError(
                f"data.file: expected a column of levels for each of {len(sensor.positions)} "
                f"transmitters, got {len(levels)}; see [transmitter]"
            )
        return Heard(run, scene, truth, sensor, None, levels, places)
    if not isinstance(data, ReceivedData):
        raise InputError(
            f"data.kind: expected received or received_file with [map], got {data.kind}; choose one"
        )
    with prefix_errors("data"):
        real = sensor if data.positions is None else _moved(sensor, data.positions)
    heard = Heard(run, scene, truth, sensor, real, torch.zeros(0), None)
    console.print("simulating the levels of the true scene")
    model, seed = heard.model(run), run.seed if data.seed is None else data.seed
    given = {name: getattr(data, name) for name in ("bandwidth", "depth", "edges", "rays")}
    richer = {name: value for name, value in given.items() if value is not None}
    with prefix_errors("data"), torch.no_grad():
        model = replace(model, propagation=replace(model.propagation, **richer))
        mean = model.predict(truth, real, derive_seed(seed, 0))
    look = replace(model, scatter=data.noise).realisations_about(mean)
    return replace(heard, levels=look(derive_seed(seed, 1), 0.0))


def _moved(sensor: Transmitters, positions: Sequence[Sequence[float]]) -> Transmitters:
    places = torch.tensor(positions, dtype=torch.float64)
    if places.shape != sensor.positions.shape:
        raise InputError(
            f"expected {len(sensor.positions)} positions, got {len(places)}; give one for each "
            "transmitter",
            "positions",
        )
    return replace(sensor, positions=places)


def _starts(heard: Heard) -> list[Tensor]:
    """Where the first transmitter is at the start of each fit."""
    table = heard.run.transmitter_starts
    if table is None:
        return [heard.sensor.positions[0]]
    with prefix_errors("transmitter_starts"):
        return [*table.sample_positions(heard.scene, heard.run.seed)]


def _stages(heard: Heard, run: RunFile) -> list[Stage]:
    names = build.tables_by_name(run.parameters)
    return [
        Stage(
            **vars(require_settings(own).build()),
            unknowns=tuple(n for n in table.parameters if n in names),
            optimizer=build.build_section(own, "optimizer"),
            models=[heard.model(own)],
        )
        for table, own in stage_runs(run)
    ]


def _fitted(
    heard: Heard, start: Tensor, number: int, mode: str, folder: RunFolder, console: Console
) -> tuple[dict[str, Any], Callable[[], Reconstruction]]:
    """The row of a fit, or what an interrupted run has kept of it, and what gives its outcome."""
    run = method_run(heard.run, mode)
    stages, part = _stages(heard, run), fit_file_stem(mode, number)
    again = partial(_fit, heard, run, stages, start, number, folder, f"{part}.pt")
    kept = folder.read_json(f"{part}.json")
    if kept is not None:
        return kept, again
    begin = time.perf_counter()
    name = f"start {number + 1}" + ("" if mode == OWN_METHOD else f", {mode.replace('_', ' ')}")
    with report_progress(name, sum(stage.steps for stage in stages), console) as shown:
        found = again(shown)
    place = found.sensors[0].positions[0].detach()
    row: dict[str, Any] = {
        "start": number,
        "start_position": start.tolist(),
        "loss": found.loss,
        "status": found.status,
        "steps": found.steps,
        "seconds": time.perf_counter() - begin,
        "values": _values(found.parameters),
        "losses": [step["loss"] for step in found.history],
    }
    if heard.true_sensor is not None and _located(run):
        real = heard.true_sensor.positions[0]
        row |= {"start_error_m": float((start - real).norm())}
        row |= {"position_error_m": float((place - real).norm())}
        row["success"] = row["position_error_m"] <= require_settings(run).position_limit
    folder.write_json(f"{part}.json", row)
    return row, lambda: found


def _fit(
    heard: Heard,
    run: RunFile,
    stages: Sequence[Stage],
    start: Tensor,
    number: int,
    folder: RunFolder,
    checkpoint: str,
    shown: Sequence[Any] = (),
) -> Reconstruction:
    own: dict[str, nn.Module | Unknown] = {}
    makers = build.module_builders(run.parameters, run.scene)
    unknowns: dict[str, nn.Module | Unknown] = {}
    for name, table in build.tables_by_name(run.parameters).items():
        if table.kind == _TRANSMITTER:
            with prefix_errors(f"parameters.{name}"):
                own[name] = Unknown(table.build(None, initial=start), table.rate)
        else:
            unknowns[name] = Unknown(makers[name], table.rate)
    places = torch.cat([start[None], heard.sensor.positions[1:]])
    sensor = replace(heard.sensor, positions=places)
    return reconstruct(
        heard.scene,
        Observation(stages[-1].models[0], heard.levels, sensor=sensor, parameters=own),
        unknowns,
        loss=build.build_section(run, "loss"),
        schedule=stages,
        callbacks=[
            *shown,
            Checkpoint(
                folder.file(checkpoint), require_settings(run).checkpoint_every, resume=True
            ),
        ],
        seed=derive_seed(run.seed, number),
    )


def _located(run: RunFile) -> bool:
    return any(table.kind == _TRANSMITTER for table in run.parameters)


def _values(modules: nn.ModuleList) -> dict[str, Any]:
    rows: dict[str, Any] = {}
    for module in modules:
        found: dict[str, Tensor] = getattr(module, "values", dict)()
        rows |= {name: value.tolist() for name, value in found.items()}
    return rows


def _rank(row: Mapping[str, Any]) -> tuple[bool, float]:
    loss = row["loss"]
    value = math.inf if loss is None or not math.isfinite(loss) else float(loss)
    return row["status"] == "diverged", value


def _others(
    heard: Heard,
    best: Reconstruction,
    ends: Sequence[tuple[dict[str, Any], Callable[[], Reconstruction]]],
) -> dict[str, Any]:
    """Ends elsewhere that the data do not reject, beside the best one."""
    if not _located(heard.run):
        return {}
    limit = require_settings(heard.run).position_limit
    kept, told = [best.sensors[0].positions[0].detach()], []
    for _, again in ends:
        end = again()
        place = end.sensors[0].positions[0].detach()
        if min(float((place - other).norm()) for other in kept) <= limit:
            continue
        kept.append(place)
        found = difference_score(best.result, end.result)
        if found is not None and found < REJECTION_ZSCORE:
            where = ", ".join(f"{x:.2f}" for x in place.tolist())
            told.append(f"a transmitter at {where} m explains the data as well: z = {found:.1f}")
    return {"ambiguities": told} if told else {}


def spread_of_ends(
    heard: Heard,
    rows: Sequence[dict[str, Any]],
    best: dict[str, Any],
    bars: Mapping[str, float],
) -> dict[str, Any]:
    """How far other starts have ended from the best one, within the limit of places.

    Error bars hold noise about one minimum. Where no other start has ended in them, there are more.

    Args:
        heard: The problem.
        rows: Of all starts.
        best: One of them.
        bars: Half widths that hold 95 % of errors, by parameter.
    """
    if not _located(heard.run) or not bars:
        return {}
    key = "transmitter.position"
    apart = {
        row["start"]: [a - b for a, b in zip(row["values"][key], best["values"][key], strict=True)]
        for row in rows
        if row["start"] != best["start"] and row["status"] != "diverged"
    }
    limit = require_settings(heard.run).position_limit
    near = [off for off in apart.values() if math.hypot(*off) <= limit]
    if len(near) < _FEW_ENDS:
        return {}
    names = [f"transmitter.{axis}" for axis in "xyz"]
    inside = [
        all(abs(x) <= bars.get(name, math.inf) for name, x in zip(names, off, strict=True))
        for off in near
    ]
    squares = zip(names, zip(*near, strict=True), strict=True)
    middle = sorted(math.hypot(*off) for off in near)[len(near) // 2]
    found: dict[str, Any] = {
        "ends_near": len(near),
        "ends_within_bars": sum(inside),
        "spread_of_ends": {
            name: math.sqrt(sum(x * x for x in column) / len(column))
            for name, column in squares
            if name in bars
        },
    }
    if not any(inside):
        found["spread_note"] = (
            f"{len(near)} other starts ended within {limit:g} m of the best, none within its error "
            f"bars, half of them more than {middle:.3f} m away: the bars hold noise about one "
            "minimum of several; take the spread of the ends instead"
        )
    return found


def _scores(
    heard: Heard, rows: dict[str, list[dict[str, Any]]], modes: list[str], best: dict[str, Any]
) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if "success" in best:
        for mode in modes:
            tail = "" if mode == OWN_METHOD else f"_{mode}"
            found[f"successes{tail}"] = sum(row["success"] for row in rows[mode])
            found[f"errors_m{tail}"] = [row["position_error_m"] for row in rows[mode]]
        found["start_errors_m"] = [row["start_error_m"] for row in rows[OWN_METHOD]]
        found |= {"position_error_m": best["position_error_m"], "success": best["success"]}
    materials = _materials(heard)
    if materials:
        found["true_values"] = materials
        for mode in modes:
            tail = "" if mode == OWN_METHOD else f"_{mode}"
            values = min(rows[mode], key=_rank)["values"]
            found[f"relative_errors{tail}"] = {
                name: abs(values[name] / value - 1) for name, value in materials.items()
            }
    return found


def _materials(heard: Heard) -> dict[str, float]:
    """True values of the materials that are fitted, where the run file knows them."""
    if heard.true_sensor is None:
        return {}
    found: dict[str, float] = {}
    for table in heard.run.parameters:
        if table.kind == "material":
            module = table.build(module_values(table.object, heard.truth, heard.run.scene))
            found |= {n: float(v) for n, v in module.values().items() if v.numel() == 1}
    return found


def _line_of_sight(heard: Heard, found: Reconstruction) -> dict[str, Any]:
    """The share of links whose line of sight is blocked, at the truth or else at the twin."""
    places = heard.places or heard.model(heard.run).places
    if not isinstance(places, ReceiverPoints):
        return {}
    sensor = heard.true_sensor or found.sensors[0]
    scene = heard.truth if heard.true_sensor else found.scene
    frequency = heard.model(heard.run).propagation.frequency
    ends = sensor.positions.detach(), places.positions
    with torch.no_grad():
        count = len(trace_paths(scene, *ends, frequency, depth=0))
    return {"blocked_share": 1 - count / (len(ends[0]) * len(ends[1]))}


def _plan(heard: Heard, rows: Sequence[dict[str, Any]], best: Reconstruction) -> Figure:
    """Where the fits of the first transmitter began and ended."""
    place = best.sensors[0].positions[:1].detach()
    shown = {"found": place}
    if heard.true_sensor is not None:
        shown = {"truth": heard.true_sensor.positions[:1], "found": place}
    places = heard.places or heard.model(heard.run).places
    if isinstance(places, ReceiverPoints):
        shown["receivers"] = places.positions
    ends = [[row["start_position"], row["values"]["transmitter.position"]] for row in rows]
    fits = torch.tensor(ends, dtype=torch.float64)
    return plotting.transmitter_fits(best.scene, float(place[0, 2]), shown, fits)


def _outcome(run: RunFile, metrics: Mapping[str, Any]) -> str:
    ended = load_texts("outcomes")[metrics["status"]].format(steps=metrics["steps"])
    believed = load_texts("verdicts")[metrics["verdict"]]
    count = metrics["starts_count"]
    which = f"Best of {count} starts: " if count > 1 else ""
    if "successes" in metrics:
        limit = require_settings(run).position_limit
        return (
            f"{which}{metrics['position_error_m']:.3f} m from the truth; {ended}. "
            f"{metrics['successes']} of {count} starts end within {limit:g} m. {believed}"
        )
    return f"{which}{ended}. {believed}"


def _tables(
    heard: Heard, metrics: Mapping[str, Any], rows: Mapping[str, list[dict[str, Any]]]
) -> list[ReportTable]:
    result = quantity_table("Result", metrics)
    true = metrics.get("true_values", {})
    if heard.true_sensor is not None and _located(heard.run):
        true = {**true, "transmitter.position": heard.true_sensor.positions[0].tolist()}
    cells = [[name, value, true.get(name)] for name, value in metrics["parameters"].items()]
    tables = [result, ReportTable("Parameters", ["parameter", "result", "truth"], cells)]
    tables.append(error_bar_table(dict(metrics)))
    if "successes" in metrics:
        heads = ["fit", "successes", "median error [m]", "largest error [m]"]
        cells = []
        for mode in rows:
            tail = "" if mode == OWN_METHOD else f"_{mode}"
            errors = sorted(metrics[f"errors_m{tail}"])
            name = "full" if mode == OWN_METHOD else mode.replace("_", " ")
            middle = errors[len(errors) // 2]
            cells.append([name, metrics[f"successes{tail}"], middle, errors[-1]])
        tables.append(ReportTable("Ways to fit", heads, cells))
    return tables
