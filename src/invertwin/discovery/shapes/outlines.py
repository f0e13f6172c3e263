"""Free outlines in place of simple shapes, where frames that were held out speak for them."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components

from invertwin.discovery.assembly import ShapeLikelihood
from invertwin.discovery.search import shape_gap
from invertwin.discovery.shapes.primitives import ShapeParameters
from invertwin.discovery.shapes.prisms import merge_into_prism

_MAX_GAP_CELLS = 2.0  # cells of range between shapes that may be one
_MIN_LENGTH_CELLS = 6.0  # cells of range along the longer side of a shape whose outline can be told
_FIT_STEPS = 80  # of a fit
_MIN_LOG_ODDS = 5.0  # logarithm of the odds for a free outline
_REPLACEABLE_KINDS = ("box", "cylinder", "sphere")  # may be something else even alone


def fit_outlines(
    fitted: ShapeLikelihood, held: ShapeLikelihood, shapes: Sequence[ShapeParameters]
) -> list[ShapeParameters]:
    """Shapes, with one prism in place of those that touch, or of one, where it is likelier.

    Simple shapes explain a thing of another form by several of them. A free outline explains
    anything, noise as well: it is fitted to some frames and judged by others.

    Args:
        fitted: Frames that are fitted.
        held: Frames that judge.
        shapes: After their fit.
    """
    cell = fitted.radar.waveform.range_resolution
    touching = _group_touching(fitted, shapes, _MAX_GAP_CELLS * cell)
    parts = [part for part in touching if _is_outline_candidate(part, _MIN_LENGTH_CELLS * cell)]
    if not parts:
        return list(shapes)
    starts = [
        merge_into_prism(_select_solid(part), fitted.ground, fitted.level, cell) for part in parts
    ]
    freed = [one for part in parts for one in part]
    new, _ = fitted.fit([*starts, *_remove_shapes(shapes, freed)], _FIT_STEPS)
    found = list(shapes)
    for part, one in zip(parts, new, strict=False):
        changed = [*_remove_shapes(found, part), one]
        if (
            float((held.log_likelihood_gains(changed) - held.log_likelihood_gains(found)).sum())
            > _MIN_LOG_ODDS
        ):
            found = changed
    return found


def _group_touching(
    likelihood: ShapeLikelihood, shapes: Sequence[ShapeParameters], max_gap: float
) -> list[list[ShapeParameters]]:
    """Shapes that hang together, nearer to each other than a gap [m]."""
    count = len(shapes)
    near = np.zeros((count, count))
    for a in range(count):
        for b in range(a):
            near[a, b] = shape_gap(shapes[a], shapes[b], likelihood.ground) < max_gap
    total, labels = connected_components(near, directed=False)
    return [[shapes[k] for k in np.flatnonzero(labels == part).tolist()] for part in range(total)]


def _is_outline_candidate(group: Sequence[ShapeParameters], min_length: float) -> bool:
    """Whether shapes that touch may be a prism, the larger of which is longer than least [m]."""
    solid = _select_solid(group)
    large = any(max(one.length, one.width) > min_length for one in solid)
    return large and (len(group) > 1 or solid[0].kind in _REPLACEABLE_KINDS)


def _select_solid(shapes: Sequence[ShapeParameters]) -> list[ShapeParameters]:
    return [one for one in shapes if one.kind not in ("corner", "point")]


def _remove_shapes(
    shapes: Sequence[ShapeParameters], removed: Sequence[ShapeParameters]
) -> list[ShapeParameters]:
    return [shape for shape in shapes if not any(shape is one for one in removed)]
