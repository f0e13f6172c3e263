"""Uniform theory of diffraction (UTD): dyadic diffraction coefficients of wedges.

The field beyond an edge is that of geometric optics, discontinuous at its shadow and reflection
boundaries, plus the edge-diffracted field: E(s) = A exp(−jks) D·E(Q). D jumps at every boundary by
as much as geometric optics does, with opposite sign, so that the sum is smooth and derivatives need
no boundary term. Convention exp(+jωt).

Source: derivations §9; Kouyoumjian and Pathak, "A uniform geometrical theory of diffraction for an
edge in a perfectly conducting surface", Proc. IEEE 62, 1974; Luebbers, IEEE TAP 32, 1984.

Differs from the source: each of the four cotangents and its transition function are one function
that is finite on its boundary, and holds for edges with ends. Faces that are not conductors reflect
by dyads in the basis of the reflected direction; D is averaged over both directions of propagation,
so that it is reciprocal. For a sheet, the terms of the direct wave are weighted by 1 − T.
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

from invertwin.channel.em import transition_functions as transitions
from invertwin.channel.em.plane_waves import cross, dot, plane_of_incidence, reflect_vectors
from invertwin.channel.em.wedges import Wedges, edge_axis
from invertwin.scene.material.fresnel import FieldCoefficients

_Reals = Float64[Tensor, " row"]
_SHEET_TOLERANCE = 1e-6  # of an opening: both faces belong to one sheet
_MIN_COUPLING = 1e-9  # couplings below this are neglected
_SERIES_ANGLE = 1e-4  # rad from a boundary, within which quotients are series
_TERM_SIGNS = ((-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0), (1.0, -1.0))
"""Signs by term: φ − φ′ or φ + φ′, and the sign of π. The third is for face n, the last face 0."""

DyadDerivative = Literal["value", "in", "out"]
"""Coefficient, or derivative with respect to the azimuth of incidence or diffraction [1/rad]."""


FaceCoefficients = Callable[[int, _Reals], FieldCoefficients]
"""Field coefficients of the faces 0 and 1 (n) of wedges, at cosines of the angle of incidence.

Those of a sheet refer to its mid-plane, its transmission to the straight path through air.
"""


def conductor_coefficients(face: int, cosine: _Reals) -> FieldCoefficients:
    """Field coefficients of perfectly conducting faces.

    Args:
        face: number of the face, 0 or 1.
        cosine: cosine of the angle of incidence.
    """
    one = torch.ones_like(cosine).to(torch.complex128)
    return FieldCoefficients(-one, one, 0 * one, 0 * one)


@dataclass(frozen=True)
class EdgeDiffraction:
    """Incidence and diffraction directions and angles at edges, one row each.

    Attributes:
        wedges: diffracting wedges.
        incident_direction: unit vectors of propagation before the edge.
        diffracted_direction: unit vectors of propagation after the edge.
        azimuth_in, azimuth: φ′ and φ about the edge, measured from face 0 through the exterior
            [rad].
        distance_parameter: distance parameter L [m]; for a spherical wave s s′ sin²β/(s + s′).
        face_coefficients: reflection and transmission of the wedges' faces.
        end_parameters: √phase by which paths over the edge's ends are longer; None = infinite edge.
        reflects: False for faces that do not reflect, whatever their material.
    """

    wedges: Wedges
    incident_direction: Float64[Tensor, "row 3"]
    diffracted_direction: Float64[Tensor, "row 3"]
    azimuth_in: _Reals
    azimuth: _Reals
    distance_parameter: _Reals
    face_coefficients: FaceCoefficients = conductor_coefficients
    end_parameters: Float64[Tensor, "row 2"] | None = None
    reflects: bool = True

    def reverse(self) -> "EdgeDiffraction":
        """Return the same geometry with source and receiver exchanged."""
        return replace(
            self,
            incident_direction=-self.diffracted_direction,
            diffracted_direction=-self.incident_direction,
            azimuth_in=self.azimuth,
            azimuth=self.azimuth_in,
        )

    @property
    def sin_beta(self) -> _Reals:
        """sinβ, with β the angle between the incident wave and the edge."""
        return cross(edge_axis(self.wedges), self.incident_direction).norm(dim=1)


def diffraction_dyads(
    diffraction: EdgeDiffraction, wave_number: float, orders: Sequence[DyadDerivative]
) -> Complex128[Tensor, "order row 3 3"]:
    """Diffraction dyads D of wedges: E(s) = A exp(−jks) D·E(Q), E in world axes [√m].

    A = √(s′/(s(s + s′))) for a spherical wave. The order ``"in"``, times 1/(jk sinβ), is the slope
    dyad that acts on the derivative of E(Q) along φ′.

    Args:
        diffraction: edge diffraction geometry.
        wave_number: wave number k [1/m].
        orders: the dyad, or its derivatives with respect to an azimuth.
    """
    forward = _directional_dyads(diffraction, wave_number, orders)
    if diffraction.face_coefficients is conductor_coefficients:
        return forward
    exchanged: dict[DyadDerivative, DyadDerivative] = {"value": "value", "in": "out", "out": "in"}
    others: list[DyadDerivative] = [exchanged[order] for order in orders]
    return (forward + _directional_dyads(diffraction.reverse(), wave_number, others).mT) / 2


def double_dyad(
    first: EdgeDiffraction, second: EdgeDiffraction, coupling: _Reals, wave_number: float
) -> Complex128[Tensor, "row 3 3"]:
    """Double-diffraction dyads of two consecutive edges [m].

    They are not the product of both dyads: in a transition region of the first edge, its field at
    the second is not a ray-optical wave. Each pair of cotangents therefore has one transition
    function. Its part that is even about the line between the edges multiplies the values of the
    cotangents, the odd part their slopes.

    Args:
        first, second: edge diffraction geometry at either edge.
        coupling: w of ``corner_transition``; > 0 if the azimuths of diffraction at the first edge
            and of incidence on the second grow to the same side.
        wave_number: wave number k [1/m].
    """
    before, after = _couple_cotangents(first, wave_number), _couple_cotangents(second, wave_number)
    # All pairs: [term of the first edge, term of the second, row].
    w = before.sides[1][:, None, None] * after.sides[0][:, None] * coupling
    same, opposite = transitions.corner_transition(before.s[:, None], after.s, torch.stack([w, -w]))
    strength = before.value[:, None] * (same + opposite) * after.value
    strength = (strength + before.slope[:, None] * (same - opposite) * after.slope) / 2
    return torch.einsum("abr,brij,arjk->rik", strength, _term_dyads(second), _term_dyads(first))


def triple_dyad(
    diffractions: Sequence[EdgeDiffraction],
    couplings: Float64[Tensor, "row 3 3"],
    wave_number: float,
) -> Complex128[Tensor, "row 3 3"]:
    """Triple-diffraction dyads of three consecutive edges [√m³], from triples of cotangents.

    As ``double_dyad``; one of the edges is coupled to both others, and the smallest of the three
    couplings is neglected. It is zero between parallel edges with another edge between them, and
    between edges at right angles. A cotangent of the middle edge that is odd to both sides
    contributes by its curvature.

    Args:
        diffractions: edge diffraction geometry at the three edges.
        couplings: w between pairs of edges, as in ``double_dyad``.
        wave_number: wave number k [1/m].
    """
    cotangents = [_couple_cotangents(geometry, wave_number) for geometry in diffractions]
    dyads = [_term_dyads(geometry) for geometry in diffractions]
    smallest = torch.stack([couplings[:, a, b].abs() for a, b in ((1, 2), (0, 2), (0, 1))])
    # For equal edges, both directions of propagation choose the same one.
    reach = torch.stack([geometry.distance_parameter for geometry in diffractions])
    smallest = torch.where(smallest > _MIN_COUPLING, smallest, -reach).argmin(0)
    total = torch.zeros(len(couplings), 3, 3, dtype=torch.complex128)
    # The middle of the chain is the edge without part in the smallest coupling.
    for center, (first, second, third) in enumerate(("cab", "acb", "abc")):
        rows = torch.nonzero(smallest == center)[:, 0]
        if not len(rows):
            continue
        others = [edge for edge in range(3) if edge != center]
        middle, *outer = (cotangents[edge].rows(rows) for edge in (center, *others))
        coupled = [couplings[rows, center, other] for other in others]
        sizes = [edge.s.abs() for edge in outer]
        parts = transitions.chain_transition(middle.s.abs(), sizes, coupled)
        strength = torch.zeros(parts.shape[2:], dtype=torch.complex128)
        for odd in itertools.product((0, 1), (0, 1)):
            weights = [middle.strength(sum(odd))]
            for other, edge, is_odd in zip(others, outer, odd, strict=True):
                weights.append(edge.strength(is_odd))
                if is_odd:
                    weights[0] = weights[0] * middle.sides[int(other > center), :, None]
                    weights[-1] = weights[-1] * edge.sides[int(other < center), :, None]
            strength = strength + parts[odd] * torch.einsum("cr,ar,br->cabr", *weights)
        selected = [dyad[:, rows] for dyad in dyads]
        chain = f"cabr,{third}rij,{second}rjk,{first}rkl->ril"
        total = total.index_add(0, rows, torch.einsum(chain, strength, *reversed(selected)))
    return total


class _CoupledCotangents(NamedTuple):
    """Cotangent terms of one edge, coupled to those of other edges.

    Attributes:
        value, slope, curve: strengths of 1/s, and of −1/s² and 2/s³ in derivatives with respect to
            s.
        s: argument of ``transition``.
        sides: 1 if s falls with the azimuth of incidence or of diffraction, else −1.
    """

    value: Complex128[Tensor, "term row"]
    slope: Complex128[Tensor, "term row"]
    curve: Complex128[Tensor, "term row"]
    s: Float64[Tensor, "term row"]
    sides: Float64[Tensor, "2 term"]

    def rows(self, index: Tensor) -> "_CoupledCotangents":
        """Select rows."""
        value, slope, curve, s = (column[:, index] for column in self[:4])
        return _CoupledCotangents(value, slope, curve, s, self.sides)

    def strength(self, order: int) -> Tensor:
        """Strength of a derivative as a function of |s|; odd orders keep their sign."""
        strength = (self.value, self.slope, self.curve)[order]
        return strength if order % 2 else torch.where(self.s < 0, -strength, strength)


def _couple_cotangents(diffraction: EdgeDiffraction, wave_number: float) -> _CoupledCotangents:
    opening, ends = diffraction.wedges.opening, diffraction.end_parameters
    root = torch.sqrt(2 * wave_number * diffraction.distance_parameter)
    scale = -_dyad_scale(diffraction, wave_number) * root
    columns = []
    for other, sign in _term_signs(diffraction):
        half = _half_boundary_angle(diffraction, other, sign)
        is_near = half.abs() < _SERIES_ANGLE
        safe = torch.where(is_near, torch.full_like(half, _SERIES_ANGLE), half)
        ratio = torch.where(is_near, opening, torch.sin(safe) / torch.sin(safe / opening))
        cosine = torch.cos(half / opening)
        s = root * torch.sin(half)
        factor = scale * transitions.edge_transition(s, ends) / transitions.transition(s)
        curve = factor * ratio**3 * cosine / opening**2
        quotient = factor * _cotangent_quotient(half, opening)
        columns.append((quotient, factor * ratio**2 / opening, curve, s))
    value, slope, curve, s = (torch.stack(column) for column in zip(*columns, strict=True))
    signs = [[sign * other, sign] for other, sign in _term_signs(diffraction)]
    return _CoupledCotangents(value, slope, curve, s, torch.tensor(signs).double().T)


def _directional_dyads(
    diffraction: EdgeDiffraction, wave_number: float, orders: Sequence[DyadDerivative]
) -> Tensor:
    weights = _term_coefficients(diffraction, wave_number, orders)[..., None, None]
    direct, _, *reflected = _directional_term_dyads(diffraction)
    total = (weights[0] + weights[1]) * direct
    for weight, dyad in zip(weights[2:], reflected, strict=True):
        total = total + weight * dyad
    return total


def _term_dyads(diffraction: EdgeDiffraction) -> Complex128[Tensor, "term row 3 3"]:
    """Dyads of the cotangent terms, averaged over both directions of propagation."""
    forward = torch.stack(torch.broadcast_tensors(*_directional_term_dyads(diffraction)))
    if diffraction.face_coefficients is conductor_coefficients:
        return forward
    backward = torch.stack(torch.broadcast_tensors(*_directional_term_dyads(diffraction.reverse())))
    return (forward + backward.mT) / 2


def _directional_term_dyads(diffraction: EdgeDiffraction) -> list[Complex128[Tensor, "row 3 3"]]:
    direct, *reflected = _geometric_optics_dyads(diffraction)
    return [direct, direct, *(reflected if diffraction.reflects else ())]


def _term_signs(diffraction: EdgeDiffraction) -> tuple[tuple[float, float], ...]:
    return _TERM_SIGNS if diffraction.reflects else _TERM_SIGNS[:2]


def _dyad_scale(diffraction: EdgeDiffraction, wave_number: float) -> Tensor:
    return -transitions.EXP_J_PI_4.conjugate() / (
        2 * diffraction.wedges.opening * math.sqrt(2 * math.pi * wave_number) * diffraction.sin_beta
    )


def _term_coefficients(
    diffraction: EdgeDiffraction, wave_number: float, orders: Sequence[DyadDerivative]
) -> Complex128[Tensor, "term order row"]:
    """Scalar coefficients of the four terms, or their derivatives."""
    scale = _dyad_scale(diffraction, wave_number)
    root = torch.sqrt(2 * wave_number * diffraction.distance_parameter)
    found = []
    for other, sign in _term_signs(diffraction):
        value, slope = _cotangent(diffraction, other, sign, root, list(orders) != ["value"])
        each: dict[DyadDerivative, Tensor] = {"value": value, "in": other * slope, "out": slope}
        found.append(torch.stack([scale * each[order] for order in orders]))
    return torch.stack(found)


def _half_boundary_angle(diffraction: EdgeDiffraction, azimuth_sign: float, sign: float) -> Tensor:
    """Half the angle δ past the boundary of β = φ ± φ′."""
    beta = diffraction.azimuth + azimuth_sign * diffraction.azimuth_in
    full = 2 * math.pi * diffraction.wedges.opening
    turns = torch.round((beta + sign * math.pi) / full).detach()
    return (sign * (full * turns - beta) - math.pi) / 2


def _cotangent_quotient(half: Tensor, opening: Tensor) -> Tensor:
    """Return sin(δ/2)/tan(δ/2n)."""
    near = half.abs() < _SERIES_ANGLE
    safe = torch.where(near, torch.full_like(half, _SERIES_ANGLE), half)
    bend = opening * (1 / 6 + 1 / (3 * opening**2))
    return torch.where(near, opening - bend * half**2, torch.sin(safe) / torch.tan(safe / opening))


def _cotangent(
    diffraction: EdgeDiffraction, azimuth_sign: float, sign: float, root: Tensor, with_slope: bool
) -> tuple[Tensor, Tensor]:
    """Product cot((π ± β)/2n) F(kLa) and, on request, its derivative with respect to β.

    With δ the angle past the boundary, it is −[sin(δ/2)/tan(δ/2n)] √(2kL) g(√(2kL) sin(δ/2)).
    """
    opening = diffraction.wedges.opening
    half = _half_boundary_angle(diffraction, azimuth_sign, sign)
    quotient = _cotangent_quotient(half, opening)
    s = root * torch.sin(half)
    transition_value = transitions.edge_transition(s, diffraction.end_parameters)
    value = -quotient * root * transition_value
    if not with_slope:
        return value, value
    near = half.abs() < _SERIES_ANGLE
    safe = torch.where(near, torch.full_like(half, _SERIES_ANGLE), half)
    sine, tangent = torch.sin(safe), torch.tan(safe / opening)
    curvature = opening * (1 / 6 + 1 / (3 * opening**2))
    slope = torch.cos(safe) / tangent - sine / (opening * torch.sin(safe / opening) ** 2)
    slope = torch.where(near, -2 * curvature * half, slope)
    by_s = transitions.edge_transition_slope(s, diffraction.end_parameters, transition_value)
    by_half = -root * (slope * transition_value + quotient * by_s * root * torch.cos(half))
    return value, by_half * (-sign / 2)


def _ray_fixed_basis(along: Tensor, direction: Tensor) -> Float64[Tensor, "row 2 3"]:
    """Ray-fixed basis β̂, φ̂ of waves that leave an edge."""
    across = normalize(cross(along, direction), dim=-1)
    return torch.stack([cross(across, direction), across], 1)


def _geometric_optics_dyads(diffraction: EdgeDiffraction) -> list[Complex128[Tensor, "row 3 3"]]:
    """Geometric-optics dyads: shadowed direct field, and reflections at the faces n and 0.

    Each is rotated from its own direction about the edge into the diffracted one.
    """
    axis, direction = edge_axis(diffraction.wedges), diffraction.incident_direction
    basis = _ray_fixed_basis(axis, diffraction.diffracted_direction)
    faces = [_face_dyads(diffraction, face) for face in (0, 1)]
    # Zero behind bodies; one sheet at an open edge, two at a crease.
    flat = (diffraction.wedges.opening > 2 - _SHEET_TOLERANCE)[:, None, None]
    through = torch.where(flat, faces[0][1], faces[1][1] @ faces[0][1])
    shadowed = torch.eye(3, dtype=torch.complex128) - through
    dyads = [_rotate_dyad(basis, _ray_fixed_basis(axis, direction), shadowed)]
    for face in (1, 0):
        reflected = reflect_vectors(direction, diffraction.wedges.normals[:, face])
        dyads.append(_rotate_dyad(basis, _ray_fixed_basis(axis, reflected), faces[face][0]))
    return dyads


def _face_dyads(
    diffraction: EdgeDiffraction, face: int
) -> tuple[Complex128[Tensor, "row 3 3"], Complex128[Tensor, "row 3 3"]]:
    """Dyads of the reflection at a face and of the transmission through it."""
    normal, direction = diffraction.wedges.normals[:, face], diffraction.incident_direction
    s, before, after = (v[:, 0] for v in plane_of_incidence(normal, direction))
    law = diffraction.face_coefficients(face, dot(normal, direction).abs())
    reflection = outer_product(law.reflection_s, s, s)
    through = outer_product(law.transmission_s, s, s)
    reflection = reflection + outer_product(law.reflection_p, after, before)
    return reflection, through + outer_product(law.transmission_p, before, before)


def outer_product(strength: Tensor, left: Tensor, right: Tensor) -> Complex128[Tensor, "row 3 3"]:
    """Dyads from the component along one vector to a multiple of another.

    Args:
        strength: complex factors, [row].
        left, right: vectors of the result and of the component, [row, 3].
    """
    return strength[:, None, None] * (left[:, :, None] * right[:, None])


def _rotate_dyad(leaving: Tensor, arriving: Tensor, law: Tensor) -> Complex128[Tensor, "row 3 3"]:
    """Rotate the fields of a dyad about the edge, from the arriving to the leaving basis."""
    return (leaving.mT @ arriving).to(torch.complex128) @ law
