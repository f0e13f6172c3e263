"""Where shadows end: points on edges, what falls behind them, and how fast it moves.

Family 1 looks from an antenna past its silhouettes; family 2 starts at an edge and looks both
ways along a direction that is tangential there, so that no silhouette is ever searched per vertex
(derivations §3). Places are detached, ``shadow_speed`` is attached.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power.discrete import DiscreteSampler, balance_by_object, sample_edge_point
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.mesh_folds import is_hidden_by_fold
from invertwin.channel.power.transmission import SegmentHit, trace_to_surface, trace_transmission
from invertwin.channel.rays.arrays import gather_points, interpolate_position, scramble_seed
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.intersections import PLANE_TOLERANCE
from invertwin.channel.rays.ray_scene import RAY_EPSILON, RayScene

_MIN_GRAZING_COSINE = (
    1e-5  # least cosine between a boundary ray and the normal of the shadowed surface
)
# Boundary rays start beside the edge, by this much (two roundings) of its distance from the origin
# and its length: its own triangles, nearly edge-on, would else lie in their way.
_EDGE_OFFSET = 1e-7
_MISS_DISTANCE = (
    2 * RAY_EPSILON
)  # how far off an edge, of its distance, rays may miss what they meet
_START_OFFSET = (
    3e-5  # how much before an edge, of its distance, such rays start among close surfaces
)
_MIN_OPENING = 1e-6  # least opening [rad] of an edge that can hide something


@dataclass(frozen=True)
class SilhouetteSample:
    """Points on edges and the triangle on which their shadow falls (Dr.Jit arrays).

    ``open`` and ``covered`` are the transmittances of the edge's own triangles: 1 where there is
    none, 0 where it is opaque. The covered side is that of the triangle that leaves the plane
    through edge and ray most.
    """

    index: Any  # of the sample
    is_receiver: (
        Any  # whether it is the receiver's silhouette; False where one serves both antennas
    )
    frame: Any  # radar pose
    first_vertex: Any  # vertices at the ends of the edge
    second_vertex: Any
    side: Any  # ±1: whether ray × edge points to the covered side
    edge_parameter: Any  # place from the first end to the second, 0 to 1
    face: Any  # triangle on which the shadow falls
    weight: Any  # one over (samples × probability per ``along``)
    transmittance: Any  # of all other sheets on the way, and the length [m] that these add
    extra_length: Any
    open_transmittance: Any  # beside the edge, on the other side
    open_extra_length: Any
    covered_transmittance: Any  # on the covered side
    covered_extra_length: Any

    @property
    def size(self) -> int:
        """How many there are."""
        return dr.width(self.face)

    def sides(self, inputs: Inputs) -> list[tuple[float, Any, Any]]:
        """Sign, transmittance and extra length of either side of the shadow's edge."""
        lit = (
            1.0,
            self.transmittance * self.open_transmittance,
            self.extra_length + self.open_extra_length,
        )
        if not inputs.surfaces.has_sheets:
            return [lit]
        return [
            lit,
            (
                -1.0,
                self.transmittance * self.covered_transmittance,
                self.extra_length + self.covered_extra_length,
            ),
        ]


@dataclass(frozen=True)
class ShadowBoundaryPoint:
    """A point on a shadow's edge."""

    b1: Any  # barycentric coordinates, detached
    b2: Any
    speed: Any  # area newly lit per unit of θ, attached


@dataclass(frozen=True)
class SampleBatch:
    """Edge points of which some are void: recorded, and executed when asked for."""

    valid: Any  # which are not void
    records: tuple[Any, ...]  # dataclasses of arrays
    factory: Callable[..., Any]  # makes the points of them

    def launch(self) -> None:
        """Start the execution, without waiting for it."""
        dr.eval(self.valid, *self.records)

    def compress(self) -> Any:
        """The points that are not void."""
        self.launch()
        lanes: Any = dr.compress(self.valid)
        return self.factory(
            *(
                type(group)(
                    *(
                        c if c is False else dr.gather(type(c), c, lanes)
                        for c in vars(group).values()
                    )
                )
                for group in self.records
            )
        )


class SilhouetteSampler:
    """Points on the silhouettes seen from one antenna or both, and where their shadows fall.

    An edge is a silhouette if all its triangles lie, as seen from the antenna, on one side of
    it: one triangle for an open edge, two for a fold, any number for a non-manifold edge. The
    rule needs no consistent winding. Of sheets, every edge counts at which they let through
    more on one side than on the other.

    Args:
        rays: The scene and its antennas.
        inputs: Detached tables.
        antennas: Antennas whose silhouettes count: ``tx``, ``rx`` or both.
        samples: Points over all frames and scenes.
        seed: Of the points.
        has_close_surfaces: Whether other surfaces may be close to edges.
    """

    def __init__(
        self,
        rays: RayScene,
        inputs: Inputs,
        antennas: Sequence[str],
        samples: int,
        seed: int,
        *,
        has_close_surfaces: bool = False,
    ) -> None:
        topology = rays.topology
        self.rays, self.inputs, self.antennas, self.has_close_surfaces = (
            rays,
            inputs,
            antennas,
            has_close_surfaces,
        )
        entries = len(antennas) * rays.poses_per_scene * len(topology.edges)
        edge, _, receiver, origin = self._decode_entry(dr.arange(mi.UInt32, entries))
        y0, y1 = rays.exact_ends(edge)
        ends = [mi.Vector3d(y - mi.Vector3d(origin)) for y in (y0, y1)]
        sides = _classify_sides(rays, inputs, edge, 0.5 * (ends[0] + ends[1]))
        self.size = samples if entries else 0
        if self.size:
            seen = mi.Float(dr.atan2(dr.norm(dr.cross(*ends)), dr.dot(*ends)))
            counts = sides.has_contrast
            if rays.differentiated_objects is not None:
                counts &= rays.differentiated_objects.has_edge(
                    edge
                ) | rays.differentiated_objects.may_receive_shadow(edge, origin, y0, y1)
            weight = dr.select(counts, seen * sides.contrast, 0.0)
            self.choice = DiscreteSampler(
                balance_by_object(rays, edge, weight, receiver, len(antennas))
            )
        self.seed, self.transmission_seed = scramble_seed(seed, 3), scramble_seed(seed, 9)

    def _decode_entry(self, entry: Any) -> tuple[Any, Any, Any, Any]:
        """Edge, frame, whether the antenna is the receiver of two, and its place."""
        rays, edges = self.rays, len(self.rays.topology.edges)
        look, edge = entry // edges, entry % edges
        first = rays.edge_scene(edge) * rays.poses_per_scene
        if len(self.antennas) == 1:
            frame = first + look
            return edge, frame, False, gather_points(getattr(rays, self.antennas[0]), frame)
        receiver = look >= rays.poses_per_scene
        frame = first + dr.select(receiver, look - rays.poses_per_scene, look)
        origin = dr.select(receiver, gather_points(rays.rx, frame), gather_points(rays.tx, frame))
        return edge, frame, receiver, origin

    def draw(self, index: Any) -> SampleBatch:
        """The samples of the given indices below ``size``; those without a shadow are void."""
        rays, topology = self.rays, self.rays.topology
        place, along, pmf = sample_edge_point(self.choice, index, self.size, self.seed)
        edge, frame, receiver, origin = self._decode_entry(place)
        first, second = (dr.gather(mi.UInt32, ends, edge) for ends in topology.device_edges)
        y0, y1 = rays.exact_ends(edge)
        y = y0 + (y1 - y0) * mi.Float64(along)
        exact = y - mi.Vector3d(origin)
        sides = _classify_sides(rays, self.inputs, edge, exact)
        aside = _EDGE_OFFSET * (dr.norm(y) + dr.norm(y1 - y0))
        beside, away = mi.Point3f(y + sides.outward * aside), mi.Vector3f(exact)
        reach = beside - away * _START_OFFSET if self.has_close_surfaces else beside
        before = trace_transmission(rays, self.inputs, reach, origin, pmf > 0)
        valid = (pmf > 0) & (before.transmittance > 0) & sides.has_contrast
        key = index, self.transmission_seed
        hit = _trace_past_edge(
            rays,
            self.inputs,
            (edge, along),
            beside,
            away,
            valid,
            key,
            has_close_surfaces=self.has_close_surfaces,
            stratified_bits=index,
        )
        valid &= hit.valid & _is_not_grazing(rays, hit.face, away, hit.valid)
        valid &= rays.is_in_scene(frame, hit.face, hit.valid)
        if rays.differentiated_objects is not None:
            valid &= rays.differentiated_objects.has_edge(
                edge
            ) | rays.differentiated_objects.has_face(hit.face, hit.valid)
        # Last, since it takes longest: packets without a shadow spare it.
        near = _MISS_DISTANCE * dr.norm(exact)
        valid &= ~is_hidden_by_fold(rays, edge, y, exact, sides.outward, aside, near, valid)
        found = SilhouetteSample(
            index,
            receiver,
            frame,
            first,
            second,
            sides.side,
            along,
            hit.face,
            weight=1 / (pmf * self.size * hit.probability),
            transmittance=before.transmittance * hit.transmittance,
            extra_length=before.extra_length + hit.extra_length,
            open_transmittance=sides.open_transmittance,
            open_extra_length=sides.open_extra_length,
            covered_transmittance=sides.covered_transmittance,
            covered_extra_length=sides.covered_extra_length,
        )
        return SampleBatch(valid, (found,), lambda points: points)


@dataclass(frozen=True)
class _EdgeSides:
    """What an edge's triangles let through on either side of a direction; see
    ``SilhouetteSample``.
    """

    side: Any
    open_transmittance: Any
    open_extra_length: Any
    covered_transmittance: Any
    covered_extra_length: Any
    outward: Any  # unit direction off the covered side; zero where there is something on both

    @property
    def contrast(self) -> Any:
        """How much of what passes changes from side to side; little where only its length does."""
        return dr.abs(self.open_transmittance - self.covered_transmittance) + 0.05 * (
            self.open_transmittance + self.covered_transmittance
        )

    @property
    def has_contrast(self) -> Any:
        """Whether the sides differ by more than rounding."""
        same_length = dr.abs(self.open_extra_length - self.covered_extra_length) <= 1e-7
        return ~(
            (dr.abs(self.open_transmittance - self.covered_transmittance) <= 1e-6) & same_length
        )


def _classify_sides(rays: RayScene, inputs: Inputs, edge: Any, direction: Any) -> _EdgeSides:
    """Sort an edge's triangles by the side of the plane through edge and direction they lie on.

    An opaque edge is a silhouette if nothing is on one side. In float64: the triangles of a fine
    mesh are nearly edge-on where they end a shadow.
    """
    topology = rays.topology
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
    transmittances, lengths = [mi.Float(1.0), mi.Float(1.0)], [mi.Float(0.0), mi.Float(0.0)]
    for number, (offset, height) in enumerate(zip(offsets, heights, strict=True)):
        transmittance, extra = mi.Float(0.0), mi.Float(0.0)
        if inputs.surfaces.has_sheets:
            face = dr.gather(mi.UInt32, topology.device_edge_faces[number], edge)
            row = dr.gather(mi.UInt32, inputs.face_surface, face)
            normal = dr.cross(y1 - y0, offset)
            cosine = dr.abs(dr.dot(normal, direction)) / (dr.norm(normal) * dr.norm(direction))
            transmittance, extra = inputs.surfaces.sheet_transmission(
                row, mi.Float(cosine), height != 0
            )
        for index, on in enumerate((height * most < 0, height * most > 0)):
            transmittances[index] = dr.select(
                on, transmittances[index] * transmittance, transmittances[index]
            )
            lengths[index] = dr.select(on, lengths[index] + extra, lengths[index])
    free = (transmittances[0] == 1) & (lengths[0] == 0)
    outwards = dr.select(free, -dr.mulsign(dr.normalize(plane), most), 0.0)
    return _EdgeSides(
        mi.Float(dr.sign(most)),
        transmittances[0],
        lengths[0],
        transmittances[1],
        lengths[1],
        mi.Vector3d(outwards),
    )


def _trace_past_edge(
    rays: RayScene,
    inputs: Inputs,
    edge_point: tuple[Any, Any],
    origin: Any,
    direction: Any,
    active: Any,
    key: tuple[Any, Any],
    *,
    has_close_surfaces: bool,
    stratified_bits: Any = None,
) -> SegmentHit:
    """What lies behind points on edges.

    Where surfaces are close the ray starts before the edge, so that it meets those in which the
    edge lies; whether the edge is before them is decided in float64. In one that it has crossed, it
    hides nothing: there the curve of the crossing counts. Rays are traced one by one, since Embree
    loses some of those of a bundle that start close to a surface.

    Args:
        rays: Rays.
        inputs: Detached.
        edge_point: Edges, and where along them.
        origin: From where rays start, off the edge.
        direction: Their directions, as long as the edge is far away.
        active: Lanes.
        key: See ``trace_to_surface``.
        has_close_surfaces: Whether other surfaces may be close to edges.
        stratified_bits: See ``trace_to_surface``.
    """
    towards, distance = dr.normalize(direction), dr.norm(direction)
    past = mi.Ray3f(mi.Point3f(origin + direction * RAY_EPSILON), mi.Vector3f(towards))
    if not has_close_surfaces:
        return trace_to_surface(
            rays, inputs, past, active, key, coherent=False, stratified_bits=stratified_bits
        )
    early = mi.Ray3f(mi.Point3f(origin - direction * _START_OFFSET), mi.Vector3f(towards))
    hit = trace_to_surface(
        rays, inputs, early, active, key, coherent=False, stratified_bits=stratified_bits
    )
    point = interpolate_position(rays.corners(hit.face, hit.valid), hit.b1, hit.b2)
    near = hit.valid & (dr.norm(point - origin) < 2 * _START_OFFSET * distance)
    edge, along = edge_point
    own = mi.Bool(False)
    for beside_edge, apex in zip(
        rays.topology.device_edge_faces, rays.topology.device_edge_apexes, strict=True
    ):
        is_there = dr.gather(mi.Int32, apex, edge) >= 0
        own |= is_there & (dr.gather(mi.UInt32, beside_edge, edge) == hit.face)
    own &= near
    y0, y1 = rays.exact_ends(edge)
    p0, p1, p2 = map(
        rays.exact_vertex, dr.gather(mi.Vector3u, rays.topology.device_faces, hit.face)
    )
    normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
    height = dr.dot(normal, y0 + (y1 - y0) * mi.Float64(along) - p0)
    crossed = -dr.mulsign(height, dr.dot(normal, mi.Vector3d(direction))) < -PLANE_TOLERANCE
    again = trace_to_surface(
        rays, inputs, past, active & own, key, coherent=False, stratified_bits=stratified_bits
    )
    pairs = zip(vars(again).values(), vars(hit).values(), strict=True)
    hit = SegmentHit(*(dr.select(own, second, first) for second, first in pairs))
    return replace(hit, valid=hit.valid & ~(near & ~own & crossed))


def _is_not_grazing(rays: RayScene, face: Any, direction: Any, active: Any) -> Any:
    """A ray in the plane of the triangle it meets has no shadow point there."""
    p0, p1, p2 = rays.corners(face, active)
    normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
    return active & (dr.abs(dr.dot(normal, direction)) > _MIN_GRAZING_COSINE * dr.norm(direction))


def shadow_speed(inputs: Inputs, samples: SilhouetteSample, source: Any) -> ShadowBoundaryPoint:
    """How fast the shadow that an edge casts from an attached centre sweeps a surface.

    ``T · (x_c − x_m)``: x_c is where the attached ray meets the attached plane behind the edge,
    x_m the material point under it; T is the edge's image turned to the shadowed side.
    Source: derivations §3.

    Args:
        inputs: Attached tables.
        samples: On edges.
        source: From where the shadow is cast, attached.
    """
    c, fixed = source, inputs.detach()
    y0, y1 = integrand.edge_ends(inputs, samples.first_vertex, samples.second_vertex)
    y = y0 + (y1 - y0) * samples.edge_parameter
    triangle = p0, p1, p2 = integrand.corners(inputs, samples.face)
    plane = dr.cross(p1 - p0, p2 - p0)
    moving = c + (y - c) * (dr.dot(plane, p0 - c) / dr.dot(plane, y - c))

    f0, f1, f2 = integrand.corners(fixed, samples.face)
    shadow, normal = dr.detach(moving), dr.normalize(dr.cross(f1 - f0, f2 - f0))
    b1, b2 = barycentric_coordinates(shadow, f0, f1, f2)
    material = interpolate_position(triangle, b1, b2)

    ray, edge = dr.detach(y - c), dr.detach(y1 - y0)
    stretch = dr.norm(shadow - dr.detach(c)) / dr.norm(ray)
    slope = 1 / dr.dot(normal, ray)

    def project_to_surface(vector: Any) -> Any:
        return stretch * (vector - ray * (dr.dot(normal, vector) * slope))

    tangent = dr.mulsign(dr.cross(normal, project_to_surface(edge)), samples.side * slope)
    return ShadowBoundaryPoint(b1, b2, dr.dot(tangent, moving - material) * samples.weight)


def barycentric_coordinates(point: Any, p0: Any, p1: Any, p2: Any) -> tuple[Any, Any]:
    """Coordinates b1 and b2 of a point in the plane of a triangle.

    Args:
        point: The point.
        p0, p1, p2: Corners.
    """
    a, b, r = p1 - p0, p2 - p0, point - p0
    aa, ab, bb, ra, rb = dr.dot(a, a), dr.dot(a, b), dr.dot(b, b), dr.dot(r, a), dr.dot(r, b)
    determinant = dr.fma(aa, bb, -ab * ab)
    return (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant
