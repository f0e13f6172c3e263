"""Data sets: samples per second, and the same bytes however they are made.

    python benchmarks/dataset.py [-o DIR] [--samples N] [--kills N] [--repeats N]
        [--seed N]

Prints a table and writes `metrics.json` into DIR (default `out/dataset`). Samples are those of
`experiments/dataset_rooms.toml`. Every case is a run of `invertwin dataset` of its own.

- `samples_per_second.workers_1`, `samples_per_second.workers_2`: samples over the time from the
  first sample's checks to the last shard, start of the workers included; the best of REPEATS runs,
  in turns. The kernels are in the cache.
- `scaling`: the second over the first. Other work on the machine makes it smaller.
- `cpu_seconds`: processor time of all processes of that run, over its samples. Alike where workers
  do not hinder each other, whatever else the machine does.
- `bytes_equal`: of each case, whether all shards have the bytes that one worker has written:
  `workers_2`; `parts_2` and `parts_5`, made by `--shard i/n`; `killed`, a run of two workers that
  was killed (`kill -9`) KILLS times at random moments and went on; `ray`, two nodes of a Ray
  cluster on this machine. Without the package ray that row is absent.
- `kills`: kills that came before the end.
"""

import argparse
import importlib.util
import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from report import MetricTable, Required, write

import invertwin
from invertwin.storage.folders import UNFINISHED

ROOMS = Path(__file__).resolve().parents[1] / "experiments" / "dataset_rooms.toml"
SAMPLES, KILLS, REPEATS, SECONDS = 200, 10, 2, 3600.0
PARTS = (2, 5)
CASES = ("workers_2", "parts_2", "parts_5", "killed", "ray")
REQUIRED: Required = {
    "scaling": (">=", 1.7),
    **{f"bytes_equal.{name}": (">=", 1) for name in CASES},
}
COUNTED = {
    "samples_per_second.workers_1": (".3g", "samples a second, one worker"),
    "samples_per_second.workers_2": (".3g", "samples a second, two workers"),
    "scaling": (".3g", "two workers over one"),
    "cpu_seconds.workers_1": (".3g", "processor time a sample [s], one worker"),
    "cpu_seconds.workers_2": (".3g", "processor time a sample [s], two workers"),
    "bytes_equal.workers_2": (".3g", "1 = all shards have the bytes of one worker: two workers"),
    "bytes_equal.parts_2": (".3g", "the same, two parts"),
    "bytes_equal.parts_5": (".3g", "the same, five parts"),
    "bytes_equal.killed": (".3g", "the same, killed and resumed"),
    "bytes_equal.ray": (".3g", "the same, two nodes of a Ray cluster"),
    "kills": (".3g", "runs that were killed before their end"),
}


def command(run_file: Path, out: Path, *more: str) -> list[str]:
    """The command line of a case."""
    return [sys.executable, "-m", "invertwin", "dataset", str(run_file), "-o", str(out), *more]


def made(run_file: Path, out: Path, *more: str) -> dict[str, Any]:
    """Metrics of a run that is left to its end, with its processor time."""
    call, before = command(run_file, out, *more), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(call, capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 0, done.stderr
    after, metrics = resource.getrusage(resource.RUSAGE_CHILDREN), out / "metrics.json"
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        **(json.loads(metrics.read_text()) if metrics.exists() else {}),
        "cpu_seconds": seconds,
    }


def shards(folder: Path) -> dict[str, bytes]:
    """All shards of a data set, those of its parts too, by name."""
    return {file.name: file.read_bytes() for file in folder.rglob("shard-*.tar")}


def killed(run_file: Path, out: Path, kills: int, span: float, moments: random.Random) -> int:
    """Kill runs in one folder that each go on where the one before was cut off; then end it.

    Args:
        run_file: Of the data set.
        out: The folder.
        kills: How many.
        span: Latest moment of a kill [s].
        moments: Draws them.
    """
    count = 0
    for _ in range(10 * kills):
        if count == kills:
            break
        begun = (out / UNFINISHED).exists()
        call = command(run_file, out, "--workers", "2", "--resume" if begun else "--overwrite")
        process = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            process.wait(span * moments.random())
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            count += 1
    begun = (out / UNFINISHED).exists()
    made(run_file, out, "--workers", "2", "--resume" if begun else "--overwrite")
    return count


def by_ray(run_file: Path, out: Path) -> bool:
    """Make a data set by two nodes of a cluster; False where ray is not installed."""
    if importlib.util.find_spec("ray") is None:
        return False
    import ray  # pyright: ignore[reportMissingImports]
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        invertwin.dataset(run_file, out, engine="ray")
    finally:
        ray.shutdown()
        cluster.shutdown()
    return True


def speeds(run_file: Path, folder: Path, repeats: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Metrics of the best runs of one worker and of two, which leave their results in the folder.

    Args:
        run_file: Of the data set.
        folder: For `workers_1` and `workers_2`.
        repeats: Runs of each, in turns.
    """
    made(run_file, folder / "workers_1", "--workers", "1")  # fills the cache of kernels
    found: dict[int, list[dict[str, Any]]] = {1: [], 2: []}
    for _ in range(repeats):
        for count, rows in found.items():
            out = folder / f"workers_{count}"
            rows.append(made(run_file, out, "--workers", str(count), "--overwrite"))
    one, two = (max(rows, key=lambda row: row["samples_per_second"]) for rows in found.values())
    return one, two


def measure(text: str, kills: int, repeats: int, seed: int) -> dict[str, Any]:
    """All cases, in a folder that is gone afterwards.

    Args:
        text: The run file.
        kills: How often a run is killed.
        repeats: Runs that are timed.
        seed: Of the moments of kills.
    """
    equal: dict[str, bool] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        run_file = folder / "rooms.toml"
        run_file.write_text(text)
        one, two = speeds(run_file, folder, repeats)
        whole = shards(folder / "workers_1")
        equal["workers_2"] = shards(folder / "workers_2") == whole
        for count in PARTS:
            out = folder / f"parts_{count}"
            for number in range(1, count + 1):
                made(run_file, out, "--workers", "2", "--shard", f"{number}/{count}")
            equal[out.name] = shards(out) == whole
        span, moments = two["wall_seconds"], random.Random(seed)
        count = killed(run_file, folder / "killed", kills, span, moments)
        equal["killed"] = shards(folder / "killed") == whole
        if by_ray(run_file, folder / "ray"):
            equal["ray"] = shards(folder / "ray") == whole
    rates = {"workers_1": one["samples_per_second"], "workers_2": two["samples_per_second"]}
    return {
        "samples": one["dataset_samples"],
        "bytes": one["dataset_bytes"],
        "samples_per_second": rates,
        "scaling": rates["workers_2"] / rates["workers_1"],
        "cpu_seconds": {
            name: row["cpu_seconds"] / row["dataset_samples"]
            for name, row in (("workers_1", one), ("workers_2", two))
        },
        "bytes_equal": equal,
        "kills": count,
    }


def flat(metrics: dict[str, Any]) -> dict[str, float]:
    """Numbers of a nested table by dotted keys."""
    found: dict[str, float] = {}
    for key, value in metrics.items():
        if isinstance(value, dict):
            found |= {f"{key}.{name}": float(part) for name, part in value.items()}
        else:
            found[key] = float(value)
    return found


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/dataset"))
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    text = ROOMS.read_text().replace("samples = 200", f"samples = {given.samples}")
    metrics = measure(text, given.kills, given.repeats, given.seed)
    table, numbers = MetricTable("Data sets", REQUIRED), flat(metrics)
    table.rows(numbers, {key: row for key, row in COUNTED.items() if key in numbers})
    if "bytes_equal.ray" not in numbers:
        print("ray is not installed: no cluster was tried (pip install 'invertwin[ray]')")
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
