"""Meshes: what a plane wave lights first, triangle by triangle.

A triangle that is seen whole counts exactly. One that is seen in part is split in four until its
pieces are as small as asked for; these are cut where light ends.
"""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel.beams.beam_tracing import Facets, IlluminatedPatches, patches_in_air
from invertwin.channel.em.plane_waves import dot, reflect_vectors
from invertwin.channel.rays.ray_scene import Occluders, find_next_surface

_MAX_SIDE_RATIO = (
    8.0  # times the smallest piece: larger triangles are split before they are looked at
)
_CORNER_INSET = 0.02  # from a corner to the middle, where a corner is looked at
_BISECTIONS = 4  # of a side, to find where it is cut
_ROWS_AT_ONCE = 1 << 18
_RAY_OFFSET = 2e-6  # of the scene's size: from how far above a surface rays start


def find_illuminated_triangles(
    facets: Facets,
    is_unoccluded: Callable[[Tensor, Tensor], Tensor],
    incident: Float64[Tensor, "aspect 3"],
    min_side: float,
) -> Iterator[IlluminatedPatches]:
    """Lit pieces of triangles, in parts of as many waves as memory holds.

    Args:
        facets: the triangles.
        is_unoccluded: points and unit vectors → whether nothing is in the way.
        incident: d of each wave.
        min_side: side of a piece that is not split [m].
    """
    number = torch.arange(len(facets.normal))
    corners = facets.corners.detach()
    while bool((large := _longest_sides(corners) > _MAX_SIDE_RATIO * min_side).any()):
        corners = torch.cat([corners[~large], _quarter_triangles(corners[large])])
        number = torch.cat([number[~large], number[large].repeat_interleave(4)])
    for some in torch.arange(len(incident)).split(max(1, _ROWS_AT_ONCE // len(number))):
        aspect = some.repeat_interleave(len(number))
        row = torch.arange(len(number)).repeat(len(some))
        facing = dot(facets.normal[number[row]].detach(), incident[aspect])
        turned = (facing < 0) | ~facets.solid[number[row]]
        keep = turned & (facing.abs() > 1e-9)
        yield _illuminate_triangles(
            facets,
            is_unoccluded,
            incident,
            min_side,
            aspect[keep],
            number[row[keep]],
            corners[row[keep]],
        )


def _illuminate_triangles(
    facets: Facets,
    is_unoccluded: Callable[[Tensor, Tensor], Tensor],
    incident: Tensor,
    min_side: float,
    aspect: Tensor,
    number: Tensor,
    corners: Tensor,
) -> IlluminatedPatches:
    d = incident[aspect]
    normal = _orient_normals(facets.normal[number].detach(), d)

    def test_illumination(row: Tensor, points: Tensor) -> Tensor:
        starts = points + ray_offset(facets, normal[row])[:, None]
        back = -d[row][:, None].expand_as(starts)
        return is_unoccluded(starts.flatten(0, 1), back.flatten(0, 1)).view(starts.shape[:2]).long()

    row, corners, lit = subdivide_triangles(
        corners, test_illumination, lambda _, pieces: _longest_sides(pieces) <= min_side
    )
    row, corners = row[lit > 0], corners[lit > 0]
    aspect, number, d = aspect[row], number[row], d[row]
    normal = _orient_normals(facets.normal[number], d)
    before = torch.full_like(aspect, -1)
    return patches_in_air(aspect, number, normal, d, torch.zeros_like(d[:, 0]), corners, before)


def subdivide_triangles(
    corners: Float64[Tensor, "row 3 3"],
    classify: Callable[[Tensor, Tensor], Tensor],
    is_narrow: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Int64[Tensor, " piece"], Float64[Tensor, "piece 3 3"], Int64[Tensor, " piece"]]:
    """Pieces of triangles in each of which all points look alike.

    Args:
        corners: Of the triangles.
        classify: Rows and points of each [row, point, 3] → numbers of what is seen there [row,
            point].
        is_narrow: Rows and pieces → whether a piece is not split in four, but cut along a line.

    Returns:
        For every piece: the row, its corners, the number.
    """
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    row = torch.arange(len(corners))
    while True:
        seen = classify(row, inset_points(corners))
        whole = (seen == seen[:, :1]).all(1)
        found.append((row[whole], corners[whole], seen[whole, 0]))
        row, corners, seen = row[~whole], corners[~whole], seen[~whole]
        if not len(row):
            break
        last = is_narrow(row, corners)
        found += _split_triangles(row[last], corners[last], seen[last], classify)
        row, corners = row[~last].repeat_interleave(4), _quarter_triangles(corners[~last])
    pieces = zip(*found, strict=True)
    return torch.cat(next(pieces)), torch.cat(next(pieces)), torch.cat(next(pieces))


def _split_triangles(
    row: Tensor, corners: Tensor, labels: Tensor, classify: Callable[[Tensor, Tensor], Tensor]
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Triangles one corner of which sees something else, cut; others look as their middles do."""
    first, second, third = labels[:, 1:].unbind(1)
    pairs = (first == second).long() + (second == third).long() + (third == first).long()
    single = pairs != 1
    yield row[single], corners[single], labels[single, 0]
    odd = torch.where(second == third, 0, torch.where(third == first, 1, 2))[~single]
    order = (odd[:, None] + torch.arange(3)) % 3
    row, labels = row[~single], labels[~single, 1:].gather(1, order)
    corners = corners[~single].gather(1, order[..., None].expand(-1, -1, 3))
    inner = inset_points(corners)[:, 1:]
    # How far the sides that begin at the odd corner look as it does.
    low = torch.zeros(len(row), 2, dtype=torch.float64)
    for step in range(1, _BISECTIONS + 1):
        middle = low + 0.5**step
        points = inner[:, :1] + middle[..., None] * (inner[:, 1:] - inner[:, :1])
        low = torch.where(classify(row, points) == labels[:, :1], middle, low)
    share = (low + 0.5 ** (_BISECTIONS + 1))[..., None]
    a, b, c = corners.unbind(1)
    p, q = (a[:, None] + share * (corners[:, 1:] - a[:, None])).unbind(1)
    yield row, torch.stack([a, p, q], 1), labels[:, 0]
    for part in ((p, b, c), (p, c, q)):
        yield row, torch.stack(part, 1), labels[:, 1]


def ray_offset(facets: Facets, normal: Float64[Tensor, "row 3"]) -> Float64[Tensor, "row 3"]:
    """How far above a surface rays start.

    Args:
        facets: All triangles.
        normal: Of the surface, towards the rays.
    """
    return _RAY_OFFSET * facets.size * normal


def inset_points(corners: Float64[Tensor, "row 3 3"]) -> Float64[Tensor, "row 4 3"]:
    """The middle of each triangle, and a point near each corner.

    Args:
        corners: Of the triangles [m].
    """
    middle = corners.mean(1, keepdim=True)
    return torch.cat([middle, corners + _CORNER_INSET * (middle - corners)], 1)


def _orient_normals(normal: Tensor, direction: Tensor) -> Tensor:
    """Normals on the side that the wave comes from."""
    return -dot(normal, direction).sign()[:, None] * normal


def _longest_sides(corners: Tensor) -> Tensor:
    return (corners.roll(-1, 1) - corners).norm(dim=2).amax(1)


def _quarter_triangles(corners: Float64[Tensor, "row 3 3"]) -> Float64[Tensor, "more 3 3"]:
    """Each triangle in four alike."""
    a, b, c = corners.unbind(1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return torch.stack([torch.stack(part, 1) for part in parts], 1).flatten(0, 1)


def trace_tubes(
    facets: Facets,
    occluders: Occluders,
    first_order: IlluminatedPatches,
    min_tube_width: float,
    depth: int,
) -> Iterator[IlluminatedPatches]:
    """Lit patches of the second order, of the third, and so on.

    Args:
        facets: The triangles.
        occluders: The same as rays see them.
        first_order: Triangles that waves light first.
        min_tube_width: Width of a tube that is not split [m].
        depth: Most bounces.

    Source: derivations §13.

    Differs from the source: tubes begin as lit triangles and are cut between facets. On a square
    grid they count whole or not at all.
    """
    last = first_order
    for _ in range(1, depth):
        last = _trace_next_order(facets, occluders, last, min_tube_width)
        if not len(last.aspect):
            return
        yield last


def _trace_next_order(
    facets: Facets, occluders: Occluders, previous: IlluminatedPatches, min_tube_width: float
) -> IlluminatedPatches:
    """What the tubes of one order meet next."""
    ways = reflect_vectors(previous.direction, previous.normal)

    def hit_facets(row: Tensor, points: Tensor) -> Tensor:
        starts = points + ray_offset(facets, previous.normal[row])[:, None]
        ends = starts + 3 * facets.size * ways[row][:, None]
        found, _ = find_next_surface(occluders, starts.flatten(0, 1), ends.flatten(0, 1))
        return found.view(starts.shape[:2])

    def is_narrow(row: Tensor, pieces: Tensor) -> Tensor:
        d = ways[row][:, None]
        across = pieces - dot(pieces, d)[..., None] * d
        return (across.roll(-1, 1) - across).norm(dim=2).amax(1) <= min_tube_width

    before, corners, facet = subdivide_triangles(previous.polygon, hit_facets, is_narrow)
    before, corners, facet = (x[facet >= 0] for x in (before, corners, facet))
    normal, d = facets.normal[facet], ways[before]
    facing = dot(normal, d)
    keep = (facing.abs() > 1e-9) & ~(facets.solid[facet] & (facing > 0))
    before, facet, corners, normal, d, facing = (
        x[keep] for x in (before, facet, corners, normal, d, facing)
    )
    # The ray tracer says which triangle; where on its plane is found in float64.
    away = dot(normal[:, None], facets.corners[facet, :1] - corners) / facing[:, None]
    polygon = corners + away[..., None] * d[:, None]
    # Equal phases on the mirror.
    offset = previous.phase_offset[before] + dot(previous.direction[before] - d, corners[:, 0])
    normal = -facing.sign()[:, None] * normal
    return patches_in_air(previous.aspect[before], facet, normal, d, offset, polygon, before)
