"""Progress of long work, for observers; by default there are none."""

import time
from collections.abc import Callable, Collection, Generator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

_T = TypeVar("_T")


@dataclass
class _ProgressListener:
    callback: Callable[[str, int, int, float], None]
    busy: bool = False


_listener: ContextVar[_ProgressListener | None] = ContextVar("listener", default=None)


@contextmanager
def progress_callback(callback: Callable[[str, int, int, float], None]) -> Generator[None]:
    """Hear how far long loops have come while the block is worked on.

    Args:
        callback: Function (name of the work, parts done, parts in all, time left [s]).
    """
    token = _listener.set(_ProgressListener(callback))
    try:
        yield
    finally:
        _listener.reset(token)


def track(parts: Collection[_T], name: str) -> Generator[_T]:
    """Go through parts of some work, and tell how many are done; loops inside keep silent.

    Args:
        parts: Parts of the work.
        name: Name of the part in progress, for people.
    """
    listener = _listener.get()
    if listener is None or listener.busy:
        yield from parts
        return
    listener.busy, begin = True, time.monotonic()
    try:
        for done, part in enumerate(parts, 1):
            yield part
            left = (time.monotonic() - begin) / done * (len(parts) - done)
            listener.callback(name, done, len(parts), left)
    finally:
        listener.busy = False


def format_duration(seconds: float) -> str:
    """A time as people say it.

    Args:
        seconds: The time [s].
    """
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
