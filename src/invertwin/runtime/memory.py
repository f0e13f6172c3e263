"""Memory: how much is free, and refusing what does not fit before any of it is taken."""

import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from invertwin.errors import InputError

_UNKNOWN = 16e9  # where the system does not say
_UNLIMITED = 1 << 60  # larger limits are none
_GROUPS = Path("/sys/fs/cgroup")


def free_memory() -> float:
    """Bytes that this process may still take, of the machine, of its group, of its limit."""
    return max(0.0, min((_of_machine(), *_of_groups(), *_of_process())))


def peak_memory() -> float | None:
    """Most bytes that this process has held at a time; None where the system does not say."""
    # First, since Linux's getrusage counts the parent's size when this process was started.
    if (held := _stated("/proc/self/status", "VmHWM")) is not None:
        return held
    try:
        import resource
    except ImportError:  # Windows
        return None
    # Kilobytes, but on macOS.
    unit = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit)


def require_memory(needed: float, what: str, do: str, at: str = "") -> None:
    """Refuse what does not fit into the memory that is free.

    Args:
        needed: Bytes.
        what: What needs them.
        do: What the user can do.
        at: The argument to lower.

    Raises:
        InputError: More than is free.
    """
    free = free_memory()
    if not needed <= free:
        raise InputError(
            f"expected {what} within the {gigabytes(free)} of memory that are free, got an "
            f"estimate of {gigabytes(needed)}; {do}",
            at,
        )


def require_at_most(count: float, most: float, what: str, do: str, at: str = "") -> None:
    """Refuse a count that only a wrong unit explains.

    Args:
        count: How many there would be; may be infinite.
        most: Of them.
        what: What they are.
        do: What the user can do.
        at: The argument to lower.

    Raises:
        InputError: More than that, or not a number.
    """
    if not count <= most:
        raise InputError(
            f"expected at most {most:,.0f} {what}, got {min(count, 1e300):.3g}; {do}", at
        )


def gigabytes(count: float) -> str:
    """Bytes as text."""
    return f"{min(count, 1e300) / 1e9:.3g} GB"


def _stated(file: str, name: str) -> float | None:
    """Bytes that Linux states in a line of a file; None where there is no such file or line."""
    try:
        for line in Path(file).read_text().splitlines():
            if line.startswith(f"{name}:"):
                return 1024.0 * int(line.split()[1])
    except OSError:
        pass
    return None


def _of_machine() -> float:
    if (free := _stated("/proc/meminfo", "MemAvailable")) is not None:
        return free
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return _UNKNOWN


def _of_groups() -> Iterator[float]:
    """What the control groups of this process, which containers are made of, still allow."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if controllers not in ("", "memory") and "memory" not in controllers.split(","):
            continue
        root = _GROUPS if not controllers else _GROUPS / "memory"
        names = ("memory.max", "memory.current", "inactive_file")
        if controllers:
            names = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
        # In a container the name may be that of the host, whose group is then the root here.
        for path in (PurePosixPath(name), *PurePosixPath(name).parents):
            yield from _of_group(root / str(path).strip("/"), *names)


def _of_group(folder: Path, most: str, used: str, cached: str) -> Iterator[float]:
    try:
        limit, taken = (int((folder / file).read_text()) for file in (most, used))
        rows = (line.split() for line in (folder / "memory.stat").read_text().splitlines())
        files = next((int(row[1]) for row in rows if row[0] == cached), 0)
    except (OSError, ValueError):  # no such group, or "max"
        return
    if limit < _UNLIMITED:
        yield float(limit - taken + files)


def _of_process() -> Iterator[float]:
    """What `ulimit -v` still allows."""
    try:
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError, ValueError):
        return
    yield math.inf if limit == resource.RLIM_INFINITY else float(limit - taken)
