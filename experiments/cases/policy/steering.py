"""The network of the robots: from what the radar shows and where the goal is to thrust and turn."""

import torch
from driving import POOLED, bins
from torch import Tensor


class Steering(torch.nn.Module):
    """Looks along every direction with the same weights, and turns to where it is best to go.

    It scores the directions of the map, with how near they are to that of the goal; what it sees in
    the best ones decides on thrust and turn.
    """

    def __init__(self, width: int = 24) -> None:
        """Draw the weights.

        Args:
            width: Features of every direction.
        """
        super().__init__()
        grid, (deep, wide) = bins(), POOLED
        self.shape = grid.range_count // deep, grid.u_count // wide
        directions = grid.u[: self.shape[1] * wide].reshape(-1, wide).mean(-1)
        self.directions: Tensor
        self.register_buffer("directions", directions)
        self.trunk = torch.nn.Sequential(
            torch.nn.Conv1d(self.shape[0] + 6, width, 5, padding=2),
            torch.nn.Tanh(),
            torch.nn.Conv1d(width, width, 5, padding=2),
            torch.nn.Tanh(),
        )
        self.score = torch.nn.Conv1d(width, 1, 1)
        self.head = torch.nn.Linear(width + 5, 2)

    def seen(self, given: Tensor) -> Tensor:
        """Features of where it is best to go, with that direction and the robot's own inputs.

        Args:
            given: From ``inputs`` [world, input].
        """
        own = given[:, -4:]
        ahead, left, _, _ = own.unbind(-1)
        power = given[:, :-4].unflatten(1, self.shape)
        u = self.directions.to(given).expand(len(given), 1, -1)
        # A goal behind is at the side to which the way is shorter.
        aim = torch.where(ahead > 0, left, torch.sign(left))[:, None, None]
        off = u - aim
        spread = torch.cat([off, off.abs(), u], dim=1)
        rest = own[:, [0, 2, 3], None].expand(-1, -1, u.shape[-1])
        features = self.trunk(torch.cat([power, spread, rest], dim=1))
        weight = (self.score(features) * 4 - 3 * off.abs()).softmax(dim=-1)
        return torch.cat([(weight * features).sum(-1), (weight * u).sum(-1), own], dim=-1)

    def forward(self, given: Tensor) -> Tensor:
        """Thrust and turn [world, 2].

        Args:
            given: From ``inputs`` [world, input].
        """
        return self.head(self.seen(given))


def policy(seed: int, share: float = 0.1) -> Steering:
    """A small network with random weights.

    Args:
        seed: Of its weights.
        share: How much the radar sways its commands.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = Steering().double()
    with torch.no_grad():
        net.head.weight *= share
        net.head.bias[0] = 0.5  # drives on, and turns to the best direction: that of the goal
        net.head.weight[1, -5] += 3.0
    return net
