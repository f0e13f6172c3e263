"""Depolarisation: fraction of scattered power that antennas of given Jones vectors receive.

Every bounce preserves V and H and reverses the handedness, as a specular reflection does. A
depolarising surface transfers the fraction χ of the power from V to H and from H to V, for any
choice of these axes. In Stokes parameters, linear polarisation is multiplied by 1 − 2χ and circular
polarisation by 1 − 4χ: scattering that is isotropic about the line of sight, and reciprocal. For χ
= 1/4, a cloud of thin wires, no circular polarisation is left.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel.paths import Link
from invertwin.scene.material.fresnel import safe_root

_LINEAR, _CIRCULAR = 2.0, 4.0

_Values: TypeAlias = Float64[Tensor, " row"]
_MATRICES = torch.tensor(
    [[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1], [-1, 0]]],
    dtype=torch.complex128,
)  # plane, dihedral, dihedral rolled by 45°, rotation by 90°
_GOLDEN = 0.618_033_988_749_894_8


class PolarisationShare(NamedTuple):
    """Term of the received power fraction: weight × Π(1 − loss·χ) over a path's bounces.

    Attributes:
        odd, even: weight for paths with an odd and an even number of bounces.
        loss: rate at which depolarisation reduces it.
    """

    odd: float
    even: float
    loss: float

    def for_bounces(self, bounces: int) -> float:
        """Return the weight for paths with a given number of bounces."""
        return self.odd if bounces % 2 else self.even


def polarisation_shares(link: Link, *, depolarising: bool) -> list[PolarisationShare]:
    """Terms whose sum is the fraction of a path's power that two antennas receive.

    ½(I I' + q q' ± u u' ∓ v v') in Stokes parameters of their mean elements, which is |rᵀ t|² after
    one bounce and |r₁t₁ − r₂t₂|² after two.

    Args:
        link: antennas.
        depolarising: True if any surface depolarises.

    Raises:
        InputError: polarisations that depend on the direction.
    """
    tx, rx = (_stokes_parameters(j.vectors.mean(0)) for j in (link.tx_jones, link.rx_jones))
    whole, q, u, v = (0.5 * s * r for s, r in zip(tx, rx, strict=True))
    terms = [
        PolarisationShare(whole, whole, 0.0),
        PolarisationShare(q + u, q - u, _LINEAR),
        PolarisationShare(-v, v, _CIRCULAR),
    ]
    if depolarising:
        return terms[:1] + [part for part in terms[1:] if part.odd or part.even]
    return [PolarisationShare(sum(p.odd for p in terms), sum(p.even for p in terms), 0.0)]


def received_power_fraction(link: Link, depolarisation: Sequence[_Values]) -> _Values:
    """Fraction of the power of paths that antennas receive.

    Args:
        link: antennas.
        depolarisation: χ at each bounce, in the order of the path.
    """
    depolarised = any(bool(value.detach().any()) for value in depolarisation)
    total = torch.zeros_like(depolarisation[0])
    for share in polarisation_shares(link, depolarising=depolarised):
        fraction = torch.full_like(total, share.for_bounces(len(depolarisation)))
        for value in depolarisation:
            fraction = fraction * (1 - share.loss * value)
        total = total + fraction
    return total


def random_scattering_matrix(
    depolarisation: Sequence[_Values], phase: _Values
) -> Complex128[Tensor, "#row 2 2"]:
    """Scattering matrices of random scatterers in V and H, receive × transmit, of unit amplitude.

    Their mean power is that of ``polarisation_shares``: a plane, dihedrals at two angles and a
    rotation, each with its probability and a phase of its own, a hash of the path's phase.

    Args:
        depolarisation: χ at each bounce, in the order of the path.
        phase: phases of the paths [rad]; the matrices do not contain them.
    """
    # The matrix that preserves polarisation comes first; after two bounces that of a dihedral.
    order = (0, 1, 2, 3) if len(depolarisation) % 2 else (1, 0, 3, 2)
    if not any(bool(value.detach().any()) for value in depolarisation):
        return _MATRICES[order[0]][None]
    linear, circular = torch.ones_like(phase), torch.ones_like(phase)
    for value in depolarisation:
        linear, circular = linear * (1 - _LINEAR * value), circular * (1 - _CIRCULAR * value)
    mean = (1 + circular) / 4
    rotated, probabilities = (1 - circular) / 4, (mean + linear / 2, mean - linear / 2)
    total = torch.zeros(len(phase), 2, 2, dtype=torch.complex128)
    cycles = phase.detach() / (2 * torch.pi)
    for number, (share, which) in enumerate(
        zip((probabilities[0], rotated, rotated, probabilities[1]), order, strict=True)
    ):
        root = safe_root(share, 1e-15)
        # Late decimal digits of a phase are as random as the phase.
        angle = 2 * torch.pi * ((cycles * 1e6 * (number + _GOLDEN)) % 1) if number else 0 * cycles
        total = total + torch.polar(root, angle)[:, None, None] * _MATRICES[which]
    return total


def _stokes_parameters(vector: Complex128[Tensor, "2"]) -> tuple[float, float, float, float]:
    first, second = complex(vector[0]), complex(vector[1])
    both = first * second.conjugate()
    powers = abs(first) ** 2, abs(second) ** 2
    return powers[0] + powers[1], powers[0] - powers[1], 2 * both.real, 2 * both.imag
