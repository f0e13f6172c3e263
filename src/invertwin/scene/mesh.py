"""Triangle meshes as tensors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from annotated_types import MinLen
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.checks import checked_tensor, set_fields, strip_derivatives, to_tensor
from invertwin.errors import InputError
from invertwin.limits import MAX_LENGTH
from invertwin.scene import mesh_topology
from invertwin.scene.pose import Basis


@dataclass(frozen=True)
class MeshSummary:
    """Size and topology of a mesh.

    Attributes:
        extent: size of the bounding box along x, y and z [m].
        triangles: number of triangles.
        open_edges: number of edges with one triangle; zero for a closed mesh.
        nonmanifold_edges: number of edges with more than two triangles.
    """

    extent: tuple[float, float, float]
    triangles: int
    open_edges: int
    nonmanifold_edges: int

    def __str__(self) -> str:
        size = " × ".join(f"{length:.4g}" for length in self.extent)
        return (
            f"{size} m, {self.triangles} triangles, {self.open_edges} open and "
            f"{self.nonmanifold_edges} non-manifold edges"
        )


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh; its normals are (v1 − v0) × (v2 − v0).

    Open and non-manifold meshes are accepted, and so are degenerate triangles, which reflect
    nothing. Arrays and lists are converted.

    Attributes:
        vertices: positions [v, 3] in the object's frame [m]; may carry gradients.
        faces: vertex indices of every triangle [f, 3].

    Raises:
        InputError: wrong shapes, NaN, an empty mesh, or an index out of range.
    """

    vertices: Float64[Tensor, "v 3"]
    faces: Int64[Tensor, "f 3"]

    def __post_init__(self) -> None:
        do = "repair the mesh before loading it"
        vertices = checked_tensor(self.vertices, (None, 3), "mesh vertices", do, MAX_LENGTH)
        set_fields(self, vertices=vertices, faces=checked_faces(self.faces, len(vertices)))

    def summary(self) -> "MeshSummary":
        """Return its size and topology, of welded vertices and divided edges as rays meet them."""
        points = strip_derivatives(self.vertices).numpy()
        edges = mesh_topology.close_cracks(points, strip_derivatives(self.faces).numpy())[1]
        x, y, z = np.ptp(points, axis=0).tolist()
        single, several = (int(mask.sum()) for mask in (edges.counts == 1, edges.counts > 2))
        return MeshSummary((x, y, z), len(self.faces), single, several)

    @property
    def center(self) -> Float64[Tensor, "3"]:
        """Centre of the bounding box [m]."""
        return (self.vertices.amin(0) + self.vertices.amax(0)) / 2

    @property
    def triangle_areas(self) -> Float64[Tensor, " f"]:
        """Areas of the triangles [m²]."""
        a, b, c = self.vertices[self.faces].unbind(1)
        return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1)

    @property
    def area(self) -> float:
        """Surface area [m²], without gradient."""
        return float(self.triangle_areas.detach().sum())

    def change_basis(self, basis: Basis) -> "Mesh":
        """Return the mesh along other axes, of the same normals in space."""
        faces = self.faces.flip(1) if basis.is_reflection else self.faces
        return replace(self, vertices=basis.vectors(self.vertices), faces=faces)


def concatenate_meshes(parts: Annotated[Sequence[Mesh], MinLen(1)]) -> Mesh:
    """Put the vertices and triangles of shapes one after the other.

    Args:
        parts: shapes in the frame of the object.
    """
    starts = torch.tensor([0, *(len(part.vertices) for part in parts)]).cumsum(0)
    faces = [part.faces + int(start) for part, start in zip(parts, starts, strict=False)]
    return Mesh(torch.cat([part.vertices for part in parts]), torch.cat(faces))


def checked_faces(faces: object, vertex_count: int) -> Tensor:
    """Validate `faces` and return them as vertex indices [f, 3].

    Args:
        faces: tensor, array or nested sequence of integers.
        vertex_count: number of vertices.

    Raises:
        InputError: wrong type or shape, no faces, or an index out of range.
    """
    do = "give a tensor or array of vertex indices"
    indices = to_tensor(faces, "mesh faces as integers of shape [any, 3]", do, None)
    # An empty list becomes a float tensor: report a mesh without faces.
    if indices.numel() == 0 or vertex_count == 0:
        raise InputError(
            f"expected a mesh with triangles, got {vertex_count} vertices and no usable face; "
            "leave out empty objects"
        )
    if indices.is_floating_point() or indices.is_complex() or indices.dtype == torch.bool:
        raise InputError(
            f"expected mesh faces as integers of shape [any, 3], got {indices.dtype}; "
            "give vertex indices"
        )
    if indices.ndim != 2 or indices.shape[1] != 3:
        raise InputError(
            f"expected mesh faces of shape [any, 3], got {list(indices.shape)}; "
            "split polygons into triangles"
        )
    indices = indices.to(torch.int64)
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= vertex_count:
        raise InputError(
            f"expected face indices in [0, {vertex_count - 1}], got [{low}, {high}]; "
            "count vertices from 0"
        )
    return indices
