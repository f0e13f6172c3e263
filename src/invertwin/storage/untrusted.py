"""Untrusted files: a context of all readers that turns any failure into an error of one line.

A file that can hang or crash its reader is read by a child process: `isolated_reader.py`.
"""

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import wraps
from os.path import realpath  # Path.resolve raises for links in a circle
from pathlib import Path
from traceback import walk_tb
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar
from zipfile import ZipFile

from invertwin.errors import InputError

if TYPE_CHECKING:  # the command line starts without NumPy
    import numpy as np

_P = ParamSpec("_P")
_R = TypeVar("_R")
# Bytes of a file or an array, and over those that it takes on disk: more is a bomb.
_MAX_EXPANDED, _MAX_EXPANSION = 2**28, 100
_MAX_TEXT = 2**28  # bytes
_PLAIN = (str, bytes, bytearray, int, float, complex, list, tuple, set, dict, type(None))
_PLAIN_MODULES = ("decimal", "datetime", "numpy", "torch")
_OWN_FAULTS = (NameError, AttributeError, ImportError, NotImplementedError, AssertionError)
_DAMAGED_ADVICE = "it is damaged or of another kind; copy or export it again"


@contextmanager
def convert_read_errors(
    path: str | Path, expected: str, do: str = _DAMAGED_ADVICE
) -> Iterator[None]:
    """Tell whatever a reader raises as an InputError of one line; warnings stay warnings.

    A name that our own lines miss is no fault of the file: it passes as it is.

    Args:
        path: The file.
        expected: Noun for the expected content, such as "a readable .ply mesh".
        do: Remedy.

    Raises:
        InputError: The reader has raised something.
    """
    try:
        yield
    except (InputError, Warning):
        raise
    # A damaged file can make readers fail in any way; every one means the same to the user.
    except Exception as error:
        if _is_own_fault(error):
            raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"expected {expected}, got {path} ({reason}); {do}") from None


def _is_own_fault(error: Exception) -> bool:
    """Return True for what a line of this package itself raises, and no content can cause."""
    value = getattr(error, "obj", error)  # of a file, and of another kind than it should be
    plain = isinstance(value, _PLAIN) or type(value).__module__ in _PLAIN_MODULES
    if plain or not isinstance(error, _OWN_FAULTS):
        return False
    *_, (frame, _) = walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).partition(".")[0] == __name__.partition(".")[0]


def safe_reader(
    expected: str, do: str = _DAMAGED_ADVICE
) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]:
    """Decorate a function that reads the file it is given first: all of it is
    `convert_read_errors`.

    Args:
        expected: Noun for the expected content.
        do: Remedy.
    """

    def decorate(function: Callable[_P, _R]) -> Callable[_P, _R]:
        @wraps(function)
        def read(*args: _P.args, **kwargs: _P.kwargs) -> _R:
            path: Any = args[0] if args else next(iter(kwargs.values()))
            with convert_read_errors(path, expected, do):
                return function(*args, **kwargs)

        return read

    return decorate


def existing_file(path: str | Path, what: str = "an existing file") -> Path:
    """Check that a file exists, and return its path.

    Args:
        path: The file.
        what: Noun for the expected content, for the error.

    Raises:
        InputError: No such file, a name that cannot be one, an empty file, or one of holes.
    """
    file = Path(path)
    try:
        known = file.stat()
    except (OSError, ValueError):  # also of a name that is too long
        raise InputError(
            f"expected {what}, got no file {str(file)[:300]}; check the path"
        ) from None
    if not file.is_file() or not known.st_size:  # as those of /proc, which can block their reader
        other = "a folder" if file.is_dir() else "a pipe or a device"
        kind = "an empty file" if file.is_file() else other
        raise InputError(f"expected {what}, got {kind}, {file}; name a file with data")
    if expands(known.st_size, 512 * getattr(known, "st_blocks", known.st_size)):
        raise InputError(
            f"expected {what}, got {file}, {known.st_size / 1e9:.2g} GB of holes; copy it again"
        )
    return file


def named_file(path: str | Path, name: str) -> Path:
    """The file that another file names: it lies in its folder or below, also where links lead.

    Args:
        path: The other file.
        name: The name in it.

    Raises:
        InputError: It lies elsewhere.
    """
    file = Path(path).parent / name
    if not Path(realpath(file)).is_relative_to(realpath(Path(path).parent)):
        raise InputError(
            f"expected names of files in the folder of {path}, got {name[:100]!r}, which is "
            "elsewhere; copy it there"
        )
    return file


def expands(size: int, stored: int) -> bool:
    """Return True if data of a small file need far more memory than the file has bytes.

    Args:
        size: Bytes that the data take in memory.
        stored: Bytes of the file.
    """
    return size > max(_MAX_EXPANDED, _MAX_EXPANSION * stored)


def numbers_expand(count: int, path: str | Path) -> bool:
    """Return True if numbers, none wider than a complex one, need far more memory than their file.

    Args:
        count: Number of them in the file.
        path: The file.
    """
    return expands(16 * count, Path(path).stat().st_size)


def read_text(path: str | Path, what: str) -> str:
    """A file as text, without a byte-order mark.

    Numbers and keywords of settings are ASCII; what is no UTF-8 stands in comments, as Windows
    tools write them.

    Args:
        path: The file.
        what: Noun for the expected content, for the error.

    Raises:
        InputError: No such file, or one that is no text.
    """
    file = existing_file(path, what)
    with convert_read_errors(file, what, "it is no text; name the settings, not the data"):
        if file.stat().st_size > _MAX_TEXT:
            raise ValueError("more than 256 MB")
        content = file.read_bytes()
        # As PowerShell writes what it redirects: every second byte of Latin letters is zero.
        if content[:2] in (b"\xff\xfe", b"\xfe\xff") and content.count(0) > len(content) / 3:
            return content.decode("utf-16")
        if b"\0" in content:
            raise ValueError("zero bytes")
        try:
            return content.decode("utf-8-sig")
        except UnicodeDecodeError:
            # Not Latin-1: its letter 0x85 would end a line.
            return content.decode("cp1252", errors="replace")


def read_npy(path: str | Path) -> "np.ndarray":
    """The array of an ``.npy`` file.

    Args:
        path: The file.

    Raises:
        InputError: No such file, a damaged one, or pickled objects.
    """
    file = existing_file(path, "a NumPy file")
    # Opened here: numpy leaves a damaged file open.
    with (
        convert_read_errors(file, "plain numbers in a NumPy file (.npy)"),
        file.open("rb") as opened,
    ):
        return _load_numbers(opened, file.stat().st_size)


def read_arrays(
    path: str | Path, do: str, names: Collection[str] | None = None
) -> "dict[str, np.ndarray]":
    """Read the arrays of an ``.npz`` file by name. Wanted arrays that are missing are left out.

    Args:
        path: The file.
        do: Remedy where it cannot be read, for the message.
        names: Names; None = all.

    Raises:
        InputError: No such file, a damaged one, or pickled objects.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(f"expected {file.name} in {file.parent}, got no such file; {do}")
    found = {}
    with convert_read_errors(file, "plain arrays in an .npz file", do), ZipFile(file) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if names is None or name in names:
                if expands(entry.file_size, entry.compress_size):
                    raise ValueError(f"{entry.file_size / 1e9:.2g} GB in {name} of a small file")
                with archive.open(entry) as opened:
                    found[name] = _load_numbers(opened, entry.file_size)
    return found


def _load_numbers(opened: Any, size: int) -> "np.ndarray":
    """Load an array whose header asks for no more memory than the file has numbers."""
    from math import prod

    import numpy as np
    from numpy.lib import format as npy

    version = npy.read_magic(opened)
    header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, kind = header(opened)
    if kind.hasobject:
        raise ValueError("pickled objects")
    if prod(shape) * kind.itemsize > size:
        raise ValueError(f"a header that says {shape} numbers of {kind}, more than the file holds")
    opened.seek(0)
    held = np.load(opened, allow_pickle=False)
    # torch takes numbers in this machine's order of bytes only.
    return held.astype(held.dtype.newbyteorder("="), copy=False)
