"""`invertwin reconstruct` with `[placement]`: a metasurface finds its place in a room."""

import math
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from invertwin import plotting
from invertwin.cli.report import ReportTable, load_texts, save_picture, write_report
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.placement import Placement
from invertwin.cli.schema.run_file import require_section
from invertwin.cli.terminal import show_progress
from invertwin.links.metasurface.placement import (
    Coverage,
    Found,
    PanelDesign,
    Trial,
    evaluations_until,
)
from invertwin.runtime.progress import track
from invertwin.seeds import derive_seed
from invertwin.storage.folders import PARTS
from invertwin.storage.run_folder import RunFolder

_AS_GOOD = 0.95
_CELLS = 2500  # of a drawn map
_FLOOR = 1e-16


def run_placement(
    run: RunFile, folder: RunFolder, console: Console
) -> tuple[list[ReportTable], str]:
    """Place the panel from every start, beside the grid and annealing; write the folder.

    Args:
        run: With `[placement]`.
        folder: Of the run.
        console: Where progress is shown.
    """
    begin = time.perf_counter()
    table, scene = require_section(run, "placement", "reconstruct"), build.scene(run)
    grid = table.grid
    placing, _ = build.panel_design(run, scene)
    scored = table.coverage(scene, run.seed, scored=True)
    with show_progress(console):
        trials = placing.trials(grid.places, grid.yaws, [math.radians(a) for a in grid.spread_deg])
        tried = _kept(folder, "grid", lambda: _exhaustive(table, placing, trials))
        rows: list[dict[str, Any]] = []
        for number in track(range(table.starts), "start"):
            seed = derive_seed(run.seed, 2, number)
            also = number < table.annealed_starts
            search = partial(_start, table, placing, scored, tried, seed, annealed=also)
            rows.append(_kept(folder, f"start_{number}", search))
    levels = torch.tensor(tried["levels_db"], dtype=torch.float64)
    metrics = _metrics(run, placing, scored, rows, tried)
    state = _state(max(rows, key=lambda row: row["level_db"]))
    pictures = [
        save_picture(
            folder, "landscape", _landscape(table, placing, trials, levels, rows), note="placement"
        ),
        save_picture(
            folder, "coverage", _maps(run, table, placing, state), note="placement_coverage"
        ),
    ]
    metrics["wall_seconds"] = time.perf_counter() - begin
    columns = ("start", "found / exhaustive", "interior only", "annealing", "evaluations ratio")
    shown = [
        [
            number,
            row["found_over_exhaustive"],
            row["interior_over_exhaustive"],
            row.get("annealing_over_exhaustive"),
            row.get("evaluations_ratio"),
        ]
        for number, row in enumerate(rows)
    ]
    notes = load_texts("notes")
    parts = [ReportTable("Starts", columns, shown, notes["placement_starts"]), *pictures]
    status = (
        f"{metrics['successes']} of {table.starts} starts reach {_AS_GOOD:g} of the best of the "
        f"grid; the worst {table.share:.0%} of receivers gain {metrics['gain_db']:.1f} dB"
    )
    title = run.title or "Placement of a metasurface"
    tables = write_report(folder, metrics, title, status, parts, again="reconstruct", note=run.note)
    return tables, status


def _kept(folder: RunFolder, name: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What was computed before the run was interrupted, or is now."""
    part = f"{PARTS}/{name}.json"
    found = folder.read_json(part)
    if found is None:
        found = compute()
        folder.write_json(part, found)
    return found


def _lists(found: Found) -> dict[str, Any]:
    return {name: value.tolist() for name, value in found.state.items()}


def _state(row: dict[str, Any]) -> dict[str, Tensor]:
    return {n: torch.tensor(v, dtype=torch.float64) for n, v in row["state"].items()}


def _exhaustive(table: Placement, placing: PanelDesign, trials: list[Trial]) -> dict[str, Any]:
    """The grid, and its best, whose place and phases are then fitted as at the end of a search."""
    settings, levels = table.descent.build(), placing.exhaustive(trials)
    module = placing.make(*trials[int(levels.argmax())])
    placing.descend(module, settings.steps, settings, width=0.0)
    state = {name: value.clone() for name, value in module.state_dict().items()}
    found = Found(state, placing.level(module))
    return {"levels_db": levels.tolist(), "level_db": found.level, "state": _lists(found)}


def _start(
    table: Placement,
    placing: PanelDesign,
    scored: Coverage,
    tried: dict[str, Any],
    seed: int,
    *,
    annealed: bool,
) -> dict[str, Any]:
    """One search, with what it is compared with; ratios are of path gains of the worst."""
    settings = table.descent.build()
    found = placing.by_gradient(settings, seed)
    interior = placing.by_gradient(settings, seed, boundary=False)
    truth = placing.level(placing.module(_state(tried)), scored)

    def ratio(one: Found) -> float:
        return 10 ** ((placing.level(placing.module(one.state), scored) - truth) / 10)

    row = {
        "state": _lists(found),
        "level_db": found.level,
        "along_m": float(found.state["along"]),
        "yaw_deg": math.degrees(float(found.state["yaw"])),
        "found_over_exhaustive": ratio(found),
        "interior_over_exhaustive": ratio(interior),
        "evaluations": found.evaluations,
    }
    if not annealed:
        return row
    enough = found.level + 10 * math.log10(_AS_GOOD)
    other = placing.annealed(table.annealing * found.evaluations, seed, enough)
    reached = evaluations_until(other.history, enough)
    return row | {
        "annealing_over_exhaustive": ratio(other),
        "annealing_evaluations": reached or other.evaluations,
        "annealing_reached": reached is not None,
        "evaluations_ratio": found.evaluations / (reached or other.evaluations),
    }


def _metrics(
    run: RunFile,
    placing: PanelDesign,
    scored: Coverage,
    rows: list[dict[str, Any]],
    tried: dict[str, Any],
) -> dict[str, Any]:
    def middle(key: str) -> float | None:
        found = [row[key] for row in rows if key in row]
        return statistics.median(found) if found else None

    def successes(key: str) -> int:
        return sum(row[key] >= _AS_GOOD for row in rows if key in row)

    best = max(rows, key=lambda row: row["level_db"])
    after = placing.level(placing.module(_state(best)), scored)
    before = float(scored.worst(scored.direct))
    return {
        "task": run.task,
        "successes": successes("found_over_exhaustive"),
        "successes_interior": successes("interior_over_exhaustive"),
        "successes_annealing": successes("annealing_over_exhaustive"),
        "found_over_exhaustive": middle("found_over_exhaustive"),
        "interior_over_exhaustive": middle("interior_over_exhaustive"),
        "annealing_over_exhaustive": middle("annealing_over_exhaustive"),
        "evaluations_ratio": middle("evaluations_ratio"),
        "evaluations": rows[0]["evaluations"],
        "evaluations_exhaustive": len(tried["levels_db"]),
        "annealing_reached": sum(row.get("annealing_reached", False) for row in rows),
        "worst_before_db": before,
        "worst_after_db": after,
        "worst_exhaustive_db": placing.level(placing.module(_state(tried)), scored),
        "gain_db": after - before,
        "starts": [{k: v for k, v in row.items() if k != "state"} for row in rows],
    }


def _landscape(
    table: Placement,
    placing: PanelDesign,
    trials: list[Trial],
    levels: Tensor,
    rows: list[dict[str, Any]],
) -> Any:
    places = table.grid.places
    best = levels.view(places, -1).amax(1)
    along = torch.tensor([trial[0] for trial in trials], dtype=torch.float64).view(places, -1)[:, 0]
    length = placing.make(0.0, 0.0, (0.0, 0.0)).path.length
    found = [[row["along_m"] % length, row["level_db"]] for row in rows]
    ends = torch.tensor(found, dtype=torch.float64)
    return plotting.placements(along, best, ends)


def _maps(run: RunFile, table: Placement, placing: PanelDesign, state: dict[str, Tensor]) -> Any:
    """Path gain over the floor plan, without the panel and with it."""
    low, high = (
        torch.tensor(end, dtype=torch.float64)
        for end in (table.receivers.low, table.receivers.high)
    )
    side = (high - low)[:2]
    step = float((side.prod() / _CELLS).sqrt())
    counts = [max(2, round(float(s) / step)) for s in side]
    axes = [torch.linspace(float(low[k]), float(high[k]), counts[k]).double() for k in range(2)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    height = 0.5 * (table.receivers.low[2] + table.receivers.high[2])
    places = torch.cat([grid, torch.full((len(grid), 1), height)], 1)
    module = placing.module(state)
    with torch.no_grad():
        panel = module(placing.panel)
        aim = Coverage.of(
            placing.coverage.scene,
            placing.coverage.tx,
            places,
            table.frequency,
            depth=table.depth,
            edges=table.edges,
            seed=run.seed,
        )
        maps = {"without": aim.direct, "with the panel": aim.gain(panel)}
    shown = {n: 10 * g.clamp_min(_FLOOR).log10().view(*counts) for n, g in maps.items()}
    return plotting.floor_plan(
        shown, (low, high), placing.coverage.scene, height, placing.coverage.tx, panel.position
    )
