"""Discrete distributions on the GPU or CPU, sampled in proportion to tabulated weights."""

from __future__ import annotations

from invertwin.channel.rays.arrays import uniform_pair
from invertwin.channel.rays.backend import Mask, dr, mi, mit
from invertwin.channel.rays.ray_scene import RayScene

# Probability of an edge above which float32 resolves the position of a sample within it.
_MIN_RESOLVED_PROBABILITY = 5e-5
_LAST_BELOW_ONE = 1 - 2.0**-24


class DiscreteSampler:
    """Sampler of entries in proportion to weights, without reading any back.

    Args:
        weights: weights of the entries.
    """

    def __init__(self, weights: mit.Float) -> None:
        self.weights, self.sums = weights, dr.cumsum(weights)
        self.entries = dr.width(weights)
        self.total = dr.gather(mi.Float, self.sums, self.entries - 1)

    def draw(self, number: mit.Float) -> tuple[mit.UInt32, mit.Float, mit.Float]:
        """Sample an entry.

        Args:
            number: uniform numbers.

        Returns:
            The entry, the rest of the number within it, and its probability: 0 if there is none.
        """
        target = number * self.total

        def is_below(at: mit.UInt32) -> mit.Bool:
            return dr.gather(mi.Float, self.sums, at) <= target

        entry: mit.UInt32 = dr.binary_search(0, self.entries - 1, is_below)
        weight = dr.gather(mi.Float, self.weights, entry)
        last = dr.gather(mi.Float, self.sums, entry) - weight
        rest = dr.clip((target - last) / weight, 0.0, _LAST_BELOW_ONE)
        return entry, rest, dr.select(weight > 0, weight / self.total, 0.0)


def balance_by_object(
    rays: RayScene, edge: mit.UInt32, weight: mit.Float, receiver: Mask, antenna_count: int
) -> mit.Float:
    """Balance the weights of edges between objects.

    An object gets the square root of the sum of its edges' weights, which is between a share by
    size and equal shares. Both antennas get the same sum, and so do all scenes.

    Args:
        rays: ray scene.
        edge: edge indices.
        weight: weights of the edges.
        receiver: True for silhouettes as the receiver sees them.
        antenna_count: 2 if the receiver has silhouettes of its own, else 1.
    """
    objects = len(rays.geometry.names)
    antenna = dr.select(receiver, mi.UInt32(1), 0)
    row = dr.gather(mi.UInt32, rays.topology.device_edge_object, edge) + antenna * objects
    totals = dr.zeros(mi.Float, antenna_count * objects)
    sums = dr.zeros(mi.Float, antenna_count * rays.scene_count)
    dr.scatter_add(totals, weight, row)
    roots, rows = dr.sqrt(totals), dr.arange(mi.UInt32, antenna_count * objects)
    scene = rays.object_scene(rows % objects)
    dr.scatter_add(sums, roots, rows // objects * rays.scene_count + scene)
    part = antenna * rays.scene_count + rays.edge_scene(edge)
    share: mit.Float = weight / (dr.gather(mi.Float, roots, row) * dr.gather(mi.Float, sums, part))
    return dr.select(weight > 0, share, 0.0)


def balance_by_scene(rays: RayScene, scene: mit.UInt32, weight: mit.Float) -> mit.Float:
    """Scale weights so that all scenes have the same sum, if they have any weight.

    Args:
        rays: ray scene.
        scene: scene of each weight.
        weight: weights.
    """
    if rays.scene_count == 1:
        return weight
    totals = dr.zeros(mi.Float, rays.scene_count)
    dr.scatter_add(totals, weight, scene)
    return dr.select(weight > 0, weight / dr.gather(mi.Float, totals, scene), 0.0)


def sample_edge_point(
    sampler: DiscreteSampler,
    index: mit.UInt32,
    count: int,
    seed: mit.UInt32,
    key: mit.UInt32 | tuple[mit.UInt32, mit.UInt32] | None = None,
) -> tuple[mit.UInt32, mit.Float, mit.Float]:
    """Sample an edge and a position along it, stratified over all samples.

    Args:
        sampler: sampler of edges.
        index: sample numbers.
        count: number of samples.
        seed: seed of the random numbers.
        key: key of the random numbers, if other than the index.

    Returns:
        The entry, the position along its edge from 0 to 1, and the probability of the entry.
    """
    jitter, along = uniform_pair(index if key is None else key, seed)
    entry, rest, probability = sampler.draw((mi.Float(index) + jitter) / count)
    return entry, dr.select(probability > _MIN_RESOLVED_PROBABILITY, rest, along), probability
