"""Results of a reconstruction: tables, pictures, the report."""

import math
from collections.abc import Mapping
from typing import Any

from scipy.spatial.transform import Rotation

from invertwin import plotting
from invertwin.cli import report
from invertwin.cli.fits.problem import INTERIOR_ONLY, OWN_METHOD, Fits, Problem, Row
from invertwin.cli.fits.radar_models import blur_end_step
from invertwin.cli.fits.scores import ANGLES, DOUBTED, error_bar_table
from invertwin.cli.fits.shape_scores import CURVE_KEY, is_shape_key, shape_label, short_label
from invertwin.cli.report import ReportPicture, ReportTable, format_cell, format_place, load_texts
from invertwin.cli.schema import RunFile, SimulatedData
from invertwin.scene import Scene
from invertwin.scene.material.values import RANGES
from invertwin.scene.shape_models.density import replace_clouds
from invertwin.storage.run_folder import RunFolder

_MATERIAL_ERRORS = {f"{name}_error": name for name in RANGES}
_INITIAL_METRICS = (
    ("distance to the truth [m]", "start_distance_m", "position_error_m"),
    ("angle to the truth [°]", "start_angle_deg", "rotation_error_deg"),
    ("size, share off the truth", "initial_scale_error", "scale_error"),
    ("loss without blur", "start_loss_sharp", "loss_sharp"),
)
_START_CURVE_KEY = f"start_{CURVE_KEY}"
START_COLUMNS = load_texts("starts") | {k: f"{name} off by" for k, name in _MATERIAL_ERRORS.items()}
"""Heads of the table of starts; what metrics.json says of the best one."""


def make_tables(fits: Fits, metrics: Row) -> list[ReportTable]:
    """Make the tables that are printed and shown in the report.

    Args:
        fits: all fits of a run to maps of radars.
        metrics: numbers of the run.
    """
    parameters = error_bar_table(metrics, parameter_values(fits))
    tables = [_result_table(fits.problem.run, metrics), parameters]
    for way, rows in _rows_by_way(fits):
        if len(rows) > 1:
            keys = [key for key in START_COLUMNS if key in rows[0]]
            cells: list[list[Any]] = []
            for row in rows:
                values = (_format_status(key, row[key], row.get("lost", False)) for key in keys)
                cells.append([row["start"] + 1, *values])
            heads = ["start", *(START_COLUMNS[key] for key in keys)]
            tables.append(ReportTable(f"Starts, {way}", heads, cells))
    if len(fits.rows) > 1 and any(is_shape_key(key) for key in metrics):
        tables.append(_method_table(fits))
    if "initial_seconds" in metrics:
        tables.append(_refinement_table(fits.problem.run, metrics))
    return tables


def _rows_by_way(fits: Fits) -> list[tuple[str, list[Row]]]:
    """The rows of every way to fit, by its name in words."""
    own = "with boundary terms" if fits.problem.run.fit_settings.boundary else "interior only"
    if set(fits.rows) - {OWN_METHOD, INTERIOR_ONLY}:
        own = "as the run says"
    names = {method: method.replace("_", " ") for method in fits.rows} | {OWN_METHOD: own}
    return [(names[method], rows) for method, rows in fits.rows.items()]


def _result_table(run: RunFile, metrics: dict[str, Any]) -> ReportTable:
    rows: list[list[Any]] = [["verdict", metrics["verdict"]]]
    rows.append(["why it stopped", _stop_reason(metrics)])
    if "success" in metrics:
        count, limits = metrics["starts_count"], _success_limits(run, metrics)
        if count == 1:
            rows.append([f"within {limits} of the truth", metrics["success"]])
        else:
            rows.append([f"starts that end within {limits}", f"{metrics['successes']} of {count}"])
        if "successes_interior_only" in metrics:
            text = f"{metrics['successes_interior_only']} of {count}"
            rows.append(["the same without boundary terms", text])
    if "share" in metrics.get("clutter", {}):
        rows.append(["echoes that the scene lacks", _describe_clutter(**metrics["clutter"])])
    if "image_peak_m" in metrics:
        place = format_place(metrics["image_peak_m"])
        rows.append(["made again from the echo of the image", f"({place}) m"])
    skip = () if blur_end_step(run) else ("start_loss_sharp", "loss_sharp")
    rows.extend(map(list, report.quantity_table("", metrics, skip=skip).rows))
    made_of = {key: name for key, name in _MATERIAL_ERRORS.items() if key in metrics}
    rows += [[f"{name}, share off the truth", metrics[key]] for key, name in made_of.items()]
    for key in metrics:
        if _is_own_shape_key(run, key):
            rows.append([shape_label(key), metrics[key]])
            found = key.removeprefix("start_")
            if found not in metrics:
                rows.append([shape_label(found), None])
    calibration = {k: _format_status(k, v) for k, v in metrics.get("calibration", {}).items()}
    rows.extend(map(list, report.quantity_table("", calibration, label_table="calibration").rows))
    return ReportTable("Result", ["quantity", "value"], rows)


def _describe_clutter(kept: bool, share: float, strongest_m: list[float]) -> str:
    use = "count as background" if kept else "but a fit among them is no better"
    return f"{100 * share:.2g} % of the power, strongest at ({format_place(strongest_m)}) m; {use}"


def _method_table(fits: Fits) -> ReportTable:
    """Measures of the shape by each way to fit, means over the starts."""
    ways = _rows_by_way(fits)
    first = ways[0][1][0]
    begun = [key for key in first if key.startswith("start_") and is_shape_key(key)]
    keys = [key.removeprefix("start_") for key in begun]
    cells: list[list[Any]] = [["start", *(first[key] for key in begun)]]
    for way, rows in ways:
        means = [[row[key] for row in rows if key in row] for key in keys]
        cells.append([way, *(sum(v) / len(v) if v else None for v in means)])
    return ReportTable("Ways to fit", ["fit", *(short_label(key) for key in keys)], cells)


def parameter_values(fits: Fits) -> dict[str, list[Any]]:
    """Return start, result and truth of all that is fitted; angles of rotation vectors in degrees.

    Args:
        fits: all fits of a run.
    """
    problem, values = fits.problem, dict[str, list[Any]]()
    ends = replace_clouds(fits.start.scene), replace_clouds(fits.found.scene)
    for name in dict.fromkeys(problem.run.fitted_objects):
        scenes = [*ends, *([problem.truth] if name in problem.known_objects else [])]
        turns = [Rotation.from_matrix(one[name].transform[:3, :3].detach()) for one in scenes]
        rows = zip("xyz", *(one[name].center.detach().tolist() for one in scenes), strict=True)
        angles = list(zip(ANGLES, *(one.as_rotvec(degrees=True) for one in turns), strict=True))
        # An angle that stays where the run file has it is no unknown.
        rows = [*rows, *(row for row in angles if not math.isclose(*row[1:3], abs_tol=1e-9))]
        for coordinate, *row in rows:
            found = [round(float(value), 9) + 0.0 for value in row]  # + 0.0: no negative zeros
            values[f"{name}.{coordinate}"] = found + [None] * (3 - len(found))
    for name, value in fits.best.get("values", {}).items():
        if name.split(".")[-1] == "position" and isinstance(value, list):
            starts, truth = fits.start.transmitter, problem.reference
            real = [None] * 3 if truth is None else truth.positions[0].tolist()
            begun = [None] * 3 if starts is None else starts.tolist()
            for row in zip("xyz", begun, value, real, strict=True):
                values[f"{name.split('.')[0]}.{row[0]}"] = list(row[1:])
        elif name.split(".")[-1] not in ("translation", "rotation"):
            values[name] = [None, value, None]
    return values


def state_positions(fits: Fits, confidence: Row) -> str:
    """State positions and angles of the fitted parameters, with error bars where these hold.

    Args:
        fits: all fits of a run.
        confidence: verdict and error bars of the best one.
    """
    bars = {} if confidence["verdict"] in DOUBTED else confidence.get("standard_deviations", {})
    values, said = parameter_values(fits), []
    for name in dict.fromkeys(key.split(".")[0] for key in values if key.endswith(".x")):
        place = ", ".join(f"{values[f'{name}.{axis}'][1]:.3f}" for axis in "xyz")
        own = [bars.get(f"{name}.{axis}", 0.0) for axis in "xyz"]
        text = f"{name} at ({place}){f' ± {math.hypot(*own):.2g}' if any(own) else ''} m"
        for axis in (axis for axis in ANGLES if f"{name}.{axis}" in values):
            width = math.degrees(bars.get(f"{name}.{axis}", 0.0))
            value = f"{values[f'{name}.{axis}'][1]:.1f}" + (f" ± {width:.2g}" if width else "")
            text += f", {axis} {value}°"
        said.append(text)
    return "; ".join(said)


def _is_own_shape_key(run: RunFile, key: str) -> bool:
    """Return True if a number measures the shape that the run's own way to fit has found."""
    return is_shape_key(key) and not key.endswith(tuple(f"_{mode}" for mode in run.variants))


def _refinement_table(run: RunFile, metrics: dict[str, Any]) -> ReportTable:
    """Improvement by the fit: the conventional guess beside the twin."""
    keys = [key for key in metrics if _is_own_shape_key(run, key)]
    shapes = [(shape_label(key), f"start_{key}", key) for key in keys]
    rows = [
        [label, metrics[before], metrics[after]]
        for label, before, after in (*_INITIAL_METRICS, *shapes)
        if metrics.get(before) is not None and metrics.get(after) is not None
    ]
    legend = load_texts("notes")["initial_points" if "initial_points" in metrics else "initial"]
    columns = ["quantity", "conventional guess", "refined twin"]
    return ReportTable("What the refinement added", columns, rows, legend.format(**metrics))


def draw_pictures(fits: Fits, metrics: Row, folder: RunFolder) -> list[ReportPicture]:
    """Write the pictures of the best fit; return those of the report.

    Args:
        fits: all fits of a run to maps of radars.
        metrics: numbers of the run.
        folder: gets the pictures.
    """
    problem, by_way = fits.problem, _rows_by_way(fits)
    ends = {"start": replace_clouds(fits.start.scene), "twin": replace_clouds(fits.found.scene)}
    run, truth, fitted_names = problem.run, problem.truth, problem.run.fitted_objects
    known = {k: truth[k] for k in truth.names if k in problem.known_objects and k in fitted_names}
    scenes = ({"truth": truth} if known else {}) | ends
    outline = Scene(known) if known else None
    radars = [item.sensor for item in problem.sensor_data.values()]
    figure = plotting.scene(scenes, radars, highlight=fitted_names, outline=outline)
    legend = "scene" if "success" in metrics else ""
    found = [report.save_picture(folder, "scene", figure, note=legend)]
    data = "exact simulation" if isinstance(run.data, SimulatedData) else "measured"
    titles = {"measured": f"data ({data})", "start": "surrogate, start", "twin": "surrogate, twin"}
    for number, (name, item) in enumerate(problem.sensor_data.items()):
        titled = {titles[key]: maps[number] for key, maps in fits.maps.items()}
        tail = f"_{name}" if name else ""
        figure = plotting.spectrum(titled, item.grid)
        found.append(report.save_picture(folder, f"spectra{tail}", figure, note="spectra"))
        if item.grid.u_count > 1 or item.sensor.frame_count > 1:
            del titled[titles["start"]]
            marked = {"twin": ends["twin"]} | ({"truth": outline} if outline else {})
            figure = plotting.from_above(titled, item.grid, item.sensor, marked)
            file = f"above_{name}" if name else "above"
            found.append(report.save_picture(folder, file, figure, "From above", "above"))
    residuals = fits.found.verdict.residuals
    for (name, item), apart in zip(problem.sensor_data.items(), residuals, strict=False):
        figure = plotting.residuals(apart, item.grid)
        file = f"residuals_{name}" if name else "residuals"
        found.append(report.save_picture(folder, file, figure, note="residuals"))
    losses = {way: [row["losses"] for row in rows] for way, rows in by_way}
    annealed, notes = blur_end_step(run), load_texts("notes")
    before = metrics["start_loss_sharp"] if annealed else None
    figure, note = plotting.convergence(losses, annealed=annealed, before=before), ""
    if annealed is not None:
        known = None not in (before, metrics["loss_sharp"])
        note = notes["loss"] + (notes["loss_sharp"].format(**metrics) if known else "")
    found.append(report.save_picture(folder, "loss", figure, note=note))
    if run.measures is not None:
        folder.write_bytes("turntable.gif", _draw_turntable(problem, ends, run.measures.object))
        curves = {way: [_shape_curve(row) for row in rows] for way, rows in by_way}
        if any(curve for fits in curves.values() for curve in fits):
            figure = plotting.convergence(losses, curves)
            found.append(report.save_picture(folder, "convergence", figure))
    if run.landscape is not None and "landscape" in metrics:
        minima = metrics["landscape"]["local_minima"]["exact"]
        span = {"span_mm": run.landscape.exact_span * 1e3}
        note = notes["landscape"].format(object=run.landscape.object, exact=minima, **span)
        found.append(ReportPicture("Landscape", folder.file("landscape.png").read_bytes(), note))
    return found


def _draw_turntable(problem: Problem, ends: Mapping[str, Scene], name: str) -> bytes:
    """The object from all around, moving."""
    scenes = ({"truth": problem.truth} if name in problem.known_objects else {}) | dict(ends)
    turns = problem.first_sensor.sensor.rotations
    up = (0.0, 0.0, 1.0) if turns is None else turns.detach().mean(0)[:, 2]
    meshes = {key: scene[name].world_mesh for key, scene in scenes.items()}
    return plotting.turntable(meshes, up)


def _shape_curve(row: dict[str, Any]) -> list[list[float]]:
    """Curve of the measure, from the start on where that is scored."""
    if not row["curve"] or _START_CURVE_KEY not in row:
        return row["curve"]
    return [[0, row[_START_CURVE_KEY]], *row["curve"]]


def describe_outcome(run: RunFile, metrics: dict[str, Any], *, counted: bool = False) -> str:
    """Say in a sentence or two what came out.

    Args:
        run: the run file.
        metrics: numbers of the run.
        counted: count the successes of a single start, too.
    """
    count = metrics.get("starts_count", 1)
    which = f"Found: {metrics['answer']}. " if metrics.get("answer") else ""
    which += f"Best of {count} starts: " if count > 1 else ""
    ended, believed = _stop_reason(metrics), load_texts("verdicts")[metrics["verdict"]]
    many = counted or "joint_error_after_deg" in metrics or count > 1
    if "joint_error_after_deg" in metrics:
        score = f"{which}joints {metrics['joint_error_after_deg']:.1f}° off, mean; {ended}."
    elif "position_error_m" in metrics:
        turn = metrics.get("rotation_error_deg")
        turned = "" if turn is None else f" and {turn:.2f}°"
        score = f"{which}{metrics['position_error_m']:.3f} m{turned} from the truth; {ended}."
    elif "chamfer_m" in metrics:
        change = f"from {metrics['start_chamfer_m']:.3f} to {metrics['chamfer_m']:.3f} m"
        return f"{which}Chamfer distance {change}; {ended}."
    else:
        return f"{which}{ended}. {believed}"
    limits = _success_limits(run, metrics)
    if many:
        return f"{score} {metrics['successes']} of {count} starts end within {limits}. {believed}"
    return f"{score} A success is within {limits}: {format_cell(metrics['success'])}. {believed}"


def _stop_reason(metrics: dict[str, Any]) -> str:
    return load_texts("outcomes")[metrics["status"]].format(steps=metrics["steps"])


def _success_limits(run: RunFile, metrics: dict[str, Any]) -> str:
    """Largest errors of a success, in words."""
    settings = run.fit_settings
    if "joint_error_after_deg" in metrics:
        return f"{settings.joint_limit_deg:g}° (mean over the joints)"
    angle = f" and {settings.rotation_limit_deg:g}°" if "rotation_error_deg" in metrics else ""
    return f"{settings.position_limit:g} m{angle}"


def _format_status(key: str, value: Any, uninformative: bool = False) -> Any:
    """Cell of a number; a start that is lost says so, however it ended."""
    return load_texts("ends")["lost" if uninformative else value] if key == "status" else value
