"""Units, channel masks and the order of transmitters, common to both kinds of settings file."""

import re
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from string import Template
from typing import Any

from invertwin.capture.chirps import ChirpSettings, shortest_loop
from invertwin.constants import read_table
from invertwin.refusals import refusal

FIELDS = read_table("invertwin.capture.ti", "fields.toml")
"""Names and places of numbers in both kinds of file."""
# Numbers of a profile, and the power of ten of the units in which both kinds of file have them.
_PROFILE: dict[str, int] = FIELDS["profile"]
_MAX_CHIRPS = 512  # that a front end can define
BITS = {0: 12, 1: 14, 2: 16}
"""Code → resolution of the ADC."""
BIT_CODES = {bits: code for code, bits in BITS.items()}


def scale_decimal(number: str | float | Decimal, exponent: int) -> float:
    """number · 10^exponent, without the rounding of a float product.

    Args:
        number: a decimal number.
        exponent: power of ten.
    """
    return float(Decimal(str(number)).scaleb(exponent))


def format_decimal(number: float, exponent: int = 0) -> str:
    """number · 10^exponent as plain decimals; `scale_decimal` gives the same float back.

    Args:
        number: a number in SI units.
        exponent: power of ten.
    """
    return f"{Decimal(repr(float(number))).scaleb(exponent).normalize():f}"


def bits_to_numbers(mask: int) -> tuple[int, ...]:
    """Numbers from 1 of the bits that are set."""
    return tuple(bit + 1 for bit in range(mask.bit_length()) if mask >> bit & 1)


def numbers_to_bits(chosen: Sequence[int]) -> int:
    """The bits of these numbers from 1."""
    return sum(1 << (number - 1) for number in chosen)


def device_family(device: str) -> str:
    """First two digits of a device such as xWR1843 or xWR18xx; none if it is not known."""
    match = re.search(r"[xai]wr(\d\d)", device.lower())
    return match.group(1) if match and match.group(1) in FIELDS["devices"] else ""


def device_lanes(device: str) -> int | None:
    """LVDS lanes of a device; None if its name does not say, as of those with several links."""
    family = device_family(device)
    return FIELDS["devices"][family]["lanes"] if family else None


def fill_file(
    kind: str, chirp_settings: ChirpSettings, mask: str, separator: str, **values: Any
) -> str:
    """Text of a file of settings.

    Args:
        kind: "cfg" or "studio", the file of `fields.toml`.
        chirp_settings: settings to write.
        mask: format of a mask of elements.
        separator: text between two chirps.
        values: further values of the file.
    """
    s = chirp_settings
    numbers = vars(s) | {"ramp_end_time": s.ramp_time}
    chirp = Template(FIELDS[f"{kind}_chirp"])
    chirps = (
        chirp.substitute(number=number, transmitters=format(numbers_to_bits([tx]), mask))
        for number, tx in enumerate(s.transmit_order)
    )
    return Template(FIELDS[f"{kind}_file"]).substitute(
        {name: format_decimal(numbers[name], -exponent) for name, exponent in _PROFILE.items()},
        receivers=format(numbers_to_bits(s.receivers), mask),
        transmitters=format(numbers_to_bits(s.transmit_order), mask),
        bits=BIT_CODES[s.bits],
        complex=int(not s.real),
        real=int(s.real),
        swap=int(s.swap_iq),
        blocks=int(s.lanes != 4),
        chirps=separator.join(chirps),
        last=len(s.transmit_order) - 1,
        loops=s.loops,
        frames=s.frames or 0,
        period=format_decimal(s.frame_period or 0, 3),
        **values,
    )


def frame_settings(
    profiles: Mapping[int, Any],
    keys: Sequence[Any],
    chirps: Iterable[tuple[int, int, int, int, bool]],
    frame: Sequence[Any],
    **values: Any,
) -> ChirpSettings:
    """Make settings of one frame as files describe it.

    Args:
        profiles: profile number → its numbers.
        keys: where a profile has the numbers of `[profile]`.
        chirps: first and last chirp, their profile, mask of their transmitters, and whether they
            vary from the profile.
        frame: first and last chirp, loops, frames (0 = endless), period [ms].
        values: further fields of `ChirpSettings`.

    Raises:
        InputError: a chirp that is not defined or varies, with no or several transmitters, or
            several profiles in one loop.
    """
    defined: dict[int, tuple[int, int]] = {}
    for first, last, profile, senders, varies in chirps:
        if varies:
            raise refusal("chirp_table.variations", first, last)
        _check_numbers(first, last)
        defined |= dict.fromkeys(range(first, last + 1), (profile, senders))
    first, last, loops, frames = (int(number) for number in frame[:4])
    _check_numbers(first, last)
    order, used = _transmit_order(defined, first, last)
    if len(used) != 1 or not used <= set(profiles):
        raise refusal("chirp_table.profiles", sorted(used), sorted(profiles))
    profile = profiles[used.pop()]
    for (name, exponent), key in zip(_PROFILE.items(), keys, strict=True):
        values[name] = scale_decimal(profile[key], exponent)
    values["samples"] = int(values["samples"])
    order, loops = shortest_loop(order, loops)
    return ChirpSettings(
        transmit_order=order,
        loops=loops,
        frames=frames or None,
        frame_period=scale_decimal(frame[4], -3) or None,
        **values,
    )


def _check_numbers(first: int, last: int) -> None:
    if not 0 <= first <= last < _MAX_CHIRPS:
        raise refusal("chirp_table.chirps", _MAX_CHIRPS - 1, first, last)


def _transmit_order(
    defined: Mapping[int, tuple[int, int]], first: int, last: int
) -> tuple[list[int], set[int]]:
    """Return the transmitter of each chirp of a loop, and the profiles in use."""
    order, used = [], set()
    for chirp in range(first, last + 1):
        if chirp not in defined:
            raise refusal("chirp_table.missing_chirp", first, last, chirp)
        profile, enabled = defined[chirp]
        senders = bits_to_numbers(enabled)
        if len(senders) != 1:
            raise refusal("chirp_table.transmitters", len(senders), chirp)
        order.append(senders[0])
        used.add(profile)
    return order, used
