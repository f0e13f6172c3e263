"""Polarised plane waves at smooth surfaces: Fresnel reflection, currents and their radiation.

Convention exp(+jωt). A plane wave propagates along the unit vector d with the field E exp(−jk(d·x +
c)) [V/m]. The far field that a body scatters along the unit vector s is F exp(−jkr)/r; with a
receiving polarisation p and an incident wave of 1 V/m, S = p·F and σ = 4π|S|². All functions are
batched over rows; fields have one row per polarisation of the incident wave.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import torch
from jaxtyping import Complex128, Float, Float64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.scene.material.fresnel import LEAST_COSINE

_Values: TypeAlias = Float64[Tensor, " row"]
_Triangles: TypeAlias = Float64[Tensor, "*#row 3 3"]
_Axes = Float64[Tensor, "row 2 3"]
Waves: TypeAlias = Complex128[Tensor, "row 2 3"]
Vectors = Float64[Tensor, "*row 3"]  # of any leading shape
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


class SmoothInterfaces(NamedTuple):
    """Electrical properties of smooth interfaces at one frequency, one row a surface.

    Attributes:
        conducting: mask of perfect conductors, for which only ``rms_height`` counts, [row].
        permittivity: complex relative permittivity.
        thickness: thickness of a sheet centred on the surface [m]; infinite for a body.
        coherence: fraction of the reflected field that is not scattered diffusely, in [0, 1].
        rms_height: RMS roughness height [m].
    """

    conducting: Tensor
    permittivity: Complex128[Tensor, " row"]
    thickness: _Values
    coherence: _Values
    rms_height: _Values

    def rows(self, index: Tensor) -> "SmoothInterfaces":
        """Select rows."""
        return SmoothInterfaces(*(column[index] for column in self))


def dot(first: Tensor, second: Tensor) -> Tensor:
    """Scalar products along the last axis.

    Args:
        first, second: vectors or complex fields, [..., 3].
    """
    # Three products are several times as fast as a sum over an axis of three.
    total, *others = (x * u for x, u in zip(first.unbind(-1), second.unbind(-1), strict=True))
    for product in others:
        total = total + product
    return total


def cross(first: Tensor, second: Tensor) -> Tensor:
    """Vector products along the last axis.

    Args:
        first, second: vectors or complex fields, [..., 3].
    """
    first, second = torch.broadcast_tensors(first, second)
    kind = torch.promote_types(first.dtype, second.dtype)
    return torch.linalg.cross(first.to(kind), second.to(kind))


def polarisations(direction: Vectors, up: Float64[Tensor, "3"] = UP) -> Float64[Tensor, "*row 2 3"]:
    """Polarisation basis vectors V and H for given directions.

    H = up × u and V = H × u: with up = z they are the unit vectors of θ and φ. For directions along
    ``up``, H is the axis that follows it cyclically (y for z).

    Args:
        direction: u, unit vectors from the target to the antenna.
        up: unit vector of the vertical axis.
    """
    transverse = cross(up.expand_as(direction), direction)
    fallback = up.roll(1) - dot(up, up.roll(1)) * up
    fallback = normalize(cross(up, fallback), dim=-1).expand_as(transverse)
    parallel = transverse.norm(dim=-1, keepdim=True) < 1e-9
    horizontal = normalize(torch.where(parallel, fallback, transverse), dim=-1)
    return torch.stack([cross(horizontal, direction), horizontal], dim=-2)


def reflect_vectors(vector: Tensor, normal: Float[Tensor, "*row 3"]) -> Tensor:
    """Reflect vectors at planes: v − 2(n·v)n.

    Args:
        vector: vectors v, [..., 3].
        normal: unit normals n.
    """
    return vector - 2 * dot(normal, vector)[..., None] * normal


def reflect_field(
    interfaces: SmoothInterfaces,
    wave_number: float,
    normal: Vectors,
    direction: Vectors,
    field: Waves,
) -> Waves:
    """Coherently reflected field on the surface; for a conductor 2(n·E)n − E.

    For a dielectric, the s and p components are multiplied by the Fresnel coefficients. Roughness
    multiplies the field by exp(−½(2kσ cosθ)²).

    Args:
        interfaces: smooth interfaces, one row each.
        wave_number: wave number k [1/m].
        normal: unit normal towards the source.
        direction: direction d of the incident wave.
        field: incident field E [V/m], one per polarisation.
    """
    cosine = -dot(normal, direction)
    attenuation = interfaces.coherence * roughness_attenuation(interfaces, wave_number, 2 * cosine)
    reflected = _reflect_from_smooth(interfaces, wave_number, normal, direction, field)
    return reflected * attenuation[:, None, None]


def scatter_from_metal(
    normal: Vectors, direction: Vectors, field: _Axes, received: _Axes
) -> tuple[Float64[Tensor, "row 2 2"], _Axes]:
    """Amplitudes S per m² of smooth metal over −jk/2π, and its reflected field.

    With F of ``radiate_field`` for a conductor, p·F = −(jk/2π) p·[d (n·E) − E (n·d)].

    Args:
        normal, direction, field: as in ``reflect_field``, the field real.
        received: receiving polarisations p, transverse to the direction towards the receiver.
    """
    across = dot(normal[:, None], field)[..., None]
    # Products of small matrices are faster than broadcasting over axes of two and three.
    current = across @ direction[:, None] - dot(normal, direction)[:, None, None] * field
    return received @ current.mT, 2 * across @ normal[:, None] - field


def radiate_field(
    interfaces: SmoothInterfaces,
    wave_number: float,
    normal: Vectors,
    direction: Vectors,
    field: Waves,
    scattered_direction: Vectors,
) -> Waves:
    """Far field F per m² of an illuminated surface, radiated by its currents.

    Currents of the reflected wave on the surface, ηJ = n × (d×E + d_r×E_r) and M = −n × (E + E_r),
    radiate F = −(jk/4π) [ηJ − s × M] without its part along s. For a conductor that is −(jk/2π) n ×
    (d×E), every bounce with its own incident field. A sheet radiates as its polarisation current: F
    = (k²/4π)(ε − 1) ∫ E_inside dx over its thickness. Roughness attenuates by exp(−½(kσ(cosθ +
    n·s))²), which is 1 in the forward direction, in the shadow.

    Args:
        interfaces, wave_number, normal, direction, field: as in ``reflect_field``.
        scattered_direction: unit vector s towards the receiver.

    Source: derivations §13 and §14; Balanis, Advanced Engineering Electromagnetics, §6.8.
    """
    reflected = _reflect_from_smooth(interfaces, wave_number, normal, direction, field)
    total = radiate_currents(wave_number, normal, direction, field, reflected, scattered_direction)
    thin = torch.isfinite(interfaces.thickness) & ~interfaces.conducting
    if bool(thin.any()):
        wave = normal, direction, field, scattered_direction
        sheet = _radiate_sheet(interfaces, wave_number, *wave)
        total = torch.where(thin[:, None, None], sheet, total)
    leaving = dot(normal, scattered_direction)
    attenuation = roughness_attenuation(interfaces, wave_number, leaving - dot(normal, direction))
    attenuation = attenuation * torch.where(leaving > 0, interfaces.coherence, 1.0)
    return project_transverse(total * attenuation[:, None, None], scattered_direction)


def project_transverse(field: Waves, direction: Vectors) -> Waves:
    """Remove the longitudinal component of fields.

    Args:
        field: far fields F.
        direction: unit vectors s.
    """
    s = direction[:, None]
    return field - dot(field, s.to(field.dtype))[..., None] * s


def radiate_currents(
    wave_number: float,
    normal: Vectors,
    wave_vector: Tensor,
    field: Waves,
    reflected_field: Waves,
    scattered_direction: Vectors,
) -> Waves:
    """Radiation −(jk/4π) [ηJ − s × M] per m² of the currents of an incident and a reflected wave.

    A wave along K, with ηH = K × E, and its reflection have ηJ = n × (K×E + K_r×E_r) and M = −n ×
    (E + E_r). The component along s is not removed.

    Args:
        wave_number: wave number k [1/m].
        normal: unit normal n, on the radiating side of the surface.
        wave_vector: K over k, [row, 3]; a unit vector in air.
        field, reflected_field: incident field E and reflected field E_r [V/m].
        scattered_direction: unit vector s towards the receiver.

    Source: derivations §13.
    """
    n, s = normal[:, None], scattered_direction[:, None]
    reflected_direction = reflect_vectors(wave_vector, normal)[:, None]
    magnetic_field = cross(wave_vector[:, None], field)
    electric = cross(n, magnetic_field + cross(reflected_direction, reflected_field))
    magnetic = cross(s, cross(n, field + reflected_field))
    return -1j * wave_number / (4 * math.pi) * (electric + magnetic)


def roughness_attenuation(
    interfaces: SmoothInterfaces, wave_number: float, cosine_sum: _Values
) -> _Values:
    """Rayleigh roughness factor of the coherent field, exp(−½(kσ(cosθ + cosθ'))²).

    Args:
        interfaces: smooth interfaces, one row each.
        wave_number: wave number k [1/m].
        cosine_sum: cosθ + cosθ', path length change per unit of height.
    """
    return torch.exp(-0.5 * (wave_number * interfaces.rms_height * cosine_sum) ** 2)


def _reflect_from_smooth(
    interfaces: SmoothInterfaces, k: float, normal: Tensor, direction: Tensor, field: Tensor
) -> Tensor:
    """Reflected field of a smooth surface."""
    n = normal[:, None]
    conductor = 2 * dot(n, field)[..., None] * n - field
    if bool(interfaces.conducting.all()):
        return conductor
    unit_s, unit_p, reflected_p = plane_of_incidence(normal, direction)
    r_s, r_p = _coefficients(interfaces, k, -dot(normal, direction))
    dielectric = r_s[:, None, None] * dot(unit_s, field)[..., None] * unit_s
    dielectric = dielectric + r_p[:, None, None] * dot(unit_p, field)[..., None] * reflected_p
    return torch.where(interfaces.conducting[:, None, None], conductor, dielectric)


def orthogonal_unit_vectors(direction: Float64[Tensor, "*row 3"]) -> Float64[Tensor, "*row 3"]:
    """Unit vectors orthogonal to given directions, otherwise arbitrary.

    Args:
        direction: nonzero vectors.
    """
    axis = torch.eye(3, dtype=direction.dtype)[direction.detach().abs().argmin(-1)]
    return normalize(cross(direction, axis), dim=-1)


def plane_of_incidence(normal: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit vectors of s polarisation, and of p polarisation before and after a reflection.

    Args:
        normal: unit normal of the surface, [row, 3], towards either side.
        direction: direction d of the incident wave, [row, 3].
    """
    unit_s = cross(direction, normal)
    # At normal incidence the axis is arbitrary.
    is_normal = unit_s.detach().norm(dim=-1, keepdim=True) < 1e-9
    unit_s = normalize(torch.where(is_normal, orthogonal_unit_vectors(normal), unit_s), dim=-1)
    reflected = reflect_vectors(direction, normal)
    # A conductor has r_p = +1 between these two, r_s = −1.
    return (unit_s[:, None], cross(direction, unit_s)[:, None], cross(reflected, unit_s)[:, None])


def _interface_terms(interfaces: SmoothInterfaces, cosine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """ε, q = √(ε − sin²θ) and the cosine, bounded from below; for conductors those of air."""
    epsilon = torch.where(interfaces.conducting, 1.0 + 0j, interfaces.permittivity)
    cosine = cosine.clamp_min(LEAST_COSINE)
    return epsilon, torch.sqrt(epsilon - 1 + cosine**2), cosine


def _coefficients(
    interfaces: SmoothInterfaces, wave_number: float, cosine: Tensor
) -> tuple[Tensor, Tensor]:
    """Reflection coefficients r_s and r_p of bodies, and of sheets referred to their mid-plane."""
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
    """Fresnel coefficients r_s and r_p of a half space."""
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
    """Far field F per m² of a sheet's polarisation current, longitudinal component included.

    Inside, waves propagate to and from the far face: E± exp(∓jkqζ) at the depth ζ, with q = √(ε −
    sin²θ).
    """
    k, cosine = wave_number, -dot(normal, direction)
    epsilon, root, cosine = _interface_terms(interfaces, cosine)
    thickness = torch.where(torch.isfinite(interfaces.thickness), interfaces.thickness, 0.0)
    unit_s, unit_p, _ = plane_of_incidence(normal, direction)
    once = torch.exp(-1j * k * root * thickness)
    tangential = direction + cosine[:, None] * normal  # sinθ times its unit vector
    total = torch.zeros_like(field)
    # Fields refer to the mid-plane; the front face is reached earlier and seen later.
    front = torch.exp(1j * k * (cosine + dot(scattered_direction, normal)) * thickness / 2)
    r_s, r_p = _fresnel(epsilon, root, cosine)
    for r, both, unit in ((r_s, cosine + root, unit_s), (r_p, epsilon * cosine + root, unit_p)):
        amplitude = dot(unit, field) * (2 * cosine / both / (1 - r**2 * once**2))[:, None]
        for sign, strength in ((1.0, torch.ones_like(r)), (-1.0, -r * once**2)):
            phase = k * (sign * root + dot(scattered_direction, normal)) * thickness / 2
            depth = thickness * _sinc(phase) * torch.exp(-1j * phase)
            if unit is unit_s:
                vector = unit_s.to(field.dtype)
            else:
                # E of a wave along (sinθ x, ∓q n) with its H across: H ∝ (1/ε)(along, q).
                vector = cross(tangential - sign * root[:, None] * normal, unit_s[:, 0])[:, None]
            total = total + vector * (amplitude * (strength * depth * front)[:, None])[..., None]
    return k**2 / (4 * math.pi) * (epsilon - 1)[:, None, None] * total


def _sinc(x: Tensor) -> Tensor:
    """Return sin(x)/x."""
    small = x.abs() < 1e-6
    safe = torch.where(small, torch.ones_like(x), x)
    return torch.where(small, 1 - x**2 / 6, torch.sin(safe) / safe)


def parallelogram_integral(wave_vector: Vectors, first: Vectors, second: Vectors) -> _Values:
    """Mean of exp(j w·x) over a parallelogram centred at the origin.

    Args:
        wave_vector: w [1/m].
        first, second: edge vectors of the parallelogram [m].
    """
    return _sinc(dot(wave_vector, first) / 2) * _sinc(dot(wave_vector, second) / 2)


def polygon_integral(
    polygon: Float64[Tensor, "row corner 3"], direction: Tensor
) -> Callable[[float], Complex128[Tensor, " row"]]:
    """Exact Fourier integral ∫ exp(jk w·x) dA over flat polygons, a function of wave number k.

    Args:
        polygon: corners in order, relative to any point [m]; some may coincide.
        direction: w, [row, 3], real, or complex for decaying waves. Terms independent of k are
            computed once.

    Source: Gordon, "Far-field approximations to the Kirchhoff-Helmholtz representations of
    scattered fields", IEEE TAP 23, 1975. It is a sum over the sides; near w ⊥ polygon the sum is
    0/0 and the series about the centroid to second order replaces it.
    """
    # Corners come first: sums over a last axis of three are ten times as slow.
    points = torch.stack(polygon.unbind(1))
    spokes = points[1:] - points[:1]
    fan = torch.linalg.cross(spokes[:-1], spokes[1:])
    normal = normalize(fan.sum(0), dim=-1, eps=1e-300)
    centroid = points.mean(0)
    corners = points - centroid
    tangential = direction - dot(direction, normal)[:, None] * normal
    square = dot(tangential, tangential)
    extent = dot(corners, corners).detach().amax(0)
    largest = tangential.detach().abs().square().sum(-1) * extent
    first, across = dot(tangential, corners), dot(cross(normal, tangential), corners)
    ends, side_factor = first.roll(-1, 0), across.roll(-1, 0) - across
    phase, half_phase = (first + ends) / 2, (ends - first) / 2
    centroid_phase = dot(direction, centroid)
    # ∫(1 + jw·x − (w·x)²/2) over the fan of triangles at the first corner.
    weight = dot(fan, normal) / 2
    a, b, c = first[:1], first[1:-1], first[2:]
    mean = (weight * (a + b + c)).sum(0) / 3
    second = (weight * (a * a + b * b + c * c + a * b + a * c + b * c)).sum(0) / 6
    weight = weight.sum(0)

    def evaluate(k: float) -> Tensor:
        near_normal = largest * k**2 < 1e-6
        exact = (side_factor * _sinc(k * half_phase) * phasor(k * phase)).sum(0)
        exact = exact / torch.where(near_normal, torch.ones_like(square), square * k) / 1j
        series = weight + 1j * k * mean - k**2 * second / 2
        return torch.where(near_normal, series, exact) * phasor(k * centroid_phase)

    return evaluate


def phasor(phase: Tensor) -> Tensor:
    """Return exp(j phase).

    Args:
        phase: phases [rad], any shape, real or complex.
    """
    return torch.exp(1j * phase) if phase.is_complex() else torch.complex(phase.cos(), phase.sin())


def area_vector(polygon: Float64[Tensor, "row corner 3"]) -> Float64[Tensor, "row 3"]:
    """Area vectors (area times unit normal) of polygons [m²].

    Args:
        polygon: corners in order [m]; some may coincide.
    """
    spokes = polygon - polygon[:, :1]
    return torch.linalg.cross(spokes, spokes.roll(-1, 1), dim=-1).sum(1) / 2


def triangle_normals(corners: Float64[Tensor, "*row 3 3"]) -> Float64[Tensor, "*row 3"]:
    """Unit normals of triangles.

    Args:
        corners: corners of the triangles [m].
    """
    a, b, c = corners.unbind(-2)
    return normalize(torch.linalg.cross(b - a, c - a), dim=-1)


def interpolate_vectors(
    values: _Triangles, corners: _Triangles, points: Float64[Tensor, "*#row 3"]
) -> Float64[Tensor, "*row 3"]:
    """Interpolate vectors given at the corners of triangles.

    Args:
        values: vectors at the corners.
        corners: corners of the triangles [m].
        points: points in the triangles [m].
    """
    return (barycentric_coordinates(corners, points)[..., None] * values).sum(-2)


def barycentric_coordinates(
    corners: _Triangles, points: Float64[Tensor, "*#row 3"]
) -> Float64[Tensor, "*row 3"]:
    """Barycentric coordinates of points in triangles.

    Args:
        corners: corners of the triangles [m].
        points: points in the triangles [m].
    """
    a, b, c = corners.unbind(-2)
    area = cross(b - a, c - a)
    square = dot(area, area)
    v = dot(cross(b - a, points - a), area) / square
    u = dot(cross(points - a, c - a), area) / square
    return torch.stack([1 - u - v, u, v], -1)
