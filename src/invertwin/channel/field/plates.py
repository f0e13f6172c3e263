"""Flat plates: waves that several edges of one plate diffract, one after another.

An edge sends a wave along the plate, strongest where H lies along the edge. It meets another edge
head on and is diffracted again. Both sides of the plate carry it with opposite sign, so the half of
a grazing wave that counts as incident counts twice.

Source: derivations §14; Ross, "Radar cross section of rectangular flat plates as a function of
aspect angle", IEEE TAP 14, 1966.
"""

import math
from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel.field.waves import cross, dot, parallelogram_integral
from invertwin.channel.field.wedges import LEAST_ANGLE, Wedges

_SAMPLES = 48  # of the last edge
_FLAT = 1e-6

Lit = Callable[[Tensor, Tensor], Tensor]
"""Points and unit vectors from them → whether nothing is in the way."""


def several_diffractions(
    wedges: Wedges,
    plates: list[list[int]],
    wave_number: float,
    incident: Float64[Tensor, "row 3"],
    field: Float64[Tensor, "row 2 3"],
    towards: Float64[Tensor, "row 3"],
    most: int,
    lit: Lit,
) -> Iterator[Tensor]:
    """F of two diffractions, of three, and so on, by edges of one plate; [row, 2, 3].

    Args:
        wedges: open edges.
        plates: their numbers, plate by plate; plates are convex.
        wave_number: k [1/m].
        incident: d of each wave.
        field: E.
        towards: s, to the receiver.
        most: diffractions.
        lit: tells what the source sees of an edge.
    """
    chains = [[edge] for plate in plates for edge in plate]
    owner = {edge: plate for plate in plates for edge in plate}
    for _ in range(2, most + 1):
        chains = [[*c, edge] for c in chains for edge in owner[c[0]] if edge != c[-1]]
        total = torch.zeros(len(incident), 2, 3, dtype=torch.complex128)
        for chain in chains:
            total = total + _chain(wedges, chain, wave_number, incident, field, towards, lit)
        yield total


def plates_of(wedges: Wedges) -> list[list[int]]:
    """Open edges that bound one flat convex plate, in groups of two and more.

    Args:
        wedges: edges; those of solid bodies and creases are left out.
    """
    left = torch.nonzero(wedges.opening > 2 - _FLAT)[:, 0].tolist()
    found: list[list[int]] = []
    while left:
        plate, rest = [left[0]], left[1:]
        grown = True
        while grown:
            near = [e for e in rest if any(_joined(wedges, e, other) for other in plate)]
            plate, rest, grown = plate + near, [e for e in rest if e not in near], bool(near)
        left = rest
        if len(plate) > 1 and _convex(wedges, plate):
            found.append(plate)
    return found


def _joined(wedges: Wedges, one: int, other: int) -> bool:
    """Whether two edges share a corner and a plane."""
    ends = [torch.stack([wedges.start[e], wedges.end[e]]) for e in (one, other)]
    gap = (ends[0][:, None] - ends[1][None]).norm(dim=2).min()
    size = (ends[0][1] - ends[0][0]).norm()
    turn = cross(wedges.normals[one, 0], wedges.normals[other, 0]).norm()
    return bool(gap < _FLAT * size) and bool(turn < _FLAT)


def _convex(wedges: Wedges, plate: list[int]) -> bool:
    middles = (wedges.start[plate] + wedges.end[plate]) / 2
    inward = wedges.inwards[plate, 0]
    depth = (inward[:, None] * (middles[None] - middles[:, None])).sum(2)
    return bool((depth > -_FLAT * depth.abs().max()).all())


def _chain(
    wedges: Wedges,
    chain: list[int],
    k: float,
    incident: Tensor,
    field: Tensor,
    towards: Tensor,
    lit: Lit,
) -> Tensor:
    """F of the waves that a sequence of edges diffracts."""
    start = wedges.start[chain[-1]]
    side = wedges.end[chain[-1]] - start
    share = (torch.arange(_SAMPLES, dtype=torch.float64) + 0.5) / _SAMPLES
    count = len(incident)
    point = (start + share[:, None] * side).repeat(count, 1)  # [row · sample, 3]
    above = wedges.normals[chain[0], 0]
    # The ways along the plate, and what each edge makes of the field.
    ways, wave = [], incident
    amplitude = torch.ones(count, 2, dtype=torch.complex128)
    for number, edge in enumerate(chain[:-1]):
        inward = wedges.inwards[edge, 0]
        along = cross(inward, above).expand_as(wave)
        cosine = dot(wave, along)
        sine = (1 - cosine**2).clamp_min(1e-12).sqrt()
        if number:
            electric = above.expand_as(wave)[:, None]
            magnetic = dot(cross(wave[:, None], electric), along[:, None])
            azimuth = torch.zeros_like(cosine)
        else:
            magnetic = dot(cross(wave[:, None], field), along[:, None])
            azimuth = torch.atan2(-dot(wave, above), -dot(wave, inward)) % (2 * math.pi)
        # The hard half plane at φ = 0: both terms are 1/cos(φ′/2).
        constant = torch.tensor(-1j * math.pi / 4, dtype=torch.complex128).exp()
        spread = -constant / math.sqrt(2 * math.pi * k) / (sine * torch.cos(azimuth / 2))
        wave = cosine[:, None] * along + sine[:, None] * inward
        turned = dot(cross(wave, above.expand_as(wave)), along)
        amplitude = amplitude * magnetic * (spread / turned)[:, None]
        # Near the edge's own direction or the plate's plane the coefficient is not valid.
        valid = sine > math.sin(LEAST_ANGLE)
        if not number:
            valid &= dot(incident, above).abs() > math.sin(LEAST_ANGLE)
        amplitude = amplitude * valid[:, None]
        ways.append(wave)
    # From the last edge back to where each ray left the edges before.
    at, path = point, torch.zeros(len(point), dtype=torch.float64)
    weight = torch.ones(len(point), dtype=torch.float64)
    for edge, way in zip(chain[-2::-1], ways[::-1], strict=True):
        origin, inward = wedges.start[edge], wedges.inwards[edge, 0]
        sideways = wedges.end[edge] - origin
        v = way.repeat_interleave(_SAMPLES, 0)
        length = dot(at - origin, inward.expand_as(at)) / dot(v, inward.expand_as(v))
        at = at - length[:, None] * v
        place = dot(at - origin, sideways.expand_as(at)) / dot(sideways, sideways)
        hit = (length > _FLAT * side.norm()) & (place >= 0) & (place <= 1)
        safe = torch.where(hit, length, torch.ones_like(length))
        weight = weight * hit / safe.sqrt()
        path = path + safe
    d = incident.repeat_interleave(_SAMPLES, 0)
    used = torch.nonzero(weight > 0)[:, 0]
    used = used[lit(at[used], -d[used])]
    if not len(used):
        return torch.zeros(count, 2, 3, dtype=torch.complex128)
    row = used // _SAMPLES
    edge, s, wave = chain[-1], towards[row], ways[-1][row]
    inward = wedges.inwards[edge, 0]
    along = cross(inward, above).expand_as(s)
    magnetic = dot(cross(wave, above.expand_as(wave)), along)
    azimuth = torch.atan2(dot(s, above), dot(s, inward)) % (2 * math.pi)
    sines = [(1 - dot(along, v) ** 2).clamp_min(1e-12).sqrt() for v in (wave, s)]
    strength = magnetic / (2 * math.pi * sines[0] * sines[1] * torch.cos(azimuth / 2))
    sent = strength[:, None, None] * cross(s, along)[:, None]
    piece = (side / _SAMPLES).expand_as(s)
    width = parallelogram_integral(k * (s - wave), piece, torch.zeros_like(piece))
    turn = k * (dot(s, point[used]) - dot(d[used], at[used]) - path[used])
    scale = torch.polar(weight[used] * width * piece.norm(dim=1), turn)
    sent = sent * amplitude[row][..., None] * scale[:, None, None]
    valid = dot(s, above).abs() > math.sin(LEAST_ANGLE)
    for sine in sines:
        valid &= sine > math.sin(LEAST_ANGLE)
    sent = torch.where(valid[:, None, None], sent, torch.zeros_like(sent))
    return torch.zeros(count, 2, 3, dtype=torch.complex128).index_add(0, row, sent)
