"""Power that a rough surface scatters once, on ways that smooth surfaces mirror.

A path is mirrored, or passes sheets, on its way to a point of a rough surface, and again on its way
from there. With one coefficient for each way,

    P = ∫ (4π/λ)² |a_out|² |a_home|² f |cosθ| |cosθ'| dA,

summed over all pairs of ways that have a mirror among them. Those without one are power paths of
one bounce (``channel.power``). Points are material points, so what moves adds boundary paths: a
region that one way lights ends at the rims of ``shadow_edges``, and there the integrand jumps.

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
from torch.nn.functional import normalize
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
from invertwin.channel.em.plane_waves import dot
from invertwin.channel.paths import Link
from invertwin.channel.rays.backend import torch_threads, tracing
from invertwin.channel.rays.intersections import find_intersection_curves
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.rays.scene_tables import Geometry, flatten
from invertwin.channel.sampling import Sampling
from invertwin.channel.specular.candidates import enumerate_sequences, shoot_sequences_from_edges
from invertwin.channel.specular.image_method import (
    CandidateSurfaces,
    SpecularPaths,
    find_paths_from,
)
from invertwin.channel.specular.ray_paths import REFLECTION, RayPaths, join_ray_paths, match_rows
from invertwin.channel.specular.trace_paths import (
    PathScene,
    evaluate_paths,
    face_interactions,
    prepare_path_scene,
)
from invertwin.checks import ArrayLike, is_differentiated, strip_derivatives
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene import Isotropic
from invertwin.scene.scene import Scene

_POINTS_AT_ONCE = 1 << 14  # points
_RAYS_PER_POINT = 16  # rays of power paths that cost as much as a point here
_PLASTIC_STEPS = (
    0.754_877_666_246_692_8,
    0.569_840_290_998_053_3,
)  # steps of an even plane sequence

#: Takes ways from transmitters and from receivers to the same points, the share of power that
#: changes its polarisation there, and the places of transmitters and receivers; returns what each
#: pair adds, ``[pair, amount]``.
PathPairMeasure = Callable[[RayPaths, RayPaths, Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class _ScatteringPoints:
    """Points on rough surfaces, one row each; detached.

    Attributes:
        place: Number of the receiver that each is for.
        points: Their places, and the area that each stands for.
    """

    receiver: Int64[Tensor, " row"]
    points: SurfacePaths

    def select(self, rows: Tensor) -> "_ScatteringPoints":
        return _ScatteringPoints(self.receiver[rows], self.points.select(rows))


#: Which ways lead to some points: from transmitters, and from receivers; detached.
_PathLegs = tuple[list[SpecularPaths], list[SpecularPaths]]


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
    """Sums over paths that are scattered once, and mirrored at least once before or after.

    One point is drawn for every 16 of ``sampling.samples``, shared by all receivers.

    Args:
        scene: What mirrors, lets through and hides.
        scattering_scene: The same objects, as they scatter.
        tx: Transmitters [tx, 3] in the world [m].
        rx: Receivers [rx, 3] [m].
        frequency: Of the coefficients [Hz].
        measure: What a pair of ways adds, over the area and the scattering of its point.
        value_count: Numbers that it adds.
        rays: Shot from all transmitters together, and from all receivers, to find sequences of
            surfaces; None tries every one.
        sampling: How many points and, for derivatives, edge points; whether boundary paths and
            contacts count; ``depth``: most surfaces that a path meets, the rough one included.
        seed: Of all that is drawn.

    Raises:
        InputError: A derivative by what moves where a surface touches or cuts one that scatters.
    """
    still = (0.0, 0.0, 0.0)
    stage = replace(prepare_path_scene(scene, tx, rx, frequency, still, still), velocities=None)
    with tracing(sampling.backend), torch_threads(1):
        geometry = flatten(scattering_scene, SPEED_OF_LIGHT / frequency)
        trace = _SingleScatteringTracer(stage, geometry, measure, value_count, rays, sampling, seed)
        if not trace.is_scattering.any() or not any(
            map(len, trace.sequences[0] + trace.sequences[1])
        ):
            return torch.zeros(len(stage.tx), len(stage.rx), value_count, dtype=torch.float64)
        total = trace.sum_interior(stage, geometry)
        shapes = is_differentiated(stage.vertices)
        moved = shapes or is_differentiated(stage.tx) or is_differentiated(stage.rx)
        if sampling.boundary and sampling.boundary_samples and moved:
            if shapes and sampling.contacts:
                _require_no_contact(geometry, stage, trace.is_scattering)
            total = total + trace.sum_boundary(stage, geometry)
    return total


class _SingleScatteringTracer:
    """Which paths there are, and what they are worth."""

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
        # Discrete: to `torch.func`, tensors made on the way would be its own.
        with _DisableFuncTorch():
            rows = strip_derivatives(geometry.surfaces.diffuse) > 0
            rows |= (strip_derivatives(geometry.surfaces.lobes) > 0).any(1)
            rows &= (strip_derivatives(geometry.surfaces.amplitude) > 0).any(1)
            self.is_scattering: Bool[Tensor, " f"] = rows[geometry.face_surface]
            self.candidate_surfaces = CandidateSurfaces(
                strip_derivatives(stage.vertices), stage.topology, torch.cat(self.antennas)
            )
            self.sequences = tuple(self._find_sequences(number, rays) for number in range(2))

    def _find_sequences(self, end: int, rays: int | None) -> tuple[Tensor, ...]:
        """What may lie between antennas of one end and rough points, by length from 1."""
        planes, most = self.candidate_surfaces.planes, self.depth - 1
        if most < 1 or not bool(self.powers.reflect.any()):
            return ()
        if rays is None:
            found = enumerate_sequences(planes, self.powers, most).steps
            return tuple(steps for steps in found if len(steps))
        starts = self.antennas[end][torch.arange(rays) % len(self.antennas[end])]
        alike = torch.zeros(rays, dtype=torch.int64)
        drawn = shoot_sequences_from_edges(
            self.candidate_surfaces, planes, self.powers, starts, alike, most, self.seed + end
        )
        return tuple(steps[:, 1:] for steps in drawn if len(steps))

    def sum_interior(self, stage: PathScene, geometry: Geometry) -> Float64[Tensor, "tx rx amount"]:
        """At fixed visibility; a derivative computes the paths again, and keeps none."""
        with _DisableFuncTorch():
            drawn = self._sample_points(
                replace(geometry, vertices=strip_derivatives(geometry.vertices))
            )
        again = any(t.requires_grad for t in (stage.vertices, stage.tx, stage.rx))
        total = torch.zeros(len(stage.tx), len(stage.rx), self.value_count, dtype=torch.float64)
        for rows in torch.arange(len(drawn.receiver)).split(_POINTS_AT_ONCE):
            part = drawn.select(rows)
            places = strip_derivatives(part.points.material_points(geometry)[0].position)
            face = part.points.face[:, 0]
            with _DisableFuncTorch():
                chains = (
                    self._find_legs(0, places, None, face),
                    self._find_legs(1, places, part.receiver, face),
                )

            def found(part: _ScatteringPoints = part, chains: _PathLegs = chains) -> Tensor:
                point = part.points.material_points(geometry)[0]
                area = part.points.weight * point.jacobian
                return self._sum_pairs(self._evaluate_pairs(stage, geometry, chains, point, area))

            total = total + (checkpoint(found, use_reentrant=False) if again else found())
        return total

    def sum_boundary(self, stage: PathScene, geometry: Geometry) -> Float64[Tensor, "tx rx amount"]:
        """What the moving rims of all regions add that ways light; zero in value."""
        samples, receivers = self.sampling.boundary_samples, len(stage.rx)
        total = torch.zeros(len(stage.tx), receivers, self.value_count, dtype=torch.float64)
        still = replace(
            stage,
            vertices=strip_derivatives(stage.vertices),
            tx=strip_derivatives(stage.tx),
            rx=strip_derivatives(stage.rx),
        )
        corners = stage.vertices[stage.topology.faces]
        for end, count in enumerate((samples, -(-samples // receivers))):
            with _DisableFuncTorch():
                met = sample_illumination_boundaries(
                    self.candidate_surfaces,
                    ReceivingTriangles(self.is_scattering),
                    self.antennas[end],
                    self.sequences[end],
                    self.powers,
                    depth=self.depth - 1,
                    samples=count,
                    seed=self.seed + 2 + end,
                )
            for some in met:
                found = evaluate_illumination_boundary(
                    self.candidate_surfaces,
                    corners,
                    some,
                    (stage.tx, stage.rx)[end],
                    stage.vertices,
                )
                if not len(found.face):
                    continue
                with _DisableFuncTorch():
                    # Rims of a transmitter's regions serve the receivers in turn.
                    place = None if end else found.edge_point % receivers
                    others = self._find_legs(1 - end, found.point, place, found.face)
                chains = (others, [found.paths]) if end else ([found.paths], others)
                with torch.no_grad():
                    point = _material_points_at(geometry, found.point, found.face)
                    share = torch.full((len(found.face),), 1.0 if end else receivers).double()
                    jumps = self._evaluate_pairs(still, geometry, chains, point, share)
                amount = strip_derivatives(jumps.amount) * found.area_rate[jumps.point, None]
                total = total + self._sum_pairs(replace(jumps, amount=amount))
        return total

    def _sample_points(self, geometry: Geometry) -> _ScatteringPoints:
        """As many points for each receiver, spread evenly over all that scatters."""
        receivers = len(self.antennas[1])
        count = max(1, self.sampling.samples // (_RAYS_PER_POINT * receivers))
        reached = (face_areas(geometry) * self.is_scattering).cumsum(0)
        numbers = np.random.default_rng(np.random.SeedSequence([self.seed, 4]))
        shift, jitter = (torch.from_numpy(numbers.random((k, receivers, 1))) for k in (2, 1))
        index = torch.arange(count)
        spot = ((index + jitter[0]) / count * reached[-1]).flatten()
        face = torch.searchsorted(reached, spot, right=True)
        face = face.clamp_max(int(torch.nonzero(self.is_scattering)[-1]))
        b1, b2 = (
            ((start + index * step) % 1).flatten()
            for start, step in zip(shift, _PLASTIC_STEPS, strict=True)
        )
        fold = b1 + b2 > 1
        b1, b2 = torch.where(fold, 1 - b1, b1), torch.where(fold, 1 - b2, b2)
        weight = torch.full_like(spot, float(reached[-1]) / count)
        points = SurfacePaths(face[:, None], b1[:, None], b2[:, None], weight, 0 * weight)
        return _ScatteringPoints(torch.arange(receivers).repeat_interleave(count), points)

    def _find_legs(
        self, end: int, points: Tensor, receiver: Int64[Tensor, " row"] | None, face: Tensor
    ) -> list[SpecularPaths]:
        """From all antennas of one end to points, or to each point from that of its number."""
        plane, sources = self.candidate_surfaces.planes.face_plane, self.antennas[end]
        every = torch.ones(len(points), dtype=torch.int64)
        numbers = [receiver] if receiver is not None else [every * k for k in range(len(sources))]
        found: list[SpecularPaths] = []
        for steps in (torch.zeros(1, 0, dtype=torch.int64), *self.sequences[end]):
            for own in numbers:
                used, number = own.unique(return_inverse=True)
                for some in find_paths_from(
                    self.candidate_surfaces, steps, sources[used], number, points, plane[face]
                ):
                    # A point has no image in its own plane.
                    kept = torch.ones(len(some.target), dtype=torch.bool)
                    if steps.shape[1]:
                        kept = plane[some.faces[:, -1]] != plane[face[some.target]]
                    source, target, faces, through = (c[kept] for c in vars(some).values())
                    found.append(SpecularPaths(used[source], target, faces, through))
        return found

    def _evaluate_pairs(
        self,
        stage: PathScene,
        geometry: Geometry,
        path_legs: _PathLegs,
        point: MaterialPoints,
        area: Float64[Tensor, " row"],
    ) -> "_LegPairs":
        """What all pairs of ways to the same points bring, times an area of each point."""
        out, home = (
            join_ray_paths([part for some in legs for part in evaluate_paths(here, some)])
            for here, legs in zip(
                [_replace_antennas(stage, end, point.position) for end in (stage.tx, stage.rx)],
                path_legs,
                strict=True,
            )
        )
        first, second = match_rows(out.rx, home.rx, len(area))
        mirrors, steps, side = (
            (values[0][first], values[1][second])
            for values in (
                [(leg.kinds == REFLECTION).any(1) for leg in (out, home)],
                [leg.depth for leg in (out, home)],
                [
                    dot(strip_derivatives(point.normal)[leg.rx], strip_derivatives(leg.arrival)) > 0
                    for leg in (out, home)
                ],
            )
        )
        kept = (mirrors[0] | mirrors[1]) & (steps[0] + steps[1] < self.depth)
        rows = torch.nonzero(kept & (side[0] == side[1]))[:, 0]
        out, home = out.select(first[rows]), home.select(second[rows])
        at = out.rx
        here = MaterialPoints(
            point.position[at], point.normal[at], point.jacobian[at], point.row[at]
        )
        k = 4 * math.pi * stage.frequency / SPEED_OF_LIGHT
        law = k**2 * area[at] * evaluate_scattering(geometry, here, out.arrival, home.arrival)
        turned = geometry.surfaces.depolarisation[here.row]
        amount = law[:, None] * self.measure(out, home, turned, stage.tx, stage.rx)
        return _LegPairs(out.tx, home.tx, at, amount)

    def _sum_pairs(self, pairs: "_LegPairs") -> Float64[Tensor, "tx rx amount"]:
        """Sums over the pairs of each link."""
        counts = [len(places) for places in self.antennas]
        total = torch.zeros(counts[0] * counts[1], self.value_count, dtype=torch.float64)
        total = total.index_add(0, pairs.tx * counts[1] + pairs.rx, pairs.amount)
        return total.unflatten(0, counts)


@dataclass(frozen=True)
class _LegPairs:
    """Pairs of ways to one point, one row each.

    Attributes:
        tx, rx: Antennas.
        point: Of the point.
        amount: What the pair adds.
    """

    tx: Int64[Tensor, " pair"]
    rx: Int64[Tensor, " pair"]
    point: Int64[Tensor, " pair"]
    amount: Float64[Tensor, "pair amount"]


def _replace_antennas(stage: PathScene, tx: Tensor, rx: Tensor) -> PathScene:
    """The stage with antennas at other places, at rest."""
    still = torch.zeros_like(strip_derivatives(tx)), torch.zeros_like(strip_derivatives(rx))
    return replace(stage, tx=tx, rx=rx, tx_velocity=still[0], rx_velocity=still[1])


def _material_points_at(
    geometry: Geometry, position: Float64[Tensor, "row 3"], face: Tensor
) -> MaterialPoints:
    """Points of triangles as the law of scattering takes them; at rest."""
    a, b, c = strip_derivatives(geometry.vertices)[geometry.faces[face]].unbind(1)
    normal = normalize(torch.linalg.cross(b - a, c - a), dim=1)
    return MaterialPoints(
        position, normal, torch.ones_like(position[:, 0]), geometry.face_surface[face]
    )


def _require_no_contact(
    geometry: Geometry, stage: PathScene, is_scattering: Bool[Tensor, " f"]
) -> None:
    """Refuse derivatives where a surface moves along one that scatters, and touches or cuts it."""
    axes = torch.eye(3, dtype=torch.float64)[None]
    wavelength = SPEED_OF_LIGHT / stage.frequency
    ends = strip_derivatives(stage.tx)[:1], strip_derivatives(stage.rx)[:1]
    link = Link(*ends, axes, Isotropic(), Isotropic(), wavelength, shared_visibility=False)
    with _DisableFuncTorch():
        met = find_intersection_curves(RayScene(geometry, link))
    if met is None:
        return
    rows = torch.nonzero(is_scattering[met.first] | is_scattering[met.second])[:, 0]
    if len(rows):
        pair = (int(geometry.face_object[side[rows[0]]]) for side in (met.first, met.second))
        names = " and ".join(geometry.names[number] for number in pair)
        raise InputError(
            "expected a gap between surfaces that move past each other where one scatters what "
            f"mirrors bring, got {names} that meet; leave a gap of a millimetre, or give "
            "contacts=False in the rough Sampling, which leaves out what moves there"
        )
