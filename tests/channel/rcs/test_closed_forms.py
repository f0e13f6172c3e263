"""The oracles of signatures against each other, limits and a published table."""

import math

import numpy as np
import pytest
import torch

from invertwin.capture import load_rcs
from invertwin.channel import (
    DihedralSection,
    PlateSection,
    SphereSection,
    SquareTrihedralSection,
    TrihedralSection,
)
from invertwin.constants import SPEED_OF_LIGHT
from scenes import float64

AHEAD = float64([[-1.0, 0.0, 0.0]])
WAVELENGTH = 0.01
BAND = float64([SPEED_OF_LIGHT / WAVELENGTH])


@pytest.mark.parametrize(
    ("oracle", "expected"),
    [
        (PlateSection(0.1, 0.2), 4 * math.pi * 0.02**2 / WAVELENGTH**2),
        (DihedralSection(0.1), 8 * math.pi * 0.1**4 / WAVELENGTH**2),
        (TrihedralSection(0.1), 4 * math.pi * 0.1**4 / (3 * WAVELENGTH**2)),
        (SquareTrihedralSection(0.1), 12 * math.pi * 0.1**4 / WAVELENGTH**2),
    ],
)
def test_peaks(oracle, expected):
    assert float(oracle.section(BAND, AHEAD)) == pytest.approx(expected)


def test_a_corner_returns_less_off_its_axis_and_nothing_along_its_plates():
    angles = float64([0.0, 0.2, 0.4])
    directions = torch.stack([-angles.cos(), angles.sin(), 0 * angles], 1)
    levels = TrihedralSection(0.1).section(BAND, directions)[0]
    assert bool((levels.diff() < 0).all())


def test_small_and_large_spheres():
    k = float64([2 * math.pi * f / SPEED_OF_LIGHT for f in (1e6, 3e11)])
    found = SphereSection(0.1).section(float64([1e6, 3e11]), AHEAD)[:, 0]
    area = math.pi * 0.1**2
    assert float(found[0]) == pytest.approx(9 * area * float(k[0] * 0.1) ** 4, rel=1e-3)  # Rayleigh
    assert float(found[1]) == pytest.approx(area, rel=2e-3)


def wave_number(x: float) -> float:
    """The frequency [Hz] at which a sphere of 0.1 m has the size ka = x."""
    return x / 0.1 * SPEED_OF_LIGHT / (2 * math.pi)


def test_a_small_dielectric_sphere_is_that_of_rayleigh():
    """σ = 4πa²(ka)⁴ |(ε − 1)/(ε + 2)|²."""
    found = SphereSection(0.1, 2.5).section(float64([wave_number(0.05)]), AHEAD)
    expected = 4 * math.pi * 0.1**2 * 0.05**4 * (1.5 / 4.5) ** 2
    assert float(found) == pytest.approx(expected, rel=2e-3)


def test_large_lossy_and_metal_spheres_return_what_their_fronts_reflect():
    """S = (a/2) r exp(2jka), in phase and polarisation that of physical optics."""
    front = 0.05 * np.exp(200j)
    m = np.sqrt(4 * (1 - 0.5j))
    for sphere, r in ((SphereSection(0.1, 4.0, 0.5), (1 - m) / (1 + m)), (SphereSection(0.1), -1)):
        found = complex(sphere.amplitude(float64([wave_number(100.0)]))[0])
        assert abs(found / (r * front) - 1) < 6e-3


def test_a_sphere_of_high_loss_is_one_of_metal():
    metal, lossy = (
        complex(s.amplitude(float64([wave_number(10.0)]))[0])
        for s in (SphereSection(0.1), SphereSection(0.1, 1e10, 1.0))
    )
    assert abs(lossy / metal - 1) < 1e-4


@pytest.mark.parametrize(("name", "radius"), [("s2", 0.3), ("s7", 9.6)])
def test_spheres_are_those_of_the_published_table(data_folder, name, radius):
    for band in ("f1", "f6"):
        data = load_rcs(data_folder / "austin_rcs" / "IA" / f"ref_rcs.I.A.{name}.{band}.V.txt")
        found = SphereSection(radius).section(data.frequency[:1], AHEAD)
        assert 10 * math.log10(float(found)) == pytest.approx(float(data.dbsm[0]), abs=1e-5)
