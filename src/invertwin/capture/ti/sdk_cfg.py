"""Settings files (`.cfg`) of the mmWave SDK and its demos: one command per line."""

from pathlib import Path

from invertwin.capture.chirps import ChirpSettings
from invertwin.capture.ti import chirp_table
from invertwin.errors import InputError
from invertwin.storage.folders import replace_file
from invertwin.storage.untrusted import read_text, safe_reader

# Fewest arguments of the commands that are read.
_ARGUMENTS = chirp_table.FIELDS["arguments"]
_UNIQUE_COMMANDS = ("channelCfg", "adcCfg", "frameCfg")
_BAND_EDGE = 70e9  # Hz, between the devices of 60 and 77 GHz
# Places of the numbers of a profile in its command.
_PROFILE = (1, 2, 3, 4, 7, 9, 10)


@safe_reader("settings of the mmWave SDK", "compare with the SDK's user guide")
def read_cfg(path: str | Path) -> ChirpSettings:
    """Read `channelCfg`, `adcCfg`, `profileCfg`, `chirpCfg` and `frameCfg` of a `.cfg` file.

    `adcbufCfg` tells the order of I and Q, if the file has it. A comment such as
    ``% Platform:xWR18xx`` names the device, which tells the number of lanes. All other commands
    set up what the demo computes; they are ignored. In MCU+ SDK files (AWR2944), `frameCfg` repeats
    the number of samples before the period.

    Raises:
        InputError: no file, a command that is missing or cannot be understood, or one that asks for
            what is not supported: several transmitters at once, several profiles, chirps that
            differ, sub-frames, headers in the stream.
    """
    path = Path(path)
    lines = read_text(path, "a .cfg file of the mmWave SDK").splitlines()
    found: dict[str, list[list[str]]] = {}
    platform = ""
    for line in lines:
        stripped = line.strip()
        if stripped.startswith("%"):
            if "platform" in stripped.lower():
                platform = stripped.partition(":")[2]
            continue
        if stripped:
            command, *arguments = stripped.split("%")[0].split()
            found.setdefault(command, []).append(arguments)
    if "advFrameCfg" in found or "subFrameCfg" in found:
        raise InputError(
            f"expected one kind of frame (frameCfg) in {path.name}, got advFrameCfg; "
            "sub-frames are not supported"
        )
    try:
        return _parse_settings(found, chirp_table.device_lanes(platform))
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    except (ValueError, ArithmeticError) as error:
        raise InputError(
            f"expected numbers as arguments in {path.name}, got others ({error}); "
            "compare with the SDK's user guide"
        ) from error


def _parse_settings(found: dict[str, list[list[str]]], lanes: int | None) -> ChirpSettings:
    for command in (*_UNIQUE_COMMANDS, "profileCfg", "chirpCfg"):
        if command not in found:
            raise InputError(
                f"expected a line {command}, got none; the settings are incomplete, or no .cfg file"
            )
    for command, count in _ARGUMENTS.items():
        for arguments in found.get(command, []):
            if len(arguments) < count:
                raise InputError(
                    f"expected at least {count} arguments of {command}, got {len(arguments)}; "
                    "the line is incomplete"
                )
    channel, adc, frame = (found[command][-1] for command in _UNIQUE_COMMANDS)
    chirps = [
        (int(first), int(last), int(profile), int(tx, 0), any(map(float, variations)))
        for first, last, profile, *variations, tx in (chirp[:8] for chirp in found["chirpCfg"])
    ]
    # MCU+ SDK: first, last, loops, frames, samples, period, trigger, delay.
    samples = int(frame.pop(4)) if len(frame) >= 8 else None
    for arguments in found.get("lvdsStreamCfg", []):
        if int(arguments[1]):
            raise InputError(
                "expected a stream of samples only, got headers (lvdsStreamCfg); record without"
            )
    bits, kind = int(adc[0]), int(adc[1])
    if bits not in chirp_table.BITS or kind not in (0, 1, 2):
        raise InputError(
            f"expected adcCfg with bits 0 to 2 and format 0 to 2, got {bits} and {kind}; "
            "see the SDK's user guide"
        )
    read = chirp_table.frame_settings(
        {int(profile[0]): profile for profile in found["profileCfg"]},
        _PROFILE,
        chirps,
        frame,
        receivers=chirp_table.bits_to_numbers(int(channel[0], 0)),
        real=kind == 0,
        # SampleSwap: 1 = Q in the lower half word. Since SDK 2 a sub-frame number comes first.
        swap_iq="adcbufCfg" in found and bool(int(found["adcbufCfg"][-1][-3])),
        bits=chirp_table.BITS[bits],
        lanes=lanes,
    )
    unused = set(read.transmit_order) - set(chirp_table.bits_to_numbers(int(channel[1], 0)))
    if unused:
        raise InputError(
            f"expected chirps of the transmitters that channelCfg enables, got TX {unused}; "
            "enable them or correct chirpCfg"
        )
    if samples not in (None, read.samples):
        raise InputError(
            f"expected {read.samples} samples in frameCfg as in profileCfg, got {samples}; "
            "the two commands contradict each other"
        )
    return read


def write_cfg(path: str | Path, chirp_settings: ChirpSettings) -> None:
    """Write what `read_cfg` reads. What the settings do not hold is written as in TI's demos.

    Args:
        path: file to write.
        chirp_settings: what to write.

    Raises:
        InputError: the folder does not exist.
    """
    s = chirp_settings
    devices = {2: "xWR68xx" if s.start_frequency < _BAND_EDGE else "xWR18xx", 4: "xWR1443"}
    start, idle, adc, end, slope, samples, rate = chirp_table.profile_texts(s)
    receivers = chirp_table.numbers_to_bits(s.receivers)
    lines = [
        *([f"% Platform:{devices[s.lanes]}"] if s.lanes else []),
        "sensorStop",
        "flushCfg",
        "dfeDataOutputMode 1",
        f"channelCfg {receivers} {chirp_table.numbers_to_bits(s.transmit_order)} 0",
        f"adcCfg {chirp_table.BIT_CODES[s.bits]} {int(not s.real)}",
        f"adcbufCfg -1 {int(s.real)} {int(s.swap_iq)} 1 1",
        f"profileCfg 0 {start} {idle} {adc} {end} 0 0 {slope} 0 {samples} {rate} 0 0 30",
        *(
            f"chirpCfg {i} {i} 0 0 0 0 0 {chirp_table.numbers_to_bits([tx])}"
            for i, tx in enumerate(s.transmit_order)
        ),
        f"frameCfg 0 {len(s.transmit_order) - 1} {s.loops} {s.frames or 0} "
        f"{chirp_table.format_decimal(s.frame_period or 0, 3)} 1 0",
        "lvdsStreamCfg -1 0 1 0",
        "sensorStart",
    ]
    with replace_file(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
