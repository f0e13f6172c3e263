"""Topology of a scene: edges shared by triangles, and the ray tracer's copy of the mesh."""

from __future__ import annotations

import itertools
from collections import OrderedDict
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch

from invertwin.channel.rays.arrays import to_float, to_index, to_signed
from invertwin.channel.rays.backend import VARIANTS, backend, mi, mit
from invertwin.checks import strip_derivatives
from invertwin.scene.mesh import Mesh

_MAX_CACHED_TOPOLOGIES = 8
_MIN_SMOOTH_ANGLE, _MAX_SMOOTH_ANGLE = (
    1e-6,
    0.35,
)  # radians: rounding of coordinates; an edge of the object itself
_MAX_UNGROUPED_FACES = 256  # triangles that are not worth a group


class Topology:
    """Connectivity of a flattened scene and the ray tracer's copy of it.

    The acceleration structure is rebuilt only when the vertices differ from the last upload.

    Args:
        faces: Vertex indices of all triangles.
        face_object: Object of every triangle.
        vertices: In the objects' own frames; those of one object at one place count as one.
    """

    def __init__(self, faces: Tensor, face_object: Tensor, vertices: Tensor) -> None:
        self.faces = faces
        self.face_object = face_object
        self.fallback_face: int | None = None  # a triangle that was no sliver when last looked at
        #: Objects in one place, when last looked at, and for which pairs, antennas and vertices.
        self.coplanar_cache: tuple[set[tuple[int, int]], Tensor, Tensor, Tensor] | None = None
        owner = torch.zeros(len(vertices), dtype=torch.int64)
        owner[faces.ravel()] = face_object.repeat_interleave(3)
        self.vertex_object = owner
        used = faces.unique()
        # Vertices of triangles, the first of each object among them, and the object of each.
        first = torch.searchsorted(owner[used], torch.arange(int(owner.max()) + 1))
        self.used_vertices = used.numpy(), first.numpy(), owner[used].numpy()
        places = torch.cat([owner[:, None].double(), vertices], dim=1).numpy()
        tables = edges_of(faces.numpy(), places)
        # Of each object, side by side: samples that follow this order are spread over its surface.
        order = torch.from_numpy(morton_order(vertices[tables[0]].mean(1).numpy()))
        order = order[owner[tables[0][order, 0]].argsort(stable=True)]
        self.edges, self.edge_apexes, self.edge_faces = (table[order] for table in tables)
        beside = self.edge_faces
        alone = (self.edge_apexes >= 0).sum(1) == 1
        self.open_objects = set(face_object[beside[alone, 0]].tolist())
        self.device_faces = to_index(faces)
        #: The same, four numbers each, the last one zero: each is read as a whole.
        self.device_corners = to_index(torch.nn.functional.pad(faces, (0, 1)))
        self.device_face_object = to_index(face_object)
        self.device_edges = [to_index(self.edges[:, k]) for k in range(2)]
        self.device_edge_object = to_index(owner[self.edges[:, 0]])
        self.device_edge_apexes = [to_signed(column) for column in self.edge_apexes.T]
        self.device_edge_faces = [to_index(column) for column in beside.clamp_min(0).T]
        mesh = mi.Mesh("scene", vertex_count=len(vertices), face_count=len(faces))
        self._parameters = mi.traverse(mesh)
        self._parameters["faces"] = self.device_faces
        self._uploaded: Tensor | None = None
        self._facet_angles: Tensor | None = None
        self._mesh = mesh
        self._scene: Any = None

    @cached_property
    def welded_faces(self) -> Int64[Tensor, "f 3"]:
        """Vertices of triangles, where vertices at one place count as one; in any order."""
        table = self.faces.clone()
        for face, apex in zip(self.edge_faces.T, self.edge_apexes.T, strict=True):
            at = face >= 0
            table[face[at]] = torch.cat([self.edges[at], apex[at, None]], 1)
        return table

    @cached_property
    def face_edges(self) -> Int64[Tensor, "f 3"]:
        """The edge opposite to each of a triangle's ``welded`` vertices (−1: no proper edge)."""
        table = torch.full_like(self.faces, -1)
        for face, apex in zip(self.edge_faces.T, self.edge_apexes.T, strict=True):
            edge = torch.nonzero(face >= 0)[:, 0]
            slot = (self.welded_faces[face[edge]] == apex[edge, None]).int().argmax(1)
            table[face[edge], slot] = edge
        return table

    def facet_angle(self, number: int, vertices: Float64[Tensor, "v 3"]) -> float:
        """Compute the typical angle between normals of neighbours where an object is curved [rad].

        It is the median over its smooth edges of the mesh at the first call; 0 = no curvature.

        Args:
            number: object index.
            vertices: world positions [v, 3] in metres.
        """
        if self._facet_angles is None:
            a, b, c = vertices.detach()[self.faces].unbind(1)
            normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
            both = self.edge_faces[(self.edge_faces >= 0).all(1)]
            first, second = normals[both[:, 0]], normals[both[:, 1]]
            angle = 2 * torch.asin((0.5 * (first - second).norm(dim=1)).clamp_max(1.0))
            owner = self.face_object[both[:, 0]]
            smooth = (angle > _MIN_SMOOTH_ANGLE) & (angle < _MAX_SMOOTH_ANGLE)
            self._facet_angles = torch.zeros(int(self.face_object.max()) + 1, dtype=torch.float64)
            for k in owner[smooth].unique():
                self._facet_angles[k] = angle[smooth & (owner == k)].median()
        return float(self._facet_angles[number])

    @cached_property
    def device_welded_faces(self) -> mit.UInt32:
        """``welded`` as a flat array of the ray tracer."""
        return to_index(self.welded_faces)

    @cached_property
    def device_face_edges(self) -> mit.Int32:
        """``face_edges`` as a flat array of the ray tracer."""
        return to_signed(self.face_edges)

    def face_neighbours(self, faces: Int64[Tensor, " n"]) -> Int64[Tensor, "n k"]:
        """Triangles and all that share an edge with them (−1: none)."""
        edges = self.face_edges[faces]
        nearby = torch.where(edges[..., None] >= 0, self.edge_faces[edges.clamp_min(0)], -1)
        return torch.cat([faces[:, None], nearby.flatten(1)], 1)

    def ray_scene(self, vertices: Tensor) -> Any:
        """The Mitsuba scene with these vertices (float32, never changed in place hereafter)."""
        if self._uploaded is vertices:
            return self._scene
        if self._uploaded is not None and torch.equal(self._uploaded, vertices):
            self._uploaded = vertices
            return self._scene
        self._build_tree(vertices)
        self._uploaded = vertices
        return self._scene

    def _build_tree(self, vertices: Tensor) -> None:
        if self._scene is None:
            self._parameters["vertex_positions"] = to_float(vertices)
            self._parameters.update()
            self._scene = mi.load_dict({"type": "scene", **self._shapes()})
            self._parameters = mi.traverse(self._scene)
        else:
            key = next(k for k, _ in self._parameters.items() if k.endswith("vertex_positions"))
            self._parameters[key] = to_float(vertices)
            self._parameters.update()

    def _shapes(self) -> dict[str, Any]:
        """The mesh; on the CPU in a group, for which Embree builds its tree three times faster.

        Rays through a group take longer, so that small meshes, built in no time, stay without.
        """
        if backend() == "cuda" or len(self.faces) <= _MAX_UNGROUPED_FACES:
            return {"mesh": self._mesh}
        reference = {"type": "ref", "id": "group"}
        return {
            "group": {"type": "shapegroup", "mesh": self._mesh},
            "instance": {"type": "instance", "group": reference},
        }


_topologies: OrderedDict[tuple, tuple[list[Tensor], Topology]] = OrderedDict()


def topology_of(meshes: list[Mesh]) -> Topology:
    """The connectivity of meshes as one, kept between calls while their faces are the same."""
    # The entry holds the face tensors, so that their ids stay theirs.
    owners = [mesh.faces for mesh in meshes]
    key = (VARIANTS[backend()], *map(id, owners))
    if key not in _topologies:
        starts = [0, *itertools.accumulate(len(mesh.vertices) for mesh in meshes)]
        with _DisableFuncTorch():
            faces = [
                strip_derivatives(mesh.faces) + start
                for mesh, start in zip(meshes, starts, strict=False)
            ]
            objects = [torch.full((len(mesh.faces),), n) for n, mesh in enumerate(meshes)]
            # In the objects' own frames, where equal positions are equal to the last bit.
            vertices = torch.cat([strip_derivatives(mesh.vertices) for mesh in meshes])
            made = Topology(torch.cat(faces), torch.cat(objects), vertices)
        _topologies[key] = (owners, made)
        while len(_topologies) > _MAX_CACHED_TOPOLOGIES:
            _topologies.popitem(last=False)
    _topologies.move_to_end(key)
    return _topologies[key][1]


def edges_of(
    faces: np.ndarray, vertex_keys: np.ndarray
) -> tuple[Int64[Tensor, "e 2"], Int64[Tensor, "e k"], Int64[Tensor, "e k"]]:
    """Edges of a triangle mesh, with opposite vertex and number of every triangle at the edge.

    Vertices with equal rows in ``vertex_keys`` (object and position) count as one, so that a mesh
    with split vertices has no false open edges; objects that touch may part. The other two tables
    have as many columns as the edge with most triangles (2 for a manifold mesh); absent ones are
    −1.

    Args:
        faces: Vertex indices of triangles.
        vertex_keys: One row a vertex: object and position.
    """
    _, first, inverse = np.unique(vertex_keys, axis=0, return_index=True, return_inverse=True)
    welded = first[inverse.ravel()][faces]
    corners = [(0, 1, 2), (1, 2, 0), (2, 0, 1)]
    ends = np.concatenate([np.sort(welded[:, [a, b]], axis=1) for a, b, _ in corners])
    apex = np.concatenate([welded[:, c] for _, _, c in corners])
    proper = ends[:, 0] != ends[:, 1]
    triangle = np.tile(np.arange(len(faces)), 3)[proper]
    ends, apex = ends[proper], apex[proper]
    edges, group, counts = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(group.ravel(), kind="stable")
    start = np.repeat(np.cumsum(counts) - counts, counts)
    opposite = np.full((len(edges), counts.max(initial=1)), -1, dtype=np.int64)
    beside = opposite.copy()
    at = group.ravel()[order], np.arange(len(order)) - start
    opposite[at], beside[at] = apex[order], triangle[order]
    tables = edges.astype(np.int64), opposite, beside
    return torch.from_numpy(tables[0]), torch.from_numpy(tables[1]), torch.from_numpy(tables[2])


def morton_order(positions: np.ndarray) -> np.ndarray:
    """The order of places along a curve that fills space (Morton).

    Args:
        positions: [n, 3].
    """
    if not len(positions):
        return np.zeros(0, dtype=np.int64)
    cells = ((positions - positions.min(0)) / (np.ptp(positions) or 1.0) * 1023).astype(np.int64)
    bits = (cells[..., None] >> np.arange(10)) & 1
    return np.argsort((bits << (3 * np.arange(10) + np.arange(3)[:, None])).sum((1, 2)))
