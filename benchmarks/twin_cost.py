"""What the search of a recording costs, against positions, samples and objects.

    python benchmarks/twin_cost.py [-o DIR] [--positions 8 16 32 64]

A board of 3 × 4 channels (77 GHz, 4 GHz) moves 1.6 m along a line in front of boxes of 0.4 × 0.5 ×
1 m; recordings are those of two bounces, with noise of 10 dB. `discovery.twin` gets the recording
and the height of the ground, and searches all that the radar sees. Every row is a process of its
own. Prints a table and writes `metrics.json` into DIR (default `out/twin_cost`):

- `positions_<n>_seconds`: processor time with n positions, 128 samples and 2 objects [s].
- `samples_<n>_seconds`, `objects_<n>_seconds`: the same with n samples, or n objects, at 16
  positions.
- `positions_exponent`, `samples_exponent`: slope of the logarithm of the time over that of the
  positions or samples; 1 = linear.
- `found_share`: share of the boxes that are found within 0.15 m, over all rows.
- `memory_gb`: most memory held by a row.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from report import MetricTable, Required, write

REQUIRED: Required = {
    "positions_16_seconds": ("<=", 180.0),
    "positions_64_seconds": ("<=", 600.0),
    "positions_exponent": ("<=", 1.1),
    "samples_exponent": ("<=", 1.1),
}
PLACES = ((2.4, -0.9), (2.7, 0.7), (3.4, 0.1))  # middles of the boxes [m]
NEAR = 0.15  # [m]


def search(positions: int, samples: int, objects: int) -> dict[str, float]:
    """Search one recording: processor seconds, boxes found, memory [GB].

    Args:
        positions: of the radar.
        samples: of a ramp.
        objects: boxes.
    """
    import invertwin as iw
    from invertwin.discovery import twin
    from invertwin.scene import Cosine, linear_array, rotation_from_vector

    chirp = iw.FMCW(77e9, 4e9, 50e-6, samples)
    pattern = Cosine(1.0)
    arrays = (
        linear_array(3, 2 * chirp.wavelength, pattern=pattern),
        linear_array(4, chirp.wavelength / 2, pattern=pattern),
    )
    along = torch.linspace(-0.8, 0.8, positions, dtype=torch.float64)
    track = torch.stack([0 * along, along, torch.full_like(along, 0.6)], 1)
    radar = iw.Radar(*arrays, chirp, track)
    boxes = {}
    for number, (x, y) in enumerate(PLACES[:objects]):
        turn = rotation_from_vector(torch.tensor([0.0, 0.0, 0.3 * number], dtype=torch.float64))
        pose = iw.rigid(turn, [x, y, 0.5])
        boxes[f"box_{number}"] = iw.Object(iw.box([0.4, 0.5, 1.0]), iw.RoughDielectric(4.0), pose)
    grid = radar.grid(0.5, 0.98 * chirp.max_range)
    sampling = iw.Sampling(depth=2, points_per_m2=300.0)
    beat = iw.simulate(iw.Scene(boxes), radar, grid, seed=1, sampling=sampling).beat
    noise = torch.randn(beat.shape, generator=torch.Generator().manual_seed(1), dtype=beat.dtype)
    level = beat.abs().square().mean().sqrt() * 10**-0.5
    recording = iw.Capture.from_beat(beat + level * noise, radar)
    before = resource.getrusage(resource.RUSAGE_SELF)
    found = twin(recording, level=0.0, seed=1)
    after = resource.getrusage(resource.RUSAGE_SELF)
    places = [one.position[:2].tolist() for one in found.objects if one.existence_probability > 0.5]
    hits = [any(math.dist(p, place) < NEAR for p in places) for place in PLACES[:objects]]
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"seconds": seconds, "found": sum(hits), "memory_gb": after.ru_maxrss / 1e6}


def measure(positions: list[int], samples: list[int], objects: list[int]) -> dict[str, Any]:
    """Search all recordings, each in a process of its own."""
    rows = {("positions", n): (n, 128, 2) for n in positions}
    rows |= {("samples", n): (16, n, 2) for n in samples}
    rows |= {("objects", n): (16, 128, n) for n in objects}
    done: dict[tuple[int, ...], dict[str, float]] = {}
    for row in rows.values():
        if row not in done:
            call = [sys.executable, __file__, "--row", *map(str, row)]
            text = subprocess.run(call, check=True, capture_output=True, text=True).stdout
            done[row] = json.loads(text.splitlines()[-1])
            print(row, done[row], flush=True)
    metrics: dict[str, Any] = {
        f"{name}_{n}_seconds": done[row]["seconds"] for (name, n), row in rows.items()
    }
    for name, counts in (("positions", positions), ("samples", samples)):
        if len(counts) > 1:
            times = [done[rows[name, n]]["seconds"] for n in counts]
            metrics[f"{name}_exponent"] = float(np.polyfit(np.log(counts), np.log(times), 1)[0])
    metrics["found_share"] = sum(one["found"] for one in done.values()) / sum(r[2] for r in done)
    metrics["memory_gb"] = max(one["memory_gb"] for one in done.values())
    return metrics


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/twin_cost"))
    parser.add_argument("--positions", type=int, nargs="+", default=[8, 16, 32, 64])
    parser.add_argument("--samples", type=int, nargs="*", default=[64, 128, 256])
    parser.add_argument("--objects", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--row", type=int, nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.row:
        print(json.dumps(search(*options.row)))
        return
    metrics = measure(options.positions, options.samples, options.objects)
    table = MetricTable("Cost of a search without a start", REQUIRED)
    for key, value in metrics.items():
        table.row(key, value, ".3g", "processor time [s]" if key.endswith("seconds") else "")
    write(metrics, table.grid, options.out)


if __name__ == "__main__":
    main()
