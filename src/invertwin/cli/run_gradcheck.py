"""`invertwin gradcheck`: the derivative of a map against central differences, scene by scene."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from matplotlib.figure import Figure
from torch import Tensor

from invertwin import plotting
from invertwin.channel import Grid, Sampling
from invertwin.cli import build
from invertwin.cli.gradients import theta_of
from invertwin.cli.report import Picture, Table, finish, texts
from invertwin.cli.run_file import about, about_file, need
from invertwin.cli.runs import PARTS, RunFolder
from invertwin.cli.schema import RunFile
from invertwin.errors import InputError
from invertwin.inversion.gradcheck import Check, GradientReport, gradcheck
from invertwin.models import SurrogateMap
from invertwin.radar.radar import Radar
from invertwin.scene import Scene

_COLUMNS = (
    *("scene", "L1 full", "L1 interior", "L1 no interior edges", "ratio", "L2 full"),
    *("correlation", "noise", "steps differ", "order", "pairs"),
)


@dataclass(frozen=True)
class Checked:
    """A gradient check that is done, for the studies that compare something with it."""

    run: RunFile
    scene: Scene  # at θ = 0, as the radar
    radar: Radar
    grid: Grid
    direction: Callable[[Scene, Radar, Tensor], tuple[Scene, Radar]]  # of θ
    step: float  # ε of the differences
    report: GradientReport
    say: Callable[[str], None]  # takes a line of progress


@runtime_checkable
class GradcheckStudy(Protocol):
    """A run-file section of a plugin that compares something with a gradient check.

    The section's name is the key of its results in metrics.json.
    """

    picture_note: str

    def compare(self, checked: Checked) -> tuple[dict[str, Any], Figure]:
        """Results for metrics.json, and a figure."""
        ...

    def table(self, name: str, found: Mapping[str, Any]) -> Table:
        """The table of those results.

        Args:
            name: Of the gradient check.
            found: What `compare` returned, also when it was read back from JSON.
        """
        ...


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
    parts: list[Table | Picture] = []
    studies: list[Table] = []
    compared: dict[str, Any] = {}
    for name, run in runs.items():
        part = f"{PARTS}/{name}.json"
        found = folder.read_json(part)
        if found is None:
            with about_file(files[name]):
                found = _check(name, run, folder, lambda line, name=name: say(f"{name}: {line}"))
            folder.write_json(part, found)
        scenes[name] = found
        parts.append(_picture(folder, f"{name}_scene", run.title or name))
        parts.append(_picture(folder, name, name, _note(run, found)))
        for key, study in _studies(run).items():
            compared[key] = found[key]
            studies.append(study.table(name, found[key]))
            parts.append(_picture(folder, f"{name}_{key}", studies[-1].title, study.picture_note))
    metrics = {"task": "gradcheck", "scenes": scenes, "wall_seconds": time.perf_counter() - begin}
    if len(scenes) == 1:
        metrics |= compared
    rows = [_row(*item) for item in scenes.items()]
    legend = texts("notes")["gradcheck"]
    table = Table("Agreement with central differences", _COLUMNS, rows, legend)
    count = "1 scene" if len(scenes) == 1 else f"{len(scenes)} scenes"
    parts = [table, *studies, *parts]
    found = finish(folder, metrics, "Gradient check", f"{count} checked.", parts, again="gradcheck")
    folder.remove([f"{PARTS}/{name}.json" for name in runs])
    return found


def _picture(folder: RunFolder, name: str, title: str, note: str = "") -> Picture:
    """A picture that is in the folder, perhaps from before an interruption."""
    return Picture(title, (folder.path / f"{name}.png").read_bytes(), note)


def _check(
    name: str, run: RunFile, folder: RunFolder, say: Callable[[str], None]
) -> dict[str, Any]:
    begin = time.perf_counter()
    settings = need(run, "gradcheck", "gradcheck")
    table = settings.parameter
    if run.surrogate.exact:
        raise InputError(
            "surrogate.exact: expected a smooth map to differentiate, got exact signals; remove "
            "it: silhouettes of single rough points have no derivative"
        )
    scene = build.scene(run)
    radar = build.radar(need(run, "radar", "gradcheck"))
    grid = build.grid(need(run, "grid", "gradcheck"), radar)
    with about("gradcheck.parameter"):
        theta = theta_of(table, run, scene)
    for key in _studies(run) if theta.shape else ():
        raise InputError(
            f"{key}: expected a parameter that moves something, got one of a shape; remove it"
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
    folder.write_figure(f"{name}.png", _maps(report, grid, theta.unit))
    moved = [table.object] if hasattr(table, "object") else []
    folder.write_figure(f"{name}_scene.png", plotting.scene(scene, radar, highlight=moved))
    others = {}
    checked = Checked(run, scene, radar, grid, theta.direction(), check.step, report, say)
    for key, study in _studies(run).items():
        others[key], figure = study.compare(checked)
        folder.write_figure(f"{name}_{key}.png", figure)
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


def _studies(run: RunFile) -> dict[str, GradcheckStudy]:
    """The sections that compare something with the gradient check."""
    values = {key: getattr(run, key) for key in type(run).model_fields}
    return {key: value for key, value in values.items() if isinstance(value, GradcheckStudy)}


def _maps(report: GradientReport, grid: Grid, unit: str) -> Figure:
    maps = {
        "differences": report.difference,
        "full": report.gradient,
        "interior only": report.interior_gradient,
    }
    error = {"full − differences, own scale": report.gradient - report.difference}
    label = f"∂ power (received/sent) [{unit}]"
    return plotting.gradient(maps, grid, label=label, own_scale=error)


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
    what = f"{parameter.kind} of {getattr(parameter, 'object', 'the radar')}"
    what = f"{getattr(parameter, 'joint', '')} {what}".strip()
    return f"Derivative with respect to the {what}; {found['seconds']:.0f} s. {run.note}"
