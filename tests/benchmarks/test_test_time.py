"""The times of the tests: rings are read, compared with what must hold, and stored."""

import json
import re
import subprocess
import sys
import tomllib

import pytest

CASE = (
    '<testcase classname="tests.{room}.test_{name}" name="test_{name}[a|b]" time="{seconds}">'
    '<properties><property name="processor_seconds" value="{used}" /></properties></testcase>'
)


def write_junit(folder, ring, tests, seconds=12.0, failures=0):
    """Write what pytest leaves of a ring.

    Args:
        tests: Name → seconds of processors.
    """
    cases = "".join(
        CASE.format(room="radar", name=name, seconds=2 * used, used=used)
        for name, used in tests.items()
    )
    folder.mkdir(exist_ok=True)
    (folder / f"{ring}.xml").write_text(
        f'<testsuites><testsuite name="pytest" errors="1" failures="{failures}" skipped="3" '
        f'tests="{len(tests)}" time="{seconds}">{cases}</testsuite></testsuites>'
    )


def test_a_ring_has_the_sum_of_its_tests(test_time, tmp_path):
    write_junit(tmp_path, "test", {"first": 1.5, "second": 4.0}, failures=2)
    ring = test_time.read_ring(tmp_path / "test.xml")
    assert (ring.name, len(ring.tests), ring.skipped, ring.failed) == ("test", 2, 3, 3)
    assert ring.seconds == 12.0
    assert ring.processor_seconds == 5.5
    assert ring.tests[1] == test_time.TimedTest("radar.test_second.test_second[a|b]", 8.0, 4.0)


def test_what_is_no_measurement_is_refused(test_time, tmp_path):
    (tmp_path / "test.xml").write_text("<testsuites />")
    with pytest.raises(SystemExit, match="expected a JUnit file"):
        test_time.read_ring(tmp_path / "test.xml")


def test_the_slowest_fifty_stand_in_order(test_time, tmp_path):
    write_junit(tmp_path, "test", {f"t{i}": float(i) for i in range(10)})
    write_junit(tmp_path, "test-all", {f"t{i}": float(i) for i in range(60)})
    rings = [test_time.read_ring(tmp_path / f"{name}.xml") for name in ("test", "test-all")]
    page = test_time.render_page(rings, "", "here")
    rows = re.findall(r"^\| `radar\.test_t(\d+)\.\S+` \| ([\d.]+) \| ([\d.]+) \| (\w*)", page, re.M)
    assert [int(number) for number, *_ in rows] == list(range(59, 9, -1))
    assert rows[0] == ("59", "59.0", "118.0", "")
    assert "a|b" not in page  # would end the cell
    page = test_time.render_page(rings[:1], page, "there")
    assert "| `radar.test_t9.test_t9[a/b]` | 9.0 | 18.0 | yes |" in page


def test_rings_that_are_not_measured_again_stay(test_time, tmp_path):
    write_junit(tmp_path, "test", {"first": 1.0}, seconds=100.0)
    write_junit(tmp_path, "test-docs", {"page": 2.0}, seconds=50.0)
    test, docs = (test_time.read_ring(tmp_path / f"{name}.xml") for name in ("test", "test-docs"))
    before = test_time.render_page([test, docs], "", "a machine")
    write_junit(tmp_path, "test", {"first": 1.0}, seconds=90.0)
    after = test_time.render_page([test_time.read_ring(tmp_path / "test.xml")], before, "another")
    assert test_time.read_rows(after) == {
        "test": "| `make test` | 1 | 3 | 1 | 90 | 1 | another |",
        "test-docs": "| `make test-docs` | 1 | 3 | 1 | 50 | 2 | a machine |",
    }


def test_rings_are_run_printed_and_stored(test_time, tmp_path, monkeypatch, capsys):
    page, called = tmp_path / "page.md", []
    page.write_text(test_time.HEAD)
    monkeypatch.setattr(test_time, "PAGE", page)

    def measure(name):
        called.append(name)
        write_junit(tmp_path / "junit", name, {"first": 1.0}, seconds=700.0)

    monkeypatch.setattr(test_time, "run_ring", measure)
    folders = ["--junit", str(tmp_path / "junit"), "-o", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["test_time.py", "--run", "test", "--store", *folders])
    test_time.main()
    assert called == ["test"]
    assert re.search(r"test\.seconds.* 700 .*<= 600 NO", capsys.readouterr().out)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics == {
        "test": {"tests": 1, "skipped": 3, "failed": 1, "seconds": 700.0, "processor_seconds": 1.0}
    }
    assert "| `make test` | 1 | 3 | 1 | 700 | 1 |" in page.read_text()


def test_without_a_measurement_the_stored_rings_are_printed(
    test_time, tmp_path, monkeypatch, capsys
):
    page = tmp_path / "page.md"
    page.write_text("| `make test` | 7 |\n\n## The slowest\nnot these\n")
    monkeypatch.setattr(test_time, "PAGE", page)
    monkeypatch.setattr(sys, "argv", ["test_time.py", "--junit", str(tmp_path)])
    test_time.main()
    printed = capsys.readouterr().out
    assert "| `make test` | 7 |" in printed
    assert "not these" not in printed


def test_every_test_states_its_processor_time(test_time, repository, tmp_path):
    file = tmp_path / "test.xml"
    line = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={file}"]
    tests = repository / "tests" / "benchmarks" / "test_report.py"
    subprocess.run([*line, str(tests)], cwd=repository, check=True, capture_output=True)
    ring = test_time.read_ring(file)
    assert len(ring.tests) > 1
    assert 0 < ring.processor_seconds < 60


def test_the_rings_of_the_makefile_name_marks_that_exist(test_time, repository):
    makefile = (repository / "Makefile").read_text()
    project = tomllib.loads((repository / "pyproject.toml").read_text())
    known = {line.split(":")[0] for line in project["tool"]["pytest"]["ini_options"]["markers"]}
    for ring in test_time.RINGS:
        (marks,) = re.findall(rf"^{ring}: .*\n\t.*\$\(PYTEST\).* -m '(.*)'$", makefile, re.M)
        assert set(re.findall(r"\w+", marks)) - {"and", "or", "not"} <= known, ring
