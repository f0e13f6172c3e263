"""Method of moments for small conductors: common base of the solvers.

It selects the discretisation per frequency, solves in batches of waves, and checks the power
balance. ``mfie`` solves closed bodies on cells, ``efie_solver`` open and closed ones on triangles.
"""

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel.em.plane_waves import phasor
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import PhysicsWarning

_ELEMENTS_PER_WAVELENGTH = 7.0  # sides of an element
_REUSE_RATIO = 1.25  # ratio of frequencies that share elements
_ASPECTS_AT_ONCE = 64
_POWER_TOLERANCE = 0.05  # relative error of the power balance

Elements = TypeVar("Elements")


@runtime_checkable
class CurrentEquation(Protocol):
    """Integral equation at one frequency."""

    def solve_currents(self, transmitters: Float64[Tensor, "aspect 3"]) -> Tensor:
        """Solve the currents η J of plane waves of 1 V/m, V and H, from given directions."""
        ...

    def conserves_power(self, current: Tensor, transmitters: Tensor) -> bool:
        """Test the power balance of the first wave's currents (optical theorem).

        Args:
            current: result of ``solve_currents``.
            transmitters: unit vectors to the transmitters.
        """
        ...

    def far_field(
        self, current: Tensor, transmitters: Tensor, receivers: Tensor
    ) -> Complex128[Tensor, "aspect 2 2"]:
        """Compute the far-field amplitudes S of currents.

        Args:
            current: η J for the transmitters' waves.
            transmitters, receivers: unit vectors to the antennas.
        """
        ...


class CurrentSolver(ABC, Generic[Elements]):
    """Method-of-moments solver of conductors, at frequencies at which they are small.

    Attributes:
        area: total area of all surfaces [m²].
    """

    MIN_SQUARES: ClassVar[int]
    """Minimum number of squares of an element's side in the total area."""

    def __init__(self, area: float) -> None:
        self.area = area
        self._cached: tuple[float, Elements | None] = (math.inf, None)

    @abstractmethod
    def build_elements(self, side: float) -> Elements | None:
        """Discretise with a side length [m]; None without a valid one of allowed size."""

    @abstractmethod
    def assemble_equation(
        self, elements: Elements, wave_number: float, wave_count: int
    ) -> CurrentEquation:
        """Assemble the integral equation at one frequency.

        Args:
            elements: result of ``build_elements``.
            wave_number: wave number k [1/m].
            wave_count: number of waves to solve for.
        """

    def elements(self, wave_number: float) -> Elements | None:
        """Return elements for a wave number; the previous ones are reused if fine enough.

        None without a valid discretisation of allowed size.

        Args:
            wave_number: wave number k [1/m].
        """
        wavelength = 2 * math.pi / wave_number
        needed = min(wavelength / _ELEMENTS_PER_WAVELENGTH, math.sqrt(self.area / self.MIN_SQUARES))
        side, known = self._cached
        if side <= needed <= side * _REUSE_RATIO:
            return known
        found = self.build_elements(needed)
        if found is not None:
            self._cached = (needed, found)
        return found

    def solve_scattering(
        self, wave_number: float, antenna_pairs: Sequence[tuple[Tensor, Tensor]]
    ) -> list[Complex128[Tensor, "aspect 2 2"]] | None:
        """Solve the total scattered field S per antenna pair; None if the conductors are too large.

        Args:
            wave_number: wave number k [1/m].
            antenna_pairs: unit vectors from the scene to transmitters and to receivers, [aspect, 3]
                each.

        Raises:
            InputError: derivatives that the solver does not support.
        """
        elements = self.elements(wave_number)
        if elements is None:
            return None
        wave_count = 2 * sum(len(pair[0]) for pair in antenna_pairs)
        equation = self.assemble_equation(elements, wave_number, wave_count)
        found: list[Tensor] = []
        for transmitters, receivers in antenna_pairs:
            chunks: list[Tensor] = []
            for rows in torch.arange(len(transmitters)).split(_ASPECTS_AT_ONCE):
                current = equation.solve_currents(transmitters[rows])
                if not chunks and not equation.conserves_power(current, transmitters[rows]):
                    _warn_power_balance(wave_number)
                    return None
                chunks.append(equation.far_field(current, transmitters[rows], receivers[rows]))
            found.append(torch.cat(chunks))
        return found


def conserves_power(
    wave_number: float,
    point: Float64[Tensor, "point 3"],
    current_moments: Complex128[Tensor, "point 2 3"],
    direction: Float64[Tensor, "3"],
    incident_field: Float64[Tensor, "2 3"],
) -> bool:
    """Test if the power radiated by currents equals that extracted from the wave (optical theorem).

    Args:
        wave_number: wave number k [1/m].
        point: positions of the current moments [m].
        current_moments: η J dA there, for both polarisations.
        direction: unit direction d of the wave.
        incident_field: E at the world's origin, for both polarisations.
    """
    phase = phasor(-wave_number * point @ direction)
    extracted = torch.einsum("c,ctx,tx->t", phase.conj(), current_moments, incident_field + 0j)
    offset = point - point.mean(0)
    extent = float(offset.norm(dim=1).max())
    nodes, node_weights = np.polynomial.legendre.leggauss(math.ceil(wave_number * extent) + 12)
    azimuths = 2 * math.pi * torch.arange(2 * len(nodes), dtype=torch.float64) / (2 * len(nodes))
    radiated = torch.zeros(2, dtype=torch.float64)
    for z, weight in zip(nodes, node_weights * math.pi / len(nodes), strict=True):
        ring = math.sqrt(1 - z**2)
        heights = torch.full_like(azimuths, z)
        directions = torch.stack([ring * azimuths.cos(), ring * azimuths.sin(), heights], 1)
        wave = phasor(wave_number * (directions @ offset.T))
        field = wave_number / (4 * math.pi) * torch.einsum("sc,ctx->stx", wave, current_moments)
        along = torch.einsum("stx,sx->st", field, directions + 0j)
        radiated += weight * (field.abs().square().sum((0, 2)) - along.abs().square().sum(0))
    return bool(((radiated / extracted.real - 1).abs() < _POWER_TOLERANCE).all())


def _warn_power_balance(wave_number: float) -> None:
    """Issue a warning that the method of moments is not used."""
    warnings.warn(
        f"at {wave_number * SPEED_OF_LIGHT / (2 * math.pi) / 1e9:.4g} GHz the currents of the "
        "method of moments do not conserve power, so bounces and edges alone are used; look for "
        "thin or touching parts of the mesh",
        PhysicsWarning,
        stacklevel=6,
    )
