"""Candidate sequences of surfaces for specular paths: exhaustive, or found by shooting rays.

A step of a sequence is the plane of a reflection. Sheets that transmit are passed on the way: they
do not bend a path and are no steps, so that they use up nothing of the depth.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch.nn.functional import normalize

from invertwin.channel.em.plane_waves import reflect_vectors
from invertwin.channel.rays.ray_scene import MAX_SHEETS
from invertwin.channel.specular.image_method import DIRECT, CandidateSurfaces
from invertwin.runtime.memory import require_at_most

_LANES = 1 << 20
_MAX_SEQUENCES = 1_000_000  # limit of the exhaustive search
_GOLDEN = math.pi * (1 + math.sqrt(5))


@dataclass(frozen=True)
class CandidateSequences:
    """Candidate sequences by length.

    Attributes:
        steps: sequences of each length from 1, [sequence, step].
        missed_fraction: estimated fraction of directions whose sequences were not found; None for
            an exhaustive search.
    """

    steps: tuple[Tensor, ...]
    missed_fraction: float | None


def enumerate_sequences(surfaces: CandidateSurfaces, depth: int) -> CandidateSequences:
    """Enumerate all sequences of planes, no plane twice in a row.

    Args:
        surfaces: candidate surfaces of the scene.
        depth: maximum number of steps.

    Raises:
        InputError: more than a million sequences.
    """
    planes, reflect = surfaces.planes, surfaces.interactions.reflect
    options = planes.face_plane[reflect & (planes.face_plane >= 0)].unique()
    count = sum(len(options) ** step for step in range(1, depth + 1))
    what = f"sequences to test one by one (of {len(planes)} planes, depth {depth})"
    require_at_most(count, _MAX_SEQUENCES, what, "give a number of rays, or a smaller depth")
    found, last = [], DIRECT
    for _ in range(depth):
        row = torch.arange(len(last)).repeat_interleave(len(options))
        grown = torch.cat([last[row], options.repeat(len(last))[:, None]], 1)
        if grown.shape[1] > 1:
            grown = grown[grown[:, -1] != grown[:, -2]]
        found.append(grown)
        last = grown
    return CandidateSequences(tuple(found), None)


def find_sequences(
    surfaces: CandidateSurfaces,
    origins: Float64[Tensor, "place 3"],
    depth: int,
    rays: int | None,
    seed: int,
) -> CandidateSequences:
    """Find candidate sequences of up to ``depth`` steps by shooting rays, or enumerate all.

    Directions form a golden spiral, rotated at random for every origin. At a sheet that reflects
    and transmits, a ray splits. A sequence that subtends the solid angle Ω at the antenna is missed
    by all of N independent random directions with the probability (1 − Ω/4π)^N < exp(−NΩ/4π);
    evenly spread directions miss less.

    ``CandidateSequences.missed_fraction`` is the Good-Turing estimate: the number of sequences
    followed by exactly one ray, over the number of rays.

    Args:
        surfaces: candidate surfaces of the scene.
        origins: origins of the rays [m].
        depth: maximum number of steps.
        rays: number of rays from each origin; None enumerates all sequences.
        seed: random seed of the rotations.

    Source: I. J. Good, "The population frequencies of species", Biometrika 40, 1953.
    """
    if not depth or rays == 0:
        return CandidateSequences((), None)
    if rays is None:
        return enumerate_sequences(surfaces, depth)
    chunk = _count_lanes(surfaces, depth)
    leaves = torch.zeros(0, depth, dtype=torch.int64)
    count = torch.zeros(0, dtype=torch.int64)
    for number, origin in enumerate(origins):
        generator = np.random.default_rng(np.random.SeedSequence([seed, number]))
        rotation = torch.from_numpy(np.linalg.qr(generator.standard_normal((3, 3)))[0])
        for start in range(0, rays, chunk):
            index = torch.arange(start, min(start + chunk, rays))
            directions = _spiral_directions(index, rays) @ rotation.T
            started = (origin, directions), depth, DIRECT, torch.zeros_like(index)
            row, row_count = _follow_rays(surfaces, *started)
            leaves, group = torch.cat([leaves, row]).unique(dim=0, return_inverse=True)
            both = torch.cat([count, row_count])
            count = torch.zeros(len(leaves), dtype=torch.int64).index_add(0, group, both)
    missed_fraction = min(1.0, float((count == 1).sum()) / (rays * len(origins)))
    return CandidateSequences(_split_by_length(leaves, 1), missed_fraction)


def shoot_sequences_from_edges(
    surfaces: CandidateSurfaces,
    origins: Float64[Tensor, "ray 3"],
    edge: Int64[Tensor, " ray"],
    depth: int,
    seed: int,
) -> tuple[Int64[Tensor, "sequence column"], ...]:
    """Find the sequences that rays from edges follow: edge number, then steps; by length from 1.

    Args:
        surfaces: candidate surfaces of the scene.
        origins: origins of the rays, whose directions are random [m].
        edge: edge number of each origin, from zero without gaps.
        depth: maximum number of steps.
        seed: random seed of the directions.
    """
    draws = np.random.default_rng(seed).standard_normal((len(origins), 3))
    directions = normalize(torch.from_numpy(draws), dim=1)
    prefix = torch.arange(int(edge.max()) + 1)[:, None]
    leaves = torch.zeros(0, depth + 1, dtype=torch.int64)
    for some in torch.arange(len(origins)).split(_count_lanes(surfaces, depth)):
        started = (origins[some], directions[some]), depth, prefix, edge[some]
        rows, _ = _follow_rays(surfaces, *started)
        leaves = torch.cat([leaves, rows]).unique(dim=0)
    return _split_by_length(leaves, 2)


def _count_lanes(surfaces: CandidateSurfaces, depth: int) -> int:
    """Number of rays at once, of which sheets may split each at every step."""
    return max(1, _LANES // 2 ** (depth if bool(surfaces.interactions.transmit.any()) else 0))


def _split_by_length(leaves: Tensor, first: int) -> tuple[Tensor, ...]:
    """Distinct sequences of each length, in tables of ``first`` columns and more."""
    # After rounding a ray may meet the plane that it has just left.
    repeated = (leaves[:, first:] == leaves[:, first - 1 : -1]) & (leaves[:, first:] >= 0)
    leaves = leaves[~repeated.any(1)]
    widths = range(first, leaves.shape[1] + 1)
    found = (leaves[leaves[:, width - 1] >= 0, :width] for width in widths)
    return tuple(some.unique(dim=0) if len(some) else some for some in found)


def _spiral_directions(index: Tensor, count: int) -> Float64[Tensor, "n 3"]:
    """Evenly spread directions of a golden spiral."""
    z = 1 - (2 * index.double() + 1) / count
    around = _GOLDEN * index.double()
    ring = (1 - z**2).clamp_min(0).sqrt()
    return torch.stack([ring * around.cos(), ring * around.sin(), z], 1)


def _follow_rays(
    surfaces: CandidateSurfaces,
    rays: tuple[Tensor, Tensor],
    depth: int,
    prefixes: Tensor,
    parent: Tensor,
) -> tuple[Tensor, Tensor]:
    """Sequences of planes that rays meet, padded with −1, and the number of rays that follow each.

    Rays start from one position, or each from its own. They extend the rows ``parent`` of
    ``prefixes``.
    """
    position, directions = rays
    origin = (position - surfaces.origin).to(torch.float32).expand(len(directions), 3)
    direction = directions.to(torch.float32)
    face_plane, normals = surfaces.planes.face_plane, surfaces.planes.normal.to(torch.float32)
    masks = surfaces.interactions.reflect, surfaces.interactions.transmit
    # Sequences are a tree: each is the number of its parent and one more step.
    ended: list[tuple[Tensor, Tensor]] = []
    width = prefixes.shape[1] + depth
    for step in range(depth):
        branches: list[tuple[Tensor, ...]] = []
        for passed in range(MAX_SHEETS + 1):
            if step or passed:
                origin = origin + surfaces.margin * direction
            face, distance = surfaces.find_first_hits(origin, direction)
            hit = (face >= 0) & (face_plane[face.clamp_min(0)] >= 0)
            ended.append((prefixes, parent[~hit]))
            point = origin + distance.to(torch.float32)[:, None] * direction
            parent, face, point, direction = (x[hit] for x in (parent, face, point, direction))
            reflects, transmits = (mask[face] for mask in masks)
            ended.append((prefixes, parent[~(reflects | transmits)]))
            reflected = reflect_vectors(direction, normals[face_plane[face]])
            columns = parent, face_plane[face], point, reflected
            branches.append(tuple(column[reflects] for column in columns))
            parent, origin, direction = (x[transmits] for x in (parent, point, direction))
            if not len(parent):
                break
        parent, plane, origin, direction = map(torch.cat, zip(*branches, strict=True))
        options = len(surfaces.planes)
        pair, parent = (parent * options + plane).unique(return_inverse=True)
        prefixes = torch.cat([prefixes[pair // options], (pair % options)[:, None]], 1)
        if step == depth - 1:
            ended.append((prefixes, parent))
    rows, counts = [], []
    for table, parent in ended:
        some, count = parent.unique(return_counts=True)
        rows.append(torch.nn.functional.pad(table[some], (0, width - table.shape[1]), value=-1))
        counts.append(count)
    return torch.cat(rows), torch.cat(counts)
