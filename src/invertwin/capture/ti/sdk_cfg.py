"""Settings files (`.cfg`) of the mmWave SDK and its demos: one command per line."""

import warnings
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from invertwin.capture.chirps import ChirpSettings
from invertwin.capture.ti import chirp_table, device_limits
from invertwin.errors import InputError, PhysicsWarning
from invertwin.refusals import refusal, refusal_text
from invertwin.storage.folders import write_text_file
from invertwin.storage.untrusted import read_text, safe_reader

# What commands mean to samples: fewest arguments, required values, and what is ignored on purpose.
_ARGUMENTS = chirp_table.FIELDS["arguments"]
_IGNORED = {name for names in chirp_table.FIELDS["ignored"].values() for name in names}
_UNIQUE_COMMANDS = ("channelCfg", "adcCfg", "frameCfg")
# Places of the numbers of a profile in its command.
_PROFILE = (1, 2, 3, 4, 7, 9, 10)
_ONES = ["1", "0"] * 4  # factors of a device's receivers
# Place, shift in the byte of a transmitter, and name of what a profile may do to each.
_TRANSMIT = ((5, 0, "power back-off [dB]"), (6, 2, "phase [5.625°]"))


@safe_reader("settings of the mmWave SDK", "compare with the SDK's user guide")
def read_cfg(path: str | Path) -> ChirpSettings:
    """Read the settings of a `.cfg` file of the SDK 1 to 3 or the MCU+ SDK.

    `compRangeBiasAndRxChanPhase` and `antPhaseRot` become a calibration of the channels. A comment
    such as ``% Platform:xWR18xx`` names the device, which tells the number of lanes. In MCU+ SDK
    files (AWR2944), `frameCfg` repeats the number of samples before the period. Commands that only
    set up what the demo computes are ignored (`fields.toml` lists them).

    Warns (`PhysicsWarning`) of commands that are not known, and of transmitters that differ in
    power or phase.

    Raises:
        InputError: no file, a command that is missing or cannot be understood, or one that asks for
            what is not supported: several transmitters at once, several profiles, chirps that
            differ, sub-frames, headers in the stream.
    """
    path = Path(path)
    lines = read_text(path, "a .cfg file of the mmWave SDK").splitlines()
    found: dict[str, list[list[str]]] = {}
    platform, unknown = "", []
    try:
        for number, line in enumerate(lines, 1):
            if line.lstrip().startswith("%"):
                platform = line.partition(":")[2] if "platform" in line.lower() else platform
            elif words := line.split("%")[0].split():
                _check_command(number, *words)
                found.setdefault(words[0], []).append(words[1:])
                if words[0] not in _ARGUMENTS and words[0] not in _IGNORED:
                    unknown.append(f"{words[0]} (line {number})")
        read = _parse_settings(found, chirp_table.device_lanes(platform))
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    except (ValueError, ArithmeticError) as error:
        raise refusal("sdk_cfg.numbers", path.name, error) from error
    messages = _compare_transmitters(found["profileCfg"], read.transmit_order)
    if unknown:
        messages.append(f"ignored {', '.join(unknown)}, not known here: they may change samples")
    for message in messages:
        warnings.warn(f"{path.name}: {message}", PhysicsWarning, stacklevel=2)
    return read


def _check_command(number: int, command: str, *arguments: str) -> None:
    """Refuse a line whose samples would mean something that is not supported."""
    line = f"line {number} ({' '.join((command, *arguments))[:60]})"
    if len(arguments) < (count := _ARGUMENTS.get(command, 0)):
        raise refusal("sdk_cfg.arguments", count, command, len(arguments), line)
    for rule in chirp_table.FIELDS["required"]:
        given = arguments[rule["place"] :][:1] if rule["command"] == command else ()
        if given and given[0] not in rule["values"]:
            allowed = " or ".join(rule["values"])
            raise InputError(f"expected {allowed}, got {given[0]} in {line}; {rule['why']}")


def _compare_transmitters(profiles: list[list[str]], order: tuple[int, ...]) -> list[str]:
    """Describe how the transmitters in use differ in power and phase."""
    found = []
    for profile, (place, shift, what) in product(profiles, _TRANSMIT):
        code = int(float(profile[place]))
        each = {f"TX{tx}": code >> 8 * (tx - 1) + shift & 0xFF >> shift for tx in order}
        if len(set(each.values())) > 1:
            found.append(refusal_text("sdk_cfg.different_transmitters", profile[0], what, each))
    return found


def _read_calibration(found: dict[str, list[list[str]]]) -> dict[str, Any]:
    """Calibration of the channels: `compRangeBiasAndRxChanPhase` times `antPhaseRot`."""
    bias, *numbers = found.get("compRangeBiasAndRxChanPhase", [["0", *_ONES]])[-1]
    signs = found.get("antPhaseRot", [["1"] * 4])[-1]
    factors = np.array(numbers, float).reshape(-1, 4, 2) * np.array(signs, float).reshape(-1, 4, 1)
    applied = bool((factors != (1, 0)).any())
    return {"range_bias": float(bias), "channel_factors": factors.tolist() if applied else ()}


def _parse_settings(found: dict[str, list[list[str]]], lanes: int | None) -> ChirpSettings:
    for command in (*_UNIQUE_COMMANDS, "profileCfg", "chirpCfg"):
        if command not in found:
            raise refusal("sdk_cfg.command", command)
    channel, adc, frame = (found[command][-1] for command in _UNIQUE_COMMANDS)
    chirps = [
        (int(first), int(last), int(profile), int(tx, 0), any(map(float, variations)))
        for first, last, profile, *variations, tx in (chirp[:8] for chirp in found["chirpCfg"])
    ]
    # MCU+ SDK: first, last, loops, frames, samples, period, trigger, delay.
    samples = int(frame.pop(4)) if len(frame) >= 8 else None
    bits, kind = int(adc[0]), int(adc[1])
    # Since SDK 2 a sub-frame number comes first: format, order of I and Q, and of the receivers.
    buffer = found.get("adcbufCfg", [[]])[-1]
    real, swap, blocks = (int(n) for n in buffer[-4:-1]) if buffer else (kind == 0, 0, lanes != 4)
    if bool(real) != (kind == 0) or (lanes and bool(blocks) != (lanes == 2)):
        raise refusal("sdk_cfg.buffer", int(kind == 0), int(lanes != 4), real, blocks)
    read = chirp_table.frame_settings(
        {int(profile[0]): profile for profile in found["profileCfg"]},
        _PROFILE,
        chirps,
        frame,
        receivers=chirp_table.bits_to_numbers(int(channel[0], 0)),
        real=kind == 0,
        swap_iq=bool(swap),  # 1 = Q in the lower half word
        bits=chirp_table.BITS[bits],
        lanes=lanes,
        **_read_calibration(found),
    )
    unused = set(read.transmit_order) - set(chirp_table.bits_to_numbers(int(channel[1], 0)))
    if unused:
        raise refusal("sdk_cfg.transmitters", unused)
    if samples not in (None, read.samples):
        raise refusal("sdk_cfg.samples", read.samples, samples)
    return read


def write_cfg(path: str | Path, chirp_settings: ChirpSettings, device: str = "") -> None:
    """Write what `read_cfg` reads. What the settings do not hold is written as in TI's demos.

    Warns (`PhysicsWarning`) of what the device cannot do; `fields.toml` has its limits.

    Args:
        path: file to write.
        chirp_settings: settings to write.
        device: name of the board, such as xWR1642; none = one of the lanes and the band.

    Raises:
        InputError: the folder does not exist.
    """
    s = chirp_settings
    family = device_limits.recording_family(s, device)
    if excess := device_limits.describe_excess(s, family):
        message = f"no xWR{family}xx records the settings of {Path(path).name}: "
        warnings.warn(message + "; ".join(excess), PhysicsWarning, stacklevel=2)
    factors = s.channel_factors or [_ONES] * max(3, *s.transmit_order)
    numbers = [s.range_bias, *np.ravel(factors).astype(float)]
    calibration = " ".join(map(chirp_table.format_decimal, numbers))
    text = chirp_table.fill_file("cfg", s, "d", "\n", calibration=calibration)
    named = f"% Platform:xWR{family}xx\n" if s.lanes else ""
    write_text_file(path, named + text)
