"""Many starts of the demo's fit against one: time, and that every end is that of its start alone.

    python benchmarks/many_starts.py [-o DIR] [--starts N] [--steps N]

The fit is that of `experiments/demo.toml` with its settings, but with fewer steps, from 32 starts
about the truth. A fit that compiles kernels goes before and is not counted. Prints a table and
writes `metrics.json` into DIR (default `out/many_starts`):

- `ratio`: processor seconds of the fits from all starts over the median of those of one.
- `wall_ratio`: the same in seconds of the clock, which other work disturbs.
- `end_difference_m`: largest distance of a vertex of the letter between the fit of a start among
  all and of the same start alone, over the first and the last start.
"""

import argparse
import os
import statistics
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from report import MetricTable, Required, write
from rich.console import Console
from torch import Tensor

from invertwin.channel import backend
from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.problem import (
    Problem,
    Start,
    make_observations,
    make_schedule,
    make_unknowns,
)
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import build
from invertwin.inversion import reconstruct

RUN = Path(__file__).parents[1] / "experiments" / "demo.toml"
STARTS, STEPS = 32, 20
REQUIRED: Required = {"ratio": ("<=", 8.0), "end_difference_m": ("<=", 1e-6)}
COUNTED = {
    "one_seconds": (".2f", "processor seconds of a fit, median"),
    "ratio": (".1f", "processor seconds of all starts over one"),
    "wall_ratio": (".1f", "seconds of the clock of the same"),
    "end_difference_m": (".1e", "ends of starts among all, and alone"),
}


def make_problem(starts: int) -> Problem:
    """The demo's problem, with so many starts."""
    run = load_run(RUN)
    table = run.starts.model_copy(update={"count": starts})
    return build_problem(run.model_copy(update={"starts": table}), Console(quiet=True))


def fit(problem: Problem, start: Start, steps: int) -> Tensor:
    """Vertices of the letter where the fit from a start ends."""
    (stage,) = make_schedule(problem)
    found = reconstruct(
        start.scene,
        make_observations(problem, start),
        make_unknowns(problem, start),
        loss=build.build_section(problem.run, "loss"),
        optimizer=build.build_section(problem.run, "optimizer"),
        schedule=replace(stage, steps=steps),
        seed=problem.run.seed,
    )
    return found.scene["letter"].vertices.detach()


def measure(starts: int = STARTS, steps: int = STEPS) -> dict[str, Any]:
    """All metrics; fewer and shorter fits in tests only."""
    problem, load = make_problem(starts), os.getloadavg()[0]
    begun = problem.starts()
    fit(problem, begun[0], steps)
    walls, works, ends = [], [], []
    for start in begun:
        wall, work = perf_counter(), process_time()
        ends.append(fit(problem, start, steps))
        walls.append(perf_counter() - wall)
        works.append(process_time() - work)
    alone = [(fit(problem, begun[k], steps) - ends[k]).norm(dim=1).max() for k in (0, -1)]
    return {
        "backend": backend(),
        "load_average": load,
        "starts": len(begun),
        "steps": steps,
        "one_seconds": statistics.median(works),
        "ratio": sum(works) / statistics.median(works),
        "wall_ratio": sum(walls) / statistics.median(walls),
        "end_difference_m": float(max(alone)),
    }


def table(metrics: dict[str, Any]) -> MetricTable:
    """A row a metric."""
    title = (
        f"{metrics['starts']} starts of {metrics['steps']} steps, backend {metrics['backend']}, "
        f"load {metrics['load_average']:.1f}"
    )
    shown = MetricTable(title, REQUIRED)
    shown.rows(metrics, COUNTED)
    return shown


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/many_starts"))
    parser.add_argument("--starts", type=int, default=STARTS)
    parser.add_argument("--steps", type=int, default=STEPS)
    given = parser.parse_args()
    metrics = measure(given.starts, given.steps)
    write(metrics, table(metrics).grid, given.out)


if __name__ == "__main__":
    main()
