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

from invertwin.channel.em.plane_waves import cross, dot, interpolate_vectors, reflect_vectors
from invertwin.channel.rays.arrays import to_float, to_torch
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RAY_EPSILON, Occluders
from invertwin.channel.rays.topology import Topology
from invertwin.channel.specular.candidates import FaceInteractions
from invertwin.channel.specular.image_method import (
    CandidateSurfaces,
    SpecularPaths,
    find_paths_between,
    image_positions,
)
from invertwin.checks import strip_derivatives

SIDE_OFFSET = 10.0  # margins between where power jumps and the two sides that are compared
_MIN_COSINE = 1e-4  # least cosine between a ray and the normal of the surface that it lights
_MAX_SURFACE_HITS = 64  # triangles of the surface that a straight piece of a path meets


class ReceivingSurface(Occluders):
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
class ReceivingTriangles:
    """Triangles of the scene itself that receive power.

    Attributes:
        is_receiving: Which of them do.
    """

    is_receiving: Bool[Tensor, " f"]


@dataclass(frozen=True)
class IlluminationBoundary:
    """Points on rims of lit regions, of paths with one number of steps.

    Attributes:
        paths: The paths from transmitters to the rims; row i ends at rim point i.
        place: Rim points on the surface, detached [m].
        face: Triangle of the surface.
        area_rate: Area newly lit, of the sample's share of the rim [m²]; zero in value, attached.
        edge_point: Number of the edge point that draws each.
    """

    paths: SpecularPaths
    point: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    area_rate: Float64[Tensor, " row"]
    edge_point: Int64[Tensor, " row"]


@dataclass(frozen=True)
class _EdgeSamples:
    """Points on edges, one row each; detached.

    Attributes:
        first, second: Vertices at the ends.
        fraction: Place from the first to the second, 0 to 1.
        weight: One over samples × probability per ``fraction``.
        faces: Triangles at the edge (−1: none).
    """

    first: Tensor
    second: Tensor
    fraction: Tensor
    weight: Tensor
    faces: Tensor

    def select(self, rows: Tensor) -> "_EdgeSamples":
        return _EdgeSamples(*(column[rows] for column in vars(self).values()))


@dataclass(frozen=True)
class _RaysPastEdges:
    """Rays that go on past an edge, one row each; detached.

    Attributes:
        origin, direction: Of the ray, about the local origin [m]; the direction of unit length.
        min_distance: Length from which on the surface counts [m]: on the first leg, that to the
            edge.
        source: Transmitter.
        edge_point: Of the edge point.
        side: Unit vector from the edge to the ray.
        steps_before_edge: Steps before the edge.
        faces, through: Steps so far, filled up with −1.
    """

    origin: Tensor
    direction: Tensor
    min_distance: Tensor
    source: Tensor
    edge_point: Tensor
    side: Tensor
    steps_before_edge: Tensor
    faces: Tensor
    through: Tensor

    def select(self, rows: Tensor) -> "_RaysPastEdges":
        return _RaysPastEdges(*(column[rows] for column in vars(self).values()))


def _concatenate_rays(parts: Sequence[_RaysPastEdges]) -> _RaysPastEdges:
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return _RaysPastEdges(*(torch.cat(column) for column in columns))


@dataclass(frozen=True)
class IlluminationBoundarySamples:
    """Points on rims of lit regions, of paths with one number of steps; detached.

    Attributes:
        edges: Points on edges that draw the rims.
        rays: Last legs of the paths.
        face: Triangle of the surface.
    """

    edges: _EdgeSamples
    rays: _RaysPastEdges
    face: Int64[Tensor, " row"]


def sample_illumination_boundaries(
    candidate_surfaces: CandidateSurfaces,
    receiver: ReceivingSurface | ReceivingTriangles,
    tx: Float64[Tensor, "tx 3"],
    sequences: tuple[Tensor, ...],
    powers: FaceInteractions,
    *,
    depth: int,
    samples: int,
    seed: int,
) -> list[IlluminationBoundarySamples]:
    """Points on the rims of all regions that specular paths light on a surface.

    Args:
        candidate_surfaces: The scene.
        receiver: Where power is received.
        tx: Transmitters in the world, detached [m].
        sequences: Candidates for what lies between transmitter and edge, by length from 1.
        powers: Of the triangles.
        depth: Most steps of a path.
        samples: Points on edges, for each transmitter.
        seed: Of the points.
    """
    found: list[IlluminationBoundarySamples] = []
    for number, source in enumerate(tx):
        edges = _sample_edges(candidate_surfaces, samples, seed, number)
        if not len(edges.fraction):
            continue
        ends = [candidate_surfaces.exact_vertices[vertex] for vertex in (edges.first, edges.second)]
        y = torch.lerp(ends[0], ends[1], edges.fraction[:, None])
        chains = [
            some
            for steps in (torch.zeros(1, 0, dtype=torch.int64), *sequences)
            for some in find_paths_between(
                candidate_surfaces, steps, source, y + candidate_surfaces.origin, number
            )
        ]
        met: dict[int, list[tuple[_RaysPastEdges, Tensor]]] = {}
        for some in chains:
            for legs in _launch_past_edges(
                candidate_surfaces, source - candidate_surfaces.origin, y, ends, some, depth
            ):
                for last, face in _follow_rays(candidate_surfaces, receiver, legs, powers, depth):
                    met.setdefault(last.faces.shape[1], []).append((last, face))
        for some in met.values():
            legs, faces = zip(*some, strict=True)
            found.append(
                IlluminationBoundarySamples(edges, _concatenate_rays(legs), torch.cat(faces))
            )
    return found


def _sample_edges(
    candidate_surfaces: CandidateSurfaces, samples: int, seed: int, number: int
) -> _EdgeSamples:
    """Points spread evenly over all edges at which anything can end."""
    topology, planes = candidate_surfaces.topology, candidate_surfaces.planes.face_plane
    beside = topology.edge_faces
    # Triangles in one plane of one object are one surface.
    plane = torch.where(beside >= 0, planes[beside.clamp_min(0)], -1)
    flat = (plane == plane[:, :1]).all(1) & (beside >= 0).all(1) & (beside.shape[1] > 1)
    edge = torch.nonzero(~flat)[:, 0]
    ends = candidate_surfaces.exact_vertices[topology.edges[edge]]
    row, along, weight = sample_along_curves(
        (ends[:, 1] - ends[:, 0]).norm(dim=1), samples, seed, number
    )
    chosen = edge[row]
    first, second = topology.edges[chosen].unbind(1)
    return _EdgeSamples(first, second, along, weight, topology.edge_faces[chosen])


def sample_along_curves(
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


def _launch_past_edges(
    candidate_surfaces: CandidateSurfaces,
    source: Tensor,
    edge_points: Tensor,
    ends: list[Tensor],
    chains: SpecularPaths,
    depth: int,
) -> Iterator[_RaysPastEdges]:
    """Rays past edges, one at each side, from the last mirror or sheet before them."""
    planes, count = candidate_surfaces.planes, chains.faces.shape[1]
    plane = planes.face_plane[chains.faces]
    if count:
        # A step in a plane that holds the edge point is one at the edge: the rays past it take it.
        last = plane[:, -1]
        height = dot(edge_points[chains.target] - planes.point[last], planes.normal[last]).abs()
        rows = torch.nonzero(height > SIDE_OFFSET * candidate_surfaces.margin)[:, 0]
        chains = SpecularPaths(*(column[rows] for column in vars(chains).values()))
        plane = plane[rows]
    if not len(chains.source):
        return
    point, normal, target = planes.point[plane], planes.normal[plane], edge_points[chains.target]
    image = image_positions(source.expand(len(target), 3), point, normal, chains.transmitted)[-1]
    edge = normalize(ends[1][chains.target] - ends[0][chains.target], dim=1)
    across = cross(normalize(target - image, dim=1), edge)
    clear = torch.nonzero(across.norm(dim=1) > _MIN_COSINE)[:, 0]
    across = normalize(across, dim=1)
    for side in (across, -across):
        offset = target + SIDE_OFFSET * candidate_surfaces.margin * side - image
        length = offset.norm(dim=1)
        direction = offset / length[:, None]
        origin, start = image, torch.zeros_like(length)
        if count:
            falls = dot(direction, normal[:, -1])
            start = dot(point[:, -1] - image, normal[:, -1]) / falls
            lift = candidate_surfaces.margin * falls.sign()
            origin = image + start[:, None] * direction + lift[:, None] * normal[:, -1]
        yield _RaysPastEdges(
            origin,
            direction,
            length - start,
            chains.source,
            chains.target,
            side,
            torch.full_like(chains.source, count),
            pad(chains.faces, (0, depth - count), value=-1),
            pad(chains.transmitted, (0, depth - count), value=False),
        ).select(clear)


def _follow_rays(
    candidate_surfaces: CandidateSurfaces,
    receiver: ReceivingSurface | ReceivingTriangles,
    rays: _RaysPastEdges,
    powers: FaceInteractions,
    depth: int,
) -> Iterator[tuple[_RaysPastEdges, Tensor]]:
    """Where rays meet the surface, and by which steps: legs with the triangle of the surface."""
    step = int(rays.steps_before_edge[0]) if len(rays.edge_point) else depth
    while len(rays.edge_point):
        face, distance = _intersect_rays(candidate_surfaces, rays.origin, rays.direction)
        for rows, triangle in _find_received(receiver, rays, face, distance):
            some = rays.select(rows)
            steps = {"faces": some.faces[:, :step], "through": some.through[:, :step]}
            yield replace(some, **steps), triangle
        if step == depth:
            return
        known = (face >= 0) & (candidate_surfaces.planes.face_plane[face.clamp_min(0)] >= 0)
        onwards: list[_RaysPastEdges] = []
        for passes, able in ((False, powers.reflect), (True, powers.transmit)):
            rows = torch.nonzero(known & able[face.clamp_min(0)])[:, 0]
            some, hit = rays.select(rows), face[rows]
            normal = candidate_surfaces.planes.normal[candidate_surfaces.planes.face_plane[hit]]
            place = some.origin + distance[rows, None] * some.direction
            way = some.direction if passes else reflect_vectors(some.direction, normal)
            lift = candidate_surfaces.margin * dot(way, normal).sign()
            faces, through = some.faces.clone(), some.through.clone()
            faces[:, step], through[:, step] = hit, passes
            onwards.append(
                replace(
                    some,
                    origin=place + lift[:, None] * normal,
                    direction=way,
                    min_distance=some.min_distance - distance[rows],
                    faces=faces,
                    through=through,
                )
            )
        rays = _concatenate_rays(onwards)
        step += 1


def _intersect_rays(
    occluders: Occluders, origin: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """The triangle that each ray meets (−1: none), and how far away [m] (else infinite)."""
    start, way = (
        kind(*(to_float(values[:, k].to(torch.float32)) for k in range(3)))
        for kind, values in ((mi.Point3f, origin), (mi.Vector3f, direction))
    )
    hit = occluders.scene.ray_intersect_preliminary(mi.Ray3f(start, way))
    face = dr.select(hit.is_valid(), mi.Int32(hit.prim_index), -1)
    distance = dr.select(hit.is_valid(), hit.t, dr.inf)
    dr.eval(face, distance)
    return to_torch(face).long(), to_torch(distance).double()


def _find_received(
    receiver: ReceivingSurface | ReceivingTriangles,
    rays: _RaysPastEdges,
    face: Tensor,
    distance: Tensor,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and triangles that receive power on the way to the next wall, or where it is met."""
    if isinstance(receiver, ReceivingSurface):
        yield from _find_surface_hits(receiver, rays, distance)
        return
    rows = torch.nonzero(
        (face >= 0) & receiver.is_receiving[face.clamp_min(0)] & (distance > rays.min_distance)
    )
    yield rows[:, 0], face[rows[:, 0]]


def _find_surface_hits(
    receiver: ReceivingSurface, rays: _RaysPastEdges, max_distance: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and triangles of the surface that they cross, past the edge and before the next wall."""
    rows, at = torch.arange(len(rays.edge_point)), rays.min_distance.clamp_min(0.0)
    for _ in range(_MAX_SURFACE_HITS):
        ahead = torch.nonzero(at < max_distance[rows])[:, 0]
        if not len(ahead):
            return
        rows, at = rows[ahead], at[ahead]
        origin, direction = rays.origin[rows], rays.direction[rows]
        face, distance = _intersect_rays(receiver, origin + at[:, None] * direction, direction)
        at = at + distance
        met = torch.nonzero((face >= 0) & (at < max_distance[rows]))[:, 0]
        rows, at = rows[met], at[met]
        yield rows, face[met]
        at = at + RAY_EPSILON * (1 + at + origin[met].norm(dim=1))


def evaluate_illumination_boundary(
    candidate_surfaces: CandidateSurfaces,
    receiving_corners: Float64[Tensor, "face 3 3"],
    samples: IlluminationBoundarySamples,
    tx: Float64[Tensor, "tx 3"],
    vertices: Float64[Tensor, "v 3"],
) -> IlluminationBoundary:
    """Points on rims, with the speeds of the rims.

    Args:
        candidate_surfaces: The scene.
        receiving_corners: Corners of the triangles where power is received, attached where they
            move [m].
        samples: The points.
        tx: Transmitters in the world, attached [m].
        vertices: Of the scene in the world, attached [m].
    """
    legs, edges = samples.rays, samples.edges.select(samples.rays.edge_point)
    corners = vertices[candidate_surfaces.topology.faces[legs.faces]]
    sides = corners[..., 1:, :] - corners[..., :1, :]
    normal = normalize(cross(sides[..., 0, :], sides[..., 1, :]), dim=-1)
    point = corners[..., 0, :]
    seen = image_positions(tx[legs.source], point, normal, legs.through)[-1]
    # Only what follows the edge mirrors it.
    kept = legs.through | (torch.arange(legs.faces.shape[1]) < legs.steps_before_edge[:, None])
    y0, y1 = vertices[edges.first], vertices[edges.second]
    y = image_positions(torch.lerp(y0, y1, edges.fraction[:, None]), point, normal, kept)[-1]
    receiving = receiving_corners[samples.face]
    p0, p1, p2 = receiving.unbind(1)
    up = normalize(cross(p1 - p0, p2 - p0), dim=1)
    ray = y - seen
    stretch = dot(p0 - seen, up) / dot(ray, up)
    rim = seen + stretch[:, None] * ray
    material = interpolate_vectors(receiving, strip_derivatives(receiving), strip_derivatives(rim))

    up = strip_derivatives(up)
    fixed = strip_derivatives(ray), strip_derivatives(stretch), strip_derivatives(normal)
    edge, aside = (
        _project_shift(v, fixed, kept, up) for v in (strip_derivatives(y1 - y0), legs.side)
    )
    outwards = cross(up, edge)
    outwards = outwards * -dot(outwards, aside).sign()[:, None]
    rate = dot(outwards, rim - material) * edges.weight
    steep = dot(fixed[0], up).abs() > _MIN_COSINE * fixed[0].norm(dim=1)
    rows = torch.nonzero(steep)[:, 0]
    chains = SpecularPaths(
        legs.source[rows], torch.arange(len(rows)), legs.faces[rows], legs.through[rows]
    )
    return IlluminationBoundary(
        chains, strip_derivatives(rim)[rows], samples.face[rows], rate[rows], legs.edge_point[rows]
    )


def _project_shift(
    vector: Tensor, fixed: tuple[Tensor, ...], is_transmission: Tensor, up: Tensor
) -> Tensor:
    """How a rim point shifts on the surface when the edge point is shifted; detached."""
    ray, stretch, normal = fixed
    for step, stays in enumerate(is_transmission.unbind(1)):
        vector = torch.where(stays[:, None], vector, reflect_vectors(vector, normal[:, step]))
    return stretch[:, None] * (vector - ray * (dot(up, vector) / dot(up, ray))[:, None])
