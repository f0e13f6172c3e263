"""Time of the tests: the rings, the tests in each, seconds, and the slowest fifty.

    python benchmarks/test_time.py [--run RING ...] [--store] [--junit DIR] [-o DIR]

The rings are the targets of the Makefile that run tests: `test`, `test-docs`, `test-all`. Each
leaves what it measured in `out/tests/<ring>.xml` (JUnit). This script reads these files, prints a
table and writes `metrics.json` into DIR (default `out/test_time`). `--run` runs rings first.
Without any measurement it prints what was stored last. `--store` writes `docs/test_times.md`: a
row for each ring, and the fifty tests that took most processor time. Rows of rings that were not
measured again stay as they were.

- `<ring>.tests`, `.failed`, `.skipped`: number of tests; errors count as failed.
- `<ring>.seconds`: from start to end by the clock, imports and collection included.
- `<ring>.processor_seconds`: of processors while tests ran, summed over threads, and over
  processes that a test started and waited for. On a busy machine it tells more.

What must hold: `make test` takes at most 600 s on two idle cores from a warm start, that is after
set-up, with the kernels that an earlier run left in `~/.drjit`; everything at most half an hour.
"""

import argparse
import os
import re
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

from report import MetricTable, Required, write

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "test_times.md"
RINGS = ("test", "test-docs", "test-all")
SLOWEST = 50
REQUIRED: Required = {"failed": ("<=", 0), "test.seconds": ("<=", 600)}
REQUIRED |= {"test-all.seconds": ("<=", 1800)}
HEAD = """# Times of the tests

Written by `python benchmarks/test_time.py --store` from what `make test`, `make test-docs` and
`make test-all` measured. [How to add a test](adding_a_test.md) explains the rings. Processor
seconds are summed over threads and processes; where other programs kept the machine busy, they tell
more than seconds.

| ring | tests | skipped | failed | seconds | processor seconds | where |
|---|---|---|---|---|---|---|
"""


@dataclass(frozen=True)
class TimedTest:
    """A test and what it took.

    Attributes:
        name: File, without `.py`, and function, with dots between.
        seconds: By the clock, fixtures included [s].
        processor_seconds: Of processors, likewise [s].
    """

    name: str
    seconds: float
    processor_seconds: float


@dataclass(frozen=True)
class Ring:
    """All tests of one target of the Makefile.

    Attributes:
        name: The target.
        tests: Tests that ran or were skipped.
        skipped: Number of tests that were skipped.
        failed: Number of tests that failed, errors included.
        seconds: From start to end by the clock [s].
    """

    name: str
    tests: tuple[TimedTest, ...]
    skipped: int
    failed: int
    seconds: float

    @property
    def processor_seconds(self) -> float:
        """Sum over all tests [s]."""
        return sum(test.processor_seconds for test in self.tests)


def read_ring(path: Path) -> Ring:
    """Read the JUnit file of a ring; its name is that of the file."""
    suite = ElementTree.parse(path).getroot().find("testsuite")
    if suite is None:
        raise SystemExit(f"expected a JUnit file of pytest, got {path}; run `make {path.stem}`")
    return Ring(
        path.stem,
        tuple(read_test(case) for case in suite.iter("testcase")),
        int(suite.attrib["skipped"]),
        int(suite.attrib["failures"]) + int(suite.attrib["errors"]),
        float(suite.attrib["time"]),
    )


def read_test(case: ElementTree.Element) -> TimedTest:
    """Read one test; `tests/conftest.py` states its processor time."""
    properties = {p.attrib["name"]: p.attrib["value"] for p in case.iter("property")}
    return TimedTest(
        f"{case.attrib['classname'].removeprefix('tests.')}.{case.attrib['name']}",
        float(case.attrib["time"]),
        float(properties.get("processor_seconds", 0.0)),
    )


def run_ring(name: str) -> None:
    """Run a target of the Makefile; tests that fail are counted later."""
    subprocess.run(["make", name], cwd=ROOT, check=False)


def render_row(ring: Ring, where: str) -> str:
    """Return the row of a ring in the page."""
    counts = f"{len(ring.tests)} | {ring.skipped} | {ring.failed}"
    times = f"{ring.seconds:.0f} | {ring.processor_seconds:.0f}"
    return f"| `make {ring.name}` | {counts} | {times} | {where} |"


def read_rows(page: str) -> dict[str, str]:
    """Read the rows of rings from the page, by the name of the ring."""
    return {
        row[2]: row[1] for row in re.finditer(r"^(\| `make ([\w-]+)` \|.*)$", page, re.MULTILINE)
    }


def render_page(rings: list[Ring], before: str, where: str) -> str:
    """Return the page: all rings, and the slowest tests of the largest ring measured.

    Args:
        rings: Those measured now.
        before: The page as it is; its rows stand for rings that were not measured.
        where: Machine, commit and day of the measurement.
    """
    rows = read_rows(before) | {ring.name: render_row(ring, where) for ring in rings}
    largest = max(rings, key=lambda ring: len(ring.tests))
    slowest = sorted(largest.tests, key=lambda test: -test.processor_seconds)[:SLOWEST]
    inner = {test.name for ring in rings if ring.name == "test" for test in ring.tests}
    lines = [rows[name] for name in RINGS if name in rows]
    lines += ["", f"## The slowest {len(slowest)} of `make {largest.name}`", ""]
    lines += ["| test | processor seconds | seconds | in `make test` |", "|---|---|---|---|"]
    for test in slowest:
        times = f"{test.processor_seconds:.1f} | {test.seconds:.1f}"
        lines.append(f"| `{escape(test.name)}` | {times} | {'yes' if test.name in inner else ''} |")
    return HEAD + "\n".join(lines) + "\n"


def escape(name: str) -> str:
    """Return the name of a test as it may stand in a cell of a table, at most 100 characters."""
    return name.replace("|", "/").replace("`", "'").replace("\n", " ")[:100]


def describe_machine() -> str:
    """Return cores, load, commit and day of this run."""
    line = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    load = f"load {os.getloadavg()[2]:.1f}" if hasattr(os, "getloadavg") else "load unknown"
    day = datetime.now(UTC).date()
    return f"{os.cpu_count()} cores, {load}, {commit.stdout.strip() or 'no commit'}, {day}"


def print_rings(rings: list[Ring], out: Path) -> None:
    """Print a table and write `metrics.json`."""
    table = MetricTable("Times of the tests", REQUIRED)
    metrics = {}
    for ring in rings:
        counts = {"tests": len(ring.tests), "skipped": ring.skipped, "failed": ring.failed}
        times = {"seconds": ring.seconds, "processor_seconds": ring.processor_seconds}
        for key, value in (counts | times).items():
            table.row(f"{ring.name}.{key}", value, ".0f")
        metrics[ring.name] = counts | times
    write(metrics, table.grid, out)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--run", nargs="+", choices=RINGS, default=[], metavar="RING")
    parser.add_argument("--store", action="store_true")
    parser.add_argument("--junit", type=Path, default=ROOT / "out" / "tests", metavar="DIR")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/test_time"))
    given = parser.parse_args()
    for name in given.run:
        run_ring(name)
    files = [given.junit / f"{name}.xml" for name in RINGS]
    rings = [read_ring(file) for file in files if file.is_file()]
    if not rings:
        print(PAGE.read_text().partition("## ")[0])
        return
    print_rings(rings, given.out)
    if given.store:
        PAGE.write_text(render_page(rings, PAGE.read_text(), describe_machine()))
        print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
