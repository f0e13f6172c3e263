"""Rough points: fixed material points whose phases give a rough surface its speckle."""

import zlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.scene.scene import Scene


@dataclass(frozen=True)
class RoughPoints:
    """The fixed material points of rough surfaces, with their phases.

    They belong to the surfaces: never drawn again between chirps, poses, looks or iterations.

    Attributes:
        face, b1, b2: Place on the surface.
        phase: Uniform in [0, 2π), a hash of object, triangle, number of the point and seed.
        density: Points per m² of the scene they were drawn on.
    """

    face: Int64[Tensor, " n"]
    b1: Float64[Tensor, " n"]
    b2: Float64[Tensor, " n"]
    phase: Float64[Tensor, " n"]
    density: float


def draw_rough_points(scene: Scene, density: float, seed: int) -> RoughPoints:
    """Draw the material points of all rough objects.

    Args:
        scene: Surfaces to cover.
        density: Points per m².
        seed: Hash key.
    """
    columns: list[list[np.ndarray]] = [[], [], [], []]
    offset = 0
    for name, item in scene.objects.items():
        triangles = item.vertices.detach()[item.mesh.faces]
        edges = triangles[:, 1:] - triangles[:, :1]
        area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1).numpy()
        if not item.material.coherent:
            key = np.uint64(zlib.crc32(name.encode()) ^ (seed * 0x9E3779B97F4A7C15 & (2**64 - 1)))
            face = np.arange(len(area), dtype=np.uint64)
            expected = area * density
            count = np.floor(expected + _hash(key, face, face * 0, 0)).astype(np.int64)
            face = np.repeat(face, count)
            number = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
            draws = [_hash(key, face, number.astype(np.uint64), stream) for stream in (1, 2, 3)]
            fold = draws[0] + draws[1] > 1
            columns[0].append(face.astype(np.int64) + offset)
            columns[1].append(np.where(fold, 1 - draws[0], draws[0]))
            columns[2].append(np.where(fold, 1 - draws[1], draws[1]))
            columns[3].append(2 * np.pi * draws[2])
        offset += len(area)
    joined = [
        torch.from_numpy(np.concatenate(c)) if c else torch.zeros(0, dtype=torch.float64)
        for c in columns
    ]
    return RoughPoints(joined[0].long(), joined[1], joined[2], joined[3], density)


def _hash(key: np.uint64, first: np.ndarray, second: np.ndarray, stream: int) -> np.ndarray:
    """Uniform numbers in [0, 1): SplitMix64 over the words of the key."""
    with np.errstate(over="ignore"):
        state = np.full(first.shape, key, dtype=np.uint64)
        for word in (first, second, np.full(first.shape, stream, dtype=np.uint64)):
            state = state + np.uint64(0x9E3779B97F4A7C15) + word
            state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            state = state ^ (state >> np.uint64(31))
    return (state >> np.uint64(11)).astype(np.float64) * 2.0**-53
