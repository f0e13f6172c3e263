"""Few flat facets: every bounce by images, with the exactly clipped beams of light.

A beam is the light that a sequence of facets has mirrored. Its source is an image; its cross
section is the lit part of the last facet, seen by that image. The next facet is lit where it lies
in the beam and no other facet stands before it. All parts are convex polygons, clipped by planes
whose corners keep their derivatives: what a moving edge changes comes by itself.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.dielectric_solids import AIR, Solids, refracted
from invertwin.channel.em.plane_waves import area_vector, cross, dot, mirrored, polygon_integral
from invertwin.channel.rays.topology import Topology

FEW = 24
"""Triangles of a scene up to which beams are clipped exactly."""
_EMPTY = 1e-12  # of the scene's size squared: a polygon of less area is none
_FLAT = 1e-12  # of a polygon's size: a side between less different heights lies in the plane
_LOST = 1e-6  # amplitude that losses leave of a wave, below which it is dropped
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
        offset: c [m].
        polygon: the lit part [m].
        before: the row of the previous order that the beam comes from; −1 at the first.
        wave: K, so that the wave has the phase −k(K·x + c): d in air, complex where it decays.
        medium: number of the solid that the beam is in; −1 = air.
        passed: whether it has crossed the face where it comes from, and was not mirrored there.
        spread: its field over that of a plane wave, by how the ways of neighbours spread.
    """

    aspect: Int64[Tensor, " row"]
    facet: Int64[Tensor, " row"]
    normal: Float64[Tensor, "row 3"]
    direction: Float64[Tensor, "row 3"]
    offset: Tensor
    polygon: Float64[Tensor, "row corner 3"]
    before: Int64[Tensor, " row"]
    wave: Tensor
    medium: Int64[Tensor, " row"]
    passed: Bool[Tensor, " row"]
    spread: Tensor

    def integral(
        self, towards: Float64[Tensor, "row 3"]
    ) -> Callable[[float], Complex128[Tensor, " row"]]:
        """∫ exp(−jk(K·x + c − s·x)) dA over each patch, by wave number k [1/m].

        Args:
            towards: s, to the receiver.
        """
        way = towards - self.wave
        if not way.is_complex():
            patches = polygon_integral(self.polygon, way)
            return lambda k: patches(k) * torch.exp(-1j * k * self.offset)
        # About a corner: far from the origin, decaying waves are out of range.
        start = self.polygon[:, 0]
        patches = polygon_integral(self.polygon - start[:, None], way)
        phase = dot(way, start) - self.offset
        return lambda k: patches(k) * torch.exp(1j * k * phase)


def in_air(
    aspect: Int64[Tensor, " row"],
    facet: Int64[Tensor, " row"],
    normal: Float64[Tensor, "row 3"],
    direction: Float64[Tensor, "row 3"],
    offset: Float64[Tensor, " row"],
    polygon: Float64[Tensor, "row corner 3"],
    before: Int64[Tensor, " row"],
) -> Bounce:
    """Lit patches of waves that no solid has let in.

    Args:
        aspect, facet, normal, direction, offset, polygon, before: as in `Bounce`.
    """
    air, plain = torch.full_like(aspect, AIR), torch.ones_like(offset)
    none = torch.zeros_like(aspect, dtype=torch.bool)
    return Bounce(
        aspect, facet, normal, direction, offset, polygon, before, direction, air, none, plain
    )


def beams(
    facets: Facets,
    incident: Float64[Tensor, "aspect 3"],
    depth: int,
    *,
    boundary: bool = True,
    solids: Solids | None = None,
) -> Iterator[Bounce]:
    """Lit patches of the first order, of the second, and so on, of plane waves.

    Args:
        facets: what is lit.
        incident: d of each wave.
        depth: most bounces.
        boundary: False leaves out of derivatives what moving edges of beams change.
        solids: what waves enter; None = nothing.

    Raises:
        InputError: a dielectric within another one, or in touch with it.
    """
    last = None
    for _ in range(depth):
        last = _next(facets, incident, last, solids)
        if not boundary:
            last = _fixed(facets, last)
        if not len(last.aspect):
            return
        yield last


class _Source(NamedTuple):
    """Beams that set out, one row each; ``side`` is normal to where from, on their side of it."""

    aspect: Tensor
    own: Tensor
    before: Tensor
    side: Tensor
    at: Tensor
    direction: Tensor
    offset: Tensor
    wave: Tensor
    medium: Tensor
    passed: Tensor


def _next(facets: Facets, incident: Tensor, last: Bounce | None, solids: Solids | None) -> Bounce:
    """All facets in all beams of one order."""
    count = len(facets.normal)
    begun = _first(incident, solids) if last is None else _onwards(last, solids)
    source = torch.arange(len(begun.aspect)).repeat_interleave(count)
    facet = torch.arange(count).repeat(len(begun.aspect))
    facing = dot(facets.normal[facet], begun.direction[source]).detach()
    lit = ~(facets.solid[facet] & (facing > 0))
    if solids is not None:
        within = begun.medium[source] == solids.owner[facet]
        lit = torch.where(within, facing > 0, lit)
    keep = (facet != begun.own[source]) & (facing.abs() > 1e-9) & lit
    source, facet = source[keep], facet[keep]
    normal = -facing[keep].sign()[:, None] * facets.normal[facet]
    bounce = Bounce(
        begun.aspect[source],
        facet,
        normal,
        begun.direction[source],
        begun.offset[source],
        facets.corners[facet],
        source,
        begun.wave[source],
        begun.medium[source],
        begun.passed[source],
        torch.ones(len(source), dtype=torch.float64),
    )
    if last is not None:
        bounce = _within(facets, bounce, last, begun)
    bounce = _unhidden(facets, bounce, None if last is None else begun, solids)
    bounce = replace(bounce, before=begun.before[bounce.before])
    if solids is None:
        return bounce
    bounce = rows_of(bounce, left(bounce, solids.wave_number))
    solids.check(bounce.facet, bounce.medium)
    return bounce


def _first(incident: Tensor, solids: Solids | None) -> _Source:
    """Plane waves from far away."""
    none = torch.full((len(incident),), -1)
    wave = incident if solids is None else incident.to(torch.complex128)
    zeros = torch.zeros(len(incident), dtype=wave.dtype)
    aspect = torch.arange(len(incident))
    at, passed = torch.zeros_like(incident), none >= 0
    return _Source(aspect, none, none, at, at, incident, zeros, wave, none, passed)


def _onwards(last: Bounce, solids: Solids | None) -> _Source:
    """What a mirror sends on, and after that what faces of solids let through."""
    direction, wave = mirrored(last.direction, last.normal), mirrored(last.wave, last.normal)
    row, at = torch.arange(len(last.aspect)), last.polygon[:, 0]
    passed = torch.zeros_like(row, dtype=torch.bool)
    medium, side = last.medium, last.normal
    if solids is not None:
        behind = solids.behind(last.facet, last.medium)
        through, going = refracted(solids.inside(behind), last.wave, last.normal)
        some = torch.nonzero(going & solids.clear[last.facet])[:, 0]
        row = torch.cat([row, some])
        at = at[row]
        passed = torch.cat([passed, torch.ones_like(some, dtype=torch.bool)])
        wave = torch.cat([wave, through[some]])
        direction = torch.cat([direction, normalize(through[some].real, dim=1)])
        medium = torch.cat([medium, behind[some]])
        side = torch.cat([side, -last.normal[some]])
    # Equal phases on the face itself.
    offset = last.offset[row] + dot(last.wave[row] - wave, at.to(wave.dtype))
    aspect, own = last.aspect[row], last.facet[row]
    return _Source(aspect, own, row, side, at, direction, offset, wave, medium, passed)


def left(bounce: Bounce, wave_number: float) -> Bool[Tensor, " row"]:
    """Whether losses leave anything of waves.

    Args:
        bounce: where they end.
        wave_number: k [1/m].
    """
    way = (dot(bounce.wave[:, None], bounce.polygon.to(bounce.wave.dtype)).detach()).imag
    way = way + bounce.offset.detach().imag[:, None]
    return wave_number * way.amax(1) > math.log(_LOST)


def _fixed(facets: Facets, bounce: Bounce) -> Bounce:
    """Patches whose corners are points of their facets and move with these alone."""
    corners = facets.corners[bounce.facet]
    sides = corners[:, 1:] - corners[:, :1]
    places = (bounce.polygon - corners[:, :1]).detach() @ torch.linalg.pinv(sides.detach())
    return replace(bounce, polygon=corners[:, :1] + places @ sides)


def _within(facets: Facets, bounce: Bounce, last: Bounce, begun: _Source) -> Bounce:
    """The parts of facets that lie in the beams that a mirror, or a face, has sent."""
    mirror = last.polygon[begun.before[bounce.before]]
    polygon = _in_front(bounce.polygon, begun.side[bounce.before], mirror[:, 0], 0.0)
    for plane, at, proper in _sides(mirror, bounce.direction):
        polygon = clip(polygon, plane, torch.where(proper, dot(plane, at), -1.0))
    return _proper(facets, bounce, polygon)


def _unhidden(
    facets: Facets, bounce: Bounce, begun: _Source | None, solids: Solids | None
) -> Bounce:
    """What no other facet hides from the source, as convex pieces."""
    for other in range(len(facets.normal)):
        if not len(bounce.aspect):
            break
        above: Tensor | float = _BEFORE * facets.size
        if solids is not None and bool(solids.conducting[other]):
            # A conductor that touches a dielectric is what waves meet there, from either side.
            above = torch.where(solids.conducting[bounce.facet], above, -above)
        shadow = facets.corners[other].expand(len(bounce.aspect), 3, 3)
        shadow = _in_front(shadow, bounce.normal, bounce.polygon[:, 0], above)
        if begun is not None:
            plane, at = begun.side[bounce.before], begun.at[bounce.before]
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
    part = rows_of(bounce, hidden)
    pieces, rest = [rows_of(bounce, ~hidden)], part.polygon
    for plane, at, proper in sides:
        plane, at, proper = plane[hidden], at[hidden], proper[hidden]
        outside = clip(rest, -plane, torch.where(proper, -dot(plane, at), 1.0))
        pieces.append(_proper(facets, part, outside))
        rest = clip(rest, plane, torch.where(proper, dot(plane, at), -1.0))
    return joined(pieces)


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


def _in_front(polygon: Tensor, normal: Tensor, point: Tensor, margin: Tensor | float) -> Tensor:
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
    rows = rows_of(bounce, keep)
    return Bounce(**{**vars(rows), "polygon": polygon[keep]})


def rows_of(bounce: Bounce, keep: Tensor) -> Bounce:
    """Some rows.

    Args:
        bounce: patches.
        keep: which.
    """
    return Bounce(**{name: column[keep] for name, column in vars(bounce).items()})


def joined(parts: Sequence[Bounce]) -> Bounce:
    """All rows of several; polygons of few corners repeat their last.

    Args:
        parts: one or more.
    """
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
