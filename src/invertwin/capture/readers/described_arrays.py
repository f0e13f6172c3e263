"""Samples in NumPy, HDF5 or MATLAB files, described by a small TOML file beside them."""

import io
import tomllib
import warnings
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
import tomli_w
import torch

from invertwin.capture.chirps import CHIRP_DIMS, ChirpData, ChirpSettings
from invertwin.checks import check_choice, checked_tensor
from invertwin.constants import FRAME, OLD_AXES
from invertwin.errors import InputError, PhysicsWarning
from invertwin.radar.boards import Mounting, TxRxArrays
from invertwin.refusals import refusal, refusal_text
from invertwin.runtime.memory import require_memory
from invertwin.scene.antenna import AntennaArray
from invertwin.storage import untrusted
from invertwin.storage.folders import replace_file, write_text_file
from invertwin.storage.isolated_reader import read_isolated

# The data tell these settings by their shape and kind.
_KNOWN_FROM_DATA = {"samples", "loops", "frames", "real", "swap_iq", "lanes"}
_KEYS = {
    "data": {"file", "variable", "dimensions", "conjugate"},
    "settings": {field.name for field in fields(ChirpSettings)} - _KNOWN_FROM_DATA,
    "radar": {"board", "elevation", "azimuth", "tx_positions", "rx_positions"},
}
_PLACES = {"positions", "look_at", "tx_positions", "rx_positions", "range_center"}
_POWER_SKEWNESS = 1.5  # of squares of normal numbers 2 to 2.8; of samples about 0
_SUFFIXES = (".npy", ".npz", ".h5", ".hdf5", ".mat")


@untrusted.safe_reader("a description of samples")
def load_described_board(
    path: str | Path,
    board: str | None = None,
    elevation: int | None = None,
    azimuth: int | None = None,
) -> Mounting | TxRxArrays:
    """The elements that recorded described samples: a board as it is mounted, or TX and RX.

    The description's ``[radar]`` says it: ``board``, ``elevation`` and ``azimuth`` of a preset, or
    ``tx_positions`` and ``rx_positions`` [m], along the axes that `read_chirps` explains.

    Args:
        path: the TOML file.
        board: name of a preset; None = as described.
        elevation: sign of the preset's rows along z, as in `Board.arrays`; None = as described.
        azimuth: sign of its columns along y; None = as described.

    Raises:
        InputError: neither the arguments nor the description say which.
    """
    description, axes = _load_chirp_description(Path(path))
    described = description.get("radar", {})
    if board is None:
        board, tx, rx = (described.get(key) for key in ("board", "tx_positions", "rx_positions"))
        if (board is None) == (tx is None or rx is None):
            raise refusal("described_arrays.board", path, "neither" if board is None else "both")
        if board is None:
            return element_array(tx, "TX", axes), element_array(rx, "RX", axes)
    elevation = described.get("elevation") if elevation is None else elevation
    return Mounting(board, elevation, described.get("azimuth", 1) if azimuth is None else azimuth)


@untrusted.safe_reader("samples as their description says")
def read_chirps(path: str | Path, *, trusted: bool = False) -> ChirpData:
    """Read every chirp of described samples.

    The description, in SI units::

        frame = 2                 # x forward, y left, z up; without it x left, y up, z ahead

        [data]
        file = "adc.npy"          # or .npz, .h5, .hdf5, .mat, beside the description
        variable = "adc"          # its name in all but .npy
        dimensions = ["frame", "chirp", "tx", "rx", "sample"]   # those it has, in its order
        conjugate = false         # true where ranges come out at negative frequencies

        [settings]                # as in ChirpSettings; the sizes are those of the data
        start_frequency = 77e9
        slope = 60e12
        sample_rate = 5e6

    Dimensions that are left out have one element, ``virtual`` stands for tx and rx (tx-major), and
    ``iq`` is one of two numbers, I and Q.
    Files of MATLAB 7.3 are read in the order of dimensions that MATLAB shows. Transmitters and
    receivers are numbered from 1 unless ``transmit_order`` and ``receivers`` say otherwise; the
    dimension tx is in the order of sending.

    A damaged file can hang or crash the libraries that read HDF5 and MATLAB files. So a child
    process tries them first, within limits of time and memory; that takes about a second.

    Args:
        path: the description.
        trusted: read the data in this process, not in a child process.

    Raises:
        InputError: no file, a damaged one, unknown or missing keys, or dimensions that do not fit.
    """
    path = Path(path)
    description, _ = _load_chirp_description(path)
    data, given = description["data"], description["settings"]
    file = untrusted.named_file(path, str(data["file"]))
    array = load_array(file, data.get("variable"), trusted=trusted)
    order = data.get("dimensions", list(CHIRP_DIMS))
    real = array.dtype.kind != "c" and "iq" not in order
    if real and _are_powers(array):
        raise refusal("described_arrays.powers", path.name)
    samples = arrange_dimensions(array, order, len(given.get("transmit_order", [])) or None)
    if data.get("conjugate", False):
        samples = samples.conj()
    _, loops, tx, rx, count = samples.shape
    values: dict[str, Any] = {
        **given,
        "transmit_order": tuple(given.get("transmit_order", range(1, tx + 1))),
        "receivers": tuple(given.get("receivers", range(1, rx + 1))),
    }
    values |= {"samples": count, "loops": loops, "frames": len(samples), "real": real}
    try:
        settings = ChirpSettings(**values)
    except TypeError as error:
        raise refusal("described_arrays.settings", path.name, error) from error
    found = ChirpData(torch.from_numpy(samples), settings)
    if array.dtype.kind in "iu" or "bits" in given:
        found.warn_if_saturated()
    return found


def _are_powers(array: np.ndarray) -> bool:
    """Return True for numbers from zero up, most of them far below their mean, unlike samples."""
    values = array.ravel()[:: max(1, array.size // 2**16)].astype(np.float64)
    deviation = values - values.mean()
    spread = float(np.mean(deviation**2))
    return bool(values.min() >= 0 and np.mean(deviation**3) > _POWER_SKEWNESS * spread**1.5 > 0)


def write_chirps(
    path: str | Path, data: ChirpData, file: str, arrays: TxRxArrays | None = None
) -> None:
    """Write samples, bit for bit, and the description that `read_chirps` reads.

    Args:
        path: the TOML file.
        data: data to write; real samples are written as real numbers.
        file: name of the data file beside it; its ending says the format: .npy, .npz, .h5, .hdf5
            or .mat (MATLAB 5).
        arrays: TX and RX elements, written as positions; their patterns are not.

    Raises:
        InputError: the folder does not exist, or another ending.
    """
    path = Path(path)
    target = path.parent / file
    if target.suffix not in _SUFFIXES or target.parent != path.parent:
        raise refusal("described_arrays.ending", ", ".join(_SUFFIXES), file)
    s = data.settings
    samples = data.samples.detach().cpu().resolve_conj().numpy()
    array = np.ascontiguousarray(np.real(samples)) if s.real else samples
    with replace_file(target) as part:
        if target.suffix == ".npy":
            np.save(part, array)
        elif target.suffix == ".npz":
            np.savez(part, adc=array)
        elif target.suffix == ".mat":
            scipy.io.savemat(part, {"adc": array})
        else:
            # In memory first: on a full disk libhdf5 fails again, and crashes, at the end.
            with h5py.File(written := io.BytesIO(), "w") as opened:
                opened["adc"] = array
            part.write_bytes(written.getbuffer())
    named = {} if target.suffix == ".npy" else {"variable": "adc"}
    settings = {name: getattr(s, name) for name in sorted(_KEYS["settings"])}
    description: dict[str, Any] = {
        "frame": FRAME,
        "data": {"file": file, **named, "dimensions": CHIRP_DIMS},
        "settings": {name: value for name, value in settings.items() if value not in (None, ())},
    }
    if arrays is not None:
        tx, rx = (array.positions.tolist() for array in arrays)
        description["radar"] = {"tx_positions": tx, "rx_positions": rx}
    write_text_file(path, tomli_w.dumps(description))


def element_array(positions: Any, name: str, axes: list[int]) -> AntennaArray:
    """Elements that a description lists.

    Args:
        positions: positions of the elements [m].
        name: name of the array, for the error.
        axes: axes of the description, see `load_description`.

    Raises:
        InputError: no points.
    """
    do = "give one [x, y, z] in metres per element in [radar]"
    return AntennaArray(checked_tensor(positions, (None, 3), f"{name} positions", do)[:, axes])


def _load_chirp_description(path: Path) -> tuple[dict[str, dict[str, Any]], list[int]]:
    description, axes = load_description(path, _KEYS)
    if "file" not in description.get("data", {}) or "settings" not in description:
        raise refusal("described_arrays.sections", path.name)
    return description, axes


def load_description(
    path: Path, keys: Mapping[str, set[str]]
) -> tuple[dict[str, dict[str, Any]], list[int]]:
    """The sections of a description, and where x forward, y left, z up are among its axes.

    Those are its axes if it says ``frame = 2`` above its sections. One that does not is old: its
    axes are x left, y up, z ahead. Where it states places, a `PhysicsWarning` says so.

    Args:
        path: the TOML file.
        keys: those that each section may have.

    Raises:
        InputError: no such file, no TOML, or another frame, other sections or keys.
    """
    text = untrusted.read_text(path, "a TOML description")
    do = "give the description of the data, not the data"
    with untrusted.convert_read_errors(path, "TOML", do):
        description = tomllib.loads(text)
    frame = description.pop("frame", None)
    if frame not in (None, FRAME):
        raise refusal("described_arrays.frame", FRAME, path.name, frame)
    for section, given in description.items():
        known = keys.get(section)
        if known is None or not isinstance(given, dict) or not set(given) <= known:
            others = sorted(set(given) - known) if known and isinstance(given, dict) else given
            wrong = f"[{section}]" if known is None else f"{others!r} in [{section}]"
            names = sorted(known or keys)
            raise refusal("described_arrays.keys", ", ".join(keys), path.name, wrong, names)
    if frame is not None:
        return description, [0, 1, 2]
    places = ", ".join(sorted(_PLACES.intersection(description.get("radar", {}))))
    if places:
        text = refusal_text("described_arrays.old_frame", places, path.name, FRAME)
        warnings.warn(text, PhysicsWarning, stacklevel=2)
    return description, list(OLD_AXES)


def load_array(path: Path, variable: str | None, *, trusted: bool) -> np.ndarray:
    """Numbers of a data file.

    Args:
        path: .npy, .npz, .h5, .hdf5 or .mat.
        variable: its name in all but .npy; fields of a structure of MATLAB have dots in it.
        trusted: read it in this process, not in a child process.

    Raises:
        InputError: no such file or variable, a damaged file, or something else than numbers.
    """
    untrusted.existing_file(path, "the data file that [data] names")
    ending = path.suffix.lower()
    check_choice(ending, _SUFFIXES, "a file that ends in", f"convert {path.name}")
    require_memory(3.0 * path.stat().st_size, f"the samples of {path.name}", "split the file")
    if ending != ".npy" and variable is None:
        raise InputError(f"expected a variable in {path.name}, got none; add it to [data]")
    with untrusted.convert_read_errors(path, f"a whole {ending} file"):
        try:
            array = _load_file(path, ending, variable, trusted=trusted)
        except KeyError:
            raise refusal("described_arrays.variable", variable, path.name) from None
    if array.dtype.names is not None and len(array.dtype.names) == 2:
        # Complex numbers as MATLAB 7.3 stores them: pairs named real and imag; others r, i or I, Q.
        one, other = array.dtype.names
        names = (other, one) if f"{one[:1]}{other[:1]}".lower() in ("ir", "qi") else (one, other)
        pairs = np.stack([array[name] for name in names], axis=-1)
        wide = pairs.dtype.itemsize > 4
        array = pairs.astype("f8" if wide else "f4").view("c16" if wide else "c8")[..., 0]
    if array.dtype.kind not in "iufc":
        raise refusal("described_arrays.numbers", path.name, array.dtype)
    if untrusted.numbers_expand(array.size, path):
        what = f"{array.size:.3g} numbers in a file of {path.stat().st_size} bytes"
        raise InputError(f"expected recorded samples in {path.name}, got {what}; copy it again")
    return array


def _load_file(path: Path, suffix: str, variable: str | None, *, trusted: bool) -> np.ndarray:
    if suffix == ".npy":
        return untrusted.read_npy(path)
    name = str(variable)
    if suffix == ".npz":
        return untrusted.read_arrays(path, "it is damaged or of another kind", [name])[name]
    kind = "matlab" if suffix == ".mat" else "hdf5"
    return read_isolated(path, kind, name, trusted=trusted).arrays[name].values


def arrange_dimensions(array: np.ndarray, order: Any, transmitters: int | None) -> np.ndarray:
    """Complex (frame, chirp, tx, rx, sample).

    Args:
        array: samples.
        order: names of its dimensions, as `read_chirps` explains them.
        transmitters: their number, where it is known.

    Raises:
        InputError: names that do not fit.
    """
    allowed = sorted({*CHIRP_DIMS, "virtual", "iq"})
    valid = isinstance(order, list) and set(order) <= set(allowed) and len(set(order)) == len(order)
    both = valid and "virtual" in order and {"tx", "rx"} & set(order)
    if not valid or both or "sample" not in order or len(order) != array.ndim:
        raise refusal("described_arrays.dimensions", array.ndim, allowed, order, array.shape)
    if "iq" in order:
        parts = np.moveaxis(array, order.index("iq"), 0)
        if len(parts) != 2 or array.dtype.kind == "c":
            raise refusal("described_arrays.iq", array.dtype, array.shape)
        array = parts[0] + np.array(1j, np.result_type(array.dtype, np.complex64)) * parts[1]
        order = [name for name in order if name != "iq"]
    if "virtual" in order:
        axis = order.index("virtual")
        size = array.shape[axis]
        if transmitters is None or size % transmitters:
            raise refusal("described_arrays.virtual", size, transmitters or "none")
        shape = (*array.shape[:axis], transmitters, size // transmitters, *array.shape[axis + 1 :])
        array = array.reshape(shape)
        order = [*order[:axis], "tx", "rx", *order[axis + 1 :]]
    missing = tuple(axis for axis, name in enumerate(CHIRP_DIMS) if name not in order)
    array = array.transpose([order.index(name) for name in CHIRP_DIMS if name in order])
    double = array.dtype.itemsize > (8 if array.dtype.kind == "c" else 4)
    kind = np.complex128 if double or array.dtype == np.int32 else np.complex64
    return np.ascontiguousarray(np.expand_dims(array, missing), dtype=kind)
