"""Dielectric solids: media, wave vectors and refraction (Snell's law) at their faces.

Convention exp(+jωt). A wave has the field E exp(−jk(K·x + c)) with K·K = ε, complex where it
decays, and propagates along the real part of K.
"""

import cmath
import math
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor

from invertwin.channel.em.plane_waves import SmoothInterfaces, Vectors, cross, dot
from invertwin.checks import is_differentiated
from invertwin.errors import InputError, PhysicsWarning

_FacetOwners = Int64[Tensor, " facet"]
MIN_CHORD_AMPLITUDE = 1e-4
"""Amplitude after the mean chord 4V/A of a body, below which no path is traced inside."""
AIR = -1
"""Number of the medium outside of all bodies."""
_MAX_OPENING = 1 / 3  # of the surface of a mesh that was meant to be closed


@dataclass(frozen=True)
class DielectricSolids:
    """Dielectric bodies with transmitted waves, at frequencies of equal permittivity.

    Attributes:
        owner: object number of each facet.
        transparent: mask of facets of bodies that transmit.
        conducting: mask of facets of conductors.
        permittivity: complex relative permittivity inside each object; 1 where nothing is
            transmitted.
        wave_number: smallest k of the frequencies [1/m], at which attenuation is least.
        names: object names, [object].
    """

    owner: _FacetOwners
    transparent: Bool[Tensor, " facet"]
    conducting: Bool[Tensor, " facet"]
    permittivity: Complex128[Tensor, " object"]
    wave_number: float
    names: Sequence[str]

    def permittivity_in(self, medium: Int64[Tensor, " row"]) -> Complex128[Tensor, " row"]:
        """Return the permittivity ε of media.

        Args:
            medium: object number of the body around the wave; −1 = air.
        """
        found = self.permittivity[medium.clamp_min(0)]
        return torch.where(medium < 0, torch.ones_like(found), found)

    def medium_behind(self, facet: Tensor, medium: Tensor) -> Int64[Tensor, " row"]:
        """Return the medium on the other side of faces of solids.

        Args:
            facet: facet numbers, [row].
            medium: medium of the incident wave, [row].
        """
        return torch.where(medium < 0, self.owner[facet], AIR)

    def require_gaps(self, facet: Int64[Tensor, " row"], medium: Int64[Tensor, " row"]) -> None:
        """Raise an error for dielectrics inside or against a solid, which is not supported.

        Args:
            facet: facet numbers.
            medium: medium of the incident wave.

        Raises:
            InputError: a dielectric within another one, or in contact with it.
        """
        owner = self.owner[facet]
        wrong = (medium >= 0) & (owner != medium) & ~self.conducting[facet]
        if bool(wrong.any()):
            row = int(wrong.nonzero()[0])
            outer, inner = self.names[int(medium[row])], self.names[int(owner[row])]
            raise InputError(
                f"expected air or conductors inside and against {outer}, got the dielectric "
                f"{inner}; leave a gap between them, or make {outer} lossy or an open mesh, of "
                "which only the front face reflects"
            )


def group_solids(
    interfaces: Sequence[SmoothInterfaces],
    wave_numbers: Sequence[float],
    corners: Float64[Tensor, "facet 3 3"],
    closed: Bool[Tensor, " facet"],
    owner: _FacetOwners,
    names: Sequence[str],
) -> list[tuple[DielectricSolids | None, list[int]]]:
    """Group frequencies with equal refraction, each with its dielectric solids.

    A body transmits if it is closed and homogeneous, and if more than `MIN_CHORD_AMPLITUDE` of a
    wave is left after its mean chord 4V/A.

    Args:
        interfaces: smooth interfaces of the facets, one table per frequency.
        wave_numbers: wave number k per frequency [1/m].
        corners: corners of the facets in world axes [m].
        closed: mask of facets of closed bodies.
        owner: object number of each facet.
        names: object names, [object].
    """
    bodies = [torch.nonzero(owner == number)[:, 0] for number in range(len(names))]
    for own, name in zip(bodies, names, strict=True):
        if not closed[own].all() and not _is_opaque(interfaces[0].rows(own)):
            _warn_openings(corners.detach()[own], name)
    chords = [_mean_chord(corners.detach()[own]) for own in bodies]
    groups: dict[tuple[object, ...], list[int]] = {}
    for f, (skin, k) in enumerate(zip(interfaces, wave_numbers, strict=True)):
        # Equal values of two frequencies may have derivatives that differ.
        key: list[object] = [f if is_differentiated(skin.permittivity) else None]
        for own, chord in zip(bodies, chords, strict=True):
            rows = skin.rows(own)
            transmits = bool(closed[own].all()) and is_homogeneous(rows) and not _is_opaque(rows)
            epsilon = complex(skin.permittivity[own[0]].detach())
            amplitude = math.exp(k * chord * cmath.sqrt(epsilon).imag)
            key.append(epsilon if transmits and amplitude > MIN_CHORD_AMPLITUDE else None)
        groups.setdefault(tuple(key), []).append(f)
    groups_found: list[tuple[DielectricSolids | None, list[int]]] = []
    for alike, members in groups.items():
        transmits = torch.tensor([value is not None for value in alike[1:]])
        if not bool(transmits.any()):
            groups_found.append((None, members))
            continue
        skin = interfaces[members[0]]
        permittivities = torch.stack([skin.permittivity[own[0]] for own in bodies])
        epsilon = torch.where(transmits, permittivities, torch.ones_like(permittivities))
        least = min(wave_numbers[f] for f in members)
        solids = DielectricSolids(owner, transmits[owner], skin.conducting, epsilon, least, names)
        groups_found.append((solids, members))
    return groups_found


def require_whole_solids(
    interfaces: SmoothInterfaces, panels: Collection[int], owner: _FacetOwners, names: Sequence[str]
) -> None:
    """Raise if dielectric objects close a body only together.

    Args:
        interfaces: smooth interfaces of the facets.
        panels: numbers of open objects that others close.
        owner: object number of each facet.
        names: object names, [object].

    Raises:
        InputError: such an object whose material is a dielectric body.
    """
    found = [names[n] for n in sorted(panels) if not _is_opaque(interfaces.rows(owner == n))]
    if found:
        raise InputError(
            f"expected each dielectric body as one object, got {', '.join(found)}, which close one "
            "together; join their meshes with merge_meshes"
        )


def is_homogeneous(interfaces: SmoothInterfaces) -> bool:
    """Return True if a surface has one permittivity; conductors and sheets count as such.

    Args:
        interfaces: smooth interfaces of its facets.
    """
    epsilon = interfaces.permittivity.detach()
    return _is_opaque(interfaces) or bool((epsilon == epsilon[0]).all())


def _is_opaque(interfaces: SmoothInterfaces) -> bool:
    """Return True if there is no dielectric body behind a surface."""
    return bool((interfaces.conducting | torch.isfinite(interfaces.thickness)).any())


def _warn_openings(corners: Tensor, name: str) -> None:
    """Warn of an open mesh whose openings are small: a solid with a hole is no half space."""
    areas = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total, flat = float(areas.norm(dim=1).sum()), 1e-3 * float(areas.norm())
    is_body = float(torch.linalg.svdvals(areas)[-1]) > flat  # unlike plates, however they are wound
    if is_body and float(areas.sum(0).norm()) < _MAX_OPENING * total:
        warnings.warn(
            f"the mesh of {name} is open, though it almost closes a body: of the dielectric only "
            "its front faces reflect; close the mesh if it is a solid (Mesh.summary counts its "
            "open edges)",
            PhysicsWarning,
            stacklevel=2,
        )


def _mean_chord(corners: Tensor) -> float:
    """Mean chord 4V/A of a closed mesh [m]."""
    a, b, c = (corners - corners[:1, :1]).unbind(1)
    volume = dot(a, cross(b, c)).sum() / 6
    area = cross(b - a, c - a).norm(dim=1).sum() / 2
    return float(4 * volume.abs() / area) if float(area) > 0 else 0.0


def normal_component(
    permittivity: Complex128[Tensor, " row"], wave_vector: Tensor, normal: Vectors
) -> Complex128[Tensor, " row"]:
    """Normal component of K behind a face: q = √(ε − K_t·K_t), K_t the tangential part.

    For evanescent waves, q = −j|q|.

    Args:
        permittivity: relative permittivity ε behind the face.
        wave_vector: K over k, [row, 3].
        normal: unit normal of the face.
    """
    tangential = wave_vector - dot(wave_vector, normal)[:, None] * normal
    square = permittivity - dot(tangential, tangential)
    root = torch.sqrt(square)
    return torch.where((square.detach().real < 0) & (root.detach().imag > 0), -root, root)


def refract_waves(
    permittivity: Complex128[Tensor, " row"], wave_vector: Tensor, normal: Vectors
) -> tuple[Complex128[Tensor, "row 3"], Bool[Tensor, " row"]]:
    """Refract wave vectors by Snell's law; the mask is False for evanescent waves.

    Args:
        permittivity: relative permittivity ε behind the face.
        wave_vector: K over k before the face, [row, 3].
        normal: unit normal towards the source.
    """
    root = normal_component(permittivity, wave_vector, normal)
    refracted = wave_vector - (dot(wave_vector, normal) + root)[:, None] * normal
    return refracted, root.detach().real > root.detach().imag.abs()
