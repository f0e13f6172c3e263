"""Derivatives of paths, replayed vertex by vertex from their records.

In material form the vertices of a path are independent of each other: vertex k enters only with
its neighbours. So the adjoint of a path and of all its beginnings is one sweep from its far end,
which carries two sums, Σ C ∂L/∂C and Σ ∂L/∂R over the paths that go on beyond the vertex. Nothing
but the records is stored, whatever the depth; the tangent is one sweep from the near end.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power.bins import Contribution
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.passage import Passage, crossed, passage
from invertwin.channel.power.walk import Records
from invertwin.channel.rays.arrays import opaque
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.scene import RayScene


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


def _vertex(rays: RayScene, inputs: Inputs, records: Records, number: Any, depth: Any) -> _Vertex:
    """Evaluate vertex ``number`` (from 0 to ``depth`` − 1) of every path."""
    lanes, single = records.lanes, records.depth == 1
    lane = dr.arange(mi.UInt32, lanes)

    def read(name: str, at: Any, active: Any = True) -> Any:
        column = getattr(records, name)
        return column if single else dr.gather(type(column), column, at * lanes + lane, active)

    throughput, frame = read("throughput", number), records.frame
    active = throughput != 0

    def located(at: Any, exists: Any) -> integrand.Place:
        face, b1, b2 = (read(name, at, exists) for name in ("face", "b1", "b2"))
        return integrand.place(inputs, face, b1, b2, exists)

    inner = mi.Bool(False) if single else active & (number > 0)

    def previous() -> Any:
        transmitter = inputs.antenna(frame, False, active)
        if single:
            return transmitter
        return dr.select(inner, located(number - 1, inner).position, transmitter)

    here, before = located(number, active), previous()
    back, distance = integrand.segment(here.position, before)
    optical, lost = distance, mi.Float(1.0)
    if inputs.surfaces.bodies and not single:
        inside = integrand.medium(inputs, here, located(number - 1, inner), back, inner)
        optical, lost = distance * inside.index, dr.exp(-inside.attenuation * distance)
    first = active if single else active & (number == 0)
    seen_from_tx = integrand.to_radar(inputs, frame, -back, first)
    gain = dr.select(first, inputs.gain(frame, False, seen_from_tx), 1.0)
    arriving = gain * here.jacobian * lost / dr.square(distance)
    connection = integrand.connection(
        inputs, frame, here, back, True, active, same=single and inputs.monostatic
    )
    goes_on, scattered = mi.Bool(False), mi.Float(1.0)
    if not single:
        goes_on = active & (number + 1 < depth)
        goes_on &= read("throughput", number + 1, goes_on) != 0
        transmitter = inputs.antenna(frame, False, active)
        onward = dr.select(goes_on, located(number + 1, goes_on).position, transmitter)
        direction, _ = integrand.segment(here.position, onward)
        scattered = inputs.surfaces.scattered(here.surface, here.normal, back, direction, goes_on)
    seen = active & read("seen", number)
    twice, passed = mi.Bool(False), Passage(mi.Float(1.0), mi.Float(0.0))
    if inputs.surfaces.sheets:
        twice = first if rays.link.shared_visibility else twice
        end = dr.select(twice, before, inputs.antenna(frame, True, active))
        fixed = (dr.detach(here.position), dr.detach(end))
        with dr.suspend_grad():
            passed = passage(rays, inputs.detached(), *fixed, seen)
    return _Vertex(
        passed=passed,
        twice=twice,
        ends=(
            previous,
            lambda: located(number, active).position,
            lambda: inputs.antenna(frame, True, active),
        ),
        active=active,
        goes_on=goes_on,
        seen=seen,
        throughput=throughput,
        length=read("length", number),
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

    def sweep(number: Any, power_sum: Any, range_sum: Any) -> tuple[Any, Any]:
        with dr.resume_grad():
            vertex = _vertex(rays, inputs, records, number, depth)
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
            objective = dr.select(vertex.active, so_far, 0.0) + dr.select(vertex.seen, ending, 0.0)
            objective += dr.select(vertex.goes_on, later, 0.0)
            dr.backward_from(objective)
        if inputs.surfaces.sheets:
            pull_sheets(vertex, power * dr.detach(path.power), length, power_sum, range_sum)
        return power_sum, range_sum

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

    _swept(rays, records, sweep, backwards=True)


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

    def sweep(number: Any, growth: Any, longer: Any) -> tuple[Any, Any]:
        with dr.resume_grad():
            vertex = _vertex(rays, inputs, records, number, depth)
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
        return growth, longer

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

    _swept(rays, records, sweep)


def _swept(
    rays: RayScene,
    records: Records,
    sweep: Callable[[Any, Any, Any], tuple[Any, Any]],
    *,
    backwards: bool = False,
) -> None:
    """Carry two sums along all paths, vertex by vertex, from the near end or from the far one."""
    last = opaque(records.depth - 1)
    first, second = (dr.zeros(mi.Float, records.lanes) for _ in range(2))
    with dr.suspend_grad():
        if records.depth == 1:
            sweep(mi.UInt32(0), first, second)
            return
        rays.loop(
            (dr.zeros(mi.UInt32, records.lanes), first, second),
            lambda done, *_: done <= last,
            lambda done, *sums: (done + 1, *sweep(last - done if backwards else done, *sums)),
        )
