"""Path replay: derivatives of paths, vertex by vertex, from their records.

In material form the vertices of a path are independent of each other: vertex k enters only with
its neighbours. The adjoint of a path and of all its prefixes is therefore one sweep from its far
end, which carries two sums, Σ C ∂L/∂C and Σ ∂L/∂R, over the paths that continue beyond the vertex.
Nothing but the records is stored, whatever the depth; the tangent is one sweep from the near end
(path replay backpropagation, Vicini et al. 2021).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

from invertwin.channel.power import integrand
from invertwin.channel.power import transmission as sheets
from invertwin.channel.power.bins import FourFloats, PathContribution
from invertwin.channel.power.integrand import Inputs, SurfaceInteraction
from invertwin.channel.power.random_walk import PathRecords, PathVertex
from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.surface_point import SurfacePoint

Sums = tuple[mit.Float, mit.Float]
Position = Callable[[], mit.Point3f]
Gradients = tuple[mit.Point3f, mit.Vector3f, mit.Float]
"""Gradients with respect to position, normal and Jacobian."""
Gradient = TypeVar("Gradient")


@dataclass(frozen=True)
class _VertexFactors:
    """Factors of a path at one vertex.

    The masks are detached; the factors are attached.

    Attributes:
        active: mask of paths with this vertex.
        has_next: mask of paths with a further vertex.
        is_visible: mask of vertices that are connected to the receiver.
        path: contribution of the path that ends here.
        incident_factor: gain at the start, 1/R² of the segment before the vertex, Jacobian.
        optical_length: optical length of that segment [m].
        distance: length of the connection to the receiver [m].
        scattering_factor: scattering towards the next vertex.
        shares_segment: mask of connections with the same transmission as the segment before.
        endpoints: functions that locate the previous vertex, this one, and the receiver.
    """

    active: mit.Bool
    has_next: mit.Bool
    is_visible: mit.Bool
    path: PathContribution
    incident_factor: mit.Float
    optical_length: mit.Float
    distance: mit.Float
    scattering_factor: mit.Float
    shares_segment: mit.Bool
    endpoints: tuple[Position, Position, Position]


@dataclass(frozen=True)
class _VertexNeighbours:
    """Vertex and its neighbours on the path.

    Attributes:
        vertex: the vertex.
        previous: vertex before; None on paths of one vertex.
        has_next: mask of paths with a further vertex.
        interaction: location of the vertex.
        previous_interaction: location of the vertex before; None on paths of one vertex.
        next_position: position of the next vertex; None on paths of one vertex.
    """

    vertex: PathVertex
    previous: PathVertex | None
    has_next: mit.Bool
    interaction: SurfaceInteraction
    previous_interaction: SurfaceInteraction | None
    next_position: mit.Point3f | None

    @staticmethod
    def read(
        inputs: Inputs, records: PathRecords, number: mit.UInt32, depth: mit.UInt32
    ) -> _VertexNeighbours:
        """Read a vertex of every path, attached if the inputs are.

        Args:
            inputs: inputs of the kernel.
            records: vertices of the paths.
            number: vertex number, from 0 to ``depth`` − 1.
            depth: most vertices of a path.
        """
        vertex = records.read_vertex(number)
        here = integrand.compute_interaction(inputs, vertex, vertex.exists)
        if records.depth == 1:
            return _VertexNeighbours(vertex, None, mi.Bool(False), here, None, None)
        inner, follows = vertex.exists & (number > 0), vertex.exists & (number + 1 < depth)
        previous = records.read_vertex(number - 1, inner)
        following = records.read_vertex(number + 1, follows)
        has_next = follows & following.exists
        before = integrand.compute_interaction(inputs, previous, inner)
        after = integrand.compute_interaction(inputs, following, has_next)
        return _VertexNeighbours(vertex, previous, has_next, here, before, after.position)

    def as_leaf_variables(self) -> _VertexNeighbours:
        """Copy the vertices, with positions that carry derivatives of their own."""
        assert self.previous_interaction is not None
        known, one = self.interaction, dr.ones(mi.Float, dr.width(self.vertex.face))
        position, normal = mi.Point3f(known.position), mi.Vector3f(known.normal)
        here = SurfaceInteraction(position, normal, known.surface_row, one)
        before = self.previous_interaction
        before = replace(before, position=mi.Point3f(before.position))
        after = mi.Point3f(self.next_position)
        dr.enable_grad(here.position, here.normal, here.jacobian, before.position, after)
        return replace(self, interaction=here, previous_interaction=before, next_position=after)


_Antennas = Callable[[bool, Any], integrand.AntennaPose]
"""Function of True for the receiver and of the mask of active lanes; returns the pose."""


def _locate_antennas(inputs: Inputs, frame: mit.UInt32) -> _Antennas:
    """Locate the antennas, once unless they carry derivatives."""
    if any(dr.grad_enabled(inputs.table(name)) for name in ("tx", "rx", "rotations")):
        return partial(integrand.AntennaPose.look_up, inputs, frame)
    poses = [integrand.AntennaPose.look_up(inputs, frame, end) for end in (False, True)]
    return lambda receiver, _: poses[receiver]


def _evaluate_vertex(
    inputs: Inputs,
    records: PathRecords,
    antennas: _Antennas,
    number: mit.UInt32,
    neighbours: _VertexNeighbours,
) -> _VertexFactors:
    """Evaluate the factors of every path at one vertex."""
    single, frame = neighbours.previous_interaction is None, records.frame
    vertex, here, has_next = neighbours.vertex, neighbours.interaction, neighbours.has_next
    active = vertex.exists
    inner = mi.Bool(False) if single else active & (number > 0)

    def locate_previous(locate: Callable[[], SurfaceInteraction | None]) -> mit.Point3f:
        start = antennas(False, active).position
        previous = locate()
        return start if previous is None else dr.select(inner, previous.position, start)

    before = locate_previous(lambda: neighbours.previous_interaction)
    incident, distance = integrand.direction_and_distance(here.position, before)
    optical, attenuation = distance, mi.Float(1.0)
    if inputs.surfaces.has_refracting_bodies and neighbours.previous_interaction is not None:
        medium = integrand.find_medium(
            inputs, here, neighbours.previous_interaction, incident, inner
        )
        optical = distance * medium.refractive_index
        attenuation = dr.exp(-medium.attenuation * distance)
    first = active if single else active & (number == 0)
    departure = integrand.project_to_axes(antennas(False, first).axes, -incident)
    gain = dr.select(first, inputs.gain(frame, False, departure), 1.0)
    arriving = gain * here.jacobian * attenuation / dr.square(distance)
    receiver = antennas(True, active)
    connection = integrand.connect_antenna(
        inputs, frame, here, incident, True, active,
        is_same_antenna=single and inputs.monostatic, antenna=receiver,
    )  # fmt: skip
    scattered = mi.Float(1.0)
    if not single:
        start = antennas(False, active).position
        after = dr.select(has_next, neighbours.next_position, start)
        direction, _ = integrand.direction_and_distance(here.position, after)
        scattered = inputs.surfaces.evaluate_scattering(
            here.surface_row, here.normal, incident, direction, has_next
        )
    assert vertex.is_visible is not None
    visible = active & vertex.is_visible
    twice, passed = mi.Bool(False), sheets.SegmentTransmission.clear()
    if inputs.surfaces.has_sheets:
        twice = first if inputs.rays.link.shared_visibility else twice
        ends = dr.detach(here.position), dr.detach(dr.select(twice, before, receiver.position))
        with dr.suspend_grad():
            passed = sheets.trace_transmission(inputs.detach(), *ends, visible)

    def locate_attached() -> SurfaceInteraction | None:
        previous = neighbours.previous
        return previous and integrand.compute_interaction(inputs, previous, inner)

    power = vertex.throughput * connection.factor * passed.transmittance
    power = power * inputs.polarisation_factor(number + 1)
    length = records.length_at(number, active) + connection.distance + passed.extra_length
    u, v = connection.direction.y, connection.direction.z
    return _VertexFactors(
        path=PathContribution(frame, power, 0.5 * length, u, v),  # type: ignore[arg-type]
        shares_segment=twice,
        endpoints=(
            lambda: locate_previous(locate_attached),
            lambda: integrand.compute_interaction(inputs, vertex, active).position,
            lambda: antennas(True, active).position,
        ),
        active=active,
        has_next=has_next,
        is_visible=visible,
        incident_factor=arriving,
        optical_length=optical,
        distance=connection.distance,
        scattering_factor=scattered,
    )


def _log_derivative_factor(active: mit.Bool, total: mit.Float, value: mit.Float) -> mit.Float:
    """Factor of an attached value whose derivative is ``total · d log(value)``; 0 if inactive."""
    return dr.select(active, total / dr.detach(value), 0.0)


@dataclass
class _PendingVertex:
    """Vertex whose gradient is complete except for the contribution of the vertex before it.

    Not frozen, since loops of Dr.Jit assign their state field by field.

    Attributes:
        vertex: vertex that is evaluated next.
        following: vertex after it, to which the gradients belong.
        interaction: location of ``vertex``, detached.
        next_position: position of ``following``, detached.
        position, normal, jacobian: gradients with respect to the location of ``following``.
        previous_position: gradient with respect to the position of ``vertex``.
    """

    vertex: PathVertex
    following: PathVertex
    interaction: SurfaceInteraction
    next_position: mit.Point3f
    position: mit.Point3f
    normal: mit.Vector3f
    jacobian: mit.Float
    previous_position: mit.Point3f

    @staticmethod
    def initialise(inputs: Inputs, records: PathRecords, depth: mit.UInt32) -> _PendingVertex:
        """State before the sweep: the last vertex, and no gradients.

        Args:
            inputs: detached inputs.
            records: vertices of the paths.
            depth: most vertices of a path.
        """
        lanes, last = records.path_count, records.read_vertex(depth - 1)
        with dr.suspend_grad():
            here = integrand.compute_interaction(inputs, last)
        return _PendingVertex(
            last,
            PathVertex(last.face, last.b1, last.b2, dr.zeros(mi.Float, lanes), None),
            here.detach(),
            next_position=dr.zeros(mi.Point3f, lanes),
            position=dr.zeros(mi.Point3f, lanes),
            normal=dr.zeros(mi.Vector3f, lanes),
            jacobian=dr.zeros(mi.Float, lanes),
            previous_position=dr.zeros(mi.Point3f, lanes),
        )

    def read_neighbours(
        self, inputs: Inputs, records: PathRecords, number: mit.UInt32
    ) -> _VertexNeighbours:
        """Collect the vertex and its neighbours; only the one before is read.

        Args:
            inputs: detached inputs.
            records: vertices of the paths.
            number: vertex number, from 0.
        """

        def read(number: mit.UInt32) -> tuple[PathVertex, SurfaceInteraction]:
            previous = records.read_vertex(number - 1)
            return previous, integrand.compute_interaction(inputs, previous).detach()

        def skip(_: mit.UInt32) -> tuple[PathVertex, SurfaceInteraction]:
            # The first vertex has none before it: nothing is read.
            lanes = records.path_count
            face, zero = dr.zeros(mi.UInt32, lanes), dr.zeros(mi.Float, lanes)
            vertex = PathVertex(face, zero, zero, zero, dr.zeros(mi.Bool, lanes))
            position, normal = dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Vector3f, lanes)
            return vertex, SurfaceInteraction(position, normal, face, None)

        previous, before = dr.if_stmt((number,), number > 0, read, skip, mode="symbolic")
        is_inner = self.vertex.exists & self.following.exists
        here = self.interaction, before, self.next_position
        return _VertexNeighbours(self.vertex, previous, is_inner, *here)

    def advance(self, inputs: Inputs, neighbours: _VertexNeighbours) -> _PendingVertex:
        """Add the gradient of ``following``, which is complete now, and move one vertex back.

        Args:
            inputs: attached inputs.
            neighbours: leaf variables of the vertex, with gradients.
        """
        here, before = neighbours.interaction, neighbours.previous_interaction
        previous, exists = neighbours.previous, neighbours.vertex.exists
        assert before is not None
        assert previous is not None

        def gradient(value: Gradient, active: mit.Bool = exists) -> Gradient:
            return dr.select(active, dr.grad(value), 0.0)

        last = gradient(neighbours.next_position, neighbours.has_next)
        assert last is not None
        replace(self, position=self.position + last).pull(inputs, neighbours.has_next)
        return _PendingVertex(
            previous,
            replace(neighbours.vertex, is_visible=None),
            before.detach(),
            next_position=dr.detach(here.position),
            position=self.previous_position + gradient(here.position),  # type: ignore[arg-type]
            normal=gradient(here.normal),
            jacobian=gradient(here.jacobian),  # type: ignore[arg-type]
            previous_position=gradient(before.position),
        )

    def pull(self, inputs: Inputs, active: mit.Bool) -> None:
        """Add the gradient of ``following`` to the gradient of the corners of its triangle.

        Args:
            inputs: attached inputs.
            active: mask of paths that have this vertex.
        """

        def act(point: SurfacePoint, active: mit.Bool, gradients: Gradients) -> tuple[()]:
            with dr.resume_grad():
                integrand.pull_interaction(inputs, point, active, *gradients)
            return ()

        # Packets in which no path continues skip it.
        point = SurfacePoint(self.following.face, self.following.b1, self.following.b2)
        known = point, mi.Bool(active), (self.position, self.normal, self.jacobian)
        dr.if_stmt(known, active, act, lambda *_: (), mode="symbolic")


def pull(
    inputs: Inputs, records: PathRecords, gather: Callable[[PathContribution, mit.Bool], FourFloats]
) -> None:
    """Reverse mode (vector–Jacobian product): add to the gradients of the attached inputs.

    Args:
        inputs: attached inputs.
        records: vertices of the paths.
        gather: adjoints of paths: ∂loss/∂power, and power · ∂loss/∂(range, u, v).
    """
    depth = opaque(records.depth)
    antennas = _locate_antennas(inputs, records.frame)
    # With neighbours, the gradient of a vertex is complete before its triangle is gathered.
    carried = records.depth > 1 and dr.grad_enabled(inputs.vertices)
    fixed = inputs.detach()

    def sweep(
        number: mit.UInt32, sums: Sums, pending: _PendingVertex | None
    ) -> tuple[Sums, _PendingVertex | None]:
        power_sum, range_sum = sums
        known = pending.read_neighbours(fixed, records, number) if pending else None
        with dr.resume_grad():
            if known:
                near = known.as_leaf_variables()
            else:
                near = _VertexNeighbours.read(inputs, records, number, depth)
            vertex = _evaluate_vertex(inputs, records, antennas, number, near)
            path = vertex.path
            seen, scattering = vertex.is_visible, vertex.scattering_factor
            power, length, u, v = (dr.select(seen, a, 0.0) for a in gather(path, seen))
            after = _log_derivative_factor(vertex.has_next, power_sum, scattering) * scattering
            ending = power * path.power + 0.5 * length * vertex.distance
            ending += u * path.u + v * path.v
            power_sum = power_sum + dr.select(seen, power * dr.detach(path.power), 0.0)
            range_sum = range_sum + 0.5 * length
            arriving = vertex.incident_factor
            before = _log_derivative_factor(vertex.active, power_sum, arriving) * arriving
            before += range_sum * vertex.optical_length
            # The factors of the attached values are zero in lanes that do not count.
            dr.backward_from(before + ending + after)
            if pending:
                pending = pending.advance(inputs, near)
        if inputs.surfaces.has_sheets:
            own = power * dr.detach(path.power), 0.5 * length
            _pull_sheets(inputs, vertex, own, (power_sum, range_sum))
        return (power_sum, range_sum), pending

    initial = _PendingVertex.initialise(fixed, records, depth) if carried else None
    pending = _sweep_vertices(inputs.rays, records, sweep, initial, backwards=True)
    if pending:
        with dr.resume_grad():
            pending.pull(inputs, pending.following.exists)


def _pull_sheets(inputs: Inputs, vertex: _VertexFactors, own: Sums, sums: Sums) -> None:
    """Add the gradients of the sheets on the segment before a vertex and on its connection.

    Args:
        inputs: attached inputs.
        vertex: factors at the vertex.
        own: derivatives with respect to the logarithm of the power and to the length [m], of the
            path that ends at the vertex.
        sums: the same derivatives, summed over all paths that pass the segment before it.
    """
    own = tuple(dr.select(vertex.is_visible, amount, 0.0) for amount in own)  # type: ignore[assignment]
    again = [dr.select(vertex.shares_segment, amount, 0.0) for amount in own]

    def pull_segment(start: Position, active: mit.Bool, sums: Sums) -> None:
        def act(_: sheets.Carry, transmittance: mit.Float, extra: mit.Float) -> None:
            factor = _log_derivative_factor(dr.detach(transmittance) > 0, sums[0], transmittance)
            dr.backward_from(factor * transmittance + sums[1] * extra)

        sheets.visit_sheets(inputs, start, vertex.endpoints[1], active, {}, act)

    sums = sums[0] + again[0], sums[1] + again[1]
    pull_segment(vertex.endpoints[0], vertex.active, sums)
    pull_segment(vertex.endpoints[2], vertex.is_visible & ~vertex.shares_segment, own)


def push(
    inputs: Inputs,
    records: PathRecords,
    scatter: Callable[[PathContribution, FourFloats, mit.Bool], None],
) -> None:
    """Forward mode (Jacobian–vector product): scatter every path with its tangents.

    Args:
        inputs: attached inputs.
        records: vertices of the paths.
        scatter: function of paths, the tangents of their power, range, u and v, and the mask of
            lanes in which they exist.
    """
    depth = opaque(records.depth)
    antennas = _locate_antennas(inputs, records.frame)

    def sweep(number: mit.UInt32, sums: Sums, pending: None) -> tuple[Sums, None]:
        growth, longer = sums
        with dr.resume_grad():
            near = _VertexNeighbours.read(inputs, records, number, depth)
            vertex = _evaluate_vertex(inputs, records, antennas, number, near)
            path = vertex.path
            segment = vertex.incident_factor, vertex.optical_length
            ending = path.power, vertex.distance, path.u, path.v
            values = *segment, *ending, vertex.scattering_factor
            # u and v also enter the pattern; by default their tangents would be cleared once
            # propagated.
            tangents = dr.forward_to(*values, flags=dr.ADFlag.ClearEdges)
        arriving, segment, power, distance, u, v, scattered = map(dr.detach, tangents)
        growth = growth + _log_derivative_factor(vertex.active, arriving, vertex.incident_factor)
        longer = longer + dr.select(vertex.active, segment, 0.0)
        found, more, further = dr.detach(path.power), mi.Float(0.0), mi.Float(0.0)
        if inputs.surfaces.has_sheets:
            before, here, receiver = vertex.endpoints
            alone = vertex.is_visible & ~vertex.shares_segment
            by_segment = _push_sheets(inputs, before, here, vertex.active)
            by_end = _push_sheets(inputs, receiver, here, alone)
            growth, longer = growth + by_segment[0], longer + by_segment[1]
            more = by_end[0] + dr.select(vertex.shares_segment, by_segment[0], 0.0)
            further = by_end[1] + dr.select(vertex.shares_segment, by_segment[1], 0.0)
        detached = (dr.detach(value) for value in (path.range, path.u, path.v))
        scatter(
            PathContribution(path.frame, found, *detached),
            (power + (growth + more) * found, 0.5 * (longer + distance + further), u, v),
            vertex.is_visible,
        )
        scattering = vertex.scattering_factor
        growth = growth + _log_derivative_factor(vertex.has_next, scattered, scattering)
        return (growth, longer), pending

    _sweep_vertices(inputs.rays, records, sweep, None)


def _push_sheets(inputs: Inputs, start: Position, end: Position, active: mit.Bool) -> Sums:
    """Compute the tangents of the logarithmic transmittance and of the extra length [m]."""

    def act(carry: sheets.Carry, transmittance: mit.Float, extra: mit.Float) -> None:
        tangents = dr.forward_to(transmittance, extra, flags=dr.ADFlag.ClearEdges)
        carry["growth"] = carry["growth"] + _log_derivative_factor(
            dr.detach(transmittance) > 0, dr.detach(tangents[0]), transmittance
        )
        carry["longer"] = carry["longer"] + dr.detach(tangents[1])

    zero = {name: dr.zeros(mi.Float, dr.width(active)) for name in ("growth", "longer")}
    done, _ = sheets.visit_sheets(inputs, start, end, active, zero, act)
    return done["growth"], done["longer"]


Pending = TypeVar("Pending")


def _sweep_vertices(
    rays: RayScene,
    records: PathRecords,
    sweep: Callable[[mit.UInt32, Sums, Pending], tuple[Sums, Pending]],
    pending: Pending,
    *,
    backwards: bool = False,
) -> Pending:
    """Carry two sums along all paths, vertex by vertex, from the near or the far end.

    Args:
        rays: ray scene.
        records: vertices of the paths.
        sweep: function of the vertex number and of what is carried, which it returns.
        pending: further state that is carried, and returned at the end.
        backwards: True to begin at the far end.
    """
    last, lanes = opaque(records.depth - 1), records.path_count
    zero: Sums = dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes)
    with dr.suspend_grad():
        if records.depth == 1:
            return sweep(mi.UInt32(0), zero, pending)[1]
        return rays.loop(
            (dr.zeros(mi.UInt32, lanes), zero, pending),
            lambda done, *_: done <= last,
            lambda done, *carried: (done + 1, *sweep(last - done if backwards else done, *carried)),
        )[2]
