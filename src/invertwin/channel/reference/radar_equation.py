"""The radar equation of a path in torch, float64: the slow reference of the power kernels.

Positions and lengths come from float64 vertices, so that the phase is right at millimetre waves:
fields are made of it, too. A path is a row of material points; its power is the product of its
segments' 1/R², the scattering at its points and the gains of both antennas.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.paths import Link
from invertwin.channel.rays.geometry import Geometry, mixed
from invertwin.channel.rays.scene import RayScene, next_surface, visible

_MOST_SHEETS = 8  # that a segment of an explicit path may pass


@dataclass(frozen=True)
class SurfacePaths:
    """Paths over as many material points each, in order from the transmitter; one row a path.

    Attributes:
        face, b1, b2: Places, per point.
        weight: One over (paths × probability per area of all points).
        phase: Phase of the path's field [rad].
    """

    face: Int64[Tensor, "n k"]
    b1: Float64[Tensor, "n k"]
    b2: Float64[Tensor, "n k"]
    weight: Float64[Tensor, " n"]
    phase: Float64[Tensor, " n"]

    def keep(self, mask: Bool[Tensor, " n"]) -> "SurfacePaths":
        """Some of the rows."""
        return SurfacePaths(*(column[mask] for column in vars(self).values()))

    def places(self, geometry: Geometry) -> "list[Place]":
        """Where the points are now."""
        columns = zip(self.face.T, self.b1.T, self.b2.T, strict=True)
        return [place(geometry, *column) for column in columns]


@dataclass(frozen=True)
class Place:
    """Material points, one row each.

    Attributes:
        position, normal: Attached [m].
        jacobian: Area of the triangle over that area detached: one in value.
        row: Row of the surface in the tables.
    """

    position: Float64[Tensor, "n 3"]
    normal: Float64[Tensor, "n 3"]
    jacobian: Float64[Tensor, " n"]
    row: Int64[Tensor, " n"]


def place(
    geometry: Geometry,
    face: Int64[Tensor, " n"],
    b1: Float64[Tensor, " n"],
    b2: Float64[Tensor, " n"],
) -> Place:
    """Where pairs of barycentric coordinates lie now.

    Args:
        geometry: The scene.
        face: Triangles.
        b1, b2: Barycentric coordinates.
    """
    p0, p1, p2 = geometry.corners(face)
    normal = torch.linalg.cross(p1 - p0, p2 - p0)
    double_area = normal.norm(dim=1)
    return Place(
        position=mixed((p0, p1, p2), b1, b2),
        normal=normal / double_area[:, None],
        jacobian=double_area / double_area.detach(),
        row=geometry.face_surface[face],
    )


@dataclass(frozen=True)
class SurfacePoints:
    """Detached points of surfaces, each seen in one frame.

    ``weight`` is what the row counts: one over (samples × probability), or a phase.
    """

    frame: Int64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    b1: Float64[Tensor, " n"]
    b2: Float64[Tensor, " n"]
    weight: Float64[Tensor, " n"]

    def keep(self, mask: Bool[Tensor, " n"]) -> "SurfacePoints":
        """Some of the rows."""
        return SurfacePoints(*(column[mask] for column in vars(self).values()))

    def place(self, geometry: Geometry) -> Place:
        """Where the points are now."""
        return place(geometry, self.face, self.b1, self.b2)

    def velocity(self, geometry: Geometry) -> Tensor | None:
        """World velocity of the points [m/s]; None if all objects are at rest."""
        return geometry.velocity(self.face, self.b1, self.b2)


@dataclass(frozen=True)
class Echo:
    """What paths carry, attached; one row a path.

    Attributes:
        power: Received over transmitted power per m² of every point; Jacobians included.
        spread: Gains and 1/R² alone: the power without scattering, over (λ/4π)².
        length: Length from antenna to antenna [m].
        ending: Scattering at the last point, gain and 1/R² of the last segment; detached.
        first, last: World positions of the ends [m].
    """

    power: Float64[Tensor, " n"]
    spread: Float64[Tensor, " n"]
    length: Float64[Tensor, " n"]
    ending: Float64[Tensor, " n"]
    first: Float64[Tensor, "n 3"]
    last: Float64[Tensor, "n 3"]


def radar_equation(
    geometry: Geometry, link: Link, frame: Int64[Tensor, " n"], places: list[Place]
) -> Echo:
    """Evaluate the radar equation of paths from antenna to antenna; nothing is in their way.

    ``(λ/4π)² G_t G_r Π 1/R² Π f |cosθ| |cosθ'|``, with the attenuation of segments inside bodies.

    Args:
        geometry: The scene.
        link: Antennas.
        frame: Radar pose of every path.
        places: The points of the paths, in order from the transmitter.
    """
    stops = [link.tx[frame], *(p.position for p in places), link.rx[frame]]
    offsets = [end - start for start, end in pairwise(stops)]
    distances = [offset.norm(dim=1) for offset in offsets]
    ways = [offset / r[:, None] for offset, r in zip(offsets, distances, strict=True)]
    gains = [
        link.tx_pattern.gain(seen_from(link, frame, ways[0])),
        link.rx_pattern.gain(seen_from(link, frame, -ways[-1])),
    ]
    spread, length = gains[0] * gains[1], distances[0] + distances[-1]
    for distance in distances:
        spread = spread / distance**2
    for number, (start, end) in enumerate(pairwise(places), start=1):
        index, attenuation = _medium(geometry, start, end, ways[number])
        spread = spread * torch.exp(-attenuation * distances[number])
        length = length + index * distances[number]
    power = (link.wavelength / (4 * torch.pi)) ** 2 * spread
    scattering = torch.ones_like(power)
    for point, back, on in zip(places, ways, ways[1:], strict=False):
        scattering = scattered(geometry, point, -back, on)
        power = power * (point.jacobian * scattering)
    ending = (scattering * gains[1] / distances[-1] ** 2).detach()
    return Echo(power, spread, length, ending, stops[1], stops[-2])


def mirror_field(
    link: Link, frame: Int64[Tensor, " n"], point: Place, echo: Echo
) -> Complex128[Tensor, " n"]:
    """Field coefficient per m² of a perfect conductor by physical optics; Jacobians included.

    ``a = (λ/4π) S / (R_t R_r)`` with ``S = −(jk/2π) ∫ (n·d)₊ V dA`` (derivations §4); for separate
    antennas ``n·d`` is the mean of both cosines, which keeps reciprocity.
    Differs from the source: the paper gives no field of a surface.

    Args:
        link: Antennas.
        frame: Radar pose of every point.
        point: The points.
        echo: Their radar equation.
    """
    cosines = [
        (point.normal * normalize(antenna[frame] - point.position, dim=1)).sum(1)
        for antenna in (link.tx, link.rx)
    ]
    lit = (cosines[0] * cosines[1] > 0).to(point.position)
    facing = 0.5 * (cosines[0] + cosines[1]).abs() * point.jacobian
    return -1j / (4 * torch.pi) * (echo.spread.sqrt() * lit * facing)


def seen_from(
    link: Link, frame: Int64[Tensor, " n"], direction: Float64[Tensor, "n 3"]
) -> Float64[Tensor, "n 3"]:
    """World directions in the radar frame.

    Args:
        link: Antennas.
        frame: Radar pose.
        direction: Unit directions in the world.
    """
    return torch.einsum("nij,ni->nj", link.rotations[frame], direction)


def scattered(
    geometry: Geometry, point: Place, back: Float64[Tensor, "n 3"], on: Float64[Tensor, "n 3"]
) -> Float64[Tensor, " n"]:
    """``f |cosθ| |cosθ'|`` between unit directions that point away from the surface.

    On one side, ``f`` is the distribution of ``scene.material``; through the skin of a body, see
    ``Surfaces.refracted``.

    Args:
        geometry: The scene.
        point: Points on surfaces.
        back: Unit directions from which paths come.
        on: Unit directions in which they go on.
    """
    surfaces, row, normal = geometry.surfaces, point.row, point.normal
    first, second, between = ((a * b).sum(1) for a, b in ((normal, back), (normal, on), (back, on)))
    product = first * second
    shape = surfaces.diffuse[row] / torch.pi
    for number, cosine in enumerate((2 * product - between, 2 * product - between, between)):
        half = (0.5 * (1 + cosine)).clamp_min(1e-7)
        shape = shape + surfaces.lobes[row, number] * half ** surfaces.exponents[row, number]
    outer = [_outside(geometry, row, cosine) for cosine in (first, second)]
    reflectance = torch.ones_like(product)
    for cosine, total in outer:
        amplitude = tabulated(surfaces.amplitude, row, cosine)
        reflectance = reflectance * torch.where(total, 1.0, amplitude)
    value = torch.where(product > 0, reflectance * shape * product, 0.0)
    if not geometry.bodies:
        return value
    variance = 2 / surfaces.exponents[row, 0].clamp_min(1.0)
    root, index = torch.ones_like(product), torch.ones_like(product)
    mismatch = torch.zeros_like(normal)
    for (cosine, total), direction, tilt in zip(outer, (back, on), (first, second), strict=True):
        passing = tabulated(surfaces.refraction, row, cosine)
        open_ = ~total & (passing > 0)
        root = root * torch.where(open_, torch.where(open_, passing, 1.0).sqrt(), 0.0)
        index = torch.where(tilt < 0, surfaces.index[row], 1.0)
        mismatch = mismatch + index[:, None] * (direction - normal * tilt[:, None])
    lobe = torch.exp(-mismatch.square().sum(1) / (2 * variance)) / (2 * torch.pi * variance)
    return torch.where(product < 0, root * index**2 * lobe * product.abs(), value)


def _outside(geometry: Geometry, row: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine on the outer side of a skin (Snell), and whether there is none."""
    if not geometry.bodies:
        return cosine, torch.zeros_like(cosine, dtype=torch.bool)
    inside = cosine < 0
    square = 1 - geometry.surfaces.index[row] ** 2 * (1 - cosine**2)
    total = inside & (square <= 1e-6)
    refracted = torch.where(inside & ~total, square, 1.0).sqrt()
    return torch.where(inside, refracted, cosine), total


def _medium(geometry: Geometry, start: Place, end: Place, way: Tensor) -> tuple[Tensor, Tensor]:
    """Refractive index and attenuation of what lies between two points."""
    index, attenuation = torch.ones_like(way[:, 0]), torch.zeros_like(way[:, 0])
    surfaces = geometry.surfaces
    for point, sign in ((start, 1.0), (end, -1.0)) if geometry.bodies else ():
        inside = (point.normal * way).sum(1) * sign < 0
        inside &= surfaces.refraction[point.row, -1] > 0
        index = torch.where(inside, surfaces.index[point.row], index)
        attenuation = torch.where(inside, surfaces.attenuation[point.row], attenuation)
    return index, attenuation


def tabulated(
    table: Float64[Tensor, "row cos"], row: Int64[Tensor, " n"], cosine: Float64[Tensor, " n"]
) -> Float64[Tensor, " n"]:
    """A table over |cosθ|, linear between its entries.

    Args:
        table: One row a surface.
        row: Rows.
        cosine: Places within them.
    """
    entries = table.shape[1]
    t = cosine.abs().clamp_max(1.0) * (entries - 1)
    low = t.detach().long().clamp_max(entries - 2)
    first, second = table[row, low], table[row, low + 1]
    return first + (second - first) * (t - low)


def passed(
    rays: RayScene, start: Float64[Tensor, "n 3"], end: Float64[Tensor, "n 3"]
) -> tuple[Float64[Tensor, " n"], Float64[Tensor, " n"]]:
    """Transmittance from point to point (0 if blocked), and the length that sheets add [m].

    Args:
        rays: The scene.
        start, end: Points.
    """
    geometry, surfaces = rays.geometry, rays.geometry.surfaces
    if not geometry.sheets:
        clear = visible(rays, start, end).to(start)
        return clear, torch.zeros_like(clear)
    transmittance = torch.ones(len(start), dtype=torch.float64)
    extra = torch.zeros_like(transmittance)
    at = torch.zeros_like(transmittance)
    rows = torch.arange(len(start))
    offset = end - start
    for _ in range(_MOST_SHEETS + 1):
        if not len(rows):
            break
        fixed = start.detach()[rows] + offset.detach()[rows] * at[rows, None]
        hit, step = next_surface(rays, fixed, end.detach()[rows])
        rows, hit, step = rows[hit >= 0], hit[hit >= 0], step[hit >= 0]
        at = at.index_add(0, rows, step * (1 - at[rows]))
        row = geometry.face_surface[hit]
        p0, p1, p2 = geometry.corners(hit)
        normal = normalize(torch.linalg.cross(p1 - p0, p2 - p0), dim=1)
        cosine = (normal * normalize(offset[rows], dim=1)).sum(1)
        factor = torch.ones_like(transmittance).index_copy(
            0, rows, tabulated(surfaces.transmittance, row, cosine)
        )
        transmittance = transmittance * factor
        extra = extra.index_add(0, rows, tabulated(surfaces.extra_length, row, cosine))
        rows = rows[transmittance.detach()[rows] > 0]
    return transmittance * torch.ones_like(transmittance).index_fill(0, rows, 0.0), extra


def path_view(rays: RayScene, frame: Int64[Tensor, " n"], paths: SurfacePaths) -> Echo:
    """Evaluate the radar equation along paths; those that are blocked carry nothing.

    Args:
        rays: The scene and its antennas.
        frame: Radar pose of every path.
        paths: Their points.
    """
    geometry, link = rays.geometry, rays.link
    places = paths.places(geometry)
    echo = radar_equation(geometry, link, frame, places)
    stops = [link.tx[frame], *(p.position for p in places), link.rx[frame]]
    power, length, transmittance = echo.power, echo.length, torch.ones_like(echo.power)
    for number, (start, end) in enumerate(pairwise(stops)):
        if number and link.shared_visibility and len(places) == 1:
            # What the transmitter sees, the receiver sees too.
            start, end = (end, start) if geometry.sheets else stops[:2]
        transmittance, extra = passed(rays, start, end)
        power, length = power * transmittance, length + extra
    ending = echo.ending * transmittance.detach()
    return replace(echo, power=power, length=length, ending=ending)
