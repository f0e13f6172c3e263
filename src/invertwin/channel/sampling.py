"""Where samples come from: rays from the antenna, points by area, points on silhouettes.

Everything here is detached: a sample is a place on the reference surface (triangle and
barycentric coordinates), a frame, and one over its density. What depends on the scene's
parameters is evaluated later, in material form (derivations §2).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from invertwin.channel import bridge
from invertwin.channel.bridge import Geometry, opaque, to_float, tracer
from invertwin.channel.paths import Link
from invertwin.errors import InputError

# Offset along a ray, relative to its length: fifty float32 roundings of a coordinate, and small
# enough that the dark side of a 0.3 m ball stays dark from a kilometre away.
_NEAR = 3e-6
_GRAZING = 1e-5  # least cosine between a boundary ray and the normal of the shadowed surface
_SLIVER = 1e-3  # a triangle's area over its squared sides, below which it is one
_FEW_EDGES = 2000  # up to here float32 can place a sample along the edge by its rest in the CDF


@dataclass(frozen=True)
class Samples:
    """Points on surfaces (Dr.Jit arrays). ``weight`` is one over (samples × area density)."""

    frame: Any
    face: Any
    b1: Any
    b2: Any
    weight: Any


@dataclass(frozen=True)
class EdgeSamples:
    """Points on silhouettes and the triangle on which their shadow falls (Dr.Jit arrays).

    Edge points that are hidden or have nothing behind them are left out. ``weight`` is one over
    (samples × density along the edge parameter).
    """

    frame: Any
    first: Any
    second: Any
    opposite: Any
    along: Any
    face: Any
    weight: Any


def scrambled(seed: int, stream: int) -> Any:
    """An opaque 32-bit seed; neighbouring seeds and streams are unrelated."""
    state = np.random.SeedSequence([seed, stream]).generate_state(1)[0]
    return opaque(int(state))


def _uniform(index: Any, seed: Any) -> tuple[Any, Any]:
    """Two uniform numbers in [0, 1) for each index."""
    mi = tracer()
    first, second = mi.sample_tea_32(index, seed)
    scale = 2.0**-24
    return mi.Float(first >> 8) * scale, mi.Float(second >> 8) * scale


class Shot:
    """What rays need: the ray scene and the antennas, in float32 about a local origin."""

    def __init__(self, geometry: Geometry, link: Link) -> None:
        self.geometry = geometry
        self.link = link
        self.origin = link.tx.detach().mean(dim=0)
        self.local_vertices = (geometry.vertices.detach() - self.origin).to(torch.float32)
        self.vertices = to_float(self.local_vertices)
        self.tx = to_float(link.tx.detach() - self.origin)
        self.rx = to_float(link.rx.detach() - self.origin)
        # Lanes without a hit are evaluated on a sound triangle, then masked: no NaN can leak.
        self.sound_face = opaque(_sound_face(geometry))

    @property
    def scene(self) -> Any:
        """The ray scene. Asked for anew: another shot of the same objects may have moved them."""
        return self.geometry.topology.ray_scene(self.local_vertices)

    def point(self, table: Any, index: Any) -> Any:
        """Rows of a flat table of points."""
        import drjit as dr

        return dr.gather(tracer().Point3f, table, index)

    def corners(self, face: Any, active: Any = True) -> tuple[Any, Any, Any]:
        """Corners of triangles."""
        import drjit as dr

        mi = tracer()
        index = dr.gather(mi.Vector3u, self.geometry.topology.device_faces, face, active)
        return tuple(dr.gather(mi.Point3f, self.vertices, i, active) for i in index)  # type: ignore[return-value]

    def clear(self, start: Any, end: Any, active: Any = True) -> Any:
        """Whether nothing lies between two points (their own surfaces excluded)."""
        mi = tracer()
        return active & ~self.scene.ray_test(
            mi.Ray3f(start + (end - start) * _NEAR, end - start, 1 - 2 * _NEAR, 0.0, []), active
        )


def _caps(
    geometry: Geometry, link: Link, margin: float
) -> tuple[Float64[Tensor, "frame object 3"], Float64[Tensor, "frame object"]]:
    """Axis and height 1 − cos of the spherical cap that holds each object, seen from TX."""
    axes, heights = [], []
    positions, tx = geometry.vertices.detach(), link.tx.detach()
    for index in range(len(geometry.coherent)):
        used = positions[geometry.topology.object_vertices[index]]
        centre = 0.5 * (used.min(dim=0).values + used.max(dim=0).values)
        radius = margin * (used - centre).norm(dim=1).max()
        offset = centre - tx
        distance = offset.norm(dim=1)
        sine = (radius / distance.clamp_min(1e-30)).clamp_max(1.0)
        height = sine**2 / (1 + (1 - sine**2).sqrt())
        axes.append(offset / distance.clamp_min(1e-30)[:, None])
        heights.append(torch.where(distance > radius, height, 2.0))
    return torch.stack(axes, dim=1), torch.stack(heights, dim=1)


class RaySampler:
    """Rays from TX, the same number into the cap around each object, jittered on a grid."""

    def __init__(
        self, shot: Shot, samples: int, seed: int, reference: tuple[Geometry, Link] | None = None
    ) -> None:
        if reference:
            axes, heights = _caps(*reference, margin=1.1)
        else:
            axes, heights = _caps(shot.geometry, shot.link, margin=1.001)
        self.shot = shot
        self.objects = axes.shape[1]
        blocks = shot.link.frame_count * self.objects
        self.rows = max(1, int(np.sqrt(samples / blocks)))
        self.columns = max(1, samples // blocks // self.rows)
        self.size = blocks * self.rows * self.columns
        self.axes, self.heights = to_float(axes), to_float(heights)
        self.seed = scrambled(seed, 0)

    def draw(self, index: Any) -> Samples:
        """The samples of the given indices below ``size``."""
        import drjit as dr

        mi = tracer()
        shot, per_block = self.shot, self.rows * self.columns
        block, place = index // per_block, index % per_block
        frame = block // self.objects
        jitter = _uniform(index, self.seed)
        disk = mi.warp.square_to_uniform_disk_concentric(
            mi.Point2f(
                (mi.Float(place % self.columns) + jitter[0]) / self.columns,
                (mi.Float(place // self.columns) + jitter[1]) / self.rows,
            )
        )
        height = dr.gather(mi.Float, self.heights, block)
        axis = dr.gather(mi.Vector3f, self.axes, block)
        depth = dr.squared_norm(disk) * height
        spread = dr.sqrt(height * (2 - depth))
        local = mi.Vector3f(disk.x * spread, disk.y * spread, 1 - depth)
        direction = dr.normalize(mi.Frame3f(axis).to_world(local))
        density = mi.Float(0.0)
        for other in range(self.objects):
            entry = frame * self.objects + other
            cap = dr.gather(mi.Float, self.heights, entry)
            away = direction - dr.gather(mi.Vector3f, self.axes, entry)
            inside = (dr.squared_norm(away) <= 2 * cap) | (block == entry)
            density += dr.select(inside, per_block / (2 * dr.pi * cap), 0.0)
        centre = shot.point(shot.tx, frame)
        hit = shot.scene.ray_intersect_preliminary(mi.Ray3f(centre, direction), coherent=True)
        valid = hit.is_valid()
        p0, p1, p2 = shot.corners(hit.prim_index, valid)
        normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
        cosine = dr.maximum(dr.abs(dr.dot(normal, direction)), 1e-6)
        if not shot.link.shared_visibility:
            position = centre + direction * hit.t
            valid &= shot.clear(position, shot.point(shot.rx, frame), valid)
        weight = dr.select(valid, dr.square(hit.t) / (cosine * density), 0.0)
        face = dr.select(valid, hit.prim_index, shot.sound_face)
        b = dr.select(valid, hit.prim_uv, 0.25)
        return Samples(frame, face, b.x, b.y, weight)


class AreaSampler:
    """Points spread over all surfaces; the density per triangle is that of a reference scene.

    A reference that does not follow the parameters keeps the point set under differences
    (common random numbers) also when areas change.
    """

    def __init__(
        self, shot: Shot, samples: int, seed: int, reference: tuple[Geometry, Link] | None = None
    ) -> None:
        mi = tracer()
        geometry = reference[0] if reference else shot.geometry
        if len(geometry.faces) != len(shot.geometry.faces):
            raise InputError(
                f"expected a reference scene of {len(shot.geometry.faces)} triangles, got "
                f"{len(geometry.faces)}; use the scene the differences start from"
            )
        areas = face_areas(geometry)
        self.shot = shot
        self.per_frame = max(1, samples // shot.link.frame_count)
        self.size = self.per_frame * shot.link.frame_count
        self.distribution = mi.DiscreteDistribution(to_float(areas / areas.mean()))
        self.seeds = scrambled(seed, 1), scrambled(seed, 2)

    def draw(self, index: Any) -> Samples:
        """The samples of the given indices below ``size``."""
        import drjit as dr

        mi = tracer()
        shot = self.shot
        frame, place = index // self.per_frame, index % self.per_frame
        jitter, _ = _uniform(index, self.seeds[0])
        uniform = (mi.Float(place) + jitter) / self.per_frame
        face, pmf = self.distribution.sample_pmf(uniform)
        b = mi.warp.square_to_uniform_triangle(mi.Point2f(*_uniform(index, self.seeds[1])))
        p0, p1, p2 = shot.corners(face)
        area = 0.5 * dr.norm(dr.cross(p1 - p0, p2 - p0))
        position = p0 * (1 - b.x - b.y) + p1 * b.x + p2 * b.y
        valid = shot.clear(shot.point(shot.tx, frame), position)
        if not shot.link.shared_visibility:
            valid &= shot.clear(shot.point(shot.rx, frame), position, valid)
        weight = dr.select(valid, area / (pmf * self.per_frame), 0.0)
        return Samples(frame, face, b.x, b.y, weight)


class EdgeSampler:
    """Points on the silhouettes seen from one antenna, and where their shadows fall.

    An edge is a silhouette if all its triangles lie, as seen from the antenna, on one side of
    it: one triangle for an open edge, two for a fold, any number for a non-manifold edge. The
    rule needs no consistent winding.
    """

    def __init__(self, shot: Shot, centre: Any, samples: int, seed: int) -> None:
        import drjit as dr

        mi = tracer()
        topology = shot.geometry.topology
        count = len(topology.edges)
        self.shot, self.centre = shot, centre
        index = dr.arange(mi.UInt32, shot.link.frame_count * count)
        frame, edge = index // count, index % count
        origin = shot.point(centre, frame)
        y0, y1 = (
            shot.point(shot.vertices, dr.gather(mi.UInt32, ends, edge))
            for ends in topology.device_edges
        )
        plane = dr.cross(y0 - origin, y1 - y0)
        left, right = mi.Bool(False), mi.Bool(False)
        for column in topology.device_opposite:
            apex = dr.gather(mi.Int32, column, edge)
            here = apex >= 0
            offset = shot.point(shot.vertices, mi.UInt32(dr.maximum(apex, 0))) - y0
            side = dr.dot(plane, offset)
            left |= here & (side > 0)
            right |= here & (side < 0)
        self.index: Any = dr.compress(left ^ right)
        self.size = samples if dr.width(self.index) else 0
        if self.size:
            length = dr.norm(y1 - y0) / dr.norm(0.5 * (y0 + y1) - origin)
            weight = dr.gather(mi.Float, length, self.index)
            self.distribution = mi.DiscreteDistribution(weight / dr.max(weight))
        self.seed = scrambled(seed, 3)

    def draw(self, index: Any) -> EdgeSamples:
        """The samples of the given indices below ``size``."""
        import drjit as dr

        mi = tracer()
        shot, topology = self.shot, self.shot.geometry.topology
        jitter, along = _uniform(index, self.seed)
        uniform = (mi.Float(index) + jitter) / self.size
        if dr.width(self.index) <= _FEW_EDGES:
            place, along, pmf = self.distribution.sample_reuse_pmf(uniform)
        else:
            place, pmf = self.distribution.sample_pmf(uniform)
        entry = dr.gather(mi.UInt32, self.index, place)
        frame, edge = entry // len(topology.edges), entry % len(topology.edges)
        first, second = (dr.gather(mi.UInt32, ends, edge) for ends in topology.device_edges)
        y0 = shot.point(shot.vertices, first)
        y = y0 + (shot.point(shot.vertices, second) - y0) * along
        origin = shot.point(self.centre, frame)
        away = y - origin
        valid = shot.clear(origin, y)
        hit = shot.scene.ray_intersect_preliminary(
            mi.Ray3f(y + away * _NEAR, away), coherent=True, active=valid
        )
        valid &= hit.is_valid()
        # A ray in the plane of the triangle it meets has no shadow point there: lose it.
        p0, p1, p2 = shot.corners(hit.prim_index, valid)
        normal = dr.normalize(dr.cross(p1 - p0, p2 - p0))
        valid &= dr.abs(dr.dot(normal, away)) > _GRAZING * dr.norm(away)
        opposite = mi.UInt32(dr.gather(mi.Int32, topology.device_opposite[0], edge))
        weight = 1 / (pmf * self.size)
        found = EdgeSamples(frame, first, second, opposite, along, hit.prim_index, weight)
        dr.eval(found, valid)
        kept: Any = dr.compress(valid)
        return EdgeSamples(
            *(dr.gather(type(column), column, kept) for column in vars(found).values())
        )


def _sound_face(geometry: Geometry) -> int:
    """A triangle that is no sliver; the last answer while it stays one, which is quicker."""
    topology = geometry.topology
    if topology.sound_face is not None:
        p0, p1, p2 = geometry.vertices.detach()[geometry.faces[topology.sound_face]]
        sides = torch.stack([p1 - p0, p2 - p0])
        area = torch.linalg.cross(sides[0], sides[1]).norm()
        if area > _SLIVER * sides.square().sum():
            return topology.sound_face
    topology.sound_face = int(face_areas(geometry).argmax())
    return topology.sound_face


def face_areas(geometry: Geometry) -> Float64[Tensor, " f"]:
    """Areas of all triangles [m²], detached."""
    p0, p1, p2 = (geometry.vertices.detach()[geometry.faces[:, k]] for k in range(3))
    areas = 0.5 * torch.linalg.cross(p1 - p0, p2 - p0).norm(dim=1)
    if not bool((areas > 0).any()):
        raise InputError("expected a triangle of positive area, got none; check the mesh's scale")
    return areas


def visible(shot: Shot, start: Float64[Tensor, "n 3"], end: Float64[Tensor, "n 3"]) -> Tensor:
    """Whether nothing lies between pairs of world points (torch in, torch out)."""
    if not len(start):
        return torch.zeros(0, dtype=torch.bool)
    mi = tracer()
    points = []
    for ends in (start, end):
        local = (ends.detach() - shot.origin).to(torch.float32)
        points.append(mi.Point3f(*(to_float(local[:, k]) for k in range(3))))
    return bridge.to_torch(shot.clear(*points)).bool()
