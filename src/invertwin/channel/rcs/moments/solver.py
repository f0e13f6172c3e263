"""What solvers of currents share: which frequencies they serve, how waves pass, and their trust.

Where a conductor is of few wavelengths, an integral equation says which currents flow. ``solved``
has it for the cells of closed bodies, ``meshed`` for triangles of any kind.
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

_ELEMENTS_PER_WAVELENGTH = 7.0  # sides of a piece
_REUSE_RATIO = 1.25  # ratio of frequencies that share pieces
_ASPECTS_AT_ONCE = 64
_POWER_TOLERANCE = 0.05  # share of the power that may get lost or be won

Elements = TypeVar("Pieces")


@runtime_checkable
class CurrentEquation(Protocol):
    """An integral equation at one frequency."""

    def solve_currents(self, transmitters: Float64[Tensor, "aspect 3"]) -> Tensor:
        """η J of plane waves of 1 V/m, V and H, that come from unit vectors."""
        ...

    def conserves_power(self, current: Tensor, transmitters: Tensor) -> bool:
        """Whether the first wave's currents send out as much power as they take from the wave.

        Args:
            current: as ``currents`` gives it.
            transmitters: where the waves come from.
        """
        ...

    def far_field(
        self, current: Tensor, transmitters: Tensor, receivers: Tensor
    ) -> Complex128[Tensor, "aspect 2 2"]:
        """S of currents.

        Args:
            current: of the transmitters' waves.
            transmitters, receivers: where these are.
        """
        ...


class CurrentSolver(ABC, Generic[Elements]):
    """Conductors whose currents are solved, at the frequencies at which they are small.

    Attributes:
        area: of all surfaces [m²].
    """

    MIN_SQUARES: ClassVar[int]
    """Squares of a piece's side in the area, however small the conductors are."""

    def __init__(self, area: float) -> None:
        self.area = area
        self._cached: tuple[float, Elements | None] = (math.inf, None)

    @abstractmethod
    def build_elements(self, side: float) -> Elements | None:
        """Pieces of about a side's length [m]; None where there are too many, or none hold."""

    @abstractmethod
    def assemble_equation(
        self, elements: Elements, wave_number: float, wave_count: int
    ) -> CurrentEquation:
        """The equation of pieces at one frequency.

        Args:
            elements: as ``cut`` gives them.
            wave_number: k [1/m].
            wave_count: for how many it is to be solved.
        """

    def supports(self, wave_number: float) -> bool:
        """Whether pieces hold the conductors, and are not too many.

        Args:
            wave_number: k [1/m].
        """
        return self.elements(wave_number) is not None

    def elements(self, wave_number: float) -> Elements | None:
        """Pieces for a wave; those of the last one where they are about as fine as needed.

        Args:
            wave_number: k [1/m].
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
        """S of the whole field for each way; None where the conductors are too large for it.

        Args:
            wave_number: k [1/m].
            antenna_pairs: unit vectors from the scene to transmitters and to receivers, [aspect,
                3] each.

        Raises:
            InputError: derivatives that the solver does not have.
        """
        pieces = self.elements(wave_number)
        if pieces is None:
            return None
        equation = self.assemble_equation(
            pieces, wave_number, 2 * sum(len(way[0]) for way in antenna_pairs)
        )
        found: list[Tensor] = []
        for transmitters, receivers in antenna_pairs:
            parts: list[Tensor] = []
            for some in torch.arange(len(transmitters)).split(_ASPECTS_AT_ONCE):
                current = equation.solve_currents(transmitters[some])
                if not parts and not equation.conserves_power(current, transmitters[some]):
                    _warn_power_balance(wave_number)
                    return None
                parts.append(equation.far_field(current, transmitters[some], receivers[some]))
            found.append(torch.cat(parts))
        return found


def conserves_power(
    wave_number: float,
    point: Float64[Tensor, "point 3"],
    current_moments: Complex128[Tensor, "point 2 3"],
    direction: Float64[Tensor, "3"],
    incident_field: Float64[Tensor, "2 3"],
) -> bool:
    """Whether currents send out as much power as they take from a wave.

    Args:
        wave_number: k [1/m].
        point: where they flow [m].
        current_moments: η J dA there, for both polarisations.
        direction: d of the wave.
        incident_field: E at the world's origin.
    """
    phase = phasor(-wave_number * point @ direction)
    taken = torch.einsum("c,ctx,tx->t", phase.conj(), current_moments, incident_field + 0j)
    place = point - point.mean(0)
    extent = float(place.norm(dim=1).max())
    level, share = np.polynomial.legendre.leggauss(math.ceil(wave_number * extent) + 12)
    turns = 2 * math.pi * torch.arange(2 * len(level), dtype=torch.float64) / (2 * len(level))
    given = torch.zeros(2, dtype=torch.float64)
    for z, weight in zip(level, share * math.pi / len(level), strict=True):
        flat = math.sqrt(1 - z**2)
        ways = torch.stack([flat * turns.cos(), flat * turns.sin(), torch.full_like(turns, z)], 1)
        wave = phasor(wave_number * (ways @ place.T))
        sent = wave_number / (4 * math.pi) * torch.einsum("sc,ctx->stx", wave, current_moments)
        along = torch.einsum("stx,sx->st", sent, ways + 0j)
        given += weight * (sent.abs().square().sum((0, 2)) - along.abs().square().sum(0))
    return bool(((given / taken.real - 1).abs() < _POWER_TOLERANCE).all())


def _warn_power_balance(wave_number: float) -> None:
    """Say that solved currents are not used."""
    warnings.warn(
        f"at {wave_number * SPEED_OF_LIGHT / (2 * math.pi) / 1e9:.4g} GHz solved currents do not "
        "keep the power, so bounces and edges alone are counted; look for thin or touching parts "
        "of the mesh",
        PhysicsWarning,
        stacklevel=6,
    )
