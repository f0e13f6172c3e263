"""Power maps of one and two bounces by brute force: NumPy alone, written from the radar equation.

Plates are cut into small patches. Every patch, and every ordered pair of patches of two plates,
is a path; what blocks it is found by cutting its segments with the plates. Nothing here knows the
package.
"""

from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plate:
    """A parallelogram that reflects on both sides.

    Attributes:
        centre, first, second: [3]; its sides are ``first`` and ``second``, at a right angle.
        permittivity: Of a half space without losses; 0 stands for a mirror of all power.
        diffuse: Share of what is reflected that is Lambertian; the rest is a lobe.
        width: Full width at half maximum of the lobe [rad].
    """

    centre: Array
    first: Array
    second: Array
    permittivity: float = 0.0
    diffuse: float = 1.0
    width: float = 1.0

    @property
    def normal(self) -> Array:
        cross = np.cross(self.first, self.second)
        return cross / np.linalg.norm(cross)

    def patches(self, count: int) -> tuple[Array, float]:
        """Centres of ``count`` × ``count`` patches, and the area of one."""
        steps = (np.arange(count) + 0.5) / count - 0.5
        s, t = (g.reshape(-1, 1) for g in np.meshgrid(steps, steps, indexing="ij"))
        area = float(np.linalg.norm(np.cross(self.first, self.second))) / count**2
        return self.centre + s * self.first + t * self.second, area

    def blocks(self, start: Array, end: Array) -> NDArray[np.bool_]:
        """Whether it lies across the segments between points (not at their ends)."""
        offset = end - start
        along = offset @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((self.centre - start) @ self.normal) / along
            hit = start + t[..., None] * offset - self.centre
        inside = (t > 1e-9) & (t < 1 - 1e-9)
        for side in (self.first, self.second):
            inside &= np.abs(hit @ side) < 0.5 * (side @ side)
        return inside

    def scattered(self, back: Array, on: Array) -> Array:
        """``f |cosθ| |cosθ'|`` between directions that point away; 0 through the plate."""
        first, second = back @ self.normal, on @ self.normal
        product = first * second
        shape = self.diffuse / np.pi
        if self.diffuse < 1:
            p = np.log(0.5) / np.log(0.5 * (1 + np.cos(0.5 * self.width)))
            shape = (
                shape
                + (1 - self.diffuse)
                / _lobe_power(p)
                * (0.5 * (1 + 2 * product - (back * on).sum(-1))) ** p
            )
        reflectance = np.sqrt(self._reflectance(first) * self._reflectance(second))
        return np.where(product > 0, reflectance * shape * product, 0.0)

    def _reflectance(self, cosine: Array) -> Array:
        """Fresnel's, mean of both polarisations."""
        c = np.abs(cosine)
        if not self.permittivity:
            return np.ones_like(c)
        root = np.sqrt(self.permittivity - 1 + c**2)
        across = (c - root) / (c + root)
        along = (self.permittivity * c - root) / (self.permittivity * c + root)
        return 0.5 * (across**2 + along**2)


def _lobe_power(exponent: float) -> float:
    """What the lobe about the normal reflects: ∫ ((1 + cosθ)/2)^p cosθ dω over the half space."""
    cosines = (np.arange(100_000) + 0.5) / 100_000
    return float(2 * np.pi * np.mean((0.5 * (1 + cosines)) ** exponent * cosines))


@dataclass(frozen=True)
class Axis:
    """Evenly spaced nodes."""

    start: float
    step: float
    count: int

    def weights(self, values: Array) -> list[tuple[NDArray[np.int64], Array]]:
        """The three nodes nearest to each value and its quadratic B-spline there."""
        t = (values - self.start) / self.step
        near = np.rint(t).astype(np.int64)
        found = []
        for node in (near - 1, near, near + 1):
            gap = np.abs(t - node)
            inner, outer = 0.75 - gap**2, 0.5 * (1.5 - gap) ** 2
            found.append((node, np.where(gap < 0.5, inner, np.where(gap < 1.5, outer, 0.0))))
        return found


def power_map(
    plates: list[Plate],
    tx: Array,
    rx: Array,
    wavelength: float,
    ranges: Axis,
    cosines: Axis,
    *,
    bounces: int,
    count: int,
) -> Array:
    """Received over transmitted power by range L/2 and the y component of arrival at ``rx``."""
    out = np.zeros((ranges.count, cosines.count))
    scale = (wavelength / (4 * np.pi)) ** 2
    orders = [(p,) for p in plates] if bounces == 1 else list(permutations(plates, 2))
    for order in orders:
        grids = [plate.patches(count) for plate in order]
        rows = [grids[0][0]] if bounces == 1 else np.array_split(grids[0][0], count)
        for row in rows:
            points = [row] if bounces == 1 else [row[:, None, :], grids[1][0][None, :, :]]
            stops = [tx, *points, rx]
            power: Array = np.full(1, scale)
            length: Array = np.zeros(1)
            directions = []
            for start, end in pairwise(stops):
                offset = end - start
                distance = np.linalg.norm(offset, axis=-1)
                power = power / distance**2
                length = length + distance
                directions.append(offset / distance[..., None])
                for plate in plates:
                    power = np.where(plate.blocks(start + 0 * end, end + 0 * start), 0.0, power)
            for number, plate in enumerate(order):
                back, on = -directions[number], directions[number + 1]
                power = power * plate.scattered(back, on) * grids[number][1]
            arrival = np.broadcast_to(-directions[-1][..., 1], power.shape)
            _deposit(out, ranges, cosines, power, 0.5 * length, arrival)
    return out


def _deposit(
    out: Array, ranges: Axis, cosines: Axis, power: Array, distance: Array, arrival: Array
) -> None:
    for i, w in ranges.weights(distance):
        for j, v in cosines.weights(arrival):
            kept = (i >= 0) & (i < ranges.count) & (j >= 0) & (j < cosines.count)
            np.add.at(out, (i[kept], j[kept]), (power * w * v)[kept])
