"""Fields of rough multiple scattering: their mean power is the map's, and they stay."""

import math

import pytest
import torch
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_power, draw_speckle, trace_field
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene import RoughDielectric, Scene, Slab, plate
from scenes import float64, link, thing

BINS = Grid(-0.1, 0.05, 160, u_start=-1.1, u_step=0.1, u_count=23)
WAVE = 0.02


def corner(front: bool = False) -> Scene:
    """A wall and a floor that do not touch, and perhaps a board before them."""
    objects = {
        "wall": thing(plate(0.8, 0.8), (1.8, 0.0, 0.0), (0.0, 0.0, 0.15), RoughDielectric(4.0)),
        "floor": thing(
            plate(0.8, 0.8), (1.2, 0.0, -0.6), (0.0, 1.4, 0.0),
            RoughDielectric(5.0, 0.0, 0.5, 0.8),
        ),
    }  # fmt: skip
    if front:
        objects["board"] = thing(
            plate(0.3, 0.3), (1.0, 0.1, -0.1), (0.0, 0.2, 0.4), Slab(2.7, 0.05, thickness=0.01)
        )
    return Scene(objects)


def looks() -> Link:
    """Poses too far apart for speckle to agree, on a rail too short for the power to change."""
    y, z = torch.meshgrid(torch.arange(4.0) * 0.03, torch.arange(4.0) * 0.03, indexing="ij")
    places = torch.stack([0 * y, y, z], dim=-1).reshape(-1, 3).double() - 0.045
    return link(places, places + float64([0.0, 0.25, 0.0]), wavelength=WAVE)


def expected(scene: Scene, antennas: Link, depth: int) -> Tensor:
    """Power of two points and more per frame, of the map."""
    maps = [
        deposit_power(
            scene,
            antennas,
            BINS,
            sampling=Sampling(depth=d, samples=1_000_000, boundary_samples=0),
            seed=0,
        )
        for d in (1, depth)
    ]
    return (maps[1].double() - maps[0].double()).sum(dim=(1, 2, 3))


def by_rough_paths(scene: Scene, antennas: Link, seed: int, count: int) -> tuple[Tensor, Tensor]:
    """Response and sum of powers of rough paths alone, per frame."""
    drawn = Sampling(depth=3, points_per_m2=1.0, rough_paths=count)
    paths = trace_field(scene, antennas, sampling=drawn, seed=seed)
    longer = (paths.first - paths.last).norm(dim=1) > 0
    phase = 2 * math.pi / antennas.wavelength * SPEED_OF_LIGHT * paths.delay[longer]
    field = paths.coefficient[longer] * torch.polar(torch.ones_like(phase), -phase)
    frames = paths.frame[longer]
    total = torch.zeros(antennas.frame_count, dtype=torch.complex128).index_add(0, frames, field)
    power = torch.zeros(antennas.frame_count, dtype=torch.float64)
    return total, power.index_add(0, frames, field.abs().square())


@pytest.mark.slow
@pytest.mark.parametrize(
    "front",
    [False, True],
    ids=["corner", "with a board"],
)
def test_paths_carry_the_power_of_the_map(front):
    """However many they are, within four standard errors of at most 8 %."""
    scene, antennas = corner(front), looks()
    truth = expected(scene, antennas, 3)
    for count, seeds in ((10_000, 6), (40_000, 4)):
        sums = [by_rough_paths(scene, antennas, seed, count)[1] for seed in range(seeds)]
        ratio = torch.stack(sums).mean(1) / truth.mean()
        error = float(ratio.std()) / seeds**0.5
        assert error < 0.08
        assert abs(float(ratio.mean()) - 1) < 4 * error + 0.01


@pytest.mark.claim
@pytest.mark.slow
def test_mean_power_of_rough_path_fields_is_the_power_map():
    """E|S|² over phases, within four standard errors of at most 5 %: the phases are independent."""
    scene, antennas = corner(), looks()
    truth = expected(scene, antennas, 3)
    found = [
        by_rough_paths(scene, antennas, seed, 2_000)[0].abs().square() / truth
        for seed in range(120)
    ]
    looked = torch.stack(found).mean(1)
    error = float(looked.std()) / len(found) ** 0.5
    assert error < 0.05
    assert abs(float(looked.mean()) - 1) < 4 * error


def test_paths_stay_while_the_radar_moves():
    scene = corner()
    antennas = [link(((0.0, y, 0.0),), ((0.0, y + 0.25, 0.0),)) for y in (0.0, 0.07)]
    few = Sampling(depth=3, points_per_m2=10.0, rough_paths=2_000)
    fixed = draw_speckle(scene, antennas[0], few, seed=1)
    paths = [
        trace_field(
            scene,
            a,
            sampling=few,
            seed=1,
            speckle=fixed,
        )
        for a in antennas
    ]
    assert len(paths[0]) > 200
    assert torch.equal(paths[0].first, paths[1].first)
    assert torch.equal(paths[0].last, paths[1].last)
    phases = [p.coefficient / p.coefficient.abs() for p in paths]
    assert torch.allclose(phases[0], phases[1], atol=1e-9)
    assert (paths[0].delay - paths[1].delay).abs().min() > 0
    both = trace_field(
        scene,
        joined(antennas),
        sampling=few,
        seed=1,
        speckle=fixed,
    )
    for number, alone in enumerate(paths):
        rows = both.frame == number
        assert sorted(both.delay[rows].tolist()) == sorted(alone.delay.tolist())
    other = draw_speckle(scene, antennas[0], few, seed=2)
    assert not torch.equal(other.paths[0].phase[:100], fixed.paths[0].phase[:100])


def joined(antennas: list[Link]) -> Link:
    return link(torch.cat([a.tx for a in antennas]), torch.cat([a.rx for a in antennas]))
