"""What one vertex of a path contributes, in Dr.Jit: the integrand of the path integral.

Everything here is differentiable or not, as its ``Inputs`` are. The torch twin of these formulas,
in float64, is ``channel/chains.py``; tests hold them equal.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from invertwin.channel.bridge import (
    Geometry,
    from_points,
    points,
    to_float,
    to_index,
    to_points,
    to_torch,
    tracer,
)
from invertwin.channel.paths import Link, Pattern
from invertwin.channel.rays import Shot

#: Rows of surfaces among the differentiable inputs.
SURFACE = (
    "amplitude", "diffuse", "lobes", "exponents", "transmittance", "excess", "refraction",
    "index", "attenuation",
)  # fmt: skip

#: The differentiable inputs of the kernel, in the order in which torch passes them.
DIFFERENTIABLE = ("vertices", "tx", "rx", "rotations", *SURFACE)
POINTS = DIFFERENTIABLE[:3]


def to_table(name: str, values: Tensor) -> Any:
    """A torch table as the kernel reads it."""
    return to_points(values) if name in POINTS else to_float(values)


def from_table(name: str, values: Any, like: Tensor) -> Tensor:
    """The torch form of an array that is laid out as one of the tables."""
    flat = from_points(values) if name in POINTS else to_torch(values)
    return flat.reshape(like.shape).to(like)


@dataclass(frozen=True)
class Inputs:
    """Flat Dr.Jit arrays; those named in ``DIFFERENTIABLE`` may carry derivatives."""

    vertices: Any
    tx: Any
    rx: Any
    rotations: Any
    amplitude: Any
    diffuse: Any
    lobes: Any
    exponents: Any
    transmittance: Any
    excess: Any
    refraction: Any
    index: Any
    attenuation: Any
    faces: Any
    face_surface: Any
    cosines: int
    lobed: tuple[bool, bool, bool]
    sheets: bool
    bodies: bool
    monostatic: bool
    tx_pattern: "PatternTable"
    rx_pattern: "PatternTable"
    scale: float

    @staticmethod
    def of(geometry: Geometry, link: Link, shot: Shot, monostatic: bool) -> "Inputs":
        """Upload a geometry and a link; positions are taken about the shot's local origin.

        ``monostatic`` spares one leg where both antennas are one, derivatives included: what is
        due to ``rx`` is then due to ``tx``.
        """
        return Inputs(
            vertices=shot.vertices,
            tx=shot.tx,
            rx=shot.rx,
            rotations=to_float(link.rotations),
            **{name: to_float(getattr(geometry, name)) for name in SURFACE},
            faces=geometry.topology.device_faces,
            face_surface=to_index(geometry.face_surface),
            cosines=geometry.amplitude.shape[1],
            lobed=geometry.lobed,
            sheets=geometry.sheets,
            bodies=geometry.bodies,
            monostatic=monostatic,
            tx_pattern=PatternTable.of(link.tx_pattern),
            rx_pattern=PatternTable.of(link.rx_pattern),
            scale=(link.wavelength / (4 * np.pi)) ** 2,
        )

    def detached(self) -> "Inputs":
        """The same values without derivatives."""
        import drjit as dr

        return replace(self, **{name: dr.detach(getattr(self, name)) for name in DIFFERENTIABLE})

    def antenna(self, frame: Any, receiver: Any, active: Any = True) -> Any:
        """Position of the receiver or the transmitter (a Python bool, or one per lane)."""
        if receiver is True or receiver is False:
            table = self.rx if receiver and not self.monostatic else self.tx
            return points(table, frame, active)
        import drjit as dr

        return dr.select(
            receiver, self.antenna(frame, True, active), self.antenna(frame, False, active)
        )

    def gain(self, frame: Any, receiver: Any, seen: Any) -> Any:
        """Linear power gain of the receiver or the transmitter towards a radar-frame direction."""
        if receiver is True or receiver is False:
            return (self.rx_pattern if receiver else self.tx_pattern).gain(seen)
        import drjit as dr

        return dr.select(receiver, self.rx_pattern.gain(seen), self.tx_pattern.gain(seen))


@dataclass(frozen=True)
class PatternTable:
    """An antenna pattern as the kernel reads it: bilinear in cosθ and φ."""

    values: Any
    shape: tuple[int, int]
    constant: float | None

    @staticmethod
    def of(pattern: Pattern) -> "PatternTable":
        table = pattern.table()
        rows, columns = int(table.shape[0]), int(table.shape[1])
        constant = float(table.reshape(-1)[0]) if rows * columns == 1 else None
        return PatternTable(to_float(table), (rows, columns), constant)

    def gain(self, direction: Any) -> Any:
        """Linear power gain for a unit direction in the radar frame."""
        import drjit as dr

        mi = tracer()
        if self.constant is not None:
            return mi.Float(self.constant)
        rows, columns = self.shape
        t = (dr.clip(direction.z, -1.0, 1.0) + 1) * (0.5 * (rows - 1))
        row = dr.minimum(mi.UInt32(dr.detach(t)), rows - 2)
        along = t - mi.Float(row)
        if columns == 1:
            low, high = (dr.gather(mi.Float, self.values, line) for line in (row, row + 1))
            return low + (high - low) * along
        s = (dr.atan2(direction.y, direction.x) / (2 * dr.pi) + 0.5) * columns
        column = dr.minimum(mi.UInt32(dr.detach(s)), columns - 1)
        across = s - mi.Float(column)
        nearby = (column + 1) % columns
        rows_of_gain = []
        for line in (row, row + 1):
            low = dr.gather(mi.Float, self.values, line * columns + column)
            high = dr.gather(mi.Float, self.values, line * columns + nearby)
            rows_of_gain.append(low + (high - low) * across)
        return rows_of_gain[0] + (rows_of_gain[1] - rows_of_gain[0]) * along


def corners(inputs: Inputs, face: Any, active: Any = True) -> tuple[Any, Any, Any]:
    """Corners of triangles, attached."""
    import drjit as dr

    index = dr.gather(tracer().Vector3u, inputs.faces, face, active)
    return tuple(points(inputs.vertices, i, active) for i in index)  # type: ignore[return-value]


def edge_ends(inputs: Inputs, first: Any, second: Any) -> tuple[Any, Any]:
    """Ends of edges, attached."""
    return points(inputs.vertices, first), points(inputs.vertices, second)


@dataclass(frozen=True)
class Place:
    """A material point: position and unit normal, attached, and the row of its surface.

    ``jacobian`` is the area of its triangle over that area detached: one in value.
    """

    position: Any
    normal: Any
    jacobian: Any
    surface: Any


def place(inputs: Inputs, face: Any, b1: Any, b2: Any, active: Any = True) -> Place:
    """Where a pair of barycentric coordinates lies now."""
    import drjit as dr

    p0, p1, p2 = corners(inputs, face, active)
    normal = dr.cross(p1 - p0, p2 - p0)
    double_area = dr.norm(normal)
    return Place(
        position=p0 * (1 - b1 - b2) + p1 * b1 + p2 * b2,
        normal=normal / double_area,
        jacobian=double_area / dr.detach(double_area),
        surface=dr.gather(tracer().UInt32, inputs.face_surface, face, active),
    )


def leg(start: Any, end: Any) -> tuple[Any, Any]:
    """Unit direction and distance from one point to another."""
    import drjit as dr

    offset = end - start
    distance = dr.norm(offset)
    return offset / distance, distance


def to_radar(inputs: Inputs, frame: Any, direction: Any, active: Any = True) -> Any:
    """World direction in the radar frame (the rotation's columns are the radar's axes)."""
    import drjit as dr

    mi = tracer()
    rows = [dr.gather(mi.Vector3f, inputs.rotations, frame * 3 + k, active) for k in range(3)]
    return mi.Vector3f(*(sum(rows[k][axis] * direction[k] for k in range(3)) for axis in range(3)))


def tabulated(inputs: Inputs, name: str, row: Any, cosine: Any, active: Any = True) -> Any:
    """A table over cosθ, linear between its entries."""
    import drjit as dr

    mi = tracer()
    table = getattr(inputs, name)
    t = dr.minimum(cosine, 1.0) * (inputs.cosines - 1)
    low = dr.minimum(mi.UInt32(dr.detach(t)), inputs.cosines - 2)
    first = dr.gather(mi.Float, table, row * inputs.cosines + low, active)
    second = dr.gather(mi.Float, table, row * inputs.cosines + low + 1, active)
    return first + (second - first) * (t - mi.Float(low))


def scattered(inputs: Inputs, row: Any, normal: Any, back: Any, on: Any, active: Any = True) -> Any:
    """``f |cosθ| |cosθ'|`` between two unit directions that point away from the surface.

    On one side, ``f`` is the distribution of ``scene.material``; through the skin of a refracting
    body, ``refracted``. ``on`` is None where both directions are one.
    """
    import drjit as dr

    mi = tracer()
    first = dr.dot(normal, back)
    low = _amplitude(inputs, row, first, active)
    if on is None:
        product, between, reflectance = dr.square(first), mi.Float(1.0), dr.square(low)
    else:
        second = dr.dot(normal, on)
        product, between = first * second, dr.dot(back, on)
        reflectance = low * _amplitude(inputs, row, second, active)
    shape = dr.gather(mi.Float, inputs.diffuse, row, active) * dr.inv_pi
    for number, present in enumerate(inputs.lobed):
        if present:
            cosine = between if number == 2 else 2 * product - between
            half = dr.maximum(0.5 * (1 + cosine), 1e-7)
            exponent = dr.gather(mi.Float, inputs.exponents, row * 3 + number, active)
            weight = dr.gather(mi.Float, inputs.lobes, row * 3 + number, active)
            shape += weight * dr.exp(exponent * dr.log(half))
    value = dr.select(dr.detach(product) > 0, reflectance * shape * product, 0.0)
    if inputs.bodies and on is not None:
        through = refracted(inputs, row, normal, back, on, active)
        value = dr.select(dr.detach(product) < 0, through, value)
    return value


def _amplitude(inputs: Inputs, row: Any, cosine: Any, active: Any) -> Any:
    """Square root of the reflectance; from inside a body, that of the refracted angle."""
    import drjit as dr

    outer = dr.abs(cosine)
    if not inputs.bodies:
        return tabulated(inputs, "amplitude", row, outer, active)
    outer, total = _outside(inputs, row, cosine, active)
    return dr.select(total, 1.0, tabulated(inputs, "amplitude", row, outer, active))


def _outside(inputs: Inputs, row: Any, cosine: Any, active: Any) -> tuple[Any, Any]:
    """Cosine on the outer side of a skin (Snell), and whether there is none (total reflection)."""
    import drjit as dr

    inside = dr.detach(cosine) < 0
    index = dr.gather(tracer().Float, inputs.index, row, active)
    square = 1 - dr.square(index) * (1 - dr.square(cosine))
    total = inside & (dr.detach(square) <= 1e-6)
    refracted = dr.sqrt(dr.select(inside & ~total, square, 1.0))
    return dr.select(inside, refracted, cosine), total


def refracted(inputs: Inputs, row: Any, normal: Any, back: Any, on: Any, active: Any) -> Any:
    """``f |cosθ| |cosθ'|`` through the skin of a body, in a lobe about Snell's direction.

    ``f = n'² sqrt(T(θ) T(θ')) g(m)`` with the mismatch ``m = n d + n' d'`` of the directions'
    tangential parts and a Gaussian ``g`` of the variance of the specular lobe: ``f / n'²`` is
    reciprocal, and a lobe within the propagating directions passes T.
    """
    import drjit as dr

    mi = tracer()
    first, second = dr.dot(normal, back), dr.dot(normal, on)
    inner = dr.gather(mi.Float, inputs.index, row, active)
    variance = refraction_variance(inputs, row, active)
    shares, mismatch, index = [], mi.Vector3f(0.0), mi.Float(1.0)
    for direction, cosine in ((back, first), (on, second)):
        outer, total = _outside(inputs, row, cosine, active)
        share = tabulated(inputs, "refraction", row, outer, active)
        # A root of zero has no derivative: opaque surfaces take part as well.
        open_ = ~total & (dr.detach(share) > 0)
        shares.append(dr.select(open_, dr.sqrt(dr.select(open_, share, 1.0)), 0.0))
        index = dr.select(dr.detach(cosine) < 0, inner, 1.0)
        mismatch = mismatch + index * (direction - normal * cosine)
    lobe = dr.exp(-dr.squared_norm(mismatch) / (2 * variance)) / (2 * dr.pi * variance)
    return shares[0] * shares[1] * dr.square(index) * lobe * dr.abs(first * second)


def refraction_variance(inputs: Inputs, row: Any, active: Any = True) -> Any:
    """Variance of the refracted direction's tangential part: that of the specular lobe."""
    import drjit as dr

    exponent = dr.gather(tracer().Float, inputs.exponents, row * 3, active)
    return 2 / dr.maximum(exponent, 1.0)


@dataclass(frozen=True)
class Medium:
    """What a segment runs through: refractive index, and power attenuation [1/m]."""

    index: Any
    attenuation: Any


def medium(inputs: Inputs, start: Place, end: Place | None, towards: Any, active: Any) -> Medium:
    """The body inside of which a segment runs, if any: that of a skin it leaves or meets inside.

    Args:
        inputs: Tables.
        start: Where it starts.
        end: Where it ends; None for an antenna.
        towards: Unit direction from start to end.
        active: Lanes.
    """
    import drjit as dr

    mi = tracer()
    index, attenuation = mi.Float(1.0), mi.Float(0.0)
    ends = ((start, 1.0),) if end is None else ((start, 1.0), (end, -1.0))
    for place, sign in ends if inputs.bodies else ():
        share = dr.gather(mi.Float, inputs.refraction, (place.surface + 1) * inputs.cosines - 1)
        inside = active & (dr.detach(dr.dot(place.normal, towards)) * sign < 0)
        inside &= dr.detach(share) > 0
        for name in ("index", "attenuation"):
            value = dr.gather(mi.Float, getattr(inputs, name), place.surface, inside)
            if name == "index":
                index = dr.select(inside, value, index)
            else:
                attenuation = dr.select(inside, value, attenuation)
    return Medium(index, attenuation)


@dataclass(frozen=True)
class Connection:
    """The last leg of a path, from a surface point to an antenna."""

    factor: Any  # f |cosθ| |cosθ'| G / R²
    distance: Any
    seen: Any  # direction of the point in the radar frame


def connection(
    inputs: Inputs,
    frame: Any,
    point: Place,
    back: Any,
    receiver: Any = True,
    active: Any = True,
    *,
    same: bool = False,
) -> Connection:
    """Scatter what comes from ``back`` towards an antenna; ``same`` if it lies there."""
    import drjit as dr

    antenna = inputs.antenna(frame, receiver, active)
    to_antenna, distance = leg(point.position, antenna)
    seen = to_radar(inputs, frame, -to_antenna, active)
    on = None if same else to_antenna
    value = scattered(inputs, point.surface, point.normal, back, on, active)
    gain = inputs.gain(frame, receiver, seen)
    return Connection(value * gain / dr.square(distance), distance, seen)
