"""Files that can hang or crash their reader: a child process reads them and hands over arrays."""

import shutil
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
import pytest
import scipy.io
import xarray as xr

from invertwin.capture import Capture
from invertwin.capture.readers import described_arrays
from invertwin.errors import InputError
from invertwin.storage.isolated_reader import read_isolated

DESCRIPTION = """
[data]
file = "{}"
variable = "adc"
[settings]
start_frequency = 77e9
slope = 60e12
sample_rate = 5e6
"""


def stored(folder):
    """A file of each kind, with what is easily lost: kinds of numbers, text, signs of zeros."""
    values = np.array([[1.5, -0.0, np.nan], [2.0, np.inf, 3.0]], np.float32)
    attributes = {
        "text": "Grün",
        "number": np.float32(0.1),
        "whole": np.int16(3),
        "several": np.arange(3.0),
    }
    names = np.array(["left", "right"])
    dataset = xr.Dataset(
        {"power": (("row", "column"), values, attributes), "half": ((), np.float64(0.5))},
        coords={"row": [3, 4], "side": ("side", names)},
        attrs={"title": "a b", "version": np.int64(2)},
    )
    dataset.drop_vars("side").to_netcdf(folder / "a.nc", engine="h5netcdf")
    with h5py.File(folder / "a.h5", "w") as file:
        file["adc"] = values + 1j
    scipy.io.savemat(folder / "a.mat", {"adc": values + 1j})
    shutil.copy(folder / "a.h5", folder / "seven.mat")


FILES: list[tuple[str, Literal["netcdf", "hdf5", "matlab"]]] = [
    ("a.nc", "netcdf"),
    ("a.h5", "hdf5"),
    ("a.mat", "matlab"),
    ("seven.mat", "matlab"),
]


@pytest.mark.parametrize(("name", "kind"), FILES)
def test_a_child_process_hands_over_every_bit(tmp_path, name, kind):
    stored(tmp_path)
    apart, here = (
        read_isolated(tmp_path / name, kind, "adc", trusted=trusted) for trusted in (False, True)
    )
    assert list(apart.arrays) == list(here.arrays)
    assert repr(apart.attributes) == repr(here.attributes)
    for name, mine in apart.arrays.items():
        other = here.arrays[name]
        assert mine.dimensions == other.dimensions
        assert (mine.values.dtype, mine.values.shape) == (other.values.dtype, other.values.shape)
        assert mine.values.tobytes() == other.values.tobytes()
        assert mine.attributes.keys() == other.attributes.keys()
        for key, value in mine.attributes.items():
            assert type(value) is type(other.attributes[key])
            np.testing.assert_array_equal(value, other.attributes[key])


def test_a_variable_that_is_missing_is_a_key_error(tmp_path):
    stored(tmp_path)
    for name, kind in FILES[1:]:
        for trusted in (False, True):
            with pytest.raises(KeyError, match="power"):
                read_isolated(tmp_path / name, kind, "power", trusted=trusted)


def test_objects_are_not_handed_over(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"adc": np.array([1, "a"], dtype=object)})
    with pytest.raises(InputError, match=r"refuses .*adc holds objects"):
        read_isolated(tmp_path / "a.mat", "matlab", "adc")


def test_modules_beside_the_file_are_not_imported(tmp_path, monkeypatch):
    """A stranger's folder may hold a module with the name of the reader."""
    stored(tmp_path)
    (tmp_path / "h5py.py").write_text("open('imported', 'w')")
    monkeypatch.chdir(tmp_path)
    assert read_isolated(tmp_path / "a.h5", "hdf5", "adc").arrays["adc"].values.shape == (2, 3)
    assert not (tmp_path / "imported").exists()


def test_a_file_that_crashes_its_reader_is_an_error(tmp_path):
    """One wrong byte ends scipy's reader of MATLAB files by a segmentation fault."""
    scipy.io.savemat(tmp_path / "q.mat", {"adc": np.ones((2, 4, 2, 4, 16), np.complex64)})
    (tmp_path / "a.toml").write_text(DESCRIPTION.format("q.mat"))
    assert described_arrays.read_chirps(tmp_path / "a.toml").samples.shape == (2, 4, 2, 4, 16)
    damaged = bytearray((tmp_path / "q.mat").read_bytes())
    damaged[192] = 255
    (tmp_path / "q.mat").write_bytes(damaged)
    with pytest.raises(InputError, match="it is damaged"):
        described_arrays.read_chirps(tmp_path / "a.toml")


@pytest.mark.slow
def test_a_file_that_hangs_its_reader_is_an_error(tmp_path):
    """One byte of a capture makes libhdf5 read for ever."""
    sound = Path(__file__).parents[1] / "capture" / "two_frames.nc"
    assert Capture.load(sound).frame_count == 2
    damaged = bytearray(sound.read_bytes())
    damaged[2760] = 0
    (tmp_path / "a.nc").write_bytes(damaged)
    with pytest.raises(InputError, match="takes its reader more than"):
        Capture.load(tmp_path / "a.nc")


def test_what_the_reader_itself_refuses_is_told(tmp_path):
    shutil.copy(__file__, tmp_path / "a.nc")
    for trusted, said in ((False, "NetCDF file, got .*refuses"), (True, "NetCDF file, got")):
        with pytest.raises(InputError, match=rf"expected a whole {said}.*OSError"):
            Capture.load(tmp_path / "a.nc", trusted=trusted)


def external(file, secret):
    file["adc"] = h5py.ExternalLink(secret, "adc")


def hidden(file, secret):
    file.create_group("a")["b"] = h5py.ExternalLink(secret, "/")
    file["adc"] = h5py.SoftLink("/a/b/adc")


def stored_outside(file, secret):
    file.create_dataset("adc", (2, 3), "f4", external=[(secret, 0, 24)])


def virtual(file, secret):
    layout = h5py.VirtualLayout((2, 3), "f4")
    layout[:] = h5py.VirtualSource(secret, "adc", (2, 3))
    file.create_virtual_dataset("adc", layout)


@pytest.mark.parametrize("make", [external, hidden, stored_outside, virtual])
@pytest.mark.parametrize("kind", ["netcdf", "hdf5", "matlab"])
def test_numbers_of_other_files_are_not_handed_over(tmp_path, make, kind):
    """A stranger's file may name any file of ours as where its numbers are."""
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["adc"] = np.ones((2, 3), np.float32)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(file, str(secret))
    with pytest.raises(InputError, match=r"refuses \(ValueError: .* in another file"):
        read_isolated(tmp_path / "a.h5", kind, "adc")


def test_links_within_a_file_are_followed_and_loops_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x/adc"] = np.arange(3.0)
        file["adc"] = h5py.SoftLink("/x/adc")
        file["loop"] = h5py.SoftLink("/loop")
        file["x/up"] = file["/"]
    assert read_isolated(tmp_path / "a.h5", "hdf5", "adc").arrays["adc"].values.tolist() == [
        0,
        1,
        2,
    ]
    with pytest.raises(InputError, match="expected a whole HDF5 file"):
        read_isolated(tmp_path / "a.h5", "hdf5", "loop")


@pytest.mark.parametrize("kind", ["hdf5", "matlab", "netcdf"])
def test_fill_values_do_not_become_gigabytes(tmp_path, kind):
    """A trusted file is read without limits of memory; none of 1 kB holds 2^25 numbers."""
    path = tmp_path / "sparse.h5"
    with h5py.File(path, "w") as opened:
        opened.create_dataset("adc", (2**25,), "f4", chunks=(2**20,), fillvalue=1.0)
    assert path.stat().st_size < 10_000
    with pytest.raises(ValueError, match=r"3\.36e\+07 numbers in adc of a small file"):
        read_isolated(path, kind, "adc", trusted=True)
