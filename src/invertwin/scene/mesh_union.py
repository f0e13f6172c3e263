"""The outer surface of bodies that overlap or touch within one mesh.

Modelling scripts put boxes into each other and write the triangles of all. Faces inside of others
reflect nothing, and edges in their planes bound nothing.
"""

from collections.abc import Sequence
from typing import Annotated

import manifold3d
import numpy as np
import torch
from annotated_types import MinLen
from jaxtyping import Int64

from invertwin.checks import is_differentiated, strip_derivatives
from invertwin.scene import mesh_topology
from invertwin.scene.mesh import Mesh, concatenate_meshes

_SAME_AREA = 1e-9  # relative change of the area of parts that only stand side by side


def merge_meshes(parts: Annotated[Sequence[Mesh], MinLen(1)]) -> Mesh:
    """Merge shapes into one rigid object of one material.

    Closed shapes that overlap or touch become one surface, without the faces inside. Shapes with
    derivatives are put side by side as they are.

    Args:
        parts: shapes in the frame of the object.
    """
    whole = concatenate_meshes(parts)
    return whole if is_differentiated(whole.vertices) else unite_parts(whole)


def unite_parts(mesh: Mesh) -> Mesh:
    """Return the mesh without what lies inside of its closed parts.

    Parts that neither overlap nor touch, open ones and cavities stay as they are; so does the mesh
    if there are no others.

    Args:
        mesh: parts of one material, without derivatives.
    """
    points, faces = (strip_derivatives(table).numpy() for table in (mesh.vertices, mesh.faces))
    welded, _, places, _ = mesh_topology.close_cracks(points, faces)
    part = mesh_topology.find_parts(welded, places)
    bodies, united = list[manifold3d.Manifold](), np.zeros(len(welded), dtype=bool)
    for number in _touching_parts(welded, part, places):
        own = part == number
        body = _closed_body(welded[own], points)
        if body is not None:
            bodies.append(body)
            united |= own
    if len(bodies) < 2:
        return mesh
    whole = manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    area = sum(body.surface_area() for body in bodies)
    if abs(whole.surface_area() - area) <= _SAME_AREA * area:
        return mesh
    outer = whole.as_original().simplify(mesh_topology.WELD_TOLERANCE * size).to_mesh64()
    vertices = np.asarray(outer.vert_properties, dtype=np.float64)
    faces = np.asarray(outer.tri_verts, dtype=np.int64)
    distinct = mesh_topology.find_distinct_faces(welded, places)
    kept = welded[distinct[~united[distinct]]]
    used, kept = np.unique(kept, return_inverse=True)
    return Mesh(
        torch.from_numpy(np.concatenate([vertices, points[used]])),
        torch.from_numpy(np.concatenate([faces, kept.reshape(-1, 3) + len(vertices)])),
    )


def _touching_parts(
    welded: Int64[np.ndarray, "f 3"], part: Int64[np.ndarray, " f"], places: mesh_topology.Points
) -> list[int]:
    """Numbers of parts whose boxes overlap those of others."""
    count = part.max(initial=-1) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    real = part >= 0
    np.minimum.at(low, part[real], places[welded[real]].min(1))
    np.maximum.at(high, part[real], places[welded[real]].max(1))
    meets = mesh_topology.overlapping_boxes(low, high + mesh_topology.WELD_TOLERANCE)
    return np.flatnonzero(meets.any(1)).tolist()


def _closed_body(
    faces: Int64[np.ndarray, "f 3"], points: mesh_topology.Points
) -> manifold3d.Manifold | None:
    """Return a part as a body; None for open parts and cavities."""
    if mesh_topology.find_inward_faces(faces, points).any():
        return None
    used, local = np.unique(faces, return_inverse=True)
    triangles = local.reshape(-1, 3).astype(np.uint64)
    mesh = manifold3d.Mesh64(vert_properties=points[used], tri_verts=triangles)
    body = manifold3d.Manifold(mesh)
    return body if body.status() == manifold3d.Error.NoError else None
