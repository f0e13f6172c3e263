"""Errors of recordings whose texts take more than a line: those of refusals.toml."""

from typing import Any

from invertwin.constants import read_table
from invertwin.errors import InputError


def refusal(name: str, *values: Any) -> InputError:
    """Make the error of bad input.

    Args:
        name: Section and key of refusals.toml, such as ``capture.sizes``.
        values: What its text leaves open.
    """
    return InputError(refusal_text(name, *values))


def refusal_text(name: str, *values: Any) -> str:
    """Make the text of an error or a warning.

    Args:
        name: Section and key of refusals.toml, such as ``capture.sizes``.
        values: What the text leaves open.
    """
    section, key = name.split(".")
    return read_table("invertwin.capture", "refusals.toml")[section][key].format(*values)
