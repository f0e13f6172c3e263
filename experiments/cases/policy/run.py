"""Robots that see by radar alone learn to drive through a gap to a goal, among boxes.

A small network turns the map of a simulated radar on board, and where the goal is, into thrust and
turn. It is trained by the derivative of whole drives through the radar. Beside it, PPO of
stable-baselines3 and an evolution strategy learn the same on the same simulator.

    .venv/bin/python experiments/cases/policy/run.py [--quick] [-o out/policy]

Writes `metrics.json` and `content_security_policy.png`. Every training goes on where it was
interrupted. PPO needs
the optional extra `cases`; without it, `--without-ppo` leaves it out.
"""

import argparse
import functools
import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import driving
import steering
import torch
from learners import ByEvolution, ByGradient, ByPPO, Learner
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from torch import Tensor

from invertwin.plotting import PALETTE
from invertwin.seeds import derive_seed
from invertwin.storage.folders import replace_file

TARGET = 0.8  # success to which steps are counted
WATCHED, UNSEEN, CHECKED = 1, 2, 3  # keys of the seeds of worlds that no training draws
KINDS = ("gradient", "ppo", "evolution")


@dataclass(frozen=True)
class Plan:
    """How much is done.

    Attributes:
        seeds: Of every learner.
        updates: By gradient, for the whole training.
        budget: Steps after which another learner is given up.
        watched: Worlds in which the success is looked at while training.
        unseen: Worlds of the evaluation.
        rays: Of each robot in the check of derivatives, for the derivative and for differences.
    """

    seeds: int = 3
    updates: int = 900
    budget: int = 200_000
    watched: int = 100
    unseen: int = 200
    rays: tuple[int, int] = (300_000, 600_000)


QUICK = Plan(1, 30, 10_000, 20, 10, (4_000, 20_000))
Row = dict[str, Any]


def written(file: Path, value: Any) -> None:
    """Write a JSON file at once.

    Args:
        file: Where.
        value: What.
    """
    with replace_file(file) as part:
        part.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")


def begun(kind: str, seed: int, plan: Plan) -> Learner:
    """A learner at its start.

    Args:
        kind: Among ``KINDS``.
        seed: Of everything.
        plan: How long it will train.
    """
    if kind == "ppo":
        return ByPPO(seed)
    if kind == "gradient":
        return ByGradient(seed, plan.updates)
    return ByEvolution(seed, plan.budget // (64 * driving.STEPS))


@torch.no_grad()
def watched(plan: Plan, learner: Learner) -> float:
    """Share of worlds in which a policy succeeds, by the smooth model with speckle.

    Args:
        plan: How many worlds.
        learner: The policy.
    """
    worlds = driving.random_worlds(plan.watched, derive_seed(0, WATCHED))
    shown = driving.smooth_radar(worlds, boundary=False)
    found = driving.drive(worlds, shown, learner.command, 0, speckle=True)
    return float(found.success.double().mean())


def trained(kind: str, seed: int, plan: Plan, folder: Path) -> tuple[Learner, list[Row]]:
    """A learner after training, and its success on the way; goes on with what the folder holds.

    Others than by gradient stop at the target, since only their steps to it count.

    Args:
        kind: Among ``KINDS``.
        seed: Of everything.
        plan: How long.
        folder: Of the output.
    """
    learner, curve = begun(kind, seed, plan), list[Row]()
    file, weights = folder / f"{kind}_{seed}.json", folder / f"{kind}_{seed}.pt"
    if file.exists() and weights.exists():
        learner.load(weights)
        # What was written before the weights of its row is done again.
        rows = json.loads(file.read_text(encoding="utf-8"))
        curve = [row for row in rows if row["steps"] <= learner.steps]
    while not _over(kind, learner, curve, plan):
        begin = time.perf_counter()
        learner.advance()
        seconds = time.perf_counter() - begin + (curve[-1]["seconds"] if curve else 0.0)
        curve.append(
            {"steps": learner.steps, "success": watched(plan, learner), "seconds": seconds}
        )
        written(file, curve)
        learner.save(weights)
        print(
            f"{kind} {seed}: {learner.steps} steps in {seconds:.0f} s, "
            f"success {curve[-1]['success']:.2f}",
            flush=True,
        )
    return learner, curve


def _over(kind: str, learner: Learner, curve: Sequence[Row], plan: Plan) -> bool:
    if isinstance(learner, ByGradient):
        return learner.number >= plan.updates
    return learner.steps >= plan.budget or steps_to(curve) is not None


def steps_to(curve: Sequence[Row]) -> int | None:
    """Simulated steps to the target, or None: the first of two looks in a row that are there.

    Args:
        curve: Of one training.
    """
    there = [row["success"] >= TARGET for row in curve]
    found = (row["steps"] for row, *both in zip(curve, there, there[1:], strict=False) if all(both))
    return next(found, None)


@torch.no_grad()
def exact_rows(name: str, learner: Learner, plan: Plan, folder: Path) -> list[Row]:
    """Drives in unseen worlds with the exact chain; those that the folder holds are kept.

    Args:
        name: Of the file.
        learner: The policy.
        plan: How many worlds.
        folder: Of the output.
    """
    file = folder / f"exact_{name}.json"
    rows: list[Row] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else []
    worlds = unseen(plan)
    for number in range(len(rows), plan.unseen):
        world = worlds.chosen([number])
        seed = derive_seed(0, UNSEEN, 1, number)
        found = driving.drive(world, driving.exact_radar(world, seed), learner.command, seed)
        way = found.states[:, 0, :2]
        rows.append({"success": bool(found.success[0]), "way": way.tolist()})
        if number % 20 == 19 or number == plan.unseen - 1:
            written(file, rows)
            print(f"exact {name}: {number + 1} of {plan.unseen} worlds", flush=True)
    return rows


def unseen(plan: Plan) -> driving.Worlds:
    """Worlds that no training has drawn.

    Args:
        plan: How many.
    """
    return driving.random_worlds(plan.unseen, derive_seed(0, UNSEEN))


@torch.no_grad()
def smooth_success(
    plan: Plan, command: Callable[[Tensor], Tensor], *, blind: bool = False
) -> float:
    """Share of the unseen worlds in which a policy succeeds by the smooth model with speckle.

    Args:
        plan: How many worlds.
        command: The policy.
        blind: Whether its radar shows nothing.
    """
    worlds = unseen(plan)
    shown: driving.Shown = driving.smooth_radar(worlds, boundary=False)
    if blind:
        shape = driving.bins().shape[:2]
        shown = lambda state, _: torch.zeros(len(state), *shape, dtype=torch.float64)  # noqa: E731
    found = driving.drive(worlds, shown, command, 0, speckle=True)
    return float(found.success.double().mean())


def checks(plan: Plan, count: int = 12, step: float = 0.01) -> dict[str, float]:
    """Derivatives of final distances by the first commands against central differences.

    The network has random weights and heeds the radar much more than one at the start of training.
    Trained ones steer back after a push: what is left of it is too small for differences to tell.
    Worlds in which it drives into a box are left out: there the radar's map ends at once.
    Differences use the same rays on both sides. Errors are sums of absolute differences over sums
    of absolute values, of all worlds and both commands.

    Args:
        plan: How many rays.
        count: Of worlds.
        step: Of differences.
    """
    seed, net = 0, steering.policy(CHECKED, share=3.0)
    drawn = driving.random_worlds(8 * count, derive_seed(0, CHECKED))
    with torch.no_grad():
        shown = driving.smooth_radar(drawn, boundary=False)
        ways = driving.drive(drawn, shown, net, seed, steps=driving.STEPS // 2).states
        free = driving.clearance(drawn, ways[:, :, :2].transpose(0, 1)).amin((1, 2)) > 0
    worlds = drawn.chosen(free.nonzero()[:count, 0].tolist())
    fine = driving.smooth_radar(worlds, plan.rays[1], boundary=False)

    def distance(shown: driving.Shown, first: Tensor) -> Tensor:
        return driving.final_distance(worlds, shown, net, seed, first)

    def derivative(shown: driving.Shown) -> Tensor:
        first = torch.zeros(worlds.count, 2, dtype=torch.float64, requires_grad=True)
        return torch.autograd.grad(distance(shown, first).sum(), first)[0]

    rows = step * torch.eye(2, dtype=torch.float64)
    with torch.no_grad():
        pairs = [
            distance(fine, row.expand(worlds.count, 2)) for side in (1, -1) for row in side * rows
        ]
    differences = torch.stack([(pairs[k] - pairs[k + 2]) / (2 * step) for k in range(2)], dim=-1)
    smooth = functools.partial(driving.smooth_radar, worlds, plan.rays[0])
    still = smooth(boundary=False)
    found = {
        "full": derivative(smooth()),
        "interior": derivative(still),
        "without_radar": derivative(lambda state, key: still(state.detach(), key)),
    }
    scale = float(differences.abs().sum())
    errors = {name: float((v - differences).abs().sum()) / scale for name, v in found.items()}
    print("derivatives:", ", ".join(f"{name} off by {v:.3f}" for name, v in errors.items()))
    return errors


def summary(curves: dict[str, list[list[Row]]], plan: Plan) -> Row:
    """Steps to the target of all learners.

    Args:
        curves: By kind and seed.
        plan: Its budget stands for what was not reached; the ratio is then a bound.
    """
    reached = {kind: [steps_to(c) for c in rows] for kind, rows in curves.items()}
    median = {
        kind: statistics.median(
            s if s is not None else c[-1]["steps"] for s, c in zip(r, curves[kind], strict=True)
        )
        for kind, r in reached.items()
    }
    found: Row = {"steps_to_target": reached, "median_steps": median}
    for other, name in (("ppo", "steps_ratio"), ("evolution", "evolution_ratio")):
        if other in median:
            found[name] = median["gradient"] / median[other]
            found[f"{name}_is_bound"] = None in reached[other]
    return found


def figure(rows: Sequence[Row], curves: dict[str, list[list[Row]]], plan: Plan) -> Figure:
    """Ways in the first unseen worlds, and success over simulated steps.

    Args:
        rows: Of exact drives.
        curves: By kind and seed.
        plan: How many worlds.
    """
    drawn = Figure(figsize=(11, 4.2), layout="constrained")
    parts: Any = drawn.subfigures(1, 2, width_ratios=[1.6, 1])
    left, right = parts
    panels = left.subplots(2, 4)
    worlds = unseen(plan)
    corners = torch.tensor([[-1.0, -1.0], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64)
    for number, axes in enumerate(panels.flat[: len(rows)]):
        c, s = worlds.yaws[number].cos(), worlds.yaws[number].sin()
        turn = torch.stack([torch.stack([c, s], -1), torch.stack([-s, c], -1)], dim=-2)
        places = (corners * worlds.halves[number][:, None]) @ turn + worlds.centres[number][:, None]
        for place in places:
            axes.add_patch(Polygon(place.numpy(), color="0.6"))
        way = torch.tensor(rows[number]["way"])
        good = rows[number]["success"]
        axes.plot(way[:, 0], way[:, 1], ".-", color=PALETTE[0 if good else 1], markersize=3)
        axes.plot(*worlds.goal[number].tolist(), "*", color="black")
        axes.set(xlim=(-0.5, 8.2), ylim=(-3.4, 3.4), aspect="equal", xticks=[], yticks=[])
    left.suptitle("ways in unseen worlds, by the exact radar", fontsize=9)
    axes = right.subplots()
    for number, (kind, found) in enumerate(curves.items()):
        for seed, curve in enumerate(found):
            label = {"label": kind} if seed == 0 else {}
            steps, success = [r["steps"] for r in curve], [r["success"] for r in curve]
            axes.plot(steps, success, color=PALETTE[number], linewidth=1, **label)
    axes.axhline(TARGET, color="0.7", linestyle=":")
    axes.set(xscale="log", ylim=(0, 1))
    axes.set_xlabel("simulated steps of robots", fontsize=8)
    axes.set_ylabel("success in 100 worlds" if plan.watched == 100 else "success", fontsize=8)
    axes.legend(fontsize=7)
    axes.tick_params(labelsize=7)
    return drawn


def main() -> None:
    """Run the case."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a small version, two minutes")
    parser.add_argument("--without-ppo", action="store_true", help="leave PPO out")
    parser.add_argument("-o", "--output", type=Path, default=None)
    given = parser.parse_args()
    plan = QUICK if given.quick else Plan()
    folder = given.output or Path("out/policy_quick" if given.quick else "out/policy")
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)  # the network is small
    kinds = [kind for kind in KINDS if not (given.without_ppo and kind == "ppo")]
    curves: dict[str, list[list[Row]]] = {}
    finals: list[Learner] = []
    for kind in kinds:
        runs = [trained(kind, seed, plan, folder) for seed in range(plan.seeds)]
        curves[kind] = [curve for _, curve in runs]
        if kind == "gradient":
            finals = [learner for learner, _ in runs]
    rows = [exact_rows(f"gradient_{n}", final, plan, folder) for n, final in enumerate(finals)]
    figure(rows[0], curves, plan).savefig(folder / "policy.png", dpi=110)
    exact = [statistics.fmean(row["success"] for row in found) for found in rows]
    errors = checks(plan)
    metrics: Row = {
        "seeds": list(range(plan.seeds)),
        "worlds": plan.unseen,
        "success": min(exact),
        "success_exact": exact,
        "success_smooth": [smooth_success(plan, final.command) for final in finals],
        "success_blind": [smooth_success(plan, final.command, blind=True) for final in finals],
        "gradient_error": errors["full"],
        "gradient_errors": errors,
        **summary(curves, plan),
        "training_seconds": {
            kind: [curve[-1]["seconds"] for curve in found] for kind, found in curves.items()
        },
    }
    written(folder / "metrics.json", metrics)
    print(json.dumps(metrics, indent=2))


if __name__ == "__main__":
    main()
