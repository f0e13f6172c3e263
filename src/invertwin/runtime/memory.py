"""Free memory, and checks that work fits into it before any is taken."""

import math
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from invertwin.errors import InputError
from invertwin.runtime.control_groups import group_folders, read_text

_DEFAULT_MEMORY = 16e9  # where the system does not say
_UNLIMITED = 1 << 60  # larger limits are none


def free_memory() -> float:
    """Return the bytes that machine, control groups and limits leave to this process."""
    return max(0.0, min((_machine_memory(), *_control_group_memory(), *_process_memory())))


def peak_memory() -> float | None:
    """Return the peak memory of this process [B]; None where the system does not say."""
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
    """Raise unless work fits into the free memory.

    Args:
        needed: Required memory [B].
        what: Name of the work, for the error.
        do: Remedy, for the error.
        at: Argument to lower.

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
    """Raise if a count is so large that only a wrong unit explains it.

    Args:
        count: Required number; may be infinite.
        maximum: Largest number.
        what: Name of the objects, for the error.
        do: Remedy, for the error.
        at: Argument to lower.

    Raises:
        InputError: More than that, or not a number.
    """
    if not count <= maximum:
        got = f"{min(count, 1e300):.3g}"
        raise InputError(f"expected at most {maximum:,.0f} {what}, got {got}; {do}", at)


def format_gigabytes(count: float) -> str:
    """Format a number of bytes in gigabytes."""
    return f"{min(count, 1e300) / 1e9:.3g} GB"


def _read_stated_bytes(file: str, name: str) -> float | None:
    """Return the bytes that Linux states in a line of a file; None without file or line."""
    stated = re.search(rf"^{name}:\s*(\d+)", read_text(Path(file)), re.MULTILINE)
    return 1024.0 * int(stated[1]) if stated else None


def _machine_memory() -> float:
    if (free := _read_stated_bytes("/proc/meminfo", "MemAvailable")) is not None:
        return free
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return _DEFAULT_MEMORY


def _control_group_memory() -> Iterator[float]:
    """Yield the memory that the control groups of this process still allow [B]."""
    for folder, version in group_folders("memory"):
        names = ("memory.max", "memory.current", "inactive_file")
        if version == 1:
            names = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
        yield from _group_memory(folder, *names)


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
    """Yield the memory that `ulimit -v` still allows [B]."""
    try:
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError, ValueError):
        return
    yield math.inf if limit == resource.RLIM_INFINITY else float(limit - taken)
