"""Fields of antennas at a surface, and of currents on conductors at an antenna."""

import torch
from jaxtyping import Complex128, Float64, Int64
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, polarisations
from invertwin.channel.paths import Link, Paths, make_paths
from invertwin.scene.polarisation import Polarisation


def antenna_fields(
    jones: Polarisation, rotation: Float64[Tensor, "row 3 3"], direction: Float64[Tensor, "row 3"]
) -> Complex128[Tensor, "row k 3"]:
    """Unit fields that an array's Jones vectors radiate along a direction, in world axes.

    By reciprocity, also the fields that it receives from there.

    Args:
        jones: Jones vectors of the array's elements.
        rotation: rotation from the radar's axes to the world's; columns are the radar's axes.
        direction: unit vectors away from the antenna, in world axes.
    """
    local = torch.einsum("nij,ni->nj", rotation, direction)
    axes = torch.einsum("nij,npj->npi", rotation, polarisations(-local))
    return jones.evaluate(local) @ axes.to(torch.complex128)


def current_kernel(
    normal: Float64[Tensor, "row 3"],
    incident_direction: Float64[Tensor, "row 3"],
    incident_fields: Complex128[Tensor, "row t 3"],
    reverse_direction: Float64[Tensor, "row 3"],
    reverse_fields: Complex128[Tensor, "row r 3"],
) -> Complex128[Tensor, "row r t"]:
    """Radiation kernel of the current that a wave induces on a conductor: p · [n × (d × E)].

    Symmetrised for reciprocity: the mean over transmitter and receiver exchanged.

    Args:
        normal: unit normal n, towards the source.
        incident_direction: direction d of the incident wave.
        incident_fields: fields E of the incident wave, one per transmit vector.
        reverse_direction: direction d of the wave that the receiver would radiate to this point.
        reverse_fields: fields of that wave, one per receive vector.
    """
    n, d, b = normal[:, None], incident_direction[:, None], reverse_direction[:, None]
    forward = torch.linalg.cross(n.to(incident_fields.dtype), cross(d, incident_fields))
    backward = torch.linalg.cross(n.to(incident_fields.dtype), cross(b, reverse_fields))
    return 0.5 * (reverse_fields @ forward.mT + backward @ incident_fields.mT)


def conductor_field(
    spread: Float64[Tensor, " row"],
    kernel: Complex128[Tensor, "row r t"],
    outgoing_cosine: Float64[Tensor, " row"],
) -> Complex128[Tensor, "row r t"]:
    """Field coefficients per m² of an illuminated conductor: ``−(j/4π) √spread p · [n × (d × E)]``.

    Args:
        spread: antenna gains and two-way spreading, without scattering.
        kernel: p · [n × (d × E)].
        outgoing_cosine: cosine of the scattering angle; ≤ 0 behind the illuminated side.
    """
    illuminated = (outgoing_cosine > 0).to(spread)
    return (-1j / (4 * torch.pi) * spread.sqrt() * illuminated)[:, None, None] * kernel


def combine_elements(
    link: Link, matrix: Complex128[Tensor, "row r t"]
) -> tuple[Complex128[Tensor, " row"], Complex128[Tensor, "row r t"] | None]:
    """Coefficients for ``Paths``: of the mean elements, and the matrix where elements differ.

    Args:
        link: antennas.
        matrix: coefficients between the Jones vectors of both arrays.
    """
    transmit, receive = link.tx_jones.mean, link.rx_jones.mean
    coefficient = torch.einsum("r,nrt,t->n", receive, matrix, transmit)
    return coefficient, None if matrix.shape[1:] == (1, 1) else matrix


def coherent_paths(
    link: Link,
    frame: Int64[Tensor, " row"],
    delay: Float64[Tensor, " row"],
    fields: Complex128[Tensor, "row r t"],
    first: Float64[Tensor, "row 3"],
    last: Float64[Tensor, "row 3"],
) -> Paths:
    """Coherent field paths at rest.

    Args:
        link: antennas.
        frame, delay, first, last: as in ``Paths``.
        fields: coefficients between the Jones vectors of both arrays.
    """
    coefficient, matrix = combine_elements(link, fields)
    columns = frame, delay, first, last, "coherent"
    return make_paths(*columns, coefficient=coefficient, matrix=matrix)
