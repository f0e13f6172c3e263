"""Regularisers: Laplacian smoothness of displacements, and prior probability of latents."""

from collections.abc import Callable

import igl
import torch
from jaxtyping import Float64
from torch import Tensor, nn

from invertwin.checks import check_shape
from invertwin.errors import InputError
from invertwin.scene import Mesh, Scene

Regularizer = Callable[[Scene], Float64[Tensor, ""]]


class Laplacian:
    """Dirichlet energy of an object's displacement from its initial shape.

    ``(weight/2) Σ_edges w_e |d_i − d_j|²`` with cotangent weights of the initial shape; d are the
    vertices' displacements in the object's frame, over the mean edge length.

    Source: §4.2 of the paper (λ L θ; its gradient is weight · L d).
    Differs from the source: the energy is that of the displacement, so that the initial shape is
    not smoothed.

    Args:
        scene: scene with the initial shape.
        object: name of the object.
        weight: weight of the energy.
    """

    def __init__(self, scene: Scene, object: str, weight: float) -> None:
        mesh = scene[object].mesh
        self.object, self.weight = object, weight
        self.start = mesh.vertices.detach().clone()
        self.edges, self.weights, self.unit = cotangent_edges(mesh)

    def __call__(self, scene: Scene) -> Float64[Tensor, ""]:
        """Return the energy of the scene's present shape.

        Raises:
            InputError: A mesh with another number of vertices.
        """
        vertices = scene[self.object].mesh.vertices
        what = f"vertices of {self.object} as those of its initial shape, for its Laplacian,"
        check_shape(vertices, self.start.shape, what, "give one shape of each object")
        moved = (vertices - self.start) / self.unit
        jump = moved[self.edges[:, 0]] - moved[self.edges[:, 1]]
        return 0.5 * self.weight * (self.weights * jump.square().sum(1)).sum()


class LatentNorm:
    """Penalty ½ weight |z|²: negative log prior probability of a latent.

    Args:
        module: module with the parameter ``latent``, such as `PriorShape` or `LinearShape`.
        weight: factor of ½ |z|².
    """

    def __init__(self, module: nn.Module, weight: float) -> None:
        if not isinstance(getattr(module, "latent", None), nn.Parameter):
            raise InputError(
                f"expected a module with a latent, got {type(module).__name__}; "
                "give a PriorShape or a LinearShape"
            )
        self.module, self.weight = module, weight

    def __call__(self, scene: Scene) -> Float64[Tensor, ""]:
        """Return the penalty at the module's present latent."""
        return 0.5 * self.weight * self.module.latent.square().sum()  # type: ignore[union-attr]


def cotangent_edges(mesh: Mesh) -> tuple[Tensor, Float64[Tensor, " edge"], float]:
    """Compute edges, their cotangent weights (at least 0.01), and the mean edge length [m]."""
    positions = mesh.vertices.detach()
    # Half cotangents of the angles opposite to the sides; a triangle without area has none.
    halves = torch.from_numpy(igl.cotmatrix_entries(positions.numpy(), mesh.faces.numpy()))
    pairs = mesh.faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)
    edges, group = pairs.sort(dim=1).values.unique(dim=0, return_inverse=True)
    halves = halves.nan_to_num(0.0, 0.0, 0.0).flatten()
    total = torch.zeros(len(edges), dtype=torch.float64).index_add(0, group, halves)
    lengths = (positions[edges[:, 0]] - positions[edges[:, 1]]).norm(dim=1)
    return edges, total.clamp_min(0.01), float(lengths.mean())
