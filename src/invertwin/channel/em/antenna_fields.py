"""Fields of antennas at a surface, and of currents on conductors at an antenna."""

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, polarisations
from invertwin.channel.paths import Link
from invertwin.scene.polarisation import Polarisation

_UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)  # of the radar


def antenna_fields(
    jones: Polarisation, rotation: Float64[Tensor, "row 3 3"], way: Float64[Tensor, "row 3"]
) -> Complex128[Tensor, "row k 3"]:
    """Unit fields in the world that an array's vectors send along unit vectors, or hear from there.

    Args:
        jones: of the array.
        rotation: columns are the radar's axes.
        way: away from the antenna.
    """
    local = torch.einsum("nij,ni->nj", rotation, way)
    axes = torch.einsum("nij,npj->npi", rotation, polarisations(-local, _UP))
    return jones.towards(local) @ axes.to(torch.complex128)


def current_kernel(
    normal: Float64[Tensor, "row 3"],
    onwards: Float64[Tensor, "row 3"],
    sent: Complex128[Tensor, "row t 3"],
    back: Float64[Tensor, "row 3"],
    received: Complex128[Tensor, "row r 3"],
) -> Complex128[Tensor, "row r t"]:
    """What the current that a wave induces on a conductor sends: p · [n × (d × E)].

    The mean of both ways: of the current of the one wave seen by the other and the reverse.

    Args:
        normal: n, towards the source.
        onwards: d, of the wave that arrives.
        sent: its fields E.
        back: d of the wave that the other antenna would send to this place.
        received: fields of that wave.
    """
    n, d, b = normal[:, None], onwards[:, None], back[:, None]
    there = torch.linalg.cross(n.to(sent.dtype), cross(d, sent))
    here = torch.linalg.cross(n.to(sent.dtype), cross(b, received))
    return 0.5 * (received @ there.mT + here @ sent.mT)


def conductor_field(
    spread: Float64[Tensor, " row"],
    kernel: Complex128[Tensor, "row r t"],
    outgoing: Float64[Tensor, " row"],
) -> Complex128[Tensor, "row r t"]:
    """Field coefficients per m² of a lit conductor: ``−(j/4π) √spread p · [n × (d × E)]``.

    Args:
        spread: gains and 1/R² of both ways, without scattering.
        kernel: p · [n × (d × E)].
        outgoing: cosine to where the wave goes to, zero behind the lit side.
    """
    lit = (outgoing > 0).to(spread)
    return (-1j / (4 * torch.pi) * spread.sqrt() * lit)[:, None, None] * kernel


def combined(
    link: Link, matrix: Complex128[Tensor, "row r t"]
) -> tuple[Complex128[Tensor, " row"], Complex128[Tensor, "row r t"] | None]:
    """Coefficients of the mean elements, and the matrix where elements differ, as ``Paths`` wants.

    Args:
        link: Antennas.
        matrix: Between the vectors of both arrays.
    """
    sent, received = link.tx_jones.mean, link.rx_jones.mean
    coefficient = torch.einsum("r,nrt,t->n", received, matrix, sent)
    return coefficient, None if matrix.shape[1:] == (1, 1) else matrix
