"""Measured values stand on one generated page, and other pages state no others."""

import json
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    page
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    if page.name != "results.md"
]
STORED = sorted((ROOT / "benchmarks" / "stored").glob("*.json"))


@cache
def measured(results) -> set[str]:
    """Values on the page of results, those in code too."""
    return results.claims(results.results_page().replace("`", ""))


def test_the_page_of_results_is_the_generated_one(results):
    assert results.read(results.RESULTS) == results.results_page()


def test_the_table_of_derivatives_is_the_tested_one(results):
    page = results.read(results.DERIVATIVES)
    assert page == results.derivatives_page(page)
    assert "| radar rotation | supported | zero |" in page


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_measured_value_of_a_page_stands_in_the_results(results, page):
    missing = results.claims(page.read_text("utf-8")) - measured(results)
    assert not missing, (
        f"{page.name} states {', '.join(sorted(missing))}: expected the same in docs/results.md, "
        "or `code` where it is a setting"
    )


def test_values_are_found_in_prose_and_not_in_code(results):
    text = (
        "It took 5 to 7.5 mm, **0.4 %**, 1e-6 and 2.1·10⁷ samples, 0.0123; 12 times as long.\n"
        "Not `3 dB`, [a link](page.md#at-5-mm), 77 GHz, 0.12, ITU-R P.2040, 440e21f9 or 3 mm².\n"
        "\n    a block: 9 dB\n\n```\n8 dB\n```\n# Heading of 4 s\n"
    )
    found = {"5 mm", "7.5 mm", "0.4 %", "1e-6", "2.1·10⁷", "0.0123", "12 times"}
    assert results.claims(text) == found


def test_a_value_that_nobody_measured_is_found(results):
    page = (ROOT / "README.md").read_text("utf-8") + "\nThe error is 0.00071 and 98.7 dB.\n"
    assert {"0.00071", "98.7 dB"} <= results.claims(page) - measured(results)


@pytest.mark.parametrize("file", STORED, ids=lambda file: file.stem)
def test_stored_figures_say_where_they_come_from(file):
    entry = json.loads(file.read_text("utf-8"))
    parts = [entry[kind] for kind in ("measured", "stated") if kind in entry]
    assert entry["title"]
    assert parts
    for part in parts:
        assert re.match(r"[0-9a-f]{7}", part["commit"])
        assert part["machine"]
        assert all(len(row) == 3 and row[0] and row[1] for row in part["rows"])
        when = part["date"] if "metrics" in part else part["since"]
        assert re.search(r"\d{4}-\d\d-\d\d", when)
    for path in re.findall(r"\b(?:experiments|benchmarks|tests)/[\w/*.]*\w", entry["command"]):
        assert list(ROOT.glob(path)), f"no file {path}"


def stored(folder: Path, **parts: object) -> Path:
    entry = {"section": "speed", "title": "Speed", "command": "python run.py"} | parts
    (folder / "run.json").write_text(json.dumps(entry))
    return folder


def test_metrics_are_stored_with_machine_and_commit(results, tmp_path):
    (tmp_path / "metrics.json").write_text('{"speed": {"ours": 12.34, "theirs": [1.0]}, "a": "b"}')
    (tmp_path / "stored").mkdir()
    folder = stored(tmp_path / "stored")
    run = json.loads(results.store(tmp_path, "run", folder).read_text())["measured"]
    assert re.fullmatch(r"[0-9a-f]{7}( with changes)?", run["commit"])
    assert "cores" in run["machine"]
    page = results.results_page(folder)
    assert "| `speed.ours` | 12.3 |  |" in page
    assert "| `speed.theirs.0` | 1 |  |" in page
    assert f"Measured {run['date']} at {run['commit']}" in page


def test_rows_survive_the_next_run(results, tmp_path):
    (tmp_path / "metrics.json").write_text('{"speed": 2.0}')
    (tmp_path / "stored").mkdir()
    rows = [["how fast", "{speed:.2f} times", "1 time"], ["least", "{min sp*:.1f}", ""]]
    folder = stored(tmp_path / "stored", measured={"rows": rows})
    results.store(tmp_path, "run", folder)
    assert "| how fast | 2.00 times | 1 time |\n| least | 2.0 |" in results.results_page(folder)
    (tmp_path / "metrics.json").write_text('{"other": 2.0}')
    with pytest.raises(KeyError, match="speed"):
        results.store(tmp_path, "run", folder)


def test_faults_of_stored_files_are_named(results, tmp_path):
    with pytest.raises(FileNotFoundError, match="section, title and command"):
        results.store(tmp_path, "missing", tmp_path)
    stored(tmp_path, section="other")
    with pytest.raises(ValueError, match="expected sections"):
        results.results_page(tmp_path)
    with pytest.raises(ValueError, match="two comments"):
        results.derivatives_page("no table")
