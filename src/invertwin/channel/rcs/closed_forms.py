"""Radar cross-sections in closed form, or by the Mie series.

Each belongs to the built-in shape of its name in its default pose, and serves as an oracle. All are
perfect conductors, except the sphere, which may be dielectric.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import torch
from annotated_types import Ge
from jaxtyping import Complex128, Float64
from numpy.typing import NDArray
from scipy.special import spherical_jn, spherical_yn
from torch import Tensor

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.limits import NonNegative, Positive
from invertwin.scene.shapes import trihedral


class CrossSection(ABC):
    """Radar cross-section σ over frequency and direction."""

    @abstractmethod
    def section(
        self, frequencies: Float64[Tensor, " frequency"], directions: Float64[Tensor, "aspect 3"]
    ) -> Float64[Tensor, "frequency aspect"]:
        """Compute the monostatic σ [m²].

        Args:
            frequencies: frequencies [Hz].
            directions: unit vectors to the radar.
        """


def _wavelengths(frequencies: Tensor) -> Tensor:
    return (SPEED_OF_LIGHT / frequencies)[:, None]


@dataclass(frozen=True)
class PlateSection(CrossSection):
    """Physical optics of a rectangle: 4πA²/λ² cos²θ with a sin(x)/x along each side.

    Attributes:
        width: side along y [m].
        height: side along z [m].
    """

    width: Positive
    height: Positive

    def section(self, frequencies: Tensor, directions: Tensor) -> Tensor:
        """Compute σ [m²]."""
        wavelength = _wavelengths(frequencies)
        x, y, z = directions.T
        sides = (self.width, y), (self.height, z)
        lobes = [torch.sinc(2 * side * part / wavelength) for side, part in sides]
        peak = 4 * math.pi * (self.width * self.height / wavelength) ** 2
        return peak * (x * lobes[0] * lobes[1]) ** 2


@dataclass(frozen=True)
class _CornerPeak(CrossSection):
    edge: Positive
    _factor: ClassVar[float]

    def section(self, frequencies: Tensor, directions: Tensor) -> Tensor:
        """Compute σ [m²], with the boresight value in all directions."""
        peak = self._factor * math.pi * self.edge**4 / _wavelengths(frequencies) ** 2
        return peak.expand(-1, len(directions))


@dataclass(frozen=True)
class DihedralSection(_CornerPeak):
    """Peak of two square plates at a right angle, two bounces at boresight: 8πa⁴/λ².

    Attributes:
        edge: side of the plates [m].
    """

    _factor = 8.0


@dataclass(frozen=True)
class SquareTrihedralSection(_CornerPeak):
    """Peak of a corner of three squares, three bounces at boresight: 12πa⁴/λ².

    Attributes:
        edge: side of the squares [m].
    """

    _factor = 12.0


@dataclass(frozen=True)
class TrihedralSection(CrossSection):
    """Triple bounce of a triangular trihedral: 4πA²/λ², A the effective area (Siegel).

    With direction cosines l ≤ m ≤ n to the inner edges, A = a²·4lm/(l+m+n) where l + m ≤ n, else
    a²(l + m + n − 2/(l + m + n)): 4πa⁴/3λ² at boresight.

    Attributes:
        edge: length of the three inner edges [m].
    """

    edge: Positive

    def section(self, frequencies: Tensor, directions: Tensor) -> Tensor:
        """Compute σ [m²]."""
        tips = trihedral(self.edge).vertices[1:] / self.edge
        low, middle, high = (directions @ tips.T).sort(dim=1).values.T
        total = low + middle + high
        narrow = 4 * low * middle / total
        area = torch.where(low + middle <= high, narrow, total - 2 / total) * self.edge**2
        return 4 * math.pi * (area / _wavelengths(frequencies)) ** 2


@dataclass(frozen=True)
class SphereSection(CrossSection):
    """Mie series of a perfectly conducting or dielectric sphere.

    ``S = (j/k) Σ (−1)ⁿ (n + ½) (b_n − a_n)`` at x = ka. With j, h = h⁽²⁾ and their (x j)′, (x h)′,
    ``a_n = (u j − (x j)′)/(u h − (x h)′)`` and ``b_n = (u j − ε (x j)′)/(u h − ε (x h)′)``, where
    u = (z j(z))′/j(z) at z = √ε x. A conductor has a_n = j/h and b_n = (x j)′/(x h)′.

    Attributes:
        radius: radius of the sphere [m].
        permittivity: relative permittivity ε' ≥ 1 of a dielectric; None = perfect conductor.
        loss_tangent: loss tangent tanδ, ε = ε' (1 − j tanδ).

    Source: Bohren, Huffman, Absorption and Scattering of Light by Small Particles, §4.3.
    """

    radius: Positive
    permittivity: Annotated[float, Ge(1)] | None = None
    loss_tangent: NonNegative = 0.0

    def section(self, frequencies: Tensor, directions: Tensor) -> Tensor:
        """Compute σ [m²], equal in all directions."""
        found = 4 * math.pi * self.amplitude(frequencies).abs() ** 2
        return found[:, None].expand(-1, len(directions))

    def amplitude(
        self, frequencies: Float64[Tensor, " frequency"]
    ) -> Complex128[Tensor, " frequency"]:
        """Compute the backscattering amplitude S [m], with the sphere's centre at the origin.

        Args:
            frequencies: frequencies [Hz].
        """
        found = [self._amplitude_at(2 * math.pi * f / SPEED_OF_LIGHT) for f in frequencies.tolist()]
        return torch.tensor(found, dtype=torch.complex128)

    def _amplitude_at(self, k: float) -> complex:
        x = k * self.radius
        n = np.arange(1, int(x + 4 * x ** (1 / 3) + 12))
        j, h = spherical_jn(n, x), spherical_jn(n, x) - 1j * spherical_yn(n, x)
        dj = spherical_jn(n, x, derivative=True)
        xj, xh = j + x * dj, h + x * (dj - 1j * spherical_yn(n, x, derivative=True))
        if self.permittivity is None:
            a, b = j / h, xj / xh
        else:
            epsilon = self.permittivity * (1 - 1j * self.loss_tangent)
            u = _logarithmic_derivatives(np.sqrt(epsilon) * x, len(n))
            a = (u * j - xj) / (u * h - xh)
            b = (u * j - epsilon * xj) / (u * h - epsilon * xh)
        return complex(1j * ((-1.0) ** n * (n + 0.5) * (b - a)).sum() / k)


def _logarithmic_derivatives(z: complex, count: int) -> NDArray[np.complex128]:
    """(z j_n(z))′/j_n(z) for n = 1 … count, by downward recurrence, which is stable."""
    last = max(count, math.ceil(abs(z))) + 16
    found = np.zeros(last + 1, dtype=np.complex128)
    for n in range(last, 0, -1):
        found[n - 1] = n / z - 1 / (found[n] + n / z)
    return z * found[1 : count + 1]
