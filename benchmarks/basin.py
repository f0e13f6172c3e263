"""Basin of attraction: from how far does a fit find a wall, by the exact signal or the surrogate?

    python benchmarks/basin.py [-o DIR]

Prints a table and writes `metrics.json` and `basin.png` into DIR (default `out/basin`).

A rough finite wall (random phases, so fully developed speckle) stands 3 m before the radar; the
data is its exact beat signal with noise. A fit starts with the wall some range cells off and
moves it in range by Adam. It converges if it ends within half a range cell of the truth. A seed
is one realisation of speckle and noise, and converges at an offset if the fits from both sides
do. The basin is the largest offset up to which 19 of 20 seeds converge.

- `exact`: the exact chain is differentiated (visibility fixed, derivations §4). The model is given
  the very phases of the data's scatterers; the loss compares power spectra.
- `exact_beat`: the same, but the loss compares the beat signals, phases included; it has a minimum
  in every half wavelength.
- `surrogate`: `invertwin.reconstruct` with annealed widths. It knows nothing of the phases.

The loss of spectra, the optimiser and the number of steps are the same for all. The exact chain
has its own rate, the best for it of 3, 10, 20 and 50 mm. A start within half a cell counts as
converged unless it is led away.
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import takewhile
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor, nn

from invertwin.capture import Capture
from invertwin.channel.paths import Grid
from invertwin.channel.tracer import RoughPoints, rough_points, trace_field
from invertwin.inversion.loss import SpectrumLoss
from invertwin.inversion.reconstruction import Optimizer, reconstruct
from invertwin.radar import FMCW, Radar, Surrogate
from invertwin.radar.range_profile import beat_signal
from invertwin.radar.spectrum import exact_spectrum
from invertwin.scene import AntennaArray, Isotropic, Object, RoughDielectric, Scene
from invertwin.scene.antenna import linear_array
from invertwin.scene.pose import rigid
from invertwin.scene.shapes import plate
from invertwin.simulation import simulate

SEEDS = 20
MAY_FAIL = 1 / 20
CONVERGED = 0.5  # range cells
STEPS = 60
RATES = {"exact": 0.01, "exact_beat": 0.01, "surrogate": 0.05}  # m
LOSS = SpectrumLoss(kind="likelihood")
OFFSETS: dict[str, Sequence[float]] = {
    "exact": (0.25, 0.5, 1.0, 2.0, 3.0),
    "exact_beat": (0.25, 0.5, 1.0, 2.0),
    "surrogate": (2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 20.0, 24.0),
}
REQUIRED = 9.3  # range cells, of the surrogate
DISTANCE, SIZE = 3.0, 1.5  # m
DENSITY = 1500.0  # scatterers per m²
SNR_DB = 20.0
WAVEFORM = FMCW(start_frequency=76e9, bandwidth=2e9, duration=50e-6, samples=128)


class Displacement(nn.Module):
    """Moves the wall along the boresight [m]."""

    applies_to = "scene"

    def __init__(self, start: float) -> None:
        super().__init__()
        self.distance = nn.Parameter(torch.tensor(start, dtype=torch.float64))

    def forward(self, scene: Scene) -> Scene:
        """The scene with the wall moved."""
        place = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) * (DISTANCE + self.distance)
        return scene.replace("wall", pose=rigid(torch.eye(3, dtype=torch.float64), place))


@dataclass(frozen=True)
class Task:
    """One realisation: scene, radar, scatterers and their data."""

    seed: int
    radar: Radar
    grid: Grid
    scene: Scene
    points: RoughPoints
    beat: Tensor

    @staticmethod
    def draw(seed: int) -> "Task":
        """Speckle and noise of a seed."""
        receivers = linear_array(4, WAVEFORM.wavelength / 2)
        transmitter = AntennaArray(torch.zeros(1, 3, dtype=torch.float64), Isotropic())
        radar = Radar(transmitter, receivers, WAVEFORM, torch.zeros(1, 3, dtype=torch.float64))
        grid = radar.grid(0.5, 6.0)
        wall = Object(plate(SIZE, SIZE), RoughDielectric(permittivity=4.0))
        with torch.no_grad():
            scene = Displacement(0.0)(Scene({"wall": wall}))
            points = rough_points(scene, DENSITY, seed)
            found = simulate(scene, radar, grid, points=points, snr_db=SNR_DB, seed=seed)
        assert found.beat is not None
        return Task(seed, radar, grid, scene, points, found.beat)

    def exact(self, start: float, rate: float, by_spectrum: bool) -> float:
        """Where the exact chain takes the wall from a start [m]."""
        module, rates = Displacement(start), Optimizer(rate=rate)
        optimizer = rates.build(module)
        measured = exact_spectrum(self.beat, self.radar, self.grid)
        scale = self.beat.abs().square().mean()
        for step in range(STEPS):
            rates.apply(optimizer, step / STEPS)
            optimizer.zero_grad()
            paths = trace_field(
                module(self.scene),
                self.radar.link(),
                points=self.points,
                seed=self.seed,
                boundary=False,
            )
            beat = beat_signal(paths, self.radar, tolerance=1e-6)
            if by_spectrum:
                value = LOSS(exact_spectrum(beat, self.radar, self.grid), measured)
            else:
                value = (beat - self.beat).abs().square().mean() / scale
            value.backward()
            optimizer.step()
        return float(module.distance.detach())

    def surrogate(self, start: float, rate: float) -> float:
        """Where the library's reconstruction takes the wall from a start [m]."""
        module = Displacement(start)
        reconstruct(
            self.scene,
            self.radar,
            Capture.from_beat(self.beat, self.radar),
            [module],
            grid=self.grid,
            loss=LOSS,
            surrogate=Surrogate(range_width=6.0),
            optimizer=Optimizer(rate=rate),
            steps=STEPS,
            samples=20_000,
            boundary_samples=2_000,
            seed=self.seed,
        )
        return float(module.distance.detach())

    def fit(self, method: str, start: float) -> float:
        """Dispatch by method name."""
        if method == "surrogate":
            return self.surrogate(start, RATES[method])
        return self.exact(start, RATES[method], by_spectrum=method == "exact")


def converged(method: str, offset: float, seed: int) -> bool:
    """Whether the fits of a seed from both sides end at the truth."""
    task, cell = _task(seed), WAVEFORM.range_resolution
    ends = (task.fit(method, side * offset * cell) / cell for side in (1.0, -1.0))
    return all(abs(end) <= CONVERGED for end in ends)


def _one_thread() -> None:
    import drjit as dr

    dr.set_thread_count(1)


@lru_cache(maxsize=SEEDS)
def _task(seed: int) -> Task:
    return Task.draw(seed)


def success_counts(offsets: dict[str, Sequence[float]], seeds: int) -> dict[str, dict[float, int]]:
    """Converged seeds by method and offset [range cells].

    A method stops at the first offset from which fewer than a quarter of the seeds converge.
    """
    counts: dict[str, dict[float, int]] = {}
    quiet = not sys.stdout.isatty()
    # Each fit is small: a process per core does more than threads inside of one.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn"), _one_thread) as pool:
        for method, listed in offsets.items():
            counts[method] = {}
            for offset in track(listed, f"{method:10}", transient=True, disable=quiet):
                fit = partial(converged, method, offset)
                counts[method][offset] = sum(pool.map(fit, range(1, seeds + 1)))
                if counts[method][offset] < seeds / 4:
                    break
    return counts


def basin(counts: dict[float, int], seeds: int) -> float:
    """Largest offset up to which all but a twentieth of the seeds converge; 0 if none."""
    held = takewhile(lambda offset: counts[offset] >= seeds - seeds * MAY_FAIL, sorted(counts))
    return max(held, default=0.0)


def table(counts: dict[str, dict[float, int]], seeds: int) -> Table:
    """Offset × method → seeds converged."""
    title = f"Seeds of {seeds} that converge, by starting offset in range cells"
    grid = Table(title=title, title_justify="left")
    grid.add_column("offset", justify="right")
    for method in counts:
        grid.add_column(method, justify="right")
    for offset in sorted({offset for of in counts.values() for offset in of}):
        grid.add_row(f"{offset:g}", *(str(of.get(offset, "")) for of in counts.values()))
    return grid


def picture(counts: dict[str, dict[float, int]], seeds: int, path: Path) -> None:
    """Share of the seeds that converge against the offset, as PNG."""
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.add_subplot(xlabel="starting offset [range cells]", ylabel="converged")
    for method, of in counts.items():
        axes.plot(list(of), [100 * count / seeds for count in of.values()], "o-", label=method)
    axes.axhline(100 * (1 - MAY_FAIL), color="gray", linestyle=":", linewidth=1)
    axes.axvline(REQUIRED, color="gray", linestyle="--", linewidth=1)
    axes.yaxis.set_major_formatter("{x:.0f} %")
    axes.legend()
    FigureCanvasAgg(figure).print_png(path)


def measure(
    out: Path, offsets: dict[str, Sequence[float]] | None = None, seeds: int = SEEDS
) -> dict[str, Any]:
    """All metrics and the picture; fewer offsets and seeds in tests only."""
    start = perf_counter()
    counts = success_counts(offsets or OFFSETS, seeds)
    out.mkdir(parents=True, exist_ok=True)
    picture(counts, seeds, out / "basin.png")
    metrics = {
        "basin_cells": {method: basin(of, seeds) for method, of in counts.items()},
        "largest_offset_tried": {method: max(of) for method, of in counts.items()},
        "converged": {
            method: {f"{offset:g}": count for offset, count in of.items()}
            for method, of in counts.items()
        },
        "seeds": seeds,
        "range_cell_m": WAVEFORM.range_resolution,
        "steps": STEPS,
        "seconds": perf_counter() - start,
    }
    (out / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
    Console().print(table(counts, seeds))
    return metrics


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/basin"))
    out = parser.parse_args().out
    metrics = measure(out)
    for method, cells in metrics["basin_cells"].items():
        print(f"basin_cells.{method} = {cells:g}")
    verdict = "holds" if metrics["basin_cells"]["surrogate"] >= REQUIRED else "DOES NOT HOLD"
    print(f"must hold: basin_cells.surrogate >= {REQUIRED}: {verdict}")
    print(f"wrote {out / 'metrics.json'} and {out / 'basin.png'} in {metrics['seconds']:.0f} s")


if __name__ == "__main__":
    main()
