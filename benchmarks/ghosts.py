"""Ghosts: what a smooth wall or floor shows a second time, beside image antennas.

    python benchmarks/ghosts.py [-o DIR] [--samples N]

A ball, a plate and a person, all rough, stand beside a smooth concrete wall, a metal wall, and
above a smooth concrete floor, 3 m in front of a 77 GHz radar of 1 GHz bandwidth and 16 elements
along the direction away from the mirror. Mirrors end before the radar's own flash. The reference
has no mirror: the target is seen by the image of the transmitter, of the receiver, or of both,
times Fresnel's power coefficients at the angles of each point.

- `position`: distance of the centres of power of a ghost and of its reference over range and
  direction, in resolution cells; of the first order (one reflection), of the second (both legs).
- `level`: their difference of total power [dB].
- `models`: difference between the power of field paths (`simulate`) and that of the map
  (`SurrogateMap`), over all ghosts [dB], the mean of its magnitude over the scenes.
- `derivative`: relative error of reverse-mode derivatives of a weighted map of a crate behind a
  post beside a wall that ends, against central differences: by the place of the target, that of
  the wall, and the permittivity.
- `cost`: time of a step of `SurrogateMap` (map and its derivative with respect to the target's
  place) with the mirror named over that without, median of turns.

Prints a table and writes `metrics.json` into DIR (default `out/ghosts`).
"""

import argparse
import math
import statistics
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from report import MetricTable, write
from torch import Tensor

from invertwin.channel import (
    Grid,
    Link,
    Sampling,
    deposit_mirrored_power,
    deposit_paths,
    trace_field_with_mirrors,
    trace_power,
)
from invertwin.models import SurrogateMap
from invertwin.radar import FMCW, Radar
from invertwin.scene import (
    Dielectric,
    Isotropic,
    Material,
    Mesh,
    Object,
    PerfectConductor,
    RoughDielectric,
    Scene,
    box,
    person,
    plate,
    rigid,
    rotation_from_vector,
    sphere,
)
from invertwin.scene.antenna import linear_array

REQUIRED = {
    "position_first": ("<=", 1 / 3),
    "position_second": ("<=", 1 / 3),
    "level_first_db": ("<=", 0.5),
    "level_second_db": ("<=", 0.5),
    "models_db": ("<=", 0.3),
    "derivative_target": ("<=", 0.02),
    "derivative_wall": ("<=", 0.02),
    "derivative_permittivity": ("<=", 0.02),
    "cost": ("<=", 2.0),
}
WAVELENGTH = 299_792_458 / 77e9
RANGE_CELL, DIRECTION_CELL = 0.15, 2 / 16
PERMITTIVITY = 5.24  # of concrete
OFFSET = 1.0  # of the mirror from the radar, and of the target to the other side [m]
AHEAD = 3.0
PAINT = RoughDielectric(5.0)
CONCRETE = Dielectric(PERMITTIVITY, scattering=0.0)
GRID = Grid(2.5, 0.025, 100, u_start=-1.0, u_step=0.02, u_count=101)
FLOOR_GRID = Grid(2.5, 0.025, 100, v_start=-1.0, v_step=0.02, v_count=101)


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def target(kind: str, up: bool) -> Object:
    """A rough body whose centre is to the left of the axis, or above it."""
    center = vector(AHEAD, 0.0, OFFSET) if up else vector(AHEAD, OFFSET, 0.0)
    if kind == "ball":
        return Object(sphere(0.1, 3), PAINT, rigid(translation=center))
    if kind == "plate":
        return Object(plate(0.2, 0.2), PAINT, rigid(translation=center))
    body = person(spacing=0.05)
    mesh = Mesh(body.vertices, body.faces)
    return Object(mesh, PAINT, rigid(translation=center - mesh.vertices.mean(0)))


def mirror(material: Material, up: bool) -> Object:
    """A plate in the plane y = −1 m or z = −1 m that begins 0.4 m ahead of the radar."""
    axis = vector(0.0, -math.pi / 2, 0.0) if up else vector(0.0, 0.0, math.pi / 2)
    place = vector(2.4, 0.0, -OFFSET) if up else vector(2.4, -OFFSET, 0.0)
    return Object(
        plate(4.0, 8.0) if not up else plate(8.0, 4.0),
        material,
        rigid(rotation_from_vector(axis), place),
    )


def link(tx: Tensor, rx: Tensor) -> Link:
    axes = torch.eye(3, dtype=torch.float64)[None]
    return Link(tx[None], rx[None], axes, Isotropic(), Isotropic(), WAVELENGTH, False)


def reflectance(material: Material, way: Tensor, up: bool) -> Tensor:
    """Fresnel's power coefficient of V for rays from an image through the mirror."""
    cosine = way[:, 2 if up else 1].abs() / way.norm(dim=1)
    if isinstance(material, PerfectConductor):
        return torch.ones_like(cosine)
    root = (PERMITTIVITY - 1 + cosine**2).sqrt()
    along = PERMITTIVITY * cosine if up else cosine  # above a floor V is in the plane of incidence
    return ((along - root) / (along + root)).square()


def image_map(
    scene: Scene, ends: list[Tensor], material: Material, up: bool, grid: Grid, samples: int
) -> Tensor:
    """The map that a transmitter and a receiver at images, or not, have of a free target."""
    of = link(*ends)
    paths = trace_power(scene, of, sampling=Sampling(1, samples, boundary=False), seed=1)
    weight = torch.ones_like(paths.power)
    for end, point in zip(ends, (paths.first, paths.last), strict=True):
        if end.any():
            weight = weight * reflectance(material, point - end, up)
    found = deposit_paths(replace(paths, power=paths.power * weight), of, grid)[0]
    # The image of a receiver sees the target turned over.
    return found.flip(2 if up else 1) if ends[1].any() else found


def moments(power: Tensor, grid: Grid) -> tuple[float, Tensor]:
    """Total power, and its centre in range and direction, in resolution cells."""
    across = grid.v if grid.u_count == 1 else grid.u
    plane = power.double().reshape(grid.range_count, -1)
    total = plane.sum()
    centre = (
        torch.stack([(plane.sum(1) * grid.ranges).sum(), (plane.sum(0) * across).sum()]) / total
    )
    return float(total), centre / vector(RANGE_CELL, DIRECTION_CELL)


def measure_ghosts(kind: str, material: Material, up: bool, samples: int) -> dict[str, float]:
    """Errors of the ghosts of one target in one mirror."""
    body, grid = target(kind, up), FLOOR_GRID if up else GRID
    scene = Scene({"target": body, "mirror": mirror(material, up)})
    here, free = vector(0, 0, 0), Scene({"target": body})
    image = vector(0, 0, -2 * OFFSET) if up else vector(0, -2 * OFFSET, 0)
    how: dict[str, Any] = {"sampling": Sampling(3, samples, boundary=False), "seed": 1}
    found = deposit_mirrored_power(scene, link(here, here), grid, ["mirror"], **how)[0]
    middle = 0.5 * (math.hypot(AHEAD, OFFSET) + math.hypot(AHEAD, 3 * OFFSET))
    seen_by = [image, here], [here, image], [image, image]
    maps = [image_map(free, ends, material, up, grid, samples // 4) for ends in seen_by]
    reference = torch.stack(maps).sum(0)
    far = (grid.ranges > 0.5 * (middle + math.hypot(AHEAD, 3 * OFFSET)))[:, None, None]
    at_image = ((grid.v if up else grid.u) < 0).reshape((1, 1, -1) if up else (1, -1, 1))
    windows = {"first": [~at_image, at_image & ~far], "second": [at_image & far]}
    errors: dict[str, float] = {}
    for order, parts in windows.items():
        both = [[moments(power * inside, grid) for power in (found, reference)] for inside in parts]
        errors[f"level_{order}_db"] = max(abs(10 * math.log10(a[0] / b[0])) for a, b in both)
        errors[f"position_{order}"] = max(float((a[1] - b[1]).norm()) for a, b in both)
    fields = trace_field_with_mirrors(
        scene, link(here, here), ["mirror"], seed=2,
        sampling=Sampling(3, points_per_m2={"target": 20_000.0, "*": 1.0}, boundary=False),
    )  # fmt: skip
    ghosts = fields.coefficient.abs().square()[is_mirrored(fields.first, fields.last, up)].sum()
    errors["models_db"] = abs(10 * math.log10(float(ghosts) / float(found.sum())))
    return errors


def is_mirrored(first: Tensor, last: Tensor, up: bool) -> Tensor:
    """Mask of paths that an antenna sees behind the mirror."""
    side = 2 if up else 1
    return (first[:, side] < -OFFSET) | (last[:, side] < -OFFSET)


def crate(shift: Tensor, aside: Tensor, permittivity: Tensor) -> Scene:
    """A crate behind a post, beside a wall that ends."""
    turned = rotation_from_vector(vector(0.0, 0.0, 0.4))
    side = vector(0.0, 1.0, 0.0)
    along = rotation_from_vector(vector(0.0, 0.0, math.pi / 2))
    smooth = Dielectric(permittivity, scattering=0.0)
    wall = Object(plate(1.5, 1.5), smooth, rigid(along, vector(1.5, -0.5, 0.0) + side * aside))
    body = Object(box(0.3), PAINT, rigid(turned, vector(3.0, 0.41, 0.0) + side * shift))
    post = Object(
        box((0.1, 0.1, 1.0)), RoughDielectric(1.0), rigid(translation=vector(2.2, 0.05, 0))
    )
    return Scene({"crate": body, "wall": wall, "post": post})


def measure_derivatives(samples: int) -> dict[str, float]:
    """Relative errors of derivatives by the target, the wall and its permittivity."""
    grid, weights = Grid(0.4, 0.05, 120), torch.linspace(1.0, 3.0, 120)
    start, errors = {"target": 0.0, "wall": 0.0, "permittivity": 5.0}, {}
    shared = replace(link(vector(0, 0, 0), vector(0, 0, 0)), shared_visibility=True)

    def loss(name: str, value: Tensor, count: int) -> Tensor:
        given = {key: vector(number)[0] for key, number in start.items()} | {name: value}
        how = Sampling(3, count, boundary_samples=160_000)
        scene = crate(*given.values())
        found = deposit_mirrored_power(scene, shared, grid, ["wall"], sampling=how, seed=1)
        return 1e12 * (found[0, :, 0, 0] * weights)[grid.ranges > 2].sum()

    for name, step in (("target", 0.01), ("wall", 0.01), ("permittivity", 0.2)):
        value = vector(start[name])[0].requires_grad_()
        slope = torch.autograd.grad(loss(name, value, samples), value)[0].item()
        with torch.no_grad():
            ends = [loss(name, value + s * step, 3 * samples) for s in (1, -1)]
        difference = float(ends[0] - ends[1]) / (2 * step)
        errors[f"derivative_{name}"] = abs(slope / difference - 1)
    return errors


def measure_cost(turns: int = 5) -> float:
    """Time of a step with a mirror over that without."""
    wave = FMCW(start_frequency=76.5e9, bandwidth=1e9, duration=40e-6, samples=96)
    row = linear_array(16, wave.wavelength / 2)
    radar = Radar(linear_array(1, 1.0), row, wave, positions=torch.zeros(1, 3).double())
    grid = radar.grid(range_min=2.5, range_max=5.0)
    scene, seconds = Scene({"target": target("ball", False), "mirror": mirror(CONCRETE, False)}), {}
    for number in range(turns + 1):
        for mirrors in ((), ("mirror",)):
            shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
            pose = rigid(translation=vector(AHEAD, OFFSET, 0.0) + shift)
            begin = perf_counter()
            moved = scene.replace("target", pose=pose)
            SurrogateMap(grid, mirrors=mirrors).predict(moved, radar, number).sum().backward()
            if number:
                seconds.setdefault(mirrors, []).append(perf_counter() - begin)
    return statistics.median(seconds[("mirror",)]) / statistics.median(seconds[()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("-o", "--out", type=Path, default=Path("out/ghosts"))
    parser.add_argument("--samples", type=int, default=3_200_000)
    given = parser.parse_args()
    scenes: dict[str, dict[str, float]] = {}
    mirrors = {"concrete wall": (CONCRETE, False), "metal wall": (PerfectConductor(), False)}
    mirrors |= {"floor": (CONCRETE, True)}
    for kind in ("ball", "plate", "person"):
        for name, (material, up) in mirrors.items():
            scenes[f"{kind}, {name}"] = measure_ghosts(kind, material, up, given.samples)
            print(f"{kind}, {name}: {scenes[f'{kind}, {name}']}", flush=True)
    keys = [key for key in REQUIRED if not key.startswith(("derivative", "cost"))]
    metrics: dict[str, Any] = {"scenes": scenes, "samples": given.samples}
    for key in keys:
        values = [errors[key] for errors in scenes.values()]
        metrics[key] = statistics.mean(values) if key == "models_db" else max(values)
    metrics |= measure_derivatives(given.samples) | {"cost": measure_cost()}
    table = MetricTable("Ghosts by smooth mirrors", REQUIRED)
    table.rows(metrics, {
        "position_first": (".3f", "cells from image antennas, worst of nine scenes"),
        "position_second": (".3f", "of ghosts by the mirror on both legs"),
        "level_first_db": (".2f", "dB from image antennas, worst"),
        "level_second_db": (".2f", "of ghosts by the mirror on both legs"),
        "models_db": (".2f", "dB between fields and map, mean"),
        "derivative_target": (".4f", "relative error of the derivative by the target's place"),
        "derivative_wall": (".4f", "by that of the wall"),
        "derivative_permittivity": (".4f", "by the wall's permittivity"),
        "cost": (".2f", "a step with the mirror over one without"),
    })  # fmt: skip
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
