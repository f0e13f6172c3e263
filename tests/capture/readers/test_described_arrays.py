"""Samples in NumPy, HDF5 and MATLAB files with a description."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import scipy.io
import torch

from invertwin.capture import ChirpData, ChirpSettings, read
from invertwin.capture.readers.described_arrays import (
    load_described_board,
    read_chirps,
    write_chirps,
)
from invertwin.errors import InputError
from invertwin.radar.boards import board
from invertwin.radar.waveform import PhysicsWarning

SETTINGS = ChirpSettings(
    start_frequency=77.4201e9,
    slope=60.012e12,
    sample_rate=2.5e6,
    samples=8,
    transmit_order=(1, 3, 2),
    receivers=(1, 2, 3, 4),
    loops=2,
    frames=5,
    frame_period=0.1,
    idle_time=30e-6,
    ramp_end_time=62e-6,
)
FILES = ["adc.npy", "adc.npz", "adc.h5", "adc.hdf5", "adc.mat"]
TOML = """\
frame = 2

[data]
file = "adc.npy"
dimensions = ["tx", "frame", "rx", "sample"]

[settings]
start_frequency = 77e9
slope = 60e12
sample_rate = 5e6

[radar]
board = "xWR1843"
elevation = 1
"""


def chirps(dtype=torch.complex64, settings=SETTINGS):
    generator = torch.Generator().manual_seed(2)
    shape = (5, 2, 3, 4, settings.samples)
    samples = torch.randn(shape, dtype=dtype, generator=generator)
    samples.imag[0, 0, 0, 0, 0] = -0.0
    return ChirpData(samples.real + 0j if settings.real else samples, settings)


@pytest.fixture
def described(tmp_path):
    """Writes an array and its description, and returns the path of the latter."""

    def write(array=None, old="", new=""):
        assert old in TOML
        shape = (3, 5, 4, 8)
        array = np.arange(np.prod(shape)).reshape(shape) * (1 + 2j) if array is None else array
        np.save(tmp_path / "adc.npy", array)
        path = tmp_path / "adc.toml"
        path.write_text(TOML.replace(old, new))
        return path

    return write


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128], ids=str)
def test_samples_survive_bit_for_bit(tmp_path, file, dtype):
    data = chirps(dtype)
    write_chirps(tmp_path / "adc.toml", data, file)
    back = read_chirps(tmp_path / "adc.toml")
    assert back.settings == SETTINGS
    assert back.samples.dtype == dtype
    assert torch.equal(
        torch.view_as_real(back.samples).signbit(), torch.view_as_real(data.samples).signbit()
    )
    assert torch.equal(back.samples, data.samples)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([file, "adc.toml"])


@pytest.mark.parametrize("file", FILES)
def test_real_samples_survive(tmp_path, file):
    data = chirps(settings=replace(SETTINGS, real=True))
    write_chirps(tmp_path / "adc.toml", data, file)
    back = read_chirps(tmp_path / "adc.toml")
    assert back.settings == data.settings
    assert torch.equal(back.samples, data.samples)


def test_dimensions_may_come_in_any_order(described):
    data = read_chirps(described())
    assert data.samples.shape == (5, 1, 3, 4, 8)
    assert data.samples[1, 0, 2, 3, 7] == (2 * 160 + 32 + 3 * 8 + 7) * (1 + 2j)
    assert (data.settings.transmit_order, data.settings.loops) == ((1, 2, 3), 1)


def test_virtual_channels_are_separated(described):
    array = np.arange(2 * 12 * 8).reshape(2, 12, 8) + 1j
    path = described(array, '["tx", "frame", "rx", "sample"]', '["chirp", "virtual", "sample"]')
    with pytest.raises(InputError, match="divides 12 virtual channels"):
        read_chirps(path)
    path.write_text(path.read_text().replace("slope", "transmit_order = [1, 3, 2]\nslope"))
    data = read_chirps(path)
    assert data.samples.shape == (1, 2, 3, 4, 8)
    assert data.samples[0, 1, 2, 1, 0].real == (12 + 2 * 4 + 1) * 8


def test_negative_frequencies_are_conjugated(described):
    plain = read_chirps(described())
    turned = read_chirps(described(None, "[settings]", "conjugate = true\n[settings]"))
    assert torch.equal(turned.samples, plain.samples.conj().resolve_conj())


def test_i_and_q_may_be_a_dimension(described):
    array = np.arange(3 * 5 * 2 * 4 * 8, dtype=np.int16).reshape(3, 5, 2, 4, 8)
    path = described(array, '"frame", "rx"', '"frame", "iq", "rx"')
    data = read_chirps(path)
    assert data.samples.shape == (5, 1, 3, 4, 8)
    assert not data.settings.real
    assert data.samples.dtype == torch.complex64
    assert data.samples[1, 0, 2, 3, 7] == complex(*array[2, 1, :, 3, 7].tolist())
    np.save(path.parent / "adc.npy", array[:, :, :1])
    with pytest.raises(InputError, match="2 of them along iq, I and Q"):
        read_chirps(path)


@pytest.mark.parametrize(
    "names", [("real", "imag"), ("imag", "real"), ("i", "r"), ("I", "Q"), ("Q", "I")]
)
def test_parts_are_told_by_their_names(tmp_path, described, names):
    pairs = np.zeros((3, 5, 4, 8), [(name, "<i2") for name in names])
    pairs[next(name for name in names if name in ("real", "r", "I"))] = 3
    pairs[next(name for name in names if name in ("imag", "i", "Q"))] = -4
    path = described(None, 'file = "adc.npy"', 'file = "adc.h5"\nvariable = "x"')
    with h5py.File(tmp_path / "adc.h5", "w") as file:
        file["x"] = pairs
    assert (read_chirps(path).samples == 3 - 4j).all()


def test_powers_are_no_samples(described):
    generator = np.random.default_rng(3)
    shape = (3, 5, 4, 8)
    with pytest.raises(InputError, match="which oscillate, got numbers as powers"):
        read_chirps(described(generator.standard_normal(shape) ** 2))
    offset = np.round(100 * generator.standard_normal(shape) + 2048).astype(np.uint16)
    assert read_chirps(described(offset)).settings.real


def test_whole_numbers_may_be_saturated(described):
    array = np.zeros((3, 5, 4, 8), np.int16)
    array[0, 0, 0, :2] = 32767, -32768
    with pytest.warns(PhysicsWarning, match="2 of 480 samples"):
        data = read_chirps(described(array))
    assert data.settings.real


def test_matlab_shows_dimensions_in_its_own_order(tmp_path, described):
    path = described(None, 'file = "adc.npy"', 'file = "adc.mat"\nvariable = "x"')
    array = np.load(tmp_path / "adc.npy")
    scipy.io.savemat(tmp_path / "adc.mat", {"x": array})
    old = read_chirps(path).samples
    # As MATLAB 7.3 writes: a header of 512 bytes, complex numbers as pairs, columns first.
    pairs = np.zeros(array.T.shape, [("real", "<f8"), ("imag", "<f8")])
    pairs["real"], pairs["imag"] = array.T.real, array.T.imag
    with h5py.File(tmp_path / "adc.mat", "w", userblock_size=512) as file:
        file["x"] = pairs
    assert torch.equal(read_chirps(path).samples, old)


def test_a_description_becomes_a_capture(described):
    capture = read(described()).to_capture(0)
    assert torch.equal(capture.beat, read_chirps(described()).samples[:, 0])
    tx, _ = board("xWR1843").arrays(elevation=1)
    assert torch.equal(capture.radar().transmitters.positions, tx.positions)
    down = read(described(), board=load_described_board(described(), elevation=-1))
    assert torch.equal(down.radar().transmitters.positions[:, 2], -tx.positions[:, 2])
    other = board("xWR1443").arrays(elevation=1, azimuth=-1)
    given = read(described(), board=other)
    assert torch.equal(given.radar().receivers.positions, other[1].positions)


def test_elements_may_be_listed(described):
    tx = [[0.0, 0.004 * i, 0.0] for i in range(3)]
    rx = [[0.0, 0.001 * i, 0.0] for i in range(4)]
    listed = f"tx_positions = {tx}\nrx_positions = {rx}\n"
    preset = 'board = "xWR1843"\nelevation = 1\n'
    capture = read(described(None, preset, listed))
    assert capture.radar().receivers.positions.tolist() == rx
    wrong = described(None, preset, listed.replace("[0.0, 0.0, 0.0]", "1"))
    with pytest.raises(InputError, match="TX positions"):
        read(wrong)
    with pytest.raises(InputError, match=r"either a board or tx_positions .* got neither"):
        read(described(None, preset, ""))
    with pytest.raises(InputError, match=r"either a board or tx_positions .* got both"):
        read(described(None, preset, preset + listed))


def test_elements_survive_and_those_of_an_old_description_are_turned(tmp_path):
    """Elements to the left, above and ahead, as versions before 0.4 wrote them, and as now."""
    elements = board("xWR1843").arrays(elevation=1, transmitters=[1, 3, 2])
    write_chirps(tmp_path / "adc.toml", chirps(), "adc.npy", elements)
    new = (tmp_path / "adc.toml").read_text()
    assert new.startswith("frame = 2\n")
    read_back = load_described_board(tmp_path / "adc.toml")
    assert isinstance(read_back, tuple)
    for found, array in zip(read_back, elements, strict=True):
        assert torch.equal(found.positions, array.positions)
    listed = "tx_positions = [[0.002, 0.001, 0.0]]\nrx_positions = [[-0.002, 0.0, 0.003]]\n"
    old = new.partition("[radar]\n")[0].removeprefix("frame = 2\n") + "[radar]\n" + listed
    (tmp_path / "adc.toml").write_text(old)
    with pytest.warns(PhysicsWarning, match="tx_positions in adc.toml along x left, y up, z ahead"):
        turned = load_described_board(tmp_path / "adc.toml")
    assert isinstance(turned, tuple)
    tx, rx = turned
    assert tx.positions.tolist() == [[0.0, 0.002, 0.001]]
    assert rx.positions.tolist() == [[0.003, -0.002, 0.0]]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frame = 2", "frame = 1", "expected frame = 2 in adc.toml, got 1"),
        ("[radar]", "[antenna]", r"got \[antenna\]"),
        ("slope", "slop", r"keys of the documentation in adc.toml, got \['slop'\] in \[settings\]"),
        ("slope = 60e12\n", "", "start_frequency, slope and sample_rate"),
        ("77e9", '"77 GHz"', "start_frequency"),
        ('file = "adc.npy"\n', "", "a file and"),
        ("adc.npy", "missing.npy", "got no file .*missing.npy"),
        ("adc.npy", "adc.toml", "ends in .npy"),
        ('"tx", "frame"', '"tx", "tx"', "different names"),
        ('"tx", "frame"', '"tx"', "different names"),
        ('"tx", "frame"', '"virtual", "frame"', "different names"),
        ('"sample"]', '"chirp"]', "with sample"),
        ("[data]", "[data", "expected TOML"),
    ],
)
def test_descriptions_that_do_not_fit_are_refused(described, old, new, message):
    with pytest.raises(InputError, match=message):
        read_chirps(described(None, old, new))


@pytest.mark.parametrize("file", FILES[1:])
def test_variables_and_damage(tmp_path, file):
    write_chirps(tmp_path / "adc.toml", chirps(), file)
    text = (tmp_path / "adc.toml").read_text()
    (tmp_path / "adc.toml").write_text(text.replace('variable = "adc"', 'variable = "x"'))
    with pytest.raises(InputError, match="expected a variable 'x'"):
        read_chirps(tmp_path / "adc.toml")
    (tmp_path / "adc.toml").write_text(text.replace('variable = "adc"', ""))
    with pytest.raises(InputError, match="expected a variable in"):
        read_chirps(tmp_path / "adc.toml")
    (tmp_path / "adc.toml").write_text(text)
    whole = (tmp_path / file).read_bytes()
    for size in (0, 7, len(whole) // 2):
        (tmp_path / file).write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"damaged or of another kind|an empty file"):
            read_chirps(tmp_path / "adc.toml")


def test_bytes_of_a_small_file_do_not_become_gigabytes(tmp_path, described):
    """The bytes are within the budget of an archive; the complex numbers from them are not."""
    path = described(None, 'file = "adc.npy"', 'file = "adc.npz"\nvariable = "adc"')
    for count in (2**14, 2**15 + 1):
        zeros = np.zeros((1, count, 64, 8), dtype=np.int8)
        np.savez_compressed(tmp_path / "adc.npz", adc=zeros)
        if count == 2**14:
            assert read_chirps(path).samples.numel() == zeros.size
    with pytest.raises(InputError, match=r"recorded samples in adc\.npz, got 1\.68e\+07 numbers"):
        read_chirps(path)


def test_other_files_are_refused(tmp_path, described):
    with pytest.raises(InputError, match="no file"):
        read_chirps(tmp_path / "missing.toml")
    path = described(np.array(["a"]))
    with pytest.raises(InputError, match="expected numbers"):
        read_chirps(path)
    with pytest.raises(InputError, match="existing folder"):
        write_chirps(tmp_path / "nowhere" / "adc.toml", chirps(), "adc.npy")
    for file in ("adc.csv", "../adc.npy"):
        with pytest.raises(InputError, match="file name that ends in"):
            write_chirps(tmp_path / "adc.toml", chirps(), file)
