"""What one sample contributes, in Dr.Jit: the attached part of the path integral.

The torch twin of these formulas, in float64, is ``channel/tracer.py``; tests hold them equal.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from invertwin.channel.bridge import Geometry, to_float, tracer
from invertwin.channel.paths import Link, Pattern
from invertwin.channel.sampling import EdgeSamples, Samples, Shot

#: The differentiable inputs of the kernel, in the order in which torch passes them.
DIFFERENTIABLE = (
    "vertices", "tx", "rx", "rotations", "amplitude", "diffuse", "lobe", "exponent",
)  # fmt: skip


@dataclass(frozen=True)
class Inputs:
    """Flat Dr.Jit arrays; those named in ``DIFFERENTIABLE`` may carry derivatives."""

    vertices: Any
    tx: Any
    rx: Any
    rotations: Any
    amplitude: Any
    diffuse: Any
    lobe: Any
    exponent: Any
    faces: Any
    face_object: Any
    cosines: int
    has_lobe: bool
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
        topology = geometry.topology
        return Inputs(
            vertices=shot.vertices,
            tx=shot.tx,
            rx=shot.rx,
            rotations=to_float(link.rotations),
            amplitude=to_float(geometry.amplitude),
            diffuse=to_float(geometry.diffuse),
            lobe=to_float(geometry.lobe),
            exponent=to_float(geometry.exponent),
            faces=topology.device_faces,
            face_object=topology.device_face_object,
            cosines=geometry.amplitude.shape[1],
            has_lobe=geometry.has_lobe,
            monostatic=monostatic,
            tx_pattern=PatternTable.of(link.tx_pattern),
            rx_pattern=PatternTable.of(link.rx_pattern),
            scale=(link.wavelength / (4 * np.pi)) ** 2,
        )

    def detached(self) -> "Inputs":
        """The same values without derivatives."""
        import drjit as dr

        return replace(self, **{name: dr.detach(getattr(self, name)) for name in DIFFERENTIABLE})


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


@dataclass(frozen=True)
class Contribution:
    """Received over transmitted power per sample, and where it falls."""

    frame: Any
    power: Any
    range: Any
    u: Any
    v: Any

    @property
    def attached(self) -> tuple[Any, Any, Any, Any]:
        """The four values that may carry derivatives."""
        return self.power, self.range, self.u, self.v


def _rows(table: Any, index: Any) -> Any:
    import drjit as dr

    return dr.gather(tracer().Point3f, table, index)


def _corners(inputs: Inputs, face: Any) -> tuple[Any, Any, Any]:
    import drjit as dr

    index = dr.gather(tracer().Vector3u, inputs.faces, face)
    return tuple(_rows(inputs.vertices, i) for i in index)  # type: ignore[return-value]


def _to_radar(inputs: Inputs, frame: Any, direction: Any) -> Any:
    """World direction in the radar frame (the rotation's columns are the radar's axes)."""
    import drjit as dr

    mi = tracer()
    rows = [dr.gather(mi.Vector3f, inputs.rotations, frame * 3 + k) for k in range(3)]
    return mi.Vector3f(*(sum(rows[k][axis] * direction[k] for k in range(3)) for axis in range(3)))


def _amplitude(inputs: Inputs, owner: Any, cosine: Any) -> Any:
    """Square root of the Fresnel reflectance, linear between table entries."""
    import drjit as dr

    mi = tracer()
    t = dr.minimum(cosine, 1.0) * (inputs.cosines - 1)
    low = dr.minimum(mi.UInt32(dr.detach(t)), inputs.cosines - 2)
    first = dr.gather(mi.Float, inputs.amplitude, owner * inputs.cosines + low)
    second = dr.gather(mi.Float, inputs.amplitude, owner * inputs.cosines + low + 1)
    return first + (second - first) * (t - mi.Float(low))


def scattered(inputs: Inputs, frame: Any, face: Any, position: Any, normal: Any) -> Contribution:
    """Power received per unit area from a surface point, by the bistatic radar equation.

    ``P_r/P_t = λ²/(4π)² · G_t G_r / (R_t² R_r²) · f_r cosθ_t cosθ_r dA`` with the reflectance
    distribution ``f_r`` of ``scene.material``. The point scatters only if both antennas are on
    the same side of the surface.
    """
    import drjit as dr

    mi = tracer()
    owner = dr.gather(mi.UInt32, inputs.face_object, face)
    to_tx = _rows(inputs.tx, frame) - position
    r_tx = dr.norm(to_tx)
    w_tx = to_tx / r_tx
    signed_tx = dr.dot(normal, w_tx)
    if inputs.monostatic:
        r_rx, w_rx, signed_rx = r_tx, w_tx, signed_tx
    else:
        to_rx = _rows(inputs.rx, frame) - position
        r_rx = dr.norm(to_rx)
        w_rx = to_rx / r_rx
        signed_rx = dr.dot(normal, w_rx)
    cosines = signed_tx * signed_rx
    seen = _to_radar(inputs, frame, -w_rx)
    gain = inputs.rx_pattern.gain(seen)
    if inputs.monostatic:
        gain *= inputs.tx_pattern.gain(seen)
        reflectance = dr.square(_amplitude(inputs, owner, dr.abs(signed_tx)))
    else:
        gain *= inputs.tx_pattern.gain(_to_radar(inputs, frame, -w_tx))
        reflectance = _amplitude(inputs, owner, dr.abs(signed_tx)) * _amplitude(
            inputs, owner, dr.abs(signed_rx)
        )
    shape = dr.gather(mi.Float, inputs.diffuse, owner) * dr.inv_pi
    if inputs.has_lobe:
        half = dr.maximum(0.5 * (1 + 2 * cosines - dr.dot(w_tx, w_rx)), 1e-7)
        exponent = dr.gather(mi.Float, inputs.exponent, owner)
        shape += dr.gather(mi.Float, inputs.lobe, owner) * dr.exp(exponent * dr.log(half))
    power = inputs.scale * gain * reflectance * shape * cosines / dr.square(r_tx * r_rx)
    power = dr.select(dr.detach(cosines) > 0, power, 0.0)
    return Contribution(frame, power, 0.5 * (r_tx + r_rx), seen.x, seen.y)


def interior(inputs: Inputs, samples: Samples) -> Contribution:
    """The interior term in material form: position, normal and Jacobian follow θ."""
    import drjit as dr

    p0, p1, p2 = _corners(inputs, samples.face)
    position = p0 * (1 - samples.b1 - samples.b2) + p1 * samples.b1 + p2 * samples.b2
    normal = dr.cross(p1 - p0, p2 - p0)
    double_area = dr.norm(normal)
    found = scattered(inputs, samples.frame, samples.face, position, normal / double_area)
    jacobian = double_area / dr.detach(double_area)
    return replace(found, power=found.power * jacobian * samples.weight)


def boundary(inputs: Inputs, samples: EdgeSamples, centre: str, shot: Shot) -> Contribution:
    """Boundary paths of one antenna segment (family 1): zero value, derivative f V_∂.

    Source: derivations §3. Only ``power`` carries a derivative; where it falls does not.
    """
    import drjit as dr

    mi = tracer()
    fixed = inputs.detached()
    c = _rows(getattr(inputs, centre), samples.frame)
    y0, y1 = _rows(inputs.vertices, samples.first), _rows(inputs.vertices, samples.second)
    y = y0 + (y1 - y0) * samples.along
    p0, p1, p2 = _corners(inputs, samples.face)
    plane = dr.cross(p1 - p0, p2 - p0)
    moving = c + (y - c) * (dr.dot(plane, p0 - c) / dr.dot(plane, y - c))

    f0, f1, f2 = _corners(fixed, samples.face)
    shadow, normal = dr.detach(moving), dr.normalize(dr.cross(f1 - f0, f2 - f0))
    b1, b2 = _barycentric(shadow, f0, f1, f2)
    material = p0 * (1 - b1 - b2) + p1 * b1 + p2 * b2

    ray, edge = dr.detach(y - c), dr.detach(y1 - y0)
    stretch = dr.norm(shadow - dr.detach(c)) / dr.norm(ray)
    slope = 1 / dr.dot(normal, ray)

    def projected(vector: Any) -> Any:
        return stretch * (vector - ray * (dr.dot(normal, vector) * slope))

    covered = _rows(fixed.vertices, samples.opposite) - dr.detach(y)
    tangent = dr.cross(normal, projected(edge))
    tangent = dr.mulsign(tangent, dr.dot(tangent, projected(covered)))
    found = scattered(fixed, samples.frame, samples.face, shadow, normal)
    lit = found.power
    if not shot.link.shared_visibility:
        other = fixed.rx if centre == "tx" else fixed.tx
        reached = shot.clear(mi.Point3f(shadow), _rows(other, samples.frame))
        lit = dr.select(reached, lit, 0.0)
    speed = dr.dot(tangent, moving - material)
    power = lit * samples.weight * speed
    return replace(found, power=dr.replace_grad(dr.zeros(mi.Float, dr.width(power)), power))


def _barycentric(point: Any, p0: Any, p1: Any, p2: Any) -> tuple[Any, Any]:
    import drjit as dr

    a, b, r = p1 - p0, p2 - p0, point - p0
    aa, ab, bb, ra, rb = dr.dot(a, a), dr.dot(a, b), dr.dot(b, b), dr.dot(r, a), dr.dot(r, b)
    determinant = dr.fma(aa, bb, -ab * ab)
    return (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant
