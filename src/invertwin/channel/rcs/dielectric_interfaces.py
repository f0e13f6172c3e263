"""Reflection and refraction at dielectric interfaces, from outside and from inside.

The field is E exp(−jk(K·x + c)) with K·K = ε and ηH = K × E. The field scattered by a closed body
is radiated by the tangential fields on the outer side of its faces alone, in air.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Complex128
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.beams.beam_tracing import IlluminatedPatches
from invertwin.channel.em import plane_waves
from invertwin.channel.em.dielectric_solids import DielectricSolids, normal_component
from invertwin.channel.em.plane_waves import (
    area_vector,
    cross,
    dot,
    project_transverse,
    radiate_field,
    roughness_attenuation,
)
from invertwin.scene.material.fresnel import refractive_index

_MAX_BEND = 1e-6  # component of Re K across its ray, rounding errors excluded


class InterfaceCoefficients(NamedTuple):
    """Reflected and transmitted fields of an interface (Fresnel coefficients applied).

    Attributes:
        reflected: reflected field [V/m].
        transmitted: transmitted field [V/m].
    """

    reflected: Complex128[Tensor, "row 2 3"]
    transmitted: Complex128[Tensor, "row 2 3"]


class InterfaceFields(NamedTuple):
    """Radiated, reflected and transmitted fields of illuminated surfaces.

    Attributes:
        radiated: far field F per m², towards a receiver outside.
        reflected: reflected field [V/m].
        transmitted: field transmitted behind the surface [V/m].
    """

    radiated: Complex128[Tensor, "row 2 3"]
    reflected: Complex128[Tensor, "row 2 3"]
    transmitted: Complex128[Tensor, "row 2 3"]


def apply_fresnel(
    permittivity_in: Complex128[Tensor, " row"],
    permittivity_out: Complex128[Tensor, " row"],
    normal: plane_waves.Vectors,
    wave_vector: Tensor,
    field: Complex128[Tensor, "row 2 3"],
) -> InterfaceCoefficients:
    """Apply the Fresnel equations to any plane wave, with total reflection, from either side.

    The tangential components of E and H are continuous. With p = −K·n and q = √(ε₂ − K_t·K_t), the
    tangential component of E is reflected as r E_t + g K_t (K_t·E_t), r = (p − q)/(p + q) and g =
    2(ε₂ − ε₁)/((ε₁q + ε₂p)(p + q)). That equals r_s and r_p, without the plane of incidence, which
    is undefined for normal incidence and for evanescent waves.

    Args:
        permittivity_in: relative permittivity ε₁ on the side of the source.
        permittivity_out: relative permittivity ε₂ behind the face.
        normal: unit normal n towards the source.
        wave_vector: K over k of the incident wave, [row, 3].
        field: incident field E on the face [V/m].

    Source: Balanis, Advanced Engineering Electromagnetics, §5.3.
    """
    p, q = -dot(wave_vector, normal), normal_component(permittivity_out, wave_vector, normal)
    n, tangential_vector = normal[:, None], (wave_vector + p[:, None] * normal)[:, None]
    total, mixed = p + q, permittivity_in * q + permittivity_out * p
    tangential = field - dot(n, field)[..., None] * n
    share = dot(tangential_vector, tangential)[..., None]
    r = ((p - q) / total)[:, None, None]
    g = (2 * (permittivity_out - permittivity_in) / (mixed * total))[:, None, None]
    reflected = r * tangential + g * share * tangential_vector
    # K·E = 0 for each wave determines the normal components.
    upright = ((permittivity_in * q - permittivity_out * p) / (mixed * p))[:, None, None] * share
    through = (2 * permittivity_in / mixed)[:, None, None] * share
    return InterfaceCoefficients(reflected - upright * n, tangential + reflected + through * n)


def scatter_at_interfaces(
    solids: DielectricSolids,
    interfaces: plane_waves.SmoothInterfaces,
    wave_number: float,
    patches: IlluminatedPatches,
    field: Complex128[Tensor, "row 2 3"],
    scattering_direction: plane_waves.Vectors,
) -> InterfaceFields:
    """Compute radiated, reflected and transmitted fields at surfaces, from outside or inside.

    From inside, the outer side of a face radiates by the tangential components of E and H, which
    are those of the incident and the reflected wave inside. Conductors inside a solid radiate
    nothing outwards.

    Args:
        solids: dielectric solids.
        interfaces: smooth interface of each patch.
        wave_number: wave number k [1/m].
        patches: illuminated patches with their waves.
        field: incident field E on the surface [V/m].
        scattering_direction: unit vectors s towards the receiver.

    Source: derivations §13 and §14.
    """
    patches, field = _straighten_waves(solids, patches, field)
    radiated, reflected, transmitted = (torch.zeros_like(field) for _ in range(3))
    outside, conducting = patches.medium < 0, solids.conducting[patches.facet]
    rows = torch.nonzero(outside)[:, 0]
    waves = patches.normal[rows], patches.direction[rows], field[rows]
    front = interfaces.rows(rows), wave_number, *waves
    radiated = radiated.index_copy(0, rows, radiate_field(*front, scattering_direction[rows]))
    reflected = reflected.index_copy(0, rows, plane_waves.reflect_field(*front))
    rows = torch.nonzero(~outside & conducting)[:, 0]
    n = patches.normal[rows, None]
    reflected = reflected.index_copy(0, rows, 2 * dot(n, field[rows])[..., None] * n - field[rows])
    rows = torch.nonzero(outside & solids.transparent[patches.facet])[:, 0]
    transmitted = transmitted.index_copy(
        0, rows, _refract_at_faces(solids, interfaces, wave_number, patches, field, rows)[1]
    )
    rows = torch.nonzero(~outside & ~conducting)[:, 0]
    inner, onward = _refract_at_faces(solids, interfaces, wave_number, patches, field, rows)
    n, s, wave = patches.normal[rows], scattering_direction[rows], patches.wave_vector[rows]
    roughness = interfaces.rows(rows)
    outer = plane_waves.radiate_currents(wave_number, -n, wave, field[rows], inner, s)
    p = -dot(wave, n).real
    cosines = p + dot(n, s), 2 * p
    losses = [roughness_attenuation(roughness, wave_number, cosine) for cosine in cosines]
    outer = project_transverse(outer, s) * losses[0][:, None, None]
    radiated = radiated.index_copy(0, rows, outer)
    reflected = reflected.index_copy(0, rows, inner * losses[1][:, None, None])
    return InterfaceFields(radiated, reflected, transmitted.index_copy(0, rows, onward))


def incident_power(
    solids: DielectricSolids, patches: IlluminatedPatches, field: Complex128[Tensor, "row 2 3"]
) -> float:
    """Compute the power √ε|E|²A cosθ incident on all patches, without losses on the way [V²].

    Args:
        solids: dielectric solids.
        patches: illuminated patches.
        field: incident field E on the surface [V/m].
    """
    index = refractive_index(solids.permittivity_in(patches.medium))
    facing = area_vector(patches.polygon).norm(dim=1) * -dot(patches.normal, patches.direction)
    return float((field.abs().square().sum((1, 2)) * index * facing).detach().sum())


def _straighten_waves(
    solids: DielectricSolids, patches: IlluminatedPatches, field: Tensor
) -> tuple[IlluminatedPatches, Tensor]:
    """Replace waves whose phase does not advance along their ray by plane waves that do.

    Behind curved faces K follows the phases at the corners of a tube, so that K·K ≠ ε. Fresnel's
    equations conserve power for plane waves alone, with E orthogonal to K.
    """
    wave, direction = patches.wave_vector, patches.direction
    bent = torch.nonzero(cross(wave.real, direction).norm(dim=1) > _MAX_BEND)[:, 0]
    index = solids.permittivity_in(patches.medium[bent]).sqrt()
    wave = wave.index_copy(0, bent, index[:, None] * direction[bent])
    turned = normalize(project_transverse(field[bent], direction[bent]), dim=2)
    turned = turned * field[bent].norm(dim=2, keepdim=True)
    return replace(patches, wave_vector=wave), field.index_copy(0, bent, turned)


def _refract_at_faces(
    solids: DielectricSolids,
    interfaces: plane_waves.SmoothInterfaces,
    wave_number: float,
    patches: IlluminatedPatches,
    field: Tensor,
    rows: Tensor,
) -> InterfaceCoefficients:
    """Reflected (without roughness) and transmitted fields at faces of solids, of some rows."""
    n, wave, medium = patches.normal[rows], patches.wave_vector[rows], patches.medium[rows]
    behind = solids.permittivity_in(solids.medium_behind(patches.facet[rows], medium))
    found = apply_fresnel(solids.permittivity_in(medium), behind, n, wave, field[rows])
    height_phase = -dot(wave, n) - normal_component(behind, wave, n)
    attenuation = roughness_attenuation(interfaces.rows(rows), wave_number, height_phase.real)
    return found._replace(transmitted=found.transmitted * attenuation[:, None, None])
