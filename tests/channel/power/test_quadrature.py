"""Maps of one and two bounces against a quadrature that shares no code with them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from invertwin.channel import Grid, Sampling, deposit_power
from invertwin.scene import (
    Object,
    RoughConductor,
    RoughDielectric,
    Scene,
    plate,
    rigid,
    rotation_from_vector,
)
from oracles.quadrature import Axis, Plate, power_map
from scenes import WAVELENGTH, float64, link, relative

RANGES, COSINES = Axis(0.5, 0.15, 20), Axis(-1.0, 0.2, 11)
GRID = Grid(0.5, 0.15, 20, u_start=-1.0, u_step=0.2, u_count=11)
WHITE, GLOSSY = RoughConductor(scattering=1.0), RoughDielectric(4.0, 0.0, 0.6, 0.9)
TX, RX = (0.0, -0.2, 0.1), (0.05, 0.25, 0.0)
# Name: sides, centre, rotation vector, material.
TWO = {
    "wall": ((1.2, 1.0), (1.8, 0.0, 0.0), (0.0, 0.0, 0.2), GLOSSY),
    "side": ((0.9, 0.8), (1.0, -0.9, 0.1), (0.1, 0.0, -1.2), WHITE),
}
THREE = TWO | {"screen": ((0.3, 0.4), (1.05, -0.15, 0.05), (0.3, 0.2, 0.5), WHITE)}


def both(layout: dict[str, Any]) -> tuple[Scene, list[Plate]]:
    """One scene, as the package takes it and as the quadrature does."""
    objects, plates = {}, []
    for name, (sides, centre, turn, material) in layout.items():
        rotation = rotation_from_vector(float64(turn))
        objects[name] = Object(plate(*sides), material, rigid(rotation, float64(centre)))
        axes = rotation.numpy()
        rough = {"permittivity": 4.0, "diffuse": 0.6, "width": 0.9} if material is GLOSSY else {}
        plates.append(
            Plate(np.array(centre), axes[:, 1] * sides[0], axes[:, 2] * sides[1], **rough)
        )
    return Scene(objects), plates


def traced(scene: Scene, bounces: int, samples: int, seeds: int) -> tuple[Tensor, float]:
    """Mean map of exactly that many bounces, and its relative Monte Carlo error."""
    maps = []
    for seed in range(seeds):
        drawn = Sampling(depth=bounces, samples=samples, boundary_samples=0)
        antennas = link((TX,), (RX,))
        found = deposit_power(scene, antennas, GRID, sampling=drawn, seed=seed).double()
        if bounces == 2:
            drawn = replace(drawn, depth=1)
            found = found - deposit_power(scene, antennas, GRID, sampling=drawn, seed=seed)
        maps.append(found[0, :, :, 0])
    stacked = torch.stack(maps)
    error = stacked.std(0) / seeds**0.5
    return stacked.mean(0), float(error.sum() / stacked.mean(0).sum())


@pytest.mark.parametrize("layout", [TWO, THREE], ids=["two plates", "an occluder between"])
@pytest.mark.parametrize(
    ("bounces", "count", "samples"), [(1, 300, 200_000), (2, 26, 6_000_000)], ids=["one", "two"]
)
def test_power_map_is_the_quadrature(layout, bounces, count, samples):
    """Bin by bin to 1 %, with a Monte Carlo error below 0.6 %."""
    scene, plates = both(layout)
    where = np.array(TX), np.array(RX), WAVELENGTH, RANGES, COSINES
    truth = torch.from_numpy(power_map(plates, *where, bounces=bounces, count=count))
    found, error = traced(scene, bounces, samples, 4)
    assert error < 0.006
    assert relative(found, truth) < 0.01
    assert float(found.sum() / truth.sum()) == pytest.approx(1, abs=0.005)


class Clear(Plate):
    """A plate that hides nothing."""

    def blocks(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        return np.zeros(np.broadcast_shapes(start.shape, end.shape)[:-1], dtype=bool)


@pytest.mark.parametrize(("bounces", "count"), [(1, 60), (2, 12)], ids=["one", "two"])
def test_the_occluder_of_the_quadrature_matters(bounces, count):
    """Without its shadows, the agreement above would fail."""
    where = np.array(TX), np.array(RX), WAVELENGTH, RANGES, COSINES
    plates = both(THREE)[1]
    clear = [*plates[:2], Clear(**vars(plates[2]))]
    maps = [
        torch.from_numpy(power_map(scene, *where, bounces=bounces, count=count))
        for scene in (plates, clear)
    ]
    assert relative(*maps) > 0.015
