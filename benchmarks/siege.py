"""Hostile files, numbers, terminals and clients: one line within limits, nothing lost, nobody in.

    python benchmarks/siege.py [-o DIR] [--only WORD ...]

Every case is a process of its own in a folder of its own. It prints its seconds, its peak memory
and what came out; `metrics.json` goes into DIR (default `out/siege`).

- `cases`: how many there are, by kind of attack.
- `failures`: cases that ended otherwise than they must: a refusal is exit code 2 and one line, a
  success is exit code 0, both without a traceback, within the limits, and with the user's files as
  they were.
- `slowest_seconds`: of processor time.
- `largest_gb`: peak memory of a process and its children.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from report import MetricTable, Required, write
from siege_files import CASES, Case, Made

SECONDS, GIGABYTES = 25.0, 2.0
_HANGS = 150.0  # wall-clock seconds: other work may be beside it
_KILLED_GB = 6.0  # more is not waited for
_AT_ONCE = 2  # cases: limits are in processor seconds
REQUIRED: Required = {
    "cases": (">=", 60),
    "failures": ("<=", 0),
    "slowest_seconds": ("<=", SECONDS),
    "largest_gb": ("<=", GIGABYTES),
}
COUNTED = {
    "cases": (".3g", "attacks, each a process in a folder of its own"),
    "failures": (".3g", "not one line, over the limits, or something lost"),
    "slowest_seconds": (".3g", "processor time of a refusal"),
    "largest_gb": (".3g", "peak memory of a refusal"),
}
#: As the console script begins: its own folder is on the import path, not the working one.
LAUNCHER = """import sys
from invertwin.errors import InputError
if sys.argv[1] == "-c":
    try:
        exec(sys.argv[2], {"__name__": "case"})
    except InputError as error:
        print(f"invertwin: {error}", file=sys.stderr)
        sys.exit(2)
elif __name__ == "__main__":
    from invertwin.__main__ import main
    main()
"""


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        failure: In words; empty where all is well.
        seconds: Of processor time.
        wall: Seconds on the clock.
        gigabytes: Peak memory.
        said: The first line of what it said.
    """

    failure: str
    seconds: float
    wall: float
    gigabytes: float
    said: str


def run(case: Case) -> Outcome:
    """Run a case in a new folder."""
    with tempfile.TemporaryDirectory(prefix="siege") as scratch:
        folder, tools = Path(scratch, "work folder"), Path(scratch, "tools")
        folder.mkdir()
        tools.mkdir()
        (tools / "launch.py").write_text(LAUNCHER)
        made = case.make(folder) or Made()
        before = dict(_contents(folder, made.keep))
        env = os.environ | {"PYTHONPATH": _library(), "MPLBACKEND": "Agg"} | dict(made.env)
        env = {name: value for name, value in env.items() if value is not None}
        env |= {"INVERTWIN": f'"{sys.executable}" "{tools / "launch.py"}"'}
        call = ["bash", "-c", case.shell.replace("invertwin ", "eval $INVERTWIN ", 1)]
        if not case.shell:
            call = [sys.executable, str(tools / "launch.py"), *case.words]
        used, begun = Path(scratch, "used.json"), time.monotonic()
        measured = [str(used), str(_HANGS), str(_KILLED_GB), *call]
        with Path(scratch, "out").open("w+b") as out, Path(scratch, "err").open("w+b") as err:
            starter = [sys.executable, "-I", str(Path(__file__).with_name("siege_measure.py"))]
            subprocess.run([*starter, *measured], cwd=folder, env=env, stdout=out, stderr=err)
            wall = time.monotonic() - begun
            status, seconds, gigabytes = json.loads(used.read_text())
            out.seek(0)
            err.seek(0)
            said = [one.read().decode(errors="replace") for one in (out, err)]
        for undo in made.undo:
            undo()
        failure = _judge(case, status, *said)
        if not failure and seconds > case.seconds:
            failure = f"took {seconds:.0f} s"
        if not failure and gigabytes > GIGABYTES:
            failure = f"took {gigabytes:.1f} GB"
        if not failure and dict(_contents(folder, made.keep)) != before:
            failure = "the user's files have changed"
        if not failure:
            failure = made.check(folder)
    shown = [line for line in said[1].splitlines() + said[0].splitlines() if line.strip()]
    return Outcome(failure, seconds, wall, gigabytes, shown[0] if shown else "")


def _library() -> str:
    import importlib.util

    found = importlib.util.find_spec("invertwin")
    assert found is not None
    assert found.origin is not None
    return str(Path(found.origin).parents[1])


def _contents(folder: Path, names: Sequence[str]) -> Iterator[tuple[str, bytes | None]]:
    for name in names:
        file = folder / name
        yield name, file.read_bytes() if file.is_file() else None


def _judge(case: Case, status: int, out: str, err: str) -> str:
    """What is wrong with how a case ended; empty where nothing is."""
    if status in (1000, 1001):
        return "hangs" if status == 1000 else f"more than {_KILLED_GB:g} GB"
    if "Traceback" in out + err:
        return "traceback: " + err.strip().splitlines()[-1][:120]
    lines = [line for line in err.splitlines() if not line.startswith("invertwin: warning: ")]
    if case.expects == "refused":
        one = len(lines) == 1 and lines[0].startswith("invertwin: ") and len(lines[0]) <= 8100
        if status != 2 or not one:
            return f"expected one line and exit code 2, got {len(lines)} lines and {status}"
    elif status:
        return f"expected exit code 0, got {status}"
    missing = [word for word in case.says if word not in out + err]
    return f"does not say {missing}" if missing else ""


def measure(only: Sequence[str] = (), show: Callable[[str], None] = print) -> dict[str, Any]:
    """Run all cases, or those whose name or kind holds one of some words."""
    rows: dict[str, dict[str, Any]] = {}
    named = {f"{case.kind}/{case.name}": case for case in CASES}
    cases = {k: v for k, v in named.items() if not only or any(word in k for word in only)}
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for (key, case), found in zip(cases.items(), pool.map(run, cases.values()), strict=True):
            row = {"seconds": round(found.seconds, 2), "gb": round(found.gigabytes, 2)}
            rows[key] = row | {"expects": case.expects, "failure": found.failure}
            show(
                f"{key:58} {found.wall:6.1f} s {found.seconds:6.1f} s {found.gigabytes:5.2f} GB  "
                f"{'FAILS: ' + found.failure if found.failure else 'passes'}"
            )
            show(f"      {found.said[:170]}")
    refused = [row for row in rows.values() if row["expects"] == "refused"]
    return {
        "cases": len(rows),
        "failures": sum(bool(row["failure"]) for row in rows.values()),
        "slowest_seconds": max((row["seconds"] for row in refused), default=None),
        "largest_gb": max((row["gb"] for row in refused), default=None),
        "rows": rows,
    }


def main() -> None:
    """Run, print, write; exit code 1 where something has failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/siege"))
    parser.add_argument("--only", nargs="*", default=[], help="words of names of cases")
    given = parser.parse_args()
    metrics = measure(given.only, lambda line: print(line, flush=True))
    table = MetricTable("Siege", REQUIRED)
    table.rows(metrics, COUNTED)
    write(metrics, table.grid, given.out)
    sys.exit(bool(metrics["failures"]))


if __name__ == "__main__":
    main()
