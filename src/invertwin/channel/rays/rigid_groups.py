"""Objects that rest against each other along edges and move together: one surface to silhouettes.

An edge that two panels of a cupboard share is not the boundary of either while the panels keep
together. Objects that move apart keep edges of their own, so that derivatives see the gap open.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.autograd import forward_ad

from invertwin.checks import is_differentiated, strip_derivatives
from invertwin.scene import mesh_topology

Contacts = Float64[Tensor, "n 4"]
_MAX_CACHED_PAIRS = 10_000
_SAME_MOTION = 1e-9  # relative difference of velocities that count as one
_TURN = 20.0  # the same over the relative width of a crack, whose sides turn at different radii
_SAME_PLACE = 1e-9  # relative distance of points that count as one
#: By numbers and faces of two objects, since several may share their faces: the faces, whose ids
#: stay theirs, all points, and the contacts.
_contacts: OrderedDict[tuple[int, ...], tuple[list[Tensor], Tensor, Contacts]] = OrderedDict()


def find_rigid_groups(
    faces: Sequence[Int64[Tensor, "_ 3"]],
    vertices: Sequence[Float64[Tensor, "_ 3"]],
    scenes: Sequence[int] | None = None,
) -> Int64[np.ndarray, " object"]:
    """Return the group of each object, numbered from 0 in the order of the objects.

    Two objects are in one group if vertices of one lie on edges of the other, or across a crack
    that is closed, and all of these points keep together: both at rest, or with equal derivatives.

    Args:
        faces: triangles of each object.
        vertices: world positions of each object [m], with their derivatives.
        scenes: scene of each object; objects of several scenes are apart. None = one scene.
    """
    fixed = [strip_derivatives(points) for points in vertices]
    moves = np.array([is_differentiated(points) for points in vertices])
    start, points = np.cumsum([0, *map(len, fixed)])[:-1], np.concatenate(fixed)
    low, high = (f.reduceat(points, start) for f in (np.minimum, np.maximum))
    size = np.linalg.norm(high - low, axis=1)
    reach = mesh_topology.CRACK_TOLERANCE * size[:, None]
    near = mesh_topology.overlapping_boxes(low - reach, high + reach) & (moves[:, None] == moves)
    if scenes is not None:
        near &= np.equal.outer(scenes, scenes)
    pairs, rows = [], []  # of vertex, two ends of an edge, position between them, and size
    for a, b in np.argwhere(np.triu(near)).tolist():
        key = a, b, id(faces[a]), id(faces[b])
        contacts = _find_contacts(key, (faces[a], faces[b]), (fixed[a], fixed[b])).numpy()
        if len(contacts) > 1:
            pairs.append((a, b))
            row = np.insert(contacts, 4, size[[a, b]].max(), axis=1)
            count = len(fixed[a])
            row[:, :3] += np.where(row[:, :3] < count, start[a], start[b] - count)
            rows.append(row)
    if pairs:
        contacts = torch.from_numpy(np.concatenate(rows))
        share, extent = contacts[:, 3:].split(1, 1)
        touching = np.unique(pairs)  # derivatives of other objects would be found in vain
        points = torch.cat([vertices[n] if n in touching else p for n, p in enumerate(fixed)])
        points = points[contacts[:, :3].long()] / extent[..., None]
        gaps = points[:, 0], torch.lerp(points[:, 1], points[:, 2], share)
        # One comparison for all pairs, as a rule; else one for each.
        if not _move_as_one(*gaps):
            parts = zip(*(side.split([*map(len, rows)]) for side in gaps), strict=True)
            pairs = list(itertools.compress(pairs, [_move_as_one(*part) for part in parts]))
    return mesh_topology.label_components(
        np.array(pairs, dtype=np.int64).reshape(-1, 2), len(faces)
    )


def _find_contacts(
    key: tuple[int, ...], faces: tuple[Tensor, Tensor], points: tuple[Tensor, Tensor]
) -> Contacts:
    """Find where vertices of one object lie on edges of another, kept while they move as one.

    Returns:
        Rows of vertex, two ends of the edge (numbers of both objects' vertices, one after the
        other), and position between the ends.
    """
    both = torch.cat(points)
    if key in _contacts:
        _, before, found = _contacts[key]
        if is_one_motion(before, both):
            _contacts.move_to_end(key)
            return found
    low = torch.maximum(points[0].amin(0), points[1].amin(0))
    high = torch.minimum(points[0].amax(0), points[1].amax(0))
    size = float((both.amax(0) - both.amin(0)).norm())
    margin = mesh_topology.CRACK_TOLERANCE * size
    places = (both / size).numpy()
    edges = []
    for number, (triangles, offset) in enumerate(zip(faces, (0, len(points[0])), strict=True)):
        corners = points[number][triangles]
        inside = (corners.amin(1) <= high + margin) & (corners.amax(1) >= low - margin)
        used = (strip_derivatives(triangles)[inside.all(1)] + offset).numpy()
        sides = np.column_stack(mesh_topology.triangle_sides(used))
        edges.append(np.unique(np.sort(sides, axis=1), axis=0))
    parts = []
    for own, other in ((0, 1), (1, 0)):
        row, vertex, share = mesh_topology.find_vertices_on_edges(
            edges[own], np.unique(edges[other]), places, mesh_topology.CRACK_TOLERANCE
        )
        parts.append(np.column_stack([vertex, edges[own][row], share]))
    found = torch.from_numpy(np.concatenate(parts).astype(np.float64))
    _contacts[key] = [*faces], both, found
    while len(_contacts) > _MAX_CACHED_PAIRS:
        _contacts.popitem(last=False)
    return found


def is_one_motion(before: Float64[Tensor, "n 3"], after: Float64[Tensor, "m 3"]) -> bool:
    """Test whether a rotation and a translation take points to others, the best of all (Kabsch).

    Args:
        before, after: positions [m].
    """
    # In NumPy, where torch's threads wait longer for each other than they work.
    one, other = before.numpy(), after.numpy()
    if one.shape != other.shape or np.array_equal(one, other):
        return one.shape == other.shape
    # The motion of few points, as a rule; else that of all, should the few lie in a plane.
    steps = sorted({len(one) // 64 or 1, 1}, reverse=True)
    return any(_fits_motion(one, other, step) for step in steps)


def _fits_motion(
    before: Float64[np.ndarray, "n 3"], after: Float64[np.ndarray, "n 3"], step: int
) -> bool:
    """Test whether the best motion of every ``step``-th point is that of all."""
    one, other = before[::step], after[::step]
    middle, target = one.mean(0), other.mean(0)
    u, _, v = np.linalg.svd((one - middle).T @ (other - target))
    gap = before @ (u @ v)
    gap += target - middle @ u @ v
    gap -= after
    return bool(np.abs(gap).max() <= _SAME_PLACE * np.abs(other - target).max())


def _move_as_one(first: Float64[Tensor, "n 3"], second: Float64[Tensor, "n 3"]) -> bool:
    """Test whether points in one place have the same derivatives, if any.

    Args:
        first, second: positions over the size of their objects, up to a crack apart.
    """
    if not is_differentiated(first) and not is_differentiated(second):
        return True
    width = float((strip_derivatives(first) - strip_derivatives(second)).abs().amax())
    pair = [forward_ad.unpack_dual(points).tangent for points in (first, second)]
    slopes = [torch.zeros_like(first) if rate is None else rate for rate in pair]
    if all(rate is None for rate in pair):
        slopes = _random_gradients(first, second)
    one, other = map(strip_derivatives, slopes)
    largest = torch.maximum(one.abs().amax(), other.abs().amax())
    return bool((one - other).abs().amax() <= (_SAME_MOTION + _TURN * width) * largest)


def _random_gradients(first: Tensor, second: Tensor) -> list[Tensor]:
    """Return the gradient of one random combination of all rows in every leaf of their graph."""
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
    return [torch.cat([part.flatten() for part in parts]) for parts in slopes]
