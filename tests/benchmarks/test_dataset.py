"""The benchmark of data sets sees bytes that differ, and kills before the end."""

import random

import pytest

RUN = """
task = "dataset"
frame = 2

[scene.ball]
shape = "sphere"
radius = 0.2
position = [1.6, 0.0, 0.0]
material = { kind = "rough_dielectric", permittivity = 4.0 }

[radar]
waveform = { kind = "fmcw", start_frequency = 77e9, bandwidth = 1e9, duration = 5e-5, samples = 32 }
transmitters = { kind = "positions", positions = [[0.0, 0.0, 0.0]] }
receivers = { kind = "linear", count = 2, spacing = 1.92e-3 }

[grid]
range_min = 0.5
range_max = 2.0

[data]
kind = "simulated"
depth = 1
points_per_m2 = 100.0

[dataset]
samples = 3
shard = 1

[[vary]]
key = "scene.ball.position[1]"
kind = "uniform"
low = -0.3
high = 0.3
"""


def test_shards_of_parts_count_by_their_names(dataset, tmp_path):
    for name in ("part_1_of_2/shard-000000.tar", "part_2_of_2/shard-000001.tar", "notes.tar"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    assert sorted(dataset.shards(tmp_path)) == ["shard-000000.tar", "shard-000001.tar"]


def test_numbers_are_flat_and_requirements_name_them(dataset):
    numbers = dataset.flat({"scaling": 1.8, "bytes_equal": {"ray": True, "killed": False}})
    assert numbers == {"scaling": 1.8, "bytes_equal.ray": 1.0, "bytes_equal.killed": 0.0}
    assert dataset.REQUIRED.keys() <= dataset.COUNTED.keys()


@pytest.mark.slow
def test_a_killed_run_ends_with_the_bytes_of_one_worker(dataset, tmp_path):
    file = tmp_path / "ball.toml"
    file.write_text(RUN)
    one = dataset.made(file, tmp_path / "one", "--workers", "1")
    assert one["samples_per_second"] == pytest.approx(3 / one["wall_seconds"])
    # Long before the command has started to work, which takes seconds.
    assert dataset.killed(file, tmp_path / "killed", 2, 1.0, random.Random(1)) == 2
    assert dataset.shards(tmp_path / "killed") == dataset.shards(tmp_path / "one")
    assert len(dataset.shards(tmp_path / "one")) == 3
