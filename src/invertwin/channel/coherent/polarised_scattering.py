"""Fields between antennas: what a current or a scatterer sends from one polarisation to another."""

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.coherent.radar_equation import PathTransfer
from invertwin.channel.em.antenna_fields import antenna_fields, conductor_field, current_kernel
from invertwin.channel.em.depolarisation import random_scattering_matrix
from invertwin.channel.em.plane_waves import dot
from invertwin.channel.paths import Link
from invertwin.scene.polarisation import JonesTable, Polarisation


def conductor_matrix(link: Link, echo: PathTransfer) -> Complex128[Tensor, "row r t"]:
    """Field coefficients per m² of a perfect conductor by physical optics; Jacobians included.

    ``a = (λ/4π) S / (R_t R_r)`` with ``S = −(jk/2π) ∫ p_r · [n × (d × p_t)] V dA`` (derivations §4
    and §13), the mean of both ways between separate antennas, which keeps reciprocity. Between
    antennas of one place that is ``(n·d) p_r · p_t``.
    Differs from the source: the paper gives no field of a surface.

    Args:
        link: Antennas.
        echo: The radar equation of single points.
    """
    (point,) = echo.points
    offsets = (point.position - antenna[echo.frame] for antenna in (link.tx, link.rx))
    ways = [normalize(offset, dim=1) for offset in offsets]
    normal = -dot(point.normal, ways[0]).sign()[:, None] * point.normal
    if torch.equal(link.tx, link.rx) and not _has_directional_jones(link):
        sent, received = link.tx_jones.evaluate(ways[0]), link.rx_jones.evaluate(ways[1])
        kernel = -0.5 * dot(normal, ways[0] + ways[1])[:, None, None] * (received @ sent.mT)
    else:
        rotation = link.rotations[echo.frame]
        sent = antenna_fields(link.tx_jones, rotation, ways[0])
        received = antenna_fields(link.rx_jones, rotation, ways[1])
        kernel = current_kernel(normal, ways[0], sent, ways[1], received)
    field = conductor_field(echo.spreading, kernel, -dot(normal, ways[1]))
    return field * point.jacobian[:, None, None]


def _has_directional_jones(link: Link) -> bool:
    return any(isinstance(jones.base, JonesTable) for jones in (link.tx_jones, link.rx_jones))


def rough_path_matrix(
    link: Link, echo: PathTransfer, phase: Float64[Tensor, " row"]
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
        return jones.evaluate(torch.einsum("nij,ni->nj", rotation, way))

    sent = towards(link.tx_jones, link.tx, echo.points[0].position)
    received = towards(link.rx_jones, link.rx, echo.points[-1].position)
    return received @ random_scattering_matrix(echo.depolarisation, phase) @ sent.mT
