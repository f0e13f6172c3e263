"""The process of the pages: one serves all, and none sees what another left."""

from pathlib import Path

import pytest

from pages import start_page_runner

MAIN = """
import os, pickle, sys
class Own: pass
assert type(pickle.loads(pickle.dumps(Own()))) is Own
sys.path.append("elsewhere")
print(__name__, os.path.samefile(os.getcwd(), {folder!r}), os.getpid())
"""
NEXT = """
import os, sys
assert "Own" not in globals() and "elsewhere" not in sys.path
print(os.getpid())
"""


@pytest.fixture(scope="module")
def runner():
    with start_page_runner() as runner:
        yield runner


def test_pages_share_a_process_and_nothing_else(runner, tmp_path: Path):
    name, in_folder, process = runner.run(MAIN.format(folder=str(tmp_path)), tmp_path).split()
    assert (name, in_folder) == ("__main__", "True")
    assert runner.run(NEXT, tmp_path).strip() == process


def test_a_page_that_fails_or_warns_is_an_error_and_the_next_one_runs(runner, tmp_path: Path):
    with pytest.raises(AssertionError, match="too far off") as caught:
        runner.run("print('before')\nassert 1 > 2, 'too far off'", tmp_path)
    assert caught.value.__notes__ == ["before\n"]
    with pytest.raises(UserWarning, match="coarse"):
        runner.run("import warnings\nwarnings.warn('coarse')", tmp_path)
    assert runner.run("print(3)", tmp_path) == "3\n"
