"""What both kinds of settings file share: numbers in other units, masks, turns of transmitters."""

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

from invertwin.capture.chirps import ChirpSettings, shortest_loop
from invertwin.errors import InputError
from invertwin.scene.files import existing_file

# By the first two digits of the device; later ones record through several kinds of link.
_LANES = {"12": 4, "14": 4, "16": 2, "18": 2, "68": 2}


def scaled(number: str | float | Decimal, exponent: int) -> float:
    """number · 10^exponent, without the rounding of a float product.

    Args:
        number: a decimal number.
        exponent: power of ten.
    """
    return float(Decimal(str(number)).scaleb(exponent))


def text(number: float, exponent: int = 0) -> str:
    """number · 10^exponent as plain decimals; `scaled` gives the same float back.

    Args:
        number: a number in SI units.
        exponent: power of ten.
    """
    return f"{Decimal(repr(float(number))).scaleb(exponent).normalize():f}"


def numbers(mask: int) -> tuple[int, ...]:
    """Numbers from 1 of the bits that are set."""
    return tuple(bit + 1 for bit in range(mask.bit_length()) if mask >> bit & 1)


def mask(chosen: Sequence[int]) -> int:
    """The bits of these numbers from 1."""
    return sum(1 << (number - 1) for number in chosen)


def read_text(path: Path, what: str) -> str:
    """The file as text.

    Args:
        path: the file.
        what: what it should be, for the error.

    Raises:
        InputError: no such file, or one that is no text.
    """
    existing_file(path, what)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"expected {what}, got {path}, which is no text; name the settings, not the data"
        ) from error


def lanes_of(device: str) -> int | None:
    """LVDS lanes of a device such as xWR1843 or xWR18xx; None if the name does not say."""
    match = re.search(r"[xai]wr(\d\d)", device.lower())
    return _LANES.get(match.group(1)) if match else None


def transmit_order(
    chirps: Mapping[int, tuple[int, int]], first: int, last: int, profiles: Sequence[int]
) -> tuple[tuple[int, ...], int]:
    """Find which transmitter sends in each chirp of a loop, and in which profile.

    Args:
        chirps: chirp number → profile, transmitter mask.
        first: first chirp of the loop.
        last: last chirp of the loop.
        profiles: those that the file defines.

    Returns:
        transmitter numbers in the order of the chirps, and the profile.

    Raises:
        InputError: a chirp that is not defined, with no or several transmitters, or several
            profiles in one loop.
    """
    order, used = [], set()
    for chirp in range(first, last + 1):
        if chirp not in chirps:
            raise InputError(
                f"expected chirps {first} to {last} of the frame to be defined, got none for "
                f"{chirp}; the settings are incomplete"
            )
        profile, enabled = chirps[chirp]
        senders = numbers(enabled)
        if len(senders) != 1:
            raise InputError(
                f"expected one transmitter per chirp (TDM), got {len(senders)} in chirp {chirp}; "
                "chirps with several at once (BPM, beamforming, DDMA) are not supported"
            )
        order.append(senders[0])
        used.add(profile)
    if len(used) != 1 or not used <= set(profiles):
        raise InputError(
            f"expected one defined profile in all chirps of the frame, got {sorted(used)} of "
            f"{sorted(profiles)}; several profiles in one frame are not supported"
        )
    return tuple(order), used.pop()


def settings(
    order: tuple[int, ...], loops: int, frames: int, period_ms: Any, **values: Any
) -> ChirpSettings:
    """Make settings of a frame as files count: 0 frames are endless, repeated orders are loops.

    Args:
        order: transmitters in their order of sending.
        loops: how often the order is sent in a frame.
        frames: number of frames; 0 = endless.
        period_ms: time between the starts of two frames [ms].
        values: further fields of `ChirpSettings`.
    """
    order, loops = shortest_loop(order, loops)
    return ChirpSettings(
        transmit_order=order,
        loops=loops,
        frames=frames or None,
        frame_period=scaled(period_ms, -3) or None,
        **values,
    )
