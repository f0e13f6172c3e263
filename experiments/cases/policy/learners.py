"""Three ways to learn to drive on one simulator: its gradient, PPO, and an evolution strategy.

All start from the same weights of the same network, see the same inputs and get the same loss. Only
the first uses the derivatives of the simulator.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import driving
import steering
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from invertwin.seeds import derive_seed
from invertwin.storage.folders import replace_file

RATE = 1e-2
CHUNK = 10  # updates between two looks at the success


class Learner(ABC):
    """A policy that is being trained.

    Attributes:
        seed: Of everything.
        steps: Simulated steps of robots so far.
    """

    def __init__(self, seed: int) -> None:
        """Start from random weights.

        Args:
            seed: Of everything.
        """
        self.seed, self.steps = seed, 0

    @abstractmethod
    def advance(self) -> None:
        """Train a little."""

    @abstractmethod
    def command(self, given: Tensor) -> Tensor:
        """What the policy does [world, 2], from ``driving.inputs``."""

    @abstractmethod
    def save(self, file: Path) -> None:
        """Write all that is needed to go on."""

    @abstractmethod
    def load(self, file: Path) -> None:
        """Go on from what ``save`` wrote."""


def _recent(mean: Tensor, new: Tensor, count: Any) -> Tensor:
    """Mean over the last updates, about twenty of them."""
    return mean + (new - mean) * torch.as_tensor(1 - count / (count + 5.0)).clamp_min(0.05)


class _Updated(Learner):
    """A learner by Adam, of worlds that are new in every update; drives by the mean of its weights.

    Source of the mean: Polyak and Juditsky, "Acceleration of stochastic approximation by
    averaging", 1992; here over the last updates.
    """

    worlds = 16

    def __init__(self, seed: int, updates: int) -> None:
        super().__init__(seed)
        self.updates, self.number = updates, 0
        self.net = steering.policy(seed)
        self.mean = AveragedModel(self.net, avg_fn=_recent)
        self.adam = torch.optim.Adam(self.net.parameters(), RATE)

    def advance(self) -> None:
        for _ in range(CHUNK):
            # The first half at the full rate, then down to zero.
            for group in self.adam.param_groups:
                group["lr"] = RATE * max(0.01, min(1.0, 2 * (1 - self.number / self.updates)))
            self.adam.zero_grad()
            self.steps += self.gradient(derive_seed(self.seed, 2, self.number))
            torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
            self.adam.step()
            self.mean.update_parameters(self.net)
            self.number += 1

    @abstractmethod
    def gradient(self, seed: int) -> int:
        """Leave the gradient of the mean loss in the weights; how many steps that took."""

    def command(self, given: Tensor) -> Tensor:
        return self.mean(given)

    def save(self, file: Path) -> None:
        kept = {
            "net": self.net.state_dict(),
            "mean": self.mean.state_dict(),
            "adam": self.adam.state_dict(),
            "number": self.number,
            "steps": self.steps,
        }
        with replace_file(file) as part:
            torch.save(kept, part)

    def load(self, file: Path) -> None:
        kept = torch.load(file)
        self.net.load_state_dict(kept["net"])
        self.mean.load_state_dict(kept["mean"])
        self.adam.load_state_dict(kept["adam"])
        self.number, self.steps = kept["number"], kept["steps"]


class ByGradient(_Updated):
    """Backwards through the whole drive, the radar included.

    The first updates take few worlds, from which most is learnt for the steps they cost; the rest
    takes more, which ends better.

    What a robot's state passes on to the step before is at most 1 long, since derivatives through
    many steps of a robot that bounces off a box grow without bound.
    """

    few, first = 4, 150  # worlds of so many first updates

    def gradient(self, seed: int) -> int:
        count = self.few if self.number < self.first else self.worlds
        worlds = driving.random_worlds(count, derive_seed(seed, 0))
        shown = driving.smooth_radar(worlds)
        found = driving.drive(worlds, shown, self.net, derive_seed(seed, 1), speckle=True, most=1.0)
        found.cost.sum().backward()  # of the sum, so that the bound counts for each world
        for weight in self.net.parameters():
            assert weight.grad is not None
            weight.grad /= worlds.count
        return found.steps


class ByEvolution(_Updated):
    """Pairs of mirrored random changes of the weights, weighed by the ranks of their losses.

    Source: Salimans et al., "Evolution strategies as a scalable alternative to reinforcement
    learning", 2017.
    """

    worlds = 64
    spread = 0.05

    def gradient(self, seed: int) -> int:
        names = [name for name, _ in self.net.named_parameters()]
        pairs = self.worlds // 2
        random = torch.Generator().manual_seed(derive_seed(seed, 2))
        noise = {
            name: torch.randn((pairs, *p.shape), generator=random, dtype=p.dtype)
            for name, p in self.net.named_parameters()
        }
        changed = {
            name: p.detach() + self.spread * torch.cat([noise[name], -noise[name]])
            for name, p in self.net.named_parameters()
        }

        def one(weights: dict[str, Tensor], given: Tensor) -> Tensor:
            return torch.func.functional_call(self.net, weights, (given[None],))[0]

        worlds = driving.random_worlds(pairs, derive_seed(seed, 0))
        worlds = worlds.chosen([*range(pairs), *range(pairs)])  # both of a pair drive in one
        with torch.no_grad():
            found = driving.drive(
                worlds,
                driving.smooth_radar(worlds),
                lambda given: torch.func.vmap(one)(changed, given),
                derive_seed(seed, 1),
                speckle=True,
            )
        ranks = found.cost.argsort().argsort().double() / (self.worlds - 1) - 0.5
        weight = (ranks[:pairs] - ranks[pairs:]) / (self.worlds * self.spread)
        for name, p in zip(names, self.net.parameters(), strict=True):
            p.grad = torch.tensordot(weight, noise[name], dims=1)
        return found.steps


class ByPPO(Learner):
    """Proximal policy optimisation of stable-baselines3, with its own settings.

    Rewards are less what a step adds to the loss. The actor has the same network and starts from
    the same weights, the critic one more of its kind.
    """

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        import proximal  # an optional dependency, which the other learners do without

        self.model: Any = proximal.model(seed)

    def advance(self) -> None:
        # One rollout; the library counts the steps of all robots.
        each = self.model.n_steps * self.model.n_envs
        self.model.learn(each, reset_num_timesteps=False)
        self.steps = self.model.num_timesteps

    def command(self, given: Tensor) -> Tensor:
        with torch.no_grad():
            return self.model.policy.get_distribution(given.float()).mode().double()

    def save(self, file: Path) -> None:
        with replace_file(file) as part:
            kept = {
                "policy": self.model.policy.state_dict(),
                "adam": self.model.policy.optimizer.state_dict(),
                "steps": self.steps,
            }
            torch.save(kept, part)

    def load(self, file: Path) -> None:
        kept = torch.load(file)
        self.model.policy.load_state_dict(kept["policy"])
        self.model.policy.optimizer.load_state_dict(kept["adam"])
        self.steps = self.model.num_timesteps = kept["steps"]
        # Robots start anew, in worlds that they have not seen.
        self.model.env.restart(self.steps)


Policy = Callable[[Tensor], Tensor]
