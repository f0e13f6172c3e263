"""Several scenes in one set of tables: they stand side by side, where none is in another's way."""

from dataclasses import replace
from math import prod

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from invertwin.channel.paths import Link
from invertwin.channel.rays.scene_tables import Geometry
from invertwin.checks import strip_derivatives

_BOX_GAP = 0.02  # between scenes, of the largest side of any


def arrange_scenes(
    geometry: Geometry, link: Link, object_scene: Int64[Tensor, " object"]
) -> tuple[Geometry, Link]:
    """Move every scene, with radar poses of its own, into a box of its own.

    A segment between two points of a box stays in it. So no scene hides anything in another one,
    and surfaces that a ray meets beyond its box do not count (``RayScene.is_in_scene``): paths are
    those of the scenes one by one. Derivatives pass, since the moves are constants.

    Args:
        geometry: The objects of all scenes, where they are in their own one.
        link: The antennas that look at every scene.
        object_scene: The scene of each object, from 0 on.

    Returns:
        The scenes apart, and the antennas in front of them, scene after scene.
    """
    owner = object_scene[geometry.topology.vertex_object]
    count = int(object_scene.max()) + 1
    points = strip_derivatives(geometry.vertices)
    antennas = torch.cat([strip_derivatives(link.tx), strip_derivatives(link.rx)])
    rows = owner[:, None].expand(-1, 3)
    low = antennas.amin(0).expand(count, 3).scatter_reduce(0, rows, points, "amin")
    high = antennas.amax(0).expand(count, 3).scatter_reduce(0, rows, points, "amax")
    shift = _box_centres(count, (high - low).amax(0)) - 0.5 * (low + high)
    vertices = geometry.vertices + shift[owner]

    def shift_positions(positions: Tensor) -> Tensor:
        return (positions + shift[:, None]).flatten(0, 1)

    moved_link = replace(
        link,
        tx=shift_positions(link.tx),
        rx=shift_positions(link.rx),
        rotations=link.rotations.repeat(count, 1, 1),
        range_origin=None if link.range_origin is None else link.range_origin.repeat(count),
    )
    return replace(geometry, vertices=vertices, object_scene=object_scene), moved_link


def _box_centres(count: int, sides: Float64[Tensor, "3"]) -> Float64[Tensor, "scene 3"]:
    """Middles of boxes of these sides, as close together as a lattice has them."""
    cell = sides + _BOX_GAP * sides.max()
    lattice = [1, 1, 1]
    while prod(lattice) < count:
        lattice[int((torch.tensor(lattice) * cell).argmin())] += 1
    axes = (torch.arange(n, dtype=torch.float64) for n in lattice)
    return torch.cartesian_prod(*axes)[:count] * cell
