"""Bounding spheres of triangles and of groups of them, to find those that lines come close to."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import dot
from invertwin.channel.rays.topology import morton_order

_GROUP_SIZE = 8  # triangles
_MAX_PAIRS = 1 << 22  # lines × groups, or × triangles, at a time


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

        Args:
            start, end: the points [m].

        Returns:
            Rows of the lines, in ascending order, and triangles, ascending for each line.
        """
        rows, faces = [torch.zeros(0, dtype=torch.int64)], [torch.zeros(0, dtype=torch.int64)]
        unit = normalize(end - start, dim=1)
        for some in torch.arange(len(start)).split(max(1, _MAX_PAIRS // len(self.members))):
            along = unit[some] @ self.group_center.T - dot(unit[some], start[some])[:, None]
            square = torch.cdist(start[some], self.group_center).square() - along.square()
            row, group = torch.nonzero(square <= self.group_radius.square(), as_tuple=True)
            pairs = some[row], group
            for line, number in zip(
                *(p.split(_MAX_PAIRS // _GROUP_SIZE) for p in pairs), strict=True
            ):
                face, beam = self.members[number], unit[line, None]
                offset = self.center[face] - start[line, None]
                square = offset.square().sum(2) - dot(offset, beam).square()
                near = (square <= self.radius[face].square()) & ~self.is_copy[number]
                index, place = torch.nonzero(near, as_tuple=True)
                rows.append(line[index])
                faces.append(face[index, place])
        row, face = torch.cat(rows), torch.cat(faces)
        order = (row * len(self.center) + face).argsort()
        return row[order], face[order]
