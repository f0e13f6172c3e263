"""Free outlines in place of simple shapes, if held-out frames support them."""

import numpy as np
from scipy.sparse.csgraph import connected_components

from invertwin.discovery.assembly import ShapeLikelihood
from invertwin.discovery.search import shape_gap
from invertwin.discovery.shapes.primitives import ShapeParameters, Shapes
from invertwin.discovery.shapes.prisms import merge_into_prism

_MAX_GAP_CELLS = 2.0  # range cells between shapes that may merge
_MIN_LENGTH_CELLS = 6.0  # range cells along the longer side of a shape with a resolvable outline
_FIT_STEPS = 80  # steps of a fit
_MIN_LOG_ODDS = 5.0  # minimum log odds of a free outline
_REPLACEABLE_KINDS = ("box", "cylinder", "sphere")  # kinds that a prism may replace even alone


def fit_outlines(
    fitted: ShapeLikelihood, held: ShapeLikelihood, shapes: Shapes
) -> list[ShapeParameters]:
    """Replace touching shapes, or a single one, by one prism where that is more likely.

    Several simple shapes may explain one object of another form. A free outline may also fit noise:
    it is fitted to some frames and validated on others.

    Args:
        fitted: likelihood of the fitted frames.
        held: likelihood of the held-out frames.
        shapes: fitted shapes.
    """
    cell = fitted.radar.waveform.range_resolution
    touching = _group_touching(shapes, _MAX_GAP_CELLS * cell)
    parts = [part for part in touching if _is_outline_candidate(part, _MIN_LENGTH_CELLS * cell)]
    if not parts:
        return list(shapes)
    starts = [merge_into_prism(_select_solid(part), fitted.level, cell) for part in parts]
    freed = [one for part in parts for one in part]
    new, _ = fitted.fit([*starts, *_remove_shapes(shapes, freed)], _FIT_STEPS)
    found = list(shapes)
    for part, one in zip(parts, new, strict=False):
        changed = [*_remove_shapes(found, part), one]
        gain = held.log_likelihood_gains(changed) - held.log_likelihood_gains(found)
        if float(gain.sum()) > _MIN_LOG_ODDS:
            found = changed
    return found


def _group_touching(shapes: Shapes, max_gap: float) -> list[list[ShapeParameters]]:
    """Group shapes connected by gaps smaller than a limit [m]."""
    near = np.array([[shape_gap(a, b) < max_gap for b in shapes] for a in shapes])
    total, labels = connected_components(near, directed=False)
    return [[shapes[k] for k in np.flatnonzero(labels == part).tolist()] for part in range(total)]


def _is_outline_candidate(group: Shapes, min_length: float) -> bool:
    """Return whether touching shapes, the larger of a minimum length [m], may be a prism."""
    solid = _select_solid(group)
    large = any(max(one.length, one.width) > min_length for one in solid)
    return large and (len(group) > 1 or solid[0].kind in _REPLACEABLE_KINDS)


def _select_solid(shapes: Shapes) -> list[ShapeParameters]:
    return [one for one in shapes if one.kind not in ("corner", "point")]


def _remove_shapes(shapes: Shapes, removed: Shapes) -> list[ShapeParameters]:
    return [shape for shape in shapes if not any(shape is one for one in removed)]
