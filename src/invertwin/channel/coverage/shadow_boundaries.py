"""Shadow and reflection boundaries on a receiving surface, and their velocity with respect to θ.

The paths of one sequence of reflections and transmissions illuminate a region of a surface. Its
boundary is cast by edges of the scene: those of the reflecting surfaces and sheets, and those of
occluders. A ray from the transmitter to a point of an edge continues on both sides of the edge, and
every path that exists on one side only contributes its power times the velocity at which the
boundary moves over the surface.

With S the last image of the transmitter and y the last image of the edge point, the boundary lies
where the line from S through y intersects the surface: ``ΔI = f · T · (x_c − x_m)``, value zero.

Source: derivations §3 and §11, for specular paths.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em import plane_waves as waves
from invertwin.channel.em.plane_waves import cross, dot, interpolate_vectors, reflect_vectors
from invertwin.channel.rays.ray_scene import MAX_SHEETS, RAY_EPSILON, Occluders
from invertwin.channel.rays.topology import Topology
from invertwin.channel.rows import Rows, concatenate_rows
from invertwin.channel.specular.image_method import (
    CandidateSurfaces,
    SpecularPaths,
    find_paths_along,
    image_positions,
)
from invertwin.checks import strip_derivatives

SIDE_OFFSET = 10.0  # margins between a boundary and the points compared on its two sides
_MIN_COSINE = 1e-4  # of the angle between a ray and the normal of the receiving surface
_ON_ONE_SIDE = 1e-9  # relative height across the plane through edge and transmitter
_MAX_SURFACE_HITS = 64  # triangles of the surface on one segment of a path


class ReceivingSurface(Occluders):
    """Surface that receives power at all its points and occludes nothing.

    Args:
        vertices: vertex positions in world axes, detached [m].
        topology: triangles of the vertices.
        origin: local origin, that of the scene [m].
    """

    def __init__(
        self, vertices: Float64[Tensor, "v 3"], topology: Topology, origin: Float64[Tensor, "3"]
    ) -> None:
        super().__init__(vertices, topology, origin)
        self.vertices = vertices
        self.corners = vertices[topology.faces]

    def find_received(
        self, rays: "_RaysPastEdges", face: Tensor, max_distance: Tensor
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Rows and triangles of surface crossings past the edge and before the next surface.

        Args:
            rays: rays past edges.
            face: triangle of the scene that each ray meets next; −1 = none.
            max_distance: its distance [m].
        """
        rows, reach = torch.arange(len(rays.edge_point)), rays.min_distance.clamp_min(0.0)
        for _ in range(_MAX_SURFACE_HITS):
            ahead = torch.nonzero(reach < max_distance[rows])[:, 0]
            if not len(ahead):
                return
            rows, reach = rows[ahead], reach[ahead]
            origin, direction = rays.origin[rows], rays.direction[rows]
            face, distance = self.find_first_hits(origin + reach[:, None] * direction, direction)
            reach = reach + distance
            is_hit = torch.nonzero((face >= 0) & (reach < max_distance[rows]))[:, 0]
            rows, reach = rows[is_hit], reach[is_hit]
            yield rows, face[is_hit]
            reach = reach + RAY_EPSILON * (1 + reach + origin[is_hit].norm(dim=1))


@dataclass(frozen=True)
class ReceivingTriangles:
    """Triangles of the scene itself that receive power.

    Attributes:
        is_receiving: mask of triangles that receive.
    """

    is_receiving: Bool[Tensor, " f"]

    def find_received(
        self, rays: "_RaysPastEdges", face: Tensor, distance: Tensor
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Rows and triangles that receive power at the ends of segments.

        Args:
            rays: rays past edges.
            face: triangle of the scene that each ray meets next; −1 = none.
            distance: its distance [m].
        """
        hit = (face >= 0) & self.is_receiving[face.clamp_min(0)] & (distance > rays.min_distance)
        rows = torch.nonzero(hit)[:, 0]
        yield rows, face[rows]


@dataclass(frozen=True)
class IlluminationBoundary:
    """Points on boundaries of illuminated regions, of paths with equal numbers of steps.

    Attributes:
        paths: paths from transmitters to the boundaries; row i ends at point i.
        point: boundary points on the surface, detached [m].
        face: triangle of the surface.
        area_rate: area newly illuminated along the sample's part of the boundary [m²]; zero in
            value, with derivatives.
        edge_point: number of the edge point that casts each.
    """

    paths: SpecularPaths
    point: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    area_rate: Float64[Tensor, " row"]
    edge_point: Int64[Tensor, " row"]


@dataclass(frozen=True)
class _EdgeSamples(Rows):
    """Points on edges, one row each; detached.

    Attributes:
        ends: vertices at the ends, [row, 2].
        fraction: position from the first to the second, 0 to 1.
        weight: reciprocal of samples × probability per ``fraction``.
    """

    ends: Tensor
    fraction: Tensor
    weight: Tensor


@dataclass(frozen=True)
class _RaysPastEdges(Rows):
    """Rays that continue past an edge, one row each; detached.

    Attributes:
        origin, direction: ray origin relative to the local origin [m], and unit direction.
        min_distance: distance beyond which the surface receives [m]: on the first leg, that to the
            edge.
        source: number of the transmitter.
        edge_point: number of the edge point.
        side: unit vector from the edge to the ray.
        steps_before_edge: number of steps before the edge.
        faces, through: triangles so far, and a mask of those that transmit.
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


@dataclass(frozen=True)
class IlluminationBoundarySamples:
    """Points on boundaries of illuminated regions, of paths with equal numbers of steps; detached.

    Attributes:
        edges: points on edges that cast the boundaries.
        rays: last legs of the paths.
        face: triangle of the surface.
    """

    edges: _EdgeSamples
    rays: _RaysPastEdges
    face: Int64[Tensor, " row"]


def sample_illumination_boundaries(
    surfaces: CandidateSurfaces,
    receiver: ReceivingSurface | ReceivingTriangles,
    tx: Float64[Tensor, "tx 3"],
    sequences: tuple[Tensor, ...],
    *,
    depth: int,
    samples: int,
    seed: int,
) -> list[IlluminationBoundarySamples]:
    """Sample points on the boundaries of regions that specular paths illuminate on a surface.

    Args:
        surfaces: surfaces of the scene.
        receiver: surface or triangles that receive power.
        tx: transmitter positions in world axes, detached [m].
        sequences: candidate sequences from transmitter to edge, by length from 1.
        depth: maximum number of reflections of a path; it passes up to 8 sheets.
        samples: number of points on edges, for each transmitter.
        seed: random seed of the points.
    """
    topology, found = surfaces.topology, list[IlluminationBoundarySamples]()
    folds = _find_folds(surfaces)
    for number, source in enumerate(tx):
        casts = folds
        if not depth:
            image = (source - surfaces.origin).expand(len(folds), 3)
            casts = folds[_cast_boundaries(surfaces, folds, image, reflects=False)]
        start, end = surfaces.exact_vertices[topology.edges[casts]].unbind(1)
        row, *place = sample_along_curves((end - start).norm(dim=1), samples, seed, number)
        if not len(row):
            continue
        edges, ends = _EdgeSamples(topology.edges[casts[row]], *place), (start[row], end[row])
        y = torch.lerp(ends[0], ends[1], edges.fraction[:, None])

        def is_needed(
            sources: Tensor, steps: Tensor, target: Tensor, edge: Tensor = casts[row]
        ) -> Tensor:
            image = surfaces.images(sources, steps)[-1]
            return _cast_boundaries(surfaces, edge[target], image, reflects=depth > 0)

        where = source[None], y + surfaces.origin
        paths = find_paths_along(surfaces, sequences, *where, is_needed)
        hits: dict[int, list[tuple[_RaysPastEdges, Tensor]]] = {}
        for part in paths:
            part = replace(part, source=part.source + number)
            for legs in _launch_past_edges(surfaces, source - surfaces.origin, y, ends, part):
                for last, face in _follow_rays(surfaces, receiver, legs, depth):
                    hits.setdefault(last.faces.shape[1], []).append((last, face))
        for part in hits.values():
            legs, faces = zip(*part, strict=True)
            last, face = concatenate_rows(legs), torch.cat(faces)
            found.append(IlluminationBoundarySamples(edges, last, face))
    return found


def _find_folds(surfaces: CandidateSurfaces) -> Int64[Tensor, " edge"]:
    """Return the edges where surfaces end or leave their plane."""
    # Coplanar triangles of one object are one surface; the table is as wide as any edge needs.
    is_there, faces = _edge_triangles(surfaces.topology)
    plane = surfaces.planes.face_plane[faces]
    return torch.nonzero((is_there & (plane != plane[:, :1])).any(1) | ~is_there[:, 1])[:, 0]


def _cast_boundaries(
    surfaces: CandidateSurfaces,
    edges: Int64[Tensor, " row"],
    image: Float64[Tensor, "row 3"],
    *,
    reflects: bool,
) -> Bool[Tensor, " row"]:
    """Mask of edges that can cast a boundary: silhouettes, and those of surfaces that light leaves.

    Args:
        surfaces: surfaces of the scene.
        edges: numbers of edges.
        image: image of the transmitter that each is seen from, relative to the local origin [m].
        reflects: True where paths may reflect after the edge.
    """
    topology, own = surfaces.topology, surfaces.interactions
    is_there, faces = _edge_triangles(topology, edges)
    y0, y1 = surfaces.exact_vertices[topology.edges[edges]].unbind(1)
    apex = surfaces.exact_vertices[topology.edge_apexes[edges].clamp_min(0)] - y0[:, None]
    height = dot(apex, cross(y0 - image, y1 - y0)[:, None])
    height = torch.where(is_there, height, 0.0)
    tolerance = _ON_ONE_SIDE * height.abs().amax(1)
    leaves = own.transmit[faces] | own.reflect[faces] if reflects else own.transmit[faces]
    return (
        (height.amin(1) >= -tolerance) | (height.amax(1) <= tolerance) | (is_there & leaves).any(1)
    )


def _edge_triangles(
    topology: Topology, edges: Tensor | slice = slice(None)
) -> tuple[Bool[Tensor, "row k"], Int64[Tensor, "row k"]]:
    """Return a mask of the triangles at edges that there are, and their numbers, else 0."""
    faces = topology.edge_faces[edges]
    return faces >= 0, faces.clamp_min(0)


def sample_along_curves(
    length: Float64[Tensor, " n"], samples: int, *seeds: int
) -> tuple[Int64[Tensor, " row"], Float64[Tensor, " row"], Float64[Tensor, " row"]]:
    """Sample points evenly on curves: number of the curve, position from 0 to 1, and weight.

    The weight is the reciprocal of samples × probability per position.

    Args:
        length: lengths of the curves [m].
        samples: number of points; without curves there are none.
        seeds: random seeds of the points.
    """
    total = length.cumsum(0)
    if not len(length) or not total[-1] > 0:
        return torch.zeros(0, dtype=torch.int64), length[:0], length[:0]
    jitter = np.random.default_rng(np.random.SeedSequence(seeds)).random(samples)
    cumulative = (torch.arange(samples) + torch.from_numpy(jitter)) / samples * total[-1]
    row = torch.searchsorted(total, cumulative, right=True).clamp_max(len(length) - 1)
    fraction = 1 - (total[row] - cumulative) / length[row]
    return row, fraction.clamp(0.0, 1.0), total[-1] / (samples * length[row])


def _launch_past_edges(
    surfaces: CandidateSurfaces,
    source: Tensor,
    edge_points: Tensor,
    ends: Sequence[Tensor],
    chains: SpecularPaths,
) -> Iterator[_RaysPastEdges]:
    """Launch rays past edges, one on each side, from the last surface before them."""
    planes, count = surfaces.planes, chains.faces.shape[1]
    plane = planes.face_plane[chains.faces]
    if count:
        # A step in a plane that contains the edge point is left to the rays past the edge.
        last = plane[:, -1]
        height = dot(edge_points[chains.target] - planes.point[last], planes.normal[last]).abs()
        rows = torch.nonzero(height > SIDE_OFFSET * surfaces.margin)[:, 0]
        chains = chains.select(rows)
        plane = plane[rows]
    if not len(chains.source):
        return
    point, normal, target = planes.point[plane], planes.normal[plane], edge_points[chains.target]
    image = image_positions(source.expand(len(target), 3), point, normal, chains.transmitted)[-1]
    edge = normalize(ends[1][chains.target] - ends[0][chains.target], dim=1)
    sideways = cross(normalize(target - image, dim=1), edge)
    valid = torch.nonzero(sideways.norm(dim=1) > _MIN_COSINE)[:, 0]
    sideways = normalize(sideways, dim=1)
    for side in (sideways, -sideways):
        offset = target + SIDE_OFFSET * surfaces.margin * side - image
        length = offset.norm(dim=1)
        direction = offset / length[:, None]
        origin, start = image, torch.zeros_like(length)
        if count:
            slope = dot(direction, normal[:, -1])
            start = dot(point[:, -1] - image, normal[:, -1]) / slope
            offset_length = surfaces.margin * slope.sign()
            origin = image + start[:, None] * direction + offset_length[:, None] * normal[:, -1]
        rays = origin, direction, length - start, chains.source, chains.target, side
        steps = torch.full_like(chains.source, count)
        yield _RaysPastEdges(*rays, steps, chains.faces, chains.transmitted).select(valid)


def _follow_rays(
    surfaces: CandidateSurfaces,
    receiver: ReceivingSurface | ReceivingTriangles,
    rays: _RaysPastEdges,
    depth: int,
) -> Iterator[tuple[_RaysPastEdges, Tensor]]:
    """Follow rays through the scene to the surface: last legs with the triangle that they hit."""
    own = surfaces.interactions
    while len(rays.edge_point):
        face, distance = surfaces.find_first_hits(rays.origin, rays.direction)
        for rows, triangle in receiver.find_received(rays, face, distance):
            yield rays.select(rows), triangle
        has_plane = (face >= 0) & (surfaces.planes.face_plane[face.clamp_min(0)] >= 0)
        passed = rays.through.sum(1)
        is_left = rays.faces.shape[1] - passed < depth, passed < MAX_SHEETS
        branches: list[_RaysPastEdges] = []
        for passes, mask in ((False, own.reflect), (True, own.transmit)):
            rows = torch.nonzero(has_plane & mask[face.clamp_min(0)] & is_left[passes])[:, 0]
            part, hit = rays.select(rows), face[rows]
            normal = surfaces.planes.normal[surfaces.planes.face_plane[hit]]
            hit_point = part.origin + distance[rows, None] * part.direction
            next_direction = part.direction if passes else reflect_vectors(part.direction, normal)
            ray_offset = surfaces.margin * dot(next_direction, normal).sign()
            faces = torch.cat([part.faces, hit[:, None]], 1)
            through = torch.cat([part.through, torch.full_like(hit[:, None], passes).bool()], 1)
            origin = hit_point + ray_offset[:, None] * normal
            left = part.min_distance - distance[rows]
            part = replace(part, origin=origin, direction=next_direction, min_distance=left)
            branches.append(replace(part, faces=faces, through=through))
        rays = concatenate_rows(branches)


def evaluate_illumination_boundary(
    surfaces: CandidateSurfaces,
    receiving_corners: Float64[Tensor, "face 3 3"],
    samples: IlluminationBoundarySamples,
    tx: Float64[Tensor, "tx 3"],
    vertices: Float64[Tensor, "v 3"],
) -> IlluminationBoundary:
    """Evaluate boundary points and the velocities of the boundaries.

    Args:
        surfaces: surfaces of the scene.
        receiving_corners: corners of the receiving triangles, with derivatives where they move [m].
        samples: boundary samples.
        tx: transmitter positions in world axes, with derivatives [m].
        vertices: vertex positions in world axes, with derivatives [m].
    """
    legs, edges = samples.rays, samples.edges.select(samples.rays.edge_point)
    corners = vertices[surfaces.topology.faces[legs.faces]]
    normal, point = waves.triangle_normals(corners), corners[..., 0, :]
    image = image_positions(tx[legs.source], point, normal, legs.through)[-1]
    # Only surfaces after the edge reflect the edge point.
    direct = legs.through | (torch.arange(legs.faces.shape[1]) < legs.steps_before_edge[:, None])
    y0, y1 = vertices[edges.ends].unbind(1)
    y = image_positions(torch.lerp(y0, y1, edges.fraction[:, None]), point, normal, direct)[-1]
    facets = receiving_corners[samples.face]
    p0, up = facets[:, 0], waves.triangle_normals(facets)
    ray = y - image
    scale = dot(p0 - image, up) / dot(ray, up)
    curve = image + scale[:, None] * ray
    material = interpolate_vectors(facets, strip_derivatives(facets), strip_derivatives(curve))

    up = strip_derivatives(up)
    fixed = strip_derivatives(ray), strip_derivatives(scale), strip_derivatives(normal)
    vectors = strip_derivatives(y1 - y0), legs.side
    edge, shift = (_project_shift(vector, fixed, direct, up) for vector in vectors)
    outwards = cross(up, edge)
    outwards = outwards * -dot(outwards, shift).sign()[:, None]
    rate = dot(outwards, curve - material) * edges.weight
    rows = torch.nonzero(dot(fixed[0], up).abs() > _MIN_COSINE * fixed[0].norm(dim=1))[:, 0]
    number = torch.arange(len(rows))
    paths = SpecularPaths(legs.source[rows], number, legs.faces[rows], legs.through[rows])
    return IlluminationBoundary(
        paths, strip_derivatives(curve)[rows], samples.face[rows], rate[rows], legs.edge_point[rows]
    )


def _project_shift(
    vector: Tensor, fixed: tuple[Tensor, ...], is_transmission: Tensor, up: Tensor
) -> Tensor:
    """Shift of a boundary point on the surface per shift of the edge point; detached."""
    ray, scale, normal = fixed
    for step, transmitted in enumerate(is_transmission.unbind(1)):
        vector = torch.where(transmitted[:, None], vector, reflect_vectors(vector, normal[:, step]))
    return scale[:, None] * (vector - ray * (dot(up, vector) / dot(up, ray))[:, None])
