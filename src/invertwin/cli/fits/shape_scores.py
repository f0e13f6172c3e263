"""Errors of found shapes: numbers of a run, and their curves over the steps."""

from collections.abc import Callable

import torch

from invertwin.cli.fits.problem import Problem, Row
from invertwin.cli.report import load_texts
from invertwin.cli.run_file import prefix_errors
from invertwin.errors import InputError
from invertwin.inversion import metrics
from invertwin.scene import Mesh, Scene
from invertwin.scene.shape_models.density import replace_clouds

CURVE_KEY = "chamfer_m"
"""Metric of the curves."""
_MEASURE_PREFIXES = ("chamfer", "fscore", "iou", "normal_consistency", "components", "euler_number")
_SUBJECT_LABELS = {"start_": ", start", "true_": ", truth", "": ""}
_SURFACE_LABELS = {"_whole": ", whole surface", "_seen": ", surface that is seen", "": ""}


def is_shape_key(key: str) -> bool:
    """Return True if a number of a fit is a measure of its shape."""
    begins = tuple(whose + name for whose in _SUBJECT_LABELS for name in _MEASURE_PREFIXES)
    return key.startswith(begins)


def shape_label(key: str) -> str:
    """Name of a measure in words."""
    whose = next(whose for whose in _SUBJECT_LABELS if key.startswith(whose))
    part = next(part for part in _SURFACE_LABELS if part in key)
    name = key.removeprefix(whose).replace(part, "")
    if name.startswith("fscore"):
        name = f"F-score at {name.removeprefix('fscore_').removesuffix('cm')} cm"
    return load_texts("shapes").get(name, name) + _SURFACE_LABELS[part] + _SUBJECT_LABELS[whose]


def short_label(key: str) -> str:
    """A measure as the head of a narrow column."""
    if key.startswith("fscore"):
        return f"F {key.removeprefix('fscore_').removesuffix('cm')} cm"
    return load_texts("shape_columns").get(key, key)


def check_measures(problem: Problem, start: Scene) -> None:
    """Refuse settings of measures before any fit.

    Raises:
        InputError: Too many voxels or none, a start without area, or one that is not seen.
    """
    table = problem.measures
    if table is None:
        return
    with prefix_errors("measures"):
        _compare_surfaces(problem, start, table.seen)
        truth = problem.truth[table.object].world_mesh
        if metrics.is_watertight(truth):
            metrics.volume_iou(truth, truth, table.voxel)


def score_shape(problem: Problem, start: Scene, twin: Scene) -> Row:
    """Measures of the found shape, whole and as far as some radar position sees it.

    Those without an ending are the ones that the run file asks for. Parts and holes are those of
    the whole surface, also of the truth, each where it is watertight. What a shape does not have,
    such as one that has collapsed, is left out.
    """
    table = problem.measures
    if table is None:
        return {}
    rows = _shape_metrics(problem, twin, table.seen)
    rows |= _shape_metrics(problem, twin, False, "_whole")
    rows |= _shape_metrics(problem, twin, True, "_seen")
    rows |= _topology_metrics(twin[table.object].mesh)
    truth = _topology_metrics(problem.truth[table.object].mesh)
    before = _shape_metrics(problem, start, table.seen)
    before |= _topology_metrics(start[table.object].mesh)
    rows |= {f"true_{key}": value for key, value in truth.items()}
    return rows | {f"start_{key}": value for key, value in before.items()}


def make_shape_metric(problem: Problem) -> Callable[[Scene], dict[str, float]] | None:
    """Metric of the twin during the fit, where the truth is known."""
    table = problem.measures
    if table is None:
        return None

    def measure_shape(scene: Scene) -> dict[str, float]:
        found = _compare_surfaces(problem, replace_clouds(scene), table.seen, volume=False)
        return {CURVE_KEY: found.chamfer}

    return measure_shape


def _compare_surfaces(
    problem: Problem, scene: Scene, visible_only: bool, volume: bool = True
) -> metrics.ShapeMetrics:
    table = problem.measures
    assert table is not None
    eyes = [item.sensor.positions.detach() for item in problem.sensor_data.values()]
    shapes = [one[table.object].world_mesh for one in (scene, problem.truth)]
    seen_from, voxel = torch.cat(eyes) if visible_only else None, table.voxel if volume else None
    return metrics.compare_shapes(
        *shapes, seen_from=seen_from, thresholds=table.thresholds, voxel=voxel
    )


def _shape_metrics(problem: Problem, scene: Scene, visible_only: bool, suffix: str = "") -> Row:
    """Measures as metrics keep them; none if the shape is empty or invisible."""
    try:
        found = _compare_surfaces(problem, scene, visible_only)
    except InputError:
        return {}
    rows: Row = {f"chamfer{suffix}_m": found.chamfer}
    for threshold, value in found.fscore.items():
        rows[f"fscore_{threshold * 100:g}cm{suffix}"] = value
    if found.iou is not None:
        rows[f"iou{suffix}"] = found.iou
    return rows | {f"normal_consistency{suffix}": found.normal_consistency}


def _topology_metrics(mesh: Mesh) -> Row:
    return dict(vars(metrics.count_topology(mesh))) if metrics.is_watertight(mesh) else {}
