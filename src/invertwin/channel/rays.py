"""What rays need: the ray scene, antennas and corners in float32 about a local origin."""

from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel import bridge
from invertwin.channel.bridge import Geometry, opaque, to_float, to_points, tracer
from invertwin.channel.paths import Link
from invertwin.errors import InputError

# Offset along a ray, relative to its length: fifty float32 roundings of a coordinate, and small
# enough that the dark side of a 0.3 m ball stays dark from a kilometre away.
NEAR = 3e-6
_SLIVER = 1e-3  # a triangle's area over its squared sides, below which it is one


def scrambled(seed: int, stream: int) -> Any:
    """An opaque 32-bit seed; neighbouring seeds and streams are unrelated."""
    state = np.random.SeedSequence([seed, stream]).generate_state(1)[0]
    return opaque(int(state))


def uniform_pair(index: Any, seed: Any) -> tuple[Any, Any]:
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
        self.vertices = to_points(self.local_vertices)
        self.tx = to_points(link.tx - self.origin)
        self.rx = to_points(link.rx - self.origin)
        # Lanes without a hit are evaluated on a sound triangle, then masked: no NaN can leak.
        self.sound_face = opaque(_sound_face(geometry))

    @property
    def scene(self) -> Any:
        """The ray scene. Asked for anew: another shot of the same objects may have moved them."""
        return self.geometry.topology.ray_scene(self.local_vertices)

    @cached_property
    def spheres(self) -> tuple[Float64[Tensor, "object 3"], Float64[Tensor, " object"]]:
        """Centre and radius of a sphere around each object [m]."""
        return bounding_spheres(self.geometry)

    def point(self, table: Any, index: Any) -> Any:
        """Rows of a table of points."""
        return bridge.points(table, index)

    def corners(self, face: Any, active: Any = True) -> tuple[Any, Any, Any]:
        """Corners of triangles."""
        import drjit as dr

        mi = tracer()
        index = dr.gather(mi.Vector3u, self.geometry.topology.device_faces, face, active)
        return tuple(bridge.points(self.vertices, i, active) for i in index)  # type: ignore[return-value]

    def clear(self, start: Any, end: Any, active: Any = True) -> Any:
        """Whether nothing lies between two points (their own surfaces excluded)."""
        mi = tracer()
        return active & ~self.scene.ray_test(
            mi.Ray3f(start + (end - start) * NEAR, end - start, 1 - 2 * NEAR, 0.0, []), active
        )


def _points(shot: Shot, place: Float64[Tensor, "n 3"]) -> Any:
    local = (place.detach() - shot.origin).to(torch.float32)
    return tracer().Point3f(*(to_float(local[:, k]) for k in range(3)))


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


def bounding_spheres(
    geometry: Geometry,
) -> tuple[Float64[Tensor, "object 3"], Float64[Tensor, " object"]]:
    """Centre and radius of a sphere around each object, detached [m]."""
    centres, radii = [], []
    positions = geometry.vertices.detach()
    for used in geometry.topology.object_vertices:
        corners = positions[used]
        low, high = torch.aminmax(corners, dim=0)
        centre = 0.5 * (low + high)
        centres.append(centre)
        radii.append((corners - centre).norm(dim=1).max())
    return torch.stack(centres), torch.stack(radii)


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
    return bridge.to_torch(shot.clear(_points(shot, start), _points(shot, end))).bool()


def next_surface(
    shot: Shot, start: Float64[Tensor, "n 3"], end: Float64[Tensor, "n 3"]
) -> tuple[Int64[Tensor, " n"], Float64[Tensor, " n"]]:
    """First triangle between pairs of world points (−1: none), and how far along it lies."""
    import drjit as dr

    mi = tracer()
    origin = _points(shot, start)
    offset = _points(shot, end) - origin
    ray = mi.Ray3f(origin + offset * NEAR, mi.Vector3f(offset), 1 - 2 * NEAR, 0.0, [])
    hit = shot.scene.ray_intersect_preliminary(ray)
    face = dr.select(hit.is_valid(), mi.Int32(hit.prim_index), -1)
    along = dr.select(hit.is_valid(), hit.t + NEAR, 1.0)
    return bridge.to_torch(face).long(), bridge.to_torch(along).double()
