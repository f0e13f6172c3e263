"""`invertwin twin`: what stands in a recording, found with no start."""

import math
import time
from dataclasses import replace
from typing import Any

import tomli_w
import torch

from invertwin.capture import Capture, ChirpCapture
from invertwin.cli.commands.look import read_recording
from invertwin.cli.exact_signals import exact
from invertwin.cli.options import Find
from invertwin.cli.report import Picture, Table, finish, picture, texts
from invertwin.cli.schema import build
from invertwin.cli.schema.recordings import SimulatedData
from invertwin.cli.schema.run_file import about_file, is_run_file, load_run, need
from invertwin.discovery import Twin, still_capture, twin
from invertwin.inversion.initialisation.detections import Ground
from invertwin.inversion.metrics import compare_shapes
from invertwin.plotting import found as pictures
from invertwin.plotting import spectrum
from invertwin.scene import RoughDielectric, Scene, joined, save_mesh
from invertwin.storage.run_folder import RunFolder

_SURE = 0.5  # confidence of things that are counted
# Of the command line; they win over those of a run file.
_OPTIONS = ("low", "high", "range_max", "level", "height", "up", "rays", "seed")


def run_twin(find: Find, folder: RunFolder) -> list[Table]:
    """Read a recording, search it, write the twin; return the tables to print.

    Raises:
        InputError: A recording or options that do not fit each other; nothing has been written.
    """
    begin = time.perf_counter()
    stated = {name: getattr(find, name) for name in _OPTIONS}
    options = {name: value for name, value in stated.items() if value is not None}
    truth = None
    if is_run_file(find.recording):
        recording, truth, table = _of_run_file(find)
        options = table | options
    else:
        _, recording = read_recording(find)
    ground = Ground(options.get("up", "y"))
    rest = {name: value for name, value in options.items() if name != "up"}
    found = twin(recording, ground=ground, **rest)
    sure = [thing for thing in found.things if thing.confidence > _SURE]
    metrics: dict[str, Any] = {
        "task": "twin",
        "things": [thing.row() for thing in found.things],
        "count": len(sure),
        "unsure": len(found.things) - len(sure),
        "notes": list(found.notes),
    }
    if found.picture is not None:
        metrics["never_seen_share"] = float((found.picture.views == 0).double().mean())
    scene = found.scene
    if scene is not None and found.predicted is not None and found.observed is not None:
        explained = found.observed.double().log() - found.predicted.double().log()
        metrics["residual_log_std"] = float(explained.std())
    if truth is not None and scene is not None:
        metrics |= _scores(scene, truth)
    metrics["wall_seconds"] = time.perf_counter() - begin
    if scene is not None:
        save_mesh(folder.file("twin.glb"), scene)
        folder.write_text("twin.toml", tomli_w.dumps(_described(found, folder)))
    parts: list[Table | Picture] = [_table(found)]
    parts += [
        picture(folder, "ground", pictures.ground(found), "The ground from above", "ground"),
        *_maps(found, folder),
    ]
    said = "; ".join(found.notes) or f"{len(sure)} things, {metrics['unsure']} unsure ones"
    title = find.recording.name
    still = still_capture(recording)
    if found.calibration is not None:
        found.calibration.save(folder.file("channels.json"))
        still = found.calibration.apply(still)
    still.save(folder.file("capture.nc"))
    # Movers are in the chirps alone, which a capture does not keep.
    name = title if isinstance(recording, ChirpCapture) else "capture.nc"
    again = " ".join(["twin", name, *_stated(options)])
    return finish(folder, metrics, title, f"{said}.", parts, again=again)


def _stated(options: dict[str, Any]) -> list[str]:
    """Options as the command line takes them."""
    found: list[str] = []
    for name, value in options.items():
        values = value if isinstance(value, list | tuple) else [value]
        found += [f"--{name.replace('_', '-')}", *(str(number) for number in values)]
    return found


def _of_run_file(
    find: Find,
) -> tuple[Capture | ChirpCapture, Scene | None, dict[str, Any]]:
    """The data of a run file, what is true of them, and what it says of the search."""
    with about_file(find.recording):
        run = load_run(find.recording)
        given = {} if run.twin is None else run.twin.model_dump(exclude_none=True)
        given["seed"] = run.seed
        data = need(run, "data", "a twin")
        if not isinstance(data, SimulatedData):
            return data.build(), None, given
        radar = build.radar(need(run, "radar", "simulated data"))
        grid = build.grid(need(run, "grid", "simulated data"), radar)
        truth = build.true_scene(run)
        capture = Capture.from_beat(exact(run, truth, radar, grid).beat, radar)
        return capture, truth, given


def _scores(scene: Scene, truth: Scene) -> dict[str, Any]:
    whole = [
        joined(
            [replace(item.mesh, vertices=item.vertices.detach()) for item in one.objects.values()]
        )
        for one in (scene, truth)
    ]
    return {
        "chamfer_m": compare_shapes(whole[0], whole[1], voxel=None).chamfer,
        "true_count": len(truth.names),
    }


def _table(found: Twin) -> Table:
    up = found.ground.vertical
    heads = ["thing", "kind", "confidence", *(f"{'xyz'[axis]} [m]" for axis in range(3))]
    heads += ["± [m]", "yaw [°]", "length, width, height [m]", "speed [m/s]"]
    rows: list[list[Any]] = []
    for thing in found.things:
        figure = thing.figure
        along = [*("xyz"[axis] for axis in range(3) if axis != up), "range", "across"]
        known = [thing.deviations[name] for name in along if name in thing.deviations]
        size, yaw, rate = None, None, None
        if figure is not None:
            size = None if figure.kind == "corner" else [figure.length, figure.width, figure.height]
            yaw = math.degrees(figure.yaw) if figure.turned else None
        if thing.velocity is not None:
            rate = float(thing.velocity.norm())
        share = f"{thing.kind} {thing.probabilities.get(thing.kind, 1.0):.2f}"
        row = [thing.name, share, thing.confidence, *thing.position.tolist()]
        rows.append([*row, max(known) if known else None, yaw, size, rate])
    return Table("Things", heads, rows, texts("notes")["things"])


def _maps(found: Twin, folder: RunFolder) -> list[Picture]:
    if found.predicted is None or found.observed is None or found.grid is None:
        return []
    shown = {"recording": found.observed, "twin": found.predicted}
    ratio = found.observed.double() / found.predicted.double()
    shown["recording over twin"] = ratio.to(found.observed)
    return [picture(folder, "maps", spectrum(shown, found.grid), "Maps", "twin_maps")]


def _described(found: Twin, folder: RunFolder) -> dict[str, Any]:
    """A run file that simulates the things that have a shape, and fits their poses on."""
    assert found.grid is not None
    assert found.scene is not None
    scene: dict[str, Any] = {}
    axis = found.ground.vertical
    for thing in found.things:
        if (figure := thing.figure) is None:
            continue
        turn = [0.0, 0.0, 0.0]
        turn[axis] = math.degrees(figure.yaw)
        sides = [figure.length] * 3
        sides[found.ground.level[1]] = figure.width
        sides[axis] = figure.height
        shape: dict[str, Any] = {"shape": "sphere", "radius": 0.5 * figure.length}
        if figure.kind in ("person", "vehicle", "corner", "prism"):
            item = found.scene.objects[thing.name]
            mesh = replace(item.mesh, vertices=item.vertices - thing.position)
            save_mesh(folder.file(f"{thing.name}.ply"), mesh)
            shape = {"file": f"{thing.name}.ply"}
        elif figure.boxed:
            shape = {"shape": "box", "size": sides, "rotation_deg": turn}
        elif figure.kind == "cylinder":
            shape = {"shape": "cylinder", "radius": 0.5 * figure.length, "height": figure.height}
            if found.ground.up == "z":
                shape["rotation_deg"] = [90.0, 0.0, 0.0]
        material = figure.material
        described: dict[str, Any] = {"kind": "rough_conductor"}
        if isinstance(material, RoughDielectric):
            value = float(torch.as_tensor(material.permittivity))
            described = {"kind": "rough_dielectric", "permittivity": value}
        scene[thing.name] = {
            **shape,
            "position": thing.position.tolist(),
            "material": described,
        }
    grid = found.grid
    last = grid.range_start + grid.range_step * (grid.range_count - 1)
    return {
        "task": "reconstruct",
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
