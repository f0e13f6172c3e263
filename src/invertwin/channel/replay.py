"""Derivatives of chains, replayed vertex by vertex from their records.

In material form the vertices of a chain are independent of each other: vertex k enters only with
its neighbours. So the adjoint of all paths along a chain is one sweep from its far end, which
carries two sums, Σ C ∂L/∂C and Σ ∂L/∂R over the paths that go on beyond the vertex. Nothing but
the records is stored, whatever the depth; the tangent is one sweep from the near end.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from invertwin.channel import kernel
from invertwin.channel.bins import Contribution
from invertwin.channel.bridge import opaque, tracer
from invertwin.channel.kernel import Inputs
from invertwin.channel.walk import Records


@dataclass(frozen=True)
class _Vertex:
    """The attached factors at one vertex; detached throughput and masks."""

    active: Any
    goes_on: Any
    seen: Any
    throughput: Any
    length: Any
    frame: Any
    arriving: Any  # gain at the start, 1/R² of the leg here, Jacobian
    leg: Any
    connection: kernel.Connection
    scattered: Any  # towards the next vertex

    def path(self) -> Contribution:
        """The path that ends here."""
        found = self.connection
        power = self.throughput * found.factor
        length = 0.5 * (self.length + found.distance)
        return Contribution(self.frame, power, length, found.seen.x, found.seen.y)


def _vertex(inputs: Inputs, records: Records, number: Any) -> _Vertex:
    """Evaluate vertex ``number`` (from 0) of every chain."""
    import drjit as dr

    mi = tracer()
    lanes, single = records.lanes, records.depth == 1
    lane = dr.arange(mi.UInt32, lanes)

    def read(name: str, at: Any, active: Any = True) -> Any:
        column = getattr(records, name)
        return column if single else dr.gather(type(column), column, at * lanes + lane, active)

    throughput, frame = read("throughput", number), records.frame
    active = throughput != 0

    def located(at: Any, exists: Any) -> kernel.Place:
        face, b1, b2 = (read(name, at, exists) for name in ("face", "b1", "b2"))
        return kernel.place(inputs, face, b1, b2, exists)

    here = located(number, active)
    transmitter = inputs.antenna(frame, False, active)
    before, gain = transmitter, mi.Float(1.0)
    if not single:
        inner = active & (number > 0)
        before = dr.select(inner, located(number - 1, inner).position, transmitter)
    back, leg = kernel.leg(here.position, before)
    first = active if single else active & (number == 0)
    seen_from_tx = kernel.to_radar(inputs, frame, -back, first)
    gain = dr.select(first, inputs.gain(frame, False, seen_from_tx), 1.0)
    arriving = gain * here.jacobian / dr.square(leg)
    connection = kernel.connection(
        inputs, frame, here, back, True, active, same=single and inputs.monostatic
    )
    goes_on, scattered = mi.Bool(False), mi.Float(1.0)
    if not single:
        goes_on = active & (number + 1 < records.depth)
        goes_on &= read("throughput", number + 1, goes_on) != 0
        onward = dr.select(goes_on, located(number + 1, goes_on).position, transmitter)
        direction, _ = kernel.leg(here.position, onward)
        scattered = kernel.reflected(inputs, here.surface, here.normal, back, direction, goes_on)
    return _Vertex(
        active=active,
        goes_on=goes_on,
        seen=active & read("seen", number),
        throughput=throughput,
        length=read("length", number),
        frame=frame,
        arriving=arriving,
        leg=leg,
        connection=connection,
        scattered=scattered,
    )


def _share(active: Any, total: Any, value: Any) -> Any:
    """total · dlog(value): what multiplies the attached value; zero where inactive."""
    import drjit as dr

    return dr.select(active, total / dr.detach(value), 0.0)


def pull(
    inputs: Inputs,
    records: Records,
    gather: Callable[[Contribution, Any], tuple[Any, Any, Any, Any]],
) -> None:
    """Reverse mode: adds to the gradients of the attached inputs.

    ``gather`` gives ∂loss/∂power, and power · ∂loss/∂(range, u, v)-like adjoints of paths.
    """
    import drjit as dr

    mi = tracer()

    def sweep(number: Any, power_sum: Any, range_sum: Any) -> tuple[Any, Any]:
        with dr.resume_grad():
            vertex = _vertex(inputs, records, number)
            path = vertex.path()
            power, length, u, v = (
                dr.select(vertex.seen, bar, 0.0) for bar in gather(path, vertex.seen)
            )
            later = _share(vertex.goes_on, power_sum, vertex.scattered) * vertex.scattered
            ending = power * path.power + 0.5 * length * vertex.connection.distance
            ending += u * path.u + v * path.v
            power_sum = power_sum + dr.select(vertex.seen, power * dr.detach(path.power), 0.0)
            range_sum = range_sum + 0.5 * length
            so_far = _share(vertex.active, power_sum, vertex.arriving) * vertex.arriving
            so_far += range_sum * vertex.leg
            objective = dr.select(vertex.active, so_far, 0.0) + dr.select(vertex.seen, ending, 0.0)
            objective += dr.select(vertex.goes_on, later, 0.0)
            dr.backward_from(objective)
        return power_sum, range_sum

    zero = dr.zeros(mi.Float, records.lanes)
    with dr.suspend_grad():
        if records.depth == 1:
            sweep(mi.UInt32(0), zero, zero)
            return
        depth = dr.zeros(mi.UInt32, records.lanes) + opaque(records.depth)
        dr.while_loop(
            (depth, zero, dr.zeros(mi.Float, records.lanes)),
            lambda left, *_: left > 0,
            lambda left, power, length: (left - 1, *sweep(left - 1, power, length)),
            mode="symbolic",
        )


def push(
    inputs: Inputs,
    records: Records,
    scatter: Callable[[Contribution, tuple[Any, Any, Any, Any], Any], None],
) -> None:
    """Forward mode: hands every path and the derivatives of its power, range, u, v on."""
    import drjit as dr

    mi = tracer()

    def sweep(number: Any, growth: Any, longer: Any) -> tuple[Any, Any]:
        with dr.resume_grad():
            vertex = _vertex(inputs, records, number)
            path = vertex.path()
            values = (
                vertex.arriving, vertex.leg, path.power, vertex.connection.distance,
                path.u, path.v, vertex.scattered,
            )  # fmt: skip
            # u and v also feed the pattern, so that by default their derivatives would be
            # cleared once passed on.
            dots = dr.forward_to(*values, flags=dr.ADFlag.ClearEdges)
        arriving, leg, power, distance, u, v, scattered = (dr.detach(dot) for dot in dots)
        growth = growth + _share(vertex.active, arriving, vertex.arriving)
        longer = longer + dr.select(vertex.active, leg, 0.0)
        found = dr.detach(path.power)
        scatter(
            Contribution(vertex.frame, found, *(dr.detach(x) for x in path.attached[1:])),
            (power + growth * found, 0.5 * (longer + distance), u, v),
            vertex.seen,
        )
        growth = growth + _share(vertex.goes_on, scattered, vertex.scattered)
        return growth, longer

    zero = dr.zeros(mi.Float, records.lanes)
    with dr.suspend_grad():
        if records.depth == 1:
            sweep(mi.UInt32(0), zero, zero)
            return
        end = opaque(records.depth)
        dr.while_loop(
            (dr.zeros(mi.UInt32, records.lanes), zero, dr.zeros(mi.Float, records.lanes)),
            lambda number, *_: number < end,
            lambda number, growth, longer: (number + 1, *sweep(number, growth, longer)),
            mode="symbolic",
        )
