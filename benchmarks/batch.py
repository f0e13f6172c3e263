"""Many scenes in one launch, beside one scene.

    python benchmarks/batch.py [-o DIR]

A block stands in front of a wall, in 32 scenes at 32 places. A call makes the scenes, predicts
their maps with `SurrogateMap.predict_batch` (`predict` of one scene) and, of a step, takes the
derivative with respect to the places: one frame of a radar, two range bins a cell, and a quarter as
many boundary samples as samples of a scene. Prints a table and writes `metrics.json` into DIR
(default `out/batch`), at depths 1 and 3:

- `step_ratio.depth<n>_<samples>`: seconds of a step of 32 scenes over those of one (medians, in
  turns in one process); `map_ratio` without derivatives. Of few samples a call is mostly launches,
  of many samples it is rays, of which 32 scenes have 32 times as many: there the ratio grows.
- `of_alone.depth<n>_<samples>`: seconds of a step of 32 scenes over 32 times those of one.
- `map_noise_ratio.depth<n>`: standard deviation of the maps of a batch over that of single calls,
  at as many samples a scene; `slope_noise_ratio` that of the derivatives.
- `compile_seconds_ratio.depth<n>`: seconds in which Dr.Jit generates and compiles code in the first
  step of a fresh process without a cache on disk, for 32 scenes over those for 2.
"""

import argparse
import json
import os
import statistics
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from first_calls import compiled, fresh
from report import MetricTable, write
from rich.table import Table
from torch import Tensor

from invertwin import SurrogateMap
from invertwin.channel import Sampling, backend
from invertwin.radar import FMCW, Radar
from invertwin.scene import (
    Object,
    RoughDielectric,
    Scene,
    box,
    linear_array,
    plate,
    rigid,
    rotation_from_vector,
)

SCENES, FEW = 32, 2
SIZES, STEPS, DRAWS = (3_000, 10_000, 30_000, 100_000), 9, 24
DEPTHS, TYPICAL = (1, 3), 10_000
REQUIRED = {
    **{
        f"{kind}_ratio.depth{depth}_{TYPICAL}": ("<=", 10.0)
        for kind in ("step", "map")
        for depth in DEPTHS
    },
    **{
        f"{kind}_noise_ratio.depth{depth}": ("<=", 1.3)
        for kind in ("map", "slope")
        for depth in DEPTHS
    },
    **{f"compile_seconds_ratio.depth{depth}": ("<=", 1.3) for depth in DEPTHS},
}
PAINT = RoughDielectric(permittivity=4.0)
CHIRP = FMCW(start_frequency=76e9, bandwidth=1e9, duration=50e-6, samples=128)
RADAR = Radar(
    linear_array(1, 1.0),
    linear_array(4, CHIRP.wavelength / 2),
    CHIRP,
    torch.zeros(1, 3, dtype=torch.float64),
)
GRID = RADAR.grid(0.5, 4.0)
TURN = rotation_from_vector(torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
WALL = Object(plate(3.0, 3.0), PAINT, rigid(translation=torch.tensor([2.5, 0.0, 0.0]).double()))
BLOCK = box((0.2, 0.3, 0.4))


def scene_at(place: Tensor) -> Scene:
    """The block at a place before the wall."""
    return Scene({"block": Object(BLOCK, PAINT, rigid(TURN, place)), "wall": WALL})


def places(count: int, number: int) -> Tensor:
    """Where the blocks of so many scenes stand; a little further in every call."""
    across = torch.linspace(-0.4, 0.4, count + 1, dtype=torch.float64)[:count] + 1e-3 * number
    return torch.stack([1.5 - 0.3 * across, across, 0.1 + 0 * across], dim=1)


class Steps:
    """Training steps of scenes: one after another, or all at once."""

    def __init__(self, depth: int, samples: int) -> None:
        drawn = Sampling(depth=depth, samples=samples, boundary_samples=samples // 4)
        self.model = SurrogateMap(GRID, sampling=drawn)

    def maps(self, at: Tensor, seed: int, *, at_once: bool) -> Tensor:
        """Of the scenes with a block at each place."""
        scenes = [scene_at(place) for place in at]
        if at_once:
            return self.model.predict_batch(scenes, RADAR, seed)
        return torch.stack([self.model.predict(scene, RADAR, seed) for scene in scenes])

    def step(self, at: Tensor, seed: int, *, at_once: bool) -> tuple[Tensor, Tensor]:
        """Maps, and what moves the weighted sum of each along the blocks' places."""
        at = at.clone().requires_grad_()
        maps = self.maps(at, seed, at_once=at_once)
        (maps * torch.linspace(0.5, 1.5, maps[0].numel()).reshape(maps[0].shape)).sum().backward()
        assert at.grad is not None
        return maps.detach(), at.grad

    def seconds(self, count: int, number: int, *, slope: bool) -> float:
        """Of one call, with places and a seed of its own."""
        at, at_once, start = places(count, number), count > 1, perf_counter()
        if slope:
            self.step(at, number, at_once=at_once)
        else:
            self.maps(at, number, at_once=at_once)
        return perf_counter() - start


def ratios(depth: int, samples: int, count: int, steps: int) -> dict[str, float]:
    """Medians of all calls but the first two, in turns."""
    made, found = Steps(depth, samples), {}
    for kind in ("map", "step"):
        times = [
            [made.seconds(number, turn, slope=kind == "step") for number in (1, count)]
            for turn in range(2 + steps)
        ]
        one, many = (statistics.median(column) for column in zip(*times[2:], strict=True))
        found |= {f"{kind}_ratio": many / one, f"{kind}_seconds": many}
    return {**found, "of_alone": found["step_ratio"] / count}


def noise(depth: int, samples: int, count: int, draws: int) -> dict[str, float]:
    """Standard deviation of maps and derivatives in a batch over that of single calls."""
    made, at, spreads = Steps(depth, samples), places(count, 0), []
    for at_once in (False, True):
        found = [made.step(at, seed + draws * at_once, at_once=at_once) for seed in range(draws)]
        columns = [torch.stack(column) for column in zip(*found, strict=True)]
        # Of maps relative to each, so that no scene counts more than another.
        scale = columns[0].mean(0).abs().flatten(1).sum(1)
        parts = columns[0].std(0).flatten(1).sum(1) / scale
        spreads.append((float(parts.mean()), float(columns[1].var(0).sum().sqrt())))
    names = ("map_noise_ratio", "slope_noise_ratio")
    return {name: many / one for name, one, many in zip(names, *spreads, strict=True)}


def compile_seconds(count: int, depth: int, samples: int) -> float:
    """Seconds of code generation and compilation in the first step of this process."""
    made = Steps(depth, samples)
    return compiled(lambda: made.step(places(count, 0), 0, at_once=True))[1]


def measure(
    count: int = SCENES, sizes: tuple[int, ...] = SIZES, steps: int = STEPS, draws: int = DRAWS
) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    metrics: dict[str, Any] = {
        "scenes": count,
        "sizes": list(sizes),
        "steps": steps,
        "draws": draws,
        "backend": backend(),
        "cpu_count": os.cpu_count(),
        "load_average": os.getloadavg()[0],
    }

    def keep(key: str, part: str, value: float) -> None:
        metrics.setdefault(key, {})[part] = value

    for depth in DEPTHS:
        for samples in sizes:
            for key, value in ratios(depth, samples, count, steps).items():
                keep(key, f"depth{depth}_{samples}", value)
        typical = TYPICAL if TYPICAL in sizes else sizes[0]
        for key, value in noise(depth, typical, count, draws).items():
            keep(key, f"depth{depth}", value)
        made = [fresh(__file__, number, depth, typical) for number in (FEW, count)]
        keep("compile_seconds_ratio", f"depth{depth}", made[1] / made[0])
    return metrics


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    count = metrics["scenes"]
    page = MetricTable(
        f"{count} scenes in one launch; medians of {metrics['steps']} calls; backend "
        f"{metrics['backend']}; {metrics['cpu_count']} CPU cores, load average "
        f"{metrics['load_average']:.1f} at the start",
        REQUIRED,
    )
    texts = {
        "step_ratio": f"maps and derivatives of {count} scenes over one",
        "map_ratio": f"maps of {count} scenes over one",
        "of_alone": f"step of {count} scenes over {count} steps of one",
        "step_seconds": f"maps and derivatives of {count} scenes",
        "map_noise_ratio": f"of {metrics['draws']} draws, a batch over single calls",
        "slope_noise_ratio": "the same of the derivatives",
        "compile_seconds_ratio": f"{count} scenes over {FEW}, first step of a fresh process",
    }
    for key, text in texts.items():
        for part, value in metrics[key].items():
            page.row(f"{key}.{part}", value, ".2f", text)
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/batch"))
    parser.add_argument("--first", type=int, nargs=3, help="only print the first step's seconds")
    arguments = parser.parse_args()
    if arguments.first:
        print(json.dumps(compile_seconds(*arguments.first)))
        return
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
