"""Facet paths: reflected paths of few flat conductors by beam tracing, differentiable.

Every beam that a sequence of facets reflects ends on an exact polygon; nothing is sampled. Its
current radiates one path to the receiver, from the polygon's centroid: the path is unfolded by
images, so that delays are exact for every element of an array. Corners move with the facets and the
antennas, so that derivatives include the moving edges of beams.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams import beam_tracing
from invertwin.channel.beams.beam_tracing import IlluminatedPatches, trace_beams
from invertwin.channel.em import antenna_fields as antennas
from invertwin.channel.em.plane_waves import area_vector, dot, polygon_integral
from invertwin.channel.paths import Link, Paths, concatenate_paths
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.coplanar import refuse_coplanar_surfaces
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.scene_tables import flatten
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.mesh_defects import require_single_surfaces
from invertwin.scene.scene import Scene


def trace_facet_paths(
    scene: Scene, link: Link, depth: int, *, stretch: float = 1.0, boundary: bool = True
) -> Paths:
    """Trace field paths between few flat conductors, one for every beam; differentiable.

    ``a = −(j/4π) √(G_t G_r)/(R r) p_r · [n × (d × E)] ∫ exp(−jk(d − s)·x) dA`` after m bounces, E
    the field after the previous reflections, R the unfolded distance to the centroid of the
    illuminated polygon; the bracket is averaged over transmitter and receiver exchanged. Beams are
    clipped as those of a plane wave from the antenna to the centre of the scene, and phases are
    plane over a polygon, so that antennas should be in its far field. Only other facets occlude a
    facet from the transmitter; nothing occludes it from the receiver.

    Args:
        scene: smooth conductors of at most 24 triangles together.
        link: antennas, per frame.
        depth: maximum number of bounces.
        stretch: wavelength of phases over a polygon, over that of the antennas. A longer one widens
            the lobes of polygons and keeps their peaks.
        boundary: False omits the derivatives due to moving edges of beams.

    Source: derivations §13.

    Raises:
        InputError: too many triangles, another material, or surfaces that are doubled.
    """
    facets = _conductor_facets(scene, link)
    centre = facets.corners.mean((0, 1))
    paths: list[Paths] = []
    previous: IlluminatedPatches | None = None
    unfolding: _Unfolding | None = None
    orders = trace_beams(facets, normalize(centre - link.tx, dim=1), depth, boundary=boundary)
    for order, patches in enumerate(orders, 1):
        unfolding = _unfold_reflections(patches, previous, unfolding)
        paths.append(_field_paths(patches, unfolding, link, order, stretch))
        previous = patches
    if not paths:
        raise InputError("expected facets that the radar illuminates, got none; check poses")
    return concatenate_paths(paths)


class _Unfolding(NamedTuple):
    """Unfolding transform x → Mx + t of points on the last facet of each beam."""

    rotation: Float64[Tensor, "row 3 3"]
    translation: Float64[Tensor, "row 3"]


def _conductor_facets(scene: Scene, link: Link) -> beam_tracing.Facets:
    geometry = flatten(scene, link.wavelength)
    if not all(geometry.coherent):
        raise InputError(
            "expected smooth conductors alone for facet paths, got others; give a "
            "PerfectConductor, or use power paths"
        )
    if len(geometry.faces) > beam_tracing.MAX_FACETS_BEAM_TRACING:
        raise InputError(
            f"expected at most {beam_tracing.MAX_FACETS_BEAM_TRACING} triangles for facet paths, "
            f"got {len(geometry.faces)}; use power paths, or simulate"
        )
    require_single_surfaces(scene)
    viewers = torch.cat([link.tx, link.rx])
    with tracing():
        rays = RayScene(geometry, link)
        refuse_coplanar_surfaces(rays, geometry.vertices, viewers, geometry.names)
    return beam_tracing.build_facets(geometry.vertices, geometry.topology)


def _unfold_reflections(
    patches: IlluminatedPatches,
    previous: IlluminatedPatches | None,
    previous_unfolding: _Unfolding | None,
) -> _Unfolding:
    """Unfolding transforms by the images of all previous facets."""
    if previous is None or previous_unfolding is None:
        count = len(patches.aspect)
        eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
        return _Unfolding(eye, torch.zeros(count, 3, dtype=torch.float64))
    row = patches.parent
    normal, point = previous.normal[row], previous.polygon[row, 0]
    rotation, translation = previous_unfolding.rotation[row], previous_unfolding.translation[row]
    # M (x − 2 n n·(x − p)) + t
    rotated_normal = (rotation @ normal[..., None])[..., 0]
    translation = translation + 2 * dot(normal, point)[:, None] * rotated_normal
    return _Unfolding(rotation - 2 * rotated_normal[:, :, None] * normal[:, None], translation)


def _field_paths(
    patches: IlluminatedPatches, unfolding: _Unfolding, link: Link, order: int, stretch: float
) -> Paths:
    frame, centroid = patches.aspect, _polygon_centroid(patches.polygon)
    tx, rx, rotation = link.tx[frame], link.rx[frame], link.rotations[frame]
    image = torch.einsum("nij,nj->ni", unfolding.rotation, centroid) + unfolding.translation
    outbound, inbound = image - tx, rx - centroid
    length, distance = outbound.norm(dim=1), inbound.norm(dim=1)
    departure, leaving_direction = outbound / length[:, None], inbound / distance[:, None]
    arriving = torch.einsum("nij,ni->nj", unfolding.rotation, departure)
    gain = link.tx_pattern.gain(torch.einsum("nij,ni->nj", rotation, departure))
    gain = gain * link.rx_pattern.gain(torch.einsum("nij,ni->nj", rotation, -leaving_direction))
    area = polygon_integral(patches.polygon - centroid[:, None], leaving_direction - arriving)
    transmit = antennas.antenna_fields(link.tx_jones, rotation, departure)
    # A reflection at a conductor maps E as it maps points, with opposite sign.
    transmit = (-1.0) ** (order - 1) * transmit @ unfolding.rotation.to(transmit.dtype)
    receive = antennas.antenna_fields(link.rx_jones, rotation, -leaving_direction)
    kernel = antennas.current_kernel(
        patches.normal, arriving, transmit, -leaving_direction, receive
    )
    spread, leaving = gain / (length * distance) ** 2, dot(patches.normal, leaving_direction)
    fields = antennas.conductor_field(spread, kernel, leaving)
    fields = fields * area(2 * torch.pi / (stretch * link.wavelength))[:, None, None]
    delay = (length + distance) / SPEED_OF_LIGHT
    return antennas.coherent_paths(link, frame, delay, fields, image, centroid)


def _polygon_centroid(polygon: Float64[Tensor, "row corner 3"]) -> Float64[Tensor, "row 3"]:
    """Centroid of the area; the mean of the corners would jump where a corner is added."""
    normal = normalize(area_vector(polygon), dim=1)
    spokes = polygon - polygon[:, :1]
    fan = torch.linalg.cross(spokes[:, 1:-1], spokes[:, 2:], dim=-1)
    weight = dot(fan, normal[:, None])[..., None]
    return polygon[:, 0] + (weight * (spokes[:, 1:-1] + spokes[:, 2:]) / 3).sum(1) / weight.sum(1)
