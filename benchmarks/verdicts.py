"""Does a fit say when it is wrong? 100 fits of letters, boxes and a car from bad starts.

    python benchmarks/verdicts.py [-o DIR] [--fits 100]

A radar on a rail looks at one object before a wall. The object's place and yaw are unknown; the
fit starts up to 1 m and 180° off. An end is right within 5 cm and 10° of the truth, or of a turn
after which the object has the same surface. Prints a table and writes `metrics.json`:

- `wrong_called_consistent`: of the wrong ends, the share with the verdict "consistent".
- `right_called_consistent`: the same of the right ends.
- `right_first_with_starts`: the share of `search` over a grid of starts, 1 m and all turns about
  the same bad start, whose best end is right.

On one idle core 100 fits take some 50 minutes. Each is kept in `rows.jsonl` as it ends; the same
command goes on after an interruption. `--fits` stops earlier.
"""

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from report import MetricTable, Required, write

import invertwin as iw
from invertwin.inversion import Optimizer, displace, pose_error, pose_grid, sample_nearby_poses
from invertwin.inversion.metrics import PoseError
from invertwin.scene import (
    AntennaArray,
    Mesh,
    RoughDielectric,
    box,
    linear_array,
    plate,
    rigid,
    rotation_from_vector,
    text,
)
from invertwin.scene.files import load_mesh
from invertwin.scene.parameters import Pose

REQUIRED: Required = {
    "wrong_called_consistent": ("<=", 0.05),
    "right_called_consistent": (">=", 0.95),
    "right_first_with_starts": (">=", 0.95),
}
CAR = Path(__file__).resolve().parents[1] / "experiments" / "car.ply"
KINDS = ("L", "A", "box", "car")
PLACE, TURN = 0.05, math.radians(10.0)  # of a right end
FAR, STEP, TURNS = 1.0, 0.4, 6  # of starts [m], of the grid of starts [m], turns at each place
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
PAINT = RoughDielectric(permittivity=4.0)
CHIRP = iw.FMCW(start_frequency=77e9, bandwidth=3.6e9, duration=50e-6, samples=128)
SAMPLING = iw.Sampling(depth=1, samples=40_000, boundary_samples=8_000)
WIDTHS = iw.Surrogate(range_width=8.0, angle_width=1.0)
FIT: dict[str, Any] = {
    "loss": iw.SpectrumLoss(kind="likelihood", floor=0.02),
    "optimizer": Optimizer("gauss_newton", rate=0.3),
    "schedule": iw.Schedule(14, annealing=0.6),
}
SETTINGS = repr((PLACE, TURN, FAR, STEP, TURNS, CHIRP, SAMPLING, WIDTHS, FIT))


def radar() -> iw.Radar:
    """Twelve places on a rail of 2.2 m, eight antennas along it."""
    rail = torch.zeros(12, 3, dtype=torch.float64)
    rail[:, 1] = torch.linspace(-1.1, 1.1, 12)
    transmitter = AntennaArray(torch.zeros(1, 3, dtype=torch.float64))
    return iw.Radar(transmitter, linear_array(8, CHIRP.wavelength / 2), CHIRP, rail)


@dataclass(frozen=True)
class Trial:
    """One object, where it is, and a bad start.

    Attributes:
        number: Of the trial; all random numbers follow from it.
        kind: What the object is.
        truth: The scene.
        start: The object where the fit begins.
        parts: Parts of a whole turn after which the object has the same surface.
    """

    number: int
    kind: str
    truth: iw.Scene
    start: iw.Object
    parts: int

    @staticmethod
    def draw(number: int) -> "Trial":
        """The trial of a number."""
        chance = torch.Generator().manual_seed(1000 + number)

        def uniform(low: float, high: float) -> float:
            return low + (high - low) * float(torch.rand((), generator=chance, dtype=torch.float64))

        kind, facing = KINDS[number % len(KINDS)], math.pi
        if kind == "box":
            wide, tall, deep = uniform(0.4, 0.7), uniform(0.3, 0.5), uniform(0.2, 0.35)
            mesh = box([deep, wide, tall])
        elif kind == "car":
            car = load_mesh(str(CAR))
            broadside = rotation_from_vector(math.pi / 2 * UP)
            mesh = Mesh(0.2 * (car.vertices - car.center) @ broadside.T, car.faces)
        else:
            # From its edge a letter shows next to nothing.
            mesh, facing = text(kind, size=0.6, depth=0.12), math.radians(50)
        turn = rotation_from_vector(uniform(-facing, facing) * UP)
        left, ahead = uniform(-0.3, 0.3), uniform(1.9, 2.4)
        place = torch.tensor([ahead, left, 0.0], dtype=torch.float64)
        item = iw.Object(mesh, PAINT, rigid(turn, place - turn @ mesh.center))
        wall = iw.Object(plate(3.6, 1.6), PAINT, rigid(translation=[3.9, 0.0, 0.0]))
        limits: dict[str, Any] = {"distance": (0.0, FAR), "angle": (0.0, math.pi), "axes": "xy"}
        (start,) = sample_nearby_poses(item, rotation_axis=UP, generator=chance, **limits)
        parts = 1 if kind in ("L", "car") else 2
        return Trial(number, kind, iw.Scene({"object": item, "wall": wall}), start, parts)

    def error(self, found: iw.Scene) -> tuple[float, float]:
        """How far an end is from the truth [m, rad]."""
        angle, distance = min((off.angle, off.distance) for off in self.pose_errors(found))
        return distance, angle

    def pose_errors(self, found: iw.Scene) -> Iterator[PoseError]:
        """Errors from the truth, and from turns of it with the same surface."""
        none = torch.zeros(3, dtype=torch.float64)
        for k in range(self.parts):
            alike = displace(self.truth["object"], none, 2 * math.pi * k / self.parts * UP)
            off = pose_error(found["object"], alike)
            assert off is not None
            yield off

    def row(self) -> dict[str, Any]:
        """Fit from the bad start, then search about it."""
        begin, sensor = perf_counter(), radar()
        grid = sensor.grid(range_min=0.8, range_max=4.6, u_max=0.75)
        points = iw.Sampling(depth=1, points_per_m2=4e3)
        data = iw.simulate(self.truth, sensor, grid, seed=self.number, sampling=points, snr_db=20.0)
        capture = iw.Capture.from_beat(data.beat, sensor)
        seen = iw.Observation(iw.SurrogateMap(grid, WIDTHS, SAMPLING), capture, sensor=sensor)
        known = self.truth.replace("object", pose=self.start.transform)
        pose = Pose("object", axes="xy", rotation_axes="z")
        fit = iw.reconstruct(known, seen, pose, seed=self.number, **FIT)
        row: dict[str, Any] = {"number": self.number, "kind": self.kind, "start": self.error(known)}
        row |= {"fit": self._judged(fit), "fit_seconds": perf_counter() - begin}
        low, high = ([float(c) + s * FAR for c in self.start.center] for s in (-1, 1))
        low[2] = high[2] = float(self.start.center[2])
        starts = [self.start, *pose_grid(self.start, low, high, STEP, TURNS)]
        pose = Pose("object", axes="xy", rotation_axes="z")
        found = iw.search(known, seen, pose, {"object": starts}, seed=self.number, **FIT)
        row |= {"search": self._judged(found.best), "ambiguities": found.ambiguities}
        row["ends"] = [
            [*self.error(end.scene), z] for end, z in zip(found.minima, found.scores, strict=True)
        ]
        return row | {"seconds": perf_counter() - begin, "settings": SETTINGS}

    def _judged(self, found: Any) -> dict[str, Any]:
        error, seen = self.error(found.scene), found.verdict
        return {
            "error": error,
            "right": error[0] <= PLACE and error[1] <= TURN,
            "loss": float(found.end.fit.objective(found.end.maps)),
            "word": seen.word,
            "excess": seen.excess,
            "structure": seen.structure,
            "rivals": [rival.score for rival in seen.ambiguities],
            "reasons": seen.reasons,
        }


def rows(out: Path, count: int) -> Iterator[dict[str, Any]]:
    """The rows of all trials; those that are in the folder are not done again."""
    out.mkdir(parents=True, exist_ok=True)
    file, kept = out / "rows.jsonl", {}
    if file.exists():
        lines = [json.loads(line) for line in file.read_text().splitlines() if line.endswith("}")]
        kept = {row["number"]: row for row in lines if row["settings"] == SETTINGS}
    begin, done = perf_counter(), 0
    for number in range(count):
        if number in kept:
            yield kept[number]
            continue
        row = Trial.draw(number).row()
        with file.open("a") as rest:
            rest.write(json.dumps(row) + "\n")
        done += 1
        left = (
            (perf_counter() - begin) / done * sum(n not in kept for n in range(number + 1, count))
        )
        one, many = row["fit"], row["search"]
        print(
            f"{number + 1} of {count}, {row['kind']}: {one['error'][0]:.3f} m, "
            f"{math.degrees(one['error'][1]):.0f}°, {one['word']}; with starts "
            f"{many['error'][0]:.3f} m, {math.degrees(many['error'][1]):.0f}°, {many['word']}; "
            f"{row['seconds']:.0f} s, {left / 60:.0f} min left",
            flush=True,
        )
        yield row


def measure(found: list[dict[str, Any]]) -> dict[str, Any]:
    """All metrics of the rows."""
    right = [row["fit"]["word"] == "consistent" for row in found if row["fit"]["right"]]
    wrong = [row["fit"]["word"] == "consistent" for row in found if not row["fit"]["right"]]
    first = [row["search"]["right"] for row in found]
    return {
        "wrong_called_consistent": sum(wrong) / len(wrong) if wrong else None,
        "right_called_consistent": sum(right) / len(right) if right else None,
        "right_first_with_starts": sum(first) / len(first) if first else None,
        "wrong": len(wrong),
        "right": len(right),
        "fits": len(found),
        "seconds": sum(row["seconds"] for row in found),
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/verdicts"))
    parser.add_argument("--fits", type=int, default=100)
    given = parser.parse_args()
    found = list(rows(given.out, given.fits))
    metrics = measure(found)
    table = MetricTable("Verdicts", REQUIRED)
    for key, of in zip(REQUIRED, ("wrong", "right", "fits"), strict=True):
        table.row(key, metrics[key], ".3f", f"of {metrics[of]}")
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
