"""Defects of meshes: doubled triangles, cracks, and closed parts within others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from invertwin.checks import strip_derivatives
from invertwin.errors import InputError
from invertwin.scene import mesh_topology
from invertwin.scene.mesh import Mesh
from invertwin.scene.mesh_union import unite_parts
from invertwin.scene.scene import Scene

_LEAST_SHARE = 1e-6  # of the smaller triangle, in common with another one


class MeshDefects(NamedTuple):
    """Departures of a mesh from one clean surface.

    Attributes:
        doubled_triangles: number of triangles that repeat others, or lie on those of other parts.
        cracked_edges: number of open edges along cracks of 10⁻⁴ to 10⁻³ of the diagonal.
        crack_width: greatest distance of these from the others [m].
        has_overlapping_parts: True if closed parts overlap or touch; `merge_meshes` unites them.
    """

    doubled_triangles: int
    cracked_edges: int
    crack_width: float
    has_overlapping_parts: bool

    def in_words(self) -> list[str]:
        """List the defects that the mesh has."""
        cracks = f"{self.cracked_edges} edges along cracks {self.crack_width:.2g} m wide"
        named = {
            "closed parts that overlap or touch": self.has_overlapping_parts,
            f"{self.doubled_triangles} triangles on others": self.doubled_triangles,
            cracks: self.cracked_edges,
        }
        return [text for text, is_there in named.items() if is_there]


_found = WeakKeyDictionary[Mesh, MeshDefects]()


def find_defects(mesh: Mesh) -> MeshDefects:
    """Find the defects of a mesh, once for each mesh.

    Args:
        mesh: any mesh; derivatives do not matter.
    """
    if mesh not in _found:
        plain = Mesh(*map(strip_derivatives, (mesh.vertices, mesh.faces)))
        points = plain.vertices.numpy()
        welded, _, places, cracks = mesh_topology.close_cracks(points, plain.faces.numpy())
        doubled = int(find_doubled_faces(welded, places).sum())
        width = cracks.width * float(np.linalg.norm(np.ptp(points, axis=0)))
        overlaps = unite_parts(plain) is not plain
        _found[mesh] = MeshDefects(doubled, cracks.open_edges, width, overlaps)
    return _found[mesh]


def require_single_surfaces(
    scene: Scene,
    names: Iterable[str] | None = None,
    *,
    allows_overlaps: bool = False,
    allows_doubled: bool = False,
) -> None:
    """Raise an error for meshes with two surfaces in one place, of which both would count.

    Args:
        scene: scene of the objects.
        names: objects that count; None = all.
        allows_overlaps: True where surfaces inside of others are hidden.
        allows_doubled: True where of two surfaces in one place one counts.

    Raises:
        InputError: an object with doubled triangles, or closed parts that overlap.
    """
    for name in scene.objects if names is None else names:
        found = find_defects(scene.objects[name].mesh)
        overlaps = found.has_overlapping_parts and not allows_overlaps
        if overlaps or (found.doubled_triangles and not allows_doubled):
            raise InputError(
                f"expected one surface in each place of {name}, got "
                f"{' and '.join(found.in_words())}; merge_meshes and load_mesh unite closed parts: "
                "delete what is doubled otherwise"
            )


def find_doubled_faces(
    faces: Int64[np.ndarray, "f 3"], places: mesh_topology.Points
) -> Bool[np.ndarray, " f"]:
    """Mask of triangles that repeat others, or lie on those of other parts of the mesh.

    Args:
        faces: welded vertices of each triangle.
        places: positions in units of the size of the mesh.
    """
    corners, part = places[faces], mesh_topology.find_parts(faces, places)
    distinct = mesh_topology.find_distinct_faces(faces, places)
    doubled = ~mesh_topology.find_slivers(faces, places)
    doubled[distinct] = False  # all but the first of each kind remain
    near = distinct[mesh_topology.near_other_parts(corners[distinct], part[distinct])]
    pairs = near[_find_near_pairs(corners[near])]
    pairs = pairs[:, part[pairs[0]] != part[pairs[1]]]
    on = _overlap_in_plane(corners[pairs[1]], corners[pairs[0]])
    doubled[pairs[:, on]] = True
    return doubled


def _find_near_pairs(corners: Float64[np.ndarray, "f 3 3"]) -> Int64[np.ndarray, "2 n"]:
    """Return pairs of triangles whose bounding spheres meet: the smaller one, and the larger."""
    middle = corners.mean(1)
    radius = np.linalg.norm(corners - middle[:, None], axis=2).max(1, initial=0.0)
    level = np.ceil(np.log2(radius)).astype(np.int64)
    pairs = [np.zeros((2, 0), dtype=np.int64)]
    for number in np.unique(level).tolist():  # one tree for each class of sizes
        own = np.flatnonzero(level == number)
        some = np.flatnonzero(level <= number)
        reach = radius[some] + 2.0**number
        found = cKDTree(middle[own]).query_ball_point(middle[some], reach, return_sorted=False)
        counts = [len(row) for row in found]
        pairs.append(np.stack([np.repeat(some, counts), own[np.concatenate(found).astype(int)]]))
    return np.concatenate(pairs, axis=1)


def _overlap_in_plane(
    one: Float64[np.ndarray, "n 3 3"], other: Float64[np.ndarray, "n 3 3"]
) -> Bool[np.ndarray, " n"]:
    """Mask of pairs of triangles that share area in the plane of the first."""
    start = one[:, :1]
    x = one[:, 1] - one[:, 0]
    normal = np.cross(x, one[:, 2] - one[:, 0])
    x, normal = (v / np.linalg.norm(v, axis=1)[:, None] for v in (x, normal))
    axes = np.stack([x, np.cross(normal, x), normal], 1)
    flat = [np.einsum("nak,nck->nca", axes, points - start) for points in (one, other)]
    found = (np.abs(flat[1][..., 2]) <= 2 * mesh_topology.WELD_TOLERANCE).all(1)
    shapes = [shapely.polygons(points[found, :, :2]) for points in flat]
    least = np.minimum(shapely.area(shapes[0]), shapely.area(shapes[1]))
    found[found] = shapely.area(shapely.intersection(*shapes)) > _LEAST_SHARE * least
    return found
