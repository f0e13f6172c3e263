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
from invertwin.channel.power.bins import Contribution
from invertwin.channel.power.integrand import Inputs, Place
from invertwin.channel.power.random_walk import Recorded, Records
from invertwin.channel.power.transmission import Passage, crossed, passage
from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RayScene


@dataclass(frozen=True)
class _Vertex:
    """The attached factors at one vertex; detached throughput and masks."""

    active: Any
    goes_on: Any
    seen: Any
    throughput: Any
    length: Any
    frame: Any
    arriving: Any  # gain at the start, 1/R² of the segment here, Jacobian
    segment: Any  # optical length of the segment here
    connection: integrand.Connection
    coupled: Any  # what the antennas' polarisations take of the path that ends here
    scattered: Any  # towards the next vertex
    passed: Passage  # by the connection
    twice: Any  # whether the connection passes what the segment here passed
    ends: tuple[Callable[[], Any], Callable[[], Any], Callable[[], Any]]  # before, here, receiver

    def path(self) -> Contribution:
        """The path that ends here."""
        found, passed = self.connection, self.passed
        power = self.throughput * found.factor * passed.transmittance * self.coupled
        length = 0.5 * (self.length + found.distance + passed.extra)
        return Contribution(self.frame, power, length, found.seen.x, found.seen.y)


@dataclass(frozen=True)
class _Near:
    """A vertex and its neighbours on the path, as far as there are any."""

    own: Recorded
    earlier: Recorded | None  # the vertex before; None on paths of one vertex
    goes_on: Any  # whether there is a next one
    here: Place
    before: Place | None
    onward: Any  # position of the next vertex

    @staticmethod
    def of(inputs: Inputs, records: Records, number: Any, depth: Any) -> "_Near":
        """Vertex ``number`` (from 0 to ``depth`` − 1) of every path, as attached as the inputs."""
        own = records.at(number)
        here = own.place(inputs, own.exists)
        if records.depth == 1:
            return _Near(own, None, mi.Bool(False), here, None, None)
        inner, follows = own.exists & (number > 0), own.exists & (number + 1 < depth)
        earlier, later = records.at(number - 1, inner), records.at(number + 1, follows)
        goes_on = follows & later.exists
        before, onward = earlier.place(inputs, inner), later.place(inputs, goes_on)
        return _Near(own, earlier, goes_on, here, before, onward.position)

    def leaves(self) -> "_Near":
        """The same, but places with derivatives of their own."""
        assert self.before is not None
        here = Place(
            mi.Point3f(self.here.position),
            mi.Vector3f(self.here.normal),
            dr.ones(mi.Float, dr.width(self.own.face)),
            self.here.surface,
        )
        before = replace(self.before, position=mi.Point3f(self.before.position))
        onward = mi.Point3f(self.onward)
        dr.enable_grad(here.position, here.normal, here.jacobian, before.position, onward)
        return replace(self, here=here, before=before, onward=onward)


@dataclass(frozen=True)
class _Antennas:
    """Where paths start and end; looked up once where that carries no derivatives."""

    inputs: Inputs
    frame: Any
    ends: tuple[integrand.End, integrand.End] | None  # transmitter and receiver

    @staticmethod
    def of(inputs: Inputs, frame: Any) -> "_Antennas":
        if any(dr.grad_enabled(inputs.table(name)) for name in ("tx", "rx", "rotations")):
            return _Antennas(inputs, frame, None)
        first, second = (integrand.End.of(inputs, frame, receiver) for receiver in (False, True))
        return _Antennas(inputs, frame, (first, second))

    def end(self, receiver: bool, active: Any) -> integrand.End:
        if self.ends is not None:
            return self.ends[receiver]
        return integrand.End.of(self.inputs, self.frame, receiver, active)


def _vertex(
    rays: RayScene, inputs: Inputs, records: Records, antennas: _Antennas, number: Any, near: _Near
) -> _Vertex:
    """Evaluate vertex ``number`` of every path."""
    single, frame = near.before is None, records.frame
    own, here, goes_on = near.own, near.here, near.goes_on
    active = own.exists
    inner = mi.Bool(False) if single else active & (number > 0)

    def previous(place: Callable[[], Place | None]) -> Any:
        start = antennas.end(False, active).position
        earlier = place()
        return start if earlier is None else dr.select(inner, earlier.position, start)

    before = previous(lambda: near.before)
    back, distance = integrand.segment(here.position, before)
    optical, lost = distance, mi.Float(1.0)
    if inputs.surfaces.bodies and near.before is not None:
        inside = integrand.medium(inputs, here, near.before, back, inner)
        optical, lost = distance * inside.index, dr.exp(-inside.attenuation * distance)
    first = active if single else active & (number == 0)
    seen_from_tx = integrand.along_axes(antennas.end(False, first).axes, -back)
    gain = dr.select(first, inputs.gain(frame, False, seen_from_tx), 1.0)
    arriving = gain * here.jacobian * lost / dr.square(distance)
    receiver = antennas.end(True, active)
    connection = integrand.connection(
        inputs, frame, here, back, True, active, same=single and inputs.monostatic, end=receiver
    )
    scattered = mi.Float(1.0)
    if not single:
        start = antennas.end(False, active).position
        direction, _ = integrand.segment(here.position, dr.select(goes_on, near.onward, start))
        scattered = inputs.surfaces.scattered(here.surface, here.normal, back, direction, goes_on)
    seen = active & own.seen
    twice, passed = mi.Bool(False), Passage(mi.Float(1.0), mi.Float(0.0))
    if inputs.surfaces.sheets:
        twice = first if rays.link.shared_visibility else twice
        end = dr.select(twice, before, receiver.position)
        fixed = (dr.detach(here.position), dr.detach(end))
        with dr.suspend_grad():
            passed = passage(rays, inputs.detached(), *fixed, seen)
    return _Vertex(
        passed=passed,
        twice=twice,
        ends=(
            lambda: previous(lambda: near.earlier and near.earlier.place(inputs, inner)),
            lambda: own.place(inputs, active).position,
            lambda: antennas.end(True, active).position,
        ),
        active=active,
        goes_on=goes_on,
        seen=seen,
        throughput=own.throughput,
        length=records.length_at(number, active),
        frame=frame,
        arriving=arriving,
        segment=optical,
        connection=connection,
        coupled=inputs.coupled(number + 1),
        scattered=scattered,
    )


def _per(active: Any, total: Any, value: Any) -> Any:
    """total · dlog(value): what multiplies the attached value; zero where inactive."""
    return dr.select(active, total / dr.detach(value), 0.0)


def pull(
    rays: RayScene,
    inputs: Inputs,
    records: Records,
    gather: Callable[[Contribution, Any], tuple[Any, Any, Any, Any]],
) -> None:
    """Reverse mode: add to the gradients of the attached inputs.

    Args:
        rays: The scene and its antennas.
        inputs: Attached tables.
        records: Vertices of the paths.
        gather: Adjoints of paths: ∂loss/∂power, and power · ∂loss/∂(range, u, v).
    """
    depth = opaque(records.depth)
    antennas = _Antennas.of(inputs, records.frame)
    # With neighbours, all that moves a vertex is summed before its triangle is asked.
    carried = records.depth > 1 and dr.grad_enabled(inputs.vertices)
    fixed = inputs.detached()

    def sweep(number: Any, sums: Any, pending: Any) -> tuple[Any, Any]:
        power_sum, range_sum = sums
        known = waited(number, pending) if carried else None
        with dr.resume_grad():
            near = known.leaves() if known else _Near.of(inputs, records, number, depth)
            vertex = _vertex(rays, inputs, records, antennas, number, near)
            path = vertex.path()
            power, length, u, v = (
                dr.select(vertex.seen, bar, 0.0) for bar in gather(path, vertex.seen)
            )
            later = _per(vertex.goes_on, power_sum, vertex.scattered) * vertex.scattered
            ending = power * path.power + 0.5 * length * vertex.connection.distance
            ending += u * path.u + v * path.v
            power_sum = power_sum + dr.select(vertex.seen, power * dr.detach(path.power), 0.0)
            range_sum = range_sum + 0.5 * length
            so_far = _per(vertex.active, power_sum, vertex.arriving) * vertex.arriving
            so_far += range_sum * vertex.segment
            # What multiplies the attached values is zero where they do not count.
            dr.backward_from(so_far + ending + later)
            if carried:
                pending = moved_on(near, pending)
        if inputs.surfaces.sheets:
            pull_sheets(vertex, power * dr.detach(path.power), length, power_sum, range_sum)
        return (power_sum, range_sum), pending

    def waited(number: Any, pending: Any) -> _Near:
        """A vertex and its neighbours; only the one before has not been read yet."""
        own, later = (Recorded(**pending[name], seen=pending["seen"]) for name in ("own", "later"))
        identity, seen, before = dr.if_stmt((number,), number > 0, read, nothing, mode="symbolic")
        here, goes_on = Place.of(pending["here"]), own.exists & later.exists
        earlier = Recorded(**identity, seen=seen)
        return _Near(own, earlier, goes_on, here, Place.of(before), pending["onward"])

    def read(number: Any) -> tuple[Any, ...]:
        earlier = records.at(number - 1)
        return _identity(earlier), earlier.seen, earlier.place(fixed).parts

    def nothing(_: Any) -> tuple[Any, ...]:
        # Before the first vertex there is none, which spares reading it.
        lanes, zero = records.lanes, dr.zeros(mi.Float, records.lanes)
        face = dr.zeros(mi.UInt32, lanes)
        identity = {"face": face, "b1": zero, "b2": zero, "throughput": zero}
        place = {
            "position": dr.zeros(mi.Point3f, lanes),
            "normal": dr.zeros(mi.Vector3f, lanes),
            "surface": face,
        }
        return identity, dr.zeros(mi.Bool, lanes), place

    def moved_on(near: _Near, pending: Any) -> Any:
        """Ask the triangle of the next vertex, of which all is known now; this one waits."""
        here, before, earlier = near.here, near.before, near.earlier
        assert before is not None
        assert earlier is not None

        def moved(value: Any, active: Any = near.own.exists) -> Any:
            return dr.select(active, dr.grad(value), 0.0)

        position = pending["position"] + moved(near.onward, near.goes_on)
        told(
            Recorded(**pending["later"], seen=None), pending | {"position": position}, near.goes_on
        )
        return {
            "own": _identity(earlier),
            "later": _identity(near.own),
            "seen": earlier.seen,
            "here": before.parts,
            "onward": dr.detach(here.position),
            "position": pending["earlier"] + moved(here.position),
            "normal": moved(here.normal),
            "jacobian": moved(here.jacobian),
            "earlier": moved(before.position),
        }

    def told(vertex: Recorded, pending: Any, active: Any) -> None:
        bars = tuple(pending[name] for name in ("position", "normal", "jacobian"))

        def act(*known: Any) -> tuple[()]:
            with dr.resume_grad():
                integrand.pull_place(inputs, *known)
            return ()

        # Packets of paths of which none goes on spare it.
        known = vertex.face, vertex.b1, vertex.b2, mi.Bool(active), *bars
        dr.if_stmt(known, active, act, lambda *_: (), mode="symbolic")

    def waiting() -> Any:
        """Nothing is known but which vertex is the last."""
        if not carried:
            return ()
        lanes, last = records.lanes, records.at(depth - 1)
        with dr.suspend_grad():
            here = last.place(fixed)
        none = Recorded(last.face, last.b1, last.b2, dr.zeros(mi.Float, lanes), None)
        return {
            "own": _identity(last),
            "later": _identity(none),
            "seen": last.seen,
            "here": here.parts,
            "onward": dr.zeros(mi.Point3f, lanes),
            "position": dr.zeros(mi.Point3f, lanes),
            "normal": dr.zeros(mi.Vector3f, lanes),
            "jacobian": dr.zeros(mi.Float, lanes),
            "earlier": dr.zeros(mi.Point3f, lanes),
        }

    def pull_sheets(
        vertex: _Vertex, power: Any, length: Any, power_sum: Any, range_sum: Any
    ) -> None:
        own = dr.select(vertex.seen, power, 0.0), dr.select(vertex.seen, 0.5 * length, 0.0)
        again = [dr.select(vertex.twice, amount, 0.0) for amount in own]
        weights = power_sum + again[0], range_sum + again[1]
        segments = (
            (vertex.ends[0], vertex.active, weights),
            (vertex.ends[2], vertex.seen & ~vertex.twice, own),
        )
        for start, active, (by_transmittance, by_extra) in segments:

            def act(
                _: Any, transmittance: Any, extra: Any, a: Any = by_transmittance, b: Any = by_extra
            ) -> None:
                known = dr.detach(transmittance) > 0
                dr.backward_from(_per(known, a, transmittance) * transmittance + b * extra)

            crossed(rays, inputs, start, vertex.ends[1], active, {}, act)

    pending = _swept(rays, records, sweep, waiting(), backwards=True)
    if carried:
        with dr.resume_grad():
            first = Recorded(**pending["later"], seen=None)
            told(first, pending, first.exists)


def _identity(vertex: Recorded) -> dict[str, Any]:
    """What a loop carries of a vertex besides whether it is seen."""
    return {name: getattr(vertex, name) for name in ("face", "b1", "b2", "throughput")}


def push(
    rays: RayScene,
    inputs: Inputs,
    records: Records,
    scatter: Callable[[Contribution, tuple[Any, Any, Any, Any], Any], None],
) -> None:
    """Forward mode: hand on every path with the derivatives of its power, range, u and v.

    Args:
        rays: The scene and its antennas.
        inputs: Attached tables.
        records: Vertices of the paths.
        scatter: Takes paths, the derivatives of their power, range, u and v, and which exist.
    """
    depth = opaque(records.depth)
    antennas = _Antennas.of(inputs, records.frame)

    def sweep(number: Any, sums: Any, pending: Any) -> tuple[Any, Any]:
        growth, longer = sums
        with dr.resume_grad():
            near = _Near.of(inputs, records, number, depth)
            vertex = _vertex(rays, inputs, records, antennas, number, near)
            path = vertex.path()
            values = (
                vertex.arriving, vertex.segment, path.power, vertex.connection.distance,
                path.u, path.v, vertex.scattered,
            )  # fmt: skip
            # u and v also feed the pattern, so that by default their derivatives would be
            # cleared once passed on.
            dots = dr.forward_to(*values, flags=dr.ADFlag.ClearEdges)
        arriving, segment, power, distance, u, v, scattered = (dr.detach(dot) for dot in dots)
        growth = growth + _per(vertex.active, arriving, vertex.arriving)
        longer = longer + dr.select(vertex.active, segment, 0.0)
        found, more, further = dr.detach(path.power), mi.Float(0.0), mi.Float(0.0)
        if inputs.surfaces.sheets:
            by_segment = push_sheets(vertex.ends[0], vertex.ends[1], vertex.active)
            by_end = push_sheets(vertex.ends[2], vertex.ends[1], vertex.seen & ~vertex.twice)
            growth, longer = growth + by_segment[0], longer + by_segment[1]
            more = by_end[0] + dr.select(vertex.twice, by_segment[0], 0.0)
            further = by_end[1] + dr.select(vertex.twice, by_segment[1], 0.0)
        scatter(
            Contribution(vertex.frame, found, *(dr.detach(x) for x in path.attached[1:])),
            (power + (growth + more) * found, 0.5 * (longer + distance + further), u, v),
            vertex.seen,
        )
        growth = growth + _per(vertex.goes_on, scattered, vertex.scattered)
        return (growth, longer), pending

    def push_sheets(start: Any, end: Any, active: Any) -> tuple[Any, Any]:
        def act(carry: dict[str, Any], transmittance: Any, extra: Any) -> None:
            dots = dr.forward_to(transmittance, extra, flags=dr.ADFlag.ClearEdges)
            known = dr.detach(transmittance) > 0
            carry["growth"] = carry["growth"] + _per(known, dr.detach(dots[0]), transmittance)
            carry["longer"] = carry["longer"] + dr.detach(dots[1])

        carry: dict[str, Any] = {
            name: dr.zeros(mi.Float, records.lanes) for name in ("growth", "longer")
        }
        done = crossed(rays, inputs, start, end, active, carry, act)
        return done["growth"], done["longer"]

    _swept(rays, records, sweep, ())


def _swept(
    rays: RayScene,
    records: Records,
    sweep: Callable[[Any, Any, Any], tuple[Any, Any]],
    pending: Any,
    *,
    backwards: bool = False,
) -> Any:
    """Carry two sums along all paths, vertex by vertex, from the near end or from the far one.

    What else is to be carried is given, and returned as it is at the end.
    """
    last = opaque(records.depth - 1)
    sums = tuple(dr.zeros(mi.Float, records.lanes) for _ in range(2))
    with dr.suspend_grad():
        if records.depth == 1:
            return sweep(mi.UInt32(0), sums, pending)[1]
        state = rays.loop(
            (dr.zeros(mi.UInt32, records.lanes), sums, pending),
            lambda done, *_: done <= last,
            lambda done, *carried: (done + 1, *sweep(last - done if backwards else done, *carried)),
        )
        return state[2]
