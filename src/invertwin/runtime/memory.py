"""Memory: how much is free, and refusing what does not fit before any of it is taken."""

import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from invertwin.errors import InputError

_DEFAULT_MEMORY = 16e9  # where the system does not say
_UNLIMITED = 1 << 60  # larger limits are none
_GROUPS = Path("/sys/fs/cgroup")


def free_memory() -> float:
    """Bytes that this process may still take, of the machine, of its group, of its limit."""
    return max(0.0, min((_machine_memory(), *_control_group_memory(), *_process_memory())))


def peak_memory() -> float | None:
    """Most bytes that this process has held at a time; None where the system does not say."""
    # First, since Linux's getrusage counts the parent's size when this process was started.
    if (held := _read_stated_bytes("/proc/self/status", "VmHWM")) is not None:
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
            f"expected {what} within the {format_gigabytes(free)} of memory that are free, got an "
            f"estimate of {format_gigabytes(needed)}; {do}",
            at,
        )


def require_at_most(count: float, maximum: float, what: str, do: str, at: str = "") -> None:
    """Refuse a count that only a wrong unit explains.

    Args:
        count: How many there would be; may be infinite.
        maximum: Of them.
        what: What they are.
        do: What the user can do.
        at: The argument to lower.

    Raises:
        InputError: More than that, or not a number.
    """
    if not count <= maximum:
        raise InputError(
            f"expected at most {maximum:,.0f} {what}, got {min(count, 1e300):.3g}; {do}", at
        )


def format_gigabytes(count: float) -> str:
    """Bytes as text."""
    return f"{min(count, 1e300) / 1e9:.3g} GB"


def _read_stated_bytes(file: str, name: str) -> float | None:
    """Bytes that Linux states in a line of a file; None where there is no such file or line."""
    try:
        for line in Path(file).read_text().splitlines():
            if line.startswith(f"{name}:"):
                return 1024.0 * int(line.split()[1])
    except OSError:
        pass
    return None


def _machine_memory() -> float:
    if (free := _read_stated_bytes("/proc/meminfo", "MemAvailable")) is not None:
        return free
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return _DEFAULT_MEMORY


def _control_group_memory() -> Iterator[float]:
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
            yield from _group_memory(root / str(path).strip("/"), *names)


def _group_memory(
    folder: Path, limit_name: str, usage_name: str, cache_name: str
) -> Iterator[float]:
    try:
        limit, taken = (int((folder / file).read_text()) for file in (limit_name, usage_name))
        rows = (line.split() for line in (folder / "memory.stat").read_text().splitlines())
        files = next((int(row[1]) for row in rows if row[0] == cache_name), 0)
    except (OSError, ValueError):  # no such group, or "max"
        return
    if limit < _UNLIMITED:
        yield float(limit - taken + files)


def _process_memory() -> Iterator[float]:
    """What `ulimit -v` still allows."""
    try:
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError, ValueError):
        return
    yield math.inf if limit == resource.RLIM_INFINITY else float(limit - taken)
