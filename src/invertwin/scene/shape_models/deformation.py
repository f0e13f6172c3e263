"""Smooth deformations: a few control points move many vertices."""

import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.checks import Counts, Point
from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh
from invertwin.scene.parameters import ObjectModule
from invertwin.scene.shape_models.lattice import Lattice, tensor_product


class LatticeDeformation(ObjectModule):
    """Deform an object by cubic B-splines over a lattice of control points.

    The displacement field is twice continuously differentiable, whatever the mesh; equal offsets
    are a translation.

    Args:
        object: name of the object.
        low, high: opposite corners of a box around the object's mesh, in its frame [m].
        counts: number of lattice nodes along x, y and z.

    Attributes:
        offsets: parameter [x+2, y+2, z+2, 3] in the object's frame [m]: offsets of the lattice's
            nodes and of one more on every side.

    Raises:
        InputError: a box without volume, or fewer than two nodes along an axis.
    """

    def __init__(self, object: str, low: Point, high: Point, counts: Counts = (4, 4, 4)) -> None:
        super().__init__(object)
        self.lattice = Lattice.from_bounds(low, high, counts)
        shape = [n + 2 for n in self.lattice.counts]
        self.offsets = nn.Parameter(torch.zeros(*shape, 3, dtype=torch.float64))

    def displacement(self, points: Float64[Tensor, "p 3"]) -> Float64[Tensor, "p 3"]:
        """Return the displacement [m] of points inside the box, in the object's frame.

        Raises:
            InputError: points outside of it.
        """
        slack = 1e-9 * (self.lattice.high - self.lattice.low)
        place = points.detach()
        out = ((place < self.lattice.low - slack) | (place > self.lattice.high + slack)).any(1)
        if bool(out.any()):
            raise InputError(
                f"expected points of {self.object!r} in the lattice's box, got {int(out.sum())} "
                "outside; choose low and high around the mesh"
            )
        # Control points begin one step before the first node: that of cell i is number i of them.
        index, t = self.lattice.cell(points)
        return tensor_product(self.offsets, index, _cubic_spline(t))

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the deformed mesh.

        Raises:
            InputError: the mesh leaves the box.
        """
        return Mesh(mesh.vertices + self.displacement(mesh.vertices), mesh.faces)

    def values(self) -> dict[str, Tensor]:
        """Return offsets [m] of the control points by name, for progress and reports."""
        return {f"{self.object}.control_offsets": self.offsets.detach().clone()}


def _cubic_spline(t: Tensor) -> Tensor:
    """Return weights of the four control points around positions t in [0, 1] of a cell; sum 1."""
    r = 1 - t
    inner = (3 * t**3 - 6 * t**2 + 4) / 6, (3 * r**3 - 6 * r**2 + 4) / 6
    return torch.stack([r**3 / 6, *inner, t**3 / 6], dim=-1)
