"""Fields between antennas: what a current or a scatterer sends from one polarisation to another."""

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.coupling import coupled_field
from invertwin.channel.field.waves import cross, dot, polarisations
from invertwin.channel.paths import Link
from invertwin.channel.reference.radar_equation import Echo
from invertwin.scene.polarisation import JonesTable, Polarisation

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


def mirror_matrix(link: Link, echo: Echo) -> Complex128[Tensor, "row r t"]:
    """Field coefficients per m² of a perfect conductor by physical optics; Jacobians included.

    ``a = (λ/4π) S / (R_t R_r)`` with ``S = −(jk/2π) ∫ p_r · [n × (d × p_t)] V dA`` (derivations §4
    and §13), the mean of both ways between separate antennas, which keeps reciprocity. Between
    antennas of one place that is ``(n·d) p_r · p_t``.
    Differs from the source: the paper gives no field of a surface.

    Args:
        link: Antennas.
        echo: The radar equation of single points.
    """
    (point,) = echo.places
    ways = [
        normalize(point.position - antenna[echo.frame], dim=1) for antenna in (link.tx, link.rx)
    ]
    normal = -dot(point.normal, ways[0]).sign()[:, None] * point.normal
    if torch.equal(link.tx, link.rx) and not _directed(link):
        sent, received = link.tx_jones.towards(ways[0]), link.rx_jones.towards(ways[1])
        kernel = -0.5 * dot(normal, ways[0] + ways[1])[:, None, None] * (received @ sent.mT)
    else:
        rotation = link.rotations[echo.frame]
        sent = antenna_fields(link.tx_jones, rotation, ways[0])
        received = antenna_fields(link.rx_jones, rotation, ways[1])
        kernel = current_kernel(normal, ways[0], sent, ways[1], received)
    return (
        conductor_field(echo.spread, kernel, -dot(normal, ways[1])) * point.jacobian[:, None, None]
    )


def _directed(link: Link) -> bool:
    return any(isinstance(jones.base, JonesTable) for jones in (link.tx_jones, link.rx_jones))


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


def rough_matrix(
    link: Link, echo: Echo, phase: Float64[Tensor, " row"]
) -> Complex128[Tensor, "#row r t"]:
    """Fields of rough paths between the vectors of both arrays, over those of V to V.

    Args:
        link: Antennas.
        echo: The radar equation of the paths.
        phase: of the paths.
    """
    rotation = link.rotations[echo.frame]

    def towards(jones: Polarisation, antenna: Tensor, position: Tensor) -> Tensor:
        if not isinstance(jones.base, JonesTable):
            return jones.base[None]
        way = normalize(position - antenna[echo.frame], dim=1)
        return jones.towards(torch.einsum("nij,ni->nj", rotation, way))

    sent = towards(link.tx_jones, link.tx, echo.places[0].position)
    received = towards(link.rx_jones, link.rx, echo.places[-1].position)
    return received @ coupled_field(echo.depolarisation, phase) @ sent.mT


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
