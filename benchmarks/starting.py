"""How soon the command line answers, and how much slower a fit is on a busy machine.

    python benchmarks/starting.py [-o DIR] [--steps N] [--load N]

Prints a table and writes `metrics.json` into DIR (default `out/starting`). The fit is that of
`invertwin demo`; one step is made before, so that its kernels are in the cache. Then it is made
alone and beside processes that never rest: those of `stress-ng --cpu N` where it is installed, else
as many of Python (`load_kind` says which). What else runs on the machine counts for both, so it
should be nothing; `load_before` is what the system says of that.

- `version_seconds`: processor time of `invertwin --version`, the least of five [s].
- `refusal_seconds`: the most of all commands that are given a file that is missing, a folder, or a
  board that there is not, of each the least of three [s]; `refusals` has them all.
- `idle_seconds`, `busy_seconds`: wall time of the fit, alone and beside the load [s].
- `busy_ratio`: of the two.
- `idle_processor_seconds`, `busy_processor_seconds`: processor time of the two [s]. Threads that
  spin while they wait show here.
"""

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tomli_w
from report import MetricTable, Required, write

STEPS, LOAD, TIMES = 120, 8, 5
RUN_FILE_COMMANDS = (
    *("simulate", "dataset", "reconstruct", "plan", "check", "convert", "gradcheck", "rcs"),
)
# A run file is refused for its board before it is for its task.
WRONG_BOARD = 'task = "simulate"\nframe = 2\nradar = { board = { name = "xWR9999" } }\n'
DEMO = Path(__file__).parents[1] / "experiments" / "demo.toml"
REQUIRED: Required = {
    "version_seconds": ("<=", 0.3),
    "refusal_seconds": ("<=", 0.5),
    "busy_ratio": ("<=", 6.0),
}
COUNTED = {
    "version_seconds": (".3g", "processor time of invertwin --version [s]"),
    "refusal_seconds": (".3g", "the most of all commands that are refused [s]"),
    "idle_seconds": (".3g", "the demo alone [s]"),
    "busy_seconds": (".3g", "the demo beside the load [s]"),
    "busy_ratio": (".3g", "of the two"),
    "idle_processor_seconds": (".3g", "processor time of the demo alone [s]"),
    "busy_processor_seconds": (".3g", "and beside the load [s]"),
}


def taken(arguments: Sequence[str], code: int = 0) -> tuple[float, float]:
    """Wall time and processor time of a command of invertwin with all its children [s].

    Args:
        arguments: Of the command line.
        code: With which it must end.
    """
    call = "from invertwin.cli.app import main; main()"
    begun, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    line = [sys.executable, "-c", call, *arguments]
    done = subprocess.run(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert done.returncode == code, done.stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - begun, used


def refusals(folder: Path) -> dict[str, list[str]]:
    """Arguments that every command refuses, by the command and what is wrong.

    Args:
        folder: Where files for them are written.
    """
    board, raw, empty = folder / "board.toml", folder / "raw.bin", folder / "empty"
    board.write_text(WRONG_BOARD, encoding="utf-8")
    raw.write_bytes(b"")
    empty.mkdir()
    wrong = {"missing": str(folder / "none.toml"), "folder": str(empty), "board": str(board)}
    found = {f"{c} {what}": [c, file] for c in RUN_FILE_COMMANDS for what, file in wrong.items()}
    del found["convert board"]  # it converts what states no frame
    for command in ("look", "twin", "view"):
        found |= {f"{command} {what}": [command, wrong[what]] for what in ("missing", "folder")}
    for command in ("look", "twin"):
        found[f"{command} board"] = [command, str(raw), "-c", str(board), "-b", "xWR9999"]
    return found


@contextmanager
def busy(count: int) -> Generator[str]:
    """Processes that never rest; gives their kind.

    Args:
        count: How many.
    """
    stress = shutil.which("stress-ng")
    call = [stress, "--cpu", str(count), "--quiet"] if stress else [sys.executable, "-c", _SPIN]
    started = [
        # A session of its own: stress-ng starts processes that must end with it.
        subprocess.Popen(call, start_new_session=True, stdout=subprocess.DEVNULL)
        for _ in range(1 if stress else count)
    ]
    try:
        yield "stress-ng" if stress else "python"
    finally:
        for process in started:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


# Ends with this script, however that ends.
_SPIN = """
import os
parent = os.getppid()
while os.getppid() == parent:
    for _ in range(1_000_000):
        pass
"""


def demo(folder: Path, steps: int) -> Path:
    """The run file of the demo with so many steps.

    Args:
        folder: Where it is written.
        steps: Of the fit.
    """
    run = tomllib.loads(DEMO.read_text(encoding="utf-8"))
    run["reconstruct"]["steps"] = steps
    file = folder / "demo.toml"
    file.write_text(tomli_w.dumps(run), encoding="utf-8")
    return file


def measure(steps: int, load: int) -> dict[str, Any]:
    """All numbers.

    Args:
        steps: Of the fit.
        load: Processes beside it.
    """
    before = os.getloadavg()[0]
    version = min(taken(["--version"])[1] for _ in range(TIMES))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        refused = {
            case: min(taken(arguments, code=2)[1] for _ in range(3))
            for case, arguments in refusals(folder).items()
        }
        call = ["reconstruct", str(demo(folder, steps)), "--overwrite", "-o", str(folder / "out")]
        warm = ["reconstruct", str(demo(folder, 1)), "-o", str(folder / "warm")]
        taken(warm)
        demo(folder, steps)
        idle, used = taken(call)
        with busy(load) as kind:
            slow, used_then = taken(call)
    return {
        "version_seconds": version,
        "refusal_seconds": max(refused.values()),
        "refusals": refused,
        "idle_seconds": idle,
        "busy_seconds": slow,
        "busy_ratio": slow / idle,
        "idle_processor_seconds": used,
        "busy_processor_seconds": used_then,
        "steps": steps,
        "load": load,
        "load_kind": kind,
        "load_before": before,
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/starting"))
    parser.add_argument("--steps", type=int, default=STEPS, help="of the fit")
    parser.add_argument("--load", type=int, default=LOAD, help="processes that never rest")
    given = parser.parse_args()
    metrics = measure(given.steps, given.load)
    table = MetricTable("Starting, and a busy machine", REQUIRED)
    table.rows(metrics, COUNTED)
    write(metrics, table.grid, given.out)


if __name__ == "__main__":
    main()
