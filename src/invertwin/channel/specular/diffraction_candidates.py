"""Which paths go round edges, detached: over one edge with mirrors and sheets before and after it.

A path over one edge is one between two images: that of the transmitter in the planes before the
edge, and that of the receiver in those after it. It exists where both of its legs are free. Every
sharp edge sends at every receiver whose way over it is free: also one whose ray would pass the end
of the edge, since the end itself then sends. Nothing therefore jumps where a ray slides off an
edge, and sums over the edges of a plate have no jump at its corners.

Source: derivations §9.

Differs from the source: where a path has as many surfaces as it may, its edge's faces neither
mirror nor let through. Waves of one surface more are not followed, and what makes up for their ends
would jump.
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
from invertwin.channel.specular.candidates import (
    FaceInteractions,
    enumerate_sequences,
    shoot_sequences_from_edges,
)
from invertwin.channel.specular.corner_diffraction import face_weight
from invertwin.channel.specular.edge_path_geometry import (
    diffraction_points,
    multiple_diffraction_points,
)
from invertwin.channel.specular.image_method import (
    find_unobstructed_paths,
    image_positions,
    intersects_planes,
)
from invertwin.channel.specular.ray_paths import REFLECTION, TRANSMISSION, match_rows
from invertwin.channel.specular.wedge_scene import WedgeScene, is_exterior

Corner = Literal["first", "last"] | None
_ROWS_AT_ONCE = 1 << 16
_EDGE_FRACTIONS = (0.5, 0.1, 0.9)  # of edges: where they may see each other
_PLANE_TOLERANCE = 1e-6  # of the scene's size, or rad


@dataclass(frozen=True)
class PathLegs:
    """Surfaces on the ways from the transmitter to the edge, or from the edge on; detached.

    Attributes:
        faces: triangles, in the order of the path.
        transmitted: whether the path goes through them instead of being mirrored.
    """

    faces: Int64[Tensor, "row step"]
    transmitted: Bool[Tensor, "row step"]

    @property
    def kinds(self) -> Int64[Tensor, "row step"]:
        """What happens there, by ``KINDS``."""
        return torch.where(self.transmitted, TRANSMISSION, REFLECTION)

    def rows(self, index: Tensor) -> "PathLegs":
        """Some rows."""
        return PathLegs(self.faces[index], self.transmitted[index])


@dataclass(frozen=True)
class DiffractionCandidates:
    """Paths over as many edges, one row each; detached.

    Attributes:
        tx, rx: numbers of the antennas.
        edge: numbers of the edges, from the transmitter on.
        before, after: surfaces on the way to the first edge and from the last.
        between: of legs from edge to edge, which of either edge's faces they run along (−1: none).
        absorbing: leave out what the edge's faces mirror and let through: one surface too many.
        corner: whether the first or the last edge is met in a corner, where its neighbour ends.
        end: which end of that neighbour it is.
    """

    tx: Int64[Tensor, " row"]
    rx: Int64[Tensor, " row"]
    edge: Int64[Tensor, "row order"]
    before: PathLegs
    after: PathLegs
    between: Int64[Tensor, "row leg 2"]
    absorbing: bool = False
    corner: Corner = None
    end: Int64[Tensor, " row"] | None = None

    def rows(self, index: Tensor) -> "DiffractionCandidates":
        """Some rows."""
        return DiffractionCandidates(
            self.tx[index],
            self.rx[index],
            self.edge[index],
            self.before.rows(index),
            self.after.rows(index),
            self.between[index],
            self.absorbing,
            self.corner,
            None if self.end is None else self.end[index],
        )


def find_diffraction_candidates(
    wedge_scene: WedgeScene,
    interactions: FaceInteractions,
    tx: Float64[Tensor, "tx 3"],
    rx: Float64[Tensor, "rx 3"],
    order: int,
    depth: int,
    rays: int | None,
    seed: int,
) -> Iterator[DiffractionCandidates]:
    """Paths over one edge with up to ``depth`` surfaces, and over more edges alone.

    Args:
        wedge_scene: the scene.
        interactions: what triangles do to rays.
        tx, rx: antennas [m].
        order: most edges of a path, 1 to 3.
        depth: most surfaces of a path over one edge.
        rays: shot from all edges together, for candidates; None = every sequence.
        seed: of these rays.
    """
    if not len(wedge_scene.detached_wedges.start):
        return
    tables = _edge_sequences(wedge_scene, interactions, depth, rays, seed)
    sides = [
        [_find_visible_edges(wedge_scene, table, places) for table in tables] for places in (tx, rx)
    ]
    for surfaces in range(len(tables)):
        for before in range(surfaces + 1):
            yield from _diffract_once(
                wedge_scene, sides[0][before], sides[1][surfaces - before], depth
            )
    if order > 1:
        yield from _diffract_repeatedly(wedge_scene, tx, rx, order)


def _edge_sequences(
    wedge_scene: WedgeScene, interactions: FaceInteractions, depth: int, rays: int | None, seed: int
) -> list[Int64[Tensor, "row column"]]:
    """Edges and sequences that begin there, by length: number of the edge, then steps."""
    walls, count = wedge_scene.surfaces, len(wedge_scene.detached_wedges.start)
    alone = torch.arange(count)
    tables = [alone[:, None]]
    if not depth:
        return tables
    if rays is None:
        for steps in enumerate_sequences(walls.planes, interactions, depth).steps:
            edge = alone.repeat_interleave(len(steps))
            tables.append(torch.cat([edge[:, None], steps.repeat(count, 1)], 1))
    else:
        edge = alone.repeat_interleave(-(-rays // count))
        share = np.random.default_rng(np.random.SeedSequence([seed, 1])).random(len(edge))
        wedges = wedge_scene.detached_wedges.rows(edge)
        places = wedges.start + torch.from_numpy(share)[:, None] * (wedges.end - wedges.start)
        places = wedge_scene.offset_points(edge, places)
        tables += shoot_sequences_from_edges(
            walls, walls.planes, interactions, places, edge, depth, seed
        )
    # Planes through the edge itself are its faces.
    return [tables[0]] + [
        table[~_lies_in_plane(wedge_scene, table[:, 0], table[:, 1] >> 1)] for table in tables[1:]
    ]


def _lies_in_plane(wedge_scene: WedgeScene, edge: Tensor, plane: Tensor) -> Bool[Tensor, " row"]:
    """Whether edges lie in planes."""
    walls = wedge_scene.surfaces
    point, normal = walls.planes.point[plane] + walls.origin, walls.planes.normal[plane]
    wedges = wedge_scene.detached_wedges
    low = dot(wedges.start[edge] - point, normal).abs()
    high = dot(wedges.end[edge] - point, normal).abs()
    return torch.maximum(low, high) < _PLANE_TOLERANCE * walls.size


@dataclass(frozen=True)
class _VisibleEdges:
    """Sequences by which antennas may see edges, in the order of the edges.

    Attributes:
        antenna, edge: numbers.
        steps: from the edge to the antenna.
        image: of the antenna in these planes, as the edge sees it [m].
        positions: of all antennas [m].
    """

    antenna: Tensor
    edge: Tensor
    steps: Tensor
    image: Float64[Tensor, "row 3"]
    positions: Float64[Tensor, "antenna 3"]

    def rows(self, index: Tensor) -> "_VisibleEdges":
        """Some rows."""
        return _VisibleEdges(
            self.antenna[index],
            self.edge[index],
            self.steps[index],
            self.image[index],
            self.positions,
        )

    @property
    def antenna_positions(self) -> Tensor:
        """Places of the antennas."""
        return self.positions[self.antenna]


def _find_visible_edges(wedge_scene: WedgeScene, table: Tensor, positions: Tensor) -> _VisibleEdges:
    """Antennas whose images lie outside the wedges and see some of the edges, each by a sequence.

    Between the ends of an edge, the line to the image moves over a plane on a straight line.
    """
    walls, wedges = wedge_scene.surfaces, wedge_scene.detached_wedges
    parts: list[tuple[Tensor, ...]] = []
    total = len(positions) * len(table)
    for some in torch.arange(total).split(_ROWS_AT_ONCE):
        antenna, row = some // len(table), some % len(table)
        edge, steps = table[row, 0], table[row, 1:]
        seen = _antenna_images(wedge_scene, positions[antenna], steps.flip(1))
        image = seen[-1] + walls.origin
        keep = is_exterior(wedges.rows(edge), image)
        if steps.shape[1]:
            ends = [end[edge] - walls.origin for end in (wedges.start, wedges.end)]
            keep &= _may_cross_planes(wedge_scene, steps.flip(1), seen, ends)
        parts.append((antenna[keep], edge[keep], steps[keep], image[keep]))
    if not parts:
        none = torch.zeros(0, dtype=torch.int64)
        return _VisibleEdges(none, none, table[:0, 1:], positions[:0], positions)
    antenna, edge, steps, image = (torch.cat(column) for column in zip(*parts, strict=True))
    return _VisibleEdges(antenna, edge, steps, image, positions).rows(edge.argsort(stable=True))


def _antenna_images(wedge_scene: WedgeScene, positions: Tensor, steps: Tensor) -> list[Tensor]:
    """Images of places about the scene's origin."""
    walls, plane = wedge_scene.surfaces, steps >> 1
    point, normal = walls.planes.point[plane], walls.planes.normal[plane]
    return image_positions(positions - walls.origin, point, normal, (steps & 1).bool())


def _may_cross_planes(
    wedge_scene: WedgeScene, steps: Tensor, images: list[Tensor], ends: list[Tensor]
) -> Bool[Tensor, " row"]:
    """False where no line from an edge to the images can cut all planes in their rectangles."""
    planes, wide = wedge_scene.surfaces.planes, wedge_scene.surfaces.margin
    keep, sure = torch.ones(2, len(steps), dtype=torch.bool).unbind(0)
    at = list(ends)
    for step in reversed(range(steps.shape[1])):
        plane = steps[:, step] >> 1
        point, normal = planes.point[plane], planes.normal[plane]
        there, valid = [], []
        for number, end in enumerate(at):
            way = images[step + 1] - end
            falls = dot(way, normal)
            safe = torch.where(falls == 0, torch.ones_like(falls), falls)
            share = dot(point - end, normal) / safe
            valid.append(
                (falls != 0) & (share > -_PLANE_TOLERANCE) & (share < 1 + _PLANE_TOLERANCE)
            )
            at[number] = end + share[:, None] * way
            there.append(torch.einsum("rx,rax->ra", at[number] - point, planes.axes[plane]))
        both = valid[0] & valid[1]
        below = torch.maximum(*there) < planes.low[plane] - wide
        above = torch.minimum(*there) > planes.high[plane] + wide
        keep &= ~sure | valid[0] | valid[1]
        # Where one end is out of sight the rest is not looked at.
        sure &= both
        keep &= ~(sure & (below | above).any(1))
    return keep


def _diffract_once(
    wedge_scene: WedgeScene, one: _VisibleEdges, other: _VisibleEdges, depth: int
) -> Iterator[DiffractionCandidates]:
    """Paths over one edge."""
    surfaces = one.steps.shape[1] + other.steps.shape[1]
    for first, last in _match_edges(one, other, len(wedge_scene.detached_wedges.start)):
        some, rest = one.rows(first), other.rows(last)
        points, good = diffraction_points(
            wedge_scene.detached_wedges.rows(some.edge), some.image, rest.image
        )
        good &= wedge_scene.is_diffracting(some.edge, points)
        beside = wedge_scene.offset_points(some.edge, points)
        for side in (some, rest):
            forth = side.steps.flip(1)
            rows = torch.nonzero(good)[:, 0]
            seen = _antenna_images(wedge_scene, side.antenna_positions[rows], forth[rows])
            good[rows] = intersects_planes(
                wedge_scene.surfaces, forth[rows], seen, beside[rows] - wedge_scene.surfaces.origin
            )
        faces = [torch.full_like(side.steps, -1) for side in (some, rest)]
        for side, met in zip((some, rest), faces, strict=True):
            rows = torch.nonzero(good)[:, 0]
            good[rows], met[rows] = find_unobstructed_paths(
                wedge_scene.surfaces,
                side.steps[rows].flip(1),
                side.antenna_positions[rows],
                beside[rows],
            )
        if bool(good.any()):
            found = DiffractionCandidates(
                some.antenna,
                rest.antenna,
                some.edge[:, None],
                PathLegs(faces[0], (some.steps.flip(1) & 1).bool()),
                PathLegs(faces[1].flip(1), (rest.steps & 1).bool()),
                torch.full((len(some.edge), 0, 2), -1),
                absorbing=surfaces == depth > 0,
            )
            yield found.rows(torch.nonzero(good)[:, 0])


def _match_edges(
    one: _VisibleEdges, other: _VisibleEdges, count: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows of both that have an edge in common, in pieces."""
    partners = torch.bincount(other.edge, minlength=count)[one.edge]
    piece = (partners.cumsum(0) - 1).clamp_min(0) // _ROWS_AT_ONCE
    for rows in torch.arange(len(one.edge)).split(torch.bincount(piece).tolist()):
        first, second = match_rows(one.edge[rows], other.edge, count)
        if len(first):
            yield rows[first], second


def _diffract_repeatedly(
    wedge_scene: WedgeScene, tx: Tensor, rx: Tensor, order: int
) -> Iterator[DiffractionCandidates]:
    """Paths over two edges and up to ``order``, on free legs."""
    chains, between = _edge_pairs(wedge_scene)
    pairs, beside = chains, between
    alone = torch.arange(len(wedge_scene.detached_wedges.start))[:, None]
    sees = []
    for places in (tx, rx):
        found = _find_visible_edges(wedge_scene, alone, places)
        table = torch.zeros(len(places), len(alone), dtype=torch.bool)
        table[found.antenna, found.edge] = True
        sees.append(table)
    yield from _find_chain_paths(wedge_scene, tx, rx, sees, chains, between)
    if order < 3 or not len(chains):
        return
    open_ways = _are_mutually_visible(wedge_scene, pairs, beside)
    pairs, beside = pairs[open_ways], beside[open_ways]
    seen = torch.nonzero(sees[0].any(0)[pairs[:, 0]])[:, 0]
    if not len(seen):
        return
    # In pieces: there are as many chains as pairs, times the edges that may follow an edge.
    step = max(1, _ROWS_AT_ONCE * len(alone) // max(1, len(pairs)))
    for some in seen.split(step):
        chains, between = _extend_chains(pairs[some], beside[some], pairs, beside)
        yield from _find_chain_paths(wedge_scene, tx, rx, sees, chains, between)


def _are_mutually_visible(
    wedge_scene: WedgeScene, pairs: Tensor, between: Tensor
) -> Bool[Tensor, " pair"]:
    """Pairs with a face between them, and those of which some of nine ways across are free."""
    found = between[:, 0, 0] >= 0
    wedges, none = wedge_scene.detached_wedges, torch.zeros(len(pairs), 0, dtype=torch.int64)
    for share, other in product(_EDGE_FRACTIONS, _EDGE_FRACTIONS):
        rows = torch.nonzero(~found)[:, 0]
        if not len(rows):
            break
        places = []
        for edge, at in zip(pairs[rows].T, (share, other), strict=True):
            point = wedges.start[edge] + at * (wedges.end[edge] - wedges.start[edge])
            places.append(wedge_scene.offset_points(edge, point))
        found[rows] = find_unobstructed_paths(
            wedge_scene.surfaces, none[rows], places[0], places[1]
        )[0]
    return found


def _extend_chains(
    chains: Tensor, between: Tensor, pairs: Tensor, pair_faces: Tensor
) -> tuple[Tensor, Tensor]:
    """Chains of edges with one edge more."""
    row, pair = match_rows(chains[:, -1], pairs[:, 0], int(pairs.max()) + 1)
    found = torch.cat([chains[row], pairs[pair, 1:]], 1)
    return found, torch.cat([between[row], pair_faces[pair]], 1)


def _find_chain_paths(
    wedge_scene: WedgeScene,
    tx: Tensor,
    rx: Tensor,
    visible_edges: list[Tensor],
    chains: Tensor,
    between: Tensor,
) -> Iterator[DiffractionCandidates]:
    """Paths over given chains of edges, of which antennas see the first and the last."""
    # Chains that some antenna sees from either side.
    kept = visible_edges[0].any(0)[chains[:, 0]] & visible_edges[1].any(0)[chains[:, -1]]
    chains, between = chains[kept], between[kept]
    if not len(chains):
        return
    links = torch.cartesian_prod(torch.arange(len(tx)), torch.arange(len(rx)))
    for some in links.split(max(1, _ROWS_AT_ONCE // len(chains))):
        both = (
            visible_edges[0][some[:, 0]][:, chains[:, 0]]
            & visible_edges[1][some[:, 1]][:, chains[:, -1]]
        )
        link, chain = torch.nonzero(both).T
        if not len(link):
            continue
        none = torch.zeros(len(link), 0, dtype=torch.int64)
        legs = PathLegs(none, none.bool())
        source, target = some[link].unbind(1)
        found = DiffractionCandidates(source, target, chains[chain], legs, legs, between[chain])
        rows = [wedge_scene.detached_wedges.rows(column) for column in found.edge.T]
        points, good = multiple_diffraction_points(rows, tx[source], rx[target])
        # Where no face lies between two edges, each must see the other's point.
        for leg in range(chains.shape[1] - 1):
            for first, second in ((leg, leg + 1), (leg + 1, leg)):
                outside = is_exterior(rows[first], points[:, second])
                good &= outside | (found.between[:, leg, 0] >= 0)
        yield from _select_unobstructed(wedge_scene, found, tx, rx, points, good)
        yield from _find_corner_paths(wedge_scene, tx, rx, found)


def _find_corner_paths(
    wedge_scene: WedgeScene, tx: Tensor, rx: Tensor, candidates: DiffractionCandidates
) -> Iterator[DiffractionCandidates]:
    """Of chains of edges, those whose first or last is met where its neighbour ends."""
    wedges = wedge_scene.detached_wedges
    ends = torch.stack([wedges.start, wedges.end], 1)
    sides: tuple[tuple[Corner, int, int, Tensor], ...] = (
        ("first", 0, 1, tx[candidates.tx]),
        ("last", -1, -2, rx[candidates.rx]),
    )
    for corner, own, other, place in sides:
        edge, beside = candidates.edge[:, own], candidates.edge[:, other]
        apart = (ends[edge][:, :, None] - ends[beside][:, None]).norm(dim=3)
        least, end = apart.amin(1).min(1)
        at = ends[beside, end]
        faces = candidates.between[:, own]
        faces = faces.flip(1) if corner == "first" else faces
        good = (least < _PLANE_TOLERANCE * wedge_scene.surfaces.size) & (faces[:, 0] >= 0)
        rows = torch.nonzero(good)[:, 0]
        sends, last = (wedges.rows(column[rows]) for column in (beside, edge))
        rows = rows[face_weight(sends, last, faces[rows], (place - at)[rows]) > 0]
        if not len(rows):
            continue
        some = replace(candidates.rows(rows), corner=corner, end=end[rows])
        numbers = range(candidates.edge.shape[1])
        main = numbers[1:] if corner == "first" else numbers[:-1]
        source, target = tx[some.tx], rx[some.rx]
        between = [wedges.rows(some.edge[:, n]) for n in main]
        if len(main) == 1:
            points, good = diffraction_points(between[0], source, target)
            points = points[:, None]
        else:
            points, good = multiple_diffraction_points(between, source, target)
        both = [points, at[rows, None]] if corner == "last" else [at[rows, None], points]
        yield from _select_unobstructed(wedge_scene, some, tx, rx, torch.cat(both, 1), good)


def _select_unobstructed(
    wedge_scene: WedgeScene,
    candidates: DiffractionCandidates,
    tx: Tensor,
    rx: Tensor,
    points: Tensor,
    valid: Tensor,
) -> Iterator[DiffractionCandidates]:
    """The good ones of paths over points of edges whose legs, all of them straight, are free."""
    valid, none = valid.clone(), candidates.before.faces
    stops = [tx[candidates.tx]]
    for edge, place in zip(candidates.edge.T, points.unbind(1), strict=True):
        valid &= wedge_scene.is_diffracting(edge, place)
        stops.append(wedge_scene.offset_points(edge, place))
    stops.append(rx[candidates.rx])
    for start, end in pairwise(stops):
        rows = torch.nonzero(valid)[:, 0]
        valid[rows], _ = find_unobstructed_paths(
            wedge_scene.surfaces, none[rows], start[rows], end[rows]
        )
    if bool(valid.any()):
        yield candidates.rows(torch.nonzero(valid)[:, 0])


def face_azimuths(
    wedge_scene: WedgeScene, candidates: DiffractionCandidates
) -> Float64[Tensor, "row leg 2"]:
    """Azimuths of departure and of incidence of legs between edges along a face, NaN of the others.

    Args:
        wedge_scene: the scene.
        candidates: the paths.
    """
    opening = torch.stack(
        [wedge_scene.detached_wedges.opening[n] for n in _edges_of_legs(candidates.edge)], 2
    )
    return torch.where(candidates.between < 0, torch.nan, candidates.between * opening * torch.pi)


def _edges_of_legs(edge: Tensor) -> tuple[Tensor, Tensor]:
    """Edges before and after each leg between edges."""
    return edge[:, :-1], edge[:, 1:]


def _edge_pairs(
    wedge_scene: WedgeScene,
) -> tuple[Int64[Tensor, "pair 2"], Int64[Tensor, "pair 1 2"]]:
    """Edges that may follow one another, and which of their faces lies between them (−1: none).

    Two edges with a face between them have one path along each side that both have in common.
    """
    wedges = wedge_scene.detached_wedges
    count = len(wedges.start)
    first, second = torch.nonzero(~torch.eye(count, dtype=torch.bool)).T
    way = (wedges.start + wedges.end)[second] - (wedges.start + wedges.end)[first]
    rows, faces, shared = [], [], torch.zeros(len(first), dtype=torch.bool)
    for one in (0, 1):
        for other in (0, 1):
            normal = wedges.normals[first, one]
            alike = dot(normal, wedges.normals[second, other]) > 1 - _PLANE_TOLERANCE**2
            flat = dot(normal, way).abs() < _PLANE_TOLERANCE * wedge_scene.surfaces.size
            over = dot(way, wedges.face_tangents[first, one]) > 0
            back = dot(way, wedges.face_tangents[second, other]) < 0
            chosen = torch.nonzero(alike & flat & over & back)[:, 0]
            shared[chosen] = True
            rows.append(torch.stack([first[chosen], second[chosen]], 1))
            faces.append(torch.tensor([[one, other]]).expand(len(chosen), 2))
    # The others: at least one end of each lies outside of the other.
    free = ~shared
    for near, far in ((first, second), (second, first)):
        outside = [is_exterior(wedges.rows(near), end[far]) for end in (wedges.start, wedges.end)]
        free &= outside[0] | outside[1]
    rows.append(torch.stack([first[free], second[free]], 1))
    faces.append(torch.full((int(free.sum()), 2), -1))
    return torch.cat(rows), torch.cat(faces)[:, None]
