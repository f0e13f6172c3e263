"""The radar equation of a path in torch, float64: the slow reference of the power kernels.

Positions and lengths come from float64 vertices, so that the phase is right at millimetre waves:
fields are made of it, too. A path is a row of material points; its power is the product of its
segments' 1/R², the scattering at its points and the gains of both antennas.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeAlias

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import triangle_normals
from invertwin.channel.paths import Link, Paths, make_paths
from invertwin.channel.rays.ray_scene import RayScene, find_passed_sheets
from invertwin.channel.rays.scene_tables import Geometry, interpolate_values
from invertwin.channel.rows import Rows
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene.material.fresnel import safe_root

_Numbers: TypeAlias = Int64[Tensor, " n"]


@dataclass(frozen=True)
class MaterialPoints(Rows):
    """Material points, one row each.

    Attributes:
        position, normal: Attached [m].
        jacobian: Area of the triangle over that area detached: one in value.
        row: Row of the surface in the tables.
    """

    position: Float64[Tensor, "n 3"]
    normal: Float64[Tensor, "n 3"]
    jacobian: Float64[Tensor, " n"]
    row: _Numbers


@dataclass(frozen=True)
class SurfacePaths(Rows):
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

    def material_points(self, geometry: Geometry) -> list[MaterialPoints]:
        """Locate material points."""
        found = []
        for face, b1, b2 in zip(self.face.T, self.b1.T, self.b2.T, strict=True):
            p0, p1, p2 = geometry.corners(face)
            normal = torch.linalg.cross(p1 - p0, p2 - p0)
            double_area = normal.norm(dim=1)
            position, row = interpolate_values((p0, p1, p2), b1, b2), geometry.face_surface[face]
            jacobian = double_area / double_area.detach()
            found.append(MaterialPoints(position, normal / double_area[:, None], jacobian, row))
        return found

    def velocity(self, geometry: Geometry) -> Float64[Tensor, "n 3"] | None:
        """World velocity of the last points [m/s]; None if all objects are at rest."""
        return geometry.velocity(self.face[:, -1], self.b1[:, -1], self.b2[:, -1])


@dataclass(frozen=True)
class PathTransfer:
    """Power and geometry of paths, attached; one row a path.

    Attributes:
        frame: Radar pose.
        points: The points of the paths, in order from the transmitter.
        power: Received over transmitted power per m² of every point; Jacobians included.
        incident_power: The same at the last point, before it scatters.
        spreading: Gains and 1/R² alone: the power without scattering, over (λ/4π)².
        length: Length from antenna to antenna [m].
        depolarisation: Share of the power that changes its polarisation, at every point.
    """

    frame: _Numbers
    points: Sequence[MaterialPoints]
    power: Float64[Tensor, " n"]
    incident_power: Float64[Tensor, " n"]
    spreading: Float64[Tensor, " n"]
    length: Float64[Tensor, " n"]
    depolarisation: Sequence[Float64[Tensor, " n"]]

    def to_paths(self, kind: str, **given: Any) -> Paths:
        """Paths of one kind.

        Args:
            kind, given: Arguments of ``make_paths``.
        """
        ends = self.points[0].position, self.points[-1].position
        return make_paths(self.frame, self.length / SPEED_OF_LIGHT, *ends, kind=kind, **given)


def radar_equation(
    geometry: Geometry, link: Link, frame: _Numbers, points: Sequence[MaterialPoints]
) -> PathTransfer:
    """Evaluate the radar equation of paths from antenna to antenna; nothing is in their way.

    ``(λ/4π)² G_t G_r Π 1/R² Π f |cosθ| |cosθ'|``, with the attenuation of segments inside bodies.

    Args:
        geometry: The scene.
        link: Antennas.
        frame: Radar pose of every path.
        points: The points of the paths, in order from the transmitter.
    """
    stops = [link.tx[frame], *(p.position for p in points), link.rx[frame]]
    offsets = [end - start for start, end in pairwise(stops)]
    distances = [offset.norm(dim=1) for offset in offsets]
    ways = [offset / r[:, None] for offset, r in zip(offsets, distances, strict=True)]

    def to_radar_frame(direction: Tensor) -> Tensor:
        return torch.einsum("nij,ni->nj", link.rotations[frame], direction)

    spread = link.tx_pattern.gain(to_radar_frame(ways[0])) / distances[0] ** 2
    ending = link.rx_pattern.gain(to_radar_frame(-ways[-1])) / distances[-1] ** 2
    length = distances[0] + distances[-1]
    for number, (start, end) in enumerate(pairwise(points), start=1):
        index, attenuation = _segment_medium(geometry, start, end, ways[number])
        spread = spread * torch.exp(-attenuation * distances[number]) / distances[number] ** 2
        length = length + index * distances[number]
    turns = list(zip(points, ways, ways[1:], strict=False))
    *earlier, last = (
        point.jacobian * evaluate_scattering(geometry, point, -back, on)
        for point, back, on in turns
    )
    arriving = math.prod(earlier, start=(link.wavelength / (4 * torch.pi)) ** 2 * spread)
    turned = []  # χ of what is scattered; refraction keeps the polarisation
    for point, back, on in turns:
        same_side = (point.normal * -back).sum(1) * (point.normal * on).sum(1) > 0
        turned.append(torch.where(same_side, geometry.surfaces.depolarisation[point.row], 0.0))
    power = arriving * last * ending
    return PathTransfer(frame, points, power, arriving, spread * ending, length, turned)


def evaluate_scattering(
    geometry: Geometry, point: MaterialPoints, incident: Tensor, outgoing: Tensor
) -> Tensor:
    """``f |cosθ| |cosθ'|`` between unit directions that point away from the surface.

    On one side, ``f`` is the distribution of ``scene.material``; through the interface of a body,
    see ``ScatteringLawTables.evaluate_refraction``.

    Args:
        geometry: The scene.
        point: Point on it.
        incident: Unit directions to the previous vertex.
        outgoing: Unit directions to the next vertex.
    """
    surfaces, row, normal = geometry.surfaces, point.row, point.normal
    pairs = (normal, incident), (normal, outgoing), (incident, outgoing)
    first, second, between = ((a * b).sum(1) for a, b in pairs)
    product = first * second
    shape = surfaces.diffuse[row] / torch.pi
    for number, cosine in enumerate((2 * product - between, 2 * product - between, between)):
        if geometry.has_lobe[number]:
            half = (0.5 * (1 + cosine)).clamp_min(1e-7)
            lobe = surfaces.lobes[row, number] * half ** surfaces.exponents[row, number]
            if number == 0 and geometry.has_spread:
                for tilt in (first, second):
                    lobe = lobe * _interpolate_table(surfaces.spread, row, tilt)
            shape = shape + lobe
    outer = [_outer_cosine(geometry, row, cosine) for cosine in (first, second)]
    reflectance = torch.ones_like(product)
    for cosine, total in outer:
        amplitude = _interpolate_table(surfaces.amplitude, row, cosine)
        reflectance = reflectance * torch.where(total, 1.0, amplitude)
    value = torch.where(product > 0, reflectance * shape * product, 0.0)
    if not geometry.has_refracting_bodies:
        return value
    variance = 2 / surfaces.exponents[row, 0].clamp_min(1.0)
    root, index = torch.ones_like(product), torch.ones_like(product)
    mismatch = torch.zeros_like(normal)
    for (cosine, total), direction, tilt in zip(
        outer, (incident, outgoing), (first, second), strict=True
    ):
        passing = _interpolate_table(surfaces.refraction, row, cosine)
        root = root * safe_root(torch.where(total, 0.0, passing), 0.0)
        index = torch.where(tilt < 0, surfaces.index[row], 1.0)
        mismatch = mismatch + index[:, None] * (direction - normal * tilt[:, None])
    lobe = torch.exp(-mismatch.square().sum(1) / (2 * variance)) / (2 * torch.pi * variance)
    return torch.where(product < 0, root * index**2 * lobe * product.abs(), value)


def _outer_cosine(geometry: Geometry, row: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine on the outer side of an interface (Snell), and whether there is none."""
    if not geometry.has_refracting_bodies:
        return cosine, torch.zeros_like(cosine, dtype=torch.bool)
    inside = cosine < 0
    square = 1 - geometry.surfaces.index[row] ** 2 * (1 - cosine**2)
    total = inside & (square <= 1e-6)
    return torch.where(inside, torch.where(inside & ~total, square, 1.0).sqrt(), cosine), total


def _segment_medium(
    geometry: Geometry, start: MaterialPoints, end: MaterialPoints, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """Refractive index and attenuation of the medium between two points."""
    index, attenuation = torch.ones_like(direction[:, 0]), torch.zeros_like(direction[:, 0])
    surfaces = geometry.surfaces
    for point, sign in ((start, 1.0), (end, -1.0)) if geometry.has_refracting_bodies else ():
        inside = (point.normal * direction).sum(1) * sign < 0
        inside &= surfaces.refraction[point.row, -1] > 0
        index = torch.where(inside, surfaces.index[point.row], index)
        attenuation = torch.where(inside, surfaces.attenuation[point.row], attenuation)
    return index, attenuation


def _interpolate_table(table: Tensor, row: _Numbers, cosine: Tensor) -> Tensor:
    """A table over |cosθ|, linear between its entries."""
    entries = table.shape[1]
    t = cosine.abs().clamp_max(1.0) * (entries - 1)
    low = t.detach().long().clamp_max(entries - 2)
    first, second = table[row, low], table[row, low + 1]
    return first + (second - first) * (t - low)


def trace_transmittance(
    rays: RayScene, start: Float64[Tensor, "n 3"], end: Float64[Tensor, "n 3"]
) -> tuple[Float64[Tensor, " n"], Float64[Tensor, " n"]]:
    """Transmittance from point to point (0 if blocked), and the length that sheets add [m].

    Args:
        rays: The scene.
        start, end: Points.
    """
    geometry, surfaces = rays.geometry, rays.geometry.surfaces
    sheets = surfaces.transmittance.any(1)[geometry.face_surface]
    clear, passed = find_passed_sheets(rays, start.detach(), end.detach(), sheets)
    transmittance, extra = clear.to(start), torch.zeros_like(start[:, 0])
    for number, face in passed:
        row, corners = geometry.face_surface[face], geometry.vertices[geometry.faces[face]]
        way = normalize((end - start)[number], dim=1)
        cosine = (triangle_normals(corners) * way).sum(1)
        share = _interpolate_table(surfaces.transmittance, row, cosine)
        transmittance = transmittance * torch.ones_like(extra).index_copy(0, number, share)
        added = _interpolate_table(surfaces.extra_length, row, cosine)
        extra = extra.index_add(0, number, added)
    return transmittance, extra


def find_unblocked(rays: RayScene, frame: _Numbers, paths: SurfacePaths) -> Bool[Tensor, " n"]:
    """Find the paths that nothing but sheets intersects.

    Args:
        rays: The scene and its antennas.
        frame: Radar pose of every path.
        paths: The points of the paths.
    """
    with torch.no_grad():
        passes = _trace_segments(rays, frame, paths.material_points(rays.geometry))
        return torch.stack([transmittance > 0 for transmittance, _ in passes]).all(0)


def evaluate_paths(rays: RayScene, frame: _Numbers, paths: SurfacePaths) -> PathTransfer:
    """Evaluate the radar equation along unblocked paths, past the sheets in their way.

    Args:
        rays: The scene and its antennas.
        frame: Radar pose of every path.
        paths: The points of the paths.
    """
    echo = radar_equation(rays.geometry, rays.link, frame, paths.material_points(rays.geometry))
    if not rays.geometry.has_sheets:
        return echo
    (*earlier, last), extras = zip(*_trace_segments(rays, frame, echo.points), strict=True)
    before = math.prod(earlier)
    return replace(
        echo,
        power=echo.power * before * last,
        incident_power=echo.incident_power * before,
        spreading=echo.spreading * before * last,
        length=echo.length + sum(extras),
    )


def _trace_segments(
    rays: RayScene, frame: Tensor, points: Sequence[MaterialPoints]
) -> list[tuple[Tensor, Tensor]]:
    """Trace the transmission of all segments of paths, see ``trace_transmittance``."""
    link = rays.link
    stops = [link.tx[frame], *(place.position for place in points), link.rx[frame]]
    found: list[tuple[Tensor, Tensor]] = []
    for start, end in pairwise(stops):
        # What the transmitter sees of a single point, the receiver sees too.
        again = bool(found) and link.shared_visibility and len(points) == 1
        if again and not rays.geometry.has_sheets:
            found += found
        else:
            found.append(trace_transmittance(rays, *(end, start) if again else (start, end)))
    return found
