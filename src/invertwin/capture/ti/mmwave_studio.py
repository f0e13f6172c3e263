"""Settings that mmWave Studio saves: `.mmwave.json` (the device) and `.setup.json` (the bench)."""

import json
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path, PureWindowsPath
from typing import Any

from invertwin.capture.chirps import ChirpSettings
from invertwin.capture.ti import chirp_table
from invertwin.errors import InputError, locate_errors
from invertwin.refusals import refusal
from invertwin.storage.folders import replace_file, write_text_file
from invertwin.storage.untrusted import convert_read_errors, existing_file, read_text, safe_reader

# Names of the numbers of a profile, of chirps, and of the frame.
_PROFILE = chirp_table.FIELDS["studio_profile"]
_CHIRP = ("chirpStartIdx", "chirpEndIdx", "profileId")
_FRAME = ("chirpStartIdx", "chirpEndIdx", "numLoops", "numFrames", "framePeriodicity_msec")
_VARIATIONS = chirp_table.FIELDS["studio_variations"]


@safe_reader("settings of mmWave Studio", "save them again with mmWave Studio")
def read_studio(path: str | Path) -> ChirpSettings:
    """Read the settings of a `.mmwave.json` file, or of the one that a `.setup.json` file names.

    A setup names its files by their absolute path on the PC that recorded them; where that does
    not exist, the file of that name beside the setup is taken.

    Raises:
        InputError: no file, no JSON, a key that is missing, or settings that are not supported:
            several devices (cascade), several transmitters at once, several profiles, chirps that
            differ, frames with sub-frames.
    """
    path = Path(path)
    content = _load_json(path)
    device = ""
    if "configUsed" in content:
        device = str(content.get("mmWaveDevice", ""))
        mode = (content.get("DCA1000Config") or {}).get("dataLoggingMode", "raw")
        do = "files of other modes have headers and are not read"
        _require_equal(mode, "raw", "a recording in raw mode (dataLoggingMode)", do)
        path = _sibling_path(path, str(content["configUsed"]))
        content = _load_json(path)
    do = "save the settings again with mmWave Studio"
    with locate_errors(path.name), convert_read_errors(path, "the keys of mmWave Studio", do):
        return _parse_settings(content, device)


@safe_reader("a setup of mmWave Studio", "save it again with mmWave Studio")
def setup_files(path: str | Path) -> list[Path]:
    """Find the raw files that a `.setup.json` file names, in the order of recording.

    Raises:
        InputError: no file, no JSON, or none that names raw files.
    """
    path = Path(path)
    content = _load_json(path)
    try:
        captured = content["capturedFiles"]
        names = [str(file["rawFileName"]) for file in _list_items(captured["files"], "rawFileName")]
        base = str(captured.get("fileBasePath", ""))
    except (KeyError, TypeError):
        names, base = [], ""
    if not names:
        raise refusal("mmwave_studio.files", path.name)
    return [_sibling_path(path, str(PureWindowsPath(base) / name)) for name in names]


def _load_json(path: Path) -> dict[str, Any]:
    whole = read_text(path, "a .json file of mmWave Studio")
    with convert_read_errors(path, "JSON"):
        content = json.loads(whole, parse_float=Decimal)
    if not isinstance(content, dict):
        raise refusal("mmwave_studio.object", path, type(content).__name__)
    return content


def _sibling_path(path: Path, named: str) -> Path:
    # The name of a file on Windows or on this machine.
    return Path(named) if Path(named).is_file() else path.parent / PureWindowsPath(named).name


def _parse_settings(content: dict[str, Any], device: str) -> ChirpSettings:
    found = _single_device(content["mmWaveDevices"])
    radio, record = found["rfConfig"], found["rawDataCaptureConfig"]
    kind = radio.get("waveformType", "legacyFrameChirp")
    _require_equal(kind, "legacyFrameChirp", "legacyFrameChirp", "other frames are not supported")
    sent = (record.get("rlDevDataPathCfg_t") or {}).get("transferFmtPkt0", "0x1")
    do = "record without chirp parameters and quality data"
    _require_equal(_parse_integer(sent), 1, "packets of samples only (transferFmtPkt0 1)", do)
    layout, lanes = record["rlDevDataFmtCfg_t"], chirp_table.device_lanes(device)
    if "rlDevLaneEnable_t" in record:
        enabled = _parse_integer(record["rlDevLaneEnable_t"]["laneEn"])
        lanes = len(chirp_table.bits_to_numbers(enabled))
    if lanes in (2, 4):
        # 0 = receivers interleaved, as through 4 lanes; 1 = one after the other, as through 2.
        order, what = int(lanes == 2), f"chInterleave {int(lanes == 2)} with {lanes} LVDS lanes"
        _require_equal(int(layout["chInterleave"]), order, what, "other orders are not supported")
    profiles = _list_items(radio["rlProfiles"], "rlProfileCfg_t")
    profiles = [item["rlProfileCfg_t"] for item in profiles]
    chirps = []
    for item in _list_items(radio["rlChirps"], "rlChirpCfg_t"):
        chirp = item["rlChirpCfg_t"]
        first, last, profile = (int(chirp[key]) for key in _CHIRP)
        varies = any(float(chirp.get(name, 0)) for name in _VARIATIONS)
        chirps.append((first, last, profile, _parse_integer(chirp["txEnable"]), varies))
    frame, output = radio["rlFrameCfg_t"], radio["rlAdcOutCfg_t"]["fmt"]
    return chirp_table.frame_settings(
        {int(profile["profileId"]): profile for profile in profiles},
        _PROFILE,
        chirps,
        [frame[key] for key in _FRAME],
        receivers=chirp_table.bits_to_numbers(_parse_integer(radio["rlChanCfg_t"]["rxChannelEn"])),
        real=int(output["b2AdcOutFmt"]) in (0, 3),
        swap_iq=bool(int(layout["iqSwapSel"])),
        bits=chirp_table.BITS[int(output["b2AdcBits"])],
        lanes=lanes,
    )


def _single_device(written: Any) -> dict[str, Any]:
    """The one device of the settings."""
    devices = _list_items(written, "rfConfig")
    if not devices:
        raise refusal("mmwave_studio.no_device")
    channels = [device["rfConfig"].get("rlChanCfg_t") or {} for device in devices]
    modes = [_parse_integer(own.get("cascading", 0)) for own in channels]
    if any(modes):
        raise refusal("mmwave_studio.cascade", len(devices), ", ".join(map(str, modes)))
    do = "name a file with the device that recorded alone; give samples of several as arrays"
    _require_equal(len(devices), 1, "settings of one device", do)
    return devices[0]


def _list_items(written: Any, key: str) -> list[dict[str, Any]]:
    """The items of a list. MATLAB writes a list of one as the item itself, others by names.

    Args:
        written: A list, an item, or an object of items.
        key: key that every item has.
    """
    if isinstance(written, dict):
        written = [written] if key in written else list(written.values())
    if not isinstance(written, list) or not all(isinstance(item, dict) for item in written):
        raise TypeError(f"{key} in {type(written).__name__}")
    return written


def _require_equal(found: Any, known: Any, what: str, do: str) -> None:
    if found != known:
        raise InputError(f"expected {what}, got {found}; {do}")


def _parse_integer(value: Any) -> int:
    return int(value, 0) if isinstance(value, str) else int(value)


def write_studio(path: str | Path, chirp_settings: ChirpSettings) -> None:
    """Write the `.mmwave.json` that `read_studio` reads.

    Args:
        path: file to write.
        chirp_settings: settings to write.

    Raises:
        InputError: the folder does not exist, or settings without a number of lanes.
    """
    s = chirp_settings
    if s.lanes is None:
        raise InputError("expected settings with 2 or 4 lanes, got none; set lanes")
    text = chirp_table.fill_file("studio", s, "#x", ",\n", lane_mask=hex(2**s.lanes - 1))
    write_text_file(path, text)


def write_setup(path: str | Path, settings: str | Path, recordings: Sequence[str | Path]) -> None:
    """Write a `.setup.json` that names its settings and raw files. They must lie beside it.

    Args:
        path: the setup.
        settings: the `.mmwave.json` file.
        recordings: the `.bin` files in the order of recording.

    Raises:
        InputError: the folder does not exist, or a file that is not in it.
    """
    path = Path(path)
    with replace_file(path) as part:
        for name in (Path(file).name for file in (settings, *recordings)):
            existing_file(path.parent / name, f"{name} beside {path}")
        names = [{"rawFileName": Path(file).name, "processedFileName": ""} for file in recordings]
        files = {"numFilesCollected": len(names), "fileBasePath": "", "files": names}
        setup = {
            "configUsed": Path(settings).name,
            "captureHardware": "DCA1000",
            "DCA1000Config": {"dataLoggingMode": "raw"},
            "capturedFiles": files,
        }
        part.write_text(json.dumps(setup, indent=2) + "\n", encoding="utf-8")
