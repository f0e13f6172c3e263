"""Ray tubes: range profile of a car at 77 GHz against the converged one, and speed; a duct.

    python benchmarks/signatures.py [-o DIR]

A car of conducting metal (`experiments/car.ply`, each triangle in four) at an oblique aspect,
77 GHz, 1 GHz of bandwidth, three bounces, no edges. The error is ‖p − q‖/‖q‖ over all ranges and
polarisations, of the complex profile p with one tube per wavelength and the profile q with
`CONVERGED`. A round duct of metal, 10 × 30 wavelengths and closed behind, is a sheet of 74 000
triangles; twenty bounces and edges at five aspects into its mouth. Prints a table and writes
`metrics.json` into DIR (default `out/signatures`):

- `profile_error_db`, `seconds`, `tubes`: of one tube per wavelength. Its first run compiles kernels
  and is not counted. `patches.<n>`: where tubes of the n-th bounce end; `tubes` is the largest.
- `converging_db.<tubes per wavelength>`: the errors of other numbers of tubes.
- `order_error_db.order <n>`: the error of the n-th bounce alone, over the whole profile.
- `rays_per_second`: rays of all bounces over the time; `tracing_share`: the share of the time in
  which rays are traced, those for shadows of the first bounce among them.
- `duct.seconds` of all its aspects, `duct.patches` of the bounce that has the most.
"""

import argparse
import math
import os
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any
from unittest.mock import patch

import torch
from report import MetricTable, Required, write
from rich.table import Table
from torch import Tensor

from invertwin import Object, Scene, rcs
from invertwin.channel import backend
from invertwin.channel.rcs import far_field as signature
from invertwin.channel.rcs import shooting_bouncing_rays as tubes
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import PhysicsWarning
from invertwin.scene import Mesh, PerfectConductor, load_mesh
from invertwin.signatures import Signature, aspect_directions

CAR = Path(__file__).parents[1] / "experiments" / "car.ply"
ASPECT = (85.0, 20.0)  # θ, φ [°]; the car points along x
FREQUENCIES = (76.5e9, 77.5e9, 64)
DEPTH = 3
WAVELENGTH = 0.03  # in which the duct is measured [m]
INTO_DUCT = (5.0, 10.0, 20.0, 35.0, 50.0)  # aspects from its axis [°]
DENSITY, OTHERS, CONVERGED = 1.0, (0.5, 2.0), 4.0  # tubes per wavelength
REQUIRED: Required = {
    "triangles": (">=", 25_000),
    "profile_error_db": ("<=", -20.0),
    "tubes": ("<=", 3e5),
    "seconds": ("<=", 20.0),
    "duct.seconds": ("<=", 120.0),
}


class Rays:
    """Counts rays and the patches that they find, and the time that tracing takes."""

    def __init__(self) -> None:
        self.count = 0
        self.seconds = 0.0
        self.patches: list[int] = []

    def traced(self, trace: Callable[..., Any]) -> Callable[..., Any]:
        """A tracer, with a count."""

        def counted(occluders: Any, start: Tensor, end: Tensor) -> Any:
            self.count += len(start)
            begin = perf_counter()
            found = trace(occluders, start, end)
            self.seconds += perf_counter() - begin
            return found

        return counted

    def bounced(self, tubes: Callable[..., Any]) -> Callable[..., Any]:
        """What follows tubes from bounce to bounce, with a count for each."""

        def counted(facets: Any, occluders: Any, faces: Any, lit: Any, *rest: Any) -> Any:
            self.patches.append(len(lit.aspect))
            for bounce in tubes(facets, occluders, faces, lit, *rest):
                self.patches.append(len(bounce.aspect))
                yield bounce

        return counted


def car() -> Scene:
    """The car, of at least 25 000 triangles."""
    mesh = load_mesh(CAR)
    corners = mesh.vertices[mesh.faces]
    middles = (corners + corners.roll(-1, 1)) / 2
    a, b, c = corners.unbind(1)
    ab, bc, ca = middles.unbind(1)
    parts = torch.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    points, index = parts.unique(dim=0, return_inverse=True)
    return Scene({"car": Object(Mesh(points, index.reshape(-1, 3)), PerfectConductor())})


def duct(count: int, rows: int) -> Mesh:
    """The duct along x in so many facets around and rows along, open at the far end."""
    angle = torch.arange(count, dtype=torch.float64) * 2 * math.pi / count
    outline = 5 * WAVELENGTH * torch.stack([angle.cos(), angle.sin()], 1)
    along = 30 * WAVELENGTH * torch.arange(rows + 1, dtype=torch.float64) / rows
    walls = torch.cat([along.repeat_interleave(count)[:, None], outline.repeat(rows + 1, 1)], 1)
    a = torch.arange(rows * count).view(rows, count)
    b = a.roll(-1, 1)
    c, d = a + count, b + count
    back = torch.stack([a[0], b[0], torch.full((count,), len(walls))], 1)
    faces = [torch.stack(corners, 2).reshape(-1, 3) for corners in ((a, c, b), (b, c, d))]
    centre = torch.zeros(1, 3, dtype=torch.float64)
    return Mesh(torch.cat([walls, centre]), torch.cat([*faces, back]))


def duct_metrics(count: int, rows: int, depth: int) -> dict[str, float]:
    """Time, and tubes of the bounce that has the most."""
    scene, rays = Scene({"duct": Object(duct(count, rows), PerfectConductor())}), Rays()
    phi = torch.deg2rad(torch.tensor(INTO_DUCT, dtype=torch.float64))
    directions = aspect_directions(math.pi / 2, phi)
    start = perf_counter()
    with (
        patch.object(signature, "trace_tubes", rays.bounced(signature.trace_tubes)),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", PhysicsWarning)
        rcs(scene, directions, SPEED_OF_LIGHT / WAVELENGTH, depth=depth)
    triangles = len(scene["duct"].mesh.faces)
    return {
        "triangles": triangles,
        "patches": max(rays.patches),
        "seconds": perf_counter() - start,
    }


def signed(scene: Scene, density: float, frequencies: tuple[float, float, int]) -> Signature:
    """The signature with so many tubes per wavelength."""
    theta, phi = torch.deg2rad(torch.tensor(ASPECT, dtype=torch.float64))
    swept = torch.linspace(*frequencies, dtype=torch.float64)
    with warnings.catch_warnings():
        # Facets of this car are what is simulated, however coarse they are.
        warnings.simplefilter("ignore", PhysicsWarning)
        return rcs(
            scene,
            aspect_directions(theta, phi),
            swept,
            depth=DEPTH,
            edges=0,
            tubes_per_wavelength=density,
        )


def error_db(found: Signature, truth: Signature, whole: Signature | None = None) -> float:
    """Of a range profile, relative to that of ``whole`` (default: the truth)."""
    difference = found.range_profile()[1] - truth.range_profile()[1]
    scale = (whole or truth).range_profile()[1].norm()
    return float(20 * torch.log10(difference.norm() / scale))


def measure(
    frequencies: tuple[float, float, int] = FREQUENCIES,
    others: tuple[float, ...] = OTHERS,
    converged: float = CONVERGED,
    facets: tuple[int, int] = (160, 231),
    depth: int = 20,
) -> dict[str, Any]:
    """All metrics; fewer frequencies in tests only."""
    load, scene = os.getloadavg()[0], car()
    signed(scene, 0.25, (*frequencies[:2], 2))
    rays = Rays()
    with (
        patch.object(tubes, "find_next_surface", rays.traced(tubes.find_next_surface)),
        patch.object(signature, "is_visible", rays.traced(signature.is_visible)),
        patch.object(signature, "trace_tubes", rays.bounced(signature.trace_tubes)),
    ):
        start = perf_counter()
        found = signed(scene, DENSITY, frequencies)
        seconds = perf_counter() - start
    truth = signed(scene, converged, frequencies)
    orders = {
        name: error_db(
            replace(found, parts={name: part}),
            replace(truth, parts={name: truth.parts[name]}),
            truth,
        )
        for name, part in found.parts.items()
    }
    return {
        "triangles": len(scene["car"].mesh.faces),
        "profile_error_db": error_db(found, truth),
        "order_error_db": orders,
        "converging_db": {
            f"{density:g}": error_db(signed(scene, density, frequencies), truth)
            for density in others
        },
        "tubes": max(rays.patches),
        "patches": {str(n): count for n, count in enumerate(rays.patches, 1)},
        "seconds": seconds,
        "rays_per_second": rays.count / seconds,
        "tracing_share": rays.seconds / seconds,
        "duct": duct_metrics(*facets, depth),
        "frequencies": frequencies[2],
        "backend": backend(),
        "load_average": load,
    }


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    page = MetricTable(
        f"A car at 77 GHz, three bounces: {metrics['frequencies']} frequencies, backend "
        f"{metrics['backend']}, load average {metrics['load_average']:.1f} at the start",
        REQUIRED,
    )
    page.row("triangles", metrics["triangles"], ".0f")
    page.row("tubes", metrics["tubes"], ".0f", "patches of the bounce that has the most")
    page.row(
        "profile_error_db", metrics["profile_error_db"], ".1f", "of the range profile, complex"
    )
    for name, value in metrics["order_error_db"].items():
        page.row(f"order_error_db.{name}", value, ".1f", "over the whole profile")
    for density, value in metrics["converging_db"].items():
        page.row(f"converging_db.{density}", value, ".1f", f"with {density} tubes per wavelength")
    page.row("seconds", metrics["seconds"], ".1f", "all frequencies, both polarisations")
    page.row("rays_per_second", metrics["rays_per_second"], ".3g", "tubes' and shadows' rays")
    page.row("tracing_share", metrics["tracing_share"], ".2f", "of the time")
    page.row("duct.seconds", metrics["duct"]["seconds"], ".1f", "five aspects, and their edges")
    page.row("duct.patches", metrics["duct"]["patches"], ".0f", "of the bounce that has the most")
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/signatures"))
    arguments = parser.parse_args()
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
