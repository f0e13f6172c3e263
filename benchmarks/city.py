"""Coverage map of a city by tiles, on many machines: the same bytes, however they are made.

    python benchmarks/city.py [-o DIR]

Prints a table and writes `metrics.json` into DIR (default `out/city`). The city is drawn from a
seed: boxes of concrete on lots of a square of 10.24 km², one lot in ten a park, and 36 transmitters
at 3.5 GHz, each 5 m above the highest roof of its district. The map has 10⁶ cells of 3.2 m, 1.5 m
above the ground. A cell holds the gain of its best transmitter and the sum over all of them, at a
random point in the cell, by paths in line of sight and with one reflection whose length is at most
`City.reach`. Powers of paths add. Edges do not diffract, so that places behind buildings stay dark.

A tile is 50 × 50 cells. For each transmitter it is traced among the buildings that a path can
touch: those whose distances from the transmitter and from the tile sum to at most the reach. This
halo leaves out no path that counts: the map depends on the tiles by rounding only. All planes are
tested (`rays=None`). Points are drawn from a seed of the tile.

Each tile is a file, written atomically; the same command goes on after an interruption.

- `difference`: largest relative difference of gains between tiles and one trace of a whole small
  city, `unequal_cells`: cells in which they differ by more than 1e-6.
- `bytes_equal`: whether the file of the merged map is that of one process: of two and four
  processes; of two Ray nodes of one core (`ray`); of two of which one was killed (`kill -9`) after
  a quarter of the tiles (`killed`). Without the package ray the last two are absent.
- `cells_per_core_second`: cells over processor seconds of the tiles, on the two Ray nodes.
- `efficiency`: processor seconds of the tiles over time × 2 cores of that run. Starting workers,
  handing out and other programs on the machine make it smaller. None if it was interrupted.
- `cells_exponent`: slope of the logarithm of processor seconds over that of cells, 62 500 to 10⁶ on
  the same area.
- `buildings_exponent`: the same over buildings, from 568 to 9 034 on the same area with 250 000
  cells: lots and footprints shrink. Required is the slope of n log n.
- `model`: processor seconds of a tile = `link` × transmitters + `pair` × pairs of a point and a
  building of its halo; least squares over all tiles. `model.error` is the relative error of its sum
  for the city of most buildings.
- `longest`: longest over mean processor seconds of a tile. `memory_mb`: peak resident memory of a
  worker. `bytes`: of a job and of its result. `tasks_per_second`: empty tasks that `run_jobs` hands
  to the two nodes. `recovery_seconds`: from the kill until the four tiles that were under way or
  next were done.
"""

import argparse
import hashlib
import json
import math
import os
import pickle
import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from growth import exponent
from report import MetricTable, Required, write
from torch import Tensor

from invertwin.channel import PathMeasure, RayPaths, trace_coverage
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.links import CellSampling, MapPlane, path_amplitudes
from invertwin.runtime.engines import Engine, run_jobs
from invertwin.scene import Dielectric, Mesh, Object, Scene
from invertwin.seeds import derive_seed
from invertwin.storage.folders import replace_file, write_text_file

FREQUENCY = 3.5e9
CONCRETE = Dielectric(5.24, scattering=0.0)  # ITU-R P.2040
HEIGHT, MAST, FLOOR = 1.5, 5.0, 3.0  # of receivers, of a mast above its roof, of a storey [m]
EMPTY_TASKS = 1000
SAME = 1e-6
DENSER = (25, 50, 100)  # lots along a side
REQUIRED: Required = {
    "area_km2": (">=", 10),
    "buildings": (">=", 2000),
    "transmitters": (">=", 20),
    "cells": (">=", 1e6),
    "difference": ("<=", SAME),
    **{f"bytes_equal.{name}": (">=", 1) for name in ("workers_2", "workers_4", "ray", "killed")},
    "cells_exponent": ("<=", 1.1),
}
COUNTED = {
    "area_km2": (".4g", "area [km²]"),
    "buildings": ("d", "boxes of concrete"),
    "transmitters": ("d", "above roofs"),
    "cells": ("d", "of the map"),
    "tiles": ("d", "of the map"),
    "covered": (".3f", "share of cells that a path reaches"),
    "difference": (".1e", "from one trace of a whole small city, largest of gains"),
    "unequal_cells": ("d", "cells of the small city that differ by more than 1e-6"),
    "cells_per_core_second": (".0f", "cells over processor seconds of tiles"),
    "core_seconds": (".0f", "processor seconds of tiles"),
    "wall_seconds": (".0f", "time on two cores [s]"),
    "efficiency": (".2f", "processor seconds over time × 2 cores"),
    "longest": (".2f", "longest tile over the mean"),
    "memory_mb": (".0f", "peak resident memory of a worker [MB]"),
    "recovery_seconds": (".1f", "from the kill of a node until four more tiles were done [s]"),
    "tasks_per_second": (".0f", "empty tasks of two nodes"),
}


class Buildings(NamedTuple):
    """Boxes that stand on the ground.

    Attributes:
        center: Middles [building, 2] [m].
        half: Half of length and width [building, 2] [m].
        yaw: About the vertical [building] [rad].
        height: Of the roofs [building] [m].
    """

    center: np.ndarray
    half: np.ndarray
    yaw: np.ndarray
    height: np.ndarray

    def select(self, rows: np.ndarray) -> "Buildings":
        """Select some of the buildings.

        Args:
            rows: A mask.
        """
        return Buildings(*(column[rows] for column in self))

    def distances(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Lower bounds of the horizontal distances from a rectangle, by circles around [m].

        Args:
            low, high: Corners of the rectangle [2] [m].
        """
        beyond = np.maximum(np.maximum(low - self.center, self.center - high), 0.0)
        return np.hypot(*beyond.T) - np.hypot(*self.half.T)

    def mesh(self) -> Mesh:
        """Walls and roofs. Walls reach 1 m into the ground, so that no ray passes between."""
        count, (cosine, sine) = len(self.yaw), (np.cos(self.yaw), np.sin(self.yaw))
        local = self.half[:, None] * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        turn = np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], 1)
        corner = self.center[:, None] + np.einsum("bij,bkj->bki", turn, local)
        levels = np.stack([np.full(count, -1.0), self.height], 1)[:, :, None, None]
        shape = (count, 2, 4)
        vertices = np.concatenate(
            [np.broadcast_to(corner[:, None], (*shape, 2)), np.broadcast_to(levels, (*shape, 1))],
            -1,
        )
        walls = [[k, (k + 1) % 4, (k + 1) % 4 + 4, k + 4] for k in range(4)]
        sides = np.array([*walls, [4, 5, 6, 7]])
        triangles = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
        faces = triangles + 8 * np.arange(count)[:, None, None]
        return Mesh(
            torch.from_numpy(vertices.reshape(-1, 3)), torch.from_numpy(faces.reshape(-1, 3))
        )


@dataclass(frozen=True)
class City:
    """A city and its map, all of it drawn from the seed.

    Attributes:
        extent: Side of the square [m].
        lots: Along a side.
        masts: Transmitters along a side, one in each district.
        reach: Longest path that counts [m].
        cells: Along a side.
        tile: Cells along a side of a tile; a divisor of ``cells``.
        seed: Of everything.
    """

    extent: float = 3200.0
    lots: int = 50
    masts: int = 6
    reach: float = 600.0
    cells: int = 1000
    tile: int = 50
    seed: int = 1

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return (self.cells // self.tile) ** 2

    @property
    def digest(self) -> str:
        """Name of the folder of its tiles, which those of another city must not enter."""
        settings = repr((self, FREQUENCY, CONCRETE, HEIGHT, MAST, FLOOR))
        return hashlib.sha256(settings.encode()).hexdigest()[:12]

    def buildings(self) -> Buildings:
        """Draw the buildings; none leaves its lot."""
        rng, pitch = np.random.default_rng(derive_seed(self.seed, 0)), self.extent / self.lots
        count = self.lots**2
        lot = np.stack(np.divmod(np.arange(count), self.lots), -1)
        built = Buildings(
            center=pitch * (lot + 0.5),
            half=pitch * rng.uniform(0.16, 0.34, (count, 2)),
            yaw=rng.uniform(-0.1, 0.1, count),
            height=FLOOR * rng.integers(3, 13, count),
        )
        return built.select(rng.random(count) < 0.9)

    def transmitters(self, buildings: Buildings) -> np.ndarray:
        """Place a transmitter above the highest roof of each district [tx, 3] [m].

        Args:
            buildings: Of the city.
        """
        column, row = (buildings.center // (self.extent / self.masts)).astype(int).T
        found = []
        for district in range(self.masts**2):
            own = np.flatnonzero(column * self.masts + row == district)
            highest = own[np.argmax(buildings.height[own])]
            found.append([*buildings.center[highest], buildings.height[highest] + MAST])
        return np.array(found)

    def plane(self, number: int) -> MapPlane:
        """Cells of a tile.

        Args:
            number: Of the tile.
        """
        side = self.extent * self.tile / self.cells
        low = side * np.array(divmod(number, self.cells // self.tile))
        sampling = CellSampling(points=1)
        return MapPlane.horizontal(low, low + side, HEIGHT, side / self.tile, sampling)

    def points(self, number: int) -> Tensor:
        """Draw a point in each cell of a tile [cell, 3] [m].

        Args:
            number: Of the tile.
        """
        rng = np.random.default_rng(derive_seed(self.seed, 1, number))
        return self.plane(number).sample_points(rng)[:, 0]

    def trace(
        self, buildings: Buildings, tx: np.ndarray, points: Tensor, ground: np.ndarray
    ) -> Tensor:
        """Trace gains from transmitters to points among some buildings [tx, point].

        Args:
            buildings: Those that may hide or reflect.
            tx: Transmitters [tx, 3] [m].
            points: Receivers [point, 3] [m].
            ground: Lowest and highest corner of what they stand on [2, 2] [m].
        """
        (x, y), (far_x, far_y) = ground
        corners = [[x, y, 0.0], [far_x, y, 0.0], [far_x, far_y, 0.0], [x, far_y, 0.0]]
        floor = Mesh(torch.tensor(corners).double(), torch.tensor([[0, 1, 2], [0, 2, 3]]))
        scene = {"ground": Object(floor, CONCRETE)}
        if len(buildings.yaw):
            scene["buildings"] = Object(buildings.mesh(), CONCRETE)

        def gain(paths: RayPaths, _tx: Tensor, _rx: Tensor) -> Tensor:
            amplitude, delay = path_amplitudes(paths)
            power = torch.view_as_real(amplitude).square().sum(-1)
            return torch.where(SPEED_OF_LIGHT * delay <= self.reach, power, 0.0).flatten(1)

        with torch.no_grad():
            found = trace_coverage(
                Scene(scene),
                torch.from_numpy(tx),
                floor,
                points,
                FREQUENCY,
                PathMeasure(gain, 1),
                depth=1,
                rays=None,
                boundary_samples=0,
                seed=0,
            )
        return found.amount[..., 0]


#: Larger than its reach, so that tiles lack most of its buildings.
SMALL = City(extent=1280.0, lots=20, masts=4, reach=300.0, cells=80, tile=10)


def map_tile(job: tuple[City, int]) -> tuple[np.ndarray, dict[str, float]]:
    """Trace one tile: gain of the best transmitter and of all [2, cell, cell], and its cost.

    Args:
        job: The city and the number of the tile.
    """
    (city, number), begin = job, time.process_time()
    buildings, points = city.buildings(), city.points(number)
    low, high = (end.numpy() for end in (points[:, :2].amin(0), points[:, :2].amax(0)))
    gains, links, pairs = torch.zeros(2, len(points), dtype=torch.float64), 0, 0
    to_tile = buildings.distances(low, high)
    for tx in city.transmitters(buildings):
        near = (points - torch.from_numpy(tx)).norm(dim=1) <= city.reach
        if not near.any():
            continue
        touched = buildings.distances(tx[:2], tx[:2]).clip(0) + to_tile.clip(0) <= city.reach
        # A point of an ellipse is not farther from the box about its foci than half its length.
        ends = np.minimum(low, tx[:2]) - city.reach / 2, np.maximum(high, tx[:2]) + city.reach / 2
        gain = city.trace(buildings.select(touched), tx[None], points[near], np.stack(ends))[0]
        gains[0, near] = torch.maximum(gains[0, near], gain)
        gains[1, near] += gain
        links, pairs = links + 1, pairs + int(near.sum()) * int(touched.sum())
    cost = {
        "seconds": time.process_time() - begin,
        "links": links,
        "pairs": pairs,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    return gains.view(2, city.tile, city.tile).numpy(), cost


class TiledMap:
    """Map of a city in a folder, a file for each tile.

    Args:
        city: The city.
        folder: May hold maps of other cities.
    """

    def __init__(self, city: City, folder: Path) -> None:
        self.city, self.folder = city, folder / city.digest
        self.folder.mkdir(parents=True, exist_ok=True)

    def tile_file(self, number: int) -> Path:
        """File of a tile; beside it is that of its cost."""
        return self.folder / f"tile_{number:06d}.npy"

    def missing(self) -> list[int]:
        """Numbers of the tiles that have no file."""
        return [n for n in range(self.city.tiles) if not self.tile_file(n).exists()]

    def compute(self, engine: Engine = "processes", workers: int = 1) -> Iterator[int]:
        """Compute the tiles that are missing; yield the number of each when it is stored.

        Args:
            engine: As of ``run_jobs``.
            workers: As of ``run_jobs``.
        """
        missing = self.missing()
        begin, whole = time.monotonic(), len(missing) == self.city.tiles
        jobs = [(self.city, number) for number in missing]
        for place, (gains, cost) in run_jobs(map_tile, jobs, engine=engine, workers=workers):
            file = self.tile_file(missing[place])
            # The tile comes last: it says that both are there.
            write_text_file(file.with_suffix(".json"), json.dumps(cost))
            with replace_file(file) as part:
                np.save(part, gains)
            yield missing[place]
        if missing:
            seconds = time.monotonic() - begin if whole else None
            write_text_file(self.folder / "wall_seconds.json", json.dumps(seconds))

    @property
    def wall_seconds(self) -> float | None:
        """Time that all tiles took; None if they were interrupted."""
        return json.loads((self.folder / "wall_seconds.json").read_text())

    @property
    def costs(self) -> list[dict[str, float]]:
        """Costs of all tiles."""
        files = (self.tile_file(n).with_suffix(".json") for n in range(self.city.tiles))
        return [json.loads(file.read_text()) for file in files]

    @property
    def seconds(self) -> float:
        """Processor seconds of all tiles."""
        return sum(cost["seconds"] for cost in self.costs)

    def merge(self) -> bytes:
        """Merge the tiles into `map.npy`, [2, cell, cell]; return its content."""
        side, tile = self.city.cells // self.city.tile, self.city.tile
        gains = np.empty((2, side, tile, side, tile))
        for number in range(self.city.tiles):
            column, row = divmod(number, side)
            gains[:, column, :, row] = np.load(self.tile_file(number))
        file = self.folder / "map.npy"
        with replace_file(file) as part:
            np.save(part, gains.reshape(2, self.city.cells, self.city.cells))
        return file.read_bytes()


def complete_map(
    city: City, folder: Path, engine: Engine = "processes", workers: int = 1
) -> TiledMap:
    """Compute the tiles that a folder lacks; return the map."""
    found = TiledMap(city, folder)
    for _ in found.compute(engine, workers):
        pass
    return found


def trace_untiled(city: City) -> np.ndarray:
    """Trace a whole city at once, at the points of its tiles [2, tile, cell, cell]."""
    buildings, edge = city.buildings(), city.reach / 2
    points = torch.cat([city.points(number) for number in range(city.tiles)])
    ground = np.array([[-edge] * 2, [city.extent + edge] * 2])
    gains = city.trace(buildings, city.transmitters(buildings), points, ground)
    both = torch.stack([gains.amax(0), gains.sum(0)])
    return both.view(2, city.tiles, city.tile, city.tile).numpy()


def compare_untiled(city: City, folder: Path) -> dict[str, float]:
    """Compare the tiles of a small city with one trace of all of it.

    Args:
        city: Larger than its reach, so that tiles lack most buildings.
        folder: For its tiles.
    """
    tiled, whole = complete_map(city, folder), trace_untiled(city)
    gains = np.stack([np.load(tiled.tile_file(number)) for number in range(city.tiles)], 1)
    largest = np.maximum(gains, whole)
    apart = np.abs(gains - whole) / np.where(largest > 0, largest, 1.0)
    return {"difference": float(apart.max()), "unequal_cells": int((apart > SAME).any(0).sum())}


@contextmanager
def two_nodes() -> Iterator[Callable[[], None]]:
    """Ray cluster of two nodes of one core on this machine; gives what kills the second."""
    import ray  # pyright: ignore[reportMissingImports]
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    # By default Ray's workers give way to all other programs of the machine.
    head = {"num_cpus": 1, "_system_config": {"worker_niceness": 0}}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        second = cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        yield lambda: cluster.remove_node(second, allow_graceful=False)
    finally:
        ray.shutdown()
        cluster.shutdown()


def map_by_ray(city: City, folder: Path) -> TiledMap:
    """Compute a map by two nodes."""
    with two_nodes():
        return complete_map(city, folder, "ray")


def map_beside_kill(city: City, folder: Path) -> tuple[TiledMap, float | None]:
    """Compute a map by two nodes, and kill one after a quarter of the tiles.

    Args:
        city: The city.
        folder: As of ``TiledMap``.

    Returns:
        The map, and the seconds from the kill until the next four tiles were done; None if they
        were done before.
    """
    found, done, killed, next_tiles = TiledMap(city, folder), 0, 0.0, set[int]()
    file = found.folder / "recovery_seconds.json"
    with two_nodes() as kill_second:
        for number in found.compute("ray"):
            done += 1
            if not killed and done >= city.tiles // 4:
                kill_second()
                killed, next_tiles = time.monotonic(), set(found.missing()[:4])
            elif number in next_tiles:
                next_tiles.remove(number)
                if not next_tiles:
                    write_text_file(file, json.dumps(time.monotonic() - killed))
    return found, json.loads(file.read_text()) if file.exists() else None


def count_empty_tasks() -> float:
    """Rate at which two nodes take and end tasks without work [1/s]."""
    with two_nodes():
        list(run_jobs(abs, range(10), engine="ray"))  # starts the workers
        begin = time.monotonic()
        list(run_jobs(abs, range(EMPTY_TASKS), engine="ray"))
        return EMPTY_TASKS / (time.monotonic() - begin)


def fit_model(costs: list[dict[str, float]], denser: list[dict[str, float]]) -> dict[str, float]:
    """Fit the seconds of tiles, and predict those of others.

    Args:
        costs: Of the tiles that count.
        denser: Of the tiles to predict.
    """

    def table(rows: list[dict[str, float]]) -> tuple[np.ndarray, np.ndarray]:
        terms = np.array([[row["links"], row["pairs"]] for row in rows])
        return terms, np.array([row["seconds"] for row in rows])

    link, pair = np.linalg.lstsq(*table(costs), rcond=None)[0]
    terms, seconds = table(denser)
    error = float((terms @ [link, pair]).sum() / seconds.sum() - 1)
    return {"link": float(link), "pair": float(pair), "error": error}


def measure_growth(city: City, full: TiledMap, folder: Path) -> dict[str, Any]:
    """Processor seconds over cells and over buildings, and their exponents.

    Args:
        city: Whose map has the most cells.
        full: That map.
        folder: For the others.
    """
    smaller = [replace(city, cells=city.cells // part) for part in (4, 2)]
    fewer = [*(complete_map(one, folder) for one in smaller), full]
    denser = [complete_map(replace(smaller[1], lots=lots), folder) for lots in DENSER]
    counts = [len(one.city.buildings().yaw) for one in denser]
    n_log_n = exponent(counts, [n * math.log(n) for n in counts])
    found: dict[str, Any] = {
        "cells": [one.city.cells**2 for one in fewer],
        "cells_seconds": [one.seconds for one in fewer],
        "buildings": counts,
        "buildings_seconds": [one.seconds for one in denser],
        "n_log_n": n_log_n,
        "model": fit_model(full.costs, denser[-1].costs),
    }
    for name in ("cells", "buildings"):
        found[f"{name}_exponent"] = exponent(found[name], found[f"{name}_seconds"])
    return found


def measure(city: City, small: City, out: Path) -> dict[str, Any]:
    """All metrics; smaller in tests only.

    Args:
        city: The city of the map.
        small: The city that is traced as a whole too.
        out: Folder that keeps the tiles.
    """
    load, equal, buildings = os.getloadavg()[0], dict[str, bool](), city.buildings()
    found: dict[str, Any] = {
        "area_km2": city.extent**2 / 1e6,
        "buildings": len(buildings.yaw),
        "transmitters": city.masts**2,
        "cells": city.cells**2,
        "tiles": city.tiles,
        "load_average": load,
        **compare_untiled(small, out / "small"),
    }
    one = full = complete_map(city, out / "workers_1")
    merged = one.merge()
    for workers in (2, 4):
        name = f"workers_{workers}"
        equal[name] = complete_map(city, out / name, workers=workers).merge() == merged
    if find_spec("ray") is not None:
        full = map_by_ray(city, out / "ray")
        equal["ray"] = full.merge() == merged
        killed, found["recovery_seconds"] = map_beside_kill(city, out / "killed")
        equal["killed"] = killed.merge() == merged
        found["tasks_per_second"] = count_empty_tasks()
    seconds, wall = [cost["seconds"] for cost in full.costs], full.wall_seconds
    best = np.load(full.folder / "map.npy")[0]
    job = pickle.dumps((city, city.tiles - 1))
    return found | {
        "bytes_equal": equal,
        "covered": float((best > 0).mean()),
        "core_seconds": sum(seconds),
        "wall_seconds": wall,
        "cells_per_core_second": city.cells**2 / sum(seconds),
        "efficiency": sum(seconds) / (2 * wall) if wall else None,
        "longest": max(seconds) * len(seconds) / sum(seconds),
        "memory_mb": max(cost["memory_mb"] for cost in full.costs),
        "bytes": {"job": len(job), "result": full.tile_file(0).stat().st_size},
        "growth": measure_growth(city, one, out / "growth"),
    }


def table(metrics: dict[str, Any]) -> MetricTable:
    """A row a metric."""
    grown, model = metrics["growth"], metrics["growth"]["model"]
    required = REQUIRED | {"buildings_exponent": ("<=", grown["n_log_n"])}
    shown = MetricTable(f"City, load {metrics['load_average']:.1f}", required)
    for key, counted in COUNTED.items():
        if key in metrics:
            shown.row(key, metrics[key], *counted)
    for name, equal in metrics["bytes_equal"].items():
        shown.row(f"bytes_equal.{name}", equal, "d", "1 = the file of one process")
    for name, what in (("job", "handed to a worker for a tile"), ("result", "that come back")):
        shown.row(f"bytes.{name}", metrics["bytes"][name], "d", f"bytes {what}")
    for name in ("cells", "buildings"):
        sizes = ", ".join(f"{size:_}".replace("_", " ") for size in grown[name])
        values = ", ".join(f"{value:.3g}" for value in grown[f"{name}_seconds"])
        key = f"{name}_exponent"
        shown.row(key, grown[key], ".2f", f"{values} core-seconds at {sizes}")
    shown.row("model.link", model["link"], ".3g", "core-seconds for each transmitter of a tile")
    shown.row("model.pair", model["pair"], ".3g", "core-seconds for each point and building")
    shown.row("model.error", model["error"], ".2f", "of the prediction for the densest city")
    return shown


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/city"))
    given = parser.parse_args()
    metrics = measure(City(), SMALL, given.out)
    if "ray" not in metrics["bytes_equal"]:
        print("ray is not installed: no cluster was tried (pip install 'invertwin[ray]')")
    write(metrics, table(metrics).grid, given.out)


if __name__ == "__main__":
    main()
