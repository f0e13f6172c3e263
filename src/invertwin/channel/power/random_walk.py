"""Paths over surface points, drawn vertex by vertex in one symbolic loop.

The loop is compiled once for any depth, and keeps no vertex unless asked to: then it writes one
`PathRecords` row a vertex, from which derivatives are replayed (``channel/power/replay.py``).
Detached.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power.bins import PathContribution
from invertwin.channel.power.direction_sampling import DirectionSampler
from invertwin.channel.power.integrand import Inputs, SurfaceInteraction
from invertwin.channel.power.transmission import (
    SegmentTransmission,
    trace_to_surface,
    trace_transmission,
)
from invertwin.channel.rays.arrays import opaque, scramble_seed, uniform_pair
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RAY_EPSILON, RayScene

_MIN_SURVIVAL = 0.1  # of Russian roulette
_MIN_ROULETTE_VERTICES = 3  # vertices after which it begins; shorter paths have less noise without
_STREAM_STEP = 0x9E3779B9  # seeds of successive vertices

#: A path at its latest vertex, one lane each: what the loop carries.
PathState = dict[str, Any]


def initial_state(
    index: Any,
    frame: Any,
    face: Any,
    b1: Any,
    b2: Any,
    incident: Any,
    throughput: Any,
    length: Any,
    transmission: SegmentTransmission | None = None,
) -> PathState:
    """The state at the first vertex.

    A state with a ``weight`` also follows one over the probability of its points per area. One with
    ``earlier`` continues paths that have had so many vertices.

    Args:
        index: Number of the path.
        frame: Radar pose.
        face: Triangle.
        b1, b2: Barycentric coordinates.
        incident: Unit direction to where the path comes from.
        throughput: All factors up to arriving here, over the probability of the samples.
        length: Of the path so far [m].
        transmission: What lies on the first segment, for antennas that share what they see.
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
        "back": mi.Vector3f(incident),
        "throughput": throughput,
        "length": length,
        **(
            {}
            if transmission is None
            else {"transmittance": transmission.transmittance, "extra": transmission.extra_length}
        ),
    }


class RandomWalk:
    """Continues paths, and shows every vertex to a visitor.

    Args:
        rays: The scene and its antennas.
        inputs: Detached tables.
        seed: Of the directions.
    """

    def __init__(self, rays: RayScene, inputs: Inputs, seed: int) -> None:
        self.rays = rays
        self.inputs = inputs
        self.seed = scramble_seed(seed, 7)

    @cached_property
    def direction_sampler(self) -> DirectionSampler:
        """How paths go on; those of one bounce never ask."""
        return DirectionSampler(self.rays, self.inputs.surfaces)

    def run(
        self, state: PathState, depth: Any, visit: Callable[[PathState, SurfaceInteraction], None]
    ) -> PathState:
        """Walk to the end of all paths; returns the last state.

        Args:
            state: The first vertex.
            depth: Most vertices (a number, or one per lane).
            visit: Called at every vertex; may change what it put into the state itself.
        """
        if isinstance(depth, int) and depth == 1:
            visit(state, self._compute_interaction(state))
            return state
        directions = self.direction_sampler  # uploaded before the loop is recorded
        last = opaque(depth) if isinstance(depth, int) else depth
        lanes = dr.width(state["index"])
        state = {**state, "last": mi.UInt32(last) + dr.zeros(mi.UInt32, lanes)}
        # Carried, since a vertex is located where it is found.
        state |= self._compute_interaction(state).detached_state

        def extend(state: PathState) -> tuple[PathState]:
            state = dict(state)
            self._extend(state, SurfaceInteraction.from_state(state), directions)
            return (state,)

        def stop(state: PathState) -> tuple[PathState]:
            return ({**state, "active": mi.Bool(False)},)

        def body(state: PathState) -> tuple[PathState]:
            state = dict(state)
            visit(state, SurfaceInteraction.from_state(state))
            # Packets of paths that have come to their last vertex spare the next one.
            going = state["active"] & (state["number"] < state["last"])
            return dr.if_stmt((state,), going, extend, stop, mode="symbolic")

        (state,) = self.rays.loop((state,), lambda state: state["active"], body)
        return state

    def step(self, state: PathState, point: SurfaceInteraction | None = None) -> PathState:
        """One more vertex, outside any loop.

        Args:
            state: The path so far.
            point: Its latest vertex, if not quite where the state has it.
        """
        state = {**state, "last": state["number"] + 1}
        self._extend(state, point or self._compute_interaction(state), self.direction_sampler)
        return state

    def trace_subpath(self, first: PathState, count: Any, receiver: Any) -> PathState:
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

        def record_last(state: PathState, point: SurfaceInteraction) -> None:
            path, exists = connect_path(self.rays, inputs, state, point, state["here"])
            last = exists & (state["number"] == state["last"])
            state["amount"] = dr.select(last, path.power, state["amount"])
            state["so_far"] = dr.select(last, 2 * path.range, state["so_far"])
            state["u"] = dr.select(last, path.u, state["u"])
            state["v"] = dr.select(last, path.v, state["v"])

        with dr.suspend_grad():
            return self.run(first, count, record_last)

    def _compute_interaction(self, state: PathState) -> SurfaceInteraction:
        return integrand.compute_interaction(
            self.inputs, state["face"], state["b1"], state["b2"], state["active"]
        )

    def _extend(
        self, state: PathState, point: SurfaceInteraction, direction_sampler: DirectionSampler
    ) -> None:
        """Draw the next vertex into the state; paths that miss or are too long end."""
        active = state["active"] & (state["number"] < state["last"])
        back = state["back"]
        scene = self.rays.frame_scene(state["frame"])
        numbers = self._uniform_numbers(state)
        drawn = direction_sampler.draw(point, back, numbers, scene)
        omega = drawn.omega
        scattered = self.inputs.surfaces.evaluate_scattering(
            point.surface_row, point.normal, back, mi.Vector3f(omega)
        )
        ratio: Any = scattered / (drawn.lobe_density * dr.abs(dr.dot(point.normal, back)))
        survival = dr.select(
            state["number"] >= _MIN_ROULETTE_VERTICES,
            dr.minimum(dr.maximum(ratio, _MIN_SURVIVAL), 1.0),
            1.0,
        )
        active &= (scattered > 0) & (numbers[1] < survival)
        side = dr.mulsign(point.normal, dr.dot(point.normal, omega))
        origin = point.position + side * (RAY_EPSILON * dr.norm(point.position))
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(omega))
        key = state["index"], self.seed + (state["number"] * 5 + 4) * _STREAM_STEP
        hit = trace_to_surface(self.rays, self.inputs, ray, active, key, coherent=False)
        active &= hit.valid & self.rays.is_in_scene(state["frame"], hit.face, active)
        found = integrand.compute_interaction(self.inputs, hit.face, hit.b1, hit.b2, active)
        to_point, distance = integrand.direction_and_distance(found.position, point.position)
        cosine: Any = dr.abs(dr.dot(found.normal, to_point))
        active &= (cosine > 1e-6) & (distance > 0)
        inside = integrand.find_medium(self.inputs, point, found, -to_point, active)
        density = direction_sampler.density(point, drawn, hit.face, active, scene)
        active &= density > 0
        odds = density * survival * cosine * hit.probability
        weight = scattered * hit.transmittance * dr.exp(-inside.attenuation * distance) / odds
        state["throughput"] = dr.select(active, state["throughput"] * weight, 0.0)
        if "weight" in state:
            state["weight"] = state["weight"] * dr.square(distance) / odds
        state["face"], state["b1"], state["b2"] = hit.face, hit.b1, hit.b2
        state |= found.detached_state
        state["back"] = mi.Vector3f(to_point)
        state["length"] = state["length"] + inside.refractive_index * distance + hit.extra_length
        state["number"] = state["number"] + 1
        state["active"] = active

    def _uniform_numbers(self, state: PathState) -> list[Any]:
        """Six uniform numbers of this vertex; ``trace_to_surface`` has a stream of its own after
        them.
        """
        numbers = []
        for stream in range(3):
            seed = self.seed + (state["number"] * 5 + stream) * _STREAM_STEP
            numbers += uniform_pair(state["index"], seed)
        return numbers


def connect_path(
    rays: RayScene,
    inputs: Inputs,
    state: PathState,
    point: SurfaceInteraction,
    receiver: Any,
    *,
    min_vertices: Any = 1,
    shared_visibility: bool = False,
    monostatic: bool = False,
    antenna: integrand.AntennaPose | None = None,
) -> tuple[PathContribution, Any]:
    """The path that ends at the latest vertex, and whether it exists.

    Args:
        rays: Rays.
        inputs: Detached.
        state: The path so far.
        point: Its latest vertex.
        receiver: Whether the path ends at the receiver (a bool, or one per lane). Where it ends at
            the transmitter, the state knows the receiver's direction ``u``, ``v``.
        min_vertices: Fewest vertices of a path (a number, or one per lane).
        shared_visibility: What the antenna at the start sees, the one at the end sees too.
        monostatic: Both are one.
        antenna: The antenna at the end, if it has been looked up.
    """
    antenna = antenna or integrand.AntennaPose.look_up(
        inputs, state["frame"], receiver, state["active"]
    )
    found = integrand.connect_antenna(
        inputs,
        state["frame"],
        point,
        state["back"],
        receiver,
        is_same_antenna=monostatic,
        antenna=antenna,
    )
    u, v = found.direction.x, found.direction.y
    if receiver is not True:
        u, v = dr.select(receiver, u, state["u"]), dr.select(receiver, v, state["v"])
    bounces = state["number"] + state.get("earlier", 0)
    power = state["throughput"] * found.factor * inputs.polarisation_factor(bounces)
    exists = state["active"] & (power != 0) & (state["number"] >= min_vertices)
    one, none = mi.Float(1.0), mi.Float(0.0)
    transmittance, extra = state.get("transmittance", one), state.get("extra", none)
    if not (shared_visibility and "last" not in state):
        first = exists & (state["number"] == 1) if shared_visibility else mi.Bool(False)
        passed = trace_transmission(rays, inputs, point.position, antenna.position, exists & ~first)
        transmittance = dr.select(first, transmittance, passed.transmittance)
        extra = dr.select(first, extra, passed.extra_length)
    length = 0.5 * (state["length"] + found.distance + extra)
    return PathContribution(state["frame"], power * transmittance, length, u, v), exists & (
        transmittance > 0
    )


@dataclass(frozen=True)
class PathVertex(integrand.SurfacePoint):
    """One vertex of every path."""

    throughput: Any  # all factors so far; zero where the path has ended before
    is_visible: Any  # whether the vertex is connected to the receiver

    @property
    def exists(self) -> Any:
        """Which paths come here."""
        return self.throughput != 0


@dataclass(frozen=True)
class PathRecords:
    """Vertices of paths.

    What tells a vertex is written and read at once, as four numbers: triangle (its bits), two
    barycentric coordinates, and the throughput, negative where the vertex is not seen. Of vertices
    that a path never had, nothing is written.
    """

    path_count: int  # paths
    depth: int  # vertices of a path
    frame: Any  # radar pose of a lane
    count: Any  # vertices of a lane
    rows: Any  # four numbers each: [vertex × lane], or four arrays for paths of one vertex
    length: Any  # from the transmitter to the vertex [m], [vertex × lane]

    @staticmethod
    def from_single_vertex(state: PathState, is_visible: Any) -> "PathRecords":
        """Records of paths of one vertex.

        Args:
            state: The path so far.
            is_visible: Whether the vertex is connected to the receiver.
        """
        lanes = dr.width(state["index"])
        count = dr.ones(mi.UInt32, lanes)
        return PathRecords(
            lanes, 1, state["frame"], count, _pack_vertex(state, is_visible), state["length"]
        )

    @staticmethod
    def allocate(state: PathState, depth: int) -> "PathRecords":
        """Room for paths that start in this state.

        Args:
            state: The path so far.
            depth: Most vertices of a path.
        """
        lanes = dr.width(state["index"])
        rows, length = dr.empty(mi.Float, 4 * lanes * depth), dr.empty(mi.Float, lanes * depth)
        count = dr.zeros(mi.UInt32, lanes)
        return PathRecords(lanes, depth, state["frame"], count, rows, length)

    @property
    def columns(self) -> list[Any]:
        """All arrays."""
        return [self.frame, self.count, self.rows, self.length]

    def read_vertex(self, number: Any, active: Any = True) -> PathVertex:
        """One vertex of every path.

        Args:
            number: Of the vertex, from 0.
            active: Lanes.
        """
        row = self.rows
        if self.depth > 1:
            there = active & (number < self.count)
            row = dr.gather(mi.Vector4f, self.rows, self._row_indices(number), there)
        face = dr.reinterpret_array(mi.UInt32, row.x)
        return PathVertex(face, row.y, row.z, dr.abs(row.w), row.w > 0)

    def length_at(self, number: Any, active: Any) -> Any:
        """Length of every path up to one of its vertices [m].

        Args:
            number: Of the vertex, from 0.
            active: Paths that have it.
        """
        if self.depth == 1:
            return self.length
        return dr.gather(mi.Float, self.length, self._row_indices(number), active)

    def write(self, state: PathState, is_visible: Any) -> None:
        """Store the latest vertex.

        Args:
            state: The path so far; ``count`` in it comes to be the number of its vertices.
            is_visible: Whether the vertex is connected to the receiver.
        """
        state["count"] = state["number"]
        at = (state["number"] - 1) * self.path_count + state["lane"]
        dr.scatter(self.rows, _pack_vertex(state, is_visible), at, state["active"])
        dr.scatter(self.length, state["length"], at, state["active"])

    def _row_indices(self, number: Any) -> Any:
        return number * self.path_count + dr.arange(mi.UInt32, self.path_count)


def _pack_vertex(state: PathState, is_visible: Any) -> Any:
    throughput = dr.select(is_visible, state["throughput"], -state["throughput"])
    face = dr.reinterpret_array(mi.Float, state["face"])
    return mi.Vector4f(face, state["b1"], state["b2"], throughput)
