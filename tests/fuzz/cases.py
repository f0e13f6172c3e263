"""One case: damaged files are read; what comes of it is success or an error of one line."""

import faulthandler
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzz.damage import SPECIAL, Files
from fuzz.formats import Format
from invertwin.errors import InputError

SECONDS, MEMORY = 20.0, 2 << 30  # of the processor
WAITS = 120.0  # on the clock: at a load of ten a case gets a fifth of a processor
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = frozenset(
    f"{module}.{name}"
    for module, names in {
        "os": "remove rename rmdir mkdir link symlink truncate chmod chown utime",
        "shutil": "rmtree copyfile move",
    }.items()
    for name in names.split()
)
_watched: Path | None = None  # the folder of the case under way
_outside: list[str] = []
_hooked = False


class _TooLong(BaseException):
    """Raised inside a case that takes too long; no reader catches it."""


@dataclass(frozen=True)
class Broken:
    """What a case did that it must not do.

    Attributes:
        what: One line.
        where: The innermost place in the library.
    """

    what: str
    where: str = ""


def outcome(form: Format, files: Files) -> tuple[Broken | None, float]:
    """Read damaged files in a folder of their own; what was wrong with that, and how long it took.

    Args:
        form: Who reads them.
        files: By name, first the one that is read.
    """
    with tempfile.TemporaryDirectory() as scratch:
        # Resolved: the watch compares paths.
        folder = Path(scratch).resolve() / "case"
        folder.mkdir()
        for name, data in files.items():
            _write(folder / name, data)
        before, begun = _most_memory(), time.process_time()
        found = _read(form, folder, folder / next(iter(files)))
        seconds, after = time.process_time() - begun, _most_memory()
        lost = [name for name in form.intact if not _same(folder / name, files.get(name))]
        left = sorted(path.name for path in folder.parent.iterdir())
    if found is None and seconds > SECONDS:
        found = Broken(f"took {seconds:.0f} s")
    if found is None and after - before > MEMORY:
        found = Broken(f"took {(after - before) / 1e9:.1f} GB")
    if found is None and (_outside or left != ["case"]):
        found = Broken(f"touched {_outside or left}")
    if found is None and lost:
        found = Broken(f"changed {lost}")
    return found, seconds


def _write(path: Path, data: bytes) -> None:
    """Write a file, or what the words of `damage.SPECIAL` stand for in place of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    match data:
        case b"a pipe":
            os.mkfifo(path)
        case b"a device":
            path.symlink_to("/dev/zero")
        case b"a folder":
            path.mkdir()
        case b"a loop":
            path.symlink_to(path.name)
        case b"holes":
            with path.open("wb") as file:
                file.truncate(8 << 30)
        case _:
            path.write_bytes(data)


def _read(form: Format, folder: Path, path: Path) -> Broken | None:
    try:
        with _watch(folder), _limited(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            form.read(path)
    except InputError as error:
        text = str(error)
        if not text.isprintable() or "expected" not in text or "got" not in text:
            return Broken(
                f"an InputError that is no plain line: {ascii(text)[:200]}", _place(error)
            )
    except _TooLong as error:
        return Broken(f"took more than {SECONDS:.0f} s", _place(error))
    # Whatever else it is, it is what is looked for.
    except BaseException as error:
        what = f"{type(error).__name__}: {error}"
        return Broken(ascii(what)[1:201], _place(error))
    return None


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/invertwin/" in frame.filename]
    frame = (ours or frames)[-1]
    return f"{Path(frame.filename).name}:{frame.lineno} in {frame.name}"


def _same(path: Path, data: bytes | None) -> bool:
    special = data is None or data in SPECIAL
    return special or (path.is_file() and path.read_bytes() == data)


def _most_memory() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@contextmanager
def _limited() -> Iterator[None]:
    """End what takes too long: by an exception where Python runs, else with the process.

    Both count processor seconds; what waits for ever, such as for a pipe, ends by the clock.
    """

    def stop(_signal: int, _frame: Any) -> None:
        raise _TooLong

    old = signal.signal(signal.SIGPROF, stop), signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, WAITS)
    faulthandler.dump_traceback_later(2 * WAITS, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGPROF, old[0])
        signal.signal(signal.SIGALRM, old[1])


@contextmanager
def _watch(folder: Path) -> Iterator[None]:
    """Note which files outside a folder are written, made, moved or removed."""
    global _watched, _hooked
    if not _hooked:
        sys.addaudithook(_audited)  # for good: Python cannot take it back
        _hooked = True
    _outside.clear()
    _watched = folder
    try:
        yield
    finally:
        _watched = None


def _audited(event: str, arguments: tuple[Any, ...]) -> None:
    folder = _watched
    if folder is None:
        return
    if event == "open":
        path, mode, flags = arguments
        writes = bool(flags & _WRITES) if isinstance(flags, int) else False
        writes = writes or (isinstance(mode, str) and bool({*mode} & {*"wax+"}))
        named = [path] if writes else []
    elif event in _CHANGES:
        made = arguments[1:2] if event == "os.symlink" else arguments[:2]
        named = [name for name in made if isinstance(name, str | bytes | os.PathLike)]
        named = named[:1] if event in ("os.symlink",) else named
    elif event in ("socket.connect", "socket.getaddrinfo", "os.system", "os.exec"):
        _outside.append(f"{event} {arguments[:2]}")
        return
    else:
        return
    for name in named:
        real = "" if isinstance(name, int) else os.path.realpath(os.fsdecode(name))
        if real not in ("", os.devnull) and not real.startswith(f"{folder}{os.sep}"):
            _outside.append(f"{event} {real}")
