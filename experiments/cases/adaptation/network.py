"""A small network from maps to where people are and how they hold themselves; ways to adapt it."""

import copy
from collections.abc import Sequence

import torch
from rooms import GRID, POSTURES, Samples
from torch import Tensor, nn

POOLED = 3
REFERENCE = 1e-9  # received over transmitted power times range⁴ [m⁴] that a map shows as ln 2
RATE, BATCH = 3e-3, 32
TENT_RATE, TENT_STEPS = 1e-3, 20


def shown(maps: Tensor) -> Tensor:
    """What the network gets of maps: pooled, by the logarithm, with coordinates [sample, 3, …].

    Args:
        maps: Power [sample, range, u].
    """
    power = maps * GRID.ranges[:, None] ** 4 / REFERENCE
    level = (1 + nn.functional.avg_pool2d(power[:, None], POOLED)).log().float() * 0.3
    rows, columns = level.shape[-2:]
    where = torch.meshgrid(
        torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij"
    )
    return torch.cat([level, torch.stack(where).expand(len(maps), -1, -1, -1)], dim=1)


class Finder(nn.Module):
    """Place [m] and scores of the postures, from maps."""

    def __init__(self) -> None:
        """Draw the weights."""
        super().__init__()
        layers: list[nn.Module] = []
        for before, after, stride in ((3, 16, 1), (16, 24, 2), (24, 32, 2), (32, 32, 1)):
            layers += [
                nn.Conv2d(before, after, 3, stride, 1, bias=False),
                nn.BatchNorm2d(after),
                nn.ReLU(),
            ]
        self.trunk = nn.Sequential(*layers, nn.Flatten())
        with torch.no_grad():
            empty = torch.zeros(1, *GRID.shape[:2])
            width = self.trunk(shown(empty)).shape[1]
        self.head = nn.Sequential(nn.Linear(width, 64), nn.ReLU(), nn.Linear(64, 2 + len(POSTURES)))

    def forward(self, given: Tensor) -> tuple[Tensor, Tensor]:
        """Places [sample, 2] and scores [sample, posture].

        Args:
            given: From ``shown``.
        """
        found = self.head(self.trunk(given))
        return found[:, :2] * 2 + torch.tensor([3.5, 0.0]), found[:, 2:]


def joined(parts: Sequence[Samples]) -> Samples:
    """All samples of some.

    Args:
        parts: One or several.
    """
    rows = zip(*(vars(part).values() for part in parts), strict=True)
    return Samples(*(torch.cat(row) for row in rows))


def trained(samples: Samples, seed: int, rounds: int, start: Finder | None = None) -> Finder:
    """A network after some rounds through labelled samples, at a rate that falls to zero.

    Args:
        samples: With labels.
        seed: Of weights and order.
        rounds: Through all samples.
        start: Where to go on; None = random weights.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = Finder() if start is None else copy.deepcopy(start)
        given, count = shown(samples.maps), len(samples.maps)
        adam = torch.optim.Adam(net.parameters(), RATE, weight_decay=1e-4)
        plan = torch.optim.lr_scheduler.CosineAnnealingLR(adam, rounds * (count // BATCH))
        net.train()
        for _ in range(rounds):
            for rows in torch.randperm(count)[: count // BATCH * BATCH].split(BATCH):
                place, score = net(given[rows])
                loss = nn.functional.smooth_l1_loss(place, samples.places[rows].float())
                loss = loss + 0.3 * nn.functional.cross_entropy(score, samples.postures[rows])
                adam.zero_grad()
                loss.backward()
                adam.step()
                plan.step()
    return net.eval()


def with_statistics(start: Finder, maps: Tensor) -> Finder:
    """Batch normalisation by the statistics of unlabelled maps.

    Args:
        start: The network.
        maps: Of the new room.
    """
    net = copy.deepcopy(start).train()
    for layer in net.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.reset_running_stats()
            layer.momentum = None  # the plain mean
    with torch.no_grad():
        net(shown(maps))
    return net.eval()


def least_entropy(start: Finder, maps: Tensor) -> Finder:
    """TENT: scales and shifts of the normalisation by the entropy of the postures.

    Source: Wang et al., "Tent: Fully test-time adaptation by entropy minimization", ICLR 2021.

    Args:
        start: The network.
        maps: Unlabelled, of the new room.
    """
    net = with_statistics(start, maps).train()
    norms = [layer for layer in net.modules() if isinstance(layer, nn.BatchNorm2d)]
    adam = torch.optim.Adam([p for layer in norms for p in layer.parameters()], TENT_RATE)
    given = shown(maps)
    for _ in range(TENT_STEPS):
        chance = net(given)[1].softmax(dim=-1)
        loss = -(chance * (chance + 1e-9).log()).sum(-1).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    return net.eval()


@torch.no_grad()
def errors(net: Finder, samples: Samples) -> tuple[float, float]:
    """Median distance from the true place [m], and the share of right postures.

    Args:
        net: The network.
        samples: With labels.
    """
    place, score = net(shown(samples.maps))
    off = (place.double() - samples.places).norm(dim=-1)
    return float(off.median()), float((score.argmax(-1) == samples.postures).double().mean())
