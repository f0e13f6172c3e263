"""False-alarm rates on noise, targets in it, and the points that come out."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from scipy.optimize import root_scalar
from torch.autograd import forward_ad

from invertwin.channel import Grid
from invertwin.errors import InputError
from invertwin.radar import (
    FMCW,
    Chirps,
    Radar,
    cell_averaging_cfar,
    ordered_statistics_cfar,
    peaks,
    point_cloud,
    range_doppler,
    range_doppler_angle,
    velocity_axis,
    velocity_span,
)
from invertwin.scene.antenna import linear_array, planar_array
from invertwin.scene.pose import rotation_from_vector
from oracles.moving_point import moving_point

BOTH = pytest.mark.parametrize("cfar", [cell_averaging_cfar, ordered_statistics_cfar])


def noise(looks: int = 1, seed: int = 0, shape=(3, 160, 200)) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(looks, *shape, dtype=torch.float64, generator=generator)
    return -(1 - draws).log().mean(0)


@BOTH
@pytest.mark.parametrize(("looks", "rate"), [(1, 1e-2), (1, 1e-3), (4, 1e-2), (12, 1e-3)])
def test_false_alarm_rate(cfar, looks, rate):
    """Within four standard deviations of a binomial count, in the middle and at the edges."""
    power = noise(looks) * torch.tensor([1e-12, 1.0, 1e6])[:, None, None]
    options = {"guard": (1, 2), "training": (3, 2), "false_alarm": rate, "looks": looks}
    found = cfar(power, **options)
    assert found.shape == power.shape
    edge = torch.ones(160, 200, dtype=torch.bool)
    edge[4:-4, 4:-4] = False
    for cells in (found[:, ~edge], found[:, edge]):
        expected = rate * cells.numel()
        # Neighbours share training cells, so their alarms come a little in groups.
        assert abs(int(cells.sum()) - expected) < 5 * math.sqrt(expected)


@pytest.mark.parametrize(
    ("training", "cell", "cells", "rank", "place"),
    [
        ((0, 8), (30, 40), 16, 0.75, 12),
        ((0, 20), (30, 40), 40, 0.75, 30),
        ((1, 2), (0, 0), 5, 1.0, 5),  # a corner, where some training cells are missing
    ],
)
@pytest.mark.parametrize("rate", [1e-2, 1e-6])
def test_factor_of_one_look_is_the_closed_form(training, cell, cells, rank, place, rate):
    """Rohling: P = Π (N − i)/(N − i + α), i = 0 … k − 1.

    In a level map, a cell is found where it exceeds α times the level.
    """

    def product(factor: float) -> float:
        return math.prod((cells - i) / (cells - i + factor) for i in range(place)) - rate

    factor = root_scalar(product, bracket=(0.0, 1e9)).root
    options: dict[str, Any] = {
        "guard": (0, 0),
        "training": training,
        "false_alarm": rate,
        "rank": rank,
    }
    for ratio, detected in ((0.999, False), (1.001, True)):
        power = torch.ones(1, 60, 80, dtype=torch.float64)
        power[(0, *cell)] = ratio * factor
        assert bool(ordered_statistics_cfar(power, **options)[(0, *cell)]) == detected


@BOTH
def test_a_target_is_detected_and_not_its_surroundings(cfar):
    power = noise(shape=(60, 80))
    power[30, 40] = 100.0
    power[0, 79] = 100.0
    found = cfar(power, false_alarm=1e-6)
    assert torch.nonzero(found).tolist() == [[0, 79], [30, 40]]


def test_ordered_statistics_see_a_target_beside_a_stronger_one():
    """A strong one among the training cells hides a weak one from the mean only."""
    power = noise(shape=(60, 80))
    power[30, 40], power[30, 45] = 60.0, 1e4
    assert not cell_averaging_cfar(power)[30, 40]
    assert ordered_statistics_cfar(power)[30, 40]


@BOTH
def test_silence_is_not_detected(cfar):
    assert not cfar(torch.zeros(20, 20)).any()


@BOTH
def test_gradients_are_refused_by_name(cfar):
    power = noise(shape=(30, 30))
    with pytest.raises(InputError, match=f"{cfar.__name__}.*not differentiable"):
        cfar(power.clone().requires_grad_())
    with forward_ad.dual_level(), pytest.raises(InputError, match="not differentiable"):
        cfar(forward_ad.make_dual(power, power))


@BOTH
def test_wrong_input(cfar):
    power = noise(shape=(30, 30))
    for wrong in (-power, power.where(power < 3, math.nan)):
        with pytest.raises(InputError, match="finite powers"):
            cfar(wrong)
    with pytest.raises(InputError, match="guard and training"):
        cfar(power, guard=(-1, 0))
    with pytest.raises(InputError, match="training cells around every cell"):
        cfar(power, training=(0, 0))
    with pytest.raises(InputError, match="training cells around every cell"):
        cfar(power[:3, :3])
    for options in ({"false_alarm": 0.0}, {"false_alarm": 1.0}, {"looks": 0}):
        with pytest.raises(InputError, match="false-alarm"):
            cfar(power, **options)
    with pytest.raises(InputError, match="rank"):
        ordered_statistics_cfar(power, rank=0.0)


WAVE = FMCW(76.5e9, 1e9, 40e-6, 64)
CHIRPS = Chirps(count=32, interval=50e-6)


@pytest.fixture(scope="module")
def radar() -> Radar:
    half = 0.5 * WAVE.wavelength
    turns = [[0.0, 0.0, 0.0], [0.2, 0.1, -0.5]]
    return Radar(
        linear_array(2, 4 * half),
        planar_array((4, 4), (half, half)),
        WAVE,
        torch.tensor([[0.0, 0, 0], [0.5, 1.0, -2]], dtype=torch.float64),
        torch.stack([rotation_from_vector(torch.tensor(t).double()) for t in turns]),
    )


def test_points_of_movers(radar):
    """From echoes to points: range, rate, direction, power, place in the world, in both poses."""
    grid = radar.grid(2, 7, u_max=0.6, v_max=0.6)
    span = velocity_span(radar, CHIRPS)
    truth = [(4.03, -0.21 * span, 0.21, -0.13, 1.0), (5.52, 0.33 * span, -0.34, 0.2, 0.7)]
    beat = torch.stack([moving_point(radar, CHIRPS, *numbers) for numbers in truth]).sum(0)
    generator = torch.Generator().manual_seed(1)
    beat = beat + 0.05 * torch.randn(beat.shape, dtype=torch.complex128, generator=generator)
    power = range_doppler_angle(beat, radar, grid, CHIRPS)
    cube = range_doppler(beat, radar, grid, CHIRPS)
    mean = cube.abs().square().mean((2, 3))
    found = point_cloud(
        power, cell_averaging_cfar(mean, false_alarm=1e-9, looks=32), radar, grid, CHIRPS
    )
    for frame in range(2):
        rows = torch.nonzero(found.frame == frame).ravel()
        strongest = rows[found.power[rows].argsort(descending=True)[:2]]
        for row, (distance, rate, u, v, amplitude) in zip(strongest, truth, strict=True):
            assert found.range[row] == pytest.approx(distance, abs=0.02)
            assert found.velocity[row] == pytest.approx(rate, abs=0.1 * span / 32)
            assert found.u[row] == pytest.approx(u, abs=0.1 * radar.beamwidth[0])
            assert found.v[row] == pytest.approx(v, abs=0.1 * radar.beamwidth[1])
            # Less what falls between the bins of range rate, range and direction.
            assert -3 < 10 * math.log10(found.power[row] / amplitude**2) < 0.3
            ray = torch.tensor([math.sqrt(1 - u**2 - v**2), u, v], dtype=torch.float64)
            link = radar.link()
            place = 0.5 * (link.tx + link.rx)[frame] + link.rotations[frame] @ ray * distance
            assert (found.position[row] - place).norm() < 0.12


def test_one_point_per_maximum_and_the_fold(radar):
    """A plateau-free bump in the map, at both ends of the axis of range rates."""
    still = radar.frames([0])
    grid = Grid(3.0, 0.1, 9, u_start=-0.2, u_step=0.1, u_count=5)
    power = torch.full((1, 8, 9, 5, 1), 1e-3, dtype=torch.float64)
    bump = torch.tensor([0.5, 1.0, 0.4], dtype=torch.float64)
    power[0, 7, 3:6, 2, 0] = bump
    power[0, 0, 3:6, 2, 0] = 0.6 * bump  # the neighbour of bin 7
    power[0, 4, 0, 4, 0] = 2.0  # at an edge: no refinement
    everywhere = torch.ones(1, 8, 9, dtype=torch.bool)
    fold = torch.zeros(1, 8, 9, dtype=torch.int64)
    fold[0, 7] = -1
    cells = power.amax((-2, -1)) > 0.3
    found = point_cloud(power, everywhere & cells, still, grid, CHIRPS, fold)
    assert len(found) == 2
    order = found.power.argsort()
    axis, span = velocity_axis(still, CHIRPS, 8), velocity_span(still, CHIRPS)
    near, far = (found.velocity[i] for i in order)
    step = axis[1] - axis[0]
    assert axis[7] - span < near < axis[7] - span + 0.5 * step
    assert far == axis[4]
    assert 3.35 < found.range[order[0]] < 3.4
    assert found.range[order[1]] == 3.0
    assert found.u[order[1]] == pytest.approx(0.2)


def test_no_detections_no_points(radar):
    grid = radar.grid(2, 3)
    power = torch.ones(2, 4, *grid.shape)
    found = point_cloud(
        power, torch.zeros(2, 4, grid.range_count, dtype=torch.bool), radar, grid, CHIRPS
    )
    assert len(found) == 0
    assert found.position.shape == (0, 3)


def test_points_refuse_gradients_and_other_shapes(radar, unchecked):
    grid = radar.grid(2, 3)
    power = torch.ones(2, 4, *grid.shape)
    cells = torch.ones(2, 4, grid.range_count, dtype=torch.bool)
    with pytest.raises(InputError, match=r"point_cloud.*not differentiable"):
        point_cloud(power.requires_grad_(), cells, radar, grid, CHIRPS)
    power = power.detach()
    for wrong in ((power[:1], cells), (power, cells[:, :2]), (power[..., :1], cells)):
        with pytest.raises(InputError, match="power of shape"):
            point_cloud(*wrong, replace(radar), grid, CHIRPS)


@pytest.mark.usefixtures("unchecked")
def test_peaks_of_a_map_are_placed_in_the_world():
    """Two bumps at one range that differ in direction alone, and one beside the detected cells."""
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64))
    radar = Radar(
        linear_array(1, 0.01),
        planar_array((8, 8), (0.0019, 0.0019)),
        FMCW(77e9, 1e9, 50e-6, 64),
        torch.tensor([[3.0, 1.0, 2.0]], dtype=torch.float64),
        turn[None],
    )
    grid = Grid(2.0, 0.1, 30, u_start=-0.5, u_step=0.05, u_count=21, v_start=-0.5, v_step=0.05,
                v_count=21)  # fmt: skip
    true = torch.tensor([[3.03, -0.21, 0.12], [3.03, 0.28, -0.09], [4.5, 0.0, 0.0]]).double()
    axes = torch.meshgrid(grid.ranges, grid.u, grid.v, indexing="ij")
    bumps = [
        torch.exp(-(((axes[0] - r) / 0.15) ** 2 + ((axes[1] - u) ** 2 + (axes[2] - v) ** 2) / 0.01))
        for r, u, v in true
    ]
    power = torch.stack(bumps).sum(0)[None]
    detections = (power.amax(3) > 0.1) & (grid.ranges < 4)[None, :, None]
    found = peaks(power, detections, radar, grid)
    assert len(found) == 2
    order = found.u.argsort()
    places = torch.stack([found.range, found.u, found.v], dim=1)[order]
    torch.testing.assert_close(places, true[:2], atol=2e-3, rtol=0.0)
    assert not found.velocity.any()
    local = torch.stack([(1 - found.u**2 - found.v**2).sqrt(), found.u, found.v], dim=1)
    expected = radar.positions + (found.range[:, None] * local) @ turn.T
    offset = radar.transmitters.positions.mean(0) + radar.receivers.positions.mean(0)
    torch.testing.assert_close(found.position, expected + 0.5 * (turn @ offset))
    with pytest.raises(InputError, match="shape"):
        peaks(power, detections[:, :-1], radar, grid)
