"""Signatures of small bodies against a full-wave solver: amplitude and phase.

    python benchmarks/full_wave.py [-o DIR]
    python benchmarks/full_wave.py --solve [BODY ...]

Bodies of three to eight wavelengths turn in front of a radar. Their scattering amplitudes S by
`invertwin.rcs` are held against those of the method of moments, which are stored in
`benchmarks/full_wave_data`. `--solve` computes these anew with bempp-cl (`pip install bempp-cl`,
some minutes a body): its function spaces, and its matrix of triangles that touch. That of the
others is summed here, which takes a tenth of the time.

Prints a table and writes `metrics.json` into DIR (default `out/full_wave`). For each cut and both
co-polar terms, `rms_db.<body>_<cut>_<polarisation>` is the rms of the difference in decibels where
the solver's S is within 30 dB of its peak in the cut. `phase_deg.<body>_<cut>_<polarisation>` is
the largest difference in phase where it is within 10 dB.
"""

import argparse
import importlib
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex128, Float64, Int64
from report import MetricTable, Required, write
from rich.table import Table
from scipy.spatial import Delaunay
from torch import Tensor

from invertwin import Object, Scene, rcs
from invertwin.channel.em.plane_waves import polarisations
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import PhysicsWarning
from invertwin.scene import Mesh, PerfectConductor
from invertwin.signatures import aspect_directions

STORED = Path(__file__).parent / "full_wave_data"
SIDE = 3.12  # of the cube: between the resonances inside, where its integral equation is sick
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
DEPTHS = (-30.0, -10.0)  # dB below the peak, down to which amplitudes and phases count
REQUIRED: Required = {"rms_db": ("<=", 2.0), "phase_deg": ("<=", 20.0)}
POLARISATIONS = "VH"

Grid = tuple[Float64[np.ndarray, "v 3"], Int64[np.ndarray, "f 3"]]
"""Vertices, in wavelengths, and triangles."""


@dataclass(frozen=True)
class Body:
    """A conductor, and how it is looked at; a wavelength is a metre.

    Attributes:
        shape: `grid` at this step of the mesh.
        fine: step of the solver's mesh, in wavelengths.
        coarse: step of the mesh whose signature is computed.
        depth: most bounces.
        cuts: θ and φ [°] by the name of a cut.
    """

    shape: Any
    fine: float
    coarse: float
    depth: int
    cuts: dict[str, tuple[np.ndarray, np.ndarray]]

    def directions(self, cut: str) -> Float64[Tensor, "aspect 3"]:
        """Towards the radar."""
        theta, phi = (torch.from_numpy(np.radians(angle)) for angle in self.cuts[cut])
        return aspect_directions(theta, phi)


def _seven_points() -> list[tuple[float, ...]]:
    """A rule of the fifth degree on a triangle: three shares and a weight for each point."""
    a, b, u, v = 0.059715871789770, 0.797426985353087, 0.470142064105115, 0.101286507323456
    rule: list[tuple[float, ...]] = [(1 / 3, 1 / 3, 1 / 3, 0.225)]
    for near, far, weight in ((u, a, 0.132394152788506), (v, b, 0.125939180544827)):
        rule += [(*np.roll((far, near, near), turn), weight) for turn in range(3)]
    return rule


SEVEN_POINTS = _seven_points()


def sheets(squares: Sequence[tuple[Any, Any, Any]], step: float) -> Grid:
    """Parallelograms (a corner and two sides) as one mesh without mesh_topology.

    Args:
        squares: normals are the vector products of the sides.
        step: of the mesh.
    """
    points, faces = [], []
    for corner, first, second in squares:
        m, n = (max(1, round(float(np.linalg.norm(side)) / step)) for side in (first, second))
        i, j = (x.ravel() for x in np.meshgrid(np.arange(m + 1), np.arange(n + 1), indexing="ij"))
        spot = np.asarray(corner) + np.outer(i / m, first) + np.outer(j / n, second)
        low = (i * (n + 1) + j)[(i < m) & (j < n)] + sum(map(len, points))
        faces += [np.stack([low, low + n + 1, low + n + 2], 1)]
        faces += [np.stack([low, low + n + 2, low + 1], 1)]
        points.append(spot)
    return _merged(points, faces)


def _merged(points: list[np.ndarray], faces: list[np.ndarray]) -> Grid:
    """One mesh of several that meet."""
    every = np.concatenate(points)
    _, kept, index = np.unique(every.round(6), axis=0, return_index=True, return_inverse=True)
    return every[kept], index.ravel()[np.concatenate(faces)]


def ogive(length: float, radius: float, step: float) -> Grid:
    """An arc turned about its chord, the z axis: round in the middle, a tip at either end.

    Args:
        length, radius: of the body.
        step: of the mesh.
    """
    bend = (length**2 / 4 + radius**2) / (2 * radius)
    half = math.asin(length / 2 / bend)
    count = round(2 * half * bend / step)
    points: list[tuple[float, float, float]] = [(0.0, 0.0, -length / 2)]
    rings: list[list[int]] = [[0]]
    for angle in np.linspace(-half, half, count + 1)[1:-1]:
        r, z = bend * math.cos(angle) - bend + radius, bend * math.sin(angle)
        around = max(5, round(2 * math.pi * r / step))
        turns = 2 * math.pi * (np.arange(around) + 0.5 * (len(rings) % 2)) / around
        rings.append([len(points) + i for i in range(around)])
        points += [(r * math.cos(turn), r * math.sin(turn), z) for turn in turns]
    rings.append([len(points)])
    points.append((0.0, 0.0, length / 2))
    return np.array(points), np.array(
        [face for low, high in pairwise(rings) for face in _zipped(low, high)]
    )


def polyhedron(
    points: Float64[np.ndarray, "v 3"], polygons: Sequence[Sequence[int]], step: float
) -> Grid:
    """Plane convex polygons, meshed evenly, as one mesh.

    Args:
        points: corners.
        polygons: numbers of the corners of each, anticlockwise from outside.
        step: of the mesh.
    """
    spots, faces = [], []
    for polygon in polygons:
        corners = points[list(polygon)]
        sides = np.roll(corners, -1, 0) - corners
        lengths = np.linalg.norm(sides, axis=1)
        normal = np.cross(sides[0], sides[1])
        along = sides[0] / lengths[0]
        axes = np.stack([along, np.cross(normal / np.linalg.norm(normal), along)], 1)
        inwards = np.stack([axes @ [-y, x] for x, y in sides @ axes / lengths[:, None]])
        parts = np.maximum(1, np.ceil(lengths / step - 1e-9)).astype(int)
        rim = [
            corner + np.outer(np.arange(n) / n, side)
            for corner, side, n in zip(corners, sides, parts, strict=True)
        ]
        count = math.ceil(lengths.sum() / step)
        i, j = (x.ravel() for x in np.mgrid[-count : count + 1, -count : count + 1])
        lattice = np.stack([i + 0.5 * j, math.sqrt(0.75) * j], 1) * step
        inner = corners.mean(0) + lattice @ axes.T
        depth = np.einsum("psx,sx->ps", inner[:, None] - corners, inwards).min(1)
        spot = np.concatenate([*rim, inner[depth > step / 2]])
        found = Delaunay(spot @ axes).simplices.astype(np.int64)
        first, second = (spot[found[:, n]] - spot[found[:, 0]] for n in (1, 2))
        area = np.cross(first, second) @ normal
        found[area < 0] = found[area < 0, ::-1]
        faces.append(found[np.abs(area) > 1e-6 * np.abs(area).max()] + sum(map(len, spots)))
        spots.append(spot)
    return _merged(spots, faces)


def wing(step: float) -> Grid:
    """A tapered half wing of 4 × 2 × 0.24: plane above and below, sharp in front and behind.

    Args:
        step: of the mesh.
    """
    points = np.array(
        [
            (x, y, z)
            for y, front, back in ((-2, 1.0, -1.0), (2, 0.3, -0.7))
            for x, z in (
                (front, 0),
                (front - 0.3, 0.12),
                (back + 0.3, 0.12),
                (back, 0),
                (back + 0.3, -0.12),
                (front - 0.3, -0.12),
            )
        ]
    )
    strips = [(i, i + 6, (i + 1) % 6 + 6, (i + 1) % 6) for i in range(6)]
    return polyhedron(points, [*strips, range(6), range(11, 5, -1)], step)


def _zipped(low: list[int], high: list[int]) -> list[tuple[int, int, int]]:
    """Triangles between two rings: the one that lags behind goes on."""
    faces, i, j = [], 0, 0
    m, n = (len(ring) if len(ring) > 1 else 0 for ring in (low, high))
    while i < m or j < n:
        a, b = low[i % len(low)], high[j % len(high)]
        if j == n or (i < m and (i + 1) * n <= (j + 1) * m):
            i += 1
            faces.append((a, low[i % len(low)], b))
        else:
            j += 1
            faces.append((a, high[j % len(high)], b))
    return faces


def _box(lids: int) -> list[tuple[Any, Any, Any]]:
    """A cube's sides, the one towards +z last."""
    x, y, z = SIDE * np.eye(3)
    low = -(x + y + z) / 2
    sides = [(low, y, x), (low, x, z), (low, z, y), (low + x, y, z), (low + y, z, x)]
    return [*sides, (low + z, x, y)][: 5 + lids]


def _cut(theta: Any, phi: Any) -> tuple[np.ndarray, np.ndarray]:
    return tuple(x.astype(float) for x in np.broadcast_arrays(theta, phi))  # type: ignore[return-value]


@cache
def bodies() -> dict[str, Body]:
    """All bodies by name."""
    x, y, z = 4.0 * np.eye(3)
    quarter, half = np.arange(0, 91), np.arange(0, 46)
    return {
        "cube": Body(
            partial(sheets, _box(1)),
            1 / 8,
            SIDE,
            1,
            {
                "face": _cut(90, half),
                "corner": _cut(quarter, 45),
                "oblique": _cut(quarter, 20),
            },
        ),
        "dihedral": Body(
            partial(sheets, [(-z / 2, x, z), (-z / 2, z, y)]),
            1 / 8,
            4.0,
            2,
            {"across": _cut(90, half), "tilted": _cut(np.arange(60, 91), 35)},
        ),
        "open_box": Body(
            partial(sheets, _box(0)),
            1 / 8,
            SIDE,
            9,
            {"straight": _cut(quarter, 0), "oblique": _cut(quarter, 30)},
        ),
        "ogive": Body(partial(ogive, 5.0, 1.0), 1 / 10, 1 / 16, 1, {"nose": _cut(quarter, 0)}),
        "slender_ogive": Body(
            partial(ogive, 8.0, 0.5), 1 / 14, 1 / 12, 1, {"nose": _cut(quarter, 0)}
        ),
        "wing": Body(
            wing,
            1 / 14,
            5.0,
            1,
            {
                "elevation": _cut(quarter, 0),
                "azimuth": _cut(90, np.arange(0, 181)),
                "shallow": _cut(84, np.arange(0, 181)),
            },
        ),
    }


def solve(body: Body, step: float) -> dict[str, Any]:
    """S of every cut by the method of moments: electric field integral equation, RWG functions.

    Args:
        body: what scatters.
        step: of the mesh, in wavelengths.
    """
    from scipy.linalg import lu_factor, lu_solve

    start = perf_counter()
    points, faces = body.shape(step)
    # The solver's fields turn with exp(−iωt); ours are the conjugates.
    k = 2 * math.pi
    matrix, currents = system(points, faces, k)
    assembled = perf_counter() - start
    factors = lu_factor(matrix, overwrite_a=True, check_finite=False)
    found: dict[str, Any] = {}
    for cut in body.cuts:
        directions = body.directions(cut)
        sent = polarisations(directions, UP).numpy()
        excited = _excitations(points, faces, currents, k * directions.numpy(), sent)
        flat = excited.reshape(-1, excited.shape[-1]).T.astype(np.complex64)
        answer = lu_solve(factors, flat, check_finite=False).T.reshape(excited.shape)
        # Its tests n × f turn the sign of the equation: minus times minus.
        s = 1j * k / (4 * math.pi) * np.einsum("arn,atn->art", excited, answer)
        found[cut] = s.conj().astype(np.complex64)
        found[f"{cut}_deg"] = np.stack(body.cuts[cut], 1)
    seconds = perf_counter() - start
    print(f"{len(matrix)} unknowns, {assembled:.0f} s for the matrix, {seconds:.0f} s in all")
    return found | {"unknowns": len(matrix), "step": step}


def system(points: np.ndarray, faces: np.ndarray, k: float) -> tuple[np.ndarray, Any]:
    """The electric field integral equation's matrix, and the space of its currents.

    Args:
        points, faces: the mesh.
        k: wave number.
    """
    bempp = importlib.import_module("bempp_cl.api")
    grid = bempp.Grid(points.T, faces.T)
    currents, tests = (bempp.function_space(grid, kind, 0) for kind in ("RWG", "SNC"))
    near = bempp.operators.boundary.maxwell.electric_field(
        currents, currents, tests, k, assembler="only_singular_part"
    )
    matrix = _apart(points, faces, currents, k)
    touching = near.weak_form().A.tocoo()
    np.add.at(matrix, (touching.row, touching.col), touching.data.astype(np.complex64))
    return matrix, currents


def functions(
    points: np.ndarray, faces: np.ndarray, space: Any, rule: Sequence[tuple[float, ...]]
) -> tuple[np.ndarray, list[Any], Any]:
    """RWG functions at points of all triangles, times the points' weights.

    Returns:
        The points [rule × face, 3]; x, y and z of the functions and their divergence, as sparse
        matrices [point, unknown].
    """
    from scipy.sparse import csr_array

    corners = points[faces]
    spots, rows, columns = [], [], []
    values: list[np.ndarray] = []
    every = np.arange(len(faces))
    for *shares, weight in rule:
        spot = np.einsum("c,fcx->fx", shares, corners)
        # Edges 01, 02, 12 of a triangle; the function grows away from the opposite corner.
        for local, (first, second, apex) in enumerate(((0, 1, 2), (2, 0, 1), (1, 2, 0))):
            edge = np.linalg.norm(corners[:, first] - corners[:, second], axis=1)
            scale = (weight * edge / 2 * space.local_multipliers[:, local])[:, None]
            along = spot - corners[:, apex]
            values.append(scale * np.concatenate([along, np.full_like(scale, 2.0)], 1))
            rows.append(every + len(spots) * len(every))
            columns.append(space.local2global[:, local])
        spots.append(spot)
    place = (np.concatenate(rows), np.concatenate(columns))
    shape = (len(rule) * len(faces), space.global_dof_count)
    parts = [csr_array((v, place), shape=shape) for v in np.concatenate(values).T]
    return np.concatenate(spots), parts[:3], parts[3]


def _apart(points: np.ndarray, faces: np.ndarray, space: Any, k: float) -> np.ndarray:
    """The integral equation's matrix of triangles that do not touch, by three points each."""
    from scipy.sparse import csr_array

    far, near = 2 / 3, 1 / 6
    rule = [(*np.roll((far, near, near), turn), 1 / 3) for turn in range(3)]
    spots, parts, charge = functions(points, faces, space, rule)
    parts = [part.astype(np.complex64) for part in (*parts, 1j / k * charge)]
    corner = csr_array(
        (np.ones(faces.size), (np.arange(len(faces)).repeat(3), faces.ravel())),
        shape=(len(faces), len(points)),
    )
    touching = (corner @ corner.T).tocsr()
    total = np.zeros((space.global_dof_count,) * 2, dtype=np.complex64)
    for one in np.arange(len(spots)).reshape(-1, len(faces)):
        for some in np.array_split(one, max(1, len(faces) // 500)):
            apart = np.linalg.norm(spots[some, None] - spots[None], axis=2).astype(np.float32)
            row, column = touching[some % len(faces)].nonzero()
            kernel = np.exp(1j * np.float32(k) * apart) / (4 * np.pi * np.maximum(apart, 1e-9))
            for turn in range(len(rule)):
                kernel[row, column + turn * len(faces)] = 0
            for part in parts:
                right = (part.T @ kernel.T).T  # of all unknowns as sources, at some points
                left = part[some]
                used = np.unique(left.nonzero()[1])
                total[used] += left[:, used].T @ right
    return -1j * np.complex64(k) * total


def _excitations(
    points: np.ndarray, faces: np.ndarray, space: Any, waves: np.ndarray, sent: np.ndarray
) -> Complex128[np.ndarray, "aspect 2 unknown"]:
    """∫ f·p exp(−ik u·x) of every RWG function f, by seven points a triangle."""
    spots, parts, _ = functions(points, faces, space, SEVEN_POINTS)
    turn = np.exp(-1j * waves @ spots.T)
    along = [(part.T @ turn.T).T for part in parts]
    return np.einsum("apx,xan->apn", sent, np.stack(along))


def compare(found: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """How far off amplitudes are, and phases.

    Args:
        found, truth: S of a cut and a polarisation.
    """
    below = 20 * np.log10(np.abs(truth) / np.abs(truth).max())
    seen, bright = (below >= depth for depth in DEPTHS)
    decibels = 20 * np.log10(np.abs(found) / np.abs(truth))[seen]
    phase = np.abs(np.degrees(np.angle(found / truth)))[bright]
    return {
        "rms_db": float(np.sqrt((decibels**2).mean())),
        "worst_db": float(np.abs(decibels).max()),
        "phase_deg": float(phase.max()),
        "phase_rms_deg": float(np.sqrt((phase**2).mean())),
    }


def measure(names: Sequence[str] | None = None, edges: int = 2) -> dict[str, Any]:
    """All metrics; fewer bodies in tests only."""
    start = perf_counter()
    metrics: dict[str, Any] = {
        key: {} for key in ("rms_db", "phase_deg", "worst_db", "phase_rms_deg")
    }
    metrics["unsolved"] = [name for name in bodies() if not (STORED / f"{name}.npz").exists()]
    for name in names or bodies():
        if name in metrics["unsolved"]:
            continue
        body = bodies()[name]
        vertices, faces = map(torch.from_numpy, body.shape(body.coarse))
        scene = Scene({name: Object(Mesh(vertices, faces), PerfectConductor())})
        stored = np.load(STORED / f"{name}.npz")
        for cut in body.cuts:
            if not np.allclose(stored[f"{cut}_deg"], np.stack(body.cuts[cut], 1)):
                raise SystemExit(f"{name}: the stored cut {cut} is another one; --solve {name}")
            with warnings.catch_warnings():
                # Where the physics ends counts here too.
                warnings.simplefilter("ignore", PhysicsWarning)
                signature = rcs(
                    scene, body.directions(cut), [SPEED_OF_LIGHT], depth=body.depth, edges=edges
                )
            ours = signature.matrix[0].numpy()
            for index, polarisation in enumerate(POLARISATIONS):
                errors = compare(ours[:, index, index], stored[cut][:, index, index])
                for key, value in errors.items():
                    metrics[key][f"{name}_{cut}_{polarisation}"] = value
    return metrics | {"seconds": perf_counter() - start}


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    required: Required = {
        f"{key}.{case}": limit for key, limit in REQUIRED.items() for case in metrics[key]
    }
    page = MetricTable("Small bodies against the method of moments", required)
    for case, value in metrics["rms_db"].items():
        page.row(f"rms_db.{case}", value, ".2f", f"at worst {metrics['worst_db'][case]:.1f} dB")
    for case, value in metrics["phase_deg"].items():
        page.row(f"phase_deg.{case}", value, ".1f", f"rms {metrics['phase_rms_deg'][case]:.1f}°")
    for name in metrics["unsolved"]:
        page.row(name, None, "", f"no truth is stored: --solve {name}")
    page.row("seconds", metrics["seconds"], ".1f", "for all signatures")
    return page.grid


def main() -> None:
    """Measure, print, write; or solve and store."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/full_wave"))
    parser.add_argument("--solve", nargs="*", choices=[*bodies()], help="store truth anew")
    arguments = parser.parse_args()
    if arguments.solve is None:
        metrics = measure()
        write(metrics, table(metrics), arguments.out)
        return
    for name in arguments.solve or bodies():
        body = bodies()[name]
        print(f"{name}: ", end="", flush=True)
        np.savez_compressed(STORED / f"{name}.npz", **solve(body, body.fine))


if __name__ == "__main__":
    main()
