"""How rough paths are drawn: with all the power, and as many paths where it is weak."""

import math

import pytest
import torch
from torch import Tensor

from invertwin.channel import Link
from invertwin.channel.coherent.radar_equation import SurfacePaths, evaluate_paths, find_unblocked
from invertwin.channel.coherent.speckle import draw_rough_paths
from invertwin.channel.rays.ray_scene import RayScene, face_areas
from invertwin.channel.rays.scene_tables import Geometry, flatten
from invertwin.scene import RoughConductor, Scene, plate
from scenes import link, thing

COUNT = 150_000
WALL, ITEM = 1, 2


def scene() -> Scene:
    """A plate behind a screen, which a glossy wall shows."""
    return Scene(
        {
            "screen": thing(plate(0.8, 0.8), (1.0, 0.0, 0.0)),
            "wall": thing(
                plate(2.0, 1.0), (1.6, 1.4, 0.0), (0.0, 0.0, math.pi / 2),
                RoughConductor(scattering=0.3, rms_slope=0.15),
            ),
            "item": thing(plate(0.3, 0.3), (2.0, 0.0, 0.0), (0.0, 0.0, 0.5)),
        }
    )  # fmt: skip


def antennas(*y: float) -> Link:
    """Poses along a rail."""
    return link(tuple((0.0, value, 0.0) for value in y))


def by_area(geometry: Geometry, count: int, seed: int) -> SurfacePaths:
    """Paths from wall to item to wall, every point uniform on its object: the plain integral."""
    generator = torch.Generator().manual_seed(seed)
    areas = face_areas(geometry)
    columns: list[list[Tensor]] = [[], [], []]
    weight = 1.0 / count
    for number in (WALL, ITEM, WALL):
        share = areas * (geometry.face_object == number)
        weight = weight * float(share.sum())
        b = torch.rand(2, count, generator=generator, dtype=torch.float64)
        b = torch.where(b.sum(0) > 1, 1 - b, b)
        face = torch.multinomial(share, count, replacement=True, generator=generator)
        for column, values in zip(columns, (face, b[0], b[1]), strict=True):
            column.append(values)
    face, b1, b2 = (torch.stack(column, dim=1) for column in columns)
    return SurfacePaths(
        face, b1, b2, torch.full((count,), weight).double(), torch.zeros(count).double()
    )


def powers(geometry: Geometry, poses: Link, paths: SurfacePaths, frame: int) -> Tensor:
    """What every path carries in a frame."""
    frames = torch.full((len(paths.weight),), frame)
    rays = RayScene(geometry, poses)
    seen = find_unblocked(rays, frames, paths)
    return evaluate_paths(rays, frames[seen], paths.select(seen)).power * paths.weight[seen]


@pytest.mark.parametrize("where", ["at the reference poses", "from another pose"])
def test_an_echo_by_a_wall_has_its_power_and_many_paths(where):
    """The integral within four standard errors, of single draws at most 12 %, by many paths."""
    whole, poses = scene(), antennas(-0.2, 0.3)
    drawn_for = poses if where == "at the reference poses" else antennas(-0.2)
    geometry = flatten(whole, poses.wavelength)
    exact = powers(geometry, poses, by_area(geometry, 400_000, 0), 1)
    truth, error = float(exact.sum()), float(exact.square().sum().sqrt() / exact.sum())
    assert error < 0.02
    found = []
    for seed in (1, 2, 3):
        paths = draw_rough_paths(whole, drawn_for, count=COUNT, depth=3, seed=seed)[1]
        objects = geometry.face_object[paths.face]
        paths = paths.select((objects == torch.tensor([WALL, ITEM, WALL])).all(1))
        found.append(powers(geometry, poses, paths, 1))
    sums = torch.stack([power.sum() for power in found]) / truth
    many = torch.stack([power.sum().square() / power.square().sum() for power in found])
    spread = float(sums.std())
    assert spread < 0.12
    assert abs(float(sums.mean()) - 1) < 4 * max(spread, 0.03) / len(found) ** 0.5 + 2 * error
    assert float(many.min()) > 100


def test_paths_are_kept_by_what_they_carry():
    """A quarter of the draws at most, their phases of their own, and the same for the same seed."""
    one, same, other = (
        draw_rough_paths(scene(), antennas(0.0), count=COUNT, depth=3, seed=seed)
        for seed in (1, 1, 2)
    )
    for k in range(2):
        assert 1_000 < len(one[k].weight) < 1.01 * COUNT / 4
        for name in ("face", "b1", "weight", "phase"):
            assert torch.equal(getattr(one[k], name), getattr(same[k], name))
        assert not torch.equal(one[k].phase[:500], other[k].phase[:500])
