"""Calibration of a room from a fifth of its links, against a finer world with hidden furniture.

    python benchmarks/measured_rooms.py [-o DIR] [--rooms 8]

The *world* stands for a measurement: three rooms in a row with doors and walls of unknown
materials, twelve pieces of furniture of wood and metal, four transmitters below the ceiling, forty
receivers. Paths meet up to four surfaces or one edge, and eighty scatterers are joined by a
propagation graph, by which the rooms reverberate (Pedersen, Steinböck and Fleury, "Modeling of
reverberant radio channels using propagation graphs", IEEE Transactions on Antennas and Propagation
60(12), 2012; here a bounce leaves g² of the power, not g² over the number of edges). Levels have
errors of 1 dB and a common offset of −4 to 4 dB. Delay spreads are those of the power delay profile
within 25 dB of its peak, as channel sounders state them.

The *twin* knows the walls alone, starts with the middle of the range of each material, and traces
paths that meet up to four surfaces, passed walls included. A fifth of the receivers gives it the
materials, with the ranges as priors, the sent power, and gain and decay of a reverberant tail
(`invertwin.links.ReverberationParameters`). Prints a table and writes
`metrics.json` into DIR (default `out/measured_rooms`). All errors are of the other links:

- `level_ratio`: root mean square error of levels over that of a power law of distance that is
  fitted to the same fifth; `level_error_db` and `power_law_error_db` are the two.
- `spread_factor`: median of the factor, at least 1, between delay spreads of twin and world.
- `before.*`: the same of the twin with a fitted power alone; its levels have a floor, since links
  may be without a path.
- `tails`: gain at distance 0 [dB] and decay [ns] of each world's tail, as found.
"""

import argparse
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from report import MetricTable, Required, write
from torch import Tensor

import invertwin as iw
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.inversion import Optimizer
from invertwin.links import (
    PropagationSettings,
    ReceiverPoints,
    ReverberationParameters,
    Transmitters,
    frequency_response,
)
from invertwin.links.transmitters import FreeSpace
from invertwin.runtime.progress import track
from invertwin.scene import Dielectric, MaterialValues, Mesh, PerfectConductor, Scene, Slab, rigid
from invertwin.scene.pose import rotation_from_vector
from invertwin.scene.shapes import box, plate
from invertwin.seeds import derive_seed

FREQUENCY, BANDWIDTH, BINS = 3.5e9, 200e6, 128
SIZE = torch.tensor([14.0, 8.0, 2.8], dtype=torch.float64)
# Ranges of permittivities and conductivities [S/m]: shell, bricks, boards.
MATERIALS = ((4.0, 8.0), (3.0, 5.0), (2.2, 3.5)), ((0.03, 0.2), (0.02, 0.1), (0.01, 0.06))
DOOR, FURNITURE = 1.0, 12
SENDERS, RECEIVERS, EACH = 4, 40, 5  # each fifth receiver calibrates
DYNAMIC_RANGE_DB, FLOOR = 25.0, 1e-11
HOW = PropagationSettings(FREQUENCY, BANDWIDTH, depth=4, rays=20_000)
STEPS, RESIDUAL = 25, 0.1  # the last: both losses of a calibrated room, about
SCATTERERS, GRAPH_GAIN, IS_EDGE = 80, 0.7, 0.8  # the last: probability of an edge
REQUIRED: Required = {"level_ratio": ("<=", 0.7), "spread_factor": ("<=", 1.3)}
COUNTED = {
    "rooms": ("d", "drawn by their numbers"),
    "links": ("d", "that calibrate nothing"),
    "level_ratio": (".2f", "errors of levels over those of a power law"),
    "level_error_db": (".2f", "of the calibrated twin"),
    "power_law_error_db": (".2f", "of a power law of the same links"),
    "before.level_error_db": (".2f", "of the twin with a fitted power alone"),
    "spread_factor": (".2f", "of delay spreads, median"),
    "before.spread_factor": (".2f", "of the twin with a fitted power alone"),
}


@dataclass(frozen=True)
class World:
    """Links of a world as they are measured.

    Attributes:
        tx, rx: positions [m].
        levels: levels [tx, rx] [dBm].
        spreads: delay spreads [tx, rx] [s].
    """

    tx: Tensor
    rx: Tensor
    levels: Tensor
    spreads: Tensor

    @property
    def chosen(self) -> Tensor:
        """Mask of the receivers that calibrate."""
        return torch.arange(len(self.rx)) % EACH == 0


def draw(generator: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    """Even random numbers."""
    return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)


def walls(epsilon: Sequence[float], conductivity: Sequence[float]) -> Scene:
    """Three rooms side by side: a shell, a wall of bricks and one of two boards, each with a door.

    Args:
        epsilon: permittivities of the shell, of bricks and of boards.
        conductivity: conductivities of these [S/m].
    """
    x, y, z = SIZE.tolist()
    outer = Dielectric(epsilon[0], conductivity[0], scattering=0.0)
    brick = Slab(epsilon[1], conductivity[1], thickness=0.1, scattering=0.0)
    board = Slab(epsilon[2], conductivity[2], thickness=0.0125, scattering=0.0)
    upright = rotation_from_vector(torch.tensor([0.0, math.pi / 2, 0.0], dtype=torch.float64))
    objects = {"shell": iw.Object(box([x, y, z]), outer, rigid(translation=[x / 2, y / 2, z / 2]))}
    for name, material, at, door in (("brick", brick, 0.38, 0.7), ("board", board, 0.68, 0.2)):
        points, faces, count = list[Tensor](), list[Tensor](), 0
        for low, high in ((0.01, door * y), (door * y + DOOR, y - 0.01)):
            part = box([0.08, high - low, z - 0.02])
            if name == "brick":
                part = plate(z - 0.02, high - low)
                part = Mesh(part.vertices @ upright.T, part.faces)
            points.append(part.vertices + torch.tensor([at * x, (low + high) / 2, z / 2]))
            faces.append(part.faces + count)
            count += len(part.vertices)
        objects[name] = iw.Object(Mesh(torch.cat(points), torch.cat(faces)), material)
    return Scene(objects)


def furnish(generator: torch.Generator, scene: Scene) -> Scene:
    """Add furniture that the twin does not know."""
    objects = dict(scene.objects)
    wood = Dielectric(permittivity=2.0, conductivity=0.01, scattering=0.0)
    for number in range(FURNITURE):
        size = [float(draw(generator, *ends, 1)) for ends in ((0.4, 1.5), (0.4, 0.8), (0.5, 1.6))]
        place = [float(draw(generator, 1.0, side - 1.0, 1)) for side in SIZE[:2].tolist()]
        turn = rotation_from_vector(
            draw(generator, 0, math.pi, 1) * torch.tensor([0.0, 0.0, 1.0]).double()
        )
        material = PerfectConductor() if number % 2 else wood
        objects[f"furniture {number}"] = iw.Object(
            box(size), material, rigid(turn, [*place, size[2] / 2 + 0.01])
        )
    return Scene(objects)


def positions(
    generator: torch.Generator, count: int, scene: Scene, heights: tuple[float, float]
) -> Tensor:
    """Places of antennas between the furniture."""
    low, high = (
        torch.tensor([*edge, height], dtype=torch.float64)
        for edge, height in zip(([0.3, 0.3], (SIZE[:2] - 0.3).tolist()), heights, strict=True)
    )
    found = low + (high - low) * draw(generator, 0, 1, 20 * count, 3)
    return found[FreeSpace(scene, low, high, 0.15).contains(found)][:count]


def reverberate(generator: torch.Generator, tx: Tensor, rx: Tensor, frequencies: Tensor) -> Tensor:
    """Response [tx, rx, frequency] of a propagation graph, its straight paths left out."""
    inner = SIZE * draw(generator, 0, 1, SCATTERERS, 3)
    groups, responses = list(itertools.pairwise([tx, inner, inner, rx])), list[Tensor]()
    for number, (begin, end) in enumerate(groups):
        delay = torch.cdist(begin, end).clamp_min(0.3) / SPEED_OF_LIGHT
        there = (draw(generator, 0, 1, *delay.shape) < IS_EDGE).double()
        if number == 1:
            there.fill_diagonal_(0.0)
            power = GRAPH_GAIN**2 * there / there.sum(1, keepdim=True)
        else:
            axis = 1 if number == 0 else 0  # edges of one antenna are a row, or a column
            mean = (delay * there).sum(axis, keepdim=True) / there.sum(axis, keepdim=True)
            share = there / delay**2 / (there / delay**2).sum(axis, keepdim=True)
            power = share / (4 * math.pi * FREQUENCY * mean)
        phase = draw(generator, 0, 2 * math.pi, *delay.shape) - 2 * math.pi * (
            frequencies[:, None, None] * delay
        )
        responses.append(torch.polar(power.sqrt().expand_as(phase), phase))
    first, between, last = responses
    one = torch.eye(SCATTERERS, dtype=between.dtype)
    return (first @ torch.linalg.solve(one - between, last)).permute(1, 2, 0)


def draw_world(number: int) -> World:
    """Links of a furnished world, as they are measured."""
    generator = torch.Generator().manual_seed(derive_seed(37, number))
    materials = [[float(draw(generator, *ends, 1)) for ends in table] for table in MATERIALS]
    scene = furnish(generator, walls(*materials))
    tx = positions(generator, SENDERS, scene, (2.2, 2.5))
    rx = positions(generator, RECEIVERS, scene, (0.8, 1.6))
    frequencies = FREQUENCY + BANDWIDTH * (torch.arange(BINS).double() / BINS - 0.5)
    response = reverberate(generator, tx, rx, frequencies)
    # Edges after reflections are left out; straight paths are in the first two.
    for sign, depth, edges in ((1, 4, 0), (1, 0, 1), (-1, 0, 0)):
        rays = 100_000 if depth else None
        paths = iw.trace_paths(
            scene, tx, rx, FREQUENCY, depth=depth, edges=edges, rays=rays, seed=1
        )
        response += sign * frequency_response(paths, frequencies)[:, 0, :, 0].transpose(0, 1)
    offset, noise = draw(generator, -4, 4, 1), torch.randn(response.shape[:2], generator=generator)
    levels = 10 * response.abs().square().mean(-1).log10() + offset + noise
    return World(tx, rx, levels, measured_spreads(response))


def measured_spreads(response: Tensor) -> Tensor:
    """Delay spreads [s] as a channel sounder states them, of responses [tx, rx, frequency]."""
    window = torch.hann_window(BINS, periodic=False, dtype=torch.float64)
    profile = torch.fft.ifft(window * response).abs().square()
    profile *= profile > profile.amax(-1, keepdim=True) * 10 ** (-DYNAMIC_RANGE_DB / 10)
    delay = torch.arange(BINS) / BANDWIDTH
    first, second = ((profile * delay**n).sum(-1) / profile.sum(-1) for n in (1, 2))
    return (second - first**2).sqrt()


def calibrate(world: World, scene: Scene) -> tuple[Scene, Transmitters]:
    """Fit the materials of a twin, and its reverberant tail."""
    chosen, sensor = world.chosen, Transmitters(world.tx)
    places, tail = ReceiverPoints(world.rx[chosen]), ReverberationParameters()
    both: dict[str, Any] = {"sensor": sensor, "parameters": tail}
    power = iw.SpectrumLoss("mse", levels=1, gain="one", background="level")
    gains, delays = (iw.RadioMap(places, HOW, what) for what in ("path_gain", "delay_spread"))
    found = iw.reconstruct(
        scene,
        [
            iw.Observation(gains, world.levels[:, chosen], loss=power, **both),
            iw.Observation(delays, world.spreads[:, chosen], loss=log_error, **both),
        ],
        {
            name: MaterialValues.from_object(name, ["permittivity", "conductivity"], item)
            for name, item in scene.objects.items()
        },
        optimizer=Optimizer("adam", rate=0.1, final_rate=0.02),
        schedule=iw.Schedule(STEPS),
        regularizers=[partial(log_prior, scene, int(chosen.sum()) * len(world.tx))],
    )
    return found.scene, found.sensors[0]


def log_prior(begun: Scene, links: int, scene: Scene) -> Tensor:
    """Minus the logarithm of the prior probability of materials, in units of the loss.

    Logarithms are as uncertain as in the ranges of `MATERIALS`. The loss is the mean over links of
    squares, whose variance is `RESIDUAL`.
    """
    total = torch.zeros(()).double()
    for name, *ranges in zip(scene.objects, *MATERIALS, strict=True):
        now, then = scene[name].material, begun[name].material
        for key, (low, high) in zip(("permittivity", "conductivity"), ranges, strict=True):
            moved = (getattr(now, key) / getattr(then, key)).log()
            total = total + (moved / math.log(high / low)).square() * 12
    return RESIDUAL / links * total


def log_error(predicted: Tensor, observed: Tensor) -> Tensor:
    """Mean square of the logarithm of a ratio."""
    return (predicted / observed).log().square().mean()


@torch.no_grad()
def errors(world: World, scene: Scene, sensor: Transmitters) -> tuple[Tensor, Tensor]:
    """Errors of levels [dB] and factors of delay spreads, at the links that calibrate nothing."""
    found = HOW.link_statistics(scene, sensor, world.rx, 0)
    gain = 10 * (found.gain + FLOOR).log10()
    offset = (world.levels - gain)[:, world.chosen].mean()
    factor = (found.delay_spread / world.spreads).log().abs().exp()
    return (gain + offset - world.levels)[:, ~world.chosen], factor[:, ~world.chosen]


def power_law_errors(world: World) -> Tensor:
    """Errors of levels [dB] of a power law of distance, at the same links."""
    distance = torch.cdist(world.tx, world.rx).log10()
    columns = torch.stack([torch.ones_like(distance), distance], -1)
    known = columns[:, world.chosen].flatten(0, 1), world.levels[:, world.chosen].reshape(-1, 1)
    law = torch.linalg.lstsq(*known).solution
    return ((columns @ law)[..., 0] - world.levels)[:, ~world.chosen]


def measure(rooms: int) -> dict[str, Any]:
    """All metrics."""
    begun = walls(*([math.sqrt(low * high) for low, high in table] for table in MATERIALS))
    columns: dict[str, list[Tensor]] = {name: [] for name in ("law", "before", "after")}
    factors: dict[str, list[Tensor]] = {name: [] for name in ("before", "after")}
    tails: list[list[float]] = []
    for number in track(range(rooms), "worlds"):
        world = draw_world(number)
        scene, sensor = calibrate(world, begun)
        tail = sensor.reverberation
        assert tail is not None
        tails.append([float(tail.gain_db), 1e9 * float(tail.decay)])
        columns["law"].append(power_law_errors(world))
        for name, twin in (("before", (begun, Transmitters(world.tx))), ("after", (scene, sensor))):
            levels, spreads = errors(world, *twin)
            columns[name].append(levels)
            factors[name].append(spreads)
    error = {
        name: float(torch.cat(found).square().mean().sqrt()) for name, found in columns.items()
    }
    factor = {name: float(torch.cat(x).median()) for name, x in factors.items()}
    return {
        "rooms": rooms,
        "links": sum(x.numel() for x in columns["law"]),
        "level_ratio": error["after"] / error["law"],
        "level_error_db": error["after"],
        "power_law_error_db": error["law"],
        "spread_factor": factor["after"],
        "before": {"level_error_db": error["before"], "spread_factor": factor["before"]},
        "tails": tails,
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/measured_rooms"))
    parser.add_argument("--rooms", type=int, default=8)
    given = parser.parse_args()
    metrics = measure(given.rooms)
    table = MetricTable("Calibrated rooms", REQUIRED)
    table.rows(metrics | {f"before.{k}": v for k, v in metrics["before"].items()}, COUNTED)
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
