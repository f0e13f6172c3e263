"""Paths over surface points, drawn vertex by vertex in one symbolic loop.

The loop is compiled once for any depth, and keeps no vertex unless asked to: then it writes one
`Records` row a vertex, from which derivatives are replayed (``channel/power/replay.py``). Detached.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power.bins import Contribution
from invertwin.channel.power.direction_sampling import Directions
from invertwin.channel.power.integrand import Inputs, Place
from invertwin.channel.power.transmission import Passage, land, passage
from invertwin.channel.rays.arrays import opaque, scrambled, uniform_pair
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import NEAR, RayScene

_LEAST_SURVIVAL = 0.1  # of Russian roulette
_ROULETTE_FROM = 3  # vertices after which it begins; shorter paths have less noise without
_STREAM = 0x9E3779B9  # seeds of successive vertices

#: A path at its latest vertex, one lane each: what the loop carries.
State = dict[str, Any]


def start(
    index: Any,
    frame: Any,
    face: Any,
    b1: Any,
    b2: Any,
    back: Any,
    throughput: Any,
    length: Any,
    passed: Passage | None = None,
) -> State:
    """The state at the first vertex.

    A state with a ``weight`` also follows one over the probability of its points per area. One with
    ``earlier`` continues paths that have had so many vertices.

    Args:
        index: Number of the path.
        frame: Radar pose.
        face: Triangle.
        b1, b2: Barycentric coordinates.
        back: Unit direction to where the path comes from.
        throughput: All factors up to arriving here, over the probability of the samples.
        length: Of the path so far [m].
        passed: What lies on the first segment, for antennas that share what they see.
    """
    count = dr.width(index)
    return {
        "index": index,
        "number": dr.full(mi.UInt32, 1, count),
        "active": throughput != 0,
        "frame": frame,
        "face": face,
        "b1": b1,
        "b2": b2,
        "back": mi.Vector3f(back),
        "throughput": throughput,
        "length": length,
        **(
            {} if passed is None else {"transmittance": passed.transmittance, "extra": passed.extra}
        ),
    }


class Walk:
    """Continues paths, and shows every vertex to a visitor.

    Args:
        rays: The scene and its antennas.
        inputs: Detached tables.
        seed: Of the directions.
    """

    def __init__(self, rays: RayScene, inputs: Inputs, seed: int) -> None:
        self.rays = rays
        self.inputs = inputs
        self.seed = scrambled(seed, 7)

    @cached_property
    def directions(self) -> Directions:
        """How paths go on; those of one bounce never ask."""
        return Directions(self.rays, self.inputs.surfaces)

    def run(self, state: State, depth: Any, visit: Callable[[State, Place], None]) -> State:
        """Walk to the end of all paths; returns the last state.

        Args:
            state: The first vertex.
            depth: Most vertices (a number, or one per lane).
            visit: Called at every vertex; may change what it put into the state itself.
        """
        if isinstance(depth, int) and depth == 1:
            visit(state, self._place(state))
            return state
        directions = self.directions  # uploaded before the loop is recorded
        last = opaque(depth) if isinstance(depth, int) else depth
        lanes = dr.width(state["index"])
        state = {**state, "last": mi.UInt32(last) + dr.zeros(mi.UInt32, lanes)}
        # Carried, since a vertex is located where it is found.
        state |= self._place(state).parts

        def extended(state: State) -> tuple[State]:
            state = dict(state)
            self._extend(state, Place.of(state), directions)
            return (state,)

        def ended(state: State) -> tuple[State]:
            return ({**state, "active": mi.Bool(False)},)

        def body(state: State) -> tuple[State]:
            state = dict(state)
            visit(state, Place.of(state))
            # Packets of paths that have come to their last vertex spare the next one.
            going = state["active"] & (state["number"] < state["last"])
            return dr.if_stmt((state,), going, extended, ended, mode="symbolic")

        (state,) = self.rays.loop((state,), lambda state: state["active"], body)
        return state

    def step(self, state: State, point: Place | None = None) -> State:
        """One more vertex, outside any loop.

        Args:
            state: The path so far.
            point: Its latest vertex, if not quite where the state has it.
        """
        state = {**state, "last": state["number"] + 1}
        self._extend(state, point or self._place(state), self.directions)
        return state

    def ended(self, first: State, count: Any, receiver: Any) -> State:
        """The one path with ``count`` vertices that ends at an antenna: its amount and ``so_far``.

        Args:
            first: Paths at their first vertex.
            count: Vertices, one number per lane.
            receiver: Whether the path ends at the receiver; then ``u`` and ``v`` are set too.
        """
        zero = dr.zeros(mi.Float, dr.width(first["index"]))
        first = first | {"u": zero, "v": zero, "amount": zero, "so_far": zero, "here": receiver}
        # What the antennas' polarisations take counts once, at the other end.
        inputs = replace(self.inputs, coupling=(1.0, 1.0))

        def ending(state: State, point: Place) -> None:
            path, exists = connect(self.rays, inputs, state, point, state["here"])
            last = exists & (state["number"] == state["last"])
            state["amount"] = dr.select(last, path.power, state["amount"])
            state["so_far"] = dr.select(last, 2 * path.range, state["so_far"])
            state["u"] = dr.select(last, path.u, state["u"])
            state["v"] = dr.select(last, path.v, state["v"])

        with dr.suspend_grad():
            return self.run(first, count, ending)

    def _place(self, state: State) -> Place:
        return integrand.place(
            self.inputs, state["face"], state["b1"], state["b2"], state["active"]
        )

    def _extend(self, state: State, point: Place, directions: Directions) -> None:
        """Draw the next vertex into the state; paths that miss or are too long end."""
        active = state["active"] & (state["number"] < state["last"])
        back = state["back"]
        scene = self.rays.frame_scene(state["frame"])
        numbers = self._numbers(state)
        drawn = directions.draw(point, back, numbers, scene)
        omega = drawn.omega
        scattered = self.inputs.surfaces.scattered(
            point.surface, point.normal, back, mi.Vector3f(omega)
        )
        ratio: Any = scattered / (drawn.scattered * dr.abs(dr.dot(point.normal, back)))
        survival = dr.select(
            state["number"] >= _ROULETTE_FROM,
            dr.minimum(dr.maximum(ratio, _LEAST_SURVIVAL), 1.0),
            1.0,
        )
        active &= (scattered > 0) & (numbers[1] < survival)
        side = dr.mulsign(point.normal, dr.dot(point.normal, omega))
        origin = point.position + side * (NEAR * dr.norm(point.position))
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(omega))
        key = state["index"], self.seed + (state["number"] * 5 + 4) * _STREAM
        hit = land(self.rays, self.inputs, ray, active, key, coherent=False)
        active &= hit.valid & self.rays.in_scene(state["frame"], hit.face, active)
        found = integrand.place(self.inputs, hit.face, hit.b1, hit.b2, active)
        to_point, distance = integrand.segment(found.position, point.position)
        cosine: Any = dr.abs(dr.dot(found.normal, to_point))
        active &= (cosine > 1e-6) & (distance > 0)
        inside = integrand.medium(self.inputs, point, found, -to_point, active)
        density = directions.density(point, drawn, hit.face, active, scene)
        active &= density > 0
        odds = density * survival * cosine * hit.chance
        weight = scattered * hit.transmittance * dr.exp(-inside.attenuation * distance) / odds
        state["throughput"] = dr.select(active, state["throughput"] * weight, 0.0)
        if "weight" in state:
            state["weight"] = state["weight"] * dr.square(distance) / odds
        state["face"], state["b1"], state["b2"] = hit.face, hit.b1, hit.b2
        state |= found.parts
        state["back"] = mi.Vector3f(to_point)
        state["length"] = state["length"] + inside.index * distance + hit.extra
        state["number"] = state["number"] + 1
        state["active"] = active

    def _numbers(self, state: State) -> list[Any]:
        """Six uniform numbers of this vertex; ``land`` has a stream of its own after them."""
        numbers = []
        for stream in range(3):
            seed = self.seed + (state["number"] * 5 + stream) * _STREAM
            numbers += uniform_pair(state["index"], seed)
        return numbers


def connect(
    rays: RayScene,
    inputs: Inputs,
    state: State,
    point: Place,
    receiver: Any,
    *,
    least: Any = 1,
    shared: bool = False,
    one_place: bool = False,
    end: integrand.End | None = None,
) -> tuple[Contribution, Any]:
    """The path that ends at the latest vertex, and whether it exists.

    Args:
        rays: Rays.
        inputs: Detached.
        state: The path so far.
        point: Its latest vertex.
        receiver: Whether the path ends at the receiver (a bool, or one per lane). Where it ends at
            the transmitter, the state knows the receiver's direction ``u``, ``v``.
        least: Fewest vertices of a path (a number, or one per lane).
        shared: What the antenna at the start sees, the one at the end sees too.
        one_place: Both are one.
        end: The antenna at the end, if it has been looked up.
    """
    end = end or integrand.End.of(inputs, state["frame"], receiver, state["active"])
    found = integrand.connection(
        inputs, state["frame"], point, state["back"], receiver, same=one_place, end=end
    )
    u, v = found.seen.x, found.seen.y
    if receiver is not True:
        u, v = dr.select(receiver, u, state["u"]), dr.select(receiver, v, state["v"])
    bounces = state["number"] + state.get("earlier", 0)
    power = state["throughput"] * found.factor * inputs.coupled(bounces)
    exists = state["active"] & (power != 0) & (state["number"] >= least)
    one, none = mi.Float(1.0), mi.Float(0.0)
    transmittance, extra = state.get("transmittance", one), state.get("extra", none)
    if not (shared and "last" not in state):
        first = exists & (state["number"] == 1) if shared else mi.Bool(False)
        passed = passage(rays, inputs, point.position, end.position, exists & ~first)
        transmittance = dr.select(first, transmittance, passed.transmittance)
        extra = dr.select(first, extra, passed.extra)
    length = 0.5 * (state["length"] + found.distance + extra)
    return Contribution(state["frame"], power * transmittance, length, u, v), exists & (
        transmittance > 0
    )


@dataclass(frozen=True)
class Recorded(integrand.Spot):
    """One vertex of every path."""

    throughput: Any  # all factors so far; zero where the path has ended before
    seen: Any  # whether the vertex is connected to the receiver

    @property
    def exists(self) -> Any:
        """Which paths come here."""
        return self.throughput != 0


@dataclass(frozen=True)
class Records:
    """Vertices of paths.

    What tells a vertex is written and read at once, as four numbers: triangle (its bits), two
    barycentric coordinates, and the throughput, negative where the vertex is not seen. Of vertices
    that a path never had, nothing is written.
    """

    lanes: int  # paths
    depth: int  # vertices of a path
    frame: Any  # radar pose of a lane
    count: Any  # vertices of a lane
    rows: Any  # four numbers each: [vertex × lane], or four arrays for paths of one vertex
    length: Any  # from the transmitter to the vertex [m], [vertex × lane]

    @staticmethod
    def single(state: State, seen: Any) -> "Records":
        """Records of paths of one vertex.

        Args:
            state: The path so far.
            seen: Whether the vertex is connected to the receiver.
        """
        lanes = dr.width(state["index"])
        count = dr.ones(mi.UInt32, lanes)
        return Records(lanes, 1, state["frame"], count, _row(state, seen), state["length"])

    @staticmethod
    def empty(state: State, depth: int) -> "Records":
        """Room for paths that start in this state.

        Args:
            state: The path so far.
            depth: Most vertices of a path.
        """
        lanes = dr.width(state["index"])
        rows, length = dr.empty(mi.Float, 4 * lanes * depth), dr.empty(mi.Float, lanes * depth)
        count = dr.zeros(mi.UInt32, lanes)
        return Records(lanes, depth, state["frame"], count, rows, length)

    @property
    def columns(self) -> list[Any]:
        """All arrays."""
        return [self.frame, self.count, self.rows, self.length]

    def at(self, number: Any, active: Any = True) -> Recorded:
        """One vertex of every path.

        Args:
            number: Of the vertex, from 0.
            active: Lanes.
        """
        row = self.rows
        if self.depth > 1:
            there = active & (number < self.count)
            row = dr.gather(mi.Vector4f, self.rows, self._places(number), there)
        face = dr.reinterpret_array(mi.UInt32, row.x)
        return Recorded(face, row.y, row.z, dr.abs(row.w), row.w > 0)

    def length_at(self, number: Any, active: Any) -> Any:
        """Length of every path up to one of its vertices [m].

        Args:
            number: Of the vertex, from 0.
            active: Paths that have it.
        """
        if self.depth == 1:
            return self.length
        return dr.gather(mi.Float, self.length, self._places(number), active)

    def write(self, state: State, seen: Any) -> None:
        """Store the latest vertex.

        Args:
            state: The path so far; ``count`` in it comes to be the number of its vertices.
            seen: Whether the vertex is connected to the receiver.
        """
        state["count"] = state["number"]
        at = (state["number"] - 1) * self.lanes + state["lane"]
        dr.scatter(self.rows, _row(state, seen), at, state["active"])
        dr.scatter(self.length, state["length"], at, state["active"])

    def _places(self, number: Any) -> Any:
        return number * self.lanes + dr.arange(mi.UInt32, self.lanes)


def _row(state: State, seen: Any) -> Any:
    throughput = dr.select(seen, state["throughput"], -state["throughput"])
    face = dr.reinterpret_array(mi.Float, state["face"])
    return mi.Vector4f(face, state["b1"], state["b2"], throughput)
