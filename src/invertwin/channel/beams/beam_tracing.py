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

from invertwin.channel.em.dielectric_solids import AIR, DielectricSolids, refract_waves
from invertwin.channel.em.plane_waves import (
    area_vector,
    cross,
    dot,
    polygon_integral,
    reflect_vectors,
)
from invertwin.channel.rays.topology import Topology

MAX_FACETS_BEAM_TRACING = 24
"""Triangles of a scene up to which beams are clipped exactly."""
_MIN_AREA = 1e-12  # of the scene's size squared: a polygon of less area is none
_COPLANAR_TOLERANCE = (
    1e-12  # of a polygon's size: a side between less different heights lies in the plane
)
_MIN_AMPLITUDE = 1e-6  # amplitude that losses leave of a wave, below which it is dropped
_OCCLUSION_TOLERANCE = (
    1e-9  # of the scene's size: what rises less above a facet hides nothing of it
)


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


def build_facets(vertices: Float64[Tensor, "v 3"], topology: Topology) -> Facets:
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
class IlluminatedPatches:
    """Lit patches of one order, rows: each is where one beam ends.

    Attributes:
        aspect: number of the incident wave.
        facet: what is lit.
        normal: of the facet, towards the beam's source.
        direction: d of the beam.
        phase_offset: c [m].
        polygon: the lit part [m].
        parent: the row of the previous order that the beam comes from; −1 at the first.
        wave_vector: K, so that the wave has the phase −k(K·x + c): d in air, complex where it
            decays.
        medium: number of the solid that the beam is in; −1 = air.
        transmitted: whether it has crossed the face where it comes from, and was not mirrored
            there.
        spreading: its field over that of a plane wave, by how the ways of neighbours spread.
    """

    aspect: Int64[Tensor, " row"]
    facet: Int64[Tensor, " row"]
    normal: Float64[Tensor, "row 3"]
    direction: Float64[Tensor, "row 3"]
    phase_offset: Tensor
    polygon: Float64[Tensor, "row corner 3"]
    parent: Int64[Tensor, " row"]
    wave_vector: Tensor
    medium: Int64[Tensor, " row"]
    transmitted: Bool[Tensor, " row"]
    spreading: Tensor

    def phase_integral(
        self, scattering_direction: Float64[Tensor, "row 3"]
    ) -> Callable[[float], Complex128[Tensor, " row"]]:
        """∫ exp(−jk(K·x + c − s·x)) dA over each patch, by wave number k [1/m].

        Args:
            scattering_direction: s, to the receiver.
        """
        way = scattering_direction - self.wave_vector
        if not way.is_complex():
            patches = polygon_integral(self.polygon, way)
            return lambda k: patches(k) * torch.exp(-1j * k * self.phase_offset)
        # About a corner: far from the origin, decaying waves are out of range.
        start = self.polygon[:, 0]
        patches = polygon_integral(self.polygon - start[:, None], way)
        phase = dot(way, start) - self.phase_offset
        return lambda k: patches(k) * torch.exp(1j * k * phase)


def patches_in_air(
    aspect: Int64[Tensor, " row"],
    facet: Int64[Tensor, " row"],
    normal: Float64[Tensor, "row 3"],
    direction: Float64[Tensor, "row 3"],
    phase_offset: Float64[Tensor, " row"],
    polygon: Float64[Tensor, "row corner 3"],
    parent: Int64[Tensor, " row"],
) -> IlluminatedPatches:
    """Lit patches of waves that no solid has let in.

    Args:
        aspect, facet, normal, direction, phase_offset, polygon, parent: as in `IlluminatedPatches`.
    """
    air, plain = torch.full_like(aspect, AIR), torch.ones_like(phase_offset)
    none = torch.zeros_like(aspect, dtype=torch.bool)
    return IlluminatedPatches(
        aspect, facet, normal, direction, phase_offset, polygon, parent, direction, air, none, plain
    )


def trace_beams(
    facets: Facets,
    incident: Float64[Tensor, "aspect 3"],
    depth: int,
    *,
    boundary: bool = True,
    solids: DielectricSolids | None = None,
) -> Iterator[IlluminatedPatches]:
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
        last = _trace_order(facets, incident, last, solids)
        if not boundary:
            last = _attach_to_facets(facets, last)
        if not len(last.aspect):
            return
        yield last


class _DepartingBeams(NamedTuple):
    """Beams that set out, one row each; ``side`` is normal to where from, on their side of it."""

    aspect: Tensor
    source_facet: Tensor
    parent: Tensor
    source_normal: Tensor
    source_point: Tensor
    direction: Tensor
    phase_offset: Tensor
    wave_vector: Tensor
    medium: Tensor
    transmitted: Tensor


def _trace_order(
    facets: Facets,
    incident: Tensor,
    previous: IlluminatedPatches | None,
    solids: DielectricSolids | None,
) -> IlluminatedPatches:
    """All facets in all beams of one order."""
    count = len(facets.normal)
    begun = (
        _launch_plane_waves(incident, solids)
        if previous is None
        else _continue_beams(previous, solids)
    )
    source = torch.arange(len(begun.aspect)).repeat_interleave(count)
    facet = torch.arange(count).repeat(len(begun.aspect))
    facing = dot(facets.normal[facet], begun.direction[source]).detach()
    lit = ~(facets.solid[facet] & (facing > 0))
    if solids is not None:
        within = begun.medium[source] == solids.owner[facet]
        lit = torch.where(within, facing > 0, lit)
    keep = (facet != begun.source_facet[source]) & (facing.abs() > 1e-9) & lit
    source, facet = source[keep], facet[keep]
    normal = -facing[keep].sign()[:, None] * facets.normal[facet]
    bounce = IlluminatedPatches(
        begun.aspect[source],
        facet,
        normal,
        begun.direction[source],
        begun.phase_offset[source],
        facets.corners[facet],
        source,
        begun.wave_vector[source],
        begun.medium[source],
        begun.transmitted[source],
        torch.ones(len(source), dtype=torch.float64),
    )
    if previous is not None:
        bounce = _clip_to_beams(facets, bounce, previous, begun)
    bounce = _remove_occluded(facets, bounce, None if previous is None else begun, solids)
    bounce = replace(bounce, parent=begun.parent[bounce.parent])
    if solids is None:
        return bounce
    bounce = select_patches(bounce, exceeds_min_amplitude(bounce, solids.wave_number))
    solids.require_gaps(bounce.facet, bounce.medium)
    return bounce


def _launch_plane_waves(incident: Tensor, solids: DielectricSolids | None) -> _DepartingBeams:
    """Plane waves from far away."""
    none = torch.full((len(incident),), -1)
    wave = incident if solids is None else incident.to(torch.complex128)
    zeros = torch.zeros(len(incident), dtype=wave.dtype)
    aspect = torch.arange(len(incident))
    at, passed = torch.zeros_like(incident), none >= 0
    return _DepartingBeams(aspect, none, none, at, at, incident, zeros, wave, none, passed)


def _continue_beams(
    previous: IlluminatedPatches, solids: DielectricSolids | None
) -> _DepartingBeams:
    """What a mirror sends on, and after that what faces of solids let through."""
    direction, wave = (
        reflect_vectors(previous.direction, previous.normal),
        reflect_vectors(previous.wave_vector, previous.normal),
    )
    row, at = torch.arange(len(previous.aspect)), previous.polygon[:, 0]
    passed = torch.zeros_like(row, dtype=torch.bool)
    medium, side = previous.medium, previous.normal
    if solids is not None:
        behind = solids.medium_behind(previous.facet, previous.medium)
        through, going = refract_waves(
            solids.permittivity_in(behind), previous.wave_vector, previous.normal
        )
        some = torch.nonzero(going & solids.transparent[previous.facet])[:, 0]
        row = torch.cat([row, some])
        at = at[row]
        passed = torch.cat([passed, torch.ones_like(some, dtype=torch.bool)])
        wave = torch.cat([wave, through[some]])
        direction = torch.cat([direction, normalize(through[some].real, dim=1)])
        medium = torch.cat([medium, behind[some]])
        side = torch.cat([side, -previous.normal[some]])
    # Equal phases on the face itself.
    offset = previous.phase_offset[row] + dot(previous.wave_vector[row] - wave, at.to(wave.dtype))
    aspect, own = previous.aspect[row], previous.facet[row]
    return _DepartingBeams(aspect, own, row, side, at, direction, offset, wave, medium, passed)


def exceeds_min_amplitude(patches: IlluminatedPatches, wave_number: float) -> Bool[Tensor, " row"]:
    """Whether losses leave anything of waves.

    Args:
        patches: where they end.
        wave_number: k [1/m].
    """
    way = (
        dot(patches.wave_vector[:, None], patches.polygon.to(patches.wave_vector.dtype)).detach()
    ).imag
    way = way + patches.phase_offset.detach().imag[:, None]
    return wave_number * way.amax(1) > math.log(_MIN_AMPLITUDE)


def _attach_to_facets(facets: Facets, patches: IlluminatedPatches) -> IlluminatedPatches:
    """Patches whose corners are points of their facets and move with these alone."""
    corners = facets.corners[patches.facet]
    sides = corners[:, 1:] - corners[:, :1]
    places = (patches.polygon - corners[:, :1]).detach() @ torch.linalg.pinv(sides.detach())
    return replace(patches, polygon=corners[:, :1] + places @ sides)


def _clip_to_beams(
    facets: Facets,
    patches: IlluminatedPatches,
    previous: IlluminatedPatches,
    departing: _DepartingBeams,
) -> IlluminatedPatches:
    """The parts of facets that lie in the beams that a mirror, or a face, has sent."""
    mirror = previous.polygon[departing.parent[patches.parent]]
    polygon = _clip_in_front(
        patches.polygon, departing.source_normal[patches.parent], mirror[:, 0], 0.0
    )
    for plane, at, proper in _side_planes(mirror, patches.direction):
        polygon = clip(polygon, plane, torch.where(proper, dot(plane, at), -1.0))
    return _drop_degenerate(facets, patches, polygon)


def _remove_occluded(
    facets: Facets,
    patches: IlluminatedPatches,
    departing: _DepartingBeams | None,
    solids: DielectricSolids | None,
) -> IlluminatedPatches:
    """What no other facet hides from the source, as convex pieces."""
    for other in range(len(facets.normal)):
        if not len(patches.aspect):
            break
        above: Tensor | float = _OCCLUSION_TOLERANCE * facets.size
        if solids is not None and bool(solids.conducting[other]):
            # A conductor that touches a dielectric is what waves meet there, from either side.
            above = torch.where(solids.conducting[patches.facet], above, -above)
        shadow = facets.corners[other].expand(len(patches.aspect), 3, 3)
        shadow = _clip_in_front(shadow, patches.normal, patches.polygon[:, 0], above)
        if departing is not None:
            plane, at = (
                departing.source_normal[patches.parent],
                departing.source_point[patches.parent],
            )
            shadow = _clip_in_front(shadow, plane, at, _OCCLUSION_TOLERANCE * facets.size)
        patches = _subtract_shadows(facets, patches, shadow)
    return patches


def _subtract_shadows(
    facets: Facets, patches: IlluminatedPatches, shadow: Tensor
) -> IlluminatedPatches:
    """Patches less the prisms along their beams above some polygons."""
    sides = _side_planes(shadow, patches.direction)
    covered = patches.polygon
    for plane, at, proper in sides:
        covered = clip(covered, plane, torch.where(proper, dot(plane, at), -1.0))
    hidden = area_vector(covered).detach().norm(dim=1) > _MIN_AREA * facets.size**2
    # The prism of a polygon without area, or seen edge-on, hides nothing.
    hidden &= (
        dot(area_vector(shadow), patches.direction).detach().abs() > _MIN_AREA * facets.size**2
    )
    if not bool(hidden.any()):
        return patches
    part = select_patches(patches, hidden)
    pieces, rest = [select_patches(patches, ~hidden)], part.polygon
    for plane, at, proper in sides:
        plane, at, proper = plane[hidden], at[hidden], proper[hidden]
        outside = clip(rest, -plane, torch.where(proper, -dot(plane, at), 1.0))
        pieces.append(_drop_degenerate(facets, part, outside))
        rest = clip(rest, plane, torch.where(proper, dot(plane, at), -1.0))
    return concatenate_patches(pieces)


def _side_planes(polygon: Tensor, direction: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
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


def _clip_in_front(
    polygon: Tensor, normal: Tensor, point: Tensor, margin: Tensor | float
) -> Tensor:
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
    steep = crossed & ((height - after).detach().abs() > _COPLANAR_TOLERANCE * extent)
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


def _drop_degenerate(
    facets: Facets, patches: IlluminatedPatches, polygon: Tensor
) -> IlluminatedPatches:
    """Patches with these polygons, without those of no area."""
    keep = area_vector(polygon).detach().norm(dim=1) > _MIN_AREA * facets.size**2
    rows = select_patches(patches, keep)
    return IlluminatedPatches(**{**vars(rows), "polygon": polygon[keep]})


def select_patches(patches: IlluminatedPatches, rows: Tensor) -> IlluminatedPatches:
    """Some rows.

    Args:
        patches: patches.
        rows: which.
    """
    return IlluminatedPatches(**{name: column[rows] for name, column in vars(patches).items()})


def concatenate_patches(parts: Sequence[IlluminatedPatches]) -> IlluminatedPatches:
    """All rows of several; polygons of few corners repeat their last.

    Args:
        parts: one or more.
    """
    width = max(part.polygon.shape[1] for part in parts)

    def pad_corners(polygon: Tensor) -> Tensor:
        last = polygon[:, -1:].expand(-1, width - polygon.shape[1], -1)
        return torch.cat([polygon, last], 1)

    columns = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in vars(parts[0])
        if name != "polygon"
    }
    return IlluminatedPatches(
        **columns, polygon=torch.cat([pad_corners(part.polygon) for part in parts])
    )
