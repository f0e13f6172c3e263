"""Edges of beams on a surface: where the power of specular paths jumps, and how fast that moves.

On a surface, the paths of one sequence of mirrors and sheets light a region. Its rim is drawn by
edges of the scene: those that end a mirror or a sheet, and those that hide. A ray from the
transmitter to a point of an edge goes on at both sides of the edge, and every path that only one of
the sides has adds its power times the speed at which the rim sweeps over the surface.

With S the last image of the transmitter and y the last image of the edge point, the rim is where
the line from S through y meets the surface: ``ΔI = f · T · (x_c − x_m)``, value zero.

Source: derivations §3 and §11, for specular paths.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize, pad

from invertwin.channel.em.plane_waves import cross, dot, mirrored, points_at
from invertwin.channel.rays.arrays import to_float, to_torch
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import NEAR, Occluders
from invertwin.channel.rays.topology import Topology
from invertwin.channel.specular.candidates import Powers
from invertwin.channel.specular.image_method import Chains, Walls, chains_between, images
from invertwin.checks import plain

ASIDE = 10.0  # margins between where power jumps and the two sides that are compared
_GRAZING = 1e-4  # least cosine between a ray and the normal of the surface that it lights
_MOST_CROSSINGS = 64  # triangles of the surface that a straight piece of a path meets


class Screen(Occluders):
    """A surface that receives power at all its points and hides nothing.

    Args:
        vertices: World positions, detached [m].
        topology: Their triangles.
        origin: The local origin, that of the scene [m].
    """

    def __init__(
        self, vertices: Float64[Tensor, "v 3"], topology: Topology, origin: Float64[Tensor, "3"]
    ) -> None:
        super().__init__(vertices, topology, origin)
        self.vertices = vertices
        self.corners = vertices[topology.faces]


@dataclass(frozen=True)
class OwnSurfaces:
    """Triangles of the scene itself that receive power.

    Attributes:
        lit: Which of them do.
    """

    lit: Bool[Tensor, " f"]


@dataclass(frozen=True)
class Rims:
    """Points on rims of lit regions, of paths with one number of steps.

    Attributes:
        chains: The paths from transmitters to the rims; row i ends at rim point i.
        place: Rim points on the surface, detached [m].
        face: Triangle of the surface.
        rate: Area newly lit, of the sample's share of the rim [m²]; zero in value, attached.
        edge_point: Number of the edge point that draws each.
    """

    chains: Chains
    place: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    rate: Float64[Tensor, " row"]
    edge_point: Int64[Tensor, " row"]


@dataclass(frozen=True)
class _Edges:
    """Points on edges, one row each; detached.

    Attributes:
        first, second: Vertices at the ends.
        along: Place from the first to the second, 0 to 1.
        weight: One over samples × probability per ``along``.
        beside: Triangles at the edge (−1: none).
    """

    first: Tensor
    second: Tensor
    along: Tensor
    weight: Tensor
    beside: Tensor

    def chosen(self, rows: Tensor) -> "_Edges":
        return _Edges(*(column[rows] for column in vars(self).values()))


@dataclass(frozen=True)
class _Legs:
    """Rays that go on past an edge, one row each; detached.

    Attributes:
        origin, direction: Of the ray, about the local origin [m]; the direction of unit length.
        after: Length from which on the surface counts [m]: on the first leg, that to the edge.
        source: Transmitter.
        row: Of the edge point.
        aside: Unit vector from the edge to the ray.
        before: Steps before the edge.
        faces, through: Steps so far, filled up with −1.
    """

    origin: Tensor
    direction: Tensor
    after: Tensor
    source: Tensor
    row: Tensor
    aside: Tensor
    before: Tensor
    faces: Tensor
    through: Tensor

    def chosen(self, rows: Tensor) -> "_Legs":
        return _Legs(*(column[rows] for column in vars(self).values()))


def _joined(parts: Sequence[_Legs]) -> _Legs:
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return _Legs(*(torch.cat(column) for column in columns))


@dataclass(frozen=True)
class RimPoints:
    """Points on rims of lit regions, of paths with one number of steps; detached.

    Attributes:
        edges: Points on edges that draw the rims.
        legs: Last legs of the paths.
        face: Triangle of the surface.
    """

    edges: _Edges
    legs: _Legs
    face: Int64[Tensor, " row"]


def rim_points(
    walls: Walls,
    screen: Screen | OwnSurfaces,
    tx: Float64[Tensor, "tx 3"],
    sequences: tuple[Tensor, ...],
    powers: Powers,
    *,
    depth: int,
    samples: int,
    seed: int,
) -> list[RimPoints]:
    """Points on the rims of all regions that specular paths light on a surface.

    Args:
        walls: The scene.
        screen: Where power is received.
        tx: Transmitters in the world, detached [m].
        sequences: Candidates for what lies between transmitter and edge, by length from 1.
        powers: Of the triangles.
        depth: Most steps of a path.
        samples: Points on edges, for each transmitter.
        seed: Of the points.
    """
    found: list[RimPoints] = []
    for number, source in enumerate(tx):
        edges = _drawn(walls, samples, seed, number)
        if not len(edges.along):
            continue
        ends = [walls.exact_vertices[vertex] for vertex in (edges.first, edges.second)]
        y = torch.lerp(ends[0], ends[1], edges.along[:, None])
        chains = [
            some
            for steps in (torch.zeros(1, 0, dtype=torch.int64), *sequences)
            for some in chains_between(walls, steps, source, y + walls.origin, number)
        ]
        met: dict[int, list[tuple[_Legs, Tensor]]] = {}
        for some in chains:
            for legs in _passing(walls, source - walls.origin, y, ends, some, depth):
                for last, face in _followed(walls, screen, legs, powers, depth):
                    met.setdefault(last.faces.shape[1], []).append((last, face))
        for some in met.values():
            legs, faces = zip(*some, strict=True)
            found.append(RimPoints(edges, _joined(legs), torch.cat(faces)))
    return found


def _drawn(walls: Walls, samples: int, seed: int, number: int) -> _Edges:
    """Points spread evenly over all edges at which anything can end."""
    topology, planes = walls.topology, walls.planes.face_plane
    beside = topology.beside
    # Triangles in one plane of one object are one surface.
    plane = torch.where(beside >= 0, planes[beside.clamp_min(0)], -1)
    flat = (plane == plane[:, :1]).all(1) & (beside >= 0).all(1) & (beside.shape[1] > 1)
    edge = torch.nonzero(~flat)[:, 0]
    ends = walls.exact_vertices[topology.edges[edge]]
    row, along, weight = spread_along((ends[:, 1] - ends[:, 0]).norm(dim=1), samples, seed, number)
    chosen = edge[row]
    first, second = topology.edges[chosen].unbind(1)
    return _Edges(first, second, along, weight, topology.beside[chosen])


def spread_along(
    length: Float64[Tensor, " n"], samples: int, *seeds: int
) -> tuple[Int64[Tensor, " row"], Float64[Tensor, " row"], Float64[Tensor, " row"]]:
    """Points spread evenly over curves: the curve, place along it from 0 to 1, and weight.

    The weight is one over samples × probability per place.

    Args:
        length: Of the curves.
        samples: Points; none where there are no curves.
        seeds: Of the points.
    """
    total = length.cumsum(0)
    if not len(length) or not total[-1] > 0:
        return torch.zeros(0, dtype=torch.int64), length[:0], length[:0]
    jitter = np.random.default_rng(np.random.SeedSequence(seeds)).random(samples)
    spot = (torch.arange(samples) + torch.from_numpy(jitter)) / samples * total[-1]
    row = torch.searchsorted(total, spot, right=True).clamp_max(len(length) - 1)
    along = 1 - (total[row] - spot) / length[row]
    return row, along.clamp(0.0, 1.0), total[-1] / (samples * length[row])


def _passing(
    walls: Walls, here: Tensor, y: Tensor, ends: list[Tensor], chains: Chains, depth: int
) -> Iterator[_Legs]:
    """Rays past edges, one at each side, from the last mirror or sheet before them."""
    planes, count = walls.planes, chains.faces.shape[1]
    plane = planes.face_plane[chains.faces]
    if count:
        # A step in a plane that holds the edge point is one at the edge: the rays past it take it.
        last = plane[:, -1]
        height = dot(y[chains.target] - planes.point[last], planes.normal[last]).abs()
        rows = torch.nonzero(height > ASIDE * walls.margin)[:, 0]
        chains = Chains(*(column[rows] for column in vars(chains).values()))
        plane = plane[rows]
    if not len(chains.source):
        return
    point, normal, target = planes.point[plane], planes.normal[plane], y[chains.target]
    image = images(here.expand(len(target), 3), point, normal, chains.through)[-1]
    edge = normalize(ends[1][chains.target] - ends[0][chains.target], dim=1)
    across = cross(normalize(target - image, dim=1), edge)
    clear = torch.nonzero(across.norm(dim=1) > _GRAZING)[:, 0]
    across = normalize(across, dim=1)
    for side in (across, -across):
        offset = target + ASIDE * walls.margin * side - image
        length = offset.norm(dim=1)
        direction = offset / length[:, None]
        origin, start = image, torch.zeros_like(length)
        if count:
            falls = dot(direction, normal[:, -1])
            start = dot(point[:, -1] - image, normal[:, -1]) / falls
            lift = walls.margin * falls.sign()
            origin = image + start[:, None] * direction + lift[:, None] * normal[:, -1]
        yield _Legs(
            origin,
            direction,
            length - start,
            chains.source,
            chains.target,
            side,
            torch.full_like(chains.source, count),
            pad(chains.faces, (0, depth - count), value=-1),
            pad(chains.through, (0, depth - count), value=False),
        ).chosen(clear)


def _followed(
    walls: Walls, screen: Screen | OwnSurfaces, legs: _Legs, powers: Powers, depth: int
) -> Iterator[tuple[_Legs, Tensor]]:
    """Where rays meet the surface, and by which steps: legs with the triangle of the surface."""
    step = int(legs.before[0]) if len(legs.row) else depth
    while len(legs.row):
        face, distance = _next(walls, legs.origin, legs.direction)
        for rows, triangle in _received(screen, legs, face, distance):
            some = legs.chosen(rows)
            steps = {"faces": some.faces[:, :step], "through": some.through[:, :step]}
            yield replace(some, **steps), triangle
        if step == depth:
            return
        known = (face >= 0) & (walls.planes.face_plane[face.clamp_min(0)] >= 0)
        onwards: list[_Legs] = []
        for passes, able in ((False, powers.reflect), (True, powers.transmit)):
            rows = torch.nonzero(known & able[face.clamp_min(0)])[:, 0]
            some, hit = legs.chosen(rows), face[rows]
            normal = walls.planes.normal[walls.planes.face_plane[hit]]
            place = some.origin + distance[rows, None] * some.direction
            way = some.direction if passes else mirrored(some.direction, normal)
            lift = walls.margin * dot(way, normal).sign()
            faces, through = some.faces.clone(), some.through.clone()
            faces[:, step], through[:, step] = hit, passes
            onwards.append(
                replace(
                    some,
                    origin=place + lift[:, None] * normal,
                    direction=way,
                    after=some.after - distance[rows],
                    faces=faces,
                    through=through,
                )
            )
        legs = _joined(onwards)
        step += 1


def _next(rays: Occluders, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """The triangle that each ray meets (−1: none), and how far away [m] (else infinite)."""
    start, way = (
        kind(*(to_float(values[:, k].to(torch.float32)) for k in range(3)))
        for kind, values in ((mi.Point3f, origin), (mi.Vector3f, direction))
    )
    hit = rays.scene.ray_intersect_preliminary(mi.Ray3f(start, way))
    face = dr.select(hit.is_valid(), mi.Int32(hit.prim_index), -1)
    distance = dr.select(hit.is_valid(), hit.t, dr.inf)
    dr.eval(face, distance)
    return to_torch(face).long(), to_torch(distance).double()


def _received(
    screen: Screen | OwnSurfaces, legs: _Legs, face: Tensor, distance: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and triangles that receive power on the way to the next wall, or where it is met."""
    if isinstance(screen, Screen):
        yield from _crossings(screen, legs, distance)
        return
    rows = torch.nonzero((face >= 0) & screen.lit[face.clamp_min(0)] & (distance > legs.after))
    yield rows[:, 0], face[rows[:, 0]]


def _crossings(screen: Screen, legs: _Legs, until: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and triangles of the surface that they cross, past the edge and before the next wall."""
    rows, at = torch.arange(len(legs.row)), legs.after.clamp_min(0.0)
    for _ in range(_MOST_CROSSINGS):
        ahead = torch.nonzero(at < until[rows])[:, 0]
        if not len(ahead):
            return
        rows, at = rows[ahead], at[ahead]
        origin, direction = legs.origin[rows], legs.direction[rows]
        face, distance = _next(screen, origin + at[:, None] * direction, direction)
        at = at + distance
        met = torch.nonzero((face >= 0) & (at < until[rows]))[:, 0]
        rows, at = rows[met], at[met]
        yield rows, face[met]
        at = at + NEAR * (1 + at + origin[met].norm(dim=1))


def rims(
    walls: Walls,
    surface: Float64[Tensor, "face 3 3"],
    found: RimPoints,
    tx: Float64[Tensor, "tx 3"],
    vertices: Float64[Tensor, "v 3"],
) -> Rims:
    """Points on rims, with the speeds of the rims.

    Args:
        walls: The scene.
        surface: Corners of the triangles where power is received, attached where they move [m].
        found: The points.
        tx: Transmitters in the world, attached [m].
        vertices: Of the scene in the world, attached [m].
    """
    legs, edges = found.legs, found.edges.chosen(found.legs.row)
    corners = vertices[walls.topology.faces[legs.faces]]
    sides = corners[..., 1:, :] - corners[..., :1, :]
    normal = normalize(cross(sides[..., 0, :], sides[..., 1, :]), dim=-1)
    point = corners[..., 0, :]
    seen = images(tx[legs.source], point, normal, legs.through)[-1]
    # Only what follows the edge mirrors it.
    kept = legs.through | (torch.arange(legs.faces.shape[1]) < legs.before[:, None])
    y0, y1 = vertices[edges.first], vertices[edges.second]
    y = images(torch.lerp(y0, y1, edges.along[:, None]), point, normal, kept)[-1]
    receiving = surface[found.face]
    p0, p1, p2 = receiving.unbind(1)
    up = normalize(cross(p1 - p0, p2 - p0), dim=1)
    ray = y - seen
    stretch = dot(p0 - seen, up) / dot(ray, up)
    rim = seen + stretch[:, None] * ray
    material = points_at(receiving, plain(receiving), plain(rim))

    up = plain(up)
    fixed = plain(ray), plain(stretch), plain(normal)
    edge, aside = (_shifted(v, fixed, kept, up) for v in (plain(y1 - y0), legs.aside))
    outwards = cross(up, edge)
    outwards = outwards * -dot(outwards, aside).sign()[:, None]
    rate = dot(outwards, rim - material) * edges.weight
    steep = dot(fixed[0], up).abs() > _GRAZING * fixed[0].norm(dim=1)
    rows = torch.nonzero(steep)[:, 0]
    chains = Chains(
        legs.source[rows], torch.arange(len(rows)), legs.faces[rows], legs.through[rows]
    )
    return Rims(chains, plain(rim)[rows], found.face[rows], rate[rows], legs.row[rows])


def _shifted(vector: Tensor, fixed: tuple[Tensor, ...], kept: Tensor, up: Tensor) -> Tensor:
    """How a rim point shifts on the surface when the edge point is shifted; detached."""
    ray, stretch, normal = fixed
    for step, stays in enumerate(kept.unbind(1)):
        vector = torch.where(stays[:, None], vector, mirrored(vector, normal[:, step]))
    return stretch[:, None] * (vector - ray * (dot(up, vector) / dot(up, ray))[:, None])
