"""A robot with a radar on board among boxes: worlds, motion, what the radar shows, and the loss.

Many worlds are one scene: they stand so far apart that all echoes of another world lie beyond the
last range bin. Every robot is one frame of one radar, so that a single trace serves all worlds, and
its derivative by the radar's poses serves all robots.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

import invertwin as iw
from invertwin.channel import Speckle, draw_speckle
from invertwin.radar.aperture import aperture
from invertwin.radar.signal.range_profile import range_profile
from invertwin.scene import Cosine, Mesh, RoughDielectric, box, linear_array
from invertwin.seeds import derive_seed

STEPS = 24
INTERVAL = 0.3  # [s] of one step
RADIUS = 0.2  # of the robot [m]
ARRIVED = 0.4  # distance at which the goal counts as reached [m]
THRUST, DRAG, TURN = 3.0, 2.0, 1.6  # [m/s²], [1/s], [rad/s]: 1.5 m/s at most
SPACING = 40.0  # of worlds [m]
HEIGHT = 1.2  # of boxes [m]
MARGIN, SOFTNESS = 0.2, 0.07  # of the clearance in the loss [m]
CLEARANCE_WEIGHT, EFFORT_WEIGHT = 4.0, 0.005
PAINT = RoughDielectric(permittivity=4.0)


@dataclass(frozen=True)
class Worlds:
    """Some worlds, each in coordinates of its own.

    Attributes:
        centres: Of the boxes [world, box, 2] [m].
        halves: Half their sides [world, box, 2] [m].
        yaws: How they are turned [world, box] [rad].
        gap: The middle of the gap in the wall [world, 2] [m].
        goal: Where to go [world, 2] [m].
        start: x, y, heading and speed of the robot [world, 4].
    """

    centres: Float64[Tensor, "world box 2"]
    halves: Float64[Tensor, "world box 2"]
    yaws: Float64[Tensor, "world box"]
    gap: Float64[Tensor, "world 2"]
    goal: Float64[Tensor, "world 2"]
    start: Float64[Tensor, "world 4"]

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.goal)

    def chosen(self, rows: list[int]) -> "Worlds":
        """Some of the worlds.

        Args:
            rows: Their numbers.
        """
        return Worlds(*(value[rows] for value in vars(self).values()))

    def replaced(self, rows: Int64[Tensor, " row"], others: "Worlds") -> "Worlds":
        """These worlds, with others in some places.

        Args:
            rows: The places.
            others: As many worlds.
        """
        pairs = zip(vars(self).values(), vars(others).values(), strict=True)
        return Worlds(*(value.index_copy(0, rows, other) for value, other in pairs))


def random_worlds(count: int, seed: int) -> Worlds:
    """A wall with a gap, a box on the way to the gap and one on the way from it to the goal.

    Args:
        count: How many.
        seed: Of all of them.
    """
    random = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=random, dtype=torch.float64)

    def pair(x: Tensor, y: Tensor) -> Tensor:
        return torch.stack([x, y], dim=-1)

    start = torch.stack(
        [torch.zeros(count), between(-0.8, 0.8), between(-0.3, 0.3), between(0.2, 0.8)], dim=-1
    )
    gap = pair(between(3.2, 4.0), between(-1.4, 1.4))
    goal = pair(between(7.0, 7.6), between(-1.5, 1.5))
    thick, half_gap, end = between(0.1, 0.2), between(0.6, 0.8), torch.full((count,), 3.5)
    boxes: list[tuple[Tensor, Tensor, Tensor]] = []
    for side in (-1.0, 1.0):
        inner, outer = gap[:, 1] + side * half_gap, side * end
        middle = pair(gap[:, 0], 0.5 * (inner + outer))
        boxes.append((middle, pair(thick, 0.5 * (outer - inner).abs()), torch.zeros(count)))
    for begin, stop, share in ((start[:, :2], gap, (0.4, 0.5)), (gap, goal, (0.5, 0.6))):
        place = begin + between(*share)[:, None] * (stop - begin)
        aside = pair(torch.zeros(count, dtype=torch.float64), between(-0.9, 0.9))
        boxes.append(
            (place + aside, pair(between(0.2, 0.3), between(0.2, 0.3)), between(-0.8, 0.8))
        )
    centres, halves, yaws = (torch.stack(part, dim=1).double() for part in zip(*boxes, strict=True))
    return Worlds(centres, halves, yaws, gap, goal, start)


def origins(count: int) -> Float64[Tensor, "world 2"]:
    """Where the worlds stand in the scene, on a square lattice about zero [m].

    Args:
        count: Of worlds.
    """
    side = math.ceil(count**0.5)
    number = torch.arange(count)
    rows = torch.stack([number % side, number // side], dim=-1)
    return SPACING * (rows.double() - 0.5 * (side - 1))


def scene_of(worlds: Worlds) -> iw.Scene:
    """All boxes of all worlds as one object.

    Args:
        worlds: The worlds.
    """
    unit = box((2.0, 2.0, HEIGHT))
    c, s = worlds.yaws.cos()[..., None], worlds.yaws.sin()[..., None]
    flat = unit.vertices[:, :2] * worlds.halves[:, :, None]
    x, y = flat[..., 0], flat[..., 1]
    turned = torch.stack([c * x - s * y, s * x + c * y], dim=-1)
    place = turned + (worlds.centres + origins(worlds.count)[:, None])[:, :, None]
    height = (unit.vertices[:, 2] + 0.5 * HEIGHT).expand(place.shape[:-1])[..., None]
    vertices = torch.cat([place, height], dim=-1).reshape(-1, 3)
    shift = torch.arange(worlds.yaws.numel()) * len(unit.vertices)
    faces = (unit.faces[None] + shift[:, None, None]).reshape(-1, 3)
    return iw.Scene({"boxes": iw.Object(Mesh(vertices, faces), PAINT)})


def radar_at(state: Float64[Tensor, "world 4"]) -> iw.Radar:
    """The radars of all robots, one a frame, looking ahead.

    Args:
        state: Of the robots.
    """
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=0.5e9, duration=20e-6, samples=64)
    half, patch = chirp.wavelength / 2, Cosine(1.0)
    tx = linear_array(2, 8 * half, pattern=patch)
    rx = linear_array(8, half, pattern=patch)
    x, y, heading, _ = state.unbind(-1)
    c, s, zero = heading.cos(), heading.sin(), torch.zeros_like(heading)
    left, up = torch.stack([-s, c, zero], -1), torch.stack([zero, zero, zero + 1], -1)
    axes = torch.stack([torch.stack([c, s, zero], -1), left, up], dim=-1)
    place = torch.stack([x, y], -1) + origins(len(state))
    position = torch.cat([place, zero[:, None] + 0.5 * HEIGHT], dim=-1)
    return iw.Radar(tx, rx, chirp, position, axes)


def bins() -> iw.Grid:
    """What the robot looks at: up to 5 m ahead."""
    still = torch.zeros(1, 4, dtype=torch.float64)
    return radar_at(still).grid(range_min=0.3, range_max=4.9, u_max=0.78)


def moved(
    state: Float64[Tensor, "world 4"], command: Float64[Tensor, "world 2"]
) -> Float64[Tensor, "world 4"]:
    """One step of a unicycle with drag: thrust and rate of turn saturate by tanh.

    Args:
        state: x, y [m], heading [rad] and speed [m/s].
        command: Thrust and turn, any numbers.
    """
    x, y, heading, speed = state.unbind(-1)
    thrust, turn = command.tanh().unbind(-1)
    faster = speed + INTERVAL * (THRUST * thrust - DRAG * speed)
    turned = heading + INTERVAL * TURN * turn
    way = 0.5 * INTERVAL * (speed + faster)
    middle = 0.5 * (heading + turned)
    return torch.stack([x + way * middle.cos(), y + way * middle.sin(), turned, faster], dim=-1)


def clearance(
    worlds: Worlds, place: Float64[Tensor, "world point 2"]
) -> Float64[Tensor, "world point box"]:
    """Signed distance from the robot's hull to every box; below zero it touches [m].

    Args:
        worlds: The worlds.
        place: Of the robot's middle, some in each world.
    """
    c, s = worlds.yaws.cos()[:, None], worlds.yaws.sin()[:, None]
    x, y = (place[:, :, None] - worlds.centres[:, None]).unbind(-1)
    local = torch.stack([c * x + s * y, c * y - s * x], dim=-1)
    beyond = local.abs() - worlds.halves[:, None]
    outside = (beyond.clamp_min(0).square().sum(-1) + 1e-12).sqrt()
    return outside + beyond.amax(-1).clamp_max(0) - RADIUS


def way_left(worlds: Worlds, place: Float64[Tensor, "world 2"]) -> Float64[Tensor, " world"]:
    """Length of the way to the goal: through the gap, as long as the robot is before the wall [m].

    Args:
        worlds: The worlds.
        place: Of the robots.
    """
    # Sideways counts double, so that robots line up with the gap early.
    aside = torch.tensor([1.0, 2.0], dtype=torch.float64)
    to_gap = (((place - worlds.gap) * aside).square().sum(-1) + 1e-4).sqrt()
    on = (worlds.gap - worlds.goal).norm(dim=-1)
    direct = ((place - worlds.goal).square().sum(-1) + 1e-4).sqrt()
    past = torch.sigmoid((place[:, 0] - worlds.gap[:, 0]) / 0.1)
    return (1 - past) * (to_gap + on) + past * direct


@dataclass(frozen=True)
class Step:
    """What one step did.

    Attributes:
        state: Afterwards.
        cost: Its part of the loss; a reward is less this.
        touched: Whether the robot met a box on the way.
        arrived: Whether it is at the goal.
    """

    state: Float64[Tensor, "world 4"]
    cost: Float64[Tensor, " world"]
    touched: Bool[Tensor, " world"]
    arrived: Bool[Tensor, " world"]


def step(worlds: Worlds, state: Tensor, command: Tensor) -> Step:
    """Move all robots.

    Args:
        worlds: Where they are.
        state: Of the robots [world, 4].
        command: Thrust and turn [world, 2].
    """
    after = moved(state, command)
    shares = torch.tensor([1 / 3, 2 / 3, 1.0], dtype=torch.float64)[:, None]
    begin, end = state[:, None, :2], after[:, None, :2]
    gaps = clearance(worlds, begin + shares * (end - begin))
    near = SOFTNESS * torch.nn.functional.softplus((MARGIN - gaps) / SOFTNESS)
    cost = way_left(worlds, after[:, :2]) - way_left(worlds, state[:, :2])
    cost = cost + CLEARANCE_WEIGHT * near.sum(-1).mean(-1)
    cost = cost + EFFORT_WEIGHT * command.square().sum(-1)
    arrived = (after[:, :2] - worlds.goal).norm(dim=-1) < ARRIVED
    return Step(after, cost, (gaps < 0).flatten(1).any(1), arrived.detach())


Shown = Callable[[Tensor, int], Tensor]
"""Power spectra [world, range, u] of the robots' radars, by their states and a seed."""


@dataclass(frozen=True, eq=False)
class SmoothRadar:
    """The radars by the smooth model, differentiable by where the robots are.

    Attributes:
        scene: Of all worlds.
        model: The smooth model.
    """

    scene: iw.Scene
    model: iw.SurrogateMap

    def __call__(self, state: Tensor, seed: int) -> Tensor:
        """See ``Shown``."""
        return self.model.predict(self.scene, radar_at(state), seed)[..., 0].double()


def smooth_radar(worlds: Worlds, samples: int = 2000, *, boundary: bool = True) -> SmoothRadar:
    """The smooth model of worlds.

    Args:
        worlds: The worlds.
        samples: Rays for each robot; an eighth as many on the silhouettes that it sees.
        boundary: False holds visibility fixed in derivatives.
    """
    count = samples * worlds.count
    sampling = iw.Sampling(
        depth=1, samples=count, boundary_samples=count // 8, boundary=boundary, contacts=False
    )
    return SmoothRadar(scene_of(worlds), iw.SurrogateMap(bins(), sampling=sampling))


@dataclass(frozen=True, eq=False)
class ExactRadar:
    """One radar by the exact chain: coherent signals of rough points, with noise.

    Attributes:
        scene: Of one world.
        speckle: Rough points with their phases, which stay while the robot drives.
    """

    scene: iw.Scene
    speckle: Speckle

    def __call__(self, state: Tensor, seed: int) -> Tensor:
        """See ``Shown``."""
        found = iw.simulate(
            self.scene,
            radar_at(state),
            bins(),
            seed=seed,
            sampling=EXACT,
            speckle=self.speckle,
            snr_db=SNR_DB,
        )
        return found.spectrum[..., 0]


EXACT = iw.Sampling(depth=1, points_per_m2=400.0, boundary=False)
SNR_DB = 20.0  # of samples


def exact_radar(world: Worlds, seed: int) -> ExactRadar:
    """The exact chain in one world.

    Args:
        world: A single one.
        seed: Of the rough points.
    """
    scene = scene_of(world)
    link = radar_at(world.start).link()
    return ExactRadar(scene, draw_speckle(scene, link, EXACT, seed))


@functools.cache
def _cells() -> tuple[Tensor, Tensor, float, float]:
    """How the radar makes bins of its samples.

    Returns:
        Range profiles of single samples [sample, range], beams [u, element], the mean power of a
        bin for unit white noise, and how many bins make up all samples, those not shown included.
    """
    grid, count = bins(), 64
    radar = radar_at(torch.zeros(count, 4, dtype=torch.float64))
    single = torch.eye(count, dtype=torch.complex128)[:, None, None].expand(
        -1, *radar.shape[1:], -1
    )
    profile = range_profile(single, radar, grid)[:, 0, 0]
    _, y, z = radar.virtual_positions.unbind(-1)
    array = aperture(radar)
    beams = array.beams(grid.u, grid.v, y, z) * array.weight
    mean = float(profile.abs().square().sum(0).mean() * beams.abs().square().sum(1).mean())
    return profile, beams, mean, radar.waveform.max_range / grid.range_step * 2 / grid.u_step


def fluctuating(power: Tensor, random: torch.Generator) -> Tensor:
    """Power as one recording shows it, with speckle and thermal noise.

    The field of many rough points, and noise, is complex normal. Neighbouring bins share a cell, so
    it is what the radar makes of white noise, times the root of the mean power.

    Args:
        power: Mean spectra [world, range, u].
        random: Draws.
    """
    profile, beams, mean, count = _cells()
    shape = len(power), len(profile), beams.shape[1]
    white = torch.randn(shape, generator=random, dtype=torch.complex128)
    field = torch.einsum("sr,wse,ue->wru", profile, white, beams)
    noise = 10 ** (-SNR_DB / 10) * power.detach().sum((1, 2), keepdim=True) / count
    return (power + noise) * field.abs().square() / mean


REFERENCE = 1e-9
"""Received over transmitted power, times range⁴ [m⁴], that a map shows as ln 2."""
MAP_SCALE = 0.3  # so that inputs are about one
POOLED = 2, 3  # bins of range and direction in one input of the network


def inputs(
    worlds: Worlds, state: Tensor, power: Tensor, speckle: torch.Generator | None = None
) -> Float64[Tensor, "world input"]:
    """What the network sees: its map, the goal in its own axes, and its speed.

    Args:
        worlds: Only their goals are read.
        state: Of the robots [world, 4].
        power: Spectra [world, range, u].
        speckle: Draws the fluctuations that one recording would have; None = none.
    """
    grid = bins()
    if speckle is not None:
        power = fluctuating(power, speckle)
    power = power * grid.ranges[:, None] ** 4 / REFERENCE
    pooled = torch.nn.functional.avg_pool2d(power[:, None], POOLED)[:, 0]
    x, y = (worlds.goal - state[:, :2]).unbind(-1)
    heading = state[:, 2]
    ahead = heading.cos() * x + heading.sin() * y
    left = heading.cos() * y - heading.sin() * x
    distance = (ahead.square() + left.square() + 1e-4).sqrt()
    own = torch.stack([ahead / distance, left / distance, distance / 5, state[:, 3]], dim=-1)
    return torch.cat([(1 + pooled).log().flatten(1) * MAP_SCALE, own], dim=-1)


def inputs_count() -> int:
    """Numbers that the network gets."""
    deep, wide = (count // size for count, size in zip(bins().shape[:2], POOLED, strict=True))
    return deep * wide + 4


def final_distance(
    worlds: Worlds,
    shown: Shown,
    net: Callable[[Tensor], Tensor],
    seed: int,
    first: Tensor,
    steps: int = STEPS // 2,
) -> Float64[Tensor, " world"]:
    """Distance to the goal after some steps; by default before robots arrive [m].

    Args:
        worlds: The worlds.
        shown: What the radars show.
        net: From inputs to commands.
        seed: Of rays.
        first: Added to the first command [world, 2].
        steps: How many.
    """
    state = worlds.start
    for number in range(steps):
        command = net(inputs(worlds, state, shown(state, derive_seed(seed, 0, number))))
        state = moved(state, command + first if number == 0 else command)
    return (state[:, :2] - worlds.goal).norm(dim=-1)


@dataclass(frozen=True)
class Drive:
    """A whole drive, of every world together.

    Attributes:
        cost: Loss of each world.
        states: [time, world, 4], the start first; a robot that has arrived rests.
        success: Reached the goal without touching before.
        steps: Simulated steps of all worlds together.
    """

    cost: Float64[Tensor, " world"]
    states: Float64[Tensor, "time world 4"]
    success: Bool[Tensor, " world"]
    steps: int


def drive(
    worlds: Worlds,
    shown: Shown,
    net: Callable[[Tensor], Tensor],
    seed: int,
    *,
    steps: int = STEPS,
    speckle: bool = False,
    most: float | None = None,
) -> Drive:
    """Let all robots drive, differentiable by the network, until all have arrived.

    Args:
        worlds: The worlds.
        shown: What the radars show.
        net: From inputs to commands.
        seed: Of rays and speckle; the same seed gives the same drive.
        steps: At most.
        speckle: Whether maps fluctuate.
        most: Largest derivative of a world's loss by a state that is passed on to the step before;
            None = all of it.
    """
    state, states = worlds.start, [worlds.start]
    cost = torch.zeros(worlds.count, dtype=torch.float64)
    driving = torch.ones(worlds.count, dtype=torch.bool)
    success, clean = ~driving, driving
    random = torch.Generator().manual_seed(derive_seed(seed, 1)) if speckle else None
    number = 0
    while number < steps and driving.any():
        if most is not None and state.requires_grad:
            state.register_hook(functools.partial(_limited, most))
        power = shown(state, derive_seed(seed, 0, number))
        command = net(inputs(worlds, state, power, random))
        done = step(worlds, state, command)
        cost = cost + torch.where(driving, done.cost, 0.0)
        state = torch.where(driving[:, None], done.state, state)
        clean = clean & ~(driving & done.touched)
        success = success | (driving & done.arrived & clean)
        driving = driving & ~done.arrived
        states.append(state)
        number += 1
    return Drive(cost, torch.stack(states), success, number * worlds.count)


def _limited(most: float, grad: Tensor) -> Tensor:
    norm = grad.norm(dim=-1, keepdim=True)
    return grad * (most / norm.clamp_min(most))
