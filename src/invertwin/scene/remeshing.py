"""Remesh surfaces between the stages of a fit.

No library (in 2026) serves all platforms: gpytoolbox has no wheels for Linux on ARM, pymeshlab is
GPL, trueform is for noncommercial use, pyacvd needs VTK and keeps neither borders nor topology, and
MMG (mmgpy) leaves edges of 1.8 times the target length, and folds a box unless its ridges are
frozen.
"""

from collections.abc import Callable, Iterator
from typing import Any

import igl
import numpy as np
import torch

from invertwin.checks import checked_number
from invertwin.errors import InputError
from invertwin.runtime.memory import require_at_most
from invertwin.scene.mesh import Mesh

_MAX_TRIANGLES = 1e6  # limit of the loops over single triangles
_REMESHING_ROUNDS = 5  # rounds of split, collapse, flip, relax; the lengths converge within these
# Split and collapse limits relative to the target length.
_SPLIT_FACTOR, _COLLAPSE_FACTOR = 4 / 3, 4 / 5
_MIN_FLIP_COSINE = 0.5  # minimum cosine between two triangles of a flipped edge: creases stay


def remesh(mesh: Mesh, edge_length: float) -> Mesh:
    """Remesh a surface with edges of nearly one length; topology and borders are preserved.

    Long edges are split, short ones collapsed, others flipped to bring valences closer to six, and
    vertices moved along the surface to the centre of their neighbours. Details finer than the
    target length are lost. Vertices of borders, and of edges with more than two triangles, are
    fixed.

    Source: Botsch and Kobbelt 2004, "A Remeshing Approach to Multiresolution Modeling".

    Args:
        mesh: surface; derivatives end here.
        edge_length: target length [m].

    Raises:
        InputError: a length that is not positive or too small, or a surface without area.
    """
    length = require_edge_length(mesh, edge_length)
    surface = _EditableMesh(mesh)
    for _ in range(_REMESHING_ROUNDS):
        surface.split(_SPLIT_FACTOR * length)
        surface.collapse(_COLLAPSE_FACTOR * length, _SPLIT_FACTOR * length)
        surface.flip()
        surface.relax(mesh)
    return surface.to_mesh()


def require_edge_length(mesh: Mesh, edge_length: float) -> float:
    """Validate an edge length for remeshing a surface.

    Args:
        mesh: the surface.
        edge_length: target length [m].

    Raises:
        InputError: as `remesh`.
    """
    length = checked_number(edge_length, "edge length [m]", 0.0, open_low=True)
    area = mesh.area
    if not area > 0:
        raise InputError("expected a surface with area, got none; check the mesh")
    do = "give metres, or a longer edge"
    require_at_most(2 * area / length / length, _MAX_TRIANGLES, "triangles", do)
    return length


def closest_points(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Return the closest points of a surface [p, 3].

    Args:
        mesh: the surface.
        points: positions in the mesh's frame [p, 3] [m].
    """
    surface = mesh.vertices.detach().numpy(), mesh.faces.numpy()
    return np.asarray(igl.point_mesh_squared_distance(points, *surface)[2])


class _EditableMesh:
    """Editable triangles with vertex positions and vertex–triangle incidence."""

    def __init__(self, mesh: Mesh) -> None:
        self.positions = list(mesh.vertices.detach().numpy().copy())
        rows = [tuple(face) for face in mesh.faces.tolist() if len(set(face)) == 3]
        self.faces: dict[int, tuple[int, int, int]] = dict(enumerate(rows))
        self.around: list[set[int]] = [set() for _ in self.positions]
        self.next = len(rows)
        for number, face in self.faces.items():
            for vertex in face:
                self.around[vertex].add(number)
        edges, counts = self._edges()
        self.fixed = set(edges[counts != 2].ravel().tolist())

    def to_mesh(self) -> Mesh:
        """Return the present mesh without unused vertices."""
        used, faces = np.unique(np.array(list(self.faces.values())), return_inverse=True)
        return Mesh(
            torch.from_numpy(np.array(self.positions)[used]),
            torch.from_numpy(faces.reshape(-1, 3).astype(np.int64)),
        )

    def split(self, longest: float) -> None:
        """Halve edges until none exceeds a length."""
        while True:
            found = False
            for a, b in self._sorted_edges(lambda length: length > longest, -1):
                found = True
                middle = len(self.positions)
                self.positions.append(0.5 * (self.positions[a] + self.positions[b]))
                self.around.append(set())
                both = self.around[a] & self.around[b]
                if len(both) != 2:
                    self.fixed.add(middle)
                for number in both:
                    face = self.faces[number]
                    self._remove(number)
                    self._add(_replace_vertex(face, a, middle))
                    self._add(_replace_vertex(face, b, middle))
            if not found:
                return

    def collapse(self, shortest: float, longest: float) -> None:
        """Collapse short edges that keep the surface manifold."""
        for a, b in self._sorted_edges(lambda length: length < shortest, 1):
            both = self.around[a] & self.around[b]
            if len(both) != 2 or a in self.fixed or b in self.fixed:
                continue
            here, there = self._neighbours(a), self._neighbours(b)
            thirds = here & there
            if len(thirds) != 2 or any(len(self.around[t]) < 4 for t in thirds):
                continue
            middle = 0.5 * (self.positions[a] + self.positions[b])
            ring = np.array([self.positions[v] for v in (here | there) - {a, b}])
            if ((ring - middle) ** 2).sum(1).max() > longest**2:
                continue
            rest = (self.around[a] | self.around[b]) - both
            if self._would_fold(rest, (a, b), middle):
                continue
            for number in both:
                self._remove(number)
            for number in list(self.around[b]):
                face = self.faces[number]
                self._remove(number)
                self._add(_replace_vertex(face, b, a))
            self.positions[a] = middle

    def flip(self) -> None:
        """Flip edges that bring valences closer to six."""
        for a, b in self._edges()[0].tolist():
            both = list(self.around[a] & self.around[b])
            if len(both) != 2:
                continue
            if _has_directed_edge(self.faces[both[1]], a, b):
                both.reverse()
            first, second = (self.faces[number] for number in both)
            if not _has_directed_edge(first, a, b) or not _has_directed_edge(second, b, a):
                continue
            c, d = sum(first) - a - b, sum(second) - a - b
            if c == d or self.around[c] & self.around[d]:
                continue
            now = [len(self.around[v]) - 6 for v in (a, b, c, d)]
            then = [now[0] - 1, now[1] - 1, now[2] + 1, now[3] + 1]
            if sum(map(abs, then)) >= sum(map(abs, now)) or min(then[:2]) < 3 - 6:
                continue
            old = [self._normal(face) for face in (first, second)]
            new = [self._normal(face) for face in ((c, a, d), (d, b, c))]
            units = [n / max(float(np.linalg.norm(n)), 1e-300) for n in (*old, *new)]
            if units[0] @ units[1] < _MIN_FLIP_COSINE or units[2] @ units[3] < _MIN_FLIP_COSINE:
                continue
            if units[2] @ units[0] <= 0 or units[3] @ units[1] <= 0:
                continue
            for number in both:
                self._remove(number)
            self._add((c, a, d))
            self._add((d, b, c))

    def relax(self, onto: Mesh) -> None:
        """Move vertices along the surface to the centre of their neighbours."""
        positions, faces = np.array(self.positions), np.array(list(self.faces.values()))
        a, b, c = positions[faces].transpose(1, 0, 2)
        normals = np.zeros_like(positions)
        for corner in faces.T:
            np.add.at(normals, corner, np.cross(b - a, c - a))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        ends = self._edges()[0]
        one, other = np.concatenate([ends, ends[:, ::-1]]).T
        middle, count = np.zeros_like(positions), np.bincount(one, minlength=len(positions))
        np.add.at(middle, one, positions[other])
        step = middle / np.maximum(count, 1)[:, None] - positions
        step -= (step * normals).sum(1, keepdims=True) * normals
        free = np.array([bool(ring) for ring in self.around])
        free[list(self.fixed)] = False
        positions[free] = closest_points(onto, (positions + step)[free])
        self.positions = list(positions)

    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return edges as pairs of vertices, and their number of triangles."""
        faces = np.array(list(self.faces.values()))
        pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        return np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)

    def _sorted_edges(
        self, is_selected: Callable[[Any], Any], order: int
    ) -> Iterator[tuple[int, int]]:
        """Yield selected edges by length, if they still exist."""
        edges, positions = self._edges()[0], np.array(self.positions)
        length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
        rows = np.nonzero(is_selected(length))[0]
        for row in rows[np.argsort(order * length[rows], kind="stable")]:
            a, b = edges[row].tolist()
            apart = np.linalg.norm(self.positions[a] - self.positions[b])
            if self.around[a] & self.around[b] and is_selected(apart):
                yield a, b

    def _neighbours(self, vertex: int) -> set[int]:
        return {v for number in self.around[vertex] for v in self.faces[number]} - {vertex}

    def _would_fold(self, numbers: set[int], moved: tuple[int, int], position: np.ndarray) -> bool:
        """Return whether a triangle would flip or degenerate with two vertices at a position."""
        rows = np.array([self.faces[number] for number in numbers])
        before = np.array([[self.positions[v] for v in row] for row in rows.tolist()])
        after = before.copy()
        after[np.isin(rows, moved)] = position
        old, new = (np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in (before, after))
        sizes = np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
        return bool(((old * new).sum(1) <= 0.2 * sizes).any())

    def _normal(self, face: tuple[int, int, int]) -> np.ndarray:
        a, b, c = (self.positions[v] for v in face)
        return np.cross(b - a, c - a)

    def _add(self, face: tuple[int, int, int]) -> None:
        self.faces[self.next] = face
        for vertex in face:
            self.around[vertex].add(self.next)
        self.next += 1

    def _remove(self, number: int) -> None:
        for vertex in self.faces.pop(number):
            self.around[vertex].discard(number)


def _replace_vertex(face: tuple[int, int, int], old: int, new: int) -> tuple[int, int, int]:
    a, b, c = (new if vertex == old else vertex for vertex in face)
    return a, b, c


def _has_directed_edge(face: tuple[int, int, int], a: int, b: int) -> bool:
    """Return whether a triangle contains the directed edge from a to b."""
    return (a, b) in ((face[0], face[1]), (face[1], face[2]), (face[2], face[0]))
