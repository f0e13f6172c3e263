"""Derivatives of paths, replayed vertex by vertex from their records.

In material form the vertices of a path are independent of each other: vertex k enters only with
its neighbours. So the adjoint of a path and of all its beginnings is one sweep from its far end,
which carries two sums, Σ C ∂L/∂C and Σ ∂L/∂R over the paths that go on beyond the vertex. Nothing
but the records is stored, whatever the depth; the tangent is one sweep from the near end.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power.bins import PathContribution
from invertwin.channel.power.integrand import Inputs, SurfaceInteraction
from invertwin.channel.power.random_walk import PathRecords, PathVertex
from invertwin.channel.power.transmission import (
    SegmentTransmission,
    trace_transmission,
    visit_sheets,
)
from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RayScene


@dataclass(frozen=True)
class _VertexFactors:
    """The attached factors at one vertex; detached throughput and masks."""

    active: Any
    has_next: Any
    is_visible: Any
    throughput: Any
    length: Any
    frame: Any
    incident_factor: Any  # gain at the start, 1/R² of the segment here, Jacobian
    optical_length: Any  # optical length of the segment here
    connection: integrand.AntennaConnection
    polarisation_factor: Any  # what the antennas' polarisations take of the path that ends here
    scattering_factor: Any  # towards the next vertex
    transmission: SegmentTransmission  # by the connection
    shares_segment: Any  # whether the connection passes what the segment here passed
    endpoints: tuple[
        Callable[[], Any], Callable[[], Any], Callable[[], Any]
    ]  # before, here, receiver

    def to_contribution(self) -> PathContribution:
        """The path that ends here."""
        found, passed = self.connection, self.transmission
        power = self.throughput * found.factor * passed.transmittance * self.polarisation_factor
        length = 0.5 * (self.length + found.distance + passed.extra_length)
        return PathContribution(self.frame, power, length, found.direction.x, found.direction.y)


@dataclass(frozen=True)
class _VertexNeighbours:
    """A vertex and its neighbours on the path, as far as there are any."""

    vertex: PathVertex
    previous: PathVertex | None  # the vertex before; None on paths of one vertex
    has_next: Any  # whether there is a next one
    interaction: SurfaceInteraction
    previous_interaction: SurfaceInteraction | None
    next_position: Any  # position of the next vertex

    @staticmethod
    def read(inputs: Inputs, records: PathRecords, number: Any, depth: Any) -> "_VertexNeighbours":
        """Vertex ``number`` (from 0 to ``depth`` − 1) of every path, as attached as the inputs."""
        own = records.read_vertex(number)
        here = own.compute_interaction(inputs, own.exists)
        if records.depth == 1:
            return _VertexNeighbours(own, None, mi.Bool(False), here, None, None)
        inner, follows = own.exists & (number > 0), own.exists & (number + 1 < depth)
        earlier, later = (
            records.read_vertex(number - 1, inner),
            records.read_vertex(number + 1, follows),
        )
        goes_on = follows & later.exists
        before, onward = (
            earlier.compute_interaction(inputs, inner),
            later.compute_interaction(inputs, goes_on),
        )
        return _VertexNeighbours(own, earlier, goes_on, here, before, onward.position)

    def as_leaf_variables(self) -> "_VertexNeighbours":
        """The same, but places with derivatives of their own."""
        assert self.previous_interaction is not None
        here = SurfaceInteraction(
            mi.Point3f(self.interaction.position),
            mi.Vector3f(self.interaction.normal),
            dr.ones(mi.Float, dr.width(self.vertex.face)),
            self.interaction.surface_row,
        )
        before = replace(
            self.previous_interaction, position=mi.Point3f(self.previous_interaction.position)
        )
        onward = mi.Point3f(self.next_position)
        dr.enable_grad(here.position, here.normal, here.jacobian, before.position, onward)
        return replace(self, interaction=here, previous_interaction=before, next_position=onward)


@dataclass(frozen=True)
class _AntennaPoses:
    """Where paths start and end; looked up once where that carries no derivatives."""

    inputs: Inputs
    frame: Any
    poses: tuple[integrand.AntennaPose, integrand.AntennaPose] | None  # transmitter and receiver

    @staticmethod
    def look_up(inputs: Inputs, frame: Any) -> "_AntennaPoses":
        if any(dr.grad_enabled(inputs.table(name)) for name in ("tx", "rx", "rotations")):
            return _AntennaPoses(inputs, frame, None)
        first, second = (
            integrand.AntennaPose.look_up(inputs, frame, receiver) for receiver in (False, True)
        )
        return _AntennaPoses(inputs, frame, (first, second))

    def pose(self, receiver: bool, active: Any) -> integrand.AntennaPose:
        if self.poses is not None:
            return self.poses[receiver]
        return integrand.AntennaPose.look_up(self.inputs, self.frame, receiver, active)


def _evaluate_vertex(
    rays: RayScene,
    inputs: Inputs,
    records: PathRecords,
    antennas: _AntennaPoses,
    number: Any,
    neighbours: _VertexNeighbours,
) -> _VertexFactors:
    """Evaluate vertex ``number`` of every path."""
    single, frame = neighbours.previous_interaction is None, records.frame
    own, here, goes_on = neighbours.vertex, neighbours.interaction, neighbours.has_next
    active = own.exists
    inner = mi.Bool(False) if single else active & (number > 0)

    def previous_position(interaction: Callable[[], SurfaceInteraction | None]) -> Any:
        start = antennas.pose(False, active).position
        earlier = interaction()
        return start if earlier is None else dr.select(inner, earlier.position, start)

    before = previous_position(lambda: neighbours.previous_interaction)
    back, distance = integrand.direction_and_distance(here.position, before)
    optical, lost = distance, mi.Float(1.0)
    if inputs.surfaces.has_refracting_bodies and neighbours.previous_interaction is not None:
        inside = integrand.find_medium(inputs, here, neighbours.previous_interaction, back, inner)
        optical, lost = distance * inside.refractive_index, dr.exp(-inside.attenuation * distance)
    first = active if single else active & (number == 0)
    seen_from_tx = integrand.project_to_axes(antennas.pose(False, first).axes, -back)
    gain = dr.select(first, inputs.gain(frame, False, seen_from_tx), 1.0)
    arriving = gain * here.jacobian * lost / dr.square(distance)
    receiver = antennas.pose(True, active)
    connection = integrand.connect_antenna(
        inputs,
        frame,
        here,
        back,
        True,
        active,
        is_same_antenna=single and inputs.monostatic,
        antenna=receiver,
    )
    scattered = mi.Float(1.0)
    if not single:
        start = antennas.pose(False, active).position
        direction, _ = integrand.direction_and_distance(
            here.position, dr.select(goes_on, neighbours.next_position, start)
        )
        scattered = inputs.surfaces.evaluate_scattering(
            here.surface_row, here.normal, back, direction, goes_on
        )
    seen = active & own.is_visible
    twice, passed = mi.Bool(False), SegmentTransmission(mi.Float(1.0), mi.Float(0.0))
    if inputs.surfaces.has_sheets:
        twice = first if rays.link.shared_visibility else twice
        end = dr.select(twice, before, receiver.position)
        fixed = (dr.detach(here.position), dr.detach(end))
        with dr.suspend_grad():
            passed = trace_transmission(rays, inputs.detach(), *fixed, seen)
    return _VertexFactors(
        transmission=passed,
        shares_segment=twice,
        endpoints=(
            lambda: previous_position(
                lambda: (
                    neighbours.previous and neighbours.previous.compute_interaction(inputs, inner)
                )
            ),
            lambda: own.compute_interaction(inputs, active).position,
            lambda: antennas.pose(True, active).position,
        ),
        active=active,
        has_next=goes_on,
        is_visible=seen,
        throughput=own.throughput,
        length=records.length_at(number, active),
        frame=frame,
        incident_factor=arriving,
        optical_length=optical,
        connection=connection,
        polarisation_factor=inputs.polarisation_factor(number + 1),
        scattering_factor=scattered,
    )


def _log_derivative_factor(active: Any, total: Any, value: Any) -> Any:
    """total · dlog(value): what multiplies the attached value; zero where inactive."""
    return dr.select(active, total / dr.detach(value), 0.0)


def pull(
    rays: RayScene,
    inputs: Inputs,
    records: PathRecords,
    gather: Callable[[PathContribution, Any], tuple[Any, Any, Any, Any]],
) -> None:
    """Reverse mode: add to the gradients of the attached inputs.

    Args:
        rays: The scene and its antennas.
        inputs: Attached tables.
        records: Vertices of the paths.
        gather: Adjoints of paths: ∂loss/∂power, and power · ∂loss/∂(range, u, v).
    """
    depth = opaque(records.depth)
    antennas = _AntennaPoses.look_up(inputs, records.frame)
    # With neighbours, all that moves a vertex is summed before its triangle is asked.
    carried = records.depth > 1 and dr.grad_enabled(inputs.vertices)
    fixed = inputs.detach()

    def sweep(number: Any, sums: Any, pending: Any) -> tuple[Any, Any]:
        power_sum, range_sum = sums
        known = collect_neighbours(number, pending) if carried else None
        with dr.resume_grad():
            near = (
                known.as_leaf_variables()
                if known
                else _VertexNeighbours.read(inputs, records, number, depth)
            )
            vertex = _evaluate_vertex(rays, inputs, records, antennas, number, near)
            path = vertex.to_contribution()
            power, length, u, v = (
                dr.select(vertex.is_visible, bar, 0.0) for bar in gather(path, vertex.is_visible)
            )
            later = (
                _log_derivative_factor(vertex.has_next, power_sum, vertex.scattering_factor)
                * vertex.scattering_factor
            )
            ending = power * path.power + 0.5 * length * vertex.connection.distance
            ending += u * path.u + v * path.v
            power_sum = power_sum + dr.select(vertex.is_visible, power * dr.detach(path.power), 0.0)
            range_sum = range_sum + 0.5 * length
            so_far = (
                _log_derivative_factor(vertex.active, power_sum, vertex.incident_factor)
                * vertex.incident_factor
            )
            so_far += range_sum * vertex.optical_length
            # What multiplies the attached values is zero where they do not count.
            dr.backward_from(so_far + ending + later)
            if carried:
                pending = advance_pending(near, pending)
        if inputs.surfaces.has_sheets:
            pull_sheets(vertex, power * dr.detach(path.power), length, power_sum, range_sum)
        return (power_sum, range_sum), pending

    def collect_neighbours(number: Any, pending: Any) -> _VertexNeighbours:
        """A vertex and its neighbours; only the one before has not been read yet."""
        own, later = (
            PathVertex(**pending[name], is_visible=pending["seen"]) for name in ("own", "later")
        )
        identity, seen, before = dr.if_stmt(
            (number,), number > 0, read_previous, read_nothing, mode="symbolic"
        )
        here, goes_on = SurfaceInteraction.from_state(pending["here"]), own.exists & later.exists
        earlier = PathVertex(**identity, is_visible=seen)
        return _VertexNeighbours(
            own, earlier, goes_on, here, SurfaceInteraction.from_state(before), pending["onward"]
        )

    def read_previous(number: Any) -> tuple[Any, ...]:
        earlier = records.read_vertex(number - 1)
        return (
            _vertex_columns(earlier),
            earlier.is_visible,
            earlier.compute_interaction(fixed).detached_state,
        )

    def read_nothing(_: Any) -> tuple[Any, ...]:
        # Before the first vertex there is none, which spares reading it.
        lanes, zero = records.path_count, dr.zeros(mi.Float, records.path_count)
        face = dr.zeros(mi.UInt32, lanes)
        identity = {"face": face, "b1": zero, "b2": zero, "throughput": zero}
        place = {
            "position": dr.zeros(mi.Point3f, lanes),
            "normal": dr.zeros(mi.Vector3f, lanes),
            "surface": face,
        }
        return identity, dr.zeros(mi.Bool, lanes), place

    def advance_pending(neighbours: _VertexNeighbours, pending: Any) -> Any:
        """Ask the triangle of the next vertex, of which all is known now; this one waits."""
        here, before, earlier = (
            neighbours.interaction,
            neighbours.previous_interaction,
            neighbours.previous,
        )
        assert before is not None
        assert earlier is not None

        def select_gradient(value: Any, active: Any = neighbours.vertex.exists) -> Any:
            return dr.select(active, dr.grad(value), 0.0)

        position = pending["position"] + select_gradient(
            neighbours.next_position, neighbours.has_next
        )
        pull_vertex(
            PathVertex(**pending["later"], is_visible=None),
            pending | {"position": position},
            neighbours.has_next,
        )
        return {
            "own": _vertex_columns(earlier),
            "later": _vertex_columns(neighbours.vertex),
            "seen": earlier.is_visible,
            "here": before.detached_state,
            "onward": dr.detach(here.position),
            "position": pending["earlier"] + select_gradient(here.position),
            "normal": select_gradient(here.normal),
            "jacobian": select_gradient(here.jacobian),
            "earlier": select_gradient(before.position),
        }

    def pull_vertex(vertex: PathVertex, pending: Any, active: Any) -> None:
        bars = tuple(pending[name] for name in ("position", "normal", "jacobian"))

        def act(*known: Any) -> tuple[()]:
            with dr.resume_grad():
                integrand.pull_interaction(inputs, *known)
            return ()

        # Packets of paths of which none goes on spare it.
        known = vertex.face, vertex.b1, vertex.b2, mi.Bool(active), *bars
        dr.if_stmt(known, active, act, lambda *_: (), mode="symbolic")

    def initialise_pending() -> Any:
        """Nothing is known but which vertex is the last."""
        if not carried:
            return ()
        lanes, last = records.path_count, records.read_vertex(depth - 1)
        with dr.suspend_grad():
            here = last.compute_interaction(fixed)
        none = PathVertex(last.face, last.b1, last.b2, dr.zeros(mi.Float, lanes), None)
        return {
            "own": _vertex_columns(last),
            "later": _vertex_columns(none),
            "seen": last.is_visible,
            "here": here.detached_state,
            "onward": dr.zeros(mi.Point3f, lanes),
            "position": dr.zeros(mi.Point3f, lanes),
            "normal": dr.zeros(mi.Vector3f, lanes),
            "jacobian": dr.zeros(mi.Float, lanes),
            "earlier": dr.zeros(mi.Point3f, lanes),
        }

    def pull_sheets(
        vertex: _VertexFactors, power: Any, length: Any, power_sum: Any, range_sum: Any
    ) -> None:
        own = (
            dr.select(vertex.is_visible, power, 0.0),
            dr.select(vertex.is_visible, 0.5 * length, 0.0),
        )
        again = [dr.select(vertex.shares_segment, amount, 0.0) for amount in own]
        weights = power_sum + again[0], range_sum + again[1]
        segments = (
            (vertex.endpoints[0], vertex.active, weights),
            (vertex.endpoints[2], vertex.is_visible & ~vertex.shares_segment, own),
        )
        for start, active, (by_transmittance, by_extra) in segments:

            def act(
                _: Any, transmittance: Any, extra: Any, a: Any = by_transmittance, b: Any = by_extra
            ) -> None:
                known = dr.detach(transmittance) > 0
                dr.backward_from(
                    _log_derivative_factor(known, a, transmittance) * transmittance + b * extra
                )

            visit_sheets(rays, inputs, start, vertex.endpoints[1], active, {}, act)

    pending = _sweep_vertices(rays, records, sweep, initialise_pending(), backwards=True)
    if carried:
        with dr.resume_grad():
            first = PathVertex(**pending["later"], is_visible=None)
            pull_vertex(first, pending, first.exists)


def _vertex_columns(vertex: PathVertex) -> dict[str, Any]:
    """What a loop carries of a vertex besides whether it is seen."""
    return {name: getattr(vertex, name) for name in ("face", "b1", "b2", "throughput")}


def push(
    rays: RayScene,
    inputs: Inputs,
    records: PathRecords,
    scatter: Callable[[PathContribution, tuple[Any, Any, Any, Any], Any], None],
) -> None:
    """Forward mode: hand on every path with the derivatives of its power, range, u and v.

    Args:
        rays: The scene and its antennas.
        inputs: Attached tables.
        records: Vertices of the paths.
        scatter: Takes paths, the derivatives of their power, range, u and v, and which exist.
    """
    depth = opaque(records.depth)
    antennas = _AntennaPoses.look_up(inputs, records.frame)

    def sweep(number: Any, sums: Any, pending: Any) -> tuple[Any, Any]:
        growth, longer = sums
        with dr.resume_grad():
            near = _VertexNeighbours.read(inputs, records, number, depth)
            vertex = _evaluate_vertex(rays, inputs, records, antennas, number, near)
            path = vertex.to_contribution()
            values = (
                vertex.incident_factor,
                vertex.optical_length,
                path.power,
                vertex.connection.distance,
                path.u,
                path.v,
                vertex.scattering_factor,
            )
            # u and v also feed the pattern, so that by default their derivatives would be
            # cleared once passed on.
            dots = dr.forward_to(*values, flags=dr.ADFlag.ClearEdges)
        arriving, segment, power, distance, u, v, scattered = (dr.detach(dot) for dot in dots)
        growth = growth + _log_derivative_factor(vertex.active, arriving, vertex.incident_factor)
        longer = longer + dr.select(vertex.active, segment, 0.0)
        found, more, further = dr.detach(path.power), mi.Float(0.0), mi.Float(0.0)
        if inputs.surfaces.has_sheets:
            by_segment = push_sheets(vertex.endpoints[0], vertex.endpoints[1], vertex.active)
            by_end = push_sheets(
                vertex.endpoints[2], vertex.endpoints[1], vertex.is_visible & ~vertex.shares_segment
            )
            growth, longer = growth + by_segment[0], longer + by_segment[1]
            more = by_end[0] + dr.select(vertex.shares_segment, by_segment[0], 0.0)
            further = by_end[1] + dr.select(vertex.shares_segment, by_segment[1], 0.0)
        scatter(
            PathContribution(
                vertex.frame, found, *(dr.detach(x) for x in path.differentiable_values[1:])
            ),
            (power + (growth + more) * found, 0.5 * (longer + distance + further), u, v),
            vertex.is_visible,
        )
        growth = growth + _log_derivative_factor(
            vertex.has_next, scattered, vertex.scattering_factor
        )
        return (growth, longer), pending

    def push_sheets(start: Any, end: Any, active: Any) -> tuple[Any, Any]:
        def act(carry: dict[str, Any], transmittance: Any, extra: Any) -> None:
            dots = dr.forward_to(transmittance, extra, flags=dr.ADFlag.ClearEdges)
            known = dr.detach(transmittance) > 0
            carry["growth"] = carry["growth"] + _log_derivative_factor(
                known, dr.detach(dots[0]), transmittance
            )
            carry["longer"] = carry["longer"] + dr.detach(dots[1])

        carry: dict[str, Any] = {
            name: dr.zeros(mi.Float, records.path_count) for name in ("growth", "longer")
        }
        done = visit_sheets(rays, inputs, start, end, active, carry, act)
        return done["growth"], done["longer"]

    _sweep_vertices(rays, records, sweep, ())


def _sweep_vertices(
    rays: RayScene,
    records: PathRecords,
    sweep: Callable[[Any, Any, Any], tuple[Any, Any]],
    pending: Any,
    *,
    backwards: bool = False,
) -> Any:
    """Carry two sums along all paths, vertex by vertex, from the near end or from the far one.

    What else is to be carried is given, and returned as it is at the end.
    """
    last = opaque(records.depth - 1)
    sums = tuple(dr.zeros(mi.Float, records.path_count) for _ in range(2))
    with dr.suspend_grad():
        if records.depth == 1:
            return sweep(mi.UInt32(0), sums, pending)[1]
        state = rays.loop(
            (dr.zeros(mi.UInt32, records.path_count), sums, pending),
            lambda done, *_: done <= last,
            lambda done, *carried: (done + 1, *sweep(last - done if backwards else done, *carried)),
        )
        return state[2]
