"""Many objects in a scene, beside the same triangles as one object.

    python benchmarks/many_objects.py [-o DIR]

Boxes stand in a cube of places before the radar, all moved together from call to call; a call is
`deposit_power` and the derivative with respect to their place, with 400 000 samples. Prints a table
and writes `metrics.json` into DIR (default `out/many_objects`), at depths 1 and 3:

- `second_call_ratio.depth<n>`: seconds of the second call and those after it (median), for 200
  objects over those for one object of the same triangles, in turns.
- `compile_seconds_ratio.depth<n>`: seconds in which Dr.Jit generates and compiles code in the first
  call of a fresh process without a cache on disk, for 2000 objects over those for 20.
- `first_call_seconds.<objects>`: of that process at depth 3, all included.
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

from invertwin.channel import Sampling, backend, deposit_power
from invertwin.radar import FMCW, Radar
from invertwin.scene import Mesh, Object, RoughDielectric, Scene, box, linear_array, rigid

MANY, FEW, MOST = 200, 20, 2000
SAMPLES, STEPS = 400_000, 9
DEPTHS = (1, 3)
REQUIRED = {
    **{f"second_call_ratio.depth{depth}": ("<=", 2.0) for depth in DEPTHS},
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


class Boxes:
    """So many boxes, as objects or as one."""

    def __init__(self, count: int, *, joined: bool = False) -> None:
        side = 1
        while side**3 < count:
            side += 1
        number = torch.arange(count)
        cells = torch.stack([number // side**2, number % side, number // side % side], dim=1)
        middle = torch.tensor([-side, side / 2, side / 2], dtype=torch.float64)
        places, one = 0.4 * (cells - middle), box((0.2, 0.2, 0.2))
        self.items = list(zip([one] * count, places, strict=True))
        if joined:
            corners = (one.vertices + places[:, None]).reshape(-1, 3)
            faces = one.faces + len(one.vertices) * number[:, None, None]
            self.items = [(Mesh(corners, faces.reshape(-1, 3)), torch.zeros(3))]

    def call(self, number: int, depth: int, samples: int = SAMPLES) -> float:
        """Seconds of a map and its derivative, with other places and another seed each time."""
        shift = torch.tensor([0.0, 1e-3 * number, 0.0], dtype=torch.float64, requires_grad=True)
        objects = {
            str(n): Object(mesh, PAINT, rigid(translation=place + shift))
            for n, (mesh, place) in enumerate(self.items)
        }
        sampling = Sampling(depth=depth, samples=samples, boundary_samples=samples // 8)
        scene, grid = Scene(objects), RADAR.grid(0.5, 9.0)
        start = perf_counter()
        deposit_power(scene, RADAR.link(), grid, sampling=sampling, seed=number).sum().backward()
        seconds = perf_counter() - start
        assert shift.grad is not None
        assert shift.grad.norm() > 0
        return seconds


def repeated(depth: int, count: int, samples: int, steps: int) -> dict[str, float]:
    """Medians of all calls but the first, in turns, and their ratio."""
    many, one = Boxes(count), Boxes(count, joined=True)
    times = [(many.call(n, depth, samples), one.call(n, depth, samples)) for n in range(1 + steps)]
    parts = [statistics.median(column) for column in zip(*times[1:], strict=True)]
    return {"many_s": parts[0], "one_s": parts[1], "ratio": parts[0] / parts[1]}


def first_call(count: int, depth: int, samples: int) -> dict[str, float]:
    """Seconds of the first call of this process: all, and in code generation and compilation."""
    seconds, made = compiled(lambda: Boxes(count).call(0, depth, samples))
    return {"call": seconds, "compile": made}


def measure(
    counts: tuple[int, int, int] = (FEW, MANY, MOST), samples: int = SAMPLES, steps: int = STEPS
) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    few, many, most = counts
    metrics: dict[str, Any] = {
        "objects": list(counts),
        "samples": samples,
        "steps": steps,
        "backend": backend(),
        "cpu_count": os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "second_call_ratio": {},
        "second_call_seconds": {},
        "compile_seconds": {},
        "compile_seconds_ratio": {},
        "first_call_seconds": {},
    }
    for depth in DEPTHS:
        part, calls = f"depth{depth}", repeated(depth, many, samples, steps)
        metrics["second_call_ratio"][part] = calls["ratio"]
        metrics["second_call_seconds"][part] = calls["many_s"]
        made = {count: fresh(__file__, count, depth, samples) for count in (few, most)}
        metrics["compile_seconds"][part] = made[most]["compile"]
        metrics["compile_seconds_ratio"][part] = made[most]["compile"] / made[few]["compile"]
        metrics["first_call_seconds"] = {str(count): made[count]["call"] for count in made}
    return metrics


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    few, many, most = metrics["objects"]
    page = MetricTable(
        f"Many objects, {metrics['samples']} samples; medians of {metrics['steps']} calls; backend "
        f"{metrics['backend']}; {metrics['cpu_count']} CPU cores, load average "
        f"{metrics['load_average']:.1f} at the start",
        REQUIRED,
    )
    texts = {
        "second_call_ratio": f"{many} objects over the same triangles as one",
        "second_call_seconds": f"of {many} objects",
        "compile_seconds": f"of {most} objects, first call of a fresh process",
        "compile_seconds_ratio": f"{most} objects over {few}",
        "first_call_seconds": "of that process at depth 3",
    }
    for key, text in texts.items():
        for part, value in metrics[key].items():
            page.row(f"{key}.{part}", value, ".2f", text)
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/many_objects"))
    parser.add_argument("--first", type=int, nargs=3, help="only print the first call's seconds")
    arguments = parser.parse_args()
    if arguments.first:
        print(json.dumps(first_call(*arguments.first)))
        return
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
