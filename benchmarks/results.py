"""Generate docs/results.md and the table of docs/derivatives.md from stored figures.

    python benchmarks/results.py                             write both pages
    python benchmarks/results.py --check                     write nothing; 1 if a page differs
    python benchmarks/results.py --store out/throughput      keep a run's metrics.json, then write

Every benchmark, experiment and group of tests has one file `benchmarks/stored/<name>.json`:

- `section`, `rank`, `title`, `command`, `note`: the place on the page, and how to measure again.
- `stated`: figures that a page of the documentation stated at a commit, before metrics were stored,
  and `since` which commit.
  Its rows are [quantity, measured value, required value or a peer's].
- `measured`: the `metrics` of a run with `machine`, `commit` and `date`. Its rows are as above, and
  the measured value is a format string over the metrics: `{scenes.letter_x.full.relative_l1:.4f}`,
  `{max scenes.*.full.relative_l1:.4f}`.

`--store FOLDER` writes `measured` of the file that `--name` states, by default the folder's name.
Rows are kept; where there are none, every number of `metrics.json` gets one.

The table of derivatives is that of `tests/gradients/capability_table.py`, every cell of which a
test checks.
"""

import argparse
import fnmatch
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from gradients import capability_table  # noqa: E402

STORED = ROOT / "benchmarks" / "stored"
RESULTS = ROOT / "docs" / "results.md"
DERIVATIVES = ROOT / "docs" / "derivatives.md"
TABLE = re.compile(
    r"(?<=<!-- table: benchmarks/results.py -->\n).*?(?=<!-- end of table -->)", re.DOTALL
)

#: Headings of the page by the `section` of a stored file, in order.
SECTIONS = {
    "derivatives": "Derivatives",
    "fits": "Reconstruction",
    "discovery": "Automatic reconstruction",
    "confidence": "Error bars and verdicts",
    "recordings": "Measured recordings",
    "signals": "Signals",
    "links": "Links, diffraction and metasurfaces",
    "rcs": "Radar cross-sections",
    "cases": "Cases",
    "speed": "Speed and memory",
    "robustness": "Robustness",
}
HEAD = """\
# Results

`python benchmarks/results.py` generates this page from `benchmarks/stored`: do not edit it. Every
table has its command, machine and commit. *Stated* figures were transcribed from the page that
stated them at that commit; *since* is the commit that wrote the newest of them there. The others
are the `metrics.json` of a run. `invertwin` and `python` stand for `.venv/bin/invertwin` and
`.venv/bin/python`, and the figures of a run file are those of the seed in it.

**The rule for other pages.** A measured value stands here first. A test reads README.md and the
pages of docs/: every number with a unit of a measurement (%, dB, °, ms, s, min, mm, cm, *times*),
with an exponent (1e-6, 10⁷) or with three decimals must stand on this page in the same spelling.
Settings and physical constants of these kinds are written as `code`, or on a page of settings.
"""
COLUMNS = "| quantity | measured | required, or a peer |\n|---|---|---|\n"


def results_page(stored: Path = STORED) -> str:
    """Compose the page of all stored figures."""
    entries = [json.loads(file.read_text("utf-8")) for file in sorted(stored.glob("*.json"))]
    entries.sort(key=lambda entry: entry.get("rank", 1000))
    unknown = {entry["section"] for entry in entries} - set(SECTIONS)
    if unknown:
        raise ValueError(f"expected sections {list(SECTIONS)}, got {sorted(unknown)}")
    parts = [HEAD]
    for section, heading in SECTIONS.items():
        parts.append(f"## {heading}\n")
        parts += [_entry(entry) for entry in entries if entry["section"] == section]
    return "\n".join(parts)


def _entry(entry: dict[str, Any]) -> str:
    """Compose one heading with its command, provenance and tables."""
    command = f"`{entry['command']}`. " if entry["command"] else "No command. "
    text = f"### {entry['title']}\n\n{command}{entry.get('note', '')}".rstrip() + "\n"
    if run := entry.get("measured"):
        numbers = Metrics(run["metrics"])
        text += f"\nMeasured {run['date']} at {run['commit']}: {run['machine']}.\n\n{COLUMNS}"
        text += "".join(_row(what, numbers.fill(value), peer) for what, value, peer in run["rows"])
    if stated := entry.get("stated"):
        text += f"\nStated by {stated['page']} at {stated['commit']}, since {stated['since']}: "
        text += f"{stated['machine']}.\n"
        text += f"\n{COLUMNS}" + "".join(_row(*row) for row in stated["rows"])
    return text


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |\n"


class Metrics:
    """Numbers of a run by dotted keys, for format strings."""

    def __init__(self, metrics: dict[str, Any]) -> None:
        self.numbers = dict(_numbers(metrics))

    def fill(self, text: str) -> str:
        """Put numbers into the fields of a format string."""
        return re.sub(
            r"\{([^{}:]+):([^{}]*)\}",
            lambda field: format(self.find(field[1]), field[2]).replace("e-0", "e-"),
            text,
        )

    def find(self, key: str) -> float:
        """Return the number of a key, or the least or greatest of a pattern: `max a.*.error`."""
        choice, _, pattern = key.rpartition(" ")
        if not choice:
            return self.numbers[key]
        found = [self.numbers[one] for one in fnmatch.filter(self.numbers, pattern)]
        return {"min": min, "max": max}[choice](found)


def _numbers(metrics: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """Walk through nested metrics: dotted keys and numbers."""
    if isinstance(metrics, dict | list):
        items = metrics.items() if isinstance(metrics, dict) else enumerate(metrics)
        for name, value in items:
            yield from _numbers(value, f"{key}.{name}" if key else str(name))
    elif isinstance(metrics, int | float):
        yield key, metrics


def derivatives_page(page: str) -> str:
    """Put the table of capabilities into the page of derivatives."""
    words, mechanisms = capability_table.CELLS, capability_table.MECHANISMS
    if not TABLE.search(page):
        raise ValueError("expected two comments about the table in docs/derivatives.md, got none")
    head = _row("parameter", *mechanisms.values()) + "|---" * (1 + len(mechanisms)) + "|\n"
    parameters = dict.fromkeys(parameter for parameter, _ in words)
    body = "".join(_row(one, *(words[one, key] for key in mechanisms)) for one in parameters)
    return TABLE.sub(lambda _: head + body, page)


def store(folder: Path, name: str, stored: Path = STORED) -> Path:
    """Keep the metrics of a run with its machine and commit.

    Args:
        folder: output of a benchmark or run, with `metrics.json`.
        name: stem of the stored file; it must exist, since it holds title and command.
        stored: folder of the stored files.
    """
    file = stored / f"{name}.json"
    if not file.exists():
        raise FileNotFoundError(
            f"expected {file} with section, title and command, got no such file; write it first"
        )
    metrics = json.loads((folder / "metrics.json").read_text("utf-8"))
    entry = json.loads(file.read_text("utf-8"))
    rows = entry.get("measured", {}).get("rows")
    entry["measured"] = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "commit": commit(),
        "machine": machine(),
        "rows": rows or [[f"`{key}`", f"{{{key}:.3g}}", ""] for key, _ in _numbers(metrics)],
        "metrics": metrics,
    }
    # A row whose number is missing is found before the file is written.
    Metrics(metrics).fill(" ".join(value for _, value, _ in entry["measured"]["rows"]))
    file.write_text(json.dumps(entry, indent=2, ensure_ascii=False) + "\n", "utf-8")
    return file


def commit() -> str:
    """Abbreviated commit of the checkout, with a remark where files differ from it."""

    def git(*words: str) -> str:
        run = ["git", "-C", str(ROOT), *words]
        return subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip()

    return git("rev-parse", "--short=7", "HEAD") + (" with changes" if git("status", "-s") else "")


def machine() -> str:
    """Processor, cores and load of this machine."""
    info = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.*)", info.read_text()) if info.exists() else None
    name, load = model[1] if model else platform.machine(), os.getloadavg()[0]
    return f"{name}, {os.cpu_count()} cores, load {load:.0f}"


_NUMBER = r"[−-]?\d+(?: \d{3})*(?:\.\d+)?"
_UNIT = r"%|dB|°|ms|s|min|mm|cm|times"
_JOINT = r"(?:–| to | or | and |, | ± | → )"
#: Numbers that share a unit, numbers with an exponent, and numbers with three decimals or more.
_WITH_UNIT = re.compile(rf"{_NUMBER}(?:{_JOINT}{_NUMBER})* ?({_UNIT})(?![\w/²³])")
_ALONE = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+\b|·10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)|(?<![\w.])\d{1,3}\.\d{3,}")
_CODE = re.compile(r"^```.*?^```|^ {4}\S.*?$|`[^`]*`|\]\([^)]*\)|^#.*?$", re.DOTALL | re.MULTILINE)


def claims(text: str) -> set[str]:
    """Find the measured values of a page by the rule that docs/results.md states.

    Values of a list share its unit: "5 to 7 mm" has "5 mm" and "7 mm".
    """
    text = _CODE.sub(" ", text).replace("**", "")
    found = set(_ALONE.findall(text))
    for match in _WITH_UNIT.finditer(text):
        found |= {f"{number} {match[1]}" for number in re.findall(_NUMBER, match[0])}
    return found


def read(page: Path) -> str:
    """Text of a page, empty where there is none yet."""
    return page.read_text("utf-8") if page.exists() else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--store", type=Path, metavar="FOLDER", help="keep its metrics.json first")
    parser.add_argument("--name", help="stored file of --store; default: the folder's name")
    parser.add_argument("--check", action="store_true", help="write nothing")
    asked = parser.parse_args()
    if asked.store:
        print(f"wrote {store(asked.store, asked.name or asked.store.resolve().name)}")
    pages = {RESULTS: results_page(), DERIVATIVES: derivatives_page(read(DERIVATIVES))}
    outdated = [page for page, text in pages.items() if read(page) != text]
    for page in outdated:
        if not asked.check:
            page.write_text(pages[page], "utf-8")
        print(f"{'differs' if asked.check else 'wrote'} {page}")
    return int(asked.check and bool(outdated))


if __name__ == "__main__":
    sys.exit(main())
