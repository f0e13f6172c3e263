"""Coverage: specular power on a receiving surface, with boundary paths for its derivatives.

The mean over an area is that of points spread over it, plus boundary paths: zero in value, with the
derivative due to the moving boundaries of illuminated regions (``shadow_boundaries``).

Source: derivations §10 and §11.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.nn.functional import normalize
from torch.utils.checkpoint import checkpoint

from invertwin.channel.coverage import shadow_boundaries
from invertwin.channel.em.plane_waves import dot, interpolate_vectors, triangle_normals
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.intersections import find_overlapping_pairs, intersect_triangles
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.channel.specular import image_method, trace_paths
from invertwin.channel.specular.candidates import find_sequences
from invertwin.channel.specular.image_method import CandidateSurfaces, find_paths_along
from invertwin.channel.specular.ray_paths import RayPaths, join_ray_paths
from invertwin.checks import ArrayLike, is_differentiated, strip_derivatives
from invertwin.scene.mesh import Mesh
from invertwin.scene.scene import Scene

_POINTS_AT_ONCE = 1 << 13


@dataclass(frozen=True)
class PathMeasure:
    """Values that each path contributes to sums over a surface.

    Attributes:
        evaluate: function of paths and of the positions of their transmitters and receivers;
            returns the values of each path, [path, amount].
        count: number of values per path.
    """

    evaluate: Callable[[RayPaths, Tensor, Tensor], Tensor]
    count: int


@dataclass(frozen=True)
class CoverageBoundaryPaths:
    """Boundary paths that end on the surface.

    Attributes:
        tx: transmitter numbers.
        point: positions on the surface [m].
        face: triangles of the surface.
        amount: contributions to the integral over the surface; zero in value.
    """

    tx: Int64[Tensor, " row"]
    point: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    amount: Float64[Tensor, "row amount"]


@dataclass(frozen=True)
class CoverageTrace:
    """Specular coverage of a surface.

    Attributes:
        amount: sums of path values at the points.
        boundary_paths: boundary paths to the surface.
    """

    amount: Float64[Tensor, "tx point amount"]
    boundary_paths: tuple[CoverageBoundaryPaths, ...]


#: Paths to a batch of points: the points' numbers, and the paths.
_PointBatch = tuple[Tensor, list[image_method.SpecularPaths]]


def trace_coverage(
    scene: Scene,
    tx: ArrayLike,
    surface: Mesh,
    points: Float64[Tensor, "point 3"],
    frequency: float,
    measure: PathMeasure,
    *,
    depth: int,
    rays: int | None,
    boundary_samples: int,
    seed: int,
) -> CoverageTrace:
    """Trace specular paths to points of a surface, and to boundaries of illumination on it.

    Args:
        scene: scene with surfaces.
        tx: transmitter positions, [tx, 3], in world axes [m].
        surface: receiving surface, in world axes; it occludes nothing.
        points: points on the surface [m].
        frequency: carrier frequency [Hz].
        measure: values that a path contributes.
        depth: maximum number of reflections on a path; sheets are passed on the way.
        rays: number of rays from each transmitter to find sequences of surfaces; None tests every
            one.
        boundary_samples: number of points on edges, for each transmitter; 0 leaves boundary paths
            out. Only derivatives with respect to positions use them.
        seed: random seed of rays and edge points.
    """
    path_scene = trace_paths.prepare_path_scene(scene, tx, points, frequency)
    with tracing():
        tracer = _CoverageTracer(path_scene, surface, measure, depth, rays, seed)
        amount = tracer.sum_paths(path_scene, tracer.find_paths(strip_derivatives(path_scene.rx)))
        paths: list[CoverageBoundaryPaths] = []
        deforms = is_differentiated(path_scene.vertices)
        if boundary_samples and (deforms or is_differentiated(path_scene.tx)):
            paths += tracer.trace_illumination_boundaries(path_scene, boundary_samples, seed)
            if deforms:
                paths += tracer.trace_intersection_curves(path_scene, boundary_samples, seed)
    return CoverageTrace(amount, tuple(paths))


class _CoverageTracer:
    """Finds specular paths to a receiving surface and sums their values."""

    def __init__(
        self,
        stage: trace_paths.PathScene,
        surface: Mesh,
        measure: PathMeasure,
        depth: int,
        rays: int | None,
        seed: int,
    ) -> None:
        self.measure, self.depth = measure, depth
        self.tx, interactions = strip_derivatives(stage.tx), trace_paths.face_interactions(stage)
        # Discrete: `torch.func` would claim the intermediate tensors.
        with _DisableFuncTorch():
            places = strip_derivatives(surface.vertices)
            vertices, ends = strip_derivatives(stage.vertices), torch.cat([self.tx, places])
            self.surfaces = CandidateSurfaces(vertices, stage.topology, ends, interactions)
            own, origin = topology_of([surface]), self.surfaces.origin
            self.receiving_surface = shadow_boundaries.ReceivingSurface(places, own, origin)
            self.meshes = [*(item.mesh for item in stage.scene.objects.values()), surface]
            self.sequences = find_sequences(self.surfaces, self.tx, depth, rays, seed).steps

    def find_paths(self, points: Tensor) -> list[_PointBatch]:
        """Find the paths to points, in batches of points."""
        batches: list[_PointBatch] = []
        with _DisableFuncTorch():
            for rows in torch.arange(len(points)).split(_POINTS_AT_ONCE):
                found = find_paths_along(self.surfaces, self.sequences, self.tx, points[rows])
                batches.append((rows, [part for part in found if len(part.source)]))
        return batches

    def sum_paths(
        self, stage: trace_paths.PathScene, batches: list[_PointBatch]
    ) -> Float64[Tensor, "tx point amount"]:
        """Sum the values of paths at points; derivatives recompute the paths (checkpointing)."""
        recompute = stage.vertices.requires_grad or stage.tx.requires_grad
        found: list[Tensor] = []
        for rows, parts in batches:
            rx = stage.rx[rows]
            local = replace(stage, rx=rx, rx_velocity=torch.zeros_like(rx))

            def total(
                local: trace_paths.PathScene = local,
                parts: list[image_method.SpecularPaths] = parts,
            ) -> Tensor:
                count = len(self.tx) * len(local.rx)
                sums = torch.zeros(count, self.measure.count, dtype=torch.float64)
                for part in parts:
                    paths = join_ray_paths(trace_paths.evaluate_paths(local, part))
                    values = self.measure.evaluate(paths, local.tx, local.rx)
                    sums = sums.index_add(0, paths.link, values)
                return sums.unflatten(0, (len(self.tx), len(local.rx)))

            found.append(checkpoint(total, use_reentrant=False) if recompute else total())
        return torch.cat(found, 1)

    def trace_illumination_boundaries(
        self, stage: trace_paths.PathScene, samples: int, seed: int
    ) -> list[CoverageBoundaryPaths]:
        """Boundary paths to illumination boundaries: path values times the boundary's area rate."""
        with _DisableFuncTorch():
            search = self.receiving_surface, self.tx, self.sequences
            groups = shadow_boundaries.sample_illumination_boundaries(
                self.surfaces, *search, depth=self.depth, samples=samples, seed=seed
            )
        boundary_paths: list[CoverageBoundaryPaths] = []
        for some in groups:
            corners, moving = self.receiving_surface.corners, (stage.tx, stage.vertices)
            boundary = shadow_boundaries.evaluate_illumination_boundary(
                self.surfaces, corners, some, *moving
            )
            detached = _detach_stage(stage, boundary.point)
            with torch.no_grad():
                paths = join_ray_paths(trace_paths.evaluate_paths(detached, boundary.paths))
                values = strip_derivatives(self.measure.evaluate(paths, detached.tx, detached.rx))
            # One path a row, in another order.
            amount = torch.zeros_like(values).index_copy(0, paths.rx, values)
            amount = amount * boundary.area_rate[:, None]
            ends = boundary.paths.source, boundary.point, boundary.face
            boundary_paths.append(CoverageBoundaryPaths(*ends, amount))
        return boundary_paths

    def trace_intersection_curves(
        self, stage: trace_paths.PathScene, samples: int, seed: int
    ) -> list[CoverageBoundaryPaths]:
        """Boundary paths where the scene intersects the surface: jump of values times area rate."""
        with _DisableFuncTorch():
            joint_topology = topology_of(self.meshes)
            own, receiver = self.surfaces, self.receiving_surface
            curve_points = sample_intersection_curves(own, receiver, joint_topology, samples, seed)
            if not len(curve_points.face):
                return []
            offset = shadow_boundaries.SIDE_OFFSET * self.surfaces.margin * curve_points.across
            points = torch.cat([curve_points.point + offset, curve_points.point - offset])
        with torch.no_grad():
            sums = self.sum_paths(_detach_stage(stage, points), self.find_paths(points))
            outer, inner = strip_derivatives(sums).chunk(2, 1)
        rate = intersection_area_rates(self.surfaces, curve_points, stage.vertices)
        count = len(self.tx)
        return [
            CoverageBoundaryPaths(
                torch.arange(count).repeat_interleave(len(rate)),
                curve_points.point.repeat(count, 1),
                curve_points.receiving_face.repeat(count),
                ((inner - outer) * rate[:, None]).flatten(0, 1),
            )
        ]


def _detach_stage(stage: trace_paths.PathScene, points: Tensor) -> trace_paths.PathScene:
    """Replace the receivers and detach all positions."""
    return replace(stage, rx=points, rx_velocity=torch.zeros_like(points), velocities=None).detach()


@dataclass(frozen=True)
class IntersectionCurvePoints:
    """Points on intersection curves of the scene with a receiving surface; detached.

    Attributes:
        point: the points [m].
        face: triangles of the scene.
        receiving_face: triangles of the receiving surface.
        across: unit vectors in the surface across the curve, to the side of the normal.
        normal: unit normals of the scene's triangles.
        weight: length of curve per point, over n·across [m].
    """

    point: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    receiving_face: Int64[Tensor, " row"]
    across: Float64[Tensor, "row 3"]
    normal: Float64[Tensor, "row 3"]
    weight: Float64[Tensor, " row"]


def sample_intersection_curves(
    surfaces: CandidateSurfaces,
    receiving_surface: shadow_boundaries.ReceivingSurface,
    joint_topology: Topology,
    samples: int,
    seed: int,
) -> IntersectionCurvePoints:
    """Sample points evenly on the intersection curves of the scene with a receiving surface.

    Args:
        surfaces: surfaces of the scene.
        receiving_surface: the receiving surface.
        joint_topology: triangles of the scene, followed by those of the receiving surface.
        samples: number of points.
        seed: random seed of the points.
    """
    vertices = surfaces.exact_vertices + surfaces.origin
    corners = vertices[surfaces.topology.faces]
    face, receiving_face = find_overlapping_pairs(corners, receiving_surface.corners)
    points = torch.cat([vertices, receiving_surface.vertices])
    segments = intersect_triangles(points, joint_topology, face, receiving_face + len(corners))
    span = segments.end - segments.start
    row, fraction, weight = shadow_boundaries.sample_along_curves(span.norm(dim=1), samples, seed)
    face, receiving_face = segments.first[row], segments.second[row] - len(corners)
    normal = triangle_normals(corners[face])
    up = triangle_normals(receiving_surface.corners[receiving_face])
    across = normalize(normal - dot(normal, up)[:, None] * up, dim=1)
    points = segments.start[row] + fraction[:, None] * span[row]
    weight = weight * span[row].norm(dim=1) / dot(normal, across)
    return IntersectionCurvePoints(points, face, receiving_face, across, normal, weight)


def intersection_area_rates(
    surfaces: CandidateSurfaces, points: IntersectionCurvePoints, vertices: Float64[Tensor, "v 3"]
) -> Float64[Tensor, " row"]:
    """Rates of the area lost on the side of the normal; zero in value, with derivatives [m²].

    Args:
        surfaces: surfaces of the scene.
        points: points on the intersection curves.
        vertices: vertex positions in world axes, with derivatives [m].
    """
    corners = vertices[surfaces.topology.faces[points.face]]
    material = interpolate_vectors(corners, strip_derivatives(corners), points.point)
    return dot(points.normal, material - strip_derivatives(material)) * points.weight
