"""Linear shape spaces: a mean shape and principal components."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor, nn

from invertwin.checks import ArrayLike, checked_count, checked_tensor, set_fields
from invertwin.errors import InputError
from invertwin.runtime.memory import require_at_most
from invertwin.scene.mesh import Mesh
from invertwin.scene.parameters import ObjectModule


@dataclass(frozen=True, eq=False)
class ShapeSpace:
    """Linear family of meshes ``mean + Σ z_k σ_k component_k`` with equal triangles.

    Attributes:
        mean: vertices of the mean shape [m].
        components: directions of the vertices, most important first.
        deviations: standard deviation σ along each [m].
        faces: vertex indices of every triangle.

    Raises:
        InputError: shapes that do not fit together, NaN, or a negative deviation.
    """

    mean: Float64[Tensor, "v 3"]
    components: Float64[Tensor, "v 3 k"]
    deviations: Float64[Tensor, " k"]
    faces: Int64[Tensor, "f 3"]

    def __post_init__(self) -> None:
        do = "give mean [v, 3], components [v, 3, k], deviations [k] of one space"
        mesh = Mesh(self.mean, self.faces)
        parts = checked_tensor(self.components, (len(mesh.vertices), 3, None), "components", do)
        sizes = checked_tensor(self.deviations, (parts.shape[2],), "deviations [m]", do)
        if bool((sizes < 0).any()) or not len(sizes):
            raise InputError(f"expected deviations >= 0, got {sizes.tolist()}; {do}")
        set_fields(self, mean=mesh.vertices, components=parts, deviations=sizes, faces=mesh.faces)

    def mesh(self, latent: Float64[Tensor, " n"]) -> Mesh:
        """Return the shape of the first n coordinates z, in standard deviations.

        Raises:
            InputError: more coordinates than the space has.
        """
        count = len(latent)
        require_at_most(count, len(self.deviations), "coordinates of the shape space", "give fewer")
        offsets = self.components[..., :count] @ (latent * self.deviations[:count])
        return Mesh(self.mean + offsets, self.faces)

    def latent(self, vertices: Float64[Tensor, "v 3"]) -> Float64[Tensor, " k"]:
        """Return the coordinates z of the shape closest to vertices in the space's order."""
        basis = (self.components * self.deviations).flatten(0, 1)
        return torch.linalg.lstsq(basis, (vertices - self.mean).reshape(-1, 1)).solution[:, 0]


class LinearShape(ObjectModule):
    """Replace an object's mesh by one of a linear shape space.

    Args:
        object: name of the object; its pose is kept.
        space: the shape space.
        initial: initial coordinates in standard deviations, or their number, from the mean shape.

    Attributes:
        latent: parameter [k], in standard deviations.

    Raises:
        InputError: none or too many coordinates, or NaN.
    """

    reported = ("latent",)

    def __init__(self, object: str, space: ShapeSpace, initial: ArrayLike | int) -> None:
        super().__init__(object)
        self.space = space
        if isinstance(initial, int):
            initial = torch.zeros(checked_count(initial, "coordinates", 1))
        start = checked_tensor(initial, (None,), "coordinates", "give numbers, or how many")
        space.mesh(start.detach())
        self.latent = nn.Parameter(start.detach().clone())

    def update_mesh(self, mesh: Mesh) -> Mesh:
        """Return the present mesh of the space."""
        return self.space.mesh(self.latent)
