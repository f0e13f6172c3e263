"""Method of moments for small conductors: common base of the solvers.

It selects the discretisation per frequency, refines it until the power balance holds, and solves in
batches of waves. ``mfie`` solves closed bodies on cells, ``efie_solver`` open and closed ones on
triangles.
"""

import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

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


class Refusal(NamedTuple):
    """Reason for which currents are not solved.

    Attributes:
        reason: text for a warning.
        by_size: True if the conductors are merely too large or too thin.
    """

    reason: str
    by_size: bool = False


@runtime_checkable
class CurrentEquation(Protocol):
    """Integral equation at one frequency."""

    def solve_currents(self, transmitters: Float64[Tensor, "aspect 3"]) -> Tensor:
        """Solve the currents η J of plane waves of 1 V/m, V and H, from given directions."""
        ...

    def power_error(self, current: Tensor, transmitters: Tensor) -> float:
        """Relative error of the power balance of the first wave's currents (optical theorem).

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


def too_many(count: float, limit: int, elements: str) -> Refusal | None:
    """Refuse more elements than a limit; None for fewer.

    Args:
        count: number of elements.
        limit: largest number allowed.
        elements: name of the elements.
    """
    if count <= limit:
        return None
    return Refusal(f"too many {elements} ({count:.0f} > {limit})", by_size=True)


class CurrentSolver(ABC, Generic[Elements]):
    """Method-of-moments solver of conductors, at frequencies at which they are small.

    Args:
        area: total area of all surfaces [m²].
        refinements: numbers of times that elements are doubled, tried in turn.
    """

    MIN_SQUARES: ClassVar[int]
    """Minimum number of squares of an element's side in the total area."""
    ELEMENTS: ClassVar[str]
    """Name of the elements in warnings."""

    def __init__(self, area: float, refinements: Sequence[int] = (0,)) -> None:
        self.area, self.refinements = area, refinements
        self._cached: dict[int, tuple[float, Elements]] = {}

    @abstractmethod
    def build_elements(self, side: float, refinement: int) -> Elements | Refusal:
        """Discretise with a side length.

        Args:
            side: side of an element, before refinement [m].
            refinement: number of times that the elements are doubled.
        """

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

    def elements(self, wave_number: float, refinement: int = 0) -> Elements | Refusal:
        """Return elements for a wave number; the previous ones are reused if fine enough.

        Args:
            wave_number: wave number k [1/m].
            refinement: number of times that the elements are doubled.
        """
        wavelength = 2 * math.pi / wave_number
        needed = min(wavelength / _ELEMENTS_PER_WAVELENGTH, math.sqrt(self.area / self.MIN_SQUARES))
        if refinement in self._cached:
            side, known = self._cached[refinement]
            if side <= needed <= side * _REUSE_RATIO:
                return known
        found = self.build_elements(needed, refinement)
        if not isinstance(found, Refusal):
            self._cached[refinement] = needed, found
        return found

    def solve_scattering(
        self, wave_number: float, antenna_pairs: Sequence[tuple[Tensor, Tensor]]
    ) -> list[Complex128[Tensor, "aspect 2 2"]] | Refusal:
        """Solve the total scattered field S per antenna pair.

        Elements are refined until the currents of the first wave conserve power.

        Args:
            wave_number: wave number k [1/m].
            antenna_pairs: unit vectors from the scene to transmitters and to receivers, [aspect, 3]
                each.

        Raises:
            InputError: derivatives that the solver does not support.
        """
        wave_count = 2 * sum(len(pair[0]) for pair in antenna_pairs)
        first = antenna_pairs[0][0][:1]
        reasons: list[str] = []
        for refinement in self.refinements:
            elements = self.elements(wave_number, refinement)
            if isinstance(elements, Refusal):
                by_size = elements.by_size and not reasons
                return Refusal(", ".join([*reasons, elements.reason]), by_size)
            equation = self.assemble_equation(elements, wave_number, wave_count)
            error = equation.power_error(equation.solve_currents(first), first)
            if error < _POWER_TOLERANCE:
                return [_scattered_field(equation, *pair) for pair in antenna_pairs]
            reasons.append(f"power balance off by {error:.1%} on {self.ELEMENTS}")
        return Refusal(", ".join(reasons))


def warn_not_solved(wave_number: float, refusals: Sequence[Refusal]) -> None:
    """Issue a warning that names the reasons, unless the conductors are merely too large or thin.

    Args:
        wave_number: wave number k [1/m].
        refusals: refusals of all solvers.
    """
    if all(refusal.by_size for refusal in refusals):
        return
    reasons = ", ".join(dict.fromkeys(refusal.reason for refusal in refusals))
    warnings.warn(
        f"at {wave_number * SPEED_OF_LIGHT / (2 * math.pi) / 1e9:.4g} GHz currents not solved, "
        f"because {reasons}: bounces and edges alone are used; look for thin or touching parts of "
        "the mesh",
        PhysicsWarning,
        stacklevel=5,
    )


def _scattered_field(equation: CurrentEquation, transmitters: Tensor, receivers: Tensor) -> Tensor:
    """Scattered field S, in batches of waves."""
    sent, received = (x.split(_ASPECTS_AT_ONCE) for x in (transmitters, receivers))
    return torch.cat([*map(equation.far_field, map(equation.solve_currents, sent), sent, received)])


def power_error(
    wave_number: float,
    point: Float64[Tensor, "point 3"],
    current_moments: Complex128[Tensor, "point 2 3"],
    direction: Float64[Tensor, "3"],
    incident_field: Float64[Tensor, "2 3"],
) -> float:
    """Compute the relative error of the power balance of currents: radiated over extracted, less 1.

    The power extracted from the wave is that of the optical theorem.

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
    return float((radiated / extracted.real - 1).abs().max())
