"""Speckle: the fixed random points and paths of rough surfaces."""

from dataclasses import dataclass

from invertwin.channel.field.rough_paths import RoughPaths, draw_rough_paths
from invertwin.channel.field.rough_points import RoughPoints, draw_rough_points
from invertwin.channel.paths import Link
from invertwin.channel.rays.backend import use_backend
from invertwin.channel.sampling import Sampling
from invertwin.scene.scene import Scene


@dataclass(frozen=True)
class Speckle:
    """The fixed random parts of fields: they stay while radar and scene move.

    Attributes:
        points: Points of rough surfaces, for paths of one bounce; None is drawn where needed.
        paths: Rough paths of several bounces; None is drawn where needed.
    """

    points: RoughPoints | None = None
    paths: RoughPaths | None = None


def draw_speckle(scene: Scene, link: Link, sampling: Sampling, seed: int) -> Speckle:
    """Draw the fixed points and paths that give rough surfaces their speckle.

    Args:
        scene: Surfaces.
        link: Antennas, which suggest what rough paths are worth drawing.
        sampling: Points per m², number and depth of rough paths.
        seed: Seed of places and phases.
    """
    paths = None
    if sampling.depth > 1:
        with use_backend(sampling.backend):
            paths = draw_rough_paths(
                scene, link, count=sampling.rough_paths, depth=sampling.depth, seed=seed
            )
    return Speckle(draw_rough_points(scene, sampling.points_per_m2, seed), paths)
