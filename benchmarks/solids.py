"""Signatures of dielectric solids, against layers, beams, the Mie series, and another mesh.

    python benchmarks/solids.py [-o DIR]

A block of 10 × 10 × 3 wavelengths is held against the closed form of a layer. A turned block above
a metal plate is shot with tubes and held against clipped beams. Range profiles of balls of three
permittivities, ka = 30 to 50, are held against those of the Mie series at the echoes of front and
back. An ellipsoid of 15 × 6 × 1.8 wavelengths and ε = 3, which focuses waves within, is held
against the power that comes in, and against another triangulation.

Prints a table and writes `metrics.json` into DIR (default `out/solids`). `block_error` is the
largest |ΔS|/|S|. `tubes_error.<order>_<tubes>` is ‖ΔS‖/‖S‖ over aspects with so many tubes per
wavelength. `front_db.<ε>` and `back_db.<ε>` are the differences of the peaks. Over all tubes and
aspects, `power_out.<order>` is the power that leaves the ellipsoid in an order, of what comes, and
`energy` the largest total of what has left up to an order and what stays inside, from order 2 on.
`mesh_db` is the rms over aspects of the difference of two triangulations in level [dB], that of all
orders and polarisations. `mesh_mean_db` and `mesh_peak_db` are the differences of the mean and of
the highest level over aspects.
"""

import argparse
import math
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from report import MetricTable, Required, write
from rich.table import Table
from torch import Tensor

from invertwin import Object, Scene, rcs
from invertwin.channel import SphereSection
from invertwin.channel.beams.beam_tracing import IlluminatedPatches
from invertwin.channel.em.dielectric_solids import DielectricSolids
from invertwin.channel.em.plane_waves import area_vector, dot
from invertwin.channel.rcs import far_field as signature
from invertwin.channel.rcs.dielectric_interfaces import InterfaceFields
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.scene import (
    Mesh,
    PerfectConductor,
    RefractingBody,
    box,
    plate,
    rigid,
    rotation_from_vector,
    slab_coefficients,
    sphere,
)
from invertwin.scene.material.materials import Layer
from invertwin.signatures import Signature

SIDE, THICKNESS, RADIUS = 0.1, 0.03, 0.1
LOSS = 0.002  # tanδ of the balls
BALLS = (1.2, 1.5, 2.5)
NEAR = 0.006  # from the place of an echo, where its peak is looked for [m]
WAVELENGTH = 0.01
AXES = (15.0, 6.0, 1.8)  # of the ellipsoid, whole lengths in wavelengths
TURN = (0.3, 0.2, 0.5)  # of the sphere that the other mesh of the ellipsoid is drawn from [rad]
REQUIRED: Required = {
    "block_error": ("<=", 1e-9),
    "order 1_16": ("<=", 0.01),
    "back_db.1.2": ("<=", 1.0),
    "back_db.1.5": ("<=", 1.0),
    "energy": ("<=", 1.0),
    "mesh_db": ("<=", 1.0),
    "mesh_mean_db": ("<=", 1.0),
    "mesh_peak_db": ("<=", 1.0),
}


def block_error(epsilon: float = 2.5, loss: float = 0.01) -> float:
    """The largest relative error of S of a block at broadside over fringes."""
    band = torch.linspace(27e9, 33e9, 13, dtype=torch.float64)
    body = Object(box((THICKNESS, SIDE, SIDE)), RefractingBody(epsilon, loss_tangent=loss))
    found = rcs(Scene({"block": body}), [[1.0, 0.0, 0.0]], band, depth=31, edges=0)
    layer = Layer(epsilon, loss_tangent=loss, thickness=THICKNESS)
    errors = []
    for value, frequency in zip(found.matrix[:, 0, 0, 0].tolist(), band.tolist(), strict=True):
        law = slab_coefficients([layer.sheet(frequency)], torch.ones(1).double(), frequency)
        k = 2 * math.pi * frequency / SPEED_OF_LIGHT
        # The sheet's front lies in the plane of the phase; the block's, half its depth before.
        turn = complex(math.cos(k * THICKNESS), math.sin(k * THICKNESS))
        exact = 1j * SIDE**2 * k / (2 * math.pi) * complex(law.reflection_s[0]) * turn
        errors.append(abs(value - exact) / abs(exact))
    return max(errors)


def tubes_error(densities: tuple[float, ...]) -> dict[str, float]:
    """‖ΔS‖/‖S‖ of each order of a block above metal, tubes against beams."""
    pose = rigid(rotation_from_vector(torch.tensor([0.1, 0.3, 0.2]).double()))
    floor = rigid(translation=torch.tensor([-0.03, 0.0, 0.0]).double())
    scene = Scene(
        {
            "block": Object(box((0.02, 0.03, 0.03)), RefractingBody(2.5, loss_tangent=0.02), pose),
            "floor": Object(plate(0.05, 0.05), PerfectConductor(), floor),
        }
    )
    generator = torch.Generator().manual_seed(1)
    # Random numbers are drawn for y, z and x, in this order.
    directions = torch.randn(8, 3, dtype=torch.float64, generator=generator).roll(1, 1)
    exact = rcs(scene, directions, 30e9, edges=0).parts
    errors = {}
    for density in densities:
        with patch.object(signature, "MAX_FACETS_BEAM_TRACING", 0):
            found = rcs(scene, directions, 30e9, edges=0, tubes_per_wavelength=density).parts
        for name, part in exact.items():
            errors[f"{name}_{density:g}"] = float((found[name] - part).norm() / part.norm())
    return errors


def ball_errors(
    epsilon: float, subdivisions: int, count: int
) -> tuple[dict[str, float], dict[str, float]]:
    """Differences of the peaks of front and back from Mie [dB], and Mie's peaks [m]."""
    frequencies = torch.linspace(30.0, 50.0, count, dtype=torch.float64)
    frequencies = frequencies / RADIUS * SPEED_OF_LIGHT / (2 * math.pi)
    body = RefractingBody(epsilon, loss_tangent=LOSS)
    scene = Scene({"ball": Object(sphere(RADIUS, subdivisions), body)})
    found = rcs(scene, [[0.3, 0.2, 1.0]], frequencies, depth=3, edges=0, tubes_per_wavelength=2.0)
    exact = SphereSection(RADIUS, epsilon, LOSS).amplitude(frequencies)[:, None, None, None]
    truth = Signature(
        {"mie": exact.expand(-1, 1, 2, 2)}, frequencies, found.directions, found.receivers
    )
    ranges, level = _profile(found)
    _, expected = _profile(truth)
    errors, peaks = {}, {}
    back = RADIUS * (2 * math.sqrt(epsilon) - 1)
    for name, place in (("front", -RADIUS), ("back", back)):
        near = (ranges - place).abs() < NEAR
        peaks[name] = float(expected[near].max())
        errors[name] = 20 * math.log10(float(level[near].max()) / peaks[name])
    return errors, peaks


def _profile(found: Signature) -> tuple[Tensor, Tensor]:
    ranges, profile = found.range_profile(padding=8)
    return ranges, profile[:, 0, 0, 0].abs()


def ellipsoid(subdivisions: int, turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Mesh:
    """An ellipsoid, from the mesh of a turned sphere."""
    ball = sphere(WAVELENGTH / 2, subdivisions)
    turned = ball.vertices @ rotation_from_vector(torch.tensor(turn).double()).T
    return Mesh(turned * torch.tensor(AXES).double(), ball.faces)


class PowerMeter:
    """Powers of ray tubes at the surface of one lossless body, order by order."""

    def __init__(self) -> None:
        self.arriving, self.leaving, self.staying = ([0.0] * 5 for _ in range(3))
        self.order = 0

    def scatter(
        self,
        solids: DielectricSolids,
        interfaces: Any,
        k: float,
        patches: IlluminatedPatches,
        field: Tensor,
        scattering_direction: Tensor,
    ) -> InterfaceFields:
        """Scatter at interfaces, and add what arrives, leaves and stays."""
        found = _scatter(solids, interfaces, k, patches, field, scattering_direction)
        self.order = 0 if bool((patches.parent < 0).all()) else self.order + 1
        behind = solids.medium_behind(patches.facet, patches.medium)
        own, other = (solids.permittivity_in(m).real for m in (patches.medium, behind))
        cosine = -dot(patches.normal, patches.direction)
        beyond = (other - own * (1 - cosine**2)).clamp_min(0).sqrt()
        area = area_vector(patches.polygon).norm(dim=1)
        come, back, passed = (
            e.abs().square().sum((1, 2)) * across * area
            for e, across in (
                (field, own.sqrt() * cosine),
                (found.reflected, own.sqrt() * cosine),
                (found.transmitted, beyond),
            )
        )
        is_inside = patches.medium >= 0
        self.arriving[self.order] += float(come.sum())
        self.leaving[self.order] += float(torch.where(is_inside, passed, back).sum())
        self.staying[self.order] += float(torch.where(is_inside, back, passed).sum())
        return found


_scatter = signature.scatter_at_interfaces


def ellipsoid_signature(
    mesh: Mesh, aspects: int, epsilon: float = 3.0
) -> tuple[Tensor, PowerMeter]:
    """Mean |S|² over polarisations per aspect, and powers."""
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(aspects, 3, dtype=torch.float64, generator=generator)
    scene = Scene({"ellipsoid": Object(mesh, RefractingBody(epsilon))})
    meter = PowerMeter()
    with patch.object(signature, "scatter_at_interfaces", meter.scatter):
        found = rcs(scene, directions, SPEED_OF_LIGHT / WAVELENGTH, edges=0)
    return found.matrix[0].abs().square().sum((1, 2)) / 2, meter


def ellipsoid_metrics(subdivisions: int, aspects: int) -> dict[str, Any]:
    """Power balance and differences of two meshes of the ellipsoid."""
    (first, meter), (second, other) = (
        ellipsoid_signature(ellipsoid(subdivisions, turn), aspects) for turn in ((0.0,) * 3, TURN)
    )
    totals = [
        (sum(each.leaving[: n + 1]) + each.staying[n]) / each.arriving[0]
        for each in (meter, other)
        for n in range(1, 5)  # the first is Fresnel's law in air
    ]
    pairs = (first, second), (first.mean(), second.mean()), (first.max(), second.max())
    levels = [10 * torch.log10(a / b) for a, b in pairs]
    names = ("mesh_db", "mesh_mean_db", "mesh_peak_db")
    differences = {n: float(x.square().mean().sqrt()) for n, x in zip(names, levels, strict=True)}
    power = {f"order {n}": p / meter.arriving[0] for n, p in enumerate(meter.leaving, start=1)}
    return {"energy": max(totals), "power_out": power} | differences


def measure(
    densities: tuple[float, ...] = (4.0, 8.0, 16.0),
    subdivisions: int = 5,
    count: int = 61,
    aspects: int = 24,
) -> dict[str, Any]:
    """All metrics.

    Args:
        densities: tubes per wavelength.
        subdivisions: of the balls and of the ellipsoid.
        count: frequencies of the range profiles.
        aspects: aspects of the ellipsoid.
    """
    balls = {f"{e:g}": ball_errors(e, subdivisions, count) for e in BALLS}
    return {
        "block_error": block_error(),
        "tubes_error": tubes_error(densities),
        "front_db": {name: errors["front"] for name, (errors, _) in balls.items()},
        "back_db": {name: errors["back"] for name, (errors, _) in balls.items()},
        **ellipsoid_metrics(subdivisions, aspects),
    }


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    page = MetricTable("Dielectric solids", REQUIRED)
    page.row("block_error", metrics["block_error"], ".1e", "depth 31 against the layer's series")
    for name, value in metrics["tubes_error"].items():
        page.row(f"tubes_error.{name}", value, ".3f", "against clipped beams")
    for kind in ("front_db", "back_db"):
        for name, value in metrics[kind].items():
            page.row(f"{kind}.{name}", value, ".2f", "peak of the range profile against Mie")
    for name, value in metrics["power_out"].items():
        page.row(f"power_out.{name}", value, ".3f", "leaves the ellipsoid, of what comes")
    page.row("energy", metrics["energy"], ".6f", "left or still inside, largest of all orders")
    page.row("mesh_db", metrics["mesh_db"], ".2f", "two meshes of the ellipsoid, rms over aspects")
    page.row("mesh_mean_db", metrics["mesh_mean_db"], ".2f", "mean power over aspects")
    page.row("mesh_peak_db", metrics["mesh_peak_db"], ".2f", "highest of all aspects")
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/solids"))
    arguments = parser.parse_args()
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
