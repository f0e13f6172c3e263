"""Solids of dielectric that waves enter, and where waves go there.

Convention exp(+jωt). A wave has the field E exp(−jk(K·x + c)) with K·K = ε, complex where it
decays, and travels along the real part of K.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor

from invertwin.channel.em.plane_waves import SmoothInterfaces, Vectors, cross, dot
from invertwin.checks import is_differentiated
from invertwin.errors import InputError

MIN_CHORD_AMPLITUDE = 1e-4
"""Amplitude after the mean chord 4V/A of a body, below which nothing is followed inside."""
AIR = -1
"""The medium outside."""


@dataclass(frozen=True)
class DielectricSolids:
    """Interiors that waves enter, at frequencies of one permittivity each.

    Attributes:
        owner: number of the object that each facet belongs to.
        transparent: facets of bodies that waves enter.
        conducting: facets of conductors.
        permittivity: complex, relative, inside each object; 1 where waves do not enter.
        wave_number: the least k of the frequencies [1/m], at which most is left.
        names: of the objects.
    """

    owner: Int64[Tensor, " facet"]
    transparent: Bool[Tensor, " facet"]
    conducting: Bool[Tensor, " facet"]
    permittivity: Complex128[Tensor, " object"]
    wave_number: float
    names: Sequence[str]

    def permittivity_in(self, medium: Int64[Tensor, " row"]) -> Complex128[Tensor, " row"]:
        """ε of media.

        Args:
            medium: number of the object that waves are in; −1 = air.
        """
        found = self.permittivity[medium.clamp_min(0)]
        return torch.where(medium < 0, torch.ones_like(found), found)

    def medium_behind(self, facet: Tensor, medium: Tensor) -> Int64[Tensor, " row"]:
        """The medium on the other side of faces of solids.

        Args:
            facet: what is met.
            medium: where the waves come from.
        """
        return torch.where(medium < 0, self.owner[facet], AIR)

    def require_gaps(self, facet: Int64[Tensor, " row"], medium: Int64[Tensor, " row"]) -> None:
        """Refuse surfaces inside a solid, of which the laws here do not hold.

        Args:
            facet: what is met.
            medium: where.

        Raises:
            InputError: a dielectric within another one, or in touch with it.
        """
        owner = self.owner[facet]
        wrong = (medium >= 0) & (owner != medium) & ~self.conducting[facet]
        if bool(wrong.any()):
            row = int(wrong.nonzero()[0])
            outer, inner = self.names[int(medium[row])], self.names[int(owner[row])]
            raise InputError(
                f"expected air or conductors inside and against {outer}, got the dielectric "
                f"{inner}; leave a gap between them, or make {outer} lossy or an open mesh, which "
                "shows its front alone"
            )


def group_solids(
    interfaces: Sequence[SmoothInterfaces],
    wave_numbers: Sequence[float],
    corners: Float64[Tensor, "facet 3 3"],
    closed: Bool[Tensor, " facet"],
    owner: Int64[Tensor, " facet"],
    names: Sequence[str],
) -> list[tuple[DielectricSolids | None, list[int]]]:
    """Groups of frequencies in which waves are refracted alike, and what they enter there.

    A body is entered where it is closed, homogeneous, and leaves more than `MIN_CHORD_AMPLITUDE`
    of a wave
    along its mean chord 4V/A.

    Args:
        interfaces: of the facets, for each frequency.
        wave_numbers: k of the frequencies [1/m].
        corners: of the facets [m].
        closed: facets of closed bodies.
        owner: the object of each facet.
        names: of the objects.
    """
    bodies = [torch.nonzero(owner == number)[:, 0] for number in range(len(names))]
    chords = [_mean_chord(corners.detach()[own]) for own in bodies]
    groups: dict[tuple[object, ...], list[int]] = {}
    for f, (skin, k) in enumerate(zip(interfaces, wave_numbers, strict=True)):
        # Equal values of two frequencies may have derivatives that differ.
        key: list[object] = [f if is_differentiated(skin.permittivity) else None]
        for own, chord in zip(bodies, chords, strict=True):
            rows = skin.rows(own)
            entered = bool(closed[own].all()) and is_homogeneous(rows) and not _is_opaque(rows)
            epsilon = complex(skin.permittivity[own[0]].detach())
            left = math.exp(k * chord * cmath.sqrt(epsilon).imag)
            key.append(epsilon if entered and left > MIN_CHORD_AMPLITUDE else None)
        groups.setdefault(tuple(key), []).append(f)
    found: list[tuple[DielectricSolids | None, list[int]]] = []
    for alike, members in groups.items():
        entered = torch.tensor([value is not None for value in alike[1:]])
        if not bool(entered.any()):
            found.append((None, members))
            continue
        skin = interfaces[members[0]]
        first = torch.stack([skin.permittivity[own[0]] for own in bodies])
        epsilon = torch.where(entered, first, torch.ones_like(first))
        least = min(wave_numbers[f] for f in members)
        solids = DielectricSolids(owner, entered[owner], skin.conducting, epsilon, least, names)
        found.append((solids, members))
    return found


def is_homogeneous(interfaces: SmoothInterfaces) -> bool:
    """Whether the permittivity of a surface is one; conductors and sheets count as such.

    Args:
        interfaces: of its facets.
    """
    epsilon = interfaces.permittivity.detach()
    return _is_opaque(interfaces) or bool((epsilon == epsilon[0]).all())


def _is_opaque(interfaces: SmoothInterfaces) -> bool:
    """Whether there is no dielectric body behind a surface."""
    return bool((interfaces.conducting | torch.isfinite(interfaces.thickness)).any())


def _mean_chord(corners: Tensor) -> float:
    """4V/A [m] of a closed mesh."""
    a, b, c = (corners - corners[:1, :1]).unbind(1)
    volume = dot(a, cross(b, c)).sum() / 6
    area = cross(b - a, c - a).norm(dim=1).sum() / 2
    return float(4 * volume.abs() / area) if float(area) > 0 else 0.0


def normal_component(
    permittivity: Complex128[Tensor, " row"], wave_vector: Tensor, normal: Vectors
) -> Complex128[Tensor, " row"]:
    """q = √(ε − K_t·K_t), the part of K across a face behind it, K_t the part along the face.

    Where nothing passes but what decays from the face, q = −j|q|.

    Args:
        permittivity: ε behind the face.
        wave_vector: K.
        normal: of the face.
    """
    along = wave_vector - dot(wave_vector, normal)[:, None] * normal
    square = permittivity - dot(along, along)
    root = torch.sqrt(square)
    wrong = (square.detach().real < 0) & (root.detach().imag > 0)
    return torch.where(wrong, -root, root)


def refract_waves(
    permittivity: Complex128[Tensor, " row"], wave_vector: Tensor, normal: Vectors
) -> tuple[Complex128[Tensor, "row 3"], Bool[Tensor, " row"]]:
    """K behind a face, whose part along the face is kept (Snell), and whether it goes on at all.

    Args:
        permittivity: ε behind the face.
        wave_vector: K before it.
        normal: towards the source.
    """
    root = normal_component(permittivity, wave_vector, normal)
    passed = wave_vector - (dot(wave_vector, normal) + root)[:, None] * normal
    return passed, root.detach().real > root.detach().imag.abs()
