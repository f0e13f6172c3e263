"""Placing a metasurface: the soft quantile, the aim, and searches in a small room."""

import math
from collections.abc import Sequence

import pytest
import torch

from invertwin.constants import SPEED_OF_LIGHT
from invertwin.links import Metasurface, PanelPlacement, WallPath
from invertwin.links.metasurface.placement import (
    Coverage,
    Descent,
    PanelDesign,
    evaluations_until,
    soft_quantile,
)
from invertwin.scene import Object, PerfectConductor, Scene, plate, rigid, rotation_from_vector
from scenes import float64

FREQUENCY = 60e9
SPACING = SPEED_OF_LIGHT / FREQUENCY / 2
TX = float64([1.0, -2.5, 2.0])


def coverage(count: int) -> Coverage:
    """Receivers behind a screen."""
    turn = rotation_from_vector(float64([math.pi / 2, 0.0, 0.0]))
    pose = rigid(turn, float64([0.5, 0.0, 1.35]))
    scene = Scene({"screen": Object(plate(3.0, 3.0), PerfectConductor(), pose)})
    generator = torch.Generator().manual_seed(2)
    u = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    places = u * float64([2.0, 2.0, 0.0]) + float64([0.0, 0.5, 1.2])
    return Coverage.of(scene, TX, places, FREQUENCY, 0.3)


def placing(count: int = 40) -> PanelDesign:
    """8 × 8 elements on the wall x = 3.9, of which a part sees behind the screen."""
    aim = coverage(count)
    path = WallPath([[3.9, -2.9], [3.9, 2.9]], 1.8)
    none = torch.zeros(8, 8, dtype=torch.float64)
    panel = Metasurface(float64([0.0, 0.0, 0.0]), torch.eye(3, dtype=torch.float64), none, SPACING)

    def make(along: float, yaw: float, spread: Sequence[float]) -> PanelPlacement:
        return PanelPlacement(
            path,
            TX,
            [1.0, 1.5, 1.2],
            FREQUENCY,
            (8, 8),
            along=along,
            yaw=yaw,
            spread=spread,
        )

    return PanelDesign(aim, panel, make, 0.4, 0.3, count)


def test_a_soft_quantile_becomes_the_quantile():
    values = torch.randn(400, generator=torch.Generator().manual_seed(1)).double()
    truth = torch.quantile(values, 0.1)
    assert float(soft_quantile(values, 0.1, 0.0)) == float(truth)
    assert float(soft_quantile(values, 0.1, 0.01)) == pytest.approx(float(truth), abs=0.03)


def test_its_derivatives_are_those_of_differences():
    values = torch.randn(20, generator=torch.Generator().manual_seed(1)).double().requires_grad_()
    (slope,) = torch.autograd.grad(soft_quantile(values, 0.2, 0.3), values)
    assert float(slope.sum()) == pytest.approx(1.0)
    for k in (0, 7):
        step = torch.zeros(20, dtype=torch.float64)
        step[k] = 1e-4
        ends = [soft_quantile(values.detach() + s * step, 0.2, 0.3) for s in (1, -1)]
        assert float(slope[k]) == pytest.approx(float(ends[0] - ends[1]) / 2e-4, rel=1e-5)


def test_strong_receivers_may_be_left_out():
    own = placing()
    with torch.no_grad():
        panel = own.make(5.0, 0.0, (0.1, 0.1))(own.panel)
        whole = own.coverage.worst(own.coverage.gain(panel))
        assert float(own.coverage.aim(panel)) == pytest.approx(float(whole))
        assert float(whole) > float(own.coverage.worst(own.coverage.direct)) + 0.5


def test_the_aim_knows_how_shadows_move():
    own = placing()

    def aim(along: float, *, boundary: bool = True) -> tuple[float, float]:
        module = own.make(along, 0.0, (0.2, 0.1))
        level = own.coverage.aim(module(own.panel), 1.0, boundary, 2.0)
        level.backward()
        assert module.along.grad is not None
        return level.item(), module.along.grad.item()

    truth = (aim(0.8 + 1e-6)[0] - aim(0.8 - 1e-6)[0]) / 2e-6
    assert aim(0.8)[1] == pytest.approx(truth, rel=1e-4)
    assert abs(aim(0.8, boundary=False)[1] - truth) > 0.1 * abs(truth)


def test_searches_reach_the_best_of_the_grid():
    own = placing()
    trials = own.trials(12, 3, [0.1])
    assert len(trials) == 36
    assert trials[-1][0] == pytest.approx(5.8)
    best = float(own.exhaustive(trials).max())
    short = Descent(scouts=6, tracks=2, track_steps=6, steps=15)
    found = own.by_gradient(short, 3)
    assert found.level > best - 0.2
    assert found.evaluations == short.evaluations == 6 + 3 * 27 + 3
    assert own.level(own.module(found.state)) == pytest.approx(found.level)


def test_scouts_are_spread_over_all_ranges():
    own = placing(5)
    scouts = own.drawn(torch.Generator().manual_seed(4), 8)
    along = torch.stack([scout.along.detach() for scout in scouts]) / 5.8
    yaw = torch.stack([scout.yaw.detach() for scout in scouts]) / (2 * own.yaw_limit) + 0.5
    for share in (along, yaw):
        assert (8 * share).long().sort().values.tolist() == list(range(8))


def test_annealing_keeps_its_best():
    own = placing(20)
    found = own.annealed(40, 1)
    assert found.evaluations == 40
    assert own.level(own.module(found.state)) == pytest.approx(found.level)
    again = own.annealed(40, 1, enough=-1e9)
    assert again.evaluations == 1
    assert abs(float(found.state["yaw"])) <= own.yaw_limit


def test_when_a_level_is_reached():
    history = [(1, -9.0), (5, -7.0), (9, -3.0)]
    assert evaluations_until(history, -7.5) == 5
    assert evaluations_until(history, 0.0) is None
