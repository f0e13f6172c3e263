"""Bounding spheres of triangles and of groups of them, to find those that lines come close to."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import dot
from invertwin.channel.rays.topology import morton_order

_GROUP_SIZE = 8  # triangles


class TriangleSpheres:
    """Bounding spheres of triangles, and of groups of them along a curve that fills space.

    Args:
        corners: corners of the triangles [m].
        margin: length by which spheres are larger than necessary [m].
    """

    def __init__(self, corners: Float64[Tensor, "f 3 3"], margin: float) -> None:
        self.center = corners.mean(1)
        self.radius = (corners - self.center[:, None]).norm(dim=2).amax(1) + margin
        order = torch.from_numpy(morton_order(self.center.numpy()))
        missing = -len(order) % _GROUP_SIZE
        self.members = torch.cat([order, order[-1:].expand(missing)]).view(-1, _GROUP_SIZE)
        self.is_copy = torch.arange(self.members.numel()).view(-1, _GROUP_SIZE) >= len(order)
        self.group_center = self.center[self.members].mean(1)
        offset = self.center[self.members] - self.group_center[:, None]
        self.group_radius = (offset.norm(dim=2) + self.radius[self.members]).amax(1)

    def find_close(
        self, start: Float64[Tensor, "row 3"], end: Float64[Tensor, "row 3"]
    ) -> tuple[Int64[Tensor, " pair"], Int64[Tensor, " pair"]]:
        """Find the triangles whose spheres meet the infinite lines through two points each.

        Give few enough lines at a time: in the worst case each comes close to all triangles.

        Args:
            start, end: the points [m].

        Returns:
            Rows of the lines, in ascending order, and triangles, ascending for each line.
        """
        unit = normalize(end - start, dim=1)
        along = unit @ self.group_center.T - dot(unit, start)[:, None]
        square = torch.cdist(start, self.group_center).square() - along.square()
        row, group = torch.nonzero(square <= self.group_radius.square(), as_tuple=True)
        face = self.members[group]
        offset = self.center[face] - start[row, None]
        square = offset.square().sum(2) - dot(offset, unit[row, None]).square()
        near = (square <= self.radius[face].square()) & ~self.is_copy[group]
        row, face = row[:, None].expand_as(face)[near], face[near]
        order = (row * len(self.center) + face).argsort()
        return row[order], face[order]
