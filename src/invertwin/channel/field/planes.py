"""Planes of a scene: triangles that lie in one plane act as one mirror."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

_ALIKE = 1e-5  # radians, and share of the scene's size, within which planes are one


@dataclass(frozen=True)
class Planes:
    """Planes, and the rectangles in them that hold their triangles; detached.

    Attributes:
        face_plane: Plane of every triangle; −1 of triangles without area.
        point: On the plane, about the scene's middle [m].
        normal: Unit vector.
        axes: Two unit vectors in the plane, along the sides of the rectangle.
        low, high: Ends of the rectangle along them, from ``point`` [m].
    """

    face_plane: Int64[Tensor, " f"]
    point: Float64[Tensor, "plane 3"]
    normal: Float64[Tensor, "plane 3"]
    axes: Float64[Tensor, "plane 2 3"]
    low: Float64[Tensor, "plane 2"]
    high: Float64[Tensor, "plane 2"]

    def __len__(self) -> int:
        return len(self.point)


def planes_of(vertices: Float64[Tensor, "v 3"], faces: Int64[Tensor, "f 3"]) -> Planes:
    """The planes of all triangles. Those that nearly coincide are one, whatever object has them.

    Args:
        vertices: About the scene's middle, detached [m].
        faces: Of triangles.
    """
    corners = vertices[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = float((vertices.amax(0) - vertices.amin(0)).norm())
    flat = area.norm(dim=1)
    whole = torch.nonzero(flat > (1e-9 * size) ** 2)[:, 0]
    normal = normalize(area[whole], dim=1)
    # One sign for both windings: that of the largest component.
    lead = normal.abs().argmax(1, keepdim=True)
    normal = normal * normal.gather(1, lead).sign()
    offset = (normal * corners[whole, 0]).sum(1) / size
    key = (torch.cat([normal, offset[:, None]], 1) / _ALIKE).round().numpy() + 0.0
    _, plane = np.unique(key, axis=0, return_inverse=True)
    plane = torch.from_numpy(plane.ravel())
    count = int(plane.max()) + 1 if len(plane) else 0
    # The largest triangle stands for its plane.
    order = np.lexsort((flat[whole].numpy(), plane.numpy()))
    last = np.searchsorted(plane.numpy()[order], np.arange(count), side="right") - 1
    best = torch.from_numpy(order[last])
    corner = corners[whole[best]]
    sides = corner.roll(-1, 1) - corner
    # The shortest side of half a rectangle is one of the rectangle's.
    shortest = sides.norm(dim=2).argmin(1)
    first = normalize(sides[torch.arange(count), shortest], dim=1)
    axes = torch.stack([first, torch.linalg.cross(normal[best], first)], 1)
    point = corners[whole[best], 0]
    seen = torch.einsum("fcx,fax->fca", corners[whole] - point[plane, None], axes[plane])
    ends = torch.full((count, 2), torch.inf, dtype=torch.float64)
    rows = plane[:, None].expand(-1, 2)
    low = ends.scatter_reduce(0, rows, seen.amin(1), "amin")
    high = (-ends).scatter_reduce(0, rows, seen.amax(1), "amax")
    face_plane = torch.full((len(faces),), -1, dtype=torch.int64)
    face_plane[whole] = plane
    return Planes(face_plane, point, normal[best], axes, low, high)
