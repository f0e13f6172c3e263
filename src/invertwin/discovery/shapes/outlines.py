"""Free outlines in place of simple shapes, where frames that were held out speak for them."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components

from invertwin.discovery.assembly import Assembly
from invertwin.discovery.search import apart
from invertwin.discovery.shapes.primitives import Figure
from invertwin.discovery.shapes.prisms import prism_of

_TOUCH = 2.0  # cells of range between shapes that may be one
_LEAST = 6.0  # cells of range along the longer side of a shape whose outline can be told
_STEPS = 80  # of a fit
_CLEAR = 5.0  # logarithm of the odds for a free outline
_PLAIN = ("box", "cylinder", "sphere")  # may be something else even alone


def outlined(fitted: Assembly, held: Assembly, shapes: Sequence[Figure]) -> list[Figure]:
    """Shapes, with one prism in place of those that touch, or of one, where it is likelier.

    Simple shapes explain a thing of another form by several of them. A free outline explains
    anything, noise as well: it is fitted to some frames and judged by others.

    Args:
        fitted: Frames that are fitted.
        held: Frames that judge.
        shapes: After their fit.
    """
    cell = fitted.radar.waveform.range_resolution
    touching = _touching(fitted, shapes, _TOUCH * cell)
    parts = [part for part in touching if _worth(part, _LEAST * cell)]
    if not parts:
        return list(shapes)
    starts = [prism_of(_solid(part), fitted.ground, fitted.level, cell) for part in parts]
    freed = [one for part in parts for one in part]
    new, _ = fitted.fitted([*starts, *_without(shapes, freed)], _STEPS)
    found = list(shapes)
    for part, one in zip(parts, new, strict=False):
        changed = [*_without(found, part), one]
        if float((held.gains(changed) - held.gains(found)).sum()) > _CLEAR:
            found = changed
    return found


def _touching(one: Assembly, shapes: Sequence[Figure], gap: float) -> list[list[Figure]]:
    """Shapes that hang together, nearer to each other than a gap [m]."""
    count = len(shapes)
    near = np.zeros((count, count))
    for a in range(count):
        for b in range(a):
            near[a, b] = apart(shapes[a], shapes[b], one.ground) < gap
    total, labels = connected_components(near, directed=False)
    return [[shapes[k] for k in np.flatnonzero(labels == part).tolist()] for part in range(total)]


def _worth(part: Sequence[Figure], least: float) -> bool:
    """Whether shapes that touch may be a prism, the larger of which is longer than least [m]."""
    solid = _solid(part)
    large = any(max(one.length, one.width) > least for one in solid)
    return large and (len(part) > 1 or solid[0].kind in _PLAIN)


def _solid(shapes: Sequence[Figure]) -> list[Figure]:
    return [one for one in shapes if one.kind not in ("corner", "point")]


def _without(shapes: Sequence[Figure], some: Sequence[Figure]) -> list[Figure]:
    return [shape for shape in shapes if not any(shape is one for one in some)]
