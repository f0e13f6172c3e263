"""The benchmark of a newcomer's wait: it finds all code, times it, and stops at what fails."""

import json
import sys

import pytest


def test_pages_are_the_readme_and_all_tutorials(newcomer, repository):
    found = [page.name for page in newcomer.pages()]
    assert found[:2] == ["README.md", "start.md"]
    assert len(found) == 2 + len(list((repository / "docs" / "tutorials").glob("*.py")))
    assert len(found) >= 13


def test_cells_are_timed_in_one_session(newcomer, tmp_path, monkeypatch):
    page = tmp_path / "page.py"
    page.write_text(
        "# %% [markdown]\n# # Title\n\n# %%\nimport time\nfirst = 1\n\n# %% [markdown]\n# text\n\n"
        "# %%\ntime.sleep(0.2)\nassert first == 1\n\n"
        "# %%\nend = time.process_time() + 0.3\nwhile time.process_time() < end: pass\n"
    )
    monkeypatch.setattr(sys, "argv", ["newcomer.py", "-o", str(tmp_path / "out"), str(page)])
    newcomer.main()
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert len(found["seconds"]["page.py"]) == 3
    assert 0.2 < found["seconds"]["page.py"][1] < 5
    _, slept, worked = found["processor_seconds"]["page.py"]
    assert slept < 0.1
    assert 0.25 < worked == found["longest_processor_s"] < 0.6
    assert found["total_s"] == pytest.approx(sum(found["seconds"]["page.py"]))


def test_a_cell_that_fails_ends_it(newcomer, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("text\n```python\nassert 1 == 2\n```\n")
    with pytest.raises(AssertionError):
        newcomer.timed(page)
