"""Fields of antennas at a surface, and of currents on conductors at an antenna."""

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, polarisations
from invertwin.channel.paths import Link
from invertwin.scene.polarisation import Polarisation

_UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)  # of the radar


def antenna_fields(
    jones: Polarisation, rotation: Float64[Tensor, "row 3 3"], direction: Float64[Tensor, "row 3"]
) -> Complex128[Tensor, "row k 3"]:
    """Unit fields in the world that an array's vectors send along unit vectors, or hear from there.

    Args:
        jones: of the array.
        rotation: columns are the radar's axes.
        direction: away from the antenna.
    """
    local = torch.einsum("nij,ni->nj", rotation, direction)
    axes = torch.einsum("nij,npj->npi", rotation, polarisations(-local, _UP))
    return jones.evaluate(local) @ axes.to(torch.complex128)


def current_kernel(
    normal: Float64[Tensor, "row 3"],
    incident_direction: Float64[Tensor, "row 3"],
    incident_fields: Complex128[Tensor, "row t 3"],
    reverse_direction: Float64[Tensor, "row 3"],
    reverse_fields: Complex128[Tensor, "row r 3"],
) -> Complex128[Tensor, "row r t"]:
    """What the current that a wave induces on a conductor sends: p · [n × (d × E)].

    The mean of both ways: of the current of the one wave seen by the other and the reverse.

    Args:
        normal: n, towards the source.
        incident_direction: d, of the wave that arrives.
        incident_fields: its fields E.
        reverse_direction: d of the wave that the other antenna would send to this place.
        reverse_fields: fields of that wave.
    """
    n, d, b = normal[:, None], incident_direction[:, None], reverse_direction[:, None]
    there = torch.linalg.cross(n.to(incident_fields.dtype), cross(d, incident_fields))
    here = torch.linalg.cross(n.to(incident_fields.dtype), cross(b, reverse_fields))
    return 0.5 * (reverse_fields @ there.mT + here @ incident_fields.mT)


def conductor_field(
    spread: Float64[Tensor, " row"],
    kernel: Complex128[Tensor, "row r t"],
    outgoing_cosine: Float64[Tensor, " row"],
) -> Complex128[Tensor, "row r t"]:
    """Field coefficients per m² of a lit conductor: ``−(j/4π) √spread p · [n × (d × E)]``.

    Args:
        spread: gains and 1/R² of both ways, without scattering.
        kernel: p · [n × (d × E)].
        outgoing_cosine: cosine to where the wave goes to, zero behind the lit side.
    """
    lit = (outgoing_cosine > 0).to(spread)
    return (-1j / (4 * torch.pi) * spread.sqrt() * lit)[:, None, None] * kernel


def combine_elements(
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
