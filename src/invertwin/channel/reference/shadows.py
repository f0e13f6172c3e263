"""Boundary paths of one bounce in torch: how fast a shadow's edge moves over a surface."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.paths import Paths, joined
from invertwin.channel.power.edges import EdgeSampler
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.geometry import mixed
from invertwin.channel.rays.scene import RayScene, visible
from invertwin.channel.reference.radar_equation import Echo, Place, radar_equation


@dataclass(frozen=True)
class SilhouettePoints:
    """Detached points on silhouettes: edge, place along it, triangle behind, weight."""

    frame: Int64[Tensor, " n"]
    first: Int64[Tensor, " n"]
    second: Int64[Tensor, " n"]
    opposite: Int64[Tensor, " n"]
    along: Float64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    weight: Float64[Tensor, " n"]

    def keep(self, mask: Bool[Tensor, " n"]) -> "SilhouettePoints":
        """Some of the points."""
        return SilhouettePoints(*(column[mask] for column in vars(self).values()))


@dataclass(frozen=True)
class ShadowEdge:
    """Points on the edge of a shadow.

    Attributes:
        frame, face: Radar pose, and the triangle the shadow falls on.
        b1, b2: Where on the triangle.
        place: Place where the shadow falls, detached.
        speed: Area newly lit per unit of θ, over the probability of the sample: attached, and
            zero in derivative where the other antenna does not see the point.
    """

    frame: Int64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    b1: Float64[Tensor, " n"]
    b2: Float64[Tensor, " n"]
    place: Place
    speed: Float64[Tensor, " n"]


def silhouette_points(
    rays: RayScene, centres: Sequence[str], samples: int, seed: int
) -> list[tuple[str, SilhouettePoints]]:
    """Sample the silhouettes seen from ``tx``, or from ``tx`` and ``rx``, apart.

    Args:
        rays: The scene and its antennas.
        centres: Antennas.
        samples: Points over all antennas and frames.
        seed: Seed of the points.
    """
    sampler = EdgeSampler(rays, Inputs.of(rays), centres, samples, seed)
    if not sampler.size:
        none, nothing = torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.float64)
        return [("tx", SilhouettePoints(none, none, none, none, nothing, none, nothing))]
    drawn = sampler.draw(dr.arange(mi.UInt32, sampler.size)).kept()
    columns = {f.name: to_torch(getattr(drawn, f.name)) for f in fields(SilhouettePoints)}
    points = SilhouettePoints(
        **{n: c.double() if n in ("along", "weight") else c.long() for n, c in columns.items()}
    )
    if drawn.receiver is False:
        return [("tx", points)]
    receiver = to_torch(drawn.receiver).bool()
    return [("tx", points.keep(~receiver)), ("rx", points.keep(receiver))]


def shadow_edge(rays: RayScene, points: SilhouettePoints, centre: str) -> ShadowEdge:
    """Turn edge points into shadow points with the attached speed of the shadow's edge.

    ``T · (x_c − x_m)``: x_c is where the attached ray meets the attached plane behind the edge,
    x_m the material point under it; T is the edge's image turned to the shadowed side.
    Source: derivations §3.

    Args:
        rays: The scene and its antennas.
        points: Points on silhouettes.
        centre: The antenna from which the shadows are cast.
    """
    geometry, link = rays.geometry, rays.link
    c = getattr(link, centre)[points.frame]
    y0, y1 = geometry.vertices[points.first], geometry.vertices[points.second]
    y = y0 + (y1 - y0) * points.along[:, None]
    p0, p1, p2 = geometry.corners(points.face)
    plane = torch.linalg.cross(p1 - p0, p2 - p0)
    moving = c + (y - c) * (_dot(plane, p0 - c) / _dot(plane, y - c))[:, None]

    shadow, normal = moving.detach(), normalize(plane.detach(), dim=1)
    b1, b2 = barycentric(shadow, p0.detach(), p1.detach(), p2.detach())
    material = mixed((p0, p1, p2), b1, b2)

    ray, edge = (y - c).detach(), (y1 - y0).detach()
    stretch = (shadow - c.detach()).norm(dim=1) / ray.norm(dim=1)

    def projected(vector: Tensor) -> Tensor:
        along = _dot(normal, vector) / _dot(normal, ray)
        return stretch[:, None] * (vector - ray * along[:, None])

    covered = geometry.vertices.detach()[points.opposite] - y.detach()
    tangent = torch.linalg.cross(normal, projected(edge))
    tangent = tangent * _dot(tangent, projected(covered)).sign()[:, None]
    weight = points.weight
    if not link.shared_visibility:
        other = (link.rx if centre == "tx" else link.tx)[points.frame]
        weight = weight * visible(rays, shadow, other)
    speed = _dot(tangent, moving - material) * weight
    ones = torch.ones_like(b1)
    place = Place(shadow, normal, ones, geometry.face_surface[points.face])
    return ShadowEdge(points.frame, points.face, b1, b2, place, speed)


def boundary_rows(
    rays: RayScene, samples: int, seed: int, row: Callable[[ShadowEdge, Echo], Paths]
) -> Paths:
    """Boundary paths of one bounce, of the segments at all antennas.

    Args:
        rays: The scene and its antennas.
        samples: Silhouette points over all antennas and frames.
        seed: Seed of the points.
        row: Makes paths of shadow points and of the radar equation there.
    """
    centres = ("tx",) if rays.link.shared_visibility else ("tx", "rx")
    count = samples // len(centres) * len(centres)
    parts = []
    for centre, points in silhouette_points(rays, centres, count, seed):
        edge = shadow_edge(rays, points, centre)
        with torch.no_grad():
            echo = radar_equation(rays.geometry, rays.link, edge.frame, [edge.place])
        parts.append(row(edge, echo))
    return joined(parts)


def barycentric(
    point: Float64[Tensor, "n 3"],
    p0: Float64[Tensor, "n 3"],
    p1: Float64[Tensor, "n 3"],
    p2: Float64[Tensor, "n 3"],
) -> tuple[Float64[Tensor, " n"], Float64[Tensor, " n"]]:
    """Second and third barycentric coordinates of points in the planes of triangles.

    Args:
        point: Points.
        p0, p1, p2: Corners.
    """
    a, b, r = p1 - p0, p2 - p0, point - p0
    aa, ab, bb, ra, rb = _dot(a, a), _dot(a, b), _dot(b, b), _dot(r, a), _dot(r, b)
    determinant = aa * bb - ab * ab
    return (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=-1)
