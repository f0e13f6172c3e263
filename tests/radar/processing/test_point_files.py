"""Points as PLY and PCD: independent readers get what was written."""

import math

import numpy as np
import pytest
import torch
import trimesh

from invertwin import InputError
from invertwin.radar import PointCloud, save_points

FIELDS = ("x", "y", "z", "range", "velocity", "u", "v", "power", "frame")


@pytest.fixture
def points():
    position = torch.tensor([[0.5, -0.25, 2.0], [1.0, 0.0, 3.0]]).double()
    return PointCloud(
        frame=torch.tensor([3, 3]),
        range=torch.tensor([2.0, 3.0]).double(),
        velocity=torch.tensor([-1.5, math.nan]).double(),
        u=torch.tensor([0.25, 0.3]).double(),
        v=torch.tensor([-0.125, 0.0]).double(),
        power=torch.tensor([1e-6, 1e-4]).double(),
        position=position,
    )


def test_ply_is_read_by_trimesh(tmp_path, points):
    save_points(tmp_path / "points.ply", points)
    read = trimesh.load(tmp_path / "points.ply")
    assert isinstance(read, trimesh.PointCloud)
    np.testing.assert_allclose(read.vertices, [[1.0, 0.0, 3.0], [0.5, -0.25, 2.0]])
    text = (tmp_path / "points.ply").read_bytes().split(b"end_header\n")[0].decode()
    assert [line.split()[-1] for line in text.splitlines() if "property" in line] == list(FIELDS)


def test_pcd_is_read_by_an_independent_reader(tmp_path, points):
    pypcd4 = pytest.importorskip("pypcd4", reason="pip install pypcd4")
    save_points(tmp_path / "points.pcd", points)
    read = pypcd4.PointCloud.from_path(tmp_path / "points.pcd")
    assert tuple(read.fields) == FIELDS
    expected = [
        [1.0, 0.0, 3.0, 3.0, math.nan, 0.3, 0.0, -40.0, 3.0],
        [0.5, -0.25, 2.0, 2.0, -1.5, 0.25, -0.125, -60.0, 3.0],
    ]
    np.testing.assert_allclose(read.numpy(FIELDS), expected, rtol=1e-6)


def test_pcd_header_and_records(tmp_path, points):
    save_points(tmp_path / "points.pcd", points)
    head, data = (tmp_path / "points.pcd").read_bytes().split(b"DATA binary\n")
    lines = dict(line.split(" ", 1) for line in head.decode().splitlines())
    assert lines["FIELDS"].split() == list(FIELDS)
    assert lines["WIDTH"] == lines["POINTS"] == "2"
    assert lines["SIZE"].split() == ["4"] * 9
    assert np.frombuffer(data, "<f4").reshape(2, 9)[1, :3].tolist() == [0.5, -0.25, 2.0]


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_no_points_are_a_file_too(tmp_path, points, suffix):
    none = PointCloud(*(getattr(points, name)[:0] for name in PointCloud.__dataclass_fields__))
    save_points(tmp_path / f"points.{suffix}", none)
    assert (tmp_path / f"points.{suffix}").read_bytes().endswith(b"\n")


def test_other_suffixes_are_refused(tmp_path, points):
    with pytest.raises(InputError, match=r"points.las to end in .ply, .pcd"):
        save_points(tmp_path / "points.las", points)
