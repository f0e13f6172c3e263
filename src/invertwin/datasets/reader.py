"""A data set as PyTorch reads it."""

import hashlib
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from invertwin.checks import check_choice
from invertwin.datasets.labels import convert_old_labels
from invertwin.datasets.shards import OLD_FORMAT, DatasetManifest, locate_members, read_manifests
from invertwin.errors import InputError
from invertwin.storage.untrusted import convert_read_errors, existing_file


class SampleDataset(Dataset[Any]):
    """The samples of a folder that ``invertwin dataset`` made, by number; map-style.

    A sample is a dict: ``index``, its arrays as tensors by name (``beat``, ``map``, …), ``labels``
    (``invertwin.datasets.object_labels`` says what is in them) and ``run``, the run file that
    simulates it again. Axes are x forward, y left, z up; labels and paths of an old data set, whose
    axes are x left, y up, z ahead, are turned; `invertwin convert` rewrites its run files. It works
    in every kind of worker of a DataLoader: nothing is read, and no file is open, before the first
    sample is asked for.

    Args:
        folder: Folder of the data set, or of all of its parts.
        entries: Entries to read; the others cost nothing. None = all.
        transform: Makes of a sample what a network takes. Workers that are spawned need a function
            of a module, not a lambda.

    Attributes:
        manifest: Manifest of the folder; of parts, that of the first one.

    Raises:
        InputError: No complete data set, or an entry that it does not have.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        entries: Sequence[str] | None = None,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        parts = read_manifests(Path(folder))
        self.manifest: DatasetManifest = parts[0][1]
        known = ["index", *self.manifest.arrays, "labels", "run"]
        for name in entries or ():
            check_choice(name, known, "entries among")
        self._keep = set(known if entries is None else entries)
        self._transform = transform
        found = [(place / shard.name, shard) for place, m in parts for shard in m.shards]
        self._shards = sorted(found, key=lambda row: row[1].first)
        self._starts = np.cumsum([0, *(shard.samples for _, shard in self._shards)])
        self._places: dict[int, dict[int, dict[str, tuple[int, int]]]] = {}

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        index %= len(self)
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        path, shard = self._shards[number]
        if number not in self._places:
            self._places[number] = locate_members(path)
        sample = shard.first + index - int(self._starts[number])
        do = "check() says which are damaged"
        with convert_read_errors(path, "a whole shard of a data set", do):
            found = self._read(path, sample, self._places[number][sample])
        return found if self._transform is None else self._transform(found)

    def check(self) -> None:
        """Compare every shard with the digest in the manifest.

        Raises:
            InputError: One that is damaged or missing.
        """
        for path, shard in self._shards:
            what = "a shard of a data set"
            with convert_read_errors(path, what), existing_file(path, what).open("rb") as opened:
                digest = hashlib.file_digest(opened, "sha256").hexdigest()
            if digest != shard.sha256:
                raise InputError(
                    f"expected the shard that the manifest describes, got {path} with other "
                    "content; copy it again, or make the data set again"
                )

    def _read(self, path: Path, sample: int, members: dict[str, tuple[int, int]]) -> dict[str, Any]:
        found: dict[str, Any] = {"index": sample} if "index" in self._keep else {}
        with path.open("rb") as opened:
            for end, (start, size) in members.items():
                name, _, kind = end.rpartition(".")
                if name in self._keep:
                    opened.seek(start)
                    found[name] = _decode(opened.read(size), kind)
        return self._turn(found) if self.manifest.format == OLD_FORMAT else found

    def _turn(self, found: dict[str, Any]) -> dict[str, Any]:
        """Turn an old sample to x forward, y left, z up."""
        if "labels" in found:
            found["labels"] = convert_old_labels(found["labels"])
        for name, info in self.manifest.arrays.items():
            if name in found and "xyz" in info.dims:
                found[name] = found[name].roll(1, info.dims.index("xyz"))
        return found


def _decode(content: bytes, kind: str) -> Any:
    if kind == "npy":
        return torch.from_numpy(np.load(io.BytesIO(content), allow_pickle=False))
    return json.loads(content) if kind == "json" else content.decode("utf-8")
