"""Shaded triangles in Matplotlib axes, painted from the farthest to the nearest."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

MAX_TRIANGLES = 40_000  # of one object
# Towards the lamp: right, up, towards the eye.
_ILLUMINATION_DIRECTION = np.array([0.35, 0.6, 0.72])

Shape = tuple[NDArray, NDArray]
"""Vertices [v, 3] and faces [f, 3]."""


def paint(axes: Any, shapes: Sequence[tuple[Shape, str]], eye: NDArray, longest: float) -> None:
    """Draw shapes as an eye far away sees them.

    Args:
        axes: Matplotlib axes to draw in.
        shapes: What to draw: each with its colour.
        eye: Right, up and towards the eye, as rows [3, 3].
        longest: Sides of triangles above this are split, so that sorting by depth is right [m].
    """
    polygons, colors = [], []
    for (vertices, faces), color in shapes:
        triangles = small_triangles((vertices @ eye.T)[faces], longest)
        triangles = triangles[:: math.ceil(len(triangles) / MAX_TRIANGLES)]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        shade = np.abs(normals @ _ILLUMINATION_DIRECTION) / np.where(lengths > 0, lengths, 1)
        polygons.append(triangles)
        colors.append(np.clip(np.array(to_rgb(color)) * (0.5 + 0.55 * shade[:, None]), 0, 1))
    triangles, color = np.concatenate(polygons), np.concatenate(colors)
    order = np.argsort(triangles[:, :, 2].mean(axis=1))
    # Edges in the face's own colour close the hairlines between neighbouring triangles.
    drawn, tint = list(triangles[order][:, :, :2]), color[order]
    axes.add_collection(PolyCollection(drawn, facecolors=tint, edgecolors=tint, linewidths=0.7))


def small_triangles(triangles: NDArray, longest: float) -> NDArray:
    """Split the triangles with a side above `longest`, up to a bound on their number.

    Args:
        triangles: Corners [t, 3, 3] (m).
        longest: Side above which a triangle is split [m].
    """
    for _ in range(4):
        sides = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
        large = sides > longest
        if not large.any() or large.sum() * 4 > MAX_TRIANGLES:
            break
        a, b, c = triangles[large].transpose(1, 0, 2)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        split = [np.stack(corners, axis=1) for corners in quarters]
        triangles = np.concatenate([triangles[~large], *split])
    return triangles


def sharp_edges(vertices: NDArray, faces: NDArray) -> NDArray:
    """Vertex pairs [e, 2] of open edges and of edges that bend by more than 30°.

    Args:
        vertices: Positions [v, 3].
        faces: Vertex indices of triangles [f, 3].
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    bent = mesh.face_adjacency_edges[mesh.face_adjacency_angles > math.radians(30)]
    alone = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    return np.concatenate([bent, mesh.edges_sorted[alone]])
