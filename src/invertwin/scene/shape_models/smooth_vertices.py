"""Free vertices with smoothed gradients, for large steps without self-intersections.

And smooth deformations: a few control points move many vertices.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import coo_array, csc_array, csgraph, eye_array
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor, nn

from invertwin.checks import Counts, Point, checked_number
from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh
from invertwin.scene.parameters import ObjectModule
from invertwin.scene.shape_models.lattice import Lattice, tensor_product

_MAX_SMOOTHING = 1e9  # √λ is a number of edges; the matrix of much more has no factors


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
        r = 1 - t
        inner = (3 * t**3 - 6 * t**2 + 4) / 6, (3 * r**3 - 6 * r**2 + 4) / 6
        weights = torch.stack([r**3 / 6, *inner, t**3 / 6], dim=-1)  # of uniform cubic B-splines
        return tensor_product(self.offsets, index, weights)

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the deformed mesh.

        Raises:
            InputError: the mesh leaves the box.
        """
        return Mesh(mesh.vertices + self.displacement(mesh.vertices), mesh.faces)

    def values(self) -> dict[str, Tensor]:
        """Return offsets [m] of the control points by name, for progress and reports."""
        return {f"{self.object}.control_offsets": self.offsets.detach().clone()}


class SmoothVertices(ObjectModule):
    """Displace every vertex by ``(I + λL)⁻¹ u``, L the graph Laplacian of the mesh.

    A step of gradient descent on u is a step ``−η (I + λL)⁻² ∂loss/∂x`` of the vertices: rough
    components of the gradient are attenuated, and every shape remains reachable.

    Source: Nicolet, Jacobson and Jakob 2021, "Large Steps in Inverse Rendering of Geometry".
    Differs from the source: u belongs to the displacement, not to the positions, so that zero is
    the initial shape; any optimiser may step u.

    Args:
        object: name of the object.
        mesh: initial mesh, whose edges define neighbours.
        smoothing: λ; detail below about √λ edge lengths is attenuated.

    Attributes:
        latent: parameter u [v, 3] in the object's frame, metres.

    Raises:
        InputError: a negative λ.
    """

    reported = ("offsets",)

    def __init__(self, object: str, mesh: Mesh, smoothing: float = 20.0) -> None:
        super().__init__(object)
        amount = checked_number(smoothing, "smoothing λ", 0.0, _MAX_SMOOTHING)
        count = len(mesh.vertices)
        self._faces = mesh.faces.clone()
        self._smoother = Smoother(mesh.faces, count, amount)
        self.latent = nn.Parameter(torch.zeros(count, 3, dtype=torch.float64))

    @property
    def offsets(self) -> Float64[Tensor, "v 3"]:
        """Return displacements of the vertices in the object's frame [m]."""
        return _Smoothed.apply(self.latent, self._smoother)  # type: ignore[return-value]

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the mesh with its vertices displaced.

        Raises:
            InputError: other triangles than those of the mesh this was created with.
        """
        if len(mesh.vertices) != len(self.latent) or not torch.equal(mesh.faces, self._faces):
            raise InputError(
                f"expected the triangles of {self.object!r} as they were "
                f"({len(self.latent)} vertices), got {len(mesh.vertices)}; "
                "create SmoothVertices with the object's own mesh"
            )
        return Mesh(mesh.vertices + self.offsets, mesh.faces)


class Smoother:
    """Factorised matrix I + λL, symmetric and positive definite; copies refactorise.

    Args:
        faces: triangles [f, 3].
        count: number of vertices.
        amount: λ.
    """

    def __init__(self, faces: Tensor, count: int, amount: float) -> None:
        self._given = faces, count, amount
        matrix = eye_array(count) + amount * laplacian(faces, count)
        self._factors: SuperLU = splu(csc_array(matrix))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._given

    def solve(self, values: Tensor) -> Tensor:
        """Return (I + λL)⁻¹ times columns, without derivatives."""
        return torch.from_numpy(self._factors.solve(np.asfortranarray(values.detach().numpy())))


def laplacian(faces: Tensor, count: int) -> csc_array:
    """Return the graph Laplacian: degrees on the diagonal, −1 for every edge.

    Args:
        faces: triangles [f, 3].
        count: number of vertices.
    """
    ends = faces.flatten().numpy(), faces.roll(-1, dims=1).flatten().numpy()
    joined = coo_array((np.ones(len(ends[0])), ends), shape=(count, count))
    return csc_array(csgraph.laplacian(((joined + joined.T) > 0).astype(np.float64)))


class _Smoothed(torch.autograd.Function):
    """Product (I + λL)⁻¹ u, with derivatives of any order in both modes.

    The matrix is symmetric, so its adjoint is itself.
    """

    @staticmethod
    def forward(ctx: Any, latent: Tensor, smoother: Smoother) -> Tensor:
        ctx.smoother = smoother
        return smoother.solve(latent)

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor, None]:
        return _Smoothed.apply(outputs[0], ctx.smoother), None  # type: ignore[return-value]

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return ctx.smoother.solve(tangents[0])
