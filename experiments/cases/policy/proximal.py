"""The simulator as a vectorised environment of stable-baselines3, which is an optional extra."""

# Types are checked without the extra.
# pyright: reportMissingImports=false, reportUntypedBaseClass=false

from typing import Any

import driving
import gymnasium
import numpy as np
import steering
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv

from invertwin.seeds import derive_seed

ROBOTS = 64
FARTHEST = 10.0  # command; tanh has long saturated


class Robots(VecEnv):
    """Robots that drive at once; one that has arrived or run out of time gets a new world."""

    def __init__(self, seed: int) -> None:
        """Draw the first worlds.

        Args:
            seed: Of worlds, rays and speckle.
        """
        self.width = driving.inputs_count()
        seen = gymnasium.spaces.Box(-np.inf, np.inf, (self.width,), np.float32)
        does = gymnasium.spaces.Box(-FARTHEST, FARTHEST, (2,), np.float32)
        self.render_mode = None
        self.origin = seed
        super().__init__(ROBOTS, seen, does)
        self.restart(0)

    def restart(self, number: int) -> None:
        """Put all robots into new worlds.

        Args:
            number: Tells one restart from another.
        """
        self.root, self.clock, self.drawn = derive_seed(self.origin, 4, number), 0, 0
        self.random = torch.Generator().manual_seed(derive_seed(self.root, 0))
        self._place(self._new(ROBOTS))
        self.state = self.worlds.start.clone()
        self.ages = torch.zeros(ROBOTS, dtype=torch.int64)

    def _new(self, count: int) -> driving.Worlds:
        self.drawn += 1
        return driving.random_worlds(count, derive_seed(self.root, 1, self.drawn))

    def _place(self, worlds: driving.Worlds) -> None:
        self.worlds, self.shown = worlds, driving.smooth_radar(worlds, boundary=False)

    def _seen(self) -> np.ndarray:
        self.clock += 1
        power = self.shown(self.state, derive_seed(self.root, 2, self.clock))
        return driving.inputs(self.worlds, self.state, power, self.random).float().numpy()

    def reset(self) -> np.ndarray:
        """Start anew, as every call of ``learn`` may ask."""
        self.restart(self.clock + 1)
        return self._seen()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the commands.

        Args:
            actions: Thrust and turn [robot, 2].
        """
        self.commands = torch.as_tensor(actions, dtype=torch.float64)

    @torch.no_grad()
    def step_wait(self) -> Any:
        """Move all robots: what they see, their rewards, whether they are done, and why."""
        done = driving.step(self.worlds, self.state, self.commands)
        self.state, self.ages = done.state, self.ages + 1
        late = (self.ages >= driving.STEPS) & ~done.arrived
        over = late | done.arrived
        infos: list[dict[str, Any]] = [{} for _ in range(ROBOTS)]
        seen = self._seen() if late.any() or not over.any() else None
        if over.any():
            rows = over.nonzero()[:, 0]
            for row in rows.tolist():
                # Only robots that ran out of time have a future, which the critic estimates.
                infos[row]["TimeLimit.truncated"] = bool(late[row])
                last = np.zeros(self.width, np.float32) if seen is None else seen[row]
                infos[row]["terminal_observation"] = last
            self._place(self.worlds.replaced(rows, self._new(len(rows))))
            self.state[rows], self.ages[rows] = self.worlds.start[rows], 0
            seen = self._seen()
        return seen, -done.cost.float().numpy(), over.numpy(), infos

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same for all robots."""
        return [getattr(self, attr_name)] * ROBOTS

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Nothing is set from outside."""
        raise NotImplementedError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """Nothing is called from outside."""
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No robot is wrapped."""
        return [False] * ROBOTS


class Seen(BaseFeaturesExtractor):
    """What the network sees before its last layer."""

    def __init__(self, observation_space: gymnasium.spaces.Box) -> None:
        """Draw the weights.

        Args:
            observation_space: Of the inputs.
        """
        network = steering.Steering()
        super().__init__(observation_space, network.head.in_features)
        self.steering = network

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """See ``steering.Steering.seen``."""
        return self.steering.seen(observations)


def model(seed: int) -> PPO:
    """PPO with the library's settings but for longer batches, as fits 64 robots.

    Args:
        seed: Of everything.
    """
    learner = PPO(
        ActorCriticPolicy,
        Robots(seed),
        n_steps=2 * driving.STEPS,
        batch_size=256,
        seed=seed,
        device="cpu",
        policy_kwargs={
            "features_extractor_class": Seen,
            "share_features_extractor": False,
            "net_arch": {"pi": [], "vf": [64]},
            "ortho_init": False,
            "log_std_init": -0.5,
        },
    )
    start: Any = steering.policy(seed).state_dict()
    actor: Any = learner.policy
    actor.pi_features_extractor.steering.load_state_dict(start)
    with torch.no_grad():
        actor.action_net.weight.copy_(start["head.weight"])
        actor.action_net.bias.copy_(start["head.bias"])
    return learner
