"""How near found shapes are to true ones: numbers of a run, and their curves over the steps."""

from collections.abc import Callable
from typing import Any

import torch

from invertwin.cli.fits.problem import Problem
from invertwin.cli.report import texts
from invertwin.cli.run_file import about
from invertwin.errors import InputError
from invertwin.inversion.metrics import (
    ShapeMetrics,
    compare_shapes,
    is_watertight,
    topology,
    volume_iou,
)
from invertwin.scene import Mesh, Scene
from invertwin.scene.geometry import without_clouds

CURVE = "chamfer_m"
"""What the curves show."""
_BEGINNINGS = ("chamfer", "fscore", "iou", "normal_consistency", "components", "euler_number")
_WHOSE = {"start_": ", start", "true_": ", truth"}


def is_shape_key(key: str) -> bool:
    """Whether a number of a fit is a measure of its shape."""
    return _parted(key)[0].startswith(_BEGINNINGS)


def shape_label(key: str) -> str:
    """What a measure is, in words."""
    name, whose = _parted(key)
    ending = ""
    for end, words in (("_whole", ", whole surface"), ("_seen", ", surface that is seen")):
        if end in name:
            name, ending = name.replace(end, ""), words
    if name.startswith("fscore"):
        name = f"F-score at {name.removeprefix('fscore_').removesuffix('cm')} cm"
    return texts("shapes").get(name, name) + ending + whose


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
    table = problem.run.measures
    if table is None or table.object not in problem.known:
        return
    with about("measures"):
        _likeness(problem, start, table.seen)
        truth = _placed(problem.truth, table.object)
        if is_watertight(truth):
            volume_iou(truth, truth, table.voxel)


def shape_scores(problem: Problem, start: Scene, twin: Scene) -> dict[str, Any]:
    """Measures of the found shape, whole and as far as some radar position sees it.

    Those without an ending are the ones that the run file asks for. Parts and holes are those of
    the whole surface, also of the truth, each where it is watertight. What a shape does not have,
    such as one that has collapsed, is left out.
    """
    table = problem.run.measures
    if table is None or table.object not in problem.known:
        return {}
    whole, seen = (_tried(problem, twin, seen) for seen in (False, True))
    rows = _rows(seen if table.seen else whole, "")
    rows |= _rows(whole, "_whole") | _rows(seen, "_seen")
    rows |= _topology(twin, table.object, "") | _topology(problem.truth, table.object, "true_")
    before = _rows(_tried(problem, start, table.seen), "") | _topology(start, table.object, "")
    return rows | {f"start_{key}": value for key, value in before.items()}


def watch_of(problem: Problem) -> Callable[[Scene], dict[str, float]] | None:
    """What is noted of the twin during the fit, where the truth is known."""
    table = problem.run.measures
    if table is None or table.object not in problem.known:
        return None

    def watch(scene: Scene) -> dict[str, float]:
        found = _placed(without_clouds(scene), table.object)
        truth = _placed(problem.truth, table.object)
        eyes = _eyes(problem, table.seen)
        return {CURVE: compare_shapes(found, truth, seen_from=eyes, voxel=None).chamfer}

    return watch


def _likeness(problem: Problem, scene: Scene, seen: bool) -> ShapeMetrics:
    table = problem.run.measures
    assert table is not None
    return compare_shapes(
        _placed(scene, table.object),
        _placed(problem.truth, table.object),
        seen_from=_eyes(problem, seen),
        thresholds=table.thresholds,
        voxel=table.voxel,
    )


def _tried(problem: Problem, scene: Scene, seen: bool) -> ShapeMetrics | None:
    """Like ``_likeness``; None if the shape is empty or invisible."""
    try:
        return _likeness(problem, scene, seen)
    except InputError:
        return None


def _eyes(problem: Problem, seen: bool) -> Any:
    if not seen:
        return None
    return torch.cat([sight.radar.positions.detach() for sight in problem.sights.values()])


def _placed(scene: Scene, name: str) -> Mesh:
    """The object's mesh in the world."""
    return Mesh(scene[name].vertices.detach(), scene[name].mesh.faces)


def _topology(scene: Scene, name: str, whose: str) -> dict[str, Any]:
    mesh = scene[name].mesh
    if not is_watertight(mesh):
        return {}
    found = topology(mesh)
    return {f"{whose}components": found.components, f"{whose}euler_number": found.euler_number}


def _parted(key: str) -> tuple[str, str]:
    """A measure without whose it is, and whose it is in words."""
    for whose, words in _WHOSE.items():
        if key.startswith(whose):
            return key.removeprefix(whose), words
    return key, ""


def _rows(found: ShapeMetrics | None, ending: str) -> dict[str, Any]:
    if found is None:
        return {}
    rows: dict[str, Any] = {f"chamfer{ending}_m": found.chamfer}
    for threshold, value in found.fscore.items():
        rows[f"fscore_{threshold * 100:g}cm{ending}"] = value
    if found.iou is not None:
        rows[f"iou{ending}"] = found.iou
    return rows | {f"normal_consistency{ending}": found.normal_consistency}
