"""As many threads as the process may use cores, which sleep while they wait."""

import json
import math
import os
import subprocess
import sys

import pytest

from invertwin.runtime.threads import available_threads, cgroup_quota


def counted(code, **environment):
    """What a new process prints as JSON, without the settings of this one."""
    ours = {k: v for k, v in os.environ.items() if "THREADS" not in k and "OMP" not in k}
    run = [sys.executable, "-c", code]
    ended = subprocess.run(run, env=ours | environment, capture_output=True, text=True, check=True)
    return json.loads(ended.stdout)


def test_the_users_own_number_wins(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3,2")
    assert available_threads() == 3
    monkeypatch.setenv("OMP_NUM_THREADS", "many")
    assert 1 <= available_threads() <= (os.cpu_count() or 1)


@pytest.mark.parametrize(
    ("listing", "files", "expected"),
    [
        ("0::/", {}, math.inf),
        ("0::/", {"cpu.max": "max 100000"}, math.inf),
        ("0::/a/b", {"cpu.max": "max 100000", "a/cpu.max": "150000 100000"}, 1.5),
        ("0::/a/b", {"a/cpu.max": "400000 100000", "a/b/cpu.max": "200000 100000"}, 2.0),
        ("0::/not/here", {"cpu.max": "50000 100000"}, 0.5),
        (
            "4:cpu,cpuacct:/a\n1:memory:/b",
            {"cpu,cpuacct/a/cpu.cfs_quota_us": "300000", "cpu,cpuacct/a/cpu.cfs_period_us": "1000"},
            300.0,
        ),
        ("2:cpu:/", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, math.inf),
    ],
)
def test_the_quota_of_control_groups_counts(tmp_path, listing, files, expected):
    (tmp_path / "listing").write_text(listing)
    for name, text in files.items():
        (tmp_path / "groups" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / name).write_text(text)
    assert cgroup_quota(tmp_path / "listing", tmp_path / "groups") == expected


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no affinity masks here")
def test_no_library_starts_more_threads_than_the_mask_allows():
    code = """
import json, os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import invertwin
from invertwin.channel.rays.backend import dr
import torch
print(json.dumps([torch.get_num_threads(), dr.thread_count(), os.environ["OMP_WAIT_POLICY"]]))
"""
    assert counted(code) == [1, 1, "PASSIVE"]
