"""Polarisation of scattered power: how much of it antennas of given Jones vectors take.

Every bounce keeps V and H, and turns handedness, as a mirror does. A depolarising surface moves the
share χ of the power from V to H and from H to V, wherever these axes lie. In Stokes parameters,
that multiplies linear polarisation by 1 − 2χ and circular polarisation by 1 − 4χ: scattering that
favours no direction about the line of sight, and that is the same both ways. Of χ = 1/4, a cloud
of thin wires, nothing circular is left.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel.paths import Link

_LINEAR, _CIRCULAR = 2.0, 4.0
_MATRICES = torch.tensor(
    [[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1], [-1, 0]]],
    dtype=torch.complex128,
)  # a mirror, a dihedral, one that is rolled by 45°, and a turn by 90°
_GOLDEN = 0.618_033_988_749_894_8


class PolarisationShare(NamedTuple):
    """A part of what antennas take: so much of a path's power × Π(1 − loss·χ) over its bounces.

    Attributes:
        odd, even: of paths with an odd and an even number of bounces.
        loss: how fast depolarisation takes it.
    """

    odd: float
    even: float
    loss: float

    def for_bounces(self, bounces: int) -> float:
        """That of paths of so many bounces."""
        return self.odd if bounces % 2 else self.even


def polarisation_shares(link: Link, *, depolarising: bool) -> list[PolarisationShare]:
    """What two antennas take of the power of paths: the sum of the shares.

    ½(I I' + q q' ± u u' ∓ v v') in Stokes parameters of their mean elements, which is |rᵀ t|² after
    one bounce and |r₁t₁ − r₂t₂|² after two.

    Args:
        link: antennas.
        depolarising: whether any surface depolarises.

    Raises:
        InputError: polarisations that depend on the direction.
    """
    sent, received = (_stokes_parameters(j.vectors.mean(0)) for j in (link.tx_jones, link.rx_jones))
    whole, q, u, v = (0.5 * s * r for s, r in zip(sent, received, strict=True))
    parts = [
        PolarisationShare(whole, whole, 0.0),
        PolarisationShare(q + u, q - u, _LINEAR),
        PolarisationShare(-v, v, _CIRCULAR),
    ]
    if depolarising:
        return parts[:1] + [part for part in parts[1:] if part.odd or part.even]
    return [PolarisationShare(sum(p.odd for p in parts), sum(p.even for p in parts), 0.0)]


def received_power_fraction(
    link: Link, depolarisation: Sequence[Float64[Tensor, " row"]]
) -> Float64[Tensor, " row"]:
    """What antennas take of the power of paths.

    Args:
        link: antennas.
        depolarisation: χ of every bounce in turn.
    """
    depolarised = any(bool(value.detach().any()) for value in depolarisation)
    total = torch.zeros_like(depolarisation[0])
    for share in polarisation_shares(link, depolarising=depolarised):
        kept = torch.full_like(total, share.for_bounces(len(depolarisation)))
        for value in depolarisation:
            kept = kept * (1 - share.loss * value)
        total = total + kept
    return total


def random_scattering_matrix(
    depolarisation: Sequence[Float64[Tensor, " row"]], phase: Float64[Tensor, " row"]
) -> Complex128[Tensor, "#row 2 2"]:
    """Fields between V and H of scatterers of random phase, received × sent, over their amplitude.

    Their mean power is that of ``polarisation_shares``: a mirror, dihedrals at two angles and a
    turn, each
    with its chance and a phase of its own, which is a hash of the first.

    Args:
        depolarisation: χ of every bounce in turn.
        phase: of the paths [rad], which this does not contain.
    """
    # The matrix that keeps the polarisation comes first; that of a dihedral after two bounces.
    order = (0, 1, 2, 3) if len(depolarisation) % 2 else (1, 0, 3, 2)
    if not any(bool(value.detach().any()) for value in depolarisation):
        return _MATRICES[order[0]][None]
    linear, circular = torch.ones_like(phase), torch.ones_like(phase)
    for value in depolarisation:
        linear, circular = linear * (1 - _LINEAR * value), circular * (1 - _CIRCULAR * value)
    both = (1 + circular) / 4
    aside, chances = (1 - circular) / 4, (both + linear / 2, both - linear / 2)
    found = torch.zeros(len(phase), 2, 2, dtype=torch.complex128)
    turns = phase.detach() / (2 * torch.pi)
    for number, (share, which) in enumerate(
        zip((chances[0], aside, aside, chances[1]), order, strict=True)
    ):
        lit = share.detach() > 1e-15
        root = torch.where(lit, torch.where(lit, share, 1.0).sqrt(), 0.0)
        # Digits of a phase far behind the point are as random as the phase.
        own = 2 * torch.pi * ((turns * 1e6 * (number + _GOLDEN)) % 1) if number else 0 * turns
        found = found + torch.polar(root, own)[:, None, None] * _MATRICES[which]
    return found


def _stokes_parameters(vector: Complex128[Tensor, "2"]) -> tuple[float, float, float, float]:
    first, second = complex(vector[0]), complex(vector[1])
    both = first * second.conjugate()
    powers = abs(first) ** 2, abs(second) ** 2
    return powers[0] + powers[1], powers[0] - powers[1], 2 * both.real, 2 * both.imag
