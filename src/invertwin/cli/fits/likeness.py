"""How near found shapes are to true ones: numbers of a run, and their curves over the steps."""

from collections.abc import Callable
from typing import Any

from invertwin.cli.fits.problem import Problem
from invertwin.inversion.measures import Likeness, compare_shapes
from invertwin.scene import Mesh, Scene
from invertwin.scene.geometry import without_clouds

CURVE = "chamfer_m"
"""What the curves show."""
_BEGINNINGS = ("chamfer", "fscore", "iou", "normal_consistency")


def is_shape_key(key: str) -> bool:
    """Whether a number of a fit is a measure of its shape."""
    return key.removeprefix("start_").startswith(_BEGINNINGS)


def shape_label(key: str) -> str:
    """What a measure is, in words."""
    name = key.removeprefix("start_")
    text, ending = name, ""
    for end, words in (("_whole", ", whole surface"), ("_seen", ", surface that is seen")):
        if end in name:
            text, ending = name.replace(end, ""), words
    if text.startswith("fscore"):
        text = f"F-score at {text.removeprefix('fscore_').removesuffix('cm')} cm"
    else:
        words = {
            "chamfer_m": "Chamfer distance, mean of both directions [m]",
            "iou": "shared over joint volume",
            "normal_consistency": "normal consistency",
        }
        text = words.get(text, text)
    return text + ending + (", start" if key.startswith("start_") else "")


def short_label(key: str) -> str:
    """A measure as the head of a narrow column."""
    if key.startswith("fscore"):
        return f"F {key.removeprefix('fscore_').removesuffix('cm')} cm"
    return {"chamfer_m": "Chamfer [m]", "iou": "IoU", "normal_consistency": "normals"}.get(key, key)


def shape_scores(problem: Problem, start: Scene, twin: Scene) -> dict[str, Any]:
    """Measures of the found shape, whole and as far as some radar position sees it.

    Those without an ending are the ones that the run file asks for.
    """
    table = problem.run.measures
    if table is None or table.object not in problem.known:
        return {}
    whole, seen = (_likeness(problem, twin, seen) for seen in (False, True))
    rows = _rows(seen if table.seen else whole, "")
    rows |= _rows(whole, "_whole") | _rows(seen, "_seen")
    before = _rows(_likeness(problem, start, table.seen), "")
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


def _likeness(problem: Problem, scene: Scene, seen: bool) -> Likeness:
    table = problem.run.measures
    assert table is not None
    return compare_shapes(
        _placed(scene, table.object),
        _placed(problem.truth, table.object),
        seen_from=_eyes(problem, seen),
        thresholds=table.thresholds,
        voxel=table.voxel,
    )


def _eyes(problem: Problem, seen: bool) -> Any:
    return problem.radar.positions if seen else None


def _placed(scene: Scene, name: str) -> Mesh:
    """The object's mesh in the world."""
    return Mesh(scene[name].vertices.detach(), scene[name].mesh.faces)


def _rows(found: Likeness, ending: str) -> dict[str, Any]:
    rows: dict[str, Any] = {f"chamfer{ending}_m": found.chamfer}
    for threshold, value in found.fscore.items():
        rows[f"fscore_{threshold * 100:g}cm{ending}"] = value
    if found.iou is not None:
        rows[f"iou{ending}"] = found.iou
    return rows | {f"normal_consistency{ending}": found.normal_consistency}
