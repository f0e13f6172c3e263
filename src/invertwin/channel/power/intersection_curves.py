"""Boundary paths of the curves in which surfaces meet: what lies behind the other is hidden.

With both unit normals turned to where a path comes from, each surface is seen on the side that the
other's normal points to. As θ moves, the curve sweeps ``n_B · (x_A − x_B) / |n_A × n_B|`` of the
surface A per metre, with the material points x_A and x_B of the curve's point; B likewise
(derivations §3). Any vertex of a path may lie on the curve.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power import random_walk as walk
from invertwin.channel.power.bins import PathContribution
from invertwin.channel.power.discrete import DiscreteSampler, balance_by_scene, sample_edge_point
from invertwin.channel.power.integrand import Inputs, SurfaceInteraction, SurfacePoint
from invertwin.channel.power.random_walk import PathState, RandomWalk
from invertwin.channel.power.silhouettes import SampleBatch, barycentric_coordinates
from invertwin.channel.power.transmission import (
    SegmentTransmission,
    trace_to_surface,
    trace_transmission,
)
from invertwin.channel.rays.arrays import (
    gather_points,
    opaque,
    scramble_seed,
    to_index,
    to_points,
    uniform_pair,
)
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.intersections import IntersectionCurves
from invertwin.channel.rays.ray_scene import RAY_EPSILON, RayScene
from invertwin.errors import InputError

_CHECKED_POINTS = 65_536  # points that tell whether paths run between surfaces that meet
_MIN_WEDGE_COSINE = -0.98  # least cosine between the normals of surfaces between which rays start


@dataclass(frozen=True)
class IntersectionSample:
    """What is drawn of points of the curve.

    Attributes:
        index: Number of the sample.
        frame: Radar pose.
        weight: One over (samples × probability per metre).
        transmittance, extra_length: Of the sheets on the way to where the path comes from.
    """

    index: Any
    frame: Any
    weight: Any
    transmittance: Any
    extra_length: Any


@dataclass(frozen=True)
class IntersectionPoint:
    """Points of the curve.

    Attributes:
        sample: What is drawn of them.
        first, second: On either surface.
        source: The surface points from which paths come, if not from an antenna.
    """

    sample: IntersectionSample
    first: SurfacePoint
    second: SurfacePoint
    source: SurfacePoint

    @property
    def size(self) -> int:
        """How many there are."""
        return dr.width(self.sample.index)


class IntersectionCurveSampler:
    """Points of the curves in which surfaces meet, and where paths come from that pass there."""

    def __init__(
        self,
        rays: RayScene,
        inputs: Inputs,
        curves: IntersectionCurves,
        samples: int,
        depth: int,
        seed: int,
    ) -> None:
        """Prepare the choice of segments.

        Args:
            rays: The scene and its antennas.
            inputs: Detached tables.
            curves: Segments of the curves.
            samples: How many points are drawn.
            depth: Most vertices of a path.
            seed: Of the points.
        """
        self.rays, self.inputs, self.size, self.depth = rays, inputs, samples, depth
        ends = [(end - rays.origin).float() for end in (curves.start, curves.end)]
        self.ends = list(map(to_points, ends))
        self.faces = [to_index(face) for face in (curves.first, curves.second)]
        self.segments = len(curves.first)
        owner = rays.geometry.face_object[curves.first]
        self.first_frame = rays.object_scene(to_index(owner)) * rays.poses_per_scene
        entries = dr.arange(mi.UInt32, self.segments * rays.poses_per_scene)
        start, offset, frame = self._segment(entries)
        legs = [dr.norm(start + 0.5 * offset - gather_points(t, frame)) for t in (rays.tx, rays.rx)]
        weight = dr.norm(offset) / (legs[0] * legs[1])
        self.choice = DiscreteSampler(balance_by_scene(rays, rays.frame_scene(frame), weight))
        self.seeds = [scramble_seed(seed, stream) for stream in (12, 13, 14)]

    def _segment(self, entry: Any) -> tuple[Any, Any, Any]:
        segment = entry % self.segments
        start, end = (gather_points(ends, segment) for ends in self.ends)
        frame = entry // self.segments
        if self.rays.scene_count > 1:
            frame += dr.gather(mi.UInt32, self.first_frame, segment)
        return start, end - start, frame

    def draw(self, index: Any) -> SampleBatch:
        """The samples of the given indices below ``size``; those out of sight are void."""
        rays, inputs, deep = self.rays, self.inputs, self.depth > 1
        entry, along, chance = sample_edge_point(self.choice, index, self.size, self.seeds[0])
        start, offset, frame = self._segment(entry)
        x, valid = start + offset * along, chance > 0
        spots = []
        for faces in self.faces:
            face = dr.gather(mi.UInt32, faces, entry % self.segments)
            spots.append(SurfacePoint(face, *barycentric_coordinates(x, *rays.corners(face))))
        places = [spot.place(inputs) for spot in spots]
        normals = [place.normal for place in places]
        count, receiver = decode_subpath(index, self.depth)
        antenna = inputs.antenna_position(frame, receiver)
        way = dr.normalize(antenna - x)
        if deep:
            numbers = mi.Point2f(*uniform_pair(index, self.seeds[1]))
            sphere = mi.Vector3f(mi.warp.square_to_uniform_sphere(numbers))
            way = dr.select(count > 0, sphere, way)
        origin = _offset_into_wedge(places[0], normals, way).position
        seen = trace_transmission(rays, inputs, origin, antenna, valid & (count == 0))
        exists, transmittance, extra = seen.transmittance > 0, seen.transmittance, seen.extra_length
        odds, source = mi.Float(1.0), SurfacePoint(mi.UInt32(0), mi.Float(0.0), mi.Float(0.0))
        if deep:
            ray, key = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(way)), (index, self.seeds[2])
            hit = trace_to_surface(rays, inputs, ray, valid & (count > 0), key, coherent=False)
            met = hit.valid & rays.is_in_scene(frame, hit.face, hit.valid)
            exists, odds, source = (
                exists | met,
                hit.probability,
                SurfacePoint(hit.face, hit.b1, hit.b2),
            )
            transmittance = dr.select(count > 0, hit.transmittance, transmittance)
            extra = dr.select(count > 0, hit.extra_length, extra)
        weight = dr.norm(offset) / (chance * self.size * odds)
        drawn = IntersectionSample(index, frame, weight, transmittance, extra)
        return SampleBatch(valid & exists, (drawn, *spots, source), IntersectionPoint)


def decode_subpath(index: Any, depth: int) -> tuple[Any, Any]:
    """How many surface points a path comes from, and whether it comes from the receiver.

    Args:
        index: Number of the sample.
        depth: Most vertices of a path.
    """
    if depth == 1:
        return mi.UInt32(0), False
    return (index // 2) % opaque(depth), (index % 2) == 1


def _offset_into_wedge(
    point: SurfaceInteraction, normals: Sequence[Any], direction: Any
) -> SurfaceInteraction:
    """The place a little off both surfaces, in the wedge between them that a direction leads to."""
    first, second = (dr.mulsign(normal, dr.dot(normal, direction)) for normal in normals)
    step = (
        2
        * RAY_EPSILON
        * dr.norm(point.position)
        / (1 + dr.maximum(dr.dot(first, second), _MIN_WEDGE_COSINE))
    )
    return replace(point, position=point.position + (first + second) * step)


def intersection_curve_paths(
    rays: RayScene, inputs: Inputs, walker: RandomWalk, points: IntersectionPoint, depth: int
) -> Iterator[tuple[Any, PathState, Callable[..., PathState]]]:
    """Speed, state and walk (see ``BoundaryPaths``) of the paths with a vertex on the curve.

    Args:
        rays: The scene and its antennas.
        inputs: Attached tables.
        walker: Continues the paths.
        points: Points of the curve.
        depth: Most vertices of a path.
    """
    fixed, drawn, spots = inputs.detach(), points.sample, (points.first, points.second)
    frame, index = drawn.frame, drawn.index
    places = [spot.compute_interaction(fixed) for spot in spots]
    count, at_receiver = decode_subpath(index, depth)
    shared = rays.link.shared_visibility and depth == 1
    other_end = True if depth == 1 else ~at_receiver
    back, distance = integrand.direction_and_distance(
        places[0].position, fixed.antenna_position(frame, at_receiver)
    )
    seen = integrand.to_radar_frame(fixed, frame, -back)
    throughput = fixed.gain(frame, at_receiver, seen) / dr.square(distance)
    length, more = distance + drawn.extra_length, {}
    if depth > 1:
        source, deep = points.source.compute_interaction(fixed, count > 0), count > 0
        way, step = integrand.direction_and_distance(places[0].position, source.position)
        inside = integrand.find_medium(fixed, places[0], source, way, deep)
        odds = dr.abs(dr.dot(source.normal, way)) / (4 * dr.pi)
        kept = dr.select(deep & (odds > 0), dr.exp(-inside.attenuation * step) / odds, 0.0)
        first = walk.initial_state(
            index, frame, points.source.face, points.source.b1, points.source.b2, -way,
            kept, inside.refractive_index * step + drawn.extra_length,
        )  # fmt: skip
        done = walker.trace_subpath(first, count, at_receiver)
        back, throughput = dr.select(deep, way, back), dr.select(deep, done["amount"], throughput)
        length = dr.select(deep, done["so_far"], length)
        more = {
            "to_receiver": other_end,
            "u": dr.select(deep, done["u"], seen.x),
            "v": dr.select(deep, done["v"], seen.y),
            "earlier": count,
        }
    normals = [place.normal for place in places]
    throughput *= fixed.scale * depth * drawn.transmittance
    for own, other in ((0, 1), (1, 0)):
        here, hiding = places[own], places[other]
        facing = dr.mulsign(hiding.normal, dr.dot(hiding.normal, back))
        sine = dr.norm(dr.cross(here.normal, hiding.normal))
        for sign in (1.0, -1.0) if fixed.surfaces.has_sheets else (1.0,):
            through = partial(_transmit_past_surface, fixed, hiding, facing * sign)

            def run(
                state: PathState,
                visit: Callable[[PathState, PathContribution, Any], None],
                here: SurfaceInteraction = here,
                through: Callable[[Any], tuple[Any, Any]] = through,
            ) -> PathState:
                end = fixed.antenna_position(frame, at_receiver if shared else other_end)
                onwards, _ = integrand.direction_and_distance(here.position, end)
                point = _offset_into_wedge(here, normals, onwards)
                path, exists = walk.connect_path(
                    rays, fixed, state, point, other_end, shared_visibility=shared
                )
                let, longer = through(onwards)
                path = replace(path, power=path.power * let, range=path.range + 0.5 * longer)
                visit(state, path, exists & (let > 0))
                if depth == 1:
                    return state

                def visit_connection(state: PathState, point: SurfaceInteraction) -> None:
                    end = state["to_receiver"]
                    visit(state, *walk.connect_path(rays, fixed, state, point, end))

                state["active"] &= count + 1 < opaque(depth)
                state = walker.step(state, _offset_into_wedge(here, normals, back))
                let, longer = through(-state["back"])
                state["active"] &= let > 0
                state["throughput"] = state["throughput"] * let
                state["length"] = state["length"] + longer
                return walker.run(state, opaque(depth) - count, visit_connection)

            let, longer = through(back)
            state = walk.initial_state(
                index + (1 << 29),
                frame,
                spots[own].face,
                spots[own].b1,
                spots[own].b2,
                back,
                throughput=throughput * let * sign,
                length=length + longer,
                transmission=SegmentTransmission(drawn.transmittance, drawn.extra_length)
                if shared
                else None,
            )
            apart = (
                spots[own].compute_interaction(inputs).position
                - spots[other].compute_interaction(inputs).position
            )
            speed = dr.dot(facing, apart) * (drawn.weight / sine)
            yield speed, state | more, run


def _transmit_past_surface(
    fixed: Inputs, sheet: SurfaceInteraction, facing: Any, direction: Any
) -> tuple[Any, Any]:
    """What a surface lets through of a way to its back, and the length that this adds."""
    cosine = dr.dot(facing, direction)
    if not fixed.surfaces.has_sheets:
        return dr.select(cosine > 0, 1.0, 0.0), mi.Float(0.0)
    let, longer = fixed.surfaces.sheet_transmission(sheet.surface_row, dr.abs(cosine))
    return dr.select(cosine > 0, 1.0, let), dr.select(cosine > 0, 0.0, longer)


def require_no_interreflection(
    rays: RayScene,
    fixed: Inputs,
    walker: RandomWalk,
    curves: IntersectionCurves,
    depth: int,
    seed: int,
) -> None:
    """Refuse paths between surfaces that meet: the derivative of such paths does not converge.

    There are some wherever a path with one vertex less runs by way of the curve and both surfaces
    scatter it.

    Args:
        rays: The scene and its antennas.
        fixed: Detached tables.
        walker: Continues the paths.
        curves: Where surfaces meet.
        depth: Most vertices of a path.
        seed: Of the points on the curve.

    Raises:
        InputError: There are such paths.
    """
    looked_at = _CHECKED_POINTS * rays.scene_count
    sampler = IntersectionCurveSampler(rays, fixed, curves, looked_at, depth - 1, seed)
    found = sampler.draw(dr.arange(mi.UInt32, sampler.size)).compress()
    if not dr.width(found.sample.index):
        return
    lit = [dr.zeros(mi.Bool, dr.width(found.sample.index)) for _ in range(2)]

    for number, (_, state, run) in enumerate(
        intersection_curve_paths(rays, fixed, walker, found, depth - 1)
    ):

        def visit(state: PathState, _: PathContribution, exists: Any) -> None:
            state["lit"] = state["lit"] | exists

        state["lit"] = dr.zeros(mi.Bool, dr.width(found.sample.index))
        lit[number % 2] |= run(state, visit)["lit"]
    both = lit[0] | lit[1] if fixed.surfaces.has_sheets else lit[0] & lit[1]
    lanes = dr.compress(both)
    if dr.width(lanes):
        faces = [dr.gather(mi.UInt32, spot.face, lanes[0]) for spot in (found.first, found.second)]
        owners = [int(rays.topology.face_object[int(face[0])]) for face in faces]
        names = " and ".join(dict.fromkeys(rays.geometry.names[owner] for owner in owners))
        raise InputError(
            f"expected no paths between surfaces that meet and move past each other, got {names} "
            f"at depth {depth}: the derivative of such paths does not converge; leave a gap, take "
            f"depth {depth - 1}, or contacts=False in Sampling, which leaves out what moves there"
        )
