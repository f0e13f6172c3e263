"""Bodies as the meshes that people have of them: values and derivatives over those of a clean mesh.

    python benchmarks/meshes.py [-o DIR]

Each row is a mechanism, each column a mesh of the same surface. Of a box: `plates` (six, whose
corners agree to rounding), `panels` (six objects), `finer`, `diagonals` (the other one of each
face), `junctions` (one face of eight triangles against undivided neighbours), `overlapping` (two
boxes with shared planes, united), `raw` (these as they are), `doubled` (a face twice, along both
diagonals), `inside_out`, `mixed` (every third triangle turned), `cracked` (by 1e-9 m), `soup`
(three float32 corners a triangle, as in an STL file), `jittered` (these up to 1e-5 of the size
apart), `shaken panels` (as far apart, six objects). Of a car, a chair and a room (`bodies.py`):
`file` (a float32 STL, loaded), `raw` (all parts in one mesh) and `objects` (each part one). Of a
wall on part of a floor's edge: `raw`, `objects`, and both with the wall 1e-9 m below the floor
(`sunk`) or above. Prints tables and writes `metrics.json` into DIR (default `out/meshes`):

- `value.<mechanism>.<mesh>`, `derivative.<mechanism>.<mesh>`: ⟨a, b⟩/⟨b, b⟩ of a quantity a and
  that of the clean mesh, b; its derivative is with respect to a translation that turns.
- `refused`: cells that are refused, by message. `worst_ratio`: largest |ratio − 1| of all others.
- `topology_seconds`: time of the topology of a mesh of 10⁶ triangles, median of five runs, the
  longer of indexed and soup; `topology_process_seconds`: of all threads of this process.
- `topology_share`: time of the topology in an optimisation step of the car's map, over that of the
  step: of one mesh and of objects, the larger.
"""

import argparse
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any
from unittest import mock

import bodies
import torch
import trimesh
from report import MetricTable, Required, write
from rich.table import Table
from torch import Tensor
from torch.autograd import forward_ad

import invertwin as iw
from invertwin.camera import Camera, ImageSampling, depths, silhouettes
from invertwin.channel import (
    Link,
    Paths,
    RayPaths,
    combine_coherently,
    deposit_paths,
    deposit_power,
    trace_facet_paths,
    trace_field,
    trace_paths,
    trace_single_scattering,
    trace_target,
)
from invertwin.channel.rays import scene_tables
from invertwin.channel.rays.topology import topology_of
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import PhysicsWarning
from invertwin.links import CellSampling, MapPlane, PropagationSettings, Transmitters
from invertwin.links.metasurface.panel import Metasurface, panel_response
from invertwin.scene import (
    AntennaArray,
    Dielectric,
    Material,
    Mesh,
    RefractingBody,
    Slab,
    load_mesh,
    merge_meshes,
    rotation_from_vector,
)
from invertwin.scene.mesh import concatenate_meshes

Parts = list[Mesh]
REQUIRED: Required = {
    "worst_ratio": ("<=", 0.01),
    "topology_seconds": ("<=", 2.0),
    "topology_share": ("<=", 0.05),
}
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
    triples = torch.arange(len(corners)).reshape(-1, 3)
    random = torch.randn(corners.shape, generator=torch.Generator().manual_seed(0)).double()
    away = 0.5e-5 * float(vector(*SIZE).norm()) * torch.nn.functional.normalize(random, dim=1)
    shaken = [Mesh(p.vertices + away[4 * k : 4 * k + 4], p.faces) for k, p in enumerate(plates())]
    flipped = clean.faces.clone()
    flipped[::3] = flipped[::3].flip(1)
    front = clean.faces[8:10]
    again = front, other_diagonal(front)
    joined = plates()
    crack = [Mesh(joined[0].vertices - vector(1e-9, 0, 0), joined[0].faces), *joined[1:]]
    x, y, z = SIZE
    right, left = iw.box((x, 0.7 * y, z)), iw.box((x, 0.6 * y, z))
    halves = [
        Mesh(right.vertices - vector(0, 0.15 * y, 0), right.faces),
        Mesh(left.vertices + vector(0, 0.2 * y, 0), left.faces),
    ]
    other = torch.cat([other_diagonal(pair) for pair in clean.faces.split(2)])
    return {
        "clean": [clean],
        "plates": [merge_meshes(joined)],
        "panels": joined,
        "finer": [subdivided(clean, slice(None))],
        "diagonals": [Mesh(clean.vertices, other)],
        "junctions": [subdivided(clean, slice(0, 2))],
        "overlapping": [merge_meshes(halves)],
        "raw": [concatenate_meshes(halves)],
        "doubled": [Mesh(clean.vertices, torch.cat([clean.faces, *again]))],
        "inside_out": [Mesh(clean.vertices, clean.faces.flip(1))],
        "mixed": [Mesh(clean.vertices, flipped)],
        "cracked": [merge_meshes(crack)],
        "soup": [Mesh(corners.float().double(), triples)],
        "jittered": [Mesh(corners + away, triples)],
        "shaken panels": shaken,
    }


def outline(pair: Tensor) -> list[Tensor]:
    """Corners of the quadrilateral of two triangles, around it, from an end of its diagonal."""
    first, second = pair.tolist()
    start = next(k for k in range(3) if first[k] not in second)
    opposite = next(v for v in second if v not in first)
    ring = [first[start], first[(start + 1) % 3], opposite, first[(start + 2) % 3]]
    # The diagonal of the mesh joins the second and the fourth; the other one the first and third.
    return [torch.tensor(v) for v in (ring[1], ring[2], ring[3], ring[0])]


def other_diagonal(pair: Tensor) -> Tensor:
    """The two triangles of a quadrilateral, split along its other diagonal."""
    quad = outline(pair)
    return torch.stack([quad[0], quad[1], quad[3], quad[1], quad[2], quad[3]]).reshape(2, 3)


def corner_meshes() -> dict[str, Parts]:
    """A wall that stands on part of a floor's far edge: the clean mesh first."""

    def quad(*corners: tuple[float, float, float]) -> Mesh:
        return Mesh(torch.tensor(corners).double(), torch.tensor([[0, 1, 2], [0, 2, 3]]))

    def wall(low: float) -> Mesh:
        return quad((0.25, -0.15, low), (0.25, 0.2, low), (0.25, 0.2, 0.2), (0.25, -0.15, 0.2))

    low = -0.25
    floor = quad((-0.2, -0.25, low), (0.25, -0.25, low), (0.25, 0.25, low), (-0.2, 0.25, low))
    points = torch.cat([floor.vertices, wall(low).vertices])
    around = [[0, 1, 4], [0, 4, 5], [0, 5, 3], [3, 5, 2]]
    upright = [[4, 5, 6], [4, 6, 7]]
    moved = {"": low, "sunk": low - 1e-9, "lifted": low + 1e-9}
    return {
        "clean": [Mesh(points, torch.tensor(around + upright))],
        **{f"raw {k}".strip(): [concatenate_meshes([floor, wall(z)])] for k, z in moved.items()},
        **{f"objects {k}".strip(): [floor, wall(z)] for k, z in moved.items()},
    }


def body_meshes(name: str) -> dict[str, Parts]:
    """The clean surface of a body first, then the file, the parts in one mesh, and as objects."""
    if name == "corner":
        return corner_meshes()
    parts, clean = {
        "car": lambda: (bodies.car(), merge_meshes(bodies.car())),
        "chair": lambda: (bodies.chair(), bodies.clean_chair()),
        "room": lambda: (bodies.room(), bodies.clean_room()),
    }[name]()
    raw = concatenate_meshes(parts)
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", PhysicsWarning)  # which says what is repaired
        path = Path(folder, "body.stl")
        trimesh.Trimesh(raw.vertices.numpy(), raw.faces.numpy(), process=False).export(path)
        read = load_mesh(path)
    return {"clean": [clean], "file": [read], "raw": [raw], "objects": parts}


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


def coverage(
    material: Material, depth: int, points: int = 400, edge_points: int = 40_000
) -> Mechanism:
    """Gains of the cells of a plane behind the box."""

    def compute(parts: Parts, theta: Tensor) -> Tensor:
        cells = CellSampling(points, edge_points)
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


def depth_image(parts: Parts, theta: Tensor) -> Tensor:
    """Depths of the box and the wall in a camera's image."""
    camera = Camera.look_at(
        [0.0, 0.2, 0.1], [1.4, 0.0, 0.0], width=16, height=16, field_of_view=0.8
    )
    return depths(scene(parts, METAL, theta, METAL), camera, 5.0, ImageSampling(256, 4096), 0)


def at_carrier(paths: Paths, link: Link) -> Tensor:
    """Real and imaginary parts of the sum of field paths."""
    phase = 2 * math.pi / link.wavelength * SPEED_OF_LIGHT * paths.delay
    field = paths.coefficient * torch.polar(torch.ones_like(phase), -phase)
    return torch.view_as_real(field.sum()[None])


def field_link(distance: float = 0.0) -> Link:
    """The antennas at 1 GHz, so that few samples resolve the fringes, a distance further back."""
    place = vector(-distance, 0, 0)[None]
    waveform = iw.FMCW(0.95e9, 0.1e9, 50e-6, 64)
    return replace(radar(), waveform=waveform, positions=place).link()


def coherent_field(parts: Parts, theta: Tensor) -> Tensor:
    """The sum of the fields of a conductor."""
    sampling = iw.Sampling(1, conductor_samples=SAMPLES, boundary_samples=SAMPLES)
    link = field_link()
    paths = trace_field(scene(parts, METAL, theta, METAL), link, sampling=sampling, seed=1)
    return at_carrier(paths, link)


def facet_paths(parts: Parts, theta: Tensor) -> Tensor:
    """The field of facets by beams of plane waves, from the far field."""
    link = field_link(100.0)
    return at_carrier(trace_facet_paths(scene(parts, METAL, theta, None), link, 1), link)


def coherent_target(parts: Parts, theta: Tensor) -> Tensor:
    """The echo of a plate that the box half hides, in range bins."""
    plate = iw.rigid(rotation_from_vector(vector(0, 0.05, 0.1)), vector(2.4, 0.4, 0.3))
    objects = scene(parts, PAINT, theta, None).objects
    whole = iw.Scene({**objects, "plate": iw.Object(iw.plate(0.3, 0.25), METAL, plate)})
    link, bins = field_link(), iw.Grid(0.5, 0.2, 20)
    fields = trace_target(whole, "plate", link, sampling=iw.Sampling(1))

    def overlap(*gaps: Tensor) -> Tensor:
        return torch.exp(-((gaps[0] / 0.4) ** 2))

    return deposit_paths(combine_coherently(fields, link, overlap), link, bins).double()


def reflected_scattering(parts: Parts, theta: Tensor) -> Tensor:
    """Power that the wall scatters past the box, with a mirror before or after."""
    mirror = iw.rigid(rotation_from_vector(vector(0, 0, 1.4)), vector(1.6, 0.9, 0.0))
    objects = {
        **scene(parts, METAL, theta, PAINT).objects,
        "mirror": iw.Object(iw.plate(1.0, 1.0), METAL, mirror),
    }
    air = {
        name: replace(item, material=item.material if name == "wall" else Dielectric(1.0))
        for name, item in objects.items()
    }

    def power(out: RayPaths, home: RayPaths, turned: Tensor, *_: Tensor) -> Tensor:
        ways = [way.coefficient.abs().square().sum((1, 2)) for way in (out, home)]
        return (ways[0] * ways[1] * (1 - turned))[:, None]

    receivers = torch.stack([vector(0.7, 0.3, 0.35), vector(0.6, -0.2, -0.3)])
    return trace_single_scattering(
        iw.Scene(objects), iw.Scene(air), vector(0.0, 0.03, 0.02), receivers, 1e9, power, 1,
        rays=None, sampling=iw.Sampling(2, 200_000, 20_000), seed=1,
    )  # fmt: skip


def metasurface(parts: Parts, theta: Tensor) -> Tensor:
    """What a panel that the box half hides sends from one antenna to another."""
    axes = torch.stack([vector(-1, 0, 0), vector(0, -1, 0), vector(0, 0, 1)])
    panel = Metasurface(vector(2.2, 0.4, 0.15), axes, torch.zeros(20, 20).double(), spacing=0.015)
    ends = vector(0, 0.03, 0.02)[None], vector(0.3, 0.9, 0.6)[None]
    whole = scene(parts, METAL, theta, METAL)
    return torch.view_as_real(panel_response(whole, panel, *ends, 1e10)).flatten()


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
    "depths": depth_image,
    "coherent field": coherent_field,
    "facet paths": facet_paths,
    "coherent targets": coherent_target,
    "reflected scattering": reflected_scattering,
    "metasurfaces": metasurface,
}


#: Mechanisms of bodies, and the meshes of them that each is compared on. A step of the car's
#: coverage compares each ray with all triangles, so that there are few.
BODIES: dict[str, dict[str, tuple[Mechanism, tuple[str, ...]]]] = {
    "car": {
        "power": (MECHANISMS["power"], ("file", "raw", "objects")),
        "two bounces": (MECHANISMS["two bounces"], ("file", "raw", "objects")),
        "coverage": (coverage(METAL, 0, 100, 2000), ("file", "raw")),
        "links, diffraction": (MECHANISMS["links, diffraction"], ("file",)),
        "masks": (mask, ("file", "raw", "objects")),
    },
    **{
        body: {name: (MECHANISMS[name], ("file", "raw", "objects")) for name in chosen}
        for body, chosen in {
            "chair": ("power", "two bounces", "coverage", "links, diffraction", "masks"),
            "room": ("power", "two bounces", "coverage", "links", "links, diffraction", "masks"),
        }.items()
    },
    "corner": {
        name: (MECHANISMS[name], tuple(corner_meshes())[1:])
        for name in ("power", "two bounces", "coverage", "links, diffraction", "rcs", "masks")
    },
}  # fmt: skip


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


def compare(
    metrics: dict[str, Any], name: str, mechanism: Mechanism, columns: dict[str, Parts], body: str
) -> None:
    """Add the cells of a mechanism: of all meshes of a body over the first one."""
    expected: tuple[Tensor, Tensor] | None = None
    for mesh, parts in columns.items():
        cell = f"{body} {mesh}".strip()
        try:
            found = evaluate(mechanism, parts)
        except iw.InputError as error:
            metrics["refused"][f"{name}.{cell}"] = str(error)
            continue
        if expected is None:
            expected = found
            continue
        for kind, a, b in zip(("value", "derivative"), found, expected, strict=True):
            metrics[kind].setdefault(name, {})[cell] = ratio(a, b)


def measure(
    mechanisms: dict[str, Mechanism] | None = None,
    chosen: tuple[str, ...] = tuple(BODIES),
    subdivisions: int = 708,
) -> dict[str, Any]:
    """All metrics; fewer mechanisms, bodies and triangles in tests only."""
    metrics: dict[str, Any] = {"value": {}, "derivative": {}, "refused": {}}
    for name, mechanism in (MECHANISMS if mechanisms is None else mechanisms).items():
        compare(metrics, name, mechanism, meshes(), "")
    for body in chosen:
        columns = body_meshes(body)
        for name, (mechanism, some) in BODIES[body].items():
            compare(metrics, name, mechanism, {k: columns[k] for k in ("clean", *some)}, body)
    ratios = [
        ratio
        for kind in ("value", "derivative")
        for row in metrics[kind].values()
        for ratio in row.values()
    ]
    metrics["worst_ratio"] = max(abs(value - 1) for value in ratios)
    metrics |= topology_seconds(subdivisions)
    if "car" in chosen:
        metrics["topology_share"] = topology_share()
    return metrics


def topology_seconds(count: int, repeats: int = 5) -> dict[str, float]:
    """Median times of the topology of a torus of 2·count² triangles, of indexed or soup."""
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
    topology_of([iw.box(0.1)])  # the ray tracer is loaded
    times = []
    for vertices, corners in ((places, faces), (soup, torch.arange(len(soup)).reshape(-1, 3))):
        runs = []
        for _ in range(repeats):
            start = perf_counter(), process_time()
            found = topology_of([Mesh(vertices, corners.clone())])  # of new faces each time
            runs.append((perf_counter() - start[0], process_time() - start[1]))
            assert len(found.edges) == 3 * count**2
            assert not found.open_objects
        times.append([median(column) for column in zip(*runs, strict=True)])
    wall, process = map(max, zip(*times, strict=True))
    return {"topology_seconds": wall, "topology_process_seconds": process}


def topology_share(steps: int = 5) -> float:
    """Time of the topology over that of a step of a map of the car, with its derivative."""
    columns, spent, shares = body_meshes("car"), 0.0, []
    wall = iw.Object(iw.plate(2.0, 2.0), PAINT, iw.rigid(translation=vector(2.4, 0, 0)))

    def timed(*arguments: Any) -> Any:
        nonlocal spent
        begin = process_time()
        found = topology_of(*arguments)
        spent += process_time() - begin
        return found

    def step(parts: Parts, theta: Tensor) -> None:
        around = scene(parts, PAINT, theta, None)
        around = iw.Scene({**around.objects, "wall": wall})
        bins = iw.Grid(0.5, 0.1, 40)
        deposit_power(
            around, radar().link(), bins, sampling=iw.Sampling(1), seed=1
        ).sum().backward()

    for column in ("file", "objects"):
        rows = []
        for number in range(steps + 1):
            spent, begin = 0.0, process_time()
            with mock.patch.object(scene_tables, "topology_of", timed):
                step(columns[column], vector(0.01 * number)[0].requires_grad_())
            rows.append(spent / (process_time() - begin))
        shares.append(sorted(rows[1:])[steps // 2])  # the first one finds the topology
    return max(shares)


def table(metrics: dict[str, Any]) -> Table:
    """Cells that are off or refused, and what must hold."""
    page = MetricTable("Meshes of bodies over the clean ones", REQUIRED)
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
    process = f"10⁶ triangles; {metrics['topology_process_seconds']:.2f} s of the process"
    page.row("topology_seconds", metrics["topology_seconds"], ".2f", process)
    page.row("topology_share", metrics.get("topology_share"), ".4f", "of a step, the car")
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
