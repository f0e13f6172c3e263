"""Random walks over surface points, sampled vertex by vertex in one symbolic loop.

The loop is compiled once for any depth. It stores no vertices unless records are requested: then
it writes one row of `PathRecords` per vertex, from which derivatives are replayed
(``channel/power/replay.py``). Detached.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypedDict, cast

from invertwin.channel.power import integrand
from invertwin.channel.power import transmission as sheets
from invertwin.channel.power.bins import PathContribution
from invertwin.channel.power.direction_sampling import DirectionSampler
from invertwin.channel.power.integrand import Inputs, SurfaceInteraction
from invertwin.channel.power.transmission import SegmentTransmission, trace_transmission
from invertwin.channel.rays.arrays import opaque, scramble_seed, uniform_pair
from invertwin.channel.rays.backend import Mask, dr, mi, mit
from invertwin.channel.rays.ray_scene import RAY_EPSILON
from invertwin.channel.rays.surface_point import SurfacePoint

_MIN_SURVIVAL = 0.1  # least survival probability of Russian roulette
_MIN_ROULETTE_VERTICES = 3  # vertices before roulette begins; it adds noise to shorter paths
_STREAM_STEP = 0x9E3779B9  # difference of the seeds of successive vertices


class PathState(TypedDict):
    """State of the loop over the vertices of paths, one lane a path.

    The keys up to ``length`` are always present; the loop, its visitors and its callers add the
    others, as they need them.

    Attributes:
        index: number of the path, which selects its random numbers.
        number: number of vertices so far.
        active: paths that continue.
        frame: radar pose.
        face, b1, b2: latest vertex: triangle and barycentric coordinates.
        incident: unit direction from the latest vertex to the one before.
        throughput: product of all factors up to the latest vertex, over the sampling density.
        length: optical length up to the latest vertex [m].
        transmittance, extra: transmission of the first segment: power factor and added length [m].
        last: number of vertices at which a path ends.
        interaction: location of the latest vertex.
        weight: one over the probability of the path's points per area.
        previous_vertices: vertices of the subpath that this one continues.
        to_receiver: True for paths that end at the receiver.
        u, v: direction cosines at the receiver, of paths that start there.
        power, optical_length: result of ``trace_subpath``; the length in metres.
        total: sum that a visitor forms.
        exists: True once a visitor has met a path of the lane.
        lane, count: lane of the path, and its recorded vertices.
    """

    index: mit.UInt32
    number: mit.UInt32
    active: mit.Bool
    frame: mit.UInt32
    face: mit.UInt32
    b1: mit.Float
    b2: mit.Float
    incident: mit.Vector3f
    throughput: mit.Float
    length: mit.Float
    transmittance: mit.Float
    extra: mit.Float
    last: mit.UInt32
    interaction: SurfaceInteraction
    weight: mit.Float
    previous_vertices: mit.UInt32
    to_receiver: Mask
    u: mit.Float
    v: mit.Float
    power: mit.Float
    optical_length: mit.Float
    total: mit.Float
    exists: mit.Bool
    lane: mit.UInt32
    count: mit.UInt32


def initial_state(
    index: mit.UInt32,
    frame: mit.UInt32,
    point: SurfacePoint,
    incident: mit.Vector3f,
    throughput: mit.Float,
    length: mit.Float,
    transmission: SegmentTransmission | None = None,
) -> PathState:
    """Create the state at the first vertex of paths.

    Args:
        index: path numbers, which select the random numbers.
        frame: radar poses.
        point: first vertices.
        incident: unit directions from the vertex to the start of the path.
        throughput: product of all factors up to the vertex, over the sampling density.
        length: optical lengths up to the vertex [m].
        transmission: transmission of the first segment, for antennas with one visibility test.
    """
    state: dict[str, object] = {
        "index": index,
        "number": dr.full(mi.UInt32, 1, dr.width(index)),
        "active": throughput != 0,
        "frame": frame,
        "face": point.face,
        "b1": point.b1,
        "b2": point.b2,
        "incident": mi.Vector3f(incident),
        "throughput": throughput,
        "length": length,
    }
    if transmission is not None:
        state["transmittance"] = transmission.transmittance
        state["extra"] = transmission.extra_length
    return cast(PathState, state)  # the other keys are added as they are needed


def update_state(state: PathState, **changes: object) -> PathState:
    """Copy a path state with some keys changed or added.

    Args:
        state: state of the loop.
        changes: keys of `PathState` and their arrays.
    """
    return cast(PathState, {**state, **changes})


class RandomWalk:
    """Random walk that extends paths and calls a visitor at every vertex.

    Args:
        inputs: detached inputs.
        seed: seed of the directions.
    """

    def __init__(self, inputs: Inputs, seed: int) -> None:
        self.rays, self.inputs = inputs.rays, inputs
        self.seed = scramble_seed(seed, 7)

    @cached_property
    def direction_sampler(self) -> DirectionSampler:
        """Sampler of the directions after a vertex; paths of one bounce do not need it."""
        return DirectionSampler(self.rays, self.inputs.surfaces)

    def run(
        self,
        state: PathState,
        depth: mit.UInt32 | int,
        visit: Callable[[PathState, SurfaceInteraction], None],
    ) -> PathState:
        """Walk to the end of all paths and return the last state.

        Args:
            state: state at the first vertex.
            depth: most vertices of a path (a number, or one per lane).
            visit: function of the state and the latest vertex; may change its own keys.
        """
        if isinstance(depth, int) and depth == 1:
            visit(state, self._compute_interaction(state))
            return state
        directions = self.direction_sampler  # uploaded before the loop is recorded
        last = opaque(depth) if isinstance(depth, int) else depth
        lanes = dr.width(state["index"])
        # The loop carries the position, since a vertex is located when it is sampled.
        located = self._compute_interaction(state).detach()
        last = mi.UInt32(last) + dr.zeros(mi.UInt32, lanes)
        state = update_state(state, last=last, interaction=located)

        def extend(state: PathState) -> tuple[PathState]:
            state = state.copy()
            self._extend(state, state["interaction"], directions)
            return (state,)

        def stop(state: PathState) -> tuple[PathState]:
            return (update_state(state, active=mi.Bool(False)),)

        def body(state: PathState) -> tuple[PathState]:
            state = state.copy()
            visit(state, state["interaction"])
            # Packets of paths at their last vertex skip the next one.
            going = state["active"] & (state["number"] < state["last"])
            return dr.if_stmt((state,), going, extend, stop, mode="symbolic")

        (state,) = self.rays.loop((state,), lambda state: state["active"], body)
        return state

    def step(self, state: PathState, point: SurfaceInteraction | None = None) -> PathState:
        """Extend paths by one vertex, outside any loop.

        Args:
            state: state at the latest vertex.
            point: latest vertex, if it differs from that of the state.
        """
        state = update_state(state, last=state["number"] + 1)
        self._extend(state, point or self._compute_interaction(state), self.direction_sampler)
        return state

    def trace_subpath(self, first: PathState, count: mit.UInt32, receiver: Mask) -> PathState:
        """Trace the one path of a given number of vertices that ends at an antenna.

        Args:
            first: state at the first vertex.
            count: numbers of vertices, one per lane.
            receiver: True for paths that end at the receiver; ``u`` and ``v`` are then set.

        Returns:
            The last state, with ``power`` and ``optical_length`` [m] of the path.
        """
        zero = dr.zeros(mi.Float, dr.width(first["index"]))
        first = update_state(
            first, u=zero, v=zero, power=zero, optical_length=zero, to_receiver=receiver
        )
        # The polarisation factor counts once, at the other end.
        inputs = replace(self.inputs, coupling=(1.0, 1.0))

        def record_last(state: PathState, point: SurfaceInteraction) -> None:
            path, exists = connect_path(inputs, state, point, state["to_receiver"])
            last = exists & (state["number"] == state["last"])
            state["power"] = dr.select(last, path.power, state["power"])
            state["optical_length"] = dr.select(last, 2 * path.range, state["optical_length"])
            state["u"] = dr.select(last, path.u, state["u"])
            state["v"] = dr.select(last, path.v, state["v"])

        with dr.suspend_grad():
            return self.run(first, count, record_last)

    def _compute_interaction(self, state: PathState) -> SurfaceInteraction:
        return integrand.compute_interaction(
            self.inputs, SurfacePoint(state["face"], state["b1"], state["b2"]), state["active"]
        )

    def _extend(
        self, state: PathState, point: SurfaceInteraction, direction_sampler: DirectionSampler
    ) -> None:
        """Sample the next vertex into the state; paths that miss or are too long end."""
        active = state["active"] & (state["number"] < state["last"])
        incident = state["incident"]
        scene = self.rays.frame_scene(state["frame"])
        # Six uniform numbers for this vertex; ``trace_to_surface`` has a later stream.
        seeds = [self.seed + (state["number"] * 5 + stream) * _STREAM_STEP for stream in range(3)]
        numbers = [number for seed in seeds for number in uniform_pair(state["index"], seed)]
        sample = direction_sampler.draw(point, incident, numbers, scene)
        omega = sample.omega
        scattered = self.inputs.surfaces.evaluate_scattering(
            point.surface_row, point.normal, incident, mi.Vector3f(omega)
        )
        facing = dr.abs(dr.dot(point.normal, incident))
        ratio: mit.Float = scattered / (sample.lobe_density * facing)
        survival = dr.minimum(dr.maximum(ratio, _MIN_SURVIVAL), 1.0)
        survival = dr.select(state["number"] >= _MIN_ROULETTE_VERTICES, survival, 1.0)
        active &= (scattered > 0) & (numbers[1] < survival)
        side = dr.mulsign(point.normal, dr.dot(point.normal, omega))
        origin = point.position + side * (RAY_EPSILON * dr.norm(point.position))
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(omega))
        key = state["index"], self.seed + (state["number"] * 5 + 4) * _STREAM_STEP
        hit = sheets.trace_to_surface(self.inputs, ray, active, key, coherent=False)
        active &= hit.valid & self.rays.is_in_scene(state["frame"], hit.point.face, active)
        found = integrand.compute_interaction(self.inputs, hit.point, active)
        to_point, distance = integrand.direction_and_distance(found.position, point.position)
        cosine: mit.Float = dr.abs(dr.dot(found.normal, to_point))
        active &= (cosine > 1e-6) & (distance > 0)
        medium = integrand.find_medium(self.inputs, point, found, -to_point, active)
        density = direction_sampler.density(point, sample, hit.point.face, active, scene)
        active &= density > 0
        probability = density * survival * cosine * hit.probability
        weight = scattered * hit.transmission.transmittance
        weight = weight * dr.exp(-medium.attenuation * distance) / probability
        state["throughput"] = dr.select(active, state["throughput"] * weight, 0.0)
        if "weight" in state:
            state["weight"] = state["weight"] * dr.square(distance) / probability
        state["face"], state["b1"], state["b2"] = hit.point.face, hit.point.b1, hit.point.b2
        state["interaction"] = found.detach()
        state["incident"] = mi.Vector3f(to_point)
        state["length"] = state["length"] + medium.refractive_index * distance
        state["length"] = state["length"] + hit.transmission.extra_length
        state["number"] = state["number"] + 1
        state["active"] = active


def connect_path(
    inputs: Inputs,
    state: PathState,
    point: SurfaceInteraction,
    receiver: Mask,
    *,
    min_vertices: mit.UInt32 | int = 1,
    shared_visibility: bool = False,
    monostatic: bool = False,
    antenna: integrand.AntennaPose | None = None,
) -> tuple[PathContribution, mit.Bool]:
    """Connect the latest vertex to an antenna.

    Args:
        inputs: detached inputs.
        state: state at the latest vertex.
        point: latest vertex.
        receiver: True for paths that end at the receiver (a bool, or one per lane). Paths that
            end at the transmitter take the receiver's direction ``u``, ``v`` from the state.
        min_vertices: fewest vertices of a path (a number, or one per lane).
        shared_visibility: True if one visibility test serves both antennas.
        monostatic: True if both antennas are one.
        antenna: pose of the antenna at the end, if it has been looked up.

    Returns:
        The path that ends there, and the mask of lanes in which it exists.
    """
    frame, incident = state["frame"], state["incident"]
    antenna = antenna or integrand.AntennaPose.look_up(inputs, frame, receiver, state["active"])
    found = integrand.connect_antenna(
        inputs, frame, point, incident, receiver, is_same_antenna=monostatic, antenna=antenna
    )
    u: mit.Float = found.direction.y  # type: ignore[assignment]
    v: mit.Float = found.direction.z  # type: ignore[assignment]
    if receiver is not True:
        u, v = dr.select(receiver, u, state["u"]), dr.select(receiver, v, state["v"])
    bounces = state["number"] + state.get("previous_vertices", 0)
    power = state["throughput"] * found.factor * inputs.polarisation_factor(bounces)
    exists = state["active"] & (power != 0) & (state["number"] >= min_vertices)
    one, none = mi.Float(1.0), mi.Float(0.0)
    transmittance, extra = state.get("transmittance", one), state.get("extra", none)
    if not (shared_visibility and "last" not in state):
        first = exists & (state["number"] == 1) if shared_visibility else mi.Bool(False)
        passed = trace_transmission(inputs, point.position, antenna.position, exists & ~first)
        transmittance = dr.select(first, transmittance, passed.transmittance)
        extra = dr.select(first, extra, passed.extra_length)
    length = 0.5 * (state["length"] + found.distance + extra)
    path = PathContribution(frame, power * transmittance, length, u, v)
    return path, exists & (transmittance > 0)


@dataclass
class PathVertex(SurfacePoint):
    """Vertex of paths.

    Attributes:
        throughput: product of all factors up to the vertex; zero if the path has ended before.
        is_visible: True if the vertex is connected to the receiver; None if that is not known.
    """

    throughput: mit.Float
    is_visible: mit.Bool | None

    @property
    def exists(self) -> mit.Bool:
        """Mask of the paths that have this vertex."""
        return self.throughput != 0  # type: ignore[return-value]


@dataclass(frozen=True)
class PathRecords:
    """Vertices of paths.

    A vertex is written and read as four numbers: triangle (its bits), two barycentric coordinates,
    and the throughput, negative if the vertex is not visible. Vertices beyond the end of a path
    are not written.

    Attributes:
        path_count: number of paths.
        depth: most vertices of a path.
        frame: radar pose of each path.
        count: number of vertices of each path.
        rows: four numbers each, [vertex × path], or four arrays for paths of one vertex.
        length: optical length from the transmitter to each vertex [m], [vertex × path].
    """

    path_count: int
    depth: int
    frame: mit.UInt32
    count: mit.UInt32
    rows: mit.Float | mit.Vector4f
    length: mit.Float

    @staticmethod
    def from_single_vertex(state: PathState, is_visible: mit.Bool) -> PathRecords:
        """Record paths of one vertex.

        Args:
            state: state at the vertex.
            is_visible: True if the vertex is connected to the receiver.
        """
        lanes = dr.width(state["index"])
        count = dr.ones(mi.UInt32, lanes)
        row = _pack_vertex(state, is_visible)
        return PathRecords(lanes, 1, state["frame"], count, row, state["length"])

    @staticmethod
    def allocate(state: PathState, depth: int) -> PathRecords:
        """Allocate records of paths.

        Args:
            state: state at the first vertex.
            depth: most vertices of a path.
        """
        lanes = dr.width(state["index"])
        rows, length = dr.empty(mi.Float, 4 * lanes * depth), dr.empty(mi.Float, lanes * depth)
        return PathRecords(lanes, depth, state["frame"], dr.zeros(mi.UInt32, lanes), rows, length)

    def read_vertex(self, number: mit.UInt32, active: Mask = True) -> PathVertex:
        """Read one vertex of every path.

        Args:
            number: vertex numbers, from 0.
            active: mask of active lanes.
        """
        row: Any = self.rows
        if self.depth > 1:
            there = active & (number < self.count)
            row = dr.gather(mi.Vector4f, self.rows, self._row_indices(number), there)
        face = dr.reinterpret_array(mi.UInt32, row.x)
        return PathVertex(face, row.y, row.z, dr.abs(row.w), row.w > 0)

    def length_at(self, number: mit.UInt32, active: mit.Bool) -> mit.Float:
        """Read the optical length of every path up to one of its vertices [m].

        Args:
            number: vertex numbers, from 0.
            active: mask of paths that have the vertex.
        """
        if self.depth == 1:
            return self.length
        return dr.gather(mi.Float, self.length, self._row_indices(number), active)

    def write(self, state: PathState, is_visible: mit.Bool) -> None:
        """Write the latest vertex.

        Args:
            state: state at the vertex; its ``count`` is set to the number of vertices.
            is_visible: True if the vertex is connected to the receiver.
        """
        state["count"] = state["number"]
        at = (state["number"] - 1) * self.path_count + state["lane"]
        dr.scatter(self.rows, _pack_vertex(state, is_visible), at, state["active"])
        dr.scatter(self.length, state["length"], at, state["active"])

    def _row_indices(self, number: mit.UInt32) -> mit.UInt32:
        return number * self.path_count + dr.arange(mi.UInt32, self.path_count)


def _pack_vertex(state: PathState, is_visible: mit.Bool) -> mit.Vector4f:
    throughput = dr.select(is_visible, state["throughput"], -state["throughput"])
    face = dr.reinterpret_array(mi.Float, state["face"])
    return mi.Vector4f(face, state["b1"], state["b2"], throughput)
