"""Every check and timing that needs a GPU: one command for the day when one is at hand.

    python benchmarks/gpu.py [-o DIR] [--device cuda|cpu]

Parts run one after the other, each in a process of its own whose ray tracer is on the device; all
of them end within `LIMIT` seconds, and a part that would not is stopped and named. Prints a table
and writes `metrics.json` into DIR (default `out/gpu`), as `benchmarks/results.py --store` reads it:

- `agreement`: difference of the CPU's and the device's result over the largest value, with equal
  seeds: `map` and `gradient` of a bumpy ball, `two_bounce_map` and `two_bounce_gradient` of a
  closed room, `rcs` of a corner reflector, `fit` the difference of two fits' ends [m].
- `throughput`, `multibounce`, `fit`, `rcs`: what `throughput.py`, `multibounce.py`, `steps.py` and
  `rcs_speed.py` measure. `twin`: `twin_cost.py` of 8 positions, 128 samples, 2 objects.
- `tests`: how many of the tests marked `gpu` passed, and failed.
- `seconds.<part>`: of the clock, imports and compilation included. `failed`: parts that did not
  end well, and why.

`--device cpu` rehearses all parts without a GPU, at small sizes: its figures mean nothing.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

from report import MetricTable, Required, write

from invertwin.runtime import doctor

ROOT = Path(__file__).parents[1]
LIMIT = 480.0  # [s]
TESTED = ("radar", "links", "inversion", "channel/power")  # folders with tests that need a GPU
REQUIRED: Required = {
    **{f"agreement.{name}": ("<=", 1e-3) for name in ("map", "two_bounce_map", "rcs", "fit")},
    **{f"agreement.{name}": ("<=", 1e-2) for name in ("gradient", "two_bounce_gradient")},
    "throughput.samples_per_second": (">=", 5e6),
    "throughput.backward_over_forward": ("<=", 2.5),
    "fit.step_over_kernels": ("<=", 2.0),
    "rcs.seconds": ("<=", 20.0),
    "rcs.peak_error_db": ("<=", 0.1),
    "tests.failed": ("<=", 0),
    "total_seconds": ("<=", LIMIT),
}
SHOWN = (
    *(name for name in REQUIRED if name.startswith("agreement")),
    *("throughput.samples_per_second", "throughput.backward_over_forward"),
    *("throughput.useful_paths_per_second", "throughput.peak_memory_gb"),
    *("multibounce.depth2.samples_per_second", "multibounce.depth3.samples_per_second"),
    *("multibounce.step.tracing_share", "multibounce.step.short_share"),
    *("fit.step", "fit.step_over_kernels", "rcs.seconds", "rcs.peak_error_db"),
    *("twin.seconds", "twin.found", "tests.passed", "tests.failed"),
)


def agreement(device: str, small: bool) -> dict[str, float]:
    """Differences of the device's results from the CPU's, over the largest value."""
    import many_starts
    import multibounce
    import rcs_speed
    import throughput

    from invertwin import rcs
    from invertwin.channel import Sampling, deposit_power, use_backend

    ball, room = throughput.Task.build(2 if small else 4), multibounce.room(1)
    samples = 20_000 if small else 1_000_000

    def difference(task: Any, name: str, depth: int) -> list[float]:
        def evaluate(backend: str) -> tuple[Any, Any]:
            vertices = task.scene[name].mesh.vertices.clone().requires_grad_()
            mesh = throughput.Mesh(vertices, task.scene[name].mesh.faces)
            power = deposit_power(
                task.scene.replace(name, mesh=mesh),
                task.radar.link(),
                task.grid,
                sampling=Sampling(depth=depth, samples=samples, backend=backend),
                seed=1,
            )
            (power / power.detach().mean()).square().mean().backward()
            return power.detach().cpu(), vertices.grad

        pairs = zip(evaluate("cpu"), evaluate(device), strict=True)
        return [float((one - other).abs().max() / one.abs().max()) for one, other in pairs]

    def on(backend: str, function: Callable[[], Any]) -> Any:
        with use_backend(backend):
            return function()

    scene, directions = rcs_speed.corner(4), rcs_speed.azimuth_sweep(3)
    echoes = [on(d, lambda: rcs(scene, directions, 10e9).matrix) for d in ("cpu", device)]
    problem = many_starts.make_problem(1)
    (start,) = problem.starts()
    steps = 2 if small else 20
    ends = [on(d, lambda: many_starts.fit(problem, start, steps)) for d in ("cpu", device)]
    one, two = difference(ball, "ball", 1), difference(room, "room", 2)
    return {
        "map": one[0],
        "gradient": one[1],
        "two_bounce_map": two[0],
        "two_bounce_gradient": two[1],
        "rcs": float((echoes[0] - echoes[1]).abs().max() / echoes[0].abs().max()),
        "fit": float((ends[0] - ends[1]).norm(dim=1).max()),
    }


def measure_throughput(device: str, small: bool) -> dict[str, Any]:
    """Samples a second, forward and backward."""
    import throughput

    return throughput.measure(10_000, 1_000, 10_000, 2) if small else throughput.measure()


def measure_multibounce(device: str, small: bool) -> dict[str, Any]:
    """Two and three bounces."""
    import multibounce

    return multibounce.measure(10_000, 10_000, 1) if small else multibounce.measure()


def measure_fit(device: str, small: bool) -> dict[str, Any]:
    """Parts of a step of a fit."""
    import steps

    return steps.measure(3, 1) if small else steps.measure()


def measure_rcs(device: str, small: bool) -> dict[str, Any]:
    """A signature over many aspects."""
    import rcs_speed

    return rcs_speed.measure(3, 4, 10e9) if small else rcs_speed.measure()


def measure_twin(device: str, small: bool) -> dict[str, Any]:
    """A search without a start."""
    import twin_cost

    return twin_cost.search(4, 64, 1) if small else twin_cost.search(8, 128, 2)


def run_tests(device: str, small: bool) -> dict[str, int]:
    """Passed and failed tests that need a GPU; without one, none."""
    folders = [str(ROOT / "tests" / name) for name in TESTED]
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", *folders[: 1 if small else None]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    words = done.stdout.splitlines()[-1].replace(",", "").split()
    count = {word: int(number) for number, word in pairwise(words) if number.isdigit()}
    failed = count.get("failed", 0) + count.get("error", 0) + count.get("errors", 0)
    return {"passed": count.get("passed", 0), "failed": failed}


PARTS: dict[str, Callable[[str, bool], dict[str, Any]]] = {
    "agreement": agreement,
    "throughput": measure_throughput,
    "fit": measure_fit,
    "rcs": measure_rcs,
    "multibounce": measure_multibounce,
    "twin": measure_twin,
    "tests": run_tests,
}


def run_part(name: str, device: str, seconds: float | None) -> dict[str, Any] | str:
    """Metrics of a part, from a process of its own, or why there are none."""
    command = [sys.executable, __file__, "--part", name, "--device", device]
    environment = os.environ | {"INVERTWIN_BACKEND": device}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=seconds
        )
    except subprocess.TimeoutExpired:
        return f"stopped after {seconds:.0f} s"
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        return (done.stderr.strip().splitlines() or ["no output"])[-1]
    return json.loads(lines[-1])


def measure(device: str, parts: list[str]) -> dict[str, Any]:
    """All parts, as far as the time allows."""
    begun = perf_counter()
    metrics: dict[str, Any] = {"device": doctor.gpu_name() if device == "cuda" else "CPU"}
    metrics |= {"cpu_count": os.cpu_count(), "seconds": {}, "failed": {}}
    for name in parts:
        start = perf_counter()
        # A rehearsal takes what it takes.
        left = LIMIT - 5.0 - (start - begun) if device == "cuda" else None
        found = run_part(name, device, left if left is None else max(1.0, left))
        metrics["seconds"][name] = perf_counter() - start
        if isinstance(found, str):
            metrics["failed"][name] = found
        else:
            metrics[name] = found
        print(f"{name}: {metrics['failed'].get(name, 'done')}", flush=True)
    return metrics | {"total_seconds": perf_counter() - begun}


def table(metrics: dict[str, Any]) -> MetricTable:
    """A row a metric; parts that failed leave their rows empty."""
    page = MetricTable(f"{metrics['device']}, {metrics['cpu_count']} CPU cores", REQUIRED)
    for key in (*SHOWN, "total_seconds"):
        value: Any = metrics
        for name in key.split("."):
            value = value.get(name, {})
        page.row(key, None if value == {} else value, ".3g")
    for name, why in metrics["failed"].items():
        page.row(name, None, "", why)
    return page


def main() -> int:
    """Measure, print, write; 2 without a GPU, 1 if a part failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/gpu"))
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.part:
        print(json.dumps(PARTS[given.part](given.device, given.device == "cpu")))
        return 0
    if given.device == "cuda" and doctor.gpu_name() is None:
        print(
            "expected an NVIDIA GPU, got no CUDA device: with one this would run "
            f"{', '.join(PARTS)} in at most {LIMIT:.0f} s; rehearse them with --device cpu",
            file=sys.stderr,
        )
        return 2
    metrics = measure(given.device, list(PARTS))
    write(metrics, table(metrics).grid, given.out)
    return 1 if metrics["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
