"""What a surface does to a path, in Dr.Jit: tables of ``scene.material.Surface`` and their law.

Everything here is differentiable or not, as the tables are. The same law in torch, float64, is
``channel/coherent/radar_equation.py``; tests hold the two equal.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from torch import Tensor

from invertwin.channel.rays.arrays import opaque, to_float
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.scene import Surface

#: Names of a surface's tables that kernels read; depolarisation scales others (``deposit_power``).
SURFACE = tuple(field.name for field in fields(Surface) if field.name != "depolarisation")
_COLUMNS = ("diffuse", "lobes", "exponents", "index", "attenuation")


@dataclass(frozen=True)
class Surfaces:
    """Rows of ``scene.material.Surface`` as flat Dr.Jit arrays, and what is known of all rows."""

    tables: Mapping[str, Any]  # by the names of ``SURFACE``
    cosines: int  # entries of a table over cosθ
    lobed: tuple[bool, ...]  # which lobes have weight anywhere
    sheets: bool  # whether something passes straight through any surface
    bodies: bool  # whether any surface is the skin of a refracting body
    spread: bool  # whether any specular lobe lacks what is mirrored
    known: Mapping[str, list[Any]]  # columns that are the same in all rows, and need no look-up

    @staticmethod
    def of(geometry: Geometry) -> "Surfaces":
        """Upload the surfaces of a scene."""
        rows = geometry.surfaces
        known = {}
        if len(rows.diffuse) == 1:
            known = {name: single_row(getattr(rows, name)) for name in _COLUMNS}
        if bool((rows.amplitude == rows.amplitude[0, 0]).all()):  # conductors
            known["amplitude"] = single_row(rows.amplitude[:1, :1])
        return Surfaces(
            {name: to_float(getattr(rows, name)) for name in SURFACE},
            known=known,
            cosines=rows.amplitude.shape[1],
            lobed=geometry.lobed,
            sheets=geometry.sheets,
            bodies=geometry.bodies,
            spread=geometry.spread,
        )

    def value(self, name: str, row: Any, active: Any = True) -> Any:
        """A number of each row: ``diffuse``, ``index`` or ``attenuation``.

        Args:
            name: Of the table.
            row: Row of the surface.
            active: Lanes.
        """
        return self._column(name, 0, 1, row, active)

    def _column(self, name: str, number: int, count: int, row: Any, active: Any) -> Any:
        """One of the ``count`` numbers that a table has for every row."""
        if self._is_known(name):
            return mi.Float(self.known[name][number])
        return self._read(name, row * count + number, active)

    def _is_known(self, name: str) -> bool:
        return name in self.known and not dr.grad_enabled(self.tables[name])

    def _read(self, name: str, at: Any, active: Any) -> Any:
        """Entries of a table; by all lanes where it has no derivatives, so that it is read once."""
        table = self.tables[name]
        return dr.gather(mi.Float, table, at, active if dr.grad_enabled(table) else True)

    def tabulated(self, name: str, row: Any, cosine: Any, active: Any = True) -> Any:
        """A table over cosθ, linear between its entries.

        Args:
            name: Of the table.
            row: Of the surface.
            cosine: Of the angle of incidence, at least 0.
            active: Lanes.
        """
        if self._is_known(name):
            return mi.Float(self.known[name][0])
        t = dr.minimum(cosine, 1.0) * (self.cosines - 1)
        low = dr.minimum(mi.UInt32(dr.detach(t)), self.cosines - 2)
        first = self._read(name, row * self.cosines + low, active)
        second = self._read(name, row * self.cosines + low + 1, active)
        return first + (second - first) * (t - mi.Float(low))

    def through(self, row: Any, cosine: Any, active: Any = True) -> tuple[Any, Any]:
        """Transmittance of a sheet, and the length [m] that it adds.

        Args:
            row: Row of the surface.
            cosine: Of the angle of incidence.
            active: Lanes.
        """
        return tuple(  # type: ignore[return-value]
            self.tabulated(name, row, cosine, active) for name in ("transmittance", "extra_length")
        )

    def lobe(
        self, number: int, row: Any, normal: Any, back: Any, on: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """``((1 + cosψ)/2)^p`` of one lobe, and its exponent p.

        By ``1 - |d|²/4``, d from the lobe's axis to the direction: a narrow lobe keeps its digits.

        Args:
            number: 0 specular, 1 directive, 2 backscattering.
            row: Of the surface.
            normal: Unit normal.
            back: Where the path comes from.
            on: Where it goes on.
            active: Lanes.
        """
        axis = back if number == 2 else normal * (2 * dr.dot(normal, back)) - back
        apart = dr.squared_norm(on - axis)
        exponent = self.exponent(number, row, active)
        return dr.exp(exponent * log_less(0.25 * apart)), exponent

    def exponent(self, number: int, row: Any, active: Any = True) -> Any:
        """Exponent of a lobe.

        Args:
            number: 0 specular, 1 directive, 2 backscattering.
            row: Of the surface.
            active: Lanes.
        """
        return self._column("exponents", number, 3, row, active)

    def scattered(self, row: Any, normal: Any, back: Any, on: Any, active: Any = True) -> Any:
        """``f |cosθ| |cosθ'|`` between two unit directions that point away from the surface.

        On one side, ``f`` is the distribution of ``scene.material``; through the skin of a
        refracting body, ``refracted``.

        Args:
            row: Of the surface.
            normal: Unit normal.
            back: Where the path comes from.
            on: Where it goes on; None where both directions are one.
            active: Lanes.
        """
        first = dr.dot(normal, back)
        low = self._amplitude(row, first, active)
        if on is None:
            on, product, reflectance = back, dr.square(first), dr.square(low)
        else:
            second = dr.dot(normal, on)
            product = first * second
            reflectance = low * self._amplitude(row, second, active)
        shape = self.value("diffuse", row, active) * dr.inv_pi
        for number, present in enumerate(self.lobed):
            if present:
                lobe, _ = self.lobe(number, row, normal, back, on, active)
                if number == 0 and self.spread:
                    for direction in (back, on):
                        cosine = dr.abs(dr.dot(normal, direction))
                        lobe *= self.tabulated("spread", row, cosine, active)
                shape += self._column("lobes", number, 3, row, active) * lobe
        value = dr.select(dr.detach(product) > 0, reflectance * shape * product, 0.0)
        if self.bodies and on is not back:
            through = self.refracted(row, normal, back, on, active)
            value = dr.select(dr.detach(product) < 0, through, value)
        return value

    def _amplitude(self, row: Any, cosine: Any, active: Any) -> Any:
        """Square root of the reflectance; from inside a body, that of the refracted angle."""
        if not self.bodies:
            return self.tabulated("amplitude", row, dr.abs(cosine), active)
        outer, total = self._outside(row, cosine, active)
        return dr.select(total, 1.0, self.tabulated("amplitude", row, outer, active))

    def _outside(self, row: Any, cosine: Any, active: Any) -> tuple[Any, Any]:
        """Cosine on the outer side of a skin (Snell), and whether there is none."""
        inside = dr.detach(cosine) < 0
        index = self.value("index", row, active)
        square = 1 - dr.square(index) * (1 - dr.square(cosine))
        total = inside & (dr.detach(square) <= 1e-6)
        refracted = dr.sqrt(dr.select(inside & ~total, square, 1.0))
        return dr.select(inside, refracted, cosine), total

    def refracted(self, row: Any, normal: Any, back: Any, on: Any, active: Any) -> Any:
        """``f |cosθ| |cosθ'|`` through the skin of a body, in a lobe about Snell's direction.

        ``f = n'² sqrt(T(θ) T(θ')) g(m)`` with the mismatch ``m = n d + n' d'`` of the directions'
        tangential parts and a Gaussian ``g`` of the variance of the specular lobe: ``f / n'²`` is
        reciprocal, and a lobe within the propagating directions passes T.

        Args:
            row: Row of the surface.
            normal: Unit normal.
            back, on: Unit directions of the path, away from the surface.
            active: Lanes.
        """
        first, second = dr.dot(normal, back), dr.dot(normal, on)
        inner = self.value("index", row, active)
        variance = self.refraction_variance(row, active)
        roots, mismatch, index = [], mi.Vector3f(0.0), mi.Float(1.0)
        for direction, cosine in ((back, first), (on, second)):
            outer, total = self._outside(row, cosine, active)
            passing = self.tabulated("refraction", row, outer, active)
            # A root of zero has no derivative: opaque surfaces take part as well.
            open_ = ~total & (dr.detach(passing) > 0)
            roots.append(dr.select(open_, dr.sqrt(dr.select(open_, passing, 1.0)), 0.0))
            index = dr.select(dr.detach(cosine) < 0, inner, 1.0)
            mismatch = mismatch + index * (direction - normal * cosine)
        lobe = gaussian(mismatch, variance)
        return roots[0] * roots[1] * dr.square(index) * lobe * dr.abs(first * second)

    def refraction_variance(self, row: Any, active: Any = True) -> Any:
        """Variance of the refracted direction's tangential part: that of the specular lobe.

        Args:
            row: Row of the surface.
            active: Lanes.
        """
        exponent = self.exponent(0, row, active)
        return 2 / dr.maximum(exponent, 1.0)

    def is_skin(self, row: Any) -> Any:
        """Whether a surface is the skin of a refracting body."""
        last = (row + 1) * self.cosines - 1
        return dr.detach(dr.gather(mi.Float, self.tables["refraction"], last)) > 0


def single_row(row: Tensor) -> list[Any]:
    """The numbers of a table of one row, each for all lanes.

    Args:
        row: The table.
    """
    return [opaque(float(number), "Float") for number in row.detach().ravel()]


def log_less(share: Any) -> Any:
    """log(1 − x), at least that of 1e-7, with the digits of a small x.

    Args:
        share: x, from 0 to 1.
    """
    series = -share * (1 + share * (1 / 2 + share / 3))
    return dr.select(dr.detach(share) < 0.01, series, dr.log(dr.maximum(1 - share, 1e-7)))


def gaussian(mismatch: Any, variance: Any) -> Any:
    """Density of a plane Gaussian at an offset from its centre.

    Args:
        mismatch: Offset from the centre.
        variance: Along each axis.
    """
    return dr.exp(-dr.squared_norm(mismatch) / (2 * variance)) / (2 * dr.pi * variance)
