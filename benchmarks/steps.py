"""One step of the demo's fit: how long it takes, and how much of that its ray kernels take.

    python benchmarks/steps.py [-o DIR] [--steps N]

Prints a table and writes `metrics.json` into DIR (default `out/steps`). The fit is that of
`experiments/demo.toml` with its settings; its first steps compile kernels and are left out.
Medians over the other steps [s]:

- `step`: the whole step, from one report to the next.
- `kernels`: execution of all Dr.Jit kernels, as Dr.Jit's kernel history tells.
- `convolutions`: torch operations that shape the deposited power (`CONVOLUTIONS`), forward and
  backward, in their own time.
- `torch`: all other torch operations, in their own time.
- `rest`: the step less all of these: Python, tracing of Dr.Jit's programs, and waiting.
- `step_over_kernels`: `step` over `kernels`.

The first two are measured in a fit without torch's profiler, which slows small operations down,
the two after them in a second, equal fit.
"""

import argparse
import os
import statistics
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

# Torch's profiler announces its every start and stop.
os.environ.setdefault("KINETO_LOG_LEVEL", "5")

import drjit as dr
import torch
from report import MetricTable, Required, write
from rich.console import Console

from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.problem import (
    Problem,
    make_observations,
    make_schedule,
    make_unknowns,
)
from invertwin.cli.run_file import load_run
from invertwin.cli.schema import build
from invertwin.inversion import Report, reconstruct

RUN = Path(__file__).parents[1] / "experiments" / "demo.toml"
STEPS, SKIPPED = 30, 5
#: Parts of the names of torch operations that only convolutions use.
CONVOLUTIONS = ("mm", "einsum", "fft", "conv")
REQUIRED: Required = {"step_over_kernels": ("<=", 2.0)}
COUNTED = {
    "step": (".4f", "one step of the fit"),
    "kernels": (".4f", "Dr.Jit kernels"),
    "convolutions": (".4f", "matrix products and FFTs of torch"),
    "torch": (".4f", "other torch operations"),
    "rest": (".4f", "Python, tracing, waiting"),
    "kernel_count": (".0f", "launches a step"),
    "step_over_kernels": (".4f", ""),
}


def fit(problem: Problem, steps: int, after_step: Callable[[dict[str, Any]], None]) -> None:
    """The first steps of the demo's fit."""
    run = problem.run
    (stage,) = make_schedule(problem)
    reconstruct(
        problem.scene,
        make_observations(problem),
        make_unknowns(problem),
        loss=build.build_section(run, "loss"),
        optimizer=build.build_section(run, "optimizer"),
        schedule=replace(stage, steps=steps),
        callbacks=[Report(after_step)],
        seed=run.seed,
    )


def wall_and_kernels(problem: Problem, steps: int) -> list[dict[str, float]]:
    """Time and kernels of every step."""
    rows: list[dict[str, float]] = []
    begun = perf_counter()

    def after_step(row: dict[str, Any]) -> None:
        nonlocal begun
        taken, kernels = perf_counter() - begun, dr.kernel_history()
        milliseconds = sum(kernel["execution_time"] for kernel in kernels)
        rows.append({"step": taken, "kernels": milliseconds / 1e3, "kernel_count": len(kernels)})
        begun = perf_counter()

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        fit(problem, steps, after_step)
        dr.kernel_history_clear()
    return rows


def torch_operations(problem: Problem, steps: int) -> list[dict[str, float]]:
    """Time of torch's operations in every step, the backward pass included."""
    rows: list[dict[str, float]] = []

    def fresh() -> torch.profiler.profile:
        profiler = torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU])
        profiler.start()
        return profiler

    profiler = fresh()

    def after_step(row: dict[str, Any]) -> None:
        nonlocal profiler
        profiler.stop()
        seconds = {"convolutions": 0.0, "torch": 0.0}
        for event in profiler.key_averages():
            if event.key.startswith("aten::"):
                shaping = any(word in event.key for word in CONVOLUTIONS)
                kind = "convolutions" if shaping else "torch"
                seconds[kind] += event.self_cpu_time_total / 1e6
        rows.append(seconds)
        profiler = fresh()

    fit(problem, steps, after_step)
    profiler.stop()
    return rows


def measure(steps: int = STEPS, skipped: int = SKIPPED) -> dict[str, Any]:
    """Medians over the steps; fewer steps in tests only."""
    problem = build_problem(load_run(RUN), Console(quiet=True))
    first, second = wall_and_kernels(problem, steps), torch_operations(problem, steps)
    rows = [one | other for one, other in zip(first, second, strict=True)][skipped:]
    found: dict[str, Any] = {key: statistics.median(row[key] for row in rows) for key in rows[0]}
    parts = found["kernels"] + found["convolutions"] + found["torch"]
    found["rest"] = max(0.0, found["step"] - parts)
    found["step_over_kernels"] = found["step"] / found["kernels"]
    return found | {"steps": len(rows)}


def table(metrics: dict[str, Any]) -> MetricTable:
    """A row a metric."""
    shown = MetricTable("One step of the demo's fit [s]", REQUIRED)
    shown.rows(metrics, COUNTED)
    return shown


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/steps"))
    parser.add_argument("--steps", type=int, default=STEPS)
    given = parser.parse_args()
    metrics = measure(given.steps)
    write(metrics, table(metrics).grid, given.out)


if __name__ == "__main__":
    main()
