"""The uniform theory of diffraction against exact solutions, and round a cube.

    python benchmarks/diffraction.py [-o DIR]
    python benchmarks/diffraction.py --solve STEP

Prints a table and writes `metrics.json` into DIR (default `out/diffraction`).
`transition` is the largest relative error of the transition function. `half_plane`, `wedge.<λ>` and
`point_source.<λ>` are the largest errors of the whole field round an edge, at that distance, over
the largest field there (a plane wave; exterior angle 3π/2) or the field in free space over the
edge (a point source). `jump.<case>` is the largest step of the field at a shadow or reflection
boundary, at oblique incidence, over the field; `reciprocity.<case>` what changes when the antennas
change places. `slope_jump` is the step of the field's derivative at a shadow boundary where the
source's field has a slope, with the slope term, over the derivative.

`vertical_db` is the largest deviation of links along the world's z axis past the edge of a wide
screen from the Fresnel integral, of V and of H antennas that look at each other; `turned_db` is
what changes when scene and antennas are turned to the horizontal. `vertical_isotropic_db` is the
largest excess over the Fresnel integral of isotropic elements for V about the link, whose
polarisation is not defined on it.

A receiver walks round a conducting cube of five wavelengths in steps of a twentieth of a
wavelength. Wherever a path comes or goes between two steps, the place is found to 1e-4 of a
wavelength. `jump_db_next` is the largest jump of the field there, of either polarisation of the
transmitter, with paths over up to three edges; `jump_db_second` and `jump_db_first` are the same
with two edges and one at most.

A dipole's field beside a conducting cube is held against the method of moments, in two places.

- `full_wave` is the *normalised error* of an upright dipole's upright field on a plane that cuts
  the cube: the sum of (|E| − |E_true|)² over that of |E_true|². Cube, dipole, plane and measure
  are those of the audit of WiTwin channel 0.5, which states 0.0351 against finite differences, of
  a scaled field; nothing is scaled here. `full_wave_with_phases` is the same of the complex field.
  Paths go over up to two edges.
- `ring_rms` is the *root* of the normalised error of the complex field, all three components of
  two dipoles, on a ring of which 150° are behind the cube: with the dipole's own field near by and
  the waves' fields along their ways. `ring_rms_of.<order>` is without these.

The truth is in `benchmarks/full_wave_data/cube_plane.npz` and `cube_dipole.npz`; `--solve`
computes both anew with bempp-cl, with a mesh of that step in wavelengths.
"""

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import torch
from full_wave import SEVEN_POINTS, bodies, functions, system
from full_wave import SIDE as SOLVED_SIDE
from jaxtyping import Complex128, Float64
from report import MetricTable, Required, write
from rich.table import Table
from scipy.special import fresnel
from torch import Tensor

from invertwin.channel.em.plane_waves import cross, dot, plane_of_incidence, reflect_vectors
from invertwin.channel.em.transition_functions import transition
from invertwin.channel.em.utd import (
    EdgeDiffraction,
    FaceCoefficients,
    conductor_coefficients,
    diffraction_dyads,
)
from invertwin.channel.em.wedges import Wedges, edge_axis, exterior_azimuth
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.ray_scene import is_visible
from invertwin.channel.rays.topology import topology_of
from invertwin.channel.specular.diffracted_paths import DiffractedPaths, evaluate_diffracted_paths
from invertwin.channel.specular.diffraction_candidates import (
    DiffractionCandidates,
    find_diffraction_candidates,
)
from invertwin.channel.specular.edge_path_geometry import PathEdge, diffract_over_edges
from invertwin.channel.specular.image_method import CandidateSurfaces, FaceInteractions
from invertwin.channel.specular.trace_paths import trace_paths
from invertwin.channel.specular.wedge_scene import WedgeScene
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.links import AntennaMount, frequency_response
from invertwin.scene import AntennaArray, Mesh, Object, PerfectConductor, Scene, box
from invertwin.scene.material.fresnel import FieldCoefficients, fresnel_coefficients
from invertwin.scene.material.slab import SlabLayer, slab_coefficients

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from oracles.exact_wedge import (
    half_plane_plane_wave,
    half_plane_point_source,
    wedge_plane_wave,
)

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
    "vertical_db": ("<=", 0.5),
    "turned_db": ("<=", 1e-9),
    "vertical_isotropic_db": ("<=", 1.0),
    "jump_db_next": ("<=", 1.0),
    "full_wave": ("<=", 0.035),
    "full_wave_with_phases": ("<=", 0.035),
}
DATA = Path(__file__).parent / "full_wave_data"
CELLS = 48  # of the plane, along either axis
SIDE, RADIUS, HEIGHT = 5.0, 6.0, 0.7  # of the cube, and of the way round it, in wavelengths
PLACES = ((9.0, 5.3, 1.1), (9.0, 8.3, 2.1), (9.0, 7.3, 4.1))  # of the transmitter
STEP = 1e-6  # of differences, in wavelengths
HALVINGS = 9  # of a step in which a path comes or goes
VERTICAL_FREQUENCY, VERTICAL_REACH = 1e9, 10.0  # Hz; m from either antenna to the screen
EDGE_HEIGHTS = (0.003, 0.03, 0.3)  # m beyond the line between the antennas
OFFSETS = (0.0, 0.01, 0.05, 0.2, 1.0)  # m of the receiver, along the edge


@dataclass(frozen=True)
class Bend:
    """An endless edge anywhere.

    Attributes:
        opening: exterior angle over π.
        faces: what its faces do.
        axes: of x into the face 0, of y off it, and along the edge.
    """

    opening: float
    faces: FaceCoefficients = conductor_coefficients
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
        """Straight and mirrored waves with phase, switched hard at their boundaries."""
        wedges = self.wedges(len(rx))
        across = edge_axis(wedges)
        azimuth_in, azimuth = (
            exterior_azimuth(wedges, _unit(p - dot(p, across)[:, None] * across), 0)
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
            length, way = _leg(reflect_vectors(tx, normal), rx)
            before = reflect_vectors(way, normal)
            law = self.faces(face, dot(normal, way).abs())
            s, p, after = (v[:, 0] for v in plane_of_incidence(normal, before))
            sent = _outer(law.reflection_s, s, s) + _outer(law.reflection_p, after, p)
            total = total + bright.double()[:, None, None] * sent * _wave(k, length)
        return total

    def diffracted(self, tx: Tensor, rx: Tensor, k: float) -> Tensor:
        """What the edge sends, with phase."""
        found = diffract_over_edges(
            [PathEdge(self.wedges(len(rx)), self.faces, infinite=True)], tx, rx, k
        )
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
    layer = SlabLayer(torch.tensor(PERMITTIVITY), torch.tensor(0j), torch.tensor(THICKNESS))
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
    turn = EdgeDiffraction(
        wedges,
        direction,
        towards,
        torch.full_like(azimuth, azimuth_in),
        azimuth,
        torch.full_like(azimuth, distance),
    )
    (dyad,) = diffraction_dyads(turn, WAVE_NUMBER, ("value",))
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
        [half_plane_plane_wave(k, azimuth_in, distance, a, polarisation) for a in angle]
    )


def series(k: float, azimuth_in: float, distance: float, angle: Any, polarisation: Any) -> Any:
    """The wedge of 3π/2."""
    return wedge_plane_wave(k, 1.5, azimuth_in, distance, angle, polarisation)


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
    for polarisation in ("soft", "hard"):
        field = parts[polarisation]
        sign = -1.0 if polarisation == "soft" else 1.0
        total = field.numpy()
        for beta, strength in ((azimuth - azimuth_in, 1.0), (azimuth + azimuth_in, sign)):
            square = 2 * distance**2 * (1 - torch.cos(beta)) + height**2
            length = square.sqrt().numpy()
            lit = (beta.abs() < math.pi).numpy()
            total = total + strength * lit * np.exp(-1j * WAVE_NUMBER * length) / length
        exact = [
            half_plane_point_source(
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
        "conductor": [Bend(n, conductor_coefficients, axes) for n in openings],
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
    found = diffract_over_edges([PathEdge(wedges, infinite=True)], tx, rx, WAVE_NUMBER, slopes=True)
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
    if corrected and found.slopes is not None:
        # A turn about the edge turns the ray by as many radians, times sinβ.
        lean = cross(edge_axis(wedges), before).norm(dim=1)[:, None]
        sent = sent + (found.slopes[0] @ (lean * vector)[..., None])[..., 0]
    power = (total + sent * phase).abs().square().sum(1)
    (gradient,) = torch.autograd.grad(power.sum(), azimuth)
    return float((gradient[1] - gradient[0]).abs() / gradient.abs().mean())


def vertical_links(
    polarisation: str, *, isotropic: bool = False, turn: Float64[Tensor, "3 3"] | None = None
) -> list[float]:
    """Compute levels of vertical links past an edge over the Fresnel integral [dB].

    Args:
        polarisation: of the elements, about the x axis, or about the link.
        isotropic: True for antennas whose z axis is along the link, False for those that look
            along it.
        turn: rotation of the scene and of the antennas.
    """
    turn = torch.eye(3, dtype=torch.float64) if turn is None else turn
    array = AntennaArray(torch.zeros(1, 3, dtype=torch.float64), polarisation=polarisation)
    x, y, z = torch.eye(3, dtype=torch.float64)
    axes = [(x, y, z)] * 2 if isotropic else [(z, y, -x), (-z, y, x)]
    ends = [AntennaMount(array, turn @ torch.stack(some, 1)) for some in axes]
    wavelength, levels = SPEED_OF_LIGHT / VERTICAL_FREQUENCY, []
    for height, offset in product(EDGE_HEIGHTS, OFFSETS):
        corners = [[-200.0, -200.0, 0.0], [200.0, -200.0, 0.0], [200.0, height, 0.0]]
        points = torch.tensor([*corners, [-200.0, height, 0.0]], dtype=torch.float64)
        screen = Mesh(points @ turn.T, torch.tensor([[0, 1, 2], [0, 2, 3]]))
        scene = Scene({"screen": Object(screen, PerfectConductor())})
        sites = torch.tensor([[0, 0, -VERTICAL_REACH], [offset, 0, VERTICAL_REACH]]).double()
        tx, rx = sites @ turn.T
        paths = trace_paths(scene, tx, rx, VERTICAL_FREQUENCY, depth=0, edges=1, rays=None)
        response = frequency_response(paths, [VERTICAL_FREQUENCY], tx=ends[0], rx=ends[1])
        distance = float((rx - tx).norm())
        sine, cosine = fresnel(height * math.sqrt(8 / (wavelength * distance)))
        knife = math.hypot(0.5 - sine, 0.5 - cosine) / math.sqrt(2)
        free = wavelength / (4 * math.pi * distance)
        levels.append(20 * math.log10(float(response.abs()) / (knife * free)))
    return levels


def vertical_deviations() -> dict[str, float]:
    """Compute deviations of vertical links, and of the same links turned to the horizontal [dB]."""
    turn = torch.tensor([[0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [-0.8, 0.6, 0.0]], dtype=torch.float64)
    kinds = [("V", False), ("H", False), ("V", True)]
    upright, turned = (
        np.array([vertical_links(name, isotropic=own, turn=by) for name, own in kinds])
        for by in (None, turn)
    )
    return {
        "vertical_db": float(np.abs(upright[:2]).max()),
        "turned_db": float(np.abs(upright - turned).max()),
        "vertical_isotropic_db": float(upright[2].max()),
    }


def _across(field: Tensor, way: Tensor) -> Tensor:
    return field - dot(field, way + 0j)[:, None] * way


class Cube:
    """A conducting cube about the origin, seen by point antennas; a wavelength is a metre."""

    def __init__(self, side: float) -> None:
        mesh = box((side, side, side))
        topology = topology_of([mesh])
        none = FaceInteractions(*torch.zeros(2, len(topology.faces), dtype=torch.bool))
        places = torch.tensor(PLACES, dtype=torch.float64)
        walls = CandidateSurfaces(mesh.vertices, topology, places, none)
        self.half = side / 2
        self.around = WedgeScene(
            mesh.vertices, topology, walls, lambda _, cosine: conductor_coefficients(0, cosine)
        )

    def optics(self, tx: Tensor, rx: Tensor) -> tuple[Tensor, Tensor]:
        """Straight and mirrored waves [row, 3, 3], and which of the seven there are [row, 7]."""
        length, way = _leg(tx, rx)
        eye = torch.eye(3, dtype=torch.float64)
        lit = [is_visible(self.around.surfaces, tx, rx)]
        total = lit[0][:, None, None] * _across_dyad(way) * _wave(WAVE_NUMBER, length)
        for axis in range(3):
            others = [other for other in range(3) if other != axis]
            for sign in (1.0, -1.0):
                normal = (sign * eye[axis]).expand(len(rx), 3)
                image = tx + 2 * (self.half - dot(tx, normal))[:, None] * normal
                length, way = _leg(image, rx)
                share = (self.half - dot(image, normal)) / dot(rx - image, normal)
                met = image + share[:, None] * (rx - image)
                bright = (dot(tx, normal) > self.half) & (dot(rx, normal) > self.half)
                lit.append(bright & (met[:, others].abs() <= self.half).all(1))
                turned = 2 * normal[:, :, None] * normal[:, None] - eye
                sent = turned.to(torch.complex128) @ _across_dyad(reflect_vectors(way, normal))
                total = total + lit[-1][:, None, None] * sent * _wave(WAVE_NUMBER, length)
        return total, torch.stack(lit, 1)

    def bends(self, tx: Tensor, rx: Tensor, order: int) -> list[DiffractionCandidates]:
        """Paths round its edges."""
        return list(find_diffraction_candidates(self.around, tx, rx, order, 0, None, 0))

    def diffracted(self, tx: Tensor, rx: Tensor, order: int) -> list[DiffractedPaths]:
        """What they are worth."""
        found = self.bends(tx, rx, order)
        return [evaluate_diffracted_paths(self.around, some, tx, rx, WAVE_NUMBER) for some in found]

    def of_dipole(self, tx: Tensor, rx: Tensor, vectors: Tensor, order: int) -> Tensor:
        """The field of Hertzian dipoles in one place [row, 3, dipole], also along the waves' ways.

        Straight and mirrored waves are those of dipoles. A diffracted one has as much along its way
        as its field across the way needs to be free of divergence.
        """
        with tracing():
            _, lit = self.optics(tx.expand(len(rx), 3), rx)
            found = self.bends(tx[None], rx, order)
        eye = torch.eye(3, dtype=torch.float64)
        total = lit[:, 0, None, None] * _of_dipole(rx - tx)
        for number, (axis, sign) in enumerate(product(range(3), (1.0, -1.0)), start=1):
            normal = sign * eye[axis]
            image = tx + 2 * (self.half - tx @ normal) * normal
            turned = (2 * normal[:, None] * normal - eye).to(torch.complex128)
            total = total + lit[:, number, None, None] * (_of_dipole(rx - image) @ turned)
        total = total @ vectors
        for some in found:
            alone = replace(some, rx=torch.arange(len(some.rx)))

            def sent(
                aside: Tensor, bends: DiffractionCandidates = alone, at: Tensor = rx[some.rx]
            ) -> Any:
                part = evaluate_diffracted_paths(
                    self.around, bends, tx[None], at + aside, WAVE_NUMBER
                )
                turn = torch.polar(torch.ones_like(part.length), -WAVE_NUMBER * part.length)
                turn = turn * (1 + 1 / (1j * WAVE_NUMBER * part.length))
                return (part.transfer * turn[:, None, None]) @ vectors, part.directions[:, -1]

            with tracing():
                across, way = sent(0 * eye[0])
                slopes = [(sent(STEP * u)[0] - across)[:, n] for n, u in enumerate(eye)]
            falls = torch.stack(slopes).sum(0) / (1j * WAVE_NUMBER * STEP)
            along = way[:, :, None] * falls[:, None]
            total = total.index_add(0, some.rx, across + along)
        return total

    def field(self, tx: Tensor, rx: Tensor, order: int) -> tuple[Tensor, list[frozenset[Any]]]:
        """The field of one transmitter [row, 3, 3], and which paths make it."""
        with tracing():
            total, lit = self.optics(tx, rx)
            found = self.diffracted(tx[:1], rx, order) if order else []
        paths: list[set[Any]] = [set(torch.nonzero(row)[:, 0].tolist()) for row in lit]
        for part in found:
            turn = torch.polar(torch.ones_like(part.length), -WAVE_NUMBER * part.length)
            total = total.index_add(0, part.rx, part.transfer * turn[:, None, None])
            for link, edges in zip(part.rx.tolist(), part.edge.tolist(), strict=True):
                paths[link].add((part.corner, *edges))
        return total, list(map(frozenset, paths))


def _of_dipole(offset: Tensor) -> Tensor:
    """E of Hertzian dipoles, 1/R far away [row, 3, 3]."""
    length = offset.norm(dim=1)
    way = offset / length[:, None]
    near = 1 / (1j * WAVE_NUMBER * length) - 1 / (WAVE_NUMBER * length) ** 2
    along = way[:, :, None] * way[:, None]
    dyad = _across_dyad(way) * (1 + near)[:, None, None] - 2 * along * near[:, None, None]
    return dyad * _wave(WAVE_NUMBER, length)


def _across_dyad(way: Tensor) -> Tensor:
    """What takes a field's part along a wave off."""
    return torch.eye(3, dtype=torch.complex128) - way[:, :, None] * way[:, None]


def polarised(tx: Tensor) -> Float64[Tensor, "3 2"]:
    """Unit vectors across the way from a transmitter to the origin: V and H."""
    across = _unit(torch.linalg.cross(tx, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)))
    return torch.stack([_unit(torch.linalg.cross(across, tx)), across], 1)


def largest_jump(order: int) -> float:
    """[dB] of the walk round the cube where a path comes or goes."""
    cube, worst = Cube(SIDE), 0.0
    count = math.ceil(2 * math.pi * RADIUS * 20)
    for place in map(torch.tensor, PLACES):
        tx = place.double()

        def walked(azimuth: Tensor, tx: Tensor = tx) -> tuple[Tensor, list[frozenset[Any]]]:
            ring = [RADIUS * azimuth.cos(), RADIUS * azimuth.sin(), 0 * azimuth + HEIGHT]
            sent, paths = cube.field(tx.expand(len(azimuth), 3), torch.stack(ring, 1), order)
            return (sent @ polarised(tx).to(sent.dtype)).norm(dim=1), paths

        azimuth = torch.arange(count + 1, dtype=torch.float64) / count * 2 * math.pi + 1e-4
        _, paths = walked(azimuth)
        at = [i for i, (a, b) in enumerate(pairwise(paths)) if a != b]
        low, high, before = azimuth[at], azimuth[[i + 1 for i in at]], [paths[i] for i in at]
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            same = [a == b for a, b in zip(walked(middle)[1], before, strict=True)]
            low = torch.where(torch.tensor(same), middle, low)
            high = torch.where(torch.tensor(same), high, middle)
        jumps = 20 * torch.log10(walked(high)[0] / walked(low)[0]).abs()
        worst = max(worst, float(jumps.nan_to_num(torch.inf).max()))
    return worst


def ring() -> "Solved":
    """A ring about the cube, two dipoles across the way to its middle."""
    angle = torch.deg2rad(torch.arange(360, dtype=torch.float64) + 0.5)
    tx = torch.tensor([10.0, 5.5, 2.5], dtype=torch.float64)
    rx = torch.stack([5 * angle.cos(), 5 * angle.sin(), 0 * angle + 0.5], 1)
    return Solved("cube_dipole", SOLVED_SIDE, tx, rx, polarised(tx))


def plane() -> "Solved":
    """The plane of the audit: 5 GHz, a cube of 0.2 m, 1.6 m of a plane 5 cm under its middle."""
    wavelength = SPEED_OF_LIGHT / 5e9
    step = 1.6 / CELLS
    x, y = torch.cartesian_prod(*[(torch.arange(CELLS).double() + 0.5) * step - 0.8] * 2).T
    outside = (x.abs() > 0.1) | (y.abs() > 0.1)
    rx = torch.stack([x, y, torch.full_like(x, -0.05)], 1)[outside]
    tx = torch.tensor([-0.2, -0.5, 0.27], dtype=torch.float64)
    upright = torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64)
    return Solved("cube_plane", 0.2 / wavelength, tx / wavelength, rx / wavelength, upright)


@dataclass(frozen=True)
class Solved:
    """Dipoles beside a cube about the origin; a wavelength is a metre.

    Attributes:
        name: of the file of the truth.
        side: of the cube.
        tx: where the dipoles are.
        rx: where their field is.
        dipoles: unit vectors [3, dipole].
    """

    name: str
    side: float
    tx: Float64[Tensor, "3"]
    rx: Float64[Tensor, "row 3"]
    dipoles: Float64[Tensor, "3 dipole"]

    @property
    def truth(self) -> Complex128[Tensor, "row 3 dipole"]:
        """Stored."""
        with np.load(DATA / f"{self.name}.npz") as stored:
            return torch.from_numpy(stored["total"]).to(torch.complex128)

    def field(self, order: int) -> Complex128[Tensor, "row 3 dipole"]:
        """Of waves across their ways, as traced, with up to so many edges."""
        sent, _ = Cube(self.side).field(self.tx.expand(len(self.rx), 3), self.rx, order)
        return sent @ self.dipoles.to(torch.complex128)

    def solve(self, step: float) -> None:
        """Store the field by the method of moments.

        Args:
            step: of its mesh.
        """
        from scipy.linalg import lu_factor, lu_solve

        points, faces = bodies()["cube"].shape(step * SOLVED_SIDE / self.side)
        points = points * (self.side / SOLVED_SIDE)
        tx, rx, vectors = (t.numpy() for t in (self.tx, self.rx, self.dipoles.T))
        matrix, currents = system(points, faces, WAVE_NUMBER)
        spots, parts, charge = functions(points, faces, currents, SEVEN_POINTS)
        driven = [
            sum(p.T @ e for p, e in zip(parts, dipole(v, tx, spots).T, strict=True))
            for v in vectors
        ]
        factors = lu_factor(matrix, overwrite_a=True, check_finite=False)
        excited = np.stack(driven, 1).astype(np.complex64)
        answer = lu_solve(factors, excited, check_finite=False)
        flow, ends = np.stack([part @ answer for part in parts], 1), charge @ answer
        total = np.stack([dipole(vector, tx, rx) for vector in vectors], 2)
        for row, place in enumerate(rx):
            apart = place - spots
            distance = np.linalg.norm(apart, axis=1)
            wave = np.exp(1j * WAVE_NUMBER * distance) / (4 * np.pi * distance)
            slope = (wave * (1j * WAVE_NUMBER - 1 / distance) / distance)[:, None] * apart
            total[row] += 1j * WAVE_NUMBER * np.einsum("s,sip->ip", wave, flow)
            total[row] += 1j / WAVE_NUMBER * np.einsum("si,sp->ip", slope, ends)
        # The solver's fields turn with exp(−iωt); ours are the conjugates.
        np.savez_compressed(
            DATA / f"{self.name}.npz", total=total.conj().astype(np.complex64), step=step
        )


def ring_error() -> dict[str, float]:
    """Of the field on the ring, without diffraction, and with up to three edges.

    Of waves across their ways, as traced, and with what they have along them.
    """
    case = ring()
    truth, found = case.truth, {}
    for order, name in enumerate(("optics", "first", "second", "third")):
        found[name] = float((case.field(order) - truth).norm() / truth.norm())
    vectors = case.dipoles.to(torch.complex128)
    whole = Cube(case.side).of_dipole(case.tx, case.rx, vectors, 3)
    return found | {"whole": float((whole - truth).norm() / truth.norm())}


def full_wave_error(order: int = 2, every: int = 1) -> dict[str, float]:
    """Normalised errors on the plane, of magnitudes, and with phases.

    Args:
        order: most edges of a path.
        every: one of so many places counts.
    """
    case = plane()
    truth, case = case.truth[::every, 2, 0], replace(case, rx=case.rx[::every])
    found, power = case.field(order)[:, 2, 0], truth.abs().square().sum()
    return {
        "full_wave": float((found.abs() - truth.abs()).square().sum() / power),
        "full_wave_with_phases": float((found - truth).abs().square().sum() / power),
    }


def dipole(vector: np.ndarray, place: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Field of a Hertzian dipole [point, 3], exp(jkR)/R far away; the solver's convention."""
    offset = points - place
    distance = np.linalg.norm(offset, axis=1)[:, None]
    way, reach = offset / distance, WAVE_NUMBER * distance
    along = (way @ vector)[:, None] * way
    near = 1j / reach - 1 / reach**2
    return np.exp(1j * reach) / distance * ((vector - along) * (1 + near) - 2 * along * near)


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
        **vertical_deviations(),
        "jump_db_next": largest_jump(3),
        "jump_db_second": largest_jump(2),
        "jump_db_first": largest_jump(1),
        **full_wave_error(),
        "ring_rms_of": ring_error(),
    }


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    page = MetricTable("Uniform theory of diffraction", REQUIRED)
    page.row("transition", metrics["transition"], ".1e", "transition function, relative")
    page.row("half_plane", metrics["half_plane"], ".1e", "plane wave, 0.5 to 30 wavelengths")
    for name, text in (("wedge", "plane wave"), ("point_source", "half plane")):
        for distance, error in metrics[name].items():
            page.row(f"{name}.{distance}", error, ".1e", f"{text}, at {distance} wavelengths")
    for name, text in (("jump", "at boundaries"), ("reciprocity", "antennas exchanged")):
        for case, value in metrics[name].items():
            key = f"{name}.{case}"
            page.required[key] = REQUIRED[name]
            page.row(key, value, ".1e", text)
    page.row("jump_optics", metrics["jump_optics"], ".2f", "the least one without diffraction")
    page.row("slope_jump", metrics["slope_jump"], ".1e", "of the derivative at a boundary")
    page.row("slope_jump_plain", metrics["slope_jump_plain"], ".2f", "without the slope term")
    page.row("vertical_db", metrics["vertical_db"], ".2f", "vertical links past an edge, V and H")
    page.row("turned_db", metrics["turned_db"], ".1e", "the same, turned to the horizontal")
    text = "excess of isotropic elements whose z axis is along the link"
    page.row("vertical_isotropic_db", metrics["vertical_isotropic_db"], ".2f", text)
    page.row("jump_db_next", metrics["jump_db_next"], ".2f", "round a cube, up to three edges")
    page.row("jump_db_second", metrics["jump_db_second"], ".2f", "up to two edges")
    page.row("jump_db_first", metrics["jump_db_first"], ".2f", "up to one edge")
    page.row("full_wave", metrics["full_wave"], ".4f", "magnitudes on a plane about a cube")
    page.row("full_wave_with_phases", metrics["full_wave_with_phases"], ".4f", "the same, complex")
    page.row("ring_rms", metrics["ring_rms"], ".3f", "root, complex, on a ring mostly in shadow")
    for case, value in metrics["ring_rms_of"].items():
        page.row(f"ring_rms_of.{case}", value, ".3f", "the same, up to this order")
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/diffraction"))
    parser.add_argument("--solve", type=float, metavar="STEP", help="store truth anew")
    arguments = parser.parse_args()
    if arguments.solve is not None:
        for case in (ring(), plane()):
            case.solve(arguments.solve)
        return
    metrics = measure()
    metrics["ring_rms"] = metrics["ring_rms_of"]["whole"]
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
