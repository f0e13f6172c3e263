"""Speckle: the fixed random points and paths of rough surfaces."""

from dataclasses import dataclass

from invertwin.channel.field.rough_paths import draw_rough_paths
from invertwin.channel.field.rough_points import draw_rough_points
from invertwin.channel.paths import Link
from invertwin.channel.rays.backend import tracing
from invertwin.channel.reference.radar_equation import SurfacePaths
from invertwin.channel.sampling import Sampling
from invertwin.scene.scene import Scene


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
        paths = draw_rough_paths(
            scene, link, count=sampling.rough_paths, depth=sampling.depth, seed=seed
        )
    return Speckle(draw_rough_points(scene, sampling.points_per_m2, seed), paths)
