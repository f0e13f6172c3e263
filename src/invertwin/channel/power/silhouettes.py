"""Silhouette sampling: points on edges, the shadows that they cast, and the shadows' velocity.

The first family of samples lies on silhouettes as the antennas see them. The second
(``interior_silhouettes``) starts at an edge and looks both ways along a tangential direction, so
that no silhouette is searched per vertex (derivations §3). Positions are detached, ``shadow_speed``
is attached.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, is_dataclass, replace
from typing import Generic, TypeVar, cast

from invertwin.channel.power import integrand
from invertwin.channel.power import transmission as sheets
from invertwin.channel.power.discrete import DiscreteSampler, balance_by_object, sample_edge_point
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.mesh_folds import is_hidden_by_fold
from invertwin.channel.power.transmission import SegmentHit, SegmentTransmission
from invertwin.channel.rays import surface_point
from invertwin.channel.rays.arrays import gather_points, scramble_seed
from invertwin.channel.rays.backend import Mask, dr, mi, mit
from invertwin.channel.rays.intersections import PLANE_TOLERANCE
from invertwin.channel.rays.ray_scene import RAY_EPSILON, RayScene

# Least cosine between a boundary ray and the normal of the shadowed surface.
_MIN_GRAZING_COSINE = 1e-5
# Boundary rays start beside the edge, at this fraction (two roundings) of the edge's length and its
# distance from the origin: they would otherwise meet its own triangles, which are nearly edge-on.
EDGE_OFFSET = 1e-7
# Distance from an edge, relative to its range, within which rays may miss a surface.
MISS_DISTANCE = 2 * RAY_EPSILON
# Distance before an edge, relative to its range, at which rays start among close surfaces.
_START_OFFSET = 3e-5
MIN_OPENING = 1e-6  # least opening of an edge that casts a shadow [rad]

Record = TypeVar("Record")


@dataclass(frozen=True)
class SilhouetteSample:
    """Points on edges and the triangles on which their shadows fall (Dr.Jit arrays).

    The plane through edge and ray divides the edge's triangles. Its covered side is that on which
    a triangle has its vertex farthest from the plane.

    Attributes:
        index: sample numbers.
        is_receiver: True for silhouettes as the receiver sees them; False if one visibility test
            serves both antennas.
        frame: radar poses.
        edge: edges of the topology.
        side: ±1, the sign with which ray × edge points to the covered side.
        edge_parameter: position from the first to the second end, 0 to 1.
        face: triangle on which the shadow falls.
        weight: one over (samples × probability per ``edge_parameter``).
        transmission: transmission of all other sheets on the ray.
        open: transmission of the edge's own triangles on the open side: 1 if there are none, 0 if
            one is opaque.
        covered: their transmission on the covered side.
        source: surface point that casts the shadow; None for an antenna.
    """

    index: mit.UInt32
    is_receiver: Mask
    frame: mit.UInt32
    edge: mit.UInt32
    side: mit.Float
    edge_parameter: mit.Float
    face: mit.UInt32
    weight: mit.Float
    transmission: SegmentTransmission
    open: SegmentTransmission
    covered: SegmentTransmission
    source: surface_point.SurfacePoint | None = None

    @property
    def size(self) -> int:
        """Number of samples."""
        return dr.width(self.face)

    def sides(self, inputs: Inputs) -> list[tuple[float, SegmentTransmission]]:
        """Sign and transmission of either side of the shadow boundary.

        Args:
            inputs: inputs of the kernel.
        """
        signs = ((1.0, self.open), (-1.0, self.covered))
        count = 2 if inputs.surfaces.has_sheets else 1
        return [(sign, self.transmission.then(own)) for sign, own in signs[:count]]


@dataclass(frozen=True)
class SampleBatch(Generic[Record]):
    """Samples, some of them void; recorded first, and executed on demand.

    Attributes:
        valid: mask of samples that are not void.
        samples: dataclass of arrays.
    """

    valid: mit.Bool
    samples: Record

    def launch(self) -> None:
        """Start the execution without waiting for it."""
        dr.eval(self.valid, self.samples)

    def compress(self) -> Record:
        """Return the samples that are not void."""
        self.launch()
        return gather_lanes(self.samples, dr.compress(self.valid))


def gather_lanes(record: Record, lanes: mit.UInt32) -> Record:
    """Gather lanes of all arrays of a dataclass; values other than arrays stay.

    Args:
        record: dataclass of arrays, which may be nested.
        lanes: indices of the lanes.
    """
    if is_dataclass(record):
        values = (gather_lanes(value, lanes) for value in vars(record).values())
        return cast(Record, type(record)(*values))
    return record if record is None or record is False else dr.gather(type(record), record, lanes)  # type: ignore[return-value]


class SilhouetteSampler:
    """Sampler of points on the silhouettes that one antenna or both see.

    An edge is a silhouette if, as seen from the antenna, all its triangles lie on one side of it:
    one triangle for an open edge, two for a fold, any number for a non-manifold edge. The rule
    needs no consistent winding. An edge of sheets counts if the transmittances of its two sides
    differ.

    Args:
        inputs: detached inputs.
        antennas: antennas whose silhouettes count: ``tx``, ``rx`` or both.
        samples: number of points over all frames and scenes.
        seed: seed of the points.
        resting: 1 for each edge that ends in a surface which goes on beyond it; None if rays past
            edges do not meet surfaces in which the edges lie.
    """

    def __init__(
        self,
        inputs: Inputs,
        antennas: Sequence[str],
        samples: int,
        seed: int,
        *,
        resting: mit.UInt32 | None = None,
    ) -> None:
        rays, topology = inputs.rays, inputs.rays.topology
        self.rays, self.inputs, self.antennas = rays, inputs, antennas
        self.resting = resting
        entries = len(antennas) * rays.poses_per_scene * len(topology.edges)
        edge, _, receiver, origin = self._decode_entry(dr.arange(mi.UInt32, entries))
        y0, y1 = rays.exact_ends(edge)
        ends = [mi.Vector3d(y - mi.Vector3d(origin)) for y in (y0, y1)]
        sides = classify_sides(inputs, edge, 0.5 * (ends[0] + ends[1]))
        self.size = samples if entries else 0
        if self.size:
            angle = mi.Float(dr.atan2(dr.norm(dr.cross(*ends)), dr.dot(*ends)))
            counts = sides.has_contrast
            if (moving := rays.differentiated_objects) is not None:
                counts &= moving.has_edge(edge) | moving.may_receive_shadow(edge, origin, y0, y1)
            weight = dr.select(counts, angle * sides.contrast, 0.0)
            self.choice = DiscreteSampler(
                balance_by_object(rays, edge, weight, receiver, len(antennas))
            )
        self.seed, self.transmission_seed = scramble_seed(seed, 3), scramble_seed(seed, 9)

    def _decode_entry(self, entry: mit.UInt32) -> tuple[mit.UInt32, mit.UInt32, Mask, mit.Point3f]:
        """Decode an entry: edge, frame, True for the receiver of two antennas, and position."""
        rays, edges = self.rays, len(self.rays.topology.edges)
        pose, edge = entry // edges, entry % edges
        first = rays.edge_scene(edge) * rays.poses_per_scene
        if len(self.antennas) == 1:
            frame = first + pose
            return edge, frame, False, gather_points(getattr(rays, self.antennas[0]), frame)
        receiver = pose >= rays.poses_per_scene
        frame = first + dr.select(receiver, pose - rays.poses_per_scene, pose)
        origin = dr.select(receiver, gather_points(rays.rx, frame), gather_points(rays.tx, frame))
        return edge, frame, receiver, origin

    def draw(self, index: mit.UInt32) -> SampleBatch[SilhouetteSample]:
        """Draw the samples of given numbers; those without a shadow are void.

        Args:
            index: sample numbers below ``size``.
        """
        rays = self.rays
        entry, along, pmf = sample_edge_point(self.choice, index, self.size, self.seed)
        edge, frame, receiver, origin = self._decode_entry(entry)
        y0, y1 = rays.exact_ends(edge)
        y = y0 + (y1 - y0) * mi.Float64(along)
        exact = y - mi.Vector3d(origin)
        sides = classify_sides(self.inputs, edge, exact)
        aside = EDGE_OFFSET * (dr.norm(y) + dr.norm(y1 - y0))
        beside, away = mi.Point3f(y + sides.outward * aside), mi.Vector3f(exact)
        reach = beside - away * _START_OFFSET if self.resting is not None else beside
        before = sheets.trace_transmission(self.inputs, reach, origin, pmf > 0)
        valid = (pmf > 0) & (before.transmittance > 0) & sides.has_contrast
        ray = beside, away, valid, (index, self.transmission_seed)
        hit = trace_past_edge(
            self.inputs, (edge, along), *ray, resting=self.resting, stratified_bits=index
        )
        face = hit.point.face
        valid &= hit.valid & is_not_grazing(rays, face, away, hit.valid)
        valid &= rays.is_in_scene(frame, face, hit.valid)
        if (moving := rays.differentiated_objects) is not None:
            valid &= moving.has_edge(edge) | moving.has_face(face, hit.valid)
        # Last, since it takes longest: packets without a shadow skip it.
        near = MISS_DISTANCE * dr.norm(exact)
        valid &= ~is_hidden_by_fold(rays, edge, y, exact, sides.outward, aside, near, valid)
        place = index, receiver, frame, edge, sides.side, along, face
        weight = 1 / (pmf * self.size * hit.probability)
        transmission = before.then(hit.transmission)
        samples = SilhouetteSample(*place, weight, transmission, sides.open, sides.covered)
        return SampleBatch(valid, samples)


@dataclass(frozen=True)
class _EdgeSides:
    """Transmission of an edge's triangles on either side of a direction.

    Attributes:
        side, open, covered: see ``SilhouetteSample``.
        outward: unit direction off the covered side; zero if there are triangles on both sides.
    """

    side: mit.Float
    open: SegmentTransmission
    covered: SegmentTransmission
    outward: mit.Vector3d

    @property
    def contrast(self) -> mit.Float:
        """Change of the transmittance from side to side; small if only the length changes."""
        first, second = self.open.transmittance, self.covered.transmittance
        return dr.abs(first - second) + 0.05 * (first + second)

    @property
    def has_contrast(self) -> mit.Bool:
        """Mask of edges whose sides differ by more than rounding."""
        same_length = dr.abs(self.open.extra_length - self.covered.extra_length) <= 1e-7
        same_power = dr.abs(self.open.transmittance - self.covered.transmittance) <= 1e-6
        return ~(same_power & same_length)


def classify_sides(inputs: Inputs, edge: mit.UInt32, direction: mit.Vector3d) -> _EdgeSides:
    """Sort an edge's triangles by their side of the plane through edge and direction.

    An opaque edge is a silhouette if one side is free. In float64: the triangles of a fine mesh
    are nearly edge-on at the boundary of a shadow.

    Args:
        inputs: attached tables of the scene.
        edge: index of each edge.
        direction: direction from the shadowing point to the edge [lane, 3].
    """
    rays, topology = inputs.rays, inputs.rays.topology
    y0, y1 = rays.exact_ends(edge)
    plane = dr.cross(direction, y1 - y0)
    offsets, heights = [], []
    most = mi.Float64(0.0)
    for column in topology.device_edge_apexes:
        apex = dr.gather(mi.Int32, column, edge)
        offset = rays.exact_vertex(mi.UInt32(dr.maximum(apex, 0))) - y0
        height = dr.select(apex >= 0, dr.dot(plane, offset), 0.0)
        # Squares, since Dr.Jit 1.5 drops the abs of a select on an abs.
        most = dr.select(dr.square(height) > dr.square(most), height, most)
        offsets.append(offset)
        heights.append(height)
    sides = [SegmentTransmission.clear(), SegmentTransmission.clear()]
    for number, (offset, height) in enumerate(zip(offsets, heights, strict=True)):
        own = SegmentTransmission(mi.Float(0.0), mi.Float(0.0))
        if inputs.surfaces.has_sheets:
            face = dr.gather(mi.UInt32, topology.device_edge_faces[number], edge)
            row = dr.gather(mi.UInt32, inputs.face_surface, face)
            normal = dr.cross(y1 - y0, offset)
            cosine = dr.abs(dr.dot(normal, direction)) / (dr.norm(normal) * dr.norm(direction))
            passed = inputs.surfaces.sheet_transmission(row, mi.Float(cosine), height != 0)
            own = SegmentTransmission(*passed)
        for index, on in enumerate((height * most < 0, height * most > 0)):
            sides[index] = dr.select(on, sides[index].then(own), sides[index])
    free = (sides[0].transmittance == 1) & (sides[0].extra_length == 0)
    outwards = dr.select(free, -dr.mulsign(dr.normalize(plane), most), 0.0)
    return _EdgeSides(mi.Float(dr.sign(most)), sides[0], sides[1], mi.Vector3d(outwards))


def trace_past_edge(
    inputs: Inputs,
    edge_point: tuple[mit.UInt32, mit.Float],
    origin: mit.Point3f,
    direction: mit.Vector3f,
    active: mit.Bool,
    key: tuple[mit.UInt32, mit.UInt32],
    *,
    resting: mit.UInt32 | None,
    stratified_bits: mit.UInt32 | None = None,
) -> SegmentHit:
    """Trace rays past points on edges.

    The ray starts before the edge, so that it meets surfaces in which the edge lies (a box on a
    floor, a shelf on a wall, of several objects or of one mesh); float64 decides whether the edge
    is in front of them. Behind a surface that it has crossed, an edge casts no shadow: there the
    intersection curve counts. Rays are not coherent, since Embree loses some of those of a bundle
    that start close to a surface.

    Args:
        inputs: detached inputs.
        edge_point: edges, and positions along them from 0 to 1.
        origin: origins of the rays, off the edge.
        direction: directions, as long as the distance of the edge.
        active: mask of active lanes.
        key: index and seed of the random numbers, see ``trace_to_surface``.
        resting: 1 for each edge that ends in a surface which goes on beyond it; None if rays past
            edges do not meet surfaces in which the edges lie.
        stratified_bits: see ``trace_to_surface``.
    """
    towards, distance = dr.normalize(direction), dr.norm(direction)
    start = mi.Point3f(origin + direction * RAY_EPSILON)  # type: ignore[operator]
    touches = crossed = rests = mi.Bool(False)
    rays, touched = inputs.rays, mi.UInt32(0)
    if resting is not None:
        early = mi.Point3f(origin - direction * _START_OFFSET)  # type: ignore[operator]
        reach = mi.Float(2 * _START_OFFSET * distance)
        found = rays.find_nearest(mi.Ray3f(early, mi.Vector3f(towards), reach, 0.0, []), active)
        touched = dr.select(found.valid, found.point.face, rays.fallback_face)
        touches = found.valid & ~_is_beside(rays, edge_point[0], touched)
        rests = dr.gather(mi.UInt32, resting, edge_point[0]) > 0
        crossed, in_plane = _has_crossed(rays, edge_point, touched, direction, rests)
        rests &= in_plane
        start = dr.select(touches, early, start)
    ray = mi.Ray3f(start, mi.Vector3f(towards))
    hit = sheets.trace_to_surface(
        inputs, ray, active, key, coherent=False, stratified_bits=stratified_bits
    )
    touches &= hit.point.face == touched
    # Motion that opens a gap and motion that closes it have two slopes: half of each counts.
    probability = dr.select(touches & rests, 2.0, 1.0) * hit.probability
    return replace(hit, valid=hit.valid & ~(touches & crossed), probability=probability)


def _is_beside(rays: RayScene, edge: mit.UInt32, face: mit.UInt32) -> mit.Bool:
    """Compute the mask of triangles that are at edges."""
    found = mi.Bool(False)
    topology = rays.topology
    for column, apex in zip(topology.device_edge_faces, topology.device_edge_apexes, strict=True):
        is_there = dr.gather(mi.Int32, apex, edge) >= 0
        found |= is_there & (dr.gather(mi.UInt32, column, edge) == face)
    return found


def _has_crossed(
    rays: RayScene,
    edge_point: tuple[mit.UInt32, mit.Float],
    face: mit.UInt32,
    direction: mit.Vector3f,
    resting: mit.Bool,
) -> tuple[mit.Bool, mit.Bool]:
    """Compute the masks of points on edges behind triangles and in their planes, in float64.

    Of edges that end in surfaces, those are behind whose own triangles are.
    """
    y0, y1 = rays.exact_ends(edge_point[0])
    p0, p1, p2 = map(rays.exact_vertex, dr.gather(mi.Vector3u, rays.topology.device_faces, face))
    normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
    normal = -dr.mulsign(normal, dr.dot(normal, mi.Vector3d(direction)))
    height = dr.dot(normal, y0 + (y1 - y0) * mi.Float64(edge_point[1]) - p0)
    crossed = height < -PLANE_TOLERANCE
    for column in rays.topology.device_edge_apexes:
        apex = dr.gather(mi.Int32, column, edge_point[0])
        offset = rays.exact_vertex(mi.UInt32(dr.maximum(apex, 0))) - p0
        crossed |= resting & (apex >= 0) & (dr.dot(normal, offset) < -PLANE_TOLERANCE)
    return crossed, dr.abs(height) <= PLANE_TOLERANCE


def is_not_grazing(
    rays: RayScene, face: mit.UInt32, direction: mit.Vector3f, active: mit.Bool
) -> mit.Bool:
    """Compute the mask of rays that are not in the plane of the triangle they meet.

    Args:
        rays: ray scene.
        face: index of the triangle that each ray meets.
        direction: direction of each ray [lane, 3].
        active: mask of valid rays.
    """
    normal = surface_point.face_normal(rays.corners(face, active))
    return active & (dr.abs(dr.dot(normal, direction)) > _MIN_GRAZING_COSINE * dr.norm(direction))


def shadow_speed(
    inputs: Inputs, samples: SilhouetteSample, source: mit.Point3f
) -> tuple[surface_point.SurfacePoint, mit.Float]:
    """Compute the velocity of the shadow boundary that edges cast from attached positions.

    ``T · (x_c − x_m)``: x_c is the point at which the attached ray meets the attached plane behind
    the edge, x_m the material point under it; T is the edge's image, oriented to the shadowed
    side.
    Source: derivations §3.

    Args:
        inputs: attached inputs.
        samples: points on edges.
        source: positions of the antennas or surface points that cast the shadow, attached.

    Returns:
        The shadow points, detached, and the illuminated area gained per unit of θ over the
        sampling density, attached.
    """
    c, fixed = source, inputs.detach()
    ends = (dr.gather(mi.UInt32, e, samples.edge) for e in inputs.rays.topology.device_edges)
    y0, y1 = (gather_points(inputs.vertices, end) for end in ends)
    y = y0 + (y1 - y0) * samples.edge_parameter  # type: ignore[operator]
    triangle = p0, p1, p2 = integrand.corners(inputs, samples.face)
    plane = dr.cross(p1 - p0, p2 - p0)
    moving = c + (y - c) * (dr.dot(plane, p0 - c) / dr.dot(plane, y - c))

    detached = integrand.corners(fixed, samples.face)
    shadow, normal = dr.detach(moving), surface_point.face_normal(detached)
    b1, b2 = surface_point.barycentric_coordinates(shadow, detached)
    material = surface_point.interpolate_position(triangle, b1, b2)

    ray, edge = dr.detach(y - c), dr.detach(y1 - y0)
    stretch = dr.norm(shadow - dr.detach(c)) / dr.norm(ray)
    slope = 1 / dr.dot(normal, ray)

    def project_to_surface(vector: mit.Vector3f) -> mit.Vector3f:
        return stretch * (vector - ray * (dr.dot(normal, vector) * slope))

    tangent = dr.mulsign(dr.cross(normal, project_to_surface(edge)), samples.side * slope)
    speed = dr.dot(tangent, moving - material) * samples.weight
    return surface_point.SurfacePoint(samples.face, b1, b2), speed
