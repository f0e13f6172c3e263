"""Topology of a scene: edges shared by triangles, and the ray tracer's copy of the mesh."""

from __future__ import annotations

import itertools
import warnings
from collections import OrderedDict
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch

from invertwin.channel.rays.arrays import to_float, to_index, to_signed
from invertwin.channel.rays.backend import VARIANTS, backend, mi, mit
from invertwin.channel.rays.rigid_groups import find_rigid_groups, is_one_motion
from invertwin.checks import strip_derivatives
from invertwin.errors import PhysicsWarning
from invertwin.scene import mesh_topology
from invertwin.scene.mesh import Mesh

_MAX_CACHED_TOPOLOGIES = 8
_MIN_SMOOTH_ANGLE = 1e-6  # rad: rounding of coordinates
_MAX_SMOOTH_ANGLE = 0.35  # rad: an edge of the object itself
_MAX_UNGROUPED_FACES = 256  # triangles that are not worth a group


class Topology:
    """Connectivity of a flattened scene and the ray tracer's copy of it.

    The acceleration structure is rebuilt only when the vertices differ from the last upload.

    Args:
        faces: vertex indices of all triangles; those of closed objects are turned outwards.
        vertex_object: object of every vertex, in ascending order.
        vertices: positions in the objects' own frames, or in the world where objects share edges.
        groups: group of each object, within which vertices at one place count as one.
    """

    def __init__(
        self, faces: Tensor, vertex_object: Tensor, vertices: Tensor, groups: np.ndarray
    ) -> None:
        self.face_object = face_object = vertex_object[faces[:, 0]]
        self.object_group = torch.from_numpy(groups)
        self.fallback_face: int | None = None  # a triangle that was no sliver at the last test
        #: Coplanar objects at the last test, and the pairs, antennas and vertices of that test.
        self.coplanar_cache: tuple[set[tuple[int, int]], Tensor, Tensor, Tensor] | None = None
        self.vertex_object = owner = vertex_object
        used = torch.bincount(faces.ravel()).nonzero()[:, 0]
        # Vertices of triangles, the first of each object among them, and the object of each.
        own = owner[used]
        first = torch.searchsorted(own, torch.arange(int(owner[-1]) + 1))
        self.used_vertices = used.numpy(), first.numpy(), own.numpy()
        welded, edges, places, cracks = mesh_topology.close_cracks(
            vertices.numpy(), faces.numpy(), groups[owner.numpy()], face_object.numpy()
        )
        self._moves = [torch.from_numpy(column) for column in cracks[:4]]
        if cracks.open_edges:
            warnings.warn(
                f"{cracks.open_edges} edges of meshes run along cracks of up to {cracks.width:.2g} "
                "of their size, which count as openings of the surface; weld the vertices",
                PhysicsWarning,
                stacklevel=2,
            )
        #: Vertices of triangles, where vertices at one place count as one.
        self.welded_faces: Int64[Tensor, "f 3"] = torch.from_numpy(welded)
        self._built = faces, vertices
        tables = edge_tables(edges, places, face_object.numpy())
        # Of each object, side by side: samples that follow this order are spread over its surface.
        start, end = tables[0].T
        middle = vertices[start].add_(vertices[end])
        order = torch.from_numpy(morton_order(middle.numpy()))
        if len(groups) > 1:
            order = order[
                mesh_topology.sort_rows(owner[start[order]].numpy(), count=len(groups))[0]
            ]
        self.edges, self.edge_apexes, self.edge_faces = (table[order] for table in tables)
        beside = self.edge_faces
        self.open_objects = _open_objects(beside, face_object)
        #: Open objects that others close: panels of a body.
        self.panels = self.open_objects - set(face_object[beside[beside[:, 1] < 0, 0]].tolist())
        self.faces = faces = _turn_outwards(faces, welded, face_object, places, self.open_objects)
        self.device_faces = to_index(faces)
        #: The same, padded to four numbers per triangle, so that one read gathers a triangle.
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

    def join_vertices(self, parts: Sequence[Float64[Tensor, "_ 3"]]) -> Float64[Tensor, "v 3"]:
        """Put the vertices of all objects one after the other, moved where cracks close.

        Args:
            parts: positions of each object, with derivatives [m].
        """
        points, (vertex, row, column, weight) = torch.cat(list(parts)), self._moves
        if not len(vertex):
            return points
        moved = points.new_zeros(len(vertex), 3).index_add(0, row, weight[:, None] * points[column])
        return points.index_put((vertex,), moved)

    @cached_property
    def _seams(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices of triangles, those of the same object that they count as, and their gaps."""
        (faces, points), welded, owner = self._built, self.welded_faces, self.vertex_object
        seam = (welded != faces) & (owner[welded] == owner[faces])
        one, other = faces[seam], welded[seam]
        return one.numpy(), other.numpy(), (points[one] - points[other]).norm(dim=1).numpy()

    def keeps_seams(self, parts: Sequence[Float64[Tensor, "_ 3"]]) -> bool:
        """Test that vertices of an object that count as one are as close as they were.

        Args:
            parts: positions of each object in its own frame [m].
        """
        one, other, gap = self._seams
        if not len(one):
            return True
        points = np.concatenate([strip_derivatives(part).numpy() for part in parts])
        tolerance = mesh_topology.CRACK_TOLERANCE * np.linalg.norm(np.ptp(points, axis=0))
        return bool((np.linalg.norm(points[one] - points[other], axis=1) <= gap + tolerance).all())

    @cached_property
    def face_edges(self) -> Int64[Tensor, "f 3"]:
        """The edge opposite to each of a triangle's welded vertices; −1 = none, or several."""
        table, number = torch.full_like(self.faces, -1), torch.zeros_like(self.faces)
        for face, apex in zip(self.edge_faces.T, self.edge_apexes.T, strict=True):
            edge = torch.nonzero(face >= 0)[:, 0]
            slot = (self.welded_faces[face[edge]] == apex[edge, None]).int().argmax(1)
            table[face[edge], slot] = edge
            number.index_put_((face[edge], slot), torch.ones_like(edge), accumulate=True)
        return torch.where(number == 1, table, -1)

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
            both = self.edge_faces[(self.edge_faces >= 0).sum(1) == 2]
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
        """``welded_faces`` as a flat array of the ray tracer."""
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
        if self._uploaded is None or not (
            self._uploaded is vertices or torch.equal(self._uploaded, vertices)
        ):
            key = next(k for k, _ in self._parameters.items() if k.endswith("vertex_positions"))
            self._parameters[key] = to_float(vertices)
            self._parameters.update()
            if self._scene is None:
                self._scene = mi.load_dict({"type": "scene", **self._shapes()})
                self._parameters = mi.traverse(self._scene)
        self._uploaded = vertices
        return self._scene

    def _shapes(self) -> dict[str, Any]:
        """The mesh; on the CPU in a group, for which Embree builds its tree three times faster.

        Rays through a group take longer, so that small meshes, built in no time, stay without.
        """
        if backend() == "cuda" or len(self.faces) <= _MAX_UNGROUPED_FACES:
            return {"mesh": self._mesh}
        group = {"type": "shapegroup", "mesh": self._mesh}
        instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
        return {"group": group, "instance": instance}


_topologies: OrderedDict[tuple, tuple[list[Tensor], dict[int, Tensor], Topology]] = OrderedDict()


def topology_of(
    meshes: Sequence[Mesh],
    vertices: Sequence[Float64[Tensor, "_ 3"]] | None = None,
    scenes: Sequence[int] | None = None,
) -> Topology:
    """The connectivity of meshes as one, kept between calls while their faces are the same.

    Args:
        meshes: one of each object.
        vertices: world positions of each object [m], with derivatives: objects that touch and
            move together share edges. None = no object shares edges with another one.
        scenes: scene of each object; None = one scene.
    """
    faces, sizes = [mesh.faces for mesh in meshes], [len(mesh.vertices) for mesh in meshes]
    with _DisableFuncTorch():
        groups = np.arange(len(meshes))
        if vertices is not None:
            groups = find_rigid_groups(faces, vertices, scenes)
        joined = np.flatnonzero(np.bincount(groups)[groups] > 1).tolist()
        world = {} if vertices is None else {n: strip_derivatives(vertices[n]) for n in joined}
        bodies = {
            g: torch.cat([world[n] for n in joined if groups[n] == g]) for g in groups[joined]
        }
        # The entry holds the face tensors, so that their ids stay theirs.
        key = (VARIANTS[backend()], groups.tobytes(), *map(id, faces), *sizes)
        _, known, found = _topologies.get(key, (faces, bodies, None))
        # The seams of a group stay as they are while its objects move as one body, those of an
        # object until they open.
        rests = all(is_one_motion(known[g], bodies[g]) for g in bodies)
        if found is None or not rests or not found.keeps_seams([one.vertices for one in meshes]):
            starts = [0, *itertools.accumulate(sizes)]
            fixed = [strip_derivatives(mesh.vertices) for mesh in meshes]
            own = [strip_derivatives(f) + start for f, start in zip(faces, starts, strict=False)]
            owner = torch.cat([torch.full((len(v),), n) for n, v in enumerate(fixed)])
            # Joined objects in the world; else in their own frames, where no pose changes a seam.
            points = torch.cat([world.get(n, own_frame) for n, own_frame in enumerate(fixed)])
            found = Topology(torch.cat(own), owner, points, groups)
            _topologies[key] = faces, bodies, found
        while len(_topologies) > _MAX_CACHED_TOPOLOGIES:
            _topologies.popitem(last=False)
    _topologies.move_to_end(key)
    return found


def _open_objects(edge_faces: Tensor, face_object: Tensor) -> set[int]:
    """Objects that have an edge at which one triangle of theirs ends."""
    if not bool(face_object.any()):  # a single one
        return {0} if bool((edge_faces[:, 1] < 0).any()) else set()
    owners = torch.where(edge_faces >= 0, face_object[edge_faces.clamp_min(0)], -1)
    owners = owners[(owners != owners[:, :1]).any(1)]
    edge, column = torch.nonzero(owners >= 0, as_tuple=True)
    count = int(face_object.max()) + 1
    # By one number for each edge and owner, since rows of two are compared 20 times slower.
    pairs, ends = (edge * count + owners[edge, column]).unique(return_counts=True)
    return set((pairs[ends == 1] % count).unique().tolist())


def _turn_outwards(
    faces: Int64[Tensor, "f 3"],
    welded: np.ndarray,
    face_object: Int64[Tensor, " f"],
    places: np.ndarray,
    open_objects: set[int],
) -> Int64[Tensor, "f 3"]:
    """Triangles of closed objects with outward normals, all others as they are."""
    inward = torch.zeros(len(faces), dtype=torch.bool)
    counts = face_object.bincount().tolist()  # objects follow each other
    parts = zip(torch.from_numpy(welded).split(counts), inward.split(counts), strict=True)
    for number, (own, turned) in enumerate(parts):
        if number not in open_objects:
            # Among the vertices of all objects, each one would take the time of all.
            low, high = int(own.min()), int(own.max())
            found = mesh_topology.find_inward_faces((own - low).numpy(), places[low : high + 1])
            turned.copy_(torch.from_numpy(found))
    return torch.where(inward[:, None], faces.flip(1), faces) if inward.any() else faces


def edge_tables(
    edges: mesh_topology.MeshEdges, places: np.ndarray, owner: np.ndarray | int = 0
) -> tuple[Int64[Tensor, "e 2"], Int64[Tensor, "e k"], Int64[Tensor, "e k"]]:
    """Edges of triangles, with opposite vertex and number of every triangle at the edge.

    An edge ends where vertices of others lie on it, so that T-junctions make no false open edges;
    doubled faces count once.

    Args:
        edges: edges of triangles, as ``close_cracks`` returns them.
        places: positions in units of the size of their group, likewise.
        owner: object of each triangle.

    Returns:
        Vertices at the ends, opposite vertices, and triangles of each edge. The last two have as
        many columns as the edge with most triangles, at least 2; absent ones are −1.
    """
    ends, counts, apex, triangle = mesh_topology.merge_doubled_sides(edges, places, owner)
    opposite = np.full((len(ends), counts.max(initial=2)), -1, dtype=np.int64)
    beside = opposite.copy()
    filled = np.arange(opposite.shape[1]) < counts[:, None]
    opposite[filled], beside[filled] = apex, triangle
    return torch.from_numpy(ends), torch.from_numpy(opposite), torch.from_numpy(beside)


def morton_order(positions: np.ndarray) -> np.ndarray:
    """The order of places along a curve that fills space (Morton).

    Args:
        positions: [n, 3].
    """
    if not len(positions):
        return np.zeros(0, dtype=np.int64)
    bits = np.arange(1024)[:, None] >> np.arange(10) & 1
    spread = (bits << 3 * np.arange(10)).sum(1)  # two zeros between the bits of a number
    fine = 1023 / (np.ptp(positions) or 1.0)
    x, y, z = (spread.take(((c - c.min()) * fine).astype(np.int64)) for c in positions.T)
    code = x << 2 | z << 1 | y  # boresight in the highest bits
    return mesh_topology.sort_order(code)
