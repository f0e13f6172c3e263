"""What a newcomer waits for: every snippet of the README and every cell of the tutorials, timed.

    python benchmarks/newcomer.py [-o DIR] [page ...]

Prints a row for each cell and writes `metrics.json` into DIR (default `out/newcomer`). Each page
runs in a process of its own, from top to bottom, as a reader would run it: the first cell pays for
imports, the first that traces rays for compilation. A cell that fails ends the benchmark.

- `longest_s`: of the slowest cell; asked are at most 60 on two idle cores.
- `total_s`: of all; asked are at most 1200.
- `longest_processor_s`, `total_processor_s`: the same in time of processors, summed over threads
  and processes; on a busy machine it tells more.
- `seconds.<page>`, `processor_seconds.<page>`: of each of its cells.
"""

import argparse
import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "docs"))

from public_names import cells  # noqa: E402


def pages() -> list[Path]:
    """The pages that a newcomer reads first."""
    tutorials = sorted((REPOSITORY / "docs" / "tutorials").glob("*.py"))
    return [REPOSITORY / "README.md", REPOSITORY / "docs" / "start.md", *tutorials]


def timed(page: Path) -> list[tuple[float, float]]:
    """Seconds of each cell of a page, run in one session: by the clock, and of processors."""
    session = {"__name__": "__main__"}
    seconds = []
    for number, code in enumerate(cells(page), 1):
        begin, used = perf_counter(), processors()
        exec(compile(code, f"{page.name}, cell {number}", "exec"), session)
        seconds.append((perf_counter() - begin, processors() - used))
    return seconds


def processors() -> float:
    """Seconds that processors have worked for this process and its children that have ended."""
    return sum(os.times()[:4])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/newcomer"))
    parser.add_argument("pages", type=Path, nargs="*", default=pages())
    asked = parser.parse_args()
    measured: dict[str, list[tuple[float, float]]] = {}
    for page in asked.pages:
        # Not a Pool: its workers may not start workers of their own, as data sets do.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            measured[page.name] = pool.submit(timed, page).result()
        for number, (seconds, used) in enumerate(measured[page.name], 1):
            row = f"{page.name:42} cell {number:2} {seconds:6.1f} s, processors {used:6.1f} s"
            print(row, flush=True)
    every = [row for rows in measured.values() for row in rows]
    longest, hardest = (max(column) for column in zip(*every, strict=True))
    total, worked = (sum(column) for column in zip(*every, strict=True))
    print(f"longest {longest:.1f} s, all {total:.0f} s")
    print(f"of processors: most {hardest:.1f} s, all {worked:.0f} s")
    asked.out.mkdir(parents=True, exist_ok=True)
    metrics = {
        "longest_s": longest,
        "total_s": total,
        "longest_processor_s": hardest,
        "total_processor_s": worked,
        "seconds": {page: [row[0] for row in rows] for page, rows in measured.items()},
        "processor_seconds": {page: [row[1] for row in rows] for page, rows in measured.items()},
    }
    (asked.out / "metrics.json").write_text(json.dumps(metrics, indent=2))


if __name__ == "__main__":
    main()
