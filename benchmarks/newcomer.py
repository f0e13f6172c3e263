"""What a newcomer waits for: every snippet of the README and every cell of the tutorials, timed.

    python benchmarks/newcomer.py [-o DIR] [page ...]

Prints a row for each cell and writes `metrics.json` into DIR (default `out/newcomer`). Each page
runs in a process of its own, from top to bottom, as a reader would run it: the first cell pays for
imports, the first that traces rays for compilation. A cell that fails ends the benchmark.

- `longest_s`: of the slowest cell; asked are at most 60 on two idle cores.
- `total_s`: of all; asked are at most 1200.
- `seconds.<page>`: of each of its cells.
"""

import argparse
import json
import multiprocessing
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


def timed(page: Path) -> list[float]:
    """Seconds of each cell of a page, run in one session."""
    session = {"__name__": "__main__"}
    seconds = []
    for number, code in enumerate(cells(page), 1):
        begin = perf_counter()
        exec(compile(code, f"{page.name}, cell {number}", "exec"), session)
        seconds.append(perf_counter() - begin)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("out/newcomer"))
    parser.add_argument("pages", type=Path, nargs="*", default=pages())
    asked = parser.parse_args()
    measured: dict[str, list[float]] = {}
    for page in asked.pages:
        # Not a Pool: its workers may not start workers of their own, as data sets do.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            measured[page.name] = pool.submit(timed, page).result()
        for number, seconds in enumerate(measured[page.name], 1):
            print(f"{page.name:42} cell {number:2} {seconds:6.1f} s", flush=True)
    longest = max(max(rows) for rows in measured.values())
    total = sum(sum(rows) for rows in measured.values())
    print(f"longest {longest:.1f} s, all {total:.0f} s")
    asked.out.mkdir(parents=True, exist_ok=True)
    metrics = {"longest_s": longest, "total_s": total, "seconds": measured}
    (asked.out / "metrics.json").write_text(json.dumps(metrics, indent=2))


if __name__ == "__main__":
    main()
