"""Paths of two and three bounces in a closed room, beside Sionna RT in the same run.

    python benchmarks/multibounce.py [-o DIR]

The room is that of Sionna RT's `box` scene (10 × 10 × 5 m, 12 triangles), of metal that scatters
with coefficient 0.5; transmitter and receiver are 4.1 m apart. Both sides start as many samples
from the transmitter, with a new seed each step, in turns; ratios are medians over steps of their
time over ours (> 1: we are faster).

- We (`deposit_power`) join every vertex of a path to the receiver and sum the paths into a map of
  range × angle. The step adds the derivative with respect to all vertices, which move from step to
  step, so that the tree is rebuilt. Shadow edges are sampled, though a convex room has none.
- They (`PathSolver`, loop mode `evaluate_value`) list paths that end with a diffuse reflection;
the step
  adds the derivative of the total power with respect to the scattering coefficient: their diffuse
  paths have no other. With specular reflection on, as in our room, a vertex is diffuse with
  probability 1/4;
  `forward_ratio_sionna_diffuse` and `step_ratio_sionna_diffuse` are with it off: every vertex
  is diffuse, and ends a path. The list is long enough for all paths.

Twelve triangles are so few that we ask no tree for them. `forward_ratio_sionna_tree` and
`step_ratio_sionna_tree` are those of the same room in 192 triangles, for which we do (theirs keeps
its twelve).

`of_ray_limit` is how near this is to bare ray casting with a tree: the rays that our forward pass
casts in the room of 192 triangles (a counter in each, in a run of its own) over its time, relative
to the rays per second that the same tree answers when nothing else is asked: those of paths of two
bounces, from antenna to wall to wall and from both to the other antenna, drawn before and read from
memory.
1 would mean that all the rest, drawing, radiometry, deposit and tracing, is free.

Further, on a scene with shadows (a ball in front of a wall and above a floor, depth 3):

- `step.tracing_share`: share of a step of 10⁵ samples in which nothing is executed: its time less
  that of building the tree for the new vertices, less the execution times of all that Dr.Jit
  launched besides (its kernel history: kernels, sums, copies), over its time. What is left is
  tracing (Python, assembling and finding kernels), and with it conversions between torch and
  Dr.Jit, torch's own part, and waiting for threads to start: more than tracing costs, never less,
  but for what is traced while a kernel runs, which costs no time. On a busy machine the waiting
  dominates. `step.tree_share` is the tree's; `step.assembly_share` is the part of the tracing that
  the history itself names: code generation, and compilation or a look-up in the cache.
- `step.short_share`: time of a step of 10³ samples over that of one of 10⁵, in turns: tracing and
  all that a step costs however few its samples, the tree too.
- `step.new_kernels`: kernels of further steps, with other vertices, seeds and depths 2, 3, 5, that
  were not among those of the first two: what would be compiled then. A kernel from Dr.Jit's cache
  on disk counts too.

Prints a table and writes `metrics.json` into DIR (default `out/multibounce`). Sionna RT comes with
the extra `bench`; without it those rows stay empty.
"""

import argparse
import math
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from edges import Task, bodies, placed, single
from report import MetricTable, write
from rich.table import Table
from throughput import WAVEFORM, sionna_version
from trimesh.remesh import subdivide

from invertwin.channel import Sampling, backend, deposit_power
from invertwin.channel.rays.backend import mi
from invertwin.channel.rays.ray_scene import Occluders
from invertwin.channel.rays.topology import Topology
from invertwin.radar import Radar
from invertwin.runtime.memory import peak_memory
from invertwin.scene import Mesh, Object, RoughConductor, Scene
from invertwin.scene.antenna import linear_array
from invertwin.scene.shapes import box

SAMPLES, MEMORY_SAMPLES = 1_000_000, 10_000_000
STEPS = 9
WARM_UP = 3
DEPTHS = (2, 3)
FEW, MANY = 1_000, 100_000  # samples of the steps whose tracing share is taken
SIZE = (10.0, 10.0, 5.0)  # [m]; the floor is at z = 0
SCATTERING = 0.5
DIVISIONS = 2  # of the room whose rays ask a tree
TRANSMITTER, RECEIVER = (-2.0, 0.5, 2.0), (2.0, 1.5, 2.0)
REQUIRED = {
    "forward_ratio_sionna": (">=", 5.0),
    "step_ratio_sionna": (">=", 4.0),
    "peak_memory_gb": ("<=", 1.0),
    "of_ray_limit": (">=", 0.5),
    "tracing_share": ("<=", 0.2),
    "new_kernels": ("<=", 0),
}


def walls_of(divisions: int) -> Mesh:
    """The room's walls, every triangle divided into four so many times."""
    mesh = box(SIZE)
    vertices, faces = mesh.vertices.numpy(), mesh.faces.numpy()
    for _ in range(divisions):
        vertices, faces, *_ = subdivide(vertices, faces)
    return Mesh(torch.from_numpy(vertices), torch.from_numpy(faces))


def room(divisions: int = 0) -> Task:
    """The room, and a 16-element array in it."""
    metal = RoughConductor(scattering=SCATTERING)
    walls = Object(walls_of(divisions), metal, placed(0, 0, SIZE[2] / 2))
    receivers = linear_array(16, WAVEFORM.wavelength / 2)
    offset = torch.tensor(RECEIVER, dtype=torch.float64) - torch.tensor(TRANSMITTER)
    radar = Radar(
        single(0.0),
        replace(receivers, positions=receivers.positions + offset),
        replace(WAVEFORM, samples=512),
        torch.tensor([TRANSMITTER], dtype=torch.float64),
    )
    return Task(Scene({"room": walls}), radar, radar.grid(1.0, 32.0, u_max=1.0), "room")


def step(task: Task, number: int, samples: int, depth: int) -> tuple[float, float]:
    """Seconds of forward and backward with new vertices and a new seed."""
    scene, vertices = task.moved(number)
    start = perf_counter()
    power = deposit_power(
        scene,
        task.radar.link(),
        task.grid,
        sampling=Sampling(depth=depth, samples=samples, boundary_samples=samples // 10),
        seed=number,
    )
    middle = perf_counter()
    (power / power.detach().mean()).square().mean().backward()
    end = perf_counter()
    assert vertices.grad is not None
    assert vertices.grad.norm() > 0
    return middle - start, end - middle


def forward(task: Task, samples: int, depth: int) -> None:
    """The forward pass alone."""
    sampling = Sampling(depth=depth, samples=samples, boundary=False)
    deposit_power(task.scene, task.radar.link(), task.grid, sampling=sampling, seed=1)


def rays_cast(task: Task, samples: int, depth: int) -> int:
    """Rays of one forward pass."""
    import drjit as dr

    counter = dr.opaque(mi.UInt32, 0)

    def counted(name: str) -> Any:
        cast = getattr(Occluders, name)

        def call(rays: Any, *given: Any, **named: Any) -> Any:
            lanes, active = dr.zeros(mi.UInt32, dr.width(given)), given[-1]
            dr.scatter_reduce(dr.ReduceOp.Add, counter, mi.UInt32(1), lanes, active)
            return cast(rays, *given, **named)

        return patch.object(Occluders, name, call)

    with counted("find_nearest"), counted("is_clear"):
        forward(task, samples, depth)
    return int(counter[0])


def forward_seconds(task: Task, samples: int, depth: int) -> float:
    """Median time of a forward pass."""
    times = []
    for _ in range(WARM_UP + STEPS):
        begun = perf_counter()
        forward(task, samples, depth)
        times.append(perf_counter() - begun)
    return statistics.median(times[WARM_UP:])


def bare_rays_per_second(paths: int = 1_000_000, repeats: int = 5) -> float:
    """Rays of paths of two bounces in the divided room on its tree, drawn before and cast alone."""
    import drjit as dr

    mesh = walls_of(DIVISIONS)
    one = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    tree = Topology(mesh.faces, one, mesh.vertices, np.zeros(1, dtype=np.int64))
    scene = tree.ray_scene(mesh.vertices.float())
    start, end = (mi.Point3f(x, y, z - SIZE[2] / 2) for x, y, z in (TRANSMITTER, RECEIVER))
    count, numbers = int(math.sqrt(paths)), np.random.default_rng(0)
    index = dr.arange(mi.UInt32, count**2)
    cell = mi.Point2f(index % count, index // count)
    jitter, other = (
        mi.Point2f(*(mi.Float(numbers.random(count**2, np.float32)) for _ in range(2)))
        for _ in range(2)
    )
    nearest, tests = [], []
    for square in ((cell + jitter) / count, other):
        ray = mi.Ray3f(start, mi.warp.square_to_uniform_sphere(square))
        place = ray(0.9999 * scene.ray_intersect_preliminary(ray).t)
        nearest.append(ray)
        tests.append(mi.Ray3f(place, end - place, 0.999, 0.0, []))
        start = place
    dr.eval(nearest, tests)
    times = []
    for _ in range(repeats + 1):
        begun = perf_counter()
        dr.eval([scene.ray_intersect_preliminary(ray).t for ray in nearest])
        dr.eval([scene.ray_test(ray) for ray in tests])
        dr.sync_thread()
        times.append(perf_counter() - begun)
    return 4 * count**2 / statistics.median(times[1:])


class Theirs:
    """Steps of Sionna RT in its `box` scene; raises ModuleNotFoundError where not installed."""

    def __init__(self) -> None:
        rt = import_module("sionna.rt")
        self.scene = rt.load_scene(rt.scene.box)
        self.scene.frequency = WAVEFORM.center_frequency
        (walls,) = self.scene.objects.values()
        self.material = walls.radio_material
        antenna = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
        self.scene.tx_array = self.scene.rx_array = antenna
        self.scene.add(rt.Transmitter("tx", mi.Point3f(*TRANSMITTER)))
        self.scene.add(rt.Receiver("rx", mi.Point3f(*RECEIVER)))
        self.solver = rt.PathSolver()
        self.solver.loop_mode = "evaluated"

    def step(
        self, number: int, samples: int, depth: int, *, specular: bool = True
    ) -> tuple[float, float, int]:
        """Seconds of forward and backward with a new seed, and the number of paths."""
        import drjit as dr

        coefficient = mi.Float(SCATTERING)
        dr.enable_grad(coefficient)
        self.material.scattering_coefficient = coefficient
        start = perf_counter()
        paths = self.solver(
            self.scene,
            max_depth=depth,
            samples_per_src=samples,
            max_num_paths_per_src=depth * samples,
            los=False,
            specular_reflection=specular,
            diffuse_reflection=True,
            refraction=False,
            seed=number + 1,
        )
        dr.eval(paths.a, paths.tau)
        dr.sync_thread()
        middle = perf_counter()
        power: Any = sum(dr.sum(dr.square(part), axis=None) for part in paths.a)
        dr.backward(power)
        gradient = np.array(dr.grad(coefficient))
        end = perf_counter()
        assert np.isfinite(gradient).all()
        assert gradient.any()
        return middle - start, end - middle, int(np.array(paths.valid).sum())


def compared(
    depth: int, samples: int, steps: int, theirs: Theirs | None, bare: float
) -> dict[str, Any]:
    """Medians of our steps and theirs, in turns."""
    task, divided = room(), room(DIVISIONS)
    ours, listed, diffuse, by_tree = [], [], [], []
    for number in range(WARM_UP + steps):
        ours.append(step(task, number, samples, depth))
        by_tree.append(step(divided, number, samples, depth))
        if theirs is not None:
            listed.append(theirs.step(number, samples, depth))
            diffuse.append(theirs.step(number, samples, depth, specular=False))
    forward, backward = (statistics.median(part) for part in zip(*ours[WARM_UP:], strict=True))
    both = statistics.median(sum(pair) for pair in ours[WARM_UP:])
    found: dict[str, Any] = {
        "forward_s": forward,
        "backward_s": backward,
        "samples_per_second": (samples + samples // 10) / both,
    }
    cast, seconds = rays_cast(divided, samples, depth), forward_seconds(divided, samples, depth)
    found["rays_per_second"] = cast / seconds
    found["of_ray_limit"] = found["rays_per_second"] / bare
    sides = {"": (ours, listed), "_diffuse": (ours, diffuse), "_tree": (by_tree, listed)}
    for suffix, (own, other) in sides.items():
        pairs = list(zip(own, other, strict=False))[WARM_UP:]
        ratios: dict[str, float | None] = {"forward": None, "step": None}
        if pairs:
            ratios["forward"] = statistics.median(b[0] / a[0] for a, b in pairs)
            ratios["step"] = statistics.median((b[0] + b[1]) / (a[0] + a[1]) for a, b in pairs)
            if suffix != "_tree":
                found[f"paths_sionna{suffix}"] = other[-1][2]
                found[f"forward_s_sionna{suffix}"] = statistics.median(b[0] for _, b in pairs)
                found[f"backward_s_sionna{suffix}"] = statistics.median(b[1] for _, b in pairs)
        found |= {f"{name}_ratio_sionna{suffix}": ratio for name, ratio in ratios.items()}
    return found


def repeated(steps: int) -> dict[str, Any]:
    """What repeating a step costs beside its kernels."""
    task = Task.build(bodies()["ball"])

    def timed(number: int, samples: int) -> float:
        return sum(step(task, number, samples, 3))

    def shares(number: int) -> tuple[float, float, float]:
        seconds: list[float] = []
        with tree_times() as trees:
            launched = history(lambda: seconds.append(timed(number, MANY)))
        executed = sum(entry["execution_time"] for entry in launched) / 1e3
        assembled = sum(e.get("codegen_time", 0) + e.get("backend_time", 0) for e in launched) / 1e3
        idle = seconds[0] - sum(trees) - executed
        return idle / seconds[0], sum(trees) / seconds[0], assembled / seconds[0]

    known, later = set[str](), set[str]()
    for number in range(2):
        known |= kernels(lambda number=number: step(task, number, MANY, 3))
    for number, depth in enumerate((3, 2, 5, 3), start=2):
        later |= kernels(lambda number=number, depth=depth: step(task, number, MANY, depth))
    pairs = [(timed(number, FEW), timed(number, MANY)) for number in range(WARM_UP + 3 * steps)]
    tracing, tree, assembly = zip(*(shares(number) for number in range(3 * steps)), strict=True)
    return {
        "tracing_share": statistics.median(tracing),
        "tree_share": statistics.median(tree),
        "assembly_share": statistics.median(assembly),
        "short_share": statistics.median(few / many for few, many in pairs[WARM_UP:]),
        "new_kernels": len(later - known),
    }


@contextmanager
def tree_times() -> Iterator[list[float]]:
    """Seconds of every building of a tree; what it launches leaves Dr.Jit's kernel history."""
    import drjit as dr

    ask, found = Topology.ray_scene, list[float]()

    def timed(topology: Topology, vertices: torch.Tensor) -> Any:
        known = topology._uploaded
        if known is not None and (known is vertices or torch.equal(known, vertices)):
            return ask(topology, vertices)
        start = perf_counter()
        scene = ask(topology, vertices)
        dr.sync_thread()
        found.append(perf_counter() - start)
        dr.kernel_history_clear()
        return scene

    with patch.object(Topology, "ray_scene", timed):
        yield found


def kernels(act: Callable[[], Any]) -> set[str]:
    """Which kernels run during an action, whether compiled then or found in a cache."""
    return {str(entry["hash"]) for entry in history(act) if entry.get("hash") is not None}


def history(act: Callable[[], Any]) -> list[dict[str, Any]]:
    """All that Dr.Jit launches during an action; times in milliseconds."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        act()
        found = dr.kernel_history()
        dr.kernel_history_clear()
    return found


def peak_of_steps(samples: int, depth: int) -> float:
    """Peak resident memory of a fresh process that does three steps [GB]."""
    command = [sys.executable, __file__, "--memory", str(samples), str(depth)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def memory_of_steps(samples: int, depth: int) -> float:
    """Peak resident memory of this process after three steps [GB]."""
    task = room()
    for number in range(3):
        step(task, number, samples, depth)
    return (peak_memory() or math.nan) / 1e9


def measure(
    samples: int = SAMPLES, memory_samples: int = MEMORY_SAMPLES, steps: int = STEPS
) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    metrics: dict[str, Any] = {
        "samples": samples,
        "memory_samples": memory_samples,
        "steps": steps,
        "backend": backend(),
        "cpu_count": os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "sionna_rt_version": sionna_version(),
    }
    metrics["step"] = repeated(steps)
    try:
        theirs = Theirs()
    except ModuleNotFoundError:
        theirs = None
    metrics["bare_rays_per_second"] = bare_rays_per_second()
    for depth in DEPTHS:
        found = compared(depth, samples, steps, theirs, metrics["bare_rays_per_second"])
        metrics[f"depth{depth}"] = found
        metrics[f"depth{depth}"]["peak_memory_gb"] = peak_of_steps(memory_samples, depth)
    return metrics


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    m = metrics
    page = MetricTable(
        f"Closed room, {m['samples']} samples; medians of {m['steps']} steps after warm-up; "
        f"backend {m['backend']}; {m['cpu_count']} CPU cores, load average "
        f"{m['load_average']:.1f} at the start",
        REQUIRED,
    )

    def row(part: str, key: str, shown: str, text: str = "") -> None:
        page.row(f"{part}.{key}", m[part].get(key), shown, text)

    version = m["sionna_rt_version"]
    for part in (f"depth{depth}" for depth in DEPTHS):
        row(part, "samples_per_second", ".3g", "forward + backward by all vertices")
        row(part, "forward_s", ".3f")
        row(part, "backward_s", ".3f")
        row(part, "rays_per_second", ".3g", "of the forward pass alone, 192 triangles")
        bare = m["bare_rays_per_second"]
        row(part, "of_ray_limit", ".2f", f"over {bare:.3g} a second of bare ray casting")
        row(part, "peak_memory_gb", ".2f", f"three steps of {m['memory_samples']} samples")
        for suffix in ("", "_diffuse"):
            if version is None:
                text = "Sionna RT is not installed: pip install 'invertwin[bench]'"
            else:
                row(part, f"forward_s_sionna{suffix}", ".3f")
                row(part, f"backward_s_sionna{suffix}", ".3f", "by the scattering coefficient")
                text = (
                    f"Sionna RT {version}, {m[part][f'paths_sionna{suffix}']} paths, specular "
                    f"reflection {'off' if suffix else 'on'}: a list of paths; ours: a map"
                )
            row(part, f"forward_ratio_sionna{suffix}", ".2f", text)
            row(part, f"step_ratio_sionna{suffix}", ".2f")
        row(part, "forward_ratio_sionna_tree", ".2f", "our room in 192 triangles")
        row(part, "step_ratio_sionna_tree", ".2f")
    row("step", "tracing_share", ".2f", f"of a step of {MANY} samples, depth 3: nothing executed")
    row("step", "tree_share", ".3f", "the tree of the new vertices")
    row("step", "assembly_share", ".3f", "kernels assembled and looked up")
    row("step", "short_share", ".2f", f"step of {FEW} samples over step of {MANY}")
    row("step", "new_kernels", "d", "in further steps: new vertices, seeds, depths 2, 3, 5")
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/multibounce"))
    parser.add_argument(
        "--memory",
        type=int,
        nargs=2,
        metavar=("N", "DEPTH"),
        help="only print the peak memory [GB] of N samples",
    )
    arguments = parser.parse_args()
    if arguments.memory:
        print(memory_of_steps(*arguments.memory))
        return
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
