"""Boundary paths in torch: how fast a shadow's edge moves over the surface it falls on."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from invertwin.channel.bridge import Geometry, differentiated, to_torch, tracer
from invertwin.channel.edges import EdgeSampler
from invertwin.channel.kernel import Inputs
from invertwin.channel.paths import Link
from invertwin.channel.rays import Shot, visible
from invertwin.errors import InputError


@dataclass(frozen=True)
class EdgePoints:
    """Detached points on silhouettes: edge, place along it, triangle behind, weight."""

    frame: Int64[Tensor, " n"]
    first: Int64[Tensor, " n"]
    second: Int64[Tensor, " n"]
    opposite: Int64[Tensor, " n"]
    along: Float64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    weight: Float64[Tensor, " n"]

    def keep(self, mask: Bool[Tensor, " n"]) -> "EdgePoints":
        """Some of the points."""
        return EdgePoints(*(column[mask] for column in vars(self).values()))


@dataclass(frozen=True)
class Edge:
    """Points on a shadow's edge.

    Attributes:
        frame, face: Radar pose, and the triangle the shadow falls on.
        shadow: Where it falls [m], detached.
        normal: Unit normal there, detached.
        speed: Area newly lit per unit of θ, divided by the sampling density: attached, and
            zero in derivative where the other antenna does not see the point.
    """

    frame: Int64[Tensor, " n"]
    face: Int64[Tensor, " n"]
    shadow: Float64[Tensor, "n 3"]
    normal: Float64[Tensor, "n 3"]
    speed: Float64[Tensor, " n"]


def silhouettes_move(geometry: Geometry, link: Link) -> bool:
    """Whether a derivative flows through anything that decides what is visible."""
    return any(differentiated(value) for value in (geometry.vertices, link.tx, link.rx))


def require_edges(geometry: Geometry, link: Link, samples: int) -> None:
    """Refuse a derivative that would silently leave moving silhouettes out.

    Raises:
        InputError: Silhouettes move and there are no samples of them.
    """
    if samples < 1 and silhouettes_move(geometry, link):
        raise InputError(
            "expected boundary_samples >= 1 for a derivative in which silhouettes move, got "
            f"{samples}; give some, or boundary=False for fixed visibility"
        )


def edge_points(
    shot: Shot, centres: Sequence[str], samples: int, seed: int
) -> list[tuple[str, EdgePoints]]:
    """Sample the silhouettes seen from ``tx``, or from ``tx`` and ``rx``, apart."""
    import drjit as dr

    inputs = Inputs.of(shot.geometry, shot.link, shot, monostatic=False)
    sampler = EdgeSampler(shot, inputs, centres, samples, seed)
    if not sampler.size:
        none, nothing = torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.float64)
        return [("tx", EdgePoints(none, none, none, none, nothing, none, nothing))]
    drawn = sampler.draw(dr.arange(tracer().UInt32, sampler.size)).kept()
    columns = {f.name: to_torch(getattr(drawn, f.name)) for f in fields(EdgePoints)}
    points = EdgePoints(
        **{n: c.double() if n in ("along", "weight") else c.long() for n, c in columns.items()}
    )
    if drawn.receiver is False:
        return [("tx", points)]
    receiver = to_torch(drawn.receiver).bool()
    return [("tx", points.keep(~receiver)), ("rx", points.keep(receiver))]


def shadow_speed(
    geometry: Geometry, link: Link, shot: Shot, points: EdgePoints, centre: str
) -> Edge:
    """Turn edge points into shadow points with the attached speed of the shadow's edge.

    ``T · (x_c − x_m)``: x_c is where the attached ray meets the attached plane behind the edge,
    x_m the material point under it; T is the edge's image turned to the shadowed side.
    Source: derivations §3.
    """
    c = getattr(link, centre)[points.frame]
    y0, y1 = geometry.vertices[points.first], geometry.vertices[points.second]
    y = y0 + (y1 - y0) * points.along[:, None]
    p0, p1, p2 = geometry.corners(points.face)
    plane = torch.linalg.cross(p1 - p0, p2 - p0)
    moving = c + (y - c) * (_dot(plane, p0 - c) / _dot(plane, y - c))[:, None]

    shadow, normal = moving.detach(), torch.nn.functional.normalize(plane.detach(), dim=1)
    b1, b2 = barycentric(shadow, p0.detach(), p1.detach(), p2.detach())
    material = p0 * (1 - b1 - b2)[:, None] + p1 * b1[:, None] + p2 * b2[:, None]

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
        weight = weight * visible(shot, shadow, other)
    speed = _dot(tangent, moving - material) * weight
    return Edge(points.frame, points.face, shadow, normal, speed)


def barycentric(
    point: Float64[Tensor, "n 3"],
    p0: Float64[Tensor, "n 3"],
    p1: Float64[Tensor, "n 3"],
    p2: Float64[Tensor, "n 3"],
) -> tuple[Float64[Tensor, " n"], Float64[Tensor, " n"]]:
    """Second and third barycentric coordinates of points in the planes of triangles."""
    a, b, r = p1 - p0, p2 - p0, point - p0
    aa, ab, bb, ra, rb = _dot(a, a), _dot(a, b), _dot(b, b), _dot(r, a), _dot(r, b)
    determinant = aa * bb - ab * ab
    return (bb * ra - ab * rb) / determinant, (aa * rb - ab * ra) / determinant


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=-1)
