"""Antenna patterns: normalisation, and one meaning for the gain and its table."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene import (
    AntennaArray,
    Cosine,
    Isotropic,
    Pattern,
    TabulatedPattern,
    linear_array,
    planar_array,
)


def random_directions(count: int) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(points, dim=1)


def direction(theta: float, phi: float) -> Tensor:
    y, z = math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi)
    return torch.tensor([math.cos(theta), y, z], dtype=torch.float64)


def read_table(table: Tensor, directions: Tensor) -> np.ndarray:
    """A plain reading of the grid that `GainPattern.table` documents."""
    rows, columns = table.shape
    values = []
    for x, y, z in directions.tolist():
        row = (x + 1) / 2 * (rows - 1)
        column = (math.atan2(z, y) + math.pi) / (2 * math.pi) * columns
        i, j = min(int(row), max(rows - 2, 0)), int(column)
        s, t = row - i, column - j
        corners = [
            [float(table[min(i + a, rows - 1), (j + b) % columns]) for b in (0, 1)] for a in (0, 1)
        ]
        low, high = ((1 - t) * left + t * right for left, right in corners)
        values.append((1 - s) * low + s * high)
    return np.array(values)


def lopsided() -> TabulatedPattern:
    """A pattern that depends on both angles, one node every 2 degrees of θ and 10 of φ."""
    theta = torch.linspace(0, math.pi / 2, 46, dtype=torch.float64)
    phi = torch.arange(36, dtype=torch.float64) * math.radians(10) - math.pi
    return TabulatedPattern(theta, phi, smooth_gain(theta[:, None], phi))


def smooth_gain(theta: Tensor, phi: Tensor) -> Tensor:
    return torch.cos(theta) ** 2 * (4 + 2 * torch.sin(theta) * torch.cos(phi - 0.7))


@pytest.mark.parametrize(
    "pattern", [Isotropic(), *(Cosine(n) for n in (0.0, 0.5, 1.0, 2.0, 8.0, 30.0))]
)
def test_gain_integrates_to_the_full_sphere(pattern):
    cosine = -1 + (torch.arange(200_000, dtype=torch.float64) + 0.5) / 100_000
    sine = (1 - cosine**2).sqrt()
    directions = torch.stack([cosine, sine, torch.zeros_like(sine)], dim=1)
    integral = 4 * math.pi * float(pattern.gain(directions).mean())
    assert integral == pytest.approx(4 * math.pi, rel=1e-5)


@pytest.mark.parametrize(
    "pattern", [Isotropic(), *(Cosine(n) for n in (1.0, 2.0, 3.0, 8.0)), lopsided()]
)
def test_table_and_gain_agree(pattern):
    directions = random_directions(3000)
    gain = pattern.gain(directions)
    peak = float(pattern.table().max())
    assert np.abs(read_table(pattern.table(), directions) - gain.numpy()).max() < 1e-5 * peak


def test_table_sizes():
    assert Isotropic().table().shape == (1, 1)
    assert Cosine(2.0).table().shape == (2049, 1)
    assert lopsided().table().shape == (2049, 360)
    theta = torch.tensor([0.0, 1.0], dtype=torch.float64)
    symmetric = TabulatedPattern(
        theta, torch.zeros(1, dtype=torch.float64), torch.ones(2, 1).double()
    )
    assert symmetric.table().shape == (2049, 1)


def test_cosine_pattern_is_dark_behind():
    pattern = Cosine(2.0)
    assert float(pattern.gain(direction(0.0, 0.0))) == 6.0
    assert float(pattern.gain(direction(math.pi / 3, 1.0))) == pytest.approx(6 / 4)
    assert float(pattern.gain(direction(2.0, 0.3))) == 0.0
    assert float(Cosine(0.0).gain(direction(1.5, 0.0))) == 2.0


def test_gain_keeps_shape_and_type():
    directions = random_directions(6).reshape(2, 3, 3)
    for pattern in (Isotropic(), Cosine(1.0), lopsided()):
        gain = pattern.gain(directions)
        rows = [float(pattern.gain(one)) for one in directions.reshape(-1, 3)]
        assert gain.shape == (2, 3)
        assert gain.flatten().tolist() == pytest.approx(rows, rel=1e-12)
        single = pattern.gain(directions.float())
        assert single.dtype == torch.float32
        torch.testing.assert_close(single, gain.float(), rtol=1e-4, atol=1e-4)


def test_measured_pattern_follows_its_samples():
    pattern = lopsided()
    for theta, phi in ((0.0, 0.0), (0.4, 1.0), (1.0, -3.0), (1.3, 3.1), (1.0, math.pi - 1e-6)):
        expected = smooth_gain(torch.tensor(theta), torch.tensor(phi))
        assert float(pattern.gain(direction(theta, phi))) == pytest.approx(
            float(expected), abs=0.02
        )
    assert float(pattern.gain(direction(2.0, 0.0))) == 0.0
    # φ continues across ±π.
    left, right = direction(0.7, math.pi - 1e-9), direction(0.7, -math.pi + 1e-9)
    assert float(pattern.gain(left)) == pytest.approx(float(pattern.gain(right)), rel=1e-6)


def test_measured_pattern_given_from_zero_to_two_pi():
    pattern = lopsided()
    phi = pattern.phi + math.pi
    shifted = TabulatedPattern(pattern.theta, phi, smooth_gain(pattern.theta[:, None], phi))
    directions = random_directions(200)
    assert torch.allclose(shifted.gain(directions), pattern.gain(directions), atol=1e-9)


@pytest.mark.parametrize("exponent", [0.5, 3.0])
def test_gradients_on_the_axis_and_at_the_horizon(exponent):
    """Gradient of 2 (n + 1) xⁿ: 2 (n + 1) n along the axis; none behind or at the horizon."""
    found = gradients(Cosine(exponent))
    expected = torch.zeros(3, 3, dtype=torch.float64)
    expected[0, 0] = 2 * (exponent + 1) * exponent
    torch.testing.assert_close(found, expected)


def test_gradients_of_a_table_on_the_axis_and_at_the_horizon():
    """In front of the axis a slope along it; behind none; at the horizon a small one."""
    front, behind, horizon = gradients(lopsided())
    assert front[1:].abs().max() < 1e-9 * front.abs().max()
    assert behind.abs().max() == 0.0
    # The gain falls to zero there as cos²θ, between nodes 2° apart.
    assert horizon[1:].abs().max() < 1e-12
    assert 0 <= float(horizon[0]) < 0.3


def gradients(pattern: Pattern) -> Tensor:
    """Derivatives of the gain on the axis, behind it, and at the horizon."""
    directions = torch.stack(
        [direction(0.0, 0.0), direction(math.pi, 0.0), torch.eye(3, dtype=torch.float64)[1]]
    )
    # The exact axis, which the sine of a rounded π misses.
    directions[1] = torch.tensor([-1.0, 0.0, 0.0])
    directions.requires_grad_()
    pattern.gain(directions).sum().backward()
    assert directions.grad is not None
    return directions.grad


def test_gradient_of_the_gain():
    points = random_directions(20)
    points[:, 0] = points[:, 0].abs() + 0.01
    points.requires_grad_()
    assert torch.autograd.gradcheck(Cosine(2.5).gain, points)
    assert torch.autograd.gradcheck(lopsided().gain, points)


def test_arrays_are_centred():
    row = linear_array(4, 0.5)
    assert row.positions[:, 1].tolist() == [-0.75, -0.25, 0.25, 0.75]
    assert not row.positions[:, [0, 2]].any()
    assert isinstance(row.pattern, Isotropic)
    column = linear_array(3, 0.1, axis="z", pattern=Cosine(1.0))
    assert column.positions[:, 2].tolist() == pytest.approx([-0.1, 0.0, 0.1])
    assert column.pattern == Cosine(1.0)
    plane = planar_array((2, 3), (1.0, 2.0))
    assert plane.positions.tolist() == [[0.0, y, z] for y in (-0.5, 0.5) for z in (-2.0, 0.0, 2.0)]


def one(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Cosine(-1.0), "pattern exponent"),
        (
            lambda: TabulatedPattern(one(0, 1), one(0), torch.ones(1, 2)),
            r"gains as numbers of shape \[2, 1\]",
        ),
        (lambda: TabulatedPattern(one(0, 1), one(0), -torch.ones(2, 1)), "linear power gains >= 0"),
        (
            lambda: TabulatedPattern(one(0, 90), one(0), torch.ones(2, 1)),
            "theta from 0 to at most pi",
        ),
        (
            lambda: TabulatedPattern(one(0.1, 1), one(0), torch.ones(2, 1)),
            "theta from 0 to at most pi",
        ),
        (lambda: TabulatedPattern(one(1, 0), one(0), torch.ones(2, 1)), "ascending"),
        (
            lambda: TabulatedPattern(one(0), one(0), torch.ones(1, 1)),
            "at least 2 ascending angles theta",
        ),
        (
            lambda: TabulatedPattern(one(0, 1), one(0, 180), torch.ones(2, 2)),
            "spanning less than 2 pi",
        ),
        (
            lambda: TabulatedPattern(one(0, 1), one(0), torch.full((2, 1), math.nan)),
            "finite pattern gains",
        ),
        (lambda: AntennaArray(torch.zeros(0, 3)), "at least one antenna element"),
        (lambda: AntennaArray(torch.zeros(4, 2)), r"element positions as numbers of shape"),
        (lambda: AntennaArray(one(0, 0, 0)[None] / 0), "finite element positions"),
        (
            lambda: AntennaArray(torch.zeros(1, 3), "isotropic"),
            "expected a pattern \\(Pattern\\), got 'isotropic'",
        ),  # pyright: ignore[reportArgumentType]
        (lambda: linear_array(0, 0.1), "elements along y"),
        (
            lambda: linear_array(2, 0.1, axis="x"),  # pyright: ignore[reportArgumentType]
            "axis y, z, got 'x'; .*x is boresight",
        ),
        (lambda: linear_array(2, 0.0), "element spacing"),
        (lambda: planar_array((2, 2), (0.1, -0.1)), "element spacing"),
    ],
)
def test_bad_antennas_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_patterns_are_abstract():
    with pytest.raises(TypeError):
        Pattern()  # pyright: ignore[reportAbstractUsage]
