"""The reader of the OpenRadar recording, on a small imitation and on the recording itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from invertwin.errors import InputError
from invertwin.radar.boards import Mounting, board
from invertwin.radar.processing.doppler import compensate_tdm, range_doppler
from invertwin_studies.recordings.kinds import openradar_data
from invertwin_studies.recordings.openradar import FILE, read_chirps

META = {"f0_hz": 77e9, "slope_hz_s": 6e13, "fs_hz": 2.5e6, "idle_s": 3e-5, "ramp_end_s": 6.2e-5}


@pytest.fixture
def write(tmp_path):
    def write(**changes):
        frame = np.arange(6 * 8 * 16).reshape(6, 8, 16) * (1 - 1j)
        arrays = {"frame_2tx4rx": frame.astype(np.complex64), "meta": np.array(json.dumps(META))}
        arrays |= changes
        given = {name: array for name, array in arrays.items() if array is not None}
        np.savez(tmp_path / FILE, allow_pickle=False, **given)
        return tmp_path

    return write


def test_virtual_channels_are_transmitters_times_receivers(write):
    data = read_chirps(write())
    assert data.samples.shape == (1, 6, 2, 4, 16)
    assert data.samples[0, 2, 1, 3, 5] == (2 * 8 * 16 + 7 * 16 + 5) * (1 - 1j)
    assert data.settings.chirps.interval == pytest.approx(92e-6)
    assert data.settings.waveform.bandwidth == pytest.approx(6e13 * 16 / 2.5e6)


def test_a_capture_has_the_elements_of_a_board(write):
    tx, _ = board("xWR1642").arrays()
    found = openradar_data(str(write()))
    assert found.moving
    assert torch.equal(found.radar().transmitters.positions, tx.positions)
    torch.testing.assert_close(found.beat, read_chirps(write()).samples)
    mine = Mounting("xWR1843", elevation=1)
    with pytest.raises(InputError, match="board: "):
        openradar_data(str(write()), replace(mine, transmitters=[1, 3]))
    other = openradar_data(str(write()), mine)
    expected, _ = board("xWR1843").arrays(elevation=1, transmitters=[1, 2])
    assert torch.equal(other.radar().transmitters.positions, expected.positions)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame_2tx4rx": None}, "got none"),
        ({"frame_2tx4rx": np.zeros((6, 7, 16), complex)}, "shape"),
        ({"frame_2tx4rx": np.zeros((6, 8, 16))}, "got float64"),
        ({"meta": None}, "expected meta"),
        ({"meta": np.array("{}")}, "expected meta"),
        ({"meta": np.array("none")}, "expected meta"),
        ({"frame_2tx4rx": np.full((6, 8, 16), np.nan + 0j)}, "finite samples"),
    ],
)
def test_recordings_that_are_wrong_are_refused(write, changes, message):
    with pytest.raises(InputError, match=message):
        read_chirps(write(**changes))


def test_missing_and_truncated_recordings_are_refused(write, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_chirps(tmp_path)
    path = write() / FILE
    whole = path.read_bytes()
    for size in (0, 10, len(whole) // 2):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match="damaged or truncated"):
            read_chirps(tmp_path)


def test_the_recording_has_movers_near_three_metres(data_folder):
    data = read_chirps(data_folder / "openradar")
    assert data.samples.shape == (1, 128, 2, 4, 128)
    window = torch.hann_window(128)
    moving = data.samples - data.samples.mean(1, keepdim=True)
    profile = torch.fft.fft(moving * window, dim=-1).abs().square().sum((0, 1, 2, 3))
    nearest = data.settings.waveform.range_resolution
    ranges = torch.arange(128) * nearest
    assert 2.8 < float(ranges[profile.argmax()]) < 3.2
    capture = data.to_chirp_capture(Mounting("xWR1642")).to_capture(0)
    assert capture.radar().waveform.center_frequency == pytest.approx(78.956e9, rel=1e-4)


def test_the_channels_of_the_mover_are_a_plane_wave(data_folder):
    data = read_chirps(data_folder / "openradar")
    radar = data.to_chirp_capture(Mounting("xWR1642")).radar()
    moving = (data.beat - data.beat.mean(1, keepdim=True)).to(torch.complex128)
    spectrum = range_doppler(moving, radar, radar.grid(2.5, 3.5), data.settings.chirps)
    spectrum = compensate_tdm(spectrum, radar, data.settings.chirps)[0]
    power = spectrum.abs().square().sum((1, 2))
    rate, bin_ = divmod(int(power.argmax()), power.shape[1])
    channels = spectrum[rate, :, :, bin_].flatten()
    steps = torch.linspace(-torch.pi, torch.pi, 721, dtype=torch.float64)
    waves = torch.exp(-1j * steps[:, None] * torch.arange(8))
    coherence = (waves * channels / channels.abs()).mean(1).abs().max()
    assert coherence > 0.99
