"""Transmission of path segments: clear, attenuated by sheets, or blocked.

A sheet (a slab meshed as one surface) transmits straight on: the power is multiplied by its
transmittance, and the optical length grows by its extra length (``scene.ScatteringLaw``). Any
number of sheets may follow one another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypedDict

from invertwin.channel.power import integrand
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.rays.arrays import opaque, uniform_pair
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.ray_scene import RAY_EPSILON
from invertwin.channel.rays.surface_point import SurfacePoint

_MAX_SHEETS = 32  # most surfaces on a segment
# Probability of transmission through a sheet on which the ray may also end. It differs from the
# transmittance: if it followed the material, finite differences would change the random numbers.
_PASS_PROBABILITY = 0.5
STRATIFIED_SHEETS = 6  # sheets with stratified random decisions

Carry = dict[str, mit.Float]


@dataclass
class SegmentTransmission:
    """Transmission of a segment.

    Not frozen, since loops of Dr.Jit assign their state field by field.

    Attributes:
        transmittance: power factor; 0 if blocked.
        extra_length: added optical length [m].
    """

    transmittance: mit.Float
    extra_length: mit.Float

    @staticmethod
    def clear() -> SegmentTransmission:
        """Transmission of a segment in free space."""
        return SegmentTransmission(mi.Float(1.0), mi.Float(0.0))

    def then(self, other: SegmentTransmission) -> SegmentTransmission:
        """Transmission of this segment followed by another."""
        transmittance = self.transmittance * other.transmittance
        return SegmentTransmission(transmittance, self.extra_length + other.extra_length)


class _SheetState(TypedDict):
    """State of the loop over the sheets of a segment."""

    at: mit.Float  # position along the segment, as a fraction of its length
    count: mit.UInt32  # number of sheets so far
    active: mit.Bool
    carry: Carry  # arrays of the visitor


class _SurfaceState(TypedDict):
    """State of the loop over the sheets that a ray meets before it ends on a surface."""

    going: mit.Bool
    valid: mit.Bool
    point: SurfacePoint
    transmission: SegmentTransmission
    probability: mit.Float
    origin: mit.Point3f
    count: mit.UInt32


def trace_transmission(
    inputs: Inputs, start: mit.Point3f, end: mit.Point3f, active: mit.Bool
) -> SegmentTransmission:
    """Trace the transmission between two points (their own surfaces excluded). Detached.

    Args:
        inputs: detached inputs.
        start, end: ends of the segment.
        active: mask of active lanes.
    """
    if not inputs.surfaces.has_sheets:
        clear = inputs.rays.is_clear(start, end, active)
        return SegmentTransmission(dr.select(clear, 1.0, 0.0), mi.Float(0.0))
    lanes = dr.width(active)
    initial = {"transmittance": dr.ones(mi.Float, lanes), "extra": dr.zeros(mi.Float, lanes)}

    def multiply(carry: Carry, transmittance: mit.Float, extra: mit.Float) -> None:
        carry["transmittance"] = carry["transmittance"] * transmittance
        carry["extra"] = carry["extra"] + extra

    done, blocked = visit_sheets(inputs, lambda: start, lambda: end, active, initial, multiply)
    transmittance = dr.select(active & ~blocked, done["transmittance"], 0.0)
    return SegmentTransmission(transmittance, done["extra"])


def visit_sheets(
    inputs: Inputs,
    start: Callable[[], mit.Point3f],
    end: Callable[[], mit.Point3f],
    active: mit.Bool,
    carry: Carry,
    visit: Callable[[Carry, mit.Float, mit.Float], None],
) -> tuple[Carry, mit.Bool]:
    """Call a visitor at every sheet between two attached points.

    The ends are functions, so that the loop over sheets gathers them anew: derivatives need not
    cross the border of the loop.

    Args:
        inputs: attached inputs.
        start: function that returns the points at one end.
        end: function that returns the points at the other end.
        active: mask of active lanes.
        carry: arrays that the loop carries for the visitor.
        visit: function of the carried arrays, the attached transmittance of the sheet, and its
            attached extra length [m].

    Returns:
        The carried arrays after the last sheet, and the mask of segments with more sheets than
        are followed.
    """
    rays, origin = inputs.rays, dr.detach(start())
    offset = dr.detach(end()) - origin
    lanes, most = dr.width(active), opaque(_MAX_SHEETS)

    def body(state: _SheetState) -> tuple[_SheetState]:
        at, carry = state["at"], state["carry"].copy()
        begin, reach = mi.Point3f(origin + offset * at), 1 - RAY_EPSILON - at
        ray = mi.Ray3f(begin, mi.Vector3f(offset), reach, 0.0, [])
        hit = rays.find_nearest(ray, state["active"])
        found = hit.valid
        face = dr.select(found, hit.point.face, rays.fallback_face)
        with dr.resume_grad():
            sheet = _sheet_transmission(inputs, face, start(), end(), found)
            extra = dr.select(found, sheet.extra_length, 0.0)
            visit(carry, dr.select(found, sheet.transmittance, 1.0), extra)
        following: _SheetState = {
            "at": dr.select(found, at + hit.t + RAY_EPSILON, at),
            "count": state["count"] + 1,
            "active": found & (dr.detach(sheet.transmittance) > 0),
            "carry": carry,
        }
        return (following,)

    first: _SheetState = {
        "at": dr.full(mi.Float, RAY_EPSILON, lanes),
        "count": dr.zeros(mi.UInt32, lanes),
        "active": mi.Bool(active),
        "carry": carry,
    }
    (last,) = rays.loop((first,), lambda state: state["active"] & (state["count"] < most), body)
    return last["carry"], last["active"]


def _sheet_transmission(
    inputs: Inputs, face: mit.UInt32, start: mit.Point3f, end: mit.Point3f, active: mit.Bool
) -> SegmentTransmission:
    p0, p1, p2 = integrand.corners(inputs, face, active)
    normal = dr.cross(p1 - p0, p2 - p0)
    offset = end - start
    cosine = dr.abs(dr.dot(normal, offset)) / (dr.norm(normal) * dr.norm(offset))
    row = dr.gather(mi.UInt32, inputs.face_surface, face, active)
    return SegmentTransmission(*inputs.surfaces.sheet_transmission(row, cosine, active))


@dataclass(frozen=True)
class SegmentHit:
    """End of a ray on a surface.

    Attributes:
        valid: mask of rays that end on a surface.
        point: end point.
        transmission: transmission of the sheets on the ray.
        probability: probability of transmission through those sheets and of ending on this one.
    """

    valid: mit.Bool
    point: SurfacePoint
    transmission: SegmentTransmission
    probability: mit.Float


def trace_to_surface(
    inputs: Inputs,
    ray: mit.Ray3f,
    active: mit.Bool,
    key: tuple[mit.UInt32, mit.UInt32],
    *,
    coherent: bool,
    stratified_bits: mit.UInt32 | None = None,
) -> SegmentHit:
    """Trace rays to a surface, with a random decision at every sheet whether the ray ends there.

    Args:
        inputs: detached inputs.
        ray: origins and unit directions.
        active: mask of active lanes.
        key: index and seed of the random numbers.
        coherent: True if neighbouring rays are alike.
        stratified_bits: decisions at the first sheets, one bit each, instead of random numbers:
            the transmitted rays are then spread as evenly as all rays.
    """
    rays, one = inputs.rays, mi.Float(1.0)
    hit = rays.find_nearest(ray, active, coherent=coherent)
    if not inputs.surfaces.has_sheets:
        face = dr.select(hit.valid, hit.point.face, rays.fallback_face)
        b1, b2 = (dr.select(hit.valid, b, 0.25) for b in (hit.point.b1, hit.point.b2))
        return SegmentHit(hit.valid, SurfacePoint(face, b1, b2), SegmentTransmission.clear(), one)
    lanes = max(dr.width(active), dr.width(ray.d))
    index, seed = key

    def body(state: _SurfaceState) -> tuple[_SurfaceState]:
        state = state.copy()
        going, origin = state["going"], state["origin"]
        hit = rays.find_nearest(mi.Ray3f(origin, ray.d), going)
        found = hit.valid
        face = dr.select(found, hit.point.face, rays.fallback_face)
        place: mit.Point3f = origin + ray.d * dr.select(found, hit.t, 0.0)  # type: ignore[operator]
        sheet = _sheet_transmission(inputs, face, origin, origin + ray.d, found)  # type: ignore[operator]
        probability = dr.select(sheet.transmittance > 0, _PASS_PROBABILITY, 0.0)
        uniform, _ = uniform_pair(index, seed + state["count"] * 0x85EBCA6B)
        if stratified_bits is not None:
            bit = ((stratified_bits ^ seed) >> state["count"]) & 1
            uniform = dr.select(state["count"] < STRATIFIED_SHEETS, mi.Float(bit), uniform)
        passes = found & (uniform < probability)
        ends = found & ~passes
        state["point"] = dr.select(ends, replace(hit.point, face=face), state["point"])
        state["valid"] = state["valid"] | ends
        passed = state["transmission"].then(sheet)
        state["transmission"] = dr.select(passes, passed, state["transmission"])
        decision = dr.select(passes, probability, dr.select(ends, 1 - probability, 1.0))
        state["probability"] = state["probability"] * decision
        step = RAY_EPSILON * (hit.t + dr.norm(place))
        state["origin"] = dr.select(passes, place + ray.d * step, origin)
        state["count"] = state["count"] + 1
        state["going"] = passes & (state["count"] < _MAX_SHEETS)
        return (state,)

    fallback = rays.fallback_face + dr.zeros(mi.UInt32, lanes)
    b1, b2 = (dr.full(mi.Float, 0.25, lanes) for _ in range(2))
    first: _SurfaceState = {
        "going": hit.valid,
        "valid": dr.zeros(mi.Bool, lanes),
        "point": SurfacePoint(fallback, b1, b2),
        "transmission": SegmentTransmission(dr.ones(mi.Float, lanes), dr.zeros(mi.Float, lanes)),
        "probability": dr.ones(mi.Float, lanes),
        "origin": mi.Point3f(ray.o) + dr.zeros(mi.Point3f, lanes),
        "count": dr.zeros(mi.UInt32, lanes),
    }
    (last,) = rays.loop((first,), lambda state: state["going"], body)
    return SegmentHit(last["valid"], last["point"], last["transmission"], last["probability"])
