"""Boundary paths of any length: a shadow's edge, and the rest of the path on both sides of it.

Their value is zero; their derivative is the speed of the shadow's edge (attached) times what the
path would carry (detached). Delay and direction do not move with θ.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power import random_walk as walk
from invertwin.channel.power.bins import PathContribution
from invertwin.channel.power.integrand import Inputs, SurfaceInteraction
from invertwin.channel.power.interior_silhouettes import (
    InteriorSilhouetteSample,
    InteriorSilhouetteSampler,
)
from invertwin.channel.power.intersection_curves import (
    IntersectionCurveSampler,
    IntersectionPoint,
    intersection_curve_paths,
)
from invertwin.channel.power.random_walk import PathState, RandomWalk
from invertwin.channel.power.silhouettes import (
    SampleBatch,
    ShadowBoundaryPoint,
    SilhouetteSample,
    SilhouetteSampler,
    shadow_speed,
)
from invertwin.channel.power.transmission import SegmentTransmission
from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.intersections import IntersectionCurves
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.sampling import Sampling


@dataclass(frozen=True)
class BoundaryPaths:
    """Boundary paths that share the speeds of their shadow edges, one lane a speed.

    Attributes:
        speed: Area newly lit per unit of θ, over the sampling density; attached.
        state: The paths at the shadow points, with unit speed.
        run: Walks them, and shows each path and whether it exists to a visitor.
    """

    speed: Any
    state: PathState
    run: Callable[[PathState, Callable[[PathState, PathContribution, Any], None]], PathState]

    def sum_weighted(self, gather: Callable[[PathContribution, Any], Any]) -> Any:
        """Σ over a lane's paths of power × ``gather(path)``."""

        def visit(state: PathState, path: PathContribution, exists: Any) -> None:
            amount = gather(path, exists) * path.power
            state["total"] = state["total"] + dr.select(exists, amount, 0.0)

        state = dict(self.state)
        state["total"] = dr.zeros(mi.Float, dr.width(self.speed))
        with dr.suspend_grad():
            return self.run(state, visit)["total"]

    def deposit(self, rate: Any, scatter: Callable[[PathContribution, Any], None]) -> None:
        """Pass on every path with its power times a lane's rate.

        Args:
            rate: Of each lane.
            scatter: Takes a path and whether it exists.
        """
        state = dict(self.state)
        state["throughput"] = state["throughput"] * dr.detach(rate)
        with dr.suspend_grad():
            self.run(state, lambda _, path, exists: scatter(path, exists))


class BoundarySamples:
    """The points of all boundary paths: antenna segments, interior ones, contacts of surfaces.

    The first of each family are drawn at once, without waiting for them: this is prepared while
    another kernel runs. They are given away once, so that they take no memory later; the rest, and
    all of them when they are asked for again, are drawn anew, to the same points.
    """

    def __init__(
        self,
        rays: RayScene,
        inputs: Inputs,
        sampling: Sampling,
        seed: int,
        curves: IntersectionCurves | None = None,
        *,
        chunks: Callable[[int], Iterator[Any]],
    ) -> None:
        """Where both antennas share one visibility, a path of one vertex has one segment, not two.

        Args:
            rays: Rays and antennas.
            inputs: Detached.
            sampling: How many edge points over all families, and the most vertices of a path.
            seed: Of the edge points.
            curves: Where surfaces meet; None where they cannot.
            chunks: Splits a number of samples into index arrays.
        """
        self.depth = depth = sampling.depth
        samples = sampling.boundary_samples * rays.scene_count
        centres = ("tx",) if rays.link.shared_visibility and depth == 1 else ("tx", "rx")
        inner = depth > 1 and sampling.interior_edges
        close = curves is not None and curves.has_close_surfaces
        crossing = curves.select(~curves.touching) if curves is not None else None
        meet = crossing is not None and len(crossing.first) > 0
        share = samples // (len(centres) + inner + meet)
        antennas = SilhouetteSampler(
            rays, inputs, centres, len(centres) * share, seed, has_close_surfaces=close
        )
        self._samplers: list[Any] = [antennas]
        self._path_builders: list[Callable[..., Iterator[BoundaryPaths]]] = [
            _antenna_silhouette_paths
        ]
        if inner:
            self._samplers.append(
                InteriorSilhouetteSampler(rays, inputs, share, seed + 2, has_close_surfaces=close)
            )
            self._path_builders.append(_interior_silhouette_paths)
        if crossing is not None and meet:
            self._samplers.append(
                IntersectionCurveSampler(rays, inputs, crossing, share, depth, seed)
            )
            self._path_builders.append(_intersection_curve_paths)
        self._chunks = chunks
        self._prefetched = [
            list(map(s.draw, itertools.islice(chunks(s.size), 1))) for s in self._samplers
        ]
        for family in self._prefetched:
            for drawn in family:
                drawn.launch()

    def iterate_families(
        self,
    ) -> list[Iterator[tuple[Callable[..., Iterator[BoundaryPaths]], Any]]]:
        """What makes paths of the points, and the points, a chunk at a time."""
        ahead, self._prefetched = self._prefetched, [[] for _ in self._samplers]
        first = [[drawn.compress() for drawn in family] for family in ahead]
        # Each sampler is bound here: a generator expression would draw all of them from the last.
        later = [
            map(
                SampleBatch.compress,
                map(s.draw, itertools.islice(self._chunks(s.size), len(now), None)),
            )
            for s, now in zip(self._samplers, first, strict=True)
        ]
        return [
            zip(itertools.repeat(kind), itertools.chain(*family))
            for kind, *family in zip(self._path_builders, first, later, strict=True)
        ]


def trace_boundary_paths(
    rays: RayScene, inputs: Inputs, walker: RandomWalk, samples: BoundarySamples
) -> Iterator[BoundaryPaths]:
    """The boundary paths through edge points.

    The first points are counted now, so that their paths are prepared while another kernel runs.

    Args:
        rays: The scene and its antennas.
        inputs: Attached tables.
        walker: Continues the paths.
        samples: On edges.
    """
    families = samples.iterate_families()

    def segments() -> Iterator[BoundaryPaths]:
        for kind, found in itertools.chain(*families):
            if found.size:
                yield from kind(rays, inputs, walker, found, samples.depth)

    return segments()


def _intersection_curve_paths(
    rays: RayScene, inputs: Inputs, walker: RandomWalk, points: IntersectionPoint, depth: int
) -> Iterator[BoundaryPaths]:
    """Surfaces that meet: either hides what lies behind it of the other."""
    return itertools.starmap(
        BoundaryPaths, intersection_curve_paths(rays, inputs, walker, points, depth)
    )


def _antenna_silhouette_paths(
    rays: RayScene, inputs: Inputs, walker: RandomWalk, samples: SilhouetteSample, depth: int
) -> Iterator[BoundaryPaths]:
    """Family 1: the shadow that an edge casts from an antenna, then the path to the other one."""
    at_receiver = samples.is_receiver
    fixed, frame = inputs.detach(), samples.frame
    shared = rays.link.shared_visibility

    def locate_shadow() -> ShadowBoundaryPoint:
        return shadow_speed(inputs, samples, inputs.antenna_position(frame, at_receiver))

    shadow = locate_shadow()
    point = integrand.compute_interaction(fixed, samples.face, shadow.b1, shadow.b2)
    back, distance = integrand.direction_and_distance(
        point.position, fixed.antenna_position(frame, at_receiver)
    )
    seen = integrand.to_radar_frame(fixed, frame, -back)
    throughput = fixed.scale * fixed.gain(frame, at_receiver, seen) / dr.square(distance)

    def run(
        state: PathState, visit: Callable[[PathState, PathContribution, Any], None]
    ) -> PathState:
        def visit_connection(state: PathState, point: SurfaceInteraction) -> None:
            to_receiver = state.get("to_receiver", True)
            # What both antennas see of a single vertex is due to the transmitter's shadows alone.
            least = dr.select(to_receiver, 1, 2) if shared and to_receiver is not True else 1
            path, exists = walk.connect_path(
                rays, fixed, state, point, to_receiver, min_vertices=least, shared_visibility=shared
            )
            visit(state, path, exists)

        return walker.run(state, depth, visit_connection)

    for number, (sign, transmittance, extra) in enumerate(samples.sides(fixed)):
        state = walk.initial_state(
            samples.index,
            frame,
            samples.face,
            shadow.b1,
            shadow.b2,
            back,
            throughput=throughput * transmittance * sign,
            length=distance + extra,
            transmission=SegmentTransmission(transmittance, extra)
            if fixed.surfaces.has_sheets
            else None,
        )
        if at_receiver is not False:
            state |= {"u": seen.x, "v": seen.y, "to_receiver": ~at_receiver}
        # Anew for each side: a derivative taken uses the speed up.
        speed = shadow.speed if number == 0 else locate_shadow().speed
        yield BoundaryPaths(speed, state, run)


def _interior_silhouette_paths(
    rays: RayScene,
    inputs: Inputs,
    walker: RandomWalk,
    samples: InteriorSilhouetteSample,
    depth: int,
) -> Iterator[BoundaryPaths]:
    """Family 2: a shadow that one surface point casts past an edge on another surface.

    The part from the point behind has a drawn number of vertices; that from the shadow, all that
    the depth leaves. Which of them ends at the receiver is drawn too: both orders are complete.
    """
    fixed, points = inputs.detach(), samples.silhouette
    source = samples.source
    behind = integrand.compute_interaction(fixed, source.face, source.b1, source.b2)

    def locate_shadow() -> ShadowBoundaryPoint:
        moving = integrand.compute_interaction(inputs, source.face, source.b1, source.b2)
        return shadow_speed(inputs, points, moving.position)

    shadow = locate_shadow()
    ahead = integrand.compute_interaction(fixed, points.face, shadow.b1, shadow.b2)
    to_behind, distance = integrand.direction_and_distance(ahead.position, behind.position)
    inside = integrand.find_medium(fixed, ahead, behind, to_behind, mi.Bool(True))
    choices = opaque(depth - 1)
    count = 1 + (points.index // 2) % choices
    ends_at_receiver = (points.index % 2) == 1
    kept = dr.exp(-inside.attenuation * distance)
    throughput = fixed.scale * mi.Float(choices) * kept / dr.square(distance)
    distance = inside.refractive_index * distance
    lanes = dr.width(points.face)
    zero = dr.zeros(mi.Float, lanes)
    first = walk.initial_state(
        points.index, points.frame, source.face, source.b1, source.b2, -to_behind,
        throughput, zero,
    )  # fmt: skip
    done = walker.trace_subpath(first, count, ends_at_receiver)

    def run(
        state: PathState, visit: Callable[[PathState, PathContribution, Any], None]
    ) -> PathState:
        def visit_connection(state: PathState, point: SurfaceInteraction) -> None:
            path, exists = walk.connect_path(rays, fixed, state, point, state["to_receiver"])
            visit(state, path, exists)

        return walker.run(state, choices + 1 - count, visit_connection)

    for number, (sign, transmittance, extra) in enumerate(points.sides(fixed)):
        state = walk.initial_state(
            points.index + _SECOND_SIDE_OFFSET,
            points.frame,
            points.face,
            shadow.b1,
            shadow.b2,
            to_behind,
            throughput=done["amount"] * transmittance * sign,
            length=done["so_far"] + distance + extra,
        )
        state |= {"u": done["u"], "v": done["v"], "to_receiver": ~ends_at_receiver}
        state["earlier"] = count
        speed = shadow.speed if number == 0 else locate_shadow().speed
        yield BoundaryPaths(speed, state, run)


_SECOND_SIDE_OFFSET = 1 << 30  # so that both sides of a segment draw their own numbers
