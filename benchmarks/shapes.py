"""Shapes of twenty cars from radar: what does a learned prior know that free vertices do not?

    python benchmarks/shapes.py [-o DIR] [--cars N] [--workers N | --engine ray]

Prints a table and writes `metrics.json` and `shapes.png` into DIR (default `out/shapes`). Cars that
an interrupted run has finished are not fitted again. `--workers N` fits N cars at a time in
processes of one thread; `--engine ray` gives them to a Ray cluster. The fits are the same; their
times are those of one thread beside others.

Radar, data, fits and metrics are those of `experiments/shape_car_prior_public.toml`; every car has
a shape, start, speckle and noise of its own. The cars are drawn from the public learned space of
vehicles (coordinates of a normal distribution, cut at two standard deviations), which the prior of
the package has never seen: it was trained on procedural cars. Settings were chosen on other cars of
that space than these. A start is the prior's mean car, 0.3 m off in some direction on the road and
turned by 10° to some side. From the same data and start are fitted:

- `pose_only`: place and heading of the mean car, by Adam.
- `free`: these, and its vertices, which move in smooth steps, by Adam: too many for Gauss–Newton.
- `prior_shape`: these, and the coordinates of the prior, 27 numbers, by Gauss–Newton, whose steps
cost
  more: `seconds_ratio` compares times.

Distances and volumes are those of the whole car, the side that no position sees included; `_seen`
are restricted to the surface that some position sees. Medians over the cars:

- `chamfer_ratio`: Chamfer distance of `prior_shape` over that of `pose_only`.
- `iou_gain`: volume IoU of `prior_shape` minus that of `pose_only`.
- `iteration_ratio`: the iteration at which `prior_shape` is first as near as `free` ends, over the
  iterations of `free`; infinite where it never is.
- `seconds_ratio`: the time until `prior_shape` is as near as `free` ends, over the time of `free`.
"""

import argparse
import hashlib
import json
import math
import statistics
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from invertwin.cli.fits.fitting import run_fit
from invertwin.cli.fits.kinds import build_problem
from invertwin.cli.fits.problem import OWN_METHOD, Start
from invertwin.cli.fits.spreading import FitWorkers
from invertwin.cli.run_file import load_run, to_minimal_toml, to_toml, validate_run
from invertwin.cli.schema import RunFile, build
from invertwin.runtime.engines import run_jobs
from invertwin.storage.run_folder import open_run

RUN = Path(__file__).parents[1] / "experiments" / "shape_car_prior_public.toml"
CARS = 20
MODES = {"pose_only": "pose_only", "free": "free", "prior": OWN_METHOD}
MODES_OF_SPACE = 78
CUT = 2.0  # standard deviations
DISTANCE, ANGLE_DEG = 0.3, 10.0  # of a start
KEPT = ("chamfer_m", "iou", "chamfer_seen_m", "iou_seen", "start_chamfer_m", "start_iou")
REQUIRED = {
    "chamfer_ratio": ("<=", 0.6),
    "iou_gain": (">=", 0.08),
    "iteration_ratio": ("<=", 1 / 3),
}

SHOWN = (*REQUIRED, "seconds_ratio")

Car = dict[str, Any]


def run_of(number: int, run: RunFile) -> RunFile:
    """The run file with the shape and start of a car."""
    draw = np.random.default_rng(number)
    shape = draw.normal(size=MODES_OF_SPACE).clip(-CUT, CUT).round(3).tolist()
    bearing, side = draw.uniform(0, 2 * math.pi), draw.choice([-1.0, 1.0])
    (part,) = run.truth["car"].parts or []
    truth = run.truth["car"].model_copy(
        update={"parts": [part.model_copy(update={"coefficients": shape})]}
    )
    there = [DISTANCE * math.sin(bearing), DISTANCE * math.cos(bearing), 0.0]
    start = run.scene["car"].model_copy(
        update={"position": there, "rotation_deg": _turned(truth.rotation_deg, side * ANGLE_DEG)}
    )
    return run.model_copy(update={"seed": number, "truth": {"car": truth}, "scene": {"car": start}})


def _turned(rotation_deg: Sequence[float] | None, heading_deg: float) -> list[float]:
    """A rotation vector, followed by a turn about the vertical."""
    first = Rotation.from_rotvec(rotation_deg or [0.0] * 3, degrees=True)
    turn = Rotation.from_rotvec([0.0, 0.0, heading_deg], degrees=True)
    return (turn * first).as_rotvec(degrees=True).tolist()


def fitted(run: RunFile) -> Car:
    """All fits of a car."""
    console = Console(quiet=True)
    problem = build_problem(run, console)
    found: Car = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = open_run(Path(scratch) / "car", {"car": to_toml(run)})
        for name, mode in MODES.items():
            row, _ = run_fit(problem, Start(problem.scene), 0, mode, folder, console, None)
            kept = {key: row[key] for key in KEPT if key in row}
            found[name] = kept | {key: row[key] for key in ("steps", "loss", "seconds", "curve")}
    return found


def key_of(run: RunFile) -> str:
    """What the fits of a car depend on: its run file, and the prior of the package."""
    mean = build.scene(run)["car"].mesh.vertices.numpy().round(6).tobytes()
    return hashlib.sha256(to_toml(run).encode() + mean).hexdigest()


def fitted_text(text: str) -> Car:
    """All fits of a car by its run file: what a worker does."""
    return fitted(validate_run(tomllib.loads(text), RUN))


def all_cars(
    out: Path, numbers: Sequence[int], run: RunFile, workers: FitWorkers | None = None
) -> dict[int, Car]:
    """The fits of the cars; those that are in the folder are read."""
    (out / "cars").mkdir(parents=True, exist_ok=True)
    found: dict[int, Car] = {}
    missing: dict[int, RunFile] = {}
    for number in numbers:
        own, path = run_of(number, run), out / "cars" / f"{number:02d}.json"
        known: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        if known.get("key") == key_of(own):
            found[number] = known["fits"]
            print(f"car {number}: {_line(found[number])}")
        else:
            missing[number] = own
    runs = list(missing.values())
    if workers is None:
        done = enumerate(map(fitted, runs))
    else:
        texts = [to_minimal_toml(own) for own in runs]
        done = run_jobs(fitted_text, texts, engine=workers.engine, workers=workers.count)
    for at, fits in done:
        number = list(missing)[at]
        kept = {"key": key_of(runs[at]), "fits": fits}
        (out / "cars" / f"{number:02d}.json").write_text(json.dumps(kept, indent=1) + "\n")
        found[number] = fits
        print(f"car {number}: {_line(fits)}", flush=True)
    return {number: found[number] for number in numbers}


def _line(car: Car) -> str:
    return ", ".join(f"{name} {100 * car[name]['chamfer_m']:.1f} cm" for name in MODES)


def compared(car: Car) -> dict[str, float]:
    """The numbers of one car whose medians count."""
    prior, pose, free = car["prior"], car["pose_only"], car["free"]
    reached = next((step for step, value in prior["curve"] if value <= free["chamfer_m"]), math.inf)
    return {
        "chamfer_ratio": prior["chamfer_m"] / pose["chamfer_m"],
        "iou_gain": prior["iou"] - pose["iou"],
        "iteration_ratio": reached / free["steps"],
        "seconds_ratio": reached / prior["steps"] * prior["seconds"] / free["seconds"],
    }


def summary(cars: dict[int, Car]) -> dict[str, Any]:
    """Medians over the cars, and the worst one, the highest ratio of distances."""
    rows = {number: compared(car) for number, car in cars.items()}
    metrics: dict[str, Any] = {
        key: statistics.median(row[key] for row in rows.values()) for key in SHOWN
    }
    worst = max(rows, key=lambda number: rows[number]["chamfer_ratio"])
    metrics["worst"] = {"car": worst, **rows[worst]}
    for key in KEPT:
        metrics[key] = {
            name: statistics.median(car[name][key] for car in cars.values())
            for name in MODES
            if all(car[name].get(key) is not None for car in cars.values())
        }
    metrics["fit_seconds"] = {
        name: statistics.median(car[name]["seconds"] for car in cars.values()) for name in MODES
    }
    metrics["cars"] = {str(number): row for number, row in rows.items()}
    return metrics


def table(cars: dict[int, Car], worst: int) -> Table:
    """Car × method → distance and shared volume; the worst is marked."""
    grid = Table(
        title="Chamfer distance [cm] and volume IoU of the whole car", title_justify="left"
    )
    grid.add_column("car", justify="right")
    for name in ("start", *MODES, "ratio", "iteration ratio"):
        grid.add_column(name, justify="right")
    for number, car in cars.items():
        row = compared(car)
        start = car["prior"]
        cells = [_cell(start["start_chamfer_m"], start["start_iou"])]
        cells += [_cell(car[name]["chamfer_m"], car[name]["iou"]) for name in MODES]
        cells += [f"{row['chamfer_ratio']:.2f}", f"{row['iteration_ratio']:.2f}"]
        grid.add_row(f"{number}{' worst' if number == worst else ''}", *cells)
    return grid


def _cell(chamfer: float, iou: float | None) -> str:
    return f"{100 * chamfer:.1f} / " + ("-" if iou is None else f"{iou:.2f}")


def picture(cars: dict[int, Car], worst: int, path: Path) -> None:
    """Distance against iteration: all cars and their median, and the worst car; as PNG."""
    figure = Figure(figsize=(9, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for i, name in enumerate(MODES):
        curves = [np.array(car[name]["curve"]) for car in cars.values()]
        for curve in curves:
            left.plot(curve[:, 0], 100 * curve[:, 1], color=f"C{i}", alpha=0.2, linewidth=0.7)
        middle = np.median([curve[:, 1] for curve in curves], axis=0)
        left.plot(curves[0][:, 0], 100 * middle, color=f"C{i}", label=name.replace("_", " "))
        alone = np.array(cars[worst][name]["curve"])
        right.plot(alone[:, 0], 100 * alone[:, 1], color=f"C{i}")
    left.set_title(f"{len(cars)} cars and their median")
    right.set_title(f"the worst, car {worst}")
    left.set_ylabel("Chamfer distance [cm]")
    left.set_ylim(bottom=0)
    left.legend()
    for axes in (left, right):
        axes.set_xlabel("iteration")
    FigureCanvasAgg(figure).print_png(path)


def measure(
    out: Path, count: int = CARS, run: RunFile | None = None, workers: FitWorkers | None = None
) -> dict[str, Any]:
    """All metrics and the picture; fewer cars and shorter fits in tests only."""
    start = perf_counter()
    cars = all_cars(out, range(1, count + 1), load_run(RUN) if run is None else run, workers)
    metrics: dict[str, Any] = {**summary(cars), "count": count, "seconds": perf_counter() - start}
    worst = metrics["worst"]["car"]
    picture(cars, worst, out / "shapes.png")
    text = json.dumps(_finite(metrics), indent=2, allow_nan=False)
    (out / "metrics.json").write_text(text + "\n")
    Console(width=110).print(table(cars, worst))
    return metrics


def _finite(value: Any) -> Any:
    """The same with null where a number is infinite, which JSON has not."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def verdicts(metrics: dict[str, Any]) -> list[str]:
    """What must hold, and whether it does."""
    lines = []
    for key, (sign, limit) in REQUIRED.items():
        holds = metrics[key] <= limit if sign == "<=" else metrics[key] >= limit
        lines.append(f"{key} {sign} {limit:.3g}: {'holds' if holds else 'DOES NOT HOLD'}")
    return lines


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/shapes"))
    parser.add_argument("--cars", type=int, default=CARS)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--engine", choices=("processes", "ray"), default="processes")
    given = parser.parse_args()
    metrics = measure(
        given.out, given.cars, workers=FitWorkers.from_options(given.engine, given.workers)
    )
    for key in SHOWN:
        print(f"{key} = {metrics[key]:.3g} (worst car {metrics['worst'][key]:.3g})")
    for line in verdicts(metrics):
        print(f"must hold: {line}")
    print(f"wrote {given.out / 'metrics.json'} and {given.out / 'shapes.png'}")


if __name__ == "__main__":
    main()
