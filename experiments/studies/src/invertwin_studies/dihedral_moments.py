"""Radar cross-section of a dihedral by a method of moments in the plane: an oracle of `rcs`."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import hankel2, roots_legendre
from torch import Tensor

from invertwin.channel import CrossSection
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.limits import Positive

_SEGMENTS_PER_WAVELENGTH = 24  # of the method of moments
_QUADRATURE_POINTS = 4  # quadrature points per segment
_EULER = math.exp(np.euler_gamma)


@dataclass(frozen=True)
class DihedralByMoments(CrossSection):
    """Square dihedral from the field of an infinite one, by a 2D method of moments.

    σ = (2a²/λ) σ_2D, for directions orthogonal to the z axis. The ends of the plates along z are
    not modelled in two dimensions.

    Attributes:
        edge: side of the plates [m].
        polarisation: "V" = E along z, "H" = H along z.
    """

    edge: Positive
    polarisation: Literal["V", "H"] = "V"

    def section(self, frequencies: Tensor, directions: Tensor) -> Tensor:
        """Compute σ [m²]."""
        rows = []
        flat = directions[:, :2].numpy()
        for frequency in frequencies.tolist():
            wavelength = SPEED_OF_LIGHT / frequency
            nodes = self._nodes(wavelength)
            solve = strip_section_tm if self.polarisation == "V" else strip_section_te
            width = solve(nodes, 2 * math.pi / wavelength, flat)
            rows.append(torch.from_numpy(2 * self.edge**2 / wavelength * width))
        return torch.stack(rows)

    def _nodes(self, wavelength: float) -> NDArray[np.float64]:
        """End points of the segments, from one free edge through the crease to the other."""
        count = math.ceil(self.edge / wavelength * _SEGMENTS_PER_WAVELENGTH)
        along = np.linspace(-1, 1, 2 * count + 1) * self.edge / math.sqrt(2)
        return np.column_stack([-np.abs(along), along])


def strip_section_tm(
    nodes: NDArray[np.float64], k: float, directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Compute σ_2D [m] of a thin conductor, E along its axis.

    Solves ∫ηJ k/4 H₀(k|r − r′|) dl′ = E with pulses.

    Args:
        nodes: end points of the segments in the plane [m].
        k: wave number [1/m].
        directions: unit vectors to the radar in the plane.

    Source: Harrington, Field Computation by Moment Methods, §3.2.
    """
    middle, length, _ = _segments(nodes)
    current = np.linalg.inv(1j * k * _potentials(nodes, k))
    wave = np.exp(1j * k * directions @ middle.T)
    return k / 4 * np.abs(np.einsum("ai,ij,aj,i->a", wave, current, wave, length)) ** 2


def strip_section_te(
    nodes: NDArray[np.float64], k: float, directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Compute σ_2D [m] of a thin conductor, H along its axis: mixed potentials, triangle basis.

    Args:
        nodes: end points of the segments in the plane [m].
        k: wave number [1/m].
        directions: unit vectors to the radar in the plane.

    Source: Harrington, Field Computation by Moment Methods, §3.3.
    """
    middle, length, tangent = _segments(nodes)
    green = _potentials(nodes, k)
    # A triangle is half a pulse on either segment, with charges +1/l and −1/l.
    count = len(length) - 1
    before, after = np.eye(count, count + 1), np.eye(count, count + 1, 1)
    pulse, charge = (before + after) / 2, before - after
    vector = (pulse * length) @ ((tangent @ tangent.T) * green) @ pulse.T
    impedance = 1j * k * vector + charge @ (green / length) @ charge.T / (1j * k)
    across = np.stack([-directions[:, 1], directions[:, 0]], 1)
    driven = np.exp(1j * k * directions @ middle.T) * (across @ tangent.T) * length @ pulse.T
    return k / 4 * np.abs(np.einsum("ai,ij,aj->a", driven, np.linalg.inv(impedance), driven)) ** 2


def _segments(
    nodes: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Midpoints, lengths and unit tangents of segments."""
    step = np.diff(nodes, axis=0)
    length = np.linalg.norm(step, axis=1)
    return (nodes[:-1] + nodes[1:]) / 2, length, step / length[:, None]


def _potentials(nodes: NDArray[np.float64], k: float) -> NDArray[np.complex128]:
    """∫ H₀(k|r_p − r′|)/4j dr′ over segment q at the midpoint of p; self terms by series."""
    middle, length, tangent = _segments(nodes)
    found = np.zeros((len(length), len(length)), dtype=np.complex128)
    for at, weight in zip(*roots_legendre(_QUADRATURE_POINTS), strict=True):
        place = middle + tangent * (length * at / 2)[:, None]
        distance = np.linalg.norm(middle[:, None] - place, axis=2)
        np.fill_diagonal(distance, 1.0)
        found += weight / 2 * length * hankel2(0, k * distance) / 4j
    np.fill_diagonal(found, length / 4j * (1 - 2j / np.pi * (np.log(_EULER * k * length / 4) - 1)))
    return found
