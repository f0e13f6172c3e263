"""Shards are plain tars of equal bytes; what is wrong with a folder is told in one line."""

import io
import json
import os
import tarfile

import numpy as np
import pytest

from invertwin.datasets.shards import (
    describe_shard,
    locate_members,
    npy_bytes,
    pack_shard,
    read_manifests,
    shard_ranges,
)
from invertwin.errors import InputError


def samples(first, count):
    for k in range(first, first + count):
        yield k, {"map.npy": npy_bytes(np.full((2, 3), k)), "labels.json": b'{"a": 1}'}


def test_a_shard_is_a_tar_that_names_no_owner_and_no_time(tmp_path):
    content = pack_shard(samples(5, 2))
    assert content == pack_shard(samples(5, 2))
    with tarfile.open(fileobj=io.BytesIO(content)) as tar:
        entries = tar.getmembers()
        names = [entry.name for entry in entries]
        read = tar.extractfile(entries[2])
        assert read is not None
        assert (np.load(io.BytesIO(read.read())) == 6).all()
    assert names == [f"0000000{k}.{end}" for k in (5, 6) for end in ("map.npy", "labels.json")]
    assert {(e.mtime, e.uid, e.gid, e.uname, e.mode) for e in entries} == {(0, 0, 0, "", 0o644)}
    (tmp_path / "a.tar").write_bytes(content)
    places = locate_members(tmp_path / "a.tar")
    start, size = places[6]["labels.json"]
    assert content[start : start + size] == b'{"a": 1}'


def test_parts_share_all_shards_among_themselves():
    whole = shard_ranges(23, 5, (1, 1))
    assert whole == [(0, 0, 5), (1, 5, 5), (2, 10, 5), (3, 15, 5), (4, 20, 3)]
    assert sorted(row for part in (1, 2, 3) for row in shard_ranges(23, 5, (part, 3))) == whole


@pytest.mark.parametrize(
    ("part", "said"), [((0, 2), "got 0/2"), ((3, 2), "got 3/2"), ((6, 6), r"shards \(5\)")]
)
def test_parts_that_are_none_are_refused(part, said):
    with pytest.raises(InputError, match=said):
        shard_ranges(23, 5, part)


def manifest(**changes) -> str:
    shard = describe_shard("shard-000000.tar", 0, 2, pack_shard(samples(0, 2))).model_dump()
    whole = {
        "format": "invertwin data set 2",
        "samples": 2,
        "part": [1, 1],
        "fingerprint": "ab",
        "versions": {},
        "arrays": {},
        "shards": [shard],
    }
    return json.dumps(whole | changes)


def test_parts_are_found_and_those_of_other_sets_refused(tmp_path):
    for name in ("part_1_of_2", "part_2_of_2"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "manifest.json").write_text(manifest(part=[int(name[5]), 2]))
    assert [found.part[0] for _, found in read_manifests(tmp_path)] == [1, 2]
    (tmp_path / name / "manifest.json").write_text(manifest(part=[2, 2], fingerprint="cd"))
    with pytest.raises(InputError, match="parts of one data set"):
        read_manifests(tmp_path)
    old = manifest(part=[2, 2], format="invertwin data set 1")
    (tmp_path / name / "manifest.json").write_text(old)
    with pytest.raises(InputError, match="parts of one data set"):
        read_manifests(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "without manifest.json"),
        ("{", "expected the manifest of a data set"),
        (manifest(format="other"), "of another format"),
        (manifest().replace("shard-0", "../shard-0"), "of another format"),
    ],
)
def test_folders_that_hold_no_set_are_refused(tmp_path, text, said):
    if text is not None:
        (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=said) as found:
        read_manifests(tmp_path)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    "change",
    [
        {"samples": -1},
        {"samples": 2**63},
        {"part": [3, 2]},
        {"part": [1, -1]},
        {"shards": []},
        *(
            {"shards": [json.loads(manifest())["shards"][0] | {key: value}]}
            for key, value in (("samples", -1), ("samples", 0), ("samples", 2**63), ("first", -5))
        ),
    ],
)
def test_counts_that_are_none_are_refused(tmp_path, change):
    (tmp_path / "manifest.json").write_text(manifest(**change))
    with pytest.raises(InputError, match="expected"):
        read_manifests(tmp_path)


def test_a_shard_that_is_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.tar")
    with pytest.raises(InputError, match="a pipe or a device"):
        locate_members(tmp_path / "a.tar")
