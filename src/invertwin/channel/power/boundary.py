"""Boundary paths of any length: a point on a shadow boundary, and the rest of the path.

Their value is zero; their derivative is the velocity of the shadow boundary (attached) times the
contribution of the path (detached). Delay and direction do not depend on θ.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from invertwin.channel.power import integrand, intersection_curves
from invertwin.channel.power import random_walk as walk
from invertwin.channel.power.bins import PathContribution
from invertwin.channel.power.integrand import Inputs, SurfaceInteraction
from invertwin.channel.power.interior_silhouettes import InteriorSilhouetteSampler
from invertwin.channel.power.intersection_curves import IntersectionCurveSampler
from invertwin.channel.power.random_walk import PathState, RandomWalk
from invertwin.channel.power.silhouettes import SilhouetteSample, SilhouetteSampler, shadow_speed
from invertwin.channel.rays.arrays import opaque, to_index
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.intersections import IntersectionCurves
from invertwin.channel.rays.surface_point import SurfacePoint
from invertwin.channel.sampling import Sampling

_SECOND_PART_OFFSET = 1 << 30  # added to indices, so that both parts have their own random numbers


_Sampler = SilhouetteSampler | InteriorSilhouetteSampler | IntersectionCurveSampler
_PathBuilder = Callable[..., Iterator[intersection_curves.PathParts]]
"""Function of attached inputs, a walker, sampled points and the depth."""


@dataclass(frozen=True)
class BoundaryPaths:
    """Boundary paths that share the velocities of their shadow boundaries, one lane each.

    Attributes:
        speed: illuminated area gained per unit of θ, over the sampling density; attached.
        state: state of the paths at the shadow points, for unit velocity.
        run: walk of the paths; calls a visitor with the state, each path, and the mask of lanes in
            which it exists.
    """

    speed: mit.Float
    state: PathState
    run: Callable[[PathState, intersection_curves.PathVisitor], PathState]

    def sum_weighted(self, gather: Callable[[PathContribution, mit.Bool], mit.Float]) -> mit.Float:
        """Sum power × ``gather(path, exists)`` over the paths of each lane.

        Args:
            gather: weight of a path.
        """

        def visit(state: PathState, path: PathContribution, exists: mit.Bool) -> None:
            amount = gather(path, exists) * path.power
            state["total"] = state["total"] + dr.select(exists, amount, 0.0)

        state = self.state.copy()
        state["total"] = dr.zeros(mi.Float, dr.width(self.speed))
        with dr.suspend_grad():
            return self.run(state, visit)["total"]

    def deposit(
        self, rate: mit.Float, scatter: Callable[[PathContribution, mit.Bool], None]
    ) -> None:
        """Deposit every path, with its power times the rate of its lane.

        Args:
            rate: factor of each lane.
            scatter: function of a path and of the mask of lanes in which it exists.
        """
        state = self.state.copy()
        state["throughput"] = state["throughput"] * dr.detach(rate)
        with dr.suspend_grad():
            self.run(state, lambda _, path, exists: scatter(path, exists))


class BoundarySamples:
    """Points of all boundary paths: antenna silhouettes, interior silhouettes, intersection curves.

    The first chunk of each family is launched at once, without waiting for it: it is prepared while
    another kernel runs. It is returned once, so that it takes no memory later; the rest, and all of
    them on a second request, are drawn anew, with the same points. If one visibility test serves
    both antennas, a path of one vertex has one segment, not two.

    Args:
        inputs: detached inputs.
        sampling: number of points over all families, and most vertices of a path.
        seed: seed of the points.
        curves: intersection curves; None if surfaces cannot meet.
        chunks: function that splits a number of samples into index arrays.
    """

    def __init__(
        self,
        inputs: Inputs,
        sampling: Sampling,
        seed: int,
        curves: IntersectionCurves | None = None,
        *,
        chunks: Callable[[int], Iterator[mit.UInt32]],
    ) -> None:
        rays, depth = inputs.rays, sampling.depth
        self.depth = depth
        samples = sampling.boundary_samples * rays.scene_count
        centres = ("tx",) if rays.link.shared_visibility and depth == 1 else ("tx", "rx")
        inner = depth > 1 and sampling.interior_edges
        rests = torch.zeros(len(rays.topology.edges) + 1, dtype=torch.int64)
        if curves is not None:
            curves = curves.select(~curves.touching | (curves.edge >= 0))
            rests[curves.edge] = 1  # the last one stands for crossings
        meet = curves is not None and len(curves.first) > 0
        resting = to_index(rests) if sampling.contacts else None
        share = samples // (len(centres) + inner + meet)
        antennas = SilhouetteSampler(inputs, centres, len(centres) * share, seed, resting=resting)
        found: list[tuple[_Sampler, _PathBuilder]] = [(antennas, _antenna_silhouette_paths)]
        if inner:
            inside = InteriorSilhouetteSampler(inputs, share, seed + 2, resting=resting)
            found.append((inside, _interior_silhouette_paths))
        if curves is not None and meet:
            contacts = IntersectionCurveSampler(inputs, curves, share, depth, seed)
            found.append((contacts, intersection_curves.intersection_curve_paths))
        self._families, self._chunks = found, chunks
        self._prefetched = [
            list(map(s.draw, itertools.islice(chunks(s.size), 1))) for s, _ in self._families
        ]
        for drawn in itertools.chain(*self._prefetched):
            drawn.launch()

    def trace_paths(self, inputs: Inputs, walker: RandomWalk) -> Iterator[BoundaryPaths]:
        """Trace the boundary paths through the points.

        The first points of each family are compressed now, so that their paths are prepared while
        another kernel runs.

        Args:
            inputs: attached inputs.
            walker: random walk that extends the paths.
        """
        first = [[drawn.compress() for drawn in family] for family in self._prefetched]
        self._prefetched = [[] for _ in first]

        def paths() -> Iterator[BoundaryPaths]:
            for (sampler, build), ready in zip(self._families, first, strict=True):
                later = itertools.islice(self._chunks(sampler.size), len(ready), None)
                held = (ready.pop() for _ in range(len(ready)))
                for found in itertools.chain(held, (sampler.draw(k).compress() for k in later)):
                    if found.size:
                        parts = build(inputs, walker, found, self.depth)
                        yield from itertools.starmap(BoundaryPaths, parts)

        return paths()


def _antenna_silhouette_paths(
    inputs: Inputs, walker: RandomWalk, samples: SilhouetteSample, depth: int
) -> Iterator[intersection_curves.PathParts]:
    """First family: the shadow that an edge casts from an antenna, and the path to the other."""
    at_receiver = samples.is_receiver
    fixed, frame = inputs.detach(), samples.frame
    shared = inputs.rays.link.shared_visibility

    def locate_shadow() -> tuple[SurfacePoint, mit.Float]:
        return shadow_speed(inputs, samples, inputs.antenna_position(frame, at_receiver))

    shadow, speed = locate_shadow()
    point = integrand.compute_interaction(fixed, shadow)
    antenna = fixed.antenna_position(frame, at_receiver)
    incident, distance = integrand.direction_and_distance(point.position, antenna)
    departure = integrand.to_radar_frame(fixed, frame, -incident)
    throughput = fixed.scale * fixed.gain(frame, at_receiver, departure) / dr.square(distance)

    def run(state: PathState, visit: intersection_curves.PathVisitor) -> PathState:
        def visit_connection(state: PathState, point: SurfaceInteraction) -> None:
            to_receiver = state.get("to_receiver", True)
            # If one test serves both antennas, single vertices count in the transmitter's shadows.
            least = dr.select(to_receiver, 1, 2) if shared and to_receiver is not True else 1
            path, exists = walk.connect_path(
                fixed, state, point, to_receiver, min_vertices=least, shared_visibility=shared
            )
            visit(state, path, exists)

        return walker.run(state, depth, visit_connection)

    for number, (sign, passed) in enumerate(samples.sides(fixed)):
        power = throughput * passed.transmittance * sign
        length = distance + passed.extra_length
        sheets = passed if fixed.surfaces.has_sheets else None
        state = walk.initial_state(samples.index, frame, shadow, incident, power, length, sheets)
        if not isinstance(at_receiver, bool):
            state = walk.update_state(state, u=departure.y, v=departure.z, to_receiver=~at_receiver)
        # Anew for each side: a derivative consumes the graph of the velocity.
        yield (speed if number == 0 else locate_shadow()[1]), state, run


def _interior_silhouette_paths(
    inputs: Inputs, walker: RandomWalk, samples: SilhouetteSample, depth: int
) -> Iterator[intersection_curves.PathParts]:
    """Second family: a shadow that one surface point casts past an edge on another surface.

    The part before the shadow has a random number of vertices, the part after it all that the depth
    permits. A random bit decides which of them ends at the receiver: both orders are complete.
    """
    fixed, source = inputs.detach(), samples.source
    assert source is not None
    behind = integrand.compute_interaction(fixed, source)

    def locate_shadow() -> tuple[SurfacePoint, mit.Float]:
        return shadow_speed(inputs, samples, integrand.compute_interaction(inputs, source).position)

    shadow, speed = locate_shadow()
    ahead = integrand.compute_interaction(fixed, shadow)
    to_behind, distance = integrand.direction_and_distance(ahead.position, behind.position)
    medium = integrand.find_medium(fixed, ahead, behind, to_behind, mi.Bool(True))
    choices = opaque(depth - 1)
    count = 1 + (samples.index // 2) % choices
    ends_at_receiver = (samples.index % 2) == 1
    attenuation = dr.exp(-medium.attenuation * distance)
    throughput = fixed.scale * mi.Float(choices) * attenuation / dr.square(distance)
    distance = medium.refractive_index * distance
    zero = dr.zeros(mi.Float, samples.size)
    first = walk.initial_state(samples.index, samples.frame, source, -to_behind, throughput, zero)
    done = walker.trace_subpath(first, count, ends_at_receiver)

    def run(state: PathState, visit: intersection_curves.PathVisitor) -> PathState:
        def visit_connection(state: PathState, point: SurfaceInteraction) -> None:
            visit(state, *walk.connect_path(fixed, state, point, state["to_receiver"]))

        return walker.run(state, choices + 1 - count, visit_connection)

    for number, (sign, passed) in enumerate(samples.sides(fixed)):
        power = done["power"] * passed.transmittance * sign
        length = done["optical_length"] + distance + passed.extra_length
        index = samples.index + _SECOND_PART_OFFSET
        state = walk.initial_state(index, samples.frame, shadow, to_behind, power, length)
        state = walk.update_state(
            state, u=done["u"], v=done["v"], to_receiver=~ends_at_receiver, previous_vertices=count
        )
        yield (speed if number == 0 else locate_shadow()[1]), state, run
