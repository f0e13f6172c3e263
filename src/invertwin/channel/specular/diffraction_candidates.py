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
    Powers,
    every_sequence,
    sequences_from_edges,
)
from invertwin.channel.specular.corner_diffraction import face_share
from invertwin.channel.specular.edge_path_geometry import several_turning_points, turning_points
from invertwin.channel.specular.image_method import clear_ways, images, reaching
from invertwin.channel.specular.ray_paths import REFLECTION, TRANSMISSION, joint
from invertwin.channel.specular.wedge_scene import EdgedScene, exterior

Corner = Literal["first", "last"] | None
_ROWS_AT_ONCE = 1 << 16
_SHARES = (0.5, 0.1, 0.9)  # of edges: where they may see each other
_ONE_PLANE = 1e-6  # of the scene's size, or rad


@dataclass(frozen=True)
class Legs:
    """Surfaces on the ways from the transmitter to the edge, or from the edge on; detached.

    Attributes:
        faces: triangles, in the order of the path.
        through: whether the path goes through them instead of being mirrored.
    """

    faces: Int64[Tensor, "row step"]
    through: Bool[Tensor, "row step"]

    @property
    def kinds(self) -> Int64[Tensor, "row step"]:
        """What happens there, by ``KINDS``."""
        return torch.where(self.through, TRANSMISSION, REFLECTION)

    def rows(self, index: Tensor) -> "Legs":
        """Some rows."""
        return Legs(self.faces[index], self.through[index])


@dataclass(frozen=True)
class Bends:
    """Paths over as many edges, one row each; detached.

    Attributes:
        tx, rx: numbers of the antennas.
        edge: numbers of the edges, from the transmitter on.
        before, after: surfaces on the way to the first edge and from the last.
        between: of legs from edge to edge, which of either edge's faces they run along (−1: none).
        absorbs: leave out what the edge's faces mirror and let through: one surface too many.
        corner: whether the first or the last edge is met in a corner, where its neighbour ends.
        end: which end of that neighbour it is.
    """

    tx: Int64[Tensor, " row"]
    rx: Int64[Tensor, " row"]
    edge: Int64[Tensor, "row order"]
    before: Legs
    after: Legs
    between: Int64[Tensor, "row leg 2"]
    absorbs: bool = False
    corner: Corner = None
    end: Int64[Tensor, " row"] | None = None

    def rows(self, index: Tensor) -> "Bends":
        """Some rows."""
        return Bends(
            self.tx[index],
            self.rx[index],
            self.edge[index],
            self.before.rows(index),
            self.after.rows(index),
            self.between[index],
            self.absorbs,
            self.corner,
            None if self.end is None else self.end[index],
        )


def find_bends(
    around: EdgedScene,
    powers: Powers,
    tx: Float64[Tensor, "tx 3"],
    rx: Float64[Tensor, "rx 3"],
    order: int,
    depth: int,
    rays: int | None,
    seed: int,
) -> Iterator[Bends]:
    """Paths over one edge with up to ``depth`` surfaces, and over more edges alone.

    Args:
        around: the scene.
        powers: what triangles do to rays.
        tx, rx: antennas [m].
        order: most edges of a path, 1 to 3.
        depth: most surfaces of a path over one edge.
        rays: shot from all edges together, for candidates; None = every sequence.
        seed: of these rays.
    """
    if not len(around.plain.start):
        return
    tables = _tables(around, powers, depth, rays, seed)
    sides = [[_reach(around, table, places) for table in tables] for places in (tx, rx)]
    for surfaces in range(len(tables)):
        for before in range(surfaces + 1):
            yield from _once(around, sides[0][before], sides[1][surfaces - before], depth)
    if order > 1:
        yield from _several(around, tx, rx, order)


def _tables(
    around: EdgedScene, powers: Powers, depth: int, rays: int | None, seed: int
) -> list[Int64[Tensor, "row column"]]:
    """Edges and sequences that begin there, by length: number of the edge, then steps."""
    walls, count = around.walls, len(around.plain.start)
    alone = torch.arange(count)
    tables = [alone[:, None]]
    if not depth:
        return tables
    if rays is None:
        for steps in every_sequence(walls.planes, powers, depth).steps:
            edge = alone.repeat_interleave(len(steps))
            tables.append(torch.cat([edge[:, None], steps.repeat(count, 1)], 1))
    else:
        edge = alone.repeat_interleave(-(-rays // count))
        share = np.random.default_rng(np.random.SeedSequence([seed, 1])).random(len(edge))
        wedges = around.plain.rows(edge)
        places = wedges.start + torch.from_numpy(share)[:, None] * (wedges.end - wedges.start)
        places = around.beside(edge, places)
        tables += sequences_from_edges(walls, walls.planes, powers, places, edge, depth, seed)
    # Planes through the edge itself are its faces.
    return [tables[0]] + [
        table[~_in_plane(around, table[:, 0], table[:, 1] >> 1)] for table in tables[1:]
    ]


def _in_plane(around: EdgedScene, edge: Tensor, plane: Tensor) -> Bool[Tensor, " row"]:
    """Whether edges lie in planes."""
    walls = around.walls
    point, normal = walls.planes.point[plane] + walls.origin, walls.planes.normal[plane]
    wedges = around.plain
    low = dot(wedges.start[edge] - point, normal).abs()
    high = dot(wedges.end[edge] - point, normal).abs()
    return torch.maximum(low, high) < _ONE_PLANE * walls.size


@dataclass(frozen=True)
class _Reach:
    """Sequences by which antennas may see edges, in the order of the edges.

    Attributes:
        antenna, edge: numbers.
        steps: from the edge to the antenna.
        image: of the antenna in these planes, as the edge sees it [m].
        places: of all antennas [m].
    """

    antenna: Tensor
    edge: Tensor
    steps: Tensor
    image: Float64[Tensor, "row 3"]
    places: Float64[Tensor, "antenna 3"]

    def rows(self, index: Tensor) -> "_Reach":
        """Some rows."""
        return _Reach(
            self.antenna[index],
            self.edge[index],
            self.steps[index],
            self.image[index],
            self.places,
        )

    @property
    def start(self) -> Tensor:
        """Places of the antennas."""
        return self.places[self.antenna]


def _reach(around: EdgedScene, table: Tensor, places: Tensor) -> _Reach:
    """Antennas whose images lie outside the wedges and see some of the edges, each by a sequence.

    Between the ends of an edge, the line to the image moves over a plane on a straight line.
    """
    walls, wedges = around.walls, around.plain
    parts: list[tuple[Tensor, ...]] = []
    total = len(places) * len(table)
    for some in torch.arange(total).split(_ROWS_AT_ONCE):
        antenna, row = some // len(table), some % len(table)
        edge, steps = table[row, 0], table[row, 1:]
        seen = _seen_from(around, places[antenna], steps.flip(1))
        image = seen[-1] + walls.origin
        keep = exterior(wedges.rows(edge), image)
        if steps.shape[1]:
            ends = [end[edge] - walls.origin for end in (wedges.start, wedges.end)]
            keep &= _may_cross(around, steps.flip(1), seen, ends)
        parts.append((antenna[keep], edge[keep], steps[keep], image[keep]))
    if not parts:
        none = torch.zeros(0, dtype=torch.int64)
        return _Reach(none, none, table[:0, 1:], places[:0], places)
    antenna, edge, steps, image = (torch.cat(column) for column in zip(*parts, strict=True))
    return _Reach(antenna, edge, steps, image, places).rows(edge.argsort(stable=True))


def _seen_from(around: EdgedScene, places: Tensor, steps: Tensor) -> list[Tensor]:
    """Images of places about the scene's origin."""
    walls, plane = around.walls, steps >> 1
    point, normal = walls.planes.point[plane], walls.planes.normal[plane]
    return images(places - walls.origin, point, normal, (steps & 1).bool())


def _may_cross(
    around: EdgedScene, steps: Tensor, seen: list[Tensor], ends: list[Tensor]
) -> Bool[Tensor, " row"]:
    """False where no line from an edge to the images can cut all planes in their rectangles."""
    planes, wide = around.walls.planes, around.walls.margin
    keep, sure = torch.ones(2, len(steps), dtype=torch.bool).unbind(0)
    at = list(ends)
    for step in reversed(range(steps.shape[1])):
        plane = steps[:, step] >> 1
        point, normal = planes.point[plane], planes.normal[plane]
        there, valid = [], []
        for number, end in enumerate(at):
            way = seen[step + 1] - end
            falls = dot(way, normal)
            safe = torch.where(falls == 0, torch.ones_like(falls), falls)
            share = dot(point - end, normal) / safe
            valid.append((falls != 0) & (share > -_ONE_PLANE) & (share < 1 + _ONE_PLANE))
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


def _once(around: EdgedScene, one: _Reach, other: _Reach, depth: int) -> Iterator[Bends]:
    """Paths over one edge."""
    surfaces = one.steps.shape[1] + other.steps.shape[1]
    for first, last in _pairs(one, other, len(around.plain.start)):
        some, rest = one.rows(first), other.rows(last)
        points, good = turning_points(around.plain.rows(some.edge), some.image, rest.image)
        good &= around.free(some.edge, points)
        beside = around.beside(some.edge, points)
        for side in (some, rest):
            forth = side.steps.flip(1)
            rows = torch.nonzero(good)[:, 0]
            seen = _seen_from(around, side.start[rows], forth[rows])
            good[rows] = reaching(
                around.walls, forth[rows], seen, beside[rows] - around.walls.origin
            )
        faces = [torch.full_like(side.steps, -1) for side in (some, rest)]
        for side, met in zip((some, rest), faces, strict=True):
            rows = torch.nonzero(good)[:, 0]
            good[rows], met[rows] = clear_ways(
                around.walls, side.steps[rows].flip(1), side.start[rows], beside[rows]
            )
        if bool(good.any()):
            found = Bends(
                some.antenna,
                rest.antenna,
                some.edge[:, None],
                Legs(faces[0], (some.steps.flip(1) & 1).bool()),
                Legs(faces[1].flip(1), (rest.steps & 1).bool()),
                torch.full((len(some.edge), 0, 2), -1),
                absorbs=surfaces == depth > 0,
            )
            yield found.rows(torch.nonzero(good)[:, 0])


def _pairs(one: _Reach, other: _Reach, count: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows of both that have an edge in common, in pieces."""
    partners = torch.bincount(other.edge, minlength=count)[one.edge]
    piece = (partners.cumsum(0) - 1).clamp_min(0) // _ROWS_AT_ONCE
    for rows in torch.arange(len(one.edge)).split(torch.bincount(piece).tolist()):
        first, second = joint(one.edge[rows], other.edge, count)
        if len(first):
            yield rows[first], second


def _several(around: EdgedScene, tx: Tensor, rx: Tensor, order: int) -> Iterator[Bends]:
    """Paths over two edges and up to ``order``, on free legs."""
    chains, between = _edge_pairs(around)
    pairs, beside = chains, between
    alone = torch.arange(len(around.plain.start))[:, None]
    sees = []
    for places in (tx, rx):
        found = _reach(around, alone, places)
        table = torch.zeros(len(places), len(alone), dtype=torch.bool)
        table[found.antenna, found.edge] = True
        sees.append(table)
    yield from _along(around, tx, rx, sees, chains, between)
    if order < 3 or not len(chains):
        return
    open_ways = _see_each_other(around, pairs, beside)
    pairs, beside = pairs[open_ways], beside[open_ways]
    seen = torch.nonzero(sees[0].any(0)[pairs[:, 0]])[:, 0]
    if not len(seen):
        return
    # In pieces: there are as many chains as pairs, times the edges that may follow an edge.
    step = max(1, _ROWS_AT_ONCE * len(alone) // max(1, len(pairs)))
    for some in seen.split(step):
        chains, between = _longer(pairs[some], beside[some], pairs, beside)
        yield from _along(around, tx, rx, sees, chains, between)


def _see_each_other(around: EdgedScene, pairs: Tensor, between: Tensor) -> Bool[Tensor, " pair"]:
    """Pairs with a face between them, and those of which some of nine ways across are free."""
    found = between[:, 0, 0] >= 0
    wedges, none = around.plain, torch.zeros(len(pairs), 0, dtype=torch.int64)
    for share, other in product(_SHARES, _SHARES):
        rows = torch.nonzero(~found)[:, 0]
        if not len(rows):
            break
        places = []
        for edge, at in zip(pairs[rows].T, (share, other), strict=True):
            point = wedges.start[edge] + at * (wedges.end[edge] - wedges.start[edge])
            places.append(around.beside(edge, point))
        found[rows] = clear_ways(around.walls, none[rows], places[0], places[1])[0]
    return found


def _longer(
    chains: Tensor, between: Tensor, pairs: Tensor, beside: Tensor
) -> tuple[Tensor, Tensor]:
    """Chains of edges with one edge more."""
    row, pair = joint(chains[:, -1], pairs[:, 0], int(pairs.max()) + 1)
    found = torch.cat([chains[row], pairs[pair, 1:]], 1)
    return found, torch.cat([between[row], beside[pair]], 1)


def _along(
    around: EdgedScene,
    tx: Tensor,
    rx: Tensor,
    sees: list[Tensor],
    chains: Tensor,
    between: Tensor,
) -> Iterator[Bends]:
    """Paths over given chains of edges, of which antennas see the first and the last."""
    # Chains that some antenna sees from either side.
    kept = sees[0].any(0)[chains[:, 0]] & sees[1].any(0)[chains[:, -1]]
    chains, between = chains[kept], between[kept]
    if not len(chains):
        return
    links = torch.cartesian_prod(torch.arange(len(tx)), torch.arange(len(rx)))
    for some in links.split(max(1, _ROWS_AT_ONCE // len(chains))):
        both = sees[0][some[:, 0]][:, chains[:, 0]] & sees[1][some[:, 1]][:, chains[:, -1]]
        link, chain = torch.nonzero(both).T
        if not len(link):
            continue
        none = torch.zeros(len(link), 0, dtype=torch.int64)
        legs = Legs(none, none.bool())
        source, target = some[link].unbind(1)
        found = Bends(source, target, chains[chain], legs, legs, between[chain])
        rows = [around.plain.rows(column) for column in found.edge.T]
        points, good = several_turning_points(rows, tx[source], rx[target])
        # Where no face lies between two edges, each must see the other's point.
        for leg in range(chains.shape[1] - 1):
            for first, second in ((leg, leg + 1), (leg + 1, leg)):
                outside = exterior(rows[first], points[:, second])
                good &= outside | (found.between[:, leg, 0] >= 0)
        yield from _open(around, found, tx, rx, points, good)
        yield from _round_corners(around, tx, rx, found)


def _round_corners(around: EdgedScene, tx: Tensor, rx: Tensor, found: Bends) -> Iterator[Bends]:
    """Of chains of edges, those whose first or last is met where its neighbour ends."""
    wedges = around.plain
    ends = torch.stack([wedges.start, wedges.end], 1)
    sides: tuple[tuple[Corner, int, int, Tensor], ...] = (
        ("first", 0, 1, tx[found.tx]),
        ("last", -1, -2, rx[found.rx]),
    )
    for corner, own, other, place in sides:
        edge, beside = found.edge[:, own], found.edge[:, other]
        apart = (ends[edge][:, :, None] - ends[beside][:, None]).norm(dim=3)
        least, end = apart.amin(1).min(1)
        at = ends[beside, end]
        faces = found.between[:, own]
        faces = faces.flip(1) if corner == "first" else faces
        good = (least < _ONE_PLANE * around.walls.size) & (faces[:, 0] >= 0)
        rows = torch.nonzero(good)[:, 0]
        sends, last = (wedges.rows(column[rows]) for column in (beside, edge))
        rows = rows[face_share(sends, last, faces[rows], (place - at)[rows]) > 0]
        if not len(rows):
            continue
        some = replace(found.rows(rows), corner=corner, end=end[rows])
        numbers = range(found.edge.shape[1])
        main = numbers[1:] if corner == "first" else numbers[:-1]
        source, target = tx[some.tx], rx[some.rx]
        between = [wedges.rows(some.edge[:, n]) for n in main]
        if len(main) == 1:
            points, good = turning_points(between[0], source, target)
            points = points[:, None]
        else:
            points, good = several_turning_points(between, source, target)
        both = [points, at[rows, None]] if corner == "last" else [at[rows, None], points]
        yield from _open(around, some, tx, rx, torch.cat(both, 1), good)


def _open(
    around: EdgedScene, found: Bends, tx: Tensor, rx: Tensor, points: Tensor, good: Tensor
) -> Iterator[Bends]:
    """The good ones of paths over points of edges whose legs, all of them straight, are free."""
    good, none = good.clone(), found.before.faces
    stops = [tx[found.tx]]
    for edge, place in zip(found.edge.T, points.unbind(1), strict=True):
        good &= around.free(edge, place)
        stops.append(around.beside(edge, place))
    stops.append(rx[found.rx])
    for start, end in pairwise(stops):
        rows = torch.nonzero(good)[:, 0]
        good[rows], _ = clear_ways(around.walls, none[rows], start[rows], end[rows])
    if bool(good.any()):
        yield found.rows(torch.nonzero(good)[:, 0])


def along_faces(around: EdgedScene, bends: Bends) -> Float64[Tensor, "row leg 2"]:
    """Azimuths of departure and of incidence of legs between edges along a face, NaN of the others.

    Args:
        around: the scene.
        bends: the paths.
    """
    opening = torch.stack([around.plain.opening[n] for n in _legs_of(bends.edge)], 2)
    return torch.where(bends.between < 0, torch.nan, bends.between * opening * torch.pi)


def _legs_of(edge: Tensor) -> tuple[Tensor, Tensor]:
    """Edges before and after each leg between edges."""
    return edge[:, :-1], edge[:, 1:]


def _edge_pairs(around: EdgedScene) -> tuple[Int64[Tensor, "pair 2"], Int64[Tensor, "pair 1 2"]]:
    """Edges that may follow one another, and which of their faces lies between them (−1: none).

    Two edges with a face between them have one path along each side that both have in common.
    """
    wedges = around.plain
    count = len(wedges.start)
    first, second = torch.nonzero(~torch.eye(count, dtype=torch.bool)).T
    way = (wedges.start + wedges.end)[second] - (wedges.start + wedges.end)[first]
    rows, faces, shared = [], [], torch.zeros(len(first), dtype=torch.bool)
    for one in (0, 1):
        for other in (0, 1):
            normal = wedges.normals[first, one]
            alike = dot(normal, wedges.normals[second, other]) > 1 - _ONE_PLANE**2
            flat = dot(normal, way).abs() < _ONE_PLANE * around.walls.size
            over = dot(way, wedges.inwards[first, one]) > 0
            back = dot(way, wedges.inwards[second, other]) < 0
            chosen = torch.nonzero(alike & flat & over & back)[:, 0]
            shared[chosen] = True
            rows.append(torch.stack([first[chosen], second[chosen]], 1))
            faces.append(torch.tensor([[one, other]]).expand(len(chosen), 2))
    # The others: at least one end of each lies outside of the other.
    free = ~shared
    for near, far in ((first, second), (second, first)):
        outside = [exterior(wedges.rows(near), end[far]) for end in (wedges.start, wedges.end)]
        free &= outside[0] | outside[1]
    rows.append(torch.stack([first[free], second[free]], 1))
    faces.append(torch.full((int(free.sum()), 2), -1))
    return torch.cat(rows), torch.cat(faces)[:, None]
