"""Kills at random moments, and two runs at once in one folder: nothing is lost, nothing mixed.

    python benchmarks/crash_safety.py [-o DIR] [--kills N] [--pairs N] [--seed N]

Prints a table and writes `metrics.json` into DIR (default `out/crash_safety`). Every case is a
process that runs one of `COMMANDS` over earlier results of its own, and is killed (`kill -9`) at a
moment drawn evenly from the time it takes. Then the same command goes on with `--resume` where a
fit was begun, and with `--overwrite` else.

- `lost`: cases in which a file of the user's was gone or changed, earlier results were not whole
  while the new ones were unfinished, or the command did not come to its end afterwards.
- `largest_difference`: of the fitted numbers and signals from those of a run that was not killed
  [m, relative for signals].
- `kills`: cases that were killed before their end.
- `mixed`: of two commands at once in one folder, pairs that ended otherwise than with one whole
  result and one refusal in one line, or with two whole results one after the other.
- `pairs`: pairs of them.
"""

import argparse
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from report import MetricTable, Required, write

from invertwin.capture import Capture
from invertwin.datasets import SampleDataset
from invertwin.storage.folders import UNFINISHED

KILLS, PAIRS, SECONDS = 100, 20, 900.0
AT_ONCE = 2  # kinds of commands, each command on one core
SAME = 1e-6  # a difference of numbers of one run [m, or relative]
REQUIRED: Required = {
    "lost": ("<=", 0),
    "largest_difference": ("<=", SAME),
    "mixed": ("<=", 0),
}
COUNTED = {
    "lost": (".3g", "cases with something lost, or that did not go on"),
    "largest_difference": (".3g", "from runs that were not killed [m, or relative]"),
    "kills": (".3g", "cases killed before their end"),
    "mixed": (".3g", "pairs that mixed their results"),
    "pairs": (".3g", "pairs in one folder at once"),
}
RUN = """
task = "reconstruct"
frame = 2
seed = 1

[scene.ball]
shape = "sphere"
radius = 0.15
position = [2.0, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[truth.ball]
position = [2.04, 0.03, 0.0]

[radar]
waveform = { kind = "fmcw", start_frequency = 77e9, bandwidth = 2e9, duration = 5e-5, samples = 64 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 8, spacing = 1.92e-3 }
positions = { kind = "grid", center = [0.0, 0.0, 0.0], size = [1.0, 0.4], count = [2, 1] }

[grid]
range_min = 1.6
range_max = 2.4
u_max = 0.5

[data]
kind = "simulated"
points_per_m2 = 200.0
snr_db = 20.0
depth = 1

[[parameters]]
kind = "translation"
object = "ball"
axes = ["x", "y"]

[loss]
kind = "likelihood"

[surrogate]
range_width = 3.0
angle_width = 1.0

[optimizer]
rate = 0.004

[reconstruct]
steps = 4
depth = 1
samples = 500
boundary_samples = 200
checkpoint_every = 1
"""
MANY = RUN + '\n[starts]\nobject = "ball"\ncount = 2\ndistance = [0.03, 0.05]\naxes = ["x", "y"]\n'
STAGED = (
    RUN + "\n[[stages]]\nreconstruct = { steps = 3 }\n\n[[stages]]\nreconstruct = { steps = 2 }\n"
)
DATASET = (
    RUN.replace("reconstruct", "dataset", 1)
    + """
[dataset]
samples = 3
shard = 1
signals = ["map"]

[[vary]]
key = "data.snr_db"
kind = "uniform"
low = 10.0
high = 30.0
"""
)
#: By name: the run file, and the arguments before its folder.
COMMANDS = {
    "reconstruct": (RUN, ["reconstruct", "reconstruct.toml"]),
    "starts": (MANY, ["reconstruct", "starts.toml"]),
    "stages": (STAGED, ["reconstruct", "stages.toml"]),
    "simulate": (RUN.replace("reconstruct", "simulate", 1), ["simulate", "simulate.toml"]),
    "dataset": (DATASET, ["dataset", "dataset.toml"]),
    "twin": (RUN, ["twin", "twin.toml"]),
    "view": (RUN, ["view", "view.toml"]),
    "train-prior": ("", ["train-prior", "--cars", "100", "--latent", "4", "--epochs", "1"]),
}
RESUMED = ("reconstruct", "starts", "stages", "dataset")
PAGE = "page.html"  # of `view --record`, which has no run folder
OWN = "notes.txt"  # a file of the user's


def command(name: str, out: Path, *more: str) -> list[str]:
    """The command line of a case."""
    call = "from invertwin.cli.app import main; main()"
    where = ["--record", str(out / PAGE)] if name == "view" else ["-o", str(out)]
    return [sys.executable, "-c", call, *COMMANDS[name][1], *where, *more]


def ended(name: str, out: Path, *more: str) -> tuple[int, str]:
    """Exit code and errors of a command that is left to its end."""
    done = subprocess.run(
        command(name, out, *more),
        cwd=out.parent,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        timeout=SECONDS,
    )
    return done.returncode, done.stderr


def results(out: Path) -> dict[str, bytes]:
    """The files of a folder, without those of a run in progress."""
    files = [path for path in out.rglob("*") if path.is_file()]
    found = {str(path.relative_to(out)): path.read_bytes() for path in files}
    # The draft of a page stays after a kill: nobody may remove it.
    passing = (".invertwin", f".{Path(PAGE).stem}.", UNFINISHED)
    return {k: v for k, v in found.items() if not k.startswith(passing)}


def numbers(out: Path) -> list[np.ndarray]:
    """What a run found, as numbers that another run of it must find again."""
    if (out / PAGE).exists():
        return [np.frombuffer((out / PAGE).read_bytes(), np.uint8).astype(float)]
    if (out / "manifest.json").exists():
        return [sample["map"].numpy() / sample["map"].max().item() for sample in SampleDataset(out)]
    metrics = json.loads((out / "metrics.json").read_text())
    if (out / "capture.nc").exists():
        beat = Capture.load(out / "capture.nc").beat.numpy()
        return [beat / np.abs(beat).max()]
    if "starts" not in metrics:
        return [np.array(metrics["held_out_error_m"])]
    return [np.array(row["values"][key]) for row in metrics["starts"] for key in row["values"]]


def difference(out: Path, whole: Sequence[np.ndarray]) -> float:
    """The largest of a number."""
    found = numbers(out)
    if [a.shape for a in found] != [b.shape for b in whole]:
        return math.inf
    return max(float(np.abs(a - b).max()) for a, b in zip(found, whole, strict=True))


class Case:
    """A command with its run file, made once without a kill: its results, numbers and time."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.out = name, folder / name
        if COMMANDS[name][0]:
            (folder / COMMANDS[name][1][1]).write_text(COMMANDS[name][0])
        if name == "view":
            self.out.mkdir()
        for more in ((), ("--overwrite",)):  # the second time kernels are in the cache
            begun = time.monotonic()
            code, said = ended(name, self.out, *more)
            assert code == 0, said
        self.seconds = time.monotonic() - begun
        self.numbers = numbers(self.out)
        (self.out / OWN).write_text("mine")

    def same(self) -> bool:
        """Whether the folder holds what the run that was not killed has found."""
        return difference(self.out, self.numbers) <= SAME

    def killed(self, share: float) -> tuple[bool, bool, float]:
        """Whether a kill came before the end, whether something was lost, and the difference."""
        before = results(self.out)
        process = subprocess.Popen(
            command(self.name, self.out, "--overwrite"),
            cwd=self.out.parent,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            process.wait(share * self.seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
        after = results(self.out)
        # A kill amid the moves leaves files of both; the next command finishes them. One between
        # the last move and the end of the process leaves the new files.
        begun = (self.out / UNFINISHED).exists()
        renewed = not begun and set(after) == set(before) and self.same()
        whole = after == before or renewed
        resumes = self.name in RESUMED
        code, said = ended(self.name, self.out, "--resume" if begun and resumes else "--overwrite")
        moving = begun and not whole
        lost = code != 0 or not (whole or moving) or (self.out / OWN).read_text() != "mine"
        if code:
            print(f"{self.name}, killed after {share * self.seconds:.2f} s: {said}")
        return process.returncode != 0, lost, difference(self.out, self.numbers)

    def together(self, random_moment: float) -> bool:
        """Whether two of the command at once in one folder mix their results."""
        processes = []
        for delay in (0.0, random_moment):
            time.sleep(delay)
            processes.append(
                subprocess.Popen(
                    command(self.name, self.out, "--overwrite"),
                    cwd=self.out.parent,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
        said = [process.communicate(timeout=SECONDS)[1] for process in processes]
        codes = [process.returncode for process in processes]
        refused = [text for code, text in zip(codes, said, strict=True) if code]
        clean = 0 in codes and all(
            text.count("\n") == 1 and "no other run uses" in text for text in refused
        )
        left = (self.out / UNFINISHED).exists() or (self.out / OWN).read_text() != "mine"
        mixed = not clean or left or not self.same()
        if mixed:
            print(f"{self.name}, two at once: {codes} {said}")
        return mixed


def measure(kills: int, pairs: int, seed: int) -> dict[str, Any]:
    """All cases, in a folder that is gone afterwards."""
    moments, names = random.Random(seed), list(COMMANDS)
    # Drawn before: kinds of commands take their turns side by side.
    shares = [(names[k % len(names)], moments.random()) for k in range(kills)]
    delays = [(names[k % len(names)], moments.random() * 2) for k in range(pairs)]
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(AT_ONCE) as pool:

        def attack(name: str) -> tuple[list[tuple[bool, bool, float]], list[bool]]:
            case = Case(name, Path(scratch))
            killed = [case.killed(share) for kind, share in shares if kind == name]
            return killed, [case.together(delay) for kind, delay in delays if kind == name]

        rows = list(pool.map(attack, {kind: 0 for kind, _ in shares + delays}))
    found = [case for killed, _ in rows for case in killed]
    mixed = [pair for _, both in rows for pair in both]
    return {
        "lost": sum(lost for _, lost, _ in found),
        "largest_difference": max((apart for _, _, apart in found), default=None),
        "kills": sum(killed for killed, _, _ in found),
        "mixed": sum(mixed),
        "pairs": pairs,
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/crash_safety"))
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    os.environ |= {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    metrics = measure(given.kills, given.pairs, given.seed)
    table = MetricTable("Crash safety", REQUIRED)
    table.rows(metrics, COUNTED)
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
