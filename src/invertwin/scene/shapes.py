"""Built-in meshes, centred at the origin, with outward normals.

Fronts face −x, towards a radar that looks along +x; z is up, y to the left of who looks along +x.
"""

import math
from collections.abc import Sequence
from functools import reduce
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import trimesh
from annotated_types import Ge, Le, MinLen

from invertwin.checks import checked_count, checked_number, checked_tensor
from invertwin.errors import InputError
from invertwin.limits import Angle, Count, Positive
from invertwin.runtime.memory import require_at_most
from invertwin.scene.mesh import Mesh

_MAX_TRIANGLES = 1e7  # triangles of one shape
_MAX_LETTERS = 100  # outlines are merged one by one


def plate(width: Positive, height: Positive, divisions: Count = 1) -> Mesh:
    """Build a rectangle in the plane x = 0 that faces −x.

    Args:
        width: size along y [m].
        height: size along z [m].
        divisions: number of cells along each side, two triangles each.

    Raises:
        InputError: a size that is not positive, or no divisions.
    """
    size = [_length(width, "plate width [m]"), _length(height, "plate height [m]")]
    n = checked_count(divisions, "divisions", 1)
    _require_triangles(2 * n**2, "divisions")
    points, faces = _lattice(n)
    # The lattice faces +x; reversed triangles face −x.
    plane = (points / n - 0.5) * size
    return _mesh(np.column_stack([plane, np.zeros(len(plane))]), faces[:, ::-1])


def box(size: Positive | Sequence[Positive], divisions: Count = 1) -> Mesh:
    """Build a closed box.

    Args:
        size: edge length [m], one number or one for each of x, y, z.
        divisions: number of cells along each edge, two triangles each.

    Raises:
        InputError: a size that is not positive, or no divisions.
    """
    sizes = [size] * 3 if isinstance(size, int | float) else list(size)
    given = checked_tensor(sizes, (3,), "box size", "give one number or three")
    extent = np.asarray(given.tolist())[[1, 2, 0]]
    for length in extent:
        _length(float(length), "box size [m]")
    n = checked_count(divisions, "divisions", 1)
    _require_triangles(12 * n**2, "divisions")
    points, faces = _lattice(n)
    corners, triangles = [], []
    for axis in range(3):
        for level, turn in ((0, -1), (n, 1)):
            # Cyclic axes keep the orientation: +axis on the far side, reversed on the near one.
            side = np.empty((len(points), 3), dtype=np.int64)
            columns = [(axis + 1) % 3, (axis + 2) % 3, axis]
            side[:, columns] = np.column_stack([points, np.full(len(points), level)])
            triangles.append(faces[:, ::turn] + len(corners) * len(points))
            corners.append(side)
    # Integer corners are exactly equal at shared edges, so merging leaves no seam.
    unique, index = np.unique(np.concatenate(corners), axis=0, return_inverse=True)
    return _mesh((unique / n - 0.5) * extent, index.ravel()[np.concatenate(triangles)])


def sphere(radius: Positive, subdivisions: Annotated[int, Ge(0), Le(8)] = 4) -> Mesh:
    """Build an icosphere with 20·4^subdivisions triangles and its vertices on the sphere.

    Args:
        radius: radius [m].
        subdivisions: number of times that every triangle of the icosahedron is split into four.

    Raises:
        InputError: a radius that is not positive, or a negative count.
    """
    length = _length(radius, "sphere radius [m]")
    count = checked_count(subdivisions, "subdivisions", 0)
    _require_triangles(20 * 4.0 ** min(count, 100), "subdivisions")
    ball = trimesh.creation.icosphere(subdivisions=count, radius=1.0)
    unit = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    return _mesh(unit * length, ball.faces)


def cylinder(
    radius: Positive, height: Positive, sections: Annotated[int, Ge(3), Le(10_000)] = 32
) -> Mesh:
    """Build a closed upright cylinder with its axis along z.

    Args:
        radius: radius [m].
        height: size along z [m].
        sections: number of flat sides.

    Raises:
        InputError: a size that is not positive, or fewer than three sides.
    """
    sizes = _length(radius, "cylinder radius [m]"), _length(height, "cylinder height [m]")
    count = checked_count(sections, "sections", 3)
    tube = trimesh.creation.cylinder(sizes[0], sizes[1], sections=count)
    # Rotation of its axis to the second of the drawing's axes.
    return _mesh(tube.vertices[:, [0, 2, 1]] * [1, 1, -1], tube.faces)


def dihedral(edge: Positive, opening: Angle = math.pi / 2) -> Mesh:
    """Build two square plates that meet on the z axis and open to −x.

    Its boresight is −x. At a right angle every double-bounce echo has the range of the z axis.

    Args:
        edge: edge length of the plates [m].
        opening: angle between the plates.

    Raises:
        InputError: a length that is not positive, or an angle beyond π.
    """
    length = _length(edge, "dihedral edge [m]")
    half = checked_number(opening, "opening [rad]", 0.0, math.pi, open_low=True) / 2
    tips = [(s * length * math.sin(half), -length * math.cos(half)) for s in (-1, 1)]
    vertices = [(y, z * length / 2, x) for y, x in (tips[0], (0.0, 0.0), tips[1]) for z in (-1, 1)]
    return _mesh(np.array(vertices), np.array([(0, 1, 3), (0, 3, 2), (2, 3, 5), (2, 5, 4)]))


def trihedral(edge: Positive) -> Mesh:
    """Build a corner reflector: three right-angled triangles with the apex at the origin, open to
    −x.

    Its boresight is −x, one of the inner edges lies in the half plane y = 0, z > 0, and every
    triple-bounce echo has the range of the apex. Its peak radar cross-section is 4π edge⁴/3λ².

    Args:
        edge: length of the three inner edges [m].

    Raises:
        InputError: a length that is not positive.
    """
    length = _length(edge, "trihedral edge [m]")
    angle = np.radians([90.0, 210.0, 330.0])
    # Cosine of the angle between three perpendicular unit vectors and their mean: 1/√3.
    tips = np.column_stack([np.cos(angle), np.sin(angle), np.full(3, -math.sqrt(0.5))])
    vertices = np.concatenate([np.zeros((1, 3)), tips * length * math.sqrt(2 / 3)])
    return _mesh(vertices, np.array([(0, 2, 1), (0, 3, 2), (0, 1, 3)]))


def text(
    text: Annotated[str, MinLen(1)],
    size: Positive = 0.6,
    depth: Positive = 0.12,
    max_edge: Positive = 0.06,
) -> Mesh:
    """Build extruded bold text, watertight, which reads correctly from −x.

    The first letter has the largest y, since +y is to the left of who looks along +x; z is up.

    Args:
        text: line of text.
        size: height of its bounding box along z [m].
        depth: thickness along x [m].
        max_edge: longest edge of a triangle [m].

    Raises:
        InputError: text without visible characters, or a length that is not positive.
    """
    height = _length(size, "text size [m]")
    thickness = _length(depth, "text depth [m]")
    longest = _length(max_edge, "longest edge [m]")
    plane, cap = _triangulate_outline(text, height, thickness, longest)
    count = len(plane)
    front = np.column_stack([plane, np.full(count, -thickness / 2)])
    back = np.column_stack([plane, np.full(count, thickness / 2)])
    # Open edges in the direction of their triangle.
    flat = trimesh.Trimesh(front, cap, process=False)
    open_edges = trimesh.grouping.group_rows(flat.edges_sorted, require_count=1)
    start, end = flat.edges[np.sort(open_edges)].T
    walls = [(start, end, end + count), (start, end + count, start + count)]
    faces = np.concatenate([cap[:, ::-1], cap + count, *(np.column_stack(w) for w in walls)])
    points, faces = _split_long_edges(np.concatenate([front, back]), faces, longest)
    # Letters run to the right, which is −y; mirrored triangles are reversed to face outwards.
    return _mesh(points * [-1, 1, 1], faces[:, ::-1])


def _length(value: object, what: str) -> float:
    return checked_number(value, what, 0.0, open_low=True)


def _require_triangles(count: float, at: str, do: str = "") -> None:
    do = do or f"lower {at}"
    require_at_most(count, _MAX_TRIANGLES, "triangles of a shape", do, at)


def _mesh(drawn: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh from drawn coordinates (y, z, x): the plane that faces the radar, and depth."""
    # C order, since torch does not accept the negative strides of reversed views.
    return Mesh(
        torch.from_numpy(np.array(drawn[:, [2, 0, 1]], dtype=np.float64, order="C")),
        torch.from_numpy(np.array(faces, dtype=np.int64, order="C")),
    )


def _lattice(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return integer points (i, j) of an n × n grid and its triangles, counter-clockwise."""
    points = np.stack(np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"), -1)
    index = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    corners = (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    a, b, c, d = (corner.ravel() for corner in corners)
    halves = [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    return points.reshape(-1, 2), np.concatenate(halves)


def _triangulate_outline(
    string: str, height: float, thickness: float, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the outlines of a text: points [p, 2] and counter-clockwise triangles."""
    require_at_most(len(string), _MAX_LETTERS, "letters", "give a shorter text", "text")
    # Local imports: only text needs these two, and matplotlib alone takes half a second.
    import matplotlib
    import shapely
    from matplotlib.font_manager import FontProperties
    from matplotlib.ft2font import FT2Font
    from matplotlib.textpath import TextPath

    if not string.strip() or not string.isprintable():
        raise InputError(f"expected one line of visible text, got {string!r}; give some letters")
    font = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans-Bold.ttf"
    glyphs = FT2Font(str(font))
    unknown = [letter for letter in string if glyphs.get_char_index(ord(letter)) == 0]
    if unknown:
        raise InputError(
            f"expected characters of the font DejaVu Sans, got {string!r} with "
            f"{''.join(unknown)}; use others"
        )
    # Curves are split into chords about one unit long, so the size sets their resolution.
    path = TextPath((0, 0), string, size=100, prop=FontProperties(fname=font))
    loops = [np.asarray(loop) for loop in path.to_polygons()]
    rings = [shapely.Polygon(loop) for loop in loops if len(loop) >= 4]
    # A ring inside another is a hole, a ring inside a hole is filled.
    outline = reduce(shapely.symmetric_difference, rings)
    left, bottom, right, top = outline.bounds
    scale = height / (top - bottom)
    center = np.array([left + right, bottom + top]) / 2
    outline = shapely.transform(outline, lambda points: (points - center) * scale)
    # Thin triangles across the walls, and across the strokes of letters, a quarter as wide as they
    # are high, are halved along their long sides again and again: three for one at every halving.
    thin = sum(max(1.0, min(s / longest, 1e9)) ** 1.585 for s in (thickness, height / 4))
    pieces = 2 * (outline.length / longest + len(loops)) * thin
    _require_triangles(pieces, "max_edge", "give sizes in metres, or larger edges")
    fine = shapely.segmentize(outline, longest)
    # The triangulation takes one polygon at a time, and returns rings of four points.
    parts = map(shapely.constrained_delaunay_triangles, shapely.get_parts(fine))
    rings = [shapely.get_coordinates(part).reshape(-1, 4, 2) for part in parts]
    triangles = np.concatenate(rings)[:, :3]
    side, other = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    clockwise = side[:, 0] * other[:, 1] < side[:, 1] * other[:, 0]
    triangles[clockwise] = triangles[clockwise, ::-1]
    # Corners are copies of the outline's points, hence exactly equal at shared vertices.
    points, index = np.unique(triangles.reshape(-1, 2), axis=0, return_inverse=True)
    return points, index.reshape(-1, 3)


def _split_long_edges(
    vertices: np.ndarray, faces: np.ndarray, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Halve all edges above a length; the mesh stays watertight.

    Every triangle splits by the pattern of its own long edges, and both neighbours of an edge see
    the same midpoint, so no crack appears.
    """
    while True:
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
        unique, index = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        index = index.reshape(-1, 3)
        lengths = np.linalg.norm(vertices[unique[:, 0]] - vertices[unique[:, 1]], axis=1)
        long = lengths > longest * (1 + 1e-9)
        if not long.any():
            return vertices, faces
        midpoint = np.full(len(unique), -1)
        midpoint[long] = len(vertices) + np.arange(long.sum())
        vertices = np.concatenate([vertices, vertices[unique[long]].mean(axis=1)])
        faces = _split(faces, midpoint[index])


def _split(faces: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Split triangles at given midpoints of their edges 01, 12, 20 (−1: not split)."""
    count = (middle >= 0).sum(axis=1)
    # Permute each triangle so that one split edge comes first, or the one whole edge last.
    after = (np.argmin(middle, axis=1) + 1) % 3
    first = np.where(count == 1, np.argmax(middle >= 0, axis=1), after)
    order = (first[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, order, axis=1)
    middle = np.take_along_axis(middle, order, axis=1)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    patterns = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
        3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }
    parts = [
        np.column_stack([corner[count == n] for corner in triangle])
        for n, triangles in patterns.items()
        for triangle in triangles
    ]
    return np.concatenate(parts)
