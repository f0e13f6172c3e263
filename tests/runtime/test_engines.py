"""Work that is spread over processes is all done; errors and deaths are told in one line."""

import os
import signal
import subprocess
import sys
import time

import pytest

from invertwin.errors import InputError
from invertwin.registry.section import KeyInputError
from invertwin.runtime.engines import run_jobs


def squared(number: int) -> tuple[int, str, int]:
    return number**2, os.environ["OMP_NUM_THREADS"], os.getpid()


def refused(number: int) -> int:
    if number == 2:
        raise KeyInputError("scene.box", "expected a box, got none")
    return number


def dies(number: int) -> int:
    if number:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_every_piece_is_done_once_by_workers_of_one_thread(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    found = dict(run_jobs(squared, [3, 4, 5, 6, 7], workers=2))
    assert {number: row[0] for number, row in found.items()} == {0: 9, 1: 16, 2: 25, 3: 36, 4: 49}
    assert {row[1] for row in found.values()} == {"1"}
    assert os.getpid() not in {row[2] for row in found.values()}
    assert os.environ["OMP_NUM_THREADS"] == "2"


def test_no_work_starts_nobody():
    assert list(run_jobs(dies, [])) == []


def test_what_a_worker_refuses_is_told_here():
    with pytest.raises(InputError, match=r"^scene\.box: expected a box, got none$"):
        list(run_jobs(refused, [1, 2, 3]))


def test_a_worker_that_dies_is_told():
    with pytest.raises(InputError, match="got one that has died"):
        list(run_jobs(dies, [0, 1]))


@pytest.mark.parametrize(
    ("options", "said"),
    [({"engine": "rya"}, "'processes' or 'ray', got 'rya'"), ({"workers": 0}, "got 0")],
)
def test_bad_arguments_are_told(unchecked, options, said):
    with pytest.raises(InputError, match=said):
        list(run_jobs(squared, [1], **options))


def test_ray_that_is_not_installed_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install 'invertwin\[ray\]'"):
        list(run_jobs(squared, [1], engine="ray"))


def waited(number: int) -> tuple[int, str]:
    time.sleep(0.5)
    return number, os.environ["OMP_NUM_THREADS"]


@pytest.mark.slow
def test_pieces_of_a_killed_node_are_done_by_others(repository, monkeypatch):
    """Runs where the extra `ray` is installed."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster  # pyright: ignore[reportMissingImports]

    paths = [str(repository / "tests"), *sys.path]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))  # of the nodes
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        second = cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        found = []
        for number, result in run_jobs(waited, range(20, 32), engine="ray"):
            found.append((number, result))
            if len(found) == 4:
                cluster.remove_node(second, allow_graceful=False)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert sorted(found) == [(k, (20 + k, "1")) for k in range(12)]


def test_code_of_the_current_folder_does_not_run(tmp_path, monkeypatch):
    """Workers and the process that looks after what they share import modules of their own."""
    mark = tmp_path / "mark"
    for name in ("multiprocessing", "numpy", "signal"):
        (tmp_path / f"{name}.py").write_text(f"open({str(mark)!r}, 'w')\nraise SystemExit(1)\n")
    monkeypatch.chdir(tmp_path)
    found = dict(run_jobs(squared, [1, 2], workers=2))
    assert [found[number][0] for number in (0, 1)] == [1, 4]
    assert not mark.exists()


SLEEPER = """
import time
from invertwin.runtime.engines import run_jobs
if __name__ == "__main__":
    print("begun", flush=True)
    list(run_jobs(time.sleep, [60, 60], workers=2))
"""


def children_of(process: int) -> list[int]:
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True)
    return [int(number) for number in found.stdout.split()]


def alive(number: int) -> bool:
    try:
        with open(f"/proc/{number}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="reads /proc")
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    script = tmp_path / "sleeper.py"
    script.write_text(SLEEPER)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE)
    try:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"begun\n"
        deadline, workers = time.monotonic() + 30, []
        # Two workers, and the process that looks after what they share.
        while len(workers) < 3 and time.monotonic() < deadline:
            time.sleep(0.2)
            workers = children_of(parent.pid)
        assert len(workers) >= 2
        time.sleep(2.0)
    finally:
        parent.kill()
        parent.communicate()
    deadline = time.monotonic() + 20
    while any(map(alive, workers)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(alive, workers))
