"""Settings files of the SDK and of mmWave Studio: read, written, refused."""

import json
from dataclasses import replace

import pytest

from invertwin.capture import ChirpSettings
from invertwin.capture.ti import read_cfg, read_settings, read_studio, write_cfg, write_studio
from invertwin.errors import InputError

# An xWR18xx demo profile: three transmitters in the order TX1, TX3, TX2.
CFG = """\
% ***************************************************************
% Created for SDK ver:03.06
% Platform:xWR18xx
% ***************************************************************
sensorStop
flushCfg
dfeDataOutputMode 1
channelCfg 15 7 0
adcCfg 2 1
adcbufCfg -1 0 1 1 1
profileCfg 0 77.01 7 6.5 57.14 0 0 70 1 256 5209 0 0 30
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 4
chirpCfg 2 2 0 0 0 0 0 2
frameCfg 0 2 16 0 100.5 1 0
lowPower 0 0
guiMonitor -1 1 1 0 0 0 1
lvdsStreamCfg -1 0 1 0
sensorStart
"""
EXPECTED = ChirpSettings(
    start_frequency=77.01e9,
    slope=70e12,
    sample_rate=5.209e6,
    samples=256,
    transmit_order=(1, 3, 2),
    receivers=(1, 2, 3, 4),
    loops=16,
    frame_period=0.1005,
    idle_time=7e-6,
    adc_start_time=6.5e-6,
    ramp_end_time=57.14e-6,
    swap_iq=True,
    lanes=2,
)
CASES = [
    EXPECTED,
    replace(EXPECTED, frames=12, receivers=(1, 3), swap_iq=False, real=True),
    replace(EXPECTED, lanes=4, bits=12, transmit_order=(2,), start_frequency=60.25e9),
    replace(EXPECTED, slope=29.982e12, frame_period=None, adc_start_time=0.0, bits=14),
]


@pytest.fixture
def cfg(tmp_path):
    def write(old="", new=""):
        assert old in CFG
        path = tmp_path / "profile.cfg"
        path.write_text(CFG.replace(old, new))
        return path

    return write


def test_a_cfg_is_read(cfg):
    assert read_cfg(cfg()) == EXPECTED
    assert read_settings(cfg()) == EXPECTED


def test_repeated_and_ranged_chirps_are_loops(cfg):
    path = cfg("frameCfg 0 2 16", "chirpCfg 3 6 0 0 0 0 0 2\nframeCfg 3 6 16")
    settings = read_cfg(path)
    assert (settings.transmit_order, settings.loops) == ((2,), 64)


def test_the_first_sdk_has_no_sub_frame_in_adcbuf(cfg):
    assert not read_cfg(cfg("adcbufCfg -1 0 1 1 1", "adcbufCfg 0 0 1 1")).swap_iq
    assert read_cfg(cfg("adcbufCfg -1 0 1 1 1", "adcbufCfg 0 1 1 1")).swap_iq


def test_the_mcu_plus_sdk_repeats_the_samples_in_frame_cfg(cfg):
    settings = read_cfg(cfg("frameCfg 0 2 16 0 100.5 1 0", "frameCfg 0 2 16 20 256 560 1 0"))
    assert (settings.frames, settings.frame_period) == (20, 0.56)
    with pytest.raises(InputError, match="expected 256 samples in frameCfg"):
        read_cfg(cfg("frameCfg 0 2 16 0 100.5 1 0", "frameCfg 0 2 16 20 128 560 1 0"))


def test_unknown_platforms_have_no_lanes(cfg):
    assert read_cfg(cfg("xWR18xx", "AWR294X")).lanes is None
    assert read_cfg(cfg("xWR18xx", "xWR14xx")).lanes == 4


@pytest.mark.parametrize("settings", CASES)
def test_settings_survive_a_cfg(tmp_path, settings):
    path = tmp_path / "written.cfg"
    write_cfg(path, settings)
    assert read_cfg(path) == settings
    whole = path.read_bytes()
    write_cfg(path, read_cfg(path))
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    ("start", "lanes", "device"), [(60e9, 2, "xWR68xx"), (77e9, 2, "xWR18xx"), (77e9, 4, "xWR1443")]
)
def test_a_cfg_names_a_device_of_its_band(tmp_path, start, lanes, device):
    path = tmp_path / "written.cfg"
    write_cfg(path, replace(EXPECTED, start_frequency=start, lanes=lanes))
    assert path.read_text().splitlines()[0] == f"% Platform:{device}"


@pytest.mark.parametrize("settings", CASES)
def test_settings_survive_mmwave_studio(tmp_path, settings):
    path = tmp_path / "written.mmwave.json"
    write_studio(path, settings)
    assert read_studio(path) == settings
    assert read_settings(path) == settings


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("channelCfg 15 7 0\n", "", "expected a line channelCfg"),
        ("chirpCfg", "chirp", "expected a line chirpCfg"),
        ("profileCfg 0 77.01", "profileCfg 0 high", "numbers as arguments in profile.cfg"),
        ("frameCfg 0 2 16 0 100.5 1 0", "frameCfg 0 2", "at least 5 arguments of frameCfg"),
        ("frameCfg 0 2", "frameCfg 0 3", "got none for 3"),
        ("chirpCfg 1 1 0 0 0 0 0 4", "chirpCfg 1 1 0 0 0 0 0 5", "one transmitter per chirp"),
        ("chirpCfg 1 1 0 0 0 0 0 4", "chirpCfg 1 1 0 0 0 0 0 0", "got 0 in chirp 1"),
        ("chirpCfg 1 1 0 0 0 0 0 4", "chirpCfg 1 1 0 0 0 0 0 1", "once per loop"),
        ("chirpCfg 1 1 0 0", "chirpCfg 1 1 0 100", "chirps that differ"),
        ("chirpCfg 1 1 0", "chirpCfg 1 1 1", "one defined profile"),
        ("channelCfg 15 7", "channelCfg 15 3", r"got TX \{3\}"),
        ("adcCfg 2 1", "adcCfg 7 1", "bits 0 to 2"),
        ("lvdsStreamCfg -1 0", "lvdsStreamCfg -1 1", "headers"),
        ("lowPower 0 0", "subFrameCfg 0 0 0 3 64", "sub-frames"),
        ("57.14", "40", "ramp of at least"),
    ],
)
def test_a_cfg_that_cannot_be_used_is_refused(cfg, old, new, message):
    with pytest.raises(InputError, match=message):
        read_cfg(cfg(old, new))


def test_files_of_another_kind_are_refused(tmp_path):
    with pytest.raises(InputError, match="no file"):
        read_cfg(tmp_path / "missing.cfg")
    with pytest.raises(InputError, match=r"to end in .cfg, .json, got"):
        read_settings(tmp_path / "profile.txt")
    path = tmp_path / "adc.cfg"
    path.write_bytes(b"\xff\xfe\x00\x80" * 10)
    with pytest.raises(InputError, match="no text"):
        read_cfg(path)
    for write in (write_cfg, write_studio):
        with pytest.raises(InputError, match="existing folder"):
            write(tmp_path / "nowhere" / "file", EXPECTED)
    with pytest.raises(InputError, match="with 2 or 4 lanes"):
        write_studio(tmp_path / "x.mmwave.json", replace(EXPECTED, lanes=None))


@pytest.fixture
def studio(tmp_path):
    """Writes settings after a change of the content."""

    def write(change=lambda device: None):
        path = tmp_path / "bench.mmwave.json"
        write_studio(path, EXPECTED)
        content = json.loads(path.read_text())
        change(content["mmWaveDevices"][0])
        path.write_text(json.dumps(content))
        return path

    return write


def test_a_setup_names_its_settings(studio, tmp_path):
    studio(lambda device: device["rawDataCaptureConfig"].pop("rlDevLaneEnable_t"))
    path = tmp_path / "bench.setup.json"
    setup = {"mmWaveDevice": "awr1843", "configUsed": "C:\\radar\\bench.mmwave.json"}
    path.write_text(json.dumps(setup))
    assert read_studio(path) == EXPECTED
    path.write_text(json.dumps(setup | {"mmWaveDevice": "awr2944"}))
    assert read_studio(path).lanes is None
    logging = {"DCA1000Config": {"dataLoggingMode": "multi"}}
    path.write_text(json.dumps(setup | logging))
    with pytest.raises(InputError, match="raw mode"):
        read_studio(path)
    path.write_text(json.dumps(setup | {"configUsed": "C:\\other.mmwave.json"}))
    with pytest.raises(InputError, match="no file"):
        read_studio(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("rfConfig"), "expected the keys of mmWave Studio"),
        (lambda d: d["rfConfig"].update(waveformType="advancedFrameChirp"), "legacyFrameChirp"),
        (lambda d: d["rfConfig"].update(rlProfiles=[]), "one defined profile"),
        (
            lambda d: d["rfConfig"]["rlChirps"][1]["rlChirpCfg_t"].update(idleTimeVar_usec=1.0),
            "chirps that differ",
        ),
        (
            lambda d: d["rfConfig"]["rlChirps"][1]["rlChirpCfg_t"].update(txEnable="0x6"),
            "one transmitter per chirp",
        ),
        (
            lambda d: d["rfConfig"]["rlFrameCfg_t"].update(numLoops="many"),
            "expected the keys",
        ),
        (
            lambda d: d["rawDataCaptureConfig"]["rlDevDataFmtCfg_t"].update(chInterleave=0),
            "expected chInterleave 1 with 2 LVDS lanes, got 0",
        ),
        (
            lambda d: d["rawDataCaptureConfig"].update(
                rlDevDataPathCfg_t={"transferFmtPkt0": "0x9"}
            ),
            "packets of samples only",
        ),
        (
            lambda d: d["rawDataCaptureConfig"]["rlDevLaneEnable_t"].update(laneEn="0x7"),
            "lanes to be one of 2, 4, got 3",
        ),
    ],
)
def test_studio_settings_that_cannot_be_used_are_refused(studio, change, message):
    with pytest.raises(InputError, match=message):
        read_studio(studio(change))


@pytest.mark.parametrize("named", [False, True])
def test_lists_of_one_may_be_objects(studio, named):
    """As MATLAB writes them: the item itself, or items by names."""

    def alone(items):
        return {f"item{i}": item for i, item in enumerate(items)} if named else items[0]

    path = studio()
    content = json.loads(path.read_text())
    (device,) = content["mmWaveDevices"]
    device["rfConfig"]["rlProfiles"] = alone(device["rfConfig"]["rlProfiles"])
    if named:
        device["rfConfig"]["rlChirps"] = alone(device["rfConfig"]["rlChirps"])
    path.write_text(json.dumps({"mmWaveDevices": alone([device])}))
    assert read_studio(path) == EXPECTED
    path.write_text(json.dumps({"mmWaveDevices": "one"}))
    with pytest.raises(InputError, match="expected the keys of mmWave Studio"):
        read_studio(path)


def test_a_cascade_and_broken_json_are_refused(studio, tmp_path):
    path = studio()
    content = json.loads(path.read_text())
    (device,) = content["mmWaveDevices"]
    path.write_text(json.dumps({"mmWaveDevices": [device] * 2}))
    with pytest.raises(InputError, match="one device, got 2; name a file"):
        read_studio(path)
    path.write_text(json.dumps({"mmWaveDevices": []}))
    with pytest.raises(InputError, match="one device, got none; connect"):
        read_studio(path)
    for count in (1, 4):
        device["rfConfig"]["rlChanCfg_t"]["cascading"] = 1
        path.write_text(json.dumps({"mmWaveDevices": [device] * count}))
        with pytest.raises(InputError, match=f"those of a cascade of {count}"):
            read_studio(path)
    path.write_text(path.read_text()[:-10])
    with pytest.raises(InputError, match="expected JSON"):
        read_studio(path)
    path.write_text("[1]")
    with pytest.raises(InputError, match="expected an object"):
        read_studio(path)
