"""`invertwin gradcheck`: the derivative of a map against central differences, scene by scene."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from invertwin.channel import Grid, Sampling
from invertwin.cli import build, pictures
from invertwin.cli.gradients import UNITS, theta_of
from invertwin.cli.report import Again, Picture, Table, report_html
from invertwin.cli.run_file import about, about_file, need, to_toml
from invertwin.cli.run_methods import compare, methods_table
from invertwin.cli.runs import PARTS, RunFolder
from invertwin.cli.schema import RunFile
from invertwin.errors import InputError
from invertwin.inversion.gradcheck import Check, GradientReport, gradcheck
from invertwin.models import SurrogateMap
from invertwin.radar.radar import Radar
from invertwin.scene import Scene

COLUMNS = (
    "scene",
    "L1 full",
    "L1 interior",
    "L1 no interior edges",
    "ratio",
    "L2 full",
    "correlation",
    "noise",
    "steps differ",
    "order",
    "pairs",
)


_LEGEND = (
    "L1 full, L1 interior: distance of the gradient to the differences over the size of the "
    "differences, ‖g − g_FD‖₁ / ‖g_FD‖₁, with boundary terms (silhouettes) and without; 0 is best. "
    "L1 no interior edges: without the shadows that surfaces cast on each other, where paths have "
    "two bounces or more. ratio: interior over full, how much the boundary terms gain. L2 full: "
    "the same in ‖·‖₂. correlation: of the two maps, bin by bin. noise: relative standard error "
    "of the differences, "
    "that is how sharp this check is. steps differ: relative change of the differences when "
    "their step is halved, noise included. order: how the gap to the differences grows with their "
    "step; 2 for a right gradient, 0 for a wrong one. pairs: difference pairs averaged."
)
_METHODS = (
    "Derivatives summed over elevation (range × azimuth) and over range (elevation × azimuth). "
    "Red: grows with θ; blue: falls. One colour scale for all that have a unit of power."
)


def run_gradcheck(
    runs: Mapping[str, RunFile],
    files: Mapping[str, Path],
    folder: RunFolder,
    say: Callable[[str], None],
) -> list[Table]:
    """Checks every run file, writes the folder, and returns the tables to print.

    Scenes that an interrupted run has finished are not computed again.
    """
    begin = time.perf_counter()
    scenes: dict[str, Any] = {}
    parts: list[Picture] = []
    methods: list[Table] = []
    for name, run in runs.items():
        part = f"{PARTS}/{name}.json"
        found = folder.read_json(part)
        if found is None:
            with about_file(files[name]):
                found = _check(name, run, folder, lambda line, name=name: say(f"{name}: {line}"))
            folder.write_json(part, found)
        scenes[name] = found
        parts += [
            Picture(run.title or name, (folder.path / f"{name}_scene.png").read_bytes()),
            Picture(name, (folder.path / f"{name}.png").read_bytes(), note=_note(run, found)),
        ]
        if "methods" in found:
            methods.append(methods_table(name, found["methods"]))
            png = (folder.path / f"{name}_methods.png").read_bytes()
            parts.append(Picture(methods[-1].title, png, note=_METHODS))
    seconds = time.perf_counter() - begin
    rows = [_row(*item) for item in scenes.items()]
    table = Table("Agreement with central differences", COLUMNS, rows, _LEGEND)
    metrics = {"task": "gradcheck", "scenes": scenes, "wall_seconds": seconds}
    if len(scenes) == 1 and methods:
        metrics["methods"] = next(iter(scenes.values()))["methods"]
    folder.write_json("metrics.json", metrics)
    count = "1 scene" if len(scenes) == 1 else f"{len(scenes)} scenes"
    folder.write_text(
        "report.html",
        report_html(
            "Gradient check", f"{count} checked.", "", [table, *methods, *parts], _again(runs)
        ),
    )
    folder.remove([f"{PARTS}/{name}.json" for name in runs])
    return [table, *methods]


def _again(runs: Mapping[str, RunFile]) -> Again:
    if len(runs) == 1:
        (run,) = runs.values()
        return Again("gradcheck run.toml", {"run.toml": to_toml(run)})
    files = {f"runs/{name}.toml": to_toml(run) for name, run in runs.items()}
    return Again("gradcheck runs/*.toml", files)


def _check(
    name: str, run: RunFile, folder: RunFolder, say: Callable[[str], None]
) -> dict[str, Any]:
    begin = time.perf_counter()
    settings = need(run, "gradcheck", "gradcheck")
    table = settings.parameter
    if run.surrogate.exact:
        raise InputError(
            "surrogate.exact: expected a smooth map to differentiate, got the exact chain; remove "
            "it: silhouettes of single rough points have no derivative"
        )
    scene = build.scene(run)
    radar = build.radar(need(run, "radar", "gradcheck"))
    grid = build.grid(need(run, "grid", "gradcheck"), radar)
    with about("gradcheck.parameter"):
        theta = theta_of(table, run, scene)
    if theta.shape and run.methods is not None:
        raise InputError(
            "methods: expected a parameter that moves something, got one of a shape; remove it"
        )
    sampling = Sampling(
        depth=settings.depth,
        samples=settings.samples,
        boundary_samples=settings.boundary_samples,
    )
    check = Check(
        repeats=settings.repeats,
        step=math.radians(settings.step_deg) if settings.step_deg else settings.step or 0.0,
        difference_samples=settings.difference_samples,
        noise=settings.noise,
        max_pairs=settings.max_pairs,
        scheme=settings.sampling,
    )
    report = gradcheck(
        SurrogateMap(grid, build.surrogate(run.surrogate), sampling),
        theta.module,
        theta.tangent,
        scene=scene,
        sensor=radar,
        of="sensor" if theta.of_radar else "scene",
        check=check,
        seed=run.seed,
        progress=say,
    )
    outer = report.no_interior_edges
    unit = UNITS.get(table.kind, f"per unit of {table.value}")
    folder.write_bytes(f"{name}.png", _maps(report, grid, unit))
    folder.write_bytes(f"{name}_scene.png", _picture(scene, radar, settings.parameter.object))
    others = {}
    if run.methods is not None:
        compared = compare(run, scene, radar, grid, theta, check.step, report, say)
        folder.write_bytes(f"{name}_methods.png", compared.picture)
        others["methods"] = compared.found
    return {
        "full": asdict(report.full),
        "interior": asdict(report.interior),
        **({} if outer is None else {"no_interior_edges": asdict(outer)}),
        "difference_noise": report.difference_noise,
        "step_agreement": report.step_agreement,
        "pairs": report.pairs,
        "seconds": time.perf_counter() - begin,
        **others,
    }


def _maps(report: GradientReport, grid: Grid, unit: str) -> bytes:
    maps = {
        "differences": report.difference,
        "full": report.gradient,
        "interior only": report.interior_gradient,
    }
    error = ("full − differences, own scale", np.asarray(report.gradient - report.difference))
    axes = pictures.Axes(grid.ranges.numpy(), grid.u.numpy(), grid.v.numpy())
    maps = {name: np.asarray(value) for name, value in maps.items()}
    return pictures.gradient_picture(maps, error, axes, unit)


def _picture(scene: Scene, radar: Radar, sought: str | None) -> bytes:
    drawing = pictures.Drawing(
        pictures.meshes_of(scene),
        sought=[] if sought is None else [sought],
        radar=radar.positions.numpy(),
    )
    return pictures.scene_picture({"scene": drawing}, pictures.frame_of(radar))


def _row(name: str, found: Mapping[str, Any]) -> list[Any]:
    full, interior = found["full"], found["interior"]
    return [
        name,
        full["relative_l1"],
        interior["relative_l1"],
        found.get("no_interior_edges", {}).get("relative_l1"),
        interior["relative_l1"] / full["relative_l1"] if full["relative_l1"] else None,
        full["relative_l2"],
        full["correlation"],
        found["difference_noise"],
        found["step_agreement"],
        full["order"],
        found["pairs"],
    ]


def _note(run: RunFile, found: Mapping[str, Any]) -> str:
    parameter = need(run, "gradcheck", "gradcheck").parameter
    what = f"{parameter.joint or ''} {parameter.kind} of {parameter.object or 'the radar'}".strip()
    return f"Derivative with respect to the {what}; {found['seconds']:.0f} s. {run.note}"
