"""The case of driving by radar: motion, derivatives through drives, a short training."""

from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from cases.loading import loaded


@pytest.fixture(scope="module")
def driving() -> ModuleType:
    return loaded("policy", "driving")


@pytest.fixture(scope="module")
def steering(driving: ModuleType) -> ModuleType:
    return loaded("policy", "steering")


@pytest.fixture(scope="module")
def learners(steering: ModuleType) -> ModuleType:
    return loaded("policy", "learners")


def test_motion_is_differentiated_and_saturates(driving: ModuleType):
    state = torch.tensor([[0.3, -0.2, 0.4, 0.7], [1.0, 2.0, -2.0, 0.0]], dtype=torch.float64)
    command = torch.tensor([[0.5, -0.3], [-1.0, 2.0]], dtype=torch.float64)
    inputs = state.requires_grad_(), command.requires_grad_()
    assert torch.autograd.gradcheck(driving.moved, inputs)
    still = torch.zeros(1, 4, dtype=torch.float64)
    for _ in range(40):
        still = driving.moved(still, torch.tensor([[50.0, 0.0]], dtype=torch.float64))
    assert float(still[0, 3]) == pytest.approx(driving.THRUST / driving.DRAG)
    assert float(still[0, 1]) == 0.0


def test_clearance_is_the_distance_to_a_turned_box(driving: ModuleType):
    zero = torch.zeros(1, 2, dtype=torch.float64)
    worlds = driving.Worlds(
        zero[:, None],
        torch.tensor([[[1.0, 0.5]]], dtype=torch.float64),
        torch.tensor([[torch.pi / 2]], dtype=torch.float64),
        zero,
        zero,
        torch.zeros(1, 4, dtype=torch.float64),
    )
    # Turned by 90°, the box reaches 0.5 along x and 1 along y.
    places = torch.tensor([[[2.0, 0.0], [0.0, 2.0], [3.5, 5.0], [0.0, 0.9]]], dtype=torch.float64)
    expected = [1.5, 1.0, 5.0, -0.1]
    found = driving.clearance(worlds, places)[0, :, 0] + driving.RADIUS
    assert found.tolist() == pytest.approx(expected, abs=1e-5)


def test_worlds_of_one_scene_do_not_see_each_other(driving: ModuleType):
    worlds = driving.random_worlds(4, 5)
    emptied = driving.Worlds(**vars(worlds) | {"centres": worlds.centres.clone()})
    emptied.centres[1:, :, 0] += 12.0  # out of the window, still between the other worlds
    state = worlds.start.clone().requires_grad_()
    alone = worlds.start.clone().requires_grad_()
    together = driving.smooth_radar(worlds, 400_000)(state, 3)
    apart = driving.smooth_radar(emptied, 400_000)(alone, 3)
    with torch.no_grad():
        # Other rays meet the boxes once others have moved.
        assert float((together[0] - apart[0]).abs().sum()) < 0.02 * float(apart[0].sum())
        assert float(apart[1:].sum()) < 1e-3 * float(together[1:].sum())
    # The map of a robot depends on that robot alone.
    (slope,) = torch.autograd.grad(together[0].sum(), state)
    assert float(slope[1:].abs().max()) == 0.0
    assert float(slope[0, :3].abs().min()) > 0.0


def test_smooth_radar_is_the_mean_of_exact_ones(driving: ModuleType):
    world = driving.random_worlds(1, 3)
    state = world.start
    looks = [driving.exact_radar(world, seed)(state, seed) for seed in range(60)]
    weight = driving.bins().ranges[:, None] ** 4
    exact = float((torch.stack(looks).mean(0) * weight).sum())
    smooth = float((driving.smooth_radar(world, 40_000)(state, 0) * weight).sum())
    assert exact == pytest.approx(smooth, rel=0.15)


def test_derivative_through_three_steps(driving: ModuleType, steering: ModuleType):
    worlds, net = driving.random_worlds(2, 8), steering.policy(1, share=3.0)
    shown = driving.smooth_radar(worlds, 100_000)

    def distance(first: torch.Tensor) -> torch.Tensor:
        return driving.final_distance(worlds, shown, net, 0, first, steps=3)

    first = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    (slopes,) = torch.autograd.grad(distance(first).sum(), first)
    with torch.no_grad():
        steps = 0.05 * torch.eye(2, dtype=torch.float64)
        columns = [(distance(s.expand(2, 2)) - distance(-s.expand(2, 2))) / 0.1 for s in steps]
    differences = torch.stack(columns, dim=-1)
    assert float((slopes - differences).abs().sum() / differences.abs().sum()) < 0.03


def test_short_training_lowers_the_loss_and_resumes(
    driving: ModuleType, learners: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(learners, "CHUNK", 5)
    monkeypatch.setattr(learners.ByGradient, "few", 8)
    worlds = driving.random_worlds(16, 77)
    shown = driving.smooth_radar(worlds, boundary=False)

    def loss(learner: Any) -> float:
        with torch.no_grad():
            return float(driving.drive(worlds, shown, learner.command, 0).cost.mean())

    learner = learners.ByGradient(0, 100)
    before = loss(learner)
    learner.advance()
    learner.save(tmp_path / "kept.pt")
    again = learners.ByGradient(0, 100)
    again.load(tmp_path / "kept.pt")
    assert loss(learner) < before - 1.0
    assert loss(again) == pytest.approx(loss(learner), abs=1e-3)
    assert (again.steps, again.number) == (learner.steps, 5)


def test_evolution_goes_downhill(
    driving: ModuleType, learners: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    given = torch.rand(64, driving.inputs_count(), dtype=torch.float64)

    def drive(worlds: Any, shown: Any, net: Any, seed: int, *, speckle: bool) -> Any:
        cost = net(given).sum(-1)
        return driving.Drive(cost, torch.zeros(1), cost > 0, 64)

    monkeypatch.setattr(driving, "drive", drive)
    learner = learners.ByEvolution(0, 100)
    exact = torch.autograd.grad(learner.net(given).sum(), list(learner.net.parameters()))
    total = 0.0
    for seed in range(10):
        assert learner.gradient(seed) == 64
        pairs = zip(exact, learner.net.parameters(), strict=True)
        total += sum(float((g * p.grad).sum()) for g, p in pairs)
    assert total > 0


def test_summary_bounds_what_was_not_reached():
    run = loaded("policy", "run")
    curve = [{"steps": n, "success": n / 100} for n in (20, 60, 85, 90)]
    never = [{"steps": 400, "success": 0.1}, {"steps": 900, "success": 0.2}]
    found = run.summary({"gradient": [curve], "ppo": [never], "evolution": [curve]}, run.Plan())
    assert found["steps_ratio"] == pytest.approx(85 / 900)
    assert found["steps_ratio_is_bound"] is True
    assert found["evolution_ratio"] == 1.0
    assert found["evolution_ratio_is_bound"] is False
