"""Discrete distributions on the GPU or CPU, sampled in proportion to tabulated weights."""

from __future__ import annotations

from invertwin.channel.rays.arrays import uniform_pair
from invertwin.channel.rays.backend import dr, mi, mit
from invertwin.channel.rays.ray_scene import RayScene

_MIN_RESOLVED_PROBABILITY = (
    5e-5  # chance of an edge from which float32 resolves a sample's place within it
)
_LAST_BELOW_ONE = 1 - 2.0**-24


class DiscreteSampler:
    """Draws entries in proportion to weights, without reading any back."""

    def __init__(self, weights: mit.Float) -> None:
        self.weights, self.sums = weights, dr.cumsum(weights)
        self.entries = dr.width(weights)
        self.total = dr.gather(mi.Float, self.sums, self.entries - 1)

    def draw(self, number: mit.Float) -> tuple[mit.UInt32, mit.Float, mit.Float]:
        """Entry, the rest of the number within it, and probability: zero if there is no entry."""
        target = number * self.total

        def is_below(at: mit.UInt32) -> mit.Bool:
            return dr.gather(mi.Float, self.sums, at) <= target

        place: mit.UInt32 = dr.binary_search(0, self.entries - 1, is_below)
        weight = dr.gather(mi.Float, self.weights, place)
        last = dr.gather(mi.Float, self.sums, place) - weight
        rest = dr.clip((target - last) / weight, 0.0, _LAST_BELOW_ONE)
        return place, rest, dr.select(weight > 0, weight / self.total, 0.0)


def balance_by_object(
    rays: RayScene,
    edge: mit.UInt32,
    weight: mit.Float,
    receiver: mit.Bool | bool,
    antenna_count: int,
) -> mit.Float:
    """Weights of edges by which no object drowns another.

    An object gets the square root of the sum of its edges' weights, which is between a share by
    size and one share for each. Both antennas get the same sum, and so do all scenes.

    Args:
        rays: The scene.
        edge: Edges.
        weight: Of each, by itself.
        receiver: Whether it is the receiver's silhouette.
        antenna_count: 2 if there are silhouettes of a receiver, else 1.
    """
    objects = len(rays.geometry.names)
    antenna = dr.select(receiver, mi.UInt32(1), 0)
    row = dr.gather(mi.UInt32, rays.topology.device_edge_object, edge) + antenna * objects
    totals, sums = (
        dr.zeros(mi.Float, antenna_count * objects),
        dr.zeros(mi.Float, antenna_count * rays.scene_count),
    )
    dr.scatter_add(totals, weight, row)
    roots, rows = dr.sqrt(totals), dr.arange(mi.UInt32, antenna_count * objects)
    scene = rays.object_scene(rows % objects)
    dr.scatter_add(sums, roots, rows // objects * rays.scene_count + scene)
    part = antenna * rays.scene_count + rays.edge_scene(edge)
    share: mit.Float = weight / (dr.gather(mi.Float, roots, row) * dr.gather(mi.Float, sums, part))
    return dr.select(weight > 0, share, 0.0)


def balance_by_scene(rays: RayScene, scene: mit.UInt32, weight: mit.Float) -> mit.Float:
    """Weights of which all scenes have the same sum, if they have any.

    Args:
        rays: The scenes.
        scene: Of each weight.
        weight: The weights.
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
    """Entry of the choice, place along its edge and probability, stratified over count.

    Args:
        sampler: Of edges.
        index: Number of the sample.
        count: Of samples.
        seed: Of the numbers.
        key: What the numbers belong to, if not the index.
    """
    jitter, along = uniform_pair(index if key is None else key, seed)
    place, rest, chance = sampler.draw((mi.Float(index) + jitter) / count)
    return place, dr.select(chance > _MIN_RESOLVED_PROBABILITY, rest, along), chance
