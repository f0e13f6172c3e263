"""`invertwin reconstruct` and `demo`: fits from one or many starts, scored against the truth."""

import math
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import nn

from invertwin.capture import Capture, calibrate, locate, rail_sar
from invertwin.channel.paths import Grid
from invertwin.cli import build, pictures
from invertwin.cli.landscape import landscape
from invertwin.cli.report import Again, Picture, Table, report_html, shown
from invertwin.cli.run_file import need, to_toml
from invertwin.cli.run_simulate import exact
from invertwin.cli.runs import CHECKPOINT, PARTS, RunFolder
from invertwin.cli.schema import CaptureData, RadarParameter, RailSarData, RunFile, SimulatedData
from invertwin.errors import InputError
from invertwin.inversion.nuisances import ClockOffset, RangeBias
from invertwin.inversion.reconstruction import Reconstruction, reconstruct
from invertwin.radar.radar import Radar
from invertwin.radar.surrogate import surrogate_spectrum
from invertwin.scene import Scene
from invertwin.scene.files import save_mesh

FULL, INTERIOR = "full", "interior_only"
_RAIL_SAR_ORIGINAL = "github.com/jjimmykang/bwsi-backprojection, trial 6"
_ENDS = {
    "converged": "the loss no longer falls",
    "budget": "all steps used",
    "diverged": "diverged, best state kept",
}
_MODES = {FULL: "with boundary terms", INTERIOR: "interior only"}


@dataclass(frozen=True)
class Problem:
    """Everything a fit needs, built from the run file.

    Attributes:
        run: The run file.
        scene: The scene as known.
        truth: The true scene, where the run file knows it.
        known: Names of the objects whose true pose is known.
        capture: The data.
        radar: What measured them.
        grid: Bins that are compared.
        target: The object that is scored, if any moves.
    """

    run: RunFile
    scene: Scene
    truth: Scene
    known: frozenset[str]
    capture: Capture
    radar: Radar
    grid: Grid
    target: str | None


def run_reconstruct(run: RunFile, folder: RunFolder, console: Console) -> tuple[list[Table], str]:
    """Fits from every start, writes the folder; returns the tables to print and the outcome.

    Starts that an interrupted run has finished are not fitted again.
    """
    begin = time.perf_counter()
    settings = need(run, "reconstruct", "reconstruct")
    problem, calibration = _calibrated(_problem(run, console), folder, console)
    scenes = [problem.scene]
    if run.starts is not None:
        scenes = build.starts(run.starts, problem.scene, problem.truth, run.seed)
    modes = [FULL] if settings.boundary else [INTERIOR]
    if settings.also_interior_only and settings.boundary:
        modes.append(INTERIOR)
    single = len(scenes) * len(modes) == 1
    rows: dict[str, list[dict[str, Any]]] = {}
    for mode in modes:
        rows[mode] = [
            _fit(problem, scene, i, mode, folder, console, CHECKPOINT if single else None)
            for i, scene in enumerate(scenes)
        ]
    best = min(rows[modes[0]], key=lambda row: _finite(row["loss"]))
    start = scenes[best["start"]]
    twin, radar, offset = _restored(problem, start, folder, best["checkpoint"])
    maps = {
        "measured": problem.capture.spectrum(problem.grid).float(),
        "start": _sharp_spectrum(problem, start, problem.radar, None),
        "twin": _sharp_spectrum(problem, twin, radar, offset),
    }
    metrics = {
        "task": run.task,
        **_summary(problem, rows, modes),
        **{key: best[key] for key in _COLUMNS if key in best and key != "seconds"},
        "start_loss_sharp": _misfit(run, maps["start"], maps["measured"]),
        "loss_sharp": _misfit(run, maps["twin"], maps["measured"]),
        "parameters": best["values"],
        **({"calibration": calibration} if calibration else {}),
        **_heldout(problem, rows[modes[0]], best),
        "starts": _without_history(rows[modes[0]]),
    }
    if len(modes) > 1:
        metrics["starts_interior_only"] = _without_history(rows[INTERIOR])
    if run.landscape is not None and isinstance(run.data, SimulatedData):
        console.print("computing the loss landscape")
        png, found = landscape(run, problem.truth, problem.radar, problem.grid, problem.capture)
        folder.write_bytes("landscape.png", png)
        metrics["landscape"] = found
    metrics["fit_seconds"] = sum(row["seconds"] for fits in rows.values() for row in fits)
    metrics["wall_seconds"] = time.perf_counter() - begin
    tables = _tables(problem, metrics, start, twin, rows)
    _draw(problem, folder, rows, metrics, start, twin, radar, maps)
    save_mesh(folder.file("twin.ply"), twin)
    if not single:
        shutil.copyfile(folder.path / best["checkpoint"], folder.file(CHECKPOINT))
    folder.write_json("metrics.json", metrics)
    _write_report(run, folder, metrics, tables)
    folder.remove([name for name in folder.names if name.startswith(PARTS)])
    return tables, _status(run, metrics)


def _finite(loss: float | None) -> float:
    """The loss as a rank: one that is not a number comes last."""
    return loss if loss is not None and math.isfinite(loss) else math.inf


def _problem(run: RunFile, console: Console) -> Problem:
    need(run, "parameters", "reconstruct")
    table = need(run, "grid", "reconstruct")
    scene, truth = build.scene(run), build.true_scene(run)
    build.parameters(run.parameters, scene)  # their errors come before any work
    data = need(run, "data", "reconstruct")
    if isinstance(data, SimulatedData):
        radar = build.radar(need(run, "radar", "simulated data"))
        grid = build.grid(table, radar)
        console.print("simulating the exact signals of the true scene")
        beat = exact(run, truth, radar, grid).beat
        assert beat is not None
        capture = Capture.from_beat(beat, radar)
        known = frozenset(truth.names)
    else:
        if run.radar is not None:
            raise InputError(
                f"radar: expected no [radar] with data.kind = {data.kind}, got one; "
                "remove it: a capture brings its radar along"
            )
        capture = _measured(data)
        radar = capture.radar()
        grid = build.grid(table, radar)
        known = frozenset(run.truth)
    target = run.starts.object if run.starts else next(iter(_sought(run)), None)
    return Problem(run, scene, truth, known, capture, radar, grid, target)


def _measured(data: CaptureData | RailSarData) -> Capture:
    if isinstance(data, CaptureData):
        with build.about("data.file"):
            return Capture.load(data.file)
    with build.about("data.folder"):
        if not (Path(data.folder) / rail_sar.FILE).is_file():
            raise InputError(
                f"expected {rail_sar.FILE} in {data.folder}, got no such file; it is made from the "
                f"public recording {_RAIL_SAR_ORIGINAL}: set INVERTWIN_DATA to the folder that "
                f"holds {Path(data.folder).name}/"
            )
        return rail_sar.read(data.folder)


def _calibrated(
    problem: Problem, folder: RunFolder, console: Console
) -> tuple[Problem, dict[str, Any]]:
    """The problem with range bias and clock offset found on an object whose place is known."""
    table = problem.run.calibration
    if table is None:
        return problem, {}
    center = problem.truth[table.object].center
    if table.method == "backprojection":
        capture, row = calibrate(problem.capture, center), {}
    else:
        alone = Scene({table.object: problem.truth[table.object]})
        nuisances = [RangeBias(), ClockOffset(problem.capture)]
        checkpoint = f"{PARTS}/calibration.pt"
        rate = table.rate or problem.run.optimizer.rate
        steps = table.steps or _steps(problem)
        found = _reconstruct(
            problem,
            alone,
            nuisances,
            _Bar(console, "calibration", steps),
            folder.file(checkpoint),
            steps=steps,
            optimizer=replace(build.optimizer(problem.run.optimizer), rate=rate),
        )
        capture = problem.capture.recalibrated(
            problem.capture.clock_offset + float(nuisances[1].shift.detach()),
            problem.capture.range_bias + float(nuisances[0].bias.detach()),
        )
        row = {"loss": found.loss, "status": found.status}
    row |= {"clock_offset_s": capture.clock_offset, "range_bias_m": capture.range_bias}
    return replace(problem, capture=capture, radar=capture.radar()), row


def _fit(
    problem: Problem,
    scene: Scene,
    index: int,
    mode: str,
    folder: RunFolder,
    console: Console,
    checkpoint: str | None,
) -> dict[str, Any]:
    """One fit, or what an interrupted run has kept of it."""
    part = f"{PARTS}/{mode}_{index:02d}"
    done = folder.read_json(f"{part}.json")
    if done is not None:
        return done
    begin = time.perf_counter()
    name = f"start {index + 1}" + (", interior only" if mode == INTERIOR else "")
    checkpoint = checkpoint or f"{part}.pt"
    found = _reconstruct(
        problem,
        scene,
        [*build.parameters(problem.run.parameters, scene), *_nuisances(problem)],
        _Bar(console, name, _steps(problem)),
        folder.file(checkpoint),
        steps=_steps(problem),
        boundary=mode == FULL,
        seed=problem.run.seed + index,
        regularizers=build.regularizers(problem.run.parameters, scene),
    )
    row = {
        "start": index,
        **_scores(problem, scene, found.scene),
        "loss": found.loss,
        "status": found.status,
        "steps": found.steps,
        "seconds": time.perf_counter() - begin,
        "values": _values(found.parameters),
        "checkpoint": checkpoint,
        "losses": [step["loss"] for step in found.history],
    }
    folder.write_json(f"{part}.json", row)
    return row


def _values(modules: nn.ModuleList) -> dict[str, Any]:
    """Fitted values by name; vertices are in the mesh file and the checkpoint."""
    rows: dict[str, Any] = {}
    for module in modules:
        found: dict[str, torch.Tensor] = getattr(module, "values", dict)()
        rows |= {name: value.tolist() for name, value in found.items() if value.numel() <= 16}
    return rows


def _reconstruct(
    problem: Problem,
    scene: Scene,
    modules: Sequence[nn.Module],
    bar: "_Bar",
    checkpoint: Any,
    **changes: Any,
) -> Reconstruction:
    settings = need(problem.run, "reconstruct", "reconstruct")
    options = {
        "grid": problem.grid,
        "loss": build.loss(problem.run.loss),
        "optimizer": build.optimizer(problem.run.optimizer),
        "surrogate": build.surrogate(problem.run.surrogate),
        "annealing": settings.annealing,
        "seed": problem.run.seed,
        "samples": settings.samples,
        "boundary_samples": settings.boundary_samples,
        "boundary": settings.boundary,
        "frames_per_step": settings.frames_per_step,
        "tolerance": settings.tolerance,
        "checkpoint": checkpoint,
        "checkpoint_every": settings.checkpoint_every,
        "resume": True,  # from its own unfinished part; open_run has settled what may be there
    }
    with bar, _interrupted_between_steps() as heed:

        def advance(row: dict[str, Any]) -> None:
            bar.advance(row)
            heed()

        return reconstruct(
            scene,
            problem.radar,
            problem.capture,
            modules,
            progress=advance,
            **(options | changes),
        )


@contextmanager
def _interrupted_between_steps() -> Iterator[Callable[[], None]]:
    """Ctrl-C waits for the end of the step, when nothing is half done; a second one does not.

    Gives a function that raises KeyboardInterrupt if one is due.
    """
    due = False

    def heed() -> None:
        if due:
            raise KeyboardInterrupt

    def note(_signal: int, _frame: FrameType | None) -> None:
        nonlocal due
        heed()
        due = True

    # Another handler, or another thread than the main one, is not ours to change.
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not ours or threading.current_thread() is not threading.main_thread():
        yield heed
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield heed
        heed()
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class _Bar:
    """Progress with the loss and the first parameters: a bar, or lines where no terminal is."""

    def __init__(self, console: Console, name: str, steps: int):
        self._console, self._name, self._steps = console, name, steps
        self._bar = Progress(
            TextColumn(name),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=console,
        )
        self._task = self._bar.add_task("", total=steps)

    def __enter__(self) -> "_Bar":
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._bar.stop()

    def advance(self, row: dict[str, Any]) -> None:
        """Shows a row of the history."""
        values = " ".join(
            np.array2string(np.atleast_1d(value), precision=3, suppress_small=True)
            for value in list(row["values"].values())[:2]
            if np.size(value) <= 3
        )
        text = f"loss {row['loss']:.4f} {values}"
        done = row["step"] + 1
        if self._console.is_terminal:
            self._bar.update(self._task, completed=done, description=text)
        elif done * 10 // self._steps > row["step"] * 10 // self._steps:
            line = f"{self._name}: step {done} of {self._steps}, {text}"
            self._console.print(line, markup=False, soft_wrap=True)


def _sought(run: RunFile) -> list[str]:
    """Objects that have parameters."""
    return [p.object for p in run.parameters if not isinstance(p, RadarParameter)]


def _steps(problem: Problem) -> int:
    return need(problem.run, "reconstruct", "reconstruct").steps


def _annealed(run: RunFile) -> float | None:
    """The step from which the surrogate has no extra widths; None if it never has."""
    settings = need(run, "reconstruct", "reconstruct")
    wide = run.surrogate.range_width > 0 or run.surrogate.angle_width > 0
    return settings.annealing * settings.steps if wide else None


def _nuisances(problem: Problem) -> list[nn.Module]:
    made = {"range_bias": RangeBias, "clock_offset": lambda: ClockOffset(problem.capture)}
    names = need(problem.run, "reconstruct", "reconstruct").nuisances
    return [made[name]() for name in names]


def _restored(
    problem: Problem, scene: Scene, folder: RunFolder, checkpoint: str
) -> tuple[Scene, Radar, torch.Tensor | None]:
    """Twin, radar and range offset of a finished fit, from its checkpoint."""
    modules = nn.ModuleList(
        [*build.parameters(problem.run.parameters, scene), *_nuisances(problem)]
    )
    saved = torch.load(folder.path / checkpoint, weights_only=True)
    modules.load_state_dict(saved["modules"])
    radar, offset = problem.radar, None
    with torch.no_grad():
        for module in modules:
            match getattr(module, "applies_to", "scene"):
                case "scene":
                    scene = module(scene)
                case "radar":
                    radar = module(radar)
                case "range":
                    offset = module()
    return scene, radar, offset


def _sharp_spectrum(
    problem: Problem, scene: Scene, radar: Radar, offset: torch.Tensor | None
) -> torch.Tensor:
    """The surrogate's map of a scene without extra widths."""
    settings = need(problem.run, "reconstruct", "reconstruct")
    sharp = replace(build.surrogate(problem.run.surrogate), range_width=0.0, angle_width=0.0)
    with torch.no_grad():
        return surrogate_spectrum(
            scene,
            radar,
            problem.grid,
            sharp,
            samples=4 * settings.samples,
            boundary_samples=0,
            seed=problem.run.seed,
            range_offset=offset,
        )


def _misfit(run: RunFile, simulated: torch.Tensor, measured: torch.Tensor) -> float | None:
    """The loss of two maps; None where a map without power has none."""
    try:
        return float(build.loss(run.loss)(simulated, measured))
    except InputError:
        return None


_COLUMNS = {
    "start_distance_m": "off at the start [m]",
    "start_angle_deg": "off at the start [°]",
    "position_error_m": "off at the end [m]",
    "rotation_error_deg": "off at the end [°]",
    "scale_error": "size off by",
    "success": "within the limits",
    "loss": "loss",
    "status": "ended as",
    "steps": "steps",
    "seconds": "time [s]",
}
_LABELS = {
    "start_distance_m": "distance to the truth, start [m]",
    "start_angle_deg": "angle to the truth, start [°]",
    "position_error_m": "distance to the truth, twin [m]",
    "rotation_error_deg": "angle to the truth, twin [°]",
    "scale_error": "size, share off the truth",
    "start_loss_sharp": "loss without extra width, start",
    "loss_sharp": "loss without extra width, twin",
    "loss": "loss at the last step",
    "heldout_error_m": "held-out object, distance to the survey [m]",
    "heldout_error_worst_m": "held-out object, the same of the worst start [m]",
    "backprojection_error_m": "held-out object, by backprojection instead [m]",
    "spread_m": "spread of the starts' results [m]",
    "backprojection_distance_m": "between the objects, by backprojection [m]",
    "surveyed_distance_m": "between the objects, by survey [m]",
    "fit_seconds": "time of the fits [s]",
    "wall_seconds": "time of all, pictures included [s]",
}
_CALIBRATION_LABELS = {
    "loss": "calibration: loss",
    "status": "calibration ended as",
    "clock_offset_s": "calibration: clock offset [s]",
    "range_bias_m": "calibration: range bias [m]",
}


def _scores(problem: Problem, start: Scene, twin: Scene) -> dict[str, Any]:
    """How far start and twin are from the truth, where it is known."""
    name = problem.target
    if name is None:
        return {}
    place = twin[name].center.detach().tolist()
    if name not in problem.known:
        return {"position": place}
    settings = need(problem.run, "reconstruct", "reconstruct")
    before = build.residual(start[name], problem.truth[name])
    after = build.residual(twin[name], problem.truth[name])
    rows: dict[str, Any] = {
        "start_distance_m": before.distance,
        "position_error_m": after.distance,
        "success": after.distance <= settings.position_limit,
        "position": place,
    }
    kinds = {p.kind for p in problem.run.parameters}
    if "pose" in kinds:
        angle = math.degrees(after.angle)
        rows |= {"start_angle_deg": math.degrees(before.angle), "rotation_error_deg": angle}
        rows["success"] &= angle <= settings.rotation_limit_deg
    if "scale" in kinds:
        rows |= {"scale_error": abs(after.scale - 1)}
    return rows


def _summary(
    problem: Problem, rows: dict[str, list[dict[str, Any]]], modes: Sequence[str]
) -> dict[str, Any]:
    """Successes with and, where asked for, without boundary terms."""
    if problem.target not in problem.known:
        return {}
    counts = {mode: sum(row["success"] for row in rows[mode]) for mode in modes}
    found = {"successes": counts[modes[0]], "starts_count": len(rows[modes[0]])}
    if INTERIOR in counts:
        found["successes_interior_only"] = counts[INTERIOR]
    return found


def _heldout(problem: Problem, rows: list[dict[str, Any]], best: dict[str, Any]) -> dict[str, Any]:
    """For calibrated captures: the error on an object that took no part in the calibration."""
    table = problem.run.calibration
    name = problem.target
    if table is None or name is None or name not in problem.known or name == table.object:
        return {}
    truth, known = problem.truth[name].center, problem.truth[table.object].center
    focused = calibrate(problem.capture, known)
    peak = locate(focused, truth)
    places = torch.tensor([row["position"] for row in rows], dtype=torch.float64)
    spread = (places - places.mean(0)).norm(dim=1).max()
    return {
        "heldout_error_m": best["position_error_m"],
        "heldout_error_worst_m": max(row["position_error_m"] for row in rows),
        "backprojection_error_m": float((peak - truth).norm()),
        "spread_m": float(spread),
        # Between the two objects. That these differ is no matter of the fit.
        "backprojection_distance_m": float((peak - locate(focused, known)).norm()),
        "surveyed_distance_m": float((truth - known).norm()),
    }


def _without_history(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k not in ("losses", "checkpoint")} for row in rows]


def _tables(
    problem: Problem,
    metrics: dict[str, Any],
    start: Scene,
    twin: Scene,
    rows: dict[str, list[dict[str, Any]]],
) -> list[Table]:
    tables = [Table("Result", ["quantity", "value"], _result(problem.run, metrics))]
    for mode, fits in rows.items():
        if len(fits) > 1:
            keys = [key for key in _COLUMNS if key in fits[0]]
            cells = [
                [row["start"] + 1, *(_ENDS[row[k]] if k == "status" else row[k] for k in keys)]
                for row in fits
            ]
            title = f"Starts, {_MODES[mode]}"
            tables.append(Table(title, ["start", *(_COLUMNS[key] for key in keys)], cells))
    cells = []
    for name in dict.fromkeys(_sought(problem.run)):
        scenes = [start, twin, *([problem.truth] if name in problem.known else [])]
        centers = [scene[name].center.detach().tolist() for scene in scenes]
        for i, axis in enumerate("xyz"):
            cells.append([f"{name}.{axis} [m]", *(_clean(center[i]) for center in centers)])
        if name in problem.known and "rotation_error_deg" in metrics:
            angles = [
                _clean(math.degrees(build.residual(scene[name], problem.truth[name]).angle))
                for scene in scenes
            ]
            cells.append([f"{name}, angle to the truth [°]", *angles])
    for row in cells:
        row += [None] * (4 - len(row))
    tables.append(Table("Parameters", ["parameter", "start", "result", "truth"], cells))
    units = {"translation": " [m]", "rotation": " [rad, rotation vector]", "scale": " [factor]"}
    moves = [[k + units.get(k.split(".")[-1], ""), v] for k, v in metrics["parameters"].items()]
    tables.append(Table("Moves from the start", ["parameter", "value"], moves))
    return tables


def _clean(value: float) -> float:
    """Without what rounding leaves of a zero."""
    return round(value, 9) + 0.0


def _result(run: RunFile, metrics: dict[str, Any]) -> list[list[Any]]:
    """The rows of the result table."""
    rows: list[list[Any]] = [["how it ended", _ended(run, metrics)]]
    if "success" in metrics:
        count = metrics["starts_count"]
        limits = _limits(run, metrics)
        if count == 1:
            rows.append([f"within {limits} of the truth", metrics["success"]])
        else:
            rows.append([f"starts that end within {limits}", f"{metrics['successes']} of {count}"])
        if "successes_interior_only" in metrics:
            text = f"{metrics['successes_interior_only']} of {count}"
            rows.append(["the same without boundary terms", text])
    skipped = () if _annealed(run) else ("start_loss_sharp", "loss_sharp")
    for key, label in _LABELS.items():
        if key in metrics and key not in skipped:
            rows.append([label, metrics[key]])
    for key, label in _CALIBRATION_LABELS.items():
        if key in metrics.get("calibration", {}):
            value = metrics["calibration"][key]
            rows.append([label, _ENDS[value] if key == "status" else value])
    return rows


def _ended(run: RunFile, metrics: dict[str, Any]) -> str:
    steps = need(run, "reconstruct", "reconstruct").steps
    match metrics["status"]:
        case "budget":
            return f"all {steps} steps used"
        case "converged":
            return f"converged: the loss no longer falls after {metrics['steps']} steps"
    return f"diverged after {metrics['steps']} steps: the best state is kept"


def _limits(run: RunFile, metrics: dict[str, Any]) -> str:
    """How near the truth counts as a success."""
    settings = need(run, "reconstruct", "reconstruct")
    turned = "rotation_error_deg" in metrics
    angle = f" and {settings.rotation_limit_deg:g}°" if turned else ""
    return f"{settings.position_limit:g} m{angle}"


def _draw(
    problem: Problem,
    folder: RunFolder,
    rows: dict[str, list[dict[str, Any]]],
    metrics: dict[str, Any],
    start: Scene,
    twin: Scene,
    radar: Radar,
    maps: dict[str, torch.Tensor],
) -> None:
    """Writes the pictures of the best fit."""
    sought = _sought(problem.run)
    places = radar.positions.detach().numpy()
    truth = pictures.meshes_of(problem.truth)
    outline = {k: v for k, v in truth.items() if k in problem.known and k in sought}
    scenes = {"truth": problem.truth} if outline else {}
    scenes |= {"start": start, "twin": twin}
    folder.write_bytes(
        "scene.png",
        pictures.scene_picture(
            {
                name: pictures.Drawing(pictures.meshes_of(scene), sought, outline, places)
                for name, scene in scenes.items()
            },
            pictures.frame_of(radar),
        ),
    )
    grid = problem.grid
    axes = pictures.Axes(grid.ranges.numpy(), grid.u.numpy(), grid.v.numpy())
    simulated = isinstance(problem.run.data, SimulatedData)
    data = "data (exact simulation)" if simulated else "data (measured)"
    titles = {"measured": data, "start": "surrogate, start", "twin": "surrogate, twin"}
    titled = {titles[name]: power.numpy() for name, power in maps.items()}
    folder.write_bytes("spectra.png", pictures.spectra_picture(titled, axes))
    losses = {_MODES[mode]: [row["losses"] for row in fits] for mode, fits in rows.items()}
    annealed = _annealed(problem.run)
    before = metrics["start_loss_sharp"] if annealed else None
    folder.write_bytes("loss.png", pictures.loss_picture(losses, annealed, before))


def _write_report(
    run: RunFile, folder: RunFolder, metrics: dict[str, Any], tables: Sequence[Table]
) -> None:
    notes = {
        "scene": "In red: where the sought objects really are." if "success" in metrics else "",
        "spectra": "Each map in dB below its own peak; maps over direction are summed over frames.",
        "loss": _loss_note(run, metrics),
        "landscape": _landscape_note(run, metrics),
    }
    shown = [
        Picture(name.capitalize(), (folder.path / f"{name}.png").read_bytes(), notes.get(name, ""))
        for name in ("scene", "spectra", "loss", "landscape")
        if f"{name}.png" in folder.names
    ]
    title = run.title or "Reconstruction"
    again = Again("reconstruct run.toml", {"run.toml": to_toml(run)})
    parts = [*tables[:1], *shown, *tables[1:]]
    folder.write_text(
        "report.html", report_html(title, _status(run, metrics), run.note, parts, again)
    )


def _loss_note(run: RunFile, metrics: dict[str, Any]) -> str:
    if _annealed(run) is None:
        return ""
    note = (
        "In the shaded part, data and simulation are both blurred by an extra width, which shrinks "
        "step by step. A blurred map is easier to match, so the loss may rise while the blur is "
        "taken away although the twin gets better: losses of the shaded part are not comparable "
        "with each other or with later ones."
    )
    before, after = metrics["start_loss_sharp"], metrics["loss_sharp"]
    if before is None or after is None:
        return note
    return f"{note} Without extra width the start has a loss of {before:.4g}, the twin {after:.4g}."


def _landscape_note(run: RunFile, metrics: dict[str, Any]) -> str:
    if run.landscape is None or "landscape" not in metrics:
        return ""
    minima = metrics["landscape"]["local_minima"]
    return (
        f"The loss when {run.landscape.object} alone is moved off the truth (dotted line), all "
        "else being right. A descent ends in the nearest minimum. The exact signal of one channel "
        f"(left, offsets in mm) has {minima['exact']} of them within ±"
        f"{run.landscape.exact_span * 1e3:g} mm, about one every half wavelength: a fit would have "
        "to start within a millimetre or so. The surrogate's power maps (right, offsets in m) are "
        "what the fit descends on; where they have a single minimum, the truth is found from "
        "anywhere on the line."
    )


def _status(run: RunFile, metrics: dict[str, Any]) -> str:
    """What came out, in a sentence or two."""
    count = metrics.get("starts_count", 1)
    which = f"Best of {count} starts: " if count > 1 else ""
    ended = _ended(run, metrics)
    if "position_error_m" not in metrics:
        return f"{which}{ended}."
    turned = f" and {metrics['rotation_error_deg']:.2f}°" if "rotation_error_deg" in metrics else ""
    score = f"{which}{metrics['position_error_m']:.3f} m{turned} from the truth; {ended}."
    limits = _limits(run, metrics)
    if count == 1:
        return f"{score} A success is within {limits}: {shown(metrics['success'])}."
    return f"{score} {metrics['successes']} of {count} starts end within {limits}."
