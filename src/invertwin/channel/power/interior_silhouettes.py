"""Silhouette sampling between surfaces: edges that shadow one surface point from another."""

from __future__ import annotations

from invertwin.channel.power import silhouettes
from invertwin.channel.power.discrete import DiscreteSampler, balance_by_scene, sample_edge_point
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.mesh_folds import is_hidden_by_fold
from invertwin.channel.rays.arrays import gather_points, sample_sphere, scramble_seed, uniform_pair
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.ray_scene import NO_TARGET, DifferentiatedObjects
from invertwin.channel.rays.surface_point import face_normal, interpolate_position


class InteriorSilhouetteSampler:
    """Sampler of points and tangential directions on edges that shadow one surface from another.

    Edges are weighted by their length, by their opening angle (the range of tangential directions)
    and by the proximity to both antennas; directions are uniform over the tangential ones.

    Args:
        inputs: detached inputs.
        samples: number of points over all frames and scenes.
        seed: seed of the points.
        importance_sampling: False draws edges by length alone and directions from the whole
            sphere, for comparison in benchmarks.
        resting: 1 for each edge that ends in a surface which goes on beyond it; None if rays past
            edges do not meet surfaces in which the edges lie.
    """

    def __init__(
        self,
        inputs: Inputs,
        samples: int,
        seed: int,
        *,
        importance_sampling: bool = True,
        resting: mit.UInt32 | None = None,
    ) -> None:
        rays, topology = inputs.rays, inputs.rays.topology
        self.rays, self.inputs = rays, inputs
        self.importance_sampling, self.resting = importance_sampling, resting
        edge = dr.arange(mi.UInt32, len(topology.edges))
        y0, y1 = rays.exact_ends(edge)
        length = mi.Float(dr.norm(y1 - y0))
        _, span = self._tangential_azimuths(edge, y0, y1)
        weight = dr.select(span > silhouettes.MIN_OPENING, length, 0.0)
        if importance_sampling:
            middle = mi.Point3f(0.5 * (y0 + y1))
            near, first = mi.Float(0.0), rays.edge_scene(edge) * rays.poses_per_scene
            count = min(rays.poses_per_scene, 8)
            for number in range(count):
                pose = first + number * rays.poses_per_scene // count
                antennas = (gather_points(table, pose) for table in (rays.tx, rays.rx))
                legs = [dr.norm(middle - antenna) + length for antenna in antennas]
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

    def _tangential_azimuths(
        self, edge: mit.UInt32, y0: mit.Vector3d, y1: mit.Vector3d
    ) -> tuple[mit.Float, mit.Float]:
        """Compute start and span of the tangential directions' azimuth about the edge, up to sign.

        Azimuths count from the first triangle of the edge. Two triangles at azimuths 0 and α leave
        (α, π) free; one triangle leaves all directions; more are left to the test of sides.
        """
        topology = self.rays.topology
        along = dr.normalize(y1 - y0)
        start, span = mi.Float(0.0), mi.Float(dr.pi)
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
            unsure |= self._is_transmissive(edge) & (span > silhouettes.MIN_OPENING)
        return dr.select(unsure, 0.0, start), dr.select(unsure, dr.pi, span)

    def _is_transmissive(self, edge: mit.UInt32) -> mit.Bool:
        """Compute the mask of edges of which any triangle transmits at normal incidence."""
        inputs, found = self.inputs, mi.Bool(False)
        for column in self.rays.topology.device_edge_faces:
            row = dr.gather(mi.UInt32, inputs.face_surface, dr.gather(mi.UInt32, column, edge))
            found |= inputs.surfaces.interpolate_cosine("transmittance", row, mi.Float(1.0)) > 0
        return found

    def _azimuth_axes(
        self, edge: mit.UInt32, y0: mit.Vector3d, along: mit.Vector3d
    ) -> tuple[mit.Vector3d, mit.Vector3d]:
        topology = self.rays.topology
        apex = mi.UInt32(dr.maximum(dr.gather(mi.Int32, topology.device_edge_apexes[0], edge), 0))
        offset = self.rays.exact_vertex(apex) - y0
        x = dr.normalize(offset - along * dr.dot(along, offset))
        return x, dr.cross(along, x)

    def draw(self, index: mit.UInt32) -> silhouettes.SampleBatch[silhouettes.SilhouetteSample]:
        """Draw the samples of given numbers; those without a shadow are void.

        The weight of a sample holds the change of measure from directions to area.

        Args:
            index: sample numbers below ``size``.
        """
        rays, moving = self.rays, self.rays.differentiated_objects
        pose, within = index // self.samples_per_pose, index % self.samples_per_pose
        edge, along, pmf = sample_edge_point(
            self.choice, within, self.samples_per_pose, self.seeds[0], index
        )
        frame = rays.edge_scene(edge) * rays.poses_per_scene + pose
        y0, y1 = rays.exact_ends(edge)
        exact_point = y0 + (y1 - y0) * mi.Float64(along)
        omega, density = self._sample_direction(index, edge, y0, y1)
        if self.importance_sampling and moving is not None and rays.scene_count == 1:
            omega, density = self._aim_at_differentiated(
                moving, index, edge, exact_point, omega, density
            )
        exact = mi.Vector3d(omega)
        sides = silhouettes.classify_sides(self.inputs, edge, exact)
        aside = silhouettes.EDGE_OFFSET * (dr.norm(exact_point) + dr.norm(y1 - y0))
        y, beside = mi.Point3f(exact_point), mi.Point3f(exact_point + sides.outward * aside)
        valid = (pmf > 0) & sides.has_contrast
        hits = []
        for sign, seed in zip((-1.0, 1.0), self.transmission_seeds, strict=True):
            hit = silhouettes.trace_past_edge(
                self.inputs, (edge, along), beside, omega * (sign * dr.norm(y)), valid,
                (index, seed), resting=self.resting if sign > 0 else None,
            )  # fmt: skip
            valid &= hit.valid & silhouettes.is_not_grazing(rays, hit.point.face, omega, hit.valid)
            valid &= rays.is_in_scene(frame, hit.point.face, hit.valid)
            hits.append(hit)
        if moving is not None:
            counts = moving.has_edge(edge)
            for hit in hits:
                counts |= moving.has_face(hit.point.face, hit.valid)
            valid &= counts
        near = silhouettes.MISS_DISTANCE * dr.norm(exact_point)
        valid &= ~is_hidden_by_fold(
            rays, edge, exact_point, exact, sides.outward, aside, near, valid
        )
        behind, ahead = hits
        source = behind.point
        triangle = rays.corners(source.face, valid)
        point = interpolate_position(triangle, source.b1, source.b2)
        measure = dr.squared_norm(point - y) / dr.abs(dr.dot(face_normal(triangle), omega))
        probability = behind.probability * ahead.probability
        place = index, False, frame, edge, sides.side, along, ahead.point.face
        weight = measure / (pmf * density * self.samples_per_pose * probability)
        passed = behind.transmission.then(ahead.transmission), sides.open, sides.covered
        samples = silhouettes.SilhouetteSample(*place, weight, *passed, source)
        return silhouettes.SampleBatch(valid, samples)

    def _aim_at_differentiated(
        self,
        objects: DifferentiatedObjects,
        index: mit.UInt32,
        edge: mit.UInt32,
        point: mit.Vector3d,
        omega: mit.Vector3f,
        density: mit.Float,
    ) -> tuple[mit.Vector3f, mit.Float]:
        """Aim half of the directions through edges at rest at objects with derivatives."""
        still = ~objects.has_edge(edge)
        (coin, first), (second, third) = (uniform_pair(index, seed) for seed in self.aim_seeds)
        chosen, turned = still & (coin < 0.5), coin < 0.25
        at = mi.Point3f(point)
        towards, aimed = objects.sample_direction(at, [first, second, third])
        line, aimed = dr.select(chosen, towards, omega), dr.select(chosen, aimed, NO_TARGET)
        mixed = 0.5 * (density + objects.line_density(at, line, aimed))
        return dr.select(chosen & turned, -line, line), dr.select(still, mixed, density)

    def _sample_direction(
        self, index: mit.UInt32, edge: mit.UInt32, y0: mit.Vector3d, y1: mit.Vector3d
    ) -> tuple[mit.Vector3f, mit.Float]:
        """Sample a tangential direction; return it and its probability per solid angle."""
        first, second = uniform_pair(index, self.seeds[1])
        if not self.importance_sampling:
            return sample_sphere(first, second), mi.Float(1 / (4 * dr.pi))
        along = dr.normalize(y1 - y0)
        x, y = self._azimuth_axes(edge, y0, along)
        start, span = self._tangential_azimuths(edge, y0, y1)
        sign = dr.select(second < 0.5, 1.0, -1.0)
        s, c = dr.sincos(start + span * (2 * second - dr.select(second < 0.5, 0.0, 1.0)))
        height = 2 * first - 1
        across = sign * dr.sqrt(dr.maximum(1 - height * height, 0.0))
        return mi.Vector3f(dr.normalize(along * height + (x * c + y * s) * across)), 1 / (4 * span)
