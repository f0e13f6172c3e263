"""Growth of time and memory with triangles, objects, positions, receivers and samples.

    python benchmarks/growth.py [-o DIR]

Every point is a fresh process: a small call that compiles kernels, then the call that counts.
Triangles, objects, positions of the radar and samples belong to a map of expected power with its
derivative (`deposit_power`, one bounce), receivers to paths between antennas (`trace_paths`, two
bounces among boxes). Prints a table and writes `metrics.json` into DIR (default `out/growth`). For
each of these, with its sizes:

- `seconds`: processor seconds of the call; `memory_mb`: by how much it raises the peak of resident
  memory over that after the small call, at least 1 MB.
- `time_exponent` and `memory_exponent`: slopes of a straight line through the logarithms of both,
  over those of the sizes. Constant parts lower them, so that sizes are as large as a few seconds
  allow.
"""

import argparse
import json
import math
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import torch
from many_objects import CHIRP, PAINT, Boxes
from report import MetricTable, Required, write

from invertwin import trace_paths
from invertwin.channel import Sampling, backend, deposit_power
from invertwin.radar import Radar
from invertwin.scene import Object, PerfectConductor, Scene, linear_array, rigid
from invertwin.scene.shapes import box, plate

SAMPLES = 100_000
MEGABYTE = 1024  # in units of the peak of resident memory
FREQUENCY = 60e9
REQUIRED: Required = {"time_exponent": ("<=", 1.1), "memory_exponent": ("<=", 1.1)}

Call = Callable[[int], None]


def map_power(scene: Scene, shift: torch.Tensor, positions: int, samples: int) -> None:
    """A map of expected power and its derivative by a shift."""
    y = torch.linspace(-0.5, 0.5, positions, dtype=torch.float64)
    places = torch.stack([torch.zeros_like(y), y, torch.zeros_like(y)], 1)
    arrays = linear_array(1, 1.0), linear_array(4, CHIRP.wavelength / 2)
    radar = Radar(*arrays, CHIRP, places)
    sampling = Sampling(depth=1, samples=samples, boundary_samples=samples // 8)
    grid = radar.grid(0.5, 9.0)
    deposit_power(scene, radar.link(), grid, sampling=sampling, seed=1).sum().backward()
    assert shift.grad is not None


def wall(triangles: int, positions: int = 1, samples: int = SAMPLES) -> None:
    """A wall of so many triangles before the radar."""
    shift = torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    mesh = plate(2.0, 2.0, divisions=round(math.sqrt(triangles / 2)))
    map_power(
        Scene({"wall": Object(mesh, PAINT, rigid(translation=shift))}), shift, positions, samples
    )


def crowd(objects: int) -> None:
    """So many boxes, all moved together."""
    Boxes(objects).call(1, 1, SAMPLES)


def antennas(receivers: int) -> None:
    """Paths from one transmitter to receivers on a line, among eight boxes on a floor."""
    metal, at = PerfectConductor(), torch.arange(8, dtype=torch.float64)
    places = torch.stack([2 + at % 4, 2 * (at // 4) - 1, torch.full_like(at, 0.5)], 1)
    objects = {
        str(n): Object(box(0.8), metal, rigid(translation=place)) for n, place in enumerate(places)
    }
    y = torch.linspace(-3, 3, receivers, dtype=torch.float64)
    line = torch.stack([torch.full_like(y, 7.0), y, torch.full_like(y, 1.2)], 1)
    trace_paths(Scene(objects), [0.0, 0.0, 1.0], line, FREQUENCY, depth=2, rays=SAMPLES)


#: By name: the call, the size of the small call, and the sizes that count.
AXES: dict[str, tuple[Call, int, tuple[int, ...]]] = {
    "triangles": (wall, 200, (80_000, 320_000, 1_280_000)),
    "objects": (crowd, 8, (500, 2000, 8000)),
    "positions": (lambda n: wall(2000, positions=n), 2, (256, 1024, 4096)),
    "receivers": (antennas, 8, (8000, 32_000, 128_000)),
    "samples": (
        lambda n: wall(2000, samples=n),
        10_000,
        (1_600_000, 6_400_000, 25_600_000),
    ),
}


def peak_memory() -> float:
    """Peak of the resident memory of this process [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MEGABYTE


def point(axis: str, size: int) -> dict[str, float]:
    """Processor seconds and memory of a call in this process, after a small one."""
    call, small, _ = AXES[axis]
    call(small)
    before, begin = peak_memory(), process_time()
    call(size)
    seconds = process_time() - begin
    return {"seconds": seconds, "memory_mb": max(1.0, peak_memory() - before)}


def fresh_point(axis: str, size: int) -> dict[str, float]:
    """The same in a fresh process."""
    command = [sys.executable, __file__, "--point", axis, str(size)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(printed.splitlines()[-1])


def exponent(sizes: list[int], values: list[float]) -> float:
    """Slope of the least-squares line through the logarithms."""
    x, y = (torch.tensor(column, dtype=torch.float64).log() for column in (sizes, values))
    x = x - x.mean()
    return float((x @ y) / (x @ x))


def growth(axis: str, sizes: tuple[int, ...], shrink: int = 1) -> dict[str, Any]:
    """All points of one axis, and their exponents."""
    counts = [max(1, size // shrink) for size in sizes]
    points = [fresh_point(axis, size) for size in counts]
    found: dict[str, Any] = {"sizes": counts}
    for key, name in (("seconds", "time"), ("memory_mb", "memory")):
        found[key] = [value[key] for value in points]
        found[f"{name}_exponent"] = exponent(counts, found[key])
    return found


def measure(axes: tuple[str, ...] = tuple(AXES), shrink: int = 1) -> dict[str, Any]:
    """All metrics; fewer and smaller in tests only."""
    load = os.getloadavg()[0]
    found = {axis: growth(axis, AXES[axis][2], shrink) for axis in axes}
    return {"backend": backend(), "load_average": load, "growth": found}


def table(metrics: dict[str, Any]) -> MetricTable:
    """A row an exponent."""
    title = f"Growth, backend {metrics['backend']}, load {metrics['load_average']:.1f}"
    shown = MetricTable(title, REQUIRED)
    for axis, found in metrics["growth"].items():
        sizes = ", ".join(f"{size:_}".replace("_", " ") for size in found["sizes"])
        for key, name, unit in (("seconds", "time", "s"), ("memory_mb", "memory", "MB")):
            values = ", ".join(f"{value:.3g}" for value in found[key])
            text = f"{values} {unit} at {sizes}"
            shown.row(f"{axis}.{name}_exponent", found[f"{name}_exponent"], ".2f", text)
    return shown


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/growth"))
    parser.add_argument("--point", nargs=2, help="only print one point: an axis and a size")
    given = parser.parse_args()
    if given.point:
        print(json.dumps(point(given.point[0], int(given.point[1]))))
        return
    metrics = measure()
    write(metrics, table(metrics).grid, given.out)


if __name__ == "__main__":
    main()
