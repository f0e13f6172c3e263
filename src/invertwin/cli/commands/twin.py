"""`invertwin twin`: automatic reconstruction from a recording, without an initial guess."""

import math
import time
from dataclasses import replace
from typing import Any

import tomli_w
import torch

from invertwin.capture import Capture, find_faults
from invertwin.cli import report
from invertwin.cli.commands.look import AnyRecording, read_recording, warning_tables
from invertwin.cli.commands.view import load_display
from invertwin.cli.exact_signals import simulate_exact
from invertwin.cli.options import TwinOptions, console
from invertwin.cli.run_file import is_run_file, load_run, require_section
from invertwin.cli.schema import RunFile, build
from invertwin.cli.schema.recordings import SimulatedData
from invertwin.constants import FRAME
from invertwin.discovery import DetectedObject, Twin, average_chirps, twin
from invertwin.discovery.shapes.primitives import MAX_DIELECTRIC_REFLECTANCE
from invertwin.errors import locate_errors
from invertwin.inversion.metrics import compare_shapes
from invertwin.plotting import found as pictures
from invertwin.plotting import spectrum
from invertwin.scene import RoughDielectric, Scene, merge_meshes, save_mesh
from invertwin.storage.folders import PARTS
from invertwin.storage.run_folder import RunFolder
from invertwin.viewer import view_html

_MIN_EXISTENCE_PROBABILITY = 0.5  # confidence of objects that are counted
_MAX_DEVIATION = 0.5  # of their positions over the longest range: more is a place unknown
_MAX_STATED = 6  # objects in the sentence that says what was found
# Of the command line; they win over those of a run file.
_TWIN_OPTION_NAMES = ("low", "high", "range_max", "level", "height", "rays", "seed")


def run_twin(arguments: TwinOptions, folder: RunFolder) -> tuple[list[report.ReportTable], str]:
    """Read a recording, search it, write the twin; return tables and a sentence to print.

    Raises:
        InputError: A recording or options that do not fit each other; nothing has been written.
    """
    begin = time.perf_counter()
    stated = ((name, getattr(arguments, name)) for name in _TWIN_OPTION_NAMES)
    options: dict[str, Any] = {name: value for name, value in stated if value is not None}
    truth, title = None, arguments.recording.name
    if is_run_file(arguments.recording):
        recording, truth, run = _load_run_file(arguments)
        table = {} if run.twin is None else run.twin.model_dump(exclude_none=True)
        options, title = table | {"seed": run.seed} | options, run.title or title
    else:
        _, recording = read_recording(arguments)
    faults = [str(fault) for fault in find_faults(recording)]
    found = twin(recording, **options, checkpoint=folder.file(f"{PARTS}/search.json"))
    sure, answer = _state_objects(found)
    metrics: dict[str, Any] = {
        "task": "twin",
        "answer": answer,
        "things": [thing.to_metrics() for thing in found.objects],
        "count": sure,
        "unsure": len(found.objects) - sure,
        "notes": list(found.notes),
        "stopped": found.stopped,
        "warnings": faults,
    }
    if found.image is not None:
        metrics["never_seen_share"] = float((found.image.view_counts == 0).double().mean())
    scene = found.scene
    if scene is not None and found.predicted is not None and found.observed is not None:
        explained = found.observed.double().log() - found.predicted.double().log()
        metrics["residual_log_std"] = float(explained.std())
    if truth is not None and scene is not None:
        whole = [merge_meshes([o.world_mesh for o in s.objects.values()]) for s in (scene, truth)]
        metrics["chamfer_m"] = compare_shapes(*whole, voxel=None).chamfer
        metrics["true_count"] = len(truth.names)
    metrics["wall_seconds"] = time.perf_counter() - begin
    if scene is not None:
        save_mesh(folder.file("twin.glb"), scene)
        folder.write_text("twin.toml", tomli_w.dumps(_describe_as_run(found, folder)))
    figure = pictures.ground(found)
    above = report.save_picture(folder, "ground", figure, "The ground from above", "ground")
    parts: list[Any] = [_object_table(found), *warning_tables(faults), above]
    parts += _draw_maps(found, folder)
    said = "; ".join((answer, *found.notes))
    still = average_chirps(recording)
    if found.calibration is not None:
        found.calibration.save(folder.file("channels.json"))
        still = found.calibration.apply(still)
    still.save(folder.file("capture.nc"))
    if scene is not None:
        view = view_html(*load_display(folder.file("capture.nc").parent))
        parts.insert(0, report.ReportView(view))
    if isinstance(recording, Capture):
        stated = {k: tuple(v) if isinstance(v, list) else v for k, v in options.items()}
        own = folder.path / "capture.nc"
        arguments = replace(arguments, recording=own, config=None, board=None, **stated)
    # Else movers are in the chirps alone, which a capture does not keep.
    again = arguments.command("twin", folder.path)
    tables = report.write_report(folder, metrics, title, f"{said}.", parts, again=again)
    if found.stopped:
        console.print(f"{said}: {folder.file('report.html')}", markup=False, soft_wrap=True)
        raise KeyboardInterrupt
    return tables, answer


def _load_run_file(options: TwinOptions) -> tuple[AnyRecording, Scene | None, RunFile]:
    """Load the data of a run file, their ground truth, and the run file."""
    with locate_errors(options.recording):
        run = load_run(options.recording)
        data = require_section(run, "data", "a twin")
        if not isinstance(data, SimulatedData):
            return data.build(), None, run
        radar = build.radar(require_section(run, "radar", "simulated data"))
        grid = build.grid(require_section(run, "grid", "simulated data"), radar)
        truth = build.true_scene(run)
        return Capture.from_beat(simulate_exact(run, truth, radar, grid).beat, radar), truth, run


def _state_objects(found: Twin) -> tuple[int, str]:
    """Count the likely objects, and state where they are."""
    limit = math.inf if found.grid is None else _MAX_DEVIATION * float(found.grid.ranges[-1])
    likely = [x for x in found.objects if x.existence_probability > _MIN_EXISTENCE_PROBABILITY]
    sure = [one for one in likely if _position_deviation(one) <= limit]
    count = f"{len(sure)} object{'s' * (len(sure) != 1)} found"
    said = [f"{count}{' so far' * found.stopped}, {len(found.objects) - len(sure)} doubtful"]
    for thing in sure[:_MAX_STATED]:
        place, off = report.format_place(thing.position[:2].tolist()), _position_deviation(thing)
        said.append(f"{thing.kind} at ({place})" + (f" ± {off:.2g} m" if off else ""))
    said += [f"{len(sure) - _MAX_STATED} more"] if len(sure) > _MAX_STATED else []
    return len(sure), "; ".join(said)


def _position_deviation(thing: DetectedObject) -> float:
    """The largest standard deviation of a position along the ground [m]."""
    return max(thing.deviations.get(name, 0.0) for name in ("x", "y", "range", "across"))


def _object_table(twin: Twin) -> report.ReportTable:
    heads = ["object", "kind", "confidence", *(f"{axis} [m]" for axis in "xyz")]
    heads += ["± [m]", "yaw [°]", "length, width, height [m]", "speed [m/s]"]
    rows: list[list[Any]] = []
    for thing in twin.objects:
        size, yaw = None, None
        if (figure := thing.shape) is not None:
            size = None if figure.kind == "corner" else [figure.length, figure.width, figure.height]
            yaw = math.degrees(figure.yaw) if figure.has_yaw else None
        rate = None if thing.velocity is None else float(thing.velocity.norm())
        share = f"{thing.kind} {thing.probabilities.get(thing.kind, 1.0):.2f}"
        row = [thing.name, share, thing.existence_probability, *thing.position.tolist()]
        rows.append([*row, _position_deviation(thing) or None, yaw, size, rate])
    return report.ReportTable("Objects", heads, rows, report.load_texts("notes")["things"])


def _draw_maps(twin: Twin, folder: RunFolder) -> list[report.ReportPicture]:
    if twin.predicted is None or twin.observed is None or twin.grid is None:
        return []
    shown = {"recording": twin.observed, "twin": twin.predicted}
    ratio = twin.observed.double() / twin.predicted.double()
    shown["recording over twin"] = ratio.to(twin.observed)
    return [report.save_picture(folder, "maps", spectrum(shown, twin.grid), "Maps", "twin_maps")]


def _describe_as_run(twin: Twin, folder: RunFolder) -> dict[str, Any]:
    """Return a run file that simulates the objects with a shape and refines their poses."""
    assert twin.grid is not None
    assert twin.scene is not None
    scene: dict[str, Any] = {}
    # Of raw counts all are brighter than metal: their ratios are kept, the gain is fitted.
    brightest = max((one.shape.brightness for one in twin.objects if one.shape), default=1.0)
    dimming = min(1.0, MAX_DIELECTRIC_REFLECTANCE / brightest)
    for thing in twin.objects:
        if (figure := thing.shape) is None:
            continue
        turn = [0.0, 0.0, math.degrees(figure.yaw)]
        sides = [figure.length, figure.width, figure.height]
        shape: dict[str, Any] = {"shape": "sphere", "radius": 0.5 * figure.length}
        if figure.kind in ("person", "vehicle", "corner", "prism"):
            item = twin.scene.objects[thing.name]
            mesh = replace(item.mesh, vertices=item.vertices - thing.position)
            save_mesh(folder.file(f"{thing.name}.ply"), mesh)
            shape = {"file": f"{thing.name}.ply"}
        elif figure.is_rectangular:
            shape = {"shape": "box", "size": sides, "rotation_deg": turn}
        elif figure.kind == "cylinder":
            shape = {"shape": "cylinder", "radius": 0.5 * figure.length, "height": figure.height}
        material = replace(figure, brightness=dimming * figure.brightness).material
        described: dict[str, Any] = {"kind": "rough_conductor"}
        if isinstance(material, RoughDielectric):
            value = float(torch.as_tensor(material.permittivity))
            described = {"kind": "rough_dielectric", "permittivity": value}
        scene[thing.name] = shape | {"position": thing.position.tolist(), "material": described}
    grid = twin.grid
    last = grid.range_start + grid.range_step * (grid.range_count - 1)
    return {
        "task": "reconstruct",
        "frame": FRAME,
        "title": "What was found",
        "scene": scene,
        "data": {"kind": "capture", "file": "capture.nc"},
        "grid": {
            "range_min": grid.range_start,
            "range_max": last,
            "u_max": min(1.0, float(grid.u.abs().max())) if grid.u_count > 1 else 1.0,
            "v_max": min(1.0, float(grid.v.abs().max())) if grid.v_count > 1 else 1.0,
        },
        "parameters": [{"kind": "translation", "object": name} for name in scene],
        "loss": {"kind": "heavy_tailed"},
        "reconstruct": {"depth": 1, "steps": 40, "samples": 100_000},
    }
