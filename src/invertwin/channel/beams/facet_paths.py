"""Mirrored paths of few flat conductors, as exact polygons: differentiable, without samples.

Every beam of light that a sequence of facets has mirrored ends on a polygon. Its current sends one
path to the receiver, from the polygon's centroid: the way is unfolded through the mirrors, so that
delays are exact for every element of an array. Corners move with the facets and the antennas, so
that what a moving edge of a beam changes is in the derivative.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams.beam_tracing import (
    MAX_FACETS_BEAM_TRACING,
    Facets,
    IlluminatedPatches,
    build_facets,
    trace_beams,
)
from invertwin.channel.em.antenna_fields import (
    antenna_fields,
    combine_elements,
    conductor_field,
    current_kernel,
)
from invertwin.channel.em.plane_waves import area_vector, dot, polygon_integral
from invertwin.channel.paths import Link, Paths, concatenate_paths
from invertwin.channel.rays.scene_tables import flatten
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.scene.scene import Scene


def trace_facet_paths(
    scene: Scene, link: Link, depth: int, *, stretch: float = 1.0, boundary: bool = True
) -> Paths:
    """Field paths between few flat conductors, one for every beam; differentiable.

    ``a = −(j/4π) √(G_t G_r)/(R r) p_r · [n × (d × E)] ∫ exp(−jk(d − s)·x) dA`` after m bounces,
    E the field as the mirrors before have turned it, R the unfolded way to the centroid of the lit
    polygon; the bracket is the mean of both ways. Beams are clipped as those of a plane wave from
    the antenna to the middle of the scene, and phases are plane over a polygon, so that antennas
    should be in its far field. Only other facets hide a facet from the transmitter; nothing hides
    it from the receiver.

    Args:
        scene: Smooth conductors of at most 24 triangles together.
        link: Antennas, per frame.
        depth: Most bounces.
        stretch: The wavelength of phases over a polygon in wavelengths of the antennas. A longer
            one widens the lobes of polygons and keeps their peaks.
        boundary: False leaves out of derivatives what moving edges of beams change.

    Source: derivations §13.

    Raises:
        InputError: Too many triangles, or another material.
    """
    facets = _conductor_facets(scene, link)
    middle = facets.corners.mean((0, 1))
    parts: list[Paths] = []
    last: IlluminatedPatches | None = None
    unfolding: _Unfolding | None = None
    lit = trace_beams(facets, normalize(middle - link.tx, dim=1), depth, boundary=boundary)
    for order, bounce in enumerate(lit, 1):
        unfolding = _unfold_reflections(bounce, last, unfolding)
        parts.append(_field_paths(bounce, unfolding, link, order, stretch))
        last = bounce
    if not parts:
        raise InputError("expected facets that the radar lights, got none; check poses")
    return concatenate_paths(parts)


class _Unfolding(NamedTuple):
    """Per beam, the motion x → Mx + t that unfolds a point on its last facet."""

    rotation: Float64[Tensor, "row 3 3"]
    translation: Float64[Tensor, "row 3"]


def _conductor_facets(scene: Scene, link: Link) -> Facets:
    geometry = flatten(scene, link.wavelength)
    if not all(geometry.coherent):
        raise InputError(
            "expected smooth conductors alone for mirrored chains, got others; give a "
            "PerfectConductor, or use power paths"
        )
    if len(geometry.faces) > MAX_FACETS_BEAM_TRACING:
        raise InputError(
            f"expected at most {MAX_FACETS_BEAM_TRACING} triangles for mirrored chains, got "
            f"{len(geometry.faces)}; use "
            "power paths, or simulate"
        )
    return build_facets(geometry.vertices, geometry.topology)


def _unfold_reflections(
    patches: IlluminatedPatches,
    previous: IlluminatedPatches | None,
    previous_unfolding: _Unfolding | None,
) -> _Unfolding:
    """How points unfold through all mirrors but the facet itself."""
    if previous is None or previous_unfolding is None:
        count = len(patches.aspect)
        eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
        return _Unfolding(eye, torch.zeros(count, 3, dtype=torch.float64))
    row = patches.parent
    normal, at = previous.normal[row], previous.polygon[row, 0]
    turn, shift = previous_unfolding.rotation[row], previous_unfolding.translation[row]
    # M (x − 2 n n·(x − p)) + t
    across = (turn @ normal[..., None])[..., 0]
    return _Unfolding(
        turn - 2 * across[:, :, None] * normal[:, None],
        shift + 2 * dot(normal, at)[:, None] * across,
    )


def _field_paths(
    patches: IlluminatedPatches, unfolding: _Unfolding, link: Link, order: int, stretch: float
) -> Paths:
    frame, place = patches.aspect, _polygon_centroid(patches.polygon)
    tx, rx, rotation = link.tx[frame], link.rx[frame], link.rotations[frame]
    image = torch.einsum("nij,nj->ni", unfolding.rotation, place) + unfolding.translation
    forth, back = image - tx, rx - place
    length, distance = forth.norm(dim=1), back.norm(dim=1)
    start, onwards = forth / length[:, None], back / distance[:, None]
    arriving = torch.einsum("nij,ni->nj", unfolding.rotation, start)
    gain = link.tx_pattern.gain(torch.einsum("nij,ni->nj", rotation, start))
    gain = gain * link.rx_pattern.gain(torch.einsum("nij,ni->nj", rotation, -onwards))
    area = polygon_integral(patches.polygon - place[:, None], onwards - arriving)
    sent = antenna_fields(link.tx_jones, rotation, start)
    # A mirror turns E as it turns places, and its sign.
    sent = (-1.0) ** (order - 1) * sent @ unfolding.rotation.to(sent.dtype)
    received = antenna_fields(link.rx_jones, rotation, -onwards)
    kernel = current_kernel(patches.normal, arriving, sent, -onwards, received)
    spread, leaving = gain / (length * distance) ** 2, dot(patches.normal, onwards)
    fields = conductor_field(spread, kernel, leaving)
    integral = area(2 * torch.pi / (stretch * link.wavelength))
    coefficient, matrix = combine_elements(link, fields * integral[:, None, None])
    return Paths(
        frame=frame,
        delay=(length + distance) / SPEED_OF_LIGHT,
        coefficient=coefficient,
        power=torch.zeros_like(length),
        first=image,
        last=place,
        kind="coherent",
        boundary=torch.zeros(len(frame), dtype=torch.bool),
        matrix=matrix,
    )


def _polygon_centroid(polygon: Float64[Tensor, "row corner 3"]) -> Float64[Tensor, "row 3"]:
    """Of the area; the mean of the corners would jump where one more appears."""
    normal = normalize(area_vector(polygon), dim=1)
    spokes = polygon - polygon[:, :1]
    fan = torch.linalg.cross(spokes[:, 1:-1], spokes[:, 2:], dim=-1)
    weight = dot(fan, normal[:, None])[..., None]
    third = (spokes[:, 1:-1] + spokes[:, 2:]) / 3
    return polygon[:, 0] + (weight * third).sum(1) / weight.sum(1)
