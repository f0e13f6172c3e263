"""Boundary paths of one bounce in torch: how fast a shadow's edge moves over a surface."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.coherent.radar_equation import MaterialPoints, PathTransfer, radar_equation
from invertwin.channel.em.plane_waves import dot
from invertwin.channel.paths import Paths
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.silhouettes import SilhouetteSampler
from invertwin.channel.rays.arrays import to_torch
from invertwin.channel.rays.backend import dr, mi
from invertwin.channel.rays.ray_scene import RayScene, is_visible
from invertwin.channel.rays.scene_tables import interpolate_values


@dataclass(frozen=True)
class _EdgePoints:
    """Silhouette samples as torch tensors, see ``SilhouetteSample``."""

    is_receiver: Bool[Tensor, " n"] | bool
    frame: Int64[Tensor, " n"]
    first_vertex: Int64[Tensor, " n"]
    second_vertex: Int64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    side: Float64[Tensor, " n"]
    edge_parameter: Float64[Tensor, " n"]
    weight: Float64[Tensor, " n"]


@dataclass(frozen=True)
class ProjectedSilhouettes:
    """Points on the edge of a shadow.

    Attributes:
        frame, face: Radar pose, and the triangle the shadow falls on.
        b1, b2: Where on the triangle.
        point: Place where the shadow falls, detached.
        area_rate: Area newly lit per unit of θ, over the probability of the sample: attached, and
            zero in derivative where the other antenna does not see the point.
    """

    frame: Int64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    b1: Float64[Tensor, " n"]
    b2: Float64[Tensor, " n"]
    point: MaterialPoints
    area_rate: Float64[Tensor, " n"]


def project_silhouettes(rays: RayScene, points: "_EdgePoints") -> ProjectedSilhouettes:
    """Turn edge points into shadow points with the attached speed of the shadow's edge.

    ``T · (x_c − x_m)``: x_c is where the attached ray meets the attached plane behind the edge,
    x_m the material point under it; T is the edge's image turned to the shadowed side.
    Source: derivations §3.

    Args:
        rays: The scene and its antennas.
        points: Points on silhouettes, as torch tensors.
    """
    geometry, link = rays.geometry, rays.link
    tx, rx = link.tx[points.frame], link.rx[points.frame]
    from_receiver = torch.as_tensor(points.is_receiver, dtype=torch.bool).reshape(-1, 1)
    c, other = torch.where(from_receiver, rx, tx), torch.where(from_receiver, tx, rx)
    y0, y1 = geometry.vertices[points.first_vertex], geometry.vertices[points.second_vertex]
    y = y0 + (y1 - y0) * points.edge_parameter[:, None]
    p0, p1, p2 = geometry.corners(points.face)
    plane = torch.linalg.cross(p1 - p0, p2 - p0)
    moving = c + (y - c) * (dot(plane, p0 - c) / dot(plane, y - c))[:, None]

    shadow, normal = moving.detach(), normalize(plane.detach(), dim=1)
    b1, b2 = _barycentric(shadow, p0.detach(), p1.detach(), p2.detach())
    material = interpolate_values((p0, p1, p2), b1, b2)

    ray, edge = (y - c).detach(), (y1 - y0).detach()
    stretch = (shadow - c.detach()).norm(dim=1) / ray.norm(dim=1)

    def project(vector: Tensor) -> Tensor:
        along = dot(normal, vector) / dot(normal, ray)
        return stretch[:, None] * (vector - ray * along[:, None])

    covered = points.side * dot(normal, ray).sign()
    tangent = torch.linalg.cross(normal, project(edge)) * covered[:, None]
    weight = points.weight
    if not link.shared_visibility:
        weight = weight * is_visible(rays, shadow, other)
    speed = dot(tangent, moving - material) * weight
    place = MaterialPoints(shadow, normal, torch.ones_like(b1), geometry.face_surface[points.face])
    return ProjectedSilhouettes(points.frame, points.face, b1, b2, place, speed)


def trace_shadow_boundary_paths(
    rays: RayScene,
    samples: int,
    seed: int,
    make_paths: Callable[[ProjectedSilhouettes, PathTransfer], Paths],
) -> list[Paths]:
    """Boundary paths of one bounce, of the segments at all antennas; none without silhouettes.

    Args:
        rays: The scene and its antennas.
        samples: Silhouette points over all antennas and frames.
        seed: Seed of the points.
        make_paths: Makes paths of shadow points and of the radar equation there.
    """
    centres = ("tx",) if rays.link.shared_visibility else ("tx", "rx")
    count = samples // len(centres) * len(centres)
    sampler = SilhouetteSampler(rays, Inputs.from_rays(rays), centres, count, seed)
    if not sampler.size:
        return []
    drawn = sampler.draw(dr.arange(mi.UInt32, sampler.size)).compress()
    receiver = drawn.is_receiver
    indices = drawn.frame, drawn.first_vertex, drawn.second_vertex, drawn.face
    numbers = drawn.side, drawn.edge_parameter, drawn.weight
    points = _EdgePoints(
        receiver if isinstance(receiver, bool) else to_torch(receiver).bool(),
        *(to_torch(column).long() for column in indices),
        *(to_torch(column).double() for column in numbers),
    )
    edge = project_silhouettes(rays, points)
    with torch.no_grad():
        echo = radar_equation(rays.geometry, rays.link, edge.frame, [edge.point])
    return [make_paths(edge, echo)]


def _barycentric(point: Tensor, p0: Tensor, p1: Tensor, p2: Tensor) -> tuple[Tensor, Tensor]:
    """Second and third barycentric coordinates of points in the planes of triangles."""
    a, b, r = p1 - p0, p2 - p0, point - p0
    aa, ab, bb, ra, rb = dot(a, a), dot(a, b), dot(b, b), dot(r, a), dot(r, b)
    determinant = aa * bb - ab * ab
    return (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant
