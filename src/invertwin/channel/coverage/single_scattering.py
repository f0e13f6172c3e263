"""Single scattering at rough surfaces with specular reflections before and after it.

A path is reflected, or passes sheets, on the leg to a point of a rough surface, and again on the
leg from there. With one coefficient for each leg,

    P = ∫ (4π/λ)² |a_out|² |a_in|² f |cosθ| |cosθ'| dA,

    summed over all pairs of legs with at least one reflection. Those without one are power paths of
    one bounce (``channel.power``). Points are material points, so that motion adds boundary paths:
    a region that one leg illuminates ends at the boundaries of ``shadow_boundaries``, where the
    integrand jumps.

Source: derivations §3, §10 and §11.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.utils.checkpoint import checkpoint

from invertwin.channel.coherent.radar_equation import (
    MaterialPoints,
    SurfacePaths,
    evaluate_scattering,
)
from invertwin.channel.coverage.shadow_boundaries import (
    ReceivingTriangles,
    evaluate_illumination_boundary,
    sample_illumination_boundaries,
)
from invertwin.channel.em.plane_waves import dot, triangle_normals
from invertwin.channel.paths import Link
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.intersections import find_intersection_curves
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.rays.scene_tables import Geometry, flatten
from invertwin.channel.rows import Rows
from invertwin.channel.sampling import Sampling
from invertwin.channel.specular import image_method
from invertwin.channel.specular.candidates import enumerate_sequences, shoot_sequences_from_edges
from invertwin.channel.specular.ray_paths import REFLECTION, RayPaths, join_ray_paths, match_rows
from invertwin.channel.specular.trace_paths import (
    PathScene,
    evaluate_paths,
    face_interactions,
    prepare_path_scene,
)
from invertwin.checks import ArrayLike, is_differentiated, strip_derivatives
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.deprecation import rename_arguments
from invertwin.errors import InputError
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene import Isotropic
from invertwin.scene.scene import Scene

_POINTS_AT_ONCE = 1 << 14
_RAYS_PER_POINT = 16  # rays of power paths at the cost of one point
_PLASTIC_STEPS = 0.754_877_666_246_692_8, 0.569_840_290_998_053_3  # of the R2 sequence

#: Function of paths from transmitters and from receivers to the same points, the depolarised
#: fraction of power there, and the positions of transmitters and receivers; returns the values that
#: each pair contributes, ``[pair, amount]``.
PathPairMeasure = Callable[[RayPaths, RayPaths, Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class _ScatteringPoints(Rows):
    """Points on rough surfaces, one row each; detached.

    Attributes:
        receiver: number of the receiver of each point.
        points: positions of the points, and the area that each represents.
    """

    receiver: Int64[Tensor, " row"]
    points: SurfacePaths


#: Paths to points from transmitters, and from receivers; detached.
_PathLegs = tuple[list[image_method.SpecularPaths], list[image_method.SpecularPaths]]


@rename_arguments(rough="scattering_scene", width="value_count")
def trace_single_scattering(
    scene: Scene,
    scattering_scene: Scene,
    tx: ArrayLike,
    rx: ArrayLike,
    frequency: float,
    measure: PathPairMeasure,
    value_count: int,
    *,
    rays: int | None,
    sampling: Sampling,
    seed: int,
) -> Float64[Tensor, "tx rx amount"]:
    """Sum the values of paths with one scattering and at least one reflection before or after it.

    One point is sampled for every 16 of ``sampling.samples``, shared by all receivers.

    Args:
        scene: scene that reflects, transmits and occludes.
        scattering_scene: the same objects with their scattering laws.
        tx: transmitter positions, [tx, 3], in world axes [m].
        rx: receiver positions, [rx, 3], in world axes [m].
        frequency: carrier frequency [Hz].
        measure: values that a pair of legs contributes, over the area and the scattering law of its
            point.
        value_count: number of values per pair.
        rays: number of rays from all transmitters together, and from all receivers, to find
            sequences of surfaces; None tests every one.
        sampling: numbers of points and of edge points, boundary paths and contacts; ``depth`` is
            the maximum number of surfaces on a path, the rough one included.
        seed: random seed of all samples.

    Raises:
        InputError: derivatives with respect to motion where a surface touches or intersects one
            that scatters.
    """
    stage = replace(prepare_path_scene(scene, tx, rx, frequency), velocities=None)
    with tracing(sampling.backend), torch_threads(1):
        geometry = flatten(scattering_scene, SPEED_OF_LIGHT / frequency)
        trace = _SingleScatteringTracer(stage, geometry, measure, value_count, rays, sampling, seed)
        if not trace.is_scattering.any() or not any(
            map(len, trace.sequences[0] + trace.sequences[1])
        ):
            return torch.zeros(len(stage.tx), len(stage.rx), value_count, dtype=torch.float64)
        total = trace.sum_interior(stage, geometry)
        deforms = is_differentiated(stage.vertices)
        moves = deforms or is_differentiated(stage.tx) or is_differentiated(stage.rx)
        if sampling.boundary and sampling.boundary_samples and moves:
            if deforms and sampling.contacts:
                _require_no_contact(geometry, stage, trace.is_scattering)
            total = total + trace.sum_boundary(stage, geometry)
    return total


class _SingleScatteringTracer:
    """Finds specular legs to rough surfaces and sums the values of their pairs."""

    def __init__(
        self,
        stage: PathScene,
        geometry: Geometry,
        measure: PathPairMeasure,
        value_count: int,
        rays: int | None,
        sampling: Sampling,
        seed: int,
    ) -> None:
        self.measure, self.value_count, self.depth = measure, value_count, sampling.depth
        self.sampling, self.seed = sampling, seed
        self.antennas = strip_derivatives(stage.tx), strip_derivatives(stage.rx)
        self.powers = face_interactions(stage)
        # Discrete: `torch.func` would claim the intermediate tensors.
        with _DisableFuncTorch():
            rows = strip_derivatives(geometry.surfaces.diffuse) > 0
            rows |= (strip_derivatives(geometry.surfaces.lobes) > 0).any(1)
            rows &= (strip_derivatives(geometry.surfaces.amplitude) > 0).any(1)
            self.is_scattering: Bool[Tensor, " f"] = rows[geometry.face_surface]
            vertices, ends = strip_derivatives(stage.vertices), torch.cat(self.antennas)
            self.surfaces = image_method.CandidateSurfaces(vertices, stage.topology, ends)
            self.sequences = tuple(self._find_sequences(number, rays) for number in range(2))

    def _find_sequences(self, end: int, rays: int | None) -> tuple[Tensor, ...]:
        """Find candidate sequences from antennas of one end to rough points, by length from 1."""
        most = self.depth - 1
        if most < 1 or not bool(self.powers.reflect.any()):
            return ()
        if rays is None:
            found = enumerate_sequences(self.surfaces.planes, self.powers, most).steps
            return tuple(steps for steps in found if len(steps))
        origins = self.antennas[end][torch.arange(rays) % len(self.antennas[end])]
        prefix = torch.zeros(rays, dtype=torch.int64)
        columns = shoot_sequences_from_edges(
            self.surfaces, self.powers, origins, prefix, most, self.seed + end
        )
        return tuple(steps[:, 1:] for steps in columns if len(steps))

    def sum_interior(self, stage: PathScene, geometry: Geometry) -> Float64[Tensor, "tx rx amount"]:
        """Sum over points at fixed visibility; derivatives recompute the paths (checkpointing)."""
        with _DisableFuncTorch():
            vertices = strip_derivatives(geometry.vertices)
            samples = self._sample_points(replace(geometry, vertices=vertices))
        recompute = any(t.requires_grad for t in (stage.vertices, stage.tx, stage.rx))
        total = torch.zeros(len(stage.tx), len(stage.rx), self.value_count, dtype=torch.float64)
        for rows in torch.arange(len(samples.receiver)).split(_POINTS_AT_ONCE):
            part = samples.select(rows)
            positions = strip_derivatives(part.points.material_points(geometry)[0].position)
            face = part.points.face[:, 0]
            with _DisableFuncTorch():
                legs = (
                    self._find_legs(0, positions, None, face),
                    self._find_legs(1, positions, part.receiver, face),
                )

            def sum_part(part: _ScatteringPoints = part, legs: _PathLegs = legs) -> Tensor:
                point = part.points.material_points(geometry)[0]
                area = part.points.weight * point.jacobian
                link, _, amount = self._evaluate_pairs(stage, geometry, legs, point, area)
                return self._sum_links(link, amount)

            total = total + (checkpoint(sum_part, use_reentrant=False) if recompute else sum_part())
        return total

    def sum_boundary(self, stage: PathScene, geometry: Geometry) -> Float64[Tensor, "tx rx amount"]:
        """Sum over the moving boundaries of illuminated regions; zero in value."""
        samples, receivers = self.sampling.boundary_samples, len(stage.rx)
        total = torch.zeros(len(stage.tx), receivers, self.value_count, dtype=torch.float64)
        corners = stage.vertices[stage.topology.faces]
        for end, count in enumerate((samples, -(-samples // receivers))):
            with _DisableFuncTorch():
                receiver, depth = ReceivingTriangles(self.is_scattering), self.depth - 1
                search = receiver, self.antennas[end], self.sequences[end], self.powers
                samples_by_length = sample_illumination_boundaries(
                    self.surfaces, *search, depth=depth, samples=count, seed=self.seed + 2 + end
                )
            for boundary_samples in samples_by_length:
                moving = (stage.tx, stage.rx)[end], stage.vertices
                boundary = evaluate_illumination_boundary(
                    self.surfaces, corners, boundary_samples, *moving
                )
                if not len(boundary.face):
                    continue
                with _DisableFuncTorch():
                    # Boundary points of a transmitter are assigned to the receivers in turn.
                    receiver = None if end else boundary.edge_point % receivers
                    other_legs = self._find_legs(1 - end, boundary.point, receiver, boundary.face)
                legs = (other_legs, [boundary.paths]) if end else ([boundary.paths], other_legs)
                with torch.no_grad():
                    point = _material_points_at(geometry, boundary.point, boundary.face)
                    area = torch.full((len(boundary.face),), 1.0 if end else receivers).double()
                    found = self._evaluate_pairs(stage.detach(), geometry, legs, point, area)
                link, index, amount = found
                amount = strip_derivatives(amount) * boundary.area_rate[index, None]
                total = total + self._sum_links(link, amount)
        return total

    def _sample_points(self, geometry: Geometry) -> _ScatteringPoints:
        """Sample points evenly over all scattering surfaces, equally many for each receiver."""
        receivers = len(self.antennas[1])
        count = max(1, self.sampling.samples // (_RAYS_PER_POINT * receivers))
        cumulative_area = (face_areas(geometry) * self.is_scattering).cumsum(0)
        generator = np.random.default_rng(np.random.SeedSequence([self.seed, 4]))
        shift, jitter = (torch.from_numpy(generator.random((k, receivers, 1))) for k in (2, 1))
        index = torch.arange(count)
        cumulative = ((index + jitter[0]) / count * cumulative_area[-1]).flatten()
        face = torch.searchsorted(cumulative_area, cumulative, right=True)
        face = face.clamp_max(int(torch.nonzero(self.is_scattering)[-1]))
        steps = zip(shift, _PLASTIC_STEPS, strict=True)
        b1, b2 = (((start + index * step) % 1).flatten() for start, step in steps)
        is_outside = b1 + b2 > 1
        b1, b2 = torch.where(is_outside, 1 - b1, b1), torch.where(is_outside, 1 - b2, b2)
        weight = torch.full_like(cumulative, float(cumulative_area[-1]) / count)
        points = SurfacePaths(face[:, None], b1[:, None], b2[:, None], weight, 0 * weight)
        return _ScatteringPoints(torch.arange(receivers).repeat_interleave(count), points)

    def _find_legs(
        self, end: int, points: Tensor, receiver: Int64[Tensor, " row"] | None, face: Tensor
    ) -> list[image_method.SpecularPaths]:
        """Find paths from all antennas of one end to points, or each from its own antenna."""
        plane, sources = self.surfaces.planes.face_plane, self.antennas[end]
        every = torch.ones(len(points), dtype=torch.int64)
        numbers = [receiver] if receiver is not None else [every * k for k in range(len(sources))]
        found: list[image_method.SpecularPaths] = []
        for steps in (image_method.DIRECT, *self.sequences[end]):
            for antenna_number in numbers:
                used, number = antenna_number.unique(return_inverse=True)
                for part in image_method.find_paths_from(
                    self.surfaces, steps, sources[used], number, points, plane[face]
                ):
                    # A point has no image in its own plane.
                    valid = torch.ones(len(part.target), dtype=torch.bool)
                    if steps.shape[1]:
                        valid = plane[part.faces[:, -1]] != plane[face[part.target]]
                    found.append(replace(part, source=used[part.source]).select(valid))
        return found

    def _evaluate_pairs(
        self,
        stage: PathScene,
        geometry: Geometry,
        path_legs: _PathLegs,
        point: MaterialPoints,
        area: Float64[Tensor, " row"],
    ) -> tuple[Tensor, Tensor, Float64[Tensor, "pair amount"]]:
        """Pairs of legs to the same points: link, point, and values times an area of the point."""
        outbound, inbound = (
            join_ray_paths([part for some in legs for part in evaluate_paths(material, some)])
            for material, legs in zip(
                [_replace_antennas(stage, end, point.position) for end in (stage.tx, stage.rx)],
                path_legs,
                strict=True,
            )
        )
        first, second = match_rows(outbound.rx, inbound.rx, len(area))
        pairs, normal = ((outbound, first), (inbound, second)), strip_derivatives(point.normal)
        side = [dot(normal[leg.rx], strip_derivatives(leg.arrival))[n] > 0 for leg, n in pairs]
        has_reflection = [(leg.kinds == REFLECTION).any(1)[n] for leg, n in pairs]
        kept = outbound.depth[first] + inbound.depth[second] < self.depth
        kept &= (has_reflection[0] | has_reflection[1]) & (side[0] == side[1])
        rows = torch.nonzero(kept)[:, 0]
        outbound, inbound = outbound.select(first[rows]), inbound.select(second[rows])
        index = outbound.rx
        material = point.select(index)
        k = 4 * math.pi * stage.frequency / SPEED_OF_LIGHT
        law = evaluate_scattering(geometry, material, outbound.arrival, inbound.arrival)
        law = k**2 * area[index] * law
        chi = geometry.surfaces.depolarisation[material.row]
        amount = law[:, None] * self.measure(outbound, inbound, chi, stage.tx, stage.rx)
        return outbound.tx * len(self.antennas[1]) + inbound.tx, index, amount

    def _sum_links(self, link: Tensor, amount: Tensor) -> Float64[Tensor, "tx rx amount"]:
        """Sum the values of the pairs of each link."""
        counts = [len(places) for places in self.antennas]
        total = torch.zeros(counts[0] * counts[1], self.value_count, dtype=torch.float64)
        return total.index_add(0, link, amount).unflatten(0, counts)


def _replace_antennas(stage: PathScene, tx: Tensor, rx: Tensor) -> PathScene:
    """Replace the antennas by others at rest."""
    rest = torch.zeros_like(strip_derivatives(tx)), torch.zeros_like(strip_derivatives(rx))
    return replace(stage, tx=tx, rx=rx, tx_velocity=rest[0], rx_velocity=rest[1])


def _material_points_at(
    geometry: Geometry, position: Float64[Tensor, "row 3"], face: Tensor
) -> MaterialPoints:
    """Material points on triangles for the scattering law; at rest."""
    normal = triangle_normals(strip_derivatives(geometry.vertices)[geometry.faces[face]])
    one = torch.ones_like(position[:, 0])
    return MaterialPoints(position, normal, one, geometry.face_surface[face])


def _require_no_contact(
    geometry: Geometry, stage: PathScene, is_scattering: Bool[Tensor, " f"]
) -> None:
    """Raise an error for derivatives where a moving surface touches or intersects a rough one."""
    axes = torch.eye(3, dtype=torch.float64)[None]
    wavelength = SPEED_OF_LIGHT / stage.frequency
    antennas = strip_derivatives(stage.tx)[:1], strip_derivatives(stage.rx)[:1]
    link = Link(*antennas, axes, Isotropic(), Isotropic(), wavelength, shared_visibility=False)
    with _DisableFuncTorch():
        curves = find_intersection_curves(RayScene(geometry, link))
    if curves is None:
        return
    rows = torch.nonzero(is_scattering[curves.first] | is_scattering[curves.second])[:, 0]
    if len(rows):
        pair = (int(geometry.face_object[side[rows[0]]]) for side in (curves.first, curves.second))
        names = " and ".join(geometry.names[number] for number in pair)
        raise InputError(
            "expected a gap between surfaces that move past each other where one scatters "
            f"reflected power, got {names} in contact; leave a gap of a millimetre, or give "
            "contacts=False in the rough Sampling, which leaves out the derivative there"
        )
