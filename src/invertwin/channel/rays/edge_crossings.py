"""Corners where sharp edges pass through surfaces without a vertex, as those of crossing bodies."""

from dataclasses import replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import cross, dot, triangle_normals
from invertwin.channel.em.wedges import Wedges, edge_axis
from invertwin.channel.rays.ray_scene import Occluders, find_next_surface
from invertwin.channel.rows import strip_rows

_MIN_SINE = 1e-3  # of the angle between an edge and a face that it passes through


def find_crossings(rays: Occluders, wedges: Wedges, offset: float) -> Int64[Tensor, "n 2"]:
    """Find where edges pass through triangles: edge and triangle, in order along each edge.

    Args:
        rays: occluders.
        wedges: sharp edges.
        offset: distance from an edge at which rays run along it, and least length of a piece [m].
    """
    with _DisableFuncTorch():  # discrete
        wedges = strip_rows(wedges)
        outward = offset * normalize((wedges.normals - wedges.face_tangents).sum(1), dim=1)
        begin, end, edge = wedges.start + outward, wedges.end + outward, torch.arange(len(outward))
        found = [torch.zeros(0, 2, dtype=torch.int64)]
        while len(edge):
            face, share = find_next_surface(rays, begin, end)
            found.append(torch.stack([edge, face], 1)[face >= 0])
            step = share[:, None] * (end - begin) + offset * normalize(end - begin, dim=1)
            left = (face >= 0) & (step.norm(dim=1) < (end - begin).norm(dim=1))
            begin, end, edge = (begin + step)[left], end[left], edge[left]
        pairs = torch.cat(found)
        pairs = pairs[pairs[:, 0].argsort(stable=True)]  # hits follow each other along an edge
        corners = rays.local_vertices.double()[rays.topology.faces] + rays.origin
        # Rays beside an edge also meet faces in whose plane it lies.
        normal = triangle_normals(corners[pairs[:, 1]])
        pairs = pairs[dot(edge_axis(wedges)[pairs[:, 0]], normal).abs() > _MIN_SINE]
        length = (wedges.end - wedges.start).norm(dim=1)[pairs[:, 0]]
        along = length * _crossing_shares(wedges, pairs, corners)
        inside = (along > offset) & (along < length - offset)
        inside[1:] &= (along.diff() > offset) | (pairs[:, 0].diff() > 0)
        return pairs[inside]


def split_at_crossings(
    wedges: Wedges, crossings: Int64[Tensor, "n 2"], corners: Float64[Tensor, "facet 3 3"]
) -> Wedges:
    """Split edges where they pass through triangles.

    Args:
        wedges: sharp edges.
        crossings: edge and triangle of each crossing, as of ``find_crossings``.
        corners: corners of the triangles [m].
    """
    edge, every = crossings[:, 0], torch.arange(len(wedges.start))
    start, side = wedges.start[edge], (wedges.end - wedges.start)[edge]
    place = start + _crossing_shares(wedges, crossings, corners)[:, None] * side
    after, before = (
        torch.cat(pair).argsort(stable=True) for pair in ((every, edge), (edge, every))
    )
    pieces = wedges.select(torch.cat([every, edge])[after])
    starts, ends = torch.cat([wedges.start, place]), torch.cat([place, wedges.end])
    return replace(pieces, start=starts[after], end=ends[before])


def _crossing_shares(wedges: Wedges, crossings: Tensor, corners: Tensor) -> Tensor:
    """Positions along edges, 0 to 1, at which they meet the planes of triangles."""
    edge, face = crossings.T
    a, b, c = corners[face].unbind(1)
    normal, start = cross(b - a, c - a), wedges.start[edge]
    return dot(a - start, normal) / dot(wedges.end[edge] - start, normal)
