"""One setting of threads for the whole process: how many there are, and how they wait.

Dr.Jit, torch, OpenMP and BLAS each start a thread for every core of the machine. A thread without
work spins for a while, so that the next piece begins sooner. On a machine that others use too, that
takes the cores from the threads that have work. So threads sleep while they wait, and none of the
libraries starts more of them than this process may use cores.
"""

import math
import os
from pathlib import Path

from invertwin.runtime.control_groups import group_folders, read_text

#: What tells libraries how their threads wait, read when they are loaded.
_WAIT_POLICY = {
    "OMP_WAIT_POLICY": "PASSIVE",
    "GOMP_SPINCOUNT": "0",  # GNU OpenMP: of torch and finufft
    "KMP_BLOCKTIME": "0",  # OpenMP of Intel and LLVM
    "OPENBLAS_THREAD_TIMEOUT": "4",  # its least: 2⁴ turns
}
COUNT_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Variables that tell libraries how many threads they may start."""


def set_thread_environment() -> None:
    """Set the environment that libraries read while they are loaded; what is set already stays.

    ``import invertwin`` calls it. Libraries that were imported earlier keep their own ways.
    """
    count = str(available_threads())
    for name, value in (_WAIT_POLICY | dict.fromkeys(COUNT_VARIABLES, count)).items():
        os.environ.setdefault(name, value)


def available_threads() -> int:
    """Return the number of threads to start: usable cores, or ``OMP_NUM_THREADS``.

    Counted are the affinity mask and the quota of the control group.
    """
    asked = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    if asked.isdecimal() and int(asked) > 0:
        return int(asked)
    found = getattr(os, "sched_getaffinity", None)
    return max(1, math.ceil(min(len(found(0)) if found else os.cpu_count() or 1, cgroup_quota())))


def cgroup_quota(
    listing: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")
) -> float:
    """Return the cores that the control groups of this process grant; infinite without a quota.

    Args:
        listing: file that names the groups of the process.
        root: folder of the hierarchies.
    """
    folders = group_folders("cpu", listing, root)
    return min((_read_quota(folder) for folder, _ in folders), default=math.inf)


def _read_quota(folder: Path) -> float:
    words = read_text(folder / "cpu.max").split()  # version 2
    if not words:
        words = [read_text(folder / f"cpu.cfs_{name}_us").strip() for name in ("quota", "period")]
    if len(words) == 2 and all(word.isdecimal() for word in words) and int(words[1]) > 0:
        return int(words[0]) / int(words[1])
    return math.inf
