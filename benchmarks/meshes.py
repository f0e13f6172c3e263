"""One box as the meshes that people have of it: values and derivatives over those of a clean mesh.

    python benchmarks/meshes.py [-o DIR]

Each row is a mechanism, each column a mesh of the same surface: `plates` (six, whose corners agree
to rounding), `panels` (six objects), `finer`, `diagonals` (the other one of each face), `junctions`
(one face of eight triangles against undivided neighbours), `overlapping` (two boxes with shared
planes), `inside_out`, `mixed` (every third triangle turned), `cracked` (by 1e-9 m), `soup` (three
float32 corners a triangle, as in an STL file). Prints tables and writes `metrics.json` into DIR
(default `out/meshes`):

- `value.<mechanism>.<mesh>`, `derivative.<mechanism>.<mesh>`: ⟨a, b⟩/⟨b, b⟩ of a quantity a and
  that of the clean mesh, b; its derivative is with respect to a translation that turns.
- `refused`: cells that are refused, by message. `worst_ratio`: largest |ratio − 1| of all others.
- `topology_seconds`: time of the edges of a mesh of 10⁶ triangles, indexed and as soup.
"""

import argparse
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from report import MetricTable, Required, write
from rich.table import Table
from torch import Tensor
from torch.autograd import forward_ad

import invertwin as iw
from invertwin.camera import Camera, ImageSampling, silhouettes
from invertwin.channel import deposit_power, trace_paths
from invertwin.channel.rays.topology import edge_tables
from invertwin.links import CellSampling, MapPlane, PropagationSettings, Transmitters
from invertwin.scene import (
    AntennaArray,
    Dielectric,
    Material,
    Mesh,
    RefractingBody,
    Slab,
    merge_meshes,
    rotation_from_vector,
)
from invertwin.scene.mesh_topology import weld_faces

Parts = list[Mesh]
REQUIRED: Required = {"worst_ratio": ("<=", 0.01), "topology_seconds": ("<=", 2.0)}
SIZE = (0.3, 0.4, 0.5)  # m
SAMPLES = 1_000_000
PAINT, METAL = iw.RoughDielectric(4.0, diffuse=1.0), iw.PerfectConductor()
WAY, TURN = (-0.4, 0.3, 0.2), (0.3, 0.2, -0.1)  # m and rad for one unit of the parameter
FREQUENCY = 3.5e9


def vector(*values: float) -> Tensor:
    """A tensor in float64."""
    return torch.tensor(values, dtype=torch.float64)


def plates() -> Parts:
    """Six plates, each turned to its face of the box."""
    half, parts = math.pi / 2, []
    turns = ((0, 0, 0), (0, 0, math.pi), (0, 0, half), (0, 0, -half), (0, half, 0), (0, -half, 0))
    x, y, z = SIZE
    sizes = ((y, z, x), (y, z, x), (x, z, y), (x, z, y), (y, x, z), (y, x, z))
    for turn, (width, height, depth) in zip(turns, sizes, strict=True):
        part = iw.plate(width, height)
        rotation = rotation_from_vector(vector(*turn))
        parts.append(Mesh((part.vertices - vector(depth / 2, 0, 0)) @ rotation.T, part.faces))
    return parts


def subdivided(mesh: Mesh, chosen: slice) -> Mesh:
    """A mesh with four triangles in place of each of some."""
    whole, parts = mesh.faces, mesh.faces[chosen]
    corners = mesh.vertices[parts]
    middle = 0.5 * (corners + corners.roll(-1, 1))
    a, b, c = corners.unbind(1)
    ab, bc, ca = middle.unbind(1)
    pieces = torch.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    kept = torch.ones(len(whole), dtype=torch.bool)
    kept[chosen] = False
    fine = Mesh(pieces, torch.arange(len(pieces)).reshape(-1, 3))
    return merge_meshes([Mesh(mesh.vertices, whole[kept]), fine]) if kept.any() else fine


def meshes() -> dict[str, Parts]:
    """The clean box first, then the others."""
    clean = iw.box(SIZE)
    corners = clean.vertices[clean.faces].reshape(-1, 3)
    flipped = clean.faces.clone()
    flipped[::3] = flipped[::3].flip(1)
    joined = plates()
    crack = [Mesh(joined[0].vertices - vector(1e-9, 0, 0), joined[0].faces), *joined[1:]]
    x, y, z = SIZE
    right, left = iw.box((x, 0.7 * y, z)), iw.box((x, 0.6 * y, z))
    halves = [
        Mesh(right.vertices - vector(0, 0.15 * y, 0), right.faces),
        Mesh(left.vertices + vector(0, 0.2 * y, 0), left.faces),
    ]
    other = torch.cat([
        torch.stack([quad[0], quad[1], quad[3], quad[1], quad[2], quad[3]]).reshape(2, 3)
        for quad in (outline(pair) for pair in clean.faces.split(2))
    ])  # fmt: skip
    return {
        "clean": [clean],
        "plates": [merge_meshes(joined)],
        "panels": joined,
        "finer": [subdivided(clean, slice(None))],
        "diagonals": [Mesh(clean.vertices, other)],
        "junctions": [subdivided(clean, slice(0, 2))],
        "overlapping": [merge_meshes(halves)],
        "inside_out": [Mesh(clean.vertices, clean.faces.flip(1))],
        "mixed": [Mesh(clean.vertices, flipped)],
        "cracked": [merge_meshes(crack)],
        "soup": [Mesh(corners.float().double(), torch.arange(len(corners)).reshape(-1, 3))],
    }


def outline(pair: Tensor) -> list[Tensor]:
    """Corners of the quadrilateral of two triangles, around it, from an end of its diagonal."""
    first, second = pair.tolist()
    start = next(k for k in range(3) if first[k] not in second)
    opposite = next(v for v in second if v not in first)
    ring = [first[start], first[(start + 1) % 3], opposite, first[(start + 2) % 3]]
    # The diagonal of the mesh joins the second and the fourth; the other one the first and third.
    return [torch.tensor(v) for v in (ring[1], ring[2], ring[3], ring[0])]


def scene(parts: Parts, material: Material, theta: Tensor, wall: Material | None) -> iw.Scene:
    """The box, moved and turned by the parameter, before a wall."""
    turn = rotation_from_vector(theta * vector(*TURN)) @ rotation_from_vector(
        vector(0.1, 0.15, 0.5)
    )
    pose = iw.rigid(turn, vector(1.4, 0, 0) + theta * vector(*WAY))
    objects = {f"part {k}": iw.Object(part, material, pose) for k, part in enumerate(parts)}
    if wall is not None:
        objects["wall"] = iw.Object(
            iw.plate(2.0, 2.0), wall, iw.rigid(translation=vector(2.4, 0, 0))
        )
    return iw.Scene(objects)


def radar() -> iw.Radar:
    """One transmitter and one receiver, aside of the origin."""
    arrays = AntennaArray(vector(0, -0.1, 0)[None]), AntennaArray(vector(0, 0.1, 0.05)[None])
    return iw.Radar(*arrays, iw.FMCW(76e9, 1e9, 50e-6, 64), torch.zeros(1, 3).double())


Mechanism = Callable[[Parts, Tensor], Tensor]


def power(material: Material, depth: int) -> Mechanism:
    """Power in range bins."""

    def compute(parts: Parts, theta: Tensor) -> Tensor:
        sampling = iw.Sampling(depth, SAMPLES, SAMPLES)
        bins = iw.Grid(0.5, 0.1, 40)
        whole = scene(parts, material, theta, PAINT)
        return deposit_power(whole, radar().link(), bins, sampling=sampling, seed=1).double()

    return compute


def signature(material: Material, edges: int) -> Mechanism:
    """Cross-sections from three sides."""
    ways = torch.nn.functional.normalize(
        torch.stack([vector(-1.0, 0.2, 0.1), vector(-1.0, -0.3, 0.4), vector(1.0, -0.5, -0.4)])
    )

    def compute(parts: Parts, theta: Tensor) -> Tensor:
        return iw.rcs(scene(parts, material, theta, None), ways, [9e9], edges=edges).cross_section

    return compute


def links(depth: int, edges: int) -> Mechanism:
    """Power gains of links past the box, or around the transmitter where it mirrors."""
    rx = torch.stack([vector(2.2, 0.1, 0.05), vector(2.3, -0.1, 0.1), vector(2.0, 0.35, -0.1)])
    if depth:
        across = torch.linspace(-1.5, 1.5, 9, dtype=torch.float64)
        rx = torch.cartesian_prod(vector(0.3), across, across)

    def compute(parts: Parts, theta: Tensor) -> Tensor:
        around = scene(parts, METAL, theta, None)
        paths = trace_paths(
            around, vector(0.0, 0.03, 0.02), rx, FREQUENCY, depth=depth, edges=edges, rays=None
        )
        turn = torch.polar(torch.ones_like(paths.delay), -2 * math.pi * FREQUENCY * paths.delay)
        total = torch.zeros(len(rx), 2, dtype=torch.complex128)
        total = total.index_add(0, paths.rx, paths.coefficient[:, :, 0] * turn[:, None])
        return total.abs().square()

    return compute


def coverage(material: Material, depth: int) -> Mechanism:
    """Gains of the cells of a plane behind the box."""

    def compute(parts: Parts, theta: Tensor) -> Tensor:
        cells = CellSampling(400, 40_000)
        plane = MapPlane(
            vector(2.37, -1.03, -1.11), vector(0, 2, 0), vector(0, 0, 2), (4, 4), cells
        )
        mast = Transmitters(vector(0.0, 0.03, 0.02))
        settings = PropagationSettings(FREQUENCY, depth=depth, rays=None)
        return plane.link_statistics(scene(parts, material, theta, METAL), mast, settings, 0).gain

    return compute


def mask(parts: Parts, theta: Tensor) -> Tensor:
    """The box in a camera's image."""
    camera = Camera.look_at(
        [0.0, 0.2, 0.1], [1.4, 0.0, 0.0], width=16, height=16, field_of_view=0.8
    )
    names = [f"part {k}" for k in range(len(parts))]
    whole = scene(parts, METAL, theta, METAL)
    return silhouettes(whole, camera, names, ImageSampling(256, 4096), 0)


MECHANISMS: dict[str, Mechanism] = {
    "power": power(PAINT, 1),
    "two bounces": power(PAINT, 2),
    "sheets": power(Slab(2.5, thickness=0.004), 1),
    "solid power": power(RefractingBody(2.5, 0.01), 1),
    "coverage": coverage(METAL, 0),
    "coverage, one bounce": coverage(METAL, 1),
    "links": links(2, 0),
    "links, diffraction": links(0, 1),
    "rcs": signature(METAL, 0),
    "rcs, diffraction": signature(METAL, 1),
    "rcs of a solid": signature(Dielectric(2.5, 0.0, scattering=0.0), 0),
    "masks": mask,
}


def evaluate(mechanism: Mechanism, parts: Parts) -> tuple[Tensor, Tensor]:
    """Value and derivative at zero, by forward mode."""
    with forward_ad.dual_level(), torch.no_grad():
        zero = torch.zeros((), dtype=torch.float64)
        found = forward_ad.unpack_dual(mechanism(parts, forward_ad.make_dual(zero, zero + 1)))
        assert found.tangent is not None
        return found.primal.clone(), found.tangent.clone()


def ratio(found: Tensor, clean: Tensor) -> float:
    """⟨a, b⟩/⟨b, b⟩."""
    return float((found * clean).sum() / clean.square().sum())


def measure(
    mechanisms: dict[str, Mechanism] | None = None, subdivisions: int = 708
) -> dict[str, Any]:
    """All metrics; fewer mechanisms and triangles in tests only."""
    metrics: dict[str, Any] = {"value": {}, "derivative": {}, "refused": {}}
    for name, mechanism in (mechanisms or MECHANISMS).items():
        clean, *_ = meshes().values()
        expected = evaluate(mechanism, clean)
        rows: tuple[dict[str, float], dict[str, float]] = {}, {}
        for mesh, parts in list(meshes().items())[1:]:
            try:
                with warnings.catch_warnings(record=True) as warned:
                    warnings.simplefilter("always")
                    found = evaluate(mechanism, parts)
            except iw.InputError as error:
                metrics["refused"][f"{name}.{mesh}"] = str(error)
                continue
            if warned:
                metrics.setdefault("warned", {})[f"{name}.{mesh}"] = str(warned[0].message)
            for row, a, b in zip(rows, found, expected, strict=True):
                row[mesh] = ratio(a, b)
        metrics["value"][name], metrics["derivative"][name] = rows
    ratios = [
        r
        for kind in ("value", "derivative")
        for row in metrics[kind].values()
        for r in row.values()
    ]
    metrics["worst_ratio"] = max(abs(value - 1) for value in ratios)
    metrics["topology_seconds"] = topology_seconds(subdivisions)
    return metrics


def topology_seconds(count: int) -> float:
    """Seconds for the edges of a torus of 2·count² triangles, the longer of indexed and soup."""
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    ring = 1 + 0.3 * angle[:, None].cos()
    places = torch.stack(
        [ring * angle.cos(), ring * angle.sin(), 0.3 * angle[:, None].sin().expand(-1, count)], -1
    ).reshape(-1, 3)
    corner = torch.arange(count**2).reshape(count, count)
    right, below = corner.roll(-1, 1), corner.roll(-1, 0)
    across = right.roll(-1, 0)
    faces = torch.stack([corner, right, across, corner, across, below], -1).reshape(-1, 3)
    soup = places[faces].reshape(-1, 3)
    times = []
    for points, triangles in ((places, faces), (soup, torch.arange(len(soup)).reshape(-1, 3))):
        start = perf_counter()
        edges, _, beside = edge_tables(*weld_faces(points.numpy(), triangles.numpy()))
        times.append(perf_counter() - start)
        assert len(edges) == 3 * count**2
        assert bool((beside >= 0).all())
    return max(times)


def table(metrics: dict[str, Any]) -> Table:
    """Cells that are off, refused or warned of, and what must hold."""
    page = MetricTable("Meshes of one box over the clean one", REQUIRED)
    for kind in ("value", "derivative"):
        for name, row in metrics[kind].items():
            worst = max(row, key=lambda mesh: abs(row[mesh] - 1), default=None)
            value = None if worst is None else row[worst]
            cells = ", ".join(f"{mesh} {r:.3f}" for mesh, r in row.items() if abs(r - 1) > 0.01)
            page.row(
                f"{kind}.{name}", value, ".4f", cells or f"worst of {len(row)} meshes: {worst}"
            )
    for cell, message in metrics["refused"].items():
        page.row(f"refused.{cell}", None, "", message)
    page.row("worst_ratio", metrics["worst_ratio"], ".4f")
    page.row("topology_seconds", metrics["topology_seconds"], ".2f", "10⁶ triangles")
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/meshes"))
    arguments = parser.parse_args()
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
