"""What is free, and what is refused before any of it is taken."""

import math
import subprocess
import sys
import textwrap

import pytest

from invertwin.errors import InputError
from invertwin.runtime import memory


def test_limits_of_groups_and_processes_count(monkeypatch, tmp_path):
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    (inner / "memory.max").write_text("max\n")
    group = inner.parent
    (group / "memory.max").write_text("3000000000\n")
    (group / "memory.current").write_text("2500000000\n")
    (group / "memory.stat").write_text("anon 5\ninactive_file 400000000\n")
    names = "memory.max", "memory.current", "inactive_file"
    assert list(memory._group_memory(inner, *names)) == []
    assert list(memory._group_memory(group, *names)) == [0.9e9]
    monkeypatch.setattr(memory, "_control_group_memory", lambda: iter([0.9e9]))
    assert memory.free_memory() <= 0.9e9
    monkeypatch.setattr(memory, "_process_memory", lambda: iter([-5.0]))
    assert memory.free_memory() == 0.0


def test_memory_is_refused_in_one_line_that_names_the_key(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 2e9)
    memory.require_memory(2e9, "a map", "lower it")
    for needed in (3e9, math.inf, math.nan, 10**400):
        with pytest.raises(InputError, match=r"within the 2 GB of memory that are free") as found:
            memory.require_memory(needed, "a map", "lower it", "range_max")
        assert found.value.at == "range_max"


def test_counts_beyond_a_stated_number_are_refused():
    memory.require_at_most(5, 5, "bins", "lower it")
    for count in (6, math.inf, math.nan, 10**400):
        with pytest.raises(InputError, match="at most 5 bins"):
            memory.require_at_most(count, 5, "bins", "lower it")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not say")
def test_the_most_that_was_held_is_this_process_alone_and_never_falls():
    # The parent holds more than its child ever will.
    script = """
        import subprocess, sys
        child = (
            "from invertwin.runtime.memory import peak_memory; before = peak_memory();"
            "block = b'1' * 100_000_000; held = peak_memory(); del block;"
            "print(before, held, peak_memory())"
        )
        block = b"1" * 400_000_000
        subprocess.run([sys.executable, "-c", child], check=True)
    """
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True
    )
    before, held, after = (float(word) for word in run.stdout.split())
    assert 5e6 < before < 3e8
    assert 0.8e8 < held - before < 1.5e8
    assert after > 0.99 * held  # the kernel counts in batches
