"""A signature of many triangles over many aspects: seconds, and that batches do not change it.

    python benchmarks/rcs_speed.py [-o DIR] [--aspects N]

A square corner reflector of conducting metal, 0.3 m or 77 wavelengths wide, 6 144 triangles, swept
over 41 azimuths at 77 GHz with both polarisations, five bounces and edges. Prints a table and
writes `metrics.json` into DIR (default `out/rcs_speed`):

- `seconds`: of the whole sweep, after one aspect that compiles kernels; `processor_seconds` of all
  threads, which other work on the machine disturbs less.
- `alone_error`: difference of the aspects computed alone from those of the sweep, over the largest
  amplitude: equal values, however aspects are batched.
- `peak_error_db`: error of the third bounce along the axis of the corner against 4πA²/λ² with the
  aperture A = a²√3.
"""

import argparse
import math
import os
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import torch
from report import MetricTable, Required, write
from torch import Tensor

from invertwin import Object, Scene, rcs
from invertwin.channel import backend
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene import Mesh, PerfectConductor
from invertwin.scene.shapes import plate
from invertwin.signatures import aspect_directions

EDGE, DIVISIONS = 0.3, 32  # of each of three plates
FREQUENCY = 77e9
ASPECTS = 41
AZIMUTHS = (15.0, 75.0)  # from one plate to another [°]
AXIS = math.acos(1 / math.sqrt(3))  # polar angle of the corner's axis
ALONE = 3  # aspects that are computed alone as well
REQUIRED: Required = {
    "triangles": (">=", 6144),
    "seconds": ("<=", 20.0),
    "alone_error": ("<=", 1e-6),
    "peak_error_db": ("<=", 0.1),
}
COUNTED = {
    "triangles": ("d", "three plates"),
    "aspects": ("d", "each with both polarisations"),
    "seconds": (".1f", "of the sweep"),
    "processor_seconds": (".1f", "of all threads"),
    "alone_error": (".1e", "aspects alone against the sweep"),
    "peak_error_db": (".3f", "three bounces along the axis, against 4πA²/λ²"),
}


def corner(divisions: int) -> Scene:
    """Three square plates that meet at the origin and open to +x, +y and +z."""
    side = plate(EDGE, EDGE, divisions=divisions)
    first = side.vertices + torch.tensor([0.0, EDGE / 2, EDGE / 2], dtype=torch.float64)
    points = torch.cat([first.roll(turn, 1) for turn in range(3)])
    faces = torch.cat([side.faces + turn * len(first) for turn in range(3)])
    # Plates share the vertices of their joints.
    lattice, index = (points * divisions / EDGE).round().unique(dim=0, return_inverse=True)
    mesh = Mesh(lattice * EDGE / divisions, index[faces])
    return Scene({"corner": Object(mesh, PerfectConductor())})


def azimuth_sweep(count: int) -> Tensor:
    """Directions about the axis of the corner, itself among them if their number is odd."""
    phi = torch.deg2rad(torch.linspace(*AZIMUTHS, count, dtype=torch.float64))
    return aspect_directions(AXIS, phi)


def measure(
    aspects: int = ASPECTS, divisions: int = DIVISIONS, frequency: float = FREQUENCY
) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    scene, directions, load = corner(divisions), azimuth_sweep(aspects), os.getloadavg()[0]
    rcs(scene, directions[:1], frequency)
    begin, worked = perf_counter(), process_time()
    found = rcs(scene, directions, frequency)
    seconds, worked = perf_counter() - begin, process_time() - worked
    some = torch.linspace(0, aspects - 1, min(ALONE, aspects)).round().long().tolist()
    alone = torch.cat([rcs(scene, directions[n : n + 1], frequency).matrix for n in some], 1)
    axis = rcs(scene, aspect_directions(AXIS, math.pi / 4), frequency, edges=0, depth=3)
    peak = 4 * math.pi * axis.parts["order 3"][0, 0, 0, 0].abs() ** 2
    expected = 4 * math.pi * (EDGE**2 * math.sqrt(3) * frequency / SPEED_OF_LIGHT) ** 2
    return {
        "backend": backend(),
        "load_average": load,
        "triangles": len(scene["corner"].mesh.faces),
        "aspects": aspects,
        "seconds": seconds,
        "processor_seconds": worked,
        "alone_error": float((alone - found.matrix[:, some]).abs().max() / alone.abs().max()),
        "peak_error_db": abs(10 * math.log10(float(peak) / expected)),
    }


def table(metrics: dict[str, Any]) -> MetricTable:
    """A row a metric."""
    title = f"RCS of a corner, backend {metrics['backend']}, load {metrics['load_average']:.1f}"
    shown = MetricTable(title, REQUIRED)
    shown.rows(metrics, COUNTED)
    return shown


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/rcs_speed"))
    parser.add_argument("--aspects", type=int, default=ASPECTS)
    given = parser.parse_args()
    metrics = measure(given.aspects)
    write(metrics, table(metrics).grid, given.out)


if __name__ == "__main__":
    main()
