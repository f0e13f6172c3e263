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

from invertwin.channel.em.plane_waves import cross, dot, plane_of_incidence, reflect_vectors
from invertwin.channel.em.transition_functions import (
    chain_transition,
    corner_transition,
    edge_transition,
    edge_transition_slope,
    transition,
)
from invertwin.channel.em.wedges import Wedges, edge_axis
from invertwin.scene.material.fresnel import FieldCoefficients

_EXP_MINUS_J_PI_4 = complex(math.sqrt(0.5), -math.sqrt(0.5))  # exp(−jπ/4)
_SHEET_TOLERANCE = 1e-6  # of an opening: both faces are those of one sheet
_MIN_COUPLING = 1e-9  # couplings that count as none
_SERIES_ANGLE = 1e-4  # rad from a boundary, within which a quotient is its series
_TERM_SIGNS = ((-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0), (1.0, -1.0))
"""By term: φ − φ′ or φ + φ′, and the sign of π beside it. The third is the face n, the last 0."""

DyadDerivative = Literal["value", "in", "out"]
"""The coefficient, or its derivative by the azimuth of incidence or of departure [1/rad]."""


FaceCoefficients = Callable[[int, Float64[Tensor, " row"]], FieldCoefficients]
"""Coefficients of the faces 0 and 1 (n) of some wedges, at cosines of the angle of incidence.

Those of a sheet are about its middle, its transmission that of the straight path through air.
"""


def conductor_coefficients(face: int, cosine: Float64[Tensor, " row"]) -> FieldCoefficients:
    """The faces of a perfect conductor.

    Args:
        face: 0 or 1.
        cosine: of the angle of incidence.
    """
    one = torch.ones_like(cosine).to(torch.complex128)
    return FieldCoefficients(-one, one, 0 * one, 0 * one)


@dataclass(frozen=True)
class EdgeDiffraction:
    """Waves that turn at edges, one row each.

    Attributes:
        wedges: whose edges they meet.
        incident_direction: unit vectors of the waves before the edge.
        diffracted_direction: after it.
        azimuth_in, azimuth: φ′ and φ about the edge from the face 0, through the exterior [rad].
        distance_parameter: distance parameter L, of a spherical wave s s′ sin²β/(s + s′) [m].
        face_coefficients: what the wedges' faces do to waves.
        end_parameters: by how much longer, as √phase, paths over the edge's ends are; None = no
            ends.
        absorbing: whether faces neither mirror nor let through, whatever they are.
    """

    wedges: Wedges
    incident_direction: Float64[Tensor, "row 3"]
    diffracted_direction: Float64[Tensor, "row 3"]
    azimuth_in: Float64[Tensor, " row"]
    azimuth: Float64[Tensor, " row"]
    distance_parameter: Float64[Tensor, " row"]
    face_coefficients: FaceCoefficients = conductor_coefficients
    end_parameters: Float64[Tensor, "row 2"] | None = None
    absorbing: bool = False

    def reverse(self) -> "EdgeDiffraction":
        """The same waves on their way back."""
        return replace(
            self,
            incident_direction=-self.diffracted_direction,
            diffracted_direction=-self.incident_direction,
            azimuth_in=self.azimuth,
            azimuth=self.azimuth_in,
        )

    @property
    def sin_beta(self) -> Float64[Tensor, " row"]:
        """Of the angle β between the waves and the edge."""
        return cross(edge_axis(self.wedges), self.incident_direction).norm(dim=1)


def diffraction_dyad(
    diffraction: EdgeDiffraction, wave_number: float, order: DyadDerivative = "value"
) -> Tensor:
    """One of ``diffraction_dyads``, [row, 3, 3].

    Args:
        diffraction: the waves.
        wave_number: k [1/m].
        order: the dyad, or its derivative by an azimuth.
    """
    return diffraction_dyads(diffraction, wave_number, (order,))[0]


def diffraction_dyads(
    diffraction: EdgeDiffraction, wave_number: float, orders: Sequence[DyadDerivative]
) -> Complex128[Tensor, "order row 3 3"]:
    """D of a wedge: E(s) = A exp(−jks) D·E(Q), with E in world coordinates, in √m.

    A = √(s′/(s(s + s′))) for a spherical wave. That of ``"in"``, times 1/(jk sinβ), is the slope
    dyad that acts on the derivative of E(Q) along φ′.

    Args:
        diffraction: the waves.
        wave_number: k [1/m].
        orders: the dyad, or its derivatives by an azimuth.
    """
    there = _directional_dyads(diffraction, wave_number, orders)
    if diffraction.face_coefficients is conductor_coefficients or diffraction.absorbing:
        return there
    flipped: dict[DyadDerivative, DyadDerivative] = {"value": "value", "in": "out", "out": "in"}
    back = _directional_dyads(
        diffraction.reverse(), wave_number, [flipped[order] for order in orders]
    )
    return (there + back.mT) / 2


def double_dyad(
    first: EdgeDiffraction,
    second: EdgeDiffraction,
    coupling: Float64[Tensor, " row"],
    wave_number: float,
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
    before, after = _couple_cotangents(first, wave_number), _couple_cotangents(second, wave_number)
    # All pairs at once: [term of the first, of the second, row].
    w = before.sides[1][:, None, None] * after.sides[0][:, None] * coupling
    same, opposite = corner_transition(before.s[:, None], after.s, torch.stack([w, -w]))
    strength = before.value[:, None] * (same + opposite) * after.value
    strength = (strength + before.slope[:, None] * (same - opposite) * after.slope) / 2
    return torch.einsum("abr,brij,arjk->rik", strength, _term_dyads(second), _term_dyads(first))


def triple_dyad(
    diffractions: Sequence[EdgeDiffraction],
    couplings: Float64[Tensor, "row 3 3"],
    wave_number: float,
) -> Complex128[Tensor, "row 3 3"]:
    """Of three edges one after the other, in √m³: as ``double_dyad``, of triples of cotangents.

    One of the edges is coupled to both others; the least of the three couplings is left out. There
    is none between parallel edges with another between them, nor between edges at right angles. A
    cotangent of the edge in the middle that is uneven to both sides counts by its curvature.

    Args:
        diffractions: the waves.
        couplings: w between edges, as in ``double_dyad``.
        wave_number: k [1/m].
    """
    found = [_couple_cotangents(turn, wave_number) for turn in diffractions]
    dyads = [_term_dyads(turn) for turn in diffractions]
    least = torch.stack([couplings[:, a, b].abs() for a, b in ((1, 2), (0, 2), (0, 1))])
    # Of edges that are all alike, either way takes the same one.
    reach = torch.stack([turn.distance_parameter for turn in diffractions])
    least = torch.where(least > _MIN_COUPLING, least, -reach).argmin(0)
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


class _CoupledCotangents(NamedTuple):
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

    def rows(self, index: Tensor) -> "_CoupledCotangents":
        """Some rows."""
        value, slope, curve, s = (column[:, index] for column in self[:4])
        return _CoupledCotangents(value, slope, curve, s, self.sides)

    def strength(self, order: int) -> Tensor:
        """Of a derivative, for |s|: of −s, a function of both has the other sign, and −w."""
        strength = (self.value, self.slope, self.curve)[order]
        return strength if order % 2 else torch.where(self.s < 0, -strength, strength)


def _couple_cotangents(diffraction: EdgeDiffraction, wave_number: float) -> _CoupledCotangents:
    opening, root = (
        diffraction.wedges.opening,
        torch.sqrt(2 * wave_number * diffraction.distance_parameter),
    )
    scale = -_dyad_scale(diffraction, wave_number) * root
    found = []
    for other, sign in _term_signs(diffraction):
        half = _half_boundary_angle(diffraction, other, sign)
        near = half.abs() < _SERIES_ANGLE
        safe = torch.where(near, torch.full_like(half, _SERIES_ANGLE), half)
        ratio = torch.where(near, opening, torch.sin(safe) / torch.sin(safe / opening))
        bent = torch.cos(half / opening)
        s = root * torch.sin(half)
        seen = scale * (edge_transition(s, diffraction.end_parameters) / transition(s))
        curve = seen * ratio**3 * bent / opening**2
        found.append(
            (seen * _cotangent_quotient(half, opening), seen * ratio**2 / opening, curve, s)
        )
    value, slope, curve, s = (torch.stack(column) for column in zip(*found, strict=True))
    sides = (
        torch.tensor([[sign * other, sign] for other, sign in _term_signs(diffraction)]).double().T
    )
    return _CoupledCotangents(value, slope, curve, s, sides)


def _directional_dyads(
    diffraction: EdgeDiffraction, wave_number: float, orders: Sequence[DyadDerivative]
) -> Tensor:
    weights = _term_coefficients(diffraction, wave_number, orders)[..., None, None]
    straight, _, *mirrors = _directional_term_dyads(diffraction)
    total = (weights[0] + weights[1]) * straight
    for weight, mirror in zip(weights[2:], mirrors, strict=True):
        total = total + weight * mirror
    return total


def _term_dyads(diffraction: EdgeDiffraction) -> Complex128[Tensor, "term row 3 3"]:
    """What the terms multiply, the same on the way back."""
    there = torch.stack(torch.broadcast_tensors(*_directional_term_dyads(diffraction)))
    if diffraction.face_coefficients is conductor_coefficients or diffraction.absorbing:
        return there
    back = torch.stack(torch.broadcast_tensors(*_directional_term_dyads(diffraction.reverse())))
    return (there + back.mT) / 2


def _directional_term_dyads(diffraction: EdgeDiffraction) -> list[Complex128[Tensor, "row 3 3"]]:
    if diffraction.absorbing:
        along = edge_axis(diffraction.wedges)
        bases = (
            _ray_fixed_basis(along, diffraction.diffracted_direction),
            _ray_fixed_basis(along, diffraction.incident_direction),
        )
        return [_rotate_dyad(*bases, torch.eye(3, dtype=torch.complex128))] * 2
    straight, *mirrors = _geometric_optics_dyads(diffraction)
    return [straight, straight, *mirrors]


def _term_signs(diffraction: EdgeDiffraction) -> tuple[tuple[float, float], ...]:
    return _TERM_SIGNS[:2] if diffraction.absorbing else _TERM_SIGNS


def _dyad_scale(diffraction: EdgeDiffraction, wave_number: float) -> Tensor:
    return -_EXP_MINUS_J_PI_4 / (
        2 * diffraction.wedges.opening * math.sqrt(2 * math.pi * wave_number) * diffraction.sin_beta
    )


def _term_coefficients(
    diffraction: EdgeDiffraction, wave_number: float, orders: Sequence[DyadDerivative]
) -> Complex128[Tensor, "term order row"]:
    """The four scalar coefficients, or their derivatives."""
    scale = _dyad_scale(diffraction, wave_number)
    root = torch.sqrt(2 * wave_number * diffraction.distance_parameter)
    found = []
    for other, sign in _term_signs(diffraction):
        value, slope = _cotangent(diffraction, other, sign, root, list(orders) != ["value"])
        each: dict[DyadDerivative, Tensor] = {"value": value, "in": other * slope, "out": slope}
        found.append(torch.stack([scale * each[order] for order in orders]))
    return torch.stack(found)


def _half_boundary_angle(diffraction: EdgeDiffraction, azimuth_sign: float, sign: float) -> Tensor:
    """Half the angle δ past a boundary of β = φ ± φ′."""
    beta, full = (
        diffraction.azimuth + azimuth_sign * diffraction.azimuth_in,
        2 * math.pi * diffraction.wedges.opening,
    )
    turns = torch.round((beta + sign * math.pi) / full).detach()
    return (sign * (full * turns - beta) - math.pi) / 2


def _cotangent_quotient(half: Tensor, opening: Tensor) -> Tensor:
    """sin(δ/2)/tan(δ/2n)."""
    near = half.abs() < _SERIES_ANGLE
    safe = torch.where(near, torch.full_like(half, _SERIES_ANGLE), half)
    bend = opening * (1 / 6 + 1 / (3 * opening**2))
    return torch.where(near, opening - bend * half**2, torch.sin(safe) / torch.tan(safe / opening))


def _cotangent(
    diffraction: EdgeDiffraction, azimuth_sign: float, sign: float, root: Tensor, with_slope: bool
) -> tuple[Tensor, Tensor]:
    """cot((π ± β)/2n) F(kLa) in one, and its derivative by β where it is asked for.

    With δ the angle past the boundary, it is −[sin(δ/2)/tan(δ/2n)] √(2kL) g(√(2kL) sin(δ/2)).
    """
    opening, half = (
        diffraction.wedges.opening,
        _half_boundary_angle(diffraction, azimuth_sign, sign),
    )
    quotient = _cotangent_quotient(half, opening)
    s = root * torch.sin(half)
    sent = edge_transition(s, diffraction.end_parameters)
    value = -quotient * root * sent
    if not with_slope:
        return value, value
    near = half.abs() < _SERIES_ANGLE
    safe = torch.where(near, torch.full_like(half, _SERIES_ANGLE), half)
    sine, tangent = torch.sin(safe), torch.tan(safe / opening)
    bend = opening * (1 / 6 + 1 / (3 * opening**2))
    past = torch.cos(safe) / tangent - sine / (opening * torch.sin(safe / opening) ** 2)
    past = torch.where(near, -2 * bend * half, past)
    by_s = edge_transition_slope(s, diffraction.end_parameters, sent)
    by_half = -root * (past * sent + quotient * by_s * root * torch.cos(half))
    return value, by_half * (-sign / 2)


def _ray_fixed_basis(along: Tensor, direction: Tensor) -> Float64[Tensor, "row 2 3"]:
    """β̂ and φ̂ of waves that leave an edge."""
    across = normalize(cross(along, direction), dim=-1)
    return torch.stack([cross(across, direction), across], 1)


def _geometric_optics_dyads(diffraction: EdgeDiffraction) -> list[Complex128[Tensor, "row 3 3"]]:
    """What becomes of the field: less what passes straight on, reflected by the faces n and 0.

    Each is the field of geometric optics, turned from its own direction about the edge.
    """
    along, direction = edge_axis(diffraction.wedges), diffraction.incident_direction
    leaving = _ray_fixed_basis(along, diffraction.diffracted_direction)
    lost = torch.eye(3, dtype=torch.complex128) - _transmission_dyad(diffraction)
    found = [_rotate_dyad(leaving, _ray_fixed_basis(along, direction), lost)]
    for face in (1, 0):
        normal = diffraction.wedges.normals[:, face]
        across, before, after = (v[:, 0] for v in plane_of_incidence(normal, direction))
        law = diffraction.face_coefficients(face, dot(normal, direction).abs())
        mirror = _outer_product(law.reflection_s, across, across) + _outer_product(
            law.reflection_p, after, before
        )
        onwards = reflect_vectors(direction, normal)
        found.append(_rotate_dyad(leaving, _ray_fixed_basis(along, onwards), mirror))
    return found


def _outer_product(strength: Tensor, left: Tensor, right: Tensor) -> Complex128[Tensor, "row 3 3"]:
    return strength[:, None, None] * (left[:, :, None] * right[:, None])


def _rotate_dyad(leaving: Tensor, arriving: Tensor, law: Tensor) -> Complex128[Tensor, "row 3 3"]:
    """A dyad whose fields are turned about the edge, from the arriving to the leaving basis."""
    return (leaving.mT @ arriving).to(torch.complex128) @ law


def _transmission_dyad(diffraction: EdgeDiffraction) -> Complex128[Tensor, "row 3 3"]:
    """The dyad of the shadow: zero behind bodies; one sheet at its end, two at a crease."""
    flat = (diffraction.wedges.opening > 2 - _SHEET_TOLERANCE)[:, None, None]
    total = torch.eye(3, dtype=torch.complex128)
    for face in (0, 1):
        normal = diffraction.wedges.normals[:, face]
        across, before, _ = (
            v[:, 0] for v in plane_of_incidence(normal, diffraction.incident_direction)
        )
        law = diffraction.face_coefficients(face, dot(normal, diffraction.incident_direction).abs())
        through = _outer_product(law.transmission_s, across, across)
        through = through + _outer_product(law.transmission_p, before, before)
        total = through if face == 0 else torch.where(flat, total, through @ total)
    return total
