"""Basin of attraction: from how far off does a fit find a panel, in range and in direction?

    python benchmarks/basin.py [-o DIR]

Prints a table and writes `metrics.json` and `basin.png` into DIR (default `out/basin`).

A rough panel of 0.6 m (random phases, so fully developed speckle) faces a radar of 2 GHz and 16
antennas, 3 m away; the radar looks from 16 places on a vertical rail, so that the data are 16 looks
at the speckle. They are exact beat signals with noise. A fit seeks range and direction
at once. It starts some range cells, or some beamwidths along the arc about the radar, off the
truth, and converges if it ends within half a range cell and half a beamwidth of it. A seed is one
realisation of speckle and noise, and converges at an offset if the fits from both sides do. The
basin is the largest offset up to which 19 of 20 seeds converge; no larger one is tried once a
second seed has failed.

- `simulate_exact`: the model is the exact signals (visibility fixed, derivations §4). It is given
the phases
  of the data's scatterers, which a user never has. The loss compares power spectra.
- `gaussian`: the paper's kernels (Gaussian pulse, Airy lobe) on powers, no extra width.
- `dirichlet`: the response without a window, no extra width; the data have no window either, and
  finer bins, which it needs.
- `surrogate`: annealed. Extra widths fall to zero, and a last stage of its own has none: it fits
  the exact mean response of the radar. Like `gaussian` and `dirichlet` it knows no phases.

`final_error_cells` and `final_error_beamwidths` are what 19 of 20 seeds stay within after the last
stage, from the required offsets. All fits are `invertwin.reconstruct` with one loss.
All surrogates take equally many steps, `simulate_exact` takes fewer. Only the rate of
`simulate_exact` was compared
with others (0.1 and 1 on two seeds); surrogates of fixed width may do better at rates of their own.
"""

import argparse
import json
import math
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import takewhile
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from report import verdict
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from invertwin.capture import Capture
from invertwin.channel import Grid, Sampling, Speckle, draw_speckle
from invertwin.inversion import Observation, Optimizer, Schedule, SpectrumLoss, reconstruct
from invertwin.models.radar import ExactMap, SurrogateMap
from invertwin.radar import FMCW, Radar, Surrogate
from invertwin.scene import AntennaArray, Object, RoughDielectric, Scene
from invertwin.scene.antenna import linear_array
from invertwin.scene.pose import rigid, rotation_from_vector
from invertwin.scene.shapes import plate
from invertwin.simulation import simulate

SEEDS = 20
MAY_FAIL = 1 / 20
CONVERGED = 0.5  # range cells and beamwidths
LOSS = SpectrumLoss(kind="likelihood")
AXES = ("cells", "beamwidths")
OFFSETS: dict[str, dict[str, Sequence[float]]] = {
    "exact": {"cells": (0.5, 1.0, 2.0), "beamwidths": (0.5, 1.0, 2.0)},
    "gaussian": {"cells": (1.0, 2.0, 4.0, 8.0), "beamwidths": (1.0, 2.0, 3.0, 4.0)},
    "dirichlet": {"cells": (1.0, 2.0, 4.0, 8.0), "beamwidths": (1.0, 2.0, 3.0, 4.0)},
    "surrogate": {"cells": (6.0, 12.0, 18.0, 24.0), "beamwidths": (1.5, 3.0, 4.0, 5.0)},
}
REQUIRED = {"cells": 18.0, "beamwidths": 3.0}  # of the surrogate
REQUIRED_ERROR = 0.05  # cells
DISTANCE, SIZE = 3.0, 0.6  # m
LOOKS, RAIL_STEP = 16, 0.03  # m: more than λR/2 over the size, so that speckle is new
DENSITY = 300.0  # scatterers per m²
SNR_DB = 20.0
WAVEFORM = FMCW(start_frequency=76e9, bandwidth=2e9, duration=50e-6, samples=128)


class Stage(NamedTuple):
    """A fit, from where the one before ended; rates in cells and beamwidths."""

    kernel: Surrogate | str
    steps: int
    rate: float
    final_rate: float


STAGES = {
    "exact": (Stage("exact", 30, 0.3, 0.015),),
    "gaussian": (Stage("gaussian", 70, 0.5, 0.01),),
    "dirichlet": (Stage("dirichlet", 70, 0.5, 0.01),),
    "surrogate": (
        Stage(Surrogate(range_width=8.0, angle_width=1.5), 45, 1.0, 0.1),
        Stage("response", 25, 0.15, 0.01),
    ),
}
ANNEALING = 0.8  # of the first stage


class Place(nn.Module):
    """Where the panel is, off the truth: along the line of sight, and on the arc about the radar.

    Attributes:
        cells: Parameter [range cells].
        beamwidths: Parameter [beamwidths in u].
    """

    def __init__(self, cells: float, beamwidths: float, beamwidth: float) -> None:
        super().__init__()
        self.cells = nn.Parameter(torch.tensor(cells, dtype=torch.float64))
        self.beamwidths = nn.Parameter(torch.tensor(beamwidths, dtype=torch.float64))
        self._beamwidth = beamwidth

    def forward(self, scene: Scene) -> Scene:
        """The scene with the panel moved; it goes on facing the radar."""
        distance = DISTANCE + WAVEFORM.range_resolution * self.cells
        angle = torch.asin((self._beamwidth * self.beamwidths).clamp(-0.95, 0.95))
        zero = torch.zeros_like(angle)
        place = distance * torch.stack([torch.cos(angle), torch.sin(angle), zero])
        turn = rotation_from_vector(torch.stack([zero, zero, angle]))
        return scene.replace("panel", pose=rigid(turn, place))


@dataclass(frozen=True)
class Task:
    """One realisation: scene, radar, scatterers and their data."""

    seed: int
    radar: Radar
    grid: Grid
    scene: Scene
    speckle: Speckle
    beat: Tensor

    @staticmethod
    def draw(seed: int) -> "Task":
        """Speckle and noise of a seed."""
        rail = torch.zeros(LOOKS, 3, dtype=torch.float64)
        rail[:, 2] = RAIL_STEP * (torch.arange(LOOKS) - 0.5 * (LOOKS - 1))
        receivers = linear_array(16, WAVEFORM.wavelength / 2)
        transmitter = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
        radar = Radar(transmitter, receivers, WAVEFORM, rail)
        grid = _grid(radar, oversample=2)
        panel = Object(plate(SIZE, SIZE), RoughDielectric(permittivity=4.0))
        with torch.no_grad():
            scene = Place(0.0, 0.0, radar.beamwidth[0])(Scene({"panel": panel}))
            drawn = Sampling(depth=1, points_per_m2=DENSITY)
            speckle = draw_speckle(scene, radar.link(), drawn, seed)
            found = simulate(
                scene, radar, grid, seed=seed, sampling=drawn, speckle=speckle, snr_db=SNR_DB
            )
        return Task(seed, radar, grid, scene, speckle, found.beat)

    def fit(self, method: str, cells: float, beamwidths: float) -> tuple[float, float]:
        """Where a method takes the panel from a start [range cells, beamwidths off the truth]."""
        radar, grid = self.radar, self.grid
        if method == "dirichlet":
            radar = replace(radar, window="rectangular")
            grid = _grid(radar, oversample=3)
        module = Place(cells, beamwidths, radar.beamwidth[0])
        drawn = Sampling(depth=1, samples=10_000, boundary_samples=2_000)
        for stage in STAGES[method]:
            model = (
                ExactMap(grid, replace(drawn, boundary=False), self.speckle)
                if stage.kernel == "exact"
                else SurrogateMap(grid, stage.kernel, drawn)
            )
            reconstruct(
                self.scene,
                Observation(model, Capture.from_beat(self.beat, radar)),
                module,
                loss=LOSS,
                optimizer=Optimizer(rate=stage.rate, final_rate=stage.final_rate),
                schedule=Schedule(stage.steps, annealing=ANNEALING),
                seed=self.seed,
            )
        return float(module.cells.detach()), float(module.beamwidths.detach())


def _grid(radar: Radar, oversample: int) -> Grid:
    """Fine in range, at the Nyquist step in direction."""
    fine, coarse = (radar.grid(0.9, 5.25, oversample=o) for o in (oversample, 1))
    return replace(fine, u_start=coarse.u_start, u_step=coarse.u_step, u_count=coarse.u_count)


def errors(method: str, axis: str, offset: float, seed: int) -> tuple[float, float]:
    """The larger |error| of the fits of a seed from both sides: range cells, beamwidths.

    The second side is left out once the first has failed.
    """
    worst = 0.0, 0.0
    for side in (1.0, -1.0):
        start = (side * offset, 0.0) if axis == "cells" else (0.0, side * offset)
        end = _task(seed).fit(method, *start)
        worst = max(worst[0], abs(end[0])), max(worst[1], abs(end[1]))
        if max(worst) > CONVERGED:
            break
    return worst


def _one_thread() -> None:
    import drjit as dr

    dr.set_thread_count(1)
    torch.set_num_threads(1)


@lru_cache(maxsize=SEEDS)
def _task(seed: int) -> Task:
    return Task.draw(seed)


Found = dict[float, list[tuple[float, float]]]  # offset → errors of the seeds tried


def trial(pool: ProcessPoolExecutor, method: str, axis: str, offset: float, seeds: int) -> list:
    """Errors of the seeds at one offset, until one more has failed than may."""
    jobs = [pool.submit(partial(errors, method, axis, offset), s) for s in range(1, seeds + 1)]
    rows: list[tuple[float, float]] = []
    for job in jobs:
        rows.append(job.result())
        if failures(rows) > seeds * MAY_FAIL:
            for waiting in jobs:
                waiting.cancel()
            break
    return rows


def failures(rows: Sequence[tuple[float, float]]) -> int:
    """Seeds that did not converge."""
    return sum(max(row) > CONVERGED for row in rows)


def all_trials(
    offsets: dict[str, dict[str, Sequence[float]]], seeds: int
) -> dict[str, dict[str, Found]]:
    """Errors by axis, method and offset; a method stops at the end of its basin."""
    found: dict[str, dict[str, Found]] = {axis: {} for axis in AXES}
    # Each fit is small: a process per core does more than threads inside of one.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn"), _one_thread) as pool:
        for method, listed in offsets.items():
            for axis, values in listed.items():
                rows = found[axis].setdefault(method, {})
                for offset in values:
                    rows[offset] = trial(pool, method, axis, offset, seeds)
                    print(f"{method}, {offset:g} {axis}: {_share(rows[offset])}", flush=True)
                    if failures(rows[offset]) > seeds * MAY_FAIL:
                        break
    return found


def basin(found: Found, seeds: int) -> float:
    """Largest offset up to which all but a twentieth of the seeds converge; 0 if none."""
    held = takewhile(lambda at: failures(found[at]) <= seeds * MAY_FAIL, sorted(found))
    return max(held, default=0.0)


def bound(rows: Sequence[tuple[float, float]], axis: int, seeds: int) -> float:
    """What all but a twentieth of the seeds stay within."""
    ordered = sorted(row[axis] for row in rows)
    return ordered[len(ordered) - 1 - int(seeds * MAY_FAIL)]


def table(found: dict[str, Found], axis: str) -> Table:
    """Offset × method → seeds converged of those tried."""
    title = f"Seeds that converge, of those tried, by starting offset in {axis}"
    grid = Table(title=title, title_justify="left")
    grid.add_column("offset", justify="right")
    for method in found:
        grid.add_column(method, justify="right")
    for offset in sorted({offset for of in found.values() for offset in of}):
        cells = (_share(of[offset]) if offset in of else "" for of in found.values())
        grid.add_row(f"{offset:g}", *cells)
    return grid


def _share(rows: Sequence[tuple[float, float]]) -> str:
    return f"{len(rows) - failures(rows)}/{len(rows)}"


def picture(found: dict[str, dict[str, Found]], path: Path) -> None:
    """Share of the tried seeds that converge against the offset, as PNG."""
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    for axis, axes in zip(AXES, figure.subplots(1, 2, sharey=True), strict=True):
        for method, of in found[axis].items():
            share = [100 * (1 - failures(rows) / len(rows)) for rows in of.values()]
            axes.plot(list(of), share, "o-", label=method)
        axes.axhline(100 * (1 - MAY_FAIL), color="gray", linestyle=":", linewidth=1)
        axes.axvline(REQUIRED[axis], color="gray", linestyle="--", linewidth=1)
        axes.set_xlabel(f"starting offset [{axis}]")
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_major_formatter("{x:.0f} %")
        axes.legend(title="converged")
    FigureCanvasAgg(figure).print_png(path)


def measure(
    out: Path, offsets: dict[str, dict[str, Sequence[float]]] | None = None, seeds: int = SEEDS
) -> dict[str, Any]:
    """All metrics and the picture; fewer offsets and seeds in tests only."""
    start = perf_counter()
    found = all_trials(offsets or OFFSETS, seeds)
    out.mkdir(parents=True, exist_ok=True)
    picture(found, out / "basin.png")
    metrics: dict[str, Any] = {
        f"basin_{axis}": {method: basin(of, seeds) for method, of in found[axis].items()}
        for axis in AXES
    }
    for i, axis in enumerate(AXES):
        rows = found[axis].get("surrogate", {}).get(REQUIRED[axis])
        metrics[f"final_error_{axis}"] = bound(rows, i, seeds) if rows else None
    metrics |= {
        "converged": {
            axis: {
                method: {f"{offset:g}": _share(rows) for offset, rows in of.items()}
                for method, of in found[axis].items()
            }
            for axis in AXES
        },
        "seeds": seeds,
        "range_cell_m": WAVEFORM.range_resolution,
        "beamwidth_u": _task(1).radar.beamwidth[0],
        "seconds": perf_counter() - start,
    }
    (out / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
    for axis in AXES:
        Console().print(table(found[axis], axis))
    return metrics


def verdicts(metrics: dict[str, Any]) -> list[str]:
    """What must hold, and whether it does."""
    lines = []
    for axis, least in REQUIRED.items():
        value = metrics[f"basin_{axis}"]["surrogate"]
        lines.append(f"basin_{axis}.surrogate {verdict(value, ('>=', least))}")
    error = metrics["final_error_cells"]
    held = verdict(math.inf if error is None else error, ("<=", REQUIRED_ERROR))
    return [*lines, f"final_error_cells {held}"]


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/basin"))
    out = parser.parse_args().out
    metrics = measure(out)
    for axis in AXES:
        for method, value in metrics[f"basin_{axis}"].items():
            print(f"basin_{axis}.{method} = {value:g}")
    for axis in AXES:
        print(f"final_error_{axis} = {metrics[f'final_error_{axis}']}")
    for line in verdicts(metrics):
        print(f"must hold: {line}")
    print(f"wrote {out / 'metrics.json'} and {out / 'basin.png'} in {metrics['seconds']:.0f} s")


if __name__ == "__main__":
    main()
