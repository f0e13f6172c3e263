"""Four fits in four threads of one process against the same fits one after the other.

    python benchmarks/threads.py [-o DIR] [--repetitions N] [--steps N]

Prints a table and writes `metrics.json` into DIR (default `out/threads`). Every repetition is a
process of its own, which makes the fits one after the other and then all at once. Each fit
simulates its own data and moves the same mesh, so that all share the ray tracer's copy of it: by
Adam, by Adam over two bounces, by Gauss–Newton, and a second time by Adam with another seed.

- `largest_difference`: how far apart a number of the twin's place is after the two ways [m].
- `serial_difference`: the same of the fits made twice in one thread, for comparison.
- `aborts`: repetitions that ended otherwise than with their numbers, within ten minutes.
- `fits`: fits in threads that were compared.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from report import MetricTable, Required, write
from torch import Tensor

import invertwin as iw
from invertwin.inversion import Optimizer
from invertwin.scene import RoughDielectric, Translation, linear_array, rigid, sphere

REPETITIONS, STEPS, SECONDS = 20, 12, 600.0
BALL = sphere(0.15, 2)  # one mesh, whose copy in the ray tracer all fits share
#: Optimiser, bounces and seed of every fit.
FITS = (
    (Optimizer("adam"), 1, 1),
    (Optimizer("adam"), 2, 2),
    (Optimizer("gauss_newton"), 1, 3),
    (Optimizer("adam"), 1, 4),
)
REQUIRED: Required = {"largest_difference": ("<=", 1e-6), "aborts": ("<=", 0)}
COUNTED = {
    "largest_difference": (".3g", "between threads and one after the other [m]"),
    "serial_difference": (".3g", "between the same fits in one thread [m]"),
    "aborts": (".3g", "repetitions without numbers"),
    "fits": (".3g", "fits in threads"),
}


def fitted(optimizer: Optimizer, depth: int, seed: int, steps: int) -> Tensor:
    """Where a fit finds a ball [m]."""
    ball = iw.Object(BALL, RoughDielectric(4.0), rigid(translation=[2.1, 0.1, 0.0]))
    scene = iw.Scene({"ball": ball})
    chirp = iw.FMCW(start_frequency=77e9, bandwidth=2e9, duration=50e-6, samples=64)
    arrays = linear_array(1, 1e-3), linear_array(8, 1.92e-3)
    places = torch.tensor([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]], dtype=torch.float64)
    radar = iw.Radar(*arrays, chirp, positions=places)
    grid = radar.grid(range_min=1.5, range_max=2.8, u_max=0.5)
    few = iw.Sampling(depth=1, points_per_m2=1e3)
    data = iw.simulate(scene, radar, grid, seed=seed, sampling=few, snr_db=20.0)
    sampling = iw.Sampling(depth=depth, samples=4000, boundary_samples=1000)
    model = iw.SurrogateMap(grid, iw.Surrogate(range_width=3.0, angle_width=1.0), sampling)
    found = iw.reconstruct(
        scene.replace("ball", pose=rigid(translation=[2.15, 0.15, 0.0])),
        iw.Observation(model, data.capture),
        Translation("ball", axes="xy"),  # a row of antennas does not tell z
        loss=iw.SpectrumLoss(kind="likelihood"),
        optimizer=optimizer,
        schedule=iw.Schedule(steps),
        seed=seed,
    )
    return found.scene["ball"].center


def apart(first: Sequence[Tensor], second: Sequence[Tensor]) -> float:
    """The largest difference of a number."""
    return max(float((a - b).abs().max()) for a, b in zip(first, second, strict=True))


def compared(steps: int) -> dict[str, float]:
    """One repetition, in this process."""
    serial = [fitted(*fit, steps=steps) for fit in FITS]
    again = [fitted(*fit, steps=steps) for fit in FITS]
    with ThreadPoolExecutor(len(FITS)) as pool:
        running = [pool.submit(fitted, *fit, steps=steps) for fit in FITS]
    together = [fit.result() for fit in running]
    return {
        "largest_difference": apart(serial, together),
        "serial_difference": apart(serial, again),
    }


def measure(repetitions: int, steps: int) -> dict[str, Any]:
    """All repetitions, each in a process of its own."""
    found: list[dict[str, float]] = []
    for _ in range(repetitions):
        command = [sys.executable, __file__, "--once", "--steps", str(steps)]
        try:
            ended = subprocess.run(
                command, stdout=subprocess.PIPE, text=True, timeout=SECONDS, check=True
            )
            found.append(json.loads(ended.stdout.splitlines()[-1]))
        except (subprocess.SubprocessError, json.JSONDecodeError, IndexError) as error:
            print(f"a repetition gave no numbers: {error}")
    return {
        **{key: max((row[key] for row in found), default=None) for key in list(COUNTED)[:2]},
        "aborts": repetitions - len(found),
        "fits": len(found) * len(FITS),
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/threads"))
    parser.add_argument("--repetitions", type=int, default=REPETITIONS)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--once", action="store_true", help="one repetition, here, as JSON")
    given = parser.parse_args()
    if given.once:
        print(json.dumps(compared(given.steps)))
        return
    metrics = measure(given.repetitions, given.steps)
    table = MetricTable("Fits in threads", REQUIRED)
    table.rows(metrics, COUNTED)
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
