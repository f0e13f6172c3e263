"""Damaged files of every format for as long as one likes.

    PYTHONPATH=tests python -m fuzz.long [--minutes N] [--seed N] [-o DIR]

Every format is read in turns by processes of their own, two at a time. `metrics.json` in DIR
(default `out/fuzz`) counts `cases` and `failures`, in all and per format; the files of a failure
are kept in DIR/<format>-<number>. Files that the libraries wrote are read in the process of the
fuzz, those of users in a child: if a signal ends the process, the case is read again as a user's,
and a failure if that fails too, else one of `deaths`.
"""

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

TURN = 180.0  # seconds of one process
_LATE = 300.0  # seconds after which a process hangs that should have ended: it starts slowly
_ROUND = 100  # cases that Hypothesis draws from one seed
_SPACE = 6 << 30  # address space beyond that of the libraries, so that a case cannot take all
_KEPT = 3  # failures of one kind whose files are kept


def work(name: str, seconds: float, seed: int, folder: Path) -> dict[str, Any]:
    """Cases of one format, in this process.

    Args:
        name: Of the format.
        seconds: How long.
        seed: Of all cases.
        folder: Gets the files of every failure, and of the case under way.
    """
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded

    from fuzz.cases import outcome
    from fuzz.damage import EDITS, Edits, damaged
    from fuzz.formats import FORMATS

    sys.dont_write_bytecode = True
    form = FORMATS[name]
    samples = form.samples()
    for files in samples:  # what libraries load late is loaded before it is limited and watched
        found, _ = outcome(form, files)
        assert found is None, found
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + _SPACE, held + _SPACE))
    cases, slowest = 0, 0.0
    kinds: dict[str, dict[str, Any]] = {}
    end = time.monotonic() + seconds

    @settings(
        max_examples=_ROUND,
        deadline=None,
        database=None,
        phases=(Phase.generate,),
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(EDITS)
    def case(edits: Edits) -> None:
        nonlocal cases, slowest
        if time.monotonic() > end:
            return
        files = damaged(samples, edits, form.levels)
        (folder / "case.json").write_text(json.dumps([cases, edits], default=vars))
        found, took = outcome(form, files)
        cases, slowest = cases + 1, max(slowest, took)
        if found is not None:
            kind = kinds.setdefault(
                f"{found.what.split(':')[0]} at {found.where}",
                {"what": found.what, "count": 0, "edits": []},
            )
            kind["count"] += 1
            if len(kind["edits"]) < _KEPT:
                kind["edits"].append([edits[0], edits[1], [vars(e) for e in edits[2]]])

    number = seed
    while time.monotonic() < end:
        seeded(number)(case)()
        number += 1
    return {"cases": cases, "slowest_seconds": slowest, "failures": kinds}


def read_again(name: str, seed: int, edits: list[Any]) -> str | None:
    """The fault of one case that is read as a user's, or None.

    Args:
        name: Of the format.
        seed: First number of the case.
        edits: Its second number, and its edits.
    """
    from fuzz.cases import outcome
    from fuzz.damage import Edit, damaged
    from fuzz.formats import FORMATS, SOUND

    form = FORMATS[name]
    case = (seed, edits[0], [Edit(**edit) for edit in edits[1]])
    files = damaged(form.samples(), case, form.levels)
    files.pop(SOUND, None)
    found, _ = outcome(form, files)
    return None if found is None else f"{found.what} at {found.where}"


def is_read_well(call: list[str], environment: dict[str, str]) -> bool:
    """Whether one case is read as a user's in a process of its own, in time."""
    try:
        return not subprocess.run(call, env=environment, timeout=_LATE).returncode
    except subprocess.TimeoutExpired:
        return False


def turn(name: str, seconds: float, seed: int, out: Path) -> dict[str, Any]:
    """Cases of one format, in a process that may die of them."""
    folder = out / f"{name}-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    call = [sys.executable, "-m", "fuzz.long", "--work", name, "--seed", str(seed)]
    call += ["--minutes", str(seconds / 60), "-o", str(folder)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    said = ""
    try:
        ended = subprocess.run(
            call, capture_output=True, text=True, env=environment, timeout=seconds + _LATE
        )
        said = f"exit code {ended.returncode}: {ended.stderr.strip()[-200:]}"
        found = json.loads(ended.stdout.splitlines()[-1])
    except (subprocess.TimeoutExpired, json.JSONDecodeError, IndexError) as error:
        last = folder / "case.json"
        kept = last.read_text() if last.exists() else ""  # empty, if it died of writing it
        cases, edits = json.loads(kept) if kept else (0, None)
        died = {"what": said or str(error)[-200:], "count": 1, "edits": [edits]}
        again = [*call[:3], "--again", json.dumps(edits), "--work", name]
        is_crash = edits is not None and said.startswith("exit code -")  # no hang
        passes = is_crash and is_read_well(again, environment)
        found = {"cases": cases + 1, "slowest_seconds": 0.0, "deaths": int(passes)}
        found["failures"] = {} if passes else {"died": died}
    (folder / "case.json").unlink(missing_ok=True)
    folder.rmdir()
    return found


def measure(minutes: float, seed: int, out: Path, only: list[str]) -> dict[str, Any]:
    """Turns of all formats until the time is over."""
    from fuzz.formats import FORMATS

    names = only or list(FORMATS)
    found: dict[str, Any] = {
        name: {"cases": 0, "failures": 0, "deaths": 0, "slowest_seconds": 0.0, "kinds": {}}
        for name in names
    }
    seeds = random.Random(seed)
    turns = max(1, round(2 * 60 * minutes / len(names) / TURN))
    seconds = 2 * 60 * minutes / len(names) / turns

    def take(name: str) -> None:
        part = turn(name, seconds, seeds.randrange(2**31), out)
        row = found[name]
        row["cases"] += part["cases"]
        row["deaths"] += part.get("deaths", 0)
        row["slowest_seconds"] = max(row["slowest_seconds"], part["slowest_seconds"])
        for key, kind in part["failures"].items():
            known = row["kinds"].setdefault(key, {"what": kind["what"], "count": 0, "edits": []})
            known["count"] += kind["count"]
            known["edits"] = (known["edits"] + kind["edits"])[:_KEPT]
            row["failures"] += kind["count"]

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(take, names * turns))
    return {
        "cases": sum(row["cases"] for row in found.values()),
        "failures": sum(row["failures"] for row in found.values()),
        "deaths": sum(row["deaths"] for row in found.values()),
        "minutes": minutes,
        "seed": seed,
        "formats": found,
    }


def main() -> None:
    """Run, print, write; exit code 1 where something has failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/fuzz"))
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=[], help="names of formats")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    parser.add_argument("--again", type=json.loads, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.again:
        sys.exit(read_again(given.work, given.again[0], given.again[1:]))
    if given.work:
        print(json.dumps(work(given.work, 60 * given.minutes, given.seed, given.out)))
        return
    given.out.mkdir(parents=True, exist_ok=True)
    metrics = measure(given.minutes, given.seed, given.out, given.only)
    for name, row in metrics["formats"].items():
        print(f"{name:12} {row['cases']:7} cases {row['failures']:6} failures", end="")
        print(f"  slowest {row['slowest_seconds']:.1f} s")
        for key, kind in row["kinds"].items():
            print(f"    {kind['count']:5} × {key}: {kind['what']}")
    print(f"{metrics['cases']} cases, {metrics['failures']} failures")
    if metrics["deaths"]:
        print(f"{metrics['deaths']} × the process died of a file that is read well as a user's")
    path = given.out / "metrics.json"
    path.write_text(json.dumps(metrics, indent=2) + "\n")
    print(f"wrote {path}")
    sys.exit(bool(metrics["failures"]))


if __name__ == "__main__":
    main()
