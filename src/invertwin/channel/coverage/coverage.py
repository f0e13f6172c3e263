"""Specular power on a surface: at points of it, and what moves where beams end on it.

The mean over an area is that of points spread over it, plus boundary paths: zero in value, with the
derivative that the moving rims of lit regions have (``shadow_edges``).

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

from invertwin.channel.coverage.shadow_boundaries import (
    SIDE_OFFSET,
    ReceivingSurface,
    evaluate_illumination_boundary,
    sample_along_curves,
    sample_illumination_boundaries,
)
from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.intersections import find_overlapping_pairs, intersect_triangles
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.channel.specular.candidates import enumerate_sequences, shoot_sequences
from invertwin.channel.specular.image_method import (
    CandidateSurfaces,
    SpecularPaths,
    find_paths_between,
)
from invertwin.channel.specular.ray_paths import RayPaths, join_ray_paths
from invertwin.channel.specular.trace_paths import (
    PathScene,
    evaluate_paths,
    face_interactions,
    prepare_path_scene,
)
from invertwin.checks import ArrayLike, is_differentiated, strip_derivatives
from invertwin.scene.mesh import Mesh
from invertwin.scene.scene import Scene

_POINTS_AT_ONCE = 1 << 13  # points

#: Takes paths and the places of their transmitters and receivers; returns what each path adds,
#: ``[path, amount]``.
PathMeasure = Callable[[RayPaths, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class CoverageBoundaryPaths:
    """Boundary paths that end on the surface.

    Attributes:
        tx: Transmitters.
        point: Where on the surface [m].
        face: Triangle of the surface.
        amount: What each adds to the integral over the surface; zero in value.
    """

    tx: Int64[Tensor, " row"]
    point: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    amount: Float64[Tensor, "row amount"]


@dataclass(frozen=True)
class CoverageTrace:
    """What specular paths bring to a surface.

    Attributes:
        amount: At the points.
        boundary_paths: Boundary paths.
    """

    amount: Float64[Tensor, "tx point amount"]
    boundary_paths: tuple[CoverageBoundaryPaths, ...]


@dataclass(frozen=True)
class _PointBatch:
    """Paths to some points: the first point, how many, and chains."""

    begin: int
    count: int
    paths: list[SpecularPaths]


def trace_coverage(
    scene: Scene,
    tx: ArrayLike,
    surface: Mesh,
    points: Float64[Tensor, "point 3"],
    frequency: float,
    measure: PathMeasure,
    value_count: int,
    *,
    depth: int,
    rays: int | None,
    boundary_samples: int,
    seed: int,
) -> CoverageTrace:
    """What specular paths bring to points of a surface, and to the rims of lit regions on it.

    Args:
        scene: What is in the way.
        tx: Transmitters [tx, 3] in the world [m].
        surface: The surface, in the world; it hides nothing.
        points: On the surface [m].
        frequency: Of the coefficients [Hz].
        measure: What a path adds.
        value_count: Numbers that a path adds.
        depth: Most surfaces that a path meets.
        rays: Shot from each transmitter to find sequences of surfaces; None tries every one.
        boundary_samples: Points on edges, for each transmitter; 0 leaves boundary paths out. Only
            derivatives by places use them.
        seed: Of rays and edge points.
    """
    stage = prepare_path_scene(scene, tx, points, frequency, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    with tracing():
        trace = _CoverageTracer(stage, surface, measure, value_count, depth, rays, seed)
        amount = trace.sum_paths(stage, trace.find_paths(strip_derivatives(stage.rx)))
        crossings: list[CoverageBoundaryPaths] = []
        moved = is_differentiated(stage.vertices)
        if boundary_samples and (moved or is_differentiated(stage.tx)):
            crossings += trace.trace_illumination_boundaries(stage, boundary_samples, seed)
            crossings += (
                trace.trace_intersection_curves(stage, boundary_samples, seed) if moved else []
            )
    return CoverageTrace(amount, tuple(crossings))


class _CoverageTracer:
    """Which paths there are, and what they are worth."""

    def __init__(
        self,
        stage: PathScene,
        surface: Mesh,
        measure: PathMeasure,
        value_count: int,
        depth: int,
        rays: int | None,
        seed: int,
    ) -> None:
        self.measure, self.value_count, self.depth = measure, value_count, depth
        self.tx, self.powers = strip_derivatives(stage.tx), face_interactions(stage)
        # Discrete: to `torch.func`, tensors made on the way would be its own.
        with _DisableFuncTorch():
            places = strip_derivatives(surface.vertices)
            self.candidate_surfaces = CandidateSurfaces(
                strip_derivatives(stage.vertices), stage.topology, torch.cat([self.tx, places])
            )
            self.receiving_surface = ReceivingSurface(
                places, topology_of([surface]), self.candidate_surfaces.origin
            )
            meshes = [item.mesh for item in stage.scene.objects.values()]
            self.meshes = [*meshes, surface]
            planes = self.candidate_surfaces.planes
            found: tuple[Tensor, ...] = ()
            if depth and rays is None:
                found = enumerate_sequences(planes, self.powers, depth).steps
            elif depth and rays:
                found = shoot_sequences(
                    self.candidate_surfaces, planes, self.powers, self.tx, depth, rays, seed
                ).steps
            self.sequences = tuple(steps for steps in found if len(steps))

    def find_paths(self, points: Tensor) -> list[_PointBatch]:
        """The paths to points, some of the points at a time."""
        every = (torch.zeros(1, 0, dtype=torch.int64), *self.sequences)
        with _DisableFuncTorch():
            return [
                _PointBatch(
                    begin,
                    len(points),
                    [
                        part
                        for steps in every
                        for number, source in enumerate(self.tx)
                        for part in find_paths_between(
                            self.candidate_surfaces, steps, source, points, number
                        )
                        if len(part.source)
                    ],
                )
                for begin, points in zip(
                    range(0, len(points), _POINTS_AT_ONCE),
                    points.split(_POINTS_AT_ONCE),
                    strict=True,
                )
            ]

    def sum_paths(
        self, stage: PathScene, parts: list[_PointBatch]
    ) -> Float64[Tensor, "tx point amount"]:
        """What paths bring to points; a derivative computes the paths again, and keeps none."""
        again = stage.vertices.requires_grad or stage.tx.requires_grad
        found: list[Tensor] = []
        for some in parts:
            rx = stage.rx[some.begin : some.begin + some.count]
            here = replace(stage, rx=rx, rx_velocity=torch.zeros_like(rx))

            def total(here: PathScene = here, some: _PointBatch = some) -> Tensor:
                sums = torch.zeros(len(self.tx) * some.count, self.value_count, dtype=torch.float64)
                for part in some.paths:
                    paths = join_ray_paths(evaluate_paths(here, part))
                    sums = sums.index_add(0, paths.link, self.measure(paths, here.tx, here.rx))
                return sums.unflatten(0, (len(self.tx), some.count))

            found.append(checkpoint(total, use_reentrant=False) if again else total())
        return torch.cat(found, 1)

    def trace_illumination_boundaries(
        self, stage: PathScene, samples: int, seed: int
    ) -> list[CoverageBoundaryPaths]:
        """Boundary paths to rims: what each path would bring, times the rim's rate."""
        with _DisableFuncTorch():
            met = sample_illumination_boundaries(
                self.candidate_surfaces,
                self.receiving_surface,
                self.tx,
                self.sequences,
                self.powers,
                depth=self.depth,
                samples=samples,
                seed=seed,
            )
        crossings: list[CoverageBoundaryPaths] = []
        for some in met:
            found = evaluate_illumination_boundary(
                self.candidate_surfaces,
                self.receiving_surface.corners,
                some,
                stage.tx,
                stage.vertices,
            )
            here = _detach_stage(stage, found.point)
            with torch.no_grad():
                paths = join_ray_paths(evaluate_paths(here, found.paths))
                brought = strip_derivatives(self.measure(paths, here.tx, here.rx))
            # One path a row, in another order.
            amount = torch.zeros_like(brought).index_copy(0, paths.rx, brought)
            crossings.append(
                CoverageBoundaryPaths(
                    found.paths.source, found.point, found.face, amount * found.area_rate[:, None]
                )
            )
        return crossings

    def trace_intersection_curves(
        self, stage: PathScene, samples: int, seed: int
    ) -> list[CoverageBoundaryPaths]:
        """Boundary paths where the scene cuts the screen: the jump of power, times the rate."""
        with _DisableFuncTorch():
            both = topology_of(self.meshes)
            cuts = sample_intersection_curves(
                self.candidate_surfaces, self.receiving_surface, both, samples, seed
            )
            if not len(cuts.face):
                return []
            away = SIDE_OFFSET * self.candidate_surfaces.margin * cuts.across
            points = torch.cat([cuts.point + away, cuts.point - away])
        with torch.no_grad():
            here = _detach_stage(stage, points)
            beside, behind = strip_derivatives(self.sum_paths(here, self.find_paths(points))).chunk(
                2, 1
            )
        rate = intersection_area_rates(self.candidate_surfaces, cuts, stage.vertices)
        count = len(self.tx)
        return [
            CoverageBoundaryPaths(
                torch.arange(count).repeat_interleave(len(rate)),
                cuts.point.repeat(count, 1),
                cuts.receiving_face.repeat(count),
                ((behind - beside) * rate[:, None]).flatten(0, 1),
            )
        ]


def _detach_stage(stage: PathScene, points: Tensor) -> PathScene:
    """The stage without derivatives of places, with other receivers."""
    return replace(
        stage,
        vertices=strip_derivatives(stage.vertices),
        velocities=None,
        tx=strip_derivatives(stage.tx),
        rx=points,
        rx_velocity=torch.zeros_like(points),
    )


@dataclass(frozen=True)
class IntersectionCurvePoints:
    """Points on curves where the scene cuts a screen; detached.

    Attributes:
        point: The points [m].
        face: Triangles of the scene.
        receiving_face: Triangles of the screen.
        across: Unit vectors in the screen across the curve, to the side of the normal.
        normal: Of the scene's triangles.
        weight: Length of curve that a point stands for, over n·aside [m].
    """

    point: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    receiving_face: Int64[Tensor, " row"]
    across: Float64[Tensor, "row 3"]
    normal: Float64[Tensor, "row 3"]
    weight: Float64[Tensor, " row"]


def sample_intersection_curves(
    candidate_surfaces: CandidateSurfaces,
    receiving_surface: ReceivingSurface,
    joint_topology: Topology,
    samples: int,
    seed: int,
) -> IntersectionCurvePoints:
    """Points spread evenly over all curves where the scene cuts a screen.

    Args:
        candidate_surfaces: The scene.
        receiving_surface: The screen.
        joint_topology: The scene's triangles, and those of the screen after them.
        samples: Points.
        seed: Of the points.
    """
    vertices = candidate_surfaces.exact_vertices + candidate_surfaces.origin
    corners = vertices[candidate_surfaces.topology.faces]
    face, on_screen = find_overlapping_pairs(corners, receiving_surface.corners)
    points = torch.cat([vertices, receiving_surface.vertices])
    met = intersect_triangles(points, joint_topology, face, on_screen + len(corners))
    span = met.end - met.start
    row, along, weight = sample_along_curves(span.norm(dim=1), samples, seed)
    face, on_screen = met.first[row], met.second[row] - len(corners)
    normal, up = (
        _triangle_normals(corners[face]),
        _triangle_normals(receiving_surface.corners[on_screen]),
    )
    aside = normalize(normal - dot(normal, up)[:, None] * up, dim=1)
    return IntersectionCurvePoints(
        met.start[row] + along[:, None] * span[row],
        face,
        on_screen,
        aside,
        normal,
        weight * span[row].norm(dim=1) / dot(normal, aside),
    )


def intersection_area_rates(
    candidate_surfaces: CandidateSurfaces,
    points: IntersectionCurvePoints,
    vertices: Float64[Tensor, "v 3"],
) -> Float64[Tensor, " row"]:
    """Area that the side of the normal loses, of each point's share; zero in value, attached [m²].

    Args:
        candidate_surfaces: The scene.
        points: The points.
        vertices: Of the scene in the world, attached [m].
    """
    corners = vertices[candidate_surfaces.topology.faces[points.face]]
    a, b, c = strip_derivatives(corners).unbind(1)
    area = cross(b - a, c - a)
    square = dot(area, area)
    v = dot(cross(b - a, points.point - a), area) / square
    u = dot(cross(points.point - a, c - a), area) / square
    share = torch.stack([1 - u - v, u, v], 1)
    material = (share[..., None] * corners).sum(1)
    return dot(points.normal, material - strip_derivatives(material)) * points.weight


def _triangle_normals(corners: Tensor) -> Tensor:
    a, b, c = corners.unbind(1)
    return normalize(cross(b - a, c - a), dim=1)
