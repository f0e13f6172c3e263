"""Silhouette sampling between surfaces: edges that shadow one surface point from another."""

from dataclasses import dataclass
from typing import Any

from invertwin.channel.power.discrete import DiscreteSampler, balance_by_scene, sample_edge_point
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.mesh_folds import is_hidden_by_fold
from invertwin.channel.power.silhouettes import (
    _EDGE_OFFSET,
    _MIN_OPENING,
    _MISS_DISTANCE,
    SampleBatch,
    SilhouetteSample,
    _classify_sides,
    _is_not_grazing,
    _trace_past_edge,
)
from invertwin.channel.rays.arrays import (
    gather_points,
    interpolate_position,
    scramble_seed,
    uniform_pair,
)
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.differentiated_objects import NO_TARGET, DifferentiatedObjects
from invertwin.channel.rays.ray_scene import RayScene


@dataclass(frozen=True)
class ShadowSource:
    """A point from which a shadow is cast."""

    face: Any  # triangle
    b1: Any  # barycentric coordinates
    b2: Any


@dataclass(frozen=True)
class InteriorSilhouetteSample:
    """Points on edges with what lies on both sides of a tangential direction."""

    silhouette: SilhouetteSample  # its weight holds the change of measure from directions to area
    source: ShadowSource  # where the shadow is cast from

    @property
    def size(self) -> int:
        """How many there are."""
        return self.silhouette.size


class InteriorSilhouetteSampler:
    """Points and tangential directions on all edges that can hide one surface from another.

    Edges are weighted by their length, by the angle under which they hide (the opening between
    their triangles' planes) and by how near they are to both antennas; directions are uniform
    over those that are tangential.

    Args:
        rays: The scene and its antennas.
        inputs: Detached tables.
        samples: Points over all frames and scenes.
        seed: Of the points.
        importance_sampling: False takes edges by length alone and directions from the whole
            sphere: what the
            benchmark compares with.
        has_close_surfaces: Whether other surfaces may be close to edges.
    """

    def __init__(
        self,
        rays: RayScene,
        inputs: Inputs,
        samples: int,
        seed: int,
        *,
        importance_sampling: bool = True,
        has_close_surfaces: bool = False,
    ) -> None:
        topology = rays.topology
        self.rays, self.inputs, self.importance_sampling, self.has_close_surfaces = (
            rays,
            inputs,
            importance_sampling,
            has_close_surfaces,
        )
        edge = dr.arange(mi.UInt32, len(topology.edges))
        y0, y1 = rays.exact_ends(edge)
        length = mi.Float(dr.norm(y1 - y0))
        _, span = self._tangential_azimuths(edge, y0, y1)
        weight = dr.select(span > _MIN_OPENING, length, 0.0)
        if importance_sampling:
            middle = mi.Point3f(0.5 * (y0 + y1))
            near, first = mi.Float(0.0), rays.edge_scene(edge) * rays.poses_per_scene
            for look in range(min(rays.poses_per_scene, 8)):
                at = first + look * rays.poses_per_scene // min(rays.poses_per_scene, 8)
                legs = [dr.norm(middle - gather_points(t, at)) + length for t in (rays.tx, rays.rx)]
                near += 1 / (legs[0] * legs[1])
            weight *= span * near
        # Poses of the same number in all scenes share one choice of edges.
        self.samples_per_pose = max(1, samples // rays.poses_per_scene)
        self.size = self.samples_per_pose * rays.poses_per_scene if len(topology.edges) else 0
        if self.size:
            self.choice = DiscreteSampler(balance_by_scene(rays, rays.edge_scene(edge), weight))
        self.seeds = scramble_seed(seed, 4), scramble_seed(seed, 5)
        self.transmission_seeds = scramble_seed(seed, 10), scramble_seed(seed, 11)
        self.aim_seeds = scramble_seed(seed, 12), scramble_seed(seed, 13)

    def _tangential_azimuths(self, edge: Any, y0: Any, y1: Any) -> tuple[Any, Any]:
        """Start and span of the tangential directions' azimuth about the edge, up to sign.

        Azimuths count from the first triangle of the edge. Two triangles at azimuths 0 and α
        leave (α, π); one triangle leaves all; more are left to the test of sides.
        """
        topology = self.rays.topology
        along = dr.normalize(y1 - y0)
        start, span = mi.Float(0.0), mi.Float(dr.pi)
        if len(topology.device_edge_apexes) < 2:
            return start, span
        x, y = self._azimuth_axes(edge, y0, along)
        apex = dr.gather(mi.Int32, topology.device_edge_apexes[1], edge)
        offset = self.rays.exact_vertex(mi.UInt32(dr.maximum(apex, 0))) - y0
        angle = mi.Float(dr.atan2(dr.dot(offset, y), dr.dot(offset, x)))
        turn = dr.abs(angle)
        # Behind a fold the free azimuths are those beyond the second triangle, up to π.
        start = dr.select(apex >= 0, dr.select(angle > 0, turn, 0.0), start)
        span = dr.select(apex >= 0, dr.pi - turn, span)
        unsure = mi.Bool(False)
        for column in topology.device_edge_apexes[2:]:
            unsure |= dr.gather(mi.Int32, column, edge) >= 0
        if self.inputs.surfaces.has_sheets:
            unsure |= self._is_transmissive(edge) & (span > _MIN_OPENING)
        return dr.select(unsure, 0.0, start), dr.select(unsure, dr.pi, span)

    def _is_transmissive(self, edge: Any) -> Any:
        """Whether any triangle of an edge lets something through."""
        inputs, found = self.inputs, mi.Bool(False)
        for column in self.rays.topology.device_edge_faces:
            face = dr.gather(mi.UInt32, column, edge)
            row = dr.gather(mi.UInt32, inputs.face_surface, face)
            found |= inputs.surfaces.interpolate_cosine("transmittance", row, mi.Float(1.0)) > 0
        return found

    def _azimuth_axes(self, edge: Any, y0: Any, along: Any) -> tuple[Any, Any]:
        topology = self.rays.topology
        apex = mi.UInt32(dr.maximum(dr.gather(mi.Int32, topology.device_edge_apexes[0], edge), 0))
        offset = self.rays.exact_vertex(apex) - y0
        x = dr.normalize(offset - along * dr.dot(along, offset))
        return x, dr.cross(along, x)

    def draw(self, index: Any) -> SampleBatch:
        """The samples of the given indices below ``size``; those that hide nothing are void."""
        rays, topology = self.rays, self.rays.topology
        look, within = index // self.samples_per_pose, index % self.samples_per_pose
        edge, along, pmf = sample_edge_point(
            self.choice, within, self.samples_per_pose, self.seeds[0], index
        )
        frame = rays.edge_scene(edge) * rays.poses_per_scene + look
        first, second = (dr.gather(mi.UInt32, ends, edge) for ends in topology.device_edges)
        y0, y1 = rays.exact_ends(edge)
        place = y0 + (y1 - y0) * mi.Float64(along)
        omega, density = self._sample_direction(index, edge, y0, y1)
        if (
            self.importance_sampling
            and rays.differentiated_objects is not None
            and rays.scene_count == 1
        ):
            omega, density = self._aim_at_differentiated(
                rays.differentiated_objects, index, edge, place, omega, density
            )
        exact = mi.Vector3d(omega)
        sides = _classify_sides(rays, self.inputs, edge, exact)
        aside = _EDGE_OFFSET * (dr.norm(place) + dr.norm(y1 - y0))
        y, beside = mi.Point3f(place), mi.Point3f(place + sides.outward * aside)
        valid = (pmf > 0) & sides.has_contrast
        hits = []
        for sign, dice in zip((-1.0, 1.0), self.transmission_seeds, strict=True):
            hit = _trace_past_edge(
                rays, self.inputs, (edge, along), beside, omega * (sign * dr.norm(y)), valid,
                (index, dice), has_close_surfaces=self.has_close_surfaces and sign > 0,
            )  # fmt: skip
            valid &= hit.valid & _is_not_grazing(rays, hit.face, omega, hit.valid)
            valid &= rays.is_in_scene(frame, hit.face, hit.valid)
            hits.append(hit)
        if rays.differentiated_objects is not None:
            moves = rays.differentiated_objects.has_edge(edge)
            for hit in hits:
                moves |= rays.differentiated_objects.has_face(hit.face, hit.valid)
            valid &= moves
        near = _MISS_DISTANCE * dr.norm(place)
        valid &= ~is_hidden_by_fold(rays, edge, place, exact, sides.outward, aside, near, valid)
        behind, ahead = hits
        triangle = p0, p1, p2 = rays.corners(behind.face, valid)
        b1, b2 = behind.b1, behind.b2
        point = interpolate_position(triangle, b1, b2)
        cosine = dr.abs(dr.dot(dr.normalize(dr.cross(p1 - p0, p2 - p0)), omega))
        measure = dr.squared_norm(point - y) / cosine
        chance = behind.chance * ahead.chance
        points = SilhouetteSample(
            index,
            False,
            frame,
            first,
            second,
            sides.side,
            along,
            ahead.face,
            weight=measure / (pmf * density * self.samples_per_pose * chance),
            transmittance=behind.transmittance * ahead.transmittance,
            extra_length=behind.extra + ahead.extra,
            open_transmittance=sides.open_transmittance,
            open_extra_length=sides.open_extra_length,
            covered_transmittance=sides.covered_transmittance,
            covered_extra_length=sides.covered_extra_length,
        )
        return SampleBatch(
            valid, (points, ShadowSource(behind.face, b1, b2)), InteriorSilhouetteSample
        )

    def _aim_at_differentiated(
        self,
        objects: DifferentiatedObjects,
        index: Any,
        edge: Any,
        point: Any,
        omega: Any,
        density: Any,
    ) -> tuple[Any, Any]:
        """Half of the directions through edges at rest go where something moves."""
        still = ~objects.has_edge(edge)
        (coin, first), (second, third) = (uniform_pair(index, seed) for seed in self.aim_seeds)
        chosen, turned = still & (coin < 0.5), coin < 0.25
        at = mi.Point3f(point)
        towards, aimed = objects.sample_direction(at, [first, second, third])
        line, aimed = dr.select(chosen, towards, omega), dr.select(chosen, aimed, NO_TARGET)
        mixed = 0.5 * (density + objects.line_density(at, line, aimed))
        return dr.select(chosen & turned, -line, line), dr.select(still, mixed, density)

    def _sample_direction(self, index: Any, edge: Any, y0: Any, y1: Any) -> tuple[Any, Any]:
        """A tangential direction and its probability per solid angle."""
        first, second = uniform_pair(index, self.seeds[1])
        if not self.importance_sampling:
            sphere = mi.warp.square_to_uniform_sphere(mi.Point2f(first, second))
            return sphere, mi.Float(1 / (4 * dr.pi))
        along = dr.normalize(y1 - y0)
        x, y = self._azimuth_axes(edge, y0, along)
        start, span = self._tangential_azimuths(edge, y0, y1)
        sign = dr.select(second < 0.5, 1.0, -1.0)
        azimuth = start + span * (2 * second - dr.select(second < 0.5, 0.0, 1.0))
        s, c = dr.sincos(azimuth)
        height = 2 * first - 1
        across = sign * dr.sqrt(dr.maximum(1 - height * height, 0.0))
        omega = along * height + (x * c + y * s) * across
        return mi.Vector3f(dr.normalize(omega)), 1 / (4 * span)
