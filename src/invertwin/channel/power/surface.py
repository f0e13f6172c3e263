"""Scattering laws in Dr.Jit: tables of ``scene.ScatteringLaw``, and their evaluation.

Values carry derivatives if the tables do. The same law in torch, float64, is
``channel/coherent/radar_equation.py``; tests hold the two equal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from torch import Tensor

from invertwin.channel.rays.arrays import opaque, to_float
from invertwin.channel.rays.backend import Mask, dr, mi, mit
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.scene import ScatteringLaw

#: Tables of a surface in kernels; depolarisation scales them before (``deposit_power``).
SCATTERING_TABLES = tuple(
    field.name for field in fields(ScatteringLaw) if field.name != "depolarisation"
)
_CONSTANT_COLUMNS = ("diffuse", "lobes", "exponents", "index", "attenuation")


@dataclass(frozen=True)
class ScatteringLawTables:
    """Rows of ``scene.ScatteringLaw`` as flat Dr.Jit arrays, and properties of all rows.

    Attributes:
        tables: tables by the names of ``SCATTERING_TABLES``.
        cosine_count: entries of a table over cosθ.
        has_lobe: for each lobe, True if any row gives it weight.
        has_sheets: True if any surface transmits straight on.
        has_refracting_bodies: True if any surface is the interface of a refracting body.
        has_spread: True if any specular lobe lacks the power of a specular reflection.
        constants: columns that are equal in all rows, which need no look-up.
    """

    tables: Mapping[str, mit.Float]
    cosine_count: int
    has_lobe: tuple[bool, ...]
    has_sheets: bool
    has_refracting_bodies: bool
    has_spread: bool
    constants: Mapping[str, list[mit.Float]]

    @staticmethod
    def from_geometry(geometry: Geometry) -> ScatteringLawTables:
        """Upload the surfaces of a scene.

        Args:
            geometry: scene as flat tables.
        """
        rows = geometry.surfaces
        known = {}
        if len(rows.diffuse) == 1:
            known = {name: opaque_row(getattr(rows, name)) for name in _CONSTANT_COLUMNS}
        if bool((rows.amplitude == rows.amplitude[0, 0]).all()):  # conductors
            known["amplitude"] = opaque_row(rows.amplitude[:1, :1])
        tables = {name: to_float(getattr(rows, name)) for name in SCATTERING_TABLES}
        has: Any = {n: value for n, value in vars(geometry).items() if n.startswith("has_")}
        count = rows.amplitude.shape[1]
        return ScatteringLawTables(tables, constants=known, cosine_count=count, **has)

    def value(self, name: str, row: mit.UInt32, active: Mask = True) -> mit.Float:
        """Look up a number of each row: ``diffuse``, ``index`` or ``attenuation``.

        Args:
            name: name of the table.
            row: rows of the surfaces.
            active: mask of active lanes.
        """
        return self._column(name, 0, 1, row, active)

    def _column(
        self, name: str, number: int, count: int, row: mit.UInt32, active: Mask
    ) -> mit.Float:
        """Look up one of the ``count`` numbers of a table for every row."""
        if self._is_constant(name):
            return mi.Float(self.constants[name][number])
        return self._read(name, row * count + number, active)

    def _is_constant(self, name: str) -> bool:
        return name in self.constants and not dr.grad_enabled(self.tables[name])

    def _read(self, name: str, index: mit.UInt32, active: Mask) -> mit.Float:
        """Gather entries of a table; by all lanes if it has no derivatives, to gather it once."""
        table = self.tables[name]
        return dr.gather(mi.Float, table, index, active if dr.grad_enabled(table) else True)

    def interpolate_cosine(
        self, name: str, row: mit.UInt32, cosine: mit.Float, active: Mask = True
    ) -> mit.Float:
        """Interpolate a table over cosθ linearly.

        Args:
            name: name of the table.
            row: rows of the surfaces.
            cosine: cosine of the angle of incidence, at least 0.
            active: mask of active lanes.
        """
        if self._is_constant(name):
            return mi.Float(self.constants[name][0])
        t = dr.minimum(cosine, 1.0) * (self.cosine_count - 1)
        low = dr.minimum(mi.UInt32(dr.detach(t)), self.cosine_count - 2)
        first = self._read(name, row * self.cosine_count + low, active)
        second = self._read(name, row * self.cosine_count + low + 1, active)
        return first + (second - first) * (t - mi.Float(low))

    def sheet_transmission(
        self, row: mit.UInt32, cosine: mit.Float, active: Mask = True
    ) -> tuple[mit.Float, mit.Float]:
        """Interpolate the transmittance of a sheet and its extra length [m].

        Args:
            row: rows of the surfaces.
            cosine: cosine of the angle of incidence.
            active: mask of active lanes.
        """
        return tuple(  # type: ignore[return-value]
            self.interpolate_cosine(name, row, cosine, active)
            for name in ("transmittance", "extra_length")
        )

    def evaluate_lobe(
        self,
        number: int,
        row: mit.UInt32,
        normal: mit.Vector3f,
        incident: mit.Vector3f,
        outgoing: mit.Vector3f,
        active: Mask = True,
    ) -> tuple[mit.Float, mit.Float]:
        """Evaluate ``((1 + cosψ)/2)^p`` of one lobe; return it and its exponent p.

        Computed as ``1 - |d|²/4``, with d from the lobe's axis to the direction, so that a narrow
        lobe keeps its digits.

        Args:
            number: 0 specular, 1 directive, 2 backscattering.
            row: rows of the surfaces.
            normal: unit normals.
            incident: unit directions to the previous vertex.
            outgoing: unit directions to the next vertex.
            active: mask of active lanes.
        """
        axis = incident if number == 2 else normal * (2 * dr.dot(normal, incident)) - incident
        apart = dr.squared_norm(outgoing - axis)
        exponent = self.exponent(number, row, active)
        return dr.exp(exponent * log_one_minus(0.25 * apart)), exponent

    def exponent(self, number: int, row: mit.UInt32, active: Mask = True) -> mit.Float:
        """Look up the exponent of a lobe.

        Args:
            number: 0 specular, 1 directive, 2 backscattering.
            row: rows of the surfaces.
            active: mask of active lanes.
        """
        return self._column("exponents", number, 3, row, active)

    def evaluate_scattering(
        self,
        row: mit.UInt32,
        normal: mit.Vector3f,
        incident: mit.Vector3f,
        outgoing: mit.Vector3f | None,
        active: Mask = True,
    ) -> mit.Float:
        """Evaluate ``f |cosθ| |cosθ'|`` between unit directions that point away from the surface.

        On one side, ``f`` is the distribution of ``scene.material``; through the interface of a
        refracting body, see ``evaluate_refraction``.

        Args:
            row: rows of the surfaces.
            normal: unit normals.
            incident: unit directions to the previous vertex.
            outgoing: unit directions to the next vertex; None if both directions are one.
            active: mask of active lanes.
        """
        first = dr.dot(normal, incident)
        low = self._amplitude(row, first, active)
        if outgoing is None:
            outgoing, product, reflectance = incident, dr.square(first), dr.square(low)
        else:
            second = dr.dot(normal, outgoing)
            product = first * second
            reflectance = low * self._amplitude(row, second, active)
        shape = self.value("diffuse", row, active) * dr.inv_pi
        for number, present in enumerate(self.has_lobe):
            if present:
                lobe, _ = self.evaluate_lobe(number, row, normal, incident, outgoing, active)
                if number == 0 and self.has_spread:
                    for direction in (incident, outgoing):
                        cosine = dr.abs(dr.dot(normal, direction))
                        lobe *= self.interpolate_cosine("spread", row, cosine, active)
                shape += self._column("lobes", number, 3, row, active) * lobe
        value = dr.select(dr.detach(product) > 0, reflectance * shape * product, 0.0)
        if self.has_refracting_bodies and outgoing is not incident:
            through = self.evaluate_refraction(row, normal, incident, outgoing, active)
            value = dr.select(dr.detach(product) < 0, through, value)
        return value

    def _amplitude(self, row: mit.UInt32, cosine: mit.Float, active: Mask) -> mit.Float:
        """Look up the root of the reflectance; inside a body, at the refracted angle."""
        if not self.has_refracting_bodies:
            return self.interpolate_cosine("amplitude", row, dr.abs(cosine), active)
        outer, total = self._outer_cosine(row, cosine, active)
        return dr.select(total, 1.0, self.interpolate_cosine("amplitude", row, outer, active))

    def _outer_cosine(
        self, row: mit.UInt32, cosine: mit.Float, active: Mask
    ) -> tuple[mit.Float, mit.Bool]:
        """Compute the cosine outside an interface (Snell), and the mask of total reflections."""
        inside = dr.detach(cosine) < 0
        square = 1 - dr.square(self.value("index", row, active)) * (1 - dr.square(cosine))
        total = inside & (dr.detach(square) <= 1e-6)
        return dr.select(inside, dr.sqrt(dr.select(inside & ~total, square, 1.0)), cosine), total

    def evaluate_refraction(
        self,
        row: mit.UInt32,
        normal: mit.Vector3f,
        incident: mit.Vector3f,
        outgoing: mit.Vector3f,
        active: Mask,
    ) -> mit.Float:
        """Evaluate ``f |cosθ| |cosθ'|`` through the interface of a body.

        ``f = n'² sqrt(T(θ) T(θ')) g(m)`` is a lobe about Snell's direction, with the mismatch
        ``m = n d + n' d'`` of the directions' tangential parts and a Gaussian ``g`` of the variance
        of the specular lobe: ``f / n'²`` is reciprocal, and a lobe within the propagating
        directions transmits T.

        Args:
            row: rows of the surfaces.
            normal: unit normals.
            incident, outgoing: unit directions of the path, away from the surface.
            active: mask of active lanes.
        """
        first, second = dr.dot(normal, incident), dr.dot(normal, outgoing)
        inner = self.value("index", row, active)
        variance = self.refraction_variance(row, active)
        roots, mismatch, index = [], mi.Vector3f(0.0), mi.Float(1.0)
        for direction, cosine in ((incident, first), (outgoing, second)):
            outer, total = self._outer_cosine(row, cosine, active)
            passing = self.interpolate_cosine("refraction", row, outer, active)
            # A root of zero has no derivative, and opaque surfaces are evaluated as well.
            open_ = ~total & (dr.detach(passing) > 0)
            roots.append(dr.select(open_, dr.sqrt(dr.select(open_, passing, 1.0)), 0.0))
            index = dr.select(dr.detach(cosine) < 0, inner, 1.0)
            mismatch = mismatch + index * (direction - normal * cosine)
        lobe = gaussian(mismatch, variance)
        return roots[0] * roots[1] * dr.square(index) * lobe * dr.abs(first * second)

    def refraction_variance(self, row: mit.UInt32, active: Mask = True) -> mit.Float:
        """Compute the variance of the refracted direction's tangential part.

        It is that of the specular lobe.

        Args:
            row: rows of the surfaces.
            active: mask of active lanes.
        """
        return 2 / dr.maximum(self.exponent(0, row, active), 1.0)

    def is_refracting(self, row: mit.UInt32) -> mit.Bool:
        """Test whether surfaces are interfaces of refracting bodies.

        Args:
            row: rows of the surfaces.
        """
        last = (row + 1) * self.cosine_count - 1
        return dr.detach(dr.gather(mi.Float, self.tables["refraction"], last)) > 0


def opaque_row(row: Tensor) -> list[mit.Float]:
    """Upload the numbers of a table of one row, each as an opaque scalar.

    Args:
        row: table of one row.
    """
    return [opaque(float(number), "Float") for number in row.detach().ravel()]


def log_one_minus(fraction: mit.Float) -> mit.Float:
    """Compute log(1 − x), bounded below by log(1e-7), accurate for small x.

    Args:
        fraction: x, from 0 to 1.
    """
    series = -fraction * (1 + fraction * (1 / 2 + fraction / 3))
    return dr.select(dr.detach(fraction) < 0.01, series, dr.log(dr.maximum(1 - fraction, 1e-7)))


def gaussian(mismatch: mit.Vector3f, variance: mit.Float) -> mit.Float:
    """Evaluate the density of a plane Gaussian.

    Args:
        mismatch: offset from the centre.
        variance: variance along each axis.
    """
    return dr.exp(-dr.squared_norm(mismatch) / (2 * variance)) / (2 * dr.pi * variance)
