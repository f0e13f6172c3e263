"""What a wedge does to a wave that meets its edge: the uniform theory of diffraction, as dyads.

The field beyond an edge is that of geometric optics, switched hard at its shadow and reflection
boundaries, plus what the edge sends: E(s) = A exp(−jks) D·E(Q). D jumps at every boundary by as
much as geometric optics does, with the other sign, so that the sum is smooth; no boundary term is
left over for derivatives. Convention exp(+jωt).

Source: derivations §9; Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction for an
edge in a perfectly conducting surface", Proc. IEEE 62, 1974; Luebbers, IEEE TAP 32, 1984.

Differs from the source: each of the four cotangents and its transition function are one function
that is finite on its boundary, and of an edge with ends. Faces that are no conductors reflect by
dyads in the basis of the mirrored direction; D is the mean of both ways, so that it is reciprocal.
The straight wave's terms of a sheet count by 1 − T.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot, mirrored, plane_of_incidence
from invertwin.channel.em.transition_functions import (
    chain_transition,
    corner_transition,
    edge_transition,
    edge_transition_slope,
    transition,
)
from invertwin.channel.em.wedges import Wedges, edge_axis
from invertwin.scene.material.fresnel import FieldCoefficients

_TURN = complex(math.sqrt(0.5), -math.sqrt(0.5))  # exp(−jπ/4)
_FLAT = 1e-6  # of an opening: both faces are those of one sheet
_UNCOUPLED = 1e-9  # couplings that count as none
_SERIES = 1e-4  # rad from a boundary, within which a quotient is its series
_SIGNS = ((-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0), (1.0, -1.0))
"""By term: φ − φ′ or φ + φ′, and the sign of π beside it. The third is the face n, the last 0."""

Order = Literal["value", "in", "out"]
"""The coefficient, or its derivative by the azimuth of incidence or of departure [1/rad]."""


Faces = Callable[[int, Float64[Tensor, " row"]], FieldCoefficients]
"""Coefficients of the faces 0 and 1 (n) of some wedges, at cosines of the angle of incidence.

Those of a sheet are about its middle, its transmission that of the straight path through air.
"""


def conductor(face: int, cosine: Float64[Tensor, " row"]) -> FieldCoefficients:
    """The faces of a perfect conductor.

    Args:
        face: 0 or 1.
        cosine: of the angle of incidence.
    """
    one = torch.ones_like(cosine).to(torch.complex128)
    return FieldCoefficients(-one, one, 0 * one, 0 * one)


@dataclass(frozen=True)
class Turn:
    """Waves that turn at edges, one row each.

    Attributes:
        wedges: whose edges they meet.
        direction: unit vectors of the waves before the edge.
        towards: after it.
        azimuth_in, azimuth: φ′ and φ about the edge from the face 0, through the exterior [rad].
        parameter: distance parameter L, of a spherical wave s s′ sin²β/(s + s′) [m].
        faces: what the wedges' faces do to waves.
        ends: by how much longer, as √phase, paths over the edge's ends are; None = no ends.
        absorbs: whether faces neither mirror nor let through, whatever they are.
    """

    wedges: Wedges
    direction: Float64[Tensor, "row 3"]
    towards: Float64[Tensor, "row 3"]
    azimuth_in: Float64[Tensor, " row"]
    azimuth: Float64[Tensor, " row"]
    parameter: Float64[Tensor, " row"]
    faces: Faces = conductor
    ends: Float64[Tensor, "row 2"] | None = None
    absorbs: bool = False

    def reversed(self) -> "Turn":
        """The same waves on their way back."""
        return replace(
            self,
            direction=-self.towards,
            towards=-self.direction,
            azimuth_in=self.azimuth,
            azimuth=self.azimuth_in,
        )

    @property
    def sine(self) -> Float64[Tensor, " row"]:
        """Of the angle β between the waves and the edge."""
        return cross(edge_axis(self.wedges), self.direction).norm(dim=1)


def diffraction_dyad(turn: Turn, wave_number: float, order: Order = "value") -> Tensor:
    """One of ``diffraction_dyads``, [row, 3, 3].

    Args:
        turn: the waves.
        wave_number: k [1/m].
        order: the dyad, or its derivative by an azimuth.
    """
    return diffraction_dyads(turn, wave_number, (order,))[0]


def diffraction_dyads(
    turn: Turn, wave_number: float, orders: Sequence[Order]
) -> Complex128[Tensor, "order row 3 3"]:
    """D of a wedge: E(s) = A exp(−jks) D·E(Q), with E in world coordinates, in √m.

    A = √(s′/(s(s + s′))) for a spherical wave. That of ``"in"``, times 1/(jk sinβ), is the slope
    dyad that acts on the derivative of E(Q) along φ′.

    Args:
        turn: the waves.
        wave_number: k [1/m].
        orders: the dyad, or its derivatives by an azimuth.
    """
    there = _one_way(turn, wave_number, orders)
    if turn.faces is conductor or turn.absorbs:
        return there
    flipped: dict[Order, Order] = {"value": "value", "in": "out", "out": "in"}
    back = _one_way(turn.reversed(), wave_number, [flipped[order] for order in orders])
    return (there + back.mT) / 2


def double_dyad(
    first: Turn, second: Turn, coupling: Float64[Tensor, " row"], wave_number: float
) -> Complex128[Tensor, "row 3 3"]:
    """Of two edges one after the other, in m: more than the product of both dyads.

    Where the second edge is in a transition region of the first, its field is no single wave. Each
    pair of cotangents then has one transition function. Of what is alike on both sides of the way
    between the edges it takes the values, of the rest the slopes.

    Args:
        first, second: the waves.
        coupling: w of ``corner_transition``; > 0 where growing azimuths of departure from the
            first edge and of incidence on the second are on the same side.
        wave_number: k [1/m].
    """
    before, after = _couplings(first, wave_number), _couplings(second, wave_number)
    # All pairs at once: [term of the first, of the second, row].
    w = before.sides[1][:, None, None] * after.sides[0][:, None] * coupling
    same, opposite = corner_transition(before.s[:, None], after.s, torch.stack([w, -w]))
    strength = before.value[:, None] * (same + opposite) * after.value
    strength = (strength + before.slope[:, None] * (same - opposite) * after.slope) / 2
    return torch.einsum("abr,brij,arjk->rik", strength, _dyads(second), _dyads(first))


def triple_dyad(
    turns: Sequence[Turn], couplings: Float64[Tensor, "row 3 3"], wave_number: float
) -> Complex128[Tensor, "row 3 3"]:
    """Of three edges one after the other, in √m³: as ``double_dyad``, of triples of cotangents.

    One of the edges is coupled to both others; the least of the three couplings is left out. There
    is none between parallel edges with another between them, nor between edges at right angles. A
    cotangent of the edge in the middle that is uneven to both sides counts by its curvature.

    Args:
        turns: the waves.
        couplings: w between edges, as in ``double_dyad``.
        wave_number: k [1/m].
    """
    found = [_couplings(turn, wave_number) for turn in turns]
    dyads = [_dyads(turn) for turn in turns]
    least = torch.stack([couplings[:, a, b].abs() for a, b in ((1, 2), (0, 2), (0, 1))])
    # Of edges that are all alike, either way takes the same one.
    reach = torch.stack([turn.parameter for turn in turns])
    least = torch.where(least > _UNCOUPLED, least, -reach).argmin(0)
    total = torch.zeros(len(couplings), 3, 3, dtype=torch.complex128)
    # The middle of the chain is the edge that takes no part in the least coupling.
    for center, (first, second, third) in enumerate(("cab", "acb", "abc")):
        rows = torch.nonzero(least == center)[:, 0]
        if not len(rows):
            continue
        others = [edge for edge in range(3) if edge != center]
        middle, *outer = (found[edge].rows(rows) for edge in (center, *others))
        parts = chain_transition(
            middle.s.abs(),
            [edge.s.abs() for edge in outer],
            [couplings[rows, center, other] for other in others],
        )
        strength = torch.zeros(parts.shape[2:], dtype=torch.complex128)
        for odd in itertools.product((0, 1), (0, 1)):
            weights = [middle.strength(sum(odd))]
            for other, edge, uneven in zip(others, outer, odd, strict=True):
                weights.append(edge.strength(uneven))
                if uneven:
                    weights[0] = weights[0] * middle.sides[int(other > center), :, None]
                    weights[-1] = weights[-1] * edge.sides[int(other < center), :, None]
            strength = strength + parts[odd] * torch.einsum("cr,ar,br->cabr", *weights)
        some = [dyad[:, rows] for dyad in dyads]
        chain = f"cabr,{third}rij,{second}rjk,{first}rkl->ril"
        total = total.index_add(0, rows, torch.einsum(chain, strength, *reversed(some)))
    return total


class _Couplings(NamedTuple):
    """Cotangents that meet those of other edges.

    Attributes:
        value, slope, curve: strengths of 1/s, and by the root of −1/s² and 2/s³ in derivatives.
        s: of ``transition``.
        sides: 1 where s falls with the azimuth of incidence or of departure.
    """

    value: Complex128[Tensor, "term row"]
    slope: Complex128[Tensor, "term row"]
    curve: Complex128[Tensor, "term row"]
    s: Float64[Tensor, "term row"]
    sides: Float64[Tensor, "2 term"]

    def rows(self, index: Tensor) -> "_Couplings":
        """Some rows."""
        value, slope, curve, s = (column[:, index] for column in self[:4])
        return _Couplings(value, slope, curve, s, self.sides)

    def strength(self, order: int) -> Tensor:
        """Of a derivative, for |s|: of −s, a function of both has the other sign, and −w."""
        strength = (self.value, self.slope, self.curve)[order]
        return strength if order % 2 else torch.where(self.s < 0, -strength, strength)


def _couplings(turn: Turn, wave_number: float) -> _Couplings:
    opening, root = turn.wedges.opening, torch.sqrt(2 * wave_number * turn.parameter)
    scale = -_scale(turn, wave_number) * root
    found = []
    for other, sign in _signs(turn):
        half = _past(turn, other, sign)
        near = half.abs() < _SERIES
        safe = torch.where(near, torch.full_like(half, _SERIES), half)
        ratio = torch.where(near, opening, torch.sin(safe) / torch.sin(safe / opening))
        bent = torch.cos(half / opening)
        s = root * torch.sin(half)
        seen = scale * (edge_transition(s, turn.ends) / transition(s))
        curve = seen * ratio**3 * bent / opening**2
        found.append((seen * _quotient(half, opening), seen * ratio**2 / opening, curve, s))
    value, slope, curve, s = (torch.stack(column) for column in zip(*found, strict=True))
    sides = torch.tensor([[sign * other, sign] for other, sign in _signs(turn)]).double().T
    return _Couplings(value, slope, curve, s, sides)


def _one_way(turn: Turn, wave_number: float, orders: Sequence[Order]) -> Tensor:
    weights = _terms(turn, wave_number, orders)[..., None, None]
    straight, _, *mirrors = _one_way_dyads(turn)
    total = (weights[0] + weights[1]) * straight
    for weight, mirror in zip(weights[2:], mirrors, strict=True):
        total = total + weight * mirror
    return total


def _dyads(turn: Turn) -> Complex128[Tensor, "term row 3 3"]:
    """What the terms multiply, the same on the way back."""
    there = torch.stack(torch.broadcast_tensors(*_one_way_dyads(turn)))
    if turn.faces is conductor or turn.absorbs:
        return there
    back = torch.stack(torch.broadcast_tensors(*_one_way_dyads(turn.reversed())))
    return (there + back.mT) / 2


def _one_way_dyads(turn: Turn) -> list[Complex128[Tensor, "row 3 3"]]:
    if turn.absorbs:
        along = edge_axis(turn.wedges)
        bases = _basis(along, turn.towards), _basis(along, turn.direction)
        return [_turned(*bases, torch.eye(3, dtype=torch.complex128))] * 2
    straight, *mirrors = _carried(turn)
    return [straight, straight, *mirrors]


def _signs(turn: Turn) -> tuple[tuple[float, float], ...]:
    return _SIGNS[:2] if turn.absorbs else _SIGNS


def _scale(turn: Turn, wave_number: float) -> Tensor:
    return -_TURN / (2 * turn.wedges.opening * math.sqrt(2 * math.pi * wave_number) * turn.sine)


def _terms(
    turn: Turn, wave_number: float, orders: Sequence[Order]
) -> Complex128[Tensor, "term order row"]:
    """The four scalar coefficients, or their derivatives."""
    scale = _scale(turn, wave_number)
    root = torch.sqrt(2 * wave_number * turn.parameter)
    found = []
    for other, sign in _signs(turn):
        value, slope = _cotangent(turn, other, sign, root, list(orders) != ["value"])
        each: dict[Order, Tensor] = {"value": value, "in": other * slope, "out": slope}
        found.append(torch.stack([scale * each[order] for order in orders]))
    return torch.stack(found)


def _past(turn: Turn, other: float, sign: float) -> Tensor:
    """Half the angle δ past a boundary of β = φ ± φ′."""
    beta, full = turn.azimuth + other * turn.azimuth_in, 2 * math.pi * turn.wedges.opening
    turns = torch.round((beta + sign * math.pi) / full).detach()
    return (sign * (full * turns - beta) - math.pi) / 2


def _quotient(half: Tensor, opening: Tensor) -> Tensor:
    """sin(δ/2)/tan(δ/2n)."""
    near = half.abs() < _SERIES
    safe = torch.where(near, torch.full_like(half, _SERIES), half)
    bend = opening * (1 / 6 + 1 / (3 * opening**2))
    return torch.where(near, opening - bend * half**2, torch.sin(safe) / torch.tan(safe / opening))


def _cotangent(
    turn: Turn, other: float, sign: float, root: Tensor, sloped: bool
) -> tuple[Tensor, Tensor]:
    """cot((π ± β)/2n) F(kLa) in one, and its derivative by β where it is asked for.

    With δ the angle past the boundary, it is −[sin(δ/2)/tan(δ/2n)] √(2kL) g(√(2kL) sin(δ/2)).
    """
    opening, half = turn.wedges.opening, _past(turn, other, sign)
    quotient = _quotient(half, opening)
    s = root * torch.sin(half)
    sent = edge_transition(s, turn.ends)
    value = -quotient * root * sent
    if not sloped:
        return value, value
    near = half.abs() < _SERIES
    safe = torch.where(near, torch.full_like(half, _SERIES), half)
    sine, tangent = torch.sin(safe), torch.tan(safe / opening)
    bend = opening * (1 / 6 + 1 / (3 * opening**2))
    past = torch.cos(safe) / tangent - sine / (opening * torch.sin(safe / opening) ** 2)
    past = torch.where(near, -2 * bend * half, past)
    by_s = edge_transition_slope(s, turn.ends, sent)
    by_half = -root * (past * sent + quotient * by_s * root * torch.cos(half))
    return value, by_half * (-sign / 2)


def _basis(along: Tensor, direction: Tensor) -> Float64[Tensor, "row 2 3"]:
    """β̂ and φ̂ of waves that leave an edge."""
    across = normalize(cross(along, direction), dim=-1)
    return torch.stack([cross(across, direction), across], 1)


def _carried(turn: Turn) -> list[Complex128[Tensor, "row 3 3"]]:
    """What becomes of the field: less what passes straight on, reflected by the faces n and 0.

    Each is the field of geometric optics, turned from its own direction about the edge.
    """
    along, direction = edge_axis(turn.wedges), turn.direction
    leaving = _basis(along, turn.towards)
    lost = torch.eye(3, dtype=torch.complex128) - _passed(turn)
    found = [_turned(leaving, _basis(along, direction), lost)]
    for face in (1, 0):
        normal = turn.wedges.normals[:, face]
        across, before, after = (v[:, 0] for v in plane_of_incidence(normal, direction))
        law = turn.faces(face, dot(normal, direction).abs())
        mirror = _outer(law.reflection_s, across, across) + _outer(law.reflection_p, after, before)
        onwards = mirrored(direction, normal)
        found.append(_turned(leaving, _basis(along, onwards), mirror))
    return found


def _outer(strength: Tensor, left: Tensor, right: Tensor) -> Complex128[Tensor, "row 3 3"]:
    return strength[:, None, None] * (left[:, :, None] * right[:, None])


def _turned(leaving: Tensor, arriving: Tensor, law: Tensor) -> Complex128[Tensor, "row 3 3"]:
    """A dyad whose fields are turned about the edge, from the arriving to the leaving basis."""
    return (leaving.mT @ arriving).to(torch.complex128) @ law


def _passed(turn: Turn) -> Complex128[Tensor, "row 3 3"]:
    """The dyad of the shadow: zero behind bodies; one sheet at its end, two at a crease."""
    flat = (turn.wedges.opening > 2 - _FLAT)[:, None, None]
    total = torch.eye(3, dtype=torch.complex128)
    for face in (0, 1):
        normal = turn.wedges.normals[:, face]
        across, before, _ = (v[:, 0] for v in plane_of_incidence(normal, turn.direction))
        law = turn.faces(face, dot(normal, turn.direction).abs())
        through = _outer(law.transmission_s, across, across)
        through = through + _outer(law.transmission_p, before, before)
        total = through if face == 0 else torch.where(flat, total, through @ total)
    return total
