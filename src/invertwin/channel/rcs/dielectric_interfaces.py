"""What waves do at the faces of solids, from outside and from within.

The field is E exp(−jk(K·x + c)) with K·K = ε and ηH = K × E. What a closed body scatters is sent by
the tangential fields on the outer side of its faces alone, as if in air.
"""

from typing import NamedTuple

import torch
from jaxtyping import Complex128
from torch import Tensor

from invertwin.channel.beams.beam_tracing import IlluminatedPatches
from invertwin.channel.em.dielectric_solids import DielectricSolids, normal_component
from invertwin.channel.em.plane_waves import (
    SmoothInterfaces,
    Vectors,
    dot,
    project_transverse,
    radiate_currents,
    radiate_field,
    reflect_field,
    roughness_attenuation,
)


class InterfaceCoefficients(NamedTuple):
    """What a face makes of waves.

    Attributes:
        reflected: field that goes back.
        transmitted: field that goes on.
    """

    reflected: Complex128[Tensor, "row 2 3"]
    transmitted: Complex128[Tensor, "row 2 3"]


class InterfaceFields(NamedTuple):
    """What waves do at surfaces.

    Attributes:
        radiated: F per m², to a receiver outside.
        reflected: field that goes back.
        transmitted: field that goes on behind the surface.
    """

    radiated: Complex128[Tensor, "row 2 3"]
    reflected: Complex128[Tensor, "row 2 3"]
    transmitted: Complex128[Tensor, "row 2 3"]


def apply_fresnel(
    permittivity_in: Complex128[Tensor, " row"],
    permittivity_out: Complex128[Tensor, " row"],
    normal: Vectors,
    wave_vector: Tensor,
    field: Complex128[Tensor, "row 2 3"],
) -> InterfaceCoefficients:
    """Fresnel's law for any plane wave, with total reflection, from either side.

    The parts of E and H along the face are continuous. With p = −K·n and q = √(ε₂ − K_t·K_t), the
    part of E along the face is mirrored as r E_t + g K_t (K_t·E_t), r = (p − q)/(p + q) and
    g = 2(ε₂ − ε₁)/((ε₁q + ε₂p)(p + q)). That is r_s across the plane of incidence and r_p in it,
    without a plane of incidence, which normal incidence and decaying waves do not have.

    Args:
        permittivity_in: ε₁, where the wave comes from.
        permittivity_out: ε₂.
        normal: n, towards the source.
        wave_vector: K of the incident wave.
        field: E on the face.

    Source: Balanis, Advanced Engineering Electromagnetics, §5.3.
    """
    p, q = -dot(wave_vector, normal), normal_component(permittivity_out, wave_vector, normal)
    n, along = normal[:, None], (wave_vector + p[:, None] * normal)[:, None]
    both, mixed = p + q, permittivity_in * q + permittivity_out * p
    tangential = field - dot(n, field)[..., None] * n
    share = dot(along, tangential)[..., None]
    r = ((p - q) / both)[:, None, None]
    g = (2 * (permittivity_out - permittivity_in) / (mixed * both))[:, None, None]
    again = r * tangential + g * share * along
    # K·E = 0 of each wave gives the parts across the face.
    upright = ((permittivity_in * q - permittivity_out * p) / (mixed * p))[:, None, None] * share
    through = (2 * permittivity_in / mixed)[:, None, None] * share
    return InterfaceCoefficients(again - upright * n, tangential + again + through * n)


def scatter_at_interfaces(
    solids: DielectricSolids,
    interfaces: SmoothInterfaces,
    wave_number: float,
    patches: IlluminatedPatches,
    field: Complex128[Tensor, "row 2 3"],
    scattering_direction: Vectors,
) -> InterfaceFields:
    """What waves do where they meet surfaces, from outside or from within.

    From within, the outer side of a face sends by the parts of E and H along it, which are those
    of the wave and its mirrored one inside. Conductors that are met inside send nothing: no wave
    is on their other side.

    Args:
        solids: what waves enter.
        interfaces: of each facet.
        wave_number: k [1/m].
        patches: waves, and the patches that they meet.
        field: E on the surface.
        scattering_direction: s, to the receiver.

    Source: derivations §13 and §14.
    """
    sent, again, passed = (torch.zeros_like(field) for _ in range(3))
    outer, metal = patches.medium < 0, solids.conducting[patches.facet]
    at = torch.nonzero(outer)[:, 0]
    front = (interfaces.rows(at), wave_number, patches.normal[at], patches.direction[at], field[at])
    sent = sent.index_copy(0, at, radiate_field(*front, scattering_direction[at]))
    again = again.index_copy(0, at, reflect_field(*front))
    at = torch.nonzero(~outer & metal)[:, 0]
    n = patches.normal[at, None]
    again = again.index_copy(0, at, 2 * dot(n, field[at])[..., None] * n - field[at])
    at = torch.nonzero(outer & solids.transparent[patches.facet])[:, 0]
    passed = passed.index_copy(
        0, at, _refract_at_faces(solids, interfaces, wave_number, patches, field, at)[1]
    )
    at = torch.nonzero(~outer & ~metal)[:, 0]
    back, through = _refract_at_faces(solids, interfaces, wave_number, patches, field, at)
    n, s, wave, rough = (
        patches.normal[at],
        scattering_direction[at],
        patches.wave_vector[at],
        interfaces.rows(at),
    )
    out = radiate_currents(wave_number, -n, wave, field[at], back, s)
    p = -dot(wave, n).real
    kept = [
        roughness_attenuation(rough, wave_number, way)[:, None, None]
        for way in (p + dot(n, s), 2 * p)
    ]
    sent = sent.index_copy(0, at, project_transverse(out, s) * kept[0])
    return InterfaceFields(
        sent, again.index_copy(0, at, back * kept[1]), passed.index_copy(0, at, through)
    )


def _refract_at_faces(
    solids: DielectricSolids,
    interfaces: SmoothInterfaces,
    wave_number: float,
    patches: IlluminatedPatches,
    field: Tensor,
    rows: Tensor,
) -> InterfaceCoefficients:
    """What faces of solids mirror, without roughness, and let through, of some rows."""
    n, wave, medium = patches.normal[rows], patches.wave_vector[rows], patches.medium[rows]
    behind = solids.permittivity_in(solids.medium_behind(patches.facet[rows], medium))
    found = apply_fresnel(solids.permittivity_in(medium), behind, n, wave, field[rows])
    changed = -dot(wave, n) - normal_component(behind, wave, n)
    kept = roughness_attenuation(interfaces.rows(rows), wave_number, changed.real)
    return found._replace(transmitted=found.transmitted * kept[:, None, None])
