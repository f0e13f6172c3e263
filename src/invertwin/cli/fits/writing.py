"""What a reconstruction leaves behind: tables, pictures, the report."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, get_args

import torch

from invertwin import plotting
from invertwin.cli import build
from invertwin.cli.fits.likeness import CURVE, is_shape_key, shape_label, short_label
from invertwin.cli.fits.problem import FULL, INTERIOR, Problem, annealed_until, sought_objects
from invertwin.cli.report import Again, Picture, Table, report_html, shown
from invertwin.cli.run_file import need, to_toml
from invertwin.cli.runs import RunFolder
from invertwin.cli.schema import MaterialValue, RunFile, SimulatedData
from invertwin.scene import Mesh, Scene

_ENDS = {
    "converged": "the loss no longer falls",
    "budget": "all steps used",
    "diverged": "diverged, best state kept",
}
_MODES = {FULL: "with boundary terms", INTERIOR: "interior only"}


COLUMNS = {
    "start_distance_m": "off at the start [m]",
    "start_angle_deg": "off at the start [°]",
    "position_error_m": "off at the end [m]",
    "rotation_error_deg": "off at the end [°]",
    "joint_error_before_deg": "joints off at the start, mean [°]",
    "joint_error_after_deg": "joints off at the end, mean [°]",
    "scale_error": "size off by",
    **{f"{name}_error": f"{name} off by" for name in get_args(MaterialValue)},
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
    "joint_error_before_deg": "joint angles to the truth, mean, start [°]",
    "joint_error_after_deg": "joint angles to the truth, mean, twin [°]",
    "scale_error": "size, share off the truth",
    **{f"{name}_error": f"{name}, share off the truth" for name in get_args(MaterialValue)},
    "start_loss_sharp": "loss without extra width, start",
    "loss_sharp": "loss without extra width, twin",
    "loss": "loss at the last step",
    "surrogate_correlation": "correlation of the surrogate with the mean of 16 exact looks, twin",
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


def tables_of(
    problem: Problem,
    metrics: dict[str, Any],
    start: Scene,
    twin: Scene,
    rows: dict[str, list[dict[str, Any]]],
) -> list[Table]:
    """What is printed, and shown in the report."""
    tables = [Table("Result", ["quantity", "value"], _result(problem.run, metrics))]
    for mode, fits in rows.items():
        if len(fits) > 1:
            keys = [key for key in COLUMNS if key in fits[0]]
            cells = [
                [row["start"] + 1, *(_ENDS[row[k]] if k == "status" else row[k] for k in keys)]
                for row in fits
            ]
            title = f"Starts, {_mode(mode, rows)}"
            tables.append(Table(title, ["start", *(COLUMNS[key] for key in keys)], cells))
    if len(rows) > 1 and any(is_shape_key(key) for key in metrics):
        tables.append(_variants(rows))
    cells = []
    for name in dict.fromkeys(sought_objects(problem.run)):
        scenes = [start, twin, *([problem.truth] if name in problem.known else [])]
        centers = [scene[name].center.detach().tolist() for scene in scenes]
        for i, axis in enumerate("xyz"):
            cells.append([f"{name}.{axis} [m]", *(_clean(center[i]) for center in centers)])
        if name in problem.known and "rotation_error_deg" in metrics:
            off = [build.residual(scene[name], problem.truth[name]) for scene in scenes]
            angles = [_clean(math.degrees(found.angle)) if found else None for found in off]
            cells.append([f"{name}, angle to the truth [°]", *angles])
    for row in cells:
        row += [None] * (4 - len(row))
    tables.append(Table("Parameters", ["parameter", "start", "result", "truth"], cells))
    units = {"translation": " [m]", "rotation": " [rad, rotation vector]", "scale": " [factor]"}
    moves = [[k + units.get(k.split(".")[-1], ""), v] for k, v in metrics["parameters"].items()]
    if moves:
        tables.append(Table("Moves from the start", ["parameter", "value"], moves))
    return tables


def _variants(rows: dict[str, list[dict[str, Any]]]) -> Table:
    """What each way to fit has made of the shape, means over the starts."""
    first = next(iter(rows.values()))[0]
    keys = [
        key.removeprefix("start_")
        for key in first
        if key.startswith("start_") and is_shape_key(key)
    ]
    cells = [["start", *(first[f"start_{key}"] for key in keys)]]
    for mode, fits in rows.items():
        means = [[row[key] for row in fits if key in row] for key in keys]
        cells.append([_mode(mode, rows), *(sum(v) / len(v) if v else None for v in means)])
    return Table("Ways to fit", ["fit", *(short_label(key) for key in keys)], cells)


def _mode(mode: str, modes: Iterable[str]) -> str:
    """A way to fit in words; beside variants the run's own is just that."""
    varied = any(other not in _MODES for other in modes)
    if mode == FULL and varied:
        return "as the run says"
    return _MODES.get(mode, mode.replace("_", " "))


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
    skipped = () if annealed_until(run) else ("start_loss_sharp", "loss_sharp")
    for key, label in _LABELS.items():
        if key in metrics and key not in skipped:
            rows.append([label, metrics[key]])
    for key in metrics:
        if is_shape_key(key) and not any(key.endswith(f"_{mode}") for mode in _modes(run)):
            rows.append([shape_label(key), metrics[key]])
            found = key.removeprefix("start_")
            if found not in metrics:
                rows.append([shape_label(found), None])
    for key, label in _CALIBRATION_LABELS.items():
        if key in metrics.get("calibration", {}):
            value = metrics["calibration"][key]
            rows.append([label, _ENDS[value] if key == "status" else value])
    return rows


def _modes(run: RunFile) -> list[str]:
    return [INTERIOR, *run.variants]


def _ended(run: RunFile, metrics: dict[str, Any]) -> str:
    steps = metrics["steps"]
    match metrics["status"]:
        case "budget":
            return f"all {steps} steps used"
        case "converged":
            return f"converged: the loss no longer falls after {metrics['steps']} steps"
    return f"diverged after {metrics['steps']} steps: the best state is kept"


def _limits(run: RunFile, metrics: dict[str, Any]) -> str:
    """How near the truth counts as a success."""
    settings = need(run, "reconstruct", "reconstruct")
    if "joint_error_after_deg" in metrics:
        return f"{settings.joint_limit_deg:g}° (mean over the joints)"
    turned = "rotation_error_deg" in metrics
    angle = f" and {settings.rotation_limit_deg:g}°" if turned else ""
    return f"{settings.position_limit:g} m{angle}"


def draw(
    problem: Problem,
    folder: RunFolder,
    rows: dict[str, list[dict[str, Any]]],
    metrics: dict[str, Any],
    start: Scene,
    twin: Scene,
    maps: dict[str, list[torch.Tensor]],
) -> None:
    """Write the pictures of the best fit.

    Args:
        problem: What was fitted.
        folder: Where to write.
        rows: Of every fit, by mode.
        metrics: Of the run.
        start: Scene at the start.
        twin: Scene that was found.
        maps: By what they show, one for every sensor.
    """
    sought = sought_objects(problem.run)
    truth = problem.truth
    known = {k: truth[k] for k in truth.names if k in problem.known and k in sought}
    scenes = {"truth": truth} if known else {}
    scenes |= {"start": start, "twin": twin}
    outline = Scene(known) if known else None
    radars = [sight.radar for sight in problem.sights.values()]
    figure = plotting.scene(scenes, radars, highlight=sought, outline=outline)
    folder.write_figure("scene.png", figure)
    simulated = isinstance(problem.run.data, SimulatedData)
    data = "data (exact simulation)" if simulated else "data (measured)"
    titles = {"measured": data, "start": "surrogate, start", "twin": "surrogate, twin"}
    for number, (name, sight) in enumerate(problem.sights.items()):
        titled = {titles[key]: found[number] for key, found in maps.items()}
        file = f"spectra_{name}.png" if name else "spectra.png"
        folder.write_figure(file, plotting.spectrum(titled, sight.grid))
    losses = {_mode(mode, rows): [row["losses"] for row in fits] for mode, fits in rows.items()}
    annealed = annealed_until(problem.run)
    before = metrics["start_loss_sharp"] if annealed else None
    figure = plotting.convergence(losses, annealed=annealed, before=before)
    folder.write_figure("loss.png", figure)


def draw_shapes(
    problem: Problem,
    folder: RunFolder,
    rows: dict[str, list[dict[str, Any]]],
    start: Scene,
    twin: Scene,
) -> None:
    """Writes the turning picture of the object, and how its measure went over the steps."""
    table = problem.run.measures
    assert table is not None
    scenes = {"truth": problem.truth} if table.object in problem.known else {}
    scenes |= {"start": start, "twin": twin}
    turns = problem.first.radar.rotations
    up = (0.0, 1.0, 0.0) if turns is None else turns.detach().mean(0)[:, 1]
    found = {name: scene[table.object] for name, scene in scenes.items()}
    meshes = {name: Mesh(item.vertices, item.mesh.faces) for name, item in found.items()}
    folder.write_bytes("turntable.gif", plotting.turntable(meshes, up))
    curves = {_mode(mode, rows): [_curve(row) for row in fits] for mode, fits in rows.items()}
    if any(curve for fits in curves.values() for curve in fits):
        losses = {_mode(mode, rows): [row["losses"] for row in fits] for mode, fits in rows.items()}
        folder.write_figure("convergence.png", plotting.convergence(losses, curves))


def _curve(row: dict[str, Any]) -> list[list[float]]:
    """How the measure went, from the start on where that is scored."""
    begun = row.get(f"start_{CURVE}")
    first: list[list[float]] = [] if begun is None or not row["curve"] else [[0, begun]]
    return [*first, *row["curve"]]


def write_report(
    run: RunFile, folder: RunFolder, metrics: dict[str, Any], tables: Sequence[Table]
) -> None:
    notes = {
        "scene": "In red: where the sought objects really are." if "success" in metrics else "",
        "spectra": "Each map in dB below its own peak; maps over direction are summed over frames.",
        "loss": _loss_note(run, metrics),
        "landscape": _landscape_note(run, metrics),
    }
    spectra = ["spectra", *(f"spectra_{name}" for name in run.observations)]
    shown = [
        Picture(
            name.capitalize().replace("_", ", "),
            (folder.path / f"{name}.png").read_bytes(),
            notes.get(name.split("_")[0], ""),
        )
        for name in ("scene", *spectra, "loss", "convergence", "landscape")
        if f"{name}.png" in folder.names
    ]
    title = run.title or "Reconstruction"
    again = Again("reconstruct run.toml", {"run.toml": to_toml(run)})
    parts = [*tables[:1], *shown, *tables[1:]]
    folder.write_text(
        "report.html", report_html(title, status(run, metrics), run.note, parts, again)
    )


def _loss_note(run: RunFile, metrics: dict[str, Any]) -> str:
    if annealed_until(run) is None:
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


def status(run: RunFile, metrics: dict[str, Any]) -> str:
    """What came out, in a sentence or two."""
    count = metrics.get("starts_count", 1)
    which = f"Best of {count} starts: " if count > 1 else ""
    ended = _ended(run, metrics)
    if "joint_error_after_deg" in metrics:
        score = f"{which}joints {metrics['joint_error_after_deg']:.1f}° off, mean; {ended}."
        return (
            f"{score} {metrics['successes']} of {count} starts end within {_limits(run, metrics)}."
        )
    if "position_error_m" not in metrics:
        if "chamfer_m" not in metrics:
            return f"{which}{ended}."
        change = f"from {metrics['start_chamfer_m']:.3f} to {metrics['chamfer_m']:.3f} m"
        return f"{which}Chamfer distance {change}; {ended}."
    turned = f" and {metrics['rotation_error_deg']:.2f}°" if "rotation_error_deg" in metrics else ""
    score = f"{which}{metrics['position_error_m']:.3f} m{turned} from the truth; {ended}."
    limits = _limits(run, metrics)
    if count == 1:
        return f"{score} A success is within {limits}: {shown(metrics['success'])}."
    return f"{score} {metrics['successes']} of {count} starts end within {limits}."
