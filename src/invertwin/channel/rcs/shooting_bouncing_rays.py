"""Shooting and bouncing rays: illuminated triangles of a mesh, and their reflected ray tubes.

A fully illuminated triangle is exact. A partly illuminated one is split in four down to a given
size; the smallest pieces are cut along the shadow boundary. Reflected tubes are split likewise
where they meet several surfaces. On one smooth surface of metal narrow tubes are kept whole, as
plane waves on the plane of one facet: cut between facets, their number would grow with every
bounce.
"""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel.beams.beam_tracing import Facets, IlluminatedPatches, patches_in_air
from invertwin.channel.em.plane_waves import dot, reflect_vectors
from invertwin.channel.rays.ray_scene import Occluders, find_next_surface, find_surface_ahead

_MAX_SIDE_RATIO = 8.0  # times the smallest piece: larger triangles are split in advance
_CORNER_INSET = 0.02  # fraction from a corner to the centre at which the corner is tested
_BISECTIONS = 8  # bisection steps along a side
_ROWS_AT_ONCE = 1 << 18
_MAX_HEIGHT = 1 / 16  # of the least tube width: hits over the plane of a tube that is kept whole
_MAX_UNEVENNESS = 1e-3  # of the least tube width: the same of a wide tube, on flat faces
_RAY_OFFSET = 2e-6  # of the scene's size: offset of ray origins from a surface


def find_illuminated_triangles(
    facets: Facets,
    is_unoccluded: Callable[[Tensor, Tensor], Tensor],
    incident: Float64[Tensor, "aspect 3"],
    min_side: float,
) -> Iterator[IlluminatedPatches]:
    """Find illuminated pieces of triangles, in batches of waves.

    Args:
        facets: facets of all triangles.
        is_unoccluded: function of points and unit directions; returns a mask of unobstructed rays.
        incident: direction d of each wave.
        min_side: side below which pieces are not split [m].
    """

    def illuminate(aspect: Tensor, number: Tensor, corners: Tensor) -> IlluminatedPatches:
        d = incident[aspect]
        normal = _orient_normals(facets.normal[number].detach(), d)

        def test_illumination(row: Tensor, points: Tensor) -> Tensor:
            starts = points + ray_offset(facets, normal[row])[:, None]
            back = -d[row][:, None].expand_as(starts)
            lit = is_unoccluded(starts.flatten(0, 1), back.flatten(0, 1))
            return lit.view(starts.shape[:2]).long()

        row, corners, lit = subdivide_triangles(
            corners, test_illumination, lambda _, pieces: _longest_sides(pieces) <= min_side
        )
        row, corners = row[lit > 0], corners[lit > 0]
        aspect, number, d = aspect[row], number[row], d[row]
        normal = _orient_normals(facets.normal[number], d)
        before = torch.full_like(aspect, -1)
        return patches_in_air(aspect, number, normal, d, torch.zeros_like(d[:, 0]), corners, before)

    number, corners = split_large_triangles(
        facets.corners.detach(),
        lambda _, pieces: _longest_sides(pieces) > _MAX_SIDE_RATIO * min_side,
    )
    for waves in torch.arange(len(incident)).split(max(1, _ROWS_AT_ONCE // len(number))):
        aspect = waves.repeat_interleave(len(number))
        row = torch.arange(len(number)).repeat(len(waves))
        facing = dot(facets.normal[number[row]].detach(), incident[aspect])
        keep = ((facing < 0) | ~facets.solid[number[row]]) & (facing.abs() > 1e-9)
        yield illuminate(aspect[keep], number[row[keep]], corners[row[keep]])


def split_large_triangles(
    corners: Float64[Tensor, "row 3 3"], is_large: Callable[[Tensor, Tensor], Tensor]
) -> tuple[Int64[Tensor, " piece"], Float64[Tensor, "piece 3 3"]]:
    """Split triangles in four until none is large; returns the row and corners of every piece.

    Args:
        corners: corners of the triangles [m].
        is_large: function of rows and pieces; returns a mask.
    """
    row = torch.arange(len(corners))
    while bool((large := is_large(row, corners)).any()):
        corners = torch.cat([corners[~large], _quarter_triangles(corners[large])])
        row = torch.cat([row[~large], row[large].repeat_interleave(4)])
    return row, corners


def subdivide_triangles(
    corners: Float64[Tensor, "row 3 3"],
    classify: Callable[[Tensor, Tensor], Tensor],
    is_narrow: Callable[[Tensor, Tensor], Tensor],
    is_flat: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None,
    group: Callable[[Tensor], Tensor] = torch.Tensor.clone,
) -> tuple[Int64[Tensor, " piece"], Float64[Tensor, "piece 3 3"], Int64[Tensor, " piece"]]:
    """Subdivide triangles into pieces of uniform label.

    Args:
        corners: corners of the triangles [m].
        classify: function of rows and their points [row, point, 3]; returns labels [row, point].
        is_narrow: function of rows and pieces; returns a mask of pieces to cut along a line instead
            of splitting in four.
        is_flat: function of rows, their centres and corners [row, 4, 3] and the labels of these;
            returns a mask of pieces to keep whole, with the label of their centre.
        group: function of labels; returns equal numbers for labels between which nothing is cut, if
            others are in the piece.

    Returns:
        Row, corners and label of every piece.
    """
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    row = torch.arange(len(corners))
    while True:
        points = inset_points(corners)
        labels = classify(row, points)
        is_uniform = (labels == labels[:, :1]).all(1)
        if is_flat is not None:
            mixed = torch.nonzero(~is_uniform)[:, 0]
            is_uniform[mixed] = is_flat(row[mixed], points[mixed], labels[mixed])
        found.append((row[is_uniform], corners[is_uniform], labels[is_uniform, 0]))
        row, corners, labels = row[~is_uniform], corners[~is_uniform], labels[~is_uniform]
        if not len(row):
            break
        narrow = is_narrow(row, corners)
        found += _split_triangles(row[narrow], corners[narrow], labels[narrow], classify, group)
        row, corners = row[~narrow].repeat_interleave(4), _quarter_triangles(corners[~narrow])
    pieces = zip(*found, strict=True)
    return torch.cat(next(pieces)), torch.cat(next(pieces)), torch.cat(next(pieces))


def _split_triangles(
    row: Tensor,
    corners: Tensor,
    labels: Tensor,
    classify: Callable[[Tensor, Tensor], Tensor],
    group: Callable[[Tensor], Tensor],
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Cut triangles with one corner of another group; others take the label of their centre."""
    is_one = (group(labels) == group(labels[:, :1])).all(1, keepdim=True)

    def key(found: Tensor) -> Tensor:
        return torch.where(is_one, found, group(found))

    keys = key(labels)[:, 1:]
    others_agree = keys.roll(-1, 1) == keys.roll(1, 1)  # those of the other two corners
    single = others_agree.sum(1) != 1
    yield row[single], corners[single], labels[single, 0]
    order = (others_agree[~single].long().argmax(1, keepdim=True) + torch.arange(3)) % 3
    row, is_one, labels = row[~single], is_one[~single], labels[~single, 1:].gather(1, order)
    corners = corners[~single].gather(1, order[..., None].expand(-1, -1, 3))
    inner = inset_points(corners)[:, 1:]
    # Fraction of the sides from the odd corner with its label.
    low = torch.zeros(len(row), 2, dtype=torch.float64)
    for step in range(1, _BISECTIONS + 1):
        middle = low + 0.5**step
        points = inner[:, :1] + middle[..., None] * (inner[:, 1:] - inner[:, :1])
        low = torch.where(key(classify(row, points)) == key(labels[:, :1]), middle, low)
    fraction = (low + 0.5 ** (_BISECTIONS + 1))[..., None]
    a, b, c = corners.unbind(1)
    p, q = (a[:, None] + fraction * (corners[:, 1:] - a[:, None])).unbind(1)
    yield row, torch.stack([a, p, q], 1), labels[:, 0]
    for part in ((p, b, c), (p, c, q)):
        yield row, torch.stack(part, 1), labels[:, 1]


def ray_offset(facets: Facets, normal: Float64[Tensor, "row 3"]) -> Float64[Tensor, "row 3"]:
    """Offset of ray origins from a surface [m].

    Args:
        facets: facets of all triangles.
        normal: unit normals of the surface, towards the rays.
    """
    return _RAY_OFFSET * facets.size * normal


def inset_points(corners: Float64[Tensor, "row 3 3"]) -> Float64[Tensor, "row 4 3"]:
    """Centre of each triangle, and a point near each corner [m].

    Args:
        corners: corners of the triangles [m].
    """
    weights = torch.full((4, 3), _CORNER_INSET / 3, dtype=corners.dtype)
    weights[0] = 1 / 3
    weights[1:].diagonal().add_(1 - _CORNER_INSET)
    # One product with a matrix of 9 × 12 is seven times as fast as interpolation.
    return (corners.flatten(1) @ torch.kron(weights, torch.eye(3).to(corners)).T).view(-1, 4, 3)


def _orient_normals(normal: Tensor, direction: Tensor) -> Tensor:
    """Orient normals towards the source of a wave."""
    return -dot(normal, direction).sign()[:, None] * normal


def _longest_sides(corners: Tensor) -> Tensor:
    return (corners.roll(-1, 1) - corners).norm(dim=2).amax(1)


def _quarter_triangles(corners: Float64[Tensor, "row 3 3"]) -> Float64[Tensor, "more 3 3"]:
    """Split each triangle into four similar ones."""
    a, b, c = corners.unbind(1)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return torch.stack([torch.stack(part, 1) for part in parts], 1).flatten(0, 1)


def trace_tubes(
    facets: Facets,
    occluders: Occluders,
    metal_face: Int64[Tensor, " entry"],
    first_order: IlluminatedPatches,
    min_tube_width: float,
    depth: int,
) -> Iterator[IlluminatedPatches]:
    """Trace ray tubes: illuminated patches of the second order, of the third, and so on.

    Args:
        facets: facets of all triangles.
        occluders: ray scene of the triangles.
        metal_face: number of the smooth face of each facet of metal; of other facets one of their
            own; and of no facet, −1, at the end.
        first_order: directly illuminated triangles.
        min_tube_width: width below which tubes are not split [m].
        depth: maximum number of bounces.

    Source: derivations §13.

    Differs from the source: tubes start as illuminated triangles and are cut between surfaces,
    instead of a square grid of tubes that count as a whole or not at all.
    """
    last = first_order
    for _ in range(1, depth):
        last = _trace_next_order(facets, occluders, metal_face, last, min_tube_width)
        if not len(last.aspect):
            return
        yield last


def _trace_next_order(
    facets: Facets,
    occluders: Occluders,
    metal_face: Tensor,
    previous: IlluminatedPatches,
    min_tube_width: float,
) -> IlluminatedPatches:
    """Trace the tubes of one order to their next surface."""
    directions = reflect_vectors(previous.direction, previous.normal)
    max_height, way = _MAX_HEIGHT * min_tube_width, 3 * facets.size * directions
    offset = ray_offset(facets, previous.normal)
    own = metal_face[previous.facet]

    def hit_facets(row: Tensor, points: Tensor) -> Tensor:
        found, along = find_surface_ahead(occluders, points, row, offset, way)
        # A tube that was kept whole overhangs its facet, and may start behind the neighbours.
        at, point = torch.nonzero(metal_face[found] == own[row, None], as_tuple=True)
        on, other, length = row[at], facets.normal[found[at, point]], along[at, point]
        behind = (length * dot(previous.normal[on], way[on]) < max_height) & (
            dot(other, way[on]) * dot(other, previous.normal[on]) > 0
        )
        at, point, on, length = (column[behind] for column in (at, point, on, length))
        starts = points[at, point] + offset[on] + length[:, None] * way[on]
        starts += 2 * ray_offset(facets, directions[on])
        found[at, point] = find_next_surface(occluders, starts, starts + way[on])[0]
        return found

    def is_flat(row: Tensor, points: Tensor, facet: Tensor) -> Tensor:
        face = metal_face[facet]
        flat = ((facet >= 0) & (face == face[:, :1])).all(1)
        row, points, facet = row[flat], points[flat], facet[flat]
        d, centre = directions[row][:, None], facet[:, :1]
        normal, distance = facets.normal[centre], _distance_to_facets(facets, facet, points, d)
        height = dot(normal, points - facets.corners[centre, 0]) + distance * dot(normal, d)
        limit = torch.where(is_narrow(row, 2 * points[:, 1:]), _MAX_HEIGHT, _MAX_UNEVENNESS)
        flat[flat.clone()] = (height.abs() <= limit[:, None] * min_tube_width).all(1)
        return flat

    def is_narrow(row: Tensor, pieces: Tensor) -> Tensor:
        d = directions[row][:, None]
        transverse = pieces - dot(pieces, d)[..., None] * d
        return (transverse.roll(-1, 1) - transverse).norm(dim=2).amax(1) <= min_tube_width

    parent, corners, facet = subdivide_triangles(
        previous.polygon, hit_facets, is_narrow, is_flat, metal_face.__getitem__
    )
    normal, d = facets.normal[facet], directions[parent]
    facing = dot(normal, d)
    keep = (facet >= 0) & (facing.abs() > 1e-9) & ~(facets.solid[facet] & (facing > 0))
    columns = parent, facet, corners, normal, d, facing
    parent, facet, corners, normal, d, facing = (column[keep] for column in columns)
    distance = _distance_to_facets(facets, facet[:, None], corners, d[:, None])
    polygon = corners + distance[..., None] * d[:, None]
    # Phase matching on the reflecting face.
    offset = previous.phase_offset[parent] + dot(previous.direction[parent] - d, corners[:, 0])
    normal = -facing.sign()[:, None] * normal
    return patches_in_air(previous.aspect[parent], facet, normal, d, offset, polygon, parent)


def _distance_to_facets(
    facets: Facets, facet: Tensor, points: Tensor, directions: Tensor
) -> Float64[Tensor, "row point"]:
    """Distance of points from planes of facets along rays, in float64 [m]."""
    normal = facets.normal[facet]
    return dot(normal, facets.corners[facet, 0] - points) / dot(normal, directions)
