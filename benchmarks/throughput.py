"""Speed and memory of the forward and backward pass, beside Sionna RT in the same run.

    python benchmarks/throughput.py [-o DIR]

Prints a table and writes `metrics.json` into DIR (default `out/throughput`). Sionna RT comes with
the extra `bench`; without it that row stays empty.
"""

import argparse
import math
import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from report import MetricTable, write
from rich.table import Table
from torch import Tensor

from invertwin.channel import Grid, Sampling, backend, deposit_power, trace_power
from invertwin.channel.rays.backend import mi
from invertwin.channel.rays.ray_scene import RayScene, is_visible
from invertwin.channel.rays.scene_tables import flatten
from invertwin.radar import FMCW, Radar
from invertwin.runtime.memory import peak_memory
from invertwin.scene import AntennaArray, Isotropic, Mesh, Object, RoughDielectric, Scene
from invertwin.scene.antenna import linear_array
from invertwin.scene.shapes import box, plate, sphere

SAMPLES, BOUNDARY_SAMPLES, MEMORY_SAMPLES = 1_000_000, 100_000, 10_000_000
STEPS = 30
WARM_UP = 5
WAVEFORM = FMCW(start_frequency=76e9, bandwidth=2e9, duration=50e-6, samples=128)
REQUIRED = {
    "samples_per_second": (">=", 5e6),
    "backward_over_forward": ("<=", 2.5),
    "peak_memory_gb": ("<=", 1.5),
    "useful_paths_ratio_sionna": (">=", 30.0),
}


@dataclass(frozen=True)
class Task:
    """A bumpy ball in front of a wall, seen by a 16-element array as a range × angle map."""

    scene: Scene
    radar: Radar
    grid: Grid

    @staticmethod
    def build(subdivisions: int = 5) -> "Task":
        """The ball has 20 · 4^subdivisions triangles; its bumps hide parts of it."""
        ball = sphere(0.3, subdivisions)
        x, y, z = (12 * ball.vertices / 0.3).unbind(dim=1)
        bumps = 1 + 0.15 * torch.sin(x) * torch.sin(y) * torch.sin(z)
        rough = RoughDielectric(permittivity=4.0)
        objects = {
            "ball": Object(replace(ball, vertices=ball.vertices * bumps[:, None]), rough, at(2.5)),
            "wall": Object(plate(3.0, 2.4, divisions=8), rough, at(3.3)),
        }
        receivers = linear_array(16, WAVEFORM.wavelength / 2)
        radar = Radar(single(0.0), receivers, WAVEFORM, torch.zeros(1, 3, dtype=torch.float64))
        return Task(Scene(objects), radar, radar.grid(2.0, 3.9, u_max=0.6))

    @property
    def triangles(self) -> int:
        """Of the whole scene."""
        return sum(len(item.mesh.faces) for item in self.scene.objects.values())

    def hidden_share(self) -> float:
        """Share of the triangles that face the radar and that it cannot see."""
        link = self.radar.link()
        geometry = flatten(self.scene, link.wavelength)
        corners = geometry.corners(torch.arange(len(geometry.faces)))
        center = torch.stack(corners).mean(dim=0)
        normal = torch.linalg.cross(corners[1] - corners[0], corners[2] - corners[0])
        facing = center[(normal * (link.tx - center)).sum(dim=1) > 0]
        seen = is_visible(RayScene(geometry, link), link.tx.expand(len(facing), 3), facing)
        return 1 - float(seen.double().mean())

    def step(self, number: int, samples: int, boundary_samples: int) -> tuple[float, float]:
        """Seconds of forward and backward with new vertices and a new seed."""
        mesh = self.scene["ball"].mesh
        vertices = (mesh.vertices * (1 + 1e-4 * number)).requires_grad_(True)
        scene = self.scene.replace("ball", mesh=Mesh(vertices, mesh.faces))
        start = perf_counter()
        power = deposit_power(
            scene,
            self.radar.link(),
            self.grid,
            sampling=Sampling(depth=1, samples=samples, boundary_samples=boundary_samples),
            seed=number,
        )
        middle = perf_counter()
        (power / power.detach().mean()).square().mean().backward()
        end = perf_counter()
        assert vertices.grad is not None
        assert vertices.grad.norm() > 0
        return middle - start, end - middle


def at(distance: float) -> Tensor:
    """A pose on the boresight."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = distance
    return pose


def single(y: float) -> AntennaArray:
    """One isotropic antenna."""
    return AntennaArray(torch.tensor([[0.0, y, 0.0]], dtype=torch.float64), Isotropic())


def speed(task: Task, samples: int, boundary_samples: int, steps: int) -> dict[str, float]:
    """Medians over steps in which the mesh moves, the tree is rebuilt and the seed changes."""
    times = [task.step(number, samples, boundary_samples) for number in range(WARM_UP + steps)]
    forward, backward = (statistics.median(part) for part in zip(*times[WARM_UP:], strict=True))
    both = statistics.median(sum(pair) for pair in times[WARM_UP:])
    return {
        "samples_per_second": (samples + boundary_samples) / both,
        "backward_over_forward": backward / forward,
        "forward_s": forward,
        "backward_s": backward,
        "compiled_kernels_per_step": compiled(
            lambda: task.step(WARM_UP + steps, samples, boundary_samples)
        ),
    }


def compiled(act: Callable[[], Any]) -> int:
    """Number of kernels that Dr.Jit compiles during an action."""
    import drjit as dr

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        act()
        history = dr.kernel_history([dr.KernelType.JIT])
        dr.kernel_history_clear()
    return sum(not kernel["cache_hit"] for kernel in history)


def peak_of_steps(samples: int) -> float:
    """Peak resident memory of a fresh process that does three steps [GB]."""
    command = [sys.executable, __file__, "--memory", str(samples)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def memory_of_steps(samples: int) -> float:
    """Peak resident memory of this process after three steps [GB]."""
    task = Task.build()
    for number in range(3):
        task.step(number, samples, BOUNDARY_SAMPLES)
    return (peak_memory() or math.nan) / 1e9


def useful_paths(rays: int, steps: int) -> dict[str, Any]:
    """Single-bounce paths on a 0.5 m cube at 2 m per second of forward time, ours and Sionna's.

    Both start the same number of rays from the antenna a call, with a new seed each, in a scene
    that does not change; the receiver is 1 cm beside the transmitter.
    """
    target = box(0.5)
    scene = Scene({"target": Object(target, RoughDielectric(permittivity=4.0), at(2.0))})
    radar = Radar(single(0.0), single(0.01), WAVEFORM, torch.zeros(1, 3, dtype=torch.float64))
    link, grid = radar.link(), radar.grid(1.5, 2.6)
    drawn = Sampling(depth=1, samples=rays, boundary_samples=0, boundary=False)

    def deposited(seed: int) -> None:
        deposit_power(scene, link, grid, sampling=drawn, seed=seed)

    def listed(seed: int) -> int:
        paths = trace_power(scene, link, sampling=drawn, seed=seed)
        return int((paths.power > 0).sum())

    hits = listed(0)
    found: dict[str, Any] = {
        "hits_ours": hits,
        "useful_paths_per_second": hits / median_time(deposited, steps),
        "useful_listed_paths_per_second": hits / median_time(listed, steps),
    }
    theirs, rate = sionna_calls(target, rays), None
    if theirs is not None:
        hits = theirs(0)
        rate = hits / median_time(theirs, steps)
        found |= {"hits_sionna": hits, "useful_paths_per_second_sionna": rate}
    for key, ours in {
        "useful_paths_ratio_sionna": "useful_paths_per_second",
        "useful_listed_paths_ratio_sionna": "useful_listed_paths_per_second",
    }.items():
        found[key] = None if rate is None else found[ours] / rate
    return found


def sionna_calls(target: Mesh, rays: int) -> Callable[[int], int] | None:
    """A call of Sionna RT's PathSolver that returns the paths found; None if not installed.

    The material scatters all power diffusely and every other interaction is off, so no ray that
    meets the target is spent on anything but a path to the receiver.
    """
    try:
        rt = import_module("sionna.rt")
    except ModuleNotFoundError:
        return None
    import drjit as dr

    mesh = mi.Mesh("target", vertex_count=len(target.vertices), face_count=len(target.faces))
    parameters = mi.traverse(mesh)
    vertices = target.vertices + torch.tensor([2.0, 0.0, 0.0])
    parameters["vertex_positions"] = mi.Float(vertices.float().numpy().ravel())
    parameters["faces"] = mi.UInt32(target.faces.numpy().astype(np.uint32).ravel())
    parameters.update()
    scene = rt.load_scene()
    scene.frequency = WAVEFORM.center_frequency
    rough = rt.RadioMaterial("rough", relative_permittivity=4.0, scattering_coefficient=1.0)
    scene.edit(add=rt.SceneObject(mi_mesh=mesh, name="target", radio_material=rough))
    antenna = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.tx_array = scene.rx_array = antenna
    scene.add(rt.Transmitter("tx", [0.0, 0.0, 0.0]))
    scene.add(rt.Receiver("rx", [0.0, 0.01, 0.0]))
    solver = rt.PathSolver()

    def call(seed: int) -> int:
        paths = solver(
            scene,
            max_depth=1,
            samples_per_src=rays,
            los=False,
            specular_reflection=False,
            diffuse_reflection=True,
            refraction=False,
            seed=seed + 1,
        )
        dr.eval(paths.a, paths.tau)
        dr.sync_thread()
        return int(np.array(paths.valid).sum())

    return call


def median_time(call: Callable[[int], Any], steps: int) -> float:
    """Median seconds of a call that takes a seed, after warm-up."""
    times = []
    for seed in range(WARM_UP + steps):
        start = perf_counter()
        call(seed)
        times.append(perf_counter() - start)
    return statistics.median(times[WARM_UP:])


def measure(
    samples: int = SAMPLES,
    boundary_samples: int = BOUNDARY_SAMPLES,
    memory_samples: int = MEMORY_SAMPLES,
    steps: int = STEPS,
) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    task = Task.build()
    metrics: dict[str, Any] = {
        "samples": samples,
        "boundary_samples": boundary_samples,
        "steps": steps,
        "triangles": task.triangles,
        "hidden_share_of_facing_triangles": task.hidden_share(),
        "map_bins": list(task.grid.shape),
        "backend": backend(),
        "cpu_count": os.cpu_count(),
        "load_average": os.getloadavg()[0],
    }
    metrics |= {"memory_samples": memory_samples, "peak_memory_gb": peak_of_steps(memory_samples)}
    metrics |= speed(task, samples, boundary_samples, steps)
    metrics |= useful_paths(samples, steps)
    metrics["sionna_rt_version"] = sionna_version()
    return metrics


def sionna_version() -> str | None:
    """Installed version of Sionna RT, if any."""
    try:
        return version("sionna-rt")
    except PackageNotFoundError:
        return None


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    m = metrics
    counted = m["samples"] + m["boundary_samples"]
    hidden = m["hidden_share_of_facing_triangles"]
    page = MetricTable(
        f"Throughput: {m['triangles']} triangles, {hidden:.0%} of those facing the radar "
        f"hidden; map of {' × '.join(map(str, m['map_bins']))} bins; "
        f"medians of {m['steps']} steps after warm-up; backend {m['backend']}; "
        f"{m['cpu_count']} CPU cores, load average {m['load_average']:.1f} at the start",
        REQUIRED,
    )

    def row(key: str, shown: str, text: str) -> None:
        page.row(key, m[key], shown, text)

    row(
        "samples_per_second",
        ".3g",
        f"{counted} samples ({m['samples']} interior, {m['boundary_samples']} boundary) over the "
        "time of forward + backward; each step moves all vertices of the ball (tree rebuilt) "
        "and changes the seed",
    )
    row("forward_s", ".4f", "")
    row("backward_s", ".4f", "boundary paths are traced here: they are zero in value")
    row("backward_over_forward", ".2f", "")
    row("compiled_kernels_per_step", "d", "kernels compiled in a further step")
    row(
        "peak_memory_gb",
        ".2f",
        f"most memory of a fresh process: three steps of {m['memory_samples']} samples, imports "
        "included",
    )
    row(
        "useful_paths_per_second",
        ".3g",
        f"0.5 m cube at 2 m, {m['samples']} rays a call; {m['hits_ours']} of them hit it and "
        "scatter to the receiver; summed into range bins",
    )
    row("useful_listed_paths_per_second", ".3g", "the same as a list of paths (trace_power)")
    if m["useful_paths_ratio_sionna"] is None:
        text = "Sionna RT is not installed: pip install 'invertwin[bench]'"
    else:
        row(
            "useful_paths_per_second_sionna",
            ".3g",
            f"Sionna RT {m['sionna_rt_version']}, PathSolver: the same cube and rays, depth 1, "
            f"only diffuse reflection, scattering coefficient 1; {m['hits_sionna']} paths; a "
            "list of paths",
        )
        text = "deposit over Sionna"
    row("useful_paths_ratio_sionna", ".0f", text)
    row("useful_listed_paths_ratio_sionna", ".0f", "list over list")
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/throughput"))
    parser.add_argument("--memory", type=int, help="only print the peak memory [GB] of N samples")
    arguments = parser.parse_args()
    if arguments.memory:
        print(memory_of_steps(arguments.memory))
        return
    metrics = measure()
    write(metrics, table(metrics), arguments.out)


if __name__ == "__main__":
    main()
