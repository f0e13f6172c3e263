"""Boundary paths at intersection curves, where each surface hides what lies behind it.

With both unit normals oriented towards the previous vertex, each surface is visible on the side to
which the other's normal points. As θ changes, the curve sweeps ``n_B · (x_A − x_B) / |n_A × n_B|``
of the surface A per metre, with the material points x_A and x_B at a point of the curve; B likewise
(derivations §3). Any vertex of a path may lie on the curve.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from invertwin.channel.power import integrand
from invertwin.channel.power import random_walk as walk
from invertwin.channel.power.bins import PathContribution
from invertwin.channel.power.discrete import DiscreteSampler, balance_by_scene, sample_edge_point
from invertwin.channel.power.integrand import Inputs, SurfaceInteraction
from invertwin.channel.power.random_walk import PathState, RandomWalk
from invertwin.channel.power.silhouettes import SampleBatch
from invertwin.channel.power.transmission import (
    SegmentTransmission,
    trace_to_surface,
    trace_transmission,
)
from invertwin.channel.rays import arrays
from invertwin.channel.rays.backend import Mask, dr, mi, mit
from invertwin.channel.rays.intersections import IntersectionCurves
from invertwin.channel.rays.ray_scene import RAY_EPSILON
from invertwin.channel.rays.surface_point import SurfacePoint, barycentric_coordinates
from invertwin.errors import InputError

_CHECKED_POINTS = 65_536  # points by which paths between surfaces that meet are detected
_MIN_WEDGE_COSINE = -0.98  # least cosine between the normals of surfaces between which rays start
_SUBPATH_OFFSET = 1 << 29  # added to indices, so that the second part has its own random numbers

PathVisitor = Callable[[PathState, PathContribution, mit.Bool], None]
PathParts = tuple[mit.Float, PathState, Callable[[PathState, PathVisitor], PathState]]
"""Fields of ``BoundaryPaths``."""


@dataclass(frozen=True)
class IntersectionPoint:
    """Samples of points on intersection curves.

    Attributes:
        index: sample numbers.
        frame: radar poses.
        weight: one over (samples × probability per metre).
        transmission: transmission of the segment from the antenna or the source.
        first, second: material points of the two surfaces.
        source: previous surface point, for paths that do not come from an antenna.
    """

    index: mit.UInt32
    frame: mit.UInt32
    weight: mit.Float
    transmission: SegmentTransmission
    first: SurfacePoint
    second: SurfacePoint
    source: SurfacePoint

    @property
    def size(self) -> int:
        """Number of samples."""
        return dr.width(self.index)


class IntersectionCurveSampler:
    """Sampler of points on intersection curves and of the directions from which paths arrive.

    Args:
        inputs: detached inputs.
        curves: segments of the curves.
        samples: number of points.
        depth: most vertices of a path.
        seed: seed of the points.
    """

    def __init__(
        self, inputs: Inputs, curves: IntersectionCurves, samples: int, depth: int, seed: int
    ) -> None:
        self.rays = rays = inputs.rays
        self.inputs, self.size, self.depth = inputs, samples, depth
        ends = [(end - rays.origin).float() for end in (curves.start, curves.end)]
        self.ends = list(map(arrays.to_points, ends))
        self.faces = [arrays.to_index(face) for face in (curves.first, curves.second)]
        self.resting = arrays.to_index(curves.edge + 1)  # 0 of crossings
        self.segments = len(curves.first)
        owner = rays.geometry.face_object[curves.first]
        self.first_frame = rays.object_scene(arrays.to_index(owner)) * rays.poses_per_scene
        entries = dr.arange(mi.UInt32, self.segments * rays.poses_per_scene)
        start, offset, frame = self._segment(entries)
        middle = start + 0.5 * offset  # type: ignore[operator]
        legs = [dr.norm(middle - arrays.gather_points(t, frame)) for t in (rays.tx, rays.rx)]
        weight = dr.norm(offset) / (legs[0] * legs[1])
        self.choice = DiscreteSampler(balance_by_scene(rays, rays.frame_scene(frame), weight))
        self.seeds = [arrays.scramble_seed(seed, stream) for stream in (12, 13, 14)]

    def _segment(self, entry: mit.UInt32) -> tuple[mit.Point3f, mit.Vector3f, mit.UInt32]:
        """Decode an entry: start and offset of the segment [m], and radar pose."""
        segment = entry % self.segments
        start, end = (arrays.gather_points(ends, segment) for ends in self.ends)
        frame = entry // self.segments
        if self.rays.scene_count > 1:
            frame += dr.gather(mi.UInt32, self.first_frame, segment)
        return start, end - start, frame  # type: ignore[return-value]

    def draw(self, index: mit.UInt32) -> SampleBatch[IntersectionPoint]:
        """Draw the samples of given numbers; those that are not visible are void.

        Args:
            index: sample numbers below ``size``.
        """
        rays, inputs, deep = self.rays, self.inputs, self.depth > 1
        entry, along, probability = sample_edge_point(self.choice, index, self.size, self.seeds[0])
        start, offset, frame = self._segment(entry)
        x: mit.Point3f = start + offset * along  # type: ignore[operator]
        valid = probability > 0
        points = []
        for faces in self.faces:
            face = dr.gather(mi.UInt32, faces, entry % self.segments)
            points.append(SurfacePoint(face, *barycentric_coordinates(x, rays.corners(face))))
        interactions = [integrand.compute_interaction(inputs, point) for point in points]
        normals = [interaction.normal for interaction in interactions]
        count, receiver = decode_subpath(index, self.depth)
        antenna = inputs.antenna_position(frame, receiver)
        incident = dr.normalize(antenna - x)
        if deep:
            sphere = arrays.sample_sphere(*arrays.uniform_pair(index, self.seeds[1]))
            incident = dr.select(count > 0, sphere, incident)
        origin = _offset_into_wedge(interactions[0], normals, incident).position
        transmission = trace_transmission(inputs, origin, antenna, valid & (count == 0))
        exists = transmission.transmittance > 0
        source = SurfacePoint(mi.UInt32(0), mi.Float(0.0), mi.Float(0.0))
        hit_probability = mi.Float(1.0)
        if deep:
            ray, key = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(incident)), (index, self.seeds[2])
            hit = trace_to_surface(inputs, ray, valid & (count > 0), key, coherent=False)
            exists |= hit.valid & rays.is_in_scene(frame, hit.point.face, hit.valid)
            hit_probability, source = hit.probability, hit.point
            transmission = dr.select(count > 0, hit.transmission, transmission)
        edge = dr.gather(mi.UInt32, self.resting, entry % self.segments)
        rests, edge = edge > 0, dr.maximum(edge, 1) - 1
        exists &= ~rests | self._is_facing(edge, points[0].face, (x, offset), normals, incident)
        weight = dr.norm(offset) / (probability * self.size * hit_probability)
        weight *= dr.select(rests, 0.5, 1.0)  # the other half is that of `trace_past_edge`
        samples = IntersectionPoint(
            index, frame, weight, transmission, points[0], points[1], source
        )
        return SampleBatch(valid & exists, samples)

    def _is_facing(
        self, edge: mit.UInt32, face: mit.UInt32, line: tuple[mit.Point3f, mit.Vector3f],
        normals: Sequence[mit.Vector3f], direction: mit.Vector3f,
    ) -> mit.Bool:  # fmt: skip
        """Test whether triangles that end in a surface face directions that lead off it."""
        x, along = line
        rays, topology = self.rays, self.rays.topology
        own = mi.Vector3f(sum(rays.corners(face)) / 3 - x)

        def alike(normal: mit.Vector3f, offset: mit.Vector3f) -> mit.Bool:
            return dr.dot(normal, offset) * dr.dot(normal, direction) > 0

        found = alike(normals[1], own)
        columns = zip(topology.device_edge_apexes, topology.device_edge_faces, strict=True)
        for apexes, faces in columns:
            apex, other = dr.gather(mi.Int32, apexes, edge), dr.gather(mi.UInt32, faces, edge)
            vertex = arrays.gather_points(rays.vertices, mi.UInt32(dr.maximum(apex, 0)))
            there = mi.Vector3f(vertex - x)
            hides = alike(normals[0], there) & ~alike(dr.cross(along, there), own)
            found &= ~hides | (apex < 0) | (other == face)
        return found


def decode_subpath(index: mit.UInt32, depth: int) -> tuple[mit.UInt32, Mask]:
    """Decode the subpath before the curve from the number of a sample.

    Args:
        index: sample numbers.
        depth: most vertices of a path.

    Returns:
        The number of surface points before the curve, and True if the path starts at the receiver.
    """
    if depth == 1:
        return mi.UInt32(0), False
    return (index // 2) % arrays.opaque(depth), (index % 2) == 1


def _offset_into_wedge(
    point: SurfaceInteraction, normals: Sequence[mit.Vector3f], direction: mit.Vector3f
) -> SurfaceInteraction:
    """Move a point a little off both surfaces, into the wedge to which a direction leads."""
    first, second = (dr.mulsign(normal, dr.dot(normal, direction)) for normal in normals)
    cosine = dr.maximum(dr.dot(first, second), _MIN_WEDGE_COSINE)
    step = 2 * RAY_EPSILON * dr.norm(point.position) / (1 + cosine)
    return replace(point, position=point.position + (first + second) * step)


class _IncidentSubpath:
    """Part of paths from an antenna to a vertex on an intersection curve, detached.

    Attributes:
        interactions: interactions of the two surfaces.
        count: number of surface points before the curve.
        at_receiver: True if the path starts at the receiver.
        other_end: True if the path ends at the receiver.
        incident: unit direction from the curve to the previous vertex or the antenna.
        throughput: product of the factors up to the curve.
        length: optical length up to the curve [m].
        keys: keys of the path state at the curve.
    """

    def __init__(self, walker: RandomWalk, points: IntersectionPoint, depth: int) -> None:
        frame, index, added = points.frame, points.index, points.transmission.extra_length
        self.fixed, self.walker, self.depth = walker.inputs, walker, depth
        self.points = points
        fixed, spots = walker.inputs, (points.first, points.second)
        self.interactions = [integrand.compute_interaction(fixed, spot) for spot in spots]
        here = self.interactions[0]
        self.count, self.at_receiver = count, at_receiver = decode_subpath(index, depth)
        self.shared = walker.rays.link.shared_visibility and depth == 1
        self.other_end = True if isinstance(at_receiver, bool) else ~at_receiver
        antenna = fixed.antenna_position(frame, at_receiver)
        incident, distance = integrand.direction_and_distance(here.position, antenna)
        departure = integrand.to_radar_frame(fixed, frame, -incident)
        throughput = fixed.gain(frame, at_receiver, departure) / dr.square(distance)
        length = distance + added
        self.keys: dict[str, object] = {}
        if depth > 1:
            source, deep = integrand.compute_interaction(fixed, points.source, count > 0), count > 0
            way, step = integrand.direction_and_distance(here.position, source.position)
            medium = integrand.find_medium(fixed, here, source, way, deep)
            pdf = dr.abs(dr.dot(source.normal, way)) / (4 * dr.pi)
            factor = dr.select(deep & (pdf > 0), dr.exp(-medium.attenuation * step) / pdf, 0.0)
            reach = medium.refractive_index * step + added
            first = walk.initial_state(index, frame, points.source, -way, factor, reach)
            done = walker.trace_subpath(first, count, at_receiver)
            incident = dr.select(deep, way, incident)
            throughput = dr.select(deep, done["power"], throughput)
            length = dr.select(deep, done["optical_length"], length)
            self.keys = {
                "to_receiver": self.other_end,
                "u": dr.select(deep, done["u"], departure.y),
                "v": dr.select(deep, done["v"], departure.z),
                "previous_vertices": count,
            }
        self.incident, self.length = incident, length
        self.throughput = throughput * (fixed.scale * depth * points.transmission.transmittance)

    @property
    def normals(self) -> list[mit.Vector3f]:
        """Unit normals of the two surfaces."""
        return [interaction.normal for interaction in self.interactions]


@dataclass(frozen=True)
class _CoveredSide:
    """Paths that touch one surface at the curve, past the other surface.

    Attributes:
        subpath: part of the paths before the curve.
        own, other: numbers of the surface that paths touch, and of the one that hides it.
        sign: 1 for the side of the other surface that is open, −1 for the side behind it.
    """

    subpath: _IncidentSubpath
    own: int
    other: int
    sign: float

    @property
    def facing(self) -> mit.Vector3f:
        """Normal of the hiding surface, oriented towards the incident direction."""
        hiding = self.subpath.interactions[self.other].normal
        return dr.mulsign(hiding, dr.dot(hiding, self.subpath.incident))

    def transmit(self, direction: mit.Vector3f) -> SegmentTransmission:
        """Evaluate the transmission of the hiding surface, for directions that lead behind it.

        Args:
            direction: unit directions from the curve.
        """
        fixed, hiding = self.subpath.fixed, self.subpath.interactions[self.other]
        cosine = dr.dot(self.facing * self.sign, direction)
        if not fixed.surfaces.has_sheets:
            return SegmentTransmission(dr.select(cosine > 0, 1.0, 0.0), mi.Float(0.0))
        passed = fixed.surfaces.sheet_transmission(hiding.surface_row, dr.abs(cosine))
        return dr.select(cosine > 0, SegmentTransmission.clear(), SegmentTransmission(*passed))

    def initial_state(self) -> PathState:
        """Create the state of the paths at the curve, for unit velocity."""
        before, points = self.subpath, self.subpath.points
        passed = self.transmit(before.incident)
        point = (points.first, points.second)[self.own]
        throughput = before.throughput * passed.transmittance * self.sign
        length = before.length + passed.extra_length
        sheets = points.transmission if before.shared else None
        index, incident = points.index + _SUBPATH_OFFSET, before.incident
        state = walk.initial_state(index, points.frame, point, incident, throughput, length, sheets)
        return walk.update_state(state, **before.keys)

    def speed(self, inputs: Inputs) -> mit.Float:
        """Compute the area that the curve sweeps per unit of θ, over the density; attached.

        Args:
            inputs: attached inputs.
        """
        points = self.subpath.points
        spots = points.first, points.second
        normals = self.subpath.normals
        sine = dr.norm(dr.cross(normals[self.own], normals[self.other]))
        own = integrand.compute_interaction(inputs, spots[self.own]).position
        offset = own - integrand.compute_interaction(inputs, spots[self.other]).position
        return dr.dot(self.facing, offset) * (points.weight / sine)

    def run(self, state: PathState, visit: PathVisitor) -> PathState:
        """Connect the vertex at the curve to the antenna, and walk on from there.

        Args:
            state: state of the paths at the curve.
            visit: function of the state, a path, and the mask of lanes in which it exists.
        """
        before, walker = self.subpath, self.subpath.walker
        fixed, depth = before.fixed, before.depth
        here, normals = before.interactions[self.own], before.normals
        target = before.at_receiver if before.shared else before.other_end
        end = fixed.antenna_position(before.points.frame, target)
        onwards, _ = integrand.direction_and_distance(here.position, end)
        point = _offset_into_wedge(here, normals, onwards)
        path, exists = walk.connect_path(
            fixed, state, point, before.other_end, shared_visibility=before.shared
        )
        passed = self.transmit(onwards)
        power, length = path.power * passed.transmittance, path.range + 0.5 * passed.extra_length
        path = replace(path, power=power, range=length)
        visit(state, path, exists & (passed.transmittance > 0))
        if depth == 1:
            return state

        def visit_connection(state: PathState, point: SurfaceInteraction) -> None:
            visit(state, *walk.connect_path(fixed, state, point, state["to_receiver"]))

        state["active"] &= before.count + 1 < arrays.opaque(depth)
        state = walker.step(state, _offset_into_wedge(here, normals, before.incident))
        passed = self.transmit(-state["incident"])
        state["active"] &= passed.transmittance > 0
        state["throughput"] = state["throughput"] * passed.transmittance
        state["length"] = state["length"] + passed.extra_length
        return walker.run(state, arrays.opaque(depth) - before.count, visit_connection)


def intersection_curve_paths(
    inputs: Inputs, walker: RandomWalk, points: IntersectionPoint, depth: int
) -> Iterator[PathParts]:
    """Create the boundary paths with a vertex on an intersection curve.

    Args:
        inputs: attached inputs.
        walker: random walk that extends the paths.
        points: points on the curves.
        depth: most vertices of a path.

    Returns:
        Velocity, initial state and walk of the paths of either surface, see ``BoundaryPaths``.
    """
    subpath = _IncidentSubpath(walker, points, depth)
    for own, other in ((0, 1), (1, 0)):
        for sign in (1.0, -1.0) if inputs.surfaces.has_sheets else (1.0,):
            side = _CoveredSide(subpath, own, other, sign)
            yield side.speed(inputs), side.initial_state(), side.run


def require_no_interreflection(
    walker: RandomWalk, curves: IntersectionCurves, depth: int, seed: int
) -> None:
    """Refuse paths between surfaces that meet, whose derivative does not converge.

    Such paths exist if a path with one vertex less has a vertex on the curve and both surfaces
    scatter it.

    Args:
        walker: random walk that extends the paths, with detached inputs.
        curves: intersection curves.
        depth: most vertices of a path.
        seed: seed of the points on the curves.

    Raises:
        InputError: There are such paths.
    """
    rays, fixed = walker.rays, walker.inputs
    samples = _CHECKED_POINTS * rays.scene_count
    sampler = IntersectionCurveSampler(fixed, curves, samples, depth - 1, seed)
    points = sampler.draw(dr.arange(mi.UInt32, sampler.size)).compress()
    if not points.size:
        return

    def record_existing(state: PathState, _: PathContribution, exists: mit.Bool) -> None:
        state["exists"] = state["exists"] | exists

    scattered = [dr.zeros(mi.Bool, points.size) for _ in range(2)]
    families = intersection_curve_paths(fixed, walker, points, depth - 1)
    for number, (_, state, run) in enumerate(families):
        state["exists"] = dr.zeros(mi.Bool, points.size)
        scattered[number % 2] |= run(state, record_existing)["exists"]
    first, second = scattered
    lanes = dr.compress(first | second if fixed.surfaces.has_sheets else first & second)
    if dr.width(lanes):
        spots = points.first, points.second
        faces = [dr.gather(mi.UInt32, spot.face, lanes[0]) for spot in spots]
        owners = [int(rays.topology.face_object[int(face[0])]) for face in faces]
        names = " and ".join(dict.fromkeys(rays.geometry.names[owner] for owner in owners))
        raise InputError(
            f"expected no paths between surfaces that meet and move past each other, got {names} "
            f"at depth {depth}: the derivative of such paths does not converge; leave a gap, take "
            f"depth {depth - 1}, or contacts=False in Sampling, which leaves out what moves there"
        )
