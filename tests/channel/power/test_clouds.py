"""Clouds: laws of single scattering, and gradients against differences."""

import math
from dataclasses import replace

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from invertwin.channel import Grid, Link, Sampling, deposit_density, deposit_power, trace_power
from invertwin.errors import InputError
from invertwin.scene import (
    Cloud,
    Cosine,
    Object,
    RoughConductor,
    RoughDielectric,
    Scene,
    plate,
    rigid,
    rotation_from_vector,
)
from scenes import float64, link, thing

BINS = Grid(0.0, 0.02, 200)
MAP = Grid(1.0, 0.05, 24, u_start=-0.5, u_step=0.1, u_count=11, v_start=-0.4, v_step=0.1, v_count=9)


def cloud_at(density: Tensor, size: tuple[float, float, float], x: float = 1.5) -> Object:
    """A cloud about a place on the boresight; its mesh is a marker."""
    high = [0.5 * side for side in size]
    cloud = Cloud(float64([-side for side in high]), float64(high), density)
    return Object(plate(0.1, 0.1), RoughDielectric(4.0), rigid(translation=[x, 0, 0]), cloud=cloud)


def even(density: float, counts: tuple[int, int, int] = (33, 9, 9)) -> Tensor:
    return torch.full(counts, density, dtype=torch.float64)


def total(item: Object, antennas: Link, samples: int = 100_000, seed: int = 1) -> float:
    found = deposit_density(item, antennas, BINS, sampling=Sampling(samples=samples), seed=seed)
    return float(found.double().sum())


@pytest.mark.parametrize("x", [1.5, 3.0])
@pytest.mark.parametrize("shared", [True, False])
def test_a_dense_slab_is_a_diffuse_sheet_of_an_eighth_of_its_albedo(x: float, shared: bool) -> None:
    """Face on, at both distances, hence with the inverse squares of both ways."""
    antennas = link(shared=shared)
    slab = cloud_at(even(400.0), (0.1, 0.2, 0.2), x)
    sheet = thing(plate(0.2, 0.2), (x - 0.05, 0, 0), material=RoughConductor(scattering=1.0))
    white = deposit_power(
        Scene({"sheet": sheet}),
        antennas,
        BINS,
        sampling=Sampling(depth=1, samples=200_000, boundary_samples=0),
        seed=1,
    )
    # The slab answers from 1/(2σ) deeper on average: within (2 / 1600 / 1.45)·2.
    assert total(slab, antennas) == pytest.approx(float(white.double().sum()) / 8, rel=0.006)


def test_a_dense_slab_at_an_angle_follows_lommel_and_seeliger() -> None:
    angle = math.radians(50)
    slab = cloud_at(even(800.0), (0.1, 0.1, 0.1), 20.0)
    turn = rotation_from_vector(float64([0.0, 0.0, angle]))
    slab = replace(slab, pose=rigid(turn, [20.0, 0.0, 0.0]))
    antennas = link()
    grid = Grid(19.8, 0.02, 30)
    found = float(
        deposit_density(slab, antennas, grid, sampling=Sampling(samples=400_000), seed=2)
        .double()
        .sum()
    )
    # Two faces are lit, of cosines cos 50° and sin 50°; each returns albedo/(8π)·cosθ per m².
    faces = 0.01 * (math.cos(angle) + math.sin(angle)) / (8 * math.pi)
    scale = (antennas.wavelength / (4 * math.pi)) ** 2
    nearest = 20.0 - 0.05 * (math.cos(angle) + math.sin(angle))
    assert scale * faces / 20.0**4 < found < scale * faces / nearest**4
    assert found == pytest.approx(scale * faces / 20.0**4, rel=0.02)


def test_a_thin_cloud_is_linear_and_adds_its_cross_sections() -> None:
    antennas = link(pattern=Cosine(2.0))
    one, ten = (total(cloud_at(even(s), (0.1, 0.1, 0.1)), antennas) for s in (1e-3, 1e-2))
    assert ten == pytest.approx(10 * one, rel=2e-3)
    section = 1e-3 * 0.1**3  # albedo · σ · volume
    gain = float(Cosine(2.0).gain(float64([1.0, 0.0, 0.0])))
    equation = gain**2 * antennas.wavelength**2 * section / ((4 * math.pi) ** 3 * 1.5**4)
    assert one == pytest.approx(equation, rel=0.01)


def test_what_is_dense_hides_what_lies_behind() -> None:
    layers = torch.zeros(41, 5, 5, dtype=torch.float64)
    layers[30:] = 5.0
    behind = deposit_density(
        cloud_at(layers, (0.4, 0.4, 0.4)), link(), BINS, sampling=Sampling(samples=100_000), seed=3
    ).double()
    layers[5:10] = 100.0
    both = deposit_density(
        cloud_at(layers, (0.4, 0.4, 0.4)), link(), BINS, sampling=Sampling(samples=100_000), seed=3
    ).double()
    far = BINS.ranges > 1.6
    assert float(behind[0, far].sum()) > 0
    assert float(both[0, far].sum()) < 1e-3 * float(behind[0, far].sum())
    assert float(both.sum()) > 3 * float(behind.sum())


def test_separate_antennas_tend_to_one() -> None:
    generator = torch.Generator().manual_seed(0)
    item = cloud_at(30 * torch.rand(9, 9, 9, generator=generator).double(), (0.4, 0.4, 0.4))
    shared = total(item, link(shared=True))
    assert total(item, link(shared=False)) == pytest.approx(shared, rel=3e-3)
    # Reciprocity: who sends and who receives does not matter.
    ends = ((0.0, 0.0, 0.0),), ((0.0, 0.6, 0.1),)
    there = total(item, link(ends[0], ends[1], shared=False))
    back = total(item, link(ends[1], ends[0], shared=False))
    assert there == pytest.approx(back, rel=0.01)


def test_the_map_puts_points_where_they_are() -> None:
    item = cloud_at(even(50.0, (3, 3, 3)), (0.02, 0.02, 0.02))
    place = float64([1.5, 0.3, -0.2])
    item = replace(item, pose=rigid(translation=place))
    power = deposit_density(item, link(), MAP, sampling=Sampling(samples=20_000), seed=0).double()[
        0
    ]
    distance = float(place.norm())
    for axis, values, truth in (
        (0, MAP.ranges, distance),
        (1, MAP.u, 0.3 / distance),
        (2, MAP.v, -0.2 / distance),
    ):
        others = [k for k in range(3) if k != axis]
        mean = float((power.sum(others) * values).sum() / power.sum())
        assert mean == pytest.approx(truth, abs=0.005)


KINDS = ("densities", "albedo", "across", "along", "turn", "radar", "radar turn")
QUICK = {("densities", True), ("turn", False)}


def moved(kind: str, theta: Tensor, shared: bool) -> tuple[Object, Link]:
    """A rough cloud, seen askew, with one thing changed by θ."""
    generator = torch.Generator().manual_seed(0)
    density, pattern = 6 * torch.rand(2, 9, 9, 9, generator=generator, dtype=torch.float64)
    shift, turn = float64([1.5, 0.1, 0.0]), float64([0.3, 0.1, 0.2])
    antennas = link(rx=None if shared else ((0.0, 0.3, 0.0),), shared=shared, pattern=Cosine(2.0))
    x, y, z = torch.eye(3, dtype=torch.float64)
    albedo = 1.0 + theta if kind == "albedo" else 1.0
    match kind:
        case "densities":
            density = density + theta * pattern
        case "across":
            shift = shift + theta * y
        case "along":
            shift = shift + theta * x
        case "turn":
            turn = turn + theta * z
        case "radar":
            antennas = replace(antennas, tx=antennas.tx + theta * y, rx=antennas.rx + theta * y)
        case "radar turn":
            antennas = replace(antennas, rotations=rotation_from_vector(theta * z)[None])
    item = cloud_at(density, (0.6, 0.6, 0.6))
    cloud = replace(item.cloud, albedo=albedo) if item.cloud else None
    return replace(item, pose=rigid(rotation_from_vector(turn), shift), cloud=cloud), antennas


@pytest.mark.parametrize(
    ("kind", "shared"),
    [
        pytest.param(kind, shared, marks=() if (kind, shared) in QUICK else pytest.mark.slow)
        for kind, shared in (
            *((kind, True) for kind in KINDS),
            ("densities", False),
            ("turn", False),
        )
    ],
)
def test_gradients_equal_differences_that_have_converged(kind: str, shared: bool) -> None:
    """The differences draw other numbers; separate ways are dear, and draw the same."""
    count, other = (300_000, 11) if shared else (30_000, 5)

    def at(theta: Tensor, samples: int, seed: int) -> Tensor:
        item, antennas = moved(kind, theta, shared)
        return deposit_density(
            item, antennas, MAP, sampling=Sampling(samples=samples), seed=seed
        ).double()

    def difference(step: float, seed: int) -> Tensor:
        ends = [at(float64(sign * step), count, seed) for sign in (1.0, -1.0)]
        return (ends[0] - ends[1]) / (2 * step)

    with torch.no_grad():
        wide, narrow = difference(4e-3, other), difference(2e-3, other)
        assert (wide - narrow).abs().sum() < 0.02 * wide.abs().sum()
    with forward_ad.dual_level():
        theta = forward_ad.make_dual(float64(0.0), float64(1.0))
        forward = forward_ad.unpack_dual(at(theta, count, 5)).tangent
    assert forward is not None
    assert (forward - narrow).abs().sum() < 0.03 * narrow.abs().sum()
    weights = torch.rand(forward.shape, generator=torch.Generator().manual_seed(1)).double()
    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (at(zero, count, 5) * weights).sum().backward()
    assert zero.grad is not None
    scale = float((forward.abs() * weights).sum())
    assert float(zero.grad) == pytest.approx(float((forward * weights).sum()), abs=1e-4 * scale)


def test_a_scene_adds_its_clouds_and_its_surfaces() -> None:
    item = cloud_at(even(5.0), (0.2, 0.2, 0.2))
    wall = thing(plate(1.0, 1.0), (2.5, 0.0, 0.0))

    def power(**objects: Object) -> Tensor:
        return deposit_power(
            Scene(objects),
            link(),
            BINS,
            sampling=Sampling(depth=1, samples=20_000, boundary_samples=0),
            seed=0,
        )

    both = power(wall=wall, item=item)
    torch.testing.assert_close(both, power(wall=wall) + power(item=item), rtol=1e-5, atol=0.0)
    with pytest.raises(InputError, match="surfaces"):
        trace_power(
            Scene({"item": item}),
            link(),
            sampling=Sampling(depth=1, samples=10, boundary_samples=0),
            seed=0,
        )


def test_bad_input_is_refused() -> None:
    item = cloud_at(even(5.0), (0.2, 0.2, 0.2))
    with pytest.raises(InputError, match="cloud"):
        deposit_density(
            replace(item, cloud=None), link(), BINS, sampling=Sampling(samples=10), seed=0
        )
    with pytest.raises(InputError, match="samples"):
        deposit_density(item, link(), BINS, sampling=Sampling(samples=0), seed=0)
    with pytest.raises(InputError, match="outside"):
        deposit_density(
            replace(item, pose=None), link(), BINS, sampling=Sampling(samples=10), seed=0
        )
    moving = replace(item, velocity=float64([0.0, 1.0, 0.0]))
    with pytest.raises(InputError, match="at rest"):
        deposit_density(moving, link(), BINS, sampling=Sampling(samples=10), seed=0)
    with pytest.raises(InputError, match="least"):
        Cloud(float64([0, 0, 0]), float64([1, 1, 1]), even(-1.0))
    with pytest.raises(InputError, match="low < high"):
        Cloud(float64([0, 0, 0]), float64([1, 1, 0]), even(1.0))
