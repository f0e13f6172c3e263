"""A twin of a room from unlabelled recordings: where its walls and its cabinet are, and of what.

For every recording somebody stands somewhere. The smooth map of a person at every place of a grid
is predicted, mirror images included, and compared with the recording; the score of a room is how
well the best places explain all recordings. It is differentiable by the room through the paths.
"""

import math
from collections.abc import Callable
from dataclasses import fields, replace

import torch
from rooms import GRID, RADAR, Room, inside, scene_of
from torch import Tensor

from invertwin.channel import trace_paths
from invertwin.constants import SPEED_OF_LIGHT

STEP = 0.35  # of the grid of places [m]
RANGE_BLUR = 0.12  # standard deviation of the main lobe of a range bin [m]
SPREAD = 0.18 * torch.tensor([[0.0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=torch.float64)
"""Parts of a person, who is no point [m]."""
SHARPNESS = 40.0  # of the choice of a place
POOLED = 3
CONTRAST = 30.0  # of logarithmic maps: ghosts 15 dB below the strongest bin still count
STEPS, RATE = 40, 0.01


START = Room(
    right=torch.tensor(-2.4, dtype=torch.float64),
    left=torch.tensor(2.4, dtype=torch.float64),
    back=torch.tensor(5.9, dtype=torch.float64),
    permittivity=torch.full((3,), 20.0, dtype=torch.float64),
    cabinet=torch.tensor([2.8, 0.5], dtype=torch.float64),
)
"""In the middle of what rooms may be."""


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
        blur: Of ranges, over that of the radar.
    """
    parts = (places[:, None] + SPREAD).flatten(0, 1)
    points = torch.cat([parts, torch.zeros(len(parts), 1, dtype=torch.float64)], dim=1)
    wave = float(RADAR.link().wavelength)
    legs = trace_paths(
        scene_of(room), [0.0, 0.0, 0.0], points, SPEED_OF_LIGHT / wave, depth=1, rays=None
    )
    out, home = torch.nonzero(legs.rx[:, None] == legs.rx).unbind(1)
    pattern = legs.departure[:, 0].clamp_min(0)  # of transmitter and receiver, both cos
    power = legs.coefficient.abs().square().sum((1, 2)) * pattern
    both = power[out] * power[home]
    ranges = 0.5 * SPEED_OF_LIGHT * (legs.delay[out] + legs.delay[home])
    bins, directions = pooled_axes()
    near = torch.exp(-0.5 * ((ranges[:, None] - bins) / (blur * RANGE_BLUR)) ** 2)
    beam = _beam(legs.departure[out, 1], legs.departure[home, 1], directions)
    maps = torch.zeros(len(places), len(bins), len(directions), dtype=torch.float64)
    rows = both[:, None, None] * near[:, :, None] * beam[:, None, :]
    maps = maps.index_add(0, legs.rx[out] // len(SPREAD), rows)
    return maps * bins[:, None] ** 4


def _beam(sent: Tensor, received: Tensor, directions: Tensor) -> Tensor:
    """Power of the array for waves that leave and arrive along some directions [path, u]."""
    tx, rx = RADAR.transmitters.positions[:, 1], RADAR.receivers.positions[:, 1]
    taper = torch.hamming_window(len(tx) * len(rx), periodic=False, dtype=torch.float64)
    turns = 2 * math.pi / float(RADAR.link().wavelength)
    phase = sent[:, None] * tx.repeat_interleave(len(rx))
    phase = turns * (phase + received[:, None] * rx.repeat(len(tx)))
    steer = turns * directions[:, None] * (tx[:, None] + rx).flatten()
    field = (
        torch.polar(taper.expand_as(phase), phase) @ torch.polar(torch.ones_like(steer), -steer).T
    )
    return field.abs().square() / taper.sum() ** 2


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
        flat = power.flatten(1)
        shown = (1 + CONTRAST * flat / flat.amax(1, keepdim=True)).log()
        return shown / shown.norm(dim=1, keepdim=True)

    alike = level(seen) @ level(maps).T
    return (torch.logsumexp(SHARPNESS * alike, dim=1) / SHARPNESS).mean()


def fitted(maps: Tensor, start: Room = START) -> Room:
    """The twin of the room of some recordings.

    Walls, cabinet and permittivities are looked for one after the other, twice, at first in large
    steps; then all together by the derivative of the score.

    Args:
        maps: Power [sample, range, u], unlabelled.
        start: A room to begin with.
    """
    seen, room = observed(maps), start
    with torch.no_grad():
        for near in (False, True):
            for tried in _tries(near):
                others = [room, *tried(room)]
                room = max(others, key=lambda other: float(score(other, seen)))
    return _polished(room, seen)


def _tries(near: bool) -> list[Callable[[Room], list[Room]]]:
    """What is tried of every value: everywhere, or near the present one."""
    small = torch.tensor([-0.12, -0.06, 0.06, 0.12], dtype=torch.float64)

    def line(name: str, low: float, high: float) -> Callable[[Room], list[Room]]:
        def tried(now: Room) -> list[Room]:
            grid = torch.arange(low, high, 0.15, dtype=torch.float64)
            values = getattr(now, name) + small if near else grid
            return [replace(now, **{name: value}) for value in values]

        return tried

    def spots(now: Room) -> list[Room]:
        if near:
            steps = torch.tensor([-0.2, -0.1, 0.0, 0.1, 0.2], dtype=torch.float64)
            return [
                replace(now, cabinet=now.cabinet + o) for o in torch.cartesian_prod(steps, steps)
            ]
        x = torch.arange(2.0, 3.61, 0.4, dtype=torch.float64)
        y = torch.tensor([-0.8, -0.5, -0.2, 0.2, 0.5, 0.8], dtype=torch.float64)
        return [replace(now, cabinet=spot) for spot in torch.cartesian_prod(x, y)]

    def wall(number: int) -> Callable[[Room], list[Room]]:
        def tried(now: Room) -> list[Room]:
            found = []
            for factor in (0.25, 0.5, 2.0, 4.0):
                values = now.permittivity.clone()
                values[number] *= factor
                found.append(replace(now, permittivity=values))
            return found

        return tried

    lines = [line("back", 4.7, 7.15), line("right", -3.3, -1.45), line("left", 1.5, 3.35)]
    return [*lines, spots, *(wall(number) for number in range(3))]


def _polished(room: Room, seen: Tensor) -> Room:
    """A room after steps of Adam, the best on the way."""
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
    return best
