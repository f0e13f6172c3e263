"""Samples come back as they were written, in any worker of a DataLoader."""

import json
import os

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
    with pytest.raises(InputError, match="index, map, labels, run, got 'mask'"):
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


def labels_of(place, size, velocity, pose, rotation, joint, device, axes):
    """Labels of one object at a place and a radar at another."""
    crate = {
        "name": "crate",
        "class": "box",
        "pose": pose,
        "box": {"low": place, "high": size},
        "oriented_box": {"center": place, "size": size, "rotation": rotation},
        "velocity": velocity,
        "triangles": {"first": 0, "count": 12},
        "seen": [0.5, 0.25, 0.125],
        "joints": {"left hand": joint},
    }
    radar = {"positions": [device, device], "rotations": [axes, axes]}
    return {"index": 0, "objects": [crate], "radar": radar}


def one_sample(folder, format, labels, first):
    """A data set of one sample with labels and the first points of its paths."""
    folder.mkdir()
    members = {
        "paths_first.npy": npy_bytes(np.array(first)),
        "labels.json": json.dumps(labels).encode(),
        "run.toml": b'task = "simulate"',
    }
    content = pack_shard([(0, members)])
    (folder / shard_name(0)).write_bytes(content)
    paths = ArrayInfo(dims=["path", "xyz"], unit="m")
    manifest = DatasetManifest(
        format=format,
        samples=1,
        part=(1, 1),
        fingerprint="ab",
        versions={},
        arrays={"paths_first": paths},
        shards=[describe_shard(shard_name(0), 0, 1, content)],
    )
    (folder / "manifest.json").write_text(manifest.model_dump_json())
    return folder


def test_old_labels_are_turned_and_new_ones_stay(tmp_path):
    """A crate 3 m ahead, 1 m to the left and 2 m up, turned to the left by 90°."""
    old = labels_of(
        place=[1.0, 2.0, 3.0],
        size=[0.5, 0.75, 0.25],
        velocity=[-1.0, 0.0, -4.0],
        pose=[
            [0.0, 0.0, 1.0, 1.0],
            [0.0, 1.0, 0.0, 2.0],
            [-1.0, 0.0, 0.0, 3.0],
            [0.0, 0.0, 0.0, 1.0],
        ],
        rotation=[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]],
        joint=[0.1, 0.2, 0.3],
        device=[7.0, 8.0, 9.0],
        axes=[[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.8, 0.6]],
    )
    new = labels_of(
        place=[3.0, 1.0, 2.0],
        size=[0.25, 0.5, 0.75],
        velocity=[-4.0, -1.0, 0.0],
        pose=[
            [0.0, -1.0, 0.0, 3.0],
            [1.0, 0.0, 0.0, 1.0],
            [0.0, 0.0, 1.0, 2.0],
            [0.0, 0.0, 0.0, 1.0],
        ],
        rotation=[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        joint=[0.3, 0.1, 0.2],
        device=[9.0, 7.0, 8.0],
        axes=[[0.6, 0.0, -0.8], [0.0, 1.0, 0.0], [0.8, 0.0, 0.6]],
    )
    (early,) = SampleDataset(
        one_sample(
            tmp_path / "old", "invertwin data set 1", old, [[4.0, 5.0, 6.0], [1.0, 2.0, 3.0]]
        )
    )
    (late,) = SampleDataset(
        one_sample(tmp_path / "new", FORMAT, new, [[6.0, 4.0, 5.0], [3.0, 1.0, 2.0]])
    )
    for sample in (early, late):
        assert sample["labels"] == new
        assert sample["paths_first"].tolist() == [[6.0, 4.0, 5.0], [3.0, 1.0, 2.0]]
        assert sample["run"] == 'task = "simulate"'


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


def test_a_pipe_as_manifest_of_a_part_is_refused(tmp_path):
    (tmp_path / "part_1").mkdir()
    os.mkfifo(tmp_path / "part_1" / "manifest.json")
    with pytest.raises(InputError, match="got a pipe or a device"):
        SampleDataset(tmp_path)
    with pytest.raises(InputError, match="the folder of a data set"):
        SampleDataset(tmp_path / ("a" * 300))
