"""Files of holes, pipes, and what writes on a full disk."""

import io
import os
import resource

import h5py
import numpy as np
import pytest
import torch
import trimesh
from trimesh.exchange import gltf

from invertwin.capture import Capture, ChannelCalibration
from invertwin.capture.ti.sdk_cfg import read_cfg
from invertwin.cli.run_file import load_run
from invertwin.errors import InputError
from invertwin.radar import FMCW, Radar
from invertwin.scene import linear_array
from invertwin.scene.files import load_mesh, load_scene_xml
from invertwin.storage.folders import MANIFEST, read_manifest
from invertwin.storage.untrusted import existing_file, read_npy

READERS = {
    "a.cfg": read_cfg,
    "a.json": ChannelCalibration.load,
    "a.npy": read_npy,
    "a.ply": load_mesh,
    "a.obj": load_mesh,
    "a.toml": load_run,
}


@pytest.mark.parametrize("name", READERS)
def test_files_of_holes_are_refused_before_they_are_read(tmp_path, name):
    with (tmp_path / name).open("wb") as file:
        file.truncate(3 << 30)
    with pytest.raises(InputError, match=r"3\.2 GB of holes"):
        READERS[name](tmp_path / name)


def test_small_holes_and_full_files_are_read(tmp_path):
    with (tmp_path / "a").open("wb") as file:
        file.truncate(1 << 20)
    assert existing_file(tmp_path / "a").stat().st_size == 1 << 20


@pytest.mark.parametrize("name", READERS)
def test_pipes_are_refused_at_once(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match="a pipe or a device"):
        READERS[name](tmp_path / name)


def test_a_manifest_that_is_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / MANIFEST)
    with pytest.raises(InputError, match="a pipe or a device"):
        read_manifest(tmp_path)


def test_run_files_are_limited_before_they_are_parsed(tmp_path):
    (tmp_path / "a.toml").write_text("# " + "x" * 4_000_000)
    with pytest.raises(InputError, match="more than 4 MB"):
        load_run(tmp_path / "a.toml")


def test_a_mesh_whose_materials_are_a_pipe_is_read(tmp_path):
    os.mkfifo(tmp_path / "part.mtl")
    (tmp_path / "part.obj").write_text("mtllib part.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert load_mesh(tmp_path / "part.obj").faces.tolist() == [[0, 1, 2]]


def test_buffers_of_holes_are_not_read(tmp_path):
    """A model of a kilobyte names its buffers; they are limited as the file itself is."""
    export = gltf.export_gltf(trimesh.Scene(trimesh.creation.box()))
    for name, content in export.items():
        (tmp_path / name).write_bytes(content)
    assert load_mesh(tmp_path / "model.gltf").faces.shape == (12, 3)
    with (tmp_path / "gltf_buffer_0.bin").open("wb") as file:
        file.truncate(3 << 30)
    with pytest.raises(InputError, match=r"3\.2 GB of holes"):
        load_mesh(tmp_path / "model.gltf")


def test_groups_of_materials_are_counted_first(tmp_path):
    groups = "".join(f"usemtl x{k}\nf 1 2 3\n" for k in range(10_001))
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + groups)
    with pytest.raises(InputError, match="at most 10,000 groups or nodes"):
        load_mesh(tmp_path / "a.obj")


def test_a_capture_on_a_full_disk_is_an_oserror_and_leaves_nothing(tmp_path):
    places = torch.zeros(1, 3, dtype=torch.float64)
    radar = Radar(linear_array(1, 1e-3), linear_array(2, 2e-3), FMCW(77e9, 2e9, 5e-5, 64), places)
    capture = Capture.from_beat(torch.ones(1, 1, 2, 64, dtype=torch.complex128), radar)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OSError, match="too large"):
            capture.save(tmp_path / "a.nc")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []
    capture.save(tmp_path / "a.nc")
    assert torch.equal(Capture.load(tmp_path / "a.nc").beat, capture.beat)
    with h5py.File(io.BytesIO((tmp_path / "a.nc").read_bytes())) as file:
        assert np.asarray(file["beat_real"]).sum() == 128


def test_meshes_and_scene_files_are_limited_before_they_are_read(tmp_path):
    (tmp_path / "a.stl").write_bytes(bytes(100_000_001))
    with pytest.raises(InputError, match="at most 100,000,000 bytes of a mesh"):
        load_mesh(tmp_path / "a.stl")
    shapes = '<shape type="sphere"/>' * 10_001
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{shapes}</scene>')
    with pytest.raises(InputError, match="at most 10,000 shapes"):
        load_scene_xml(tmp_path / "a.xml")
