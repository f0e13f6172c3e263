"""The laws of polarised waves at smooth surfaces: reflection, currents, what these send out.

Convention exp(+jωt). A plane wave travels along the unit vector d with the field
E exp(−jk(d·x + c)) [V/m]. What a body scatters along the unit vector s is F exp(−jkr)/r far away;
with a receiving polarisation p and an incident wave of 1 V/m, S = p·F and σ = 4π|S|².
All functions work on rows; fields have one row for each polarisation of the incident wave.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.scene.material.fresnel import LEAST_COSINE

Vectors = Float64[Tensor, "*row 3"]


class SmoothInterfaces(NamedTuple):
    """What surfaces are made of at one frequency, one row a surface.

    Attributes:
        conducting: perfect conductors; the other fields but the last do not count there.
        permittivity: complex relative permittivity.
        thickness: of a sheet about the surface [m]; infinite for a body.
        coherence: share of the reflected field that is not scattered, in [0, 1].
        rms_height: of the roughness [m].
    """

    conducting: Tensor
    permittivity: Complex128[Tensor, " row"]
    thickness: Float64[Tensor, " row"]
    coherence: Float64[Tensor, " row"]
    rms_height: Float64[Tensor, " row"]

    def rows(self, index: Tensor) -> "SmoothInterfaces":
        """Some rows."""
        return SmoothInterfaces(*(column[index] for column in self))


def dot(first: Tensor, second: Tensor) -> Tensor:
    """Scalar products of rows.

    Args:
        first, second: vectors, or fields and vectors.
    """
    # Three products are several times as fast as a sum over an axis of three.
    total, *others = (x * u for x, u in zip(first.unbind(-1), second.unbind(-1), strict=True))
    for product in others:
        total = total + product
    return total


def cross(first: Tensor, second: Tensor) -> Tensor:
    """Vector products of rows.

    Args:
        first, second: vectors, or fields and vectors.
    """
    first, second = torch.broadcast_tensors(first, second)
    kind = torch.promote_types(first.dtype, second.dtype)
    return torch.linalg.cross(first.to(kind), second.to(kind))


def polarisations(direction: Vectors, up: Float64[Tensor, "3"]) -> Float64[Tensor, "*row 2 3"]:
    """Unit vectors V and H of waves to or from antennas in some directions.

    H = up × u and V = H × u: with up = z they are the unit vectors of θ and φ. Where the direction
    is along ``up``, H is the axis that follows it (y for z).

    Args:
        direction: u, unit vectors from the target to the antenna.
        up: unit vector.
    """
    flat = cross(up.expand_as(direction), direction)
    aside = up.roll(1) - dot(up, up.roll(1)) * up
    aside = normalize(cross(up, aside), dim=-1).expand_as(flat)
    small = flat.norm(dim=-1, keepdim=True) < 1e-9
    horizontal = normalize(torch.where(small, aside, flat), dim=-1)
    return torch.stack([cross(horizontal, direction), horizontal], dim=-2)


def reflect_vectors(vector: Tensor, normal: Vectors) -> Tensor:
    """A vector reflected by a plane: v − 2(n·v)n.

    Args:
        vector: v.
        normal: n.
    """
    return vector - 2 * dot(normal, vector)[..., None] * normal


def reflect_field(
    interfaces: SmoothInterfaces,
    wave_number: float,
    normal: Vectors,
    direction: Vectors,
    field: Complex128[Tensor, "row 2 3"],
) -> Complex128[Tensor, "row 2 3"]:
    """Coherently reflected field on the surface: of a conductor 2(n·E)n − E.

    A dielectric multiplies the parts of E across and in the plane of incidence by its coefficients.
    Roughness multiplies the field by exp(−½(2kσ cosθ)²).

    Args:
        interfaces: one row each.
        wave_number: k [1/m].
        normal: towards the source.
        direction: d of the incident wave.
        field: E.
    """
    cosine = -dot(normal, direction)
    kept = interfaces.coherence * roughness_attenuation(interfaces, wave_number, 2 * cosine)
    return (
        _reflect_from_smooth(interfaces, wave_number, normal, direction, field)
        * kept[:, None, None]
    )


def radiate_field(
    interfaces: SmoothInterfaces,
    wave_number: float,
    normal: Vectors,
    direction: Vectors,
    field: Complex128[Tensor, "row 2 3"],
    scattered_direction: Vectors,
) -> Complex128[Tensor, "row 2 3"]:
    """F per m² of a lit surface: what its currents send along ``towards``.

    Currents of the reflected wave on the surface, ηJ = n × (d×E + d_r×E_r) and
    M = −n × (E + E_r), send F = −(jk/4π) [ηJ − s × M] without its part along s. For a conductor
    that is −(jk/2π) n × (d×E), every bounce with its own incident field. A sheet sends what its
    polarisation current does: F = (k²/4π)(ε − 1) ∫ E_inside dx over its thickness. Roughness takes
    exp(−½(kσ(cosθ + n·s))²) off: nothing straight on, where the shadow is.

    Args:
        interfaces, wave_number, normal, direction, field: as in ``reflect_field``.
        towards: s, to the receiver.

    Source: derivations §13 and §14; Balanis, Advanced Engineering Electromagnetics, §6.8.
    """
    again = _reflect_from_smooth(interfaces, wave_number, normal, direction, field)
    sent = radiate_currents(wave_number, normal, direction, field, again, scattered_direction)
    thin = torch.isfinite(interfaces.thickness) & ~interfaces.conducting
    if bool(thin.any()):
        sheet = _radiate_sheet(
            interfaces, wave_number, normal, direction, field, scattered_direction
        )
        sent = torch.where(thin[:, None, None], sheet, sent)
    leaving = dot(normal, scattered_direction)
    kept = roughness_attenuation(interfaces, wave_number, leaving - dot(normal, direction))
    kept = kept * torch.where(leaving > 0, interfaces.coherence, 1.0)
    return project_transverse(sent * kept[:, None, None], scattered_direction)


def project_transverse(
    field: Complex128[Tensor, "row 2 3"], direction: Vectors
) -> Complex128[Tensor, "row 2 3"]:
    """Fields without their part along a direction.

    Args:
        field: F.
        direction: s.
    """
    s = direction[:, None]
    return field - dot(field, s.to(field.dtype))[..., None] * s


def radiate_currents(
    wave_number: float,
    normal: Vectors,
    wave_vector: Tensor,
    field: Complex128[Tensor, "row 2 3"],
    reflected_field: Complex128[Tensor, "row 2 3"],
    scattered_direction: Vectors,
) -> Complex128[Tensor, "row 2 3"]:
    """−(jk/4π) [ηJ − s × M] per m² of the tangential fields of a wave and of its mirrored one.

    A wave along K, of which ηH = K × E, and its mirrored one have ηJ = n × (K×E + K_r×E_r) and
    M = −n × (E + E_r). What lies along s is still in it.

    Args:
        wave_number: k [1/m].
        normal: n, on the side of the surface that sends.
        wave_vector: K over k: a unit vector in air.
        field, reflected_field: E and E_r.
        scattered_direction: s, to the receiver.

    Source: derivations §13.
    """
    n, s = normal[:, None], scattered_direction[:, None]
    onwards = reflect_vectors(wave_vector, normal)[:, None]
    electric = cross(n, cross(wave_vector[:, None], field) + cross(onwards, reflected_field))
    magnetic = cross(s, cross(n, field + reflected_field))
    return -1j * wave_number / (4 * math.pi) * (electric + magnetic)


def roughness_attenuation(
    interfaces: SmoothInterfaces, wave_number: float, cosine_sum: Float64[Tensor, " row"]
) -> Float64[Tensor, " row"]:
    """Share of the field that roughness leaves: phases spread by kσ(cosθ + cosθ').

    Args:
        interfaces: one row each.
        wave_number: k [1/m].
        cosine_sum: cosθ + cosθ', what a height changes of the way.
    """
    return torch.exp(-0.5 * (wave_number * interfaces.rms_height * cosine_sum) ** 2)


def _reflect_from_smooth(
    interfaces: SmoothInterfaces,
    wave_number: float,
    normal: Tensor,
    direction: Tensor,
    field: Tensor,
) -> Tensor:
    """Reflected field of a surface without roughness."""
    n = normal[:, None]
    whole = 2 * dot(n, field)[..., None] * n - field
    if bool(interfaces.conducting.all()):
        return whole
    across, before, after = plane_of_incidence(normal, direction)
    r_s, r_p = _coefficients(interfaces, wave_number, -dot(normal, direction))
    part = r_s[:, None, None] * dot(across, field)[..., None] * across
    part = part + r_p[:, None, None] * dot(before, field)[..., None] * after
    return torch.where(interfaces.conducting[:, None, None], whole, part)


def orthogonal_unit_vectors(direction: Float64[Tensor, "*row 3"]) -> Float64[Tensor, "*row 3"]:
    """A unit vector at a right angle to each direction, any that turns with it.

    Args:
        direction: not zero.
    """
    spare = torch.eye(3, dtype=direction.dtype)[direction.detach().abs().argmin(-1)]
    return normalize(cross(direction, spare), dim=-1)


def plane_of_incidence(normal: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors of E across the plane of incidence (s), and in it (p) before and after a mirror.

    Args:
        normal: of the surface, towards either side.
        direction: d of the incident wave.
    """
    across = cross(direction, normal)
    # At normal incidence any axis serves.
    steep = across.detach().norm(dim=-1, keepdim=True) < 1e-9
    across = normalize(torch.where(steep, orthogonal_unit_vectors(normal), across), dim=-1)
    onwards = reflect_vectors(direction, normal)
    # A conductor has r_p = +1 between these two, r_s = −1.
    return (across[:, None], cross(direction, across)[:, None], cross(onwards, across)[:, None])


def _interface_terms(interfaces: SmoothInterfaces, cosine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """ε, q = √(ε − sin²θ) and the safe cosine; of conductors those of air."""
    epsilon = torch.where(interfaces.conducting, 1.0 + 0j, interfaces.permittivity)
    cosine = cosine.clamp_min(LEAST_COSINE)
    return epsilon, torch.sqrt(epsilon - 1 + cosine**2), cosine


def _coefficients(
    interfaces: SmoothInterfaces, wave_number: float, cosine: Tensor
) -> tuple[Tensor, Tensor]:
    """Reflection coefficients r_s and r_p of bodies, and of sheets about their middle."""
    epsilon, root, cosine = _interface_terms(interfaces, cosine)
    r_s, r_p = _fresnel(epsilon, root, cosine)
    thin = torch.isfinite(interfaces.thickness)
    if not bool(thin.any()):
        return r_s, r_p
    thickness = torch.where(thin, interfaces.thickness, 0.0)
    once = torch.exp(-1j * wave_number * root * thickness)
    front = torch.exp(1j * wave_number * cosine * thickness)

    def sheet(r: Tensor) -> Tensor:
        return torch.where(thin, front * r * (1 - once**2) / (1 - r**2 * once**2), r)

    return sheet(r_s), sheet(r_p)


def _fresnel(epsilon: Tensor, root: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """r_s and r_p of a half space."""
    parallel = epsilon * cosine
    return (cosine - root) / (cosine + root), (parallel - root) / (parallel + root)


def _radiate_sheet(
    interfaces: SmoothInterfaces,
    wave_number: float,
    normal: Tensor,
    direction: Tensor,
    field: Tensor,
    scattered_direction: Tensor,
) -> Tensor:
    """F per m² of a sheet's polarisation current, before its part along s is taken off.

    Inside, waves go to and from the far face: E± exp(∓jkqζ) at the depth ζ, with q = √(ε − sin²θ).
    """
    k, cosine = wave_number, -dot(normal, direction)
    epsilon, root, cosine = _interface_terms(interfaces, cosine)
    thickness = torch.where(torch.isfinite(interfaces.thickness), interfaces.thickness, 0.0)
    across, before, _ = plane_of_incidence(normal, direction)
    once = torch.exp(-1j * k * root * thickness)
    along = direction + cosine[:, None] * normal  # sinθ times its unit vector
    total = torch.zeros_like(field)
    # The fields refer to the middle; the front face is met earlier and seen later.
    front = torch.exp(1j * k * (cosine + dot(scattered_direction, normal)) * thickness / 2)
    r_s, r_p = _fresnel(epsilon, root, cosine)
    parts = ((r_s, cosine + root, across), (r_p, epsilon * cosine + root, before))
    for r, both, unit in parts:
        t = 2 * cosine / both
        amplitude = dot(unit, field) * (t / (1 - r**2 * once**2))[:, None]
        for way, strength in ((1.0, torch.ones_like(r)), (-1.0, -r * once**2)):
            turn = k * (way * root + dot(scattered_direction, normal)) * thickness / 2
            depth = thickness * _sinc(turn) * torch.exp(-1j * turn)
            if unit is across:
                vector = across.to(field.dtype)
            else:
                # E of a wave along (sinθ x, ∓q n) with its H across: H ∝ (1/ε)(along, q).
                inner = along - way * root[:, None] * normal
                vector = cross(inner, across[:, 0])[:, None]
            total = total + vector * (amplitude * (strength * depth * front)[:, None])[..., None]
    return k**2 / (4 * math.pi) * (epsilon - 1)[:, None, None] * total


def _sinc(x: Tensor) -> Tensor:
    """sin(x)/x."""
    small = x.abs() < 1e-6
    safe = torch.where(small, torch.ones_like(x), x)
    return torch.where(small, 1 - x**2 / 6, torch.sin(safe) / safe)


def parallelogram_integral(
    wave_vector: Vectors, first: Vectors, second: Vectors
) -> Float64[Tensor, " row"]:
    """∫ exp(j w·x) over a parallelogram about the origin, over its area.

    Args:
        wave_vector: w [1/m].
        first, second: its sides [m].
    """
    return _sinc(dot(wave_vector, first) / 2) * _sinc(dot(wave_vector, second) / 2)


def polygon_integral(
    polygon: Float64[Tensor, "row corner 3"], direction: Tensor
) -> Callable[[float], Complex128[Tensor, " row"]]:
    """∫ exp(jk w·x) dA over flat polygons, exactly: a sum over their sides, by wave number k.

    Args:
        polygon: corners in order, about any point; some may coincide.
        direction: w, real, or complex where a wave decays; what does not depend on k is computed
            once.

    Source: Gordon, "Far-field approximations to the Kirchhoff-Helmholtz representations of
    scattered fields", IEEE TAP 23, 1975. Near w ⊥ polygon the sum is 0/0; there two terms of the
    series about the middle serve.
    """
    area = area_vector(polygon)
    size = area.norm(dim=-1)
    normal = area / size.clamp_min(1e-300)[:, None]
    middle = polygon.mean(1)
    flat = direction - dot(direction, normal)[:, None] * normal
    square = dot(flat, flat)
    corners = polygon - middle[:, None]
    length = flat.detach().abs().square().sum(-1)
    largest = length * corners.detach().norm(dim=-1).amax(1) ** 2
    ends = corners.roll(-1, 1)
    sides = ends - corners
    phase = dot(flat[:, None], corners + ends) / 2
    share = dot(cross(sides, normal[:, None]), flat[:, None])
    turn = dot(flat[:, None], sides) / 2
    whole = dot(direction, middle)
    # ∫(1 + jw·x − (w·x)²/2) by the triangles about the first corner.
    first = dot(flat[:, None], corners)
    fan = torch.linalg.cross(
        corners[:, 1:-1] - corners[:, :1], corners[:, 2:] - corners[:, :1], dim=-1
    )
    weight = dot(fan, normal[:, None]) / 2
    a, b, c = first[:, :1], first[:, 1:-1], first[:, 2:]
    mean = (weight * (a + b + c)).sum(1) / 3
    second = (weight * (a * a + b * b + c * c + a * b + a * c + b * c)).sum(1) / 6
    weight = weight.sum(1)

    def evaluate(k: float) -> Tensor:
        broad = largest * k**2 < 1e-6
        exact = (share * _sinc(k * turn) * phasor(k * phase)).sum(1)
        exact = exact / torch.where(broad, torch.ones_like(square), square * k) / 1j
        series = weight + 1j * k * mean - k**2 * second / 2
        return torch.where(broad, series, exact) * phasor(k * whole)

    return evaluate


def phasor(phase: Tensor) -> Tensor:
    """exp(j phase).

    Args:
        phase: [rad], real or complex.
    """
    if phase.is_complex():
        return torch.exp(1j * phase)
    return torch.complex(phase.cos(), phase.sin())


def area_vector(polygon: Float64[Tensor, "row corner 3"]) -> Float64[Tensor, "row 3"]:
    """Area times unit normal [m²].

    Args:
        polygon: corners in order; some may coincide.
    """
    spokes = polygon - polygon[:, :1]
    return torch.linalg.cross(spokes, spokes.roll(-1, 1), dim=-1).sum(1) / 2


def interpolate_vectors(
    values: Float64[Tensor, "*#row 3 3"],
    corners: Float64[Tensor, "*#row 3 3"],
    points: Float64[Tensor, "*#row 3"],
) -> Float64[Tensor, "*row 3"]:
    """Vectors at the corners of triangles, interpolated at points in these.

    Args:
        values: At the corners.
        corners: Of the triangles [m].
        points: In them [m].
    """
    return (barycentric_coordinates(corners, points)[..., None] * values).sum(-2)


def barycentric_coordinates(
    corners: Float64[Tensor, "*#row 3 3"], points: Float64[Tensor, "*#row 3"]
) -> Float64[Tensor, "*row 3"]:
    """Barycentric coordinates of points in triangles.

    Args:
        corners: Of the triangles [m].
        points: In them [m].
    """
    a, b, c = corners.unbind(-2)
    area = cross(b - a, c - a)
    square = dot(area, area)
    v = dot(cross(b - a, points - a), area) / square
    u = dot(cross(points - a, c - a), area) / square
    return torch.stack([1 - u - v, u, v], -1)
