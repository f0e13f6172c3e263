"""Fits at low SNR, and beside things that nobody modelled.

    python benchmarks/robustness.py [-o DIR] [--fits 12] [--rows snr_-10 box ...]

A radar on a rail looks at a letter, a box or a car before a wall. Fits start up to 0.2 m and 15°
off. Each row has `--fits` of them with random numbers of its own:

- `snr_<dB>`: the right model, in noise.
- `box`, `post`, `pole`, `ball`: one more object, 0.5 to 0.8 m aside, that the model lacks.
- `no_wall`: the model lacks the wall.
- `wider`: the modelled object is 10 % too large.

Rows of strange objects are fitted by `reconstruct_among_clutter`, the others by `reconstruct`.
Prints a table and writes `metrics.json` into DIR (default `out/robustness`), for each row:

- `right`: share of ends within 3 cm and 3° of the truth, or of a turn with the same surface.
- `within_bars`: share of coordinates within three of their own standard deviations.
- `coverage_95`: share of coordinates within their stated 95 % intervals.
- `wrong_called_consistent` (of all rows): share of the other ends called consistent.

Fits are kept in `rows.jsonl` as they end; the same command goes on after an interruption.
"""

import argparse
import json
import math
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from report import MetricTable, Required, write
from verdicts import FIT, PAINT, SAMPLING, UP, WIDTHS, Trial, radar

import invertwin as iw
from invertwin.discovery import reconstruct_among_clutter
from invertwin.inversion import sample_nearby_poses
from invertwin.scene import Mesh, box, cylinder, rigid, sphere
from invertwin.scene.parameters import Pose

NEAR, TURN = 0.2, math.radians(15.0)  # of starts
PLACE, ANGLE = 0.03, math.radians(3.0)  # of a right end
STRANGERS = {
    "box": lambda: box((0.25, 0.25, 0.4)),
    "post": lambda: box((0.1, 0.1, 0.8)),
    "pole": lambda: cylinder(0.03, 1.0),
    "ball": lambda: sphere(0.05),
}
ROWS = ("snr_20", "snr_10", "snr_0", "snr_-10", *STRANGERS, "no_wall", "wider")
REQUIRED: Required = {
    "right.snr_20": (">=", 0.95),
    "right.snr_10": (">=", 0.95),
    "right.snr_0": (">=", 0.9),
    **{f"within_bars.snr_{level}": (">=", 0.9) for level in (20, 10, 0, -10)},
    **{f"right.{name}": (">=", 0.9) for name in (*STRANGERS, "no_wall")},
    **{f"coverage_95.{name}": (">=", 0.85) for name in ROWS},
    "wrong_called_consistent": ("<=", 0.02),
}


def run(row: str, number: int) -> dict[str, Any]:
    """One fit.

    Args:
        row: of the table.
        number: of the fit in its row; all random numbers follow from it.
    """
    begin, key = perf_counter(), 10_000 + 100 * ROWS.index(row) + number
    chance = torch.Generator().manual_seed(key)
    trial = Trial.draw(key)
    truth, item = trial.truth, trial.truth["object"]
    limits: dict[str, Any] = {"distance": (0.0, NEAR), "angle": (0.0, TURN), "axes": "xy"}
    (start,) = sample_nearby_poses(item, rotation_axis=UP, generator=chance, **limits)
    seen = truth
    if row in STRANGERS:
        ahead, aside, left = torch.rand(3, generator=chance, dtype=torch.float64).tolist()
        way = (0.8 * ahead - 0.4, math.copysign(0.5 + 0.3 * aside, left - 0.5), 0.0)
        place = item.center + torch.tensor(way, dtype=torch.float64)
        stranger = iw.Object(STRANGERS[row](), PAINT, rigid(translation=place))
        seen = iw.Scene({**truth.objects, "stranger": stranger})
    model = truth.replace("object", pose=start.transform)
    if row == "no_wall":
        model = iw.Scene({"object": model["object"]})
    if row == "wider":
        mesh = item.mesh
        grown = Mesh(mesh.center + 1.1 * (mesh.vertices - mesh.center), mesh.faces)
        model = model.replace("object", mesh=grown)
    sensor = radar()
    grid = sensor.grid(range_min=0.8, range_max=4.6, u_max=0.75)
    level = float(row.removeprefix("snr_")) if row.startswith("snr_") else 20.0
    points = iw.Sampling(depth=1, points_per_m2=4e3)
    data = iw.simulate(seen, sensor, grid, seed=key, sampling=points, snr_db=level)
    capture = iw.Capture.from_beat(data.beat, sensor)
    observation = iw.Observation(iw.SurrogateMap(grid, WIDTHS, SAMPLING), capture)
    fit = reconstruct_among_clutter if row in (*STRANGERS, "no_wall") else iw.reconstruct
    pose = Pose("object", axes="xy", rotation_axes="z")
    found = fit(model, observation, pose, seed=key, **FIT)
    errors = end_errors(trial, found.scene)
    distance, angle = math.hypot(*errors[:2]), errors[2]
    stated = found.uncertainty.deviations, found.uncertainty.interval()
    names = [f"object.{name}" for name in ("x", "y", "yaw")]
    return {
        "row": row,
        "number": number,
        "kind": trial.kind,
        "distance": distance,
        "angle": angle,
        "right": distance <= PLACE and angle <= ANGLE,
        "within_bars": [abs(e) < 3 * stated[0][n] for e, n in zip(errors, names, strict=True)],
        "covered": [abs(e) < stated[1][n] for e, n in zip(errors, names, strict=True)],
        "deviations": [stated[0][n] for n in names],
        "word": found.verdict.word,
        "seconds": perf_counter() - begin,
    }


def end_errors(trial: Trial, scene: iw.Scene) -> list[float]:
    """Errors in x, y [m] and yaw [rad] from the nearest turn with the same surface."""
    off = min(trial.pose_errors(scene), key=lambda error: error.angle)
    return [float(off.offset[0]), float(off.offset[1]), off.angle]


def measure(found: list[dict[str, Any]]) -> dict[str, Any]:
    """All metrics of the fits."""
    metrics: dict[str, Any] = {key: {} for key in ("right", "within_bars", "coverage_95")}
    for row in dict.fromkeys(fit["row"] for fit in found):
        mine = [fit for fit in found if fit["row"] == row]
        metrics["right"][row] = sum(fit["right"] for fit in mine) / len(mine)
        for key, name in (("within_bars", "within_bars"), ("coverage_95", "covered")):
            values = [value for fit in mine for value in fit[name]]
            metrics[key][row] = sum(values) / len(values)
    wrong = [fit["word"] == "consistent" for fit in found if not fit["right"]]
    metrics["wrong_called_consistent"] = sum(wrong) / max(1, len(wrong))
    return metrics | {"fits": len(found), "seconds": sum(fit["seconds"] for fit in found)}


def fits(out: Path, rows: tuple[str, ...], count: int) -> list[dict[str, Any]]:
    """All fits; those that are in the folder are not done again.

    Args:
        out: the folder.
        rows: of the table.
        count: fits in a row.
    """
    out.mkdir(parents=True, exist_ok=True)
    file, found = out / "rows.jsonl", []
    lines = file.read_text().splitlines() if file.exists() else []
    kept = {(fit["row"], fit["number"]): fit for fit in map(json.loads, lines)}
    for row in rows:
        for number in range(count):
            if (row, number) not in kept:
                kept[row, number] = fit = run(row, number)
                with file.open("a") as rest:
                    rest.write(json.dumps(fit) + "\n")
                angle = math.degrees(fit["angle"])
                print(
                    f"{row} {number + 1} of {count}, {fit['kind']}: {fit['distance']:.3f} m, "
                    f"{angle:.1f}°, {fit['word']}, {fit['seconds']:.0f} s",
                    flush=True,
                )
            found.append(kept[row, number])
    return found


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/robustness"))
    parser.add_argument("--fits", type=int, default=12)
    parser.add_argument("--rows", nargs="*", choices=ROWS, default=ROWS)
    given = parser.parse_args()
    metrics = measure(fits(given.out, tuple(given.rows), given.fits))
    table = MetricTable("Fits in noise and beside strangers", REQUIRED)
    for key in ("right", "within_bars", "coverage_95"):
        for row, value in metrics[key].items():
            table.row(f"{key}.{row}", value, ".2f", "")
    table.row("wrong_called_consistent", metrics["wrong_called_consistent"], ".3f", "of all rows")
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
