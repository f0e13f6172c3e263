"""Files from strangers: every reader works in here, and what it cannot read is one line.

Some libraries read a damaged file for ever, or end the whole process: one wrong byte is enough in
HDF5, NetCDF and MATLAB files. So these are read by a child process first, within limits of time
and memory, unless the user trusts them.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar
from zipfile import ZipFile

from invertwin.errors import InputError

if TYPE_CHECKING:  # the command line starts without NumPy
    import numpy as np

_P = ParamSpec("_P")
_R = TypeVar("_R")
_DAMAGED = "it is damaged or of another kind; copy or export it again"
_SECONDS, _BYTES_PER_SECOND = 8.0, 10e6  # of processor time, that of importing a reader with it
_WAITING = 10.0  # times as long on a busy machine
_MEMORY = 2 << 30  # beside four times the size of the file
_READERS = {
    "netcdf": "import xarray; xarray.load_dataset(path, engine='h5netcdf', decode_cf=False)",
    "hdf5": "import h5py; h5py.File(path)[variable][()]",
    "matlab": "import scipy.io; scipy.io.loadmat(path, variable_names=[variable])",
}
_LARGE = 77  # exit code of the child
_SLOW = -getattr(signal, "SIGXCPU", 0) or 78
# An error of a reader is told by it again where the result is wanted.
_CHILD = """
import sys
path, variable, memory, seconds = sys.argv[1:]
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 1))
except ImportError:
    pass
try:
    {reader}
except MemoryError:
    sys.exit(77)
except Exception:
    pass
"""


@contextmanager
def reading(path: str | Path, expected: str, do: str = _DAMAGED) -> Iterator[None]:
    """Tell whatever a reader raises as an InputError of one line; warnings stay warnings.

    Args:
        path: The file.
        expected: What it should be, such as "a readable .ply mesh".
        do: What the user can do.

    Raises:
        InputError: The reader has raised something.
    """
    try:
        yield
    except (InputError, Warning):
        raise
    # A damaged file can make readers fail in any way; every one means the same to the user.
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"expected {expected}, got {path} ({reason}); {do}") from None


def reader(expected: str, do: str = _DAMAGED) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]:
    """Decorate a function that reads the file it is given first: all of it is `reading`.

    Args:
        expected: What the file should be.
        do: What the user can do.
    """

    def decorate(function: Callable[_P, _R]) -> Callable[_P, _R]:
        @wraps(function)
        def read(*args: _P.args, **kwargs: _P.kwargs) -> _R:
            path: Any = args[0] if args else next(iter(kwargs.values()))
            with reading(path, expected, do):
                return function(*args, **kwargs)

        return read

    return decorate


def existing_file(path: str | Path, what: str = "an existing file") -> Path:
    """Check that a file exists, and return its path.

    Args:
        path: The file.
        what: What it should be, for the error.

    Raises:
        InputError: No such file, or a name that cannot be one.
    """
    file = Path(path)
    try:
        found = file.is_file()
    except OSError:  # a name that is too long
        found = False
    if not found:
        raise InputError(f"expected {what}, got no file {str(file)[:300]}; check the path")
    return file


def read_text(path: str | Path, what: str) -> str:
    """A file as text, without a byte-order mark.

    Args:
        path: The file.
        what: What it should be, for the error.

    Raises:
        InputError: No such file, or one that is no text.
    """
    file = existing_file(path, what)
    with reading(file, what, "it is no text; name the settings, not the data"):
        return file.read_text(encoding="utf-8-sig")


def read_npy(path: str | Path) -> "np.ndarray":
    """The array of an ``.npy`` file.

    Args:
        path: The file.

    Raises:
        InputError: No such file, a damaged one, or pickled objects.
    """
    import numpy as np

    file = existing_file(path, "a NumPy file")
    # Opened here: numpy leaves a damaged file open.
    with reading(file, "plain numbers in a NumPy file (.npy)"), file.open("rb") as opened:
        _check_header(opened, file.stat().st_size)
        return np.load(opened, allow_pickle=False)


def read_arrays(
    path: str | Path, do: str, wanted: Collection[str] | None = None
) -> "dict[str, np.ndarray]":
    """Read the arrays of an ``.npz`` file by name. Wanted arrays that are missing are left out.

    Args:
        path: The file.
        do: What the user can do where it cannot be read, for the message.
        wanted: Names; None = all.

    Raises:
        InputError: No such file, a damaged one, or pickled objects.
    """
    import numpy as np

    file = Path(path)
    if not file.is_file():
        raise InputError(f"expected {file.name} in {file.parent}, got no such file; {do}")
    found = {}
    with reading(file, "plain arrays in an .npz file", do), ZipFile(file) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if wanted is None or name in wanted:
                with archive.open(entry) as opened:
                    _check_header(opened, entry.file_size)
                    found[name] = np.load(opened, allow_pickle=False)
    return found


def _check_header(opened: Any, size: int) -> None:
    """Raise ValueError where a header of NumPy asks for more memory than the file has numbers."""
    from math import prod

    from numpy.lib import format as npy

    version = npy.read_magic(opened)
    header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, kind = header(opened)
    if kind.hasobject:
        raise ValueError("pickled objects")
    if prod(shape) * kind.itemsize > size:
        raise ValueError(f"a header that says {shape} numbers of {kind}, more than the file holds")
    opened.seek(0)


def try_apart(
    path: Path, kind: Literal["netcdf", "hdf5", "matlab"], variable: str | None = None
) -> None:
    """Let a child process read a file first: one that hangs or crashes it is refused.

    What the reader raises is no matter here: it raises it again when the file is read.

    Args:
        path: The file.
        kind: Who reads it.
        variable: Which is read; NetCDF files are read as a whole.

    Raises:
        InputError: The reader did not end in time, crashed, or asked for too much memory.
    """
    size = path.stat().st_size
    seconds, memory = _SECONDS + size / _BYTES_PER_SECOND, _MEMORY + 4 * size
    script = _CHILD.format(reader=_READERS[kind])
    limits = [str(memory), str(int(seconds))]
    call = [sys.executable, "-c", script, os.fspath(path), variable or "", *limits]
    try:
        code = subprocess.run(call, capture_output=True, timeout=_WAITING * seconds).returncode
    except subprocess.TimeoutExpired:
        code = _SLOW
    if not code:
        return
    if code == _SLOW:
        what = f"one that takes its reader more than {seconds:.0f} s"
    elif code == _LARGE:
        what = f"one that asks for more than {memory / 1e9:.1f} GB"
    else:
        what = f"one that crashes its reader ({signal.Signals(-code).name if code < 0 else code})"
    raise InputError(
        f"expected a whole {kind} file, got {path}, {what}; it is damaged: copy or record it "
        "again. If you trust it, say trusted = True"
    )
