"""The uniform theory of diffraction against exact solutions, and round a cube.

    python benchmarks/diffraction.py [-o DIR]

Prints a table and writes `metrics.json` into DIR (default `out/diffraction`).
`transition` is the largest relative error of the transition function. `half_plane`, `wedge.<λ>` and
`point_source.<λ>` are the largest errors of the whole field round an edge, at that distance, over
the largest field there (a plane wave; exterior angle 3π/2) or the field in free space over the
edge (a point source). `jump.<case>` is the largest step of the field at a shadow or reflection
boundary, at oblique incidence, over the field; `reciprocity.<case>` what changes when the antennas
change places. `slope_jump` is the step of the field's derivative at a shadow boundary where the
source's field has a slope, with the slope term, over the derivative.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import torch
from jaxtyping import Float64
from report import MetricTable, Required, write
from rich.table import Table
from torch import Tensor

from invertwin.channel.field.diffraction import Faces, Turn, conductor, diffraction_dyad
from invertwin.channel.field.edge_paths import Edge, over_edges, slope_transfer
from invertwin.channel.field.transition import transition
from invertwin.channel.field.waves import cross, dot, mirrored, plane_of_incidence
from invertwin.channel.field.wedges import Wedges, azimuth_outside, edge_axis
from invertwin.channel.reference.wedges import (
    half_plane_of_plane_wave,
    half_plane_of_point_source,
    wedge_of_plane_wave,
)
from invertwin.scene.material.fresnel import FieldCoefficients, fresnel_coefficients
from invertwin.scene.material.slab import Sheet, slab_coefficients

WAVE_NUMBER = 2 * math.pi  # a wavelength is a metre
PERMITTIVITY = 5 - 0.3j
THICKNESS = 0.12  # of the sheet, in wavelengths
ASIDE = 1e-9  # rad from a boundary, on either side
REQUIRED: Required = {
    "transition": ("<=", 1e-12),
    "half_plane": ("<=", 1e-10),
    "wedge.3": ("<=", 6e-4),
    "wedge.10": ("<=", 2e-4),
    "point_source.3": ("<=", 2e-3),
    "jump": ("<=", 1e-6),
    "reciprocity": ("<=", 1e-9),
}


@dataclass(frozen=True)
class Bend:
    """An endless edge anywhere.

    Attributes:
        opening: exterior angle over π.
        faces: what its faces do.
        axes: of x into the face 0, of y off it, and along the edge.
    """

    opening: float
    faces: Faces = conductor
    axes: Float64[Tensor, "3 3"] | None = None

    def wedges(self, count: int) -> Wedges:
        """As many rows of it."""
        angle = self.opening * math.pi
        x, y, z = torch.eye(3, dtype=torch.float64) if self.axes is None else self.axes
        inwards = torch.stack([x, math.cos(angle) * x + math.sin(angle) * y])
        normals = torch.stack([y, math.sin(angle) * x - math.cos(angle) * y])
        columns = (-z, z, inwards, normals, torch.tensor(self.opening, dtype=torch.float64))
        rows = [column.expand(count, *column.shape) for column in columns]
        return Wedges(*rows, faces=torch.zeros(count, 2, dtype=torch.int64))

    def place(self, distance: Any, azimuth: Tensor, height: float) -> Float64[Tensor, "row 3"]:
        """Points about it."""
        x, y, z = torch.eye(3, dtype=torch.float64) if self.axes is None else self.axes
        ring = azimuth.cos()[:, None] * x + azimuth.sin()[:, None] * y
        return distance * ring + height * z

    def optics(self, tx: Tensor, rx: Tensor, k: float) -> Tensor:
        """Straight and mirrored waves, switched hard at their boundaries: [row, 3, 3], with phase."""
        wedges = self.wedges(len(rx))
        across = edge_axis(wedges)
        azimuth_in, azimuth = (
            azimuth_outside(wedges, _unit(p - dot(p, across)[:, None] * across), 0)
            for p in (tx, rx)
        )
        length, way = _leg(tx, rx)
        lit = ((azimuth - azimuth_in).abs() < math.pi).double()[:, None, None]
        one = torch.eye(3, dtype=torch.complex128) - way[:, :, None] * way[:, None]
        normal = wedges.normals[:, 0]
        law = self.faces(0, dot(normal, way).abs())
        s, p, _ = (v[:, 0] for v in plane_of_incidence(normal, way))
        through = _outer(law.transmission_s, s, s) + _outer(law.transmission_p, p, p)
        total = (lit * one + (1 - lit) * through) * _wave(k, length)
        last = (2 * self.opening - 1) * math.pi
        sees = ((0, azimuth + azimuth_in < math.pi), (1, azimuth + azimuth_in > last))
        for face, bright in sees:
            normal = wedges.normals[:, face]
            length, way = _leg(mirrored(tx, normal), rx)
            before = mirrored(way, normal)
            law = self.faces(face, dot(normal, way).abs())
            s, p, after = (v[:, 0] for v in plane_of_incidence(normal, before))
            sent = _outer(law.reflection_s, s, s) + _outer(law.reflection_p, after, p)
            total = total + bright.double()[:, None, None] * sent * _wave(k, length)
        return total

    def diffracted(self, tx: Tensor, rx: Tensor, k: float) -> Tensor:
        """What the edge sends, with phase."""
        found = over_edges([Edge(self.wedges(len(rx)), self.faces, endless=True)], tx, rx, k)
        turn = torch.polar(torch.ones_like(found.length), -k * found.length)
        return found.transfer * turn[:, None, None]

    def boundaries(self, azimuth: float) -> dict[str, float]:
        """Azimuths at which geometric optics jumps."""
        found = {
            "shadow": azimuth + math.pi,
            "shadow of the other face": azimuth - math.pi,
            "mirror": math.pi - azimuth,
            "other mirror": (2 * self.opening - 1) * math.pi - azimuth,
        }
        return {name: angle for name, angle in found.items() if 0 < angle < self.opening * math.pi}


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.norm(dim=-1, keepdim=True)


def _leg(tx: Tensor, rx: Tensor) -> tuple[Tensor, Tensor]:
    length = (rx - tx).norm(dim=1)
    return length, (rx - tx) / length[:, None]


def _wave(k: float, length: Tensor) -> Tensor:
    """exp(−jkR)/R."""
    return torch.polar(1 / length, -k * length)[:, None, None]


def _outer(strength: Tensor, left: Tensor, right: Tensor) -> Tensor:
    return strength[:, None, None] * (left[:, :, None] * right[:, None])


def lossy(face: int, cosine: Tensor) -> FieldCoefficients:
    """Faces of a lossy body."""
    found = fresnel_coefficients(torch.tensor(PERMITTIVITY), cosine)
    none = torch.zeros_like(found.reflection_s)
    return found._replace(transmission_s=none, transmission_p=none)


def sheet(face: int, cosine: Tensor) -> FieldCoefficients:
    """Both sides of a sheet, about its middle."""
    frequency = 299_792_458.0 * WAVE_NUMBER / (2 * math.pi)
    layer = Sheet(torch.tensor(PERMITTIVITY), torch.tensor(0j), torch.tensor(THICKNESS))
    found = slab_coefficients([layer], cosine, frequency)
    turn = torch.polar(torch.ones_like(cosine), WAVE_NUMBER * THICKNESS * cosine)
    return FieldCoefficients(*(turn * value for value in found))


def transition_error() -> float:
    """Of numbers from 1e-6 to 100."""
    worst = 0.0
    for s in np.geomspace(1e-6, 100, 41).tolist():
        with mpmath.workdps(30):
            x, turn = mpmath.mpf(s), mpmath.expjpi(0.25)
            size = mpmath.sqrt(mpmath.pi) * turn
            truth = complex(size * mpmath.expj(x * x) * mpmath.erfc(turn * x))
        found = transition(torch.tensor(s, dtype=torch.float64)).item()
        worst = max(worst, abs(found - truth) / abs(truth))
    return worst


def plane_wave_error(opening: float, distance: float, truth: Callable[..., Any]) -> float:
    """Largest error of both polarisations over all azimuths, over the largest field."""
    azimuth_in, worst = math.radians(50.0), 0.0
    azimuth = torch.linspace(1e-3, opening * math.pi - 1e-3, 721, dtype=torch.float64)
    bend = Bend(opening)
    wedges = bend.wedges(len(azimuth))
    towards = bend.place(1.0, azimuth, 0.0)
    direction = -bend.place(1.0, torch.full_like(azimuth, azimuth_in), 0.0)
    turn = Turn(
        wedges,
        direction,
        towards,
        torch.full_like(azimuth, azimuth_in),
        azimuth,
        torch.full_like(azimuth, distance),
    )
    dyad = diffraction_dyad(turn, WAVE_NUMBER)
    axis = edge_axis(wedges)
    parts = {
        # E along the edge, and H along it, of both waves.
        "soft": torch.einsum("ri,rij,rj->r", axis + 0j, dyad, axis + 0j),
        "hard": torch.einsum(
            "ri,rij,rj->r", cross(axis, towards) + 0j, dyad, cross(axis, direction) + 0j
        ),
    }
    reach = WAVE_NUMBER * distance
    for polarisation, sent in parts.items():
        sign = -1.0 if polarisation == "soft" else 1.0
        total = sent.numpy() * np.exp(-1j * reach) / math.sqrt(distance)
        angle = azimuth.numpy()
        mirror = 2 * opening * math.pi - angle - azimuth_in
        for beta, strength in (
            (angle - azimuth_in, 1.0),
            (angle + azimuth_in, sign),
            (mirror, sign),
        ):
            total = total + strength * (np.abs(beta) < math.pi) * np.exp(1j * reach * np.cos(beta))
        exact = truth(WAVE_NUMBER, azimuth_in, distance, angle, polarisation)
        worst = max(worst, float(np.abs(total - exact).max() / np.abs(exact).max()))
    return worst


def sommerfeld(k: float, azimuth_in: float, distance: float, angle: Any, polarisation: Any) -> Any:
    """The half plane for many azimuths."""
    return np.array(
        [half_plane_of_plane_wave(k, azimuth_in, distance, a, polarisation) for a in angle]
    )


def series(k: float, azimuth_in: float, distance: float, angle: Any, polarisation: Any) -> Any:
    """The wedge of 3π/2."""
    return wedge_of_plane_wave(k, 1.5, azimuth_in, distance, angle, polarisation)


def point_source_error(distance: float) -> float:
    """A point source beside a half plane, as far away as the receiver and aside along the edge.

    The scalar fields are those of the two polarisations' coefficients.
    """
    bend, azimuth_in, height = Bend(2.0), math.radians(50.0), 0.8 * distance
    azimuth = torch.linspace(1e-3, 2 * math.pi - 1e-3, 181, dtype=torch.float64) + 1e-5
    tx = bend.place(distance, torch.full_like(azimuth, azimuth_in), 0.0)
    rx = bend.place(distance, azimuth, height)
    sent = bend.diffracted(tx, rx, WAVE_NUMBER)
    wedges = bend.wedges(len(azimuth))
    axis, middle = edge_axis(wedges), bend.place(0.0, azimuth, height / 2)
    direction, towards = _unit(middle - tx), _unit(rx - middle)
    across = [_unit(cross(axis, way)) for way in (direction, towards)]
    parts = {
        "hard": torch.einsum("ri,rij,rj->r", across[1] + 0j, sent, across[0] + 0j),
        "soft": torch.einsum(
            "ri,rij,rj->r",
            cross(across[1], towards) + 0j,
            sent,
            cross(across[0], direction) + 0j,
        ),
    }
    reference, worst = 1 / float((middle - tx)[0].norm() + (rx - middle)[0].norm()), 0.0
    for polarisation, field in parts.items():
        sign = -1.0 if polarisation == "soft" else 1.0
        total = field.numpy()
        for beta, strength in ((azimuth - azimuth_in, 1.0), (azimuth + azimuth_in, sign)):
            square = 2 * distance**2 * (1 - torch.cos(beta)) + height**2
            length = square.sqrt().numpy()
            lit = (beta.abs() < math.pi).numpy()
            total = total + strength * lit * np.exp(-1j * WAVE_NUMBER * length) / length
        exact = [
            half_plane_of_point_source(
                WAVE_NUMBER, (distance, azimuth_in), (distance, a, height), polarisation
            )
            for a in azimuth.tolist()
        ]
        worst = max(worst, float(np.abs(total - np.array(exact)).max() / reference))
    return worst


def bends() -> dict[str, list[Bend]]:
    """Cases by name; turned anyhow."""
    generator = torch.Generator().manual_seed(1)
    axes, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    axes = axes * torch.linalg.det(axes)
    openings = (2.0, 1.5, 1.25)
    return {
        "conductor": [Bend(n, conductor, axes) for n in openings],
        "lossy": [Bend(n, lossy, axes) for n in openings],
        "sheet": [Bend(2.0, sheet, axes)],
    }


def jump(bend: Bend, *, diffracted: bool = True) -> float:
    """Largest step of the field at a boundary, over the field."""
    worst = 0.0
    for degrees in (50.0, 130.0):
        azimuth_in = math.radians(degrees)
        for name, boundary in bend.boundaries(azimuth_in).items():
            if bend.opening == 2.0 and name == "other mirror":
                continue  # the same plane seen from its other side
            azimuth = torch.tensor([boundary - ASIDE, boundary + ASIDE], dtype=torch.float64)
            tx = bend.place(11.0, torch.full_like(azimuth, azimuth_in), 8.0)
            rx = bend.place(9.0, azimuth, -5.0)
            total = bend.optics(tx, rx, WAVE_NUMBER)
            if diffracted:
                total = total + bend.diffracted(tx, rx, WAVE_NUMBER)
            step = (total[1] - total[0]).norm() / total[0].norm()
            worst = max(worst, float(step))
    return worst


def reciprocity(bend: Bend) -> float:
    """What changes when the antennas change places, over the diffracted field."""
    azimuth = torch.linspace(0.1, bend.opening * math.pi - 0.1, 40, dtype=torch.float64)
    tx = bend.place(11.0, torch.full_like(azimuth, math.radians(50.0)), 8.0)
    rx = bend.place(9.0, azimuth, -5.0)
    there, back = bend.diffracted(tx, rx, WAVE_NUMBER), bend.diffracted(rx, tx, WAVE_NUMBER)
    return float((there - back.mT).norm() / there.norm())


def slope_jump(*, corrected: bool = True) -> float:
    """Step of ∂|E|²/∂φ at a shadow boundary, at oblique incidence, over its size.

    The source's field grows by its size per radian about the edge.
    """
    bend, azimuth_in = Bend(1.5), math.radians(50.0)
    boundary = azimuth_in + math.pi
    azimuth = torch.tensor([boundary - 1e-7, boundary + 1e-7], dtype=torch.float64)
    azimuth.requires_grad_()
    tx = bend.place(11.0, torch.full((2,), azimuth_in, dtype=torch.float64), 8.0)
    rx = bend.place(9.0, azimuth, -5.0)
    wedges = bend.wedges(2)
    found = over_edges([Edge(wedges, endless=True)], tx, rx, WAVE_NUMBER)
    direction = _unit(found.points[:, 0] - tx).detach()
    turned = _unit(cross(direction, edge_axis(wedges)))  # −e × d
    vector = edge_axis(wedges) + 0j

    def emitted(way: Tensor) -> Tensor:
        return (1 + dot(way, turned))[:, None] * vector

    length, way = _leg(tx, rx)
    lit = ((azimuth - azimuth_in).abs() < math.pi).double()[:, None]
    straight = torch.polar(1 / length, -WAVE_NUMBER * length)[:, None]
    total = lit * straight * _across(emitted(way), way)
    phase = torch.polar(torch.ones_like(found.length), -WAVE_NUMBER * found.length)[:, None]
    before = _unit(found.points[:, 0] - tx)
    sent = (found.transfer @ emitted(before)[..., None])[..., 0]
    if corrected:
        slope = slope_transfer(Edge(wedges, endless=True), tx, rx, WAVE_NUMBER)
        sent = sent + (slope @ vector[..., None])[..., 0]
    power = (total + sent * phase).abs().square().sum(1)
    (gradient,) = torch.autograd.grad(power.sum(), azimuth)
    return float((gradient[1] - gradient[0]).abs() / gradient.abs().mean())


def _across(field: Tensor, way: Tensor) -> Tensor:
    return field - dot(field, way + 0j)[:, None] * way


def measure() -> dict[str, Any]:
    """All metrics."""
    cases = bends()
    return {
        "transition": transition_error(),
        "half_plane": max(
            plane_wave_error(2.0, x, sommerfeld) for x in (0.5, 1.0, 3.0, 10.0, 30.0)
        ),
        "wedge": {f"{x:g}": plane_wave_error(1.5, x, series) for x in (0.5, 1.0, 3.0, 10.0)},
        "point_source": {f"{x:g}": point_source_error(x) for x in (1.0, 3.0, 10.0)},
        "jump": {name: max(map(jump, some)) for name, some in cases.items()},
        "jump_optics": min(min(map(partial(jump, diffracted=False), b)) for b in cases.values()),
        "reciprocity": {name: max(map(reciprocity, some)) for name, some in cases.items()},
        "slope_jump": slope_jump(),
        "slope_jump_plain": slope_jump(corrected=False),
    }


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    page = MetricTable("Uniform theory of diffraction", REQUIRED)
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/diffraction"))
    arguments = parser.parse_args()
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
