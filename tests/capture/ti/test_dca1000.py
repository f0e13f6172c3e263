"""DCA1000 recordings: the order of words, bit for bit, and sizes that contradict the settings."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from invertwin.capture import Capture, ChirpData, ChirpSettings, adc_counts, read
from invertwin.capture.ti import (
    read_samples,
    recorded_files,
    write_cfg,
    write_samples,
    write_setup,
    write_studio,
)
from invertwin.errors import InputError
from invertwin.radar.boards import Mounting, board
from invertwin.radar.waveform import PhysicsWarning

SETTINGS = ChirpSettings(
    start_frequency=77e9,
    slope=60e12,
    sample_rate=5e6,
    samples=10,
    transmit_order=(1, 3, 2),
    receivers=(1, 2, 4),
    loops=2,
    frames=3,
    frame_period=0.1,
    idle_time=7e-6,
    lanes=2,
)
KINDS = [
    {"lanes": lanes, "real": real, "swap_iq": swap}
    for lanes in (2, 4)
    for real, swap in ((False, False), (False, True), (True, False))
]


def counts(settings, seed=0, low=-20000, high=20000):
    shape = (settings.frames, settings.loops, len(settings.transmit_order))
    shape = (*shape, len(settings.receivers), settings.samples, 2)
    generator = np.random.default_rng(seed)
    parts = generator.integers(low, high, shape).astype(np.float32)
    if settings.real:
        parts[..., 1] = 0
    return ChirpData(torch.view_as_complex(torch.from_numpy(parts)), settings)


def words_of(path):
    return np.fromfile(path, "<i2")


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_samples_and_files_survive_bit_for_bit(tmp_path, kind):
    settings = replace(SETTINGS, **kind)
    data, path = counts(settings), tmp_path / "adc.bin"
    write_samples(path, data)
    back = read_samples(path, settings)
    assert torch.equal(back.samples, data.samples)
    assert back.settings == settings
    again = tmp_path / "again.bin"
    write_samples(again, back)
    assert again.read_bytes() == path.read_bytes()


def test_any_recorded_file_survives_bit_for_bit(tmp_path):
    settings = replace(SETTINGS, receivers=(1, 2, 3, 4))
    for kind in KINDS:
        chosen = replace(settings, **kind)
        size = 3 * 6 * 4 * 10 * (1 if kind["real"] else 2)
        raw = np.random.default_rng(1).integers(-30000, 30000, size).astype("<i2")
        raw.tofile(tmp_path / "adc.bin")
        write_samples(tmp_path / "again.bin", read_samples(tmp_path / "adc.bin", chosen))
        assert np.array_equal(words_of(tmp_path / "again.bin"), raw)


def one_chirp(**kind):
    settings = replace(SETTINGS, loops=1, frames=1, samples=4, transmit_order=(1,), **kind)
    return replace(settings, receivers=(1, 2, 3, 4))


def labelled(settings):
    """Sample n of receiver r is 100 r + n, its Q 1000 more."""
    value = 100 * torch.arange(1, 5)[:, None] + torch.arange(4)
    samples = value + 0j if settings.real else value + 1j * (value + 1000)
    return ChirpData(samples.to(torch.complex64)[None, None, None], settings)


def test_two_lanes_are_receiver_after_receiver_in_pairs(tmp_path):
    write_samples(tmp_path / "a", labelled(one_chirp()))
    expected = [100, 101, 1100, 1101, 102, 103, 1102, 1103, 200, 201, 1200, 1201]
    assert words_of(tmp_path / "a")[:12].tolist() == expected
    write_samples(tmp_path / "a", labelled(one_chirp(swap_iq=True)))
    assert words_of(tmp_path / "a")[:4].tolist() == [1100, 1101, 100, 101]
    write_samples(tmp_path / "a", labelled(one_chirp(real=True)))
    assert words_of(tmp_path / "a")[:6].tolist() == [100, 101, 102, 103, 200, 201]


def test_four_lanes_are_receivers_side_by_side(tmp_path):
    write_samples(tmp_path / "a", labelled(one_chirp(lanes=4)))
    expected = [100, 200, 300, 400, 1100, 1200, 1300, 1400, 101, 201, 301, 401]
    assert words_of(tmp_path / "a")[:12].tolist() == expected
    write_samples(tmp_path / "a", labelled(one_chirp(lanes=4, real=True)))
    assert words_of(tmp_path / "a")[:8].tolist() == [100, 200, 300, 400, 101, 201, 301, 401]


def test_lanes_without_receiver_are_silent(tmp_path):
    settings = replace(SETTINGS, lanes=4)
    write_samples(tmp_path / "a", counts(settings))
    lanes = words_of(tmp_path / "a").reshape(-1, 4)
    assert not lanes[:, 2].any()
    assert lanes[:, [0, 1, 3]].any(axis=0).all()


def test_transmitters_come_in_their_turns(tmp_path):
    settings = replace(one_chirp(real=True), transmit_order=(1, 3, 2))
    samples = torch.tensor(settings.transmit_order)[:, None, None] * torch.ones(3, 4, 4) + 0j
    write_samples(tmp_path / "a", ChirpData(samples.to(torch.complex64)[None, None], settings))
    assert words_of(tmp_path / "a").reshape(3, 16)[:, 0].tolist() == [1, 3, 2]
    assert read_samples(tmp_path / "a", settings).samples[0, 0, :, 0, 0].real.tolist() == [1, 3, 2]


def test_twelve_bits_may_lack_their_sign(tmp_path):
    settings = replace(one_chirp(real=True), bits=12)
    raw = np.arange(16, dtype="<i2")
    raw[3] = 4095
    raw.tofile(tmp_path / "a")
    assert read_samples(tmp_path / "a", settings).samples[0, 0, 0, 0, 3] == -1


def test_split_recordings_are_one(tmp_path):
    data = counts(SETTINGS)
    write_samples(tmp_path / "whole.bin", data)
    whole = (tmp_path / "whole.bin").read_bytes()
    parts = [tmp_path / "adc_Raw_0.bin", tmp_path / "adc_Raw_1.bin"]
    parts[0].write_bytes(whole[:1001])
    parts[1].write_bytes(whole[1001:])
    assert torch.equal(read_samples(parts, SETTINGS).samples, data.samples)
    setup = tmp_path / "bench.setup.json"
    files = {"fileBasePath": "D:\\data", "files": [{"rawFileName": p.name} for p in parts]}
    setup.write_text(json.dumps({"capturedFiles": files}))
    assert recorded_files(setup) == parts
    setup.write_text("{}")
    with pytest.raises(InputError, match="expected capturedFiles"):
        recorded_files(setup)


def test_an_incomplete_last_frame_is_dropped_with_a_warning(tmp_path):
    data, path = counts(SETTINGS), tmp_path / "adc.bin"
    write_samples(path, data)
    whole = path.read_bytes()
    frame = len(whole) // 3
    path.write_bytes(whole[: 2 * frame + 100])
    for settings in (SETTINGS, replace(SETTINGS, frames=None)):
        message = rf"2 whole frames are read, 1 incomplete frame \(100 of {frame} bytes\)"
        with pytest.warns(PhysicsWarning, match=message):
            back = read_samples(path, settings)
        assert torch.equal(back.samples, data.samples[:2])
        assert back.settings.frames == 2


def test_a_recording_that_was_stopped_is_warned_of(tmp_path):
    settings = replace(SETTINGS, frames=7)
    path = tmp_path / "adc.bin"
    write_samples(path, counts(replace(settings, frames=5)))
    with pytest.warns(PhysicsWarning, match="holds 5 of the 7 frames"):
        assert read_samples(path, settings).frame_count == 5
    assert read_samples(path, replace(settings, frames=None)).frame_count == 5


def test_saturated_samples_are_warned_of(tmp_path):
    data = counts(SETTINGS)
    data.samples[0, 0, 0, 0, :3] = 32767
    data.samples.imag[2, 0, 0, 0, 0] = -32768
    write_samples(tmp_path / "adc.bin", data)
    with pytest.warns(PhysicsWarning, match="4 of 540 samples .* saturated"):
        read_samples(tmp_path / "adc.bin", SETTINGS)


@pytest.mark.parametrize(
    ("change", "fits"),
    [
        ({"samples": 20}, "samples=10"),
        ({"samples": 8}, "samples=10"),
        ({"loops": 5}, "loops=2"),
        ({"real": True}, "real=False"),
        ({"lanes": 4}, "lanes=2"),
        ({"receivers": (1, 2, 3, 4)}, "receivers=3"),
        ({"transmit_order": (1, 2)}, "transmitters=3"),
        ({"frames": 2}, "frames=3"),
        ({"frames": 6}, "frames=3"),
        ({"samples": 7000}, "samples=10"),
        ({"samples": 14, "loops": 11}, "samples=10, loops=2"),
    ],
)
def test_contradictory_settings_say_what_fits(tmp_path, change, fits):
    write_samples(tmp_path / "adc.bin", counts(SETTINGS))
    with pytest.raises(InputError, match=rf"what fits: .*{fits}"):
        read_samples(tmp_path / "adc.bin", replace(SETTINGS, **change))


def test_what_is_no_recording_is_refused(tmp_path):
    path = tmp_path / "adc.bin"
    with pytest.raises(InputError, match="no file"):
        read_samples(path, SETTINGS)
    path.write_bytes(b"\0" * 4321)
    with pytest.raises(InputError, match=r"odd number of bytes \(4321\)"):
        read_samples(path, SETTINGS)
    path.write_bytes(b"\0" * 2)
    with pytest.raises(InputError, match="no one or two changes of the settings fit"):
        read_samples(path, SETTINGS)
    with pytest.raises(InputError, match="at least one frame of 720 bytes"):
        read_samples(path, replace(SETTINGS, frames=None))
    with pytest.raises(InputError, match="expected settings with 2 or 4 LVDS lanes"):
        read_samples(path, replace(SETTINGS, lanes=None))
    with pytest.raises(InputError, match="an even number of samples"):
        read_samples(path, replace(SETTINGS, samples=9))
    with pytest.raises(InputError, match="receivers 1 to 4"):
        read_samples(path, replace(SETTINGS, receivers=(5,), lanes=4))


def test_what_is_no_count_is_not_written(tmp_path):
    data = counts(SETTINGS)
    for factor in (0.3, 1000.0):
        with pytest.raises(InputError, match="whole counts"):
            write_samples(tmp_path / "a", replace(data, samples=data.samples * factor))
    with pytest.raises(InputError, match="without imaginary part"):
        write_samples(tmp_path / "a", replace(data, settings=replace(SETTINGS, real=True)))
    with pytest.raises(InputError, match="existing folder"):
        write_samples(tmp_path / "nowhere" / "a", data)


def test_a_recording_becomes_a_capture(tmp_path):
    data = counts(SETTINGS)
    write_samples(tmp_path / "adc.bin", data)
    write_cfg(tmp_path / "profile.cfg", SETTINGS)
    mounted = Mounting("xWR1843", elevation=-1)
    capture = read(tmp_path / "adc.bin", tmp_path / "profile.cfg", board=mounted).to_capture(1)
    assert torch.equal(capture.beat, data.samples[:, 1])
    assert capture.times.tolist() == pytest.approx([0.0, 0.1, 0.2])
    tx, rx = board("xWR1843").arrays(elevation=-1, transmitters=[1, 3, 2], receivers=[1, 2, 4])
    assert torch.equal(capture.radar().transmitters.positions, tx.positions)
    assert torch.equal(capture.radar().receivers.positions, rx.positions)
    capture.save(tmp_path / "capture.nc")
    assert torch.equal(Capture.load(tmp_path / "capture.nc").beat, capture.beat)
    unknown = replace(SETTINGS, lanes=None)
    given = read(tmp_path / "adc.bin", unknown, board=(tx, rx), lanes=2)
    torch.testing.assert_close(given.to_capture().beat, data.samples.mean(1))


def test_a_setup_is_enough(tmp_path):
    data = counts(SETTINGS)
    write_samples(tmp_path / "adc_Raw_0.bin", data)
    write_studio(tmp_path / "bench.mmwave.json", SETTINGS)
    files = {"fileBasePath": "D:\\data", "files": [{"rawFileName": "adc_Raw_0.bin"}]}
    setup = {"configUsed": "D:\\data\\bench.mmwave.json", "capturedFiles": files}
    (tmp_path / "bench.setup.json").write_text(json.dumps(setup))
    mounted = Mounting("xWR1843", elevation=1)
    capture = read(tmp_path / "bench.setup.json", board=mounted).to_capture(0)
    assert torch.equal(capture.beat, data.samples[:, 0])
    write_setup(
        tmp_path / "own.setup.json", tmp_path / "bench.mmwave.json", [tmp_path / "adc_Raw_0.bin"]
    )
    own = read(tmp_path / "own.setup.json", board=mounted).to_capture(0)
    assert torch.equal(own.beat, capture.beat)
    with pytest.raises(InputError, match=r"expected adc_Raw_1\.bin beside"):
        write_setup(tmp_path / "x.setup.json", "bench.mmwave.json", ["adc_Raw_1.bin"])
    with pytest.raises(InputError, match="existing folder"):
        write_setup(tmp_path / "nowhere" / "x.setup.json", "bench.mmwave.json", [])
    with pytest.raises(InputError, match=r"to end in .cfg, .json, got"):
        read(tmp_path / "adc_Raw_0.bin", board=mounted)


def test_a_simulated_echo_is_found_in_its_file(tmp_path):
    settings = replace(SETTINGS, samples=64, frames=1, swap_iq=True)
    chirp = settings.waveform
    cycles = 2 * 3.0 / 299792458.0 * (chirp.start_frequency + chirp.slope * chirp.sample_times)
    beat = (2e-5 * torch.exp(2j * torch.pi * cycles)).expand(1, 3, 3, 64)
    write_samples(tmp_path / "adc.bin", adc_counts(beat, settings, full_scale=1e-4))
    mounted = Mounting("xWR1843", elevation=1)
    capture = read(tmp_path / "adc.bin", settings, board=mounted).to_capture()
    grid = capture.radar().grid(0.0, 6.0)
    profile = capture.spectrum(grid)[0].amax((1, 2))
    assert grid.ranges[profile.argmax()] == pytest.approx(3.0, abs=chirp.range_resolution / 2)
    assert float(profile.max().sqrt()) * 1e-4 / 32767 == pytest.approx(2e-5, rel=0.15)


def openradar_organize(raw, chirps, receivers, samples):
    """OpenRadar, mmwave/dataloader/adc.py: DCA1000.organize, for 2 lanes."""
    found = np.zeros(len(raw) // 2, dtype=complex)
    found[0::2] = raw[0::4] + 1j * raw[2::4]
    found[1::2] = raw[1::4] + 1j * raw[3::4]
    return found.reshape(chirps, receivers, samples)


def readdca1000(raw, receivers):
    """TI, SWRA581, readDCA1000.m for the xWR12xx and xWR14xx: [receiver, all samples]."""
    columns = raw.reshape(-1, 2 * receivers).T
    return columns[:receivers] + 1j * columns[receivers:]


@pytest.mark.parametrize("lanes", [2, 4])
def test_other_tools_find_the_samples_and_the_echo(tmp_path, lanes):
    """Their own few lines, not ours; receivers grow in phase as they were told to."""
    settings = replace(SETTINGS, samples=64, frames=1, receivers=(1, 2, 3, 4), lanes=lanes)
    chirp = settings.waveform
    cycles = 2 * 3.0 / 299792458.0 * (chirp.start_frequency + chirp.slope * chirp.sample_times)
    turns = 0.1 * torch.arange(4.0)[:, None] + 0.2 * torch.arange(3.0)[:, None, None]
    beat = torch.exp(2j * torch.pi * (cycles + turns))[None]
    data = adc_counts(beat, settings, full_scale=2.0)
    write_samples(tmp_path / "adc.bin", data)
    raw = words_of(tmp_path / "adc.bin")
    chirps = settings.loops * 3
    if lanes == 2:
        found = openradar_organize(raw, chirps, 4, 64)
    else:
        found = readdca1000(raw, 4).reshape(4, chirps, 64).swapaxes(0, 1)
    expected = data.samples[0].flatten(0, 1).numpy()
    assert (found == expected).all()
    profile = np.fft.fft(found, axis=-1)
    assert (np.abs(profile).argmax(-1) == round(3.0 / chirp.range_resolution)).all()


def test_a_capture_needs_a_board(tmp_path):
    write_samples(tmp_path / "adc.bin", counts(SETTINGS))
    with pytest.raises(InputError, match="expected the board that recorded, got none"):
        read(tmp_path / "adc.bin", SETTINGS)
    with pytest.raises(InputError, match="TX numbers of xWR1642"):
        read(tmp_path / "adc.bin", SETTINGS, board=Mounting("xWR1642"))
