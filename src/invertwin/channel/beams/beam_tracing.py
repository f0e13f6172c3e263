"""Beam tracing between few flat facets, with exactly clipped polygons (Heckbert and Hanrahan 1984).

A beam is a plane wave that a sequence of facets has reflected. Its source is an image; its cross
section is the illuminated part of the last facet, seen from that image. The next facet is
illuminated where it lies in the beam and no other facet occludes it. All parts are convex polygons,
clipped by planes, whose corners keep their derivatives: those due to moving edges need no extra
term.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex128, Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em import plane_waves
from invertwin.channel.em.dielectric_solids import AIR, DielectricSolids, refract_waves
from invertwin.channel.rays.topology import Topology
from invertwin.channel.rows import Rows, concatenate_rows

MAX_FACETS_BEAM_TRACING = 24
"""Maximum number of triangles for exact beam tracing."""
_MIN_AREA = 1e-12  # of the scene's size squared: smaller polygons are dropped
_COPLANAR_TOLERANCE = 1e-12  # of a polygon's size: height difference of a side in the plane
_MIN_AMPLITUDE = 1e-6  # amplitude after losses below which a wave is dropped
_OCCLUSION_TOLERANCE = 1e-9  # of the scene's size: least height of an occluder above a facet


@dataclass(frozen=True)
class Facets:
    """Triangles that reflect on both sides.

    Attributes:
        corners: corners of the facets [m].
        normal: unit normals.
        solid: mask of facets of closed bodies, with outward normals, not illuminated from behind.
        size: diagonal of the bounding box of all vertices [m].
    """

    corners: Float64[Tensor, "facet 3 3"]
    normal: Float64[Tensor, "facet 3"]
    solid: Bool[Tensor, " facet"]
    size: float


def build_facets(vertices: Float64[Tensor, "v 3"], topology: Topology) -> Facets:
    """Build facets from the triangles of meshes.

    Args:
        vertices: vertex positions of all meshes [m].
        topology: faces and edges of the meshes.
    """
    corners = vertices[topology.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volume = plane_waves.dot(corners.detach()[:, 0], area.detach()) / 6
    solid = torch.zeros(len(corners), dtype=torch.bool)
    for number in range(int(topology.face_object.max()) + 1):
        own = topology.face_object == number
        solid[own] = number not in topology.open_objects and bool(volume[own].sum() > 0)
    extent = vertices.detach().amax(0) - vertices.detach().amin(0)
    return Facets(corners, normalize(area, dim=1), solid, float(extent.norm()))


@dataclass(frozen=True)
class IlluminatedPatches(Rows):
    """Illuminated patches of one order, one row per beam that ends there.

    Attributes:
        aspect: number of the incident wave.
        facet: number of the illuminated facet.
        normal: unit normal of the facet, towards the beam's source.
        direction: direction d of the beam.
        phase_offset: phase offset c [m].
        polygon: corners of the illuminated part [m].
        parent: row of the previous order that the beam comes from; −1 at the first.
        wave_vector: K over k, so that the wave has the phase −k(K·x + c): d in air, complex where
            it decays.
        medium: number of the solid that contains the beam; −1 = air.
        transmitted: True if the beam was transmitted at its last face, False if reflected.
        spreading: spreading factor, its field over that of a plane wave.
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

    def to_complex(self) -> "IlluminatedPatches":
        """Return the patches with complex waves, which may decay."""
        names = ("wave_vector", "phase_offset", "spreading")
        return replace(self, **{name: getattr(self, name).to(torch.complex128) for name in names})

    def phase_integral(
        self, scattering_direction: Float64[Tensor, "row 3"]
    ) -> Callable[[float], Complex128[Tensor, " row"]]:
        """Return ∫ exp(−jk(K·x + c − s·x)) dA over each patch, as a function of k [1/m].

        Args:
            scattering_direction: unit vectors s towards the receiver.
        """
        difference = scattering_direction - self.wave_vector
        # Relative to a corner: far from the origin, decaying waves would overflow.
        start = self.polygon[:, 0]
        patches = plane_waves.polygon_integral(self.polygon - start[:, None], difference)
        phase = plane_waves.dot(difference, start) - self.phase_offset
        return lambda k: patches(k) * plane_waves.phasor(k * phase)


def patches_in_air(
    aspect: Int64[Tensor, " row"],
    facet: Int64[Tensor, " row"],
    normal: Float64[Tensor, "row 3"],
    direction: Float64[Tensor, "row 3"],
    phase_offset: Float64[Tensor, " row"],
    polygon: Float64[Tensor, "row corner 3"],
    parent: Int64[Tensor, " row"],
) -> IlluminatedPatches:
    """Build illuminated patches of waves in air.

    Args:
        aspect, facet, normal, direction, phase_offset, polygon, parent: as in `IlluminatedPatches`.
    """
    air, unit = torch.full_like(aspect, AIR), torch.ones_like(phase_offset)
    none = torch.zeros_like(aspect, dtype=torch.bool)
    return IlluminatedPatches(
        aspect, facet, normal, direction, phase_offset, polygon, parent, direction, air, none, unit
    )


def trace_beams(
    facets: Facets,
    incident: Float64[Tensor, "aspect 3"],
    depth: int,
    *,
    boundary: bool = True,
    solids: DielectricSolids | None = None,
) -> Iterator[IlluminatedPatches]:
    """Trace beams of plane waves: illuminated patches order by order.

    Args:
        facets: facets of the scene.
        incident: direction d of each wave.
        depth: maximum number of bounces.
        boundary: False omits the derivatives due to moving edges of beams.
        solids: dielectric solids; None = none.

    Raises:
        InputError: a dielectric within another one, or in contact with it.
    """
    last = None
    for _ in range(depth):
        last = _trace_order(facets, incident, last, solids)
        if not boundary:
            last = _attach_to_facets(facets, last)
        if not len(last.aspect):
            return
        yield last


def _trace_order(
    facets: Facets,
    incident: Tensor,
    previous: IlluminatedPatches | None,
    solids: DielectricSolids | None,
) -> IlluminatedPatches:
    """Illuminated parts of all facets in all beams of one order."""
    count = len(facets.normal)
    if previous is None:
        departing = _launch_plane_waves(incident, solids)
    else:
        departing = _continue_beams(previous, solids)
    source = torch.arange(len(departing.aspect)).repeat_interleave(count)
    facet = torch.arange(count).repeat(len(departing.aspect))
    facing = plane_waves.dot(facets.normal[facet], departing.direction[source]).detach()
    is_front = ~(facets.solid[facet] & (facing > 0))
    if solids is not None:
        within = departing.medium[source] == solids.owner[facet]
        is_front = torch.where(within, facing > 0, is_front)
    keep = (facet != departing.facet[source]) & (facing.abs() > 1e-9) & is_front
    source, facet = source[keep], facet[keep]
    normal = -facing[keep].sign()[:, None] * facets.normal[facet]
    beams, corners = departing.select(source), facets.corners[facet]
    bounce = replace(beams, facet=facet, normal=normal, polygon=corners, parent=source)
    polygon = corners
    if previous is not None:  # clip facets to the beams that leave the previous patches
        polygon = _clip_in_front(corners, beams.normal, beams.polygon[:, 0], 0.0)
        for plane, point, proper in _side_planes(beams.polygon, bounce.direction):
            polygon = clip(polygon, plane, torch.where(proper, plane_waves.dot(plane, point), -1.0))
    bounce = _drop_degenerate(facets, bounce, polygon)
    bounce = _remove_occluded(facets, bounce, None if previous is None else departing, solids)
    bounce = replace(bounce, parent=departing.parent[bounce.parent])
    if solids is None:
        return bounce
    bounce = bounce.select(exceeds_min_amplitude(bounce, solids.wave_number))
    solids.require_gaps(bounce.facet, bounce.medium)
    return bounce


def _launch_plane_waves(incident: Tensor, solids: DielectricSolids | None) -> IlluminatedPatches:
    """Launch plane waves from infinity, from patches without place or normal."""
    aspect, zero = torch.arange(len(incident)), torch.zeros_like(incident)
    none = torch.full_like(aspect, -1)
    waves = patches_in_air(aspect, none, zero, incident, zero[:, 0], zero[:, None], none)
    return waves if solids is None else waves.to_complex()


def _continue_beams(
    previous: IlluminatedPatches, solids: DielectricSolids | None
) -> IlluminatedPatches:
    """Continue beams by reflection, followed by transmission into solids: patches that they leave.

    The normal of a patch points to the side of its beam, and ``parent`` is its row.
    """
    direction = plane_waves.reflect_vectors(previous.direction, previous.normal)
    wave = plane_waves.reflect_vectors(previous.wave_vector, previous.normal)
    row = torch.arange(len(previous.aspect))
    left = replace(previous, transmitted=torch.zeros_like(row, dtype=torch.bool), parent=row)
    if solids is not None:
        behind = solids.medium_behind(previous.facet, previous.medium)
        epsilon = solids.permittivity_in(behind)
        refracted, propagates = refract_waves(epsilon, previous.wave_vector, previous.normal)
        rows = torch.nonzero(propagates & solids.transparent[previous.facet])[:, 0]
        wave = torch.cat([wave, refracted[rows]])
        direction = torch.cat([direction, normalize(refracted[rows].real, dim=1)])
        passing = replace(
            left, medium=behind, normal=-left.normal, transmitted=torch.ones_like(left.transmitted)
        )
        left = concatenate_rows([left, passing.select(rows)])
    # Phase matching on the face.
    offset = left.phase_offset + plane_waves.dot(
        left.wave_vector - wave, left.polygon[:, 0].to(wave.dtype)
    )
    return replace(left, direction=direction, phase_offset=offset, wave_vector=wave)


def exceeds_min_amplitude(patches: IlluminatedPatches, wave_number: float) -> Bool[Tensor, " row"]:
    """Test if the amplitude of waves exceeds the minimum after losses.

    Args:
        patches: illuminated patches.
        wave_number: wave number k [1/m].
    """
    polygon = patches.polygon.to(patches.wave_vector.dtype)
    decay = plane_waves.dot(patches.wave_vector[:, None], polygon).detach().imag
    decay = decay + patches.phase_offset.detach().imag[:, None]
    return wave_number * decay.amax(1) > math.log(_MIN_AMPLITUDE)


def _attach_to_facets(facets: Facets, patches: IlluminatedPatches) -> IlluminatedPatches:
    """Make the corners of patches material points of their facets."""
    corners = facets.corners[patches.facet]
    sides = corners[:, 1:] - corners[:, :1]
    coordinates = (patches.polygon - corners[:, :1]).detach() @ torch.linalg.pinv(sides.detach())
    return replace(patches, polygon=corners[:, :1] + coordinates @ sides)


def _remove_occluded(
    facets: Facets,
    patches: IlluminatedPatches,
    departing: IlluminatedPatches | None,
    solids: DielectricSolids | None,
) -> IlluminatedPatches:
    """Subtract the shadows of all other facets, leaving convex pieces."""
    for other in range(len(facets.normal)):
        if not len(patches.aspect):
            break
        above: Tensor | float = _OCCLUSION_TOLERANCE * facets.size
        if solids is not None and bool(solids.conducting[other]):
            # A conductor in contact with a dielectric occludes it, from either side.
            above = torch.where(solids.conducting[patches.facet], above, -above)
        shadow = facets.corners[other].expand(len(patches.aspect), 3, 3)
        shadow = _clip_in_front(shadow, patches.normal, patches.polygon[:, 0], above)
        if departing is not None:
            plane, point = (x[patches.parent] for x in (departing.normal, departing.polygon[:, 0]))
            shadow = _clip_in_front(shadow, plane, point, _OCCLUSION_TOLERANCE * facets.size)
        patches = _subtract_shadows(facets, patches, shadow)
    return patches


def _subtract_shadows(
    facets: Facets, patches: IlluminatedPatches, shadow: Tensor
) -> IlluminatedPatches:
    """Subtract the prisms of polygons along the beams from patches."""
    sides = _side_planes(shadow, patches.direction)
    covered = patches.polygon
    for plane, point, proper in sides:
        covered = clip(covered, plane, torch.where(proper, plane_waves.dot(plane, point), -1.0))
    hidden = plane_waves.area_vector(covered).detach().norm(dim=1) > _MIN_AREA * facets.size**2
    # The prism of a degenerate or edge-on polygon occludes nothing.
    profile = plane_waves.dot(plane_waves.area_vector(shadow), patches.direction).detach().abs()
    hidden &= profile > _MIN_AREA * facets.size**2
    if not bool(hidden.any()):
        return patches
    part = patches.select(hidden)
    pieces, rest = [patches.select(~hidden)], part.polygon
    for plane, point, proper in sides:
        plane, point, proper = plane[hidden], point[hidden], proper[hidden]
        outside = clip(rest, -plane, torch.where(proper, -plane_waves.dot(plane, point), 1.0))
        pieces.append(_drop_degenerate(facets, part, outside))
        rest = clip(rest, plane, torch.where(proper, plane_waves.dot(plane, point), -1.0))
    return concatenate_patches(pieces)


def _side_planes(polygon: Tensor, direction: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Planes through a polygon's sides along a direction: inward normal, a point, and a mask.

    The mask is False for sides whose corners coincide.
    """
    centre, found = polygon.mean(1), []
    size = (polygon - centre[:, None]).detach().norm(dim=2).amax(1)
    for start, end in zip(polygon.unbind(1), polygon.roll(-1, 1).unbind(1), strict=True):
        plane = plane_waves.cross(end - start, direction)
        length = plane.norm(dim=1)
        proper = length.detach() > 1e-9 * size
        plane = plane / torch.where(proper, length, torch.ones_like(length))[:, None]
        plane = plane * plane_waves.dot(centre - start, plane).detach().sign()[:, None]
        found.append((plane * proper[:, None], start, proper))
    return found


def _clip_in_front(
    polygon: Tensor, normal: Tensor, point: Tensor, margin: Tensor | float
) -> Tensor:
    return clip(polygon, normal, plane_waves.dot(normal, point) + margin)


def clip(
    polygon: Float64[Tensor, "row corner 3"],
    normal: Float64[Tensor, "row 3"],
    offset: Float64[Tensor, " row"],
) -> Float64[Tensor, "row more 3"]:
    """Clip convex polygons to the half space n·x ≥ offset (Sutherland and Hodgman).

    The selection of corners is detached; new corners at intersections of sides with the plane have
    derivatives. An empty polygon becomes a point.

    Args:
        polygon: corners in order [m]; some may coincide.
        normal: normals n of the planes.
        offset: offsets of the planes [m].
    """
    height = plane_waves.dot(polygon, normal[:, None]) - offset[:, None]
    after = height.roll(-1, 1)
    inside = height.detach() >= 0
    crossed = inside != inside.roll(-1, 1)
    if bool(inside.all()):
        return polygon
    # A side in the plane, or of zero length, is crossed by rounding alone, with a meaningless
    # derivative.
    extent = (polygon - polygon[:, :1]).detach().norm(dim=2).amax(1, keepdim=True)
    steep = crossed & ((height - after).detach().abs() > _COPLANAR_TOLERANCE * extent)
    fraction = height / torch.where(steep, height - after, torch.ones_like(height))
    cuts = polygon + torch.where(steep, fraction, 0.0)[..., None] * (polygon.roll(-1, 1) - polygon)
    points = torch.stack([polygon, cuts], 2).flatten(1, 2)
    keep = torch.stack([inside, crossed], 2).flatten(1, 2)
    order = torch.argsort((~keep).to(torch.int8), dim=1, stable=True)
    number = keep.sum(1)
    width = max(3, int(number.max()))
    # Unused corners repeat the last one.
    slot = torch.minimum(torch.arange(width), (number[:, None] - 1).clamp_min(0))
    return points.gather(1, order.gather(1, slot)[..., None].expand(-1, -1, 3))


def _drop_degenerate(
    facets: Facets, patches: IlluminatedPatches, polygon: Tensor
) -> IlluminatedPatches:
    """Set the polygons of patches and drop those without area."""
    keep = plane_waves.area_vector(polygon).detach().norm(dim=1) > _MIN_AREA * facets.size**2
    return replace(patches, polygon=polygon).select(keep)


def concatenate_patches(parts: Sequence[IlluminatedPatches]) -> IlluminatedPatches:
    """Concatenate patches; polygons with fewer corners repeat their last.

    Args:
        parts: one or more tables.
    """
    width = max(part.polygon.shape[1] for part in parts)

    def pad_corners(polygon: Tensor) -> Tensor:
        return torch.cat([polygon, polygon[:, -1:].expand(-1, width - polygon.shape[1], -1)], 1)

    return concatenate_rows(parts, polygon=torch.cat([pad_corners(p.polygon) for p in parts]))
