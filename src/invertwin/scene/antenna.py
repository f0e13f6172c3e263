"""Antennas: gain patterns and arrays of elements, in the radar frame.

The radar frame is x boresight, y left, z up. A direction is a unit vector in this frame that
points away from the antenna; θ is its angle to x, φ = atan2(z, y).
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
import torch
from annotated_types import MinLen
from jaxtyping import Float, Float64
from torch import Tensor

from invertwin import checks
from invertwin.errors import InputError
from invertwin.limits import RADIANS, Count, NonNegative, Positive
from invertwin.runtime.memory import require_at_most
from invertwin.scene.polarisation import JonesTable, Polarisation, checked_angles
from invertwin.scene.pose import Basis

Polarised = str | checks.ArrayLike | JonesTable
_MAX_ELEMENTS = 1e5
COSINE_COUNT = 2049
"""Nodes of a pattern table over cosθ, at linspace(−1, 1, 2049)."""


class Pattern(ABC):
    """Power gain of one antenna element over direction."""

    @abstractmethod
    def gain(self, direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return the linear power gain towards unit vectors in the radar frame, differentiable by
        torch.
        """

    @abstractmethod
    def table(self) -> Float64[Tensor, "n_cos n_phi"]:
        """Return the gain on a grid: cosθ = linspace(−1, 1, n_cos), φ = −π + 2π i/n_phi, periodic.

        Ray kernels interpolate it bilinearly. A single row or column means that the gain does not
        depend on that angle.
        """


@dataclass(frozen=True)
class Isotropic(Pattern):
    """Gain 1 in every direction."""

    def gain(self, direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return the linear power gain, 1."""
        return torch.ones_like(direction[..., 0])

    def table(self) -> Float64[Tensor, "1 1"]:
        """Return a single node."""
        return torch.ones(1, 1, dtype=torch.float64)


@dataclass(frozen=True)
class Cosine(Pattern):
    """Gain 2(n+1) cosⁿθ in front of the antenna and 0 behind it; its integral is 4π.

    The table deviates from it by at most 1.2e-7 n(n−1) of the peak gain for n ≥ 1.

    Attributes:
        exponent: exponent n ≥ 0 of the power pattern.

    Raises:
        InputError: a negative exponent.
    """

    exponent: NonNegative

    def __post_init__(self) -> None:
        checks.checked_number(self.exponent, "pattern exponent", 0.0)

    def gain(self, direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return the linear power gain."""
        return self._gain_of_cosine(direction[..., 0])

    def table(self) -> Float64[Tensor, "2049 1"]:
        """Return the gain over cosθ."""
        cosine = torch.linspace(-1, 1, COSINE_COUNT, dtype=torch.float64)
        return self._gain_of_cosine(cosine)[:, None]

    def _gain_of_cosine(self, cosine: Tensor) -> Tensor:
        front = cosine > 0
        # Replace zeros first, since the gradient of 0ⁿ is infinite for n < 1.
        power = torch.where(front, cosine, 1.0) ** self.exponent
        return torch.where(front, 2 * (self.exponent + 1) * power, 0.0)


@dataclass(frozen=True, eq=False)
class TabulatedPattern(Pattern):
    """A measured or simulated pattern.

    It is resampled once, linearly in the given angles, onto the grid of `table`; `gain`
    interpolates that grid, so that torch and the ray kernels use the same pattern. The grid's step
    in cosθ, 1/1024, is 2.5° at boresight and finer elsewhere.

    Attributes:
        theta: n ≥ 2 ascending angles to x [rad], from 0 to at most π; the gain beyond is 0.
        phi: m ascending angles around x, from y towards z [rad], spanning less than 2π; m = 1 for a
            pattern that is symmetric about x. Between the last and the first it continues
            periodically.
        gains: linear power gain at these angles.

    Raises:
        InputError: wrong shapes or ranges, NaN, a negative gain, or values that require grad.
    """

    theta: Float64[Tensor, " n"]
    phi: Float64[Tensor, " m"]
    gains: Float64[Tensor, "n m"]
    _grid: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        do = "give theta [n], phi [m] in rad and linear gains [n, m]"
        theta, phi = checked_angles(self.theta, self.phi, "a pattern", do)
        gains = checks.checked_tensor(self.gains, (len(theta), len(phi)), "pattern gains", do)
        for value in (theta, phi, gains):
            do = "patterns are resampled and cannot be fitted: detach them"
            checks.refuse_derivatives(value, "a pattern", do)
        if bool((gains < 0).any()):
            raise InputError(
                f"expected linear power gains >= 0, got {float(gains.min()):g}; "
                "convert decibels with 10**(dB/10)"
            )
        grid = _resample_gains(theta, phi, gains)
        checks.set_fields(self, theta=theta, phi=phi, gains=gains, _grid=grid)

    @classmethod
    def from_decibels(
        cls,
        theta: Annotated[Sequence[float], MinLen(2), RADIANS],
        gain_db: Sequence[Sequence[float]],
        phi: Annotated[Sequence[float], MinLen(1), RADIANS] = (0.0,),
    ) -> "TabulatedPattern":
        """Build a pattern from a measured power gain in decibels.

        Args:
            theta: angles to boresight, from 0 on [rad].
            gain_db: power gain [dB], one row per theta, one column per phi.
            phi: angles about boresight [rad]; a single one means symmetric about boresight.

        Raises:
            InputError: as the pattern itself, or rows of other lengths.
        """
        rows, columns = len(theta), len(phi)
        if len(gain_db) != rows or any(len(row) != columns for row in gain_db):
            lengths = sorted({len(row) for row in gain_db})
            raise InputError(
                f"expected gain_db with {rows} rows of {columns}, got {len(gain_db)} rows of "
                f"{' or '.join(map(str, lengths))}; give one row per theta and one column per phi"
            )
        angles, around, levels = (
            torch.tensor(values, dtype=torch.float64) for values in (theta, phi, gain_db)
        )
        return cls(angles, around, 10 ** (levels / 10))

    def gain(self, direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return the linear power gain, bilinear between the nodes of `table`."""
        grid = self._grid.to(direction)
        x, y, z = direction.unbind(-1)
        height = (x.clamp(-1, 1) + 1) / 2 * (COSINE_COUNT - 1)
        row = height.detach().to(torch.int64).clamp(max=COSINE_COUNT - 2)
        up = height - row
        count = grid.shape[1]
        # atan2 has no gradient on the axis; φ is arbitrary there.
        on_axis = (y == 0) & (z == 0)
        turn = (torch.atan2(z, torch.where(on_axis, 1.0, y)) + torch.pi) / (2 * torch.pi) * count
        cell = turn.detach().to(torch.int64)
        across = turn - cell
        column, neighbour = cell % count, (cell + 1) % count
        low = torch.lerp(grid[row, column], grid[row, neighbour], across)
        high = torch.lerp(grid[row + 1, column], grid[row + 1, neighbour], across)
        return torch.lerp(low, high, up)

    def table(self) -> Float64[Tensor, "2049 n_phi"]:
        """Return the resampled gain."""
        return self._grid


@dataclass(frozen=True, eq=False)
class AntennaArray:
    """Antenna elements of one pattern at fixed positions.

    Attributes:
        positions: element positions in the radar frame [m].
        pattern: gain of every element.
        polarisation: "V", "H", "circular" (right-hand) or a Jones vector (V, H) of all elements or
            of each. V lies in the plane of the direction and the radar's z axis, H perpendicular to
            it. In Python also a `JonesTable` over direction.
        leakage: field of the orthogonal polarisation over that of the nominal one, of all elements
            or of each. The gain includes both.

    Raises:
        InputError: no elements, wrong shape, NaN, positions that require grad, a pattern of
            another type, an unknown polarisation.
    """

    positions: Float64[Tensor, "n 3"]
    pattern: Pattern = field(default_factory=Isotropic)
    polarisation: Polarised = "V"
    leakage: float | checks.ArrayLike = 0.0
    jones: Polarisation = field(init=False, repr=False)

    def __post_init__(self) -> None:
        do = "give one position [x, y, z] in metres per element"
        what = "element positions"
        positions = checks.checked_positions(self.positions, what, "antenna element", do)
        do = "spectra do not differentiate their steering: detach them"
        checks.refuse_derivatives(positions, what, do)
        do = "give Isotropic(), Cosine(exponent) or Table(theta, phi, gains)"
        checks.checked_type(self.pattern, Pattern, "a pattern", do)
        jones = Polarisation.from_jones(self.polarisation, self.leakage, len(positions))
        checks.set_fields(self, positions=positions, jones=jones)

    def change_basis(self, basis: Basis) -> "AntennaArray":
        """Return the array with positions along other axes."""
        return replace(self, positions=basis.vectors(self.positions))


def linear_array(
    count: Count,
    spacing: Positive,
    axis: Literal["y", "z"] = "y",
    pattern: Pattern | None = None,
    polarisation: Polarised = "V",
    leakage: float | checks.ArrayLike = 0.0,
) -> AntennaArray:
    """Build a row of elements, centred at the origin of the radar frame.

    Args:
        count: number of elements.
        spacing: distance between neighbours [m].
        axis: direction of the row, y (to the left) or z (up).
        pattern: gain of every element, isotropic by default.
        polarisation: "V", "H", "circular" or a Jones vector (V, H), see `AntennaArray`.
        leakage: field of the orthogonal polarisation over that of the nominal one.

    Raises:
        InputError: no elements, a spacing that is not positive, or another axis.
    """
    checks.check_choice(axis, ("y", "z"), "axis", "arrays lie in the y-z plane, and x is boresight")
    counts = (count, 1) if axis == "y" else (1, count)
    return planar_array(counts, (spacing, spacing), pattern, polarisation, leakage)


def planar_array(
    count: tuple[Count, Count],
    spacing: tuple[Positive, Positive],
    pattern: Pattern | None = None,
    polarisation: Polarised = "V",
    leakage: float | checks.ArrayLike = 0.0,
) -> AntennaArray:
    """Build a grid of elements, centred at the origin of the radar frame; z runs fastest.

    Args:
        count: elements along y, z.
        spacing: distance between neighbours along y, z [m].
        pattern: gain of every element, isotropic by default.
        polarisation: "V", "H", "circular" or a Jones vector (V, H), see `AntennaArray`.
        leakage: field of the orthogonal polarisation over that of the nominal one.

    Raises:
        InputError: no elements, or a spacing that is not positive.
    """
    require_at_most(count[0] * count[1], _MAX_ELEMENTS, "antenna elements", "lower count", "count")
    y = centre_positions(count[0], spacing[0], "elements along y")
    plane = torch.cartesian_prod(y, centre_positions(count[1], spacing[1], "elements along z"))
    positions = torch.cat([torch.zeros_like(plane[:, :1]), plane], dim=1)
    gain = Isotropic() if pattern is None else pattern
    return AntennaArray(positions, gain, polarisation, leakage)


def centre_positions(count: int, spacing: float, what: str) -> Float64[Tensor, " element"]:
    """Place elements along a line, centred on zero.

    Args:
        count: number of elements.
        spacing: distance of neighbours [m].
        what: noun for the elements, for the message.

    Raises:
        InputError: no element, or a spacing that is not positive.
    """
    number = checks.checked_count(count, what, 1)
    distance = checks.checked_number(spacing, "element spacing [m]", 0.0, open_low=True)
    return (torch.arange(number, dtype=torch.float64) - (number - 1) / 2) * distance


def _resample_gains(theta: Tensor, phi: Tensor, gains: Tensor) -> Tensor:
    cosine = np.linspace(-1, 1, COSINE_COUNT)
    given = gains.detach().numpy()
    if len(phi) > 1:
        # A multiple of the given number keeps evenly spaced angles as nodes.
        count = len(phi) * -(-360 // len(phi))
        around = -np.pi + 2 * np.pi * np.arange(count) / count
        known = phi.detach().numpy()
        given = np.stack([np.interp(around, known, row, period=2 * np.pi) for row in given])
    angle, known = np.arccos(cosine), theta.detach().numpy()
    columns = [np.interp(angle, known, column, right=0.0) for column in given.T]
    return torch.from_numpy(np.stack(columns, axis=1))
