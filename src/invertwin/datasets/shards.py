"""Shards of data sets: tar files as WebDataset reads them, and the manifest of a folder of them.

A sample is a few files whose names begin with its number: ``00000017.map.npy``,
``00000017.labels.json``. A shard is a plain tar of the samples of a range of numbers, in order.
Nothing in it depends on who wrote it when: the same samples make the same bytes.

Source: A. Aizman, G. Maltby, T. Breuel, "High performance I/O for large scale deep learning", 2019
(the layout of WebDataset).
"""

import hashlib
import io
import tarfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le, MinLen
from pydantic import BaseModel

from invertwin.errors import InputError
from invertwin.limits import MAX_COUNT, Count
from invertwin.storage.untrusted import convert_read_errors, existing_file

MANIFEST = "manifest.json"
FORMAT = "invertwin data set 2"
"""Its axes are x forward, y left, z up."""
OLD_FORMAT = "invertwin data set 1"
"""Its axes are x left, y up, z ahead."""
_DIGITS = 8  # of a sample's number


class Shard(BaseModel):
    """A tar file of a data set."""

    name: str
    first: Annotated[int, Ge(0), Le(MAX_COUNT)]  # number of its first sample
    samples: Count
    size: int  # bytes
    sha256: str


class ArrayInfo(BaseModel):
    """Name, type and shape of an array of every sample."""

    dims: list[str]
    unit: str


class DatasetManifest(BaseModel):
    """Contents of a folder of shards."""

    format: str
    samples: Count  # of the whole data set
    part: tuple[Count, Count]  # which of how many parts of the data set this folder holds
    fingerprint: str  # SHA-256 of the run file as used
    versions: dict[str, str]  # of what computed the samples
    arrays: dict[str, ArrayInfo]
    shards: Annotated[list[Shard], MinLen(1)]


def shard_name(number: int) -> str:
    """Name of a shard's file."""
    return f"shard-{number:06d}.tar"


def pack_shard(samples: Iterable[tuple[int, Mapping[str, bytes]]]) -> bytes:
    """A tar file.

    Args:
        samples: Number of each, and its files by the end of their names, such as ``map.npy``.
    """
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for number, members in samples:
            for end, content in members.items():
                # Owner, mode and time of a new TarInfo are the same everywhere.
                entry = tarfile.TarInfo(f"{number:0{_DIGITS}d}.{end}")
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
    return made.getvalue()


def npy_bytes(array: np.ndarray) -> bytes:
    """An array as the content of an ``.npy`` file."""
    made = io.BytesIO()
    np.save(made, array, allow_pickle=False)
    return made.getvalue()


def describe_shard(name: str, first: int, samples: int, content: bytes) -> Shard:
    """The manifest's row of a shard.

    Args:
        name: Name of the file.
        first: Number of its first sample.
        samples: Number of samples in it.
        content: Content of the file.
    """
    digest = hashlib.sha256(content).hexdigest()
    return Shard(name=name, first=first, samples=samples, size=len(content), sha256=digest)


def shard_ranges(samples: int, size: int, part: tuple[int, int]) -> list[tuple[int, int, int]]:
    """Number, first sample and length of every shard of a part: part i of n has every n-th one.

    Args:
        samples: Number of samples of the whole data set.
        size: Samples of a shard; the last one may have fewer.
        part: Number from 1, and of how many.

    Raises:
        InputError: No such part, or one without a shard.
    """
    number, count = part
    if not 1 <= number <= count:
        raise InputError(
            f"expected a part i/n with 1 <= i <= n, got {number}/{count}; count from 1"
        )
    starts = list(enumerate(range(0, samples, size)))[number - 1 :: count]
    if not starts:
        raise InputError(
            f"expected at most as many parts as shards ({-(-samples // size)}), got part "
            f"{number} of {count}; use fewer parts or smaller shards"
        )
    return [(k, first, min(size, samples - first)) for k, first in starts]


def locate_members(path: Path) -> dict[int, dict[str, tuple[int, int]]]:
    """Locate the files of every sample of a shard: first byte and size, by number and name.

    Args:
        path: The tar file.

    Raises:
        InputError: No tar file, or one that is no shard.
    """
    found: dict[int, dict[str, tuple[int, int]]] = {}
    what = "a shard of a data set"
    with convert_read_errors(path, what), tarfile.open(existing_file(path, what), "r:") as tar:
        for entry in tar:
            number, _, end = entry.name.partition(".")
            found.setdefault(int(number), {})[end] = (entry.offset_data, entry.size)
    return found


def read_manifests(folder: Path) -> list[tuple[Path, DatasetManifest]]:
    """The manifest of a folder, or those of its parts, each with its folder.

    Args:
        folder: Folder of the data set.

    Raises:
        InputError: None, a damaged one, or those of different data sets.
    """
    whole = folder / MANIFEST
    with convert_read_errors(folder, "the folder of a data set"):
        files = [whole] if whole.is_file() else sorted(folder.glob(f"part_*/{MANIFEST}"))
    found = []
    for file in files:
        with convert_read_errors(file, "the manifest of a data set"):
            manifest = DatasetManifest.model_validate_json(existing_file(file).read_bytes())
        known = manifest.format in (FORMAT, OLD_FORMAT)
        known &= manifest.part[0] <= manifest.part[1]
        if not known or any(Path(s.name).name != s.name for s in manifest.shards):
            raise InputError(f"expected {FORMAT!r}, got {file} of another format; make it again")
        found.append((file.parent, manifest))
    if not found:
        raise InputError(
            f"expected a data set, got {folder} without {MANIFEST}; give a folder that invertwin "
            "dataset has completed"
        )
    if len({(m.format, m.fingerprint, m.samples, m.part[1]) for _, m in found}) > 1:
        raise InputError(
            f"expected parts of one data set, got those of several in {folder}; make them with "
            "one run file and one number of parts"
        )
    return found
