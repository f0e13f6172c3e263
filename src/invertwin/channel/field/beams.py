"""Few flat facets: every bounce by images, with the exactly clipped beams of light.

A beam is the light that a sequence of facets has mirrored. Its source is an image; its cross
section is the lit part of the last facet, seen by that image. The next facet is lit where it lies
in the beam and no other facet stands before it. All parts are convex polygons, clipped by planes
whose corners keep their derivatives: what a moving edge changes comes by itself.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.field.waves import area_vector, cross, dot, mirrored, polygon_integral
from invertwin.channel.rays.topology import Topology

FEW = 24
"""Triangles of a scene up to which beams are clipped exactly."""
_EMPTY = 1e-12  # of the scene's size squared: a polygon of less area is none
_FLAT = 1e-12  # of a polygon's size: a side between less different heights lies in the plane
_BEFORE = 1e-9  # of the scene's size: what rises less above a facet hides nothing of it


@dataclass(frozen=True)
class Facets:
    """Triangles that reflect on both sides.

    Attributes:
        corners: of every facet [m].
        normal: unit normals.
        solid: facets of closed bodies, whose normals point outwards: dark from behind.
        size: of all together [m].
    """

    corners: Float64[Tensor, "facet 3 3"]
    normal: Float64[Tensor, "facet 3"]
    solid: Bool[Tensor, " facet"]
    size: float


def facets_of(vertices: Float64[Tensor, "v 3"], topology: Topology) -> Facets:
    """The triangles of meshes as facets.

    Args:
        vertices: of all meshes [m].
        topology: their faces and edges.
    """
    corners = vertices[topology.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volume = dot(corners.detach()[:, 0], area.detach()) / 6
    solid = torch.zeros(len(corners), dtype=torch.bool)
    for number in range(int(topology.face_object.max()) + 1):
        own = topology.face_object == number
        solid[own] = number not in topology.open_objects and bool(volume[own].sum() > 0)
    extent = vertices.detach().amax(0) - vertices.detach().amin(0)
    return Facets(corners, normalize(area, dim=1), solid, float(extent.norm()))


@dataclass(frozen=True)
class Bounce:
    """Lit patches of one order, rows: each is where one beam ends.

    Attributes:
        aspect: number of the incident wave.
        facet: what is lit.
        normal: of the facet, towards the beam's source.
        direction: d of the beam.
        offset: c, so that the wave has the phase −k(d·x + c) [m].
        polygon: the lit part [m].
        before: the row of the previous order that the beam comes from; −1 at the first.
    """

    aspect: Int64[Tensor, " row"]
    facet: Int64[Tensor, " row"]
    normal: Float64[Tensor, "row 3"]
    direction: Float64[Tensor, "row 3"]
    offset: Float64[Tensor, " row"]
    polygon: Float64[Tensor, "row corner 3"]
    before: Int64[Tensor, " row"]

    def integral(
        self, towards: Float64[Tensor, "row 3"]
    ) -> Callable[[float], Complex128[Tensor, " row"]]:
        """∫ exp(−jk(d·x + c − s·x)) dA over each patch, by wave number k [1/m].

        Args:
            towards: s, to the receiver.
        """
        patches = polygon_integral(self.polygon, towards - self.direction)
        return lambda k: patches(k) * torch.exp(-1j * k * self.offset)


def beams(
    facets: Facets,
    incident: Float64[Tensor, "aspect 3"],
    depth: int,
    *,
    boundary: bool = True,
) -> Iterator[Bounce]:
    """Lit patches of the first order, of the second, and so on, of plane waves.

    Args:
        facets: what is lit.
        incident: d of each wave.
        depth: most bounces.
        boundary: False leaves out of derivatives what moving edges of beams change.
    """
    last = None
    for _ in range(depth):
        last = _next(facets, incident, last)
        if not boundary:
            last = _fixed(facets, last)
        if not len(last.aspect):
            return
        yield last


def _next(facets: Facets, incident: Tensor, last: Bounce | None) -> Bounce:
    """All facets in all beams of one order."""
    count = len(facets.normal)
    if last is None:
        row = torch.arange(len(incident)).repeat_interleave(count)
        aspect, before = row, torch.full_like(row, -1)
        direction, offset = incident[row], torch.zeros(len(row), dtype=torch.float64)
        own = before
    else:
        before = torch.arange(len(last.aspect)).repeat_interleave(count)
        aspect, own = last.aspect[before], last.facet[before]
        normal, d = last.normal[before], last.direction[before]
        direction = mirrored(d, normal)
        # Equal phases on the mirror itself.
        on_mirror = last.polygon[before, 0]
        offset = last.offset[before] + dot(d - direction, on_mirror)
    facet = torch.arange(count).repeat(len(before) // count)
    normal = facets.normal[facet]
    facing = dot(normal, direction).detach()
    keep = (facet != own) & (facing.abs() > 1e-9) & ~(facets.solid[facet] & (facing > 0))
    aspect, facet, before = aspect[keep], facet[keep], before[keep]
    direction, offset = direction[keep], offset[keep]
    normal = -facing[keep].sign()[:, None] * normal[keep]
    bounce = Bounce(aspect, facet, normal, direction, offset, facets.corners[facet], before)
    if last is not None:
        bounce = _within(facets, bounce, last)
    return _unhidden(facets, bounce, last)


def _fixed(facets: Facets, bounce: Bounce) -> Bounce:
    """Patches whose corners are points of their facets and move with these alone."""
    corners = facets.corners[bounce.facet]
    sides = corners[:, 1:] - corners[:, :1]
    places = (bounce.polygon - corners[:, :1]).detach() @ torch.linalg.pinv(sides.detach())
    return replace(bounce, polygon=corners[:, :1] + places @ sides)


def _within(facets: Facets, bounce: Bounce, last: Bounce) -> Bounce:
    """The parts of facets that lie in the beams that a mirror has sent."""
    mirror = last.polygon[bounce.before]
    polygon = _in_front(bounce.polygon, last.normal[bounce.before], mirror[:, 0], 0.0)
    for plane, at, proper in _sides(mirror, bounce.direction):
        polygon = clip(polygon, plane, torch.where(proper, dot(plane, at), -1.0))
    return _proper(facets, bounce, polygon)


def _unhidden(facets: Facets, bounce: Bounce, last: Bounce | None) -> Bounce:
    """What no other facet hides from the source, as convex pieces."""
    for other in range(len(facets.normal)):
        if not len(bounce.aspect):
            break
        shadow = facets.corners[other].expand(len(bounce.aspect), 3, 3)
        shadow = _in_front(shadow, bounce.normal, bounce.polygon[:, 0], _BEFORE * facets.size)
        if last is not None:
            plane, at = last.normal[bounce.before], last.polygon[bounce.before, 0]
            shadow = _in_front(shadow, plane, at, _BEFORE * facets.size)
        bounce = _without(facets, bounce, shadow)
    return bounce


def _without(facets: Facets, bounce: Bounce, shadow: Tensor) -> Bounce:
    """Patches less the prisms along their beams above some polygons."""
    sides = _sides(shadow, bounce.direction)
    covered = bounce.polygon
    for plane, at, proper in sides:
        covered = clip(covered, plane, torch.where(proper, dot(plane, at), -1.0))
    hidden = area_vector(covered).detach().norm(dim=1) > _EMPTY * facets.size**2
    # The prism of a polygon without area, or seen edge-on, hides nothing.
    hidden &= dot(area_vector(shadow), bounce.direction).detach().abs() > _EMPTY * facets.size**2
    if not bool(hidden.any()):
        return bounce
    part = _rows(bounce, hidden)
    pieces, rest = [_rows(bounce, ~hidden)], part.polygon
    for plane, at, proper in sides:
        plane, at, proper = plane[hidden], at[hidden], proper[hidden]
        outside = clip(rest, -plane, torch.where(proper, -dot(plane, at), 1.0))
        pieces.append(_proper(facets, part, outside))
        rest = clip(rest, plane, torch.where(proper, dot(plane, at), -1.0))
    return _joined(pieces)


def _sides(polygon: Tensor, direction: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Planes through a polygon's sides along a direction: inward normal, a point, whether any.

    Corners that coincide have none.
    """
    middle, found = polygon.mean(1), []
    size = (polygon - middle[:, None]).detach().norm(dim=2).amax(1)
    for start, end in zip(polygon.unbind(1), polygon.roll(-1, 1).unbind(1), strict=True):
        plane = cross(end - start, direction)
        length = plane.norm(dim=1)
        proper = length.detach() > 1e-9 * size
        plane = plane / torch.where(proper, length, torch.ones_like(length))[:, None]
        plane = plane * dot(middle - start, plane).detach().sign()[:, None]
        found.append((plane * proper[:, None], start, proper))
    return found


def _in_front(polygon: Tensor, normal: Tensor, point: Tensor, margin: float) -> Tensor:
    return clip(polygon, normal, dot(normal, point) + margin)


def clip(
    polygon: Float64[Tensor, "row corner 3"],
    normal: Float64[Tensor, "row 3"],
    offset: Float64[Tensor, " row"],
) -> Float64[Tensor, "row more 3"]:
    """The parts of convex polygons where n·x ≥ offset; what is left of none is a point.

    Which corners stay is detached; new corners are where sides meet the plane, attached.

    Args:
        polygon: corners in order; some may coincide.
        normal: n.
        offset: [m].
    """
    height = dot(polygon, normal[:, None]) - offset[:, None]
    after = height.roll(-1, 1)
    inside = height.detach() >= 0
    crossed = inside != inside.roll(-1, 1)
    if bool(inside.all()):
        return polygon
    # A side that lies in the plane, or one of no length, is crossed by rounding alone: where it is
    # crossed would have any derivative.
    extent = (polygon - polygon[:, :1]).detach().norm(dim=2).amax(1, keepdim=True)
    steep = crossed & ((height - after).detach().abs() > _FLAT * extent)
    share = height / torch.where(steep, height - after, torch.ones_like(height))
    between = polygon + torch.where(steep, share, 0.0)[..., None] * (polygon.roll(-1, 1) - polygon)
    points = torch.stack([polygon, between], 2).flatten(1, 2)
    kept = torch.stack([inside, crossed], 2).flatten(1, 2)
    order = torch.argsort((~kept).to(torch.int8), dim=1, stable=True)
    number = kept.sum(1)
    width = max(3, int(number.max()))
    # Corners that are left over repeat the last one that is kept.
    slot = torch.minimum(torch.arange(width), (number[:, None] - 1).clamp_min(0))
    index = order.gather(1, slot)
    return points.gather(1, index[..., None].expand(-1, -1, 3))


def _proper(facets: Facets, bounce: Bounce, polygon: Tensor) -> Bounce:
    """Patches with these polygons, without those of no area."""
    keep = area_vector(polygon).detach().norm(dim=1) > _EMPTY * facets.size**2
    rows = _rows(bounce, keep)
    return Bounce(**{**vars(rows), "polygon": polygon[keep]})


def _rows(bounce: Bounce, keep: Tensor) -> Bounce:
    return Bounce(**{name: column[keep] for name, column in vars(bounce).items()})


def _joined(parts: list[Bounce]) -> Bounce:
    width = max(part.polygon.shape[1] for part in parts)

    def wide(polygon: Tensor) -> Tensor:
        last = polygon[:, -1:].expand(-1, width - polygon.shape[1], -1)
        return torch.cat([polygon, last], 1)

    columns = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in vars(parts[0])
        if name != "polygon"
    }
    return Bounce(**columns, polygon=torch.cat([wide(part.polygon) for part in parts]))
