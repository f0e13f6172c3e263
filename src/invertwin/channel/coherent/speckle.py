"""Rough points: fixed material points whose phases give a rough surface its speckle."""

import zlib
from dataclasses import dataclass

import numpy as np
import torch

from invertwin.channel.coherent.radar_equation import SurfacePaths
from invertwin.channel.coherent.rough_paths import draw_rough_paths
from invertwin.channel.paths import Link
from invertwin.channel.rays.backend import tracing
from invertwin.channel.sampling import Densities, Sampling, resolve_densities
from invertwin.scene.scene import Scene


def draw_rough_points(scene: Scene, points_per_m2: Densities, seed: int) -> SurfacePaths:
    """Draw the material points of all rough objects, as paths of one point.

    They belong to the surfaces: never drawn again between chirps, poses, looks or iterations. The
    phase is uniform in [0, 2π), a hash of object, triangle, number of the point and seed.

    Args:
        scene: Surfaces to cover.
        points_per_m2: Their number per m², of all objects or by name.
        seed: Hash key.

    Raises:
        InputError: See ``resolve_densities``.
    """
    densities = resolve_densities(scene, points_per_m2)
    found: list[np.ndarray] = [np.zeros((5, 0))]
    offset = 0
    for name, item in scene.objects.items():
        triangles = item.vertices.detach()[item.mesh.faces]
        edges = triangles[:, 1:] - triangles[:, :1]
        area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).numpy()
        if name in densities:
            key = np.uint64(zlib.crc32(name.encode()) ^ (seed * 0x9E3779B97F4A7C15 & (2**64 - 1)))
            face = np.arange(len(area), dtype=np.uint64)
            expected = area * densities[name]
            count = np.floor(expected + _hash_uniform(key, face, face * 0, 0)).astype(np.int64)
            face = np.repeat(face, count)
            number = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
            b1, b2, turn = (
                _hash_uniform(key, face, number.astype(np.uint64), k) for k in (1, 2, 3)
            )
            fold = b1 + b2 > 1
            b1, b2 = np.where(fold, 1 - b1, b1), np.where(fold, 1 - b2, b2)
            # A point stands for the area that is its own at the density of its object.
            weight = np.full(len(face), 1 / densities[name])
            phase = 2 * np.pi * turn
            found.append(np.stack([face.astype(np.int64) + offset, b1, b2, weight, phase]))
        offset += len(area)
    face, b1, b2, weight, phase = torch.from_numpy(np.concatenate(found, axis=1))
    return SurfacePaths(face.long()[:, None], b1[:, None], b2[:, None], weight, phase)


def _hash_uniform(key: np.uint64, first: np.ndarray, second: np.ndarray, stream: int) -> np.ndarray:
    """Uniform numbers in [0, 1): SplitMix64 over the words of the key."""
    with np.errstate(over="ignore"):
        state = np.full(first.shape, key, dtype=np.uint64)
        for word in (first, second, np.full(first.shape, stream, dtype=np.uint64)):
            state = state + np.uint64(0x9E3779B97F4A7C15) + word
            state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)).astype(np.float64) * 2.0**-53


@dataclass(frozen=True)
class Speckle:
    """The fixed random parts of fields: they stay while radar and scene move.

    Attributes:
        points: Points of rough surfaces: paths of one bounce.
        paths: Rough paths of two points, of three points, and so on.
    """

    points: SurfacePaths
    paths: tuple[SurfacePaths, ...] = ()


def draw_speckle(scene: Scene, link: Link, sampling: Sampling, seed: int) -> Speckle:
    """Draw the fixed points and paths that give rough surfaces their speckle.

    Args:
        scene: Surfaces.
        link: Antennas, which suggest what rough paths are worth drawing.
        sampling: Points per m², number and depth of rough paths.
        seed: Seed of places and phases.

    Raises:
        InputError: Points per m² of what is not in the scene, or not of all its rough objects.
    """
    with tracing(sampling.backend):
        count, depth = sampling.rough_paths, sampling.depth
        paths = draw_rough_paths(scene, link, count=count, depth=depth, seed=seed)
    return Speckle(draw_rough_points(scene, sampling.points_per_m2, seed), paths)
