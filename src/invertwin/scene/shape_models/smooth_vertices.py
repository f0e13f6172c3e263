"""Free vertices with smoothed gradients, for large steps without self-intersections."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import coo_array, csc_array, csgraph, eye_array
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor, nn

from invertwin.checks import checked_number
from invertwin.errors import InputError
from invertwin.scene.mesh import Mesh
from invertwin.scene.parameters import ObjectModule


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
        amount = checked_number(smoothing, "smoothing λ", 0.0)
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
