"""Candidate diffracted paths: one edge with surfaces before and after it, or up to three edges.

Sheets are passed on the way; the search has no derivatives. A path over one edge connects two
images: that of the transmitter in the planes before the edge, and that of the receiver in those
after it. It exists where both of its legs are unobstructed. Every sharp edge contributes at every
receiver with an unobstructed path over it, also if the diffraction point lies beyond the end of the
edge, since the end itself then diffracts. The field is therefore continuous where a ray slides off
an edge, and sums over the edges of a plate have no jump at its corners.

Source: derivations §9.

Differs from the source: where a path has the maximum number of reflections, its edge's faces do not
reflect. Waves of one reflection more are not traced, and the diffracted terms that compensate for
their boundaries would jump.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel.em.plane_waves import dot
from invertwin.channel.rows import Rows, concatenate_rows
from invertwin.channel.specular import image_method
from invertwin.channel.specular.candidates import enumerate_sequences, shoot_sequences_from_edges
from invertwin.channel.specular.corner_diffraction import face_weight
from invertwin.channel.specular.edge_path_geometry import multiple_diffraction_points
from invertwin.channel.specular.ray_paths import REFLECTION, TRANSMISSION, match_rows
from invertwin.channel.specular.wedge_scene import WedgeScene, is_exterior

Corner = Literal["first", "last"] | None
_Antennas = tuple[Float64[Tensor, "tx 3"], Float64[Tensor, "rx 3"]]
"""Positions of transmitters and receivers [m]."""
_ROWS_AT_ONCE = 1 << 16
_EDGE_FRACTIONS = (0.5, 0.1, 0.9)  # points on edges of the mutual visibility test
_PLANE_TOLERANCE = 1e-6  # of the scene's size, or rad


@dataclass(frozen=True)
class PathLegs(Rows):
    """Surfaces on the legs from the transmitter to the edge, or from the edge on; detached.

    Attributes:
        faces: triangles, in the order of the path.
        transmitted: True for transmission, False for reflection.
    """

    faces: Int64[Tensor, "row step"]
    transmitted: Bool[Tensor, "row step"]

    def reverse(self) -> "PathLegs":
        """Return the legs in the opposite order."""
        return PathLegs(self.faces.flip(1), self.transmitted.flip(1))

    @property
    def kinds(self) -> Int64[Tensor, "row step"]:
        """Interaction types, numbers of ``KINDS``."""
        return torch.where(self.transmitted, TRANSMISSION, REFLECTION)


@dataclass(frozen=True)
class DiffractionCandidates(Rows):
    """Diffracted paths over equal numbers of edges, one row each; detached.

    Attributes:
        tx, rx: antenna numbers.
        edge: edge numbers, from the transmitter on.
        before, after: surfaces before the first edge and after the last.
        between: faces of both edges along which a leg between edges runs (−1: none).
        reflects: False if the edge's faces do not reflect, at the maximum depth.
        corner: "first" or "last" if that edge is met in a corner, where its neighbour ends.
        end: end of that neighbour, 0 or 1.
    """

    tx: Int64[Tensor, " row"]
    rx: Int64[Tensor, " row"]
    edge: Int64[Tensor, "row order"]
    before: PathLegs
    after: PathLegs
    between: Int64[Tensor, "row leg 2"]
    reflects: bool = True
    corner: Corner = None
    end: Int64[Tensor, " row"] | None = None


def find_diffraction_candidates(
    wedge_scene: WedgeScene,
    tx: Float64[Tensor, "tx 3"],
    rx: Float64[Tensor, "rx 3"],
    order: int,
    depth: int,
    rays: int | None,
    seed: int,
) -> Iterator[DiffractionCandidates]:
    """Find paths over one edge with up to ``depth`` reflections, and over more without surfaces.

    Args:
        wedge_scene: scene with sharp edges.
        tx, rx: antenna positions [m].
        order: maximum number of edges on a path, 0 to 3.
        depth: maximum number of reflections on a path over one edge.
        rays: number of rays from all edges together; None tests every sequence.
        seed: random seed of the rays.
    """
    if not order or not len(wedge_scene.detached_wedges.start):
        return
    tables = _edge_sequences(wedge_scene, depth, rays, seed)
    sides = [
        [_find_visible_edges(wedge_scene, table, positions) for table in tables]
        for positions in (tx, rx)
    ]
    for surfaces in range(len(tables)):
        for before in range(surfaces + 1):
            ends = sides[0][before], sides[1][surfaces - before]
            yield from _diffract_once(wedge_scene, *ends, depth)
    if order > 1:
        yield from _diffract_repeatedly(wedge_scene, (tx, rx), order)


def _edge_sequences(
    wedge_scene: WedgeScene, depth: int, rays: int | None, seed: int
) -> list[Int64[Tensor, "row column"]]:
    """Sequences that start at edges, by length: edge number, then steps."""
    surfaces, count = wedge_scene.surfaces, len(wedge_scene.detached_wedges.start)
    edges = torch.arange(count)
    tables = [edges[:, None]]
    if not depth:
        return tables
    if rays is None:
        for steps in enumerate_sequences(surfaces, depth).steps:
            edge = edges.repeat_interleave(len(steps))
            tables.append(torch.cat([edge[:, None], steps.repeat(count, 1)], 1))
    else:
        edge = edges.repeat_interleave(-(-rays // count))
        fraction = np.random.default_rng(np.random.SeedSequence([seed, 1])).random(len(edge))
        wedges = wedge_scene.detached_wedges.select(edge)
        points = wedges.start + torch.from_numpy(fraction)[:, None] * (wedges.end - wedges.start)
        points = wedge_scene.offset_points(edge, points)
        tables += shoot_sequences_from_edges(surfaces, points, edge, depth, seed)
    # Planes that contain the edge are its faces.
    own = [_lies_in_plane(wedge_scene, table[:, 0], table[:, 1]) for table in tables[1:]]
    return [tables[0], *(table[~mask] for table, mask in zip(tables[1:], own, strict=True))]


def _lies_in_plane(wedge_scene: WedgeScene, edge: Tensor, plane: Tensor) -> Bool[Tensor, " row"]:
    """Test if edges lie in planes."""
    surfaces = wedge_scene.surfaces
    point, normal = surfaces.planes.point[plane] + surfaces.origin, surfaces.planes.normal[plane]
    wedges = wedge_scene.detached_wedges
    low = dot(wedges.start[edge] - point, normal).abs()
    high = dot(wedges.end[edge] - point, normal).abs()
    return torch.maximum(low, high) < _PLANE_TOLERANCE * surfaces.size


@dataclass(frozen=True)
class _VisibleEdges(Rows):
    """Sequences that may connect edges to antennas, in the order of the edges.

    Attributes:
        antenna, edge: antenna and edge numbers.
        steps: planes of the reflections, from the edge to the antenna.
        image: image of the antenna in these planes [m].
        position: position of the antenna [m].
    """

    antenna: Tensor
    edge: Tensor
    steps: Tensor
    image: Float64[Tensor, "row 3"]
    position: Float64[Tensor, "row 3"]


def _find_visible_edges(wedge_scene: WedgeScene, table: Tensor, positions: Tensor) -> _VisibleEdges:
    """Find antennas whose images lie in the exterior of wedges, for each sequence.

    As a point moves along an edge, the line to the image intersects a plane along a straight line.
    """
    surfaces, wedges = wedge_scene.surfaces, wedge_scene.detached_wedges
    none = torch.zeros(0, dtype=torch.int64)
    parts = [_VisibleEdges(none, none, table[:0, 1:], positions[:0], positions[:0])]
    for rows in torch.arange(len(positions) * len(table)).split(_ROWS_AT_ONCE):
        antenna, row = rows // len(table), rows % len(table)
        edge, steps = table[row, 0], table[row, 1:]
        images = surfaces.images(positions[antenna], steps.flip(1))
        image = images[-1] + surfaces.origin
        keep = is_exterior(wedges.select(edge), image)
        if steps.shape[1]:
            ends = [end[edge] - surfaces.origin for end in (wedges.start, wedges.end)]
            keep &= _may_cross_planes(wedge_scene, steps.flip(1), images, ends)
        found = _VisibleEdges(antenna, edge, steps, image, positions[antenna])
        parts.append(found.select(keep))
    found = concatenate_rows(parts)
    return found.select(found.edge.argsort(stable=True))


def _may_cross_planes(
    wedge_scene: WedgeScene, steps: Tensor, images: list[Tensor], ends: list[Tensor]
) -> Bool[Tensor, " row"]:
    """False where no line from an edge to the images can intersect all planes within them."""
    planes, margin = wedge_scene.surfaces.planes, wedge_scene.surfaces.margin
    keep, decidable = torch.ones(2, len(steps), dtype=torch.bool).unbind(0)
    points = list(ends)
    for step in reversed(range(steps.shape[1])):
        plane = steps[:, step]
        point, normal = planes.point[plane], planes.normal[plane]
        local, valid = [], []
        for number, end in enumerate(points):
            direction = images[step + 1] - end
            slope = dot(direction, normal)
            fraction = dot(point - end, normal) / image_method.replace_zeros(slope)
            within = (fraction > -_PLANE_TOLERANCE) & (fraction < 1 + _PLANE_TOLERANCE)
            valid.append((slope != 0) & within)
            points[number] = end + fraction[:, None] * direction
            local.append(torch.einsum("rx,rax->ra", points[number] - point, planes.axes[plane]))
        both = valid[0] & valid[1]
        below = torch.maximum(*local) < planes.low[plane] - margin
        above = torch.minimum(*local) > planes.high[plane] + margin
        keep &= ~decidable | valid[0] | valid[1]
        # If one line misses a plane, the remaining planes decide nothing.
        decidable &= both
        keep &= ~(decidable & (below | above).any(1))
    return keep


def _diffract_once(
    wedge_scene: WedgeScene, one: _VisibleEdges, other: _VisibleEdges, depth: int
) -> Iterator[DiffractionCandidates]:
    """Find paths over one edge."""
    surfaces, count = wedge_scene.surfaces, one.steps.shape[1] + other.steps.shape[1]
    for first, last in _match_edges(one, other, len(wedge_scene.detached_wedges.start)):
        outbound, inbound = one.select(first), other.select(last)
        wedges = wedge_scene.detached_wedges.select(outbound.edge)
        points, valid = multiple_diffraction_points([wedges], outbound.image, inbound.image)
        points = points[:, 0]
        valid &= wedge_scene.is_diffracting(outbound.edge, points)
        beside = wedge_scene.offset_points(outbound.edge, points)
        for side in (outbound, inbound):
            rows = torch.nonzero(valid)[:, 0]
            steps, end = side.steps[rows].flip(1), beside[rows] - surfaces.origin
            images = surfaces.images(side.position[rows], steps)
            valid[rows] = image_method.intersects_planes(surfaces, steps, images, end)
        rows, legs = torch.nonzero(valid)[:, 0], list[tuple[Tensor, Tensor]]()
        for side in (outbound, inbound):
            part = side.select(rows)
            path = part.steps.flip(1), part.position, beside[rows]
            clear, *leg = image_method.find_unobstructed_paths(surfaces, *path)
            rows, legs = rows[clear], [(f[clear], t[clear]) for f, t in (*legs, leg)]
        numbers = outbound.antenna, inbound.antenna, outbound.edge[:, None]
        lengths = torch.stack([(faces >= 0).sum(1) for faces, _ in legs], 1)
        for own in lengths.unique(dim=0):
            chosen = torch.nonzero((lengths == own).all(1))[:, 0]
            before, after = (
                PathLegs(faces[chosen, :length], transmitted[chosen, :length])
                for (faces, transmitted), length in zip(legs, own.tolist(), strict=True)
            )
            tx, rx, edge = (number[rows[chosen]] for number in numbers)
            path = tx, rx, edge, before, after.reverse(), torch.full((len(chosen), 0, 2), -1)
            yield DiffractionCandidates(*path, reflects=not 0 < depth == count)


def _match_edges(
    one: _VisibleEdges, other: _VisibleEdges, count: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Row pairs with equal edges, in chunks."""
    partners = torch.bincount(other.edge, minlength=count)[one.edge]
    piece = (partners.cumsum(0) - 1).clamp_min(0) // _ROWS_AT_ONCE
    for rows in torch.arange(len(one.edge)).split(torch.bincount(piece).tolist()):
        first, second = match_rows(one.edge[rows], other.edge, count)
        if len(first):
            yield rows[first], second


def _diffract_repeatedly(
    wedge_scene: WedgeScene, ends: _Antennas, order: int
) -> Iterator[DiffractionCandidates]:
    """Find paths over two edges, and over three if ``order`` is 3, with unobstructed legs."""
    chains, between = pairs, pair_faces = _edge_pairs(wedge_scene)
    edges = torch.arange(len(wedge_scene.detached_wedges.start))[:, None]
    visible = []
    for positions in ends:
        found = _find_visible_edges(wedge_scene, edges, positions)
        table = torch.zeros(len(positions), len(edges), dtype=torch.bool)
        table[found.antenna, found.edge] = True
        visible.append(table)
    yield from _find_chain_paths(wedge_scene, ends, visible, chains, between)
    if order < 3 or not len(chains):
        return
    is_open = _are_mutually_visible(wedge_scene, pairs, pair_faces)
    pairs, pair_faces = pairs[is_open], pair_faces[is_open]
    rows = torch.nonzero(visible[0].any(0)[pairs[:, 0]])[:, 0]
    if not len(rows):
        return
    # In chunks: the number of chains is that of pairs, times the edges that may follow.
    for part in rows.split(max(1, _ROWS_AT_ONCE * len(edges) // max(1, len(pairs)))):
        row, pair = match_rows(pairs[part, 1], pairs[:, 0], int(pairs.max()) + 1)
        chains = torch.cat([pairs[part][row], pairs[pair, 1:]], 1)
        between = torch.cat([pair_faces[part][row], pair_faces[pair]], 1)
        yield from _find_chain_paths(wedge_scene, ends, visible, chains, between)


def _are_mutually_visible(
    wedge_scene: WedgeScene, pairs: Tensor, between: Tensor
) -> Bool[Tensor, " pair"]:
    """Mask of pairs with a face between them, or with any of nine lines across unobstructed."""
    found = between[:, 0, 0] >= 0
    wedges = wedge_scene.detached_wedges
    for fraction, other_fraction in product(_EDGE_FRACTIONS, _EDGE_FRACTIONS):
        rows = torch.nonzero(~found)[:, 0]
        if not len(rows):
            break
        points = []
        for edge, position in zip(pairs[rows].T, (fraction, other_fraction), strict=True):
            point = wedges.start[edge] + position * (wedges.end[edge] - wedges.start[edge])
            points.append(wedge_scene.offset_points(edge, point))
        found[rows] = image_method.is_unobstructed(wedge_scene.surfaces, *points)
    return found


def _find_chain_paths(
    wedge_scene: WedgeScene, ends: _Antennas, seen: list[Tensor], chains: Tensor, between: Tensor
) -> Iterator[DiffractionCandidates]:
    """Find paths over given chains of edges whose first and last edge the antennas see."""
    # Chains visible to an antenna at both ends.
    visible = seen[0].any(0)[chains[:, 0]] & seen[1].any(0)[chains[:, -1]]
    chains, between = chains[visible], between[visible]
    if not len(chains):
        return
    links = torch.cartesian_prod(*(torch.arange(len(places)) for places in ends))
    for part in links.split(max(1, _ROWS_AT_ONCE // len(chains))):
        from_tx = seen[0][part[:, 0]][:, chains[:, 0]]
        link, chain = torch.nonzero(from_tx & seen[1][part[:, 1]][:, chains[:, -1]]).T
        if not len(link):
            continue
        none = torch.zeros(len(link), 0, dtype=torch.int64)
        legs = PathLegs(none, none.bool())
        source, target = part[link].unbind(1)
        found = DiffractionCandidates(source, target, chains[chain], legs, legs, between[chain])
        rows = [wedge_scene.detached_wedges.select(column) for column in found.edge.T]
        points, valid = multiple_diffraction_points(rows, ends[0][source], ends[1][target])
        # Without a face between two edges, each point must lie in the exterior of the other edge.
        for leg in range(chains.shape[1] - 1):
            for first, second in ((leg, leg + 1), (leg + 1, leg)):
                outside = is_exterior(rows[first], points[:, second])
                valid &= outside | (found.between[:, leg, 0] >= 0)
        yield from _select_unobstructed(wedge_scene, found, ends, points, valid)
        yield from _find_corner_paths(wedge_scene, ends, found)


def _find_corner_paths(
    wedge_scene: WedgeScene, antennas: _Antennas, candidates: DiffractionCandidates
) -> Iterator[DiffractionCandidates]:
    """Find paths whose first or last edge is met in a corner, where its neighbour ends."""
    wedges = wedge_scene.detached_wedges
    ends = torch.stack([wedges.start, wedges.end], 1)
    sides: tuple[tuple[Corner, int, int, Tensor], ...] = (
        ("first", 0, 1, antennas[0][candidates.tx]),
        ("last", -1, -2, antennas[1][candidates.rx]),
    )
    for corner, own, other, antenna in sides:
        edge, neighbour = candidates.edge[:, own], candidates.edge[:, other]
        distance = (ends[edge][:, :, None] - ends[neighbour][:, None]).norm(dim=3)
        smallest, end = distance.amin(1).min(1)
        at = ends[neighbour, end]
        faces = candidates.between[:, own]
        faces = faces.flip(1) if corner == "first" else faces
        valid = (smallest < _PLANE_TOLERANCE * wedge_scene.surfaces.size) & (faces[:, 0] >= 0)
        rows = torch.nonzero(valid)[:, 0]
        first, last = (wedges.select(column[rows]) for column in (neighbour, edge))
        rows = rows[face_weight(first, last, faces[rows], (antenna - at)[rows]) > 0]
        if not len(rows):
            continue
        part = replace(candidates.select(rows), corner=corner, end=end[rows])
        numbers = range(candidates.edge.shape[1])
        main = numbers[1:] if corner == "first" else numbers[:-1]
        source, target = antennas[0][part.tx], antennas[1][part.rx]
        between = [wedges.select(part.edge[:, n]) for n in main]
        points, valid = multiple_diffraction_points(between, source, target)
        both = [points, at[rows, None]] if corner == "last" else [at[rows, None], points]
        yield from _select_unobstructed(wedge_scene, part, antennas, torch.cat(both, 1), valid)


def _select_unobstructed(
    wedge_scene: WedgeScene,
    candidates: DiffractionCandidates,
    ends: _Antennas,
    points: Tensor,
    valid: Tensor,
) -> Iterator[DiffractionCandidates]:
    """Keep the valid paths over edge points with unobstructed straight legs."""
    valid, nodes = valid.clone(), [ends[0][candidates.tx]]
    for edge, point in zip(candidates.edge.T, points.unbind(1), strict=True):
        valid &= wedge_scene.is_diffracting(edge, point)
        nodes.append(wedge_scene.offset_points(edge, point))
    nodes.append(ends[1][candidates.rx])
    for start, end in pairwise(nodes):
        rows = torch.nonzero(valid)[:, 0]
        valid[rows] = image_method.is_unobstructed(wedge_scene.surfaces, start[rows], end[rows])
    if bool(valid.any()):
        yield candidates.select(torch.nonzero(valid)[:, 0])


def face_azimuths(
    wedge_scene: WedgeScene, candidates: DiffractionCandidates
) -> Float64[Tensor, "row leg 2"]:
    """Azimuths of departure and of incidence for legs along a face, NaN for other legs.

    Args:
        wedge_scene: scene with sharp edges.
        candidates: diffracted paths.
    """
    opening = wedge_scene.detached_wedges.opening[candidates.edge]
    opening = torch.stack([opening[:, :-1], opening[:, 1:]], 2)  # before and after each leg
    return torch.where(candidates.between < 0, torch.nan, candidates.between * opening * torch.pi)


def _edge_pairs(
    wedge_scene: WedgeScene,
) -> tuple[Int64[Tensor, "pair 2"], Int64[Tensor, "pair 1 2"]]:
    """Pairs of consecutive edges, and the faces of each that lie between them (−1: none).

    Two edges with a face between them have one path along each side that they share.
    """
    wedges = wedge_scene.detached_wedges
    first, second = torch.nonzero(~torch.eye(len(wedges.start), dtype=torch.bool)).T
    offset = (wedges.start + wedges.end)[second] - (wedges.start + wedges.end)[first]
    rows, faces, shared = [], [], torch.zeros(len(first), dtype=torch.bool)
    for one, other in product((0, 1), (0, 1)):
        normal = wedges.normals[first, one]
        parallel = dot(normal, wedges.normals[second, other]) > 1 - _PLANE_TOLERANCE**2
        flat = dot(normal, offset).abs() < _PLANE_TOLERANCE * wedge_scene.surfaces.size
        ahead = dot(offset, wedges.face_tangents[first, one]) > 0
        behind = dot(offset, wedges.face_tangents[second, other]) < 0
        rows_chosen = torch.nonzero(parallel & flat & ahead & behind)[:, 0]
        shared[rows_chosen] = True
        rows.append(torch.stack([first[rows_chosen], second[rows_chosen]], 1))
        faces.append(torch.tensor([[one, other]]).expand(len(rows_chosen), 2))
    # Other pairs: at least one end of each lies in the exterior of the other.
    free = ~shared
    for near, far in ((first, second), (second, first)):
        outside = [is_exterior(wedges.select(near), end[far]) for end in (wedges.start, wedges.end)]
        free &= outside[0] | outside[1]
    rows.append(torch.stack([first[free], second[free]], 1))
    faces.append(torch.full((int(free.sum()), 2), -1))
    return torch.cat(rows), torch.cat(faces)[:, None]
