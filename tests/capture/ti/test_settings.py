"""Settings files of the SDK and of mmWave Studio: read, written, refused."""

import json
import math
from dataclasses import replace

import pytest
import torch

from invertwin.capture import ChirpData, ChirpSettings, make_settings
from invertwin.capture.ti import (
    add_demo_times,
    read_cfg,
    read_settings,
    read_studio,
    write_cfg,
    write_studio,
)
from invertwin.errors import InputError, PhysicsWarning
from invertwin.radar import FMCW

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
profileCfg 0 77.005 7 6.5 57 0 0 70 1 256 5209 0 0 30
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
    start_frequency=77.005e9,
    slope=70e12,
    sample_rate=5.209e6,
    samples=256,
    transmit_order=(1, 3, 2),
    receivers=(1, 2, 3, 4),
    loops=16,
    frame_period=0.1005,
    idle_time=7e-6,
    adc_start_time=6.5e-6,
    ramp_end_time=57e-6,
    swap_iq=True,
    lanes=2,
)
CASES = [
    EXPECTED,
    replace(EXPECTED, frames=12, receivers=(1, 3), swap_iq=False, real=True),
    replace(EXPECTED, lanes=4, bits=12, transmit_order=(2,)),
    replace(EXPECTED, start_frequency=60.0025e9, real=True, loops=255, frame_period=0.0493),
    replace(EXPECTED, slope=29.982e12, adc_start_time=0.0, bits=14),
    replace(EXPECTED, range_bias=0.07, channel_factors=[[[0.5, -0.25]] * 4] * 3),
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


ALTERNATING = "compRangeBiasAndRxChanPhase 0.05 " + "1 0 0.5 -0.25 " * 6


def test_a_cfg_calibrates_its_channels(cfg):
    """Of TX3, second in the order of sending, RX2 and RX4 have the factor that follows them."""
    settings = read_cfg(cfg("lowPower 0 0", ALTERNATING))
    assert settings.range_bias == 0.05
    ones = torch.ones(1, 1, 3, 4, 256, dtype=torch.complex64)
    beat = ChirpData(ones.expand(1, 16, -1, -1, -1), settings).beat[0, 0]
    assert torch.allclose(beat[1, 1] / beat[1, 0], torch.tensor(0.5 - 0.25j), atol=1e-6)
    # A bias of 5 cm turns the phase by 4π · 0.05 m · step / c from one sample to the next.
    step = beat[0, 0, 1] / beat[0, 0, 0]
    expected = -4 * math.pi * 0.05 * settings.waveform.step / 299792458
    assert math.isclose(math.atan2(step.imag, step.real), expected, rel_tol=1e-4)
    receivers = read_cfg(cfg("lowPower 0 0", "antPhaseRot " + "1 -1 1 1 " * 3))
    receivers = replace(receivers, receivers=(2, 4), transmit_order=(3,))
    assert receivers.correction[0, :, 0].tolist() == [-1, 1]
    assert read_cfg(cfg("lowPower 0 0", "antPhaseRot " + "1 " * 12)) == EXPECTED
    with pytest.raises(InputError, match=r"factors of 3 TX and 4 RX, got \(2, 4\)"):
        read_cfg(cfg("lowPower 0 0", "antPhaseRot " + "1 -1 " * 4))
    with pytest.raises(InputError, match="numbers as arguments"):
        read_cfg(cfg("lowPower 0 0", "compRangeBiasAndRxChanPhase 0.05 1 0 1"))


def test_a_reflector_appears_in_its_direction_through_channels_of_both_signs(cfg):
    """The IWR6843AOP feeds half of its elements from the other side: their fields are reversed."""
    settings = read_cfg(cfg("lowPower 0 0", "antPhaseRot " + "1 -1 " * 6))
    plain = replace(settings, channel_factors=())
    signs = torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None]
    echo = torch.exp(2j * torch.pi * 0.1 * torch.arange(256)).to(torch.complex64)
    recorded = (signs * echo).expand(1, 16, 3, -1, -1)
    assert torch.allclose(ChirpData(recorded, settings).beat, echo.expand(1, 16, 3, 4, -1))
    assert not torch.allclose(ChirpData(recorded, plain).beat, echo.expand(1, 16, 3, 4, -1))


@pytest.mark.parametrize(
    ("power", "phase", "message"),
    [
        ("394758", "0", None),  # 6 dB each, as in people tracking
        ("1536", "0", r"power back-off \[dB\] {'TX1': 0, 'TX3': 0, 'TX2': 6}: directions"),
        ("0", "3145728", r"phase \[5.625°\] {'TX1': 0, 'TX3': 12, 'TX2': 0}"),
    ],
)
def test_transmitters_that_differ_are_a_warning(cfg, power, phase, message):
    path = cfg("57 0 0 70", f"57 {power} {phase} 70")
    if message is None:
        assert read_cfg(path) == EXPECTED
    else:
        with pytest.warns(PhysicsWarning, match=message):
            assert read_cfg(path) == EXPECTED


def test_unknown_commands_are_named_in_one_warning(cfg):
    path = cfg("lowPower 0 0", "stirSoup 1 2\ncfarCfg -1 0 2 8\nboilEggs 3")
    with pytest.warns(
        PhysicsWarning, match=r"ignored stirSoup \(line 16\), boilEggs \(line 18\)"
    ) as said:
        assert read_cfg(path) == EXPECTED
    assert len(said) == 1


def test_unknown_platforms_have_no_lanes(cfg):
    assert read_cfg(cfg("xWR18xx", "AWR294X")).lanes is None
    side_by_side = cfg("adcbufCfg -1 0 1 1 1", "% Platform:xWR14xx\nadcbufCfg -1 0 1 0 1")
    assert read_cfg(side_by_side).lanes == 4


@pytest.mark.parametrize("settings", CASES)
def test_settings_survive_a_cfg(tmp_path, settings):
    path = tmp_path / "written.cfg"
    write_cfg(path, settings)
    assert read_cfg(path) == settings
    whole = path.read_bytes()
    write_cfg(path, read_cfg(path))
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    ("start", "lanes", "device"), [(60e9, 2, "xWR68xx"), (77e9, 2, "xWR18xx"), (77e9, 4, "xWR14xx")]
)
def test_a_cfg_names_a_device_of_its_band(tmp_path, start, lanes, device):
    path = tmp_path / "written.cfg"
    write_cfg(path, replace(EXPECTED, start_frequency=start, lanes=lanes))
    assert path.read_text().splitlines()[0] == f"% Platform:{device}"


def test_a_cfg_names_the_device_of_the_board(tmp_path):
    path = tmp_path / "written.cfg"
    two = replace(EXPECTED, transmit_order=(1, 2))
    write_cfg(path, two, "xWR1642")
    assert path.read_text().splitlines()[0] == "% Platform:xWR16xx"
    assert read_cfg(path) == two


@pytest.mark.parametrize(
    ("device", "changes", "message"),
    [
        # 77.005 GHz + 70 MHz/µs · 57.14 µs = 81.0048 GHz
        ("", {"ramp_end_time": 57.14e-6}, r"end of the ramp \[GHz\] is 81.0048, not 77 to 81"),
        ("", {"start_frequency": 76.9e9}, r"end of the ramp \[GHz\] is 80.89, not 76 to 78"),
        ("IWR6843ISK", {}, r"no xWR68xx .*start frequency \[GHz\] is 77.005, not 60 to 64"),
        (
            "",
            {
                "slope": 101e12,
                "start_frequency": 77e9,
                "adc_start_time": 0.0,
                "ramp_end_time": 39e-6,
                "samples": 200,
            },
            r"slope \[MHz/µs\] is 101, not 0 to 100$",
        ),
        (
            "xWR1642",
            {"sample_rate": 6.3e6, "transmit_order": (1, 2)},
            r"complex samples \[Msps\] is 6.3, not 2 to 6.25$",
        ),
        ("xWR1642", {}, "number of a transmitter is 3, not 1 to 2$"),
        # 2 · 2 · 1025 · 4
        (
            "xWR1443",
            {
                "samples": 1025,
                "lanes": 4,
                "sample_rate": 18e6,
                "ramp_end_time": 57e-6 + 9e-6,
                "slope": 60e12,
            },
            r"memory of a chirp \[byte\] is 16400, not 1 to 16384$",
        ),
        ("", {"idle_time": 0.0}, r"idle time \[µs\] is 0, not 2 to 5242.87$"),
        ("", {"loops": 256}, "loops is 256, not 1 to 255$"),
        ("", {"frames": 65536}, "frames is 65536, not 0 to 65535$"),
        # 16 · 3 · 64 µs = 3.072 ms of chirps
        ("", {"frame_period": 3.3e-3}, r"pause .* \[ms\] is 0.228, not 0.3 to 1342$"),
        ("", {"frame_period": None}, r"pause after the chirps of a frame \[ms\] is -3.072"),
    ],
)
def test_a_cfg_that_no_device_takes_is_a_warning(tmp_path, device, changes, message):
    path, settings = tmp_path / "written.cfg", replace(EXPECTED, **changes)
    with pytest.warns(PhysicsWarning, match=message):
        write_cfg(path, settings, device)
    assert read_cfg(path) == settings


def test_times_of_the_demos_keep_what_is_sampled(tmp_path):
    """6 µs of 13 to 20 µs of idle time become that to the ADC start, if the band reaches."""
    waveform = FMCW(61e9, 2e9, 40e-6, 128)
    settings = make_settings(waveform, 3, 4, loops=16, idle_time=20e-6, lanes=2)
    timed = add_demo_times(settings)
    assert (timed.adc_start_time, timed.idle_time) == (6e-6, 14e-6)
    assert timed.start_frequency == pytest.approx(61e9 - 6 * 50e6)
    assert timed.waveform.start_frequency == pytest.approx(61e9)
    assert timed.chirps == settings.chirps
    assert timed.frame_period == 4e-3  # 16 · 3 · 60 µs = 2.88 ms, and 0.3 ms
    write_cfg(tmp_path / "timed.cfg", timed)
    assert read_cfg(tmp_path / "timed.cfg").chirps.interval == pytest.approx(60e-6)
    assert add_demo_times(timed) == timed
    # 60.1 GHz - 2 µs · 50 MHz/µs is the end of the band; 9 µs of idle time leave 2 µs, too.
    for start, idle in ((60.1e9, 20e-6), (61e9, 9e-6)):
        less = replace(settings, start_frequency=start, idle_time=idle, frame_period=0.1)
        assert add_demo_times(less).adc_start_time == pytest.approx(2e-6)
        assert add_demo_times(less).frame_period == 0.1
    # A 77 GHz device has no room below 77 GHz for a ramp that ends above 78 GHz.
    high = replace(settings, start_frequency=77e9)
    assert add_demo_times(high).adc_start_time == 0
    assert add_demo_times(replace(high, slope=20e12)).adc_start_time == 6e-6


@pytest.mark.parametrize("settings", CASES[:-1])  # it has no place for a calibration
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
        ("profileCfg 0 77.005", "profileCfg 0 high", "numbers as arguments in profile.cfg"),
        ("frameCfg 0 2 16 0 100.5 1 0", "frameCfg 0 2", "at least 5 arguments of frameCfg"),
        ("frameCfg 0 2", "frameCfg 0 3", "got none for 3"),
        ("chirpCfg 1 1 0 0 0 0 0 4", "chirpCfg 1 1 0 0 0 0 0 5", "one transmitter per chirp"),
        ("chirpCfg 1 1 0 0 0 0 0 4", "chirpCfg 1 1 0 0 0 0 0 0", "got 0 in chirp 1"),
        ("chirpCfg 1 1 0 0 0 0 0 4", "chirpCfg 1 1 0 0 0 0 0 1", "once per loop"),
        ("chirpCfg 1 1 0 0", "chirpCfg 1 1 0 100", "chirps that differ"),
        ("chirpCfg 1 1 0", "chirpCfg 1 1 1", "one defined profile"),
        ("channelCfg 15 7", "channelCfg 15 3", r"got TX \{3\}"),
        ("adcCfg 2 1", "adcCfg 7 1", "0 or 1 or 2, got 7 in line 9"),
        ("lvdsStreamCfg -1 0", "lvdsStreamCfg -1 1", "headers"),
        ("lvdsStreamCfg -1 0 1", "lvdsStreamCfg -1 0 4", "0 or 1, got 4 in line 18 .*quality data"),
        ("lvdsStreamCfg -1 0 1 0", "lvdsStreamCfg -1 0 1 1", "the demo's own results"),
        ("lowPower 0 0", "subFrameCfg 0 0 0 3 64", "line 16 .subFrameCfg 0 0 0 3 64.; sub-frames"),
        ("lowPower 0 0", "contModeCfg 77 0 0 9000", "continuous chirps"),
        ("dfeDataOutputMode 1", "dfeDataOutputMode 3", "expected 1, got 3 in line 7"),
        ("channelCfg 15 7 0", "channelCfg 15 7 1", "a device of a cascade"),
        ("lowPower 0 0", "bpmCfg -1 1 0 1", "alternating signs"),
        ("lowPower 0 0", "bpmCfgAdvanced 0 1 2", "false range rates"),
        ("adcbufCfg -1 0", "adcbufCfg -1 1", "format 0 as adcCfg says, .* got 1 and 1"),
        ("adcbufCfg -1 0 1 1", "adcbufCfg -1 0 1 0", "interleaving 1 as the device does, got 0"),
        (" 57 ", " 40 ", "ramp of at least"),
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
