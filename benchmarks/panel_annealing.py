"""Simulated annealing of a metasurface, beside what a fit of the same run file has found.

    python benchmarks/panel_annealing.py RUN_FOLDER [-o DIR] [--starts N] [--times N]

RUN_FOLDER is that of `invertwin reconstruct experiments/metasurface.toml`. From random placements,
annealing gets up to N times the evaluations of a fit (default 10; a derivative counts for two), and
ends early at 0.95 of the level of that fit. `metrics.json` goes into DIR (default
`out/panel_annealing`): medians over starts (default 3).

- `annealing_over_exhaustive`: path gain of the worst receivers over that of the best of the grid.
- `evaluations_ratio`: evaluations of the fit over those of annealing; where annealing does not get
  there, over all that it had.
- `annealing_reached`: starts from which it got there.
"""

import argparse
import json
import math
import statistics
from pathlib import Path
from typing import Any

import torch
from report import MetricTable, Required, write
from rich.console import Console

from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.problem import Problem
from invertwin.cli.run_file import load_run
from invertwin.cli.schema.placement import RandomPanels
from invertwin.links import ElementPhases, PanelPlacement
from invertwin.seeds import derive_seed

AS_GOOD = 0.95
REQUIRED: Required = {"evaluations_ratio": ("<=", 1.0)}
COUNTED = {
    "annealing_over_exhaustive": (".3g", "worst receivers, over the best of the grid"),
    "evaluations_ratio": (".3g", "evaluations of the fit, over those of annealing"),
    "annealing_reached": (".3g", "starts from which annealing got as far"),
}


class Annealing:
    """The unknowns of a panel, and the level of its worst receivers.

    Args:
        problem: With `[placement]`.
    """

    def __init__(self, problem: Problem) -> None:
        self.table: Any = problem.run.placement
        item = problem.first_sensor
        self.coverage, self.panel = item.recording, item.sensor
        self.aim = self.coverage.part(slice(0, self.table.receivers.batch))
        self.scored = problem.reference

    def level(self, module: torch.nn.Module, scored: bool = False) -> float:
        """Level of the worst receivers [dB], of those that the fit sees or of the others."""
        with torch.no_grad():
            return float((self.scored if scored else self.aim).aim(module(self.panel)))

    def anneal(self, evaluations: int, seed: int, enough: float) -> tuple[torch.nn.Module, int]:
        """The best placement, and the evaluations until it was good enough, or all.

        Half of the moves change position, yaw and spread, from the whole range down to a
        hundredth; the others add a random wave to the phases. The temperature falls from 3 dB to
        0.03 dB.

        Args:
            evaluations: Most of them.
            seed: Of all random numbers.
            enough: Level at which it ends [dB].
        """
        chance = torch.Generator().manual_seed(seed)
        (trial,) = RandomPanels(kind="panels", count=1).trials(self.table, chance)
        phases = ElementPhases(self.table.panel.counts)
        here = torch.nn.Sequential(self.table.place(self.coverage, trial), phases)
        level = best = self.level(here)
        kept = top = {name: value.clone() for name, value in here.state_dict().items()}
        for count in range(1, evaluations):
            if best >= enough:
                break
            part = count / evaluations
            self.disturb(here, 0.01**part, chance)
            found = self.level(here)
            drawn = float(torch.rand((), generator=chance))
            if drawn < math.exp(min(0.0, (found - level) / (3.0 * 0.01**part))):
                level, kept = found, {n: v.clone() for n, v in here.state_dict().items()}
            else:
                here.load_state_dict(kept)
            if level > best:
                best, top = level, kept
        else:
            count = evaluations
        here.load_state_dict(top)
        return here, count

    @torch.no_grad()
    def disturb(self, here: torch.nn.Module, size: float, chance: torch.Generator) -> None:
        """Make a random move, of a share of the ranges."""
        placed, phases = here.children()
        assert isinstance(placed, PanelPlacement)
        assert isinstance(phases, ElementPhases)
        u = torch.randn(8, generator=chance, dtype=torch.float64)
        if torch.rand((), generator=chance) < 0.5:
            placed.along.add_(0.3 * size * placed.path.length * u[0])
            placed.yaw.add_(size * math.radians(self.table.yaw_limit_deg) * u[1])
            placed.spread.add_(size * math.radians(self.table.spread_limit_deg) * u[2:4])
            return
        x, y = (torch.linspace(-1, 1, n, dtype=torch.float64) for n in phases.shift.shape)
        wave = torch.cos(3 * u[4] * x[:, None] + 3 * u[5] * y + math.pi * u[6])
        phases.shift.add_(size * u[7] * wave)


def compare(problem: Problem, fits: dict[str, Any], starts: int, times: int) -> dict[str, Any]:
    """Anneal from several starts, beside the fits of as many.

    Args:
        problem: With `[placement]`.
        fits: Metrics of the run.
        starts: Number of starts.
        times: Evaluations, times those of a fit.
    """
    own, rows = Annealing(problem), []
    for number, row in enumerate(fits["starts"][:starts]):
        enough = row["level_db"] + 10 * math.log10(AS_GOOD)
        seed = derive_seed(problem.run.seed, 2, number)
        module, count = own.anneal(times * row["evaluations"], seed, enough)
        ratio = 10 ** ((own.level(module, scored=True) - fits["worst_exhaustive_db"]) / 10)
        reached = own.level(module) >= enough
        rows.append(
            {
                "annealing_over_exhaustive": ratio,
                "annealing_evaluations": count,
                "annealing_reached": reached,
                "evaluations_ratio": row["evaluations"] / count,
            }
        )
        print(f"start {number + 1}: {ratio:.3f} of the grid after {count} evaluations", flush=True)
    found = {key: statistics.median(row[key] for row in rows) for key in list(COUNTED)[:2]}
    return {
        **found,
        "successes_annealing": sum(r["annealing_over_exhaustive"] >= AS_GOOD for r in rows),
        "annealing_reached": sum(row["annealing_reached"] for row in rows),
        "starts": rows,
    }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/panel_annealing"))
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--times", type=int, default=10)
    given = parser.parse_args()
    problem = build_problem(load_run(given.run / "run.toml"), Console())
    fits = json.loads((given.run / "metrics.json").read_text(encoding="utf-8"))
    metrics = compare(problem, fits, given.starts, given.times)
    table = MetricTable("Annealing of a metasurface", REQUIRED)
    table.rows(metrics, COUNTED)
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
