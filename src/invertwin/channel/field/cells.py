"""Cells of closed surfaces: even patches, a few to the wavelength, whatever the triangles are.

Triangles may be far smaller than currents need, or far larger, or long and thin. They are cut into
small pieces, and the pieces are gathered about even centres. Pieces of faces that meet at an edge
stay apart, since their normals count as places do.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from scipy.spatial import KDTree

_PIECES = 4.0  # of a side of a cell over the longest side of its pieces
_MANY = 40  # pieces of a cell with which centres are spread first
_SPREAD, _SETTLED = 20, 5  # rounds with some pieces, then with all
_LEAN = 0.7  # cells' sides that normals at right angles are apart
_NEIGHBOURS = 9
_TURNED = 0.6  # cosine of neighbours' normals, below which an edge lies between
_ASIDE = 1e-3  # of the size: nearer to the tangent plane, nothing faces a cell from within
_CURVATURE_ROWS = 1 << 21
_BURIED, _SOME = 0.35, 0.02  # off half a solid angle, and share of the surface where it may be

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cells:
    """Patches of closed surfaces, one row each.

    Attributes:
        point: a place on the surface in the middle [m].
        normal: unit vectors outwards.
        area: [m²].
        bend: how normals change along the surface, dn = B dx [1/m].
        ball: radius of the ball inside that touches the surface there and nothing else [m].
        closed: whether the surfaces enclose bodies that do not overlap.
    """

    point: Float64[np.ndarray, "cell 3"]
    normal: Float64[np.ndarray, "cell 3"]
    area: Float64[np.ndarray, " cell"]
    bend: Float64[np.ndarray, "cell 3 3"]
    ball: Float64[np.ndarray, " cell"]
    closed: bool

    @property
    def axes(self) -> Float64[np.ndarray, "cell 2 3"]:
        """Unit vectors in the surface: t₁, t₂ with t₁ × t₂ = n."""
        return _axes(self.normal)


def cells_of(corners: Float64[np.ndarray, "facet 3 3"], side: float) -> Cells:
    """Even cells of triangles.

    Args:
        corners: of the triangles, whose normals point outwards [m].
        side: of a cell [m].
    """
    place, normal, area = _pieces(corners, side / _PIECES)
    owner = _gathered(np.concatenate([place, _LEAN * side * normal], 1), area, side)
    count = int(owner.max()) + 1
    whole = np.bincount(owner, area, count).astype(np.float64)
    middle = _mean(owner, area, place, whole)
    towards = _mean(owner, area, normal, whole)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    # The middle of a bent patch lies beside the surface.
    near = _nearest(place, middle)
    off = np.einsum("cx,cx->c", place[near] - middle, normal[near])
    middle += (off / np.einsum("cx,cx->c", towards, normal[near]))[:, None] * towards
    ball, closed = _surroundings(middle, towards, whole)
    return Cells(middle, towards, whole, _bend(middle, towards), ball, closed)


def _pieces(corners: Array, longest: float) -> tuple[Array, Array, Array]:
    """Triangles halved until their sides are short: middles, normals, areas."""
    found: list[Array] = []
    while len(corners):
        size = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2)
        large = size.max(1) > longest
        found.append(corners[~large])
        # The longest side first, so that long thin triangles do not become many thin ones.
        turn = (size[large].argmax(1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[large], turn[..., None], 1).transpose(1, 0, 2)
        middle = (a + b) / 2
        corners = np.concatenate([np.stack(part, 1) for part in ((a, middle, c), (middle, b, c))])
    every = np.concatenate(found)
    normal = np.cross(every[:, 1] - every[:, 0], every[:, 2] - every[:, 0]) / 2
    area = np.linalg.norm(normal, axis=1)
    some = area > 1e-9 * area.mean()
    return every.mean(1)[some], normal[some] / area[some, None], area[some]


def _gathered(feature: Array, area: Array, side: float) -> NDArray[np.int64]:
    """The number of each piece's cell: Lloyd's rounds from centres drawn by area, always alike."""
    count = max(1, round(float(area.sum()) / side**2))
    draw = np.random.default_rng(0)
    order = draw.permutation(len(area))
    share = np.cumsum(area[order]) / area.sum()
    # One centre from each equal share of the area.
    chosen = order[np.searchsorted(share, (np.arange(count) + 0.5) / count)]
    centre = feature[np.unique(chosen)]
    some = order[: _MANY * count]
    rounds = [some] * _SPREAD + [order] * _SETTLED
    for pieces in rounds:
        owner = _nearest(centre, feature[pieces])
        whole = np.bincount(owner, area[pieces], len(centre)).astype(np.float64)
        kept = whole > 0
        centre = _mean(owner, area[pieces], feature[pieces], whole)[kept]
    return np.unique(_nearest(centre, feature), return_inverse=True)[1]


def _nearest(place: Array, to: Array, count: int = 1) -> NDArray[np.int64]:
    """Numbers of the nearest places."""
    return np.asarray(KDTree(place).query(to, k=count)[1], dtype=np.int64)


def _mean(owner: NDArray[np.int64], area: Array, value: Array, whole: Array) -> Array:
    """Means over cells; of empty ones zero."""
    total = np.stack([np.bincount(owner, area * column, len(whole)) for column in value.T], 1)
    return np.asarray(total / np.where(whole > 0, whole, 1.0)[:, None], dtype=np.float64)


def _axes(normal: Array) -> Array:
    aside = np.eye(3)[np.abs(normal).argmin(1)]
    first = np.cross(normal, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.asarray(np.stack([first, np.cross(normal, first)], 1), dtype=np.float64)


def _bend(point: Array, normal: Array) -> Array:
    """How normals turn towards neighbours on the same face, by least squares."""
    near = _nearest(point, point, min(_NEIGHBOURS, len(point)))[:, 1:]
    axes = _axes(normal)
    same = np.einsum("ckx,cx->ck", normal[near], normal) > _TURNED
    away = np.einsum("cax,ckx->cka", axes, point[near] - point[:, None]) * same[..., None]
    turn = np.einsum("cax,ckx->cka", axes, normal[near] - normal[:, None]) * same[..., None]
    square = np.einsum("cka,ckb->cab", away, away)
    # Where neighbours are few or in line, the surface counts as flat.
    least = 1e-9 * np.einsum("caa->c", square) + 1e-30
    sums = np.einsum("cka,ckb->cab", away, turn)
    bent: Array = np.linalg.solve(square + least[:, None, None] * np.eye(2), sums).real
    even = (bent + bent.transpose(0, 2, 1)) / 2
    return np.asarray(axes.transpose(0, 2, 1) @ even @ axes, dtype=np.float64)


def _surroundings(point: Array, normal: Array, area: Array) -> tuple[Array, bool]:
    """Radii of touching balls, and whether the solid angle inside is half of all, as it should."""
    count = len(point)
    ball, angle = np.full(count, np.inf), np.zeros(count)
    least = _ASIDE * float(np.ptp(point, axis=0).max())
    for rows in np.array_split(np.arange(count), math.ceil(count**2 / _CURVATURE_ROWS)):
        away = point - point[rows, None]
        square = np.einsum("rcx,rcx->rc", away, away)
        below = -np.einsum("rcx,rx->rc", away, normal[rows])
        radius = np.where(below > least, square / (2 * np.maximum(below, least)), np.inf)
        ball[rows] = radius.min(1)
        seen = np.einsum("rcx,cx->rc", away, normal) * area
        # The cell itself is seen edge-on: zero over something.
        angle[rows] = (seen / np.maximum(square, least**2) ** 1.5).sum(1) / (4 * math.pi)
    wrong = np.abs(angle - 0.5) > _BURIED
    return ball, bool(area[wrong].sum() < _SOME * area.sum())
