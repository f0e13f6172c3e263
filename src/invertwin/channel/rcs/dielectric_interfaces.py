"""What waves do at the faces of solids, from outside and from within.

The field is E exp(−jk(K·x + c)) with K·K = ε and ηH = K × E. What a closed body scatters is sent by
the tangential fields on the outer side of its faces alone, as if in air.
"""

from typing import NamedTuple

import torch
from jaxtyping import Complex128
from torch import Tensor

from invertwin.channel.beams.beam_tracing import Bounce
from invertwin.channel.em.dielectric_solids import Solids, normal_part
from invertwin.channel.em.plane_waves import (
    Skins,
    Vectors,
    dot,
    kept_by_heights,
    radiated,
    reflected,
    sent_by_currents,
    transverse,
)


class Passage(NamedTuple):
    """What a face makes of waves.

    Attributes:
        mirrored: field that goes back.
        passed: field that goes on.
    """

    mirrored: Complex128[Tensor, "row 2 3"]
    passed: Complex128[Tensor, "row 2 3"]


class Meeting(NamedTuple):
    """What waves do at surfaces.

    Attributes:
        sent: F per m², to a receiver outside.
        mirrored: field that goes back.
        passed: field that goes on behind the surface.
    """

    sent: Complex128[Tensor, "row 2 3"]
    mirrored: Complex128[Tensor, "row 2 3"]
    passed: Complex128[Tensor, "row 2 3"]


def passage(
    before: Complex128[Tensor, " row"],
    behind: Complex128[Tensor, " row"],
    normal: Vectors,
    wave: Tensor,
    field: Complex128[Tensor, "row 2 3"],
) -> Passage:
    """Fresnel's law for any plane wave, with total reflection, from either side.

    The parts of E and H along the face are continuous. With p = −K·n and q = √(ε₂ − K_t·K_t), the
    part of E along the face is mirrored as r E_t + g K_t (K_t·E_t), r = (p − q)/(p + q) and
    g = 2(ε₂ − ε₁)/((ε₁q + ε₂p)(p + q)). That is r_s across the plane of incidence and r_p in it,
    without a plane of incidence, which normal incidence and decaying waves do not have.

    Args:
        before: ε₁, where the wave comes from.
        behind: ε₂.
        normal: n, towards the source.
        wave: K of the incident wave.
        field: E on the face.

    Source: Balanis, Advanced Engineering Electromagnetics, §5.3.
    """
    p, q = -dot(wave, normal), normal_part(behind, wave, normal)
    n, along = normal[:, None], (wave + p[:, None] * normal)[:, None]
    both, mixed = p + q, before * q + behind * p
    tangential = field - dot(n, field)[..., None] * n
    share = dot(along, tangential)[..., None]
    r = ((p - q) / both)[:, None, None]
    g = (2 * (behind - before) / (mixed * both))[:, None, None]
    again = r * tangential + g * share * along
    # K·E = 0 of each wave gives the parts across the face.
    upright = ((before * q - behind * p) / (mixed * p))[:, None, None] * share
    through = (2 * before / mixed)[:, None, None] * share
    return Passage(again - upright * n, tangential + again + through * n)


def at_surface(
    solids: Solids,
    skins: Skins,
    wave_number: float,
    bounce: Bounce,
    field: Complex128[Tensor, "row 2 3"],
    towards: Vectors,
) -> Meeting:
    """What waves do where they meet surfaces, from outside or from within.

    From within, the outer side of a face sends by the parts of E and H along it, which are those
    of the wave and its mirrored one inside. Conductors that are met inside send nothing: no wave
    is on their other side.

    Args:
        solids: what waves enter.
        skins: of each facet.
        wave_number: k [1/m].
        bounce: waves, and the patches that they meet.
        field: E on the surface.
        towards: s, to the receiver.

    Source: derivations §13 and §14.
    """
    sent, again, passed = (torch.zeros_like(field) for _ in range(3))
    outer, metal = bounce.medium < 0, solids.conducting[bounce.facet]
    at = torch.nonzero(outer)[:, 0]
    front = (skins.rows(at), wave_number, bounce.normal[at], bounce.direction[at], field[at])
    sent = sent.index_copy(0, at, radiated(*front, towards[at]))
    again = again.index_copy(0, at, reflected(*front))
    at = torch.nonzero(~outer & metal)[:, 0]
    n = bounce.normal[at, None]
    again = again.index_copy(0, at, 2 * dot(n, field[at])[..., None] * n - field[at])
    at = torch.nonzero(outer & solids.clear[bounce.facet])[:, 0]
    passed = passed.index_copy(0, at, _at_face(solids, skins, wave_number, bounce, field, at)[1])
    at = torch.nonzero(~outer & ~metal)[:, 0]
    back, through = _at_face(solids, skins, wave_number, bounce, field, at)
    n, s, wave, rough = bounce.normal[at], towards[at], bounce.wave[at], skins.rows(at)
    out = sent_by_currents(wave_number, -n, wave, field[at], back, s)
    p = -dot(wave, n).real
    kept = [
        kept_by_heights(rough, wave_number, way)[:, None, None] for way in (p + dot(n, s), 2 * p)
    ]
    sent = sent.index_copy(0, at, transverse(out, s) * kept[0])
    return Meeting(sent, again.index_copy(0, at, back * kept[1]), passed.index_copy(0, at, through))


def _at_face(
    solids: Solids, skins: Skins, wave_number: float, bounce: Bounce, field: Tensor, at: Tensor
) -> Passage:
    """What faces of solids mirror, without roughness, and let through, of some rows."""
    n, wave, medium = bounce.normal[at], bounce.wave[at], bounce.medium[at]
    behind = solids.inside(solids.behind(bounce.facet[at], medium))
    found = passage(solids.inside(medium), behind, n, wave, field[at])
    changed = -dot(wave, n) - normal_part(behind, wave, n)
    kept = kept_by_heights(skins.rows(at), wave_number, changed.real)
    return found._replace(passed=found.passed * kept[:, None, None])
