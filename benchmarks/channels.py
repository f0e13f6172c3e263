"""Paths between antennas beside the `PathSolver` of Sionna RT 2.2 (extra `bench`).

    python benchmarks/channels.py [-o DIR]

Three scenes that come with Sionna RT are read from its own files. In each, both list all paths of
one link of up to three reflections and, where a scene has panes, transmissions; both have antennas
of two polarisations at 3.5 GHz, and 200 000 rays. Then both find the paths from the transmitter to
1000 receivers. Prints a table and writes `metrics.json` into DIR (default `out/channels`):

- `<scene>.unmatched`: paths that only one of both has, of at least 1e-6 of the strongest amplitude.
  A path is known by what happens along it, and by its delay.
- `<scene>.delay_s`: largest difference of delays.
- `<scene>.amplitude`: largest difference of moduli of the 2 × 2 coefficients, over the path's
  largest one. Phases have other conventions: Sionna RT counts the thickness of a sheet twice, in
  the length of the path and in its coefficient, and mirrors at its surface; we mirror and pass at
  its middle.
- `links_ratio_sionna.<scene>`: seconds of Sionna RT over ours for 1000 links (median of the calls
  after the first).
- `gradient_ratio_sionna.<scene>`: its seconds, without derivatives, over ours with the derivative
  of the received power by all vertices.
"""

import argparse
import os
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from report import MetricTable, write
from rich.table import Table

import invertwin as iw
from invertwin.channel import KINDS, backend
from invertwin.scene import Mesh, Scene, load_scene_xml

FREQUENCY, DEPTH, RAYS, RECEIVERS, CALLS = 3.5e9, 3, 200_000, 1000, 1
LEAST = 1e-6  # of the strongest amplitude
SAME_DELAY = 2e-11  # s: beyond, two paths are different ones
KIND_OF = {0: 0, 1: KINDS.index("reflection"), 4: KINDS.index("transmission")}
REQUIRED = {
    "unmatched": ("<=", 0),
    "delay_s": ("<=", 2e-14),
    "box.amplitude": ("<=", 1e-5),
    "amplitude": ("<=", 2e-3),
    **{f"links_ratio_sionna.{name}": (">=", 3.0) for name in ("box", "box_one_screen", "canyon")},
    **{
        f"gradient_ratio_sionna.{name}": (">=", 1.0) for name in ("box", "box_one_screen", "canyon")
    },
}


@dataclass(frozen=True)
class Case:
    """A scene of Sionna RT, and antennas in it.

    Attributes:
        scene: what Sionna RT calls it.
        tx, rx: places [m].
        low, high: of the box of places with 1000 receivers.
        panes: whether waves go through walls.
    """

    scene: str
    tx: tuple[float, float, float]
    rx: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    panes: bool


CASES = {
    "box": Case("box", (1.3, -1.1, 2.2), (-2.4, 1.7, 1.5), (-4, -4, 1), (4, 4, 4), False),
    "box_one_screen": Case(
        "box_one_screen", (1.3, -1.1, 1.2), (-2.4, 1.7, 1.5), (-4, -4, 1), (4, 4, 4), True
    ),
    "canyon": Case(
        "simple_street_canyon", (-33, 3, 5), (20, -2, 1.5), (-30, -6, 1), (30, 6, 3), True
    ),
}


@dataclass(frozen=True)
class PathList:
    """What both can tell of the paths of one link.

    Attributes:
        kinds: what happens, by ``KINDS`` [path, 3].
        delay: [s].
        amplitude: moduli of the coefficients [path, receive, transmit].
    """

    kinds: np.ndarray
    delay: np.ndarray
    amplitude: np.ndarray

    def strong(self) -> "PathList":
        """Without those that are too weak to matter."""
        peaks = self.amplitude.max((1, 2))
        rows = peaks >= LEAST * peaks.max(initial=0.0)
        return PathList(self.kinds[rows], self.delay[rows], self.amplitude[rows])


class Sionna:
    """A case as Sionna RT takes it."""

    def __init__(self, case: Case, receivers: np.ndarray) -> None:
        mi, rt = import_module("mitsuba"), import_module("sionna.rt")
        self.case = case
        scene = rt.load_scene(getattr(rt.scene, case.scene), merge_shapes=False)
        scene.frequency = FREQUENCY
        array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="VH")
        scene.tx_array = scene.rx_array = array
        scene.add(rt.Transmitter("tx", position=mi.Point3f(*map(float, case.tx))))
        for number, place in enumerate(receivers):
            scene.add(rt.Receiver(f"rx{number}", position=mi.Point3f(*map(float, place))))
        self.scene, self.solver = scene, rt.PathSolver()

    def paths(self, seed: int = 42) -> Any:
        """Sionna's paths, computed to the end."""
        found = self.solver(
            self.scene,
            max_depth=DEPTH,
            samples_per_src=RAYS,
            refraction=self.case.panes,
            specular_reflection=True,
            los=True,
            seed=seed,
        )
        _ = np.array(found.a[0]), np.array(found.a[1]), np.array(found.tau)
        return found

    def listed(self) -> PathList:
        """The paths of the one link."""
        found = self.paths()
        field = np.array(found.a[0]) + 1j * np.array(found.a[1])
        delay = np.array(found.tau).ravel()
        kinds = np.array(found.interactions).reshape(DEPTH, -1).T
        field = np.moveaxis(field.reshape(2, 2, -1), -1, 0)
        return PathList(np.vectorize(KIND_OF.get)(kinds), delay, np.abs(field))


class Ours:
    """A case as invertwin takes it, from the same file."""

    def __init__(self, case: Case, receivers: np.ndarray) -> None:
        rt = import_module("sionna.rt")
        self.case = case
        self.scene = load_scene_xml(getattr(rt.scene, case.scene))
        self.receivers = torch.from_numpy(receivers)

    def paths(self, scene: Scene | None = None, seed: int = 0) -> iw.channel.RayPaths:
        """Our paths."""
        ends = self.case.tx, self.receivers
        return iw.trace_paths(
            self.scene if scene is None else scene,
            *ends,
            FREQUENCY,
            depth=DEPTH,
            rays=RAYS,
            seed=seed,
        )

    def differentiated(self, seed: int = 0) -> float:
        """The received power, and its derivative by all vertices."""
        scene, leaves = self.scene, []
        for name in scene.names:
            mesh = scene[name].mesh
            leaves.append(mesh.vertices.clone().requires_grad_())
            scene = scene.replace(name, mesh=Mesh(leaves[-1], mesh.faces))
        power = self.paths(scene, seed).coefficient.abs().square().sum()
        power.backward()
        assert all(leaf.grad is not None and leaf.grad.isfinite().all() for leaf in leaves)
        return power.item()

    def listed(self) -> PathList:
        """The paths of the one link."""
        found = self.paths()
        kinds = torch.nn.functional.pad(found.kinds, (0, DEPTH - found.kinds.shape[1]))
        amplitude = found.coefficient.abs()
        return PathList(kinds.numpy(), found.delay.numpy(), amplitude.numpy())


def compared(ours: PathList, theirs: PathList) -> dict[str, float]:
    """How two lists of paths differ."""
    ours, theirs = ours.strong(), theirs.strong()
    used = np.zeros(len(theirs.delay), dtype=bool)
    delays, amplitudes, alone = [0.0], [0.0], 0
    for kinds, delay, amplitude in zip(ours.kinds, ours.delay, ours.amplitude, strict=True):
        apart = np.abs(theirs.delay - delay)
        same = (theirs.kinds == kinds).all(1) & ~used & (apart < SAME_DELAY)
        if not same.any():
            alone += 1
            continue
        off = np.abs(theirs.amplitude - amplitude).max((1, 2)) / amplitude.max()
        best = np.where(same, off, np.inf).argmin()
        used[best] = True
        delays.append(apart[best])
        amplitudes.append(off[best])
    return {
        "paths": len(ours.delay),
        "unmatched": alone + int((~used).sum()),
        "delay_s": float(max(delays)),
        "amplitude": float(max(amplitudes)),
    }


def seconds(call: Callable[[int], object], calls: int) -> float:
    """Median of all calls but the first."""
    times = []
    for number in range(1 + calls):
        start = perf_counter()
        call(number)
        times.append(perf_counter() - start)
    return statistics.median(times[1:])


def spread(case: Case, count: int) -> np.ndarray:
    """Places of many receivers."""
    return np.random.default_rng(1).uniform(case.low, case.high, (count, 3))


def measure(receivers: int = RECEIVERS, calls: int = CALLS) -> dict[str, Any]:
    """All metrics; the sizes are smaller in tests only."""
    metrics: dict[str, Any] = {
        "frequency": FREQUENCY,
        "depth": DEPTH,
        "rays": RAYS,
        "receivers": receivers,
        "backend": backend(),
        "cpu_count": os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "links_ratio_sionna": {},
        "gradient_ratio_sionna": {},
        "seconds": {},
    }
    for name, case in CASES.items():
        one, many = np.array([case.rx], dtype=float), spread(case, receivers)
        metrics[name] = compared(Ours(case, one).listed(), Sionna(case, one).listed())
        ours, theirs = Ours(case, many), Sionna(case, many)
        took = {
            "sionna": seconds(theirs.paths, calls),
            "forward": seconds(lambda seed, of=ours: of.paths(seed=seed), calls),
            "gradient": seconds(ours.differentiated, calls),
        }
        metrics["seconds"][name] = took
        metrics["links_ratio_sionna"][name] = took["sionna"] / took["forward"]
        metrics["gradient_ratio_sionna"][name] = took["sionna"] / took["gradient"]
    return metrics


def table(metrics: dict[str, Any]) -> Table:
    """What was counted, and what must hold."""
    page = MetricTable(
        f"Paths between antennas, {metrics['rays']} rays, depth {metrics['depth']}, beside Sionna "
        f"RT 2.2; backend {metrics['backend']}; {metrics['cpu_count']} CPU cores, load average "
        f"{metrics['load_average']:.1f} at the start",
        REQUIRED,
    )
    texts = {
        "unmatched": "paths that one of both lacks",
        "delay_s": "largest difference of delays",
        "amplitude": "largest relative difference of amplitudes",
    }
    for name in CASES:
        page.row(f"{name}.paths", metrics[name]["paths"], "d", "of one link")
        for key, text in texts.items():
            page.row(f"{name}.{key}", metrics[name][key], ".2g", text)
    for key, text in (
        ("links_ratio_sionna", "its seconds over ours"),
        ("gradient_ratio_sionna", "the same, ours with the gradient by all vertices"),
    ):
        for name, value in metrics[key].items():
            page.row(f"{key}.{name}", value, ".2f", f"{metrics['receivers']} links: {text}")
    return page.grid


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/channels"))
    out = parser.parse_args().out
    metrics = measure()
    write(metrics, table(metrics), out)


if __name__ == "__main__":
    main()
