"""Files that can hang or crash their reader are read by a child process.

One wrong byte makes libraries of HDF5, NetCDF and MATLAB files read for ever or end the process.
So a child process reads them within limits of time and memory and hands over plain arrays. Only
files that the user trusts are read in this process.
"""

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from invertwin.errors import InputError
from invertwin.storage.untrusted import numbers_expand

if TYPE_CHECKING:  # a child process starts without what it does not need
    import numpy as np

_SECONDS, _BYTES_PER_SECOND = 8.0, 10e6  # of processor time, that of importing a reader with it
_TIMEOUT_FACTOR = 10.0  # times as long on a busy machine
_MEMORY = 2 << 30  # beside four times the size of the file
_TOO_LARGE, _REFUSED, _MISSING = 77, 76, 75  # exit codes of the child
_TIMED_OUT = -getattr(signal, "SIGXCPU", 0) or 78
_NAMES = {"netcdf": "NetCDF", "hdf5": "HDF5", "matlab": "MATLAB"}
_CHILD = (
    "import sys; from invertwin.storage.isolated_reader import run_child_reader; "
    "run_child_reader(*sys.argv[1:])"
)


class StoredArray(NamedTuple):
    """An array as a file holds it.

    Attributes:
        dimensions: Their names; none where the format has none.
        values: Numbers or text, never objects.
        attributes: Numbers, text and arrays of them by name.
    """

    dimensions: tuple[str, ...]
    values: "np.ndarray"
    attributes: dict[str, Any]


class StoredArrays(NamedTuple):
    """Arrays and attributes of a file.

    Attributes:
        arrays: Arrays by name.
        attributes: Attributes of the file.
    """

    arrays: dict[str, StoredArray]
    attributes: dict[str, Any]


def read_isolated(
    path: Path,
    kind: Literal["netcdf", "hdf5", "matlab"],
    variable: str = "",
    *,
    trusted: bool = False,
) -> StoredArrays:
    """Read a file of HDF5, NetCDF or MATLAB by a child process.

    Args:
        path: The file.
        kind: Expected format. Files of MATLAB 7.3 are HDF5 inside.
        variable: Variable to read; NetCDF files are read as a whole.
        trusted: Read it in this process, which is faster by about a second.

    Raises:
        InputError: The reader did not end in time, crashed, asked for too much memory, or
            refused the file.
        KeyError: No such variable.
    """
    if trusted:
        return _READERS[kind](os.fspath(path), variable)
    size = path.stat().st_size
    seconds, memory = _SECONDS + size / _BYTES_PER_SECOND, _MEMORY + 4 * size
    # -P: the reader's libraries are those of this process, not what lies in the folder.
    call = [sys.executable, "-P", "-c", _CHILD, kind, os.fspath(path), variable]
    call += [str(memory), str(int(seconds))]
    known = os.environ | {"PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    try:
        limit = _TIMEOUT_FACTOR * seconds
        ended = subprocess.run(call, capture_output=True, timeout=limit, env=known)
        code, said = ended.returncode, ended.stdout
    except subprocess.TimeoutExpired:
        code, said = _TIMED_OUT, b""
    if not code:
        return _unpack_arrays(said)
    if code == _MISSING:
        raise KeyError(variable)
    causes = {
        _TIMED_OUT: f"one that takes its reader more than {seconds:.0f} s",
        _TOO_LARGE: f"one that asks for more than {memory / 1e9:.1f} GB",
        _REFUSED: f"one that its reader refuses ({said.decode(errors='replace').strip()})",
    }
    crash = f"one that crashes its reader ({signal.Signals(-code).name if code < 0 else code})"
    raise InputError(
        f"expected a whole {_NAMES[kind]} file, got {path}, {causes.get(code, crash)}; it is "
        "damaged or of another kind: copy or record it again. If you trust it, say trusted = True"
    )


def run_child_reader(kind: str, path: str, variable: str, memory: str, seconds: str) -> None:
    """Read a file within limits in the child process, and write its arrays.

    Args:
        kind: Kind of the file.
        path: The file.
        variable: Variable to read.
        memory: Address space [bytes].
        seconds: Processor time [s].
    """
    with suppress(ImportError):  # Windows has no such limits; the parent limits the time
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 1))
    # What libraries print must not be among the arrays.
    with os.fdopen(os.dup(1), "wb") as handed:
        os.dup2(2, 1)
        try:
            import h5py
            import numpy as np

            if h5py.is_hdf5(path):
                with h5py.File(path) as opened:
                    outside = opened.visititems_links(partial(_name_stored_elsewhere, opened))
                if outside is not None:
                    raise ValueError(f"{outside} is stored in another file")
            np.savez(handed, *_pack_arrays(_READERS[kind](path, variable)))
        except MemoryError:
            sys.exit(_TOO_LARGE)
        # Whatever a library raises for a damaged file, the parent tells it in one line.
        except Exception as error:
            if isinstance(error, KeyError) and error.args == (variable,):
                sys.exit(_MISSING)
            handed.write(ascii(f"{type(error).__name__}: {error}"[:200])[1:-1].encode())
            sys.exit(_REFUSED)


def _name_stored_elsewhere(opened: Any, name: str, link: Any) -> str | None:
    """Return the name of a link to another file, or of numbers that lie in others."""
    import h5py

    found = opened[name] if isinstance(link, h5py.HardLink) else None
    outside = isinstance(found, h5py.Dataset) and (found.external or found.is_virtual)
    return name if outside or not isinstance(link, h5py.HardLink | h5py.SoftLink) else None


def _netcdf(path: str, _variable: str) -> StoredArrays:
    import h5py
    import xarray

    # Where this fails, h5netcdf breaks off half made, and complains when it is thrown away.
    with h5py.File(path) as file:
        file.attrs.get("_nc3_strict")
        file.visititems(partial(_check_size, path))
    # Nothing is decoded: seconds stay numbers, and every bit stays what it was.
    whole = xarray.load_dataset(path, engine="h5netcdf", decode_cf=False)
    arrays = {
        str(name): StoredArray(tuple(map(str, array.dims)), array.values, dict(array.attrs))
        for name, array in whole.variables.items()
    }
    return StoredArrays(arrays, dict(whole.attrs))


def _hdf5(path: str, location: str, name: str = "") -> StoredArrays:
    import h5py
    import numpy as np

    name = name or location
    with h5py.File(path, "r") as opened:
        if location not in opened:
            raise KeyError(name)
        _check_size(path, location, opened[location])
        return StoredArrays({name: StoredArray((), np.asarray(opened[location]), {})}, {})


def _check_size(path: str, name: str, held: Any) -> None:
    """Raise ValueError for many more numbers than a file of HDF5 has bytes."""
    count = getattr(held, "size", 0) or 0
    if numbers_expand(count, path):
        raise ValueError(f"{count:.3g} numbers in {name} of a small file")


def _matlab(path: str, variable: str) -> StoredArrays:
    import h5py
    import numpy as np
    import scipy.io

    root, *fields = variable.split(".")
    if h5py.is_hdf5(path):
        # MATLAB stores the first dimension fastest.
        array = _hdf5(path, "/".join([root, *fields]), variable).arrays[variable].values.T
    else:
        found = scipy.io.loadmat(path, variable_names=[root])
        if root not in found:
            raise KeyError(variable)
        array = np.asarray(found[root])
        for field in fields:
            if field not in (array.dtype.names or ()):
                raise KeyError(variable)
            array = np.asarray(array[field].item())  # a structure is an array of one record
    return StoredArrays({variable: StoredArray((), array, {})}, {})


_READERS: dict[str, Callable[[str, str], StoredArrays]] = {
    "netcdf": _netcdf,
    "hdf5": _hdf5,
    "matlab": _matlab,
}


def _pack_arrays(stored: StoredArrays) -> "list[np.ndarray]":
    """Plain arrays; the last is text that says whose values or attribute each other is."""
    import numpy as np

    labels: list[tuple[Any, ...]] = []  # name, dimensions, key of an attribute
    arrays: list[np.ndarray] = []

    def add_array(value: Any, *label: Any) -> None:
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise ValueError(f"{label[2] or label[0]} holds objects, not numbers or text")
        labels.append(label)
        arrays.append(array)

    for name, array in stored.arrays.items():
        add_array(array.values, name, array.dimensions, None)
        for key, value in array.attributes.items():
            add_array(value, name, (), key)
    for key, value in stored.attributes.items():
        add_array(value, None, (), key)
    return [*arrays, np.asarray(json.dumps(labels))]


def _unpack_arrays(content: bytes) -> StoredArrays:
    import numpy as np

    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        *packed, text = archive.values()
    found = StoredArrays({}, {})
    for value, (name, dimensions, key) in zip(packed, json.loads(text.item()), strict=True):
        if key is None:
            found.arrays[name] = StoredArray(tuple(dimensions), value, {})
            continue
        own = found.attributes if name is None else found.arrays[name].attributes
        # A number of NumPy stays one; text of NumPy is text.
        own[key] = value.item() if value.ndim == 0 and value.dtype.kind == "U" else value[()]
    return found
