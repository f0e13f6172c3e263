"""Meshes: what a plane wave lights first, triangle by triangle.

A triangle that is seen whole counts exactly. One that is seen in part is split in four until its
pieces are as small as asked for; these are cut where light ends.
"""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel.beams.beam_tracing import Bounce, Facets, in_air
from invertwin.channel.em.plane_waves import dot, mirrored
from invertwin.channel.rays.ray_scene import Occluders, next_surface

_LARGE = 8.0  # times the smallest piece: larger triangles are split before they are looked at
_INSET = 0.02  # from a corner to the middle, where a corner is looked at
_HALVINGS = 4  # of a side, to find where it is cut
_ROWS_AT_ONCE = 1 << 18
_ASIDE = 2e-6  # of the scene's size: from how far above a surface rays start


def lit_triangles(
    facets: Facets,
    clear: Callable[[Tensor, Tensor], Tensor],
    incident: Float64[Tensor, "aspect 3"],
    smallest: float,
) -> Iterator[Bounce]:
    """Lit pieces of triangles, in parts of as many waves as memory holds.

    Args:
        facets: the triangles.
        clear: points and unit vectors → whether nothing is in the way.
        incident: d of each wave.
        smallest: side of a piece that is not split [m].
    """
    number = torch.arange(len(facets.normal))
    corners = facets.corners.detach()
    while bool((large := _longest(corners) > _LARGE * smallest).any()):
        corners = torch.cat([corners[~large], _quarters(corners[large])])
        number = torch.cat([number[~large], number[large].repeat_interleave(4)])
    for some in torch.arange(len(incident)).split(max(1, _ROWS_AT_ONCE // len(number))):
        aspect = some.repeat_interleave(len(number))
        row = torch.arange(len(number)).repeat(len(some))
        facing = dot(facets.normal[number[row]].detach(), incident[aspect])
        turned = (facing < 0) | ~facets.solid[number[row]]
        keep = turned & (facing.abs() > 1e-9)
        yield _lit(
            facets, clear, incident, smallest, aspect[keep], number[row[keep]], corners[row[keep]]
        )


def _lit(
    facets: Facets,
    clear: Callable[[Tensor, Tensor], Tensor],
    incident: Tensor,
    smallest: float,
    aspect: Tensor,
    number: Tensor,
    corners: Tensor,
) -> Bounce:
    d = incident[aspect]
    normal = _towards(facets.normal[number].detach(), d)

    def seen(row: Tensor, points: Tensor) -> Tensor:
        starts = points + above(facets, normal[row])[:, None]
        back = -d[row][:, None].expand_as(starts)
        return clear(starts.flatten(0, 1), back.flatten(0, 1)).view(starts.shape[:2]).long()

    row, corners, lit = divided(corners, seen, lambda _, pieces: _longest(pieces) <= smallest)
    row, corners = row[lit > 0], corners[lit > 0]
    aspect, number, d = aspect[row], number[row], d[row]
    normal = _towards(facets.normal[number], d)
    before = torch.full_like(aspect, -1)
    return in_air(aspect, number, normal, d, torch.zeros_like(d[:, 0]), corners, before)


def divided(
    corners: Float64[Tensor, "row 3 3"],
    look: Callable[[Tensor, Tensor], Tensor],
    narrow: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Int64[Tensor, " piece"], Float64[Tensor, "piece 3 3"], Int64[Tensor, " piece"]]:
    """Pieces of triangles in each of which all points look alike.

    Args:
        corners: Of the triangles.
        look: Rows and points of each [row, point, 3] → numbers of what is seen there [row, point].
        narrow: Rows and pieces → whether a piece is not split in four, but cut along a line.

    Returns:
        For every piece: the row, its corners, the number.
    """
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    row = torch.arange(len(corners))
    while True:
        seen = look(row, inner_points(corners))
        whole = (seen == seen[:, :1]).all(1)
        found.append((row[whole], corners[whole], seen[whole, 0]))
        row, corners, seen = row[~whole], corners[~whole], seen[~whole]
        if not len(row):
            break
        last = narrow(row, corners)
        found += _cut(row[last], corners[last], seen[last], look)
        row, corners = row[~last].repeat_interleave(4), _quarters(corners[~last])
    pieces = zip(*found, strict=True)
    return torch.cat(next(pieces)), torch.cat(next(pieces)), torch.cat(next(pieces))


def _cut(
    row: Tensor, corners: Tensor, seen: Tensor, look: Callable[[Tensor, Tensor], Tensor]
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Triangles one corner of which sees something else, cut; others look as their middles do."""
    first, second, third = seen[:, 1:].unbind(1)
    pairs = (first == second).long() + (second == third).long() + (third == first).long()
    single = pairs != 1
    yield row[single], corners[single], seen[single, 0]
    odd = torch.where(second == third, 0, torch.where(third == first, 1, 2))[~single]
    order = (odd[:, None] + torch.arange(3)) % 3
    row, seen = row[~single], seen[~single, 1:].gather(1, order)
    corners = corners[~single].gather(1, order[..., None].expand(-1, -1, 3))
    inner = inner_points(corners)[:, 1:]
    # How far the sides that begin at the odd corner look as it does.
    low = torch.zeros(len(row), 2, dtype=torch.float64)
    for step in range(1, _HALVINGS + 1):
        middle = low + 0.5**step
        points = inner[:, :1] + middle[..., None] * (inner[:, 1:] - inner[:, :1])
        low = torch.where(look(row, points) == seen[:, :1], middle, low)
    share = (low + 0.5 ** (_HALVINGS + 1))[..., None]
    a, b, c = corners.unbind(1)
    p, q = (a[:, None] + share * (corners[:, 1:] - a[:, None])).unbind(1)
    yield row, torch.stack([a, p, q], 1), seen[:, 0]
    for part in ((p, b, c), (p, c, q)):
        yield row, torch.stack(part, 1), seen[:, 1]


def above(facets: Facets, normal: Float64[Tensor, "row 3"]) -> Float64[Tensor, "row 3"]:
    """How far above a surface rays start.

    Args:
        facets: All triangles.
        normal: Of the surface, towards the rays.
    """
    return _ASIDE * facets.size * normal


def inner_points(corners: Float64[Tensor, "row 3 3"]) -> Float64[Tensor, "row 4 3"]:
    """The middle of each triangle, and a point near each corner.

    Args:
        corners: Of the triangles [m].
    """
    middle = corners.mean(1, keepdim=True)
    return torch.cat([middle, corners + _INSET * (middle - corners)], 1)


def _towards(normal: Tensor, direction: Tensor) -> Tensor:
    """Normals on the side that the wave comes from."""
    return -dot(normal, direction).sign()[:, None] * normal


def _longest(corners: Tensor) -> Tensor:
    return (corners.roll(-1, 1) - corners).norm(dim=2).amax(1)


def _quarters(corners: Float64[Tensor, "row 3 3"]) -> Float64[Tensor, "more 3 3"]:
    """Each triangle in four alike."""
    a, b, c = corners.unbind(1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return torch.stack([torch.stack(part, 1) for part in parts], 1).flatten(0, 1)


def tubes(
    facets: Facets, occluders: Occluders, lit: Bounce, narrowest: float, depth: int
) -> Iterator[Bounce]:
    """Lit patches of the second order, of the third, and so on.

    Args:
        facets: The triangles.
        occluders: The same as rays see them.
        lit: Triangles that waves light first.
        narrowest: Width of a tube that is not split [m].
        depth: Most bounces.

    Source: derivations §13.

    Differs from the source: tubes begin as lit triangles and are cut between facets. On a square
    grid they count whole or not at all.
    """
    last = lit
    for _ in range(1, depth):
        last = _next(facets, occluders, last, narrowest)
        if not len(last.aspect):
            return
        yield last


def _next(facets: Facets, occluders: Occluders, last: Bounce, narrowest: float) -> Bounce:
    """What the tubes of one order meet next."""
    ways = mirrored(last.direction, last.normal)

    def met(row: Tensor, points: Tensor) -> Tensor:
        starts = points + above(facets, last.normal[row])[:, None]
        ends = starts + 3 * facets.size * ways[row][:, None]
        found, _ = next_surface(occluders, starts.flatten(0, 1), ends.flatten(0, 1))
        return found.view(starts.shape[:2])

    def narrow(row: Tensor, pieces: Tensor) -> Tensor:
        d = ways[row][:, None]
        across = pieces - dot(pieces, d)[..., None] * d
        return (across.roll(-1, 1) - across).norm(dim=2).amax(1) <= narrowest

    before, corners, facet = divided(last.polygon, met, narrow)
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
    offset = last.offset[before] + dot(last.direction[before] - d, corners[:, 0])
    normal = -facing.sign()[:, None] * normal
    return in_air(last.aspect[before], facet, normal, d, offset, polygon, before)
