"""What a segment passes through: nothing, sheets that let part of the power through, or a wall.

A sheet (a slab meshed as one surface) is passed straight on: power times its transmittance, length
plus its extra (``scene.material.Surface``), any number of sheets one after another.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from invertwin.channel.power import integrand
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.rays.arrays import opaque, uniform_pair
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RAY_EPSILON, RayScene

_MAX_SHEETS = 32  # surfaces that a segment may pass
# Probability of passing a sheet on which the ray may end. It is not the transmittance: a
# probability that follows the material would throw the dice anew under differences.
_PASS_PROBABILITY = 0.5
STRATIFIED_SHEETS = 6  # sheets


@dataclass(frozen=True)
class SegmentTransmission:
    """What lies on a segment."""

    transmittance: Any  # 0 if blocked
    extra_length: Any  # length that it adds [m]


def trace_transmission(
    rays: RayScene, inputs: Inputs, start: Any, end: Any, active: Any
) -> SegmentTransmission:
    """What gets from one point to another (their own surfaces excluded). Detached.

    Args:
        rays: The scene and its antennas.
        inputs: Detached tables.
        start, end: Points.
        active: Lanes.
    """
    if not inputs.surfaces.has_sheets:
        return SegmentTransmission(
            dr.select(rays.is_clear(start, end, active), 1.0, 0.0), mi.Float(0.0)
        )
    lanes = dr.width(active)
    carry = {"transmittance": dr.ones(mi.Float, lanes), "extra": dr.zeros(mi.Float, lanes)}

    def act(carry: dict[str, Any], transmittance: Any, extra: Any) -> None:
        carry["transmittance"] = carry["transmittance"] * transmittance
        carry["extra"] = carry["extra"] + extra

    done = visit_sheets(rays, inputs, lambda: start, lambda: end, active, carry, act)
    return SegmentTransmission(
        dr.select(active & ~done["active"], done["transmittance"], 0.0), done["extra"]
    )


def visit_sheets(
    rays: RayScene,
    inputs: Inputs,
    start: Callable[[], Any],
    end: Callable[[], Any],
    active: Any,
    carry: dict[str, Any],
    visit: Callable[[dict[str, Any], Any, Any], None],
) -> dict[str, Any]:
    """Show every sheet between two attached points: ``act(carry, transmittance, extra)``, attached.

    The ends are functions, so that the loop over sheets gathers them anew: no derivative has to
    cross the loop's border. Returns the carry, and as ``active`` where the way has no end.

    Args:
        rays: The scene and its antennas.
        inputs: Attached tables.
        start: Gives the points at one end.
        end: Gives those at the other.
        active: Lanes.
        carry: Arrays that the loop carries.
        visit: Called with what the loop carries, a transmittance and an extra length.
    """
    origin = dr.detach(start())
    offset = dr.detach(end()) - origin
    lanes, most = dr.width(active), opaque(_MAX_SHEETS)
    state = {"at": dr.full(mi.Float, RAY_EPSILON, lanes), "count": dr.zeros(mi.UInt32, lanes)}

    def body(state: dict[str, Any]) -> tuple[dict[str, Any]]:
        state = dict(state)
        at, active = state["at"], state["active"]
        hit = rays.find_nearest(
            mi.Ray3f(
                mi.Point3f(origin + offset * at), mi.Vector3f(offset), 1 - RAY_EPSILON - at, 0.0, []
            ),
            active,
        )
        found = hit.valid
        face = dr.select(found, hit.face, rays.fallback_face)
        with dr.resume_grad():
            transmittance, extra = _sheet_transmission(inputs, face, start(), end(), found)
            visit(state, dr.select(found, transmittance, 1.0), dr.select(found, extra, 0.0))
        state["active"] = found & (dr.detach(transmittance) > 0)
        state["at"] = dr.select(found, at + hit.t + RAY_EPSILON, at)
        state["count"] = state["count"] + 1
        return (state,)

    (state,) = rays.loop(
        ({**state, "active": mi.Bool(active), **carry},),
        lambda state: state["active"] & (state["count"] < most),
        body,
    )
    return state


def _sheet_transmission(
    inputs: Inputs, face: Any, start: Any, end: Any, active: Any
) -> tuple[Any, Any]:
    p0, p1, p2 = integrand.corners(inputs, face, active)
    normal = dr.cross(p1 - p0, p2 - p0)
    offset = end - start
    cosine = dr.abs(dr.dot(normal, offset)) / (dr.norm(normal) * dr.norm(offset))
    row = dr.gather(mi.UInt32, inputs.face_surface, face, active)
    return inputs.surfaces.sheet_transmission(row, cosine, active)


@dataclass(frozen=True)
class SegmentHit:
    """Where a ray ends.

    Attributes:
        valid: Whether it meets a surface to end on.
        face, b1, b2: Where.
        transmittance, extra_length: Of the sheets that it passed.
        probability: Probability of having passed those and ended on this one.
    """

    valid: Any
    face: Any
    b1: Any
    b2: Any
    transmittance: Any
    extra_length: Any
    probability: Any


def trace_to_surface(
    rays: RayScene,
    inputs: Inputs,
    ray: Any,
    active: Any,
    key: tuple[Any, Any],
    *,
    coherent: bool,
    stratified_bits: Any = None,
) -> SegmentHit:
    """Follow a ray to a surface; every sheet on the way is passed or not by a throw of dice.

    Args:
        rays: Rays.
        inputs: Detached.
        ray: Origin and unit direction.
        active: Lanes.
        key: Index and seed of the dice.
        coherent: Whether neighbouring rays are alike.
        stratified_bits: Whether the first sheets are passed, a bit each, instead of dice: so that
            those that
            pass are spread as evenly as all.
    """
    one = mi.Float(1.0)
    hit = rays.find_nearest(ray, active, coherent=coherent)
    if not inputs.surfaces.has_sheets:
        face = dr.select(hit.valid, hit.face, rays.fallback_face)
        b1, b2 = (dr.select(hit.valid, b, 0.25) for b in (hit.b1, hit.b2))
        return SegmentHit(hit.valid, face, b1, b2, one, mi.Float(0.0), one)
    lanes = max(dr.width(active), dr.width(ray.d))
    state = {
        "going": hit.valid,
        "valid": dr.zeros(mi.Bool, lanes),
        "face": dr.zeros(mi.UInt32, lanes) + rays.fallback_face,
        "b1": dr.full(mi.Float, 0.25, lanes),
        "b2": dr.full(mi.Float, 0.25, lanes),
        "transmittance": dr.ones(mi.Float, lanes),
        "extra": dr.zeros(mi.Float, lanes),
        "chance": dr.ones(mi.Float, lanes),
        "origin": mi.Point3f(ray.o) + dr.zeros(mi.Point3f, lanes),
        "count": dr.zeros(mi.UInt32, lanes),
    }
    index, seed = key

    def body(state: dict[str, Any]) -> tuple[dict[str, Any]]:
        state = dict(state)
        going, origin = state["going"], state["origin"]
        hit = rays.find_nearest(mi.Ray3f(origin, ray.d), going)
        found = hit.valid
        face = dr.select(found, hit.face, rays.fallback_face)
        point = origin + ray.d * dr.select(found, hit.t, 0.0)
        transmittance, extra = _sheet_transmission(inputs, face, origin, origin + ray.d, found)
        chance = dr.select(transmittance > 0, _PASS_PROBABILITY, 0.0)
        dice, _ = uniform_pair(index, seed + state["count"] * 0x85EBCA6B)
        if stratified_bits is not None:
            bit = ((stratified_bits ^ seed) >> state["count"]) & 1
            dice = dr.select(state["count"] < STRATIFIED_SHEETS, mi.Float(bit), dice)
        passes = found & (dice < chance)
        ends = found & ~passes
        for name, value in (("face", face), ("b1", hit.b1), ("b2", hit.b2)):
            state[name] = dr.select(ends, value, state[name])
        state["valid"] = state["valid"] | ends
        state["transmittance"] = dr.select(
            passes, state["transmittance"] * transmittance, state["transmittance"]
        )
        state["extra"] = dr.select(passes, state["extra"] + extra, state["extra"])
        odds = dr.select(passes, chance, dr.select(ends, 1 - chance, 1.0))
        state["chance"] = state["chance"] * odds
        step = RAY_EPSILON * (hit.t + dr.norm(point))
        state["origin"] = dr.select(passes, point + ray.d * step, origin)
        state["count"] = state["count"] + 1
        state["going"] = passes & (state["count"] < _MAX_SHEETS)
        return (state,)

    (state,) = rays.loop((state,), lambda state: state["going"], body)
    names = ("valid", "face", "b1", "b2", "transmittance", "extra", "chance")
    return SegmentHit(*(state[name] for name in names))
