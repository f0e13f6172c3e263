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
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.utils.checkpoint import checkpoint

from invertwin.channel.coherent import radar_equation
from invertwin.channel.coherent.multibounce_po import sample_surface_points
from invertwin.channel.coverage import shadow_boundaries
from invertwin.channel.em.plane_waves import dot, triangle_normals
from invertwin.channel.paths import Link
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.intersections import find_intersection_curves
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.rays.scene_tables import Geometry, flatten
from invertwin.channel.rows import Rows
from invertwin.channel.sampling import Sampling
from invertwin.channel.specular import image_method, trace_paths
from invertwin.channel.specular.candidates import enumerate_sequences, shoot_sequences_from_edges
from invertwin.channel.specular.ray_paths import REFLECTION, RayPaths, join_ray_paths, match_rows
from invertwin.channel.specular.trace_paths import PathScene, evaluate_paths, face_interactions
from invertwin.checks import ArrayLike, is_differentiated, strip_derivatives
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene import Isotropic, Material, ScatteringLaw
from invertwin.scene.scene import Scene

POINTS_AT_ONCE = 1 << 14
_RAYS_PER_POINT = 16  # rays of power paths at the cost of one point
_BALANCED_SHARE = 0.5  # of the points that all objects get alike, whatever their area

#: Function of paths from transmitters and from receivers to the same points, the depolarised
#: fraction of power there, and the positions of transmitters and receivers; returns the values that
#: each pair contributes, ``[pair, amount]``.
PathPairMeasure = Callable[[RayPaths, RayPaths, Tensor, Tensor, Tensor], Tensor]

Pairing = Literal["all", "frames", "monostatic"]
"""Antennas that belong together: each transmitter with all receivers, with the receiver of its
number, or with that one where both share every visibility test (from the transmitter)."""


@dataclass(frozen=True)
class ScatteredPairs(Rows):
    """Pairs of legs from the antennas to the same points of scattering surfaces, one row each.

    Attributes:
        outbound, inbound: legs to the point from the transmitter, and from the receiver.
        weight: (4π/λ)² f |cosθ| |cosθ'| times the area that the point stands for; on a boundary,
            times the area newly illuminated: zero in value, with its derivative.
        depolarisation: fraction of the scattered power converted between V and H.
    """

    outbound: RayPaths
    inbound: RayPaths
    weight: Float64[Tensor, " pair"]
    depolarisation: Float64[Tensor, " pair"]


@dataclass(frozen=True)
class ScatteringPoints(Rows):
    """Points on scattering surfaces, one row each; detached.

    Attributes:
        antenna: number of the receiver of each point, or of the pair of antennas.
        points: positions of the points, and the area that each represents.
    """

    antenna: Int64[Tensor, " row"]
    points: radar_equation.SurfacePaths


#: Paths to points from transmitters, and from receivers; detached.
PathLegs = tuple[list[image_method.SpecularPaths], list[image_method.SpecularPaths]]


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
            the maximum number of reflections on a path, the rough one included.
        seed: random seed of all samples.

    Raises:
        InputError: derivatives with respect to motion where a surface touches or intersects one
            that scatters.
    """
    stage = replace(trace_paths.prepare_path_scene(scene, tx, rx, frequency), velocities=None)
    counts = len(stage.tx), len(stage.rx)

    def sum_links(pairs: ScatteredPairs) -> Tensor:
        amount = measure(pairs.outbound, pairs.inbound, pairs.depolarisation, stage.tx, stage.rx)
        link = pairs.outbound.tx * counts[1] + pairs.inbound.tx
        total = torch.zeros(counts[0] * counts[1], value_count, dtype=torch.float64)
        return total.index_add(0, link, pairs.weight[:, None] * amount).unflatten(0, counts)

    with tracing(sampling.backend), torch_threads(1):
        geometry = flatten(scattering_scene, SPEED_OF_LIGHT / frequency)
        drawn = replace(sampling, samples=max(1, sampling.samples // _RAYS_PER_POINT))
        tracer = SingleScatteringTracer(stage, geometry, rays, drawn, seed)
        total = tracer.sum_pairs(stage, geometry, sum_links)
    return torch.zeros(*counts, value_count, dtype=torch.float64) if total is None else total


def without_specular(scene: Scene, names: Collection[str]) -> Scene:
    """Replace materials by their incoherent part, which scatters and does not mirror.

    Args:
        scene: scene with the objects.
        names: names of the objects to replace.
    """
    for name in names:
        scene = scene.replace(name, material=IncoherentMaterial(scene[name].material))
    return scene


@dataclass(frozen=True)
class IncoherentMaterial(Material):
    """Scattering of a material without its coherent specular reflection.

    Attributes:
        base: the material.
    """

    base: Material

    @property
    def faces(self) -> int | None:
        """Number of triangles of its values; None if they hold for any."""
        return self.base.faces

    def scattering_law(self, frequency: float) -> ScatteringLaw:
        """Return the incoherent part of the law. See ``Material.incoherent_law``."""
        return self.base.incoherent_law(frequency)


class SingleScatteringTracer:
    """Finds specular legs to scattering surfaces and sums over their pairs.

    Args:
        stage: scene that reflects, transmits and occludes, with the antennas.
        geometry: the same objects with their scattering laws.
        rays: number of rays of the search for sequences; None tests every one.
        sampling: as of ``trace_single_scattering``, with one sample for each point.
        seed: random seed of all samples.
        pairing: antennas that belong together.
    """

    def __init__(
        self,
        stage: PathScene,
        geometry: Geometry,
        rays: int | None,
        sampling: Sampling,
        seed: int,
        pairing: Pairing = "all",
    ) -> None:
        self.depth, self.sampling, self.seed, self.pairing = sampling.depth, sampling, seed, pairing
        self.antennas = strip_derivatives(stage.tx), strip_derivatives(stage.rx)
        interactions = face_interactions(stage)
        # Discrete: `torch.func` would claim the intermediate tensors.
        with _DisableFuncTorch():
            rows = strip_derivatives(geometry.surfaces.diffuse) > 0
            rows |= (strip_derivatives(geometry.surfaces.lobes) > 0).any(1)
            rows &= (strip_derivatives(geometry.surfaces.amplitude) > 0).any(1)
            self.is_scattering: Bool[Tensor, " f"] = rows[geometry.face_surface]
            vertices, ends = strip_derivatives(stage.vertices), torch.cat(self.antennas)
            self.surfaces = image_method.CandidateSurfaces(
                vertices, stage.topology, ends, interactions
            )
            self.sequences = tuple(self._find_sequences(number, rays) for number in range(2))

    def _find_sequences(self, end: int, rays: int | None) -> tuple[Tensor, ...]:
        """Find candidate sequences from antennas of one end to rough points, by length from 1."""
        most = self.depth - 1
        if most < 1 or not bool(self.surfaces.interactions.reflect.any()):
            return ()
        if rays is None:
            found = enumerate_sequences(self.surfaces, most).steps
            return tuple(steps for steps in found if len(steps))
        origins = self.antennas[end][torch.arange(rays) % len(self.antennas[end])]
        prefix = torch.zeros(rays, dtype=torch.int64)
        columns = shoot_sequences_from_edges(self.surfaces, origins, prefix, most, self.seed + end)
        return tuple(steps[:, 1:] for steps in columns if len(steps))

    def sum_pairs(
        self, stage: PathScene, geometry: Geometry, reduce: Callable[[ScatteredPairs], Tensor]
    ) -> Tensor | None:
        """Sum over sampled points, and over boundaries where something moves; None without paths.

        Args:
            stage: as given, with derivatives.
            geometry: as given, with derivatives.
            reduce: sum of the values of some pairs, of one shape whatever their number.

        Raises:
            InputError: derivatives where a moving surface touches one that scatters.
        """
        if not self.is_scattering.any() or not any(map(len, self.sequences[0] + self.sequences[1])):
            return None
        total = self._sum_interior(stage, geometry, reduce)
        deforms, sampling = is_differentiated(stage.vertices), self.sampling
        moves = deforms or is_differentiated(stage.tx) or is_differentiated(stage.rx)
        if sampling.boundary and sampling.boundary_samples and moves:
            if deforms and sampling.contacts:
                _require_no_contact(geometry, stage, self.is_scattering)
            for part in self._boundary_pairs(stage, geometry):
                total = total + reduce(part)
        return total

    def _sum_interior(
        self, stage: PathScene, geometry: Geometry, reduce: Callable[[ScatteredPairs], Tensor]
    ) -> Tensor:
        """Sum over points at fixed visibility; derivatives recompute the paths (checkpointing)."""
        with _DisableFuncTorch():
            vertices = strip_derivatives(geometry.vertices)
            samples = self.sample_points(replace(geometry, vertices=vertices))
        recompute = any(t.requires_grad for t in (stage.vertices, stage.tx, stage.rx))
        recompute &= len(samples.antenna) > POINTS_AT_ONCE
        total: Tensor | float = 0.0
        for rows in torch.arange(len(samples.antenna)).split(POINTS_AT_ONCE):
            part = samples.select(rows)
            legs = self.find_legs(part, geometry)

            def sum_part(part: ScatteringPoints = part, legs: PathLegs = legs) -> Tensor:
                point = part.points.material_points(geometry)[0]
                area = part.points.weight * point.jacobian
                return reduce(self.evaluate_pairs(stage, geometry, legs, point, area)[0])

            total = total + (checkpoint(sum_part, use_reentrant=False) if recompute else sum_part())
        assert isinstance(total, Tensor)
        return total

    def _boundary_pairs(self, stage: PathScene, geometry: Geometry) -> Iterator[ScatteredPairs]:
        """Pairs at the moving boundaries of illuminated regions; zero in value."""
        antennas, paired = len(stage.rx), self.pairing != "all"
        corners = stage.vertices[stage.topology.faces]
        for end in range(1 if self.pairing == "monostatic" else 2):
            count = -(-self.sampling.boundary_samples // (antennas if end or paired else 1))
            with _DisableFuncTorch():
                receiver = shadow_boundaries.ReceivingTriangles(self.is_scattering)
                depth = self.depth - 1
                search = receiver, self.antennas[end], self.sequences[end]
                samples_by_length = shadow_boundaries.sample_illumination_boundaries(
                    self.surfaces, *search, depth=depth, samples=count, seed=self.seed + 2 + end
                )
            for boundary_samples in samples_by_length:
                moving = (stage.tx, stage.rx)[end], stage.vertices
                boundary = shadow_boundaries.evaluate_illumination_boundary(
                    self.surfaces, corners, boundary_samples, *moving
                )
                if not len(boundary.face):
                    continue
                own, spread = [boundary.paths], 1.0
                with _DisableFuncTorch():
                    antenna = boundary.paths.source if paired else None
                    if not end and not paired:
                        # Boundary points of a transmitter are assigned to the receivers in turn.
                        antenna, spread = boundary.edge_point % antennas, float(antennas)
                    where = boundary.point, antenna, boundary.face
                    shared = self.pairing == "monostatic"
                    others = self._find_legs(0 if shared else 1 - end, *where)
                    if shared:
                        # One boundary of both legs: it passes with each other leg, and with itself.
                        others = [self._drop_same(part, boundary.paths) for part in others]
                both: list[PathLegs] = [(own, [*others, *own] if shared else others)]
                both += [(others, own)] if shared else []
                for legs in both:
                    with torch.no_grad():
                        point = _material_points_at(geometry, boundary.point, boundary.face)
                        area = torch.full((len(boundary.face),), spread).double()
                        ordered = (legs[1], legs[0]) if end else legs
                        found = self.evaluate_pairs(stage.detach(), geometry, ordered, point, area)
                    pairs, index = found
                    weight = strip_derivatives(pairs.weight) * boundary.area_rate[index]
                    yield replace(pairs, weight=weight)

    def _drop_same(
        self, legs: image_method.SpecularPaths, own: image_method.SpecularPaths
    ) -> image_method.SpecularPaths:
        """Legs to points on boundaries without those whose boundary it is."""
        if legs.faces.shape[1] != own.faces.shape[1]:
            return legs
        plane = self.surfaces.planes.face_plane
        same = plane[legs.faces] == plane[own.faces[legs.target]]
        same &= legs.transmitted == own.transmitted[legs.target]
        return legs.select(~same.all(1))

    def sample_points(self, geometry: Geometry) -> ScatteringPoints:
        """Sample points on all scattering surfaces, equally many for each receiver.

        Half of them are spread evenly, and half get every object alike, so that a small one beside
        a large wall has some.

        Args:
            geometry: surfaces, detached.
        """
        areas, owner = face_areas(geometry) * self.is_scattering, geometry.face_object
        owned = torch.zeros(len(geometry.names), dtype=torch.float64).index_add(0, owner, areas)
        even, alike = 1 / areas.sum(), 1 / (owned.clamp_min(1e-300) * (owned > 0).sum())[owner]
        density = (1 - _BALANCED_SHARE) * even + _BALANCED_SHARE * alike
        antennas = len(self.antennas[1])
        count = max(1, self.sampling.samples // antennas) * antennas
        points = sample_surface_points(areas * density, count, self.seed)
        weight = points.weight * antennas / density[points.face[:, 0]]
        return ScatteringPoints(torch.arange(count) % antennas, replace(points, weight=weight))

    def find_legs(self, part: ScatteringPoints, geometry: Geometry) -> PathLegs:
        """Find the legs of both ends to points, at fixed visibility.

        Args:
            part: points.
            geometry: triangles of the points.
        """
        with _DisableFuncTorch():
            position = strip_derivatives(part.points.material_points(geometry)[0].position)
            face = part.points.face[:, 0]
            antenna = None if self.pairing == "all" else part.antenna
            outbound = self._find_legs(0, position, antenna, face)
            if self.pairing == "monostatic":
                return outbound, outbound
            return outbound, self._find_legs(1, position, part.antenna, face)

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

    def evaluate_pairs(
        self,
        stage: PathScene,
        geometry: Geometry,
        path_legs: PathLegs,
        point: radar_equation.MaterialPoints,
        area: Float64[Tensor, " row"],
    ) -> tuple[ScatteredPairs, Int64[Tensor, " pair"]]:
        """Pair the legs to the same points on one side, with a reflection on one of them.

        Args:
            stage: scene and antennas.
            geometry: surfaces with their scattering laws.
            path_legs: legs to the points, as of ``find_legs``.
            point: the points.
            area: area that each stands for [m²].

        Returns:
            The pairs, and the number of the point of each.
        """
        found = []
        for end, legs in zip((stage.tx, stage.rx), path_legs, strict=True):
            local = _replace_antennas(stage, end, point.position)
            found.append(join_ray_paths([p for some in legs for p in evaluate_paths(local, some)]))
        outbound, inbound = found
        first, second = match_rows(outbound.rx, inbound.rx, len(area))
        ends, normal = ((outbound, first), (inbound, second)), strip_derivatives(point.normal)
        side = [dot(normal[leg.rx], strip_derivatives(leg.arrival))[n] > 0 for leg, n in ends]
        reflections = [(leg.kinds == REFLECTION).sum(1)[n] for leg, n in ends]
        total = reflections[0] + reflections[1]
        kept = (total > 0) & (total < self.depth) & (side[0] == side[1])
        rows = torch.nonzero(kept)[:, 0]
        outbound, inbound = outbound.select(first[rows]), inbound.select(second[rows])
        index = outbound.rx
        material = point.select(index)
        k = 4 * math.pi * stage.frequency / SPEED_OF_LIGHT
        law = radar_equation.evaluate_scattering(
            geometry, material, outbound.arrival, inbound.arrival
        )
        chi = geometry.surfaces.depolarisation[material.row]
        return ScatteredPairs(outbound, inbound, k**2 * area[index] * law, chi), index


def scattered_power(
    outbound: RayPaths,
    inbound: RayPaths,
    sent: Complex128[Tensor, "pair t 2"],
    received: Complex128[Tensor, "pair r 2"],
    depolarisation: Float64[Tensor, " pair"],
) -> Float64[Tensor, " pair"]:
    """Power that arrives by pairs of legs from a scatterer of unit weight.

    It is the mean over the elements of both antennas.

    Args:
        outbound, inbound: legs to the scatterer from the transmitter, and from the receiver.
        sent: amplitudes of the transmitter's elements along the legs, in V and H.
        received: those of the receiver's.
        depolarisation: fraction of the power that the scatterer converts between V and H.
    """
    ends = _stokes(outbound, sent), _stokes(inbound, received)
    whole, q, u, v = (0.5 * ends[0] * ends[1]).unbind(1)
    return whole + (1 - 2 * depolarisation) * (q + u) - (1 - 4 * depolarisation) * v


def _stokes(legs: RayPaths, fields: Tensor) -> Tensor:
    """Mean Stokes parameters, over the elements of an antenna, at the far ends of legs."""
    field = torch.einsum("pij,pej->pei", legs.coefficient, fields)
    power = torch.view_as_real(field).square().sum(-1)
    both = field[..., 0] * field[..., 1].conj()
    first, second = power.unbind(-1)
    return torch.stack([first + second, first - second, 2 * both.real, 2 * both.imag], -1).mean(1)


def _replace_antennas(stage: PathScene, tx: Tensor, rx: Tensor) -> PathScene:
    """Replace the antennas by others at rest."""
    rest = torch.zeros_like(strip_derivatives(tx)), torch.zeros_like(strip_derivatives(rx))
    return replace(stage, tx=tx, rx=rx, tx_velocity=rest[0], rx_velocity=rest[1])


def _material_points_at(
    geometry: Geometry, position: Float64[Tensor, "row 3"], face: Tensor
) -> radar_equation.MaterialPoints:
    """Material points on triangles for the scattering law; at rest."""
    normal = triangle_normals(strip_derivatives(geometry.vertices)[geometry.faces[face]])
    one = torch.ones_like(position[:, 0])
    return radar_equation.MaterialPoints(position, normal, one, geometry.face_surface[face])


def _require_no_contact(geometry: Geometry, stage: PathScene, is_scattering: Tensor) -> None:
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
