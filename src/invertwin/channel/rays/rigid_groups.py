"""Objects that rest against each other along edges and move together: one surface to silhouettes.

An edge that two panels of a cupboard share is not the boundary of either while the panels keep
together. Objects that move apart keep edges of their own, so that derivatives see the gap open.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.autograd import forward_ad

from invertwin.checks import is_differentiated, strip_derivatives
from invertwin.scene.mesh_topology import (
    WELD_TOLERANCE,
    find_vertices_on_edges,
    label_components,
    overlapping_boxes,
    triangle_sides,
)

_MAX_CACHED_PAIRS = 10_000
_SAME_MOTION = 1e-9  # relative difference of velocities that count as one
_contacts: OrderedDict[tuple[int, int], tuple[list[Tensor], Tensor]] = OrderedDict()

Contacts = Float64[Tensor, "n 4"]


def find_rigid_groups(
    faces: Sequence[Int64[Tensor, "_ 3"]],
    vertices: Sequence[Float64[Tensor, "_ 3"]],
    scenes: Sequence[int] | None = None,
) -> Int64[np.ndarray, " object"]:
    """Return the group of each object, numbered from 0 in the order of the objects.

    Two objects are in one group if vertices of one lie on edges of the other, and all of these
    points keep together: both at rest, or with equal derivatives.

    Args:
        faces: triangles of each object.
        vertices: world positions of each object [m], with their derivatives.
        scenes: scene of each object; objects of several scenes are apart. None = one scene.
    """
    fixed = [strip_derivatives(points) for points in vertices]
    moves = np.array([is_differentiated(points) for points in vertices])
    start, points = np.cumsum([0, *map(len, fixed)])[:-1], torch.cat(fixed).numpy()
    low, high = (f.reduceat(points, start) for f in (np.minimum, np.maximum))
    reach = WELD_TOLERANCE * np.linalg.norm(high - low, axis=1)[:, None]
    near = overlapping_boxes(low - reach, high + reach) & (moves[:, None] == moves)
    if scenes is not None:
        near &= np.equal.outer(scenes, scenes)
    pairs = []
    for a, b in np.argwhere(np.triu(near)).tolist():
        contacts = _find_contacts((faces[a], faces[b]), (fixed[a], fixed[b]))
        if _keep_together(contacts, vertices[a], vertices[b]):
            pairs.append((a, b))
    return label_components(np.array(pairs, dtype=np.int64).reshape(-1, 2), len(faces))


def _find_contacts(faces: tuple[Tensor, Tensor], points: tuple[Tensor, Tensor]) -> Contacts:
    """Find where vertices of one object lie on edges of another, kept while neither moves.

    Returns:
        Rows of vertex, two ends of the edge (numbers of both objects' vertices, one after the
        other), and position between the ends.
    """
    key = id(faces[0]), id(faces[1])
    if key in _contacts:
        (*_, one, other), found = _contacts[key]
        if torch.equal(one, points[0]) and torch.equal(other, points[1]):
            _contacts.move_to_end(key)
            return found
    low = torch.maximum(points[0].amin(0), points[1].amin(0))
    high = torch.minimum(points[0].amax(0), points[1].amax(0))
    both = torch.cat(points)
    size = float((both.amax(0) - both.amin(0)).norm())
    margin = WELD_TOLERANCE * size
    places = (both / size).numpy()
    edges = []
    for number, (triangles, offset) in enumerate(zip(faces, (0, len(points[0])), strict=True)):
        corners = points[number][triangles]
        inside = (corners.amin(1) <= high + margin) & (corners.amax(1) >= low - margin)
        used = (strip_derivatives(triangles)[inside.all(1)] + offset).numpy()
        edges.append(np.unique(np.sort(triangle_sides(used), axis=1), axis=0))
    parts = []
    for own, other in ((0, 1), (1, 0)):
        row, vertex, share = find_vertices_on_edges(edges[own], np.unique(edges[other]), places)
        parts.append(np.column_stack([vertex, edges[own][row], share]))
    found = torch.from_numpy(np.concatenate(parts).astype(np.float64))
    _contacts[key] = [*faces, *points], found
    while len(_contacts) > _MAX_CACHED_PAIRS:
        _contacts.popitem(last=False)
    return found


def _keep_together(contacts: Contacts, first: Tensor, second: Tensor) -> bool:
    """Test whether two objects touch along an edge and their points of contact move as one."""
    if len(contacts) < 2:
        return False
    if not is_differentiated(first):
        return True
    index, share = contacts[:, :3].long(), contacts[:, 3:]

    def ends_of_gap(values: Tensor) -> tuple[Tensor, Tensor]:
        vertex, start, end = values[index].unbind(1)
        return vertex, (1 - share) * start + share * end

    pair = [forward_ad.unpack_dual(points).tangent for points in (first, second)]
    if any(tangent is not None for tangent in pair):
        rates = [
            torch.zeros_like(points) if tangent is None else tangent
            for points, tangent in zip((first, second), pair, strict=True)
        ]
        one, other = ends_of_gap(strip_derivatives(torch.cat(rates)))
        return _are_close(one, other)
    return _have_one_gradient(*ends_of_gap(torch.cat([first, second])))


def _have_one_gradient(first: Tensor, second: Tensor) -> bool:
    """Test whether rows that are equal have the same derivative in every leaf of their graph.

    One random combination of all rows decides.
    """
    generator = torch.Generator().manual_seed(0)
    weight = torch.rand(first.shape, dtype=torch.float64, generator=generator) + 0.5
    leaves, seen, nodes = list[Tensor](), set[Any](), [first.grad_fn, second.grad_fn]
    while nodes:
        node = nodes.pop()
        if node is None or node in seen:
            continue
        seen.add(node)
        if hasattr(node, "variable"):
            leaves.append(node.variable)
        nodes += [parent for parent, _ in node.next_functions]
    slopes = [
        torch.autograd.grad(
            points, leaves, weight, retain_graph=True, allow_unused=True, materialize_grads=True
        )
        for points in (first, second)
    ]
    return _are_close(*(torch.cat([part.flatten() for part in parts]) for parts in slopes))


def _are_close(first: Tensor, second: Tensor) -> bool:
    largest = float(torch.cat([first, second]).abs().amax())
    return float((first - second).abs().amax()) <= _SAME_MOTION * largest
