"""A twin of a room from unlabelled recordings: where its walls and its cabinet are, and of what.

For every recording somebody stands somewhere. The smooth map of a person at every place of a grid
is predicted, mirror images included, and compared with the recording; the score of a room is how
well the best places explain all recordings. It is differentiable by the room through the paths.
"""

import math
from dataclasses import dataclass, fields, replace

import torch
from rooms import GRID, RADAR, Room, inside, scene_of
from torch import Tensor

from invertwin.channel import trace_paths
from invertwin.constants import SPEED_OF_LIGHT

STEP = 0.35  # of the grid of places [m]
RANGE_BLUR, U_BLUR = 0.35, 0.06  # standard deviations: a person is no point [m], [1]
SHARPNESS = 40.0  # of the choice of a place
POOLED = 3
CHANNELS = 0.07  # standard deviation of the beam of the eight receivers in u
"""The two transmitters narrow it further; a person is wider than that."""
STEPS, RATE = 60, 0.03


@dataclass(frozen=True)
class Fit:
    """A twin and how it was found.

    Attributes:
        room: The twin.
        score: Mean correlation of the recordings with their best places.
    """

    room: Room
    score: float


def places_in(room: Room) -> Tensor:
    """A grid over what the radar can see [place, 2].

    Args:
        room: Its bounds.
    """
    x = torch.arange(1.3, 6.6, STEP, dtype=torch.float64)
    y = torch.arange(-2.8, 2.81, STEP, dtype=torch.float64)
    both = torch.cartesian_prod(x, y)
    with torch.no_grad():
        return both[inside(room, both)]


def predicted(room: Room, places: Tensor, blur: float = 1.0) -> Tensor:
    """Smooth maps of a person at some places [place, range, u], pooled; times range⁴.

    Args:
        room: Differentiable.
        places: [place, 2].
        blur: Of directions and ranges, over that of a person.
    """
    points = torch.cat([places, torch.zeros(len(places), 1, dtype=torch.float64)], dim=1)
    wave = float(RADAR.link().wavelength)
    legs = trace_paths(
        scene_of(room), [0.0, 0.0, 0.0], points, SPEED_OF_LIGHT / wave, depth=1, rays=None
    )
    out, home = torch.nonzero(legs.rx[:, None] == legs.rx).unbind(1)
    pattern = legs.departure[:, 0].clamp_min(0)  # of transmitter and receiver, both cos
    power = legs.coefficient.abs().square().sum((1, 2)) * pattern
    both = power[out] * power[home]
    ranges = 0.5 * SPEED_OF_LIGHT * (legs.delay[out] + legs.delay[home])
    u = 0.5 * (legs.departure[out, 1] + legs.departure[home, 1])
    bins, directions = pooled_axes()
    near = torch.exp(-0.5 * ((ranges[:, None] - bins) / (blur * RANGE_BLUR)) ** 2)
    wide = blur * math.hypot(U_BLUR, CHANNELS)
    beam = torch.exp(-0.5 * ((u[:, None] - directions) / wide) ** 2)
    maps = torch.zeros(len(places), len(bins), len(directions), dtype=torch.float64)
    parts = both[:, None, None] * near[:, :, None] * beam[:, None, :]
    maps = maps.index_add(0, legs.rx[out], parts)
    return maps * bins[:, None] ** 4


def pooled_axes() -> tuple[Tensor, Tensor]:
    """Ranges and directions of pooled bins."""
    rows, columns = (count // POOLED * POOLED for count in GRID.shape[:2])
    return (
        GRID.ranges[:rows].reshape(-1, POOLED).mean(1),
        GRID.u[:columns].reshape(-1, POOLED).mean(1),
    )


def observed(maps: Tensor) -> Tensor:
    """Recordings as the fit compares them: pooled, times range⁴.

    Args:
        maps: Power [sample, range, u].
    """
    power = maps * GRID.ranges[:, None] ** 4
    return torch.nn.functional.avg_pool2d(power[:, None], POOLED)[:, 0]


def score(room: Room, seen: Tensor, blur: float = 1.0) -> Tensor:
    """How well a room explains recordings, at most 1.

    Args:
        room: Differentiable.
        seen: From ``observed``.
        blur: See ``predicted``.
    """
    maps = predicted(room, places_in(room), blur)

    def level(power: Tensor) -> Tensor:
        flat = (power + 1e-30).sqrt().flatten(1)
        return flat / flat.norm(dim=1, keepdim=True)

    alike = level(seen) @ level(maps).T
    return (torch.logsumexp(SHARPNESS * alike, dim=1) / SHARPNESS).mean()


def fitted(maps: Tensor, start: Room) -> Fit:
    """The twin of the room of some recordings.

    Each wall is looked for by itself, then the cabinet, then all again together by steps of Adam.

    Args:
        maps: Power [sample, range, u], unlabelled.
        start: A room to begin with.
    """
    seen, room = observed(maps), start
    scans = {
        "left": -torch.arange(1.5, 3.31, 0.15, dtype=torch.float64),
        "right": torch.arange(1.5, 3.31, 0.15, dtype=torch.float64),
        "back": torch.arange(4.7, 7.11, 0.2, dtype=torch.float64),
    }
    spots = torch.cartesian_prod(
        torch.arange(2.0, 3.61, 0.4, dtype=torch.float64),
        torch.tensor([-0.8, -0.5, -0.2, 0.2, 0.5, 0.8], dtype=torch.float64),
    )
    with torch.no_grad():
        for _ in range(2):
            for name, values in scans.items():
                tried = [replace(room, **{name: value}) for value in values]
                room = max(tried, key=lambda other: float(score(other, seen, 1.3)))
            tried = [replace(room, cabinet=spot) for spot in spots]
            room = max(tried, key=lambda other: float(score(other, seen)))
    values = {item.name: getattr(room, item.name).clone() for item in fields(Room)}
    values["permittivity"] = values["permittivity"].log()
    for value in values.values():
        value.requires_grad_()
    adam = torch.optim.Adam(list(values.values()), RATE)
    plan = torch.optim.lr_scheduler.CosineAnnealingLR(adam, STEPS)
    best, most = room, -math.inf
    for _ in range(STEPS):
        now = Room(**values | {"permittivity": values["permittivity"].exp()})
        found = score(now, seen)
        if float(found.detach()) > most:
            most = float(found.detach())
            best = Room(**{item.name: getattr(now, item.name).detach() for item in fields(Room)})
        adam.zero_grad()
        (-found).backward()
        adam.step()
        plan.step()
    return Fit(best, most)
