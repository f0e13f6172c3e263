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
from invertwin.channel.power.bins import Contribution
from invertwin.channel.power.integrand import Inputs, Place
from invertwin.channel.power.interior_silhouettes import InteriorEdgeSampler, TwoSided
from invertwin.channel.power.intersection_curves import ContactSampler, Meeting, contact_paths
from invertwin.channel.power.random_walk import State, Walk
from invertwin.channel.power.silhouettes import Drawn, EdgePoints, EdgeSampler, Shadow, shadow_speed
from invertwin.channel.power.transmission import Passage
from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.intersections import Contacts
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
    state: State
    run: Callable[[State, Callable[[State, Contribution, Any], None]], State]

    def weighted(self, gather: Callable[[Contribution, Any], Any]) -> Any:
        """Σ over a lane's paths of power × ``gather(path)``."""

        def visit(state: State, path: Contribution, exists: Any) -> None:
            amount = gather(path, exists) * path.power
            state["total"] = state["total"] + dr.select(exists, amount, 0.0)

        state = dict(self.state)
        state["total"] = dr.zeros(mi.Float, dr.width(self.speed))
        with dr.suspend_grad():
            return self.run(state, visit)["total"]

    def deposit(self, rate: Any, scatter: Callable[[Contribution, Any], None]) -> None:
        """Pass on every path with its power times a lane's rate.

        Args:
            rate: Of each lane.
            scatter: Takes a path and whether it exists.
        """
        state = dict(self.state)
        state["throughput"] = state["throughput"] * dr.detach(rate)
        with dr.suspend_grad():
            self.run(state, lambda _, path, exists: scatter(path, exists))


class BoundaryPoints:
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
        contacts: Contacts | None = None,
        *,
        chunks: Callable[[int], Iterator[Any]],
    ) -> None:
        """Where both antennas share one visibility, a path of one vertex has one segment, not two.

        Args:
            rays: Rays and antennas.
            inputs: Detached.
            sampling: How many edge points over all families, and the most vertices of a path.
            seed: Of the edge points.
            contacts: Where surfaces meet; None where they cannot.
            chunks: Splits a number of samples into index arrays.
        """
        self.depth = depth = sampling.depth
        samples = sampling.boundary_samples * rays.scenes
        centres = ("tx",) if rays.link.shared_visibility and depth == 1 else ("tx", "rx")
        inner = depth > 1 and sampling.interior_edges
        close = contacts is not None and contacts.close
        crossing = contacts.chosen(~contacts.touching) if contacts is not None else None
        meet = crossing is not None and len(crossing.first) > 0
        share = samples // (len(centres) + inner + meet)
        antennas = EdgeSampler(rays, inputs, centres, len(centres) * share, seed, close=close)
        self._samplers: list[Any] = [antennas]
        self._kinds: list[Callable[..., Iterator[BoundaryPaths]]] = [_antenna_segment]
        if inner:
            self._samplers.append(InteriorEdgeSampler(rays, inputs, share, seed + 2, close=close))
            self._kinds.append(_interior_segment)
        if crossing is not None and meet:
            self._samplers.append(ContactSampler(rays, inputs, crossing, share, depth, seed))
            self._kinds.append(_contact)
        self._chunks = chunks
        self._first = [
            list(map(s.draw, itertools.islice(chunks(s.size), 1))) for s in self._samplers
        ]
        for family in self._first:
            for drawn in family:
                drawn.launch()

    def families(self) -> list[Iterator[tuple[Callable[..., Iterator[BoundaryPaths]], Any]]]:
        """What makes paths of the points, and the points, a chunk at a time."""
        ahead, self._first = self._first, [[] for _ in self._samplers]
        first = [[drawn.kept() for drawn in family] for family in ahead]
        # Each sampler is bound here: a generator expression would draw all of them from the last.
        later = [
            map(Drawn.kept, map(s.draw, itertools.islice(self._chunks(s.size), len(now), None)))
            for s, now in zip(self._samplers, first, strict=True)
        ]
        return [
            zip(itertools.repeat(kind), itertools.chain(*family))
            for kind, *family in zip(self._kinds, first, later, strict=True)
        ]


def boundary_paths(
    rays: RayScene, inputs: Inputs, walker: Walk, points: BoundaryPoints
) -> Iterator[BoundaryPaths]:
    """The boundary paths through edge points.

    The first points are counted now, so that their paths are prepared while another kernel runs.

    Args:
        rays: The scene and its antennas.
        inputs: Attached tables.
        walker: Continues the paths.
        points: On edges.
    """
    families = points.families()

    def segments() -> Iterator[BoundaryPaths]:
        for kind, found in itertools.chain(*families):
            if found.size:
                yield from kind(rays, inputs, walker, found, points.depth)

    return segments()


def _contact(
    rays: RayScene, inputs: Inputs, walker: Walk, found: Meeting, depth: int
) -> Iterator[BoundaryPaths]:
    """Surfaces that meet: either hides what lies behind it of the other."""
    return itertools.starmap(BoundaryPaths, contact_paths(rays, inputs, walker, found, depth))


def _antenna_segment(
    rays: RayScene, inputs: Inputs, walker: Walk, points: EdgePoints, depth: int
) -> Iterator[BoundaryPaths]:
    """Family 1: the shadow that an edge casts from an antenna, then the path to the other one."""
    at_receiver = points.receiver
    fixed, frame = inputs.detached(), points.frame
    shared = rays.link.shared_visibility

    def shadow_points() -> Shadow:
        return shadow_speed(inputs, points, inputs.antenna(frame, at_receiver))

    shadow = shadow_points()
    point = integrand.place(fixed, points.face, shadow.b1, shadow.b2)
    back, distance = integrand.segment(point.position, fixed.antenna(frame, at_receiver))
    seen = integrand.to_radar(fixed, frame, -back)
    throughput = fixed.scale * fixed.gain(frame, at_receiver, seen) / dr.square(distance)

    def run(state: State, visit: Callable[[State, Contribution, Any], None]) -> State:
        def connected(state: State, point: Place) -> None:
            to_receiver = state.get("to_receiver", True)
            # What both antennas see of a single vertex is due to the transmitter's shadows alone.
            least = dr.select(to_receiver, 1, 2) if shared and to_receiver is not True else 1
            path, exists = walk.connect(
                rays, fixed, state, point, to_receiver, least=least, shared=shared
            )
            visit(state, path, exists)

        return walker.run(state, depth, connected)

    for number, (sign, transmittance, extra) in enumerate(points.sides(fixed)):
        state = walk.start(
            points.index, frame, points.face, shadow.b1, shadow.b2, back,
            throughput=throughput * transmittance * sign,
            length=distance + extra,
            passed=Passage(transmittance, extra) if fixed.surfaces.sheets else None,
        )  # fmt: skip
        if at_receiver is not False:
            state |= {"u": seen.x, "v": seen.y, "to_receiver": ~at_receiver}
        # Anew for each side: a derivative taken uses the speed up.
        speed = shadow.speed if number == 0 else shadow_points().speed
        yield BoundaryPaths(speed, state, run)


def _interior_segment(
    rays: RayScene, inputs: Inputs, walker: Walk, found: TwoSided, depth: int
) -> Iterator[BoundaryPaths]:
    """Family 2: a shadow that one surface point casts past an edge on another surface.

    The part from the point behind has a drawn number of vertices; that from the shadow, all that
    the depth leaves. Which of them ends at the receiver is drawn too: both orders are complete.
    """
    fixed, points = inputs.detached(), found.edge
    source = found.behind
    behind = integrand.place(fixed, source.face, source.b1, source.b2)

    def shadow_points() -> Shadow:
        moving = integrand.place(inputs, source.face, source.b1, source.b2)
        return shadow_speed(inputs, points, moving.position)

    shadow = shadow_points()
    ahead = integrand.place(fixed, points.face, shadow.b1, shadow.b2)
    to_behind, distance = integrand.segment(ahead.position, behind.position)
    inside = integrand.medium(fixed, ahead, behind, to_behind, mi.Bool(True))
    choices = opaque(depth - 1)
    count = 1 + (points.index // 2) % choices
    ends_at_receiver = (points.index % 2) == 1
    kept = dr.exp(-inside.attenuation * distance)
    throughput = fixed.scale * mi.Float(choices) * kept / dr.square(distance)
    distance = inside.index * distance
    lanes = dr.width(points.face)
    zero = dr.zeros(mi.Float, lanes)
    first = walk.start(
        points.index, points.frame, source.face, source.b1, source.b2, -to_behind,
        throughput, zero,
    )  # fmt: skip
    done = walker.ended(first, count, ends_at_receiver)

    def run(state: State, visit: Callable[[State, Contribution, Any], None]) -> State:
        def connected(state: State, point: Place) -> None:
            path, exists = walk.connect(rays, fixed, state, point, state["to_receiver"])
            visit(state, path, exists)

        return walker.run(state, choices + 1 - count, connected)

    for number, (sign, transmittance, extra) in enumerate(points.sides(fixed)):
        state = walk.start(
            points.index + _OTHER_SIDE, points.frame, points.face, shadow.b1, shadow.b2, to_behind,
            throughput=done["amount"] * transmittance * sign,
            length=done["so_far"] + distance + extra,
        )  # fmt: skip
        state |= {"u": done["u"], "v": done["v"], "to_receiver": ~ends_at_receiver}
        state["earlier"] = count
        speed = shadow.speed if number == 0 else shadow_points().speed
        yield BoundaryPaths(speed, state, run)


_OTHER_SIDE = 1 << 30  # so that both sides of a segment draw their own numbers
