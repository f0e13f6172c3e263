"""Damage to valid files: to their bytes, to their words, and to the values that they hold.

Hypothesis draws numbers; what they mean is fixed here, so that a case can be made again from them.
"""

import copy
import functools
import io
import json
import re
import sys
import tomllib
import zipfile
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from importlib.metadata import packages_distributions
from typing import Any

import h5py
import numpy as np
import scipy.io
import tomli_w
import torch
from hypothesis import strategies as st

Files = dict[str, bytes]
SOUND = "sound"
"""Name of an empty file beside damaged ones that the libraries of their formats wrote."""
SPECIAL = (b"a pipe", b"a device", b"a folder", b"a loop", b"holes")
"""In place of a file's bytes: something else than a file, or one that takes no disk."""
_WORD = re.compile(rb"[^\s,=:\[\]{}()<>]+")
_MOST = 1 << 20  # bytes of a damaged file
#: Of a value that is valid nearly everywhere, and of one that is valid hardly anywhere.
NUMBERS: tuple[Any, ...] = (
    *(0, -1, 1, 2, 3, 255, 65_536, 2**31 - 1, 2**31, 2**32, 2**63 - 1, 2**63, -(2**63), 10**30),
    *(0.0, -0.0, 0.5, -1.5, 1e-300, 1e-9, 1e9, 1e308, float("nan"), float("inf"), -float("inf")),
)
TEXTS: tuple[str, ...] = (
    *("", " ", "x", "nan", "-1", "1e999", "0x", "0xFFFFFFFFFF", "9" * 5_000, "a" * 5_000),
    *("\0", "a\0b", "\x1b[31m", "line\nline", "$\\frac$", "<script>", "{0}", "%s", "\u202e"),
    *("ü" * 300, ".", "..", "../victim", "link/victim", "/", "/dev/zero", "/etc/passwd", "~"),
    *("C:\\x.bin", "http://x.invalid/", "a" * 100_000, ".a" * 5_000, "ü\n" * 10_000),
)
OTHERS: tuple[Any, ...] = (None, True, False, [], {}, [[]], [None], {"": None}, [0] * 1_000)
HOSTILE = NUMBERS + TEXTS + OTHERS


@dataclass(frozen=True)
class Edit:
    """One change: of which kind, where, and what else it needs; all as plain numbers."""

    level: int
    kind: int
    place: int
    more: int


Edits = tuple[int, int, list[Edit]]
_NUMBER = st.integers(0, 2**32 - 1)
#: Number of a sample, number of its file, and what is done to that file.
EDITS: st.SearchStrategy[Edits] = st.tuples(
    _NUMBER,
    _NUMBER,
    st.lists(st.builds(Edit, _NUMBER, _NUMBER, _NUMBER, _NUMBER), min_size=1, max_size=4),
)


def damaged(samples: list[Files], edits: Edits, levels: tuple[str, ...]) -> Files:
    """One of the samples with a damaged file.

    Args:
        samples: Valid files by name.
        edits: What is done.
        levels: Of "bytes", "words", "values", "numbers", "special" and "planted": which kinds of
            damage are done.
    """
    files = dict(samples[edits[0] % len(samples)])
    # The first file is the one that is read: it gets half of the damage.
    names = [*files, *[next(iter(files))] * max(0, len(files) - 2)]
    name = names[edits[1] % len(names)]
    chosen = [levels[edit.level % len(levels)] for edit in edits[2]]
    for level, edit in zip(chosen, edits[2], strict=True):
        if level == "planted":
            files = {**files, **_planted(edit), **files}  # the first stays the first
        elif files[name] not in SPECIAL:  # nothing is done to what is no file
            files[name] = _LEVELS[level](name, files[name], edit)[:_MOST]
    return files | ({} if {"bytes", "special"} & {*chosen} else {SOUND: b""})


def _values(name: str, data: bytes, edit: Edit) -> bytes:
    """Change one value of a tree; formats without trees get another word."""
    suffix = name[name.rfind(".") :]
    if data.startswith(b"\x89HDF"):
        return _hdf5(data, edit)
    if suffix not in _TREES:
        return _words(name, data, edit)
    load, dump = _TREES[suffix]
    try:
        tree = load(data)
        _change(tree, edit)
        return dump(tree)
    # Not every hostile value can be written, nor every damaged file read again.
    except Exception:
        return data if suffix == ".mat" else _words(name, data, edit)


def _change(tree: Any, edit: Edit) -> None:
    """Replace, remove, copy, rename or wrap one value of nested dicts and lists."""
    places = [(box, key) for box in _boxes(tree) for key in _keys(box)]
    if not places:
        return
    box, key = places[edit.place % len(places)]
    value = box[key]
    match edit.kind % 8:
        case 0:
            del box[key]
        case 1:
            other, its = places[edit.more % len(places)]
            box[key] = copy.deepcopy(other[its])  # no value within itself
        case 2 if isinstance(box, list):
            box.extend([value] * (edit.more % 40))
        case 2 | 3 if isinstance(box, dict):
            box[TEXTS[edit.more % len(TEXTS)]] = box.pop(key)
        case 4:
            box[key] = [value] if edit.more % 2 else {"value": value}
        case 5 if isinstance(value, list) and value:
            box[key] = value[: edit.more % len(value)]
        case _:
            arrays = isinstance(value, np.ndarray | torch.Tensor) and edit.more % 4
            box[key] = _spoiled(value, edit.more) if arrays else HOSTILE[edit.more % len(HOSTILE)]


def _numbers(name: str, data: bytes, edit: Edit) -> bytes:
    """Give one number of a tree another size or sign: slips of units, and what no physics has."""
    load, dump = _TREES[name[name.rfind(".") :]]
    try:
        tree = load(data)
        places = [
            (box, key)
            for box in _boxes(tree)
            for key in _keys(box)
            if isinstance(box[key], int | float) and not isinstance(box[key], bool)
        ]
        box, key = places[edit.place % len(places)]
        value = box[key]
        if edit.kind % 4:
            power = 10 ** (1 + edit.more % 18)
            scaled = (value * power, value / power, -value * power, -value)[edit.kind % 16 // 4]
            box[key] = int(scaled) if isinstance(value, int) else float(scaled)
        else:
            box[key] = NUMBERS[edit.more % len(NUMBERS)]
        return dump(tree)
    # A word that another edit has damaged.
    except Exception:
        return data


def _boxes(tree: Any) -> list[Any]:
    found = [tree] if isinstance(tree, MutableMapping | list) else []
    for box in found:  # grows while it is gone through
        found += [box[k] for k in _keys(box) if isinstance(box[k], MutableMapping | list)]
    return found


def _keys(box: Any) -> list[Any]:
    return list(range(len(box))) if isinstance(box, list) else list(box)


_SPOILS: tuple[Callable[[np.ndarray], Any], ...] = (
    lambda a: a[:0],
    lambda a: a.reshape(-1),
    lambda a: a[None],
    lambda a: a.reshape(-1)[0],
    lambda a: a.T,
    lambda a: np.repeat(a, 3, axis=0),
    lambda a: a.astype(bool),
    lambda a: a.astype(np.int8),
    lambda a: a.astype(np.float16),
    lambda a: a.astype(complex),
    lambda a: a.astype(str),
    lambda a: a.astype("S8"),
    lambda a: a.astype("M8[s]"),
    lambda a: a.astype(a.dtype.newbyteorder()),
    lambda a: a.astype(np.uint64),
    lambda a: np.full_like(a, -1),
    lambda a: np.full(a.shape, np.nan),
    lambda a: np.full(a.shape, np.inf),
    lambda a: np.full(a.shape, 2**62),
    lambda a: np.zeros_like(a),
    lambda a: np.zeros(a.shape, [("x", "f8"), ("y", "f8")]),
    lambda a: np.zeros(a.shape, [("x", "S3"), ("y", "f8")]),
    lambda a: np.zeros((0, 2**40)),
    lambda a: np.array("text"),
    lambda a: np.broadcast_to(a, (2, 2, *a.shape)),
)


def _spoiled(value: Any, which: int) -> Any:
    spoil = _SPOILS[which % len(_SPOILS)]
    if isinstance(value, torch.Tensor):
        return torch.from_numpy(np.array(spoil(value.detach().numpy())))
    return spoil(value)


def _hdf5(data: bytes, edit: Edit) -> bytes:
    """Change an attribute, a variable or a link of a file that libhdf5 itself finds sound."""
    try:
        return _hdf5_changed(data, edit)
    except Exception:
        return data


def _hdf5_changed(data: bytes, edit: Edit) -> bytes:
    whole = io.BytesIO(data)
    with h5py.File(whole, "r+") as file:
        holders = [file, *(file[name] for name in file)]
        holder = holders[edit.place % len(holders)]
        hostile = HOSTILE[edit.more % len(HOSTILE)]
        names = [str(name) for name in file if isinstance(file[name], h5py.Dataset)]
        name = names[edit.place % len(names)]
        keys = list(holder.attrs)
        match edit.kind % 9:
            case 8:  # some kB of file that are gigabytes of fill values
                shape = _dataset(file, name).shape or (1,)
                del file[name]
                size = (*shape[:-1], 1 << (20 + edit.more % 16))
                file.create_dataset(name, size, "f8", fillvalue=1.0, chunks=True)
            case 0 | 1 if keys:
                holder.attrs[keys[edit.place % len(keys)]] = hostile
            case 2 if keys:
                del holder.attrs[keys[edit.place % len(keys)]]
            case 3:
                del file[name]
            case 4:
                kept = _dataset(file, name)[()]
                del file[name]
                file[name] = hostile if edit.more % 4 == 0 else _spoiled(kept, edit.more)
            case 5:
                links = (
                    h5py.SoftLink(f"/{name}"),
                    h5py.SoftLink("/nowhere"),
                    h5py.ExternalLink("/etc/passwd", "/x"),
                    h5py.ExternalLink("victim", "/x"),
                )
                del file[name]
                file[name] = links[edit.more % len(links)]
            case 6:
                del file[name]
                file.create_group(name)["again"] = file["/"]
            case _:
                values = np.array(_dataset(file, name)[()])
                values.reshape(-1)[edit.more % values.size] = NUMBERS[edit.more % len(NUMBERS)]
                _dataset(file, name)[...] = values
    return whole.getvalue()


def _dataset(file: h5py.File, name: str) -> h5py.Dataset:
    found = file[name]
    assert isinstance(found, h5py.Dataset)
    return found


def _words(name: str, data: bytes, edit: Edit) -> bytes:
    """Change a word, or a line, of a text."""
    lines = data.split(b"\n")
    if edit.kind % 4 == 0 and len(lines) > 1:
        line = lines.pop(edit.place % len(lines))
        for _ in range(edit.more % 4):
            lines.insert(edit.more % (len(lines) + 1), line)
        return b"\n".join(lines)
    words = list(_WORD.finditer(data[:200_000]))
    if not words:
        return _bytes(name, data, edit)
    word = words[edit.place % len(words)]
    if edit.kind % 4 == 1:
        new = words[edit.more % len(words)].group()
    elif edit.kind % 4 == 2:
        new = word.group() * (1 + edit.more % 3) + b"e9" * (edit.more % 2)
    else:
        new = str(HOSTILE[edit.more % len(HOSTILE)]).encode(errors="replace")
    return data[: word.start()] + new + data[word.end() :]


_WHOLE = [
    number.to_bytes(size, order)
    for size in (2, 4, 8)
    for number in (0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1), 2 ** (8 * size - 1) - 1)
    for order in ("little", "big")
]
_PATTERNS = (*_WHOLE, *(np.float64(x).tobytes() for x in ("nan", "inf")))


def _bytes(_name: str, data: bytes, edit: Edit) -> bytes:
    """Flip, set, cut, repeat, swap or insert bytes."""
    if not data:
        return bytes([edit.more % 256]) * (edit.place % 100)
    # Headers decide how the rest is read, so half of the damage is done to them.
    at = edit.place % (len(data) if edit.place % 2 else min(len(data), 512))
    size = 1 + edit.more % min(64, len(data))
    match edit.kind % 8:
        case 0:
            return data[:at] + bytes([data[at] ^ (1 << edit.more % 8)]) + data[at + 1 :]
        case 1:
            return data[:at] + bytes([edit.more % 256]) + data[at + 1 :]
        case 2:
            new = _PATTERNS[edit.more % len(_PATTERNS)]
            return data[:at] + new + data[at + len(new) :]
        case 3:
            return data[:at]
        case 4:
            return data[:at] + data[at + size :]
        case 5:
            return data[:at] + data[at : at + size] * (1 + edit.more % 500) + data[at + size :]
        case 6:
            other = edit.more % len(data)
            first, second = sorted((at, other))
            middle, last = data[first:second], data[second : second + size]
            return data[:first] + last + middle + data[second + size :]
        case _:
            return data[:at] + edit.more.to_bytes(4, "little") * (1 + edit.more % 9) + data[at:]


def _special(name: str, data: bytes, edit: Edit) -> bytes:
    """Put something else than a file in its place, or one that expands or has many of a thing."""
    if edit.kind % 2:
        return SPECIAL[edit.more % len(SPECIAL)]
    if name.endswith(".mat") and not data.startswith(b"\x89HDF"):
        new = io.BytesIO()  # 100 MB at most, of a thousandth of that
        scipy.io.savemat(new, {"adc": np.zeros(1 << edit.more % 24)}, do_compression=True)
        return new.getvalue()
    if data.startswith(b"PK"):
        try:
            return _expanding(data, edit)
        except Exception:  # an archive that is damaged already
            return data
    return _many(name, data, edit)


def _expanding(data: bytes, edit: Edit) -> bytes:
    """An archive one member of which becomes zeros: a thousandth of what it says it holds."""
    new, (old, count) = io.BytesIO(), (zipfile.ZipFile(io.BytesIO(data)), 1 << (20 + edit.more % 9))
    names = old.namelist()
    with zipfile.ZipFile(new, "w", zipfile.ZIP_DEFLATED) as archive:
        for number, name in enumerate(names):
            kept = old.read(name)
            if number == edit.place % len(names):
                kept = kept[:128].replace(b"(3,", b"(%d," % (count // 24)) + bytes(count)
            archive.writestr(name, kept)
    return new.getvalue()


def _many(name: str, data: bytes, edit: Edit) -> bytes:
    """A text one line of which is there ten thousand times, or has ten thousand of its words."""
    lines = data[:_MOST].split(b"\n")
    at = edit.place % len(lines)
    count = min(1 + edit.more % 10_000, 1 + _MOST // (1 + len(lines[at])))
    if edit.more % 2:
        lines[at] = b" ".join([lines[at]] * count)
    else:
        lines[at : at + 1] = [lines[at]] * count
    return b"\n".join(lines)


_LEVELS = {
    "special": _special,
    "bytes": _bytes,
    "words": _words,
    "values": _values,
    "numbers": _numbers,
}
RAN = ".ran"
"""Ends the name of the file that a planted module makes beside itself where it is imported."""
_MODULE = f"open(__file__ + {RAN!r}, 'w').close()\n".encode()
_SETTINGS = {
    "matplotlibrc": b"backend: module://planted\ntext.usetex: True\nfigure.dpi: 9000\n",
    "planted.py": _MODULE,
    "libLLVM.so": b"\x7fELF",
    "pyvenv.cfg": b"home = .\n",
}


@functools.cache
def _module_names() -> list[str]:
    """Names of modules that Python, the libraries or nobody has."""
    known = {*sys.stdlib_module_names, *packages_distributions()}
    known |= {"sitecustomize", "usercustomize"}
    return sorted(name for name in known if name.isidentifier())


def _planted(edit: Edit) -> Files:
    """Modules with the names of others, and settings, in the working folder or that of the data."""
    names, folder = _module_names(), "data/" if edit.kind % 3 == 0 else ""
    stride = 1 + edit.more % 7
    chosen = [names[(edit.place + stride * k) % len(names)] for k in range(100)]
    form = "{}{}/__init__.py" if edit.kind % 2 else "{}{}.py"
    found = {form.format(folder, name): _MODULE for name in chosen}
    return found | {folder + name: content for name, content in _SETTINGS.items()}


def _npz(data: bytes) -> dict[str, Any]:
    with np.load(io.BytesIO(data), allow_pickle=False) as opened:
        return dict(opened)


def _saved(save: Callable[[Any, Any], Any]) -> Callable[[Any], bytes]:
    def saved(value: Any) -> bytes:
        file = io.BytesIO()
        save(file, value)
        return file.getvalue()

    return saved


def _save_npz(file: Any, arrays: Mapping[str, Any]) -> None:
    np.savez(file, allow_pickle=True, **{name: np.asarray(a) for name, a in arrays.items()})


def _mat(data: bytes) -> dict[str, Any]:
    found = scipy.io.loadmat(io.BytesIO(data))
    return {name: value for name, value in found.items() if not name.startswith("__")}


def _checkpoint(data: bytes) -> Any:
    # As the library does: torch spends minutes on its message about names of a million letters.
    if torch.serialization.get_unsafe_globals_in_checkpoint(io.BytesIO(data)):
        raise ValueError("classes")
    return torch.load(io.BytesIO(data), weights_only=True)


_TREES: dict[str, tuple[Callable[[bytes], Any], Callable[[Any], bytes]]] = {
    ".json": (json.loads, lambda tree: json.dumps(tree).encode()),
    ".gltf": (json.loads, lambda tree: json.dumps(tree).encode()),
    ".toml": (lambda data: tomllib.loads(data.decode()), lambda tree: tomli_w.dumps(tree).encode()),
    ".npz": (_npz, _saved(_save_npz)),
    ".mat": (_mat, _saved(scipy.io.savemat)),
    ".pt": (
        _checkpoint,
        _saved(lambda file, state: torch.save(state, file)),
    ),
}
