"""Shadows of fine, uneven meshes far away: the boundary part of a derivative over the truth.

    python benchmarks/fine_meshes.py [-o DIR]

A bumpy ball grows in front of a wall and hides more of it. In the range bins of the wall, the
derivative of the received power with respect to the ball's size is the boundary part alone: what
the ball itself returns is nearer by a metre and more. Prints a table and writes `metrics.json` into
DIR (default `out/fine_meshes`): `boundary_ratio.<triangles>_<metres>` is that derivative over the
truth, the mean of several seeds, and `error.<triangles>_<metres>` its standard error.

The truth casts no ray. The ball is star-shaped about its centre, and so is its shadow on the wall:
the shadow's outline in a direction is the furthest crossing with the shadow of any of the mesh's
edges. The power that the shadow takes from the wall is the integral of the radar equation
(`channel/reference`, torch) within the outline, and the truth its difference between two sizes; all
in float64.
"""

import argparse
import itertools
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from report import MetricTable, write
from rich.table import Table

from invertwin.channel import Grid, Link, Sampling, backend, deposit_power
from invertwin.channel.coherent.radar_equation import MaterialPoints, radar_equation
from invertwin.channel.rays.scene_tables import flatten
from invertwin.scene import Isotropic, Mesh, Object, RoughDielectric, Scene, plate, rigid, sphere

SUBDIVISIONS = (4, 6, 7)
METRES = (1.5, 30.0, 100.0, 500.0)
SAMPLES, SEEDS = 200_000, 4
TOLERANCE = 0.01
RADIUS, BUMPS, HEIGHT = 0.3, 12.0, 0.15  # m, per radius, of the radius
ASIDE = (1.0, 0.12, -0.07)  # direction of the ball
BEHIND = 2.0  # how much further the wall is [m]
STEP = 1e-4  # relative change of size, of the truth's differences
AZIMUTHS, NODES = 16_384, 8  # of the integral within the outline
PAINT = RoughDielectric(permittivity=4.0)


class Task:
    """A bumpy ball, so far away, and what it hides of a wall."""

    def __init__(self, subdivisions: int, metres: float) -> None:
        ball = sphere(1.0, subdivisions=subdivisions)
        waves = torch.sin(BUMPS * ball.vertices).prod(1, keepdim=True)
        self.mesh = Mesh(RADIUS * ball.vertices * (1 + HEIGHT * waves), ball.faces)
        aside = torch.tensor(ASIDE, dtype=torch.float64)
        self.centre = metres * aside / aside.norm()
        depth = float(self.centre[0]) + BEHIND
        stretch = depth / float(self.centre[0])
        self.wall = Object(plate(4.0, 4.0), PAINT, rigid(translation=stretch * self.centre))
        origin = torch.zeros(1, 3, dtype=torch.float64)
        turn = torch.eye(3, dtype=torch.float64)[None]
        pattern = Isotropic()
        self.link = Link(origin, origin, turn, pattern, pattern, 3.9e-3, shared_visibility=True)
        self.grid = Grid(float(self.centre.norm()) + 0.5 * BEHIND, 0.1, 100)

    def derivative(self, samples: int, seed: int) -> float:
        """Of the power in the wall's bins, by relative size."""
        size = torch.ones((), dtype=torch.float64, requires_grad=True)
        mesh = Mesh(self.mesh.vertices * size, self.mesh.faces)
        ball = Object(mesh, PAINT, rigid(translation=self.centre))
        sampling = Sampling(depth=1, samples=4, boundary_samples=samples)
        scene = Scene({"wall": self.wall, "ball": ball})
        power = deposit_power(scene, self.link, self.grid, sampling=sampling, seed=seed)
        return float(torch.autograd.grad(power.sum(), size)[0])

    def truth(self) -> float:
        """The same by differences of what the shadow takes away."""
        return (self._hidden(1 - STEP) - self._hidden(1 + STEP)) / (2 * STEP)

    def _hidden(self, size: float) -> float:
        """Power of the wall's part in the shadow."""
        centre, depth = self.centre.numpy(), float(self.wall.center[0])
        corners = self.mesh.vertices.numpy() * size + centre
        shadow = corners[:, 1:] * (depth / corners[:, :1]) - centre[1:] * (depth / centre[0])
        outline = furthest(shadow, self.mesh.faces.numpy())
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        share = 0.5 * (nodes + 1)
        radius = outline[:, None] * share
        angle = 2 * math.pi * np.arange(len(outline))[:, None] / len(outline)
        flat = np.stack([0 * radius, radius * np.cos(angle), radius * np.sin(angle)], -1)
        position = torch.from_numpy(flat.reshape(-1, 3)) + self.wall.center
        area = 0.5 * weights * radius * outline[:, None] * (2 * math.pi / len(outline))
        geometry = flatten(Scene({"wall": self.wall}), self.link.wavelength)
        still = torch.zeros(len(position), dtype=torch.int64)
        normal = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64).expand(len(position), 3)
        place = MaterialPoints(
            position, normal, torch.ones(len(position), dtype=torch.float64), still
        )
        power = radar_equation(geometry, self.link, still, [place]).power
        return float(power @ torch.from_numpy(area.ravel()))


def furthest(
    points: Float64[np.ndarray, "v 2"], faces: np.ndarray, count: int = AZIMUTHS
) -> Float64[np.ndarray, " count"]:
    """How far from the origin the edges of triangles come, in directions all around."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    first, second = (points[column] for column in np.unique(pairs, axis=0).T)
    outer = np.maximum((first**2).sum(1), (second**2).sum(1)) > 0.25 * (points**2).sum(1).max()
    first, second = first[outer], second[outer]
    angle = np.arctan2(first[:, 1], first[:, 0])
    turn = np.angle(np.exp(1j * (np.arctan2(second[:, 1], second[:, 0]) - angle)))
    step = 2 * math.pi / count
    low = np.ceil(np.minimum(angle, angle + turn) / step).astype(int)
    high = np.floor(np.maximum(angle, angle + turn) / step).astype(int)
    crossed = np.maximum(high - low + 1, 0)
    edge = np.repeat(np.arange(len(first)), crossed)
    number = low[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(crossed) - crossed, crossed)
    way = np.stack([np.cos(number * step), np.sin(number * step)], 1)
    along = second[edge] - first[edge]
    across = way[:, 0] * along[:, 1] - way[:, 1] * along[:, 0]
    away = first[edge, 0] * along[:, 1] - first[edge, 1] * along[:, 0]
    found = np.zeros(count)
    with np.errstate(divide="ignore", invalid="ignore"):
        np.maximum.at(found, number % count, np.nan_to_num(away / across, posinf=0, neginf=0))
    return found


def measure(
    subdivisions: tuple[int, ...] = SUBDIVISIONS,
    metres: tuple[float, ...] = METRES,
    samples: int = SAMPLES,
    seeds: int = SEEDS,
) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    metrics: dict[str, Any] = {
        "samples": samples,
        "seeds": seeds,
        "backend": backend(),
        "load_average": os.getloadavg()[0],
        "boundary_ratio": {},
        "error": {},
    }
    for count, distance in itertools.product(subdivisions, metres):
        task, key = Task(count, distance), f"{20 * 4**count}_{distance:g}"
        ratios = np.array([task.derivative(samples, seed) for seed in range(seeds)]) / task.truth()
        metrics["boundary_ratio"][key] = float(ratios.mean())
        metrics["error"][key] = float(ratios.std(ddof=1) / math.sqrt(seeds))
    return metrics


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    page = MetricTable(
        f"Fine meshes: {metrics['samples']} boundary samples, {metrics['seeds']} seeds, backend "
        f"{metrics['backend']}, load average {metrics['load_average']:.1f} at the start",
        {},
    )
    for key, value in metrics["boundary_ratio"].items():
        triangles, distance = key.split("_")
        held = "yes" if abs(value - 1) <= TOLERANCE else "NO"
        text = f"± {metrics['error'][key]:.4f}; {triangles} triangles at {distance} m"
        page.grid.add_row(f"boundary_ratio.{key}", f"{value:.4f}", f"1 ± {TOLERANCE} {held}", text)
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/fine_meshes"))
    arguments = parser.parse_args()
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
