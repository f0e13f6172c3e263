"""How near found shapes are to true ones: numbers of a run, and their curves over the steps."""

from collections.abc import Callable
from typing import Any

import torch

from invertwin.cli.fits.problem import Problem
from invertwin.cli.report import texts
from invertwin.cli.schema.run_file import about
from invertwin.errors import InputError
from invertwin.inversion.metrics import (
    ShapeMetrics,
    compare_shapes,
    is_watertight,
    topology,
    volume_iou,
)
from invertwin.scene import Mesh, Scene
from invertwin.scene.shape_models.density import without_clouds

CURVE = "chamfer_m"
"""What the curves show."""
_BEGINNINGS = ("chamfer", "fscore", "iou", "normal_consistency", "components", "euler_number")
_WHOSE = {"start_": ", start", "true_": ", truth", "": ""}
_PARTS = {"_whole": ", whole surface", "_seen": ", surface that is seen", "": ""}


def is_shape_key(key: str) -> bool:
    """Whether a number of a fit is a measure of its shape."""
    return key.startswith(tuple(whose + name for whose in _WHOSE for name in _BEGINNINGS))


def shape_label(key: str) -> str:
    """What a measure is, in words."""
    whose = next(whose for whose in _WHOSE if key.startswith(whose))
    part = next(part for part in _PARTS if part in key)
    name = key.removeprefix(whose).replace(part, "")
    if name.startswith("fscore"):
        name = f"F-score at {name.removeprefix('fscore_').removesuffix('cm')} cm"
    return texts("shapes").get(name, name) + _PARTS[part] + _WHOSE[whose]


def short_label(key: str) -> str:
    """A measure as the head of a narrow column."""
    if key.startswith("fscore"):
        return f"F {key.removeprefix('fscore_').removesuffix('cm')} cm"
    return texts("shape_columns").get(key, key)


def check_measures(problem: Problem, start: Scene) -> None:
    """Refuse settings of measures before any fit.

    Raises:
        InputError: Too many voxels or none, a start without area, or one that is not seen.
    """
    table = problem.measures
    if table is None:
        return
    with about("measures"):
        _compared(problem, start, table.seen)
        truth = _placed(problem.truth, table.object)
        if is_watertight(truth):
            volume_iou(truth, truth, table.voxel)


def shape_scores(problem: Problem, start: Scene, twin: Scene) -> dict[str, Any]:
    """Measures of the found shape, whole and as far as some radar position sees it.

    Those without an ending are the ones that the run file asks for. Parts and holes are those of
    the whole surface, also of the truth, each where it is watertight. What a shape does not have,
    such as one that has collapsed, is left out.
    """
    table = problem.measures
    if table is None:
        return {}
    rows = _rows(problem, twin, table.seen)
    rows |= _rows(problem, twin, False, "_whole") | _rows(problem, twin, True, "_seen")
    rows |= _topology(twin[table.object].mesh)
    truth = _topology(problem.truth[table.object].mesh)
    before = _rows(problem, start, table.seen) | _topology(start[table.object].mesh)
    rows |= {f"true_{key}": value for key, value in truth.items()}
    return rows | {f"start_{key}": value for key, value in before.items()}


def watch_of(problem: Problem) -> Callable[[Scene], dict[str, float]] | None:
    """What is noted of the twin during the fit, where the truth is known."""
    table = problem.measures
    if table is None:
        return None

    def watch(scene: Scene) -> dict[str, float]:
        return {CURVE: _compared(problem, without_clouds(scene), table.seen, volume=False).chamfer}

    return watch


def _compared(problem: Problem, scene: Scene, seen: bool, volume: bool = True) -> ShapeMetrics:
    table = problem.measures
    assert table is not None
    eyes = [sight.radar.positions.detach() for sight in problem.sights.values()]
    return compare_shapes(
        _placed(scene, table.object),
        _placed(problem.truth, table.object),
        seen_from=torch.cat(eyes) if seen else None,
        thresholds=table.thresholds,
        voxel=table.voxel if volume else None,
    )


def _rows(problem: Problem, scene: Scene, seen: bool, ending: str = "") -> dict[str, Any]:
    """Measures as metrics keep them; none if the shape is empty or invisible."""
    try:
        found = _compared(problem, scene, seen)
    except InputError:
        return {}
    rows: dict[str, Any] = {f"chamfer{ending}_m": found.chamfer}
    for threshold, value in found.fscore.items():
        rows[f"fscore_{threshold * 100:g}cm{ending}"] = value
    if found.iou is not None:
        rows[f"iou{ending}"] = found.iou
    return rows | {f"normal_consistency{ending}": found.normal_consistency}


def _topology(mesh: Mesh) -> dict[str, Any]:
    return dict(vars(topology(mesh))) if is_watertight(mesh) else {}


def _placed(scene: Scene, name: str) -> Mesh:
    """The object's mesh in the world."""
    return Mesh(scene[name].vertices.detach(), scene[name].mesh.faces)
