"""Weighted against uniform sampling of edges, where surfaces hide each other, at equal time.

    python benchmarks/edges.py [-o DIR]

A body in front of a wall and above a floor, seen by separate antennas at depth 2. The derivative of
the received power with respect to a shift of the body has a part from the shadows that surfaces
cast on each other (family 2). The benchmark estimates this part with weighted edge sampling and
with uniform edge sampling (edges by length alone, directions from the whole sphere), in turns, with
the same numbers of samples and seeds. It prints a table and writes `metrics.json` into DIR (default
`out/edges`). For a plate, whose four edges are open, and for a ball, a closed mesh of nearly flat
edges, `edge_sampling.<body>.variance_ratio` is variance × time of uniform sampling over that of the
weighted one (> 1: the weighted one is better); `edge_sampling.variance_ratio` is the lesser.
"""

import argparse
import math
import os
import statistics
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Float64
from report import verdict, write
from rich.table import Table
from torch import Tensor

from invertwin.channel import Grid, Sampling, backend
from invertwin.channel.power import boundary
from invertwin.channel.power.integrand import Inputs
from invertwin.channel.power.interior_silhouettes import InteriorSilhouetteSampler
from invertwin.channel.power.random_walk import RandomWalk
from invertwin.channel.rays.arrays import from_points
from invertwin.channel.rays.backend import mi
from invertwin.channel.rays.ray_scene import RayScene
from invertwin.channel.rays.scene_tables import flatten
from invertwin.radar import FMCW, Radar
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene import AntennaArray, Isotropic, Mesh, Object, RoughDielectric, Scene
from invertwin.scene.antenna import linear_array
from invertwin.scene.shapes import plate, sphere

SAMPLES, SEEDS = 100_000, 40
WARM_UP = 3
DEPTH = 2
FAMILIES = 3  # among which samples are shared: shadows from both antennas, and interior ones
REQUIRED = (">=", 1.0)  # variance_ratio
WAYS = {"weighted": True, "uniform": False}
NOTHING = SimpleNamespace(size=0, draw=None)  # a sampler that finds no edges
WAVEFORM = FMCW(start_frequency=76e9, bandwidth=2e9, duration=50e-6, samples=512)


@dataclass(frozen=True)
class Task:
    """A scene, the antennas that look at it, the bins, and the object that moves."""

    scene: Scene
    radar: Radar
    grid: Grid
    moving: str

    @staticmethod
    def build(body: Mesh) -> "Task":
        """A body in front of a wall and above a floor; it hides parts of both from each other."""
        rough = RoughDielectric(permittivity=4.0)
        objects = {
            "wall": Object(plate(4.0, 3.0, divisions=4), rough, placed(4.0, 0.0, 0.5)),
            "floor": Object(plate(4.0, 4.0, divisions=4), rough, lying(2.5, 0.0, -1.0)),
            "body": Object(body, rough, placed(3.2, 0.2, -0.4)),
        }
        receivers = linear_array(16, WAVEFORM.wavelength / 2)
        offset = torch.tensor([0.0, 1.5, 0.4], dtype=torch.float64)
        radar = Radar(
            single(-0.8, 0.6),
            replace(receivers, positions=receivers.positions + offset),
            WAVEFORM,
            torch.zeros(1, 3, dtype=torch.float64),
        )
        return Task(Scene(objects), radar, radar.grid(1.0, 12.0, u_max=1.0), "body")

    def moved(self, number: int) -> tuple[Scene, Tensor]:
        """The scene with the moving object's vertices elsewhere, and these (a leaf)."""
        mesh = self.scene[self.moving].mesh
        vertices = (mesh.vertices * (1 + 1e-4 * number)).requires_grad_(True)
        return self.scene.replace(self.moving, mesh=Mesh(vertices, mesh.faces)), vertices


def bodies() -> dict[str, Mesh]:
    """What is moved."""
    return {"plate": plate(0.8, 0.6), "ball": sphere(0.3, subdivisions=3)}


def placed(x: float, y: float, z: float) -> Tensor:
    """A pose without rotation."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, z])
    return pose


def lying(x: float, y: float, z: float) -> Tensor:
    """A pose that turns a plate's face upwards."""
    pose = placed(x, y, z)
    pose[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    return pose


def single(y: float, z: float = 0.0) -> AntennaArray:
    """One isotropic antenna."""
    return AntennaArray(torch.tensor([[0.0, y, z]], dtype=torch.float64), Isotropic())


class Estimator:
    """Draws estimates of the derivative by a rigid shift of the body."""

    def __init__(self, task: Task) -> None:
        link = task.radar.link()
        geometry = flatten(task.scene, link.wavelength)
        names = task.scene.names
        owners = torch.zeros(len(geometry.vertices), dtype=torch.int64)
        owners[geometry.faces.ravel()] = geometry.face_object.repeat_interleave(3)
        self.moving = owners == list(names).index(task.moving)
        self.rays = RayScene(geometry, link)
        self.inputs = Inputs.from_rays(self.rays)

    def __call__(
        self, samples: int, seed: int, *, weighted: bool
    ) -> tuple[Float64[np.ndarray, " 3"], float]:
        """The derivative [1/m] of the power over all bins, and the seconds that it took."""
        import drjit as dr

        vertices = mi.Float(self.inputs.vertices)
        dr.enable_grad(vertices)
        attached = replace(self.inputs, vertices=vertices)
        start = perf_counter()
        # The samplers of the first family find nothing, so that all samples are of the second.
        with (
            patch.object(boundary, "SilhouetteSampler", lambda *_, **__: NOTHING),
            patch.object(
                boundary,
                "InteriorSilhouetteSampler",
                partial(InteriorSilhouetteSampler, importance_sampling=weighted),
            ),
        ):
            points = boundary.BoundarySamples(
                self.inputs,
                Sampling(depth=DEPTH, boundary_samples=FAMILIES * samples),
                seed,
                chunks=lambda size: iter([dr.arange(mi.UInt32, size)] if size else []),
            )
            walk = RandomWalk(self.inputs, seed)
            for paths in points.trace_paths(attached, walk):
                total = paths.sum_weighted(lambda _, exists: dr.select(exists, mi.Float(1.0), 0.0))
                dr.backward_from(paths.speed * total)
        gradient = from_points(dr.grad(vertices)).numpy()
        seconds = perf_counter() - start
        return gradient[self.moving.numpy()].sum(axis=0, dtype=np.float64), seconds


def compare(body: Mesh, samples: int, seeds: int) -> dict[str, Any]:
    """Variance and time of both ways of sampling edges."""
    estimate = Estimator(Task.build(body))
    values: dict[str, list[np.ndarray]] = {name: [] for name in WAYS}
    times: dict[str, list[float]] = {name: [] for name in WAYS}
    with torch_threads(1):
        for seed in range(WARM_UP + seeds):
            for name, weighted in WAYS.items():
                value, seconds = estimate(samples, seed, weighted=weighted)
                values[name].append(value)
                times[name].append(seconds)
    found: dict[str, Any] = {}
    for name in WAYS:
        kept = np.stack(values[name][WARM_UP:])
        mean, variance = kept.mean(axis=0), float(kept.var(axis=0, ddof=1).sum())
        found[name] = {
            "mean": mean.tolist(),
            "variance": variance,
            "relative_error": math.sqrt(variance / (mean**2).sum()),
            "seconds": statistics.median(times[name][WARM_UP:]),
        }
    pairs = zip(*(times[name][WARM_UP:] for name in ("uniform", "weighted")), strict=True)
    time_ratio = statistics.median(uniform / weighted for uniform, weighted in pairs)
    variances = found["uniform"]["variance"] / found["weighted"]["variance"]
    return found | {
        "equal_samples_variance_ratio": variances,
        "time_ratio": time_ratio,
        "variance_ratio": variances * time_ratio,
    }


def measure(samples: int = SAMPLES, seeds: int = SEEDS) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    load = os.getloadavg()[0]
    found: dict[str, Any] = {name: compare(body, samples, seeds) for name, body in bodies().items()}
    found["variance_ratio"] = min(found[name]["variance_ratio"] for name in bodies())
    return {
        "samples": samples,
        "seeds": seeds,
        "backend": backend(),
        "load_average": load,
        "edge_sampling": found,
    }


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    found = metrics["edge_sampling"]
    grid = Table(
        title=f"Interior edges: {metrics['samples']} samples, {metrics['seeds']} seeds, backend "
        f"{metrics['backend']}, load average {metrics['load_average']:.1f} at the start",
        title_justify="left",
    )
    columns = ("body", "edges", "relative error of one estimate", "variance [1/m²]", "seconds")
    for name in columns:
        grid.add_column(name, no_wrap=True)
    for body in bodies():
        for name in WAYS:
            row = found[body][name]
            error, variance, seconds = row["relative_error"], row["variance"], row["seconds"]
            grid.add_row(body, name, f"{error:.2f}", f"{variance:.3g}", f"{seconds:.4f}")
    held = verdict(found["variance_ratio"], REQUIRED)
    ratios = ", ".join(f"{body} {found[body]['variance_ratio']:.2f}" for body in bodies())
    grid.caption = f"variance × time, uniform over weighted: {ratios} ({held})"
    return grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/edges"))
    arguments = parser.parse_args()
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
