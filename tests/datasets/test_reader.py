"""Samples come back as they were written, in any worker of a DataLoader."""

import json

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from invertwin.datasets import SampleDataset
from invertwin.datasets.shards import (
    FORMAT,
    ArrayInfo,
    DatasetManifest,
    describe_shard,
    npy_bytes,
    pack_shard,
    shard_name,
)
from invertwin.errors import InputError


def written(folder, ranges, part=(1, 1)):
    """A data set whose sample k has a map full of k."""
    folder.mkdir(parents=True, exist_ok=True)
    shards = []
    for first, count in ranges:
        content = pack_shard(
            (
                k,
                {
                    "map.npy": npy_bytes(np.full((2, 3), k, dtype=np.float32)),
                    "labels.json": json.dumps({"index": k}).encode(),
                    "run.toml": b'task = "simulate"',
                },
            )
            for k in range(first, first + count)
        )
        name = shard_name(first)
        (folder / name).write_bytes(content)
        shards.append(describe_shard(name, first, count, content))
    manifest = DatasetManifest(
        format=FORMAT,
        samples=10,
        part=part,
        fingerprint="ab",
        versions={},
        arrays={"map": ArrayInfo(dims=["frame", "range"], unit="")},
        shards=shards,
    )
    (folder / "manifest.json").write_text(manifest.model_dump_json())
    return folder


def map_of(sample):
    return sample["map"]


def test_every_sample_is_found_by_its_number(tmp_path):
    found = SampleDataset(written(tmp_path, [(0, 4), (4, 4), (8, 2)]))
    assert len(found) == 10
    for k in (0, 3, 4, 7, 9, -1):
        sample = found[k]
        assert sample["index"] == k % 10
        assert sample["labels"] == {"index": k % 10}
        assert sample["run"] == 'task = "simulate"'
        assert torch.equal(sample["map"], torch.full((2, 3), float(k % 10)))
    with pytest.raises(IndexError, match="10 of 10"):
        found[10]


def test_parts_are_read_as_one_set_in_order(tmp_path):
    written(tmp_path / "part_1_of_2", [(0, 4), (8, 2)], (1, 2))
    written(tmp_path / "part_2_of_2", [(4, 4)], (2, 2))
    assert [sample["index"] for sample in SampleDataset(tmp_path, entries=["index"])] == list(
        range(10)
    )
    # A part alone says which samples it has.
    assert [s["index"] for s in SampleDataset(tmp_path / "part_2_of_2")] == [4, 5, 6, 7]


def test_only_what_is_kept_is_read(tmp_path):
    found = SampleDataset(written(tmp_path, [(0, 10)]), entries=["map"])
    assert set(found[2]) == {"map"}
    with pytest.raises(InputError, match="index, map, labels, run, got mask"):
        SampleDataset(tmp_path, entries=["mask"])


@pytest.mark.parametrize("context", [None, "spawn"])
def test_a_data_loader_reads_it(tmp_path, context):
    found = SampleDataset(written(tmp_path, [(0, 4), (4, 6)]), transform=map_of)
    loader = DataLoader(
        found,
        batch_size=4,
        shuffle=True,
        generator=torch.Generator().manual_seed(1),
        num_workers=0 if context is None else 1,
        multiprocessing_context=context,
    )
    batches = list(loader)
    assert [tuple(batch.shape) for batch in batches] == [(4, 2, 3), (4, 2, 3), (2, 2, 3)]
    assert sorted(torch.cat(batches)[:, 0, 0].tolist()) == list(range(10))


def test_a_damaged_shard_is_told(tmp_path):
    found = SampleDataset(written(tmp_path, [(0, 10)]))
    found.check()
    shard = tmp_path / shard_name(0)
    whole = shard.read_bytes()
    shard.write_bytes(whole.replace(b"simulate", b"simulatf", 1))
    with pytest.raises(InputError, match="with other content"):
        found.check()
    shard.write_bytes(whole[:600])
    with pytest.raises(InputError) as told:
        found[9]
    assert "\n" not in str(told.value)
